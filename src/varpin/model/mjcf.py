"""Reading MJCF files: the file is rewritten in a form that Pinocchio's parser reads as MuJoCo does.

Pinocchio drops the placement of a body that is fixed to the world, reads only one body of the world, no ``<include>``
and not every default, and makes one joint of several in a body. The rewritten text therefore has includes expanded,
defaults at each element, rotations as quaternions, and one joint a body.
"""

import logging
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from varpin.errors import RobotError
from varpin.model.equalities import Closure, End, Equality, Gear
from varpin.model.urdf import captured_stderr, read_xml

logger = logging.getLogger(__name__)

T = TypeVar("T")

# Elements that generate bodies; they are refused.
_MACROS = {"attach", "composite", "flexcomp", "replicate"}
# A frame is read as a body without joint or mass.
_BODIES = {"body", "frame"}
_IN_FRAMES = {"body", "camera", "frame", "light", "site"}
# Allowed numbers of values of the attributes that the model depends on.
_SIZES = {
    "armature": (1,), "axis": (3,), "density": (1,), "diaginertia": (3,), "frictionloss": (1,), "fromto": (6,),
    "fullinertia": (6,), "mass": (1,), "pos": (3,), "quat": (4,), "range": (2,), "ref": (1,), "size": (1, 2, 3),
    "springdamper": (2,), "xyaxes": (6,), "zaxis": (3,),
}  # fmt: skip
_ROTATIONS = ("quat", "euler", "axisangle", "xyaxes", "zaxis")
# Half the thickness of the plate that shows a plane [m].
_PLATE = 5e-4
# Elements with forces that the model leaves out.
_LEFT_OUT = {"tendon": "tendons", "deformable": "deformable bodies"}


@dataclass(frozen=True, eq=False)
class Mjcf:
    """An MJCF file, read by :func:`read_mjcf`.

    Attributes:
        path: Path of the file.
        dynamics: The MJCF text from which Pinocchio builds the model.
        looks: The MJCF text from which Pinocchio builds the shapes; its mesh paths are absolute.
        remarks: What the model leaves out, in words.
        equalities: Equality constraints as in the file, see :func:`varpin.model.equalities.at_reference`.
    """

    path: Path
    dynamics: str = field(repr=False)
    looks: str = field(repr=False)
    remarks: tuple[str, ...] = ()
    equalities: tuple[Equality, ...] = ()


