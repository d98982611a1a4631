"""A UR5 under gravity brought to a posture by a digital PD controller with gravity compensation."""

from pathlib import Path

import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.load_robot("ur5")
scene = vp.Scene(robot, damping=0.1)
goal = np.array([0.5, -1.0, 1.2, -0.6, 0.8, 0.0])  # [rad]
stiffness = np.array([400.0, 400.0, 200.0, 40.0, 20.0, 4.0])  # [N m/rad]
damping = np.array([80.0, 80.0, 30.0, 4.0, 2.0, 0.2])  # [N m s/rad]


def control(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Torques [N m], held over the controller's period: what carries the arm, springs and dampers towards the goal.

    The springs' ends go there in a second and a half: pulled all at once, the arm would be faster than its motors are.
    """
    way = 0.5 - 0.5 * np.cos(np.pi * min(t / 1.5, 1.0))
    torque = scene.holding_torque(q) - stiffness * (q - way * goal) - damping * v
    return np.clip(torque, -robot.effort_limit, robot.effort_limit)


motion = vp.simulate(scene, np.zeros(6), np.zeros(6), dt=2e-3, steps=2000, controls=control, period=1)
print(motion)
print("distance to the goal [rad]:", np.abs(motion.q[-1] - goal).max())
print(vp.replay(robot, motion, html=out / "ur5_pd.html"))
