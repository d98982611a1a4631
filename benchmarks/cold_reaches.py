"""Cold reaches of arms that no test has, at 50 nodes: varpin's defaults against crocoddyl's FDDP on RK4's map.

    PYTHONPATH=src python benchmarks/cold_reaches.py

In the environment of plans_race.py. An arm without dampers goes to a posture within a second; both begin with the
torques that hold it at its start, and end where the expected decrease is below 1e-4. Processor times, the best of five
in turns, without the making of problems and without varpin's check of the finished plan.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator

import numpy as np
from native import Dynamics
from plans_race import TOLERANCE, by_crocoddyl, by_varpin, policy_of, timed, true_cost

import varpin as vp

ARMS, SEEDS, NODES, ROUNDS = ("ur3", "so100", "talos_arm"), range(4), 50, 5


def reaches() -> Iterator[tuple[str, vp.OptimalControlProblem]]:
    for name in ARMS:
        robot = vp.load_robot(name)
        lower, upper = (np.clip(limits, -2.0, 2.0) for limits in robot.position_limits)
        for seed in SEEDS:
            rng, n = np.random.default_rng(seed), robot.dof
            begin = 0.5 * (lower + upper) + 0.25 * (upper - lower) * rng.uniform(-1.0, 1.0, n)
            goal = np.clip(begin + 0.6 * rng.uniform(-1.0, 1.0, n), lower, upper)
            cost = vp.ControlCost(1.0 / robot.effort_limit**2) + vp.VelocityCost(0.1)
            cost += vp.Terminal(vp.TrackingCost(goal, 1e3) + vp.VelocityCost(10.0))
            scene = vp.Scene(robot, damping=0)
            yield (
                f"{name} {seed}",
                vp.OptimalControlProblem(scene, cost, begin, np.zeros(n), dt=1.0 / NODES, steps=NODES),
            )


def main() -> None:
    logging.getLogger("varpin").setLevel(logging.ERROR)
    ratios = []
    for name, problem in reaches():
        stop = TOLERANCE * vp.solve(problem, check=False).cost
        runs = by_varpin(problem), by_crocoddyl(problem, Dynamics(problem).shooting(NODES, "RK4"), stop)
        tried = [[timed(run) for run in runs] for _ in range(ROUNDS)]
        ours, theirs = (min(seconds for _, seconds in side) for side in zip(*tried, strict=True))
        true = [true_cost(problem, policy_of(problem, plan), 0.0, plan.cost) for plan, _ in tried[-1]]
        ratios.append(ours / theirs)
        print(f"{name:12} {1e3 * ours:6.1f} ms, FDDP {1e3 * theirs:6.1f} ms, true cost {true[0] / true[1] - 1.0:+.0e}")
    print(f"median ratio {np.median(ratios):.2f}, from {min(ratios):.2f} to {max(ratios):.2f}")


if __name__ == "__main__":
    main()
