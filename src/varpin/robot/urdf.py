"""Reading a URDF file, and saying in words what is wrong with it.

Pinocchio's parser drops what it cannot read (an inertia that is not a number, a joint that closes a loop) with at
most a line on stderr, and goes on with another robot than the file describes.
"""

import contextlib
import logging
import math
import os
import re
import reprlib
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pinocchio as pin

from varpin.errors import FileError, RobotError

logger = logging.getLogger(__name__)

_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")

# What is read. Pinocchio's parser goes down a tree by recursion and ends the process some 3500 links deep, and its data
# of a robot of n joints take 64 n^3 bytes: a gigabyte at the limit.
MAX_BYTES = 10_000_000
MAX_LINKS = 10_000
MAX_DEPTH = 1000
MAX_JOINTS = 256
# Elements within elements; a URDF has half a dozen.
_NESTED = 100

# The numbers that Python and C++ read alike.
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class Mimic:
    """A mimic element: the joint stands at ratio * (position of joint ``leader``) + offset."""

    leader: str
    ratio: float
    offset: float


def read_urdf(path: Path) -> tuple[pin.Model, dict[str, Mimic]]:
    """The model of a URDF file with every joint on its own, and its mimic elements by joint.

    Raises:
        FileError: The file cannot be read.
        RobotError: It is not a URDF, or not one of a tree of bodies with finite masses and inertias.
    """
    root = read_root(path)
    _check_tree(root, path)
    for link in root.findall("link"):
        _check_inertial(link, path)
    mimics = {joint.get("name", ""): _mimic(joint, path) for joint in root.findall("joint[mimic]")}
    with _captured_stderr() as complaints:
        try:
            # From what was checked, not from the file: the two XML parsers do not agree on everything.
            model = pin.buildModelFromXML(ET.tostring(root, encoding="unicode"))
        except (ValueError, RuntimeError, IndexError) as error:
            detail = "; ".join(complaints()) or str(error)
            raise RobotError(f"{path} is not a URDF that Pinocchio can read: {detail}") from None
        for line in complaints():
            logger.warning("%s: %s", path, line)
    described = sum(float(mass.get("value", "0")) for mass in root.findall("link/inertial[1]/mass[1]"))
    read = sum(body.mass for body in model.inertias)
    if not math.isclose(described, read, rel_tol=1e-9):
        raise RobotError(f"{path} describes links of {described:.6g} kg in all, of which Pinocchio reads {read:.6g} kg")
    return model, mimics


