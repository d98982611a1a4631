"""Meshes are found beside the file and in packages, and mean in every use what their files say."""

import struct
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from chromium import commands
from mechanisms import INERTIAL, joint, link, write_urdf
from refusals import naming, refused

import varpin as vp
from varpin.model import geometry, readable_geometry
from varpin.model.meshes import read_mesh

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def mesh(name, scale="1 1 1"):
    return f'<visual><geometry><mesh filename="{name}" scale="{scale}"/></geometry></visual>'


@pytest.fixture
def package(tmp_path):
    """A ROS package with a mesh, whose folder has another name."""
    folder = tmp_path / "workspace" / "Some-Repo"
    (folder / "meshes").mkdir(parents=True)
    (folder / "urdf").mkdir()
    (folder / "meshes" / "ball.obj").write_text(TRIANGLE)
    (folder / "package.xml").write_text("<package><name>my_arm</name></package>")
    return folder


def two_links(folder, first="", second="", inertial=INERTIAL):
    parts = [link("l1", INERTIAL, first), link("l2", inertial, second)]
    return write_urdf(folder, *parts, joint("j1", "base", "l1"), joint("j2", "l1", "l2"))


@pytest.mark.parametrize(
    "name",
    [
        *(f"{package}/meshes/ball.obj" for package in ("package://my_arm", "$(find my_arm)", "model://my_arm", "..")),
        "{}",
        "file://{}",
    ],
)
def test_found_from_any_folder(package, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    file = package / "meshes" / "ball.obj"
    robot = vp.load_robot(two_links(package / "urdf", mesh(name.format(file))))
    (shape,) = geometry(robot).geometryObjects
    assert shape.parentJoint == 1
    assert Path(shape.meshPath).is_absolute()
    assert Path(shape.meshPath).samefile(file)


def test_packages_elsewhere(package, tmp_path, monkeypatch):
    path, folder = two_links(tmp_path, mesh("package://my_arm/meshes/ball.obj")), package.parent
    (tmp_path / "share").symlink_to(folder)
    places = {"ROS_PACKAGE_PATH": folder, "AMENT_PREFIX_PATH": tmp_path}
    for variable in places:
        monkeypatch.delenv(variable, raising=False)
    with refused(vp.RobotError, "ball.obj"):
        geometry(vp.load_robot(path))
    for folders in ([folder], folder, str(folder)):
        assert geometry(vp.load_robot(path, package_dirs=folders)).ngeoms == 1
    for variable, place in places.items():
        with monkeypatch.context() as patch:
            patch.setenv(variable, str(place))
            assert geometry(vp.load_robot(path)).ngeoms == 1


@pytest.mark.parametrize("name", ["package://my_arm/Meshes/ball.obj", "../meshes/BALL.obj"])
def test_a_file_in_other_case_is_named(package, name):
    robot = vp.load_robot(two_links(package / "urdf", mesh(name)))
    with refused(vp.RobotError, name, "ball.obj is there", "'l1'"):
        geometry(robot)


def test_every_link_is_named_and_where_was_looked(package, tmp_path, caplog):
    first = mesh("package://lost/a.stl") + mesh("package://my_arm/meshes/ball.obj")
    path = two_links(package / "urdf", first, mesh("b.stl") + mesh("http://c"))
    robot = vp.load_robot(path, package_dirs=[tmp_path])
    looked = f"{tmp_path}, {package.parent}, {path.parent}"
    needed = (str(path), "'l1'", "package://lost/a.stl", "'l2'", "b.stl, http://c", looked, "package_dirs=")
    with refused(vp.RobotError, needed):
        geometry(robot)
    shapes, missing = readable_geometry(robot)
    assert shapes.ngeoms == 0
    assert {name: at for name, (at, _) in missing.items()} == {"l1": 1, "l2": 2}
    assert len(naming((text for _, text in missing.values()), needed)) == 2


# A box of 0.1 x 0.2 x 0.3 m with a corner at the origin.
SIDES = np.array([0.1, 0.2, 0.3])
CORNERS = np.array([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.2) for z in (0.0, 0.3)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
TRIANGLES = np.concatenate([QUADS[:, :3], QUADS[:, [0, 2, 3]]])


def words(numbers):
    return " ".join(f"{number:.9g}" for number in np.ravel(numbers))


INSTANCE = '<instance_geometry url="#g"/>'


def collada(corners=CORNERS, unit='<unit meter="1"/>', up="Z_UP", node=INSTANCE, primitives=None, extra=""):
    """A Collada file of corners, by default in the box's triangles."""
    vertex = '<input semantic="VERTEX" source="#v" offset="0"/>'
    faces = f'<triangles count="12">{vertex}<p>{words(TRIANGLES)}</p></triangles>'
    faces = faces if primitives is None else primitives.replace("VERTEX", vertex)
    axes = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    asset = f"<asset>{unit}<up_axis>{up}</up_axis></asset>" if unit else ""
    return (
        f'<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">{asset}{extra}'
        f'<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="{corners.size}">'
        f'{words(corners)}</float_array><technique_common><accessor source="#a" count="{len(corners)}" stride="3">'
        f'{axes}</accessor></technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/>'
        f"</vertices>{faces}</mesh></geometry></library_geometries><library_visual_scenes>"
        f'<visual_scene id="s"><node id="n">{node}</node></visual_scene></library_visual_scenes>'
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def wavefront(corners=CORNERS, faces=QUADS):
    lines = [f"v {words(corner)}" for corner in corners] + [f"f {words(face + 1)}" for face in faces]
    return "\n".join(lines) + "\n"


FACET = "facet normal 0 0 0\nouter loop\n{}endloop\nendfacet\n"


def ascii_stl(triangles=TRIANGLES, name="box"):
    facets = (FACET.format("".join(f"vertex {words(CORNERS[k])}\n" for k in face)) for face in triangles)
    return f"solid {name}\n{''.join(facets)}endsolid {name}\n"


def binary_stl(corners=CORNERS):
    facets = b"".join(struct.pack("<12fH", 0, 0, 0, *np.ravel(corners[face]), 0) for face in TRIANGLES)
    return b"solid of a CAD program".ljust(80) + struct.pack("<I", len(TRIANGLES)) + facets


HALF = "<triangles count='6' material='{}'>VERTEX<p>{}</p></triangles>"
HALVES = HALF.format("red", words(TRIANGLES[:6])) + HALF.format("blue", words(TRIANGLES[6:]))
LINES = f"<lines count='1'>VERTEX<p>0 1</p></lines>{HALVES}"
POLYLIST = f"<polylist count='6'>VERTEX<vcount>{words([4] * 6)}</vcount><p>{words(QUADS)}</p></polylist>"
POLYGONS = f"<polygons count='6'>VERTEX{''.join(f'<p>{words(quad)}</p>' for quad in QUADS)}</polygons>"
FANS = f"<trifans count='6'>VERTEX{''.join(f'<p>{words(quad)}</p>' for quad in QUADS)}</trifans>"
NESTED = (
    f'<translate>0.1 0 0.3</translate><node id="m"><rotate>0 1 0 180</rotate><scale>0.5 2 1</scale>{INSTANCE}</node>'
)
MIRRORED = f"<matrix>-1 0 0 0.1 0 1 0 0 0 0 1 0 0 0 0 1</matrix>{INSTANCE}"
TWICE = f'<scale>1 1 0.5</scale>{INSTANCE}<node id="m"><translate>0 0 0.3</translate>{INSTANCE}</node>'
NO_MATERIAL = (
    '<instance_geometry url="#g"><bind_material><technique_common><instance_material symbol="red" target="#gone"/>'
    "</technique_common></bind_material></instance_geometry>"
)
OFF = [*(words(corner) for corner in CORNERS), *(f"3 {words(face)}" for face in TRIANGLES)]
# Files of the same box; and below the scale in the URDF of those of another size.
FILES = {
    "centimetres.dae": collada(CORNERS / 0.01, '<unit meter="0.01" name="cm"/>'),
    "inches.dae": collada(CORNERS / 0.0254, '<unit name="inch" meter="2.54e-2"/>', "Y_UP"),
    "no_unit.dae": collada(unit=""),
    "unit_and_scale.dae": collada(CORNERS / 0.01, '<unit meter="0.001"/>'),
    "nested.dae": collada(CORNERS * [2.0, 0.5, 1.0], node=NESTED),
    "mirrored_node.dae": collada(node=MIRRORED),
    "twice.dae": collada(node=TWICE),
    "two_materials.dae": collada(primitives=HALVES),
    "lines.dae": collada(primitives=LINES),
    "polylist.dae": collada(primitives=POLYLIST),
    "polygons.DAE": collada(primitives=POLYGONS),
    "fans.dae": collada(primitives=FANS),
    "no_material.dae": collada(primitives=HALVES, node=NO_MATERIAL),
    "mixed.obj": wavefront(faces=[*QUADS[:3], *TRIANGLES[3:6], *TRIANGLES[9:]]),
    "materials.obj": "mtllib a.mtl\n"
    + wavefront(faces=QUADS[:2])
    + "usemtl red\n"
    + wavefront(faces=QUADS[2:4] + 8)
    + "usemtl blue\n"
    + wavefront(faces=QUADS[4:] + 16),
    "objects.obj": "o one\n" + wavefront(faces=QUADS[:3]) + "o two\n" + wavefront(faces=QUADS[3:] + 8),
    "mirrored.obj": wavefront(CORNERS * [1.0, -1.0, 1.0], QUADS[:, ::-1]),
    "through_a_point.obj": wavefront(-CORNERS, QUADS[:, ::-1]),
    "box.off": "\n".join(["OFF", "8 12 0", *OFF, ""]),
    "ascii.stl": ascii_stl(),
    "two_solids.stl": ascii_stl(TRIANGLES[:5]) + ascii_stl(TRIANGLES[5:], "rest"),
    "binary.STL": binary_stl(),
    "millimetres.stl": binary_stl(1000.0 * CORNERS),
}
SCALES = {"unit_and_scale.dae": "10 10 10", "mirrored.obj": "1 -1 1", "through_a_point.obj": "-1 -1 -1"}
SCALES |= {"millimetres.stl": "0.001 0.001 0.001"}


def drawn(page):
    """The triangles (F, 3, 3) of all shapes of the robot on a page."""
    found = []
    for command in commands(page):
        if command["type"] == "set_object" and "/shapes/" in command["path"]:
            (form,) = command["object"]["geometries"]
            points = np.frombuffer(form["data"]["attributes"]["position"]["array"].data, dtype=np.float32)
            found.append(points.reshape(-1, 3)[np.frombuffer(form["data"]["index"]["array"].data, dtype=np.uint32)])
    return np.concatenate(found).reshape(-1, 3, 3)


def volume(triangles):
    return np.linalg.det(triangles).sum() / 6.0


def arm(folder, name, scale="1 1 1"):
    """Its second link has a mesh and no inertia."""
    return two_links(folder, "", mesh(name, scale), "")


@pytest.mark.parametrize("name", FILES)
def test_a_box_is_a_box_in_every_file(tmp_path, caplog, name):
    content, scale = FILES[name], SCALES.get(name, "1 1 1")
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\nd 0.5\n")
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    path = arm(tmp_path, name, scale)
    robot = vp.load_robot(path, inertia="meshes")
    body = robot.model.inertias[2]
    assert body.mass == pytest.approx(6.0, rel=1e-6)
    np.testing.assert_allclose(body.lever, 0.5 * SIDES, atol=1e-7)
    moments = 6.0 / 12.0 * ((SIDES**2).sum() - SIDES**2)
    np.testing.assert_allclose(body.inertia, np.diag(moments), atol=1e-7)
    clear = vp.KeepClear(robot, [vp.Obstacle.sphere([9.0, 0.0, 0.0], 0.1)], 0.01)
    begin, end, radius = clear.capsules["l2"]
    assert radius == pytest.approx(np.hypot(0.05, 0.1), rel=1e-6)
    np.testing.assert_allclose(np.mean([begin, end], axis=0), 0.5 * SIDES, atol=1e-7)
    if scale == "1 1 1":
        obstacle = vp.Obstacle.mesh(tmp_path / name, 2.0, [1.0, 2.0, 3.0])
        np.testing.assert_allclose(obstacle.points.max(axis=0), 2.0 * SIDES, rtol=1e-6)
        np.testing.assert_allclose(obstacle.points.min(axis=0), np.zeros(3), atol=1e-7)
        assert obstacle.position.tolist() == [1.0, 2.0, 3.0]
    # A model that Pinocchio has read the meshes of, as coal does.
    model = pin.buildModelFromUrdf(str(path))
    model.appendBodyToJoint(2, pin.Inertia.Random(), pin.SE3.Identity())
    shapes = pin.buildGeomFromUrdf(model, str(path), pin.GeometryType.VISUAL, package_dirs=[str(tmp_path)])
    wrapped = vp.load_robot(pin.RobotWrapper(model, visual_model=shapes))
    marks = vp.Marks(torques=np.zeros((1, 2)), ghost=np.zeros((2, 2)))
    for shown in (robot, wrapped):
        triangles = drawn(vp.replay(shown, np.zeros((2, 2)), dt=1.0, html=tmp_path / "a.html", marks=marks))
        np.testing.assert_allclose(triangles.min(axis=(0, 1)), np.zeros(3), atol=1e-7)
        np.testing.assert_allclose(triangles.max(axis=(0, 1)), SIDES, rtol=1e-6)
        # The robot and its ghost.
        assert volume(triangles) == pytest.approx(2.0 * 0.006, rel=1e-5)
    assert bool(naming(caplog.messages, "no_material.dae", "colours")) == (name == "no_material.dae")


@pytest.mark.parametrize(("opaque", "opacity"), [("A_ONE", 0.25), ("RGB_ZERO", 0.95)])
def test_parts_have_the_looks_of_their_materials(tmp_path, opaque, opacity):
    clear = f'<transparent opaque="{opaque}"><color>0.2 0.2 0.2 1</color></transparent>'
    clear += "<transparency><float>0.25</float></transparency>"
    effects, materials, bound = "", "", ""
    for name, kind, color, more in (("red", "lambert", "1 0 0", ""), ("blue", "phong", "0 0 1", clear)):
        look = f"<{kind}><diffuse><color>{color} 1</color></diffuse>{more}</{kind}>"
        effects += f'<effect id="{name}e"><profile_COMMON><technique>{look}</technique></profile_COMMON></effect>'
        materials += f'<material id="{name}m"><instance_effect url="#{name}e"/></material>'
        bound += f'<instance_material symbol="{name}" target="#{name}m"/>'
    library = f"<library_effects>{effects}</library_effects><library_materials>{materials}</library_materials>"
    node = NO_MATERIAL.replace('<instance_material symbol="red" target="#gone"/>', bound)
    path = tmp_path / "a.dae"
    path.write_text(collada(primitives=HALVES, node=node, extra=library))
    red, blue = read_mesh(str(path))
    np.testing.assert_allclose(red.color, [1.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(blue.color, [0.0, 0.0, 1.0, opacity])
    assert red.shine["specular"] == (0.0, 0.0, 0.0)
    assert "specular" not in blue.shine


@pytest.mark.parametrize(
    ("name", "content", "facts"),
    [
        ("a.stl", b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n", ("Git LFS", "pull")),
        ("a.stl", b"no mesh", "no triangles"),
        ("a.step", b"ISO-10303-21;", ".stl"),
        ("a.dae", b"<COLLADA", "cannot be read"),
        ("a.dae", collada(unit='<unit meter="0"/>').encode(), "<unit>"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\n", "no triangles"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "finite"),
        ("a.obj", b"v 0 0 0\nf 1 2 3\n", "cannot be read"),
    ],
)
def test_what_is_no_mesh_is_named_with_its_cause(tmp_path, name, content, facts):
    (tmp_path / name).write_bytes(content)
    facts = (name, *([facts] if isinstance(facts, str) else facts))
    with refused(vp.FileError, facts):
        vp.Obstacle.mesh(tmp_path / name)
    with refused(vp.RobotError, ("'l2'", *facts)):
        geometry(vp.load_robot(arm(tmp_path, name), lock={"j2": 0.0}))


def test_meshes_without_a_volume_and_scales_that_are_none_are_named(tmp_path):
    path = arm(tmp_path, "a.obj")
    for faces in (QUADS[:, ::-1], QUADS[:5]):
        (tmp_path / "a.obj").write_text(wavefront(faces=faces))
        with refused(vp.RobotError, "'l2'", "a.obj", "no volume"):
            vp.load_robot(path, inertia="meshes")
    (tmp_path / "a.obj").unlink()
    with refused(vp.RobotError, "'l2'", "a.obj", "package_dirs"):
        vp.load_robot(path, inertia="meshes")
    (tmp_path / "a.obj").write_text(wavefront())
    for scale in ("1 1", "1 0 1", "one 1 1", "inf 1 1"):
        with refused(vp.RobotError, "'l2'", "a.obj", repr(scale)):
            vp.load_robot(arm(tmp_path, "a.obj", scale), inertia="meshes")


@pytest.mark.parametrize("scale", ["1 1 1", "1000 1000 1000", "39.4 39.4 39.4", "1e-3 1e-3 1e-3"])
def test_a_mesh_in_other_units_is_told(tmp_path, scale):
    (tmp_path / "a.stl").write_bytes(binary_stl())
    warnings = vp.inspect_robot(two_links(tmp_path, mesh("a.stl", scale))).warnings
    assert bool(naming(warnings, "mesh 'a.stl'", "'l1'", "scale=")) == (scale != "1 1 1")
    assert all(len(warning) <= 240 for warning in warnings)
