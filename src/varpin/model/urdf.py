"""URDF files: Pinocchio's parser builds the model, and its complaints tell what it leaves out or refuses.

The file is parsed here as well, for what Pinocchio has no word for: mimic elements, loops, textures, the limits that
exporters write for "none". Everything else, with the version of URDF that it depends on, is Pinocchio's reading.
"""

from __future__ import annotations

import contextlib
import copy
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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from varpin.errors import FileError, RobotError
from varpin.model.meshes import Reader, put_mesh, read_mesh
from varpin.model.packages import Packages, content
from varpin.model.units import NO_LIMIT, typed_in_degrees
from varpin.support.frozen import Frozen

logger = logging.getLogger(__name__)

# A bound in words that Pinocchio reads and :class:`varpin.Robot` takes as none.
_NONE = "1e308"
_WORDS = ("", "none", "nan")  # by which files say so

# Longest text of Pinocchio's own in a message.
_COMPLAINT = 150

COMMENT = re.compile(rb"<!--.*?-->|(<!\[CDATA\[.*?\]\]>)", re.DOTALL)

# One thread at a time redirects the stderr of the process.
_STDERR = threading.Lock()


@dataclass(frozen=True, eq=False)
class Inertial(Frozen):
    """Mass and inertia of a link, as Pinocchio reads them."""

    link: str
    mass: float  # [kg]
    center: NDArray[np.float64]  # centre of mass (3,) in the link's frame [m]
    inertia: NDArray[np.float64]  # (3, 3) about the centre of mass, in the link's axes [kg m^2]


@dataclass(frozen=True, eq=False)
class Urdf:
    """A URDF file, read by :func:`read_urdf`."""

    path: Path
    root: ET.Element = field(repr=False)  # with prefixes of names as written
    model: pin.Model = field(repr=False)  # in which mimic joints are independent
    inertials: tuple[Inertial, ...] = field(repr=False)  # of the links that have one
    faults: tuple[str, ...]  # what Pinocchio leaves out of links and joints, in words
    remarks: tuple[str, ...]  # how the file is read where that is not plain, one sentence a kind
    notes: tuple[str, ...]  # what of the file has no effect on purpose, likewise

    @property
    def loops(self) -> tuple[tuple[str, str], ...]:
        """The links of each ``<loop_joint>``, which no tree has."""
        ends = [[joint.find(end) for end in ("link1", "link2")] for joint in self.root.findall("loop_joint")]
        names = [[end.get("link", "") for end in pair if end is not None] for pair in ends]
        return tuple((pair[0], pair[1]) for pair in names if len(pair) == 2 and all(pair))


def read_urdf(path: Path, text: str | None = None) -> Urdf:
    """Read a URDF file, or its text if that is another one.

    As for Pinocchio, prefixes need no namespace, and comments may contain ``--``; the rest of the file must be XML.
    """
    root = read_xml(path, text, "URDF")
    parent: dict[str, str] = {}
    for joint in root.findall("joint[child]"):
        link, name = joint.findall("child")[0].get("link", ""), joint.get("name", "")
        if parent.setdefault(link, name) != name:
            raise RobotError(
                f"{path}: link {link!r} is the child of joints {parent[link]!r} and {name!r}: "
                "varpin takes trees, no closed loops"
            )
    remarks = tuple(_remarks(root))
    soft = _joints_with(root, "safety_controller")
    notes = (f"soft limits of <safety_controller> have no effect: {listed(soft, 'joints')}",) if soft else ()
    model, inertials, complaint = _model(root, path)
    faults = (f"Pinocchio reads links in part: {complaint}",) if complaint else ()
    return Urdf(path, root, model, inertials, faults, remarks, notes)


