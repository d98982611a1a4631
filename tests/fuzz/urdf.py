"""URDF texts: damaged in their elements, attributes and bytes, or of a shape of their own."""

from __future__ import annotations

import copy
import random
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from mechanisms import INERTIAL, joint, link, mimic

import varpin as vp
from fuzz.damage import NUMBERS, WORDS, Case, damaged_bytes, require_finite
from varpin.model import bundled_robots, geometry
from varpin.model.example_robot_data import FIXED_BASE, locate

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


def _robot(*parts: str, base: str = '<link name="base"/>') -> str:
    return f'<?xml version="1.0"?>\n<robot name="made_up">\n{base}\n{"".join(parts)}</robot>\n'


def corpus() -> list[str]:
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
    size = int(10 ** rng.uniform(1.0, 2.7))  # joints beyond some thousand are taken, and take their time
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


def whole(corpus: list[str]) -> Case:
    """A small robot."""
    return Case("urdf", {"input.urdf": corpus[0].encode()})


def make(rng: random.Random, corpus: list[str]) -> Case:
    """A damaged URDF."""
    if rng.random() < 0.02:
        return Case("urdf", {"input.urdf": extreme_urdf(rng)})
    text = rng.choice(corpus)
    if rng.random() < 0.85:
        text = damaged_text(text, rng)
    content = text.encode("utf-8", errors="replace")
    return Case("urdf", {"input.urdf": damaged_bytes(content, rng) if rng.random() < 0.25 else content})


def read(path: Path, form: str) -> str:
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
        require_finite(motion)
    except vp.VarpinError as error:
        return f"taken, then {type(error).__name__}"
    for name, use in (("inspected", vp.inspect_robot), ("drawn", lambda _: geometry(robot))):
        try:
            use(path)
        except vp.VarpinError as error:
            return f"taken, not {name}: {type(error).__name__}"
    return "taken"
