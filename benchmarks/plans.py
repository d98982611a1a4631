"""How the search of a plan goes on a set of tasks: iterations, rollouts, and its cost above the best one known.

    PYTHONPATH=src python benchmarks/plans.py [--best FILE] [--fddp] [words that a task's name has]

Five arms reach, without limits on their torques and within them; one carries a load, one follows a wave, and two links
swing up. Cold starts, all options as they are. ``--best FILE`` keeps the least cost that any run has found, and
compares with it. ``--fddp`` solves each task with crocoddyl's FDDP too, within limits with its BoxFDDP, on the same
steps from the same first motion; it needs the environment of docs/crocoddyl.md. What is counted does not depend on the
machine's load.
"""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pinocchio as pin

import varpin as vp

LOCKS = {"panda": {"panda_finger_joint1": 0.02}, "z1": {"jointGripper": 0.0}}
ARMS = ("z1", "xarm7", "ur5", "panda", "ur10")
FREE = (-np.inf, np.inf)


def postures(robot: vp.Robot, rng: np.random.Generator, far: float) -> tuple[np.ndarray, np.ndarray]:
    """Where a task begins, about the middle of the joints' ranges, and a posture that far away at most [rad]."""
    lower, upper = robot.position_limits
    room = np.minimum(0.5 * (upper - lower), 1.5)
    begin = np.clip(0.5 * (lower + upper), -1.5, 1.5) + 0.5 * room * rng.uniform(-1.0, 1.0, robot.dof)
    goal = begin + far * rng.uniform(-1.0, 1.0, robot.dof)
    return begin, np.clip(goal, lower + 0.05, upper - 0.05)


def at_tool(robot: vp.Robot, goal: np.ndarray, place: float, turn: float) -> vp.Cost:
    """The place and orientation that the last frame has at a posture."""
    model = robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, robot.configuration(goal))
    name, tool = model.frames[model.nframes - 1].name, data.oMf[model.nframes - 1]
    return vp.FramePositionCost(robot, name, tool.translation.copy(), place) + vp.FrameOrientationCost(
        robot, name, tool.rotation.copy(), turn
    )


def effort(robot: vp.Robot, weight: float) -> vp.Cost:
    """On torques in units of the motors' limits."""
    return vp.ControlCost(weight / robot.effort_limit**2)


def of_arms() -> Iterator[tuple[str, vp.OptimalControlProblem]]:
    for place, name in enumerate(ARMS):
        robot = vp.load_robot(name, lock=LOCKS.get(name))
        rng = np.random.default_rng([7, place])
        begin, goal = postures(robot, rng, 0.8)
        speed = vp.VelocityCost(1.0)
        posture = vp.Terminal(vp.TrackingCost(goal, 1e4) + 1e3 * speed)
        costs = {
            "posture": effort(robot, 1.0) + speed + posture,
            "posture, end alone": effort(robot, 0.1) + posture,
            "tool, end alone": effort(robot, 0.1) + vp.Terminal(at_tool(robot, goal, 1e4, 1e3) + 10.0 * speed),
        }
        scene = vp.Scene(robot, damping="robot" if robot.damping.any() else 0.1)
        for kind, cost in costs.items():
            for limit, limits in (("free", FREE), ("limited", (-robot.effort_limit, robot.effort_limit))):
                yield f"{name} {kind}, {limit}", problem(scene, cost, begin, 50, limits)


