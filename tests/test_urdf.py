"""Robots as Pinocchio reads them from any URDF or xacro file; what is left out is told, what cannot be is refused."""

import os
import pickle
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import INERTIAL, arm, built, joint, link, mimic, write_urdf
from refusals import naming, refused, unnamed

import varpin as vp
from varpin.model import geometry, readable_geometry
from varpin.model.names import robots_dir
from varpin.model.urdf import read_urdf

ROBOTS = robots_dir()
PUBLISHED = sorted(str(path.relative_to(ROBOTS)) for path in ROBOTS.rglob("*.urdf"))
BALL = '<visual><geometry><sphere radius="0.1"/></geometry></visual>'
HEAVY = '<inertial><origin xyz="0.1 0 0.2"/><mass value="5"/></inertial>'
THIN = '<inertial><mass value="2"/><inertia ixx="{}" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'


@pytest.fixture
def two(tmp_path):
    """The text of a robot of two joints, the second of which mimics the first, and a fixed link."""
    parts = [link(name, extra=BALL) for name in ("l1", "l2", "tool")]
    joints = [joint("j1", "base", "l1"), joint("j2", "l1", "l2", inside=mimic("j1", 2, 0.1))]
    return write_urdf(tmp_path, *parts, *joints, joint("j3", "l2", "tool", "fixed")).read_text()


def written(folder, text, encoding="utf-8"):
    path = folder / "odd.urdf"
    path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
    return path


def assert_same(model, expected):
    """Two models have the same joints, placements, inertias and limits."""
    assert list(model.names) == list(expected.names)
    assert list(model.parents) == list(expected.parents)
    for one, other in zip(model.jointPlacements, expected.jointPlacements, strict=True):
        np.testing.assert_array_equal(one.homogeneous, other.homogeneous)
    for one, other in zip(model.inertias, expected.inertias, strict=True):
        np.testing.assert_array_equal(one.toDynamicParameters(), other.toDynamicParameters())
    for one, other in zip(model.joints, expected.joints, strict=True):
        assert one.shortname() == other.shortname()
    for name in ("lowerPositionLimit", "upperPositionLimit", "effortLimit", "velocityLimit", "damping"):
        np.testing.assert_array_equal(getattr(model, name), getattr(expected, name))


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_robots_are_as_pinocchio_reads_them(name):
    try:
        expected = pin.buildModelFromUrdf(str(ROBOTS / name))
    except ValueError:
        with pytest.raises(vp.RobotError):
            read_urdf(ROBOTS / name)
        return
    urdf = read_urdf(ROBOTS / name)
    assert_same(urdf.model, expected)
    frames = {frame.name: frame for frame in expected.frames if frame.type == pin.FrameType.BODY}
    # Links that hang on one another for good, taken together, are the bodies.
    bodies = np.zeros((expected.njoints, 6, 6))
    for part in urdf.inertials:
        lever, place = part.mass * pin.skew(part.center), frames[part.link].placement
        body = np.block([[part.mass * np.eye(3), -lever], [lever, part.inertia - lever @ pin.skew(part.center)]])
        bodies[frames[part.link].parentJoint] += place.toDualActionMatrix() @ body @ place.toActionMatrixInverse()
    for joint_index, body in enumerate(bodies):
        read = expected.inertias[joint_index].matrix()
        np.testing.assert_allclose(body, read, rtol=0, atol=1e-12 * max(np.abs(read).max(), 1e-9))


OTHERS = (
    '<gazebo reference="l1"><mu1>0.2</mu1><plugin name="p" filename="q"/></gazebo><transmission name="t">'
    '<joint name="j1"/><actuator name="m"><mechanicalReduction>x</mechanicalReduction></actuator></transmission>'
    '<ros2_control name="r" type="system"><joint name="j1"/></ros2_control></robot>'
)
EXPANDED = '<robot xmlns:xacro="http://ros.org/wiki/xacro" '
UNEXPANDED = '<robot name="made_up" xmlns:x="http://ros.org/wiki/xacro"><x:insert/>'
TOOL = '<link name="tool">' + INERTIAL
# What is replaced in the text, and what the log has to say of it.
ODD = {
    "as it is": ("", "", ()),
    "drake's attributes without a namespace": ("<limit ", '<limit drake:acceleration="3" ', ()),
    "drake's elements": ("</robot>", '<drake:joint name="x"/><drake:loop_constraint a="b"/></robot>', ()),
    "a default namespace": ("<robot ", '<robot xmlns="http://drake.mit.edu" ', ()),
    "an expanded xacro": ("<robot ", EXPANDED, ()),
    "a xacro macro that nothing uses": ("</robot>", "<xacro:macro name='a'/></robot>", "<xacro:macro>"),
    "a xacro macro that nothing expanded": ('<robot name="made_up">', UNEXPANDED, "<x:insert>"),
    "an expression": ("</visual>", '<material name="${color}"/></visual>', ()),
    "comments with dashes": ("<joint", "<!-- one -- two --- -->\n<!---->\n<joint", ()),
    "a comment around a joint": ("</robot>", "<!--<joint name='k'/>--></robot>", ()),
    "unknown elements": ("</link>", "<sensor><camera/></sensor><mass/></link>", ()),
    "other programs' elements": ("</robot>", OTHERS, ()),
    "a byte order mark": ("<?xml", "\ufeff<?xml", ()),
    "dos lines": ("\n", "\r\n", ()),
    "blank lines first": ("<?xml", "\n \n<?xml", ()),
    "no inertia": (INERTIAL, HEAVY, ("[l1]", "inertia")),
    "no mass": ('<mass value="1.3"/>', "", ("[l1]", "mass")),
    "a mass that is none": ('"1.3"', '"1.3 kg"', ("[l1]", "mass", "[1.3 kg]")),
    "a negative mass": (TOOL, TOOL.replace("1.3", "-0.1"), ("'tool'", "mass", "-0.1")),
    "a moment that is none": ('ixx="0.02"', 'ixx="nan"', ("[l1]", "ixx")),
    "a centre of two numbers": ('xyz="0.02 0.05 0.1"', 'xyz="0.02 0.05"', ("[l1]", "[0.02 0.05]")),
    "a number with blanks": ('"1.3"', '" 1.3 "', ()),
}


