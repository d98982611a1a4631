"""A Panda wipes a slanted plane: its hand stays on the plane and upright to it, and draws a figure of eight."""

from pathlib import Path

import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

robot = vp.load_robot("panda", lock={"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.02}, mimic="free")
slope = 0.3  # [rad]
normal = np.array([-np.sin(slope), 0.0, np.cos(slope)])
along, across = np.array([np.cos(slope), 0.0, np.sin(slope)]), np.array([0.0, 1.0, 0.0])
middle = np.array([0.5, 0.0, 0.3])
# The hand's middle and two points beside it in the plane: three rows keep its z axis on the normal.
feet = [[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.05, 0.0]]
planes = [vp.PointOnPlane(("panda_hand_tcp", foot), middle, normal) for foot in feet]
scene = vp.Scene(robot, constraints=planes, damping="robot")

at = vp.PointOnPoint("panda_hand_tcp", middle)  # where the path begins
begin = vp.assemble(vp.Scene(robot, constraints=[at, *planes[1:]], damping=0), [0.0, 0.1, 0.0, -2.2, 0.0, 2.2, 0.785])


def path(t):
    """A figure of eight in four seconds, in the plane [m]."""
    turn = 0.5 * np.pi * t
    return middle + 0.15 * np.sin(turn) * across + 0.08 * np.sin(2.0 * turn) * along


effort = robot.effort_limit
cost = vp.FramePositionCost(robot, "panda_hand_tcp", path, 1e3)
cost += vp.ControlCost(1e-2 / effort**2, scene.holding_controls(begin)) + vp.VelocityCost(1e-2)
problem = vp.OptimalControlProblem(
    scene, cost, begin, np.zeros(7), dt=0.02, steps=200, integrator=vp.Gauss(2), control_limits=(-effort, effort)
)
plan = vp.solve(problem, tolerance=1e-5)
motion = plan.trajectory

tip, wanted = robot.frame_positions(motion.q, "panda_hand_tcp"), np.array([path(t) for t in motion.t])
off, above = np.linalg.norm(tip - wanted, axis=1), np.abs((tip - middle) @ normal)
push = motion.constraint_forces.sum(axis=1)
print(f"{plan.iterations} iterations, {plan.status.value}")
print(f"the hand is within {1e3 * off.max():.1f} mm of its path, and {above.max():.0e} m off the plane")
print(f"the plane pushes with {push.min():.1f} to {push.max():.1f} N; where that is negative, it pulls")
print(vp.replay(robot, plan, marks=vp.Marks(trace=["panda_hand_tcp"]), html=out / "panda_wipes.html"))
