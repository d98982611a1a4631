"""Twenty plans of four robots within hard constraints, five of them with obstacles: violations, optimality, effort.

    python benchmarks/plan_constraints.py

Optimality is the gradient of the Lagrangian in the controls, by differences of the cost and the constraints of motions
along random directions, relative to the slopes of what the cost is the sum of, without their signs.
"""

import time

import numpy as np

import varpin as vp

ARMS = {
    "ur5": ([0.0, -1.2, 1.4, -1.8, -1.57, 0.0], [1.0, 0.2, -0.3, 0.2, 0.3, 0.4], "tool0"),
    "panda": ([0.0, -0.6, 0.0, -2.2, 0.0, 1.8, 0.7], [0.9, 0.4, 0.2, 0.4, -0.2, 0.3, 0.4], None),
    "kinova": ([0.3, 2.6, 1.6, 0.5, 1.0, 0.5], [0.7, -0.2, 0.3, 0.4, 0.3, 0.2], None),
}


def problem(robot, begin, move, constraints, dt=0.04, steps=30):
    """A reach from rest."""
    end = begin + move
    most = np.where(np.isfinite(robot.effort_limit), robot.effort_limit, np.inf)
    weight = 1.0 / np.where(np.isfinite(most), most, 10.0) ** 2
    cost = vp.ControlCost(weight) + vp.VelocityCost(0.1)
    cost += vp.Terminal(vp.TrackingCost(end, 50.0) + vp.VelocityCost(10.0))
    return vp.OptimalControlProblem(
        vp.Scene(robot, damping=0.1), cost, begin, np.zeros(robot.dof), dt=dt, steps=steps, constraints=constraints
    )


def tasks():
    """(name, problem)."""
    for name, (start, way, given) in ARMS.items():
        lock = {"panda_finger_joint1": 0.02} if name == "panda" else None
        robot = vp.load_robot(name, lock=lock)
        begin, move = np.array(start)[: robot.dof], np.array(way)[: robot.dof]
        frame = given or robot.end_effector
        places = robot.frame_positions(begin + np.linspace(0, 1, 5)[:, None] * move, frame)
        free = vp.solve(problem(robot, begin, move, []), check=False)
        speed = np.abs(free.trajectory.v).max(axis=0)
        rate = np.abs(np.diff(free.trajectory.u, axis=0)).max(axis=0) / 0.04
        top = np.maximum(begin, begin + move) - 0.05 * np.abs(move) + 1e-9
        seen = free.trajectory.q[:, :]
        middle = robot.frame_positions(seen[len(seen) // 2], frame)
        reach = np.linalg.norm(places[0] - middle)
        families = {
            "speeds": [vp.WithinVelocityLimits(robot, (-0.8 * speed, 0.8 * speed))],
            "joints": [vp.WithinJointLimits(robot, (np.minimum(begin, begin + move) - 0.2, np.maximum(top, begin)))],
            "rates and goal": [vp.WithinControlRate(0.8 * rate), vp.ReachFrame(robot, frame, position=places[-1])],
            "sphere": [vp.KeepOutOfSphere(robot, frame, middle + np.eye(3)[2] * 0.02, min(0.06, 0.5 * reach))],
        }
        obstacle = vp.Obstacle.sphere(middle + np.eye(3)[2] * 0.03, 0.03)
        links = list(vp.KeepClear(robot, [obstacle]).capsules)[-1:]
        families["obstacle"] = [
            vp.KeepClear(robot, [obstacle], 0.0, links=links),
            vp.WithinVelocityLimits(robot, (-1.5 * speed, 1.5 * speed)),
        ]
        for kind, constraints in families.items():
            yield f"{name}, {kind}", problem(robot, begin, move, constraints)
    chain = vp.planar_chain(3)
    arm = {f"joint{k}": ([0, 0, 0], [1, 0, 0], 0.05) for k in (1, 2, 3)}
    begin, move = np.array([-1.5, 0.0, 0.0]), np.array([1.0, 0.6, 0.4])
    ball, box = vp.Obstacle.sphere([1.9, 0.0, 0.9], 0.2), vp.Obstacle.box([2.2, 0.0, 0.8], [0.4, 0.4, 0.4])
    for kind, constraints in {
        "speeds": [vp.WithinVelocityLimits(chain, (-1.2, 1.2))],
        "goal": [vp.ReachFrame(chain, "tip", position=[2.0, 0.0, 1.2])],
        "box": [vp.KeepInBox(chain, "tip", [-3.0, -1.0, -0.2], [3.0, 1.0, 2.8])],
        "ball": [vp.KeepClear(chain, [ball], 0.05, capsules=arm)],
        "box obstacle": [vp.KeepClear(chain, [box], 0.05, capsules=arm)],
    }.items():
        yield f"three links, {kind}", problem(chain, begin, move, constraints)


def stationarity(task, plan, directions=6):
    """The Lagrangian's slope along random changes of the controls, relative to those of the cost's shares."""
    rng, u = np.random.default_rng(0), plan.controls
    parts = list(zip(task.bound_constraints, plan.constraints, strict=True))

    def values(u):
        motion = task.simulate(u)
        pull = [float((r.multipliers * b.value(motion.q, motion.v, motion.u)).sum()) for b, r in parts]
        return np.concatenate([task.shares(motion), pull])

    # Torques that accelerate all joints alike: a light joint takes little.
    masses = np.array([vp.lagrangian_jet(task.scene, q, 0.0 * q).Lvv for q in plan.trajectory.q[:-1]])
    worst = 0.0
    for _ in range(directions):
        way = (masses @ rng.normal(size=u.shape)[:, :, None])[:, :, 0]
        slope = (values(u + 1e-5 * way) - values(u - 1e-5 * way)) / 2e-5
        worst = max(worst, abs(slope.sum()) / np.abs(slope).sum())
    return worst


def main():
    """Print a row for each task."""
    print(f"{'task':28} {'status':12} {'iterations':>10} {'violation':>10} {'active':>7} {'KKT':>8} {'seconds':>8}")
    for name, task in tasks():
        began = time.perf_counter()
        plan = vp.solve(task, check=False)
        took = time.perf_counter() - began
        active = sum(int(report.active.sum()) for report in plan.constraints)
        residual = stationarity(task, plan)
        row = f"{plan.status.name.lower():12} {len(plan.history):10d} {plan.violation:10.1e} {active:7d}"
        print(f"{name:28} {row} {residual:8.1e} {took:8.1f}")


if __name__ == "__main__":
    main()
