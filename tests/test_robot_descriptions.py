"""Robots by the names of robot_descriptions: of a stand-in, as the package downloads git repositories on import."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pinocchio as pin
import pytest
from mechanisms import arm
from refusals import refused

import varpin as vp
from varpin.model import geometry

PACKAGE = """
from types import SimpleNamespace
tags = {"one_description": "arm", "xacro_description": "arm", "walker_description": "biped", "lost_description": "arm"}
DESCRIPTIONS = {name: SimpleNamespace(tags={tag}) for name, tag in tags.items()}
"""
BALL = '<visual><geometry><mesh filename="package://one_robot/ball.obj"/></geometry></visual>'
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
XACRO = """<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:arg name="mass" default="9"/><xacro:arg name="tip" default="tip"/><link name="base"/>
<xacro:include filename="$(find other)/link.xacro"/>
<joint name="j_$(arg tip)" type="continuous"><parent link="base"/><child link="l"/><axis xyz="0 1 0"/></joint>
</robot>"""
LINK = """<robot><link name="l"><inertial><origin xyz="1 0 0"/><mass value="$(arg mass)"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A stand-in for the package, its robots downloaded already; returns the repository."""
    repository = tmp_path / "cache" / "repository"
    (repository / "one_robot").mkdir(parents=True)
    (repository / "odd_name").mkdir()
    (repository / "one_robot" / "ball.obj").write_text(TRIANGLE)
    urdf = arm(repository / "one_robot")
    urdf.write_text(urdf.read_text().replace("</link>", f"{BALL}</link>"))
    (repository / "x.urdf.xacro").write_text(XACRO)
    (repository / "odd_name" / "link.xacro").write_text(LINK)
    package = tmp_path / "site" / "robot_descriptions"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text(PACKAGE)
    paths = f"REPOSITORY_PATH = {str(repository)!r}\nPACKAGE_PATH = REPOSITORY_PATH + '/one_robot'\n"
    (package / "one_description.py").write_text(f"{paths}URDF_PATH = PACKAGE_PATH + '/made_up.urdf'\n")
    (package / "walker_description.py").write_text(f"{paths}URDF_PATH = PACKAGE_PATH + '/made_up.urdf'\n")
    (package / "xacro_description.py").write_text(
        f"{paths}XACRO_PATH = REPOSITORY_PATH + '/x.urdf.xacro'\nXACRO_ARGS = {{'mass': '2'}}\n"
        "XACRO_PACKAGE_PATHS = {'other': REPOSITORY_PATH + '/odd_name'}\n"
    )
    (package / "lost_description.py").write_text("raise RuntimeError('Could not\\n resolve host: github.com')\n")
    for name in [name for name in sys.modules if name.partition(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(package.parent)
    importlib.invalidate_caches()
    yield repository
    for name in [name for name in sys.modules if name.partition(".")[0] == "robot_descriptions"]:
        del sys.modules[name]


def test_urdf(cache):
    robot = vp.load_robot("one_description")
    path = cache / "one_robot" / "made_up.urdf"
    assert (robot.name, robot.urdf) == ("one_description", path)
    expected = pin.buildModelFromUrdf(str(path))
    q = np.array([0.4])
    np.testing.assert_allclose(
        vp.Scene(robot).holding_torque(q),
        pin.computeGeneralizedGravity(expected, expected.createData(), q),
        rtol=1e-12,
    )
    # Its mesh is in a package in the repository.
    assert geometry(robot).ngeoms == 1


def test_xacro_with_the_arguments_and_packages_of_the_package(cache):
    pytest.importorskip("xacro")
    robot = vp.load_robot("xacro_description")
    assert (robot.joint_names, robot.model.inertias[1].mass) == (("j_tip",), 2.0)
    robot = vp.load_robot("xacro_description", xacro_args={"tip": "end", "mass": 3})
    assert (robot.joint_names, robot.model.inertias[1].mass) == (("j_end",), 3.0)


def test_download_that_fails(cache):
    for _ in range(2):
        with refused(vp.RobotError, "'lost_description'", "Could not resolve host: github.com"):
            vp.load_robot("lost_description")


def test_robots_that_walk_are_refused(cache):
    with refused(vp.RobotError, "'walker_description'", "made_up.urdf"):
        vp.load_robot("walker_description")


def test_without_the_package(monkeypatch):
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
