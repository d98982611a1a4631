"""Controls that change within a step: their values at the stages of a method, and the polynomial through them.

Of degree s - 1 through the stages of a method it is as good as the control itself: it leaves what the method's own
quadrature does not see, so that a motion under it is of the method's order, in whole steps and in parts of them.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from varpin.core.arrays import Commands
from varpin.integrators.base import open_loop
from varpin.integrators.tableau import gauss_coefficients, interpolation

Floats = NDArray[np.float64]
Times = tuple[float, ...]


@functools.cache
def shares(times: Times) -> Floats:
    """The weight of each stage (s,) in the mean over the step."""
    _, weights, points = gauss_coefficients(max(1, -(-len(times) // 2)))
    shares: Floats = weights @ interpolation(np.array(times), points)
    shares.setflags(write=False)
    return shares


def changing(values: Floats, times: Times) -> Commands:
    """Commands of controls (N, s, m) at the stages of each of N steps, which stand at ``times`` in units of a step."""
    values = np.ascontiguousarray(values)
    return open_loop(shares(times) @ values)._replace(within=values)


def in_parts(values: Floats, times: Times, parts: int, at: Times) -> Floats:
    """Controls (N parts, r, m) at ``at`` in each part of steps that are cut into equal ones.

    ``values`` (N, s, m) are those at ``times`` in the whole steps.
    """
    N, _, m = values.shape
    places = (np.arange(parts)[:, None] + np.array(at)).ravel() / parts
    found: Floats = interpolation(np.array(times), places) @ values
    return found.reshape(N * parts, len(at), m)


def in_pairs(values: Floats, times: Times, at: Times) -> Floats:
    """Controls (N / 2, r, m) at ``at`` in each two of N steps taken as one; ``values`` (N, s, m) as of `in_parts`."""
    places = 2.0 * np.array(at)
    second = places > 1.0
    found: Floats = np.where(
        second[:, None],
        interpolation(np.array(times), places - 1.0) @ values[1::2],
        interpolation(np.array(times), places) @ values[::2],
    )
    return found