@pytest.mark.parametrize("kind", ODD)
def test_odd_files_load_as_pinocchio_reads_them(tmp_path, two, caplog, kind):
    old, new, facts = ODD[kind]
    assert old in two
    path = written(tmp_path, two.replace(old, new, -1 if kind == "dos lines" else 1))
    robot = vp.load_robot(path)
    assert bool(facts) == bool(caplog.records)
    if kind != "a number with blanks":  # of which Pinocchio's parser reads nothing
        assert_same(robot.model, pin.buildModelFromUrdf(str(path)))
    assert robot.joint_names == ("j1",)
    (tie,) = robot.ties
    assert (tie.ratio, tie.offset) == (2.0, 0.1)
    found, missing = readable_geometry(robot)
    # Pinocchio drops the visuals of a link with the rest of its inertial.
    assert (found.ngeoms, missing) == (3, {})
    assert kind != "no inertia" or robot.model.inertias[1].mass == 5.0
    report = vp.inspect_robot(path)
    assert len(report.joints) == 2
    assert not facts or naming(caplog.messages, facts)


def test_names_in_the_encoding_that_is_declared(tmp_path, two, caplog):
    text = two.replace("?>", " encoding='latin-1' ?>", 1).replace('"j1"', '"épaule"')
    robot = vp.load_robot(written(tmp_path, text, "latin-1"))
    assert robot.joint_names == ("épaule",)
    assert not caplog.records


