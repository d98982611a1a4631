"""What the integrator does to what is identified: logs of MuJoCo, parameters by varpin.

    PYTHONPATH=src python benchmarks/identification.py            # the table of docs/identification.md
    PYTHONPATH=src python benchmarks/identification.py --claims   # coverage of the deviations, a Panda, times

A UR5 with six dampers and 2 kg at its flange follows sums of sines, under torques that are held for 10 ms. MuJoCo
simulates it by its Runge-Kutta method at 0.1 ms (extra `peers`). The scene begins without dampers and payload.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable

import mujoco
import numpy as np
import peers

import varpin as vp

DAMPING = np.array([2.0, 1.5, 1.0, 0.3, 0.2, 0.1])  # [N m s/rad]
PAYLOAD, NOISE = 2.0, 2e-4  # [kg], [rad]
PERIOD, FINE = 1e-2, 1e-4  # [s]
NAMES = ("damping", "payload")
METHODS = (vp.SemiImplicitEuler(), vp.Midpoint(), vp.RungeKutta4(), vp.Gauss(2))

Law = Callable[[float, np.ndarray, np.ndarray], np.ndarray]


def ur5() -> tuple[vp.Scene, vp.Scene, np.ndarray]:
    """The arm that is logged, the scene to begin with, and the middle of the motion."""
    robot = vp.load_robot("ur5", payload=vp.Payload("tool0", PAYLOAD))
    middle = np.array([0.0, -1.2, 1.2, -0.5, 0.5, 0.0])
    return vp.Scene(robot, damping=DAMPING), vp.Scene(vp.load_robot("ur5"), damping=0.0), middle


def tracking(scene: vp.Scene, middle: np.ndarray, seed: int) -> Law:
    """Computed torques within their limits along sums of sines of 0.3 to 2 Hz, which grow from rest in a second."""
    n, rng, limit = scene.robot.dof, np.random.default_rng(seed), scene.robot.effort_limit
    phase, rate = rng.uniform(0.0, 2.0 * np.pi, (3, n)), rng.uniform(0.3, 2.0, (3, n))
    size = 0.2 * rng.uniform(0.5, 1.0, (3, n)) / rate

    def law(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        goal = middle + min(t, 1.0) * np.sum(size * np.sin(2.0 * np.pi * rate * t + phase), axis=0)
        M = scene.core.jets(q[None], v[None])[0][0]
        torque = scene.holding_torque(q) + M @ (200.0 * (goal - q) - 20.0 * v) + scene.damping * v
        return np.clip(torque, -limit, limit)

    return law


def mujoco_log(scene: vp.Scene, q0: np.ndarray, law: Law, duration: float) -> vp.Log:
    """The log of a motion from rest by MuJoCo, without noise."""
    model = peers.mujoco_model(scene, FINE, "RK4", actuators="motors")
    data, K = mujoco.MjData(model), round(duration / PERIOD)
    data.qpos[:] = q0
    q, u = np.empty((K + 1, len(q0))), np.empty((K + 1, len(q0)))
    for k in range(K + 1):
        q[k], u[k] = data.qpos, law(k * PERIOD, data.qpos.copy(), data.qvel.copy())
        data.ctrl[:] = u[k]
        mujoco.mj_step(model, data, nstep=round(PERIOD / FINE))
    return vp.Log(PERIOD * np.arange(K + 1), q, u)


def with_noise(log: vp.Log, seed: int) -> vp.Log:
    return vp.Log(log.t, log.q + NOISE * np.random.default_rng(seed).standard_normal(log.q.shape), log.u)


def table() -> None:
    """Errors of the worst damper and of the payload in percent, from a log without noise."""
    truth, begin, middle = ur5()
    log = mujoco_log(truth, middle, tracking(truth, middle, 3), 4.0)
    again = vp.identify(truth, log, NAMES, q_noise=NOISE, dt=5e-3, integrator=vp.Gauss(3), delay=0.0)
    apart, moved = np.abs(log.q - again.predicted_before[0]).max(), np.abs(again.values - again.start).max()
    print(f"MuJoCo and Gauss(3) with the same parameters differ by {apart:.0e} rad, their parameters by {moved:.0e}")
    noisy = vp.identify(begin, with_noise(log, 0), NAMES, q_noise=NOISE, delay=0.0)
    spread = 100.0 * noisy.deviations / noisy.values
    print(f"deviations by the encoders: {spread[:6].max():.2g} % of the worst damper, {spread[6]:.2g} % of the payload")
    print("\n| | " + " | ".join(f"{1e3 * dt:g} ms" for dt in (5e-3, 1e-2, 2e-2)) + " |\n|---|---|---|---|")
    for method in METHODS:
        cells = []
        for dt in (5e-3, 1e-2, 2e-2):
            found = vp.identify(begin, log, NAMES, q_noise=NOISE, dt=dt, integrator=method, delay=0.0)
            off = 100.0 * np.abs(found.values / np.append(DAMPING, PAYLOAD) - 1.0)
            told = "" if found.warnings else ", silent"
            cells.append(f"{off[:6].max():.2g} %, {off[6]:.2g} %{told}")
        print(f"| `{method}` | {' | '.join(cells)} |")


def coverage(logs: int = 200) -> None:
    """How often values are within 1.96 of their deviations, and what an identification takes."""
    truth, begin, middle = ur5()
    exact = mujoco_log(truth, middle, tracking(truth, middle, 3), 4.0)
    off, seconds = [], []
    for seed in range(logs):
        started = time.process_time()
        found = vp.identify(begin, with_noise(exact, seed), NAMES, q_noise=NOISE)
        seconds.append(time.process_time() - started)
        off.append((found.values - np.append(DAMPING, PAYLOAD)) / found.deviations)
    within, worst = np.mean(np.abs(off) < 1.96), np.abs(off).max()
    payload = np.abs(np.array(off)[:, 6]).max() * found.deviations[6] / PAYLOAD
    print(f"{logs} logs: {100 * within:.1f} % within 1.96 deviations, the farthest at {worst:.1f}; payload within "
          f"{100 * payload:.3f} %; {np.median(seconds):.2f} s of processor time each")  # fmt: skip


def panda() -> None:
    """Inertias of all links from three logs of a Panda whose links differ from its URDF's; a fourth is predicted."""
    nominal = vp.load_robot("panda", lock={"panda_finger_joint1": 0.0})
    rng, model = np.random.default_rng(1), nominal.model.copy()
    for inertia in list(model.inertias)[1:]:
        inertia.mass *= 1.0 + 0.3 * rng.uniform(-1.0, 1.0)
        inertia.lever = inertia.lever * (1.0 + 0.3 * rng.uniform(-1.0, 1.0, 3))
        inertia.inertia = inertia.inertia * (1.0 + 0.2 * rng.uniform(-1.0, 1.0))
    damping = np.full(nominal.dof, 0.5)
    truth = vp.Scene(nominal.changed(model=model, inertials=()), damping=damping)
    middle = np.array([0.0, -0.5, 0.0, -1.9, 0.2, 1.6, 0.4])
    logs = [with_noise(mujoco_log(truth, middle, tracking(truth, middle, seed), 4.0), seed) for seed in range(4)]
    begin, started = vp.Scene(nominal, damping=damping), time.process_time()
    found = vp.identify(begin, logs[:3], "inertia", q_noise=NOISE, held_out=logs[3])
    seconds = time.process_time() - started
    before = vp.identify(begin, logs[3], "damping:panda_joint1", q_noise=NOISE, delay=0.0, evaluations=1)
    rms = [np.sqrt(np.mean(np.square(each))) for each in (found.held_out[0], logs[3].q - before.predicted_before[0])]
    print(f"Panda: {len(found.names)} numbers, {len(found.null_space)} combinations not told; rms of a held-out motion "
          f"{rms[0]:.2e} rad, with the URDF's {rms[1]:.2e} ({rms[1] / rms[0]:.0f} times); {seconds:.1f} s")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--claims", action="store_true", help="coverage, a Panda, times")
    logging.disable(logging.WARNING)
    if parser.parse_args().claims:
        panda()
        coverage()
    else:
        table()


if __name__ == "__main__":
    main()
