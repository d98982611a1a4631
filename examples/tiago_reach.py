"""A TIAGO drives to a shelf and reaches into it: one plan for base, torso and arm, with the file's damping."""

from pathlib import Path

import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

HAND = "arm_tool_link"
still = {"head_1_joint": 0.0, "head_2_joint": 0.0, "wheel_left_joint": 0.0, "wheel_right_joint": 0.0}
robot = vp.load_robot("tiago_no_hand", base="planar", lock=still)
friction = vp.CoulombFriction(robot.friction, width=0.05)  # [N m], the file's
wheels = vp.JointDamper({"base_x": 60.0, "base_y": 60.0, "base_turn": 20.0})  # [N s/m], [N m s/rad]
scene = vp.Scene(robot, damping="robot", forces=[friction, wheels])

begin = np.zeros(robot.dof)
begin[3:] = [0.1, 0.3, -0.9, -1.6, 1.9, -1.2, 0.3, 0.0]
target = np.array([2.0, 0.6, 0.95])  # in the shelf [m]
motors = np.where(np.isfinite(robot.effort_limit), robot.effort_limit, 0.0)
motors[:3] = 150.0, 150.0, 60.0  # of the base [N], [N m]
hold = scene.holding_torque(begin)

cost = vp.ControlCost(0.1 / motors**2, hold) + vp.VelocityCost(0.02)
cost += vp.JointLimitBarrier(robot, 1e2, margin=0.05)
cost += vp.Terminal(vp.FramePositionCost(robot, HAND, target, 1e4) + vp.VelocityCost(10.0))
problem = vp.OptimalControlProblem(
    scene, cost, begin, np.zeros(robot.dof), dt=0.02, steps=150, control_limits=(-motors, motors)
)
plan = vp.solve(problem, [hold] * 150)
motion = plan.trajectory

hand = robot.frame_positions(motion.q, HAND)
print(f"{plan.iterations} iterations, {plan.status.value}")
print(f"the hand ends {1e3 * np.linalg.norm(hand[-1] - target):.2f} mm from its target")
x, y, turn = motion.q[-1, :3]
print(f"the base drives to ({x:.2f}, {y:.2f}) m and turns by {np.degrees(turn):.1f} degrees")
truth = plan.verify(tolerance=1e-4)
print(f"planned cost {plan.cost:.4g}; on the continuous robot {truth.closed_loop_cost:.4g} ({truth.integrator})")
marks = vp.Marks(trace=HAND, targets={"shelf": target})
print(vp.replay(robot, motion, html=out / "tiago_reach.html", marks=marks))
