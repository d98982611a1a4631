"""Forces on joints and frames: springs, dampers, friction, stops, rotors, servos, wrenches. A scene takes any number.

    scene = vp.Scene(robot, forces=[vp.CoulombFriction(0.5), vp.JointStop(stiffness=1e3, damping=5.0)])

Every integrator takes them, in steps, in linearizations of first and second order, in energies and in dissipated work.
Parameters of forces on joints are one number for every joint, (n,), or numbers by joint name; a joint without a number
has no such force. Forces on frames act at points: a frame name for the frame's origin, (frame name, point in the
frame's axes (3,) [m]), or, for forces with two ends, a point in world axes (3,) [m].
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats, Mask
from varpin.core import coupling_kinds, element_kinds
from varpin.core.arrays import Coupling, Element
from varpin.errors import InputError
from varpin.model import Robot, in_degrees
from varpin.model.tree import place_of_frame
from varpin.support.checks import JointValues, as_floats, finite_array, joint_array, rotation_matrix, word
from varpin.support.frozen import Frozen

logger = logging.getLogger(__name__)

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
# Kinds of elements whose sums by joint are attributes of a scene.
SUMMED = ("Armature", "JointDamper", "JointSpring")


def bound_force(force: Force, robot: Robot) -> tuple[Element | Coupling, ...]:
    """``force.bind(robot)``; what else than numbers of the core the ``bind`` of a user returns is refused here."""
    parts = tuple(force.bind(robot))
    for part in parts:
        if not isinstance(part, Element | Coupling) or np.isnan(as_floats("values", part.values)).any():
            raise InputError(
                f"{type(force).__name__}.bind returned {part!r}: it must be an Element or a Coupling without NaN"
            )
    return parts


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
    if callable(value):
        return str(getattr(value, "__name__", repr(value)))
    if isinstance(value, tuple):
        return f"({', '.join(map(shown, value))})"
    if isinstance(value, np.ndarray | np.generic):
        return str(value.tolist())
    return repr(dict(value) if isinstance(value, Mapping) else value)


# Parameters of forces on joints, other than those >= 0: of any sign, > 0 where the force acts, and limits, with the
# number for joints without one.
_SIGNED, _POSITIVE = ("rest", "lower", "upper"), ("width", "stribeck_velocity", "effort")
_LIMITS = {"lower": -np.inf, "upper": np.inf, "effort": np.inf}


@dataclass(frozen=True, eq=False, repr=False)
class JointForce(Force):
    """A force on single joints, whose parameters are numbers for each joint.

    Attributes:
        columns: The parameters in the order of the core; that of the class if empty.
    """

    columns: ClassVar[tuple[str, ...]] = ()

    def bind(self, robot: Robot) -> tuple[Element, ...]:
        numbers: dict[str, Floats] = {}
        given = (item for item in fields(self) if item.default is not None or getattr(self, item.name) is not None)
        for name in (item.name for item in given):
            none = _LIMITS.get(name, 0.0)
            values = joint_array(name, getattr(self, name), robot.joint_names, uniform=True, absent=none)
            if name in _LIMITS:
                refuse_where(
                    name, values, np.isnan(values) | (values == -none), f"must be a number, or {none} for none"
                )
            if name not in _SIGNED + _POSITIVE:
                refuse_where(name, values, values < 0.0, "must be >= 0")
            numbers[name] = values
        acts = self.acts(numbers, robot)
        for name in numbers.keys() & set(_POSITIVE):
            refuse_where(name, numbers[name], acts & ~(numbers[name] > 0.0), "must be > 0")
        for name in (name for name in _SIGNED if name in numbers):
            places = np.where(acts & np.isfinite(numbers[name]), numbers[name], 0.0)
            for finding in in_degrees(robot, f"{name} of the {type(self).__name__}", places):
                logger.warning(finding)
        table = np.column_stack([numbers[name] for name in self.columns or numbers])
        return tuple(Element(type(self).__name__, int(c), tuple(table[c].tolist())) for c in np.flatnonzero(acts))

    def acts(self, numbers: dict[str, Floats], robot: Robot) -> Mask:  # noqa: ARG002
        """Whether the force acts on each joint (n,); parameters that are left out are added to ``numbers`` here."""
        return np.asarray(next(iter(numbers.values())) > 0.0)


@dataclass(frozen=True, eq=False, repr=False)
class JointSpring(JointForce):
    """Linear springs: the force -stiffness * (q - rest). Their energy is part of the potential energy.

    Attributes:
        stiffness: >= 0 [N m/rad or N/m].
        rest: Position without force [rad or m].
    """

    stiffness: JointValues
    rest: JointValues = 0.0


@dataclass(frozen=True, eq=False, repr=False)
class JointDamper(JointForce):
    """Viscous damping: the force -damping * v.

    Attributes:
        damping: >= 0 [N m s/rad or N s/m].
    """

    damping: JointValues


@dataclass(frozen=True, eq=False, repr=False)
class Armature(JointForce):
    """Rotor inertia reflected to the joints, gear ratio squared times rotor inertia; it adds to the robot's armature.

    Attributes:
        inertia: >= 0 [kg m^2 or kg].
    """

    inertia: JointValues


@dataclass(frozen=True, eq=False, repr=False)
class CoulombFriction(JointForce):
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
    columns = ("level", "width", "breakaway", "stribeck_velocity")

    def acts(self, numbers: dict[str, Floats], robot: Robot) -> Mask:  # noqa: ARG002
        if (self.breakaway is None) != (self.stribeck_velocity is None):
            raise InputError("breakaway and stribeck_velocity belong together: give both or neither")
        level = numbers["level"]
        breakaway = numbers.setdefault("breakaway", level)
        numbers.setdefault("stribeck_velocity", np.ones_like(level))
        acts = np.maximum(level, breakaway) > 0.0
        refuse_where("breakaway", breakaway, acts & (breakaway < level), "must be at least the level")
        return np.asarray(acts)


@dataclass(frozen=True, eq=False, repr=False)
class JointStop(JointForce):
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
    columns = ("lower", "upper", "stiffness", "damping", "width")

    def acts(self, numbers: dict[str, Floats], robot: Robot) -> Mask:
        ends = zip(("lower", "upper"), robot.position_limits, strict=True)
        lower, upper = (numbers.setdefault(name, own) for name, own in ends)
        given = (numbers["stiffness"] > 0.0) | (numbers["damping"] > 0.0)
        acts = given & (np.isfinite(lower) | np.isfinite(upper))
        endless = np.array(robot.joint_names)[given & ~acts]
        # One number for all joints skips those without limits, such as continuous joints.
        if endless.size and (isinstance(self.stiffness, Mapping) or not acts.any()):
            raise InputError(
                f"JointStop: {robot.name} has no position limits for {', '.join(map(repr, endless.tolist()))}: give "
                "lower= and upper="
            )
        refuse_where("lower", lower, acts & ~(lower < upper), "must be below the upper end")
        return np.asarray(acts)


@dataclass(frozen=True, eq=False, repr=False)
class PositionServo(JointForce):
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
        word("axes", self.axes, ("world", "frame"))
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
        (a, here, x), (b, there, y) = ends_of(self, robot)
        found = self._of_points()
        springs = [Coupling(kind, a, b, (*x.tolist(), *y.tolist(), *numbers)) for kind, numbers in found]
        # One spring between each axis of frame a and its rest direction in b.
        R = np.eye(3) if self.rest_rotation is None else rotation_matrix("rest_rotation", self.rest_rotation)
        if self.rotational_stiffness is None:
            if self.rest_rotation is not None:
                raise InputError("rest_rotation is of a rotational_stiffness, and there is none")
            return tuple(springs)
        about = _along_axes("rotational_stiffness", self.rotational_stiffness)
        weights, slack = 0.5 * about.sum() - about, there @ R
        for i in np.flatnonzero(weights):
            axes = (*here[:, i].tolist(), *slack[:, i].tolist())
            springs.append(Coupling("FrameTurnSpring", a, b, (*axes, float(weights[i]))))
        return tuple(springs)

    def _of_points(self) -> list[tuple[str, list[float]]]:
        """The kind of the spring between the points, and its numbers; empty for none."""
        stiffness, rest = _along_axes("stiffness", self.stiffness), as_floats("rest", self.rest)
        if rest.shape not in ((), (3,)) or not np.isfinite(rest).all() or (rest.ndim == 0 and rest < 0.0):
            raise InputError(f"rest must be a length >= 0, or finite along three axes (3,), got {shown(rest)}")
        if not stiffness.any():
            return []
        if rest.ndim == 0 and rest > 0.0:
            if np.ndim(self.stiffness):
                raise InputError("a spring with a length at rest has one stiffness, and not one along each axis")
            return [("FrameLengthSpring", [stiffness[0], float(rest)])]
        return [("FrameSpring", [*stiffness.tolist(), *np.broadcast_to(rest, (3,)).tolist()])]


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
        (a, _, x), (b, _, y) = ends_of(self, robot)
        found = []
        for kind, name in (("FrameDamper", "damping"), ("FrameTurnDamper", "rotational_damping")):
            given = getattr(self, name)
            damping = np.zeros(3) if given is None else _along_axes(name, given)
            if damping.any():
                found.append(Coupling(kind, a, b, (*x.tolist(), *y.tolist(), *damping.tolist())))
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
    body, turned, at = place_of_frame(robot.model, frame, robot.name)
    return body, turned, at + turned @ place


End: TypeAlias = tuple[int, Floats, Floats]


def ends_of(owner: Any, robot: Robot) -> tuple[End, End]:
    """:func:`point_of` of the ends a and b of a force or constraint.

    Raises:
        InputError: Both are fixed, in the world or to the base.
    """
    a, b = point_of("a", owner.a, robot), point_of("b", owner.b, robot)
    if a[0] < 0 and b[0] < 0:
        raise InputError(
            f"{type(owner).__name__}: both ends are fixed, in the world or to the base of robot {robot.name!r}: no "
            "joint moves one"
        )
    return a, b


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


def drive_forces(elements: Iterable[Element], q: Floats, v: Floats, force: Floats) -> Floats:
    """``force`` (K, n) [N m or N] with S of :class:`PositionServo` in the columns of servos, at q and v (K, n).

    Those of ``force`` are stiffness times command.
    """
    driven = force.copy()
    for servo in of_kind(elements, "PositionServo"):
        c, (stiffness, damping, effort) = servo.coordinate, servo.values
        wanted = force[:, c] - stiffness * q[:, c] - damping * v[:, c]
        if np.isfinite(effort):
            over = np.clip(np.abs(wanted) / effort - 0.9, 0.0, 0.2)
            wanted = np.sign(wanted) * effort * (np.minimum(np.abs(wanted) / effort, 0.9) + over - 2.5 * over**2)
        driven[:, c] = wanted
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


def refuse_where(name: str, values: Floats, wrong: Mask, what: str) -> None:
    """Refuse the first of the values (n,) that is wrong."""
    if wrong.any():
        c = int(np.argmax(wrong))
        raise InputError(f"{name}[{c}] is {values[c]}; it {what}")
