"""Modes of a motion linearized at its nodes: d/dt (dq, dv) = (dv, aq dq + av dv)."""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats


def first_order(aq: Floats, av: Floats) -> Floats:
    """Matrices (K, 2n, 2n) of the linearized motion from derivatives of the accelerations (K, n, n)."""
    n = aq.shape[-1]
    A = np.zeros((len(aq), 2 * n, 2 * n))
    A[:, range(n), range(n, 2 * n)] = 1.0
    A[:, n:, :n], A[:, n:, n:] = aq, av
    return A


def rate_bounds(aq: Floats, av: Floats) -> Floats:
    """Upper bounds (K,) of the rates of all modes [1/s], from norms."""
    of_q, of_v = (np.abs(slope).sum(axis=2).max(axis=1) for slope in (aq, av))
    bounds: Floats = np.sqrt(of_q) + of_v
    return bounds
