"""What inspection says of sound and of faulty robots."""

import logging
from pathlib import Path

import mechanisms
import numpy as np
import pytest
from findings import about
from oracles import Mechanism
from refusals import naming, refused, unnamed

import varpin as vp
from varpin.show.inspection import inspect_robot

ROD = '<mass value="1"/><origin xyz="0.5 0 0"/><inertia ixx="0.001" ixy="0" ixz="0" iyy="0.083" iyz="0" izz="0.083"/>'
ODD = "non-physical inertia"


def inertial(mass: float, ixx: float, iyy: float, izz: float, x: float = 0.5) -> str:
    return (
        f'<mass value="{mass}"/><origin xyz="{x} 0 0"/>'
        f'<inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/>'
    )


def write_arm(folder: Path, *links: str | None) -> Path:
    """A URDF of links link1, link2, ... in a row, 1 m apart on joints joint1, joint2, ... about y."""
    parts, before, place = [], "base", 'xyz="0 0 0"'
    for k, own in enumerate(links, start=1):
        parts.append(mechanisms.link(f"link{k}", "" if own is None else f"<inertial>{own}</inertial>"))
        parts.append(mechanisms.joint(f"joint{k}", before, f"link{k}", place=place))
        before, place = f"link{k}", 'xyz="1 0 0"'
    return mechanisms.write_urdf(folder, *parts)


def test_sound_arm_gives_no_warning_and_its_figures(tmp_path):
    report = inspect_robot(write_arm(tmp_path, ROD, ROD))
    assert report.warnings == ()
    assert report.total_mass == pytest.approx(2.0)
    first = report.joints[0]
    assert (first.name, first.kind, first.unit) == ("joint1", "revolute", "rad")
    assert (first.lower, first.upper, first.effort, first.velocity) == (-1.0, 1.0, 9.0, 8.0)
    np.testing.assert_allclose(first.axis, [0.0, 1.0, 0.0])
    link = report.links[1]
    assert (link.name, link.joint, link.mass) == ("link2", "joint2", 1.0)
    np.testing.assert_allclose(link.center, [0.5, 0.0, 0.0])
    np.testing.assert_allclose(link.moments, [0.001, 0.083, 0.083])
    # Joints span all links together: 3 m to a centre of mass are plausible where six joints are 1 m apart.
    assert inspect_robot(write_arm(tmp_path, *[ROD] * 5, inertial(1, 0.001, 0.083, 0.083, x=3.0))).warnings == ()


@pytest.mark.parametrize(
    ("links", "facts"),
    [
        ((ROD, None), ("massless", "'link2'", "'joint2'", "nothing")),
        ((ROD, None), ("mass matrix", "singular", "'joint2'")),
        ((ROD, inertial(1, 0, 0, 0)), ("point mass", "'link2'", "1 kg")),
        ((ROD, inertial(1, -0.02, 0.08, 0.08)), (ODD, "'link2'", "positive definite", "-0.02, 0.08, 0.08")),
        ((ROD, inertial(1, 0.01, 0.02, 0.08)), (ODD, "'link2'", "triangle inequality", "0.08 > 0.01 + 0.02")),
        ((ROD, inertial(1, 0.08, 0.08, 0.08, x=500)), ("centre of mass", "'link2'", "500 m", "1 m")),
        ((ROD, inertial(1, 80, 80, 80)), ("radius of gyration", "'link2'", "8.94 m")),
        ((ROD, inertial(1, 1e-7, 1e-7, 1e-7)), ("inertia", "small", "'link2'", "1 kg")),
    ],
)
def test_faulty_link_is_named(tmp_path, links, facts):
    report = inspect_robot(write_arm(tmp_path, *links))
    assert naming(report.warnings, facts), report.warnings
    assert (report.condition == np.inf) == (None in links)


def test_inertia_that_its_shape_cannot_have():
    """A published UR5 gives its wrists a radius of gyration of 0.42 m, and they are as large as a hand."""
    (warning,) = naming(inspect_robot("ur5").warnings, "implausibly large inertia")
    assert not naming(inspect_robot("ur5", meshes=False).warnings, "inertia")
    assert not unnamed(warning, "'wrist_1_link'", "'wrist_2_link'", "'wrist_3_link'", "0.424 m", "0.14 m")
    assert not [text for text in inspect_robot("ur10").warnings if "inertia" in text]


@pytest.mark.parametrize(("x", "told"), [(0.12, False), (0.9, True)])
def test_centre_of_mass_far_outside_of_its_shape(tmp_path, x, told):
    """Arms of a maker give centres in the base's axes: their hands have them 1.4 m away from themselves."""
    arm = write_arm(tmp_path, ROD, inertial(1, 0.001, 0.001, 0.001, x=x))
    shape = '<visual><geometry><box size="0.2 0.1 0.1"/></geometry></visual>'
    arm.write_text(arm.read_text().replace('<link name="link2">', f'<link name="link2">{shape}'))
    warnings = naming(inspect_robot(arm).warnings, ("centre of mass", "'link2'", "0.8 m", "0.24 m"))
    assert bool(warnings) == told
    assert not inspect_robot(arm, meshes=False).warnings


def test_one_line_for_each_kind(tmp_path):
    plate = inertial(1, 0.01, 0.02, 0.08)
    report = inspect_robot(write_arm(tmp_path, plate, plate, plate, plate, plate))
    (warning,) = report.warnings
    assert not unnamed(warning, "'link1'", "'link2'", "'link3'", "2 more")
    assert len(warning) <= 240


