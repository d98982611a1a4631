"""Holonomic constraints g(q) = 0: closed loops, welds, planes, lines, rods, gears, user functions.

    scene = vp.Scene(robot, constraints=[vp.PointOnPoint("tip", (1.0, 0.0, 0.0), axes="xz")])

They hold at every node and at inner points of every step. They are bilateral: there is no contact and no impact.
Points are given as in :mod:`varpin.mechanics.forces`: a frame name for the frame's origin, (frame name, point in the
frame's axes (3,) [m]), or a point in world axes (3,) [m].
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.arrays import Floats
from varpin.core.arrays import Carried, ConstraintRows, CustomRows, Product, Tied
from varpin.errors import InputError
from varpin.mechanics.forces import Described, End, Point, ends_of, shown
from varpin.model import Robot
from varpin.support.checks import (
    as_floats,
    count,
    finite_array,
    positive,
    require_function,
    returned,
    rotation_matrix,
    word,
)
from varpin.support.differences import slopes

_AXES = "xyz"


class Bound(NamedTuple):
    """A constraint on a robot, in the form of the core."""

    rows: ConstraintRows
    labels: tuple[str, ...]  # one for each row
    # Pairs of vectors whose product is 1 in the intended assembly, and -1 or 0 in others that satisfy the rows.
    aligned: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class Constraint(Described, ABC):
    """A holonomic constraint of one or several rows g(q) = 0."""

    @abstractmethod
    def bind(self, robot: Robot) -> Bound:
        """The constraint on a robot.

        Raises:
            InputError: A wrong shape; a value that is not finite or out of range; no joint moves either end.
            UnknownJoint: A joint is no coordinate of the robot.
            UnknownFrame: The robot has no such frame.
        """


@dataclass(frozen=True, eq=False, repr=False)
class PointOnPoint(Constraint):
    """Two points that coincide along some world axes, for closed loops: g = x_a - x_b.

    The constraint forces act on a along these axes, and with opposite sign on b [N].

    Attributes:
        a: First point.
        b: Second point.
        axes: Constrained world axes, some of ``"xyz"``.
    """

    a: Point
    b: Point
    axes: str = "xyz"

    def bind(self, robot: Robot) -> Bound:
        axes = self.axes
        if not (isinstance(axes, str) and axes and set(axes) <= set(_AXES) and len(set(axes)) == len(axes)):
            raise InputError(f"axes must be some of 'xyz', each once, got {axes!r}")
        a, b = _ends(self, robot)
        units = np.eye(3)[[_AXES.index(axis) for axis in axes]]
        return _along(a, b, -1, units, [f"{self!r} along {axis}" for axis in axes])


@dataclass(frozen=True, eq=False, repr=False)
class FrameOnFrame(Constraint):
    """Two frames welded together: three rows of position and three of rotation.

    The constraint forces act on a along the world axes [N], the moments about the axes of b [N m].

    Attributes:
        a: Name of the first frame.
        b: Name of the second frame; ``"universe"`` is the world.
        placement: Pose of a in b's axes, (4, 4) homogeneous matrix of a rotation and a translation [m]; the identity if
            left out.
    """

    a: str
    b: str
    placement: ArrayLike | None = None

    def bind(self, robot: Robot) -> Bound:
        for name in ("a", "b"):
            if not isinstance(getattr(self, name), str):
                raise InputError(f"FrameOnFrame: {name} must be a frame's name, got {shown(getattr(self, name))}")
        pose = np.eye(4) if self.placement is None else finite_array("placement", self.placement, (4, 4))
        R, x = rotation_matrix("placement[:3, :3]", pose[:3, :3]), pose[:3, 3]
        if (pose[3] != (0, 0, 0, 1)).any():
            raise InputError(f"placement[3] must be 0, 0, 0, 1, got {pose[3]}")
        (a, Ra, at), (b, Rb, there) = _ends(self, robot)
        # The labels leave out the sixteen numbers of the placement.
        name = f"FrameOnFrame(a={self.a!r}, b={self.b!r})"
        labels = [f"{name} {how} {axis}" for how in ("along", "about") for axis in _AXES]
        places = _along((a, Ra, at), (b, Rb, there + Rb @ x), -1, np.eye(3), labels[:3]).rows
        axes = (*(_direction(a, axis) for axis in (Ra @ R.T).T), *(_direction(b, axis) for axis in Rb.T))
        # d(y_a . z_b) = (w_a - w_b) . (y_a x z_b), the turn about x.
        turns = [Product(4 + (k + 1) % 3, 7 + (k + 2) % 3, 1.0, 0.0) for k in range(3)]
        rows = ConstraintRows((*places.vectors, *axes), (*places.products, *turns))
        return Bound(rows, tuple(labels), tuple((4 + k, 7 + k) for k in range(3)))


@dataclass(frozen=True, eq=False, repr=False)
class PointOnPlane(Constraint):
    """A point on a plane: g = normal . (x_a - x_b). The constraint force acts on a along the normal [N].

    Attributes:
        a: The point.
        b: A point of the plane; it may be fixed to a frame.
        normal: Normal of the plane (3,), of any length, in the axes of b's frame, or of the world.
    """

    a: Point
    b: Point
    normal: ArrayLike

    def bind(self, robot: Robot) -> Bound:
        a, b = _ends(self, robot)
        return _along(a, b, b[0], [b[1] @ _unit("normal", self.normal)], [f"{self!r}"])


@dataclass(frozen=True, eq=False, repr=False)
class PointOnLine(Constraint):
    """A point on a line. The two constraint forces act on a across the line [N].

    Attributes:
        a: The point.
        b: A point of the line; it may be fixed to a frame.
        direction: Direction of the line (3,), of any length, in the axes of b's frame, or of the world.
    """

    a: Point
    b: Point
    direction: ArrayLike

    def bind(self, robot: Robot) -> Bound:
        a, b = _ends(self, robot)
        along = _unit("direction", self.direction)
        first = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
        first /= np.linalg.norm(first)
        across = [b[1] @ first, b[1] @ np.cross(along, first)]
        return _along(a, b, b[0], across, [f"{self!r}, first row", f"{self!r}, second row"])


@dataclass(frozen=True, eq=False, repr=False)
class Distance(Constraint):
    """Two points at a fixed distance (a rigid rod): g = (d . d - length^2) / (2 length), d = x_a - x_b.

    The constraint force acts on a, away from b [N].

    Attributes:
        a: First point.
        b: Second point.
        length: > 0 [m].
    """

    a: Point
    b: Point
    length: float

    def bind(self, robot: Robot) -> Bound:
        a, b = _ends(self, robot)
        length = positive("length", self.length, "m")
        rows = ConstraintRows(((_point(a), _point(b)),), (Product(0, 0, 0.5 / length, 0.5 * length),))
        return Bound(rows, (f"{self!r}",))


@dataclass(frozen=True, eq=False, repr=False)
class JointTie(Constraint):
    """A joint that follows another, as with gears and cams: g = q_joint - (c_0 + c_1 q_leader + c_2 q_leader^2 + ...).

    The constraint force is the one on the following joint [N m or N].

    Attributes:
        joint: Name of the following joint.
        leader: Name of the leading joint.
        coefficients: c (k,); (0, r) is a gear of ratio r.
    """

    joint: str
    leader: str
    coefficients: ArrayLike = (0.0, 1.0)

    def bind(self, robot: Robot) -> Bound:
        follower, leader = robot.coordinate(self.joint), robot.coordinate(self.leader)
        if follower == leader:
            raise InputError(f"JointTie ties joint {self.joint!r} to itself")
        given = as_floats("coefficients", self.coefficients)
        if given.ndim != 1 or not given.size:
            raise InputError(f"coefficients must have shape (k,), got {given.shape}")
        c = finite_array("coefficients", given, given.shape)
        return Bound(ConstraintRows(ties=(Tied(follower, leader, tuple(c.tolist())),)), (f"{self!r}",))


@dataclass(frozen=True, eq=False, repr=False)
class KinematicInput(Constraint):
    """A joint with a prescribed motion: its control is its position at the end of each step, and its force results.

    Row k of the controls holds the joint's position [rad or m] at node k + 1, in place of a force. A function of time
    returns the position at that time, a control law the position at the end of its period. The joint needs a control of
    its own: a column of the actuation with a 1, as in the default actuation.
    ``Trajectory.constraint_forces`` holds the mean force on the joint over each step [N m or N].

    Attributes:
        joint: Name of the joint.
        interpolation: Motion within a step. ``"linear"``: constant rate. ``"cubic"``: the cubic through position and
            velocity at both nodes. A cubic has a second control, the velocity at node k + 1 [rad/s or m/s]: a column
            that the scene adds behind those of ``actuation``, in the order of the scene's constraints. Velocities are
            then continuous, and no impulse acts at nodes.
    """

    joint: str
    interpolation: Literal["linear", "cubic"] = "linear"

    def __repr__(self) -> str:
        shape = "" if self.interpolation == "linear" else f", interpolation={self.interpolation!r}"
        return f"KinematicInput(joint={self.joint!r}{shape})"

    def bind(self, robot: Robot) -> Bound:
        word("interpolation", self.interpolation, ("linear", "cubic"))
        c = robot.coordinate(self.joint)
        # 0 marks a cubic; the scene fills in the index of the velocity control.
        rate = 0 if self.interpolation == "cubic" else -1
        return Bound(ConstraintRows(ties=(Tied(c, c, (), rate),)), (f"{self!r}",))


@dataclass(frozen=True, eq=False, repr=False)
class CustomConstraint(Constraint):
    """Constraints that the user writes in Python. Their generalized force is jacobian' lambda, one lambda per row.

    Attributes:
        rows: Number of rows r.
        value: g, a function of q (n,) that returns (r,), in [m] or [rad].
        jacobian: dg/dq, a function of q that returns (r, n). It must be exact: it also gives the constraint forces.
        curvature: sum_k w_k d2 g_k/dq2, a function of q and weights w (r,) that returns (n, n). If left out,
            differences of the Jacobian replace it, and linearizations are accurate to about 1e-9.
    """

    rows: int
    value: Callable[[Floats], ArrayLike]
    jacobian: Callable[[Floats], ArrayLike]
    curvature: Callable[[Floats, Floats], ArrayLike] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        count("rows", self.rows, least=1)
        for name in ("value", "jacobian", "curvature"):
            require_function(f"CustomConstraint {name}", getattr(self, name), "q", optional=name == "curvature")

    def bind(self, robot: Robot) -> Bound:  # noqa: ARG002
        r = int(self.rows)
        rows = ConstraintRows(customs=(CustomRows(r, self._values_at, self._curvature_at),))
        return Bound(rows, tuple(f"{self!r}, row {k}" for k in range(r)))

    def _values_at(self, q: Floats) -> tuple[Floats, Floats]:
        """Checked g (r,) and dg/dq (r, n)."""
        return self._checked("value", (int(self.rows),), q), self._jacobian_at(q)

    def _jacobian_at(self, q: Floats) -> Floats:
        return self._checked("jacobian", (int(self.rows), q.size), q)

    def _curvature_at(self, q: Floats, weights: Floats) -> Floats:
        """Checked sum_k w_k d2 g_k/dq2 (n, n), by differences where the user gives none."""
        if self.curvature is not None:
            return self._checked("curvature", (q.size, q.size), q, weights)
        H = slopes(lambda at: weights @ self._jacobian_at(at), q, 1e-3 * np.maximum(1.0, np.abs(q)))
        symmetric: Floats = 0.5 * (H + H.T)
        return symmetric

    def _checked(self, name: str, shape: tuple[int, ...], *arguments: Floats) -> Floats:
        """The result of a function; a CustomConstraintError if it raised, or is not a finite array of this shape."""
        call, told = partial(getattr(self, name), *arguments), f"the {name} of a CustomConstraint"
        at = partial(np.array2string, arguments[0], precision=6)
        return returned(told, call, shape, lambda: f" at q = {at()}", CustomConstraintError)


class CustomConstraintError(InputError):
    """A function of a custom constraint raised, or returned a wrong type, shape or value."""


def bound_constraint(constraint: Constraint, robot: Robot) -> Bound:
    """``constraint.bind(robot)``; what a user's ``bind`` returns is refused here where it does not fit together."""
    bound, name = constraint.bind(robot), f"{type(constraint).__name__}.bind"
    if not isinstance(bound, Bound):
        raise InputError(f"{name} must return a Bound, got {type(bound).__name__}")
    rows = len(bound.rows.products) + len(bound.rows.ties) + sum(custom.rows for custom in bound.rows.customs)
    if len(bound.labels) != rows:
        raise InputError(f"{name} must return a label for each of its {rows} rows, got {len(bound.labels)}")
    axes = {k for k, vector in enumerate(bound.rows.vectors) if len(vector) == 1}
    pairs = {k for product in bound.rows.products for k in (product.x, product.y)}
    if not (pairs <= set(range(len(bound.rows.vectors))) and axes.issuperset(chain(*bound.aligned))):
        raise InputError(f"{name} must return indices of its vectors, those of aligned axes of one direction each")
    return bound


