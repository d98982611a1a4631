"""Reading URDF files: Pinocchio's parser builds the model; what it drops is read here or reported.

Pinocchio drops what it cannot read (an inertia that is not a number, a joint that closes a loop) with at most a line on
stderr, and returns a robot that differs from the file. It merges links on fixed joints into one body, and it refuses
some useful mimic elements.
"""

import codecs
import contextlib
import logging
import math
import os
import re
import reprlib
import sys
import tempfile
import threading
import xml.etree.ElementTree as ET
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar
from xml.parsers import expat

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from varpin.errors import FileError, RobotError
from varpin.model.meshes import Reader, put_mesh, read_mesh, with_own_meshes

logger = logging.getLogger(__name__)

T = TypeVar("T")

_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")

# Numbers that Python and C++ parse to the same value.
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")

_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
    (codecs.BOM_UTF8, "utf-8-sig"),
)
_DECLARED = re.compile(rb"\s*<\?xml[^>]*?encoding\s*=\s*[\"']([\w.:-]+)[\"']")
_COMMENT = re.compile(r"<!--.*?-->|(<!\[CDATA\[.*?\]\]>)", re.DOTALL)

# Pinocchio's parser is recursive and needs some 2.5 kB of stack a link. Files of more than _DEEP links are parsed in a
# thread with _STACK_OF_LINK bytes of stack a link.
_DEEP, _STACK_OF_LINK = 1000, 10_000

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
        text: URDF text.
        root: The ``<robot>`` element, with prefixes of names as written. None if the text is not well-formed XML, which
            Pinocchio's parser may still read; the next two are then empty.
        inertials: Inertias of the links that have one.
        mimics: Mimic elements by joint.
        remarks: What the file leaves out and how it is read, in words.
        fault: The fault of the XML, in words; empty if there is none.
    """

    path: Path
    text: str = field(repr=False)
    root: ET.Element | None = field(repr=False)
    inertials: tuple[Inertial, ...] = ()
    mimics: Mapping[str, Mimic] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    fault: str = ""

    @property
    def loops(self) -> tuple[tuple[str, str], ...]:
        """The links of each ``<loop_joint>``, which no tree has."""
        ends = [[joint.find(end) for end in ("link1", "link2")] for joint in self.elements("loop_joint")]
        names = [[end.get("link", "") for end in pair if end is not None] for pair in ends]
        return tuple((pair[0], pair[1]) for pair in names if len(pair) == 2 and all(pair))

    def elements(self, tag: str) -> list[ET.Element]:
        """The children of the root with a tag."""
        return [] if self.root is None else self.root.findall(tag)


def read_urdf(path: Path, text: str | None = None) -> Urdf:
    """Read a URDF file.

    XML is read leniently: prefixes need no namespace, and comments may contain ``--``.

    Args:
        path: Path of the file.
        text: The URDF text, if not the file's content.

    Raises:
        FileError: The file cannot be read.
        RobotError: It is not a URDF, its bodies do not form a tree, or a number in a mimic element is invalid.
    """
    text, remarks = decoded(path) if text is None else (text, [])
    if not text.strip("\0 \t\r\n"):
        raise RobotError(f"{path} is not a URDF: it is empty")
    try:
        root = parsed(text)
    except expat.ExpatError as error:
        if text[:200].lower().startswith(("<!doctype html", "<html")):
            raise RobotError(f"{path} is a web page, not a URDF") from None
        return Urdf(path, text, None, remarks=tuple(remarks), fault=f"it is not well-formed XML: {error}")
    _require_robot(root, path)
    _require_tree(root, path)
    found = [_inertial(link, remarks) for link in root.findall("link")]
    mimics = {joint.get("name", ""): _mimic(joint, path) for joint in root.findall("joint[mimic]")}
    return Urdf(path, text, root, tuple(x for x in found if x is not None), mimics, tuple(remarks))


def build_model(urdf: Urdf, *, mimic: bool = False) -> pin.Model:
    """Pinocchio's model of a file; mimic joints are independent unless ``mimic`` is set.

    Raises:
        RobotError: Pinocchio cannot read the file, or drops mass.
    """
    massive = {inertial.link for inertial in urdf.inertials}
    text = urdf.text if urdf.root is None else _written(urdf, _dynamics(urdf.root, massive))
    options = {"mimic": True} if mimic else {}
    with captured_stderr() as complaints:
        try:
            model = _on_a_stack(urdf, lambda: pin.buildModelFromXML(text, **options))
        except (ValueError, RuntimeError, IndexError) as error:
            detail = "; ".join(complaints()) or str(error)
            fault = f": {urdf.fault}" if urdf.fault else f" that Pinocchio can read: {detail}"
            raise RobotError(f"{urdf.path} is not a URDF{fault}") from None
        for line in complaints():
            logger.warning("%s: %s", urdf.path, line)
    described = sum(inertial.mass for inertial in urdf.inertials)
    read = sum(body.mass for body in model.inertias)
    largest = max((abs(inertial.mass) for inertial in urdf.inertials), default=0.0)
    if urdf.root is not None and not math.isclose(described, read, rel_tol=1e-9, abs_tol=1e-9 * largest):
        raise RobotError(
            f"{urdf.path} describes links of {described:.6g} kg in all, of which Pinocchio reads {read:.6g} kg"
        )
    return model


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
    text, looks = urdf.text, dict[str, _Look]()
    if urdf.root is not None:
        root, looks = _looks(urdf.root)
        text = _written(urdf, root)

    with captured_stderr() as complaints:
        try:
            shapes = _on_a_stack(
                urdf, lambda: pin.buildGeomFromUrdfString(model, text, pin.GeometryType.VISUAL, None, [*package_dirs])
            )
        except (ValueError, RuntimeError, IndexError) as error:
            raise RobotError(f"the shapes in {urdf.path} cannot be read: {error}") from None
        for line in complaints():
            logger.warning("%s: %s", urdf.path, line)
    absent = missing_meshes(urdf, package_dirs)
    faults = dict.fromkeys(absent, missing_meshes_message(urdf, absent, package_dirs))
    for shape in shapes.geometryObjects:
        look = looks.get(shape.name, _Look(""))
        if look.texture:
            texture = _located(look.texture, urdf.path, package_dirs)
            if texture is None:
                logger.warning("%s: texture %r is not there", urdf.path, look.texture)
            shape.meshTexturePath = "" if texture is None else str(texture)
        if look.mesh and look.link not in faults:
            scale = [number for word in look.scale.split() if (number := _finite(word))]
            try:
                if len(scale) != len(look.scale.split()) or len(scale) != 3:
                    raise FileError(f"mesh {look.mesh} has the scale {look.scale!r}: give three numbers other than 0")
                put_mesh(shape, str(_located(look.mesh, urdf.path, package_dirs)), scale, read)
            except FileError as error:
                faults[look.link] = f"link {look.link!r}: {error}"
    found = pin.GeometryModel()
    for shape in with_own_meshes(shapes, read).geometryObjects:
        if shape.name not in looks or looks[shape.name].link not in faults:
            found.addGeometryObject(shape)
    return found, faults


def missing_meshes(urdf: Urdf, package_dirs: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The missing visual meshes by link, as the file names them."""
    missing = {}
    for element in urdf.elements("link"):
        files = [mesh.get("filename", "") for mesh in element.iterfind("visual/geometry/mesh")]
        if absent := tuple(file for file in files if _located(file, urdf.path, package_dirs) is None):
            missing[element.get("name", "")] = absent
    return missing