@dataclass(frozen=True, eq=False)
class _Reader:
    """Settings and defaults of a file, and counts of what is left out."""

    path: Path
    compiler: Mapping[str, str]
    classes: Mapping[str, Mapping[str, Mapping[str, str]]]
    left_out: Counter[str]

    @property
    def angle_unit(self) -> float:
        """The file's unit of angles [rad]."""
        return 1.0 if self.compiler.get("angle") == "radian" else np.pi / 180.0

    def fault(self, what: str) -> RobotError:
        return RobotError(f"{self.path}: {what}")

    def numbers(self, element: ET.Element, key: str, sizes: tuple[int, ...]) -> NDArray[np.float64]:
        try:
            values = np.array([float(word) for word in element.get(key, "").split()])
        except ValueError:
            values = np.array([np.nan])
        if len(values) not in sizes or not np.isfinite(values).all():
            name = element.get("name", "")
            size = " or ".join(map(str, sizes))
            raise self.fault(
                f"<{element.tag}> {name!r}: its {key} must be {size} finite number(s), got {element.get(key)!r}"
            )
        return values

    def resolved(self, element: ET.Element, childclass: str) -> ET.Element:
        """A copy of an element without its children, with its defaults."""
        name = element.get("class", childclass)
        if name not in self.classes:
            raise self.fault(f"<{element.tag}> {element.get('name', '')!r}: there is no default class {name!r}")
        attributes = self.turned(element)
        given = self.classes[name].get(element.tag, {})
        if any(key in attributes for key in _ROTATIONS):
            given = {key: value for key, value in given.items() if key not in _ROTATIONS}
        return ET.Element(element.tag, {**given, **attributes})

    def look(self, geom: ET.Element, childclass: str) -> list[ET.Element]:
        """A geom as :meth:`resolved`; a bounded plane becomes a thin plate, as coal's planes are infinite."""
        plain = self.resolved(geom, childclass)
        if plain.get("type") != "plane":
            return [plain]
        x, y, *_ = (*self.numbers(plain, "size", (1, 2, 3)), 0.0) if "size" in plain.attrib else (0.0, 0.0)
        if not (x > 0.0 and y > 0.0):
            logger.info("%s: plane %r is infinite; it is not drawn", self.path, plain.get("name", ""))
            return []
        plain.attrib |= {"type": "box", "size": f"{float(x)!r} {float(y)!r} {_PLATE!r}"}
        return [plain]

    def turned(self, element: ET.Element) -> dict[str, str]:
        """The attributes of an element, with its rotation in a form that Pinocchio reads as MuJoCo does."""
        attributes = {key: value for key, value in element.items() if key not in ("class", "childclass")}
        for key in attributes:
            if element.tag in ("body", "frame", "geom", "inertial", "joint") and key in _SIZES:
                self.numbers(element, key, _SIZES[key])
        unit = self.angle_unit
        if "axisangle" in attributes:
            *axis, angle = self.numbers(element, "axisangle", (4,))
            length = np.linalg.norm(axis)
            if length == 0.0:
                raise self.fault(f"<{element.tag}> {element.get('name', '')!r}: the axis of its axisangle is 0")
            del attributes["axisangle"]
            attributes["quat"] = _quaternion(pin.AngleAxis(unit * angle, np.array(axis) / length).matrix())
        elif "euler" in attributes:
            sequence = self.compiler.get("eulerseq", "xyz")
            if len(sequence) != 3 or set(sequence.lower()) - set("xyz"):
                raise self.fault(f"eulerseq must be three of x, y and z, got {sequence!r}")
            rotation = np.eye(3)
            for letter, angle in zip(sequence, self.numbers(element, "euler", (3,)), strict=True):
                turn = pin.AngleAxis(unit * angle, np.eye(3)["xyz".index(letter.lower())]).matrix()
                rotation = rotation @ turn if letter.islower() else turn @ rotation
            del attributes["euler"]
            attributes["quat"] = _quaternion(rotation)
        return attributes


def is_mjcf(path: Path) -> bool:
    """Whether a file is an MJCF by its root element; only ``.xml`` and ``.mjcf`` files are opened."""
    return path.suffix in (".xml", ".mjcf") and root_tag(path) == "mujoco"


def root_tag(path: Path) -> str:
    """Tag of the root element of a file; empty if the file is not well-formed XML.

    Raises:
        FileError: The file cannot be read.
    """
    try:
        return read_xml(path)[0].tag
    except RobotError:
        return ""


