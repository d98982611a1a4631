"""Replays in real, headless Chromium, cut off from the network."""

import contextlib
import importlib.util
import itertools
import logging
import re
import shutil
import time

import imageio.v3 as imageio
import numpy as np
import pytest
from chromium import (
    animation,
    commands,
    connect,
    names,
    picture,
    seek,
    severe,
    shape_poses,
    shapes_stand,
    visit,
    wait_until,
)
from mechanisms import joint, link, mimic, write_urdf
from PIL import Image, ImageSequence
from refusals import naming, refused, unnamed
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select

import varpin as vp
from varpin import replay
from varpin.cli import main
from varpin.model import geometry
from varpin.show.replay import live, page, video
from varpin.show.replay import page as page_module
from varpin.show.replay import shapes as shape_module
from varpin.show.replay.picture import Picture

FINGER = vp.load_robot("finger")


@pytest.fixture(scope="module")
def motion():
    scene = vp.Scene(FINGER, gravity=False, stiffness=[0.54, 0.28, 0.12], damping=[3.1e-3, 2.2e-3, 0.9e-3])
    return vp.simulate(scene, q0=[0.9, 1.2, 0.8], v0=[0.0, 0.0, 0.0], dt=1e-3, steps=500)


def test_page_plays_offline_and_shows_the_finger_large(show, browser, motion):
    assert ">loading<" in show(FINGER, motion).read_text()
    assert browser.execute_script("return viewer.animator.playing")
    assert browser.find_elements(By.ID, "loading") == []

    seek(browser, 0.0)
    first, again = picture(browser), picture(browser)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 500
    skin = (first[..., 0] > first[..., 2] + 30.0).mean()
    assert 0.04 < skin < 0.6
    seek(browser, 0.5)
    noise, changed = ((np.abs(other - first).max(axis=-1) > 40.0).mean() for other in (again, picture(browser)))
    assert noise < 1e-4
    assert changed > 0.01
    fetched = browser.execute_script("return performance.getEntriesByType('resource').map(entry => entry.name)")
    assert [url for url in fetched if not url.startswith(("data:", "blob:"))] == []


@pytest.mark.parametrize(
    "name", ["finger", "ur5", *(pytest.param(name, marks=pytest.mark.slow) for name in ("kinova", "panda"))]
)
def test_page_poses_every_shape_as_pinocchio_does(show, browser, name):
    """Those of the robot, and of its ghost, whose three rows stand at 0, 0.75 and 1.5 s."""
    robot = vp.load_robot(name)
    rng = np.random.default_rng(5)
    q = rng.uniform(-1.0, 1.0, (4, robot.dof)) * np.where(np.isinf(robot.position_limits[0]), 8.0, 1.0)
    ghost = rng.uniform(-1.0, 1.0, (3, robot.dof))
    show(robot, q, dt=0.5, marks=vp.Marks(ghost=ghost))
    for seconds, now, then in [
        (0.0, q[0], ghost[0]),
        (0.75, 0.5 * (q[1] + q[2]), ghost[1]),
        (1.125, 0.75 * q[2] + 0.25 * q[3], 0.5 * (ghost[1] + ghost[2])),
        (1.5, q[3], ghost[2]),
    ]:
        seek(browser, seconds)
        assert shapes_stand(browser, robot, now)
        assert shapes_stand(browser, robot, then, "ghost")
    looks = browser.execute_script(
        """
        const looks = [];
        viewer.scene_tree.find(["meshcat", "ghost"]).object.traverse(node => {
            if (node.isMesh && node.parent.parent.name == "shapes")
                looks.push([node.material.transparent, node.material.opacity]);
        });
        return looks;"""
    )
    assert looks
    assert all(transparent and 0.1 < opacity < 0.6 for transparent, opacity in looks)


@pytest.mark.parametrize(("dt", "steps", "speed"), [(1e-4, 3000, 1.0), (1e-4, 7, 1.0), (2e-2, 40, 0.1), (0.7, 3, 1.0)])
def test_duration_is_the_motions(show, browser, dt, steps, speed):
    q, duration = np.linspace([0.0, 0.0, 0.0], [1.0, 0.5, 0.2], steps + 1), steps * dt / speed
    path = show(FINGER, q, dt=dt, speed=speed)
    assert browser.execute_script("return viewer.animator.duration") == pytest.approx(duration, rel=1e-6)
    tracks, options = animation(path)
    assert options == {"play": True, "repetitions": float("inf")}
    for times, values in tracks.values():
        assert times[0] == 0.0
        assert times[-1] == pytest.approx(duration, rel=1e-6)
        assert len(times) == len(values) <= min(steps, max(1, np.ceil(30 * duration))) + 1
    assert [values[-1] for _, values in tracks.values()] == pytest.approx([1.0, 0.5, 0.2], rel=1e-6)


