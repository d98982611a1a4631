"""Scene files with several robots, against the same scene made in Python."""

import numpy as np
import pytest

import varpin as vp
from varpin.cli import main

TWO = """
damping = { right_pip = 0.1 }

[[robot]]
source = "finger"
prefix = "left_"
lock = { dip = 0.2 }

[[robot.payload]]
frame = "tip"
mass = 1e-3

[[robot]]
source = "finger"
prefix = "right_"
base = { xyz = [0.02, 0.0, 0.0], rpy = [0.0, 0.0, 3.141592653589793] }

[actuation]
joints = ["left_mcp", "right_mcp"]

[initial]
q = { left_mcp = 0.1, right_dip = -0.2 }

[horizon]
dt = 1e-3
steps = 20
"""


TWO_HANDS = """
gravity = false

[[robot]]
source = "allegro_right_hand"
prefix = "left_"

[[robot]]
source = "allegro_right_hand"
prefix = "right_"

[initial]

[horizon]
dt = 1e-3
steps = 5
"""


def write(folder, text):
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def test_joints_that_stay(tmp_path):
    text = '[robot]\nsource = "ur5"\nkeep = ["elbow_joint", "wrist_1_joint"]\nlock = { shoulder_lift_joint = -1.0 }\n'
    robot = vp.load_scene(write(tmp_path, text + "[horizon]\ndt = 1e-3\nsteps = 5\n")).robot
    assert robot.joint_names == ("elbow_joint", "wrist_1_joint")
    assert robot.locked["shoulder_lift_joint"] == -1.0
    wrong = write(tmp_path, text.replace("elbow_joint", "elbow") + "[horizon]\ndt = 1e-3\nsteps = 5\n")
    with pytest.raises(vp.SceneFileError, match=r"keep.*elbow_joint"):
        vp.load_scene(wrong)


def test_robots_of_a_file_are_those_that_combine_makes(tmp_path):
    file = vp.load_scene(write(tmp_path, TWO), required_only=False)
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned[0, 3] = 0.02
    left = vp.load_robot("finger", lock={"dip": 0.2}, payload=vp.Payload("tip", 1e-3))
    right = vp.load_robot("finger", base=turned)
    robot = vp.combine(left, right, prefixes=["left_", "right_"])
    assert file.robot.joint_names == ("left_mcp", "left_pip", "right_mcp", "right_pip", "right_dip")
    assert dict(file.robot.locked) == {"left_dip": 0.2}
    scene = vp.Scene(robot, damping={"right_pip": 0.1}, actuation=["left_mcp", "right_mcp"])
    start = {"left_mcp": 0.1, "right_dip": -0.2}
    motion = vp.simulate(scene, start, 0.0 * np.zeros(5), dt=1e-3, steps=20, integrator=file.integrator)
    np.testing.assert_allclose(file.simulate().q, motion.q, atol=1e-12)


def test_joints_that_nothing_touches_are_left_out_of_each_robot(tmp_path):
    text = TWO.replace("damping = { right_pip = 0.1 }", "gravity = false")
    path = write(tmp_path, text.replace("[horizon]", "v = { right_mcp = 1.0 }\n\n[horizon]"))
    file, whole = vp.load_scene(path), vp.load_scene(path, required_only=False)
    # A robot of which nothing is left would be none.
    assert file.robot.joint_names == whole.robot.joint_names
    np.testing.assert_array_equal(file.simulate().q, whole.simulate().q)
    hands = TWO_HANDS.replace("[horizon]", 'v = { "right_joint_1.0" = 1.0, "left_joint_5.0" = 1.0 }\n\n[horizon]')
    path = write(tmp_path, hands)
    file, whole = vp.load_scene(path), vp.load_scene(path, required_only=False)
    assert len(file.robot.joint_names) == 8
    own = [whole.robot.joint_names.index(name) for name in file.robot.joint_names]
    assert {name.partition("_")[0] for name in file.robot.joint_names} == {"left", "right"}
    np.testing.assert_allclose(file.simulate().q, whole.simulate().q[:, own], atol=1e-12)


MISTAKES = [
    (TWO.replace(TWO.split("[[robot]]")[1], "").replace("[[robot]]", "", 1), "robot", "two or more robots"),
    (TWO.replace('prefix = "right_"', 'prefix = "left_"'), "robot", "'left_dip'"),
    (TWO.replace("prefix = ", "prefx = ", 1), "robot[0].prefx", ""),
    (TWO.replace("dip = 0.2 }", "dop = 0.2 }"), "robot[0].lock.dop", "dip"),
    (TWO.replace('"tip"', '"tipp"'), "robot[0].payload", "tip"),
    (TWO.replace('"left_mcp", "right_mcp"', '"mcp"'), "actuation.joints[0]", "left_mcp"),
]


@pytest.mark.parametrize(("text", "key", "words"), MISTAKES, ids=[key for _, key, _ in MISTAKES])
def test_mistakes_name_the_robot(tmp_path, text, key, words):
    with pytest.raises(vp.SceneFileError) as caught:
        vp.load_scene(write(tmp_path, text))
    assert caught.value.key == key
    assert words in str(caught.value)


def test_two_arms_lift_their_beam(capsys):
    task = vp.load_scene("beam_lift")
    plan = task.solve()
    assert plan.status is vp.Status.CONVERGED
    g = np.abs([task.scene.constraint_values(q)[0] for q in plan.trajectory.q]).max()
    assert g < 1e-12
    height = task.robot.frame_positions(plan.trajectory.q, "left_tool0")[:, 2]
    assert height[-1] - height[0] > 0.1
    assert main(["inspect", "beam_lift"]) == 0
    assert "left_elbow_joint" in capsys.readouterr().out
