"""A human index finger let go against its passive joint impedance: simulate, plot, replay."""

from pathlib import Path

import varpin as vp
from varpin import plots

# Passive joint stiffness [N m/rad] and damping [N m s/rad]; see models/SOURCES.md.
STIFFNESS = (0.54, 0.28, 0.12)
DAMPING = (3.1e-3, 2.2e-3, 0.9e-3)

out = Path("out")
out.mkdir(exist_ok=True)

finger = vp.load_robot("finger")
scene = vp.Scene(finger, gravity=False, stiffness=STIFFNESS, damping=DAMPING, rest=[0.5, 0.7, 0.3])
motion = vp.simulate(scene, q0=[1.2, 1.1, 0.6], v0=[0.0, 0.0, 0.0], dt=1e-4, steps=3000)
print(motion)

figure, _ = plots.plot_trajectory(motion, robot=finger)
figure.savefig(out / "finger.png", dpi=120)
motion.save(out / "finger.npz")
print(vp.replay(finger, motion, html=out / "finger.html", speed=0.1))
