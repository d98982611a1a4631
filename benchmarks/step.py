"""One whole Midpoint step inside ``simulate`` against one Python call of Pinocchio and of MuJoCo.

Everything is measured in one run, interleaved, and reported as ratios: times on shared machines differ between
runs, their ratios far less. MuJoCo takes part where it is installed (``pip install "varpin[peers]"``).

    python benchmarks/step.py
"""

from collections.abc import Callable

import numpy as np
import pinocchio as pin
from peers import mujoco_model
from timing import in_turns

import varpin as vp

ROUNDS = 25
STEPS = 20_000


def simulate(scene: vp.Scene, q0: np.ndarray, dt: float) -> Callable[[], object]:
    """STEPS steps of one simulate call: solver, guards, energy and recording included; no look."""
    options = {"dt": dt, "steps": STEPS, "integrator": vp.Midpoint(), "check": False}
    return lambda: vp.simulate(scene, q0, np.zeros_like(q0), **options)


def rnea_derivatives(robot: vp.Robot, q0: np.ndarray) -> Callable[[], object]:
    """STEPS Python calls of pin.computeRNEADerivatives."""
    model = robot.model
    data, q, v = model.createData(), robot.configuration(q0), np.zeros(model.nv)

    def run() -> None:
        for _ in range(STEPS):
            pin.computeRNEADerivatives(model, data, q, v, v)

    return run


def mujoco_step(links: int, dt: float) -> Callable[[], object] | None:
    """STEPS Python calls of mujoco.mj_step on a planar chain, or None without MuJoCo."""
    model = mujoco_model(vp.Scene(vp.planar_chain(links)), dt)
    if model is None:
        return None
    import mujoco  # noqa: PLC0415

    data = mujoco.MjData(model)

    def run() -> None:
        mujoco.mj_resetData(model, data)
        for _ in range(STEPS):
            mujoco.mj_step(model, data)

    return run


def best(runs: dict[str, Callable[[], object]]) -> dict[str, float]:
    """The fastest of ROUNDS rounds of each, in microseconds a step."""
    return {name: 1e6 * own.min() / STEPS for name, own in in_turns(runs, ROUNDS).items()}


def main() -> None:
    print(
        f"{'robot':12} {'n':>2} {'dt [s]':>7} {'step [us]':>10} {'its':>5} {'RNEA derivatives [us]':>22} {'ratio':>6}"
    )
    for name, q0 in (("finger", [0.5, 0.3, 0.2]), ("ur5", [0.1] * 6), ("xarm7", [0.1] * 7), ("talos_arm", [0.1] * 7)):
        robot = vp.load_robot(name)
        scene, start = vp.Scene(robot, gravity=(0.0, -9.81, 0.0) if name == "finger" else True), np.array(q0)
        for dt in (1e-3,):
            motion = vp.simulate(scene, start, np.zeros(robot.dof), dt=dt, steps=STEPS, integrator=vp.Midpoint())
            times = best({"step": simulate(scene, start, dt), "rnea": rnea_derivatives(robot, start)})
            iterations = motion.statistics.newton_iterations.mean()
            ratio = times["step"] / times["rnea"]
            print(f"{name:12} {robot.dof:2d} {dt:7.0e} {times['step']:10.2f} {iterations:5.2f}", end="")
            print(f" {times['rnea']:22.2f} {ratio:6.2f}")
    for links in (3, 7):
        run = mujoco_step(links, 1e-3)
        if run is None:
            print("MuJoCo is not installed")
            return
        scene = vp.Scene(vp.planar_chain(links))
        times = best({"step": simulate(scene, np.zeros(links), 1e-3), "mujoco": run})
        print(
            f"chain of {links}: step {times['step']:.2f} us, mj_step (Euler) {times['mujoco']:.2f} us, "
            f"ratio {times['step'] / times['mujoco']:.2f}"
        )


if __name__ == "__main__":
    main()
