"""Costs of joints and controls: distances from references, changes of controls, and barriers at limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats
from varpin.control.costs.base import (
    BoundCost,
    BoundTerm,
    Cost,
    CostSum,
    LeastSquares,
    Points,
    ReferenceValues,
    checked_reference,
    checked_weight,
    plain,
    sample,
    weight_matrix,
)
from varpin.core import Subject
from varpin.errors import InputError
from varpin.model import Robot, require_robot
from varpin.model.kinematics import require_same
from varpin.support.checks import JointValues, as_floats, control_values, joint_array, some_limits
from varpin.support.frozen import Frozen


class _Quadratic(LeastSquares):
    """weight . (y - y_r)^2 for the block y of z = (q, v, u) of this index."""

    reference: ReferenceValues | Mapping[str, float]
    _block: int

    def __init__(self, reference: ReferenceValues | Mapping[str, float], weight: JointValues) -> None:
        name = type(self).__name__
        self.weight = weight if isinstance(weight, Mapping) else checked_weight(name, weight)
        self.reference = reference if isinstance(reference, Mapping) else checked_reference(name, reference)

    def bind(self, points: Points) -> BoundCost:
        name, of_controls = type(self).__name__, self._block == 2
        size = points.controls if of_controls else points.dof

        def named(what: str, values: Mapping[str, float]) -> Floats:
            if of_controls:
                return control_values(f"{name} {what}", values, points.control_joints, points.controls)
            return joint_array(f"{name} {what}", values, points.joints)

        weight, given = self.weight, self.reference
        if isinstance(weight, Mapping):
            weight = checked_weight(name, named("weight", weight))
        given = named("reference", given) if isinstance(given, Mapping) else given
        reference = sample(name, given, points, (size,), held=of_controls)
        begin = self._block * points.dof
        return BoundTerm(points, Subject.entries, begin, weight_matrix(name, weight, size), reference)


class TrackingCost(_Quadratic):
    """weight . (q - q_r(t))^2: follow a reference in joint space."""

    _block = 0

    def __init__(self, reference: ReferenceValues | Mapping[str, float], weight: JointValues = 1.0) -> None:
        """Describe the cost.

        Args:
            reference: q_r: a function of the time [s] that returns (n,), a constant (n,), by joint name too, with 0 for
                joints that are not named, or an array (N + 1, n) of its values at the problem's nodes, between which it
                is linear [rad or m].
            weight: One number, (n,), by joint name, with 0 for joints that are not named, or a matrix (n, n), positive
                semidefinite.
        """
        super().__init__(reference, weight)


class VelocityCost(_Quadratic):
    """weight . (v - v_r(t))^2."""

    _block = 1

    def __init__(self, weight: JointValues = 1.0, reference: ReferenceValues | Mapping[str, float] = 0.0) -> None:
        """Describe the cost; see :class:`TrackingCost`."""
        super().__init__(reference, weight)


class ControlCost(_Quadratic):
    """weight . (u - u_r(t))^2."""

    _block = 2
    of_controls = True

    def __init__(self, weight: JointValues = 1.0, reference: ReferenceValues | Mapping[str, float] = 0.0) -> None:
        """Describe the cost; see :class:`TrackingCost`, with m controls for n coordinates.

        Args:
            weight: One number, (m,), by joint name where each control is the force of a joint, or a matrix (m, m),
                positive semidefinite.
            reference: u_r: a function of the time [s], a constant, by joint name too, or an array of rows of m: N + 1
                of them as there, or N, one for each step and constant over it, as controls are; for example those of
                another solution.
        """
        super().__init__(reference, weight)


class ControlRateCost(LeastSquares):
    """weight . (du/dt)^2: keep controls smooth.

    Controls are constant over a period T = hold dt and jump between periods. The cost is the integral of the squared
    rate of the line through them, the sum over decisions of weight . (u_k - u_(k-1))^2 / T. For controls that are
    smooth in time it is the same at every ``dt``, up to an error of order T.
    """

    before: Floats | Mapping[str, float] | None
    of_controls = True

    def __init__(self, weight: JointValues = 1.0, before: JointValues | None = None) -> None:
        """Describe the cost.

        Args:
            weight: One number, (m,), by joint name where each control is the force of a joint, or a matrix (m, m),
                positive semidefinite [cost s / control^2].
            before: The control before the horizon, for the first change: one number, (m,) or by joint name. By default
                the first control is free.
        """
        self.weight = weight if isinstance(weight, Mapping) else checked_weight("ControlRateCost", weight)
        self.before = (
            before if before is None or isinstance(before, Mapping) else as_floats("ControlRateCost before", before)
        )

    def _text(self) -> str:
        own = super()._text()
        return own if self.before is None else f"{own[:-1]}, before={plain(self.before)})"

    def bind(self, points: Points) -> BoundCost:  # noqa: ARG002
        """Raise an error: the cost has no value at single points, and a problem takes it by :func:`control_rate`.

        Raises:
            InputError: Always: the cost is part of another cost than a sum.
        """
        raise InputError(f"{self!r} must be a term of a problem's cost, scaled or not, and no part of another")


@dataclass(frozen=True, eq=False)
class ControlRate(Frozen):
    """The total cost of control changes, (O5).

    Attributes:
        weight: (m, m).
        before: The control before the horizon (m,), or None where the first one is free.
    """

    weight: Floats
    before: Floats | None

    def shares(self, u: Floats, period: float) -> Floats:
        """Costs (..., N) of the changes to each of N controls (..., N, m) that change every ``period`` [s]."""
        changes = self._changes(u)
        shares: Floats = ((changes @ (self.weight / period)) * changes).sum(axis=-1)
        return shares

    def expand(self, u: Floats, period: float) -> tuple[Floats, Floats]:
        """Gradients (N, m) and Hessians (N, m, m) in u_k of the cost of each change, at controls (N, m)."""
        hessian = np.tile(2.0 * self.weight / period, (len(u), 1, 1))
        if self.before is None:
            hessian[:1] = 0.0
        return 2.0 * self._changes(u) @ (self.weight / period), hessian

    def _changes(self, u: Floats) -> Floats:
        """The change to each control (..., N, m); none to a first one that is free."""
        first = u[..., :1, :]
        changes: Floats = np.diff(u, axis=-2, prepend=first if self.before is None else first * 0.0 + self.before)
        return changes


def control_rate(cost: Cost, controls: int, joints: Sequence[str] | None = None) -> ControlRate | None:
    """The sum of a cost's terms on the rate of m controls; None if there is none.

    ``joints`` are those whose force each control is; None where controls are something else.

    Raises:
        UnknownJoint: A name that is no driven joint's.
        InputError: Weights or controls of a wrong size, or terms with different controls before.
    """
    name = "ControlRateCost"
    weight = np.zeros((controls, controls))
    starts: dict[object, Floats | None] = {}
    for term in cost.terms:
        if not isinstance(term, ControlRateCost):
            continue
        entries = term.weight
        if isinstance(entries, Mapping):
            entries = checked_weight(name, control_values(f"{name} weight", entries, joints, controls))
        weight += term.factor * weight_matrix(name, entries, controls)
        start = term.before
        if start is not None:
            start = control_values(f"{name} before", start, joints, controls, uniform=True)
        starts[None if start is None else tuple(start.tolist())] = start
    if len(starts) > 1:
        raise InputError(f"{name} terms of one cost must have the same control before")
    return ControlRate(weight, *starts.values()) if starts else None


def with_control_before(cost: Cost, before: Floats) -> Cost:
    """The same cost with another control before the horizon (m,)."""
    terms = (term.changed(before=before) if isinstance(term, ControlRateCost) else term for term in cost.terms)
    return CostSum(tuple(terms))


class _Barrier(LeastSquares):
    weight: Floats
    limits: Floats
    _block: int

    def __init__(
        self,
        robot: Robot,
        weight: JointValues = 1.0,
        margin: JointValues = 0.0,
        limits: tuple[JointValues, JointValues] | None = None,
    ) -> None:
        """Describe the cost.

        Args:
            robot: The robot.
            weight: One number, (n,), by joint name, or a matrix (n, n), positive semidefinite.
            margin: One number, (n,) or by joint name, >= 0, in the units of the limits. At most half the distance
                between the limits of a joint is used.
            limits: (lower, upper), each one number, (n,) or by joint name, infinite where there is none; the robot's if
                left out [rad or m; of velocities rad/s or m/s].
        """
        name, joints = type(self).__name__, require_robot(robot, type(self).__name__).joint_names
        self.robot = robot
        given = joint_array(f"{name} weight", weight, joints) if isinstance(weight, Mapping) else weight
        self.weight = checked_weight(name, given)
        own = (-robot.velocity_limit, robot.velocity_limit) if self._block else robot.position_limits
        self.limits = some_limits(name, limits, own, robot.name, joints)
        margin = joint_array(f"{name} margin", margin, joints, uniform=True)
        if (margin < 0.0).any():
            raise InputError(f"{name} margin must be >= 0, got {margin.min():g}")
        self.margin = np.minimum(margin, 0.5 * (self.limits[1] - self.limits[0]))

    def bind(self, points: Points) -> BoundCost:
        name = type(self).__name__
        require_same(name, self.robot, points.robot)
        weight = weight_matrix(name, self.weight, points.dof)
        limits = np.hstack([self.limits[0] + self.margin, self.limits[1] - self.margin])[None]
        return BoundTerm(points, Subject.excess, self._block * points.dof, weight, limits)


class JointLimitBarrier(_Barrier):
    """weight . (what q is beyond a limit less a margin)^2: keep joints within their limits.

    A penalty that begins ``margin`` before the limit and is zero farther inside; it is finite beyond the limit, so that
    a search may begin there.
    """

    _block = 0


class VelocityLimitBarrier(_Barrier):
    """weight . (what v is beyond a limit less a margin)^2; see :class:`JointLimitBarrier`."""

    _block = 1