def bar(browser):
    """What the bar shows: the clock [s of motion], its end, whether it says that the motion plays."""
    return browser.execute_async_script(
        """
        requestAnimationFrame(() => requestAnimationFrame(() => arguments[0]([
            ...document.getElementById("clock").textContent.split(/ [/] | s/).slice(0, 2).map(Number),
            document.getElementById("play").title.startsWith("Pause")])));"""
    )


def test_the_bar_plays_pauses_and_goes_to_a_time(show, browser):
    show(FINGER, np.linspace([0.1, 0.2, 0.3], [0.9, 0.8, 0.7], 21), dt=0.1, speed=0.5)
    assert bar(browser)[1:] == [2.0, True]
    browser.find_element(By.ID, "play").click()
    paused = bar(browser)
    assert not paused[2]
    assert bar(browser) == paused
    # Half of the way, in 4 s of playback for 2 s of motion.
    browser.execute_script(
        "const slider = document.getElementById('time'); slider.value = 2; slider.dispatchEvent(new Event('input'));"
    )
    assert bar(browser) == [1.0, 2.0, False]
    assert shapes_stand(browser, FINGER, [0.5, 0.5, 0.5])
    browser.find_element(By.TAG_NAME, "body").send_keys(Keys.ARROW_RIGHT)
    assert bar(browser)[0] == pytest.approx(1.02)
    browser.find_element(By.TAG_NAME, "body").send_keys(Keys.SPACE)
    assert bar(browser)[2]
    choice = Select(browser.find_element(By.ID, "speed"))
    assert choice.first_selected_option.text == "0.5 x"
    choice.select_by_visible_text("2 x")
    # Of 2 s of motion, by the clock: 2 s of it in a second.
    moved, elapsed = browser.execute_async_script(
        """
        viewer.animator.seek(0); viewer.animator.play();
        const now = () => [2 * viewer.animator.actions[0].time / viewer.animator.duration, performance.now() / 1000];
        requestAnimationFrame(() => requestAnimationFrame(() => {
            const first = now();
            setTimeout(() => requestAnimationFrame(() => {
                const last = now();
                arguments[0]([last[0] - first[0], last[1] - first[1]]);
            }), 500);
        }));"""
    )
    assert moved == pytest.approx(2.0 * elapsed, abs=0.2)


def test_the_key_names_what_has_a_colour_of_its_own(tmp_path):
    q = np.linspace([0.1, 0.2, 0.3], [0.9, 0.8, 0.7], 5)
    page = replay(FINGER, q[:1], dt=0.1, html=tmp_path / "plain.html")
    plain = page.read_text()
    # A pose has no bar and does not move.
    assert 'id="bar"' not in plain
    assert all(command["type"] != "set_animation" for command in commands(page))
    assert re.findall("<li>.*</li>", plain) == []
    marked = replay(
        FINGER, q, dt=0.1, html=tmp_path / "key.html",
        marks=vp.Marks(trace=True, ghost=q[::-1], torques=np.zeros((4, 3)),
            reference={"way": [[0.0, 0.0, 0.1], [0.1, 0.0, 0.1]]}, targets={"cup <1>": [0.1, 0.0, 0.0]}),
    ).read_text()  # fmt: skip
    words = [re.sub("<.*?>", "", line) for line in re.findall("<li>.*</li>", marked)]
    frame = FINGER.end_effector
    paths = [f"path of {frame}", f"path of {frame}, ghost"]
    assert words == ["torque: none, half, all of the limit", "ghost", *paths, "reference: way", "target: cup &lt;1&gt;"]


def test_size_stays_sane_for_a_long_motion(tmp_path):
    t = np.arange(1_000_001) * 1e-3
    q = np.column_stack([np.sin(t), 1.0 + np.cos(0.7 * t), 0.5 + 0.5 * np.sin(1.3 * t)])
    path = replay(FINGER, q, dt=1e-3, html=tmp_path / "long.html")
    assert path.stat().st_size < 2_000_000
    assert "<li>drawn every 0.1 s, straight in between</li>" in path.read_text(encoding="utf-8")
    tracks, _ = animation(path)
    for (times, values), column in zip(tracks.values(), q.T, strict=True):
        assert len(times) == 10_000
        assert times[-1] == 1000.0
        np.testing.assert_allclose(np.interp(t, times, values), column, atol=3e-3)


