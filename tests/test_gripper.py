"""The bundled gripper: its four-bars are parallelograms, so that all joints turn as the crank does."""

import numpy as np
import pytest
from findings import about
from refusals import naming, unnamed

import varpin as vp

# right crank, link, finger; left ones: a finger turns back by what its link turns.
TURNS = {"crank": 1.0, "link": 1.0, "finger": -1.0}


@pytest.fixture(scope="module")
def task():
    return vp.load_scene("gripper_closes")


def shares(robot):
    return np.array([TURNS[name.split("_")[1]] for name in robot.joint_names])


def test_the_loops_are_closed_wherever_the_crank_is(task):
    way = shares(task.robot)
    for angle in (0.0, 0.3, 0.8):
        g, C = task.scene.constraint_values(angle * way)
        assert np.abs(g).max() < 1e-15
        np.testing.assert_allclose(C @ way, 0.0, atol=1e-15)
        assert np.linalg.matrix_rank(C) == 5
        np.testing.assert_allclose(
            vp.assemble(task.scene, angle * way + 0.01),
            way * way[0] * vp.assemble(task.scene, angle * way + 0.01)[task.robot.coordinate("right_crank")],
            atol=1e-12,
        )
    ends = {side: task.robot.frame_positions(np.zeros((1, 6)), f"{side}_pad")[0] for side in ("right", "left")}
    np.testing.assert_allclose(ends["right"] * [-1.0, 1.0, 1.0], ends["left"], atol=1e-15)
    assert ends["right"][0] - ends["left"][0] == pytest.approx(0.0854, abs=1e-12)


def test_the_plan_closes_it_to_forty_millimetres(task):
    plan = task.solve()
    assert plan.status.converged
    pads = [task.robot.frame_positions(plan.trajectory.q[-1:], f"{side}_pad")[0, 0] for side in ("right", "left")]
    assert pads[0] - pads[1] == pytest.approx(0.04, abs=1e-6)
    assert abs(plan.verify().closed_loop_loss) < 1e-6


def test_a_gripper_whose_loops_are_open_says_so(caplog):
    robot = vp.load_robot("gripper")
    assert robot.loops == (("right_crank_pin", "right_finger_pin"), ("left_crank_pin", "left_finger_pin"))
    assert not unnamed(repr(robot), "2 loops")
    assert naming(vp.inspect_robot("gripper").warnings, "'left_crank_pin'", "'left_finger_pin'")
    pair = vp.combine(robot, vp.load_robot("finger"), prefixes=["a_", "b_"])
    assert pair.loops[0] == ("a_right_crank_pin", "a_right_finger_pin")
    assert vp.load_robot("finger").loops == ()
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
    path = tmp_path / "gripper.urdf"
    path.write_text(
        text.replace('<link2 link="left_finger_pin"/>', "").replace('<link1 link="right_crank_pin"/>', "<link1/>")
    )
    assert vp.load_robot(path).loops == ()
