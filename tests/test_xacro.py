"""Robots of xacro files and of robot_descriptions load as the URDF that they stand for."""

from __future__ import annotations

import re
import sys
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import INERTIAL, arm, joint, link
from refusals import refused

import varpin as vp
from varpin.model import geometry

HEAD = '<?xml version="1.0"?>\n<robot name="made_up" xmlns:xacro="http://www.ros.org/wiki/xacro">\n'
BALL = '<visual><geometry><mesh filename="package://parts/ball.obj"/></geometry></visual>'
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
SEGMENT = link("l${name}", INERTIAL.replace('"1.3"', '"${mass}"'), BALL) + joint("j${name}", "${parent}", "l${name}")
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
    urdf.write_text(urdf.read_text().replace("</link>", f"{BALL}</link>"))
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
