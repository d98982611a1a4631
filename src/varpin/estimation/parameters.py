"""Parameters of a scene by name: dampers, friction, springs, rotors, servos, payload, inertias of links."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.integrators.base import Varied
from varpin.mechanics.forces import (
    Armature,
    CoulombFriction,
    Force,
    JointDamper,
    JointForce,
    JointSpring,
    PositionServo,
)
from varpin.mechanics.scene import Scene, with_forces
from varpin.model import Robot
from varpin.model.inertia import inertial_numbers, inertials_of, point_mass, with_inertial_numbers
from varpin.support.checks import joint_array, tuple_of

# The inertial numbers of a body: mass [kg], first moments [kg m] and second ones about the joint's origin [kg m^2].
INERTIAL = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
_UNITS = ("kg", "kg m", "kg m", "kg m", *["kg m^2"] * 6)
# Half the distance of the scenes around a parameter, in its unit. L and F are linear in all but the gains of servos
# with an effort limit, so any distance gives the derivative; the unit is far above rounding for arms from 10 g to 1 t.
# Gains are moved by this share, which leaves 1e-10 of a difference.
_APART, _GAIN_SHARE = 1.0, 1e-5


# Least stiffness of a servo [N m/rad]: without any it would be none, and its control nothing.
_SOFTEST = 1e-6


class _Kind(NamedTuple):
    """A number of a force on a joint."""

    force: type[JointForce]
    number: str
    unit: str
    adds: bool = True  # whether a joint without such a force gets one
    least: float = 0.0


_KINDS = {
    "damping": _Kind(JointDamper, "damping", "N m s/rad"),
    "friction": _Kind(CoulombFriction, "level", "N m"),
    "stiffness": _Kind(JointSpring, "stiffness", "N m/rad"),
    "rest": _Kind(JointSpring, "rest", "rad", False, -np.inf),
    "armature": _Kind(Armature, "inertia", "kg m^2"),
    "servo_stiffness": _Kind(PositionServo, "stiffness", "N m/rad", False, _SOFTEST),
    "servo_damping": _Kind(PositionServo, "damping", "N m s/rad", False),
}


@dataclass(frozen=True, eq=False)
class Parameters:
    """P parameters of a scene.

    Attributes:
        scene: The scene.
        names: Names (P,): ``kind:joint``, ``payload:frame`` or ``inertia:link:number``.
        values: Their values in the scene (P,).
        least: Their least values (P,); -inf for none.
        units: Their units (P,); of joints that slide read m for rad and N for N m.
    """

    scene: Scene
    names: tuple[str, ...]
    values: Floats
    least: Floats
    units: tuple[str, ...]

    def scene_with(self, values: Floats) -> Scene:
        """The scene with these values (P,)."""
        forces, robot = self.scene.forces, self.scene.robot
        bodies: dict[int, Floats] = {}
        for name, value, before in zip(self.names, values.tolist(), self.values.tolist(), strict=True):
            kind, _, place = name.partition(":")
            if value == before:
                continue
            if kind in _KINDS:
                forces = _with_number(forces, robot, _KINDS[kind], place, value)
            else:
                joint, share = _per_unit(robot, kind, place)
                bodies[joint] = bodies.get(joint, 0.0) + (value - before) * share
        if bodies:
            robot = with_inertial_numbers(robot, bodies)
        return with_forces(self.scene, forces, robot)

    def varied(self) -> tuple[Varied, ...]:
        """The scenes around each parameter; the scene itself is the lower one where it has no lower value."""
        found = []
        for k, name in enumerate(self.names):
            apart = np.zeros_like(self.values)
            gain = name.startswith("servo")
            apart[k] = _GAIN_SHARE * max(abs(self.values[k]), _APART) if gain else _APART
            # L and F are linear, so one side is as good, and never passes a body without mass.
            low = bool(self.values[k] - apart[k] < self.least[k]) if gain else bool(np.isfinite(self.least[k]))
            below = self.scene if low else self.scene_with(self.values - apart)
            found.append(Varied(self.scene_with(self.values + apart), below, (1.0 if low else 2.0) * apart[k]))
        return tuple(found)


def parameters_of(scene: Scene, parameters: str | Sequence[str]) -> Parameters:
    """The parameters of a scene by name.

    A kind alone, ``"damping"``, stands for those of all joints; ``"damping:elbow_joint"`` for one. Kinds are
    ``damping``, ``friction`` (the level), ``stiffness`` and ``rest`` of springs, ``armature`` (that of
    :class:`varpin.Armature`, beyond the robot's own), ``servo_stiffness`` and ``servo_damping``. ``"payload"`` is the
    mass of a point at the end effector, ``"payload:frame"`` at a frame, beyond what the robot carries.
    ``"inertia:link"`` are ten numbers of the body that the link is part of, in the frame of its joint: mass, first
    moments and moments of inertia about the joint's origin; ``"inertia"`` those of all bodies.

    Raises:
        InputError: A name stands for no parameter, or twice for the same.
        UnknownJoint: There is no such joint.
        UnknownFrame: There is no such frame.
    """
    given = (parameters,) if isinstance(parameters, str) else tuple_of("parameters", parameters, str)
    rows = [row for name in given for row in _rows(scene, name)]
    names = [name for name, *_ in rows]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"parameters has {twice!r} twice")
    if not rows:
        raise InputError("parameters is empty: name at least one, such as 'damping'")
    values, least = (np.array([row[k] for row in rows], dtype=np.float64) for k in (1, 2))
    return Parameters(scene, tuple(names), values, least, tuple(row[3] for row in rows))


def _rows(scene: Scene, given: str) -> list[tuple[str, float, float, str]]:
    """Name, value, least value and unit of each parameter that a name stands for."""
    kind, _, place = given.partition(":")
    if kind in _KINDS:
        return _joint_rows(scene, kind, place)
    if kind == "payload":
        frame = place or scene.robot.end_effector
        # Less than nothing is what the robot carries in the scene, and not in the log.
        joint, _ = _per_unit(scene.robot, kind, frame)
        return [(f"payload:{frame}", 0.0, -float(scene.robot.model.inertias[joint].mass), "kg")]
    if kind != "inertia":
        raise InputError(
            f"there is no parameter {given!r}: kinds are {', '.join([*_KINDS, 'payload', 'inertia'])}, alone or as "
            "'kind:joint', 'payload:frame', 'inertia:link'"
        )
    found = []
    for one in [place] if place else [each.link for each in inertials_of(scene.robot.model)]:
        link, _, number = one.partition(":")
        own = inertial_numbers(scene.robot, link)[1]
        if not own[0] > 0.0 and place:
            raise InputError(f"{given}: link {link!r} has no mass, and its inertia cannot be found from none")
        if not own[0] > 0.0:
            continue
        for name, value, unit in zip(INERTIAL, own.tolist(), _UNITS, strict=True):
            if number in ("", name):
                found.append((f"inertia:{link}:{name}", value, 0.0 if name == "m" else -np.inf, unit))
    if not found:
        raise InputError(f"there is no parameter {given!r}: the numbers of a link are {', '.join(INERTIAL)}")
    return found


def _joint_rows(scene: Scene, kind: str, place: str) -> list[tuple[str, float, float, str]]:
    of, found = _KINDS[kind], []
    for joint in [place] if place else scene.robot.joint_names:
        index = _acting(scene.forces, scene.robot, of, joint)
        if index is None and not (of.adds or place):
            continue
        if index is None and not of.adds:
            raise InputError(f"{kind}:{joint}: the joint has no {of.force.__name__}, whose {of.number} it is")
        value = 0.0 if index is None else _numbers(scene.forces[index], scene.robot, of)[scene.robot.coordinate(joint)]
        found.append((f"{kind}:{joint}", float(value), of.least, of.unit))
    if not found:
        raise InputError(f"{kind}: no joint has a {of.force.__name__}, whose {of.number} it is")
    return found


def _per_unit(robot: Robot, kind: str, place: str) -> tuple[int, Floats]:
    """The body of a parameter, and its inertial numbers (10,) per unit of it."""
    if kind == "payload":
        return point_mass(robot, place)
    link, _, number = place.rpartition(":")
    return inertial_numbers(robot, link)[0], np.eye(10)[INERTIAL.index(number)]


def _numbers(force: Force, robot: Robot, kind: _Kind) -> Floats:
    return joint_array(kind.number, getattr(force, kind.number), robot.joint_names, uniform=True)


def _acting(forces: Sequence[Force], robot: Robot, kind: _Kind, joint: str) -> int | None:
    """The index of the force of a kind that acts on a joint; None for none."""
    c = robot.coordinate(joint)
    of_kind = [(k, force) for k, force in enumerate(forces) if type(force) is kind.force]
    found = [k for k, force in of_kind if any(each.coordinate == c for each in force.bind(robot))]
    if len(found) > 1:
        raise InputError(
            f"joint {joint!r} has {len(found)} forces of the kind {kind.force.__name__}: give it one, of which the "
            "parameter is"
        )
    return found[0] if found else None


def _with_number(forces: tuple[Force, ...], robot: Robot, kind: _Kind, joint: str, value: float) -> tuple[Force, ...]:
    """The forces with another number of a joint's."""
    c, index = robot.coordinate(joint), _acting(forces, robot, kind, joint)
    if index is None:
        if value == 0.0:
            return forces
        make: Callable[..., Force] = kind.force
        return (*forces, make(**{kind.number: {joint: value}}))
    force, numbers = forces[index], _numbers(forces[index], robot, kind)
    change = value - numbers[c]
    numbers[c] = value
    changes: dict[str, Floats] = {kind.number: numbers}
    if isinstance(force, CoulombFriction) and force.breakaway is not None:
        # What a joint that hardly moves has more stays.
        changes["breakaway"] = joint_array("breakaway", force.breakaway, robot.joint_names, uniform=True)
        changes["breakaway"][c] += change
    return (*forces[:index], replace(force, **changes), *forces[index + 1 :])
