"""A fan of noisy finger motions with the covariance that the linearization predicts drawn over it."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import varpin as vp

STIFFNESS = (0.54, 0.28, 0.12)  # [N m/rad]
DAMPING = (3.1e-3, 2.2e-3, 0.9e-3)  # [N m s/rad]

out = Path("out")
out.mkdir(exist_ok=True)

finger = vp.load_robot("finger")
noise = vp.AdditiveNoise(1e-3) + vp.StateNoise(2e-3)  # forces on every joint, stronger away from the start
surroundings = {"gravity": False, "stiffness": STIFFNESS, "damping": DAMPING, "rest": [0.5, 0.7, 0.3]}
scene = vp.Scene(finger, noise=noise, **surroundings)
start = {"q0": [1.2, 1.1, 0.6], "v0": [0.0, 0.0, 0.0], "dt": 5e-4, "steps": 400}

mean_path = vp.simulate(scene, **start, increments=0)  # the motion without noise
moments = vp.propagate_moments(vp.linearize(scene, mean_path))
ensemble = vp.simulate_ensemble(scene, **start, paths=1000, rng=0)

predicted = np.sqrt(np.einsum("jii->ji", moments.covariance))[:, :3]
sampled = ensemble.q.std(axis=0)
print("deviation at the end, predicted and of 1000 paths [rad]:", predicted[-1], sampled[-1])

figure = Figure(figsize=(8, 6), layout="constrained")
for j, axes in enumerate(figure.subplots(3, 1, sharex=True)):
    axes.plot(ensemble.t, ensemble.q[:60, :, j].T, color="0.75", linewidth=0.5)
    axes.plot(mean_path.t, mean_path.q[:, j], color="#0072b2", label="no noise")
    for sign in (-2.0, 2.0):
        label = "2 deviations, predicted" if sign > 0 else None
        axes.plot(mean_path.t, mean_path.q[:, j] + sign * predicted[:, j], color="#d55e00", linestyle="--", label=label)
    axes.set_ylabel(f"{finger.joint_names[j]} [rad]")
axes.set_xlabel("t [s]")
axes.legend()
figure.savefig(out / "noisy_finger.png", dpi=120)
