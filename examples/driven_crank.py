"""A crank that is turned by hand drives a slider: what torque does it take?"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.planar_chain(2, length=0.3, mass=0.5)  # the crank and the rod
slot = vp.PointOnPoint("tip", (0.0, 0.0, 0.0), axes="z")  # the rod's end slides along x
scene = vp.Scene(robot, actuation=["joint1"], constraints=[slot, vp.KinematicInput("joint1")], damping=0.01)
begin = vp.assemble(scene, [-0.6, 1.2])

dt, steps = 2e-3, 1000
t = dt * np.arange(steps + 1)
turn = begin[0] + 0.5 * (1.0 - np.cos(np.pi * t))  # there and back, from rest to rest [rad]
motion = vp.simulate(scene, begin, np.zeros(2), dt=dt, steps=steps, controls=turn[1:, None], integrator=vp.Gauss(2))

torque = motion.constraint_forces[:, 1]
work = float(torque @ np.diff(turn))
print(f"the crank takes up to {np.abs(torque).max():.2f} N m, and a work of {work:.3f} J against friction")
print(f"the rod's end stays on its line to {np.abs(robot.frame_positions(motion.q, 'tip')[:, 2]).max():.0e} m")
print(f"d(end)/d(position of the crank): {vp.linearize(scene, motion).B[0, :2, 0].round(3)}")

fig, (upper, lower) = plt.subplots(2, 1, figsize=(7, 4.5), sharex=True, layout="constrained")
upper.plot(t, turn, label="crank [rad]")
upper.plot(t, robot.frame_positions(motion.q, "tip")[:, 0], label="slider [m]")
upper.legend()
lower.stairs(torque, t, baseline=None)
lower.set(xlabel="time [s]", ylabel="torque on the crank [N m]")
fig.savefig(out / "driven_crank.png", dpi=150)
print(vp.replay(robot, motion, marks=vp.Marks(constraints=scene, trace=["tip"]), html=out / "driven_crank.html"))
