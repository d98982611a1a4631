"""Barriers at the limits of joints: their positions and their velocities."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats
from varpin.control.costs.base import BoundCost, CompiledCost, Cost, Points, Scaled, Terminal
from varpin.control.costs.residual import TaskCost
from varpin.control.costs.terms import Terms
from varpin.errors import InputError
from varpin.model import Robot
from varpin.support.checks import JointValues, joint_array, some_limits


@dataclass(frozen=True, eq=False)
class _BoundBarrier(CompiledCost):
    begin: int
    weight: Floats  # (n, n)
    lower: Floats  # (n,)
    upper: Floats  # (n,)
    points: Points

    def add_to(self, terms: Terms, factor: float) -> bool:
        terms.add_excess(self.begin, factor * self.weight, self.lower, self.upper)
        return True


class _Barrier(TaskCost):
    limits: Floats
    in_velocity: bool

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

        Raises:
            InputError: There is no limit, or an argument has a wrong shape or value.
        """
        self.size = robot.dof if isinstance(robot, Robot) else 0
        name = type(self).__name__
        if isinstance(weight, Mapping) and isinstance(robot, Robot):
            weight = joint_array(f"{name} weight", weight, robot.joint_names)
        super().__init__(robot, weight)
        self.limits = some_limits(name, limits, self._limits_of(robot), robot.name, robot.joint_names)
        self.margin = joint_array(f"{name} margin", margin, robot.joint_names, uniform=True)
        if (self.margin < 0.0).any():
            raise InputError(f"{name} margin must be >= 0, got {self.margin.min():g}")
        self.margin = np.minimum(self.margin, 0.5 * (self.limits[1] - self.limits[0]))

    @staticmethod
    @abstractmethod
    def _limits_of(robot: Robot) -> tuple[Floats, Floats]:
        """The robot's limits."""

    def _bound(self, points: Points, weight: Floats) -> BoundCost:
        begin = points.dof if self.in_velocity else 0
        return _BoundBarrier(begin, weight, self.limits[0] + self.margin, self.limits[1] - self.margin, points)


class JointLimitBarrier(_Barrier):
    """weight . (what q is beyond a limit less a margin)^2: keep joints within their limits.

    A penalty that begins ``margin`` before the limit and is zero farther inside; it is finite beyond the limit, so that
    a search may begin there. ``Solution.violations`` has the remaining excess.
    """

    in_velocity = False

    @staticmethod
    def _limits_of(robot: Robot) -> tuple[Floats, Floats]:
        return robot.position_limits


class VelocityLimitBarrier(_Barrier):
    """weight . (what v is beyond a limit less a margin)^2; see :class:`JointLimitBarrier`."""

    in_velocity = True

    @staticmethod
    def _limits_of(robot: Robot) -> tuple[Floats, Floats]:
        return -robot.velocity_limit, robot.velocity_limit


def barriers_of(cost: Cost) -> tuple[list[JointLimitBarrier], list[VelocityLimitBarrier]]:
    """The barriers among the terms of a cost."""
    joints: list[JointLimitBarrier] = []
    speeds: list[VelocityLimitBarrier] = []
    for term in cost.terms:
        inner = term
        while isinstance(inner, Terminal | Scaled):
            inner = inner.cost
        for part in inner.terms:
            if isinstance(part, JointLimitBarrier):
                joints.append(part)
            elif isinstance(part, VelocityLimitBarrier):
                speeds.append(part)
    return joints, speeds
