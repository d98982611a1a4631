"""Controls that change within a step: their values at the stages of a method, and the polynomial through them.

The polynomial of degree s - 1 through the s stages keeps the order of the method, in whole and in divided steps: it
differs from the control only by terms that the method's quadrature does not resolve.
"""

from __future__ import annotations

import functools

import numpy as np

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.integrators.base import open_loop
from varpin.integrators.tableau import gauss_coefficients, interpolation

Times = tuple[float, ...]


@functools.cache
def shares(times: Times) -> Floats:
    """The weight of each stage (s,) in the mean over the step; read-only."""
    _, weights, points = gauss_coefficients(max(1, -(-len(times) // 2)))
    shares: Floats = weights @ interpolation(np.array(times), points)
    shares.setflags(write=False)
    return shares


def changing(values: Floats, times: Times) -> Commands:
    """Commands of controls (N, s, m) at the stages of N steps, at ``times`` (s,) in units of a step."""
    values = np.ascontiguousarray(values)
    return open_loop(shares(times) @ values)._replace(within=values)


def in_parts(values: Floats, times: Times, parts: int, at: Times) -> Floats:
    """Controls (N parts, r, m) at times ``at`` (r,) of each of ``parts`` equal parts of N steps.

    ``values`` (N, s, m) are the controls at ``times`` of the whole steps.
    """
    N, _, m = values.shape
    points = (np.arange(parts)[:, None] + np.array(at)).ravel() / parts
    found: Floats = interpolation(np.array(times), points) @ values
    return found.reshape(N * parts, len(at), m)


def in_pairs(values: Floats, times: Times, at: Times) -> Floats:
    """Controls (N / 2, r, m) at times ``at`` (r,) of double steps, from ``values`` (N, s, m) as in :func:`in_parts`."""
    points = 2.0 * np.array(at)
    second = points > 1.0
    found: Floats = np.where(
        second[:, None],
        interpolation(np.array(times), points - 1.0) @ values[1::2],
        interpolation(np.array(times), points) @ values[::2],
    )
    return found