def test_ghost_keeps_its_corners_between_sparse_nodes_of_the_motion(tmp_path):
    ghost = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    path = replay(
        FINGER, np.zeros((3, 3)), dt=1.0, marks=vp.Marks(ghost=ghost), speed=0.5, html=tmp_path / "ghost.html"
    )
    tracks, _ = animation(path)
    for (node, _), (times, values) in tracks.items():
        np.testing.assert_allclose(times, [0.0, 4.0 / 3.0, 2.0, 8.0 / 3.0, 4.0], rtol=1e-6)
        moves = "/ghost/" in node and "mcp" in node.rsplit("/", 2)[-2]
        np.testing.assert_allclose(values, [0.0, 1.0, 0.5, 0.0, 1.0] if moves else np.zeros(5), atol=1e-6)


def test_a_model_without_geometry_gets_a_skeleton(show, browser, caplog):
    with caplog.at_level(logging.WARNING, logger="varpin.show.replay"):
        show(vp.planar_chain(3), np.zeros((2, 3)), dt=1.0)
    assert naming(caplog.messages, "'chain3'", "skeleton")
    poses = shape_poses(browser)
    for place in (*np.arange(0.0, 3.0, 0.5), *np.arange(0.25, 3.0)):
        assert any(np.allclose(pose[:3, 3], [place, 0.0, 0.0], atol=1e-6) for pose in poses.values())


def test_a_missing_mesh_costs_its_link_alone(tmp_path, caplog):
    shapes = {
        "box": '<box size="1 1 1"/>',
        "rod": '<mesh filename="no_such_mesh.stl"/>',
        "ball": '<sphere radius="0.2"/>',
    }
    parts = [link(k, extra=f"<visual><geometry>{shape}</geometry></visual>") for k, shape in shapes.items()]
    pairs = [("first", "base", "box"), ("second", "box", "rod"), ("third", "rod", "ball")]
    urdf = write_urdf(tmp_path, *parts, *(joint(*names) for names in pairs))
    for lock in ({}, {"second": 0.5}):
        caplog.clear()
        robot = vp.load_robot(urdf, lock=lock)
        with caplog.at_level(logging.WARNING, logger="varpin.show.replay"):
            path = replay(robot, np.zeros((2, robot.dof)), dt=0.1, html=tmp_path / "arm.html")
        assert len(caplog.records) == 1
        assert "no_such_mesh.stl" in caplog.text
        drawn = [command["path"] for command in commands(path) if command["type"] == "set_object"]
        assert len([p for p in drawn if "/shapes/" in p and "skeleton" not in p]) == 2
        # Locked, the rod is a part of the box's body.
        bones = {p.split("/moving/shapes/")[0].rpartition("/")[2] for p in drawn if "skeleton" in p}
        assert bones == {"0 first" if lock else "1 second"}


def test_a_mesh_the_page_cannot_take_is_left_out(browser, tmp_path, monkeypatch):
    broken = {"type": "BufferGeometry", "data": {"attributes": {"position": None}}}
    monkeypatch.setattr(shape_module._Triangles, "lower", lambda form, _: {"uuid": form.uuid, **broken})
    visit(browser, replay(vp.load_robot("ur5"), np.zeros((11, 6)), dt=0.1, html=tmp_path / "ur5.html"))
    assert severe(browser)
    assert browser.execute_script("return viewer.animator.playing && viewer.animator.duration") == 1.0


def end(viewer):
    viewer.window.server_proc.kill()
    viewer.window.server_proc.wait()


def test_live_window(browser, motion, monkeypatch, capfd):
    opened = []
    monkeypatch.setattr(page_module.webbrowser, "open", lambda url, new=0: opened.append(url) or True)
    viewer = replay(FINGER, motion, marks=vp.Marks(ghost=motion.q[::-1]), open=True)
    try:
        assert opened == [viewer.url()]
        assert capfd.readouterr().out == ""
        connect(browser, online=True)
        browser.get(viewer.url())
        wait_until(lambda: browser.execute_script("return viewer.animator.duration") == 0.5)
        seek(browser, 0.5)
        assert shapes_stand(browser, FINGER, motion.q[0], "ghost")
    finally:
        browser.get("about:blank")
        end(viewer)


