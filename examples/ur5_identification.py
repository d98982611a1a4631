"""A log of a UR5 tells its dampers and its payload; a URDF is written with them."""

from pathlib import Path

import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

# The arm that is logged: 2 kg at its flange and dampers, which its URDF does not have.
damping = np.array([2.0, 1.5, 1.0, 0.3, 0.2, 0.1])  # [N m s/rad]
arm = vp.Scene(vp.load_robot("ur5", payload=vp.Payload("tool0", 2.0)), damping=damping)
middle, rng = np.array([0.0, -1.2, 1.2, -0.5, 0.5, 0.0]), np.random.default_rng(0)
rate, phase = rng.uniform(0.3, 1.5, (2, 6)), rng.uniform(0.0, 2.0 * np.pi, (2, 6))


def law(t, q, v):
    """Computed torques along sums of sines that grow from rest, held for 10 ms."""
    goal = middle + min(t, 1.0) * np.sum(0.2 / rate * np.sin(2.0 * np.pi * rate * t + phase), axis=0)
    M = vp.lagrangian_jet(arm, q, v).Lvv
    return arm.holding_torque(q) + M @ (200.0 * (goal - q) - 20.0 * v)


motion = vp.simulate(arm, middle, np.zeros(6), dt=1e-3, steps=4000, controls=law, period=10)
samples = np.arange(0, 4001, 10)
encoders = motion.q[samples] + 2e-4 * rng.standard_normal((len(samples), 6))
log = vp.Log(motion.t[samples], encoders, motion.u[np.minimum(samples, 3999)])

scene = vp.Scene(vp.load_robot("ur5"), damping=0.0)
found = vp.identify(scene, log, ["damping", "payload"], q_noise=2e-4)
print(found)
off = (found.values - np.append(damping, 2.0)) / found.deviations
print("errors in standard deviations:", off.round(1))
figure, _ = vp.plots.plot_identification(found, joints=["elbow_joint", "wrist_1_joint"])
figure.savefig(out / "identification.png", dpi=110)
print(found.save_urdf(out / "ur5_identified.urdf"))
