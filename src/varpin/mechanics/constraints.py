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
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.arrays import Floats
from varpin.core.arrays import Carried, ConstraintRows, CustomRows, Product, Tied
from varpin.errors import InputError, UnknownJoint
from varpin.mechanics.forces import Described, Point, point_of, require_index, require_movable, shown
from varpin.model import Robot
from varpin.support.checks import as_floats, count, finite, finite_array, is_one_of, positive, returned, tuple_of
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


def bound_constraint(constraint: Constraint, robot: Robot) -> Bound:
    """``constraint.bind(robot)``, which the core can take: subclasses of users are checked here.

    Raises:
        InputError: A body, coordinate or vector out of range, or not a label for each row.
    """
    bound = constraint.bind(robot)
    where = f"{type(constraint).__name__}.bind returned"
    if not isinstance(bound, Bound):
        raise InputError(f"{where} {bound!r}, which is no Bound")
    vectors, products, ties, customs = bound.rows
    for part in (part for vector in vectors for part in vector):
        require_index(f"{where} {part!r}: its body", part.body, -1, len(robot.tree.parent))
    for product in products:
        for index in (product.x, product.y):
            require_index(f"{where} {product!r}: its vector", index, 0, len(vectors))
    for tie in ties:
        for index in (tie.follower, tie.leader):
            require_index(f"{where} {tie!r}: its coordinate", index, 0, robot.dof)
    for index in (index for pair in bound.aligned for index in pair):
        require_index(f"{where} aligned = {bound.aligned!r}: its vector", index, 0, len(vectors))
    rows = len(products) + len(ties) + sum(custom.rows for custom in customs)
    if len(bound.labels) != rows:
        raise InputError(f"{where} {len(bound.labels)} labels for {rows} rows")
    return bound


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
        a, b, _ = _ends(self, robot)
        units = [((Carried(-1, True, _row(np.eye(3)[_AXES.index(axis)])),)) for axis in axes]
        products = tuple(Product(0, 1 + k, 1.0, 0.0) for k in range(len(units)))
        return Bound(ConstraintRows(((a, b), *units), products), tuple(f"{self!r} along {axis}" for axis in axes))


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
        R, x = pose[:3, :3], pose[:3, 3]
        if np.abs(R.T @ R - np.eye(3)).max() > 1e-9 or np.linalg.det(R) < 0.0 or (pose[3] != (0, 0, 0, 1)).any():
            raise InputError("placement must be a matrix (4, 4) of a rotation and a place")
        (a, Ra, at), (b, Rb, there) = point_of("a", self.a, robot), point_of("b", self.b, robot)
        _require_movable(self, a, b, robot)
        axes, others = Ra @ R.T, Rb
        vectors: list[tuple[Carried, ...]] = [(Carried(a, False, _row(at)), Carried(b, False, _row(there + Rb @ x)))]
        vectors += [(Carried(-1, True, _row(axis)),) for axis in np.eye(3)]
        vectors += [(Carried(a, True, _row(axis)),) for axis in axes.T]
        vectors += [(Carried(b, True, _row(axis)),) for axis in others.T]
        # d(y_a . z_b) = (w_a - w_b) . (y_a x z_b), the turn about x.
        turns = [Product(4 + (k + 1) % 3, 7 + (k + 2) % 3, 1.0, 0.0) for k in range(3)]
        rows = ConstraintRows(tuple(vectors), (*(Product(0, 1 + k, 1.0, 0.0) for k in range(3)), *turns))
        # The labels leave out the sixteen numbers of the placement.
        name = f"FrameOnFrame(a={self.a!r}, b={self.b!r})"
        labels = [f"{name} along {axis}" for axis in _AXES] + [f"{name} about {axis}" for axis in _AXES]
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
        a, b, turned = _ends(self, robot)
        normal = turned @ _unit("normal", self.normal)
        vectors = ((a, b), (Carried(b.body, True, _row(normal)),))
        return Bound(ConstraintRows(vectors, (Product(0, 1, 1.0, 0.0),)), (f"{self!r}",))


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
        a, b, turned = _ends(self, robot)
        along = _unit("direction", self.direction)
        first = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
        first /= np.linalg.norm(first)
        across = [turned @ first, turned @ np.cross(along, first)]
        vectors = ((a, b), *((Carried(b.body, True, _row(axis)),) for axis in across))
        rows = ConstraintRows(vectors, (Product(0, 1, 1.0, 0.0), Product(0, 2, 1.0, 0.0)))
        return Bound(rows, (f"{self!r}, first row", f"{self!r}, second row"))


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
        a, b, _ = _ends(self, robot)
        length = positive("length", _number(self.length), "m")
        return Bound(ConstraintRows(((a, b),), (Product(0, 0, 0.5 / length, 0.5 * length),)), (f"{self!r}",))


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
        for name in (self.joint, self.leader):
            if name not in robot.joint_names:
                raise UnknownJoint(str(name), robot.joint_names, "JointTie")
        if self.joint == self.leader:
            raise InputError(f"JointTie ties joint {self.joint!r} to itself")
        given = as_floats("coefficients", self.coefficients)
        if given.ndim != 1 or not given.size:
            raise InputError(f"coefficients must have shape (k,), got {given.shape}")
        c = finite_array("coefficients", given, given.shape)
        tie = Tied(robot.coordinate(self.joint), robot.coordinate(self.leader), tuple(c.tolist()))
        return Bound(ConstraintRows(ties=(tie,)), (f"{self!r}",))


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
        if not isinstance(self.joint, str):
            raise InputError(f"KinematicInput takes the name of a joint, got {self.joint!r}")
        if self.joint not in robot.joint_names:
            raise UnknownJoint(self.joint, robot.joint_names, "KinematicInput")
        if not is_one_of(self.interpolation, ("linear", "cubic")):
            raise InputError(f"interpolation must be 'linear' or 'cubic', got {self.interpolation!r}")
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
        for name in ("value", "jacobian"):
            if not callable(getattr(self, name)):
                raise InputError(f"CustomConstraint: {name} must be a function of q, got {getattr(self, name)!r}")
        if not (self.curvature is None or callable(self.curvature)):
            raise InputError(f"CustomConstraint: curvature must be a function of q and weights, got {self.curvature!r}")

    def bind(self, robot: Robot) -> Bound:
        n, r = robot.dof, int(self.rows)
        custom = CustomRows(r, _Values(self, n), _Curvature(self, n))
        return Bound(ConstraintRows(customs=(custom,)), tuple(f"{self!r}, row {k}" for k in range(r)))


