"""Hard constraints on a frame: a goal at the end, or a region that it stays in or out of."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.control.constraints.base import OfStates, finite_sides
from varpin.errors import InputError
from varpin.model import Robot
from varpin.model.kinematics import frame_kinematics, rotation_vector_slopes, rotation_vectors
from varpin.support.checks import finite, finite_array, named_limits, over_time, positive, rotation_matrix

_XYZ = ("x", "y", "z")


class _OfFrame(OfStates):
    frame: str

    def __init__(self, robot: Robot, frame: str, margin: float = 0.0) -> None:
        super().__init__(robot, margin)
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
        super().__init__(robot, frame)
        if position is None and rotation is None:
            raise InputError("ReachFrame takes a position, a rotation or both")
        self.position = None if position is None else finite_array("ReachFrame position", position, (3,))
        self.rotation = None if rotation is None else rotation_matrix("ReachFrame rotation", rotation)

        self._rows = () if self.position is None else tuple(f"position {axis}" for axis in _XYZ)
        self._rows += () if self.rotation is None else tuple(f"rotation {axis}" for axis in _XYZ)
        self._unit = "m and rad" if len(self._rows) == 6 else "m" if self.rotation is None else "rad"

    def values(self, q: Floats, v: Floats) -> Floats:  # noqa: ARG002
        R, p = self.kinematics.placements(q)
        found = [] if self.position is None else [p - self.position]
        found += [] if self.rotation is None else [rotation_vectors(self.rotation.T @ R)]
        return np.concatenate(found, axis=1)

    def slopes(self, q: Floats, v: Floats) -> Floats:  # noqa: ARG002
        R, _, J = self.kinematics.jacobians(q)
        found = [] if self.position is None else [J[:, :3]]
        if self.rotation is not None:
            of_body = rotation_vector_slopes(self.rotation.T @ R) @ np.swapaxes(R, 1, 2)
            found.append(of_body @ J[:, 3:])
        return np.concatenate(found, axis=1)


class _Region(_OfFrame):
    @abstractmethod
    def measured(self, p: Floats) -> tuple[Floats, Floats]:
        """Distances of positions p (P, 3) outside of bounds (P, rows) [m], and their derivatives (P, rows, 3)."""

    def values(self, q: Floats, v: Floats) -> Floats:  # noqa: ARG002
        return self.measured(self.kinematics.placements(q)[1])[0]

    def slopes(self, q: Floats, v: Floats) -> Floats:  # noqa: ARG002
        _, p, J = self.kinematics.jacobians(q)
        found: Floats = self.measured(p)[1] @ J[:, :3]
        return found


class _WithinPlanes(_Region):
    """outward . p <= most, with outward unit normals (rows, 3) and distances along them (rows,) [m]."""

    _outward: Floats
    _most: Floats

    def measured(self, p: Floats) -> tuple[Floats, Floats]:
        return p @ self._outward.T - self._most, np.broadcast_to(self._outward, (len(p), *self._outward.shape))


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
        super().__init__(robot, frame, margin)
        given = finite_array("KeepInHalfSpace normal", normal, (3,))
        length = float(np.linalg.norm(given))
        if not length > 0.0:
            raise InputError("KeepInHalfSpace normal must not be zero")
        self.normal = given / length
        self.offset = finite("KeepInHalfSpace offset", offset) / length
        self._outward, self._most = -self.normal[None], np.array([-self.offset])


class KeepInBox(_WithinPlanes):
    """lower <= p(q) <= upper at every node after the first: a frame's origin stays in a box along the world's axes."""

    def __init__(self, robot: Robot, frame: str, lower: ArrayLike, upper: ArrayLike, *, margin: float = 0.0) -> None:
        """Describe the constraint; see :class:`KeepInHalfSpace`.

        Args:
            lower: One number or (3,) in the world, infinite where there is no limit [m].
            upper: Likewise.
        """
        super().__init__(robot, frame, margin)
        self.limits = named_limits("KeepInBox", (lower, upper), None, 3)
        if not np.isfinite(self.limits).any():
            raise InputError("KeepInBox has no finite side")
        axes, signs, self._most, sides = finite_sides(self.limits)
        self._outward = signs[:, None] * np.eye(3)[axes]
        self._rows = tuple(f"{side} side in {_XYZ[axis]}" for side, axis in zip(sides, axes, strict=True))


class _OfSphere(_Region):
    outside: bool
    center: Floats | Callable[[float], ArrayLike]
    _centers: Floats
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
        super().__init__(robot, frame, margin)
        name = type(self).__name__
        self.center = center if callable(center) else finite_array(f"{name} center", center, (3,))
        self.radius = positive(f"{name} radius", radius, "m")

    def at(self, times: Floats) -> Self:
        return self.changed(_centers=self.centers(times))

    def centers(self, times: Floats) -> Floats:
        """The centre at times (K,) [s]: (K, 3), or (1, 3) where it does not move [m]."""
        if callable(self.center):
            return over_time(f"{type(self).__name__} center", self.center, times, 3)
        return self.center[None]

    def measured(self, p: Floats) -> tuple[Floats, Floats]:
        away = (p.reshape(-1, *self._centers.shape) - self._centers).reshape(-1, 3)
        length = np.linalg.norm(away, axis=1, keepdims=True)
        # At the centre, where the distance has no gradient: any direction to leave the sphere, none to stay inside.
        fixed = np.array([0.0, 0.0, 1.0 if self.outside else 0.0])
        unit = np.where(length > 0.0, away / np.where(length > 0.0, length, 1.0), fixed)
        sign = -1.0 if self.outside else 1.0
        return sign * (length - self.radius), sign * unit[:, None]


class KeepInSphere(_OfSphere):
    """abs(p(q) - center) <= radius at every node after the first: a frame's origin stays in a sphere."""

    outside = False


class KeepOutOfSphere(_OfSphere):
    """abs(p(q) - center) >= radius at every node after the first: a frame's origin stays out of a sphere."""

    outside = True
