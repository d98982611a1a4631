"""A joint is moved by hand so that the pole on it hangs still at the end: the plan chooses where the joint goes."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.planar_chain(2, length=0.5, mass=0.5)
scene = vp.Scene(robot, actuation=["joint1"], constraints=vp.KinematicInput("joint1"))  # joint2 is free
begin = np.array([0.5 * np.pi, 0.0])  # both hang
goal = begin + np.array([0.8, -0.8])  # the first link is raised, the pole on it hangs again

cost = vp.ControlRateCost(0.02, before=[begin[0]]) + vp.VelocityCost([0.0, 0.02])
cost += vp.Terminal(vp.TrackingCost(goal, 100.0) + vp.VelocityCost([0.0, 10.0]))
limits = (begin[0] - 0.1, goal[0])  # of the joint's positions [rad]
problem = vp.OptimalControlProblem(scene, cost, begin, np.zeros(2), dt=0.02, steps=60, control_limits=limits)
plan = vp.solve(problem)
motion = plan.trajectory

print(f"{plan.status.value} in {plan.iterations} iterations, off by {np.abs(motion.q[-1] - goal).max():.0e} rad")
print(f"moving it takes up to {np.abs(motion.constraint_forces).max():.1f} N m")
print(plan.verify(tolerance=1e-5))

fig, (upper, lower) = plt.subplots(2, 1, figsize=(7, 4.5), sharex=True, layout="constrained")
upper.plot(motion.t, motion.q[:, 0], label="moved by hand")
upper.plot(motion.t, motion.q.sum(axis=1), label="direction of the pole")
upper.axhline(goal[0], color="0.5", linestyle="--", linewidth=0.9, label="goal")
upper.set_ylabel("angle [rad]")
upper.legend()
lower.stairs(motion.constraint_forces[:, 0], motion.t, baseline=None)
lower.set(xlabel="time [s]", ylabel="torque that it takes [N m]")
fig.savefig(out / "moved_pole.png", dpi=100)
print(vp.replay(robot, motion, marks=vp.Marks(trace=["tip"]), html=out / "moved_pole.html"))