H = np.sqrt(0.5)
SPEC = (
    '<inertial><origin xyz="0.1 0.2 0" {}/><mass value="2"/>'
    '<inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def of_version(folder, version, turn, extra=""):
    """A robot whose joint, inertias and extra are turned; quat_xyzw belongs to URDF 1.1 and later."""
    inertial, moved = SPEC.format(turn), joint("j1", "base", "l1").replace('rpy="0.1 0.2 0.3"', turn)
    path = write_urdf(folder, link("l1", inertial, extra), moved, link("t", inertial), joint("j2", "l1", "t", "fixed"))
    path.write_text(path.read_text().replace("<robot ", f'<robot version="{version}" '))
    return path


@pytest.mark.parametrize("version", ["1.0", "1.1", "1.2"])
def test_turns_are_as_pinocchio_reads_them(tmp_path, version):
    path = of_version(tmp_path, version, f'quat_xyzw="{H} 0 0 {H}"')
    robot = vp.load_robot(path)
    assert_same(robot.model, pin.buildModelFromUrdf(str(path)))
    turned = robot.model.jointPlacements[1].rotation
    expected = np.eye(3) if version == "1.0" else pin.rpy.rpyToMatrix(np.pi / 2, 0, 0)
    np.testing.assert_allclose(turned, expected, atol=1e-12)
    for part in vp.inspect_robot(path).links:
        np.testing.assert_allclose(part.inertia, expected @ np.diag([0.1, 0.2, 0.25]) @ expected.T, atol=1e-12)


def test_what_came_with_later_versions(tmp_path, caplog):
    """Turns of shapes, capsules, and limits without an effort."""
    capsule = '<geometry><capsule radius="0.05" length="0.5"/></geometry>'
    shape = f'<visual><origin quat_xyzw="0 {H} 0 {H}"/>{capsule}</visual>'
    path = of_version(tmp_path, "1.2", 'rpy="0 0 0"', shape)
    path.write_text(path.read_text().replace('effort="9" velocity="8" ', ""))
    robot = vp.load_robot(path)
    (drawn,) = geometry(robot).geometryObjects
    assert isinstance(drawn.geometry, pin.coal.Capsule)
    np.testing.assert_allclose(drawn.placement.rotation[:, 2], [1.0, 0.0, 0.0], atol=1e-12)
    assert (robot.position_limits[1].tolist(), robot.velocity_limit.tolist()) == ([1.0], [np.inf])
    assert not caplog.records


NONE, NO_LIMITS = "count as none", (-np.inf, np.inf, np.inf, np.inf)


@pytest.mark.parametrize(
    ("limit", "read", "facts"),
    [
        ('lower="-1" upper="1" velocity="3" effort="-1"', (-1, 1, 3, np.inf), (NONE, "effort -1", "'j1'")),
        ('lower="-1" upper="1" velocity="-1" effort="3"', (-1, 1, np.inf, 3), (NONE, "velocity -1", "'j1'")),
        ('lower="-inf" upper="inf" velocity="inf" effort="+Infinity"', NO_LIMITS, (NONE, "'j1'")),
        ('lower="-1" upper="-1" velocity="3" effort="3"', (-np.inf, np.inf, 3, 3), (NONE, "upper -1", "'j1'")),
        ('lower="none" upper="None" velocity="nan" effort=""', NO_LIMITS, (NONE, "None")),
        ('lower="0" upper="0" velocity="0" effort="0"', NO_LIMITS, ()),
        ('lower="-1" upper="1"', (-1, 1, np.inf, np.inf), (NONE, "no effort", "no velocity")),
        ("", NO_LIMITS, (NONE, "no effort")),
        ('lower="-1e16" upper="1e16" velocity="3" effort="3"', (-np.inf, np.inf, 3, 3), (NONE, "1e16")),
        ('lower="-170" upper="172.5" velocity="3" effort="3"', (-170, 172.5, 3, 3), ("degrees", "-170 to 172.5")),
        ('lower="-6.28" upper="6.28" velocity="3" effort="3"', (-6.28, 6.28, 3, 3), ()),
        ('lower="1" upper="-1" velocity="3" effort="3"', (1, -1, 3, 3), ("no room", "1 and -1 of 'j1'")),
    ],
)
def test_limits_as_exporters_write_them(tmp_path, caplog, limit, read, facts):
    text = arm(tmp_path).read_text().replace('effort="9" velocity="8" lower="-1" upper="1"', limit)
    robot = vp.load_robot(written(tmp_path, text))
    found = (*robot.position_limits[0], *robot.position_limits[1], *robot.velocity_limit, *robot.effort_limit)
    assert found == read
    told = vp.inspect_robot(robot).warnings
    assert len(caplog.messages) == len(told) == bool(facts)
    assert naming(caplog.messages, facts) == caplog.messages
    assert naming(told, (NONE, "'j1'") if NONE in facts else facts) == list(told)


def test_one_line_for_many_joints(tmp_path, caplog):
    parts = [link(f"l{k}") + joint(f"j{k}", f"l{k - 1}" if k else "base", f"l{k}") for k in range(12)]
    vp.load_robot(written(tmp_path, write_urdf(tmp_path, *parts).read_text().replace('effort="9"', 'effort="-1"')))
    (line,) = caplog.messages
    assert len(line) < 240


SOFT = '<safety_controller soft_lower_limit="-0.1" k_velocity="10"/><joint_properties damping="0.2" friction="0.2"/>'


@pytest.mark.parametrize(
    ("given", "lower", "logged", "told"),
    [
        ({"kind": "continuous"}, -np.inf, ("continuous", "'j1'"), ()),
        ({"inside": SOFT}, -1.0, ("joint_properties", "dynamics", "'j1'"), ("safety_controller", "'j1'")),
        ({"inside": mimic("thumb")}, -1.0, ("'j1'", "'thumb'"), ()),
    ],
    ids=["limits of a wheel", "soft limits and misnamed dynamics", "a leader that is not there"],
)
def test_odd_joints_are_told(tmp_path, caplog, given, lower, logged, told):
    path = arm(tmp_path, **given)
    robot = vp.load_robot(path)
    assert (robot.joint_names, robot.position_limits[0].tolist()) == (("j1",), [lower])
    assert naming(caplog.messages, logged)
    assert naming(vp.inspect_robot(path).warnings, told) or not told


@pytest.mark.parametrize("how", ["beside", "given"])
def test_rotors_of_an_srdf_are_as_pinocchio_reads_them(tmp_path, how):
    path = write_urdf(tmp_path, link("a"), link("b"), joint("j1", "base", "a"), joint("j2", "a", "b"))
    rotors = '<joint name="j2" mass="1e-4" gear_ratio="-50"/><joint name="no" mass="1" gear_ratio="1"/>'
    srdf = tmp_path / ("made_up.srdf" if how == "beside" else "other.srdf")
    srdf.write_text(f'<robot name="{how}"><rotor_params>{rotors}</rotor_params></robot>')
    robot = vp.load_robot(path, srdf=None if how == "beside" else srdf)
    model = pin.buildModelFromUrdf(str(path))
    pin.loadRotorParameters(model, str(srdf), False)
    np.testing.assert_allclose(robot.model.armature, model.armature, rtol=1e-14)
    assert model.armature[1] == pytest.approx(0.25)
    assert vp.load_robot(path, armature=0.5).model.armature.tolist() == [0.5, 0.5]
    follower = joint("j2", "a", "b", inside=mimic("j1", -2))
    tied = write_urdf(tmp_path, link("a"), link("b"), joint("j1", "base", "a"), follower, name="tied")
    assert vp.load_robot(tied, srdf=srdf).tree.armature == pytest.approx([4.0 * 0.25])
    (plain := tmp_path / "plain.srdf").write_text('<robot name="plain"/>')
    assert vp.load_robot(path, srdf=plain).model.armature.tolist() == [0.0, 0.0]


def test_a_decimal_comma_is_named_as_the_cause(tmp_path):
    with refused(vp.SingularMassMatrix, "'j1'", "[l1]", "[0,3]", "point") as info:
        vp.load_robot(arm(tmp_path, INERTIAL.replace('"1.3"', '"0,3"')))
    assert len(str(info.value)) <= 240


def test_a_mass_of_a_billion_kilograms_is_told_as_what_it_is(tmp_path):
    heavy = INERTIAL.replace('"1.3"', '"6e9"').replace('ixx="0.02"', 'ixx="1e30"')
    path = write_urdf(tmp_path, link("a"), link("b", heavy), joint("j1", "base", "a"), joint("j2", "a", "b"))
    with refused(vp.SingularMassMatrix, "'b'", "6e+09 kg", "millimetres"):
        vp.load_robot(path)
    assert naming(vp.inspect_robot(path).warnings, "'b'", "6e+09 kg")


def test_faulty_shapes_are_told(tmp_path, caplog):
    shape = '<visual><geometry><box size="0,1 0.1 0.1"/></geometry></visual>'
    path = write_urdf(tmp_path, link("l1", extra=shape), joint("j1", "base", "l1"))
    assert geometry(vp.load_robot(path)).ngeoms == 0
    assert naming(caplog.messages, "read in part", "made_up.urdf")


BALLAST = '"0.02" iyy="0.03" izz="0.025"', '"2" iyy="2" izz="2"'


@pytest.mark.parametrize(
    ("ixx", "facts"),
    [
        (0.0, ()),
        (0.1, ()),
        (0.2, ()),
        (-0.05, ("non-physical inertia", "positive definite", "-0.05, 0.1, 0.1 kg m^2")),
        (0.5, ("non-physical inertia", "0.1, 0.1, 0.5 kg m^2", "0.5 > 0.1 + 0.1")),
    ],
)
def test_inertia_that_no_body_has_is_told_at_load_and_in_the_report(tmp_path, caplog, ixx, facts):
    """Of a link on a fixed joint, too, where the body that two links make has no fault."""
    path = arm(tmp_path, THIN.format(ixx))
    robot = vp.load_robot(path)
    assert robot.model.inertias[1].inertia[0, 0] == pytest.approx(ixx)
    vp.load_robot(pin.buildModelFromUrdf(str(path)))
    sound = link("l1", INERTIAL.replace(*BALLAST)), joint("j1", "base", "l1")
    tool = link("tool", THIN.format(ixx)), joint("j2", "l1", "tool", "fixed")
    vp.load_robot(write_urdf(tmp_path, *sound, *tool))
    names = ("link 'l1'", "'l1'", "link 'tool'")
    assert len(caplog.messages) == (len(names) if facts else 0)
    for name, text in zip(names, caplog.messages, strict=False):
        assert not unnamed(text, name, facts)
    assert naming(vp.inspect_robot(robot).warnings, "'l1'", facts) or not facts


def test_negative_inertia_is_told_from_none(tmp_path):
    """Of a joint, and of a motion of several; without a warning of NumPy's."""
    path = arm(tmp_path, THIN.format("0.1").replace('iyy="0.1"', 'iyy="-3"'))
    with refused(vp.SingularMassMatrix, "'j1'") as caught:
        vp.load_robot(path)
    assert (caught.value.negative, caught.value.joints) == (True, ("j1",))
    with refused(vp.SingularMassMatrix, "'joint1'"):
        built(*((pin.JointModelPZ(), [0, 0, 0], pin.Inertia(mass, np.zeros(3), np.eye(3))) for mass in (3.0, -1.0)))


@pytest.mark.parametrize("axis", ["0 0 0", "", "x y z", "0 1"])
def test_axes_of_fixed_joints_are_not_read(tmp_path, axis):
    joints = joint("j1", "base", "l1"), joint("j2", "l1", "tool", "fixed", axis=axis)
    robot = vp.load_robot(write_urdf(tmp_path, link("l1"), link("tool"), *joints))
    assert [inertial.link for inertial in robot.inertials] == ["l1", "tool"]


def test_threads_that_load_at_once_keep_stderr(tmp_path, capfd):
    path = arm(tmp_path)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(vp.load_robot, [path] * 40))
    os.write(2, b"still here")
    assert "still here" in capfd.readouterr().err


