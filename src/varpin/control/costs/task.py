"""Costs in the task: of frames, the centre of mass and manipulability."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.control.costs.base import (
    BoundTerm,
    LeastSquares,
    Points,
    ReferenceValues,
    checked_reference,
    checked_weight,
    sample,
    weight_matrix,
)
from varpin.core import Subject
from varpin.errors import InputError
from varpin.model import Robot, require_robot
from varpin.model.kinematics import frame_kinematics, mass_carriers, require_same
from varpin.support.checks import positive, tuple_of


class _TaskCost(LeastSquares):
    """weight . r^2 with r what a ``subject`` of the core is beside a target."""

    robot: Robot
    weight: Floats
    target: ReferenceValues
    subject = Subject.position
    shape: tuple[int, ...] = (3,)  # of a constant target
    _of_all = False  # of all links, not of a frame
    _directions = np.zeros(0, dtype=np.int64)  # rows of the Jacobian in a manipulability

    def __init__(self, robot: Robot, frame: str, target: ReferenceValues, weight: ArrayLike = 1.0) -> None:
        """Describe the cost.

        Args:
            robot: The robot.
            frame: Name of the frame.
            target: A constant, a function of the time [s] that returns one, or an array of one for each of the
                problem's N + 1 nodes. Between nodes it is linear; rotations turn evenly.
            weight: One number, a vector or a matrix, positive semidefinite; zeros leave directions out.
        """
        name = type(self).__name__
        self.robot, self.frame = require_robot(robot, name), frame
        self._of = mass_carriers(robot) if self._of_all else frame_kinematics(robot, frame)
        self.weight = checked_weight(name, weight)
        weight_matrix(name, self.weight, self.shape[0])
        self.target = checked_reference(name, target, turns=self.shape == (3, 3))

    def bind(self, points: Points) -> BoundTerm:
        name = type(self).__name__
        require_same(name, self.robot, points.robot)
        target = sample(name, self.target, points, self.shape)
        weight = weight_matrix(name, self.weight, self.shape[0])
        return BoundTerm(points, self.subject, self._of, weight, target.reshape(len(target), -1), self._directions)


class FramePositionCost(_TaskCost):
    """weight . (p(q) - p_r(t))^2: bring the origin of a frame to a place, or along a path.

    The target p_r is a place (3,) in the world [m], the weight one number, (3,) or (3, 3) [cost / m^2].
    """


class FrameOrientationCost(_TaskCost):
    """weight . log(R_r(t)' R(q))^2: turn a frame.

    The target R_r is a rotation matrix (3, 3) from the frame's axes to the world's, the weight one number, (3,) or
    (3, 3) [cost / rad^2]. The residual is the rotation vector [rad] from target to frame, in the frame's own axes. It
    is at most pi long, and jumps there: a target half a turn away has no direction to turn in.
    """

    subject = Subject.orientation
    shape = (3, 3)


class FrameVelocityCost(_TaskCost):
    """weight . (J(q) v - V_r(t))^2: the velocity of a frame's origin, and its angular velocity, in world axes.

    The target V_r is linear [m/s] over angular [rad/s] velocity (6,), the weight one number, (6,) or (6, 6).
    """

    subject = Subject.twist
    shape = (6,)

    def __init__(self, robot: Robot, frame: str, target: ReferenceValues = 0.0, weight: ArrayLike = 1.0) -> None:
        """Describe the cost; see :class:`FramePositionCost`."""
        super().__init__(robot, frame, target, weight)


class CenterOfMassCost(_TaskCost):
    """weight . (c(q) - c_r(t))^2 with c the centre of mass of the links that joints move."""

    _of_all = True

    def __init__(self, robot: Robot, target: ReferenceValues, weight: ArrayLike = 1.0) -> None:
        """Describe the cost; see :class:`FramePositionCost`.

        Raises:
            InputError: The links have no mass, or a weight is no such weight.
        """
        super().__init__(robot, "", target, weight)


_DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
_SETS = {"all": _DIRECTIONS, "linear": _DIRECTIONS[:3], "angular": _DIRECTIONS[3:]}


class ManipulabilityCost(_TaskCost):
    """weight (least - w(q))^2 where w < least: keep away from singular configurations.

    w = sqrt(det(J J')) of the frame's Jacobian (Yoshikawa, "Manipulability of robotic mechanisms", 1985), zero where
    the frame cannot move in some direction.
    """

    subject = Subject.manipulability
    shape = (1,)

    def __init__(
        self,
        robot: Robot,
        frame: str,
        least: float,
        weight: float = 1.0,
        directions: str | Sequence[str] = "all",
    ) -> None:
        """Describe the cost.

        Args:
            robot: The robot.
            frame: Name of the frame.
            least: The manipulability below which it costs, in the units of the directions' product [m or rad each].
            weight: One number.
            directions: Which velocities of the frame are to be possible: ``"all"`` six, ``"linear"``, ``"angular"``, or
                some of x, y, z, rx, ry, rz, in world axes.
        """
        self.least = positive("ManipulabilityCost least", least, "m or rad for each direction")
        super().__init__(robot, frame, self.least, weight)
        if self.weight.ndim:
            raise InputError(f"ManipulabilityCost weight must be one number, got shape {self.weight.shape}")
        names = _SETS.get(directions, ()) if isinstance(directions, str) else directions
        chosen = tuple_of("ManipulabilityCost directions", names, str)
        if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= set(_DIRECTIONS):
            raise InputError(
                "ManipulabilityCost directions must be 'all', 'linear', 'angular' or some of "
                f"{', '.join(_DIRECTIONS)}; got {directions!r}"
            )
        if len(chosen) > robot.dof:
            raise InputError(
                f"ManipulabilityCost: with {robot.dof} coordinates no frame moves freely in {len(chosen)} directions"
            )
        self._directions = np.array([_DIRECTIONS.index(name) for name in chosen], dtype=np.int64)
