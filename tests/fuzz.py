"""Damaged input for everything that reads a file: URDF texts and npz archives, a hundred thousand of them if asked.

    python tests/fuzz.py --inputs 100000 --seed 0

Every input follows from (kind, seed, number). Workers read them one after another, with a limit on memory and under a
watch: a worker that dies or hangs is a finding with its input, and so is whatever is raised that is no VarpinError.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import copy
import io
import json
import logging
import os
import random
import resource
import selectors
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from mechanisms import INERTIAL, joint, link, mimic

import varpin as vp
from varpin.paper.cases import MAIN
from varpin.paper.experiments import Cell, Store, Task
from varpin.robot import bundled_robots, geometry
from varpin.robot.example_robot_data import FIXED_BASE, locate
from varpin.tradeoff import OptimalControlTradeoff, WorkPrecision
from varpin.tradeoff.optimal_control import OptimalControlRun
from varpin.tradeoff.precision import WorkPrecisionRun

MEMORY = 1_000_000_000  # bytes that a reader may take in all
TIMEOUT = 20.0  # [s] of processor time that one input may take; of wall time twenty times as much
KINDS = ("urdf", "npz")

NUMBERS = [
    *(
        "0",
        "-0",
        "1",
        "-1",
        "2",
        "1e-3",
        "1e3",
        "1e8",
        "1e-12",
        "1e-320",
        "1e150",
        "-1e150",
        "1e160",
        "1e308",
        "-1e308",
    ),
    *("1e309", "nan", "NaN", "-nan", "inf", "-inf", "infinity", "0x1p3", "1_000", "1,5", "1e", "1d3", "+1", ".5", "5."),
    *("٣", "½", "abc", "3.14159265358979", "1.5707963", "99999999999999999999", "2147483648", "1e-9", "1e9", "", " "),
    *("1 2", "\t1", "9" * 5000),
]
WORDS = [
    *("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical", "mimic", "universe", "world"),
    *("root_joint", "base", "base_link", "l1", "l2", "j1", "j2", "%s%n%s", "../../etc/passwd", "package://x/y.stl"),
    *("file:///dev/zero", "/dev/zero", "/dev/stdin", "é", "机器人", "\u202e", "🤖", "", " ", "a" * 20_000, "a b"),
]
ELEMENTS = [
    INERTIAL,
    mimic("j1"),
    mimic("j2", -2.5, 0.3),
    mimic("j1", 0),
    mimic("nobody", "nan"),
    '<axis xyz="0 0 0"/>',
    '<axis xyz="1 1 1"/>',
    '<axis xyz="1e-200 0 0"/>',
    '<axis xyz="1e200 1e200 0"/>',
    '<origin xyz="0 0 0" rpy="0 0 0"/>',
    '<origin xyz="1e9 -1e9 1e200" rpy="1e9 1e22 3"/>',
    '<limit effort="1" velocity="1" lower="1" upper="-1"/>',
    '<limit effort="-1" velocity="nan" lower="-inf" upper="inf"/>',
    '<dynamics damping="0.1" friction="1"/>',
    '<dynamics damping="-1" friction="nan"/>',
    '<safety_controller k_velocity="1" k_position="nan" soft_lower_limit="2" soft_upper_limit="-2"/>',
    '<calibration rising="0.0" falling="x"/>',
    '<visual><geometry><box size="1 1 1"/></geometry></visual>',
    '<visual><geometry><box size="-1 nan 1e308"/></geometry></visual>',
    '<visual><geometry><sphere radius="-1"/></geometry><material name=""/></visual>',
    '<visual><geometry><cylinder radius="0" length="inf"/></geometry></visual>',
    '<visual><geometry><mesh filename="package://nowhere/x.dae" scale="0 0 0"/></geometry></visual>',
    '<visual><geometry><mesh filename="/dev/null"/></geometry></visual>',
    "<visual><geometry/></visual>",
    "<visual/>",
    '<collision><geometry><capsule radius="1" length="1"/></geometry></collision>',
    '<collision><geometry><box size="1 1"/></geometry></collision>',
    '<transmission name="t"><joint name="j1"/><actuator name="m"><mechanicalReduction>nan</mechanicalReduction>'
    "</actuator></transmission>",
    '<gazebo reference="l1"><mu1>0.2</mu1></gazebo>',
    '<material name="m"><color rgba="1 2 nan x"/></material>',
    '<link name="extra"/>',
    '<link name="l1"/>',
    '<link name="universe"/>',
    '<joint name="extra" type="continuous"><parent link="l1"/><child link="extra"/></joint>',
    '<joint name="universe" type="continuous"><parent link="l1"/><child link="l2"/><axis xyz="0 1 0"/></joint>',
    '<robot name="inner"><link name="x"/></robot>',
    '<inertia ixx="1" ixy="2" ixz="3" iyy="1" iyz="4" izz="1"/>',
    '<mass value="-1"/>',
    "<mass/>",
    '<sensor name="s"><camera/></sensor>',
]


# -- URDF --------------------------------------------------------------------------------------------------------------


def _robot(*parts: str, base: str = '<link name="base"/>') -> str:
    return f'<?xml version="1.0"?>\n<robot name="made_up">\n{base}\n{"".join(parts)}</robot>\n'


def urdf_corpus() -> list[str]:
    """Small robots that between them have every element, the bundled ones, and arms as they are published."""
    made_up = [
        _robot(link("l1"), joint("j1", "base", "l1")),
        _robot(link("l1"), link("l2"), joint("j1", "base", "l1", "continuous"), joint("j2", "l1", "l2", "prismatic")),
        _robot(
            link("l1"),
            link("l2"),
            link("l3", ""),
            joint("j1", "base", "l1"),
            joint("j2", "l1", "l2", inside=mimic("j1", 0.5, 0.1)),
            joint("j3", "l2", "l3", "fixed"),
        ),
        _robot(
            link("l1", extra=ELEMENTS[17]),
            link("l2"),
            joint("j1", "base", "l1", axis="1 1 0"),
            joint("j2", "base", "l2", "continuous", axis="0.3 0.2 -1", inside=mimic("j1", -1)),
        ),
        _robot(link("l1", ""), link("l2"), joint("j1", "base", "l1"), joint("j2", "l1", "l2", "planar")),
    ]
    published = [locate(FIXED_BASE[name]).read_text() for name in ("ur5", "double_pendulum", "so100", "panda")]
    # The small ones more often: what is cheap to read is cheap to damage.
    return made_up * 4 + [path.read_text() for path in bundled_robots().values()] * 3 + published


def extreme_urdf(rng: random.Random) -> bytes:
    """A text of its own kind: nested, long, cyclic, expanding or in another encoding."""
    size = int(10 ** rng.uniform(1.0, 4.3))
    kind = rng.choice(["continuous", "fixed", "revolute", "prismatic"])
    which = rng.randrange(14)
    links = "".join(link(f"l{i}") for i in range(1, size + 1))
    if which == 0:
        return (
            _robot(links, *(joint(f"j{i}", f"l{i - 1}", f"l{i}", kind) for i in range(1, size + 1)))
            .replace('"base"', '"l0"')
            .encode()
        )
    if which == 1:
        return _robot(links, *(joint(f"j{i}", "base", f"l{i}", kind) for i in range(1, size + 1))).encode()
    if which == 2:
        return _robot("<a>" * size + "</a>" * size).encode()
    if which == 3:
        laughs = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 12))
        return f'<!DOCTYPE robot [<!ENTITY e0 "ha">{laughs}]><robot name="&e11;"><link name="a"/>&e9;</robot>'.encode()
    if which == 4:
        inner = f'<!DOCTYPE robot [<!ENTITY big "{"a" * size}">]>'
        return f'{inner}<robot name="a"><link name="{"&big;" * size}"/></robot>'.encode()
    if which == 5:
        target = rng.choice(["file:///etc/passwd", "file:///dev/zero", "http://localhost:9/x", "/dev/stdin"])
        return (
            f'<!DOCTYPE robot [<!ENTITY x SYSTEM "{target}"><!ENTITY % y SYSTEM "{target}"> %y;]>'
            f'<robot name="a"><link name="b"/>&x;</robot>'
        ).encode()
    if which == 6:
        return _robot(links, *(joint(f"j{i}", f"l{i}", f"l{i % size + 1}", kind) for i in range(1, size + 1))).encode()
    if which == 7:
        text = _robot(link("l1"), joint("j1", "base", "l1"))
        encoding = rng.choice(["utf-16", "utf-16-le", "utf-32", "utf-8-sig", "latin-1", "cp037", "utf-7"])
        named = rng.choice(["utf-16", "latin-1", "ucs4", "EBCDIC", "bogus", "utf-8"])
        return text.replace('version="1.0"', f'version="1.0" encoding="{named}"').encode(encoding)
    if which == 8:
        attributes = " ".join(f"a{i}=''" for i in range(size))
        return f'<robot name="a" {attributes}><link name="x"/></robot>'.encode()
    if which == 9:
        return _robot("x" * size * 100, link("l1"), joint("j1", "base", "l1")).encode()
    if which == 10:
        wraps = ("<![CDATA[", "]]>"), ("<!--", "-->"), ("<?pi ", "?>"), ("<!-- -- ", "--->")
        begin, end = rng.choice(wraps)
        return _robot(begin * rng.randrange(1, 5), link("l1"), end, joint("j1", "base", "l1")).encode()
    if which == 11:  # every joint follows the next
        ties = [mimic(f"j{i % size + 1}" if rng.random() < 0.5 else f"j{max(1, i - 1)}") for i in range(1, size + 1)]
        return _robot(
            links, *(joint(f"j{i}", "base", f"l{i}", kind, inside=ties[i - 1]) for i in range(1, size + 1))
        ).encode()
    if which == 12:
        tree = [joint(f"j{i}", f"l{rng.randrange(i)}", f"l{i}", kind) for i in range(1, size + 1)]
        rng.shuffle(tree)
        return _robot(links, *tree).replace('"base"', '"l0"').encode()
    return rng.choice([b"", b"\0" * size, b"<" * size, b"<robot>" * size, rng.randbytes(size), b"\xef\xbb\xbf"])


def damaged_text(text: str, rng: random.Random) -> str:
    """A URDF after some changes to its elements and attributes."""
    root = ET.fromstring(text)
    for _ in range(rng.choice([1, 1, 1, 2, 2, 3, 5, 10])):
        everything = list(root.iter())
        element = rng.choice(everything)
        change = rng.randrange(12)
        if change <= 4 and (with_attributes := [e for e in everything if e.attrib]):
            _damage_attribute(rng.choice(with_attributes), everything, rng)
        elif change == 5 and element is not root:
            parent = next(e for e in everything if element in list(e))
            parent.remove(element)
        elif change == 6:
            rng.choice(everything).append(copy.deepcopy(element) if len(everything) < 3000 else ET.Element("link"))
        elif change == 7:
            other = rng.choice(everything)
            element.tag, other.tag = other.tag, element.tag
        elif change == 8:
            host = rng.choice([e for e in everything if e.tag in ("joint", "link", "robot", "inertial")] or [root])
            host.insert(rng.randrange(len(host) + 1), ET.fromstring(rng.choice(ELEMENTS)))
        elif change == 9:
            children = list(element)
            rng.shuffle(children)
            element[:] = children
        elif change == 10:
            element.text = rng.choice(WORDS)
        else:
            other = rng.choice(everything)
            element.attrib, other.attrib = other.attrib, element.attrib
    return ET.tostring(root, encoding="unicode")


def _damage_attribute(element: ET.Element, everything: list[ET.Element], rng: random.Random) -> None:
    name = rng.choice(list(element.attrib))
    words = element.attrib[name].split()
    try:
        numeric = [float(word) for word in words] != []
    except ValueError:
        numeric = False
    change = rng.random()
    if change < 0.08:
        del element.attrib[name]
    elif change < 0.12:
        element.attrib[rng.choice(["name", "type", "link", "xyz", "value", "joint"])] = element.attrib.pop(name)
    elif numeric and change < 0.9:
        words[rng.randrange(len(words))] = rng.choice(NUMBERS)
        if rng.random() < 0.1:
            words += [rng.choice(NUMBERS)]
        element.attrib[name] = " ".join(words)
    elif change < 0.6:
        others = [value for e in everything if (value := e.get(name)) is not None]
        element.attrib[name] = rng.choice(others)
    else:
        element.attrib[name] = rng.choice(WORDS)


def damaged_bytes(content: bytes, rng: random.Random) -> bytes:
    """Bytes flipped, cut, doubled or put in."""
    data = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 4, 16])):
        at = rng.randrange(len(data) + 1)
        change = rng.randrange(6)
        if change == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif change == 1 and at < len(data):
            data[at] = rng.randrange(256)
        elif change == 2:
            data[at:at] = rng.randbytes(rng.choice([1, 2, 8, 100]))
        elif change == 3:
            del data[at : at + rng.choice([1, 2, 8, 100])]
        elif change == 4:
            data[at:at] = data[at : at + rng.choice([4, 40, 400])]
        else:
            data[at : at + 4] = struct.pack("<I", rng.choice([0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x10000]))
    if rng.random() < 0.05:
        del data[rng.randrange(len(data) + 1) :]
    return bytes(data)


def urdf(number: int, seed: int, corpus: list[str]) -> bytes:
    """The URDF of that number."""
    rng = random.Random(f"urdf {seed} {number}")
    if rng.random() < 0.02:
        return extreme_urdf(rng)
    text = rng.choice(corpus)
    if rng.random() < 0.85:
        text = damaged_text(text, rng)
    content = text.encode("utf-8", errors="replace")
    return damaged_bytes(content, rng) if rng.random() < 0.25 else content


def read_urdf(path: Path) -> str:
    """Load a robot and use it: what is taken must move."""
    rng = np.random.default_rng(0)
    try:
        robot = vp.load_robot(path, mimic="tied" if path.stat().st_size % 4 else "free")
    except vp.VarpinError as error:
        return type(error).__name__
    if robot.dof > 60:
        return "taken, large"
    scene = vp.Scene(robot, damping=0.1)
    try:
        motion = vp.simulate(scene, rng.normal(size=robot.dof), rng.normal(size=robot.dof), dt=1e-3, steps=2)
        _require_finite(motion)
    except vp.VarpinError as error:
        return f"taken, then {type(error).__name__}"
    for name, use in (("inspected", vp.inspect_robot), ("drawn", lambda _: geometry(robot))):
        try:
            use(path)
        except vp.VarpinError as error:
            return f"taken, not {name}: {type(error).__name__}"
    return "taken"


def _require_finite(motion: vp.Trajectory) -> None:
    for name in ("t", "q", "v", "p", "u", "energy"):
        assert np.isfinite(getattr(motion, name)).all(), f"a motion whose {name} is not finite"


# -- npz ---------------------------------------------------------------------------------------------------------------

Members = dict[str, bytes]


def _members(content: bytes) -> Members:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _npy(array: object, *, allow_pickle: bool = False) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=allow_pickle)
    return stream.getvalue()


def npz_corpus() -> dict[str, list[bytes]]:
    """Whole files of every format that is read, by format."""
    finger = vp.Scene(vp.load_robot("finger"), noise=vp.AdditiveNoise(1e-7))
    chain = vp.Scene(vp.planar_chain(2))
    motions = [
        vp.simulate(finger, [0.1, 0.2, 0.3], [0, 1, 0], dt=1e-3, steps=6, rng=0),
        vp.simulate(chain, [0.1, 0.2], [0.0, 0.0], dt=1e-2, steps=40),
        vp.simulate(chain, [0.1, 0.2], [0.0, 0.0], dt=1e-2, steps=0),
    ]
    values = {"int": 3, "float": 0.25, "str": "Midpoint"}

    def row(kind: type) -> object:
        return kind(**{item.name: values[str(item.type)] for item in fields(kind)})

    precision = WorkPrecision((row(WorkPrecisionRun),) * 3, "ur5", 1.0, "Reference", 1e-12, 1e-12, 64, 1, "abc")
    tradeoff = OptimalControlTradeoff((row(OptimalControlRun),) * 2, "ur5", 1.0, 0, "abc")
    cell = Cell("main", "0", "midpoint", 0.01, 1.0, 0.0, 5, "CONVERGED", 0.1, 1.0, 1.0, 1e-6, t=np.zeros(4))
    with tempfile.TemporaryDirectory() as folder:
        task = Task(MAIN, None, "midpoint", 0.01)
        store = Store(Path(folder))
        store.save(task, cell)
        return {
            "trajectory": [motion.save(Path(folder, "a.npz")).read_bytes() for motion in motions],
            "precision": [precision.save(Path(folder, "b.npz")).read_bytes()],
            "tradeoff": [tradeoff.save(Path(folder, "c.npz")).read_bytes()],
            "cell": [Path(folder, f"{task.name}.npz").read_bytes()],
        }


def _strange_array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    """Another array in the place of one."""
    change = rng.randrange(10)
    if change == 0:
        return array.astype(rng.choice(["f2", "f4", ">f8", "c16", "i1", "U8", "S3", "?", "M8[s]"]), casting="unsafe")
    if change == 1:
        return array.reshape(rng.choice([(-1,), (1, -1), (-1, 1), (1, *array.shape)]))
    if change == 2:
        return np.concatenate([array.reshape(-1)] * rng.randrange(4) or [np.zeros(0)])
    if change == 3 and array.dtype.kind in "fi" and array.size:
        wrong = np.array(array, dtype=float)
        wrong.flat[rng.randrange(array.size)] = float(rng.choice([np.nan, np.inf, 1e308, -1e308, -1.0, 0.0, 1e-320]))
        return wrong
    if change == 4:
        return np.asfortranarray(array)
    if change == 5:
        return np.zeros(rng.choice([(), (0,), (0, 0), (3, 0), (0, 3), (1,) * 32, (7,), (7, 3)]))
    if change == 6:
        return np.array(
            rng.choice(["", "x" * 3000, "varpin.trajectory/2", "\0", "é", "{", "[]", "{}", "null", "1" * 5000])
        )
    if change == 7:
        return np.zeros(3, dtype=[("a", "f8"), ("b", "U3")])
    if change == 8 and array.ndim:
        return np.swapaxes(array, 0, -1)
    return np.zeros_like(array)


def _strange_header(npy: bytes, rng: random.Random) -> bytes:
    """An array whose header says something else than its data."""
    shapes = [
        "()",
        "(1,)",
        "(-1,)",
        "(10**9,)",
        "(1000000000,)",
        "(100000000, 100)",
        "(9223372036854775807,)",
        "(2, 2)",
    ]
    shapes += ["(4611686018427387904, 4)", "(0, 1000000000000)", "(1.5,)", "('a',)", "None", "(True,)"]
    shapes += ["(" * 900 + ")" * 900, "(" + "1, " * 70 + ")", "(" + "0, " * 40 + ")", "(-4611686018427387904, 2)"]
    kinds = [
        "'<f8'",
        "'|O'",
        "'<U1000000000'",
        "'<U0'",
        "'V0'",
        "[('a', '<f8')]",
        "'<f8, <f8'",
        "'>i8'",
        "'<M8[s]'",
        "1",
    ]
    kinds += ["[('a', '|O')]", "('<f8', (1000, 1000, 1000))", "[" * 300 + "]" * 300, "'x'", "'<U2147483647'", "'<f16'"]
    shape, kind = rng.choice(shapes), rng.choice(kinds)
    head = "{'descr': %s, 'fortran_order': %s, 'shape': %s, }" % (  # noqa: UP031
        kind if rng.random() < 0.5 else "'<f8'",
        rng.choice(["False", "True", "2", "None"]),
        shape if rng.random() < 0.7 else "(3,)",
    )
    if rng.random() < 0.1:
        head = rng.choice(["{}", "[" * 5000, "", "a" * 9000, "{'descr': " * 500, "-" * 5000 + "1", "9" * 5000])
    version = rng.choice([(1, 0), (1, 0), (1, 0), (2, 0), (3, 0), (9, 9)])
    raw = head.encode() + b"\n"
    length = struct.pack("<H" if version == (1, 0) else "<I", len(raw) if rng.random() < 0.9 else 65535)
    return b"\x93NUMPY" + bytes(version) + length + raw + npy[-rng.randrange(1, 200) :]


def _zipped(members: list[tuple[str, bytes]], rng: random.Random) -> bytes:
    stream = io.BytesIO()
    odd = [zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    method = zipfile.ZIP_DEFLATED if rng.random() < 0.9 else rng.choice(odd)
    with zipfile.ZipFile(stream, "w", method) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # names that are there twice
        for name, content in members:
            archive.writestr(name, content)
    return stream.getvalue()


def _bomb(members: Members, rng: random.Random) -> bytes:
    """An archive that unpacks to much more than it is."""
    size = rng.choice([10**7, 10**8, 3 * 10**8])
    name = rng.choice(list(members))
    if rng.random() < 0.5:
        stream = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            stream, {"descr": rng.choice(["<f8", "|i1", "<U1"]), "fortran_order": False, "shape": (size // 8,)}
        )
        members[name] = stream.getvalue()
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = packer.compress(members[name]) + b"".join(packer.compress(bytes(10**6)) for _ in range(size // 10**6))
    packed += packer.flush()
    # Written as a stored member of that content, and then called deflated, with a checksum that does not fit.
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for other, content in members.items():
            archive.writestr(other, packed if other == name else content)
        info = archive.getinfo(name)
        info.compress_type, info.file_size = zipfile.ZIP_DEFLATED, rng.choice([len(members[name]) + size, 100, 2**40])
    return stream.getvalue()


def npz(number: int, seed: int, corpus: dict[str, list[bytes]]) -> tuple[str, bytes]:
    """The archive of that number, and the format it is damaged from."""
    rng = random.Random(f"npz {seed} {number}")
    form = rng.choice(["trajectory", "trajectory", "precision", "tradeoff", "cell"])
    content = rng.choice(corpus[form])
    if rng.random() < 0.3:
        return form, damaged_bytes(content, rng)
    members = _members(content)
    if rng.random() < 0.01:
        return form, _bomb(members, rng)
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        name = rng.choice(list(members))
        change = rng.randrange(10)
        if change <= 3:
            with contextlib.suppress(Exception):  # what an earlier change has made no array of
                array = np.load(io.BytesIO(members[name]))
                members[name] = _npy(_strange_array(array, rng))
        elif change <= 5:
            members[name] = _strange_header(members[name], rng)
        elif change == 6:
            other = rng.choice(list(members))
            members[name], members[other] = members[other], members[name]
        elif change == 7:
            members[name] = damaged_bytes(members[name], rng)
        elif change == 8:
            members[rng.choice(["x.npy", "t", "../up.npy", "statistics.npy", name.replace(".npy", "")])] = members[name]
            if rng.random() < 0.5 and len(members) > 1:
                del members[name]
        else:
            members[name] = rng.choice([b"", _npy([{}], allow_pickle=True), b"\x93NUMPY", b"\x80\x04.", b"PK\3\4"])
        if not members:
            break
    if form == "cell" and rng.random() < 0.5:
        members["facts.npy"] = _npy(np.array(_damaged_facts(members.get("facts.npy", b""), rng)))
    listed = list(members.items())
    if rng.random() < 0.05:
        listed += [rng.choice(listed)] if listed else []
    if rng.random() < 0.02:
        listed += [(f"m{i}.npy", b"") for i in range(3000)]
    content = _zipped(listed, rng)
    return form, damaged_bytes(content, rng) if rng.random() < 0.1 else content


def _damaged_facts(npy: bytes, rng: random.Random) -> str:
    """The JSON of a paper cell, with another value or another structure."""
    try:
        facts = json.loads(str(np.load(io.BytesIO(npy))))
    except Exception:
        facts = {}
    if not isinstance(facts, dict):
        facts = {}
    strange = [None, "", "x", [], {}, [[]], 1, -1, 1e400, True, "a" * 10_000, 10**400, [1, 2, 3], float("nan")]
    change = rng.randrange(5)
    if change == 0:
        return rng.choice(["", "{", "[" * 100_000, "null", "1", "[]", '"x"', '{"a":' * 50_000, "9" * 100_000])
    if facts and change == 1:
        del facts[rng.choice(list(facts))]
    elif change == 2:
        facts[rng.choice(["more", "t", "__class__", "q"])] = rng.choice(strange)
    elif facts:
        facts[rng.choice(list(facts))] = rng.choice(strange)
    return json.dumps(facts)


def read_npz(path: Path, form: str) -> str:
    """Read a file as what it was, and use it."""
    try:
        if form == "cell":
            task = Task(MAIN, None, "midpoint", 0.01)
            cell = Store(path.parent).load(task) if path.rename(path.with_name(f"{task.name}.npz")) else None
            if cell is None:
                return "refused"
            assert cell.q.shape[1:] == (3,)
            assert np.isscalar(cell.true_cost)
            return "taken"
        if form == "trajectory":
            robot = vp.load_robot("finger") if path.stat().st_size % 2 else None
            motion = vp.Trajectory.load(path, robot)
            _require_finite(motion)
            repr(motion), motion.duration, motion.statistics.split_steps
            if robot is not None:
                vp.linearize(vp.Scene(robot, noise=vp.AdditiveNoise(1e-7)), motion)
            motion.save(path)
            return "taken"
        record = (WorkPrecision if form == "precision" else OptimalControlTradeoff).load(path)
        repr(record), record.pareto(), [run.survived for run in record.runs]
        record.save(path)
        record.to_csv(path.with_suffix(".csv"))
    except vp.VarpinError as error:
        return type(error).__name__
    return "taken"


# -- Workers -----------------------------------------------------------------------------------------------------------


def make(kind: str, number: int, seed: int, corpus: object) -> tuple[str, bytes]:
    """What is read as input ``number``: a format and its bytes."""
    return ("urdf", urdf(number, seed, corpus)) if kind == "urdf" else npz(number, seed, corpus)


def work(kind: str, seed: int, begin: int, end: int) -> None:
    """Read inputs begin .. end and report each on stdout, before it is read and after."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    corpus = urdf_corpus() if kind == "urdf" else npz_corpus()
    report = os.fdopen(os.dup(1), "w", buffering=1)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        # What varpin, Pinocchio and compiled kernels take themselves is no part of an input's memory.
        if kind == "urdf":
            Path("warm.urdf").write_text(corpus[0])
            read_urdf(Path("warm.urdf").resolve())
        else:
            Path("warm.npz").write_bytes(corpus["trajectory"][0])
            read_npz(Path("warm.npz").resolve(), "trajectory")
        own = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (own + MEMORY, own + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in range(begin, end):
            report.write(f"{number}\n")
            form, content = make(kind, number, seed, corpus)
            path = Path(folder, f"input.{'urdf' if kind == 'urdf' else 'npz'}")
            path.write_bytes(content)
            started = time.perf_counter()
            problem = ""
            try:
                outcome = read_urdf(path) if kind == "urdf" else read_npz(path, form)
            except BaseException as error:
                where = traceback.extract_tb(error.__traceback__)[-1]
                outcome, problem = "FINDING", f"{type(error).__name__}: {str(error)[:200]} ({where.name}, {where.line})"
                problem += " <- " + " <- ".join(frame.name for frame in traceback.extract_tb(error.__traceback__)[-5:])
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            if peak > MEMORY and not problem:
                outcome, problem = "FINDING", f"took {peak / 1e6:.0f} MB"
            took = time.perf_counter() - started
            report.write(json.dumps([number, outcome, problem, took, peak]) + "\n")
            for leftover in Path(folder).iterdir():
                leftover.unlink()
            if peak > MEMORY:
                return


@dataclass
class Report:
    """What came out."""

    inputs: int = 0
    outcomes: collections.Counter[str] = field(default_factory=collections.Counter)
    findings: list[tuple[str, int, str]] = field(default_factory=list)
    slowest: float = 0.0
    largest: float = 0.0

    def __str__(self) -> str:
        lines = [f"{self.inputs} inputs, slowest {self.slowest:.2f} s, most memory {self.largest / 1e6:.0f} MB"]
        lines += [f"{count:8d}  {outcome}" for outcome, count in self.outcomes.most_common()]
        lines += [f"FINDING {kind} {number}: {problem}" for kind, number, problem in self.findings]
        return "\n".join(lines)


def run(kind: str, seed: int, begin: int, end: int, folder: Path | None = None, report: Report | None = None) -> Report:
    """Inputs begin .. end of a kind, each in a worker that may die of it."""
    report = Report() if report is None else report
    corpus = None
    while begin < end:
        number, problem, started = begin, "", False
        for line in _watched(kind, seed, begin, end):
            if line is None:
                problem = f"hangs: more than {TIMEOUT:g} s of processor time"
            elif line.startswith("["):
                number, outcome, problem, took, peak = json.loads(line)
                report.inputs += 1
                report.outcomes[outcome] += 1
                report.slowest, report.largest = max(report.slowest, took), max(report.largest, peak)
                if problem:
                    report.findings.append((kind, number, problem))
                begin, problem = number + 1, ""
            elif line.startswith("died"):
                if not started:
                    raise RuntimeError(f"a worker does not get to its first input: {line}")
                problem = line if begin < end else ""
            else:
                number, started = int(line), True
        if problem:
            report.inputs += 1
            report.outcomes["FINDING"] += 1
            report.findings.append((kind, number, problem))
            begin = number + 1
    if folder is not None:
        for kind_of, number, _ in report.findings:
            if kind_of == kind:
                corpus = (urdf_corpus() if kind == "urdf" else npz_corpus()) if corpus is None else corpus
                form, content = make(kind, number, seed, corpus)
                (folder / f"{form}-{seed}-{number}.{'urdf' if kind == 'urdf' else 'npz'}").write_bytes(content)
    return report


def _watched(kind: str, seed: int, begin: int, end: int) -> Iterator[str | None]:
    """The lines of a worker; None where it hangs, and how it died last, if it did."""
    command = [sys.executable, __file__, "--worker", kind, "--seed", str(seed), "--numbers", str(begin), str(end)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as worker:
        assert worker.stdout is not None
        os.set_blocking(worker.stdout.fileno(), False)
        waiting, rest = selectors.DefaultSelector(), b""
        waiting.register(worker.stdout, selectors.EVENT_READ)
        patience = 20.0  # in units of TIMEOUT, until kernels are there
        used, silent = 0.0, time.monotonic()
        while True:
            if not waiting.select(1.0):
                wall, busy = time.monotonic() - silent, _processor_time(worker.pid) - used
                if busy > patience * TIMEOUT or wall > 20.0 * patience * TIMEOUT:
                    worker.kill()
                    yield None
                    return
                continue
            chunk = os.read(worker.stdout.fileno(), 1 << 16)
            if not chunk:
                break
            patience, used, silent = 1.0, _processor_time(worker.pid), time.monotonic()
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                yield line.decode()
        if worker.wait() != 0:
            yield f"died: exit code {worker.returncode}"


def _processor_time(pid: int) -> float:
    """Of a process so far [s]."""
    fields_of = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields_of[11]) + int(fields_of[12])) / os.sysconf("SC_CLK_TCK")


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=2000, help="in all, half of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=KINDS, action="append", help="only this kind")
    parser.add_argument("--findings", type=Path, help="folder for inputs that are findings")
    parser.add_argument("--worker", choices=KINDS, help=argparse.SUPPRESS)
    parser.add_argument("--numbers", type=int, nargs=2, help="only inputs from one number to another")
    options = parser.parse_args()
    if options.worker:
        work(options.worker, options.seed, *options.numbers)
        return 0
    if options.findings:
        options.findings.mkdir(parents=True, exist_ok=True)
    kinds = options.kind or KINDS
    report = Report()
    for kind in kinds:
        begin, end = options.numbers or (0, options.inputs // len(kinds))
        run(kind, options.seed, begin, end, options.findings, report)
    print(report)  # noqa: T201
    return 1 if report.findings else 0


if __name__ == "__main__":
    sys.exit(main())
