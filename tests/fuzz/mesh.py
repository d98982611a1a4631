"""Mesh files that a URDF names, and the URDF's other shapes: STL, OBJ and Collada, damaged, read and drawn."""

from __future__ import annotations

import base64
import random
import re
import unittest.mock
from pathlib import Path

import numpy as np
from mechanisms import INERTIAL, joint, link

import varpin as vp
from fuzz.damage import NUMBERS, WORDS, Case, Special, damaged_bytes
from varpin.replay import picture
from varpin.replay.page import Page
from varpin.robot import readable_geometry
from varpin.robot.example_robot_data import FIXED_BASE, locate

STL = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 1\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n"
)
OBJ = (
    "mtllib a.mtl\no a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvn 0 0 1\n"
    "usemtl m\nf 1/1/1 2/1/1 3/1/1\nf 1//1 2//1 4//1\n"
)
DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_images><image id="i"><init_from>texture.png</init_from></image></library_images>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="12">0 0 0 1 0 0 0 1 0 0 0 1</float_array><technique_common>
<accessor source="#pa" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="2"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2 0 1 3</p></triangles>
<polylist count="1"><input semantic="VERTEX" source="#v" offset="0"/><vcount>3</vcount><p>0 2 3</p></polylist>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><matrix>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</matrix>
<instance_geometry url="#g"/></node><node id="o"><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""
ENDINGS = [
    "stl",
    "obj",
    "dae",
    "STL",
    "ply",
    "off",
    "bvh",
    "x3d",
    "gltf",
    "glb",
    "fbx",
    "3ds",
    "blend",
    "mdl",
    "ifc",
    "",
]
SECRET = b"not for others" * 9  # where a texture is
PLACES = [
    *("mesh.stl", "/dev/zero", "/dev/stdin", "file:///dev/zero", "file:///etc/passwd", "/etc/passwd", "fifo.stl", "."),
    *(
        "package://fifo.stl",
        "package://folder.stl",
        "package://../../../etc/passwd",
        "http://x/a.stl",
        "://",
        "",
        "%s%n",
    ),
]
SHAPES = [
    '<box size="{a} {b} {c}"/>',
    '<sphere radius="{a}"/>',
    '<cylinder radius="{a}" length="{b}"/>',
    '<mesh filename="package://{mesh}" scale="{a} {b} {c}"/>',
]

Corpus = list[tuple[str, bytes]]


def corpus() -> Corpus:
    """Small files of each kind, and published ones of a few kilobytes."""
    found = [("stl", STL.encode()), ("obj", OBJ.encode()), ("dae", DAE.encode())] * 8
    folder = locate(FIXED_BASE["ur5"]).parents[2]
    for ending in ("stl", "STL", "obj", "dae"):
        published = sorted(folder.rglob(f"*.{ending}"), key=lambda path: (path.stat().st_size, path.name))
        found += [(ending.lower(), path.read_bytes()) for path in published[:6]]
    return found


def whole(corpus: Corpus) -> Case:
    """A robot with one mesh."""
    return _case("mesh.stl", corpus[0][1], '<mesh filename="package://mesh.stl"/>')


def _case(name: str, content: bytes, shape: str, rest: str = "") -> Case:
    visual = f"<visual>{rest}<geometry>{shape}</geometry></visual>"
    robot = f'<robot name="a"><link name="base"/>{link("l1", INERTIAL, visual)}{joint("j1", "base", "l1")}</robot>'
    beside = {"fifo.stl": Special("fifo"), "folder.stl": Special("folder"), "secret": SECRET}
    beside |= {"texture.png": Special("link", "secret")}
    return Case("mesh", {"robot.urdf": robot.encode("utf-8", errors="replace"), name: content, **beside})


