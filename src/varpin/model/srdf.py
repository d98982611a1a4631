"""Postures of a robot: the group states of an SRDF file, or the reference configurations of a Pinocchio model."""

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pinocchio as pin

from varpin.errors import FileError, RobotError
from varpin.model.urdf import finite_number, read_xml
from varpin.model.xacro import plain_name

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Posture:
    """Named positions of joints.

    Attributes:
        name: Name of the posture.
        group: Name of the group of joints; empty if there is none.
        positions: Joints and their positions [rad or m].
    """

    name: str
    group: str
    positions: tuple[tuple[str, float], ...]


def beside(path: Path, robot: str) -> Path | None:
    """The SRDF file of a robot in the folder of its file ``path``, or in a sibling folder ``srdf``.

    It is the one with the name of the robot's file, or else the only one whose robot is named ``robot``.
    """
    found = sorted([*path.parent.glob("*.srdf"), *path.parent.parent.glob("srdf/*.srdf")])
    for file in found:
        if file.stem == plain_name(path):
            return file
    named = [file for file in found if robot and _robot_of(file) == robot]
    return named[0] if len(named) == 1 else None


def read_rotors(path: Path, text: str | None = None) -> dict[str, float]:
    """The armature of joints [kg m^2 or kg] in an SRDF file, rotor inertia times squared gear ratio.

    Raises:
        FileError: The file cannot be read.
        RobotError: It is not an SRDF, or a number in it is none.
    """
    armature = {}
    for joint in read_xml(path, text).iterfind("rotor_params/joint"):
        name = joint.get("name", "")
        mass, ratio = (
            finite_number(joint.get(key, "0"), f"{path}: {key} of the rotor of joint {name!r}")
            for key in ("mass", "gear_ratio")
        )
        if mass < 0.0:
            raise RobotError(f"{path}: mass of the rotor of joint {name!r} is negative: {mass:g}")
        armature[name] = mass * ratio**2
    return armature


def read_postures(path: Path, text: str | None = None) -> tuple[Posture, ...]:
    """The postures in an SRDF file.

    Args:
        path: Path of the file.
        text: The SRDF text, if not the file's content.

    Raises:
        FileError: The file cannot be read.
        RobotError: It is not an SRDF, or a position in it is not a number.
    """
    root = read_xml(path, text)
    if root.tag != "robot":
        raise RobotError(f"{path} is not an SRDF: its root element is <{root.tag}>, not <robot>")
    postures = []
    for state in root.findall("group_state"):
        name, positions = state.get("name", ""), []
        for joint in state.findall("joint"):
            where = f"{path}: posture {name!r}: the position of joint {joint.get('name')!r}"
            words = joint.get("value", "").split()
            numbers = [finite_number(word, where) for word in words or [""]]
            if len(numbers) <= 2:  # More numbers belong to a joint with several axes, such as a free-flyer.
                positions.append((joint.get("name", ""), _angle(numbers)))
        postures.append(Posture(name, state.get("group", ""), tuple(positions)))
    return tuple(postures)


def reference_postures(model: pin.Model) -> tuple[Posture, ...]:
    """The reference configurations of a model as postures of its one-axis joints."""
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
    """The postures that set some of ``joints``."""
    return tuple(posture for posture in postures if any(joint in joints for joint, _ in posture.positions))


def _angle(numbers: Sequence[float]) -> float:
    """The position of a one-axis joint from one number, or from cosine and sine."""
    return float(numbers[0]) if len(numbers) == 1 else math.atan2(numbers[1], numbers[0])


def _robot_of(path: Path) -> str:
    """The name of the robot in a file; empty if the file cannot be read."""
    try:
        return read_xml(path).get("name", "")
    except (RobotError, FileError):
        return ""
