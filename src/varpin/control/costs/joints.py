"""Costs of joints and controls: distances from references, and barriers at limits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from varpin.arrays import Floats
from varpin.control.costs.base import (
    BoundCost,
    BoundTerm,
    LeastSquares,
    Points,
    ReferenceValues,
    checked_weight,
    sample,
    weight_matrix,
)
from varpin.core import Subject
from varpin.errors import InputError
from varpin.model import Robot, require_robot
from varpin.model.kinematics import require_same
from varpin.support.checks import JointValues, as_floats, control_array, joint_array, some_limits


class _Quadratic(LeastSquares):
    """weight . (y - y_r)^2 for the block y of z = (q, v, u) of this index."""

    reference: ReferenceValues | Mapping[str, float]
    _block: int

    def __init__(self, reference: ReferenceValues | Mapping[str, float], weight: JointValues) -> None:
        name = type(self).__name__
        self.weight = weight if isinstance(weight, Mapping) else checked_weight(name, weight)
        given = isinstance(reference, Mapping) or callable(reference)
        self.reference = reference if given else as_floats(f"{name} reference", reference)

    def bind(self, points: Points) -> BoundCost:
        name, of_controls = type(self).__name__, self._block == 2
        size = points.controls if of_controls else points.dof

        def named(what: str, values: Mapping[str, float]) -> Floats:
            if of_controls:
                return control_array(f"{name} {what}", values, points.control_joints)
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
