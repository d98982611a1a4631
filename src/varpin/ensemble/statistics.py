"""Chunks of paths merged into the statistics of an ensemble, in the order of the paths."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.ensemble.paths import Extremes, Moments, Part, Shared, Task, chunks, examine
from varpin.ensemble.record import Ensemble, EnsembleStatistics, PathFailure
from varpin.finding import Finding
from varpin.support.executors import in_order

# Without stored paths, quantiles are those of as many of the first paths as have this many numbers, P (N + 1) 2n.
_KEPT = 2**25
# Quantiles are computed for runs of nodes with up to this many numbers.
_SPAN = 100_000


def greater(one: Extremes, other: Extremes) -> Extremes:
    """The greater of each extreme; ``one`` where both are equal."""
    return {name: max(one.get(name, found), found, key=lambda x: x[0]) for name, found in other.items()}


def findings_of_paths(
    shared: Shared, q0: Floats, v0: Floats, extremes: Extremes, pool: Executor | None
) -> tuple[Finding, ...]:
    """Findings about a few paths, each kind once, for the path with the largest value; without a pool in this thread.

    They are the first path, and those with the most split steps, the most energy and the largest speed.
    """
    if not shared.steps:
        return ()
    split = [path for amount, path in (extremes["split"],) if amount > 0]
    some = dict.fromkeys([0, *split, extremes["energy"][1], extremes["speed"][1]])
    tasks = [Task(shared, path, q0[path : path + 1].copy(), v0[path : path + 1].copy()) for path in some]
    found: dict[str, Finding] = {}
    results = (examine(task) for task in tasks) if pool is None else in_order(pool, examine, tasks)
    with closing(results) as results:
        for path, findings in zip(some, results, strict=True):
            for finding in findings:
                kept = found.get(finding.kind)
                if kept is None or (finding.value or 0.0) > (kept.value or 0.0):
                    found[finding.kind] = finding.about(f"path {path}: ")
    return tuple(found.values())


class Sums:
    """Sums over the chunks, which are added in the order of the paths."""

    def __init__(self, shared: Shared, paths: int, levels: Floats, *, store: bool) -> None:
        self.shared, self.paths, self.levels, self.store = shared, paths, levels, store
        n, N = shared.scene.robot.dof, shared.steps
        self.done = 0
        self.moments: Moments | None = None
        self.failures: list[PathFailure] = []
        self.extremes: Extremes = {}
        # Paths whose arrays are kept, for the record or for quantiles.
        self.known = paths if store else min(paths, max(1, _KEPT // ((N + 1) * 2 * n))) if len(levels) else 0
        self.nodes = np.zeros(self.known, dtype=np.int64)
        names = ("q", "v", "p", "energy", "u") if store else ("q", shared.second)
        self.stored = {name: np.empty((self.known, *shared.shape(name))) for name in names}

    def tasks(self, q0: Floats, v0: Floats) -> Iterator[Task]:
        """The chunks."""
        for first, last in chunks(self.shared.steps, self.paths):
            kept = tuple(self.stored) if first < self.known else ()
            yield Task(self.shared, first, q0[first:last].copy(), v0[first:last].copy(), kept)

    def part_bytes(self) -> int:
        """Size of a chunk's result [bytes], the arrays alone."""
        _, paths = next(chunks(self.shared.steps, self.paths))
        size = 2 * self.shared.scene.robot.dof
        row = sum(array[:1].nbytes for array in self.stored.values()) if self.known else 0
        return 8 * (self.shared.steps + 1) * (size**2 + size + 3) + paths * (8 + row)

    def add(self, part: Part) -> None:
        """Add the next chunk. One after a gap, which Ctrl-C may leave, is not added."""
        if part.first != self.done:
            return
        assert part.moments is not None
        self.moments = part.moments if self.moments is None else self.moments.merged(part.moments)
        self.failures += part.failures
        self.extremes = greater(self.extremes, part.extremes)
        self.done += len(part.nodes)
        room = self.nodes[part.first : self.done]
        room[:] = part.nodes[: len(room)]
        for name, array in part.stored.items():
            self.stored[name][part.first : self.done] = array[: len(room)]

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
        """The record of the paths added so far, with findings as its warnings."""
        moments, n2 = self.moments, 2 * self.shared.scene.robot.dof
        assert moments is not None
        there = moments.count > 0
        degrees = np.maximum(moments.count - 1, 1)
        stored = {name: array[: self.done] for name, array in self.stored.items()} if self.store else {}
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
            **stored,
            failures=tuple(self.failures),
            warnings=tuple(found),
            integrator=str(self.shared.integrator),
        )

    def _quantiles(self) -> Floats:
        paths, size = min(self.known, self.done), 2 * self.shared.scene.robot.dof
        found = np.full((len(self.levels), self.shared.steps + 1, size), np.nan)
        if not len(self.levels):
            return found
        span, nodes = max(1, _SPAN // (paths * size)), self.nodes[:paths]
        spans, begin = [], 0
        # Between two nodes at which paths fail, the set of paths is the same.
        for end in np.unique(nodes).tolist():
            spans += [(a, min(a + span, end), nodes >= end) for a in range(begin, end, span)]
            begin = end

        def take(part: tuple[int, int, NDArray[np.bool_]]) -> None:
            first, last, inside = part
            x = np.concatenate([self.stored[name][:paths, first:last] for name in ("q", self.shared.second)], axis=2)
            # The paths are the last axis: the numbers of one quantile lie next to each other.
            x = np.ascontiguousarray(x.transpose(1, 2, 0))
            found[:, first:last] = np.quantile(x if inside.all() else x[:, :, inside], self.levels, axis=2)

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            list(pool.map(take, spans))
        return found