def test_a_notebook_shows_the_page_in_a_frame(browser, motion, tmp_path):
    shown = replay(FINGER, motion, size=(600, 400))
    assert repr(shown) == f"Inline(replay of finger, {len(shown.html) / 1e6:.1f} MB)"
    page = tmp_path / "notebook.html"
    page.write_text(f"<!DOCTYPE html><title>notebook</title><p>above</p>{shown._repr_html_()}<p>below</p>")
    browser.get(page.as_uri())
    frame = browser.find_element("tag name", "iframe")
    assert frame.size == {"width": 600, "height": 400}
    browser.switch_to.frame(frame)
    wait_until(lambda: browser.execute_script("return document.documentElement.dataset.loaded"))
    assert browser.execute_script("return document.title") == "finger - varpin"
    assert browser.execute_script("return 'robot' in viewer.scene_tree.find(['meshcat']).children")
    browser.switch_to.default_content()
    assert [text.text for text in browser.find_elements("tag name", "p")] == ["above", "below"]


def test_says_where_to_look_when_no_browser_opens(motion, monkeypatch, caplog):
    monkeypatch.setattr(page_module.webbrowser, "open", lambda url, new=0: False)
    viewer = replay(FINGER, motion, open=True)
    end(viewer)
    assert naming(caplog.messages, "browser", viewer.url())


def test_refuses_what_it_cannot_show(motion, tmp_path):
    page = tmp_path / "page.html"

    def no(*facts, robot=FINGER, motion=motion, html=page, **options):
        with refused(vp.InputError, *facts):
            replay(robot, motion, html=html, **options)

    q = np.zeros((3, 3))
    no("html=path", "open=True", open=True)
    no("robot", "load_robot", robot=FINGER.model)
    no("dt", motion=q)
    no("0.001 s", dt=0.1)
    no("dt", "0.0", motion=q, dt=0.0)
    no("motion", "(N + 1, 3)", "(3, 2)", motion=np.zeros((3, 2)), dt=0.1)
    no("motion", "(N + 1, 3)", "(0, 3)", motion=np.zeros((0, 3)), dt=0.1)
    no("motion", "'still'", motion="still", dt=0.1)
    q[1, 2] = np.nan
    no("motion[1, 2]", "nan", motion=q, dt=0.1)
    no("speed", "0", speed=0)
    for size in ((-1, 3), (700,), 700, ("a", "b")):
        no("size", html=None, size=size)
    no("fps", "-1", fps=-1)
    no("ghost", "(K, 3)", "(3, 2)", marks=vp.Marks(ghost=np.zeros((3, 2))))
    no("ghost[1, 2]", "nan", marks=vp.Marks(ghost=q))
    no("ghost", "'still'", marks=vp.Marks(ghost="still"))
    no("ghost", "4", motion=[[0.0, 0.0, 0.0]], dt=1.0, marks=vp.Marks(ghost=motion.q[:4]))
    other = vp.simulate(vp.Scene(vp.planar_chain(3)), [0, 0, 0], [0, 0, 0], dt=1e-3, steps=2)
    both = ("'chain3'", "joint1, joint2, joint3", "'finger'", "mcp, pip, dip")
    no("ghost", *both, marks=vp.Marks(ghost=other))
    no("motion", *both, robot=vp.planar_chain(3))
    assert not page.exists()


def test_refuses_an_unwritable_path_before_the_work(motion, tmp_path, monkeypatch):
    def work(robot):
        raise AssertionError("worked first")

    monkeypatch.setattr(Picture, "of", work)
    nowhere = tmp_path / "missing" / "page.html"
    for path, folder in ((nowhere, nowhere.parent), (tmp_path, tmp_path)):
        with refused(vp.FileError, "folder", str(folder)):
            replay(FINGER, motion, html=path)