# --- robots that cannot be --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "kind", "facts"),
    [
        ("arm.urdf", vp.RobotNotFound, "arm.urdf"),
        ("{}/arm.urdf", vp.RobotNotFound, "arm.urdf"),
        ("{}/mad_up.urdf", vp.RobotNotFound, ("made_up.urdf", "{}")),
        ("{}/no/arm.urdf", vp.RobotNotFound, "urdf"),
        ("a\0b.urdf", vp.InputError, "source"),
        ("{}/pipe.urdf", vp.RobotNotFound, "pipe.urdf"),
        ("", vp.RobotNotFound, "robot_names"),
        ("qwertyuiop", vp.RobotNotFound, "robot_names"),
        ("ur55", vp.RobotNotFound, ("'ur55'", "ur5")),
        ("Panda", vp.RobotNotFound, ("'Panda'", "panda")),
        ("fingr", vp.RobotNotFound, ("'fingr'", "finger")),
        ("talos", vp.RobotNotFound, ("fixed-base", "'talos'", "talos_arm")),
        ("TwoDofs", vp.RobotNotFound, ("'TwoDofs'", "asr_twodof")),
        ("a1", vp.RobotError, ("'a1'", "a1.urdf")),
        ("{}", vp.RobotError, ("{}", "folder", "made_up.urdf")),
        ("{}/empty", vp.RobotError, ("folder", "no URDF")),
        # A regular file whose every read fails, even for root.
        ("/proc/self/mem", vp.FileError, ("/proc/", "Input/output error")),
        ("a" * 5000 + ".urdf", vp.RobotNotFound, "URDF"),
        *((source, vp.InputError, ("source", type(source).__name__)) for source in (3, None, b"ur5", ["ur5"], object)),
    ],
)
def test_source(tmp_path, source, kind, facts):
    arm(tmp_path)
    (tmp_path / "empty").mkdir()
    os.mkfifo(tmp_path / "pipe.urdf")
    given, facts = [source], (facts,) if isinstance(facts, str) else facts
    if isinstance(source, str):
        given = [source.format(tmp_path), *([Path(source.format(tmp_path))] if "{}" in source else [])]
    for each in given:
        with refused(kind, *(fact.format(tmp_path) for fact in facts)) as info:
            vp.load_robot(each)
        assert "{}" not in str(source) or "ur5" not in str(info.value)
        if kind is vp.RobotNotFound and "'" in facts[0]:
            assert (info.value.name, info.value.matches[0]) == (source, facts[1])


@pytest.mark.parametrize("start", ["", "\n", "<?xml version='1.0'?>\n"])
def test_text_for_a_path(tmp_path, start):
    with refused(vp.InputError, "text of a file", "path") as info:
        vp.load_robot(start + arm(tmp_path).read_text())
    assert len(str(info.value)) < 240


XACRO = b"<robot name='a' xmlns:xacro='http://www.ros.org/wiki/xacro'>"
MASS = b"<robot name='a'><link name='x'><inertial><mass value='${m}'/></inertial></link></robot>"