def others() -> Iterator[tuple[str, vp.OptimalControlProblem]]:
    name = "ur5"
    carrying = vp.load_robot(name, payload=vp.Payload("tool0", 3.0))
    begin, goal = postures(carrying, np.random.default_rng([7, len(ARMS)]), 1.2)
    cost = effort(carrying, 0.1) + vp.Terminal(vp.TrackingCost(goal, 1e4) + vp.VelocityCost(1e3))
    limits = (-carrying.effort_limit, carrying.effort_limit)
    yield f"{name} with 3 kg, limited", problem(vp.Scene(carrying, damping=0.1), cost, begin, 50, limits)

    robot = vp.load_robot("xarm7")
    begin, _ = postures(robot, np.random.default_rng([7, len(ARMS) + 1]), 0.0)
    path = lambda t: begin + 0.4 * np.sin(2.0 * np.pi * np.asarray(t)[..., None] + np.arange(robot.dof))  # noqa: E731
    limits = (-robot.effort_limit, robot.effort_limit)
    cost = effort(robot, 1e-2) + vp.TrackingCost(path, 100.0)
    yield "xarm7 follows a wave, limited", problem(vp.Scene(robot, damping=0.1), cost, begin, 50, limits)

    up, down = np.array([-np.pi / 2, 0.0]), np.array([np.pi / 2, 0.0])
    swing = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
    swing += vp.Terminal(vp.TrackingCost(up, 1e3) + vp.VelocityCost(1e2))
    links = vp.planar_chain(2)
    by_elbow = vp.Scene(links, actuation=["joint2"], damping=0.02)
    yield "swing-up by both joints, free", problem(vp.Scene(links), swing, down, 100, FREE)
    yield "swing-up by both joints, limited", problem(vp.Scene(links), swing, down, 100, (-20.0, 20.0))
    yield "swing-up by the elbow, free", problem(by_elbow, swing, down, 200, FREE)
    yield "swing-up by the elbow, limited", problem(by_elbow, swing, down, 200, (-8.0, 8.0))


def problem(
    scene: vp.Scene, cost: vp.Cost, begin: np.ndarray, steps: int, limits: tuple[object, object]
) -> vp.OptimalControlProblem:
    rest = np.zeros(scene.robot.dof)
    return vp.OptimalControlProblem(scene, cost, begin, rest, dt=0.02, steps=steps, control_limits=limits)


def by_fddp(task: vp.OptimalControlProblem, most: int) -> tuple[int, float]:
    """Iterations and cost of crocoddyl's solver."""
    import crocoddyl  # noqa: PLC0415 - an environment of its own

    from varpin.crocoddyl import first_guess, shooting_problem  # noqa: PLC0415

    solver = (crocoddyl.SolverBoxFDDP if task.limited else crocoddyl.SolverFDDP)(shooting_problem(task))
    solver.th_stop = 1e-7
    solver.solve(*first_guess(task), most, False)
    return min(solver.iter + 1, most), solver.cost


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--best", type=Path, help="a file (JSON) of the least costs known")
    parser.add_argument("--most", type=int, default=100, help="iterations")
    parser.add_argument("--fddp", action="store_true", help="crocoddyl's iterations and costs, too")
    parser.add_argument("words", nargs="*", help="of the tasks' names")
    asked = parser.parse_args()
    logging.getLogger("varpin").setLevel(logging.ERROR)
    best = json.loads(asked.best.read_text()) if asked.best and asked.best.exists() else {}
    print(f"{'task':36} {'status':15} {'iterations':>10} {'rollouts':>8} {'passes':>6} {'cost':>11} {'above best':>10}")
    total, theirs = np.zeros(4, dtype=int), 0
    for name, task in (*of_arms(), *others()):
        if not all(word in name for word in asked.words):
            continue
        plan = vp.solve(task, check=False, max_iterations=asked.most)
        counts = [sum(getattr(row, what) for row in plan.history) for what in ("rollouts", "backward_passes")]
        best[name] = min(best.get(name, np.inf), plan.cost)
        total += [plan.status.converged, plan.iterations, *counts]
        print(
            f"{name:36} {plan.status.name:15} {plan.iterations:10d} {counts[0]:8d} {counts[1]:6d} {plan.cost:11.5g} "
            f"{plan.cost / best[name] - 1.0:10.1e}",
            flush=True,
        )
        if asked.fddp:
            iterations, cost = by_fddp(task, asked.most)
            theirs += iterations
            print(f"{'':36} {'FDDP':15} {iterations:10d} {'':15} {cost:11.5g}", flush=True)
    print(f"{'all':36} {total[0]:3d} converged   {total[1]:10d} {total[2]:8d} {total[3]:6d}")
    if asked.fddp:
        print(f"{'all':36} {'FDDP':15} {theirs:10d}")
    if asked.best:
        asked.best.write_text(json.dumps(best, indent=1))


if __name__ == "__main__":
    main()
