"""Forces on single joints: springs, dampers, friction, stops, rotors, servos. A scene takes any number of them.

    scene = vp.Scene(robot, forces=[vp.CoulombFriction(0.5), vp.JointStop(stiffness=1e3, damping=5.0)])

Every integrator and every derivative knows them: steps, linearizations of first and second order, energies and the part
of them that turns into heat. Parameters are one number for every joint, (n,), or numbers by joint name; joints that are
not named have none.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from varpin.checks import JointValues, as_floats, joint_array
from varpin.core.arrays import Element
from varpin.errors import InputError, UnknownJoint
from varpin.frozen import Frozen
from varpin.robot import Robot

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Force(Frozen, ABC):
    """A force that acts on joints one by one."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value: Any = getattr(self, item.name)
            if isinstance(value, Mapping):
                value = MappingProxyType(dict(value))
            elif value is not None:
                value = as_floats(item.name, value)
                value.setflags(write=False)
            object.__setattr__(self, item.name, value)

    def __repr__(self) -> str:
        own = [(item.name, getattr(self, item.name)) for item in fields(self)]
        given = [
            f"{name}={dict(value) if isinstance(value, Mapping) else value.tolist()}"
            for name, value in own
            if value is not None
        ]
        return f"{type(self).__name__}({', '.join(given)})"

    @abstractmethod
    def bind(self, robot: Robot) -> tuple[Element, ...]:
        """The force on a robot, one element for each joint that it acts on.

        Raises:
            InputError: A wrong shape, or a value that is not finite or out of range.
            UnknownJoint: It names a joint that is no coordinate of the robot.
        """


@dataclass(frozen=True, eq=False, repr=False)
class JointSpring(Force):
    """Linear springs, part of the potential energy: the force -stiffness * (q - rest).

    Attributes:
        stiffness: >= 0 [N m/rad or N/m].
        rest: Where they are slack [rad or m].
    """

    stiffness: JointValues
    rest: JointValues = 0.0

    def bind(self, robot: Robot) -> tuple[Element, ...]:
        """See :meth:`Force.bind`."""
        stiffness = not_negative("stiffness", self.stiffness, robot)
        rest = joint_array("rest", self.rest, robot.joint_names, uniform=True)
        return tuple(_elements("JointSpring", stiffness > 0.0, stiffness, rest))


@dataclass(frozen=True, eq=False, repr=False)
class JointDamper(Force):
    """Viscous damping: the force -damping * v.

    Attributes:
        damping: >= 0 [N m s/rad or N s/m].
    """

    damping: JointValues

    def bind(self, robot: Robot) -> tuple[Element, ...]:
        """See :meth:`Force.bind`."""
        damping = not_negative("damping", self.damping, robot)
        return tuple(_elements("JointDamper", damping > 0.0, damping))


@dataclass(frozen=True, eq=False, repr=False)
class Armature(Force):
    """Inertia of rotors, seen at the joints: gear ratio squared times the rotor's own. It adds to the robot's armature.

    Attributes:
        inertia: >= 0 [kg m^2 or kg].
    """

    inertia: JointValues

    def bind(self, robot: Robot) -> tuple[Element, ...]:
        """See :meth:`Force.bind`."""
        inertia = not_negative("inertia", self.inertia, robot)
        return tuple(_elements("Armature", inertia > 0.0, inertia))


@dataclass(frozen=True, eq=False, repr=False)
class CoulombFriction(Force):
    """Dry friction, smooth in the velocity: the force -g(v) tanh(v / width).

    g is ``level``; or, with ``breakaway``, level + (breakaway - level) exp(-(v / stribeck_velocity)^2). Nothing sticks
    for good: under a load of half the level a joint creeps by about half the width.

    Attributes:
        level: Friction of a joint that moves, >= 0 [N m or N].
        width: Velocity at which it is 76 % of itself, > 0 [rad/s or m/s].
        breakaway: Friction of a joint that hardly moves, >= level [N m or N]; ``level`` if left out.
        stribeck_velocity: At which 37 % of the difference are left, > 0 [rad/s or m/s].
    """

    level: JointValues
    width: JointValues = 0.01
    breakaway: JointValues | None = None
    stribeck_velocity: JointValues | None = None

    def bind(self, robot: Robot) -> tuple[Element, ...]:
        """See :meth:`Force.bind`."""
        if (self.breakaway is None) != (self.stribeck_velocity is None):
            raise InputError("breakaway and stribeck_velocity belong together: give both or neither")
        level = not_negative("level", self.level, robot)
        breakaway, fading = level, np.ones_like(level)
        acts = level > 0.0
        if self.breakaway is not None and self.stribeck_velocity is not None:
            breakaway = not_negative("breakaway", self.breakaway, robot)
            acts |= breakaway > 0.0
            _refuse("breakaway", breakaway, acts & (breakaway < level), "must be at least the level")
            fading = _positive("stribeck_velocity", self.stribeck_velocity, robot, acts)
        width = _positive("width", self.width, robot, acts)
        return tuple(_elements("CoulombFriction", acts, level, width, breakaway, fading))


