"""A UR5 on position servos: commands a hundred times a second, along a smooth path, under torque noise."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import varpin as vp
from varpin import plots

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.load_robot("ur5")
stiffness = np.array([8000.0, 8000.0, 5000.0, 800.0, 800.0, 400.0])  # [N m/rad]
damping = np.array([400.0, 400.0, 200.0, 20.0, 20.0, 10.0])  # [N m s/rad]
servos = vp.PositionServo(stiffness, damping, effort=robot.effort_limit)
noise = vp.AdditiveNoise(0.01 * robot.effort_limit)  # [N m s^0.5]
plain, noisy = (vp.Scene(robot, forces=[servos], noise=own) for own in (None, noise))

begin = np.array([0.0, -1.2, 1.4, -1.0, -1.57, 0.0])
middle, swing = np.array([0.4, -1.0, 1.1, -0.8, -1.47, 0.0]), np.array([0.4, 0.2, 0.3, 0.2, 0.1, 0.5])
dt, steps, period = 2.5e-3, 1600, 4  # four steps a command


def path(t):
    """Where the joints are to be [rad]: there and back every two seconds, from rest."""
    return begin + (middle - begin) * (0.5 - 0.5 * np.cos(np.pi * t)) + swing * np.sin(np.pi * t) ** 2


def speed(t):
    """Its derivative [rad/s]."""
    return np.pi * (0.5 * (middle - begin) * np.sin(np.pi * t) + swing * np.sin(2.0 * np.pi * t))


def command(t):
    """What a servo is told for its joint to be on the path: the path, its lag and its sag made up for."""
    now = t + 0.5 * period * dt  # the middle of the time over which it is held
    return path(now) + (damping * speed(now) + plain.holding_torque(path(now))) / stiffness


commands = np.repeat([command(period * dt * k) for k in range(steps // period)], period, axis=0)
# Servos are faster than the step and commands jump, which is what Radau's methods are for.
options = {"dt": dt, "steps": steps, "controls": commands, "integrator": vp.Radau(2)}
motion = vp.simulate(plain, begin, np.zeros(6), **options)
finer = {"dt": dt / 4, "steps": 4 * steps, "controls": np.repeat(commands, 4, axis=0), "integrator": vp.Radau(3)}
fine = vp.simulate(plain, begin, np.zeros(6), **finer, check=False)
paths = [vp.simulate(noisy, begin, np.zeros(6), **options, rng=seed) for seed in range(8)]

wanted = np.array([path(t) for t in motion.t])
print(motion)
print(f"steps taken in parts: {motion.statistics.split_steps}")
print(f"error of the integration: {1e3 * np.abs(motion.q - fine.q[::4]).max():.4f} mrad")
rms = [np.sqrt(((own.q - wanted)[200:] ** 2).mean()) for own in (motion, *paths)]
print(f"off the path, rms: {1e3 * rms[0]:.2f} mrad without noise, {1e3 * np.mean(rms[1:]):.2f} mrad with it")

figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(8.0, 6.0), layout="constrained")
for joint, name in enumerate(robot.joint_names[:3]):
    color = plots.COLORS[joint]
    above.plot(motion.t, motion.q[:, joint], color=color, label=name)
    above.stairs(motion.u[:, joint], motion.t, baseline=None, color=color, linewidth=0.6, alpha=0.6)
    for own in paths:
        below.plot(own.t, 1e3 * (own.q - wanted)[:, joint], color=color, linewidth=0.3)
    below.plot(motion.t, 1e3 * (motion.q - wanted)[:, joint], color=color)
for axes, label in ((above, "angle, and command (thin) [rad]"), (below, "off the path [mrad]")):
    plots.apply_style(axes)
    axes.set_ylabel(label)
above.legend(fontsize=8)
below.set_xlabel("time [s]")
figure.savefig(out / "ur5_servos.png", dpi=120)
print(vp.replay(robot, paths[0], html=out / "ur5_servos.html", marks=vp.Marks(ghost=wanted, trace="tool0")))
