"""The bundled robots: the finger by its lengths, radii and density, the gripper by its two parallelograms."""

import numpy as np
import pytest
from findings import about
from refusals import naming, unnamed

import varpin as vp

LENGTHS, RADII, DENSITY = (0.0431, 0.0344, 0.0270), (0.010, 0.008, 0.007), 1104.0
# Of right joints when the right crank turns, and of left ones: a finger turns back by what its link turns.
TURNS = {"crank": 1.0, "link": 1.0, "finger": -1.0}


def test_the_finger_is_uniform_cylinders_in_a_row():
    finger = vp.load_robot("finger")
    assert finger.joint_names == ("mcp", "pip", "dip")
    for L, R, body in zip(LENGTHS, RADII, list(finger.model.inertias)[1:], strict=True):
        mass = DENSITY * np.pi * R**2 * L
        across, along = mass * (3.0 * R**2 + L**2) / 12.0, mass * R**2 / 2.0
        np.testing.assert_allclose(body.mass, mass, rtol=1e-14)
        np.testing.assert_allclose(body.lever, [L / 2.0, 0.0, 0.0], rtol=1e-14)
        np.testing.assert_allclose(body.inertia, np.diag([along, across, across]), rtol=1e-13, atol=1e-30)
    for frame, x in (("mcp", 0.0), ("pip", LENGTHS[0]), ("dip", sum(LENGTHS[:2])), ("tip", sum(LENGTHS))):
        np.testing.assert_allclose(finger.frame_positions(np.zeros(3), frame), [x, 0.0, 0.0], rtol=1e-14)


def pads(robot, q):
    """Where the pads are, the right one first."""
    return np.array([robot.frame_positions(q, f"{side}_pad") for side in ("right", "left")])


def test_the_loops_of_the_gripper_are_closed_wherever_the_crank_is():
    task = vp.load_scene("gripper_closes")
    way = np.array([TURNS[name.split("_")[1]] for name in task.robot.joint_names])
    crank = task.robot.coordinate("right_crank")
    for angle in (0.0, 0.3, 0.8):
        g, C = task.scene.constraint_values(angle * way)
        assert np.abs(g).max() < 1e-15
        np.testing.assert_allclose(C @ way, 0.0, atol=1e-15)
        assert np.linalg.matrix_rank(C) == 5
        q = vp.assemble(task.scene, angle * way + 0.01)
        np.testing.assert_allclose(q, way * way[0] * q[crank], atol=1e-12)
    right, left = pads(task.robot, np.zeros(6))
    np.testing.assert_allclose(right * [-1.0, 1.0, 1.0], left, atol=1e-15)
    assert right[0] - left[0] == pytest.approx(0.0854, abs=1e-12)
    plan = task.solve()
    assert plan.status.converged
    right, left = pads(task.robot, plan.trajectory.q[-1])
    assert right[0] - left[0] == pytest.approx(0.04, abs=1e-6)
    assert abs(plan.verify().closed_loop_loss) < 1e-6


def test_a_gripper_whose_loops_are_open_says_so(caplog):
    robot = vp.load_robot("gripper")
    assert robot.loops == (("right_crank_pin", "right_finger_pin"), ("left_crank_pin", "left_finger_pin"))
    assert not unnamed(repr(robot), "2 loops")
    assert naming(vp.inspect_robot("gripper").warnings, "'left_crank_pin'", "'left_finger_pin'")
    assert not about(caplog.messages, "open loops")
    start = np.zeros(6), np.zeros(6)
    tied = vp.Scene(robot, damping=0.0, constraints=vp.JointTie("left_crank", "right_crank"))
    for _ in range(2):
        motion = vp.simulate(tied, *start, dt=1e-3, steps=3)
        assert naming(about(motion.warnings, "open loops"), "'right_crank_pin'", "'right_finger_pin'")
        assert len(about(caplog.messages, "open loops")) == 1
    one = vp.Scene(robot, damping=0.0, constraints=vp.PointOnPoint("right_crank_pin", "right_finger_pin", axes="xz"))
    assert not about(vp.simulate(one, *start, dt=1e-3, steps=3).warnings, "open loops")
    assert not vp.load_scene("gripper_closes").scene.open_loops


def test_loops_of_a_file_that_says_too_little_are_none(tmp_path):
    text = vp.load_robot("gripper").urdf.read_text()
    for whole, part in (('<link2 link="left_finger_pin"/>', ""), ('<link1 link="right_crank_pin"/>', "<link1/>")):
        text = text.replace(whole, part)
    path = tmp_path / "gripper.urdf"
    path.write_text(text)
    assert vp.load_robot(path).loops == ()
