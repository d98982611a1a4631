"""Wiener increments: drawn from a seed, refined to half the step, or summed to a multiple of it.

Those that are refined or summed are of the processes themselves: the first k columns of :attr:`Trajectory.dw`.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.support.checks import as_floats, count, finite_array, positive, require_finite

# Children spawned in one call.
_BATCH = 10_000


def wiener_increments(
    processes: int,
    dt: float,
    steps: int,
    rng: np.random.Generator | int | None = None,
    increments: ArrayLike | None = None,
) -> Floats:
    """Increments of k independent Wiener processes over N steps.

    Args:
        processes: k.
        dt: Time step [s].
        steps: N.
        rng: Generator or seed; each increment is drawn from N(0, dt).
        increments: Given increments (N, k) [s^0.5], which are only checked; 0 for none.

    Returns:
        Increments (N, k) [s^0.5]; (0, k) without noise: no processes, or neither ``rng`` nor ``increments``.

    Raises:
        InputError: Both ``rng`` and ``increments``, a wrong shape, or values that are not finite.
    """
    if increments is not None:
        if rng is not None:
            raise InputError("give rng, to draw the Wiener increments, or increments, to use yours; not both")
        given = as_floats("increments", increments)
        if given.ndim == 0 and given == 0.0:
            return np.zeros((0, processes))
        return finite_array("increments", given, (steps, processes))
    if rng is None or processes == 0:
        return np.zeros((0, processes))
    deviation = math.sqrt(positive("dt", dt, "s"))
    return generator(rng).normal(scale=deviation, size=(steps, processes))


def generator(rng: np.random.Generator | int | None) -> np.random.Generator:
    """``rng`` itself, or a generator seeded with it.

    Raises:
        InputError: Neither a generator nor a seed.
    """
    try:
        return np.random.default_rng(rng)
    except (TypeError, ValueError) as error:
        raise InputError(f"rng must be a numpy Generator or a seed, an integer >= 0, got {rng!r}: {error}") from None


@dataclass(frozen=True)
class Children:
    """The children of a random generator, in a few bytes for other processes; generators are made on demand."""

    kind: type[np.random.BitGenerator]
    seed: np.random.SeedSequence  # of the parent, as it was before they were spawned

    def generators(self, first: int, last: int) -> list[np.random.Generator]:
        """The children first, ..., last - 1, equal to those of ``Generator.spawn``."""
        seed, before = self.seed, self.seed.n_children_spawned
        keys = ((*seed.spawn_key, before + i) for i in range(first, last))
        own = (np.random.SeedSequence(seed.entropy, spawn_key=key, pool_size=seed.pool_size) for key in keys)
        return [np.random.Generator(self.kind(child)) for child in own]


def children(rng: np.random.Generator | int, number: int) -> Children:
    """``number`` children of ``rng``; a generator counts them as spawned.

    Raises:
        InputError: Neither a generator nor a seed, or a generator without a numpy SeedSequence.
    """
    parent = generator(rng).bit_generator
    seed = parent.seed_seq
    if not isinstance(seed, np.random.SeedSequence):
        raise InputError(f"rng must be seeded by a numpy SeedSequence, to have a child for each path; got {seed!r}")
    before = copy.copy(seed)
    if isinstance(rng, np.random.Generator):
        for first in range(0, number, _BATCH):
            seed.spawn(min(_BATCH, number - first))
    return Children(type(parent), before)


def coarsen(increments: ArrayLike, factor: int = 2) -> Floats:
    """The same Brownian path at ``factor`` times the step: sums of increments, (N, k) to (N / factor, k).

    Raises:
        InputError: N is no multiple of ``factor``, or the increments are not a finite array (N, k).
    """
    values = _rows(increments)
    steps, processes = values.shape
    if steps % count("factor", factor, least=1):
        raise InputError(f"{steps} increments cannot be summed by {factor}: the number must be a multiple of it")
    total: Floats = values.reshape(steps // factor, factor, processes).sum(axis=1)
    return total


def refine(increments: ArrayLike, dt: float, rng: np.random.Generator | int) -> Floats:
    """The same Brownian path at half the step, by Brownian bridge: (N, k) to (2 N, k).

    The first half of an increment, given the whole, is normal with mean half the increment and variance dt / 4.

    Args:
        increments: Increments over steps of ``dt`` (N, k) [s^0.5].
        dt: Time step of ``increments`` [s].
        rng: Generator or seed of the bridges.

    Raises:
        InputError: dt <= 0, or the increments are not a finite array (N, k).
    """
    half = 0.5 * _rows(increments)
    deviation = 0.5 * math.sqrt(positive("dt", dt, "s"))
    bridge = generator(rng).normal(scale=deviation, size=half.shape)
    return np.stack([half + bridge, half - bridge], axis=1).reshape((2 * len(half), half.shape[1]))


def _rows(increments: ArrayLike) -> Floats:
    values = require_finite("increments", as_floats("increments", increments))
    if values.ndim != 2:
        raise InputError(f"increments must have shape (N, k), got {values.shape}")
    return values
