"""Steps over the samples of a log: their nodes, the samples among them, and the controls that act in them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.estimation.log import Log
from varpin.support.checks import positive

# Longest step where none is given, in usual intervals of the log: one step from sample to sample though the clock
# jitters, and more over gaps.
_JITTER = 1.5
# Excess of an interval over a multiple of the step that makes no further step: rounding.
_ROUNDING = 1e-6
# Rounding of clocks, in units of their last digit.
_DIGITS = 4.0
# Distance of a control before a node from which it acts at the node [s]: rounding of times in seconds.
_NEXT = 1e-9
# Steps of a log that are too many: they take an hour and a gigabyte.
_MOST = 1e8


@dataclass(frozen=True, eq=False)
class Grid:
    """N steps over the K samples of a log.

    Attributes:
        log: The log.
        t: Times of the nodes (N + 1,) [s].
        at: Places of the samples (K,) in units of steps: k at node k, and between nodes where no sample is at one.
    """

    log: Log
    t: Floats
    at: Floats

    @classmethod
    def even(cls, log: Log, dt: float) -> Grid:
        """Equal steps from the first sample to beyond the last one."""
        after = (log.t - log.t[0]) / dt
        steps = max(1.0, np.ceil(after[-1] - _ROUNDING))
        _require_few(dt, steps)
        # A sample next to a node is at it, though clocks round.
        near = np.abs(after - np.rint(after)) < max(_ROUNDING, _DIGITS * np.spacing(np.abs(log.t[-1])) / dt)
        return cls(log, log.t[0] + dt * np.arange(steps + 1.0), np.where(near, np.rint(after), after))

    @classmethod
    def between(cls, log: Log, dt: float | None) -> Grid:
        """Equal steps from sample to sample, none longer than ``dt``; if it is None, one, and more over gaps."""
        intervals = np.diff(log.t)
        longest = _JITTER * float(np.median(intervals)) if dt is None else positive("dt", dt, "s")
        parts = np.maximum(1.0, np.ceil(intervals / longest - _ROUNDING))
        _require_few(longest, float(parts.sum()))
        at = np.concatenate([[0.0], np.cumsum(parts)])
        return cls(log, np.interp(np.arange(at[-1] + 1.0), at, log.t), at)

    @property
    def steps(self) -> int:
        """N."""
        return len(self.t) - 1

    @cached_property
    def node(self) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
        """The step of each sample (K,): that which begins at it, or within which it is, or the last one."""
        return np.minimum(self.at.astype(np.int64), self.steps - 1)

    @cached_property
    def _passed(self) -> Floats:
        """The integral of the held controls up to each sample (K, m)."""
        held = np.diff(self.log.t)[:, None] * self.log.u[:-1]
        return np.concatenate([np.zeros((1, held.shape[1])), np.cumsum(held, axis=0)])

    def controls(self, delay: float, begin: int = 0, end: int | None = None) -> tuple[Floats, Floats]:
        """The mean of the held controls in steps ``begin`` to ``end`` (N, m), and its derivative in their delay."""
        edges = self.t[begin : None if end is None else end + 1]
        late, log, h = edges - delay, self.log, np.diff(edges)[:, None]
        k = np.clip(np.searchsorted(log.t, late + _NEXT, side="right") - 1, 0, len(log.t) - 1)
        passed = self._passed[k] + (late - log.t[k])[:, None] * log.u[k]
        return np.diff(passed, axis=0) / h, -np.diff(log.u[k], axis=0) / h

    def at_nodes(self, u: Floats) -> Grid:
        """The grid of a log with a row for each node, NaN where it has no sample, and with controls u (N, m)."""
        log, rows = self.log, self.at.astype(np.int64)

        def spread(samples: Floats) -> Floats:
            found = np.full((len(self.t), samples.shape[1]), np.nan)
            found[rows] = samples
            return found

        v = None if log.v is None else spread(log.v)
        nodes = Log(self.t, spread(log.q), np.concatenate([u, u[-1:]]), v, log.joints, log.controls)
        return Grid(nodes, self.t, np.arange(len(self.t), dtype=np.float64))


def _require_few(dt: float, steps: float) -> None:
    if not steps < _MOST:
        raise InputError(f"dt = {dt:g} s gives {steps:.3g} steps of the log: take a longer one")
