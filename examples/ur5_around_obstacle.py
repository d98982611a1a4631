"""A UR5 brings its tool to a place behind a post, within its limits, with every link clear of the post."""

from pathlib import Path

import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.load_robot("ur5")
scene = vp.Scene(robot, damping=0.1)
begin = np.array([0.0, -1.2, 1.4, -1.8, -1.57, 0.0])  # [rad]
end = np.array([1.6, -1.2, 1.4, -1.8, -1.57, 0.0])
place = robot.frame_positions(end, "tool0")  # [m]
post = vp.Obstacle.capsule([0.4, 0.45, 0.0], [0.4, 0.45, 0.55], 0.06, name="post")

cost = vp.ControlCost(1.0 / robot.effort_limit**2) + vp.VelocityCost(0.2)
cost += vp.Terminal(vp.TrackingCost(end, 1.0) + vp.VelocityCost(100.0))
constraints = [
    vp.WithinJointLimits(robot),
    vp.WithinVelocityLimits(robot, (-2.5, 2.5)),
    vp.ReachFrame(robot, "tool0", position=place),
]
problem = vp.OptimalControlProblem(
    scene,
    cost,
    begin,
    np.zeros(6),
    dt=0.02,
    steps=75,
    control_limits=(-robot.effort_limit, robot.effort_limit),
    constraints=[*constraints, vp.KeepClear(robot, [post], 0.02)],
)
plan = vp.solve(problem)
print(plan)
print(f"{plan.iterations} iterations, violations of {plan.violation:.1e} at most: {plan.status.value}")

print(vp.replay(robot, plan, marks=vp.Marks(trace="tool0"), html=out / "ur5_around_obstacle.html"))
