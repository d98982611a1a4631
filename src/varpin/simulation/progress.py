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
# Longest time between two calls of a function that gets the motion [s], except within a chunk of steps.
_LONGEST = 1.0 / 60.0


class Reporter:
    """Calls a progress function with the number of steps done and, if it takes them, the new nodes."""

    def __init__(self, progress: Progress | None, steps: int, dt: float) -> None:
        self._progress: Any = progress
        self._steps, self._dt = steps, dt
        self._takes_nodes = told_motion("progress", progress, "steps done, steps in all", "nodes")
        self._parts: list[Segment] = []
        self._last = time.perf_counter()

    def begin(self, node: Segment) -> None:
        """Take the first node, and report it to a function that takes nodes."""
        if self._takes_nodes:
            self._parts = [node]
            self._report(0)

    def add(self, segment: Segment, done: int, *, due: bool) -> None:
        """Take steps, ``done`` the number of all so far; report if ``due``, late or at the end."""
        if self._progress is None:
            return
        if self._takes_nodes:
            self._parts.append(segment)
            due = due or time.perf_counter() - self._last > _LONGEST
        if due or done == self._steps:
            self._report(done)

    def _report(self, done: int) -> None:
        if not self._takes_nodes:
            self._progress(done, self._steps)
            return
        q, v = (np.concatenate([getattr(part, name) for part in self._parts]) for name in ("q", "v"))
        nodes = Nodes(np.arange(done - len(q) + 1, done + 1, dtype=np.float64) * self._dt, q, v)
        self._parts = [replace(self._parts[-1], q=q[-1:], v=v[-1:])]
        self._progress(done, self._steps, nodes)
        self._last = time.perf_counter()
