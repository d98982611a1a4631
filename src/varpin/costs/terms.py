"""Costs that the core evaluates, all at once: weight . r^2 with r of entries of z = (q, v, u), or of a frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from varpin.core import CostTerms, Subject
from varpin.robot.kinematics import FrameKinematics

Floats = NDArray[np.float64]


class Terms:
    """Terms at the same points. Targets are (N, r), or (1, r) where they are constant."""

    def __init__(self, dof: int, controls: int) -> None:
        self._core = CostTerms.make(dof, controls)
        self._frames: dict[bytes, int] = {}

    def add_entries(self, begin: int, weight: Floats, target: Floats) -> None:
        """Weight . (y - target)^2 with y the entries of z from ``begin`` on."""
        self._core.add_term(Subject.entries, begin, weight, target)

    def add_frame(self, subject: Subject, frame: FrameKinematics, weight: Floats, target: Floats) -> None:
        """Weight . r^2 with r the ``subject`` of a frame beside its target; those of orientations are (N, 9)."""
        # The frame of several terms is placed once.
        key = frame.key
        if key not in self._frames:
            self._frames[key] = self._core.add_frame(frame.links.core, frame.rotation, frame.translation)
        self._core.add_term(subject, self._frames[key], weight, target)

    def values(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """The value of each term (..., N, terms) at q (..., N, n), v (..., N, n) and u (..., N, m)."""
        rows = (np.ascontiguousarray(x).reshape(-1, x.shape[-1]) for x in (q, v, u))
        found = self._core.values(*rows)
        return found.reshape(*q.shape[:-1], found.shape[1])

    def expand(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats]:
        """Gradient (N, 2n + m) and Hessian (N, 2n + m, 2n + m) of all terms together.

        The Hessian is that of Gauss and Newton, 2 J' weight J, and (1, 2n + m, 2n + m) where it is the same everywhere.
        """
        return self._core.expand(q, v, u)
