"""An arm by its name in robot_descriptions, dropped from a posture under its own damping, to a tolerance.

The package downloads the arm's repository on first use. Without the package or the network there is nothing to show.
"""

import sys
from pathlib import Path

import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)
name = sys.argv[1] if len(sys.argv) > 1 else "edo_description"

try:
    robot = vp.load_robot(name)
except (vp.MissingDependency, vp.RobotNotFound, vp.RobotError) as error:
    print(f"skipped: {error}")
    sys.exit(0)

scene = vp.Scene(robot, damping=np.maximum(robot.damping, 0.5))  # [N m s/rad]
q0 = np.clip(np.linspace(0.4, -0.4, robot.dof), *robot.position_limits)
motion = vp.simulate(scene, q0, np.zeros(robot.dof), duration=1.0, tolerance=1e-6)
print(motion)
print(f"{robot.dof} joints, falling by {np.abs(motion.q[-1] - q0).max():.4f} rad, {motion.accuracy}")
energy = motion.energy - motion.energy[0]
heat = np.trapezoid(motion.v**2 @ scene.damping, motion.t)
print(f"energy lost {-energy[-1]:.4f} J, heat of the dampers {heat:.4f} J")
print(vp.replay(robot, motion, html=out / f"{name}.html", marks=vp.Marks(trace=True)))
