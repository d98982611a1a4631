"""URDF files of robots whose masses, dampers or dry friction are others than those in the file they were read from."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from xml.parsers import expat

import numpy as np
import pinocchio as pin

from varpin.errors import InputError
from varpin.io.archive import atomic_file
from varpin.model.inertia import fault, principal_moments
from varpin.model.packages import Packages
from varpin.model.robot import Robot, require_robot
from varpin.model.urdf import COMMENT, Inertial, read_urdf
from varpin.support.checks import JointValues, joint_array, writable

# A body that differs from its links by this share of its largest number is the file's: rounding is some 1e-16 a link.
_ROUNDING = 1e-13


def save_urdf(
    robot: Robot,
    path: str | os.PathLike[str],
    damping: JointValues | None = None,
    friction: JointValues | None = None,
) -> Path:
    """Write a robot's URDF file with the masses and inertias that its bodies have now; all else stays as it is.

    :func:`varpin.load_robot` reads the same robot from it with the same ``lock``, ``keep``, ``mimic`` and ``base``;
    payloads and inertias of meshes are in the file. Where several links are one body, the link of the joint takes the
    difference, or all where no rigid body has the difference. Paths of meshes that lead elsewhere from the new file
    become ``file://`` paths.

    Args:
        robot: A robot from a URDF or xacro file.
        path: The file, which ends in .urdf.
        damping: Viscous damping [N m s/rad or N s/m]: a number for all joints, (n,), or by name; joints that are not
            named keep the file's. Followers of a joint with one have none.
        friction: Dry friction [N m or N], likewise.

    Returns:
        The path.

    Raises:
        InputError: The robot comes from no URDF, ``path`` does not end in .urdf, a damping or friction is negative or
            of a joint that the file does not have, or a body has no mass or no link.
        UnknownJoint: There is no such joint.
        FileError: The file cannot be written.
    """
    target, source = writable(path), require_robot(robot).urdf
    if source is None:
        raise InputError(f"robot {robot.name!r} does not come from one URDF file, which save_urdf writes anew")
    if target.suffix.lower() != ".urdf":
        raise InputError(f"path must end in .urdf, got {target.name!r}")
    file = _whole(source.read_bytes() if robot.expanded is None else robot.expanded.encode())
    links, joints = (
        {part.get("name", "").strip(): part for part in file.iterfind(f"robot/{tag}")} for tag in ("link", "joint")
    )
    for link, body in _changed(robot, read_urdf(source, robot.expanded).inertials):
        _put_inertial(links[link], body)
    for kind, given in (("damping", damping), ("friction", friction)):
        if given is not None:
            _put_dynamics(robot, joints, kind, given)
    for part in (part for tag in ("mesh", "texture") for part in file.iter(tag)):
        name = part.get("filename", "").strip()
        there = Packages(source, robot.package_dirs).locate(name)
        here = Packages(target, (str(target.parent),)).locate(name)
        if there and not (here and here.samefile(there)):
            part.set("filename", f"file://{there.resolve()}")
    with atomic_file(target) as stream:
        parts = "\n".join(ET.tostring(part, "unicode").rstrip() for part in file)
        stream.write(f'<?xml version="1.0" encoding="utf-8"?>\n{parts}\n'.encode())
    return target


def _whole(content: bytes) -> ET.Element:
    """All of a file that :func:`varpin.model.urdf.read_xml` takes, with texts and comments, under one element."""

    def legal(found: re.Match[bytes]) -> bytes:
        # XML forbids hyphens side by side in a comment.
        return found[1] or b"<!--" + re.sub(rb"-(?=-|$)", b"- ", found[0][4:-3]) + b"-->"

    builder, parser = ET.TreeBuilder(insert_comments=True), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler, parser.CommentHandler = builder.data, builder.comment
    builder.start("file", {})
    parser.Parse(COMMENT.sub(legal, content.lstrip(b" \t\r\n")), True)
    builder.end("file")
    return builder.close()


def _changed(robot: Robot, inertials: Sequence[Inertial]) -> Iterator[tuple[str, pin.Inertia | None]]:
    """The links whose inertia, in their frame, is another one than the file's; None for none at all."""
    given = {each.link: pin.Inertia(each.mass, each.center, each.inertia) for each in inertials}
    bodies = [frame for frame in robot.model.frames if frame.type == pin.FrameType.BODY]
    for joint, inertia in list(enumerate(robot.model.inertias))[1:]:
        links = [frame for frame in bodies if frame.parentJoint == joint]
        own = [(frame.name, frame.placement.act(given[frame.name])) for frame in links if frame.name in given]
        whole, parts = np.array(inertia.toDynamicParameters()), {name: x.toDynamicParameters() for name, x in own}
        if np.abs(whole - sum(parts.values())).max() <= _ROUNDING * np.abs(whole).max():
            continue
        if not (links and np.isfinite(whole).all() and whole[0]):
            raise InputError(f"the body of joint {robot.model.names[joint]!r} has no finite mass or no link")
        parts.pop(links[0].name, None)
        rest = pin.Inertia.FromDynamicParameters(whole - sum(parts.values()))
        if parts and (not rest.mass > 0.0 or fault("", rest.mass, principal_moments(np.array(rest.inertia)))[1]):
            rest = inertia
            yield from ((name, None) for name in parts)
        yield links[0].name, links[0].placement.actInv(rest)


def _put_inertial(link: ET.Element, body: pin.Inertia | None) -> None:
    for old in link.findall("inertial"):
        link.remove(old)
    if body is not None:
        inertial, moments = ET.Element("inertial"), np.array(body.inertia).tolist()
        ET.SubElement(inertial, "origin", xyz=" ".join(map(repr, body.lever.tolist())), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=repr(float(body.mass)))
        upper = ((a, b) for a in range(3) for b in range(a, 3))
        ET.SubElement(inertial, "inertia", {f"i{'xyz'[a]}{'xyz'[b]}": repr(moments[a][b]) for a, b in upper})
        ET.indent(inertial, level=2)
        _put_first(link, inertial)


def _put_first(parent: ET.Element, part: ET.Element) -> None:
    """Put an element before all others, indented as they are."""
    part.tail = parent.text
    parent.insert(0, part)


def _put_dynamics(robot: Robot, joints: Mapping[str, ET.Element], kind: str, given: JointValues) -> None:
    values = joint_array(kind, given, robot.joint_names, uniform=True).tolist()
    named, names = dict(zip(robot.joint_names, values, strict=True)), robot.model.names
    if isinstance(given, Mapping):
        named = {name: named[name] for name in given}
    named |= {names[tie.follower]: 0.0 for tie in robot.ties if names[tie.leader] in named}
    for name, value in named.items():
        if value < 0.0 or (value and name not in joints):
            allowed = "it must be >= 0" if name in joints else "the URDF has no such joint, which can have none"
            raise InputError(f"{kind} of joint {name!r} is {value:g}: {allowed}")
        if name in joints:
            if (found := joints[name].find("dynamics")) is None:
                _put_first(joints[name], found := ET.Element("dynamics"))
            found.set(kind, repr(value))
