"""Links that keep clear of obstacles and of each other."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.control.constraints.base import (
    BoundConstraint,
    Horizon,
    PlanConstraint,
    checked_margin,
    nodes_after,
    require_robot,
    require_same,
)
from varpin.errors import InputError
from varpin.model import Robot
from varpin.model.clearance import Clearance, Obstacle, clearance
from varpin.support.checks import finite, path_like

Floats = NDArray[np.float64]

# A tenth of an arm's reach [m].
_LENGTH = 0.1


@dataclass(frozen=True, eq=False)
class _BoundClearance(BoundConstraint):
    of: Clearance
    distance: float

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:  # noqa: ARG002
        at = q[..., self.places, :]
        found = self.of.distances(at.reshape(-1, at.shape[-1]))
        return (self.distance - found).reshape(*at.shape[:-1], len(self.rows))

    def jacobian(self, q: Floats, v: Floats) -> Floats:  # noqa: ARG002
        slopes = -self.of.slopes(np.ascontiguousarray(q[self.places]))
        return np.concatenate([slopes, np.zeros_like(slopes)], axis=2)


class KeepClear(PlanConstraint):
    """distance(q) >= distance for every pair, at every node after the first: links stay clear of obstacles.

    Each link is taken for the smallest capsule around its shapes, which holds more than the link; ``capsules`` gives
    others. Between capsules and balls distances are exact; of boxes coal tells them. Derivatives are those of the
    points that are nearest.
    """

    robot: Robot
    obstacles: tuple[Obstacle, ...]

    def __init__(
        self,
        robot: Robot,
        obstacles: Sequence[Obstacle] = (),
        distance: float = 0.0,
        *,
        links: Sequence[str] | None = None,
        itself: bool = False,
        srdf: str | os.PathLike[str] | None = None,
        capsules: Mapping[str, tuple[ArrayLike, ArrayLike, float]] | None = None,
        margin: float = 0.0,
    ) -> None:
        """Describe the constraint.

        Args:
            robot: The robot.
            obstacles: From :meth:`Obstacle.sphere`, :meth:`Obstacle.capsule` and :meth:`Obstacle.box`; they may move
                (:meth:`Obstacle.moving`).
            distance: What is to be between the bodies of a pair at least [m].
            links: Which links; all that joints move and that have shapes or a capsule given if left out.
            itself: Keep links clear of each other, too, but for neighbours: those on one joint or on two that follow
                each other, and pairs that overlap at q = 0; ``pairs`` says which are left.
            srdf: An SRDF file, whose ``disable_collisions`` leave out more pairs of links.
            capsules: By the name of a link, or of another frame, (begin (3,), end (3,), radius) in its own axes [m], in
                place of the fitted one.
            margin: In standard deviations of what noise does to a distance.

        Raises:
            RobotError: A mesh is missing or cannot be read, or the file is no SRDF.
            UnknownFrame: There is no such link.
            InputError: There is nothing to keep clear of, a link without shapes, or a wrong value.
        """
        self.robot = require_robot(self, robot)
        if isinstance(obstacles, Obstacle) or not all(isinstance(item, Obstacle) for item in obstacles):
            raise InputError(f"KeepClear obstacles must be a list of varpin.Obstacle, got {obstacles!r}")
        self.obstacles = tuple(obstacles)
        self.distance = finite("KeepClear distance", distance)
        self.margin = checked_margin(self, margin)
        file = None if srdf is None else path_like("KeepClear srdf", srdf)
        self._of = clearance(robot, self.obstacles, links=links, itself=itself, srdf=file, capsules=capsules)
        self.pairs = self._of.names
        self.capsules = {
            name: (begin.tolist(), end.tolist(), radius) for name, (begin, end, radius) in self._of.capsules.items()
        }

    def bind(self, horizon: Horizon) -> BoundConstraint:
        """See :meth:`PlanConstraint.bind`."""
        require_same(self, self.robot, horizon)
        places, times = nodes_after(horizon)
        of = self._of.over(times)
        return _BoundClearance(self, places, times, self.pairs, "m", _LENGTH, of, self.distance)
