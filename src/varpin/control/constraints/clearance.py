"""Clearance of links from obstacles and from each other, as a hard constraint of a plan."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Self

from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.control.constraints.base import OfStates
from varpin.errors import InputError
from varpin.model import Robot
from varpin.model.clearance import Obstacle, clearance
from varpin.support.checks import finite, flag, path_like, tuple_of


class KeepClear(OfStates):
    """distance(q) >= distance for every pair, at every node after the first: links stay clear of obstacles.

    Each link is modelled by the smallest capsule around its shapes, which is larger than the link; ``capsules`` gives
    others. coal computes the distances, those between capsules and spheres exactly; derivatives are those of the
    nearest points.
    """

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
            obstacles: From :meth:`Obstacle.sphere`, :meth:`Obstacle.capsule`, :meth:`Obstacle.box`,
                :meth:`Obstacle.convex` and :meth:`Obstacle.mesh`; they may move (:meth:`Obstacle.moving`).
            distance: Least distance between the bodies of a pair [m].
            links: Names of the links; by default all moving links with shapes or a given capsule.
            itself: Keep links clear of each other, too, except for pairs on one joint or on two consecutive joints, and
                pairs that overlap at q = 0; ``pairs`` lists the rest.
            srdf: With ``itself``, an SRDF file, whose ``disable_collisions`` leave out more pairs of links;
                a warning tells if the robot lacks most of the links that they name.
            capsules: By the name of a link, or of another frame, (begin (3,), end (3,), radius) in its own axes [m], in
                place of the fitted one.
            margin: In standard deviations of a distance under noise.

        Raises:
            RobotError: A mesh is missing or cannot be read, or the file is no SRDF.
            UnknownFrame: The robot has no such link.
            InputError: There are no pairs, a link has no shapes, the SRDF file has no link of the robot, or
                a value is invalid.
        """
        super().__init__(robot, margin)
        self.obstacles = tuple_of("obstacles", obstacles, Obstacle)
        self.distance = finite("KeepClear distance", distance)
        itself = flag("KeepClear itself", itself)
        names = None if links is None else tuple_of("names of links", links, str)
        file = None if srdf is None else path_like("KeepClear srdf", srdf)
        if file is not None and not itself:
            raise InputError("KeepClear srdf leaves out pairs of links, and there are none without itself=True")
        self._of = clearance(robot, self.obstacles, links=names, itself=itself, srdf=file, capsules=capsules)
        self.pairs = self._rows = self._of.names
        self.capsules = self._of.capsules

    def at(self, times: Floats) -> Self:
        return self.changed(_of=self._of.over(times))

    def values(self, q: Floats, v: Floats) -> Floats:  # noqa: ARG002
        found: Floats = self.distance - self._of.distances(q)
        return found

    def slopes(self, q: Floats, v: Floats) -> Floats:  # noqa: ARG002
        return -self._of.slopes(q)