@pytest.mark.parametrize(
    ("content", "facts"),
    [
        (b"hello world\n", ("XML", "line 1")),
        (b"", "empty"),
        (b"<!DOCTYPE html>\n<html><head><meta charset=utf8></head></html>", "XML"),
        (b"<html><body/></html>", "<html>"),
        (b"<sdf/>", ("not a URDF", "<sdf>")),
        (b"<mujoco><worldbody/></mujoco>", ("not a URDF", "<mujoco>")),
        (b"<robot name='a'>\n<link name='x'>\n</robot>", ("XML", "line 3")),
        (b"<robot name='a'>\n<link name='x'/>\n", ("XML", "line 3")),
        (b"<robot name='a'>\0\0</robot>", "XML"),
        (MASS, ("xacro", "mass [${m}]")),
        (XACRO + b"<xacro:property name='b'/></robot>", "xacro"),
        (XACRO + b'<link name="world"/><xacro:arm/></robot>', ("no joint that moves", "<xacro:arm>")),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n", ("Git LFS", "git lfs pull")),
        (bytes(range(256)) * 20, "XML"),
        (b"\x7fELF\x02\x01\x01" + bytes(500), "XML"),
        (b"<robot><link name='x'/></robot>", "No name given for the robot"),
        (b"<robot name='a'/>", "link"),
        (b"<robot name='a'><link name='x'/></robot>", "joint"),
        *((f"<robot name='a' version='{x}'/>".encode(), ("not a URDF", "version")) for x in ("9.9", "1", "x")),
    ],
)
def test_no_urdf(tmp_path, content, facts):
    path = tmp_path / "odd.urdf"
    path.write_bytes(content)
    with refused(vp.RobotError, "odd", facts):
        vp.load_robot(path)


# In a file whose joint j1 moves a and j2, which follows it, b: what is changed, and what the message names.
AXIS = 'xyz="0 1 0"'
FOLLOWER = joint("j2", "a", "b", inside=mimic("j1"))
PARTS = [
    (AXIS, 'xyz="0 0 0"', ("'j1'", "axis")),
    (AXIS, 'xyz="nan 0 0"', ("axis", "[j1]")),
    (AXIS, 'xyz="up"', ("axis", "[j1]")),
    # What is not normalised moves other inertia in Pinocchio than in varpin, whose rotations were NaN.
    (AXIS, 'xyz="1e-200 0 0"', ("'j1'", "axis")),
    (AXIS, 'xyz="0 1e-320 0"', ("'j1'", "axis")),
    ("revolute", "hinge", ("[j1]", "[hinge]")),
    ("revolute", "", "[j1]"),
    ('rpy="0.1 0.2 0.3"/><parent', 'rpy="0 nan 0"/><parent', ("origin", "[j1]")),
    ('xyz="0.1 0.02 0.2"', 'xyz="0,1 0.02 0.2"', ("[j1]", "[0,1]", "point")),
    ('<child link="a"/>', '<child link="l9"/>', ("child", "[l9]", "[j1]")),
    ('<parent link="base"/>', '<parent link="l9"/>', ("parent", "[l9]", "[j1]")),
    ('<parent link="base"/>', '<parent link="b"/>', ("'a'", "'b'", "loop")),
    ("</robot>", '<link name="c"/></robot>', ("[base]", "[c]")),
    ("</robot>", '<link name="a"/></robot>', "'a'"),
    ('name="j2"', 'name="j1"', "'j1'"),
    # Pinocchio loads it, with a joint that moves nothing.
    ("</robot>", joint("j3", "base", "b") + "</robot>", ("'b'", "'j2'", "'j3'", "closed loops")),
    # Pinocchio drops them without a word.
    ("</robot>", joint("j3", "c", "d") + joint("j4", "d", "c") + link("c") + link("d") + "</robot>", ("'c'", "loop")),
    ('multiplier="1"', 'multiplier="nan"', ("[j2]", "multiplier", "(nan)")),
    ('multiplier="1"', 'multiplier="twice"', ("[j2]", "multiplier", "(twice)")),
    ('multiplier="1"', 'multiplier="-1e200"', "finite"),
    ('offset="0"', 'offset="inf"', ("[j2]", "offset", "(inf)")),
    (mimic("j1"), "<mimic/>", ("[j2]", "mimic")),
    ('mimic joint="j1"', 'mimic joint="j2"', ("'j2'", "itself")),
    ("</joint>", mimic("j2") + "</joint>", ("'j1'", "itself")),
    ('ixx="0.02" iyy="0.03"', 'ixx="1e308" iyy="1e308"', "finite"),
]


@pytest.mark.parametrize(("old", "new", "facts"), PARTS)
def test_parts_of_a_urdf(tmp_path, old, new, facts):
    path = write_urdf(tmp_path, link("a"), link("b"), joint("j1", "base", "a"), FOLLOWER)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 2 if "ixx" in old else 1))
    with refused(vp.RobotError, facts) as info:
        vp.load_robot(path)
    assert not re.search(r"\.cpp|\n", str(info.value))
    with pytest.raises(vp.RobotError):
        vp.inspect_robot(path)


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        (lambda m: setattr(m.inertias[1], "mass", np.nan), "finite"),
        (lambda m: setattr(m.inertias[1], "lever", np.full(3, np.inf)), "finite"),
        (lambda m: m.jointPlacements.__setitem__(1, pin.SE3(2 * np.eye(3), np.zeros(3))), ("placement", "'joint1'")),
        (lambda m: m.jointPlacements.__setitem__(1, pin.SE3(np.eye(3), np.full(3, np.nan))), "placement"),
        *((lambda m, x=x: setattr(m, "armature", np.full(3, x)), ("armature", "0")) for x in (-1.0, np.nan, np.inf)),
        (lambda m: setattr(m, "armature", np.zeros(1)), ("armature", "1", "3")),
        (lambda m: setattr(m, "lowerPositionLimit", np.zeros(1)), ("lowerPositionLimit", "1", "3")),
        (lambda m: m.parents.__setitem__(3, 9), ("'chain3'", "damaged")),
        (lambda m: m.names.__setitem__(2, "joint1"), "'joint1'"),
    ],
)
def test_parts_of_a_model(change, facts):
    model = vp.planar_chain(3).model.copy()
    change(model)
    with refused(vp.RobotError, facts):
        vp.load_robot(model)


