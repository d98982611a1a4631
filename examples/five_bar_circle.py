"""A five-bar robot traces a circle: two driven cranks, two rods, and a loop that a constraint closes."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.planar_chain(4, length=0.3, mass=0.5)  # crank, rod, rod, crank: rods meet at joint 3
drives = np.zeros((4, 2))
drives[0, 0] = drives[3, 1] = 1.0
scene = vp.Scene(robot, constraints=vp.PointOnPoint("tip", (0.3, 0.0, 0.0), axes="xz"), actuation=drives, damping=0.02)
begin = vp.assemble(scene, [-1.57, 0.52, 2.09, 0.52])  # both cranks upright
middle = robot.frame_positions(begin, "joint3") - [0.0, 0.0, 0.06]


def circle(t):
    """From rest to rest in two seconds [m]."""
    turn = 2.0 * np.pi * (t / 2.0) ** 3 * (10.0 - 15.0 * (t / 2.0) + 6.0 * (t / 2.0) ** 2)
    return middle + 0.06 * np.array([np.sin(turn), 0.0, np.cos(turn)])


cost = vp.FramePositionCost(robot, "joint3", circle, 1e5) + vp.VelocityCost(1e-3)
cost += vp.ControlCost(1e-3, scene.holding_controls(begin))
problem = vp.OptimalControlProblem(scene, cost, begin, np.zeros(4), dt=0.02, steps=100)
plan = vp.solve(problem)
motion = plan.trajectory

path, wanted = robot.frame_positions(motion.q, "joint3"), np.array([circle(t) for t in motion.t])
off = 1e3 * np.linalg.norm(path - wanted, axis=1)
print(f"{plan.iterations} iterations, {plan.status.value}")
print(f"joint 3 is within {off.max():.2f} mm of the circle")
print(plan.verify(tolerance=1e-6))

fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
left.plot(wanted[:, 0], wanted[:, 2], "0.7", linewidth=4)
left.plot(path[:, 0], path[:, 2])
left.set(xlabel="x [m]", ylabel="z [m]", aspect="equal")
for joint, torque in zip(("joint1", "joint4"), motion.u.T, strict=True):
    right.stairs(torque, motion.t, label=joint, baseline=None)
right.set(xlabel="time [s]", ylabel="torque [N m]")
right.legend()
fig.savefig(out / "five_bar_circle.png", dpi=150)
print(vp.replay(robot, plan, marks=vp.Marks(trace=["joint3"]), html=out / "five_bar_circle.html"))
