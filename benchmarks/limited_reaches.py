"""Random reaches of six arms at their limits: servos whose drives saturate, and linear controls within tight speeds.

    python benchmarks/limited_reaches.py

Prints a row for each plan: how its search ended, and after how many iterations.
"""

import logging

import numpy as np

import varpin as vp

ARMS = ("ur5", "panda", "z1", "ur10", "ur3", "kinova")
# Distance of a goal from its joints' limits, and the limit of joints without one [rad or m].
INSIDE, TURN = 0.1, 3.1


def reach(robot, seed, far):
    """Begin and goal (n,) of a random reach by ``far`` in every joint, as far as its limits allow."""
    rng, n = np.random.default_rng(seed), robot.dof
    lower, upper = np.clip(robot.position_limits, -TURN, TURN) + np.array([[INSIDE], [-INSIDE]])
    begin = np.clip(0.5 * rng.normal(size=n), lower, upper)
    return begin, np.clip(begin + far * rng.choice([-1, 1], size=n), lower, upper)


def served(name, seed, share):
    """A reach on servos of 20 rad/s, critically damped, whose drives have a share of the arm's effort limits.

    They have at least 1.3 times what holds the arm at its goal.
    """
    robot = vp.load_robot(name)
    begin, goal = reach(robot, seed, 0.6)
    still, rest = vp.Scene(robot, damping=0), np.zeros(robot.dof)
    inertia = np.diag(vp.lagrangian_jet(still, begin, rest).Lvv)
    effort = np.maximum(share * robot.effort_limit, 1.3 * np.abs(still.holding_torque(goal)))
    scene = vp.Scene(robot, damping=0, forces=[vp.PositionServo(400.0 * inertia, 40.0 * inertia, effort)])
    cost = vp.ControlCost(1e-2, reference=goal) + vp.VelocityCost(1e-3)
    cost += vp.Terminal(vp.TrackingCost(goal, 1e2) + vp.VelocityCost(1.0))
    return vp.OptimalControlProblem(scene, cost, begin, rest, dt=0.02, steps=50)


def within(name, seed, limit):
    """A reach with linear controls, all of whose joints may be no faster than ``limit``."""
    robot = vp.load_robot(name)
    begin, goal = reach(robot, seed, 0.7)
    cost = vp.ControlCost(1e-4) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost(goal, 1e2) + vp.VelocityCost(1.0))
    return vp.OptimalControlProblem(
        vp.Scene(robot, damping="robot"),
        cost,
        begin,
        np.zeros(robot.dof),
        dt=0.04,
        steps=25,
        controls="linear",
        constraints=[vp.WithinVelocityLimits(robot, (-limit, limit))],
    )


def main():
    """Print a row for each plan."""
    logging.disable(logging.WARNING)
    row = "{:44} {:>14} {:>10} {:>12}"
    for made, sizes, words in ((served, (0.15, 0.3), "drives of {:g} of its efforts"), (within, (0.4, 0.8), "{:g} /s")):
        print(row.format(made.__doc__.split(",")[0], "status", "iterations", "cost"))
        for name in ARMS:
            for seed in (0, 1):
                for size in sizes:
                    plan = vp.solve(made(name, seed, size), check=False, max_iterations=1000)
                    said = f"{name}, seed {seed}, {words.format(size)}"
                    print(row.format(said, plan.status.name.lower(), plan.iterations, f"{plan.cost:.7g}"), flush=True)


if __name__ == "__main__":
    main()
