"""A UR5 brings its tool to a place and an orientation in one second, within 60% of its motors' torques."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.load_robot("ur5")
scene = vp.Scene(robot, damping=0.1)
begin = np.array([0.0, -1.5, 0.8, -0.5, 0.0, 0.0])  # [rad]
place = np.array([0.485, 0.535, 0.333])  # of the tool in the world [m]
axes = Rotation.from_euler("xyz", [147.0, 39.5, -66.0], degrees=True).as_matrix()
limits = 0.6 * robot.effort_limit  # [N m]

cost = vp.ControlCost(1.0 / robot.effort_limit**2) + vp.VelocityCost(1.0)
cost += vp.JointLimitBarrier(robot, 1e3, margin=0.1) + vp.VelocityLimitBarrier(robot, 1e2, margin=0.1)
reached = vp.FramePositionCost(robot, "tool0", place, 1e5) + vp.FrameOrientationCost(robot, "tool0", axes, 1e4)
cost += vp.Terminal(reached + vp.VelocityCost(10.0))
problem = vp.OptimalControlProblem(
    scene, cost, begin, np.zeros(6), dt=1e-2, steps=100, control_limits=(-limits, limits)
)
plan = vp.solve(problem)
motion = plan.trajectory

data = robot.model.createData()
pin.framesForwardKinematics(robot.model, data, robot.configuration(motion.q[-1]))
tool = data.oMf[robot.model.getFrameId("tool0")]
turn = np.linalg.norm(pin.log3(axes.T @ tool.rotation))
print(f"{plan.iterations} iterations, {plan.status.value}")
print(f"the tool ends {1e3 * np.linalg.norm(tool.translation - place):.2f} mm and {1e3 * turn:.2f} mrad off")
print(f"{np.count_nonzero(np.abs(plan.controls) == limits)} of {plan.controls.size} torques are at their limits")
print(f"{len(plan.warnings)} warnings, such as of joints beyond their limits")
truth = plan.verify(tolerance=1e-6)
print(f"on the continuous arm, with feedback, {truth.closed_loop_gap:.1e} rad from where the plan ends")

fig, axis = plt.subplots(figsize=(7, 3.5), layout="constrained")
for name, torque in zip(robot.joint_names, (motion.u / limits).T, strict=True):
    axis.stairs(torque, motion.t, label=name, baseline=None)
axis.set(xlabel="time [s]", ylabel="torque [limit]", ylim=(-1.1, 1.1))
axis.legend(fontsize="small", ncols=2)
fig.savefig(out / "ur5_reach_frame.png", dpi=150)
print(vp.replay(robot, motion, marks=vp.Marks(ghost=[motion.q[-1]]), html=out / "ur5_reach_frame.html", speed=0.5))
