"""Coarse steps on a falling chain: what the guards do, and how the record says so."""

import numpy as np

import varpin as vp

links = 5
scene = vp.Scene(vp.planar_chain(links))
unit = 9.81 * links**2 / 2  # m g n^2 / 2 [J]

for dt in (0.01, 0.05, 0.2):
    motion = vp.simulate(scene, np.zeros(links), np.zeros(links), dt=dt, steps=round(100 / dt))
    error = np.abs(motion.energy - motion.energy[0]).max() / unit
    print(
        f"dt = {dt:4} s: energy error {error:.3f}, {motion.statistics.split_steps} of {motion.steps} steps split, "
        f"{motion.statistics.substeps.mean():.1f} substeps a step"
    )
