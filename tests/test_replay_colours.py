"""What a replay's shapes look like: colours of mesh files, textures, and a node of its own for each."""

import logging

import numpy as np
import pytest
from chromium import commands, wait_until
from mechanisms import joint, link, write_urdf
from PIL import Image
from refusals import naming

import varpin as vp
from varpin.model import geometry
from varpin.show.replay.picture import Picture, labels

CORNERS = [f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)]
CUBE = "\n".join(
    [
        "mtllib cube.mtl",
        *CORNERS,
        *("vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"),
        *("usemtl red", "f 1/1 2/2 4/3 3/4", "f 5/1 7/2 8/3 6/4"),
        *("usemtl blue", "f 1 5 6 2", "f -6 -5 -1 -2"),
        *("usemtl squares", "f 1/1 3/2 7/3 5/4", "f 2/1 6/2 8/3 4/4"),
    ]
)
LIBRARY = (
    "newmtl red\nKa 1 1 1\nKd 0.9 0.1 0.1\nnewmtl blue\n  Kd 0.1 0.1 0.9\n  d 0.5\n"
    "newmtl squares\nKd 0 0 0\nmap_Kd -s 1 1 1 squares.png\n"
)
MESH = '<mesh filename="package://cube.obj"/>'
TEXTURE = '<material name="t"><texture filename="package://squares.png"/></material>'
BLACK = '<material name="b"><texture/><color rgba="0 0.0 0 1"/></material>'
ORANGE = '<material name="o"><color rgba="1 0.5 0 1"/></material>'
# Of the page: of each mesh its colour, whether it has a texture that was loaded, and its opacity.
LOOKS = """
const found = {};
viewer.scene_tree.find(["meshcat", "robot"]).object.traverse(node => {
    if (!node.isMesh) return;
    let part = node, path = [];
    for (; part.name != "shapes"; part = part.parent) if (part.name && part.name != "<object>") path.unshift(part.name);
    const m = node.material;
    found[path.join("/")] = ["#" + m.color.getHexString(), m.map ? m.map.image.width : 0, m.opacity, m.vertexColors];
});
return found;"""


def visual(shape, material="", where=0):
    return f'<visual><origin xyz="{where} 0 0"/><geometry>{shape}</geometry>{material}</visual>'


@pytest.fixture
def folder(tmp_path):
    squares = np.kron(np.indices((4, 4)).sum(axis=0) % 2, np.ones((4, 4)))[..., None] * np.array([0, 200, 0])
    Image.fromarray(squares.astype(np.uint8)).save(tmp_path / "squares.png")
    (tmp_path / "cube.obj").write_text(CUBE)
    (tmp_path / "cube.mtl").write_text(LIBRARY)
    return tmp_path


def robot_with(folder, *visuals):
    return vp.load_robot(write_urdf(folder, link("l1", extra="".join(visuals)), joint("j1", "base", "l1")))


def test_shapes_have_the_colours_of_their_files(show, browser, folder):
    colored = "\n".join(f"{line} {line[2]} {line[4]} {line[6]}" for line in CORNERS)
    (folder / "rainbow.obj").write_text(colored + "\nf 1 2 4 3\nf 5 7 8 6\n")
    robot = robot_with(
        folder,
        visual(MESH),
        visual(MESH, BLACK, 2),
        visual(MESH, ORANGE, 4),
        visual(MESH, TEXTURE, 6),
        visual('<box size="1 1 1"/>', TEXTURE, 8),
        visual('<mesh filename="package://rainbow.obj"/>', "", 10),
        visual('<box size="1 1 1"/>', BLACK, 12),
    )
    show(robot, np.zeros((1, 1)), dt=1.0)
    wait_until(lambda: sum(look[1] == 16 for look in browser.execute_script(LOOKS).values()) == 5)
    found = {name.replace("l1_", ""): look for name, look in browser.execute_script(LOOKS).items()}
    cube = [["#e61a1a", 0, 1, False], ["#1a1ae6", 0, 0.5, False], ["#ffffff", 16, 1, False]]
    assert [found[f"0 0/{k}"] for k in range(3)] == cube
    assert [found[f"1 1/{k}"] for k in range(3)] == cube
    assert [found[f"2 2/{k}"] for k in range(3)] == [["#ff8000", 0, 1, False]] * 3
    # Faces without texture coordinates have the colour of the file.
    assert [found[f"3 3/{k}"][:2] for k in range(3)] == [["#ffffff", 16], ["#1a1ae6", 0], ["#ffffff", 16]]
    assert found["4 4"][:2] == ["#ffffff", 16]
    assert found["5 5"] == ["#ffffff", 0, 1, True]
    assert found["6 6"][0] in ("#e5e5e5", "#e6e6e6")


def test_textures_that_are_not_there_are_named(folder, caplog):
    (folder / "squares.png").unlink()
    robot = robot_with(folder, visual(MESH), visual('<box size="1 1 1"/>', TEXTURE, 8))
    with caplog.at_level(logging.WARNING):
        assert [shape.meshTexturePath for shape in geometry(robot).geometryObjects] == ["", ""]
        vp.replay(robot, np.zeros((1, 1)), dt=1.0, html=folder / "a.html")
    assert naming(caplog.messages, "texture", "'package://squares.png'")
    assert naming(caplog.messages, "texture", "'-s 1 1 1 squares.png'")


def test_every_joint_has_a_node_of_its_own(tmp_path):
    names = ["a/b", "a_b", "shapes", "base", "notes", "a/b 2"]
    parts = [link(f"l{k}") + joint(name, "base", f"l{k}") for k, name in enumerate(names)]
    robot = vp.load_robot(write_urdf(tmp_path, *parts))
    nodes = Picture.of(robot).moving_nodes("robot")
    assert len(set(nodes)) == len(names)
    assert not {"robot/shapes/moving", "robot/base/moving", "robot/notes/moving"} & set(nodes)
    page = vp.replay(robot, np.random.default_rng(0).normal(size=(3, 6)), dt=1.0, html=tmp_path / "a.html")
    moved = [part["path"] for part in commands(page)[-1]["animations"]]
    assert len({str(path) for path in moved}) == len(moved) == 6
    assert labels(["x", "x", "x 2", ""]) == ["x", "x 2", "x 2 2", "_"]
