"""Calls of the progress function of a simulation."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from varpin.integrators import Segment
from varpin.support.checks import told_motion
from varpin.trajectory import Nodes

Progress = Callable[[int, int], None] | Callable[[int, int, Nodes], None]
# Who is told the motion is called at least so often [s], where nothing but whole chunks of steps takes longer.
_LOOK = 1.0 / 60.0


class Reporter:
    """Who is told how far a motion is, and perhaps what it was since the last time."""

    def __init__(self, progress: Progress | None, steps: int, dt: float) -> None:
        self._progress: Any = progress
        self._steps, self._dt = steps, dt
        self._moving = told_motion("progress", progress, "steps done, steps in all", "nodes")
        self._parts: list[Segment] = []
        self._last = time.perf_counter()

    def begin(self, node: Segment) -> None:
        """Take the first node, and tell of it who is told the motion."""
        if self._moving:
            self._parts = [node]
            self._tell(0)

    def add(self, segment: Segment, done: int, *, due: bool) -> None:
        """Take steps, after which so many are ``done``; and tell, if that is due."""
        if self._progress is None:
            return
        if self._moving:
            self._parts.append(segment)
            due = due or time.perf_counter() - self._last > _LOOK
        if due or done == self._steps:
            self._tell(done)

    def _tell(self, done: int) -> None:
        if not self._moving:
            self._progress(done, self._steps)
            return
        q, v = (np.concatenate([getattr(part, name) for part in self._parts]) for name in ("q", "v"))
        nodes = Nodes(np.arange(done - len(q) + 1, done + 1, dtype=np.float64) * self._dt, q, v)
        self._parts = [replace(self._parts[-1], q=q[-1:], v=v[-1:])]
        self._progress(done, self._steps, nodes)
        self._last = time.perf_counter()