def joined(bound: Sequence[Bound]) -> tuple[Bound, NDArray[np.int64]]:
    """All constraints as one with its rows in the core's order, and the position there of each row as given (c,)."""
    vectors: list[tuple[Carried, ...]] = []
    products: list[Product] = []
    labels: list[str] = []
    aligned: list[tuple[int, int]] = []
    kinds: list[int] = []
    for constraint in bound:
        first, rows = len(vectors), constraint.rows
        vectors += rows.vectors
        products += [product._replace(x=product.x + first, y=product.y + first) for product in rows.products]
        labels += constraint.labels
        aligned += [(x + first, y + first) for x, y in constraint.aligned]
        counts = len(rows.products), len(rows.ties), sum(custom.rows for custom in rows.customs)
        kinds += np.repeat([0, 1, 2], counts).tolist()
    core = np.argsort(np.array(kinds, dtype=np.int64), kind="stable")
    ties = tuple(tie for constraint in bound for tie in constraint.rows.ties)
    customs = tuple(custom for constraint in bound for custom in constraint.rows.customs)
    together = ConstraintRows(tuple(vectors), tuple(products), ties, customs)
    return Bound(together, tuple(labels[row] for row in core), tuple(aligned)), np.argsort(core)


def _along(a: End, b: End, body: int, axes: Sequence[Floats] | Floats, labels: Sequence[str]) -> Bound:
    """Rows axis . (x_a - x_b), with axes (3,) that are fixed to a body."""
    vectors = ((_point(a), _point(b)), *(_direction(body, axis) for axis in axes))
    products = tuple(Product(0, 1 + k, 1.0, 0.0) for k in range(len(axes)))
    return Bound(ConstraintRows(vectors, products), tuple(labels))


def _point(end: End) -> Carried:
    x, y, z = end[2].tolist()
    return Carried(end[0], False, (x, y, z))


def _direction(body: int, axis: Floats) -> tuple[Carried]:
    x, y, z = axis.tolist()
    return (Carried(body, True, (x, y, z)),)


def _unit(name: str, value: ArrayLike) -> Floats:
    given = finite_array(name, value, (3,))
    length = float(np.linalg.norm(given))
    if not length > 0.0:
        raise InputError(f"{name} must not be zero")
    return given / length


def _ends(constraint: Constraint, robot: Robot) -> tuple[End, End]:
    a, b = ends_of(constraint, robot)
    if a[0] == b[0]:
        raise InputError(
            f"{type(constraint).__name__}: both ends are on one body, and no joint moves one against the other"
        )
    return a, b