def read_mjcf(path: Path) -> Mjcf:
    """Read an MJCF file.

    Raises:
        FileError: The file, or an included one, cannot be read.
        RobotError: It is not an MJCF, or has elements that Pinocchio cannot read.
    """
    root = _included(path, path.parent, ())
    compiler = {key: value for part in root.findall("compiler") for key, value in part.items()}
    reader = _Reader(path, compiler, {}, Counter())
    reader = _Reader(path, compiler, _classes(root, reader), reader.left_out)
    if "settotalmass" in compiler:
        raise reader.fault("its masses are scaled by settotalmass, which Pinocchio does not read")
    if compiler.get("coordinate", "local") == "global":
        raise reader.fault(
            "its places are in world axes (coordinate='global'), which MuJoCo has not read since 2.3.4, nor does "
            "Pinocchio: MuJoCo 2.3.3 writes it with places in each body's own axes"
        )
    reader.left_out["least masses and inertias"] += int(bool({"boundmass", "boundinertia"} & set(compiler)))
    reader.left_out["balancing of inertias"] += int(compiler.get("balanceinertia") == "true")
    for part in root.iter():
        if part.tag in _MACROS:
            raise reader.fault(f"it has <{part.tag}>, which Pinocchio does not read: write its bodies out")
        other = [child.tag for child in part if part.tag == "frame" and child.tag not in _IN_FRAMES]
        if other:
            raise reader.fault(f"it has a <{other[0]}> in a <frame>: varpin reads those around bodies and sites")
    for option in root.findall("option"):
        fluid = [reader.numbers(option, key, (1,)) for key in ("density", "viscosity") if key in option.attrib]
        reader.left_out["forces of a fluid"] += int(np.any(fluid))
    for tag, what in _LEFT_OUT.items():
        reader.left_out[what] += sum(len(part) for part in root.findall(tag))
    equalities = _equalities(root, reader)
    texts = []
    try:
        for dynamics in (True, False):
            plain = ET.Element("mujoco", {"model": root.get("model", path.stem)})
            ET.SubElement(plain, "compiler", {"angle": "radian", "autolimits": compiler.get("autolimits", "true")})
            if not dynamics:
                plain.append(_assets(root, reader))
            world = ET.SubElement(plain, "worldbody")
            # Pinocchio takes the first body of <worldbody> for the world and ignores the others.
            stand = ET.SubElement(world, "body", {"name": "world"})
            for part in root.iterfind("worldbody/*"):
                if part.tag in _BODIES:
                    stand.append(_body(part, "main", reader, moving=False, dynamics=dynamics))
                elif part.tag == "site":
                    # Pinocchio drops sites of the world itself.
                    around = ET.SubElement(stand, "body", {"name": f"world:{part.get('name', '')}"})
                    around.append(reader.resolved(part, "main"))
                elif part.tag == "geom" and not dynamics:
                    stand.extend(reader.look(part, "main"))
            keys = ET.SubElement(plain, "keyframe")
            keys.extend(part for part in root.iterfind("keyframe/key") if part.get("qpos") and part.get("name"))
            texts.append(ET.tostring(plain, encoding="unicode"))
    except RecursionError:
        raise reader.fault("its bodies are nested too deep") from None
    found = [f"{what} ({count})" for what, count in reader.left_out.items() if count]
    remarks = (f"{path} has {', '.join(found)}, which the model leaves out",) if found else ()
    return Mjcf(path, texts[0], texts[1], remarks, equalities)


def build_mjcf_model(path: Path, text: str) -> pin.Model:
    """Pinocchio's model of a file.

    Args:
        path: Path of the file.
        text: ``dynamics`` or ``looks`` of :class:`Mjcf`: their joints are the same, their masses are not.

    Raises:
        RobotError: Pinocchio cannot read it.
    """
    return _read(path, text, pin.buildModelFromMJCF)


def build_mjcf_shapes(path: Path, looks: str, model: pin.Model) -> pin.GeometryModel:
    """The visual geometry of a file, as Pinocchio reads it.

    Args:
        path: Path of the file.
        looks: As in :class:`Mjcf`.
        model: From :func:`build_mjcf_model`.

    Raises:
        RobotError: A mesh is missing or cannot be read; the message names it.
    """
    root, _ = read_xml(path, looks)
    files = {part.get("name", ""): part.get("file", "") for part in root.iterfind("asset/mesh")}
    absent = {name: file for name, file in files.items() if file and not Path(file).is_file()}
    lacking = {
        body.get("name", ""): ", ".join(absent[mesh] for geom in geoms if (mesh := geom.get("mesh", "")) in absent)
        for body in root.iter("body")
        if (geoms := body.findall("geom"))
    }
    if links := "; ".join(f"link {name!r}: {what}" for name, what in lacking.items() if what):
        raise RobotError(f"meshes of {path} are missing: {links}")
    return _read(path, looks, lambda file: pin.buildGeomFromMJCF(model, file, pin.GeometryType.VISUAL))