@pytest.mark.parametrize("inertial", ["", re.sub(r'(value|i..)="[^"]*"', r'\1="0"', INERTIAL)])
def test_massless_at_the_tip(tmp_path, inertial):
    path = write_urdf(tmp_path, link("a"), link("b", inertial), joint("j1", "base", "a"), joint("j2", "a", "b"))
    with refused(vp.SingularMassMatrix, "'j2'", "armature", "lock") as info:
        vp.load_robot(path)
    assert info.value.joints == ("j2",)
    assert vp.load_robot(path, lock={"j2": 0}).joint_names == ("j1",)


def test_two_joints_that_only_move_the_same_point():
    """A ball on two parallel axes through it: only the sum of the angles moves anything."""
    ball = pin.Inertia.FromSphere(1.0, 0.1)
    with refused(vp.SingularMassMatrix, "'joint0', 'joint1'"):
        built(*((pin.JointModelRZ(), [0, 0, 0], body) for body in (None, ball)))


def test_nothing_moves(tmp_path):
    path = arm(tmp_path)
    fixed = write_urdf(tmp_path, link("l1"), joint("j1", "base", "l1", "fixed"), name="fixed")
    for source, options, name in (
        (fixed, {}, "fixed"),
        (path, {"lock": {"j1": 0.0}}, "made_up"),
        (pin.Model(), {}, "model"),
    ):
        with refused(vp.RobotError, f"'{name}'", "joint"):
            vp.load_robot(source, **options)


@pytest.mark.parametrize("content", ["", "from nose import tools\n"])
def test_another_package_of_pinocchio_s_name(tmp_path, content):
    (tmp_path / "nose").mkdir()
    (tmp_path / "nose" / "tools.py").touch()
    (tmp_path / "pinocchio.py").write_text(content)
    paths = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    run = [sys.executable, "-S", "-c", "import varpin"]
    found = subprocess.run(run, env={"PYTHONPATH": paths}, capture_output=True, text=True, check=False)
    assert found.returncode == 1
    assert "pip uninstall -y pinocchio" in found.stderr.splitlines()[-1]


# --- xacro files and robot_descriptions load as the URDF that they stand for -----------------------------------------


HEAD = '<?xml version="1.0"?>\n<robot name="made_up" xmlns:xacro="http://www.ros.org/wiki/xacro">\n'
PART = '<visual><geometry><mesh filename="package://parts/ball.obj"/></geometry></visual>'
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"

# A macro in a package beside it, one found by a relative path, an argument, a property and a condition.
ARM = f"""{HEAD}<xacro:arg name="prefix" default=""/>
<xacro:arg name="tool" default="false"/>
<xacro:property name="mass" value="${{0.65 * 2}}"/>
<xacro:include filename="$(find parts)/macros.xacro"/>
<xacro:include filename="base.xacro"/>
<xacro:segment name="$(arg prefix)1" parent="base" mass="${{mass}}"/>
<xacro:if value="$(arg tool)"><xacro:segment name="$(arg prefix)2" parent="l$(arg prefix)1" mass="0.5"/></xacro:if>
</robot>
"""
SEGMENT = link("l${name}", INERTIAL.replace('"1.3"', '"${mass}"'), PART) + joint("j${name}", "${parent}", "l${name}")
MACROS = f'{HEAD}<xacro:macro name="segment" params="name parent mass">{SEGMENT}</xacro:macro></robot>'


@pytest.fixture
def workspace(tmp_path):
    """A folder of two ROS packages; returns the file of the robot."""
    pytest.importorskip("xacro")
    for name in ("my_arm", "parts"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "package.xml").write_text(f"<package><name>{name}</name></package>")
    (tmp_path / "parts" / "macros.xacro").write_text(MACROS)
    (tmp_path / "parts" / "ball.obj").write_text(TRIANGLE)
    (tmp_path / "my_arm" / "base.xacro").write_text(HEAD + '<link name="base"/></robot>')
    path = tmp_path / "my_arm" / "arm.urdf.xacro"
    path.write_text(ARM)
    return path


@pytest.fixture
def described(monkeypatch, tmp_path):
    """Makes a stand-in for robot_descriptions, which clones git repositories on import, with one robot cloned."""

    def make(kind="arm", **files):
        robots = {name: SimpleNamespace(tags={kind}) for name in ("one_description", "lost_description")}
        package = SimpleNamespace(DESCRIPTIONS=robots, __path__=[str(tmp_path)], __spec__=None)
        paths = {name: str(path) if name.endswith("PATH") else path for name, path in files.items()}
        monkeypatch.setitem(sys.modules, "robot_descriptions", package)
        monkeypatch.setitem(sys.modules, "robot_descriptions.one_description", SimpleNamespace(**paths))

    return make


def assert_is(robot, urdf):
    """Gravity's torque and the inertia of the robot's one joint are those of a URDF."""
    expected, q = pin.buildModelFromUrdf(str(urdf)), np.array([0.7])
    jet = vp.lagrangian_jet(vp.Scene(robot), q, q)
    gravity = pin.computeGeneralizedGravity(expected, expected.createData(), q)
    np.testing.assert_allclose(-jet.Lq, gravity, rtol=1e-12)
    np.testing.assert_allclose(jet.Lvv, pin.crba(expected, expected.createData(), q), rtol=1e-12)
    # Its mesh is in a package.
    assert geometry(robot).ngeoms == 1


def test_robot_is_that_of_the_urdf_written_by_hand(workspace, tmp_path, monkeypatch):
    monkeypatch.chdir("/")
    robot = vp.load_robot(workspace)
    assert (robot.name, robot.urdf, robot.joint_names) == ("arm", workspace, ("j1",))
    assert_is(robot, arm(tmp_path))


def test_arguments(workspace):
    robot = vp.load_robot(workspace, xacro_args={"prefix": "left_", "tool": True})
    assert robot.joint_names == ("jleft_1", "jleft_2")
    assert robot.model.inertias[2].mass == 0.5
    with refused(vp.InputError, "arm.urdf.xacro", "'prefx'", "prefix, tool"):
        vp.load_robot(workspace, xacro_args={"prefx": "left_"})


