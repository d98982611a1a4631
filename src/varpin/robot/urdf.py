"""Reading a URDF file, and saying in words what is wrong with it.

Pinocchio's parser drops what it cannot read (an inertia that is not a number, a joint that closes a loop) with at
most a line on stderr, and goes on with another robot than the file describes.
"""

import contextlib
import logging
import os
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from varpin.errors import FileError, RobotError

logger = logging.getLogger(__name__)

_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


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
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from None
    root = _root(text, path)
    _check_tree(root, path)
    for link in root.findall("link"):
        _check_inertial(link, path)
    mimics = {joint.get("name", ""): _mimic(joint, path) for joint in root.findall("joint[mimic]")}
    with _captured_stderr() as complaints:
        try:
            model = pin.buildModelFromUrdf(str(path))
        except (ValueError, RuntimeError) as error:
            detail = "; ".join(complaints()) or str(error)
            raise RobotError(f"{path} is not a URDF that Pinocchio can read: {detail}") from None
        for line in complaints():
            logger.warning("%s: %s", path, line)
    return model, mimics


def _root(text: str, path: Path) -> ET.Element:
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        start = text[:200].lstrip("\ufeff \t\r\n").lower()
        if start.startswith(("<!doctype html", "<html")):
            raise RobotError(f"{path} is a web page, not a URDF") from None
        raise RobotError(f"{path} is not a URDF: it is not well-formed XML: {error}") from None
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
    for start in above:
        link, seen = start, [start]
        while link in above:
            link = above[link][0]
            if link in seen:
                raise RobotError(f"{path}: links {', '.join(map(repr, seen))} form a loop that hangs on no root")
            seen.append(link)


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
    for entry in _MOMENTS:
        _number(moments.get(entry), f"{where}: its inertia {entry}")
    for entry in ("xyz", "rpy"):
        words = (origin.get(entry, "0 0 0") if origin is not None else "0 0 0").split()
        if len(words) != 3:  # Pinocchio would drop the whole <inertial> in silence
            raise RobotError(f"{where}: the {entry} of its <inertial> must be three numbers, got {' '.join(words)!r}")
        for word in words:
            _number(word, f"{where}: the {entry} of its <inertial>")


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
    try:
        number = float(word or "")
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise RobotError(f"{what} is {'missing' if word is None else repr(word)}, where a finite number belongs")
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
