"""Hard constraints on a frame: a goal at the end, or a region that it stays in or out of."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.control.constraints.base import (
    LENGTH,
    BoundConstraint,
    Horizon,
    PlanConstraint,
    checked_margin,
)
from varpin.errors import InputError
from varpin.model import Robot, require_robot
from varpin.model.kinematics import frame_kinematics, require_same
from varpin.support.checks import finite, finite_array, named_limits, over_time, positive, rotation_matrix

_XYZ = ("x", "y", "z")
# Angle [rad] below which a series replaces the formula, which cancels there; from 1e-4 to 1e-2.
_SMALL = 1e-3


class _OfFrame(PlanConstraint):
    robot: Robot
    frame: str

    def _take(self, robot: Robot, frame: str) -> None:
        self.robot = require_robot(robot, type(self).__name__)
        self.kinematics = frame_kinematics(robot, frame)
        self.frame = frame

    @property
    def label(self) -> str:
        return f"{type(self).__name__}({self.frame!r})"


class ReachFrame(_OfFrame):
    """p(q) = position and log(rotation' R(q)) = 0 at the last node: a frame ends at a goal.

    The rotation's residual is the rotation vector from goal to frame in the frame's own axes, at most pi long [rad]. It
    is not differentiable half a turn away from the goal.
    """

    equality = True

    def __init__(
        self, robot: Robot, frame: str, position: ArrayLike | None = None, rotation: ArrayLike | None = None
    ) -> None:
        """Describe the constraint.

        Args:
            robot: The robot.
            frame: Name of the frame.
            position: Goal of its origin in the world (3,) [m]; by default free.
            rotation: Goal of its rotation matrix, from the frame's axes to the world's (3, 3); by default free.
        """
        self._take(robot, frame)
        if position is None and rotation is None:
            raise InputError("ReachFrame takes a position, a rotation or both")
        self.position = None if position is None else finite_array("ReachFrame position", position, (3,))
        self.rotation = None if rotation is None else rotation_matrix("ReachFrame rotation", rotation)

    def bind(self, horizon: Horizon) -> BoundConstraint:
        require_same(self.label, self.robot, horizon.robot)
        rows: tuple[str, ...] = () if self.position is None else tuple(f"position {axis}" for axis in _XYZ)
        rows += () if self.rotation is None else tuple(f"rotation {axis}" for axis in _XYZ)
        unit = "m and rad" if len(rows) == 6 else "m" if self.rotation is None else "rad"
        return _BoundGoal(self, np.array([horizon.steps]), horizon.t[-1:], rows, unit, LENGTH, self)


@dataclass(frozen=True, eq=False)
class _BoundGoal(BoundConstraint):
    goal: ReachFrame

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:  # noqa: ARG002
        end = q[..., -1, :]
        R, p = self.goal.kinematics.placements(np.ascontiguousarray(end.reshape(-1, end.shape[-1])))
        found: Floats = np.concatenate(self._residuals(R, p), axis=1).reshape(*end.shape[:-1], 1, len(self.rows))
        return found

    def _residuals(self, R: Floats, p: Floats) -> list[Floats]:
        found = [] if self.goal.position is None else [p - self.goal.position]
        if self.goal.rotation is not None:
            turn = scipy.spatial.transform.Rotation.from_matrix(self.goal.rotation.T @ R)
            found.append(turn.as_rotvec())
        return found

    def jacobian(self, q: Floats, v: Floats) -> Floats:  # noqa: ARG002
        n = q.shape[-1]
        R, p, J = self.goal.kinematics.jacobians(q[-1:])
        blocks = [] if self.goal.position is None else [J[0, :3]]
        if self.goal.rotation is not None:
            blocks.append(_log_slope(self._residuals(R, p)[-1][0]) @ R[0].T @ J[0, 3:])
        rows = np.vstack(blocks)
        return np.hstack([rows, np.zeros((len(rows), n))])[None]


def _log_slope(e: Floats) -> Floats:
    """The inverse of SO(3)'s right Jacobian at the rotation vector e (3,): d log(R) over the body's rotation."""
    angle = float(np.linalg.norm(e))
    E = np.array([[0.0, -e[2], e[1]], [e[2], 0.0, -e[0]], [-e[1], e[0], 0.0]])
    near = angle < _SMALL
    part = 1.0 / 12.0 + angle**2 / 720.0 if near else 1.0 / angle**2 - 0.5 / (angle * np.tan(0.5 * angle))
    slope: Floats = np.eye(3) + 0.5 * E + part * E @ E
    return slope


@dataclass(frozen=True, eq=False)
class BoundRegion(BoundConstraint):
    """A region on a grid."""

    region: _Region
    shifts: Floats  # displacement of the region at each place (K, 3), or (1, 3) where it does not move

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:  # noqa: ARG002
        at = q[..., self.places, :]
        _, p = self.region.kinematics.placements(np.ascontiguousarray(at.reshape(-1, at.shape[-1])))
        p = (p.reshape(*at.shape[:-1], 3) - self.shifts).reshape(-1, 3)
        return self.region.distances(p).reshape(*at.shape[:-1], len(self.rows))

    def jacobian(self, q: Floats, v: Floats) -> Floats:  # noqa: ARG002
        _, p, J = self.region.kinematics.jacobians(np.ascontiguousarray(q[self.places]))
        slopes = self.region.slopes(p - self.shifts) @ J[:, :3]
        return np.concatenate([slopes, np.zeros_like(slopes)], axis=2)


class _Region(_OfFrame):
    _rows: tuple[str, ...]

    @abstractmethod
    def distances(self, p: Floats) -> Floats:
        """Distances of positions p (N, 3) [m] outside of the region's bounds (N, rows) [m]."""

    @abstractmethod
    def slopes(self, p: Floats) -> Floats:
        """Derivatives of the distances in p (N, rows, 3)."""

    def bind(self, horizon: Horizon) -> BoundConstraint:
        require_same(self.label, self.robot, horizon.robot)
        places, times = horizon.places
        return BoundRegion(self, places, times, self._rows, "m", LENGTH, self, self.shifts(times))

    def shifts(self, times: Floats) -> Floats:  # noqa: ARG002
        """Displacements of the region at given times (K,) [s]: (K, 3), or (1, 3) where it does not move [m].

        Raises:
            InputError: A user's function fails.
        """
        return np.zeros((1, 3))


class _WithinPlanes(_Region):
    """outward . p <= most, with outward unit normals (rows, 3) and distances along them (rows,) [m]."""

    _outward: Floats
    _most: Floats

    def distances(self, p: Floats) -> Floats:
        found: Floats = p @ self._outward.T - self._most
        return found

    def slopes(self, p: Floats) -> Floats:
        return np.broadcast_to(self._outward, (len(p), *self._outward.shape))


class KeepInHalfSpace(_WithinPlanes):
    """normal . p(q) >= offset at every node after the first: a frame's origin stays on one side of a plane."""

    _rows = ("the plane",)

    def __init__(self, robot: Robot, frame: str, normal: ArrayLike, offset: float, *, margin: float = 0.0) -> None:
        """Describe the constraint.

        Args:
            robot: The robot.
            frame: Name of the frame.
            normal: Normal of the plane (3,), towards the allowed side; of any length.
            offset: Least normal . p, with the normal as given; for a unit normal, the distance of the plane from the
                world's origin along it [m].
            margin: In standard deviations of the distance under noise.
        """
        self._take(robot, frame)
        given = finite_array("KeepInHalfSpace normal", normal, (3,))
        length = float(np.linalg.norm(given))
        if not length > 0.0:
            raise InputError("KeepInHalfSpace normal must not be zero")
        self.normal = given / length
        self.offset = finite("KeepInHalfSpace offset", offset) / length
        self.margin = checked_margin(self, margin)
        self._outward, self._most = -self.normal[None], np.array([-self.offset])


class KeepInBox(_WithinPlanes):
    """lower <= p(q) <= upper at every node after the first: a frame's origin stays in a box along the world's axes."""

    def __init__(self, robot: Robot, frame: str, lower: ArrayLike, upper: ArrayLike, *, margin: float = 0.0) -> None:
        """Describe the constraint; see :class:`KeepInHalfSpace`.

        Args:
            lower: One number or (3,) in the world, infinite where there is no limit [m].
            upper: Likewise.
        """
        self._take(robot, frame)
        self.limits = named_limits("KeepInBox", (lower, upper), None, 3)
        if not np.isfinite(self.limits).any():
            raise InputError("KeepInBox has no finite side")
        self.margin = checked_margin(self, margin)
        # Upper sides, then lower ones.
        sides, axes = np.nonzero(np.isfinite(self.limits[::-1]))
        signs = np.where(sides == 0, 1.0, -1.0)
        self._outward, self._most = signs[:, None] * np.eye(3)[axes], signs * self.limits[::-1][sides, axes]
        names = ("upper", "lower")
        self._rows = tuple(f"{names[side]} side in {_XYZ[axis]}" for side, axis in zip(sides, axes, strict=True))


class _OfSphere(_Region):
    outside: bool
    center: Floats | Callable[[float], ArrayLike]
    _rows = ("the sphere",)

    def __init__(
        self,
        robot: Robot,
        frame: str,
        center: ArrayLike | Callable[[float], ArrayLike],
        radius: float,
        *,
        margin: float = 0.0,
    ) -> None:
        """Describe the constraint; see :class:`KeepInHalfSpace`.

        Args:
            center: Centre in the world (3,) [m], or a function of time [s] that returns it.
            radius: Radius [m].
        """
        self._take(robot, frame)
        name = type(self).__name__
        self.center = center if callable(center) else finite_array(f"{name} center", center, (3,))
        self.radius = positive(f"{name} radius", radius, "m")
        self.margin = checked_margin(self, margin)

    def shifts(self, times: Floats) -> Floats:
        """See the base: positions are relative to the centre."""
        if callable(self.center):
            return over_time(f"{type(self).__name__} center", self.center, times, 3)
        return self.center[None]

    def distances(self, p: Floats) -> Floats:
        beyond: Floats = np.linalg.norm(p, axis=1, keepdims=True) - self.radius
        return -beyond if self.outside else beyond

    def slopes(self, p: Floats) -> Floats:
        length = np.linalg.norm(p, axis=1, keepdims=True)
        # At the centre, where the distance has no gradient: any direction to leave the sphere, none to stay inside.
        fixed = np.array([0.0, 0.0, 1.0 if self.outside else 0.0])
        unit = np.where(length > 0.0, p / np.where(length > 0.0, length, 1.0), fixed)
        found: Floats = (-unit if self.outside else unit)[:, None]
        return found


class KeepInSphere(_OfSphere):
    """abs(p(q) - center) <= radius at every node after the first: a frame's origin stays in a sphere."""

    outside = False


class KeepOutOfSphere(_OfSphere):
    """abs(p(q) - center) >= radius at every node after the first: a frame's origin stays out of a sphere."""

    outside = True
