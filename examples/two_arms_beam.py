"""Two UR5 carry a beam of 3 kg that both hold: one tree of two arms, and a weld that closes the loop."""

from pathlib import Path

import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

# The second arm stands 1 m away, and looks at the first. The beam, 0.5 m long, hangs on the first arm's tool.
facing = [[-1, 0, 0, 1.0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
beam = vp.Payload("tool0", mass=3.0, center=[0.0, 0.0, 0.25], inertia=[0.0625, 0.0625, 1e-3])
left, right = vp.load_robot("ur5", payload=beam), vp.load_robot("ur5")
robot = vp.combine(left, right, placements=[None, facing], prefixes=["left_", "right_"])
# The tools stand face to face at the beam's ends.
grip = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]]
scene = vp.Scene(robot, constraints=vp.FrameOnFrame("right_tool0", "left_tool0", grip), damping=1.0)

begin = vp.assemble(scene, [-0.35, -1.3, 1.9, -0.6, 1.2, 0.0] * 2)
lifted = vp.assemble(scene, begin + np.tile([0.4, -0.4, -0.2, 0.5, 0.0, 0.0], 2))
effort = robot.effort_limit
cost = vp.ControlCost(1.0 / effort**2) + vp.VelocityCost(0.1)
cost += vp.Terminal(vp.TrackingCost(lifted, 1e3) + vp.VelocityCost(10.0))
problem = vp.OptimalControlProblem(
    scene, cost, begin, np.zeros(12), dt=0.02, steps=50, integrator=vp.Gauss(2), control_limits=(-effort, effort)
)
plan = vp.solve(problem, tolerance=1e-5)
motion = plan.trajectory

ends = [robot.frame_positions(motion.q, f"{side}_tool0") for side in ("left", "right")]
off, lift = np.abs(motion.q[-1] - lifted).max(), ends[0][-1, 2] - ends[0][0, 2]
print(f"{plan.iterations} iterations, {plan.status.value}")
print(f"the beam is lifted by {lift:.3f} m, and the arms end {off:.1e} rad from their goal")
print(f"its length changes by {np.ptp(np.linalg.norm(ends[1] - ends[0], axis=1)):.1e} m")
print(f"the grip takes up to {np.abs(motion.constraint_forces[:, :3]).max():.0f} N")
print(plan.verify(tolerance=1e-6))
print(vp.replay(robot, plan, marks=vp.Marks(trace=["left_tool0", "right_tool0"]), html=out / "two_arms_beam.html"))