class CustomConstraintError(InputError):
    """A function of a custom constraint raised, or returned a wrong type, shape or value."""


def _called(name: str, call: Callable[[], ArrayLike], shape: tuple[int, ...], q: Floats) -> Floats:
    """The checked result of a function of a custom constraint.

    Raises:
        CustomConstraintError: The function raised, or its result is not a finite array of this shape.
    """
    at = f" at q = {np.array2string(q, precision=6)}"
    return returned(f"the {name} of a CustomConstraint", call, shape, at, CustomConstraintError)


@dataclass(frozen=True)
class _Values:
    """Checked g (r,) and dg/dq (r, n) of a custom constraint."""

    custom: CustomConstraint
    dof: int

    def __call__(self, q: Floats) -> tuple[Floats, Floats]:
        r = int(self.custom.rows)
        return _called("value", lambda: self.custom.value(q), (r,), q), self.jacobian(q)

    def jacobian(self, q: Floats) -> Floats:
        return _called("jacobian", lambda: self.custom.jacobian(q), (int(self.custom.rows), self.dof), q)


@dataclass(frozen=True)
class _Curvature:
    """Checked sum_k w_k d2 g_k/dq2 (n, n) of a custom constraint, by differences where the user gives none."""

    custom: CustomConstraint
    dof: int

    def __call__(self, q: Floats, weights: Floats) -> Floats:
        n = self.dof
        curvature = self.custom.curvature
        if curvature is not None:
            return _called("curvature", lambda: curvature(q, weights), (n, n), q)
        jacobian = _Values(self.custom, n).jacobian
        H = slopes(lambda at: weights @ jacobian(at), q, 1e-3 * np.maximum(1.0, np.abs(q)))
        symmetric: Floats = 0.5 * (H + H.T)
        return symmetric


def constraints_of(given: Constraint | Sequence[Constraint]) -> tuple[Constraint, ...]:
    """A constraint or a sequence of them as a tuple.

    Raises:
        InputError: Something else is given.
    """
    note = "; those of a plan, such as limits and obstacles, belong to varpin.OptimalControlProblem(constraints=)"
    return tuple_of("constraints", given, Constraint, note)


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


def _row(values: Floats) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _number(value: Any) -> float:
    return float(value) if np.ndim(value) == 0 else finite("length", value)


def _unit(name: str, value: ArrayLike) -> Floats:
    given = finite_array(name, value, (3,))
    length = float(np.linalg.norm(given))
    if not length > 0.0:
        raise InputError(f"{name} must not be zero")
    return given / length


def _require_movable(constraint: Constraint, a: int, b: int, robot: Robot) -> None:
    require_movable(constraint, a, b, robot)
    if a == b:
        raise InputError(
            f"{type(constraint).__name__}: both ends are on one body, and no joint moves one against the other"
        )


def _ends(constraint: Any, robot: Robot) -> tuple[Carried, Carried, Floats]:
    """The points a and b, and the rotation (3, 3) of b's frame on its body."""
    (a, _, here), (b, turned, there) = point_of("a", constraint.a, robot), point_of("b", constraint.b, robot)
    _require_movable(constraint, a, b, robot)
    return Carried(a, False, _row(here)), Carried(b, False, _row(there)), turned
