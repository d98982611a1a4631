"""A Panda with dry friction and its file's damping, pushed and held by its motor against the stop of its elbow."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import varpin as vp
from varpin import plots

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.load_robot("panda", lock={"panda_finger_joint1": 0.02})
# The file has dampers and no dry friction. Gaz et al. identified phi1 / (1 + exp(-phi2 (v + phi3))) less its value at
# rest ("Dynamic identification of the Franka Emika Panda robot", IEEE RA-L 4, 2019; the numbers are in their
# franka_model.h). Without its small shift phi3 that is phi1 / 2 tanh(phi2 v / 2): level [N m] and width [rad/s].
level = 0.5 * np.array([0.54615, 0.87224, 0.64068, 1.2794, 0.83904, 0.30301, 0.56489])
width = 2.0 / np.array([5.1181, 9.0657, 10.136, 5.5903, 8.3469, 17.133, 10.336])
stop = vp.JointStop(stiffness=2000.0, damping=20.0, width=2e-3)  # at the position limits of the file
scene = vp.Scene(robot, damping="robot", forces=[vp.CoulombFriction(level, width), stop])

free = vp.Scene(robot, damping=0.0)  # what the controller knows

q0 = np.array([0.0, -0.4, 0.0, -1.2, 0.0, 1.6, 0.8])
stiffness = np.array([400.0, 400.0, 400.0, 0.0, 50.0, 50.0, 2.0])  # [N m/rad]
damping = np.array([40.0, 40.0, 40.0, 6.0, 3.0, 3.0, 0.1])  # [N m s/rad]
elbow, push = 3, 12.0  # [N m]
begin, end = 0.2, 2.0  # of the push [s]


def law(t, q, v):
    """Gravity compensation at 1 kHz, springs in all joints but the elbow: it is pushed, then drawn back."""
    torque = -stiffness * (q - q0) - damping * v
    torque[elbow] += push if begin <= t < end else -2.0
    return np.clip(free.holding_torque(q) + torque, -robot.effort_limit, robot.effort_limit)


motion = vp.simulate(scene, q0, np.zeros(7), dt=1e-3, steps=2500, controls=law, integrator=vp.Radau(2))
upper = robot.position_limits[1][elbow]
beyond = motion.q[:, elbow] - upper
rest = round(end / motion.dt)
print(motion)
print(f"at the stop after {motion.t[np.argmax(beyond > 0)]:.3f} s, at most {1e3 * beyond.max():.2f} mrad beyond it")
# Its spring is soft over the first 2 mrad, and has given away half of them when it is stiff.
held = 2000.0 * (beyond[rest] - 1e-3)
print(f"held {1e3 * beyond[rest]:.3f} mrad beyond it: the stop bears {held:.3f} N m of the motor's {push:g} N m")

figure, (above, middle, below) = plt.subplots(3, 1, sharex=True, figsize=(8.0, 7.0), layout="constrained")
above.plot(motion.t, motion.q[:, elbow], color=plots.COLORS[0], label="elbow")
above.axhline(upper, color="0.3", linestyle="--", linewidth=0.9, label="limit")
above.legend(frameon=False)
middle.plot(motion.t, 1e3 * beyond, color=plots.COLORS[1])
middle.set_ylim(-2.0, 17.0)
turned = np.cumsum([level * np.tanh(own / width) @ own * motion.dt for own in motion.v])
below.plot(motion.t, turned, color=plots.COLORS[2])
labels = ("angle [rad]", "beyond the limit [mrad]", "heat of dry friction [J]")
for axes, label in zip((above, middle, below), labels, strict=True):
    plots.apply_style(axes)
    axes.set_ylabel(label)
below.set_xlabel("time [s]")
figure.savefig(out / "panda_stop.png", dpi=120)
print(vp.replay(robot, motion, html=out / "panda_stop.html", marks=vp.Marks(trace="panda_hand")))
