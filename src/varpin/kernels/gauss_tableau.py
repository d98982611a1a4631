"""Coefficients of collocation at the Gauss points, and of the guess that extrapolates it."""

import functools
from typing import NamedTuple

import numpy as np

from varpin.kernels.tree import Floats


class Tableau(NamedTuple):
    """Collocation of s stages over a step of unit length."""

    a: Floats  # (s, s) weights of the stages in the integral from 0 to each node
    b: Floats  # (s,) in the integral over the step
    c: Floats  # (s,) the nodes
    reach: float  # the largest Rayleigh quotient of a^2 in the metric of b
    ahead: Floats  # (s, s + 1) values at the next step's nodes of the polynomial through this one's and its end


def interpolation(nodes: Floats, at: Floats) -> Floats:
    """Values at ``at`` (r,) of the Lagrange polynomials on ``nodes`` (s,): (r, s)."""
    values = np.ones((at.size, nodes.size))
    for j in range(nodes.size):
        for k in range(nodes.size):
            if k != j:
                values[:, j] *= (at - nodes[k]) / (nodes[j] - nodes[k])
    return values


@functools.cache
def tableau(stages: int) -> Tableau:
    """The Gauss-Legendre tableau of ``stages`` stages, of order 2 ``stages``."""
    x, w = np.polynomial.legendre.leggauss(stages)
    c, b = 0.5 * (1.0 + x), 0.5 * w
    # The rule itself integrates the Lagrange polynomials from 0 to each node, exactly.
    a = np.array([c[i] * (b @ interpolation(c, c[i] * c)) for i in range(stages)])
    ahead = interpolation(np.append(c, 1.0), 1.0 + c)
    # Symplectic, b_i a_ij + b_j a_ji = b_i b_j, to the last digit.
    half = b[:, None] * a
    a = 0.5 * b + 0.5 * (half - half.T) / b[:, None]
    root = np.sqrt(b)
    square = (root[:, None] * (a @ a)) / root[None, :]
    reach = float(np.linalg.eigvalsh(0.5 * (square + square.T))[-1])
    return Tableau(a, b, c, reach, ahead)