def _read(path: Path, text: str, read: Callable[[str], T]) -> T:
    """What Pinocchio's parser ``read``, which takes the path of a file, returns for a text."""
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder, "plain.xml")
        plain.write_text(text, encoding="utf-8")
        with captured_stderr() as complaints:
            try:
                result = read(str(plain))
            except (ValueError, RuntimeError, IndexError) as error:
                detail = "; ".join(complaints()) or " ".join(str(error).rpartition("message:")[2].split())
                raise RobotError(f"Pinocchio cannot read the MJCF file {path}: {detail}") from None
            for line in complaints():
                logger.warning("%s: %s", path, line)
    return result


def _included(path: Path, folder: Path, above: tuple[Path, ...]) -> ET.Element:
    """The root element of a file, with its includes expanded."""
    if path in above:
        raise RobotError(f"{path} includes itself")
    root, _ = read_xml(path)
    if root.tag not in ("mujoco", "mujocoinclude"):
        raise RobotError(f"{path} is not an MJCF: its root element is <{root.tag}>, not <mujoco>")
    for parent in root.iter():
        parts = list(parent)
        for index in reversed([k for k, part in enumerate(parts) if part.tag == "include"]):
            file = folder / parts[index].get("file", "")
            parent[index : index + 1] = list(_included(file, folder, (*above, path)))
    return root


def _classes(root: ET.Element, reader: _Reader) -> dict[str, dict[str, dict[str, str]]]:
    """The attributes of each default class by tag, including those of its enclosing classes."""
    classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}

    def read(element: ET.Element, name: str, around: Mapping[str, Mapping[str, str]]) -> None:
        defaults = {tag: dict(values) for tag, values in around.items()}
        for part in element:
            if part.tag != "default":
                defaults.setdefault(part.tag, {}).update(reader.turned(part))
        classes[name] = defaults
        for part in element.findall("default"):
            read(part, part.get("class", ""), defaults)

    for top in root.findall("default"):
        read(top, "main", classes["main"])
        classes[top.get("class", "main")] = classes["main"]
    return classes


def _equalities(root: ET.Element, reader: _Reader) -> tuple[Equality, ...]:
    """The active equality constraints of bodies, sites, joints and pairs of joints; the others count as left out."""
    found: list[Equality] = []
    for part in root.iterfind("equality/*"):
        # Defaults are those of <equality>, whatever the kind.
        plain = reader.resolved(ET.Element("equality", part.attrib), "main")
        if plain.get("active") == "false":
            reader.left_out["inactive equality constraints"] += 1
        elif part.tag in ("connect", "weld"):
            found.append(_closure(part, reader))
        elif part.tag == "tendon" and (gear := _gear_of_tendon(part, root, reader)) is not None:
            found.append(gear)
        elif part.tag == "joint":
            c = reader.numbers(part, "polycoef", (1, 2, 3, 4, 5)) if "polycoef" in part.attrib else np.array([0.0, 1.0])
            # Left-out coefficients have their defaults, as in MuJoCo.
            c = np.concatenate([c, np.array([0.0, 1.0, 0.0, 0.0, 0.0])[len(c) :]])
            leader = part.get("joint2")
            kept = c if leader else c[:1]
            name, joint = _named(part, part.get("joint1", "")), part.get("joint1", "")
            found.append(Gear(name, joint, leader, tuple(np.trim_zeros(kept, "b").tolist()) or (0.0,)))
        else:
            reader.left_out[f"equality constraints of kind {part.tag}"] += 1
    return tuple(found)