def missing_meshes_message(urdf: Urdf, missing: Mapping[str, Sequence[str]], package_dirs: Sequence[str]) -> str:
    """The error message for meshes from :func:`missing_meshes`."""
    links = "; ".join(f"link {link!r}: {', '.join(files)}" for link, files in missing.items())
    places = ", ".join(_places(package_dirs)) or "no folder"
    return (
        f"meshes of {urdf.path} are missing: {links}; package:// was looked up in {places}, other paths beside the "
        "file; package_dirs=[...] adds folders that contain packages"
    )


def decoded(path: Path) -> tuple[str, list[str]]:
    """A file's text, decoded as the file declares, and remarks about its encoding.

    Raises:
        FileError: The file cannot be read.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from None
    declared = _DECLARED.match(content)
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS if content.startswith(mark)), "")
    remarks = []
    if not encoding:
        encoding = declared[1].decode() if declared else "utf-8"
        try:
            name = codecs.lookup(encoding).name
        except LookupError:
            remarks.append(f"its encoding {encoding!r} is unknown; it is read as utf-8")
            encoding = "utf-8"
        else:
            # A declaration that is readable byte by byte cannot be in UTF-16 or UTF-32.
            encoding = "utf-8" if name.startswith(("utf-16", "utf-32")) else encoding
    try:
        text = content.decode(encoding)
    except (UnicodeError, LookupError) as error:
        remarks.append(f"it is not valid {encoding} ({error}); what cannot be read is replaced by \ufffd")
        text = content.decode("utf-8", errors="replace")
    return text.lstrip("\ufeff \t\r\n"), remarks


def parsed(text: str) -> ET.Element:
    """The root element of an XML text, prefixes kept as they are written.

    Raises:
        ExpatError: The text is not well-formed.
    """
    # Comments are removed: they often contain "--", which XML forbids. Their line breaks stay, for line numbers.
    text = _COMMENT.sub(lambda found: found[1] or "\n" * found[0].count("\n"), text)
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data
    parser.Parse(text, True)
    return builder.close()


def _require_robot(root: ET.Element, path: Path) -> None:
    if root.tag.lower() == "html":
        raise RobotError(f"{path} is a web page, not a URDF")
    if root.tag != "robot":
        raise RobotError(f"{path} is not a URDF: its root element is <{root.tag}>, not <robot>")
    if leftover := _xacro(root):
        name = path.name.removesuffix(".xacro").removesuffix(".urdf")
        raise RobotError(
            f"{path} is a xacro file: expand it first, with xacro {path.name} > {name}.expanded.urdf, "
            f"or name it {name}.xacro; it has {leftover}"
        )
    if not root.get("name"):
        raise RobotError(f"{path}: its <robot> has no name, which a URDF must have")
    if root.find("link") is None:
        raise RobotError(f"{path} describes no link")


def _xacro(root: ET.Element) -> str:
    """The first element or attribute that xacro would replace; empty if there is none."""
    prefixes = {"xacro"} | {key.removeprefix("xmlns:") for key, value in root.items() if "wiki/xacro" in value}
    for element in root.iter():
        prefix, colon, _ = element.tag.partition(":")
        if colon and prefix in prefixes:
            return f"<{element.tag}>"
    for part in root:
        for element in part.iter() if part.tag in ("link", "joint") else ():
            for key, value in element.items():
                if "${" in value or value.startswith("$("):
                    return f"<{element.tag} {key}={value!r}>"
    return ""


def _require_tree(root: ET.Element, path: Path) -> None:
    above: dict[str, tuple[str, str]] = {}
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is None or child is None:
            continue
        name, link = joint.get("name", ""), child.get("link", "")
        if link in above and above[link][1] != name:
            raise RobotError(
                f"{path}: link {link!r} is the child of joints {above[link][1]!r} and {name!r}: "
                "varpin takes trees, no closed loops"
            )
        above[link] = parent.get("link", ""), name
    rooted: set[str] = set()
    for start in above:
        link, way = start, dict[str, None]()
        while link in above and link not in rooted:
            if link in way:
                loop = list(way)[list(way).index(link) :]
                raise RobotError(f"{path}: links {', '.join(map(repr, loop))} form a loop without a root")
            way[link] = None
            link = above[link][0]
        rooted.update(way)


def _inertial(link: ET.Element, remarks: list[str]) -> Inertial | None:
    """Mass and inertia of a link as Pinocchio reads them, or None if it has none.

    A remark is added for each missing or invalid number of the link's ``<inertial>``.
    """
    inertial = link.find("inertial")
    if inertial is None:
        return None
    name = link.get("name", "")
    mass, moments, origin = inertial.find("mass"), inertial.find("inertia"), inertial.find("origin")

    fault, value = "", None if mass is None else _finite(mass.get("value"))
    if mass is None or mass.get("value") is None:
        fault = "its <inertial> has no <mass>"
    elif value is None:
        fault = f"its mass is {reprlib.repr(mass.get('value'))}, no finite number"
    xyz_rpy = np.zeros((2, 3))
    for row, entry in zip(xyz_rpy, ("xyz", "rpy"), strict=True):
        words = ("0 0 0" if origin is None else origin.get(entry, "0 0 0")).split()
        numbers = [number for word in words if (number := _finite(word)) is not None]
        if len(words) == len(numbers) == 3:
            row[:] = numbers
        else:
            given = reprlib.repr(" ".join(words))
            fault = fault or f"the {entry} of its <inertial> is {given}, no three finite numbers"
    if fault or value is None:
        remarks.append(f"link {name!r}: {fault}: it is massless, as Pinocchio reads it")
        return None
    numbers_given = _moments(moments)
    if numbers_given is None:
        absent = [key for key in _MOMENTS if key not in _words(moments)]
        wrong = [f"{key} {reprlib.repr(word)}" for key, word in _words(moments).items() if _finite(word) is None]
        fault = f"no {', '.join(absent)}" if absent else f"{', '.join(wrong)}, no finite number"
        fault = "no <inertia>" if moments is None else fault
        remarks.append(f"link {name!r}: its <inertial> has {fault}: it is a point mass, as Pinocchio reads it")
    xx, xy, xz, yy, yz, zz = numbers_given or np.zeros(6)
    turn = pin.rpy.rpyToMatrix(*xyz_rpy[1])
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    with np.errstate(over="ignore", invalid="ignore"):
        return Inertial(name, value, xyz_rpy[0], turn @ matrix @ turn.T)


def _words(moments: ET.Element | None) -> dict[str, str]:
    """The given moments of an ``<inertia>``, as text."""
    return {} if moments is None else {key: moments.get(key, "") for key in _MOMENTS if moments.get(key) is not None}


def _moments(moments: ET.Element | None) -> list[float] | None:
    """The six numbers of an ``<inertia>``; None, for a point mass, unless all are given and finite."""
    numbers = [number for word in _words(moments).values() if (number := _finite(word)) is not None]
    return numbers if len(numbers) == len(_MOMENTS) else None


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


def _finite(word: str | None) -> float | None:
    """A word as a finite number; None if it is not one."""
    number = float(word) if word is not None and _NUMBER.fullmatch(word.strip()) else math.nan
    return number if math.isfinite(number) else None


def finite_number(word: str, what: str) -> float:
    """A word as a finite number.

    Raises:
        RobotError: It is not one; the message calls it ``what``.
    """
    if (value := _finite(word)) is None:
        raise RobotError(f"{what} is {reprlib.repr(word)}, where a finite number belongs")
    return value


def _dynamics(root: ET.Element, massive: Collection[str]) -> ET.Element:
    """The part of a URDF for Pinocchio's model: joints and links, with the inertias of the links ``massive``."""
    small = ET.Element("robot", {"name": root.get("name", "")})
    for link in root.findall("link"):
        part = ET.SubElement(small, "link", _named(link))
        if link.get("name", "") in massive:
            part.extend(_tidy(inertial) for inertial in link.findall("inertial")[:1])
    small.extend(root.findall("joint"))
    return small