@dataclass(frozen=True, eq=False, repr=False)
class JointStop(Force):
    """A spring and a damper beyond the ends of a joint's way, part of the potential energy and of the losses.

    Stiffness and damping rise smoothly from 0 to the whole over the first ``width`` beyond an end, so that forces have
    continuous derivatives.

    Attributes:
        stiffness: >= 0 [N m/rad or N/m].
        damping: >= 0 [N m s/rad or N s/m].
        lower: Lower end [rad or m], -inf for none; the robot's own position limit if left out.
        upper: Upper end [rad or m], inf for none; the robot's own position limit if left out.
        width: > 0 [rad or m].
    """

    stiffness: JointValues
    damping: JointValues = 0.0
    lower: JointValues | None = None
    upper: JointValues | None = None
    width: JointValues = 0.01

    def bind(self, robot: Robot) -> tuple[Element, ...]:
        """See :meth:`Force.bind`."""
        stiffness = not_negative("stiffness", self.stiffness, robot)
        damping = not_negative("damping", self.damping, robot)
        own_lower, own_upper = robot.position_limits
        lower = own_lower if self.lower is None else _ends("lower", self.lower, robot, -np.inf)
        upper = own_upper if self.upper is None else _ends("upper", self.upper, robot, np.inf)
        asked = (stiffness > 0.0) | (damping > 0.0)
        acts = asked & (np.isfinite(lower) | np.isfinite(upper))
        endless = [name for name, wanted, has in zip(robot.joint_names, asked, acts, strict=True) if wanted and not has]
        # One number for all leaves joints without limits alone, as those that turn for ever.
        if endless and (isinstance(self.stiffness, Mapping) or not acts.any()):
            raise InputError(
                f"JointStop: {robot.name} has no position limits for {', '.join(map(repr, endless))}: give lower= and "
                "upper="
            )
        if (crossed := acts & ~(lower < upper)).any():
            c = int(np.argmax(crossed))
            raise InputError(
                f"JointStop: the lower end of joint {robot.joint_names[c]!r}, {lower[c]:g}, is not below its upper "
                f"end, {upper[c]:g}"
            )
        width = _positive("width", self.width, robot, acts)
        return tuple(_elements("JointStop", acts, lower, upper, stiffness, damping, width))


@dataclass(frozen=True, eq=False, repr=False)
class PositionServo(Force):
    """Position servos: the control of a joint is the position it is to go to [rad or m], and no force.

    The drive's force is S(stiffness * (u - q) - damping * v) at every instant of a step, not only where it begins, so
    implicit integrators take servos of any stiffness. S is the identity up to 0.9 of the effort limit and bends
    smoothly to the limit at 1.1. The energy of a motion is that of the robot, without its servos'.

    Attributes:
        stiffness: >= 0 [N m/rad or N/m]; joints with 0 have no servo.
        damping: >= 0 [N m s/rad or N s/m].
        effort: Largest force, > 0 [N m or N]; inf for no limit.
    """

    stiffness: JointValues
    damping: JointValues = 0.0
    effort: JointValues = np.inf

    def bind(self, robot: Robot) -> tuple[Element, ...]:
        """See :meth:`Force.bind`."""
        stiffness = not_negative("stiffness", self.stiffness, robot)
        damping = not_negative("damping", self.damping, robot)
        effort = _ends("effort", self.effort, robot, np.inf)
        acts = stiffness > 0.0
        _refuse("effort", effort, acts & ~(effort > 0.0), "must be > 0")
        return tuple(_elements("PositionServo", acts, stiffness, damping, effort))