def _model(root: ET.Element, path: Path) -> tuple[pin.Model, tuple[Inertial, ...], str]:
    """Pinocchio's model of a file, the inertias of its links, and Pinocchio's complaints."""
    small = ET.Element("robot", _head(root))
    for part in root.iterfind("*"):
        if part.tag in ("link", "joint"):
            kept = ET.SubElement(small, part.tag, part.attrib)
            kept.extend(part if part.tag == "joint" else part.findall("inertial"))
    model, complaint = _built(small)
    expand = "${" in complaint or "$(" in complaint or (model is None and bool(_xacro(root)))
    complaint = textwrap.shorten(complaint, _COMPLAINT)
    if re.search(r"\d,\d", complaint):
        complaint += " (the decimal sign is a point)"
    if expand:
        name = path.name.removesuffix(".xacro").removesuffix(".urdf")
        raise RobotError(f"{path} is a xacro file, to be expanded: name it {name}.urdf.xacro ({complaint})")
    if model is None:
        if root.find("link") is None:
            complaint += " (it has no links: of a file of xacro macros, load the one that calls them)"
        raise RobotError(f"{path} is not a URDF: {complaint}")
    bodies = {frame.name for frame in model.frames if frame.type == pin.FrameType.BODY}
    if lost := [repr(link.get("name")) for link in root.findall("link") if link.get("name") not in bodies]:
        raise RobotError(f"{path}: links {listed(lost, 'links')} are on a loop of joints without a root")
    # Pinocchio merges links on fixed joints into one body: with joints that move, each link is one. Of fixed joints it
    # reads no axes.
    for joint in small.iterfind("joint[@type='fixed']"):
        joint.set("type", "continuous")
        joint[:] = [part for part in joint if part.tag != "axis"]
    apart = _built(small)[0]
    given = {link.get("name", "") for link in root.findall("link[inertial]")}
    found = []
    for frame in apart.frames:
        body = apart.inertias[frame.parentJoint]
        if frame.type == pin.FrameType.BODY and frame.name in given and (body.mass or body.inertia.any()):
            found.append(Inertial(frame.name, body.mass, np.array(body.lever), np.array(body.inertia)))
    return model, tuple(found), complaint


def _built(root: ET.Element) -> tuple[Any, str]:
    """Pinocchio's model of a URDF, None if it has none, and its complaints."""
    with captured_stderr() as complaints:
        try:
            return pin.buildModelFromXML(ET.tostring(root, encoding="unicode")), "; ".join(complaints())
        except (ValueError, RuntimeError, IndexError) as error:
            return None, "; ".join(complaints()) or str(error)


def build_shapes(
    urdf: Urdf, package_dirs: Sequence[str], read: Reader = read_mesh
) -> tuple[pin.GeometryModel, dict[str, str]]:
    """The visual geometry in a file, as Pinocchio reads it, except for meshes.

    Returns:
        The shapes of the links whose meshes can all be read, and the fault of each other link in words.
    """
    root, looks = _looks(urdf.root)
    text = ET.tostring(root, encoding="unicode")
    with captured_stderr() as complaints:
        try:
            shapes = pin.buildGeomFromUrdfString(urdf.model, text, pin.GeometryType.VISUAL)
        except (ValueError, RuntimeError, IndexError) as error:
            raise RobotError(f"the shapes in {urdf.path} cannot be read: {error}") from None
        lines = complaints()
    if lines:
        logger.warning("%s: shapes are read in part: %s", urdf.path, textwrap.shorten("; ".join(lines), _COMPLAINT))
    packages = Packages(urdf.path, tuple(package_dirs))
    faults: dict[str, str] = {}
    missing: dict[str, list[str]] = {}
    for shape in shapes.geometryObjects:
        link, mesh, texture = looks.get(shape.name, ("", None, ""))
        if texture:
            image = packages.locate(texture)
            if image is None:
                logger.warning("%s: texture %r is not there", urdf.path, texture)
            shape.meshTexturePath = "" if image is None else str(image)
        if mesh is None:
            continue
        file, words = mesh.get("filename", ""), mesh.get("scale", "1 1 1")
        if path := packages.locate(file):
            scale = [_number(word) for word in words.split()]
            try:
                if len(scale) != 3 or not all(math.isfinite(number) and number for number in scale):
                    raise FileError(f"mesh {file} has the scale {words!r}: give three numbers other than 0")
                put_mesh(shape, str(path), scale, read)
            except FileError as error:
                faults[link] = f"link {link!r}: {error}"
        else:
            missing.setdefault(link, []).append(file)
    if missing:
        links = listed((f"link {link!r}: {', '.join(files)}" for link, files in missing.items()), "links")
        places = ", ".join(map(str, packages.places)) or "no folder"
        advice = f"looked beside the file and in {places} (package_dirs=[...] adds)"
        if there := packages.in_other_case(next(iter(missing.values()))[0]):
            advice = f"{there} is there, in other upper and lower case"
        faults |= dict.fromkeys(missing, f"meshes of {urdf.path} are missing: {links}; {advice}")
    found = pin.GeometryModel()
    for shape in shapes.geometryObjects:
        if shape.name not in looks or looks[shape.name][0] not in faults:
            found.addGeometryObject(shape)
    return found, faults


