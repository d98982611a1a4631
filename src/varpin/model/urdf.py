"""Reading URDF files: Pinocchio's parser builds the model; what it leaves out of a file or refuses is told here.

The file is parsed here as well, for what Pinocchio has no word for: mimic elements, loops, textures, the limits that
exporters write for "none". Everything else, with the version of URDF that it depends on, is Pinocchio's reading.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import re
import reprlib
import sys
import tempfile
import textwrap
import threading
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from varpin.errors import FileError, RobotError
from varpin.model.meshes import Reader, put_mesh, read_mesh
from varpin.model.packages import LFS_POINTER, Packages
from varpin.model.units import NO_LIMIT, limits_in_degrees

logger = logging.getLogger(__name__)

VERSIONS = ("1.0", "1.1", "1.2")  # of URDF, which Pinocchio reads
# Most links one after another: its parser ends the process on chains of about 4,000.
_LONGEST = 3000

# A link with less than this share of the mass of all links on its joint is massless, but for rounding.
_ROUNDING = 1e-12

# The attributes of a URDF that hold numbers, by element.
_NUMBERS = {
    "origin": ("xyz", "rpy", "quat_xyzw"),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction"),
}
# Those of shapes and of mimic joints.
_SIZES, _MIMIC = ("size", "radius", "length", "scale"), ("multiplier", "offset")
_COUNTS = {"xyz": 3, "rpy": 3, "quat_xyzw": 4}

# A bound in words that Pinocchio reads and :class:`varpin.Robot` takes as none.
_NONE = "1e308"
_WORDS = ("", "none", "nan")  # by which files say so

_COMMENT = re.compile(rb"<!--.*?-->|(<!\[CDATA\[.*?\]\]>)", re.DOTALL)

# One thread at a time redirects the stderr of the process.
_STDERR = threading.Lock()


@dataclass(frozen=True)
class Mimic:
    """A mimic element: the joint is at ratio * (position of joint ``leader``) + offset."""

    leader: str
    ratio: float
    offset: float


@dataclass(frozen=True, eq=False)
class Inertial:
    """Mass and inertia of a link, as Pinocchio reads them.

    Attributes:
        link: Name of the link.
        mass: Mass [kg].
        center: Centre of mass (3,) in the link's frame [m].
        inertia: Inertia (3, 3) about the centre of mass, in the link's axes [kg m^2].
    """

    link: str
    mass: float
    center: NDArray[np.float64]
    inertia: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Urdf:
    """A URDF file, read by :func:`read_urdf`.

    Attributes:
        path: Path of the file.
        root: The ``<robot>`` element, with prefixes of names as written.
        mimics: Mimic elements by joint.
        remarks: How the file is read where that is not plain, one sentence a kind.
        unlimited: A sentence about limits that are read as none; empty if there are none.
        notes: What of the file has no effect on purpose, likewise.
        plain: Whether nothing in it was tidied or mended: Pinocchio's own reading is varpin's.
    """

    path: Path
    root: ET.Element = field(repr=False)
    mimics: Mapping[str, Mimic]
    remarks: tuple[str, ...]
    notes: tuple[str, ...]
    plain: bool
    unlimited: str = ""

    @property
    def loops(self) -> tuple[tuple[str, str], ...]:
        """The links of each ``<loop_joint>``, which no tree has."""
        ends = [[joint.find(end) for end in ("link1", "link2")] for joint in self.root.findall("loop_joint")]
        names = [[end.get("link", "") for end in pair if end is not None] for pair in ends]
        return tuple((pair[0], pair[1]) for pair in names if len(pair) == 2 and all(pair))


def read_urdf(path: Path, text: str | None = None) -> Urdf:
    """Read a URDF file.

    XML is read leniently: prefixes need no namespace, and comments may contain ``--``.

    Args:
        path: Path of the file.
        text: The URDF text, if not the file's content.

    Raises:
        FileError: The file cannot be read.
        RobotError: It is not a URDF, a link is the child of two joints, or a number in a mimic element is invalid.
    """
    root, fault = read_xml(path, text)
    if root.tag != "robot":
        raise RobotError(f"{path} is not a URDF: its root element is <{root.tag}>, not <robot>")
    _require_expanded(root, path)
    if not root.get("name"):
        raise RobotError(f"{path} is not a URDF: its <robot> has no name")
    if root.find("link") is None:
        raise RobotError(
            f"{path} is not a URDF: it describes no link" + ("; it has xacro to expand" * bool(_xacro(root)))
        )
    if root.get("version", "1.0") not in VERSIONS:
        raise RobotError(
            f"{path}: there is no URDF version {root.get('version')!r}; Pinocchio reads {', '.join(VERSIONS)}"
        )
    parent: dict[str, str] = {}
    for joint in root.findall("joint"):
        child, name = joint.find("child"), joint.get("name", "")
        link = "" if child is None else child.get("link", "")
        if link and parent.setdefault(link, name) != name:
            raise RobotError(
                f"{path}: link {link!r} is the child of joints {parent[link]!r} and {name!r}: "
                "varpin takes trees, no closed loops"
            )
    if (length := _longest_chain(root)) > _LONGEST:
        raise RobotError(f"{path} has {length} links one after another, and varpin reads {_LONGEST} at most")
    tidied = False
    for element in (part for tag in ("link/inertial", "joint") for found in root.iterfind(tag) for part in found):
        for key in _NUMBERS.get(element.tag, ()):
            if (words := element.get(key)) is not None and (tidy := " ".join(words.split())) != words:
                element.set(key, tidy)
                tidied = True
    remarks = [*([f"its XML is not well-formed, and was mended: {fault}"] if fault else []), *_remarks(root)]
    unlimited = _unlimited(root)
    mimics = {joint.get("name", ""): _mimic(joint, path) for joint in root.findall("joint[mimic]")}
    soft = _joints_with(root, "safety_controller")
    notes = (f"soft limits of <safety_controller> have no effect: {listed(soft, 'joints')}",) if soft else ()
    return Urdf(path, root, mimics, tuple(remarks), notes, not (tidied or remarks or unlimited), unlimited)


def build_model(urdf: Urdf) -> pin.Model:
    """Pinocchio's model of a file; mimic joints are independent.

    Raises:
        RobotError: Pinocchio cannot read the file, or leaves links out.
    """
    model = _build(_part(urdf.root, "link/inertial", "joint"))
    if isinstance(model, str):
        why = next(_faults(urdf.root), f"Pinocchio cannot read it: {textwrap.shorten(model, 120)}")
        raise RobotError(f"{urdf.path} is not a URDF: {why}")
    return _require_all_links(urdf, model)


def _require_all_links(urdf: Urdf, model: pin.Model) -> pin.Model:
    bodies = {frame.name for frame in model.frames if frame.type == pin.FrameType.BODY}
    links = [link.get("name", "") for link in urdf.root.findall("link")]
    if lost := [repr(link) for link in links if link not in bodies]:
        raise RobotError(f"{urdf.path}: links {listed(lost, 'links')} are on a loop of joints without a root")
    return model


def read_inertials(urdf: Urdf, model: pin.Model) -> tuple[tuple[Inertial, ...], tuple[str, ...]]:
    """The inertias of the links that have one, as Pinocchio reads them, and remarks about those it reads in part."""
    given = {link.get("name", ""): link for link in urdf.root.findall("link") if link.find("inertial") is not None}
    # Pinocchio merges links on fixed joints into one body, whose parts are in the frames of these joints.
    fixed = [frame for frame in model.frames if frame.type == pin.FrameType.FIXED_JOINT and frame.inertia.mass]
    found, remarks = [], []
    for frame in (frame for frame in model.frames if frame.type == pin.FrameType.BODY and frame.name in given):
        name, link, up = frame.name, given[frame.name], model.frames[frame.parentFrame]
        body = up.inertia if up.inertia.mass else frame.inertia
        if up.type == pin.FrameType.JOINT:
            body = model.inertias[frame.parentJoint]
            if parts := [part for part in fixed if part.parentJoint == frame.parentJoint]:
                body = _without(body, [part.placement.act(part.inertia) for part in parts])
        if fault := next(_faults_of_numbers(link.findall("inertial")[0], required=True), ""):
            effect = "massless" if body.mass == 0.0 else "a point mass"
            remarks.append(f"link {name!r} is {effect}, as Pinocchio reads it: {fault}")
        if body.mass or body.inertia.any():
            found.append(Inertial(name, body.mass, np.array(body.lever), np.array(body.inertia)))
    more = f" (and {len(remarks) - 1} more)" if len(remarks) > 1 else ""
    return tuple(found), tuple(remark + more for remark in remarks[:1])


def _without(body: pin.Inertia, parts: Sequence[pin.Inertia]) -> pin.Inertia:
    """A body without some of its parts; zero if they leave rounding errors alone."""
    rest = body.toDynamicParameters() - sum(part.toDynamicParameters() for part in parts)
    return pin.Inertia.FromDynamicParameters(rest) if rest[0] > _ROUNDING * body.mass else pin.Inertia.Zero()


def compared_model(urdf: Urdf, text: str | None) -> tuple[pin.Model, tuple[str, ...]]:
    """Pinocchio's model of a file, and where it is not what Pinocchio reads from the file as it is, if it reads that.

    Args:
        urdf: The file.
        text: The URDF text, if not the file's content.

    Raises:
        RobotError: As for :func:`build_model`.
    """
    try:
        with captured_stderr():
            own = pin.buildModelFromUrdf(str(urdf.path)) if text is None else pin.buildModelFromXML(text)
        theirs = list(own.names)[1:]
    except (ValueError, RuntimeError, IndexError):
        return build_model(urdf), ()
    # Pinocchio's parser knows no entities.
    if urdf.plain and b"<!ENTITY" not in (urdf.path.read_bytes() if text is None else text.encode()):
        return _require_all_links(urdf, own), ()
    model = build_model(urdf)
    if own == model:
        return model, ()
    if theirs != list(model.names)[1:]:
        return model, (f"Pinocchio's own reading of the file has other joints: {listed(theirs, 'joints')}",)
    odd = [
        repr(name)
        for j, name in enumerate(model.names)
        if model.inertias[j] != own.inertias[j] or model.jointPlacements[j] != own.jointPlacements[j]
    ]
    if urdf.unlimited and not odd:
        return model, ()
    what = f"in the masses or places of {listed(odd, 'joints')}" if odd else "in limits or frames"
    return model, (f"Pinocchio's own reading of the file differs {what}: it reads numbers less leniently",)


def build_shapes(
    urdf: Urdf, model: pin.Model, package_dirs: Sequence[str], read: Reader = read_mesh
) -> tuple[pin.GeometryModel, dict[str, str]]:
    """The visual geometry in a file, as Pinocchio reads it, except for meshes.

    Args:
        urdf: The file.
        model: From :func:`build_model`.
        package_dirs: Folders in which ``package://`` paths are looked up.
        read: Reads a mesh file.

    Returns:
        The shapes of the links whose meshes can all be read, and the fault of each other link in words.

    Raises:
        RobotError: A shape is no shape; the message names the file.
    """
    root, looks = _looks(urdf.root)
    text = ET.tostring(root, encoding="unicode")
    with captured_stderr() as complaints:
        try:
            shapes = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.VISUAL, None, [*package_dirs])
        except (ValueError, RuntimeError, IndexError) as error:
            raise RobotError(f"the shapes in {urdf.path} cannot be read: {error}") from None
        lines = complaints()
    if lines:
        logger.warning("%s: shapes are read in part: %s", urdf.path, "; ".join(lines)[:120])
    packages = Packages(urdf.path, tuple(package_dirs))
    faults = _missing_meshes(urdf, packages)
    for shape in shapes.geometryObjects:
        link, mesh, texture = looks.get(shape.name, ("", None, ""))
        if texture:
            image = packages.locate(texture)
            if image is None:
                logger.warning("%s: texture %r is not there", urdf.path, texture)
            shape.meshTexturePath = "" if image is None else str(image)
        if mesh is not None and link not in faults:
            file, words = mesh.get("filename", ""), mesh.get("scale", "1 1 1")
            scale = [_number(word) for word in words.split()]
            try:
                if len(scale) != 3 or not all(math.isfinite(number) and number for number in scale):
                    raise FileError(f"mesh {file} has the scale {words!r}: give three numbers other than 0")
                put_mesh(shape, str(packages.locate(file)), scale, read)
            except FileError as error:
                faults[link] = f"link {link!r}: {error}"
    found = pin.GeometryModel()
    for shape in shapes.geometryObjects:
        if shape.name not in looks or looks[shape.name][0] not in faults:
            found.addGeometryObject(shape)
    return found, faults


def _missing_meshes(urdf: Urdf, packages: Packages) -> dict[str, str]:
    """The links whose visual meshes are missing, each with the message about all of them."""
    missing: dict[str, list[str]] = {}
    for link in urdf.root.findall("link"):
        for mesh in link.iterfind("visual/geometry/mesh"):
            if packages.locate(file := mesh.get("filename", "")) is None:
                missing.setdefault(link.get("name", ""), []).append(file)
    if not missing:
        return {}
    links = listed((f"link {link!r}: {', '.join(files)}" for link, files in missing.items()), "links")
    message = f"meshes of {urdf.path} are missing: {links}; "
    if there := packages.in_other_case(next(iter(missing.values()))[0]):
        return dict.fromkeys(missing, f"{message}{there} is there, in other upper and lower case")
    places = ", ".join(map(str, packages.places)) or "no folder"
    return dict.fromkeys(missing, f"{message}looked beside the file and in {places} (package_dirs=[...] adds)")


def _mended(content: bytes) -> str:
    """Text of a file that expat cannot decode, as UTF-8, without its declaration and what follows the root element."""
    text = content.decode("utf-8", errors="replace").lstrip("\ufeff \t\r\n")
    text = re.sub(r"^<\?xml.*?\?>", "", text, flags=re.DOTALL)
    text = re.sub(r"&(?!#?\w+;)", "&amp;", text)
    return text[: text.rfind("</robot>") + len("</robot>")] if "</robot>" in text else text


def read_xml(path: Path, text: str | None = None) -> tuple[ET.Element, str]:
    """The root element of an XML file, with prefixes as written, and the fault that was mended; empty if none was.

    Args:
        path: Path of the file.
        text: The XML text, if not the file's content.

    Raises:
        FileError: The file cannot be read.
        RobotError: It is not well-formed XML.
    """
    try:
        content = path.read_bytes() if text is None else text.encode()
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from None
    if not content.strip(b"\0 \t\r\n"):
        raise RobotError(f"{path} is empty")
    if content.startswith(LFS_POINTER):
        raise RobotError(f"{path} is a Git LFS pointer, not the file itself: git lfs pull downloads it")
    # Comments often contain "--", which XML forbids. Their line breaks stay, for line numbers.
    content = _COMMENT.sub(lambda found: found[1] or b"\n" * found[0].count(b"\n"), content.lstrip(b" \t\r\n"))
    try:
        return _tree(content), ""
    except (expat.ExpatError, LookupError) as error:
        fault = str(error)
    if content[:200].lower().startswith((b"<!doctype html", b"<html")):
        raise RobotError(f"{path} is a web page, not a robot's file")
    try:
        return _tree(_mended(content)), fault
    except expat.ExpatError:
        raise RobotError(f"{path} is not well-formed XML: {fault}") from None


def _tree(content: bytes | str) -> ET.Element:
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data
    parser.Parse(content, True)
    return builder.close()


def _longest_chain(root: ET.Element) -> int:
    """The largest number of links one after another."""
    ends = ([joint.find(tag) for tag in ("parent", "child")] for joint in root.findall("joint"))
    up = {child.get("link"): parent.get("link") for parent, child in ends if parent is not None and child is not None}
    depth: dict[str | None, int] = {}
    for first in up:
        way: list[str | None] = []
        link = first
        while link in up and link not in depth and len(way) <= len(up):
            way.append(link)
            link = up[link]
        for own in reversed(way):
            depth[own] = depth.get(up[own], 1) + 1
    return max(depth.values(), default=1)


def _require_expanded(root: ET.Element, path: Path) -> None:
    """Refuse a xacro file that was not expanded: a value that xacro has to fill in is missing."""
    for element in (part for tag in ("link", "joint") for found in root.iterfind(tag) for part in found.iter()):
        for key, value in element.items():
            numbers = (*_NUMBERS.get(element.tag, ()), *_SIZES, *_MIMIC)
            if key in numbers and ("${" in value or value.startswith("$(")):
                name = path.name.removesuffix(".xacro").removesuffix(".urdf")
                raise RobotError(
                    f"{path} is a xacro file, to be expanded: it has <{element.tag} {key}={value!r}>. Name it "
                    f"{name}.urdf.xacro, or expand it with xacro {path.name} > {name}.expanded.urdf"
                )


def _xacro(root: ET.Element) -> dict[str, None]:
    """The kinds of xacro elements in a file."""
    prefixes = {"xacro"} | {key.removeprefix("xmlns:") for key, value in root.items() if "wiki/xacro" in value}
    return dict.fromkeys(f"<{part.tag}>" for part in root.iter() if part.tag.partition(":")[0] in prefixes)


def _unlimited(root: ET.Element) -> str:
    """Replace the limits by which exporters mean none; returns a sentence about them, empty if there are none.

    Two bounds of 0 are none as well, as a URDF before version 1.2 without bounds is read.
    """
    stated, told = root.get("version") == "1.2", []
    for joint in root.findall("joint"):
        name, limit = joint.get("name", ""), joint.find("limit")
        if limit is None and joint.get("type") in ("revolute", "prismatic"):
            limit = ET.SubElement(joint, "limit")
        if limit is None:
            continue
        bounded = bool({"lower", "upper"} & set(limit.keys()))
        minus_one = _number(limit.get("lower")) == _number(limit.get("upper")) == -1.0
        for key in ("lower", "upper", "effort", "velocity"):
            word, drive = limit.get(key), key in ("effort", "velocity")
            if word is None and (stated if drive else bounded or not stated):
                continue
            value = _number(word)
            none = word is None or word.strip().lower() in _WORDS or math.isinf(value)
            none |= value < 0.0 if drive else minus_one
            if joint.get("type") != "fixed" and (none or (not drive and abs(value) > NO_LIMIT)):
                told.append(f"no {key} of {name!r}" if word is None else f"{key} {word} of {name!r}")
            if none:
                limit.set(key, f"-{_NONE}" if key == "lower" else _NONE)
    what = "limits that are missing, infinite, negative or huge count as none"
    return f"{what}: {listed(told, 'limits')}" if told else ""


def _remarks(root: ET.Element) -> Iterator[str]:
    """How limits and elements without effect are read, one sentence a kind."""
    left = _xacro(root)
    left |= {
        f"<{part.tag} {key}={value!r}>": None
        for part in root.iter()
        for key, value in part.items()
        if key != "filename" and ("${" in value or value.startswith("$(")) and part.tag not in left
    }
    if left:
        yield f"leftover xacro elements have no effect: {listed(left, 'kinds')}"
    degrees, ignored = [], []
    for joint in root.findall("joint[limit]"):
        name, kind, limit = repr(joint.get("name", "")), joint.get("type"), joint.findall("limit")[0]
        low, high = (_number(limit.get(key)) for key in ("lower", "upper"))
        if kind == "continuous" and low < high and high - low < NO_LIMIT:
            ignored.append(name)
        if kind == "revolute" and limits_in_degrees(low, high):
            degrees.append(f"{low:g} to {high:g} of {name}")
    if degrees:
        yield f"limits look like degrees, and URDF has radians: {listed(degrees, 'joints')}"
    if ignored:
        yield f"limits of continuous joints have no effect (type revolute has limits): {listed(ignored, 'joints')}"
    if named := _joints_with(root, "joint_properties"):
        yield f"<joint_properties> has no effect, URDF calls it <dynamics>: {listed(named, 'joints')}"


def _joints_with(root: ET.Element, tag: str) -> list[str]:
    return [repr(joint.get("name", "")) for joint in root.findall("joint") if joint.find(tag) is not None]


def _faults(root: ET.Element) -> Iterator[str]:
    """What Pinocchio cannot read in links and joints."""
    for joint in root.findall("joint"):
        for fault in _faults_of_numbers(joint):
            yield f"joint {joint.get('name')!r}: {fault}"
        for tag in ("parent", "child"):
            end = joint.find(tag)
            link = None if end is None else end.get("link")
            if link not in [known.get("name") for known in root.findall("link")]:
                yield f"joint {joint.get('name')!r} has the {tag} {link!r}, which is no link of the file"


def _faults_of_numbers(parent: ET.Element, *, required: bool = False) -> Iterator[str]:
    """The numbers in an ``<inertial>`` or ``<joint>`` that Pinocchio cannot read.

    Args:
        parent: The element.
        required: Whether mass and moments have to be there.
    """
    for tag, keys in _NUMBERS.items():
        element = parent.find(tag)
        needed = required and tag in ("mass", "inertia")
        if element is None and needed:
            yield f"its <inertial> has no <{tag}>"
        if element is None:
            continue
        for key in keys:
            words = element.get(key, "").split()
            if key in element.attrib and not (
                len(words) == _COUNTS.get(key, 1) and all(math.isfinite(_number(word)) for word in words)
            ):
                comma = "; the decimal sign is a point" if "," in element.attrib[key] else ""
                numbers = "no finite number" if key not in _COUNTS else f"not {_COUNTS[key]} finite numbers"
                yield f"{key} of <{tag}> is {reprlib.repr(element.attrib[key])}, {numbers}{comma}"
            elif key not in element.attrib and needed:
                yield f"<{tag}> of its <inertial> has no {key}"


def _mimic(joint: ET.Element, path: Path) -> Mimic:
    element = joint.find("mimic")
    assert element is not None
    where = f"{path}: joint {joint.get('name')!r}: its mimic"
    if not element.get("joint"):
        raise RobotError(f"{where} element names no joint")
    return Mimic(
        element.get("joint", ""),
        finite_number(element.get("multiplier", "1"), f"{where} multiplier"),
        finite_number(element.get("offset", "0"), f"{where} offset"),
    )


def _number(word: str | None) -> float:
    """A word as a number, as Python and C++ read it alike; NaN if it is none."""
    # Python also takes digits of other scripts, and underscores.
    if word is None or not word.isascii() or "_" in word:
        return math.nan
    try:
        return float(word)
    except ValueError:
        return math.nan


def finite_number(word: str, what: str) -> float:
    """A word as a finite number.

    Raises:
        RobotError: It is not one; the message calls it ``what``.
    """
    if not math.isfinite(value := _number(word)):
        raise RobotError(f"{what} is {reprlib.repr(word)}, where a finite number belongs")
    return value


def listed(names: Iterable[str], what: str) -> str:
    """Some names; of more than four the first three, and how many more there are."""
    names = list(names)
    return ", ".join(names[:3]) + f" and {len(names) - 3} more {what}" if len(names) > 4 else ", ".join(names)


def _looks(root: ET.Element) -> tuple[ET.Element, dict[str, tuple[str, ET.Element | None, str]]]:
    """The part of a URDF for Pinocchio's shapes: joints, and links with their visuals; and what it does not read.

    That is for each shape, by the name that Pinocchio gives it, its link, its mesh and the file of its texture, or "".

    Spheres stand for the meshes, as coal's loader misreads some.

    Pinocchio ignores textures and shows a material without a colour in black. Such a material is left out, as is black
    beside a texture, which converters write for want of a colour: the mesh then keeps the colours of its file.
    """
    small = ET.Element("robot", _head(root))
    shared = {material.get("name"): material for material in root.findall("material")}
    small.extend(material for material in shared.values() if _has_color(material))
    looks = {}
    for link in root.findall("link"):
        part = ET.SubElement(small, "link", {"name": link.get("name", "")})
        for k, visual in enumerate(link.findall("visual")):
            declared, mesh = visual.find("material"), visual.find("geometry/mesh")
            material = declared if declared is None or len(declared) else shared.get(declared.get("name"), declared)
            texture = None if material is None else material.find("texture")
            plain = ET.SubElement(part, "visual", visual.attrib)
            for child in visual:
                if child is declared and not (material is not None and _has_color(material)):
                    continue
                if child.tag == "geometry" and mesh is not None:
                    ET.SubElement(ET.SubElement(plain, "geometry"), "sphere", radius="1")
                else:
                    plain.append(child)
            image = "" if texture is None else texture.get("filename", "")
            looks[f"{link.get('name', '')}_{k}"] = link.get("name", ""), mesh, image
    small.extend(root.findall("joint"))
    return small, looks


def _has_color(material: ET.Element) -> bool:
    color = material.find("color")
    if color is None:
        return False
    return material.find("texture") is None or any(word.strip("0.") for word in color.get("rgba", "").split()[:3])


def _head(root: ET.Element) -> dict[str, str]:
    return {key: root.get(key, "") for key in ("name", "version") if key in root.attrib}


def _part(root: ET.Element, *paths: str) -> ET.Element:
    """A URDF of the links and joints of another, with the children at ``paths`` or, without a child, all of them."""
    small = ET.Element("robot", _head(root))
    for part in root:
        if part.tag in ("link", "joint"):
            copied = ET.SubElement(small, part.tag, part.attrib)
            copied.extend(child for child in part if {part.tag, f"{part.tag}/{child.tag}"} & set(paths))
    return small


def _build(root: ET.Element) -> pin.Model | str:
    """Pinocchio's model of a URDF, or what it says of it if it cannot read it."""
    with captured_stderr() as complaints:
        try:
            return pin.buildModelFromXML(ET.tostring(root, encoding="unicode"))
        except (ValueError, RuntimeError, IndexError) as error:
            return "; ".join(complaints()) or str(error)


@contextlib.contextmanager
def captured_stderr() -> Iterator[Callable[[], list[str]]]:
    """Capture what Pinocchio's C++ parser writes to stderr; yields a function that returns the messages."""
    with _STDERR, tempfile.TemporaryFile() as sink:
        sys.stderr.flush()
        saved = os.dup(2)
        os.dup2(sink.fileno(), 2)

        def messages() -> list[str]:
            sink.seek(0)
            lines = [line.strip() for line in sink.read().decode(errors="replace").splitlines()]
            # The parser follows each message by a line with its place in the C++ source.
            return [line.removeprefix("Error:").strip() for line in lines if line and not line.startswith("at line ")]

        try:
            yield messages
        finally:
            os.dup2(saved, 2)
            os.close(saved)
