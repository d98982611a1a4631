"""Costs that the core evaluates, all at once: weight . r^2 with r of z = (q, v, u), a frame or the centre of mass."""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.core import CostTerms, Subject
from varpin.model.kinematics import FrameKinematics, Links

_NO_DIRECTIONS = np.zeros(0, dtype=np.int64)


class Terms:
    """Terms at the same points. Targets are (N, r), or (1, r) where they are constant."""

    def __init__(self, dof: int, controls: int) -> None:
        self._core = CostTerms.make(dof, controls)
        self._indices: dict[bytes, int] = {}
        self._count = 0

    @property
    def core(self) -> CostTerms:
        """For the core's own loops."""
        return self._core

    @property
    def count(self) -> int:
        """How many there are."""
        return self._count

    def _add(
        self, subject: Subject, index: int, weight: Floats, target: Floats, directions: Integers = _NO_DIRECTIONS
    ) -> None:
        self._core.add_term(subject, index, weight, target, directions)
        self._count += 1

    def add_entries(self, begin: int, weight: Floats, target: Floats) -> None:
        """Weight . (y - target)^2 with y the entries of z from ``begin`` on."""
        self._add(Subject.entries, begin, weight, target)

    def add_excess(self, begin: int, weight: Floats, lower: Floats, upper: Floats) -> None:
        """Weight . r^2 with r what the entries of z from ``begin`` on are beyond limits (r,)."""
        limits = np.concatenate([lower, upper])[None]
        self._add(Subject.excess, begin, weight, limits)

    def add_frame(self, subject: Subject, frame: FrameKinematics, weight: Floats, target: Floats) -> None:
        """Weight . r^2 with r the ``subject`` of a frame beside its target; those of orientations are (N, 9)."""
        self._add(subject, self._index_of(frame), weight, target)

    def add_manipulability(self, frame: FrameKinematics, directions: Integers, weight: Floats, least: float) -> None:
        """Weight (1, 1) . (least - w)^2 where w < least, of some rows of a frame's Jacobian."""
        self._add(Subject.manipulability, self._index_of(frame), weight, np.array([[least]]), directions)

    def add_center(self, links: Links, weight: Floats, target: Floats) -> None:
        """Weight . (c - target)^2 with c the bodies' centre of mass."""
        if links.key not in self._indices:
            self._indices[links.key] = self._core.add_center(links.core)
        self._add(Subject.position, self._indices[links.key], weight, target)

    def _index_of(self, frame: FrameKinematics) -> int:
        # The frame of several terms is placed once.
        if frame.key not in self._indices:
            self._indices[frame.key] = self._core.add_frame(frame.links.core, frame.rotation, frame.translation)
        return self._indices[frame.key]

    def values(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """The value of each term (..., N, terms) at q (..., N, n), v (..., N, n) and u (..., N, m)."""
        if q.ndim == 2:
            return self._core.values(q, v, u)
        rows = (np.ascontiguousarray(x).reshape(-1, x.shape[-1]) for x in (q, v, u))
        found = self._core.values(*rows)
        return found.reshape(*q.shape[:-1], found.shape[1])

    def expand(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats]:
        """Gradient (N, 2n + m) and Hessian (N, 2n + m, 2n + m) of all terms together.

        The Hessian is that of Gauss and Newton, 2 J' weight J, and (1, 2n + m, 2n + m) where it is the same everywhere.
        """
        return self._core.expand(q, v, u)