@pytest.mark.parametrize("size", [(800, 640), (400, 700)])
def test_all_of_the_motion_is_in_view_above_the_bar(show, browser, size):
    robot = vp.load_robot("talos_arm")
    q = np.linspace(-0.5, 0.5, 5)[:, None] * np.ones(robot.dof)
    marks = vp.Marks(targets={"a place with a long name": [0.3, 0.5, 0.6]}, frames=True)
    browser.set_window_size(*size)
    try:
        show(robot, q, dt=0.2, marks=marks)
        for seconds in (0.0, 0.4, 0.8):
            seek(browser, seconds)
            canvas, pane, low, high = browser.execute_script(
                """
                const camera = viewer.camera, Point = camera.position.constructor, pane = viewer.dom_element;
                camera.updateMatrixWorld(true);
                const low = [9, 9], high = [-9, -9];
                viewer.scene_tree.find(["meshcat"]).object.traverse(node => {
                    if (!node.isMesh && !node.isSprite) return;
                    // A label is turned to the camera; its corners are half of its width and height from its place.
                    const sides = [[-0.5, 0.5], [-0.5, 0.5], [0, 0]];
                    const place = new Point().setFromMatrixPosition(node.matrixWorld);
                    if (node.isMesh) {
                        node.geometry.computeBoundingBox();
                        const {min, max} = node.geometry.boundingBox;
                        ["x", "y", "z"].forEach((axis, k) => { sides[k] = [min[axis], max[axis]]; });
                    }
                    for (const x of sides[0]) for (const y of sides[1]) for (const z of sides[2]) {
                        const corner = node.isMesh
                            ? new Point(x, y, z).applyMatrix4(node.matrixWorld)
                            : new Point(x * node.scale.x, y * node.scale.y, 0)
                                .applyQuaternion(camera.getWorldQuaternion(camera.quaternion.clone())).add(place);
                        corner.project(camera);
                        [corner.x, corner.y].forEach((value, k) => {
                            low[k] = Math.min(low[k], value); high[k] = Math.max(high[k], value);
                        });
                    }
                });
                const canvas = viewer.renderer.domElement;
                return [[canvas.clientWidth, canvas.clientHeight], [pane.clientWidth, pane.clientHeight], low, high];"""
            )
            assert canvas == pane
            assert canvas[1] <= browser.execute_script(
                "return innerHeight - document.getElementById('bar').offsetHeight"
            )
            assert min(low) > -1.0
            assert max(high) < 1.0
    finally:
        browser.set_window_size(800, 600)
    told = [entry["message"] for entry in browser.get_log("browser")]
    assert not [words for words in told if "deprecated" in words]


# --- looks of shapes: colours of mesh files, textures, and a node of its own for each --------------------------------


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
    page = vp.replay(robot, np.random.default_rng(0).normal(size=(3, 6)), dt=1.0, html=tmp_path / "a.html")
    moved = [part["path"] for part in commands(page)[-1]["animations"]]
    assert len({str(path) for path in moved}) == len(moved) == 6
    assert not {"shapes", "notes"} & {path.split("/")[-2] for path in moved}


def test_a_follower_is_where_its_leader_puts_it(tmp_path):
    leads = link("one") + joint("first", "base", "one")
    robot = vp.load_robot(
        write_urdf(tmp_path, leads, link("two") + joint("second", "base", "two", inside=mimic("first", -2.0, 0.3)))
    )
    page = vp.replay(robot, [[0.1], [0.4]], dt=1.0, html=tmp_path / "a.html")
    tracks, _ = animation(page)
    found = {path.split("/")[-2].split()[-1]: values for (path, _), (_, values) in tracks.items()}
    np.testing.assert_allclose(found["second"], [0.1, -0.5], atol=1e-12)


# --- films -----------------------------------------------------------------------------------------------------------


CHAIN, Q = vp.planar_chain(2), np.linspace([0.0, 0.0], [1.2, -0.8], 11)
SCENE = vp.Scene(CHAIN)


def frames(path):
    return np.array(
        [np.asarray(frame.convert("RGB"), dtype=float) for frame in ImageSequence.Iterator(Image.open(path))]
    )


def test_frames_are_at_exact_times(browser, tmp_path):
    q = np.repeat([[0.0, 0.0], [1.0, 0.5]], [6, 5], axis=0)  # moves between 0.5 s and 0.6 s alone
    path = tmp_path / "jump.gif"
    assert replay(CHAIN, q, dt=0.1, video=path, fps=10.0, size=(320, 240)) == path
    film = frames(path)
    assert film.shape == (11, 240, 320, 3)
    assert Image.open(path).info["duration"] == 100  # [ms]
    assert (film[:6] == film[0]).all()
    assert (film[6:] == film[-1]).all()
    assert (np.abs(film[6] - film[5]).max(axis=-1) > 40.0).mean() > 1e-3


