"""Xacro files load as the URDF that they stand for."""

from __future__ import annotations

import re
import sys

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import INERTIAL, arm, joint, link
from refusals import refused

import varpin as vp

HEAD = '<?xml version="1.0"?>\n<robot name="made_up" xmlns:xacro="http://www.ros.org/wiki/xacro">\n'
BALL = '<visual><geometry><sphere radius="0.1"/></geometry></visual>'

# A macro in a package beside it, one found by a relative path, an argument, a property and a condition.
ARM = (
    HEAD
    + """<xacro:arg name="prefix" default=""/>
<xacro:arg name="tool" default="false"/>
<xacro:property name="mass" value="${0.65 * 2}"/>
<xacro:include filename="$(find parts)/macros.xacro"/>
<xacro:include filename="base.xacro"/>
<xacro:segment name="$(arg prefix)1" parent="base" mass="${mass}"/>
<xacro:if value="$(arg tool)"><xacro:segment name="$(arg prefix)2" parent="l$(arg prefix)1" mass="0.5"/></xacro:if>
</robot>
"""
)
MACROS = (
    HEAD
    + '<xacro:macro name="segment" params="name parent mass">'
    + link("l${name}", INERTIAL.replace('"1.3"', '"${mass}"'), BALL)
    + joint("j${name}", "${parent}", "l${name}")
    + "</xacro:macro></robot>"
)


@pytest.fixture
def workspace(tmp_path):
    """A folder of two ROS packages; returns the file of the robot."""
    pytest.importorskip("xacro")
    for name in ("my_arm", "parts"):
        folder = tmp_path / name
        (folder / "urdf").mkdir(parents=True)
        (folder / "package.xml").write_text(f"<package><name>{name}</name></package>")
    (tmp_path / "parts" / "macros.xacro").write_text(MACROS)
    (tmp_path / "my_arm" / "urdf" / "base.xacro").write_text(HEAD + '<link name="base"/></robot>')
    path = tmp_path / "my_arm" / "urdf" / "arm.urdf.xacro"
    path.write_text(ARM)
    return path


def test_robot_is_that_of_the_urdf_written_by_hand(workspace, tmp_path, monkeypatch):
    monkeypatch.chdir("/")
    robot = vp.load_robot(workspace)
    assert (robot.name, robot.urdf, robot.joint_names) == ("arm", workspace, ("j1",))
    expected = pin.buildModelFromUrdf(str(arm(tmp_path)))
    q = np.array([0.7])
    np.testing.assert_allclose(
        vp.Scene(robot).holding_torque(q),
        pin.computeGeneralizedGravity(expected, expected.createData(), q),
        rtol=1e-12,
    )
    jet = vp.lagrangian_jet(vp.Scene(robot), q, q)
    np.testing.assert_allclose(jet.Lvv, pin.crba(expected, expected.createData(), q), rtol=1e-12)


def test_arguments(workspace):
    robot = vp.load_robot(workspace, xacro_args={"prefix": "left_", "tool": True})
    assert robot.joint_names == ("jleft_1", "jleft_2")
    assert robot.model.inertias[2].mass == 0.5
    with refused(vp.InputError, "arm.urdf.xacro", "'prefx'", "prefix, tool"):
        vp.load_robot(workspace, xacro_args={"prefx": "left_"})


def test_package_dirs(workspace, tmp_path):
    elsewhere = tmp_path / "not" / "near" / "it"
    elsewhere.mkdir(parents=True)
    (tmp_path / "parts").rename(elsewhere / "parts")
    with refused(vp.RobotError, "'parts'") as caught:
        vp.load_robot(workspace)
    assert str(caught.value).count("no package") == 1
    assert vp.load_robot(workspace, package_dirs=[elsewhere]).dof == 1


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        (
            lambda text: text.replace("${0.65 * 2}", "${lost * 2}"),
            ("arm.urdf.xacro", "'lost'", "'lost * 2'"),
        ),
        (lambda text: text.replace("</robot>", ""), "XML"),
        (lambda text: text.replace('parent="base"', 'perent="base"'), "perent"),
    ],
)
def test_bad_files_give_one_error(workspace, change, facts):
    workspace.write_text(change(workspace.read_text()))
    with refused(vp.RobotError, facts) as caught:
        vp.load_robot(workspace)
    # Each thing is said once, and none in the names of Python's classes.
    assert not re.search(r"<class|Error:|Exception", str(caught.value))
    assert str(caught.value).count("No such file") <= 1


def test_without_the_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "xacro", None)
    (tmp_path / "arm.urdf.xacro").write_text(ARM)
    with refused(vp.MissingDependency, "arm.urdf.xacro", "xacro", "varpin[xacro]"):
        vp.load_robot(tmp_path / "arm.urdf.xacro")


def test_arguments_of_what_is_no_xacro_file(tmp_path):
    for source in (arm(tmp_path), "ur5"):
        with refused(vp.InputError, "xacro"):
            vp.load_robot(source, xacro_args={"prefix": "left_"})
    with refused(vp.InputError, "xacro_args"):
        vp.load_robot("ur5", xacro_args=["prefix"])


@pytest.mark.parametrize("how", ['"$(arg tool)"', "\"${xacro.arg('tool')}\""])
def test_an_argument_without_a_default_is_named(tmp_path, how):
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(f'<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name={how}/>')
    with refused(vp.RobotError, "arm.urdf.xacro", "'tool'", "xacro_args={'tool'"):
        vp.load_robot(path)
