"""Time of a Midpoint step against the number of joints, with matrices and by elimination from the leaves.

Where the two cross is what ``body_cost``, ``pair_cost`` and ``block_cost`` in src/core/include/varpin/elimination.hpp
are about: they are fitted to the dense times here, in units of the time of elimination for a joint. Chains with mimic
joints are what ``tied_cost`` and ``slot_cost`` are fitted to, against chains without. MuJoCo's mj_step
(Euler) takes part where it is installed (``pip install "varpin[peers]"``).

    python benchmarks/joints.py
"""

import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin
from peers import mujoco_model

import varpin as vp
from varpin.core import Solver, VariationalRollout
from varpin.core.arrays import new_nodes
from varpin.signals.commands import open_loop

LINKS = (3, 6, 10, 15, 20, 30, 60, 100, 200, 1000)
# Joints that follow, in chains of so many links; how many.
TIED_LINKS = (20, 30, 45, 60, 100)
TIES = (1, 2, 4)
ROBOTS = ("ur5", "talos_arm", "allegro_left_hand")
MOST_DENSE = 200
ROUNDS = 10
DT = 1e-3


def tied_chain(links: int, ties: int) -> vp.Robot:
    """A chain with mimic joints whose spans overlap."""
    model = vp.planar_chain(links).model
    for leader in range(3, 3 + ties):
        model = pin.transformJointIntoMimic(model, leader, leader + ties, -0.7, 0.1)
    return vp.load_robot(model)


def steps_for(dof: int) -> int:
    """As many as take a few milliseconds."""
    return max(10, 6000 // dof)


def step(scene: vp.Scene, solver: Solver) -> Callable[[], float]:
    """Seconds of a step from near rest, guards and recording included."""
    n, steps = scene.robot.dof, steps_for(scene.robot.dof)
    integrator = vp.Midpoint()
    run = VariationalRollout(
        scene.core, integrator._tableau(), float(integrator.tolerance), integrator._guards(), 1.0, 1, solver
    )
    commands = open_loop(np.zeros((steps, scene.controls)))

    def measured() -> float:
        run.begin(np.full((1, n), 0.05), np.zeros((1, n)))
        nodes = new_nodes(1, steps, n, scene.controls)
        start = time.process_time()
        run.roll(DT, commands, scene.silence, np.empty((0, 0, 0)), nodes)
        return (time.process_time() - start) / steps

    return measured


def mujoco_step(scene: vp.Scene) -> Callable[[], float] | None:
    """Seconds of a Python call of mujoco.mj_step, or None where it cannot."""
    # MuJoCo's reader takes no deeper nesting.
    model = mujoco_model(scene, DT) if scene.robot.dof <= MOST_DENSE else None
    if model is None:
        return None
    import mujoco  # noqa: PLC0415

    data, steps = mujoco.MjData(model), steps_for(scene.robot.dof)

    def measured() -> float:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = 0.05
        start = time.process_time()
        for _ in range(steps):
            mujoco.mj_step(model, data)
        return (time.process_time() - start) / steps

    return measured


def main() -> None:
    header = f"{'robot':20} {'n':>4} {'matrices [us]':>14} {'elimination [us]':>17} {'a joint':>8} {'ratio':>6}"
    print(f"{header} {'mj_step [us]':>13} {'ratio':>6}")
    chains = [(f"chain of {links}", vp.planar_chain(links)) for links in LINKS]
    chains += [(f"chain of {links}, {k} ties", tied_chain(links, k)) for k in TIES for links in TIED_LINKS]
    for name, robot in [*chains, *((name, vp.load_robot(name)) for name in ROBOTS)]:
        scene = vp.Scene(robot)
        runs = {"elimination": step(scene, Solver.elimination)}
        if robot.dof <= MOST_DENSE:
            runs["matrices"] = step(scene, Solver.dense)
        peer = mujoco_step(scene) if name.startswith("chain") and "ties" not in name else None
        if peer is not None:
            runs["mujoco"] = peer
        best = dict.fromkeys(("matrices", "elimination", "mujoco"), np.nan)
        for _ in range(ROUNDS):
            for kind, run in runs.items():
                best[kind] = np.fmin(best[kind], 1e6 * run())
        dense, eliminated, theirs = best.values()
        print(f"{name:20} {robot.dof:4d} {dense:14.2f} {eliminated:17.2f} {eliminated / robot.dof:8.3f}", end="")
        print(f" {dense / eliminated:6.2f} {theirs:13.2f} {np.fmin(dense, eliminated) / theirs:6.2f}")


if __name__ == "__main__":
    main()