def test_a_file_of_macros_is_told_from_a_robot(workspace, tmp_path):
    with refused(vp.RobotError, "macros.xacro", "no links", "the one that calls them"):
        vp.load_robot(tmp_path / "parts" / "macros.xacro")


def test_packages_elsewhere(workspace, tmp_path, described):
    elsewhere = tmp_path / "not" / "near" / "it"
    elsewhere.mkdir(parents=True)
    (tmp_path / "parts").rename(elsewhere / "parts")
    with refused(vp.RobotError, "'parts'") as caught:
        vp.load_robot(workspace)
    assert str(caught.value).count("no package") == 1
    assert vp.load_robot(workspace, package_dirs=[elsewhere]).dof == 1
    packages = {"parts": str(elsewhere / "parts")}
    described(XACRO_PATH=workspace, XACRO_ARGS={"prefix": "a_", "tool": "true"}, XACRO_PACKAGE_PATHS=packages)
    assert vp.load_robot("one_description").joint_names == ("ja_1", "ja_2")
    assert vp.load_robot("one_description", xacro_args={"prefix": "b_"}).joint_names == ("jb_1", "jb_2")


@pytest.mark.parametrize(
    ("old", "new", "facts"),
    [
        ("${0.65 * 2}", "${lost * 2}", ("arm.urdf.xacro", "'lost'", "'lost * 2'")),
        ("</robot>", "", "XML"),
        ('parent="base"', 'perent="base"', "perent"),
        ('name="made_up"', 'name="$(arg tooth)"', ("arm.urdf.xacro", "'tooth'", "xacro_args={'tooth'")),
        ('name="made_up"', "name=\"${xacro.arg('tooth')}\"", ("arm.urdf.xacro", "'tooth'", "xacro_args={'tooth'")),
    ],
)
def test_bad_files_give_one_error(workspace, old, new, facts):
    workspace.write_text(workspace.read_text().replace(old, new))
    with refused(vp.RobotError, facts) as caught:
        vp.load_robot(workspace)
    # Each thing is said once, and none in the names of Python's classes.
    assert not re.search(r"<class|Error:|Exception", str(caught.value))
    assert str(caught.value).count("No such file") <= 1


def test_arguments_of_what_is_no_xacro_file(tmp_path):
    for source in (arm(tmp_path), "ur5"):
        with refused(vp.InputError, "xacro"):
            vp.load_robot(source, xacro_args={"prefix": "left_"})
    with refused(vp.InputError, "xacro_args"):
        vp.load_robot("ur5", xacro_args=["prefix"])


def test_a_robot_of_robot_descriptions(tmp_path, described):
    """With the posture of its SRDF, and a mesh in a package of its repository."""
    pytest.importorskip("xacro")
    folder = tmp_path / "cache" / "repository" / "parts"
    folder.mkdir(parents=True)
    (folder / "ball.obj").write_text(TRIANGLE)
    urdf, srdf = arm(tmp_path), tmp_path / "any.srdf.xacro"
    urdf.write_text(urdf.read_text().replace("</link>", f"{PART}</link>"))
    srdf.write_text(f'{HEAD}<group_state name="home"><joint name="j1" value="${{0.25 * 2}}"/></group_state></robot>')
    described(URDF_PATH=urdf, SRDF_PATH=srdf, REPOSITORY_PATH=folder.parent)
    robot = vp.load_robot("one_description")
    assert (robot.name, robot.urdf, robot.posture("home")) == ("one_description", urdf, [0.5])
    assert_is(robot, urdf)
    described("biped", URDF_PATH=urdf)
    with refused(vp.RobotError, "'one_description'", "made_up.urdf"):
        vp.load_robot("one_description")


def test_a_download_that_fails(tmp_path, described):
    (tmp_path / "lost_description.py").write_text("raise RuntimeError('Could not\\n resolve host: github.com')\n")
    described()
    for _ in range(2):
        with refused(vp.RobotError, "'lost_description'", "Could not resolve host: github.com"):
            vp.load_robot("lost_description")


def test_without_the_packages(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "xacro", None)
    (tmp_path / "arm.urdf.xacro").write_text(ARM)
    with refused(vp.MissingDependency, "arm.urdf.xacro", "xacro", "varpin[xacro]"):
        vp.load_robot(tmp_path / "arm.urdf.xacro")
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    with refused(vp.MissingDependency, "'iiwa14_description'", "robot_descriptions", "varpin[descriptions]"):
        vp.load_robot("iiwa14_description")
    with refused(vp.RobotNotFound, "ur5"):
        vp.load_robot("ur55")
    # Names of the package without their ending are unknown, and the message has the pip command.
    with refused(vp.RobotNotFound, "'iiwa14'", "iiwa14_description", "varpin[descriptions]"):
        vp.load_robot("iiwa14")
    with refused(vp.RobotNotFound, "arm.urdf") as info:
        vp.load_robot("arm.urdf")
    assert "descriptions" not in str(info.value)


# --- postures of SRDF files are the configurations that Pinocchio reads from them ------------------------------------


# Robots of example-robot-data and the postures in their SRDF files, under srdf/ of each.
POSTURES = {name: (name, ("default",)) for name in ("alex_nub_hands", "alex_psyonic_hands", "alex_sake_hands")}
POSTURES |= {"panda": ("panda", ("default",)), "panda_collision": ("panda", ("default",))}
POSTURES |= {"finger_edu": ("finger_edu", ("hanging",)), "kinova": ("kinova", ("arm_up",))}
POSTURES |= {"talos_arm": ("talos", ("half_sitting",)), "xarm7": ("xarm7", ("home", "hold-up"))}
POSTURES |= {"z1": ("z1", ("home", "arm_up"))}


def of_joint(model, q, name):
    own = model.joints[model.getJointId(name)]
    return q[own.idx_q : own.idx_q + own.nq]


