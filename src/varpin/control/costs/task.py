"""Costs in the task: of frames, the centre of mass and manipulability."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from varpin.arrays import Floats, Integers
from varpin.control.costs.base import BoundCost, CompiledCost, CostError, Points, ReferenceValues, sample
from varpin.control.costs.residual import TaskCost
from varpin.control.costs.terms import Terms
from varpin.core import Subject
from varpin.errors import InputError
from varpin.model import Robot
from varpin.model.kinematics import (
    FrameKinematics,
    Links,
    frame_kinematics,
    mass_carriers,
)
from varpin.support.checks import as_floats, positive, require_finite


class _FrameCost(TaskCost):
    frame: str

    def __init__(self, robot: Robot, frame: str, weight: ArrayLike) -> None:
        if not isinstance(frame, str):
            raise InputError(f"{type(self).__name__} frame must be the name of a frame, got {frame!r}")
        super().__init__(robot, weight)
        self.frame = frame
        self._kinematics = frame_kinematics(robot, frame)

    def _subject(self) -> str:
        return f"{self.frame!r}, "


@dataclass(frozen=True, eq=False)
class _BoundFrame(CompiledCost):
    subject: Subject
    of: FrameKinematics
    weight: Floats  # (r, r)
    target: Floats  # (N, r) or (1, r); of orientations (N, 9) or (1, 9)
    points: Points

    def add_to(self, terms: Terms, factor: float) -> bool:
        terms.add_frame(self.subject, self.of, factor * self.weight, self.target)
        return True


class FramePositionCost(_FrameCost):
    """weight . (p(q) - p_r(t))^2: bring the origin of a frame to a place, or along a path."""

    size = 3

    def __init__(self, robot: Robot, frame: str, target: ReferenceValues, weight: ArrayLike = 1.0) -> None:
        """Describe the cost.

        Args:
            robot: The robot.
            frame: Name of the frame.
            target: p_r in the world [m]: a constant (3,), a function of the time [s] that returns (3,), or an array
                (N + 1, 3) of its values at the problem's nodes, between which it is linear.
            weight: One number, (3,), or a matrix (3, 3), positive semidefinite [cost / m^2].

        Raises:
            UnknownFrame: The robot has no such frame.
            InputError: The frame is fixed to the base, or a weight is no such weight.
        """
        super().__init__(robot, frame, weight)
        self.target = target if callable(target) else as_floats("FramePositionCost target", target)

    def _bound(self, points: Points, weight: Floats) -> BoundCost:
        target = sample("FramePositionCost", self.target, points, 3)
        return _BoundFrame(Subject.position, self._kinematics, weight, target, points)


class FrameOrientationCost(_FrameCost):
    """weight . log(R_r(t)' R(q))^2: turn a frame.

    The residual is the rotation vector [rad] from target to frame, in the frame's own axes. It is at most pi long, and
    jumps there: a target half a turn away has no direction to turn in.
    """

    size = 3
    _rank = 2

    def __init__(
        self, robot: Robot, frame: str, target: ArrayLike | Callable[[float], ArrayLike], weight: ArrayLike = 1.0
    ) -> None:
        """Describe the cost.

        Args:
            robot: The robot.
            frame: Name of the frame.
            target: R_r from the frame's axes to the world's: a rotation matrix (3, 3), a function of the time [s]
                that returns one, or an array (N + 1, 3, 3) of them at the problem's nodes, between which it turns
                evenly.
            weight: One number, (3,), or a matrix (3, 3), positive semidefinite [cost / rad^2].

        Raises:
            UnknownFrame: The robot has no such frame.
            InputError: The frame is fixed to the base, or a weight is no such weight.
        """
        super().__init__(robot, frame, weight)
        self.target = target if callable(target) else as_floats("FrameOrientationCost target", target)

    def _bound(self, points: Points, weight: Floats) -> BoundCost:
        target = _sample_rotations(self.target, points).reshape(-1, 9)
        return _BoundFrame(Subject.orientation, self._kinematics, weight, target, points)


def _sample_rotations(target: Floats | Callable[[float], ArrayLike], points: Points) -> Floats:
    """Rotation matrices at the points, (N, 3, 3), or (1, 3, 3) where they are constant."""
    name = "FrameOrientationCost"
    if callable(target):
        found = []
        for time in points.t.tolist():
            try:
                found.append(as_floats("the target", target(time)))
                _require_rotations("the target", found[-1][None])
            except Exception as error:
                raise CostError(name, f"at t = {time:.6g} s: {error}") from error
        return np.array(found)
    if target.shape == (3, 3):
        return _require_rotations(f"{name} target", target[None])
    if target.shape != (points.steps + 1, 3, 3):
        raise InputError(
            f"{name} target must be a function of time, have shape (3, 3), or ({points.steps + 1}, 3, 3): one matrix "
            f"for each of the problem's nodes; got {target.shape}"
        )
    nodes = np.linspace(0.0, points.duration, points.steps + 1)
    rotations = scipy.spatial.transform.Rotation.from_matrix(_require_rotations(f"{name} target", target))
    turns = scipy.spatial.transform.Slerp(nodes, rotations)
    between: Floats = turns(np.clip(points.elapsed, 0.0, points.duration)).as_matrix()
    return between


def _require_rotations(name: str, R: Floats) -> Floats:
    if R.shape[1:] != (3, 3):
        raise InputError(f"{name} must have shape (3, 3), got {R.shape[1:]}")
    require_finite(name, R)
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    wrong = (off > 1e-6) | (np.linalg.det(R) < 0.0)
    if wrong.any():
        which = "" if len(R) == 1 else f" number {int(np.argmax(wrong))}"
        raise InputError(f"{name}{which} is no rotation matrix: R'R is {off.max():.3g} from 1, or R mirrors")
    return R


class FrameVelocityCost(_FrameCost):
    """weight . (J(q) v - V_r(t))^2: the velocity of a frame's origin, and its angular velocity, in world axes."""

    size = 6

    def __init__(self, robot: Robot, frame: str, target: ReferenceValues = 0.0, weight: ArrayLike = 1.0) -> None:
        """Describe the cost.

        Args:
            robot: The robot.
            frame: Name of the frame.
            target: V_r, linear [m/s] over angular [rad/s] velocity (6,), as for :class:`FramePositionCost`.
            weight: One number, (6,), or a matrix (6, 6), positive semidefinite; zeros leave directions out.

        Raises:
            UnknownFrame: The robot has no such frame.
            InputError: The frame is fixed to the base, or a weight is no such weight.
        """
        super().__init__(robot, frame, weight)
        self.target = target if callable(target) else as_floats("FrameVelocityCost target", target)

    def _bound(self, points: Points, weight: Floats) -> BoundCost:
        target = sample("FrameVelocityCost", self.target, points, 6)
        return _BoundFrame(Subject.twist, self._kinematics, weight, target, points)


@dataclass(frozen=True, eq=False)
class _BoundCenter(CompiledCost):
    of: Links
    weight: Floats  # (3, 3)
    target: Floats  # (N, 3) or (1, 3)
    points: Points

    def add_to(self, terms: Terms, factor: float) -> bool:
        terms.add_center(self.of, factor * self.weight, self.target)
        return True


class CenterOfMassCost(TaskCost):
    """weight . (c(q) - c_r(t))^2 with c the centre of mass of the links that joints move."""

    size = 3

    def __init__(self, robot: Robot, target: ReferenceValues, weight: ArrayLike = 1.0) -> None:
        """Describe the cost; see :class:`FramePositionCost`.

        Raises:
            InputError: The links have no mass, or a weight is no such weight.
        """
        super().__init__(robot, weight)
        self._links = mass_carriers(robot)
        self.target = target if callable(target) else as_floats("CenterOfMassCost target", target)

    def _bound(self, points: Points, weight: Floats) -> BoundCost:
        target = sample("CenterOfMassCost", self.target, points, 3)
        return _BoundCenter(self._links, weight, target, points)


_DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
_SETS = {"all": _DIRECTIONS, "linear": _DIRECTIONS[:3], "angular": _DIRECTIONS[3:]}


@dataclass(frozen=True, eq=False)
class _BoundManipulability(CompiledCost):
    of: FrameKinematics
    directions: Integers  # rows of the Jacobian
    weight: Floats  # (1, 1)
    least: float
    points: Points

    def add_to(self, terms: Terms, factor: float) -> bool:
        terms.add_manipulability(self.of, self.directions, factor * self.weight, self.least)
        return True


class ManipulabilityCost(_FrameCost):
    """weight (least - w(q))^2 where w < least: keep away from singular configurations.

    w = sqrt(det(J J')) of the frame's Jacobian (Yoshikawa, "Manipulability of robotic mechanisms", 1985), zero where
    the frame cannot move in some direction.
    """

    size = 1

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

        Raises:
            UnknownFrame: The robot has no such frame.
            InputError: More directions than coordinates, of which one is always impossible; or as for the others.
        """
        super().__init__(robot, frame, weight)
        if self.weight.ndim:
            raise InputError(f"ManipulabilityCost weight must be one number, got shape {self.weight.shape}")
        chosen = _SETS.get(directions, ()) if isinstance(directions, str) else tuple(directions)
        if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= set(_DIRECTIONS):
            raise InputError(
                "ManipulabilityCost directions must be 'all', 'linear', 'angular' or some of "
                f"{', '.join(_DIRECTIONS)}; got {directions!r}"
            )
        if len(chosen) > robot.dof:
            raise InputError(
                f"ManipulabilityCost: with {robot.dof} coordinates no frame moves freely in {len(chosen)} directions"
            )
        self.least = positive("ManipulabilityCost least", least, "m or rad for each direction")
        self.rows = [_DIRECTIONS.index(name) for name in chosen]

    def _bound(self, points: Points, weight: Floats) -> BoundCost:
        return _BoundManipulability(self._kinematics, np.array(self.rows, dtype=np.int64), weight, self.least, points)
