"""Noise about a motion under feedback, to first order: covariances forward, standard deviations of rows, and its cost.

Control limits are neglected.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from varpin.arrays import Floats
from varpin.control.constraints import BoundConstraint
from varpin.control.stages import Feedback, Steps


def noise_cost(steps: Steps, feedback: Feedback, *, halves: bool = False) -> float:
    """The noise cost of a motion under feedback, to second order, without that of control changes.

    With ``halves`` the steps are halves of those whose linear controls the feedback decides.
    """
    C, x, end = _propagated(steps, feedback, halves=halves), steps.J.shape[1], steps.terminal.hessian
    of_states = (steps.costs[1] * C[:-1]).sum() + (end * C[-1, :x, :x]).sum()
    return 0.5 * float(of_states) + _of_impulses(steps, steps.kicked, C)


def left_within_steps(steps: Steps, feedback: Feedback) -> float:
    """The part of :func:`noise_cost` that no path shows."""
    if steps.beyond is None:
        return 0.0
    return _of_impulses(steps, steps.problem.dt * steps.beyond, _propagated(steps, feedback))


def covariances(steps: Steps, feedback: Feedback) -> Floats:
    """Covariances of the state at the nodes (N + 1, 2n, 2n); :func:`varpin.propagate_moments` has none of feedback."""
    x = steps.J.shape[1]
    return _propagated(steps, feedback)[:, :x, :x]


def deviations(steps: Steps, feedback: Feedback, bounds: Sequence[BoundConstraint]) -> list[Floats]:
    """Standard deviations (K, rows) of state constraints."""
    P, motion, found = covariances(steps, feedback), steps.trajectory, []
    for bound in bounds:
        J = bound.jacobian(motion.q, motion.v) @ steps.slopes[bound.places]
        variance = np.einsum("krx,kxy,kry->kr", J, P[bound.places], J)
        found.append(np.sqrt(np.maximum(variance, 0.0)))
    return found


def _propagated(steps: Steps, feedback: Feedback, *, halves: bool = False) -> Floats:
    """Covariances (N + 1, Z, Z) of the variables of each step, and that of the state at the end.

    C = T P T', P' = J C J' + dt sum_i E[g_i g_i'] with the steps closed by feedback in T.
    """
    J, G, Gz, T = steps.J, steps.lin.G, steps.Gz, steps.closed(feedback, halves=halves)
    N, x, Z = J.shape
    C, through = np.zeros((N + 1, Z, Z)), np.eye(Z)
    for k in range(N):
        C[k] = T[k] @ C[k] @ T[k].T
        through[:x] = J[k]
        C[k + 1] = through @ C[k] @ through.T
        C[k + 1, :x, :x] += steps.problem.dt * (G[k] @ G[k].T + (Gz[k] @ C[k]).reshape(x, -1) @ Gz[k].reshape(x, -1).T)
    C[N, x:], C[N, :, x:] = 0.0, 0.0
    return C


def _of_impulses(steps: Steps, hessian: Floats, C: Floats) -> float:
    """The cost of the noise's effects by its Hessian (N, 2n, 2n) in them, for the covariances C before the steps."""
    G, Gz = steps.lin.G, steps.Gz
    twice = np.einsum("Nak,Nab,Nbk->", G, hessian, G, optimize=True)
    return 0.5 * float(twice + np.einsum("Nakz,Nab,Nbky,Nzy->", Gz, hessian, Gz, C[:-1], optimize=True))