def test_an_mp4_and_its_page(browser, tmp_path):
    path, page = tmp_path / "chain.mp4", tmp_path / "chain.html"
    assert replay(CHAIN, Q, dt=0.1, html=page, video=path, fps=5.0, size=(320, 240), speed=2.0) == path
    film = imageio.imread(path, plugin="FFMPEG").astype(float)
    assert film.shape == (3, 240, 320, 3)
    assert (np.abs(film[2] - film[0]).max(axis=-1) > 40.0).mean() > 1e-3
    assert page.stat().st_size > 10_000


def test_frame_times():
    np.testing.assert_allclose(video.frame_times(".mp4", 30.0, 1.0, 99), np.arange(31) / 30.0)
    np.testing.assert_allclose(video.frame_times(".gif", 30.0, 1.0, 99), 0.03 * np.arange(34))
    np.testing.assert_allclose(video.frame_times(".gif", 1000.0, 0.1, 99), 0.02 * np.arange(6))
    assert [len(video.frame_times(kind, 30.0, 100.0, 11)) for kind in video.FORMATS] == [11, 11]
    np.testing.assert_array_equal(video.frame_times(".gif", 30.0, 0.0, 99), [0.0])


def test_says_what_is_missing_and_how_to_get_it(tmp_path, monkeypatch):
    found, which = importlib.util.find_spec, shutil.which

    def without(*gone):
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in gone else found(name))
        monkeypatch.setattr(shutil, "which", lambda name: None if name in gone else (which(name) or f"/usr/bin/{name}"))
        with pytest.raises(vp.MissingDependency) as caught:
            replay(CHAIN, Q, dt=0.1, video=tmp_path / "chain.gif")
        return caught.value

    error = without("imageio", "imageio_ffmpeg")
    assert (error.missing, error.command) == (("imageio", "imageio-ffmpeg"), 'pip install "varpin[video]"')
    assert isinstance(error, ImportError)
    assert without("selenium").missing == ("selenium",)
    nothing = without("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chromedriver")
    assert nothing.missing == ("chromium", "chromedriver")
    assert not (tmp_path / "chain.gif").exists()


def test_refuses_other_formats_and_sizes(tmp_path):
    for name, size, facts in [
        ("chain.avi", (320, 240), ("video", ".gif", ".mp4", "'chain.avi'")),
        ("chain.mp4", (321, 240), ("size", "even", "321 x 240")),
        ("chain.mp4", 320, ("size", "width", "height", "320")),
        ("chain.mp4", (320, 2), ("size", "16", "2")),
    ]:
        with refused(vp.InputError, facts):
            replay(CHAIN, Q, dt=0.1, video=tmp_path / name, size=size)


@pytest.mark.slow
def test_the_command_line_films_with_traces(browser, tmp_path, capsys):
    path = tmp_path / "finger.gif"
    start = ["simulate", "finger", "--no-gravity", "--v0", "2", "1", "1", "--dt", "1e-2", "--steps", "10"]
    assert main([*start, "--video", str(path), "--trace", "tip", "--speed", "0.5", "--quiet"]) == 0
    assert len(frames(path)) == 7  # 0.2 s of playback, 0.03 s each
    assert main([*start, "--html", str(tmp_path / "page.html"), "--trace", "nail"]) == 2
    assert not unnamed(" ".join(capsys.readouterr().err.split()), "--trace", "'finger'", "'nail'")
    assert main([*start, "--video", str(tmp_path / "finger.avi")]) == 2
    assert not unnamed(capsys.readouterr().err, "video", ".gif", ".mp4")


# --- motions and plans while they are computed -----------------------------------------------------------------------


@pytest.fixture
def opened():
    with contextlib.ExitStack() as stack:
        yield lambda *given, **options: stack.enter_context(vp.LiveView(*given, open=False, **options))


@pytest.fixture
def seen(opened, browser):
    def make(*given, **options):
        view = opened(*given, **options)
        connect(browser, online=True)
        browser.get(view.url)
        assert view.wait(60.0)
        return view

    return make


