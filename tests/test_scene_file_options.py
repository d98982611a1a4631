"""Every option of load_robot and Scene has a key in scene files, and postures are configurations there."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from mechanisms import joint, link, write_urdf
from refusals import refused, unnamed

import varpin as vp
from varpin.cli import main

SRDF = """<robot name="made_up">
<group_state name="home" group="arm"><joint name="j1" value="0.5"/><joint name="j2" value="-0.3"/></group_state>
<group_state name="folded" group="arm"><joint name="j1" value="0.1"/></group_state>
<group_state name="folded" group="all"><joint name="j1" value="0.2"/><joint name="j2" value="0.4"/></group_state>
</robot>"""
HORIZON = "\n[horizon]\ndt = 1e-3\nsteps = 3\n"
DYNAMICS = '<dynamics damping="0.3" friction="0.2"/>'


@pytest.fixture
def arm(tmp_path):
    """A URDF file of two joints with dampers and dry friction, and an SRDF file that is not found by its name."""
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "postures.srdf").write_text(SRDF)
    parts = [link(f"l{i}") for i in (1, 2)]
    parts += [joint("j1", "base", "l1", inside=DYNAMICS), joint("j2", "l1", "l2", inside=DYNAMICS)]
    return write_urdf(tmp_path, *parts)


def load(path, text):
    file = path.parent / "scene.toml"
    file.write_text(text)
    return vp.load_scene(file, required_only=False)


@pytest.mark.parametrize(
    ("keys", "given"),
    [
        ('friction = "robot"', {"friction": "robot"}),
        ("friction = { j2 = 0.7 }\ndamping = 0.1", {"friction": {"j2": 0.7}, "damping": 0.1}),
        ('[[force]]\ntype = "friction"\nlevel = "robot"\nwidth = 0.1', {"forces": [vp.CoulombFriction(0.2, 0.1)]}),
    ],
)
def test_dry_friction(arm, keys, given):
    head, force = ("", keys) if keys.startswith("[[") else (keys, "")
    scene = load(arm, f'{head}\n[robot]\nsource = "{arm.name}"\n{force}{HORIZON}').scene
    expected = vp.Scene(vp.load_robot(arm), **given)
    # Compared with the force itself, in a motion.
    ends = [vp.simulate(s, [0.1, 0.2], [0.7, -1.3], dt=1e-3, steps=20).q for s in (scene, expected)]
    np.testing.assert_array_equal(*ends)
    assert np.abs(
        ends[0] - vp.simulate(vp.Scene(vp.load_robot(arm)), [0.1, 0.2], [0.7, -1.3], dt=1e-3, steps=20).q
    ).any()


def test_a_description_without_damping_and_friction_is_named(caplog):
    with caplog.at_level(logging.WARNING):
        scene = vp.Scene(vp.load_robot("ur10"), damping="robot", friction="robot")
    assert not scene.forces
    assert [unnamed(record.getMessage(), ("'ur10'", "='robot'", "none")) for record in caplog.records] == [[], []]


def test_friction_is_short_for_a_force(arm):
    robot = vp.load_robot(arm)
    short, long = vp.Scene(robot, friction="robot"), vp.Scene(robot, forces=[vp.CoulombFriction(robot.friction)])
    assert [element.values for element in short.elements] == [element.values for element in long.elements]
    np.testing.assert_array_equal([element.values[0] for element in short.elements], [0.2, 0.2])
    for wrong in ("urdf", -0.1, [0.1]):
        with refused(vp.InputError, "friction"):
            vp.Scene(robot, friction=wrong)


@pytest.mark.parametrize(
    ("keys", "messages"), [("", 2), ("damping = 0.0", 0), ('damping = "robot"\nfriction = 0.0', 0)]
)
def test_what_a_file_leaves_out_is_logged_once(arm, caplog, keys, messages):
    with caplog.at_level(logging.WARNING):
        path = arm.parent / "scene.toml"
        path.write_text(f'{keys}\n[robot]\nsource = "{arm.name}"{HORIZON}')
        vp.load_scene(path).simulate()
    assert len([record for record in caplog.records if "leaves out" in record.getMessage()]) == messages


def test_postures_are_configurations(arm):
    text = f"""
[robot]
source = "{arm.name}"
srdf = "config/postures.srdf"
[springs]
stiffness = 1.0
rest = "arm/folded"
[initial]
q = "home"
[[noise]]
type = "state"
intensity = 0.1
center = "all/folded"
[[cost]]
type = "tracking"
reference = "home"
terminal = true
[[cost]]
type = "control"
hold = "home"
{HORIZON}"""
    file = load(arm, text)
    np.testing.assert_array_equal(file.q0, [0.5, -0.3])
    np.testing.assert_array_equal(file.scene.rest, [0.1, 0.0])
    np.testing.assert_array_equal(file.scene.values["noise.center"].ravel()[::2], [0.2, 0.4])
    tracking, control = file.problem.cost.terms
    np.testing.assert_array_equal(tracking.reference, [0.5, -0.3])
    np.testing.assert_allclose(control.reference, file.scene.holding_torque(file.q0), rtol=1e-12)
    with refused(vp.SceneFileError, "initial.q", "'hom'", "home", "folded"):
        load(arm, text.replace('q = "home"', 'q = "hom"'))
    with refused(vp.SceneFileError, "springs.rest", "arm/folded", "all/folded"):
        load(arm, text.replace('"arm/folded"', '"folded"'))


def test_postures_of_a_command(arm, tmp_path, capsys):
    saved = tmp_path / "motion.npz"
    (arm.parent / "config" / "postures.srdf").rename(arm.with_suffix(".srdf"))
    command = ["simulate", str(arm), "--steps", "2", "--save", str(saved), "--quiet", "--q0"]
    for word, expected in (("home", [0.5, -0.3]), ("all/folded", [0.2, 0.4])):
        assert main([*command, word]) == 0
        np.testing.assert_array_equal(vp.Trajectory.load(saved).q[0], expected)
    capsys.readouterr()
    for words, facts in ((["hom"], ("'hom'", "home", "folded")), (["home", "0.1"], "--q0")):
        assert main([*command, *words]) != 0
        assert not unnamed(capsys.readouterr().err, facts)


def test_a_joint_with_several_axes_is_locked(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text('[robot]\nsource = "kinova"\nlock = { j2s6s200_joint_1 = 0.3 }' + HORIZON)
    assert vp.load_scene(path).robot.locked == {"j2s6s200_joint_1": 0.3}
    path.write_text('[robot]\nsource = "kinova"\nlock = { j2s6s200_joint_1 = [0.3, 0.1] }' + HORIZON)
    with refused(vp.SceneFileError, "robot", "j2s6s200_joint_1", "1 value"):
        vp.load_scene(path)


def test_arguments_of_a_xacro_file(tmp_path):
    pytest.importorskip("xacro")
    inertial = (
        '<inertial><mass value="$(arg mass)"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    (tmp_path / "arm.urdf.xacro").write_text(
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arg name="prefix" default=""/>'
        f'<xacro:arg name="mass" default="1"/><link name="base"/><link name="l">{inertial}</link>'
        '<joint name="$(arg prefix)j" type="continuous"><parent link="base"/><child link="l"/></joint>'
        "</robot>"
    )
    path = tmp_path / "scene.toml"
    path.write_text('[robot]\nsource = "arm.urdf.xacro"\nxacro_args = { prefix = "left_", mass = 3 }' + HORIZON)
    robot = vp.load_scene(path, required_only=False).robot
    assert (robot.joint_names, robot.tree.mass.tolist()) == (("left_j",), [3.0])
