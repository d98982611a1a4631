"""Every robot that cannot be is an error of its own kind that names where it fails and what is allowed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import INERTIAL, arm, joint, link, mimic, write_urdf
from refusals import refused

import varpin as vp


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
        ("talos", vp.RobotError, ("'talos'", "URDF")),
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
    ('multiplier="1"', 'multiplier="nan"', ("'j2'", "multiplier", "'nan'")),
    ('multiplier="1"', 'multiplier="twice"', ("'j2'", "multiplier", "'twice'")),
    ('multiplier="1"', 'multiplier="-1e200"', "finite"),
    ('offset="0"', 'offset="inf"', ("'j2'", "offset", "'inf'")),
    (mimic("j1"), "<mimic/>", ("'j2'", "mimic")),
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
    model = pin.Model()
    for k in range(2):
        model.addJoint(k, pin.JointModelRZ(), pin.SE3.Identity(), f"j{k + 1}")
    model.appendBodyToJoint(2, pin.Inertia.FromSphere(1.0, 0.1), pin.SE3.Identity())
    with refused(vp.SingularMassMatrix, "'j1', 'j2'"):
        vp.load_robot(model)


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


def test_joints_that_are_not_there():
    with refused(vp.UnknownJoint, "'ur5'", "'elbow_joit'", "'elbow_joint'") as info:
        vp.load_robot("ur5", lock={"elbow_joit": 0.0})
    assert info.value.matches[0] == "elbow_joint"
    with refused(vp.UnknownJoint, "'3'", "shoulder_pan_joint"):
        vp.load_robot("ur5", lock={3: 0.0})
    with refused(vp.InputError, "'panda_finger_joint2'", "'panda_finger_joint1'"):
        vp.load_robot("panda", lock={"panda_finger_joint2": 0.0})
    for value in ("jont2", ["joint1", "jont2"]):
        with refused(vp.UnknownJoint, "'chain2'", "'jont2'", "'joint2'"):
            vp.Scene(vp.planar_chain(2), actuation=value)


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