def make(rng: random.Random, corpus: Corpus) -> Case:
    """A damaged file, another ending, or another shape."""
    ending, content = rng.choice(corpus)
    if ending != "stl" or content.startswith(b"solid"):
        for _ in range(rng.choice([0, 0, 1, 2, 5])):
            content = _other_word(content, rng)
    if rng.random() < 0.6:
        content = damaged_bytes(content, rng)
    if rng.random() < 0.03:
        content, ending = extreme(rng)
    name = f"mesh.{ending if rng.random() < 0.9 else rng.choice(ENDINGS)}"
    shape, rest = f'<mesh filename="package://{name}"/>', ""
    if rng.random() < 0.15:
        numbers = {key: rng.choice(["1", "0.5", *NUMBERS]) for key in "abc"}
        shape = rng.choice(SHAPES).format(mesh=name, **numbers)
        color = " ".join(rng.choice(["0.5", "1", *NUMBERS]) for _ in range(4))
        rest = rng.choice(["", f'<material name="m"><color rgba="{color}"/></material>', '<origin xyz="1e39 0 0"/>'])
    elif rng.random() < 0.05:
        shape = f'<mesh filename="{rng.choice([*PLACES, *WORDS])}"/>'
    return _case(name, content, shape, rest)


def _other_word(content: bytes, rng: random.Random) -> bytes:
    found = list(re.finditer(rb"[-+\w.#]+", content))
    if not found:
        return content
    here = rng.choice(found)
    words = [*NUMBERS, "-1", "999999999", "4294967295", "18446744073709551615", "1/2/3/4", "1//", "#v", "#p", "secret"]
    words += ["solid", "facet", "endsolid", "v", "f", "vn", "g", "usemtl", "mtllib", "triangles", "lines", "tristrips"]
    return content[: here.start()] + rng.choice(words).encode() + content[here.end() :]


def extreme(rng: random.Random) -> tuple[bytes, str]:
    """Long, nested, empty, or with counts that nothing follows."""
    size = int(10 ** rng.uniform(2.0, 5.5))
    head, tail = DAE.split("<instance_geometry", 1)
    return rng.choice(
        [
            (b"\0" * 80 + b"\xff\xff\xff\xff" + b"\0" * size, "stl"),
            (b"\0" * 80 + (size // 50).to_bytes(4, "little") + b"\xff" * size, "stl"),
            (b"solid " * size, "stl"),
            (b"v 0 0 0\n" * size + b"f" + b" 1" * size, "obj"),
            (b"f -1 -2 -3\n" * size, "obj"),
            (DAE.replace('count="12"', f'count="{size}000000"').encode(), "dae"),
            (DAE.replace('stride="3"', f'stride="{size}000000"').encode(), "dae"),
            (DAE.replace("<vcount>3", f"<vcount>{size}000000").encode(), "dae"),
            ((head + "<node>" * size + "</node>" * size + "<instance_geometry" + tail).encode(), "dae"),
            ((head + '<instance_geometry url="#g"/>' * (size // 10) + "<instance_geometry" + tail).encode(), "dae"),
            (b"<a>" * size + b"</a>" * size, "dae"),
            (rng.randbytes(size), rng.choice(ENDINGS)),
            (b"", rng.choice(ENDINGS)),
        ]
    )


def read(path: Path, form: str) -> str:
    """Load the robot and write a replay of it."""
    missing = {}

    def noted(robot: vp.Robot) -> tuple[object, object]:
        found = readable_geometry(robot)
        missing.update(found[1])
        return found

    try:
        robot = vp.load_robot(path)
        with (
            unittest.mock.patch.object(Page, "html", lambda page, title: "".join(map(repr, page.commands))),
            unittest.mock.patch.object(picture, "readable_geometry", noted),
        ):
            page = vp.replay(robot, np.zeros((1, robot.dof)), dt=1.0, html=path.with_suffix(".html"))
    except vp.VarpinError as error:
        return type(error).__name__
    assert base64.b64encode(SECRET) not in page.read_bytes()
    return "taken, as a skeleton" if missing else "taken"