def read_root(path: Path) -> ET.Element:
    """The <robot> element of a URDF file, expanded and within the limits on its size.

    Raises:
        FileError: The file cannot be read.
        RobotError: It is too large, or not the XML of a URDF.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from None
    if len(content) > MAX_BYTES:
        raise RobotError(f"{path} is larger than {MAX_BYTES / 1e6:g} MB, the largest URDF that is read")
    text = content.decode("utf-8", errors="replace")
    if "<!ENTITY" in text:
        raise RobotError(f"{path} declares XML entities, which can expand without bound: write out what they stand for")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        start = text[:200].lstrip("\ufeff \t\r\n").lower()
        if start.startswith(("<!doctype html", "<html")):
            raise RobotError(f"{path} is a web page, not a URDF") from None
        raise RobotError(f"{path} is not a URDF: it is not well-formed XML: {error}") from None
    level, depth = [root], 0
    while level:
        depth, level = depth + 1, [child for element in level for child in element]
        if depth > _NESTED:
            raise RobotError(f"{path} is not a URDF: its elements are nested more than {_NESTED} deep")
    if root.tag != "robot":
        raise RobotError(f"{path} is not a URDF: its root element is <{root.tag}>, not <robot>")
    if any("wiki/xacro}" in element.tag for element in root):
        raise RobotError(f"{path} is a xacro file: expand it first, with xacro {path.name} > {path.stem}.urdf")
    if not root.get("name"):
        raise RobotError(f"{path}: its <robot> has no name, which a URDF must have")
    if root.find("link") is None:
        raise RobotError(f"{path} describes no link")
    return root


def _check_tree(root: ET.Element, path: Path) -> None:
    links, joints = len(root.findall("link")), root.findall("joint")
    moving = sum(joint.get("type") != "fixed" for joint in joints)
    for number, what, most in ((max(links, len(joints)), "links", MAX_LINKS), (moving, "moving joints", MAX_JOINTS)):
        if number > most:
            raise RobotError(f"{path} has {number} {what}; varpin takes robots of at most {most}")
    above: dict[str, tuple[str, str]] = {}
    for joint in joints:
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
    depths: dict[str, int] = {}
    for start in above:
        link, way = start, dict[str, None]()
        while link in above and link not in depths:
            if link in way:
                loop = list(way)[list(way).index(link) :]
                raise RobotError(f"{path}: links {', '.join(map(repr, loop))} form a loop that hangs on no root")
            way[link] = None
            link = above[link][0]
        depth = depths.get(link, 0)
        for link in reversed(way):
            depth += 1
            depths[link] = depth
        if depth > MAX_DEPTH:
            raise RobotError(f"{path}: link {start!r} is {depth} joints from its root; {MAX_DEPTH} are the most")


def _check_inertial(link: ET.Element, path: Path) -> None:
    inertial = link.find("inertial")
    if inertial is None:
        return
    where = f"{path}: link {link.get('name')!r}"
    mass, moments, origin = inertial.find("mass"), inertial.find("inertia"), inertial.find("origin")
    if mass is None or moments is None:
        raise RobotError(f"{where}: its <inertial> has no <{'mass' if mass is None else 'inertia'}>")
    if _number(mass.get("value"), f"{where}: its mass") < 0.0:
        raise RobotError(f"{where} has mass {mass.get('value')} < 0 [kg]")
    # Numbers are put back without white space that Pinocchio would stumble over.
    mass.set("value", mass.get("value", "").strip())
    for entry in _MOMENTS:
        _number(moments.get(entry), f"{where}: its inertia {entry}")
        moments.set(entry, moments.get(entry, "").strip())
    for entry in ("xyz", "rpy") if origin is not None else ():
        assert origin is not None
        words = origin.get(entry, "0 0 0").split()
        if len(words) != 3:  # Pinocchio would drop the whole <inertial> in silence
            raise RobotError(f"{where}: the {entry} of its <inertial> must be three numbers, got {' '.join(words)!r}")
        for word in words:
            _number(word, f"{where}: the {entry} of its <inertial>")
        origin.set(entry, " ".join(words))


def _mimic(joint: ET.Element, path: Path) -> Mimic:
    element = joint.find("mimic")
    assert element is not None
    where = f"{path}: joint {joint.get('name')!r}: its mimic"
    if not element.get("joint"):
        raise RobotError(f"{where} element names no joint")
    return Mimic(
        element.get("joint", ""),
        _number(element.get("multiplier", "1"), f"{where} multiplier"),
        _number(element.get("offset", "0"), f"{where} offset"),
    )


def _number(word: str | None, what: str) -> float:
    number = float(word) if word is not None and _NUMBER.fullmatch(word.strip()) else math.nan
    if not math.isfinite(number):
        found = "missing" if word is None else reprlib.repr(word)
        raise RobotError(f"{what} is {found}, where a finite number belongs")
    return number


@contextlib.contextmanager
def _captured_stderr() -> Iterator[Callable[[], list[str]]]:
    """Catch what Pinocchio's C++ parser writes to the process's stderr; yields a function that returns its messages."""
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile() as sink:
        os.dup2(sink.fileno(), 2)

        def messages() -> list[str]:
            sink.seek(0)
            lines = [line.strip() for line in sink.read().decode(errors="replace").splitlines()]
            # Every message is followed by the line of the parser's C++ source that it comes from.
            return [line.removeprefix("Error:").strip() for line in lines if line and not line.startswith("at line ")]

        try:
            yield messages
        finally:
            os.dup2(saved, 2)
            os.close(saved)
