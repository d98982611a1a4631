"""Coefficients of collocation: Gauss-Legendre and Radau points, and the generalized midpoint rule."""

import functools
from typing import NamedTuple

import numpy as np
import scipy

from varpin.arrays import Floats
from varpin.core import Tableau
from varpin.signals.commands import interpolation


@functools.cache
def gauss_coefficients(stages: int) -> tuple[Floats, Floats, Floats]:
    """A (s, s), b (s,), c (s,) of the Gauss-Legendre method with s stages, of order 2 s, on a unit step; read-only."""
    x, w = np.polynomial.legendre.leggauss(stages)
    c, b = 0.5 * (1.0 + x), 0.5 * w
    # The quadrature rule integrates the Lagrange polynomials from 0 to each node exactly.
    a = np.array([c[i] * (b @ interpolation(c, c[i] * c)) for i in range(stages)])
    # Make b_i a_ij + b_j a_ji = b_i b_j (symplecticity) exact to rounding.
    half = b[:, None] * a
    return _read_only(0.5 * b + 0.5 * (half - half.T) / b[:, None], b, c)


@functools.cache
def radau_coefficients(stages: int) -> tuple[Floats, Floats, Floats]:
    """A (s, s), b (s,) and c (s,) of the Radau IIA method with s stages, of order 2 s - 1, over a unit step.

    Its points are the end of the step and the roots of a Jacobi polynomial (Hairer and Wanner, Solving Ordinary
    Differential Equations II, IV.5). The arrays are read-only.
    """
    inner, _ = scipy.special.roots_jacobi(stages - 1, 1.0, 0.0) if stages > 1 else (np.zeros(0), None)
    c = np.append(0.5 * (1.0 + inner), 1.0)
    # The Gauss rule with as many points integrates the Lagrange polynomials exactly.
    _, weights, points = gauss_coefficients(stages)
    a = np.array([c[i] * (weights @ interpolation(c, c[i] * points)) for i in range(stages)])
    return _read_only(a, a[-1].copy(), c)


def _read_only(a: Floats, b: Floats, c: Floats) -> tuple[Floats, Floats, Floats]:
    for array in (a, b, c):
        array.setflags(write=False)
    return a, b, c


class Scheme(NamedTuple):
    """A method of collocation on a unit step."""

    tableau: Tableau  # for the core
    # How forces act: A (s, s), b (s,) and c (s,).
    a: Floats
    b: Floats
    c: Floats
    times: Floats  # of the stages (s,)
    places: Floats | None = None  # :func:`lobatto_places` where constraints hold; None if they do not


def _scheme(points: tuple[Floats, Floats, Floats], ahead: Floats, places: Floats | None, *, stiff: bool) -> Scheme:
    a, b, c = points
    root = np.sqrt(b)
    square = (root[:, None] * (a @ a)) / root[None, :]
    reach = float(np.linalg.eigvalsh(0.5 * (square + square.T))[-1])
    tableau = Tableau.make(
        a=a, gradient=a, force=a, b=b, c=c, ahead=ahead, reach=reach, skew=0.0, stiffly_accurate=stiff
    )
    return Scheme(tableau, *points, c, places)


@functools.cache
def gauss(stages: int) -> Scheme:
    """The Gauss-Legendre method of ``stages`` stages, of order 2 ``stages``."""
    points = gauss_coefficients(stages)
    ahead = interpolation(np.append(points[2], 1.0), 1.0 + points[2])
    return _scheme(points, ahead, lobatto_places(stages), stiff=False)


@functools.cache
def radau(stages: int) -> Scheme:
    """The Radau IIA method of ``stages`` stages, of order 2 ``stages`` - 1. Its last stage is the end of the step."""
    points = radau_coefficients(stages)
    ahead = np.column_stack([interpolation(points[2], 1.0 + points[2]), np.zeros(stages)])
    return _scheme(points, ahead, None, stiff=True)


@functools.cache
def midpoint(alpha: float) -> Scheme:
    """The generalized midpoint rule: the Lagrangian at ``alpha``, each half-step with half of the forces' impulse."""
    one = np.ones(1)
    # The prediction interpolates between c = 1/2, for every alpha, and 1: the two points must differ.
    ahead = interpolation(np.array([0.5, 1.0]), np.array([1.5]))
    tableau = Tableau.make(
        a=np.full((1, 1), alpha),
        gradient=np.full((1, 1), 1.0 - alpha),
        force=np.full((1, 1), 0.5),
        b=one,
        c=0.5 * one,
        ahead=ahead,
        reach=alpha * (1.0 - alpha),
        skew=alpha - 0.5,
        stiffly_accurate=False,
    )
    return Scheme(tableau, *gauss_coefficients(1), alpha * one, lobatto_places(1) if alpha == 0.5 else None)


@functools.cache
def lobatto_places(stages: int) -> Floats:
    """Integrals (s + 1, s) of the Lagrange polynomials on s Gauss points, from 0 to each of s + 1 Lobatto points.

    Constraints hold at the Lobatto points of a unit step. The array is read-only.
    """
    _, weights, points = gauss_coefficients(stages)
    inner = np.polynomial.legendre.Legendre.basis(stages).deriv().roots().real
    at = 0.5 * (1.0 + np.concatenate([[-1.0], inner, [1.0]]))
    places = np.array([end * (weights @ interpolation(points, end * points)) for end in at])
    places[-1] = weights
    places.setflags(write=False)
    return places
