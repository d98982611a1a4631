"""Chunks of paths merged into the statistics of an ensemble, in the order of the paths."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.ensemble.looks import greater
from varpin.ensemble.paths import Extremes, Moments, Part, Shared, Task, chunk_size, chunks
from varpin.ensemble.record import Ensemble, EnsembleStatistics, PathFailure
from varpin.finding import Finding

# Without stored paths, quantiles are those of as many of the first paths as have this many numbers, P (N + 1) 2n.
_KEPT = 2**25
# Quantiles are computed for runs of nodes with up to this many numbers.
_SPAN = 100_000


class Sums:
    """Sums over the chunks, which are added in the order of the paths."""

    def __init__(self, shared: Shared, paths: int, levels: Floats, *, store: bool) -> None:
        self.shared, self.paths, self.levels, self.store = shared, paths, levels, store
        n, m, N = shared.scene.robot.dof, shared.scene.controls, shared.steps
        self.done = 0
        self.moments: Moments | None = None
        self.failures: list[PathFailure] = []
        self.extremes: Extremes = {}
        self.nodes = np.zeros(paths, dtype=np.int64)
        self.stored: dict[str, Floats] = {}
        if store:
            self.stored = {name: np.empty((paths, N + 1, n)) for name in ("q", "v", "p")}
            self.stored |= {"energy": np.empty((paths, N + 1)), "u": np.empty((paths, N, m))}
        self.known = paths if store else min(paths, max(1, _KEPT // ((N + 1) * 2 * n))) if len(levels) else 0
        self.values = None if store else np.empty((N + 1, 2 * n, self.known))

    def tasks(self, q0: Floats, v0: Floats) -> Iterator[Task]:
        """The chunks."""
        for first, last in chunks(self.shared.steps, self.paths):
            yield Task(
                self.shared,
                first,
                q0[first:last].copy(),
                v0[first:last].copy(),
                store=self.store,
                values=not self.store and first < self.known,
            )

    def part_bytes(self) -> int:
        """Size of a chunk's result [bytes], arrays alone."""
        nodes, size = self.shared.steps + 1, 2 * self.shared.scene.robot.dof
        paths = chunk_size(self.shared.steps, self.paths)
        numbers = nodes * (size**2 + size + 3) + paths
        if self.store:
            numbers += paths * (nodes * (3 * size // 2 + 1) + self.shared.steps * self.shared.scene.controls)
        elif self.known:
            numbers += paths * nodes * size
        return 8 * numbers

    def add(self, part: Part) -> None:
        """Add the next chunk. One after a gap, which Ctrl-C may leave, is not added."""
        here = slice(part.first, part.first + part.paths)
        if part.first != self.done:
            return
        assert part.moments is not None
        self.moments = part.moments if self.moments is None else self.moments.merged(part.moments)
        self.failures += part.failures
        self.extremes = greater(self.extremes, part.extremes)
        self.nodes[here] = part.nodes
        for name, array in self.stored.items():
            array[here] = part.stored[name]
        if self.values is not None and part.values is not None:
            room = self.values[:, :, here]
            room[:] = part.values[:, :, : room.shape[2]]
        self.done = here.stop

    def lost(self) -> tuple[Finding, ...]:
        """A finding about failed paths, if there are any."""
        if not self.failures:
            return ()
        return (Finding("failed paths", f"{self.failing()}; they are left out of the statistics from there on"),)

    def failing(self) -> str:
        """The number of failed paths and the earliest failure, in words."""
        first = min(self.failures, key=lambda failure: failure.step)
        return f"{len(self.failures)} of {self.done} paths failed, the first at step {first.step}: {first.reason}"

    def ensemble(self, found: Sequence[Finding]) -> Ensemble:
        """The record of the paths added so far.

        Args:
            found: Findings, whose sentences become its warnings.
        """
        moments, n2 = self.moments, 2 * self.shared.scene.robot.dof
        assert moments is not None
        there = moments.count > 0
        degrees = np.maximum(moments.count - 1, 1)
        stored = {name: array[: self.done] for name, array in self.stored.items()}
        return Ensemble(
            t=np.arange(self.shared.steps + 1, dtype=np.float64) * self.shared.dt,
            statistics=EnsembleStatistics(
                mean=np.where(there[:, None], moments.mean[:, :n2], np.nan),
                covariance=np.where(there[:, None, None], moments.squares / degrees[:, None, None], np.nan),
                levels=self.levels,
                quantiles=self._quantiles(),
                quantile_paths=min(self.known, self.done),
                energy_mean=np.where(there, moments.mean[:, n2], np.nan),
                energy_deviation=np.where(there, np.sqrt(moments.energy / degrees), np.nan),
                count=moments.count,
            ),
            q=stored.get("q"),
            v=stored.get("v"),
            p=stored.get("p"),
            u=stored.get("u"),
            energy=stored.get("energy"),
            failures=tuple(self.failures),
            warnings=tuple(found),
            integrator=str(self.shared.integrator),
        )

    def _quantiles(self) -> Floats:
        shape = (len(self.levels), self.shared.steps + 1, 2 * self.shared.scene.robot.dof)
        found, paths = np.full(shape, np.nan), min(self.known, self.done)
        if not len(self.levels):
            return found
        size, nodes = max(1, _SPAN // (paths * shape[2])), self.nodes[:paths]
        spans, begin = [], 0
        # Between two nodes at which paths fail, the set of paths is the same.
        for end in np.unique(nodes).tolist():
            spans += [(a, min(a + size, end), nodes >= end) for a in range(begin, end, size)]
            begin = end

        def take(span: tuple[int, int, NDArray[np.bool_]]) -> None:
            first, last, inside = span
            x = self._states(first, last)
            found[:, first:last] = np.quantile(x if inside.all() else x[:, :, inside], self.levels, axis=2)

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            list(pool.map(take, spans))
        return found

    def _states(self, first: int, last: int) -> Floats:
        """States x at nodes ``first`` .. ``last`` (k, 2n, P)."""
        if self.values is not None:
            return self.values[first:last, :, : min(self.known, self.done)]
        second = self.stored["p" if self.shared.integrator.variational else "v"]
        parts = [array[: self.done, first:last].transpose(1, 2, 0) for array in (self.stored["q"], second)]
        return np.concatenate(parts, axis=1)