@dataclass(frozen=True)
class _Look:
    """What Pinocchio does not read of a ``<visual>``: names of its mesh and texture, as in the file, or empty."""

    link: str
    texture: str = ""
    mesh: str = ""
    scale: str = "1 1 1"


def _looks(root: ET.Element) -> tuple[ET.Element, dict[str, _Look]]:
    """The part of a URDF for Pinocchio's shapes: joints, and links with their visuals; and the rest by shape.

    Spheres stand for the meshes, as coal's loader misreads some.

    Pinocchio ignores textures and shows a material without a colour in black. Such a material is left out, as is black
    beside a texture, which converters write for want of a colour: the mesh then keeps the colours of its file.
    """
    small = ET.Element("robot", {"name": root.get("name", "")})
    shared = {material.get("name"): material for material in root.findall("material")}
    small.extend(material for material in shared.values() if _has_color(material))
    looks = {}
    for link in root.findall("link"):
        part = ET.SubElement(small, "link", _named(link))
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
            # The name that Pinocchio gives to the shape.
            name = link.get("name", "")
            looks[f"{name}_{k}"] = _Look(
                name,
                "" if texture is None else texture.get("filename", ""),
                "" if mesh is None else mesh.get("filename", ""),
                "1 1 1" if mesh is None else mesh.get("scale", "1 1 1"),
            )
    small.extend(root.findall("joint"))
    return small, looks


