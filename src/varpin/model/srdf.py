"""Postures of a robot: the group states of an SRDF file, or the reference configurations of a Pinocchio model."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pinocchio as pin

from varpin.errors import FileError, RobotError
from varpin.model.urdf import finite_number, read_xml
from varpin.model.xacro import plain_name


@dataclass(frozen=True)
class Posture:
    """Named positions of joints."""

    name: str
    group: str  # of joints; empty if there is none
    positions: tuple[tuple[str, float], ...]  # by joint [rad or m]


def beside(path: Path, robot: str) -> Path | None:
    """The SRDF file beside a robot's file, or in a sibling folder: of its name, or the only one of the robot's."""
    found = sorted([*path.parent.glob("*.srdf"), *path.parent.parent.glob("srdf/*.srdf")])
    for file in found:
        if file.stem == plain_name(path):
            return file
    named = [file for file in found if robot and _robot_of(file) == robot]
    return named[0] if len(named) == 1 else None


def read_srdf(path: Path, text: str | None = None) -> tuple[tuple[Posture, ...], dict[str, float]]:
    """The postures of an SRDF file, and the armature of joints by name [kg m^2 or kg]."""
    root = read_xml(path, text, "SRDF")
    postures, armature = [], {}
    for state in root.findall("group_state"):
        name, positions = state.get("name", ""), []
        for joint in state.findall("joint"):
            where = f"{path}: posture {name!r}: the position of joint {joint.get('name')!r}"
            numbers = [finite_number(word, where) for word in joint.get("value", "").split() or [""]]
            if len(numbers) <= 2:  # More numbers belong to a joint with several axes, such as a free-flyer.
                positions.append((joint.get("name", ""), _angle(numbers)))
        postures.append(Posture(name, state.get("group", ""), tuple(positions)))
    for joint in root.iterfind("rotor_params/joint"):
        where = f"of the rotor of joint {joint.get('name')!r}"
        mass = finite_number(joint.get("mass", "0"), f"{path}: mass {where}")
        ratio = finite_number(joint.get("gear_ratio", "0"), f"{path}: gear_ratio {where}")
        armature[joint.get("name", "")] = mass * ratio**2
    return tuple(postures), armature


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


def _angle(numbers: Sequence[float]) -> float:
    """The position of a one-axis joint from one number, or from cosine and sine."""
    return float(numbers[0]) if len(numbers) == 1 else math.atan2(numbers[1], numbers[0])


def _robot_of(path: Path) -> str:
    """The name of the robot in a file; empty if the file cannot be read."""
    try:
        return read_xml(path).get("name", "")
    except (RobotError, FileError):
        return ""