def _gear_of_tendon(part: ET.Element, root: ET.Element, reader: _Reader) -> Gear | None:
    """The tie of two joints by a ``<fixed>`` tendon of constant length; None for other tendons."""
    name = part.get("tendon1", "")
    tendon = next((each for each in root.iterfind("tendon/fixed") if each.get("name") == name), None)
    if part.get("tendon2") or tendon is None:
        return None
    parts = [(each.get("joint", ""), float(reader.numbers(each, "coef", (1,))[0])) for each in tendon]
    if len(parts) != 2 or not all(weight for _, weight in parts):
        return None
    offset = reader.numbers(part, "polycoef", (1, 2, 3, 4, 5))[0] if "polycoef" in part.attrib else 0.0
    (joint, weight), (leader, other) = parts
    return Gear(_named(part, name), joint, leader, (float(offset) / weight, -other / weight))


def _closure(part: ET.Element, reader: _Reader) -> Closure:
    """A ``<connect>`` or a ``<weld>``."""
    weld = part.tag == "weld"
    turns = weld and ("torquescale" not in part.attrib or bool(reader.numbers(part, "torquescale", (1,)).any()))
    if {"site1", "site2"} & set(part.attrib):
        a, b = (End(part.get(key, ""), "site", pin.SE3.Identity()) for key in ("site1", "site2"))
        return Closure(_named(part, a.frame), a, b, turns)
    first, second = part.get("body1", ""), part.get("body2") or "world"
    name = _named(part, first)
    anchor = pin.SE3.Identity()
    if "anchor" in part.attrib or not weld:
        anchor.translation = reader.numbers(part, "anchor", (3,))
    if not weld:
        return Closure(name, End(first, "body", anchor), End(second, "body", None), turns)
    given = reader.numbers(part, "relpose", (7,)) if "relpose" in part.attrib else np.zeros(7)
    place = None
    if given[3:].any():
        w, x, y, z = given[3:] / np.linalg.norm(given[3:])
        place = pin.SE3(pin.Quaternion(w, x, y, z).matrix(), given[:3])
    return Closure(name, End(first, "body", place), End(second, "body", anchor), turns)


def _named(part: ET.Element, of: str) -> str:
    """An equality constraint in words: its name, or the body, site or joint that comes first."""
    return f"<{part.tag}> {part.get('name', of)!r}"


def _assets(root: ET.Element, reader: _Reader) -> ET.Element:
    assets = ET.Element("asset")
    folders = {
        tag: reader.path.parent / reader.compiler.get(key, reader.compiler.get("assetdir", ""))
        for tag, key in (("mesh", "meshdir"), ("texture", "texturedir"))
    }
    for part in root.iterfind("asset/*"):
        if part.tag in ("mesh", "texture", "material"):
            plain = reader.resolved(part, "main")
            if plain.get("file"):
                plain.set("name", plain.get("name", Path(plain.get("file", "")).stem))
                plain.set("file", str(folders[part.tag] / plain.get("file", "")))
            assets.append(plain)
    return assets


def _body(body: ET.Element, childclass: str, reader: _Reader, *, moving: bool, dynamics: bool) -> ET.Element:
    """A body in rewritten form. Several joints become a chain of bodies, the last of which is the body itself."""
    childclass = body.get("childclass", childclass)
    whole = reader.turned(body)
    if dynamics and "gravcomp" in whole and reader.numbers(body, "gravcomp", (1,)).any():
        reader.left_out["gravity compensation"] += 1
    name = whole.pop("name", "")
    top = last = ET.Element("body", whole)
    joints = [_joint(part, childclass, reader, dynamics) for part in body if part.tag in ("joint", "freejoint")]
    for k, joint in enumerate(joints):
        last.append(joint)
        if k < len(joints) - 1:
            last.set("name", f"{name}:{joint.get('name', k)}")
            last = ET.SubElement(last, "body")
    if name:
        last.set("name", name)
    moving = moving or bool(joints)
    # Lists: `extend` turns an error in a generator into a TypeError.
    last.extend([reader.resolved(part, childclass) for part in body.findall("site")])
    if not dynamics:
        last.extend([look for part in body.findall("geom") for look in reader.look(part, childclass)])
    elif moving:
        last.extend(_masses(body, name, childclass, reader))
    parts = [part for part in body if part.tag in _BODIES]
    last.extend([_body(part, childclass, reader, moving=moving, dynamics=dynamics) for part in parts])
    return top


