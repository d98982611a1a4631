"""Model predictive control of a UR5 at 100 Hz: what planning takes, and how far the tool is from its moving target.

    python benchmarks/mpc.py

The task of examples/mpc_moving_target.py: 50 nodes of 10 ms ahead, one iteration a tick, on a plant that RungeKutta4
integrates at a tenth of the step. Once without surprises, once under noise, and once with noise and a payload of 0.3 kg
that the controller does not know; budget 10 ms, so that a plan that comes later does not act. Writes the table of
``docs/control-loop.md`` between its markers.
"""

import gc
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pages import fill

import varpin as vp

DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "control-loop.md"
BEGIN = np.array([0.0, -1.5, 1.2, -1.2, -1.5, 0.0])
SEEDS = range(4)
NOISE = vp.AdditiveNoise(0.02)


def target(t: float) -> list[float]:
    """Where the flange is to be [m]."""
    return [0.45 + 0.1 * np.sin(2.0 * t), 0.15 + 0.15 * np.cos(1.3 * t), 0.4 + 0.1 * np.sin(1.7 * t)]


def controller(robot: vp.Robot, integrator: vp.Integrator) -> vp.Mpc:
    scene = vp.Scene(robot, damping=0.05)
    hold = -vp.lagrangian_jet(scene, BEGIN, np.zeros(robot.dof)).Lq
    cost = vp.FramePositionCost(robot, "tool0", target, 1e3) + vp.VelocityCost(0.05) + vp.ControlCost(1e-4, hold)
    cost += vp.Terminal(vp.FramePositionCost(robot, "tool0", target, 1e2) + vp.VelocityCost(0.5))
    rest = np.zeros(robot.dof)
    problem = vp.OptimalControlProblem(scene, cost, BEGIN, rest, dt=1e-2, steps=50, integrator=integrator)
    return vp.Mpc(problem, iterations=1, budget=1e-2)


def off_target(robot: vp.Robot, motion: vp.Trajectory) -> float:
    """Root mean square distance of the tool from the target after the first second [mm]."""
    late = motion.t > 1.0
    tip = robot.frame_positions(motion.q[late], "tool0")
    error = np.linalg.norm(tip - [target(t) for t in motion.t[late]], axis=1)
    return float(1e3 * np.sqrt((error**2).mean()))


def row(name: str, mpc: vp.Mpc, plants: dict[str, vp.Scene], robot: vp.Robot) -> str:
    mpc.run(duration=0.05)
    # A full pass of the garbage collector over all that has been imported takes 0.1 s.
    gc.freeze()
    seconds, misses, cells = [], 0, []
    for scene in plants.values():
        off = []
        for seed in SEEDS if scene.processes else range(1):
            run = mpc.run(vp.Plant(scene), duration=4.0, rng=seed)
            off.append(off_target(robot, run.motion))
            seconds.append(run.seconds[1:])
            misses += run.misses
        spread = f" ± {np.std(off, ddof=1) / np.sqrt(len(off)):.2f}" if len(off) > 1 else ""
        cells.append(f"{np.mean(off):.2f}{spread}")
    took = 1e3 * np.concatenate(seconds)
    times = f"{took.mean():.2f} | {np.quantile(took, 0.95):.2f} | {took.max():.2f} | {misses} of {len(took)}"
    return f"| {name} | {times} | {' | '.join(cells)} |"


def main() -> None:
    robot, heavier = vp.load_robot("ur5"), vp.load_robot("ur5", payload=vp.Payload("tool0", mass=0.3))
    make: Callable[..., vp.Scene] = vp.Scene
    plants = {
        "as modelled": make(robot, damping=0.05),
        "noise": make(robot, damping=0.05, noise=NOISE),
        "noise and payload": make(heavier, damping=0.05, noise=NOISE),
    }
    integrators = {
        "Midpoint": vp.Midpoint(),
        "SemiImplicitEuler": vp.SemiImplicitEuler(),
        "ExplicitEuler": vp.ExplicitEuler(),
    }
    table = [
        f"| plans with | mean [ms] | 95% [ms] | most [ms] | late | {' | '.join(f'{name} [mm]' for name in plants)} |",
        "|---" * (5 + len(plants)) + "|",
        *(row(name, controller(robot, integrator), plants, robot) for name, integrator in integrators.items()),
    ]
    print("\n".join(table))
    fill(DOCUMENT, {"mpc": "\n".join(table)})


if __name__ == "__main__":
    main()
