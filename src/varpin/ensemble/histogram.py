"""Counts of states in bins, and quantiles read from them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers

# Total number of bins, over all nodes and states, and the smallest and largest number for one state at one node.
_BINS, _FEWEST_BINS, _MOST_BINS = 2**25, 64, 1000
# Margin of the bins below and above the first chunk's values, as a share of their range.
_MARGIN = 0.75


def count_in_bins(
    x: Floats, least: Floats, width: Floats, bins: int, counts: NDArray[np.uint16], bounds: Floats
) -> None:
    """Count x (k, 2n, C) in bins that start at ``least`` and are ``width`` wide (k, 2n); find its bounds (2, k, 2n)."""
    position = np.floor((x - least[:, :, None]) / width[:, :, None])
    there = ~np.isnan(position)
    index = np.clip(np.where(there, position, 0.0), -1, bins).astype(np.int64) + 1
    index += (bins + 2) * np.arange(width.size).reshape(*width.shape, 1)
    counts.reshape(-1)[:] = np.bincount(index[there], minlength=counts.size)
    bounds[0], bounds[1] = np.fmin.reduce(x, axis=2, initial=np.inf), np.fmax.reduce(x, axis=2, initial=-np.inf)


class Histogram:
    """Histograms of x at each node, with bins around the values of the first paths (N + 1, 2n, C)."""

    def __init__(self, values: Floats) -> None:
        least = np.fmin.reduce(values, axis=2, initial=np.inf)
        most = np.fmax.reduce(values, axis=2, initial=-np.inf)
        # Where all of these paths have failed, the bins are those of the last node before.
        there = np.isfinite(least).all(axis=1)
        node = np.maximum.accumulate(np.where(there, np.arange(len(there)), 0))
        least, most = least[node], most[node]
        spread = np.maximum(most - least, 1e-9 * np.maximum(np.abs(least), np.abs(most)) + 1e-300)
        bins = int(np.clip(_BINS // spread.size, _FEWEST_BINS, _MOST_BINS))
        self.grid = np.stack([least - _MARGIN * spread, (1.0 + 2.0 * _MARGIN) * spread / bins]), bins
        self.counts = np.zeros((*spread.shape, bins + 2), dtype=np.int64)
        self.bounds = np.stack([np.full(spread.shape, np.inf), np.full(spread.shape, -np.inf)])
        counts, bounds = np.zeros(self.counts.shape, dtype=np.uint16), np.empty(self.bounds.shape)
        count_in_bins(values, self.grid[0][0], self.grid[0][1], bins, counts, bounds)
        self.add(counts, bounds)

    def add(self, counts: NDArray[np.uint16], bounds: Floats) -> None:
        """Add the counts and bounds of other paths."""
        self.counts += counts
        np.minimum(self.bounds[0], bounds[0], out=self.bounds[0])
        np.maximum(self.bounds[1], bounds[1], out=self.bounds[1])

    def quantiles(self, levels: Floats) -> tuple[Floats, Floats]:
        """Quantiles and bounds of their errors, each (L, N + 1, 2n)."""
        found, errors = np.full((2, len(levels), *self.counts.shape[:2]), np.nan)
        for j in range(len(self.counts)):
            below = np.cumsum(self.counts[j], axis=1)
            for i, level in enumerate(levels):
                rank = level * (below[:, -1] - 1)
                lower, upper = (
                    self._ranked(j, below, np.asarray(r(rank), dtype=np.int64)) for r in (np.floor, np.ceil)
                )
                found[i, j] = lower[0] + (rank - np.floor(rank)) * (upper[0] - lower[0])
                errors[i, j] = np.maximum(lower[1], upper[1])
        return np.where(self.counts.any(axis=2), found, np.nan), np.where(self.counts.any(axis=2), errors, np.nan)

    def _ranked(self, node: int, below: Integers, rank: Integers) -> tuple[Floats, Floats]:
        """Values (2n,) of a rank (the number of smaller values) and bounds of their errors.

        Args:
            node: Index of the node.
            below: Cumulated counts (2n, B + 2).
            rank: Rank for each state (2n,).
        """
        (least, width), bins = self.grid[0][:, node], self.grid[1]
        first, last = self.bounds[:, node]
        bin_of = np.argmax(below > rank[:, None], axis=1)
        rows = np.arange(len(rank))
        inside = np.maximum(self.counts[node][rows, bin_of], 1)
        share = (rank + 0.5 - (below[rows, bin_of] - inside)) / inside
        begin = np.where(bin_of == 0, first, least + (bin_of - 1) * width)
        end = np.where(bin_of == bins + 1, last, least + bin_of * width)
        # The smallest and the largest value are known exactly.
        begin, end = np.maximum(begin, first), np.minimum(end, last)
        begin = np.where(rank >= below[:, -1] - 1, last, begin)
        end = np.where(rank <= 0, first, np.maximum(begin, end))
        begin = np.minimum(begin, end)
        return begin + share * (end - begin), end - begin