def read_xml(path: Path, text: str | None = None, kind: str = "") -> ET.Element:
    """The elements of an XML file without texts, prefixes as written; the root of a URDF or an SRDF is ``<robot>``."""
    data = (content(path) if text is None else text.encode()).lstrip(b" \t\r\n")
    # Comments often contain "--", which XML forbids. Their line breaks stay, for line numbers.
    data = COMMENT.sub(lambda found: found[1] or b"\n" * found[0].count(b"\n"), data)
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler = lambda tag, has: builder.start(tag, {key: text.strip() for key, text in has.items()})
    parser.EndElementHandler = builder.end
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, LookupError) as error:
        raise RobotError(f"{path} is {f'not well-formed XML: {error}' if data else 'empty'}") from None
    root = builder.close()
    if kind and root.tag != "robot":
        raise RobotError(f"{path} is not a {kind}: its root element is <{root.tag}>, not <robot>")
    return root


def _xacro(root: ET.Element) -> dict[str, None]:
    """The kinds of xacro elements in a file."""
    prefixes = {"xacro"} | {key.removeprefix("xmlns:") for key, value in root.items() if "wiki/xacro" in value}
    return dict.fromkeys(f"<{part.tag}>" for part in root.iter() if part.tag.partition(":")[0] in prefixes)


def _remarks(root: ET.Element) -> Iterator[str]:
    """How limits and elements without effect are read, one sentence a kind; limits that mean none are replaced.

    Two bounds of 0 are none as well, as a URDF before version 1.2 without bounds is read.
    """
    if left := _xacro(root):
        yield f"leftover xacro elements have no effect: {listed(left, 'kinds')}"
    stated, none, degrees, ignored = root.get("version") == "1.2", [], [], []
    for joint in root.findall("joint"):
        name, kind, limit = repr(joint.get("name", "")), joint.get("type"), joint.find("limit")
        if limit is None and kind in ("revolute", "prismatic"):
            limit = ET.SubElement(joint, "limit")
        if limit is None:
            continue
        low, high = (_number(limit.get(key)) for key in ("lower", "upper"))
        if kind == "continuous" and low < high and high - low < NO_LIMIT:
            ignored.append(name)
        if kind == "revolute" and typed_in_degrees(np.array([low, high])).any():
            degrees.append(f"{low:g} to {high:g} of {name}")
        bounded, minus_one = bool({"lower", "upper"} & set(limit.keys())), low == high == -1.0
        for key in ("lower", "upper", "effort", "velocity"):
            word, drive = limit.get(key), key in ("effort", "velocity")
            if word is None and (stated if drive else bounded or not stated):
                continue
            value = _number(word)
            means_none = word is None or word.lower() in _WORDS or math.isinf(value)
            means_none |= value < 0.0 if drive else minus_one
            if means_none:
                limit.set(key, f"-{_NONE}" if key == "lower" else _NONE)
            if kind != "fixed" and (means_none or (not drive and abs(value) > NO_LIMIT)):
                none.append(f"no {key} of {name}" if word is None else f"{key} {word} of {name}")
    if degrees:
        yield f"limits look like degrees, and URDF has radians: {listed(degrees, 'joints')}"
    if ignored:
        yield f"limits of continuous joints have no effect (type revolute has limits): {listed(ignored, 'joints')}"
    if none:
        yield f"limits that are missing, infinite, negative or huge count as none: {listed(none, 'limits')}"
    if named := _joints_with(root, "joint_properties"):
        yield f"<joint_properties> has no effect, URDF calls it <dynamics>: {listed(named, 'joints')}"


def _joints_with(root: ET.Element, tag: str) -> list[str]:
    return [repr(joint.get("name", "")) for joint in root.findall(f"joint[{tag}]")]


def _number(word: str | None) -> float:
    """A word as a number; NaN if it is none."""
    try:
        return float(word or "nan")
    except ValueError:
        return math.nan


def finite_number(word: str, what: str) -> float:
    """A word as a finite number."""
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
    small.extend(filter(_has_color, shared.values()))
    looks = {}
    for link in root.findall("link"):
        name = link.get("name", "")
        part = ET.SubElement(small, "link", name=name)
        part.extend(copy.deepcopy(link.findall("visual")))
        for k, visual in enumerate(part):
            material, mesh, texture = visual.find("material"), visual.find("geometry/mesh"), None
            if material is not None:
                meant = material if len(material) else shared.get(material.get("name"), material)
                texture = meant.find("texture")
                if not _has_color(meant):
                    visual.remove(material)
            if mesh is not None:
                visual.findall("geometry")[0][:] = [ET.Element("sphere", radius="1")]
            looks[f"{name}_{k}"] = name, mesh, "" if texture is None else texture.get("filename", "")
    small.extend(root.findall("joint"))
    return small, looks


def _has_color(material: ET.Element) -> bool:
    color = material.find("color")
    if color is None:
        return False
    return material.find("texture") is None or any(word.strip("0.") for word in color.get("rgba", "").split()[:3])


def _head(root: ET.Element) -> dict[str, str]:
    return {key: root.get(key, "") for key in ("name", "version") if key in root.attrib}


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
