"""A double pendulum swings up by its elbow alone, with less than half the torque that would lift it."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.planar_chain(2)  # two links of 1 m and 1 kg
scene = vp.Scene(robot, actuation=["joint2"], damping=0.02)
down, up = np.array([np.pi / 2, 0.0]), np.array([-np.pi / 2, 0.0])  # [rad]
limit = 8.0  # [N m]; holding both links level takes 20

cost = vp.ControlCost(1e-2) + vp.VelocityCost(1e-2)
cost += vp.Terminal(vp.TrackingCost(up, 1e3) + vp.VelocityCost(1e2))
problem = vp.OptimalControlProblem(scene, cost, down, np.zeros(2), dt=0.02, steps=200, control_limits=(-limit, limit))
plan = vp.solve(problem, max_iterations=300)
motion = plan.trajectory
at_limit = np.abs(plan.controls) == limit
print(plan)
print(f"ends {np.abs(motion.q[-1] - up).max():.1e} rad from upright at {np.abs(motion.v[-1]).max():.1e} rad/s")
print(f"{at_limit.sum()} of {at_limit.size} controls are at their limit of {limit:g} N m")
# There, and only there, the cost still has a slope: it would fall if the motor were stronger.
print(f"largest slope of the cost at a limit {np.abs(plan.gradient[at_limit]).max(initial=0.0):.2g},", end=" ")
print(f"elsewhere {np.abs(plan.gradient[~at_limit]).max():.2g}")

fig, (angles, torque) = plt.subplots(2, 1, sharex=True, figsize=(7, 5), layout="constrained")
angles.plot(motion.t, motion.q, label=robot.joint_names)
angles.axhline(up[0], color="0.7", linewidth=1, label="shoulder, upright")
angles.set_ylabel("angle [rad]")
angles.legend()
torque.stairs(motion.u[:, 0], motion.t, baseline=None, label="torque")
torque.hlines([-limit, limit], *motion.t[[0, -1]], color="0.7", linewidth=1, label="limits")
torque.set(xlabel="time [s]", ylabel="elbow torque [N m]")
torque.legend()
fig.savefig(out / "double_pendulum_swing_up.png", dpi=150)
print(vp.replay(robot, motion, marks=vp.Marks(ghost=[up]), html=out / "double_pendulum_swing_up.html", speed=0.5))
