"""Least squares, weight . r^2 with a residual r of the robot's motion, evaluated at all points at once.

Their Hessians are those of Gauss and Newton, 2 J' weight J with J the residual's derivative: positive semidefinite,
and exact where r is zero or linear.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.costs.base import BoundCost, Cost, Expansion, Points, checked_weight, weight_matrix
from varpin.errors import InputError
from varpin.frozen import Frozen
from varpin.robot import Robot

Floats = NDArray[np.float64]


class Residual(Frozen):
    """A residual at given points; ``columns`` are those entries of z = (q, v, u) it depends on."""

    columns: slice

    @abstractmethod
    def value(self, q: Floats, v: Floats) -> Floats:
        """Its values (..., N, r) at q and v (..., N, n)."""

    @abstractmethod
    def expand(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Its values (N, r) and their derivatives in its columns (N, r, c)."""


@dataclass(frozen=True, eq=False)
class _BoundTask(BoundCost):
    residual: Residual
    weight: Floats  # (r, r)
    size: int

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:  # noqa: ARG002
        error = self.residual.value(q, v)
        total: Floats = np.einsum("...i,...i->...", error @ self.weight, error)
        return total

    def expand(self, q: Floats, v: Floats, u: Floats) -> Expansion:  # noqa: ARG002
        error, J = self.residual.expand(q, v)
        columns = self.residual.columns
        WJ = 2.0 * (self.weight @ J)
        gradient, hessian = np.zeros((len(q), self.size)), np.zeros((len(q), self.size, self.size))
        gradient[:, columns] = (error[:, None, :] @ WJ)[:, 0]
        hessian[:, columns, columns] = np.swapaxes(J, 1, 2) @ WJ
        return Expansion(gradient, hessian)


class TaskCost(Cost):
    """weight . r^2 with a residual of ``size`` entries."""

    robot: Robot
    weight: Floats
    size: int

    def __init__(self, robot: Robot, weight: ArrayLike) -> None:
        if not isinstance(robot, Robot):
            raise InputError(f"{type(self).__name__} takes a robot from load_robot, got {type(robot).__name__}")
        self.robot = robot
        self.weight = checked_weight(type(self).__name__, weight)
        weight_matrix(type(self).__name__, self.weight, self.size)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._subject()}weight={self.weight.tolist()})"

    def _subject(self) -> str:
        return ""

    @property
    def nonnegative(self) -> bool:
        """See :attr:`varpin.costs.Cost.nonnegative`."""
        return True

    def bind(self, points: Points) -> BoundCost:
        """See :meth:`varpin.costs.Cost.bind`."""
        name = type(self).__name__
        if points.dof != self.robot.dof:
            raise InputError(
                f"{name} is for robot {self.robot.name!r} with {self.robot.dof} coordinates; "
                f"the problem has {points.dof}"
            )
        return self._bound(points, weight_matrix(name, self.weight, self.size))

    @abstractmethod
    def _bound(self, points: Points, weight: Floats) -> BoundCost:
        """The cost at given points, with its weight as a matrix (r, r)."""


class ResidualCost(TaskCost):
    """A task cost whose residual is evaluated with NumPy."""

    def _bound(self, points: Points, weight: Floats) -> BoundCost:
        return _BoundTask(self._at(points), weight, points.size)

    @abstractmethod
    def _at(self, points: Points) -> Residual:
        """The residual at given points."""
