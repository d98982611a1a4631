"""Plans within constraints at the nodes alone, and between them, too: iterations, cost, what is left between nodes.

    python benchmarks/between_nodes.py

Violations between nodes are those of the motion in 32 parts of each step, by Gauss' method of four stages.
"""

import numpy as np

import varpin as vp

PARTS = 32


def links(count, goal, limit, *, weights=(1e-4, 1.0), **grid):
    """A planar chain whose joints may be no faster than ``limit``."""
    robot, rest = vp.planar_chain(count), np.zeros(count)
    cost = vp.ControlCost(weights[0]) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost(goal, 1e2) + vp.VelocityCost(weights[1]))
    within = [vp.WithinVelocityLimits(robot, (-limit, limit))]
    return vp.OptimalControlProblem(vp.Scene(robot, damping=0.1), cost, rest, rest, constraints=within, **grid)


def arm(name, obstacle):
    """An arm that turns around a post, or out of a sphere in the middle of its way."""
    panda = name == "panda"
    robot = vp.load_robot(name, lock={"panda_finger_joint1": 0.02} if panda else None)
    begin = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8] if panda else [0.0, -1.2, 1.4, -1.8, -1.57, 0.0])
    end, frame = begin + np.array([1.0, 0.4, -0.3, 0.0, 0.0, 0.0, 0.0][: robot.dof]), "panda_hand" if panda else "tool0"
    cost = vp.ControlCost(1.0 / robot.effort_limit**2) + vp.VelocityCost(0.2)
    cost += vp.Terminal(vp.TrackingCost(end, 100.0) + vp.VelocityCost(100.0))
    middle = robot.frame_positions(0.5 * (begin + end), frame)
    if obstacle == "sphere":
        within = vp.KeepOutOfSphere(robot, frame, center=middle, radius=0.12)
    else:
        post = vp.Obstacle.capsule([*middle[:2], 0.0], [*middle[:2], 0.3], 0.06, name="post")
        wrist = ["forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link"]
        within = vp.KeepClear(robot, [post], 0.02, links=wrist)
    scene, rest = vp.Scene(robot, damping=0.1), np.zeros(robot.dof)
    return vp.OptimalControlProblem(scene, cost, begin, rest, dt=0.05, steps=24, constraints=[within])


def on_lines(name, limit, **grid):
    """A reach of all joints with linear controls."""
    robot = vp.planar_chain(2) if name == "two links" else vp.load_robot(name)
    rest, scene = np.zeros(robot.dof), vp.Scene(robot, damping=0.1)
    cost = vp.ControlCost(1e-4) + vp.VelocityCost(1e-2)
    cost += vp.Terminal(vp.TrackingCost(np.linspace(0.6, -0.6, robot.dof), 1e2) + vp.VelocityCost(1.0))
    within = [vp.WithinVelocityLimits(robot, (-limit, limit))]
    return vp.OptimalControlProblem(scene, cost, rest, rest, controls="linear", constraints=within, **grid)


HELD = {
    "two links within 0.6 rad/s, 100 ms": links(2, [0.6, -0.6], 0.6, dt=0.1, steps=6),
    "UR5 clear of a post, 50 ms": arm("ur5", "post"),
    "UR5 out of a sphere, 50 ms": arm("ur5", "sphere"),
    "Panda out of a sphere, 50 ms": arm("panda", "sphere"),
    "three links within 1.2 rad/s, decisions of two steps of 40 ms": links(
        3, [1.0, 0.5, 0.3], 1.2, weights=(1e-3, 10.0), dt=0.04, steps=30, hold=2, control_limits=(-60.0, 60.0)
    ),
}
LINEAR = {
    "UR10 within 1.2 rad/s, 20 ms": on_lines("ur10", 1.2, dt=0.02, steps=50),
    "UR5 within 0.8 rad/s, 50 ms": on_lines("ur5", 0.8, dt=0.05, steps=20),
    "two links within 0.6 rad/s, 100 ms": on_lines("two links", 0.6, dt=0.1, steps=10),
    "UR3 within 0.6 rad/s, 50 ms": on_lines("ur3", 0.6, dt=0.05, steps=20),
    "UR3 within 0.6 rad/s, 20 ms": on_lines("ur3", 0.6, dt=0.02, steps=50),
}


def between(problem, plan):
    """By how much the motion violates the problem's constraint in all parts of its steps."""
    if problem.linear:
        controls = vp.FirstOrderHold(plan.controls).refined(PARTS)
    else:
        controls = np.repeat(plan.controls, PARTS * problem.hold, axis=0)
    h, steps = problem.dt / PARTS, problem.steps * PARTS
    given = {"dt": h, "steps": steps, "controls": controls, "integrator": vp.Gauss(4), "check": False}
    motion = vp.simulate(problem.scene, problem.q0, problem.v0, **given)
    (bound,) = problem.constraints_on(h, steps, problem.hold * PARTS)
    u = motion.u_nodes if problem.linear else motion.u
    return max(float(bound.value(motion.q, motion.v, u).max()), 0.0)


def main():
    """Print a row for each plan."""
    row = "{:62} {:>10} {:>10} {:>12} {:>10}"
    print(row.format("held controls", "status", "iterations", "cost", "between"))
    for name, problem in HELD.items():
        for kept in (False, True):
            plan = vp.solve(problem.at(between_nodes=kept), check=False)
            cells = plan.status.name.lower(), len(plan.history), f"{plan.cost:.7g}", f"{between(problem, plan):.1e}"
            print(row.format(name if not kept else "    between nodes, too", *cells))
    print(row.format("linear controls", "status", "iterations", "cost", "between"))
    for name, problem in LINEAR.items():
        plan = vp.solve(problem, check=False)
        cells = plan.status.name.lower(), len(plan.history), f"{plan.cost:.7g}", f"{between(problem, plan):.1e}"
        print(row.format(name, *cells))


if __name__ == "__main__":
    main()