@pytest.mark.parametrize("name", POSTURES)
def test_published_postures_are_pinocchio_s(load, name):
    robot, (file, names) = load(name), POSTURES[name]
    assert robot.postures == names
    model = pin.buildModelFromUrdf(str(robot.urdf))
    pin.loadReferenceConfigurations(model, str(robot.urdf.parent.parent / "srdf" / f"{file}.srdf"))
    for posture in names:
        q, expected = robot.configuration(robot.posture(posture)), model.referenceConfigurations[posture]
        for each in robot.joint_names:
            np.testing.assert_allclose(of_joint(robot.model, q, each), of_joint(model, expected, each), atol=1e-12)


SRDF = """<robot name="made_up">
<group_state name="home" group="arm"><joint name="j1" value="0.5"/><joint name="j2" value="9"/></group_state>
<group_state name="home" group="hand"><joint name="j3" value="-0.25"/>
<joint name="root" value="0 0 0 0 0 0 1"/></group_state>
<group_state name="there" group="arm"><joint name="j3" value="0.6 0.8"/></group_state>
<group_state name="there" group="hand"><joint name="j3" value="0.1"/></group_state>
<group_state name="none" group="other"><joint name="k1" value="1"/></group_state></robot>"""


@pytest.fixture
def urdf(tmp_path):
    parts = [link(f"l{k}") for k in (1, 2, 3, 4)]
    joints = [joint("j1", "base", "l1"), joint("j2", "l1", "l2", inside=mimic("j1", 2, 0.1))]
    joints += [joint("j3", "l2", "l3", "continuous"), joint("j4", "l3", "l4", "prismatic")]
    return write_urdf(tmp_path, *parts, *joints)


def test_coordinates_of_a_posture(urdf):
    (urdf.parent / "made_up.srdf").write_text(SRDF)
    robot = vp.load_robot(urdf)
    assert robot.joint_names == ("j1", "j3", "j4")
    assert robot.postures == ("home", "there")
    np.testing.assert_array_equal(robot.posture("home"), [0.5, -0.25, 0.0])
    np.testing.assert_array_equal(robot.posture("home", others={"j4": 0.3, "j1": 7.0}), [0.5, -0.25, 0.3])
    np.testing.assert_array_equal(robot.posture("hand/home", others=[1.0, 2.0, 3.0]), [1.0, -0.25, 3.0])
    assert robot.posture("arm/there")[1] == pytest.approx(np.arctan2(0.8, 0.6))
    assert vp.load_robot(urdf, lock={"j3": 1.0}).posture("home").tolist() == [0.5, 0.0]
    assert pickle.loads(pickle.dumps(robot)).posture("home").tolist() == [0.5, -0.25, 0.0]


def test_names_and_files_that_are_not_there(urdf):
    (urdf.parent / "made_up.srdf").write_text(SRDF)
    robot = vp.load_robot(urdf)
    with refused(vp.UnknownPosture, "'hme'", "'home'", "'there'") as caught:
        robot.posture("hme")
    assert caught.value.known == ("home", "there")
    with refused(vp.InputError, "'j3'", "'arm/there'", "'hand/there'"):
        robot.posture("there")
    with refused(vp.UnknownPosture, "'leg/home'"):
        robot.posture("leg/home")
    with refused(vp.UnknownJoint, "'j9'"):
        robot.posture("home", others={"j9": 1.0})
    with refused(vp.UnknownPosture, "srdf=path"):
        vp.load_robot("ur5").posture("home")
    with refused(vp.FileError, "lost.srdf"):
        vp.load_robot(urdf, srdf="lost.srdf")
    with refused(vp.InputError, "srdf", "3"):
        vp.load_robot(urdf, srdf=3)


@pytest.mark.parametrize(
    ("place", "name", "found"),
    [
        ("{}/made_up.srdf", "another", True),
        ("srdf/made_up.srdf", "another", True),
        ("srdf/any.srdf", "made_up", True),
        ("srdf/any.srdf", "another", False),
        ("srdf/one.srdf srdf/two.srdf", "made_up", False),
        ("deep/srdf/made_up.srdf", "made_up", False),
    ],
)
def test_where_the_file_is_looked_for(urdf, tmp_path, place, name, found):
    folder = tmp_path / "urdf"
    folder.mkdir()
    urdf = urdf.rename(folder / urdf.name)
    for each in place.format("urdf").split():
        file = tmp_path / each
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(SRDF.replace("made_up", name))
    assert bool(vp.load_robot(urdf).postures) == found
    assert vp.load_robot(urdf, srdf=str(file)).postures == ("home", "there")


BAD = {
    "no number": (SRDF.replace('"0.5"', '"half"'), ("'home'", "'j1'", "'half'")),
    "no value": (SRDF.replace('value="0.5"', ""), ("'j1'", "''")),
    "infinite": (SRDF.replace('"0.5"', '"inf"'), ("'j1'", "'inf'")),
    "broken": (SRDF[:-5], ("made_up.srdf", "XML")),
    "empty": ("", ("made_up.srdf", "empty")),
    "another format": (SRDF.replace("robot", "sdf"), ("made_up.srdf", "<sdf>")),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_files(urdf, caplog, kind):
    text, facts = BAD[kind]
    path = urdf.parent / "made_up.srdf"
    path.write_text(text)
    with refused(vp.RobotError, facts):
        vp.load_robot(urdf, srdf=path)
    # One that nobody asks for is told of.
    assert vp.load_robot(urdf).postures == ()
    assert not unnamed(caplog.text, facts)


def test_reference_configurations_of_a_model(urdf):
    model = pin.buildModelFromUrdf(str(urdf))
    q = pin.randomConfiguration(model, -np.ones(model.nq), np.ones(model.nq))
    model.referenceConfigurations["here"] = q
    robot = vp.load_robot(model)
    np.testing.assert_allclose(robot.configuration(robot.posture("here")), q, atol=1e-15)