def _joint(joint: ET.Element, childclass: str, reader: _Reader, dynamics: bool) -> ET.Element:
    plain = reader.resolved(joint, childclass)
    if plain.get("limited") == "false":
        plain.attrib.pop("range", None)
    # Pinocchio takes the range of a slide joint for degrees, too, and subtracts `ref` from every range.
    unit = 1.0 if plain.get("type") == "slide" else reader.angle_unit
    ref = np.zeros(1)
    if "ref" in plain.attrib:
        ref = unit * reader.numbers(plain, "ref", (1,))
        plain.set("ref", repr(float(ref[0])))
    if "range" in plain.attrib:
        numbers = unit * reader.numbers(plain, "range", (2,)) + ref
        plain.set("range", " ".join(repr(float(number)) for number in numbers))
    # Linear coefficients; from MuJoCo 4 on also those of higher powers.
    stiffness, damping = (
        reader.numbers(plain, key, (1, 2, 3)) if key in plain.attrib else np.zeros(1)
        for key in ("stiffness", "damping")
    )
    plain.set("damping", repr(float(damping[0])))
    if dynamics:
        given = "springdamper" in plain.attrib and (reader.numbers(plain, "springdamper", (2,)) > 0.0).all()
        reader.left_out["springs and dampers by their time constant"] += int(given)
        reader.left_out["joint springs"] += int(stiffness.any())
        reader.left_out["nonlinear joint dampers"] += int(damping[1:].any())
    return plain


def _masses(body: ET.Element, name: str, childclass: str, reader: _Reader) -> list[ET.Element]:
    """The inertia of a moving body, or the shapes from which it is computed."""
    inertial, from_shapes = body.find("inertial"), reader.compiler.get("inertiafromgeom", "auto")
    lowest, highest = reader.numbers(
        ET.Element("compiler", {"inertiagrouprange": "0 5", **reader.compiler}), "inertiagrouprange", (2,)
    )
    geoms = [reader.resolved(geom, childclass) for geom in body.findall("geom")]
    for plain in geoms:
        plain.attrib = {"density": "1000", "group": "0", **plain.attrib}
    geoms = [plain for plain in geoms if lowest <= reader.numbers(plain, "group", (1,)) <= highest]
    if inertial is not None and not (from_shapes == "true" and geoms):
        if "mass" not in inertial.attrib or not {"diaginertia", "fullinertia"} & set(inertial.attrib):
            raise reader.fault(f"body {name!r}: its <inertial> has no mass, or neither diaginertia nor fullinertia")
        return [ET.Element("inertial", reader.turned(inertial))]
    shapes = []
    for plain in geoms if from_shapes != "false" else ():
        if reader.numbers(plain, "mass" if "mass" in plain.attrib else "density", (1,)) == 0.0:
            continue
        if plain.get("mesh") or plain.get("type") in ("mesh", "sdf", "hfield"):
            raise reader.fault(
                f"body {name!r} has no <inertial>, and Pinocchio computes the mass of a mesh differently from MuJoCo: "
                "give it an <inertial>, from body_mass, body_ipos, body_iquat and body_inertia of MuJoCo"
            )
        if plain.get("shellinertia") == "true":
            raise reader.fault(f"body {name!r}: its mass is on the surface of a shape, which Pinocchio does not read")
        # Pinocchio gives no mass to a shape that collides with nothing.
        for key in ("contype", "conaffinity"):
            plain.attrib.pop(key, None)
        shapes.append(plain)
    return shapes


def _quaternion(rotation: NDArray[np.float64]) -> str:
    """(w, x, y, z) of a rotation matrix, as text."""
    q = pin.Quaternion(rotation)
    return " ".join(map(repr, (float(q.w), float(q.x), float(q.y), float(q.z))))
