"""Forces on joints and frames: springs, dampers, friction, stops, rotors, servos, wrenches. A scene takes any number.

    scene = vp.Scene(robot, forces=[vp.CoulombFriction(0.5), vp.JointStop(stiffness=1e3, damping=5.0)])

Every integrator takes them, in steps, in linearizations of first and second order, in energies and in dissipated work.
Parameters of forces on joints are one number for every joint, (n,), or numbers by joint name; a joint without a number
has no such force. Forces on frames act at points: a frame name for the frame's origin, (frame name, point in the
frame's axes (3,) [m]), or, for forces with two ends, a point in world axes (3,) [m].
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.arrays import Floats
from varpin.core import coupling_kinds, element_kinds
from varpin.core.arrays import Coupling, Element
from varpin.errors import InputError, UnknownJoint
from varpin.model import Robot
from varpin.model.tree import place_of_frame
from varpin.support.checks import (
    JointValues,
    as_floats,
    finite_array,
    is_one_of,
    joint_array,
    rotation_matrix,
    tuple_of,
)
from varpin.support.frozen import Frozen

# A frame name or (frame name, point in the frame's axes); a Point may also be a point in world axes.
FramePoint: TypeAlias = str | tuple[str, ArrayLike]
Point: TypeAlias = FramePoint | ArrayLike


@dataclass(frozen=True, eq=False, repr=False)
class Described(Frozen):
    """What its parameters describe, of which it keeps immutable copies."""

    def __post_init__(self) -> None:
        for item in fields(self):
            object.__setattr__(self, item.name, kept(item.name, getattr(self, item.name)))

    def __repr__(self) -> str:
        items = [(item.name, getattr(self, item.name)) for item in fields(self) if item.repr]
        given = [f"{name}={shown(value)}" for name, value in items if value is not None]
        return f"{type(self).__name__}({', '.join(given)})"


@dataclass(frozen=True, eq=False, repr=False)
class Force(Described, ABC):
    """A force on single joints or on frames."""

    @abstractmethod
    def bind(self, robot: Robot) -> tuple[Element | Coupling, ...]:
        """The force on a robot, in the form of the core: one element for each joint that it acts on, or couplings.

        Raises:
            InputError: A wrong shape, or a value that is not finite or out of range.
            UnknownJoint: A joint is no coordinate of the robot.
            UnknownFrame: The robot has no such frame.
        """


class Kind(NamedTuple):
    """A kind of elements or couplings."""

    numbers: int  # of its parameters; a coupling has six more for its two points
    potential: bool
    force: bool  # whether it has a force without potential


# Armature is an element of a scene, and part of the tree in the core.
ELEMENTS = {"Armature": Kind(1, False, False)} | {name: Kind(*facts) for name, facts in element_kinds().items()}
COUPLINGS = {name: Kind(*facts) for name, facts in coupling_kinds().items()}


def bound_force(force: Force, robot: Robot) -> tuple[Element | Coupling, ...]:
    """``force.bind(robot)``, of which the core can take every element: subclasses of users are checked here.

    Raises:
        InputError: An element of an unknown kind, with a coordinate or body out of range, or with wrong values.
    """
    bound = tuple(force.bind(robot))
    for each in bound:
        where = f"{type(force).__name__}.bind returned {each!r}"
        if isinstance(each, Element):
            kinds, points = ELEMENTS, 0
            require_index(f"{where}: its coordinate", each.coordinate, 0, robot.dof)
        elif isinstance(each, Coupling):
            kinds, points = COUPLINGS, 6
            for end in (each.a, each.b):
                require_index(f"{where}: its body", end, -1, len(robot.tree.parent))
        else:
            raise InputError(f"{where}, which is neither an Element nor a Coupling")
        if each.kind not in kinds:
            raise InputError(f"{where}, of an unknown kind; kinds: {', '.join(kinds)}")
        count = points + kinds[each.kind].numbers
        if len(each.values) != count or np.isnan(as_floats("values", each.values)).any():
            raise InputError(f"{where}, which must have {count} values, none of them NaN")
    return bound


def require_index(what: str, index: Any, least: int, end: int) -> None:
    """Refuse an index that is no integer from ``least`` to ``end`` - 1."""
    if isinstance(index, bool) or not isinstance(index, int | np.integer) or not least <= index < end:
        raise InputError(f"{what} must be an integer from {least} to {end - 1}, got {index!r}")


def kept(name: str, value: Any) -> Any:
    """An immutable copy of a parameter."""
    if value is None or isinstance(value, str) or callable(value):
        return value
    if isinstance(value, Mapping):
        return MappingProxyType(dict(value))
    if isinstance(value, tuple | list) and len(value) == 2 and isinstance(value[0], str):
        return value[0], kept(name, value[1])
    given = as_floats(name, value)
    given.setflags(write=False)
    return given


def shown(value: Any) -> str:
    """A parameter as text."""
    if isinstance(value, str | int):
        return repr(value)
    if callable(value):
        return str(getattr(value, "__name__", repr(value)))
    if isinstance(value, tuple):
        return f"({', '.join(map(shown, value))})"
    return str(dict(value) if isinstance(value, Mapping) else value.tolist())


@dataclass(frozen=True, eq=False, repr=False)
class JointSpring(Force):
    """Linear springs: the force -stiffness * (q - rest). Their energy is part of the potential energy.

    Attributes:
        stiffness: >= 0 [N m/rad or N/m].
        rest: Position without force [rad or m].
    """

    stiffness: JointValues
    rest: JointValues = 0.0

    def bind(self, robot: Robot) -> tuple[Element, ...]:
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
        damping = not_negative("damping", self.damping, robot)
        return tuple(_elements("JointDamper", damping > 0.0, damping))


@dataclass(frozen=True, eq=False, repr=False)
class Armature(Force):
    """Rotor inertia reflected to the joints, gear ratio squared times rotor inertia; it adds to the robot's armature.

    Attributes:
        inertia: >= 0 [kg m^2 or kg].
    """

    inertia: JointValues

    def bind(self, robot: Robot) -> tuple[Element, ...]:
        inertia = not_negative("inertia", self.inertia, robot)
        return tuple(_elements("Armature", inertia > 0.0, inertia))


@dataclass(frozen=True, eq=False, repr=False)
class CoulombFriction(Force):
    """Dry friction, smooth in the velocity: the force -g(v) tanh(v / width).

    g is ``level``; or, with ``breakaway``, level + (breakaway - level) exp(-(v / stribeck_velocity)^2). Joints do not
    stick: under a load of half the level a joint creeps at about half the width. Near rest the friction is a damper of
    level / width, usually with a time constant far below a time step. Implicit integrators can step over it, explicit
    ones cannot; :attr:`Trajectory.warnings` names joints whose velocity near rest is wrong for this reason.

    Attributes:
        level: Friction of a moving joint, >= 0 [N m or N].
        width: Velocity at which tanh reaches 76 %, > 0 [rad/s or m/s].
        breakaway: Friction of a joint that hardly moves, >= level [N m or N]; ``level`` if left out.
        stribeck_velocity: Velocity at which 37 % of breakaway - level remain, > 0 [rad/s or m/s].
    """

    level: JointValues
    width: JointValues = 0.01
    breakaway: JointValues | None = None
    stribeck_velocity: JointValues | None = None

    def bind(self, robot: Robot) -> tuple[Element, ...]:
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
    """A spring and a damper beyond the ends of a joint's range; they store potential energy and dissipate.

    Stiffness and damping rise smoothly from 0 to their full values over the first ``width`` beyond an end, so that
    forces have continuous derivatives: at a depth x beyond it they have the share s = 3 y^2 - 2 y^3, y = min(x / width,
    1). The spring's force is stiffness times the integral of s over the depth, so stiffness (x - width / 2) beyond the
    width, and the damper's damping s v.

    Attributes:
        stiffness: >= 0 [N m/rad or N/m].
        damping: >= 0 [N m s/rad or N s/m].
        lower: Lower end [rad or m], -inf for none; the robot's own position limit if left out.
        upper: Upper end [rad or m], inf for none; the robot's own position limit if left out.
        width: Width of the transition, > 0 [rad or m].
    """

    stiffness: JointValues
    damping: JointValues = 0.0
    lower: JointValues | None = None
    upper: JointValues | None = None
    width: JointValues = 0.01

    def bind(self, robot: Robot) -> tuple[Element, ...]:
        stiffness = not_negative("stiffness", self.stiffness, robot)
        damping = not_negative("damping", self.damping, robot)
        own_lower, own_upper = robot.position_limits
        lower = own_lower if self.lower is None else _ends("lower", self.lower, robot, -np.inf)
        upper = own_upper if self.upper is None else _ends("upper", self.upper, robot, np.inf)
        given = (stiffness > 0.0) | (damping > 0.0)
        acts = given & (np.isfinite(lower) | np.isfinite(upper))
        endless = [name for name, wanted, has in zip(robot.joint_names, given, acts, strict=True) if wanted and not has]
        # One number for all joints skips those without limits, such as continuous joints.
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
    """Position servos: the control of a joint is its target position [rad or m] in place of a force.

    The drive's force is S(stiffness * (u - q) - damping * v) throughout a step, not only at its start, so implicit
    integrators take servos of any stiffness. S is the identity up to 0.9 of the effort limit and bends smoothly to the
    limit at 1.1. The energy of a trajectory excludes the energy of servos.

    Attributes:
        stiffness: >= 0 [N m/rad or N/m]; joints with 0 have no servo.
        damping: >= 0 [N m s/rad or N s/m].
        effort: Largest force, > 0 [N m or N]; inf for no limit.
    """

    stiffness: JointValues
    damping: JointValues = 0.0
    effort: JointValues = np.inf

    def bind(self, robot: Robot) -> tuple[Element, ...]:
        stiffness = not_negative("stiffness", self.stiffness, robot)
        damping = not_negative("damping", self.damping, robot)
        effort = _ends("effort", self.effort, robot, np.inf)
        acts = stiffness > 0.0
        _refuse("effort", effort, acts & ~(effort > 0.0), "must be > 0")
        return tuple(_elements("PositionServo", acts, stiffness, damping, effort))


@dataclass(frozen=True, eq=False, repr=False)
class FrameWrench(Force):
    """A constant wrench w at a frame: the generalized force J(q)' w.

    A force that is constant in world axes is part of the potential energy, -force . x. A moment, or a wrench that turns
    with the frame, has no potential; its work changes the energy.

    Attributes:
        frame: Point of action: a frame name, or (frame name, point in the frame's axes).
        wrench: Force [N] and moment about that point [N m] (6,), linear part first.
        axes: ``"world"``, or ``"frame"`` for a wrench that turns with the frame.
    """

    frame: FramePoint
    wrench: ArrayLike
    axes: Literal["world", "frame"] = "world"

    def bind(self, robot: Robot) -> tuple[Coupling, ...]:
        if not is_one_of(self.axes, ("world", "frame")):
            raise InputError(f"axes must be 'world' or 'frame', got {self.axes!r}")
        wrench = finite_array("wrench", self.wrench, (6,))
        if not isinstance(self.frame, str | tuple):
            raise InputError(f"frame must be a frame's name or (name, place), got {shown(self.frame)}")
        body, turned, place = point_of("frame", self.frame, robot)
        if body < 0:
            raise InputError(f"frame {self.frame!r} of robot {robot.name!r} is fixed to the base: no joint moves it")
        at = (*place.tolist(), 0.0, 0.0, 0.0)
        force, moment = wrench[:3], wrench[3:]
        if self.axes == "frame":
            numbers = (*(turned @ force).tolist(), *(turned @ moment).tolist(), 1.0)
            return (Coupling("FrameWrench", body, -1, (*at, *numbers)),) if wrench.any() else ()
        found = []
        if force.any():
            found.append(Coupling("FrameLoad", body, -1, (*at, *force.tolist())))
        if moment.any():
            found.append(Coupling("FrameWrench", body, -1, (*at, 0.0, 0.0, 0.0, *moment.tolist(), 0.0)))
        return tuple(found)


@dataclass(frozen=True, eq=False, repr=False)
class FrameSpring(Force):
    """A linear spring between two points, with an optional rotational spring. Both are part of the potential energy.

    With d = x_a - x_b in world axes the energy is 1/2 sum of stiffness (d - rest)^2 over the axes; with a number > 0
    for ``rest``, 1/2 stiffness (``|d|`` - rest)^2, whose force is set to zero at d = 0.

    Let E = R_0' R_b' R_a be the rotation of frame a from its rest orientation R_0 in b, and k the stiffnesses about the
    axes of a. The rotational energy is the sum of g_i (1 - E_ii), g_i = (k_1 + k_2 + k_3) / 2 - k_i; with one stiffness
    k, k (3 - tr E) / 2. That is k (1 - cos angle), smooth at all angles and k angle^2 / 2 at small ones. Its moment
    k sin(angle) is largest at a quarter turn and zero at half a turn, an unstable equilibrium.

    Attributes:
        a: First end: a frame name, (frame name, point in the frame's axes), or a point in world axes (3,) [m].
        b: Second end.
        stiffness: >= 0, one number or along each world axis (3,) [N/m].
        rest: d without force: in world axes (3,), or a length >= 0 [m].
        rotational_stiffness: >= 0, one number or about each axis of frame a (3,) [N m/rad]; zero if left out.
        rest_rotation: R_0, the orientation of frame a in b without moment, a rotation matrix (3, 3); the identity if
            left out. A point in world axes has the orientation of the world.
    """

    a: Point
    b: Point
    stiffness: ArrayLike
    rest: ArrayLike = 0.0
    rotational_stiffness: ArrayLike | None = None
    rest_rotation: ArrayLike | None = None

    def bind(self, robot: Robot) -> tuple[Coupling, ...]:
        return (*self._of_points(robot), *self._of_turning(robot))

    def _of_turning(self, robot: Robot) -> tuple[Coupling, ...]:
        """One spring between each axis of frame a and its rest direction in b."""
        rest = np.eye(3) if self.rest_rotation is None else rotation_matrix("rest_rotation", self.rest_rotation)
        if self.rotational_stiffness is None:
            if self.rest_rotation is not None:
                raise InputError("rest_rotation is of a rotational_stiffness, and there is none")
            return ()
        about = _along_axes("rotational_stiffness", self.rotational_stiffness)
        (a, here, _), (b, there, _) = point_of("a", self.a, robot), point_of("b", self.b, robot)
        _ends_of(self, robot)
        weights, slack = 0.5 * about.sum() - about, there @ rest
        return tuple(
            Coupling("FrameTurnSpring", a, b, (*here[:, i].tolist(), *slack[:, i].tolist(), float(weights[i])))
            for i in range(3)
            if weights[i]
        )

    def _of_points(self, robot: Robot) -> tuple[Coupling, ...]:
        bodies, places = _ends_of(self, robot)
        stiffness = _along_axes("stiffness", self.stiffness)
        rest = as_floats("rest", self.rest)
        if rest.shape not in ((), (3,)) or not np.isfinite(rest).all() or (rest.ndim == 0 and rest < 0.0):
            raise InputError(f"rest must be a length >= 0, or finite along three axes (3,), got {shown(rest)}")
        if not stiffness.any():
            return ()
        if rest.ndim == 0 and rest > 0.0:
            if np.ndim(self.stiffness):
                raise InputError("a spring with a length at rest has one stiffness, and not one along each axis")
            return (Coupling("FrameLengthSpring", *bodies, (*places, float(stiffness[0]), float(rest))),)
        slack = np.broadcast_to(rest, (3,))
        return (Coupling("FrameSpring", *bodies, (*places, *stiffness.tolist(), *slack.tolist())),)


@dataclass(frozen=True, eq=False, repr=False)
class FrameDamper(Force):
    """A viscous damper between two points: the force -damping (v_a - v_b) on a, and its opposite on b.

    Optionally also the moment -rotational_damping (w_a - w_b) on a's body, with angular velocities w in world axes, and
    its opposite on b's.

    Attributes:
        a: First end, as in :class:`FrameSpring`.
        b: Second end.
        damping: >= 0, one number or along each world axis (3,) [N s/m].
        rotational_damping: >= 0, one number or along each world axis (3,) [N m s/rad]; zero if left out.
    """

    a: Point
    b: Point
    damping: ArrayLike
    rotational_damping: ArrayLike | None = None

    def bind(self, robot: Robot) -> tuple[Coupling, ...]:
        bodies, places = _ends_of(self, robot)
        found = []
        for kind, name, given in (
            ("FrameDamper", "damping", self.damping),
            ("FrameTurnDamper", "rotational_damping", self.rotational_damping),
        ):
            damping = np.zeros(3) if given is None else _along_axes(name, given)
            if damping.any():
                found.append(Coupling(kind, *bodies, (*places, *damping.tolist())))
        return tuple(found)


def point_of(name: str, point: Any, robot: Robot) -> tuple[int, Floats, Floats]:
    """The body of a point (-1: the world), and on it the frame's rotation (3, 3) and the point's position (3,)."""
    offset: Any = (0.0, 0.0, 0.0)
    frame = point
    if isinstance(point, tuple) and len(point) == 2:
        frame, offset = point
    if not isinstance(frame, str):
        shape = np.shape(point)
        if shape != (3,):
            raise InputError(
                f"{name} must be a frame's name, (name, place in the frame (3,)) or a place in the world (3,), got "
                f"shape {shape}"
            )
        return -1, np.eye(3), finite_array(name, point, (3,))
    place = finite_array(f"{name}, the place in frame {frame!r},", offset, (3,))
    body, turned, at = place_of_frame(robot.free_model, frame, robot.name)
    return body, turned, at + turned @ place


def require_movable(owner: object, a: int, b: int, robot: Robot) -> None:
    """Refuse a force or constraint between bodies ``a`` and ``b`` of :func:`point_of` if both are fixed."""
    if a < 0 and b < 0:
        raise InputError(
            f"{type(owner).__name__}: both ends are fixed, in the world or to the base of robot {robot.name!r}: no "
            "joint moves one"
        )


def _ends_of(force: FrameSpring | FrameDamper, robot: Robot) -> tuple[tuple[int, int], tuple[float, ...]]:
    """The bodies at both ends, and the points on them, concatenated (6,)."""
    (a, _, here), (b, _, there) = point_of("a", force.a, robot), point_of("b", force.b, robot)
    require_movable(force, a, b, robot)
    return (a, b), (*here.tolist(), *there.tolist())


def _along_axes(name: str, value: ArrayLike) -> Floats:
    """``value``, one number or (3,), as numbers >= 0 along the axes of the world."""
    given = as_floats(name, value)
    if given.shape not in ((), (3,)) or not (np.isfinite(given).all() and (given >= 0.0).all()):
        raise InputError(f"{name} must be >= 0, one number or along three axes (3,), got {shown(given)}")
    return np.array(np.broadcast_to(given, (3,)))


def of_kind(elements: Iterable[Element], kind: str) -> tuple[Element, ...]:
    """The elements of one kind."""
    return tuple(element for element in elements if element.kind == kind)


def limited_servos(elements: Iterable[Element]) -> tuple[Element, ...]:
    """The servos with an effort limit."""
    return tuple(servo for servo in of_kind(elements, "PositionServo") if np.isfinite(servo.values[2]))


def drive_force(servo: Element, q: Floats, v: Floats, force: Floats) -> Floats:
    """The force of a servo on its joint (K,) [N m or N], S of :class:`PositionServo`.

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
    """``force`` (K, n) [N m or N] with the columns of servos replaced by :func:`drive_force` at q and v (K, n)."""
    driven = force.copy()
    for servo in of_kind(elements, "PositionServo"):
        c = servo.coordinate
        driven[:, c] = drive_force(servo, q[:, c], v[:, c], force[:, c])
    return driven


def dissipates(element: Element | Coupling) -> bool:
    """Whether an element or a coupling may turn energy into heat."""
    if element.kind == "JointStop":
        return element.values[3] > 0.0
    kinds = ELEMENTS if isinstance(element, Element) else COUPLINGS
    return kinds[element.kind].force and element.kind != "FrameWrench"


def keeps_energy(coupling: Coupling) -> bool:
    """Whether a coupling is part of the potential energy."""
    return not COUPLINGS[coupling.kind].force


def forces_of(given: Force | Sequence[Force]) -> tuple[Force, ...]:
    """A force or a sequence of them as a tuple.

    Raises:
        InputError: Something else is given.
    """
    return tuple_of("forces", given, Force)


def not_negative(name: str, value: JointValues, robot: Robot) -> Floats:
    """``value`` as numbers >= 0 for each joint (n,).

    Raises:
        InputError: As :func:`varpin.support.checks.joint_array`, or a number is negative.
    """
    values = joint_array(name, value, robot.joint_names, uniform=True)
    return _refuse(name, values, values < 0.0, "must be >= 0")


def _positive(name: str, value: JointValues, robot: Robot, needed: NDArray[np.bool_]) -> Floats:
    """``value`` for each joint (n,), > 0 where it is needed."""
    values = joint_array(name, value, robot.joint_names, uniform=True)
    return _refuse(name, values, needed & ~(values > 0.0), "must be > 0")


def _ends(name: str, value: JointValues, robot: Robot, absent: float) -> Floats:
    """A limit for each joint (n,), ``absent`` for joints without one."""
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
