"""Least squares, weight . r^2 with a residual r of the robot's motion.

Their Hessians are those of Gauss and Newton, 2 J' weight J with J the residual's derivative: positive semidefinite,
and exact where r is zero or linear.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.control.costs.base import BoundCost, Cost, Points, checked_weight, weight_matrix
from varpin.errors import InputError
from varpin.model import Robot, require_robot


class TaskCost(Cost):
    """weight . r^2 with a residual of ``size`` entries."""

    robot: Robot
    weight: Floats
    size: int
    # Dimensions of a target, if there is one, that is constant.
    _rank: ClassVar[int] = 1

    def __init__(self, robot: Robot, weight: ArrayLike) -> None:
        self.robot = require_robot(robot, type(self).__name__)
        self.weight = checked_weight(type(self).__name__, weight)
        weight_matrix(type(self).__name__, self.weight, self.size)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._subject()}weight={self.weight.tolist()})"

    def _subject(self) -> str:
        return ""

    @property
    def nonnegative(self) -> bool:
        """See :attr:`varpin.control.costs.Cost.nonnegative`."""
        return True

    @property
    def timed(self) -> bool:
        """See :attr:`varpin.control.costs.Cost.timed`."""
        target = getattr(self, "target", None)
        return target is not None and (callable(target) or np.ndim(target) > self._rank)

    def bind(self, points: Points) -> BoundCost:
        """See :meth:`varpin.control.costs.Cost.bind`."""
        name = type(self).__name__
        if points.dof != self.robot.dof:
            raise InputError(
                f"{name} is for robot {self.robot.name!r} with {self.robot.dof} coordinates; "
                f"the problem has {points.dof}"
            )
        if points.robot is not None and not self.robot.built_like(points.robot):
            raise InputError(
                f"{name} is for robot {self.robot.name!r}, whose links are of other lengths or turned otherwise than "
                f"those of the problem's robot {points.robot.name!r}; make it with scene.robot"
            )
        return self._bound(points, weight_matrix(name, self.weight, self.size))

    @abstractmethod
    def _bound(self, points: Points, weight: Floats) -> BoundCost:
        """The cost at given points, with its weight as a matrix (r, r)."""