def test_the_robot_is_where_the_motion_is_while_it_is_computed(seen, browser):
    finger = vp.load_robot("finger")
    scene = vp.Scene(finger, gravity=False, damping=1e-3)
    view = seen(scene, marks=vp.Marks(trace=True), speed=None, fps=1e6)
    looks = []

    def progress(done, steps, nodes):
        view.progress(done, steps, nodes)
        if len(looks) < 4 or done == steps:
            wait_until(lambda: shapes_stand(browser, finger, nodes.q[-1]))
            looks.append(done)

    vp.simulate(scene, [0.1, 0.2, 0.3], [2.0, 1.0, 1.0], dt=1e-5, steps=60_000, progress=progress)
    assert looks[0] == 0
    assert looks[-1] == 60_000
    assert 0 < looks[1] < looks[2] < looks[3] < 60_000
    assert any("tip" in name or finger.end_effector in name for name in names(browser, ["notes", "live"]))
    assert "words" in names(browser, ["notes"])
    assert severe(browser) == []


def test_a_motion_takes_the_time_that_it_would_take(opened, monkeypatch):
    view = opened(SCENE, speed=2.0, fps=20.0)
    motion = {"dt": 1e-3, "steps": 1000, "progress": view.progress, "check": False}
    begin = time.monotonic()
    vp.simulate(SCENE, [0.3, 0.0], [0.0, 0.0], **motion)
    # Nobody looks, so nobody waits.
    assert time.monotonic() - begin < 0.45
    monkeypatch.setattr(live._Window, "watched", property(lambda window: True))
    shown, move = [], view._move
    monkeypatch.setattr(view, "_move", lambda t, q, now, *rest, **last: shown.append(now) or move(t, q, now, *rest))
    begin = time.monotonic()
    end = vp.simulate(SCENE, [0.3, 0.0], [0.0, 0.0], **motion).t[-1]
    assert time.monotonic() - begin > 0.45
    assert shown == sorted(shown)
    assert len(shown) <= 13
    assert shown[-1] == end


def test_a_controllers_run_is_shown(opened):
    cost = vp.TrackingCost([0.5, -1.0], 10.0) + vp.VelocityCost(0.1) + vp.ControlCost(1e-4)
    problem = vp.OptimalControlProblem(SCENE, cost, [0.0, 0.0], [0.0, 0.0], dt=2e-2, steps=20)
    view = opened(problem, speed=None)
    parts = []

    def progress(done, ticks, nodes):
        view.progress(done, ticks, nodes)
        parts.append(nodes)

    run = vp.Mpc(problem).run(duration=0.2, progress=progress)
    np.testing.assert_array_equal(np.concatenate([part.q[1:] for part in parts]), run.motion.q[1:])
    np.testing.assert_allclose(np.concatenate([part.t[1:] for part in parts]), run.motion.t[1:], rtol=1e-12)
    np.testing.assert_array_equal(view._q, run.motion.q[-1])


def test_the_camera_moves_back_from_what_leaves_the_view(opened):
    view = opened(SCENE.robot)
    before = view._in_view
    view._keep_in_view(np.array([[9.0, 0.0, 0.0]]))
    assert view._in_view.max() > 10.0
    after = view._in_view
    view._keep_in_view(np.array([[9.5, 0.0, 0.0]]))
    assert view._in_view is after is not before


def test_ctrl_c_ends_the_motion_and_not_the_view(opened):
    view = opened(SCENE, speed=None)

    def progress(done, steps, nodes):
        view.progress(done, steps, nodes)
        if done:
            # As if it came between a command and its answer.
            view._window.zmq_socket.send_multipart([b"url"])
            raise KeyboardInterrupt

    with pytest.raises(vp.Interrupted) as caught:
        vp.simulate(SCENE, [0.3, 0.0], [0.0, 0.0], dt=1e-4, steps=100_000, progress=progress)
    assert 0 < caught.value.trajectory.steps < 100_000
    motion = vp.simulate(SCENE, [0.3, 0.0], [0.0, 0.0], dt=1e-3, steps=10, progress=view.progress)
    np.testing.assert_array_equal(view._q, motion.q[-1])


def test_a_server_that_dies_costs_the_picture_alone(opened, caplog, monkeypatch):
    monkeypatch.setattr(live, "_ANSWER_LIMIT", 0.2)
    view = opened(SCENE, speed=None)
    view._window.server_proc.kill()
    with caplog.at_level(logging.WARNING, logger="varpin.show.replay"):
        motion = vp.simulate(SCENE, [0.3, 0.0], [0.0, 0.0], dt=1e-3, steps=10, progress=view.progress)
    assert motion.steps == 10
    assert caplog.text.count("the computation continues without it") == 1


