"""Meshes are found beside the file and in packages; those that are not there are named, link by link."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from mechanisms import INERTIAL, joint, link, write_urdf

import varpin as vp
from varpin.model import geometry, readable_geometry

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def mesh(name):
    return f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'


@pytest.fixture
def package(tmp_path):
    """A ROS package with a mesh."""
    folder = tmp_path / "workspace" / "my_arm"
    (folder / "meshes").mkdir(parents=True)
    (folder / "urdf").mkdir()
    (folder / "meshes" / "ball.obj").write_text(TRIANGLE)
    (folder / "package.xml").write_text("<package><name>my_arm</name></package>")
    return folder


def two_links(folder, first, second=""):
    parts = [link("l1", INERTIAL, first), link("l2", INERTIAL, second)]
    return write_urdf(folder, *parts, joint("j1", "base", "l1"), joint("j2", "l1", "l2"))


@pytest.mark.parametrize(
    "name",
    ["package://my_arm/meshes/ball.obj", "model://my_arm/meshes/ball.obj", "../meshes/ball.obj", "{}", "file://{}"],
)
def test_found_from_any_folder(package, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    file = package / "meshes" / "ball.obj"
    robot = vp.load_robot(two_links(package / "urdf", mesh(name.format(file))))
    (shape,) = geometry(robot).geometryObjects
    assert shape.parentJoint == 1
    assert Path(shape.meshPath).is_absolute()
    assert Path(shape.meshPath).samefile(file)


@pytest.mark.parametrize("variable", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH", ""])
def test_packages_elsewhere(package, tmp_path, monkeypatch, variable):
    path = two_links(tmp_path, mesh("package://my_arm/meshes/ball.obj"))
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    with pytest.raises(vp.RobotError, match="are missing"):
        geometry(vp.load_robot(path))
    (tmp_path / "share").symlink_to(package.parent)
    if variable:
        monkeypatch.setenv(variable, str(package.parent if variable.startswith("ROS") else tmp_path))
    folders = [] if variable else [package.parent]
    assert geometry(vp.load_robot(path, package_dirs=folders)).ngeoms == 1


def test_home_in_package_dirs(package, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    robot = vp.load_robot(two_links(tmp_path, mesh("package://my_arm/meshes/ball.obj")), package_dirs="~/workspace")
    assert geometry(robot).ngeoms == 1


def test_every_link_is_named_and_where_was_looked(package, tmp_path, caplog):
    path = two_links(
        package / "urdf",
        mesh("package://lost/a.stl") + mesh("package://my_arm/meshes/ball.obj"),
        mesh("b.stl") + mesh("http://c"),
    )
    robot = vp.load_robot(path, package_dirs=[tmp_path])
    words = (
        f"meshes of {path} are missing: link 'l1': package://lost/a.stl; link 'l2': b.stl, http://c; "
        f"package:// was looked up in {tmp_path}, {package.parent}, {path.parent}, other paths beside the "
        "file; package_dirs="
    )
    with pytest.raises(vp.RobotError, match="^" + re.escape(words)):
        geometry(robot)
    shapes, missing = readable_geometry(robot)
    assert shapes.ngeoms == 0
    assert {name: at for name, (at, _) in missing.items()} == {"l1": 1, "l2": 2}
    assert {text.startswith(words) for _, text in missing.values()} == {True}


def test_a_mesh_that_is_none_beside_one_that_is_not_there(package):
    (package / "meshes" / "bad.stl").write_text("no mesh")
    robot = vp.load_robot(two_links(package / "urdf", mesh("../meshes/bad.stl"), mesh("lost.stl")))
    _, missing = readable_geometry(robot)
    assert "bad.stl" in missing["l1"][1]
    assert "link 'l2': lost.stl" in missing["l2"][1]
