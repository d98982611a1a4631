"""A parallel gripper closes: two four-bars and a tie keep its pads parallel, and one drive moves both."""

from pathlib import Path

import numpy as np

import varpin as vp

out = Path("out")
out.mkdir(exist_ok=True)

task = vp.load_scene("gripper_closes")  # models/scenes/gripper_closes.toml
robot, scene = task.robot, task.scene
plan = task.solve()
motion = plan.trajectory

width = robot.frame_positions(motion.q, "right_pad") - robot.frame_positions(motion.q, "left_pad")
tilt = motion.q[:, robot.coordinate("right_link")] + motion.q[:, robot.coordinate("right_finger")]
pins = slice(0, 4)  # of the constraint forces: both pins along x and z; then the tie
print(f"{robot.dof} joints, {len(scene.constraint_labels)} constraints, one drive: {plan.status.value}")
begin, end = 1e3 * width[[0, -1], 0]
print(f"the pads close from {begin:.1f} to {end:.1f} mm and tilt by {np.abs(tilt).max():.0e} rad")
print(
    f"the drive gives up to {np.abs(motion.u).max():.2f} N m, the pins up to "
    f"{np.abs(motion.constraint_forces[:, pins]).max():.2f} N"
)
print(plan.verify(tolerance=1e-6))
plan.save(out / "gripper_closes.npz")
print(vp.replay(robot, plan, html=out / "gripper_closes.html", speed=0.25, marks=task.marks()))