def test_a_browser_is_started_and_waited_for(monkeypatch, caplog, capfd):
    asked = []
    monkeypatch.setattr(page.webbrowser, "open", lambda url, new=0: asked.append(url) or True)
    monkeypatch.setattr(live.LiveView.wait, "__defaults__", (0.1,))
    with vp.LiveView(SCENE) as view:
        assert asked == [view.url]
        assert f'<iframe src="{view.url}"' in view._repr_html_()
    assert "no browser shows" in caplog.text
    assert capfd.readouterr().out == ""
    assert "closed" in repr(view)
    # What is told a closed view is lost, and nothing else.
    vp.simulate(SCENE, [0.3, 0.0], [0.0, 0.0], dt=1e-3, steps=10, progress=view.progress)


def test_says_what_does_not_fit(opened):
    problem = vp.OptimalControlProblem(SCENE, vp.ControlCost(1.0), [0.0, 0.0], [0.0, 0.0], dt=1e-2, steps=5)
    other, tell = vp.Scene(vp.planar_chain(3)), opened(SCENE).progress
    with refused(vp.InputError, "progress"):
        vp.solve(problem, progress=tell)
    with refused(vp.InputError, "'chain2'", "2", "3"):
        vp.simulate(other, np.zeros(3), np.zeros(3), dt=1e-3, steps=10, progress=tell)
    for given, options, kind, facts in (
        (SCENE, {"marks": vp.Marks(ghost=[[0.0, 0.0]])}, vp.InputError, "ghost"),
        (SCENE, {"marks": vp.Marks(trace="hand")}, vp.UnknownFrame, ("trace", "'chain2'", "'hand'")),
        (SCENE, {"speed": 0.0}, vp.InputError, ("speed", "0.0")),
        (SCENE.robot.model, {}, vp.InputError, ("LiveView", "Robot", "Scene", "OptimalControlProblem")),
    ):
        with refused(kind, facts):
            vp.LiveView(given, **options)


def law(t, q, v):
    return np.array([np.sin(t), -q[0]])


CONTROLS = [
    None,
    law,
    vp.OpenLoop(lambda t: [np.sin(t), 0.0]),
    vp.FirstOrderHold(np.linspace(0, 1, 802).reshape(401, 2)),
]


@pytest.mark.parametrize("controls", CONTROLS)
def test_who_asks_for_nodes_gets_all_of_them_once(controls, monkeypatch):
    monkeypatch.setattr("varpin.simulation.simulate._CHUNK", 50)
    parts = []

    def progress(done, steps, nodes):
        assert steps == 400
        assert nodes.t[-1] == pytest.approx(done * 1e-3)
        parts.append(nodes)

    given = {"q0": [0.3, 0.0], "v0": [0.0, 0.0], "dt": 1e-3, "steps": 400, "controls": controls}
    given |= {"period": 3} if controls is law else {}
    told, plain = vp.simulate(SCENE, **given, progress=progress), vp.simulate(SCENE, **given)
    assert len(parts) > 10
    for name in ("t", "q", "v"):
        rows = np.concatenate([getattr(parts[0], name)[:1], *(getattr(part, name)[1:] for part in parts)])
        np.testing.assert_array_equal(rows, getattr(told, name))
        np.testing.assert_array_equal(rows, getattr(plain, name))
    for before, after in itertools.pairwise(parts):
        assert before.t[-1] == after.t[0]
        np.testing.assert_array_equal(before.q[-1], after.q[0])


def test_functions_of_two_arguments_are_told_as_before(capsys):
    start = {"q0": [0.3, 0.0], "v0": [0.0, 0.0], "dt": 1e-3, "steps": 10}
    told = []
    vp.simulate(SCENE, **start, progress=lambda done, steps: told.append((done, steps)))
    vp.simulate(SCENE, **start, progress=lambda *given: told.append(given))
    assert told == [(10, 10), (10, 10)]
    vp.simulate(SCENE, **start, progress=print)
    assert capsys.readouterr().out == "10 10\n"
    for wrong in (lambda done: None, 3):
        with refused(vp.InputError, "progress"):
            vp.simulate(SCENE, **start, progress=wrong)
    vp.simulate(SCENE, **(start | {"steps": 0}), progress=lambda done, steps, nodes: told.append(nodes.q))
    np.testing.assert_array_equal(told[-1], [[0.3, 0.0]])