def of_kind(elements: Iterable[Element], kind: str) -> tuple[Element, ...]:
    """The elements of one kind."""
    return tuple(own for own in elements if own.kind == kind)


def drive_force(servo: Element, q: Floats, v: Floats, force: Floats) -> Floats:
    """What a servo's drive does to its joint (K,) [N m or N], S of :class:`PositionServo`.

    Args:
        servo: A ``PositionServo``.
        q: The joint's positions (K,) [rad or m].
        v: Its velocities (K,) [rad/s or m/s].
        force: Stiffness times command (K,) [N m or N].
    """
    stiffness, damping, effort = servo.values
    wanted = force - stiffness * q - damping * v
    if not np.isfinite(effort):
        return wanted
    over = np.clip(np.abs(wanted) / effort - 0.9, 0.0, 0.2)
    bent: Floats = np.sign(wanted) * effort * (np.minimum(np.abs(wanted) / effort, 0.9) + over - 2.5 * over**2)
    return bent


def drive_forces(elements: Iterable[Element], q: Floats, v: Floats, force: Floats) -> Floats:
    """The forces (K, n) that drives make of the controls' constant forces (K, n), at q and v (K, n) [N m or N]."""
    driven = force.copy()
    for own in of_kind(elements, "PositionServo"):
        c = own.coordinate
        driven[:, c] = drive_force(own, q[:, c], v[:, c], force[:, c])
    return driven


def dissipates(element: Element) -> bool:
    """Whether an element turns energy into heat."""
    if element.kind == "JointStop":
        return element.values[3] > 0.0
    return element.kind in ("JointDamper", "CoulombFriction", "PositionServo")


def forces_of(given: Force | Sequence[Force]) -> tuple[Force, ...]:
    """What a user gives as forces.

    Raises:
        InputError: It is none of them.
    """
    forces = (given,) if isinstance(given, Force) else given
    if isinstance(forces, str) or not isinstance(forces, Sequence):
        raise InputError(f"forces must be a list of varpin's forces, got {type(given).__name__}")
    for force in forces:
        if not isinstance(force, Force):
            raise InputError(f"forces must be a list of varpin's forces, got {force!r} in it")
    return tuple(forces)


def not_negative(name: str, value: JointValues, robot: Robot) -> Floats:
    """``value`` as numbers >= 0 for each joint (n,).

    Raises:
        InputError: As :func:`varpin.checks.joint_array`, or a number is negative.
    """
    values = joint_array(name, value, robot.joint_names, uniform=True)
    return _refuse(name, values, values < 0.0, "must be >= 0")


def _positive(name: str, value: JointValues, robot: Robot, needed: NDArray[np.bool_]) -> Floats:
    """``value`` for each joint (n,), > 0 where it is needed."""
    values = joint_array(name, value, robot.joint_names, uniform=True)
    return _refuse(name, values, needed & ~(values > 0.0), "must be > 0")


def _ends(name: str, value: JointValues, robot: Robot, absent: float) -> Floats:
    """Ends of a way for each joint (n,), ``absent`` for those that have none."""
    joints = robot.joint_names
    if isinstance(value, Mapping):
        values = np.full(len(joints), absent)
        for joint, number in value.items():
            if joint not in joints:
                raise UnknownJoint(str(joint), joints, name)
            values[joints.index(joint)] = as_floats(f"{name}[{joint!r}]", number)
    else:
        given = as_floats(name, value)
        if given.shape not in ((), (len(joints),)):
            raise InputError(f"{name} must be one number or have shape ({len(joints)},), got {given.shape}")
        values = np.array(np.broadcast_to(given, (len(joints),)))
    return _refuse(name, values, np.isnan(values) | (values == -absent), f"must be a number, or {absent} for none")


def _refuse(name: str, values: Floats, wrong: NDArray[np.bool_], what: str) -> Floats:
    if wrong.any():
        c = int(np.argmax(wrong))
        raise InputError(f"{name}[{c}] is {values[c]}; it {what}")
    return values


def _elements(kind: str, acts: NDArray[np.bool_], *columns: Floats) -> Iterator[Element]:
    for c in np.flatnonzero(acts):
        yield Element(kind, int(c), tuple(float(column[c]) for column in columns))
