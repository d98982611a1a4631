"""Chunks of paths merged into the statistics of an ensemble."""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.ensemble.paths import Part, Paths, Reduction, Shared
from varpin.ensemble.record import Ensemble, EnsembleStatistics
from varpin.finding import Finding
from varpin.support.frozen import Frozen

# Without stored paths, quantiles are those of as many of the first paths as have this many numbers, P (N + 1) 2n.
_KEPT = 2**25


@dataclass(frozen=True, eq=False)
class Moments(Frozen):
    """Sums over some paths at each of N + 1 nodes."""

    count: Integers  # (N + 1,)
    mean: Floats  # of x and of the energy (N + 1, 2n + 1)
    squares: Floats  # sums of products of the deviations of x from its mean (N + 1, 2n, 2n)
    energy: Floats  # sums of squared deviations of the energy from its mean (N + 1,)

    # Paths that blow up may have squares that are infinite.
    @classmethod
    @np.errstate(over="ignore", invalid="ignore")
    def of(cls, x: Floats, nodes: Integers) -> Moments:
        """Sums of x and the energy (N + 1, 2n + 1, C), the first ``nodes`` (C,) of each path; x is overwritten."""
        gone = np.arange(len(x))[:, None] >= nodes
        count = len(nodes) - gone.sum(axis=1)
        np.copyto(x, 0.0, where=gone[:, None])
        mean = x.sum(axis=2) / np.maximum(count, 1)[:, None]
        x -= mean[:, :, None]
        np.copyto(x, 0.0, where=gone[:, None])
        squares = np.einsum("jaP,jbP->jab", x[:, :-1], x[:, :-1])
        return cls(count, mean, squares, np.einsum("jP,jP->j", x[:, -1], x[:, -1]))

    @np.errstate(over="ignore", invalid="ignore")
    def merged(self, other: Moments) -> Moments:
        """Sums over the paths of both (Chan, Golub and LeVeque 1979)."""
        total = self.count + other.count
        share = other.count / np.maximum(total, 1)
        apart = other.mean - self.mean
        weight, x = self.count * share, apart[:, :-1]
        return Moments(
            total,
            self.mean + apart * share[:, None],
            self.squares + other.squares + (weight[:, None] * x)[:, :, None] * x[:, None, :],
            self.energy + other.energy + weight * apart[:, -1] ** 2,
        )


def moments_of(
    arrays: dict[str, Floats], nodes: Integers, *, second: str, kept: tuple[str, ...]
) -> tuple[Moments, Integers, dict[str, Floats]]:
    """The moments of a chunk's paths, their numbers of nodes, and the arrays that are kept."""
    whole = np.concatenate([arrays["q"], arrays[second], arrays["energy"][:, :, None]], axis=2)
    # Statistics run over the paths, which are the last axis.
    x = np.ascontiguousarray(whole.transpose(1, 2, 0))
    return Moments.of(x, nodes), nodes, {name: arrays[name] for name in kept}


class Sums(Paths):
    """Sums over the chunks, which are added in the order of the paths."""

    def __init__(self, shared: Shared, q0: Floats, v0: Floats, levels: Floats, *, store: bool) -> None:
        super().__init__(shared, q0, v0)
        self.levels, self.store, paths = levels, store, len(q0)
        self.moments: Moments | None = None
        # Paths whose arrays are kept, for the record or for quantiles.
        width = 2 * (shared.steps + 1) * shared.scene.robot.dof
        self.known = paths if store else min(paths, max(1, _KEPT // width)) if len(levels) else 0
        self.nodes = np.zeros(self.known, dtype=np.int64)
        names = ("q", "v", "p", "energy", "u") if store else ("q", shared.second)
        self.stored = {name: np.empty((self.known, *shared.shape(name))) for name in names}

    def reduction(self, first: int) -> tuple[tuple[str, ...], Reduction]:
        kept = tuple(self.stored) if first < self.known else ()
        return kept, functools.partial(moments_of, second=self.shared.second, kept=kept)

    def part_bytes(self) -> int:
        """Size of a chunk's result [bytes], the arrays alone."""
        _, paths = next(self.shared.chunks(len(self.q0)))
        size = 2 * self.shared.scene.robot.dof
        row = sum(array[:1].nbytes for array in self.stored.values()) if self.known else 0
        return 8 * (self.shared.steps + 1) * (size**2 + size + 3) + paths * (8 + row)

    def take(self, part: Part) -> None:
        moments, nodes, stored = part.found
        self.moments = moments if self.moments is None else self.moments.merged(moments)
        room = slice(part.first, min(part.first + part.paths, self.known))
        self.nodes[room] = nodes[: self.nodes[room].size]
        for name, array in stored.items():
            self.stored[name][room] = array[: self.nodes[room].size]

    def result(self, found: Sequence[Finding]) -> Ensemble:
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
        known, states, names = min(self.known, self.done), 2 * self.shared.scene.robot.dof, ("q", self.shared.second)

        def of_node(node: int) -> Floats:
            there = self.nodes[:known] > node
            if not there.any():
                return np.full((len(self.levels), states), np.nan)
            x = np.concatenate([self.stored[name][:known, node][there] for name in names], axis=1)
            return np.asarray(np.quantile(x, self.levels, axis=0))

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            return np.stack(list(pool.map(of_node, range(self.shared.steps + 1))), axis=1)
