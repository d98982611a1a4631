"""Postures of a robot: the group states of an SRDF file, or the reference configurations of a Pinocchio model."""

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

import pinocchio as pin

from varpin.errors import RobotError
from varpin.model.urdf import decoded, finite_number, parsed
from varpin.model.xacro import plain_name

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Posture:
    """Positions of joints under a name.

    Attributes:
        name: Of the posture.
        group: Of the joints, as the file calls them; empty if it does not.
        positions: Joints and their positions [rad or m].
    """

    name: str
    group: str
    positions: tuple[tuple[str, float], ...]


def beside(path: Path, robot: str) -> Path | None:
    """The SRDF file of a robot in the folder of its file, or in a folder ``srdf`` beside that.

    It has the file's name; failing that, it is the only one for a robot of the name that the file gives, ``robot``.
    """
    found = sorted([*path.parent.glob("*.srdf"), *path.parent.parent.glob("srdf/*.srdf")])
    for file in found:
        if file.stem == plain_name(path):
            return file
    named = [file for file in found if robot and _robot_of(file) == robot]
    return named[0] if len(named) == 1 else None


def read_postures(path: Path, text: str | None = None) -> tuple[Posture, ...]:
    """The postures in an SRDF file.

    Args:
        path: Of the file.
        text: What it stands for, if that is not its content.

    Raises:
        FileError: The file cannot be read.
        RobotError: It is no SRDF, or a position in it is no number.
    """
    try:
        root = parsed(decoded(path)[0] if text is None else text)
    except expat.ExpatError as error:
        raise RobotError(f"{path} is not an SRDF: it is not well-formed XML: {error}") from None
    if root.tag != "robot":
        raise RobotError(f"{path} is not an SRDF: its root element is <{root.tag}>, not <robot>")
    postures = []
    for state in root.findall("group_state"):
        name, positions = state.get("name", ""), []
        for joint in state.findall("joint"):
            where = f"{path}: posture {name!r}: the position of joint {joint.get('name')!r}"
            words = joint.get("value", "").split()
            numbers = [finite_number(word, where) for word in words or [""]]
            if len(numbers) <= 2:  # More are those of a joint that is no coordinate, a free-flyer's.
                positions.append((joint.get("name", ""), _angle(numbers)))
        postures.append(Posture(name, state.get("group", ""), tuple(positions)))
    return tuple(postures)


def reference_postures(model: pin.Model) -> tuple[Posture, ...]:
    """The reference configurations of a model, each for all of its one-axis joints."""
    postures = []
    for entry in model.referenceConfigurations:
        name, q = entry.key(), entry.data()
        joints = [(model.names[j], model.joints[j]) for j in range(1, model.njoints)]
        positions = tuple(
            (joint, _angle(q[kind.idx_q : kind.idx_q + kind.nq])) for joint, kind in joints if kind.nv == 1
        )
        postures.append(Posture(name, "", positions))
    return tuple(postures)


def of_joints(postures: Iterable[Posture], joints: Sequence[str]) -> tuple[Posture, ...]:
    """The postures that say something of some of ``joints``."""
    return tuple(posture for posture in postures if any(joint in joints for joint, _ in posture.positions))


def _angle(numbers: Sequence[float]) -> float:
    """The position of a one-axis joint, which may be written as cosine and sine."""
    return float(numbers[0]) if len(numbers) == 1 else math.atan2(numbers[1], numbers[0])


def _robot_of(path: Path) -> str:
    """The robot that a file names; empty if it cannot be read."""
    try:
        return parsed(decoded(path)[0]).get("name", "")
    except (expat.ExpatError, OSError):
        return ""