def test_condition_number_is_that_of_the_mass_matrix():
    q = [0.1, -0.4, 0.8, 0.2, 0.5, -0.3, 0.0]
    report = inspect_robot("z1", q=q)
    M = Mechanism(vp.Scene(report.robot)).mass_matrix(np.array(q))
    scale = np.diag(np.diag(M) ** -0.5)
    assert report.condition == pytest.approx(np.linalg.cond(scale @ M @ scale))


def test_ill_conditioned_mass_matrix_is_said(tmp_path):
    """Two joints on one axis: only the first link's own inertia tells them apart."""
    path = write_arm(tmp_path, inertial(1e-3, 1e-7, 1e-7, 1e-7, x=0), inertial(1, 0.01, 0.5, 0.5))
    path.write_text(path.read_text().replace('<origin xyz="1 0 0"/><parent', '<origin xyz="0 0 0"/><parent'))
    report = inspect_robot(path)
    assert naming(report.warnings, "mass matrix", "ill-conditioned")
    # M = [[I + e, I], [I, I]] with I = 0.75 and e = 1e-7.
    assert report.condition == pytest.approx(4 * 0.75 / 1e-7, rel=1e-5)


def test_mimic_joints_locked_joints_and_damping_are_said():
    report = inspect_robot("panda", lock={"panda_joint7": 0.5})
    mimic = next(joint for joint in report.joints if joint.kind == "mimic")
    assert (mimic.name, mimic.follows, mimic.unit) == ("panda_finger_joint2", "1 * panda_finger_joint1", "m")
    assert not naming(report.warnings, "'panda_joint7'", "locked")
    assert "1 * panda_finger_joint1" in str(report)
    assert naming(report.warnings, "damping='robot'")
    assert inspect_robot("panda", mimic="free").robot.dof == 9


def test_loaded_robot_is_taken_and_not_loaded_otherwise():
    robot = vp.planar_chain(2)
    assert inspect_robot(robot).robot is inspect_robot(robot, lock=None).robot is robot
    with pytest.raises(TypeError, match="unexpected keyword argument 'lokc'"):
        inspect_robot("ur5", lokc={})
    with refused(vp.InputError, "lock"):
        inspect_robot(robot, lock={"joint1": 0.0})


def test_a_report_prints_its_tables_and_warnings():
    report = inspect_robot("panda", lock={"panda_joint7": 0.5})
    text = str(report)
    for joint in report.joints:
        assert joint.name in text
    for link in report.links:
        assert f"\n  {link.name} " in text
    assert f"  {report.total_mass:.5g}\n" in text
    assert f"end effector          {report.robot.end_effector}\n" in text
    for warning in report.warnings:
        assert f"warning: {warning}\n" in text + "\n"
    assert "\x1b" not in text
    assert repr(report).startswith("RobotReport(panda: ")
    assert "nothing looks wrong" in str(inspect_robot("finger"))


def test_frames_are_listed_with_what_carries_them():
    """Each by a name that varpin finds; the chain of parents ends at the world, and passes the joint that moves it."""
    robot = vp.load_robot("ur5")
    report = inspect_robot(robot)
    model = robot.model
    assert [frame.name for frame in report.frames] == [frame.name for frame in list(model.frames)[1:]]
    frames = {frame.name: frame for frame in report.frames}
    q = np.zeros((1, 6))
    for frame in report.frames:
        assert robot.frame_positions(q, frame.name).shape == (1, 3)
        at, passed = frame, set()
        while at is not None:
            passed.add(at.name)
            at = frames.get(at.parent)
        assert not frame.joint or frame.joint in passed
        moving = [joint for joint in robot.joint_names if joint in passed]
        assert frame.joint == (moving[-1] if moving else "")
    assert frames["tool0"].kind == "link"
    assert frames["tool0"].parent == "wrist_3_link-tool0_fixed_joint"
    assert frames["elbow_joint"] == vp.FrameReport("elbow_joint", "joint", "upper_arm_link", "elbow_joint")
    for name in frames:
        assert f"\n  {name} " in str(report)


def test_a_leader_that_turns_is_an_angle_whatever_follows(tmp_path):
    """And inspection says that zero is outside of its limits."""
    turns = mechanisms.joint("turns", "base", "a").replace('lower="-1" upper="1"', 'lower="0.5" upper="1.5"')
    follows = mechanisms.joint("follows", "base", "b", "prismatic", inside=mechanisms.mimic("turns", 0.1))
    links = mechanisms.link("a"), mechanisms.link("b")
    path = mechanisms.write_urdf(tmp_path, *links, turns.replace('velocity="8"', 'velocity="1"'), follows)
    robot = vp.load_robot(path)
    assert robot.tree.prismatic.any()
    assert robot.slides.tolist() == [False]
    motion = vp.simulate(vp.Scene(robot, gravity=False), [1.0], [3.0], dt=1e-2, steps=40)
    assert naming(motion.warnings, "1.5", "rad")
    told = about(inspect_robot(robot).warnings, "outside limits")
    assert len(told) == len(naming(told, "q = 0", "'turns'", "0.5", "1.5")) == 1
    assert not about(inspect_robot(robot, q=[1.0]).warnings, "outside limits")


def test_joints_locked_outside_their_limits_are_told_of(caplog):
    with caplog.at_level(logging.WARNING):
        vp.load_robot("panda", lock={"panda_joint4": -1.0})
        assert not about(caplog.messages, "outside limits")
        vp.load_robot("panda", lock={"panda_joint4": 1.0})
    assert naming(caplog.messages, "lock['panda_joint4'] = 1", "limits", "-3.0718")