def _has_color(material: ET.Element) -> bool:
    color = material.find("color")
    if color is None:
        return False
    return material.find("texture") is None or any(word.strip("0.") for word in color.get("rgba", "").split()[:3])


def _located(name: str, urdf: Path, package_dirs: Sequence[str]) -> Path | None:
    """The path of a file named in a URDF; None if it does not exist."""
    scheme, separator, rest = name.partition("://")
    if not separator:
        paths = [urdf.parent / name, Path(name)]
    elif scheme == "file":
        paths = [Path(rest)]
    else:
        # Gazebo uses model:// for package://.
        paths = [Path(folder, rest) for folder in _places(package_dirs)] if scheme in ("package", "model") else []
    return next((path.absolute() for path in paths if path.is_file()), None)


def _places(package_dirs: Sequence[str]) -> list[str]:
    """Folders in which packages are looked up: ``package_dirs``, then those of a sourced ROS."""
    ros = [folder for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if folder]
    ament = [folder for folder in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if folder]
    return [*package_dirs, *ros, *(f"{folder}/share" for folder in ament)]


def _named(link: ET.Element) -> dict[str, str]:
    return {key: value for key, value in link.items() if key == "name"}


def _tidy(inertial: ET.Element) -> ET.Element:
    """The complete ``<inertial>`` of a massive link, without white space that Pinocchio cannot parse."""
    tidy = ET.Element("inertial")
    mass, moments, origin = inertial.find("mass"), inertial.find("inertia"), inertial.find("origin")
    if origin is not None:
        ET.SubElement(tidy, "origin", {key: " ".join(origin.get(key, "0 0 0").split()) for key in ("xyz", "rpy")})
    ET.SubElement(tidy, "mass", {"value": "" if mass is None else mass.get("value", "").strip()})
    words = {key: word.strip() for key, word in _words(moments).items()}
    ET.SubElement(tidy, "inertia", dict.fromkeys(_MOMENTS, "0") if _moments(moments) is None else words)
    return tidy


def _written(urdf: Urdf, root: ET.Element) -> str:
    try:
        return ET.tostring(root, encoding="unicode")
    except RecursionError:
        raise RobotError(f"{urdf.path} is not a URDF: its elements are nested too deep") from None


def _on_a_stack(urdf: Urdf, read: Callable[[], T]) -> T:
    """What ``read`` returns, run on a stack that is large enough for Pinocchio's recursive parser."""
    links = urdf.text.count("<link")
    if links <= _DEEP:
        return read()
    # This sets the size for all threads that start from now on, until it is restored; a larger one does no harm.
    before = threading.stack_size(max(links * _STACK_OF_LINK // 4096 * 4096, 16 * 2**20))
    try:
        with ThreadPoolExecutor(1) as thread:
            return thread.submit(read).result()
    finally:
        threading.stack_size(before)


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
