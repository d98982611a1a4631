"""Modes of a motion linearized at its nodes: d/dt (dq, dv) = (dv, aq dq + av dv).

Under constraints dq = Z y on the tangent space, with Z'MZ = 1 and C Z = 0, and y follows the same equation: the
constraint forces C' lam are constant to first order in it, but for their curvature lam . g_qq.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.integrators.explicit import accelerations
from varpin.mechanics.scene import Scene

# Rank tolerance of the constraints in the metric of the kinetic energy, relative to the largest singular value.
_RANK = 1e-9


class Linearized(NamedTuple):
    """Motions linearized at K states, in f coordinates y of their tangent spaces, with dq = Z y; y = q without any."""

    a: Floats  # accelerations of y (K, f)
    aq: Floats  # their derivatives in y (K, f, f)
    av: Floats  # in the rate of y (K, f, f)
    af: Floats  # in a force (K, f, n)
    Z: Floats  # (K, n, f)
    onto: Floats  # the rate of y is onto @ v (K, f, n)


def linearized(scene: Scene, q: Floats, v: Floats, forces: Floats, of_inputs: Floats | None = None) -> Linearized:
    """Linearize the motions at states q, v (K, n) under constant forces (K, n).

    Args:
        scene: The scene.
        q: Configurations (K, n), on the constraints [rad or m].
        v: Velocities (K, n) that the constraints allow.
        forces: (K, n) [N m or N].
        of_inputs: Accelerations of the joints (K, n), of which those with kinematic inputs are read; zero if left out.

    Raises:
        LinearizationError: A mass matrix is not positive definite.
    """
    a, aq, av, af = accelerations(scene, q, v, forces)
    if not scene.constraints:
        unit = np.broadcast_to(np.eye(q.shape[1]), aq.shape)
        return Linearized(a, aq, av, af, unit, unit)
    pushed, bases, inverses, bends = [], [], [], []
    C = scene.core.constraints(np.ascontiguousarray(q))[2]
    for k in range(len(q)):
        root = np.linalg.cholesky(af[k])
        left, sizes, right = np.linalg.svd(C[k] @ root)
        rank = int((sizes > _RANK * sizes.max(initial=0.0)).sum())
        # The acceleration and the velocity across the tangent space, by the least squares of all rows.
        inverse = root @ (right[:rank].T / sizes[:rank]) @ left[:, :rank].T
        bend = scene.core.constraint_curvature(q[k], np.zeros(len(C[k])), v[k])[1]
        wanted = -bend @ v[k]
        for row, c in scene.inputs.items():
            wanted[row] = 0.0 if of_inputs is None else of_inputs[k, c]
        impulse = left[:, :rank] @ ((left[:, :rank].T @ (wanted - C[k] @ a[k])) / sizes[:rank] ** 2)
        pushed.append(impulse)
        bases.append(root @ right[rank:].T)
        inverses.append(inverse)
        bends.append(bend)
    lam = np.array(pushed)
    a, aq, av, af = accelerations(scene, q, v, forces + np.einsum("kri,kr->ki", C, lam))
    Z = np.array(bases)
    M = np.linalg.inv(af)
    onto = np.swapaxes(Z, 1, 2) @ M
    curved = np.array([scene.core.constraint_curvature(x, y, x)[0] for x, y in zip(q, lam, strict=True)])
    # A velocity stays on the constraints: its part across them changes with y.
    turned = -np.array(inverses) @ np.array(bends) @ Z
    by_place = onto @ (aq + af @ curved) @ Z + onto @ av @ turned
    return Linearized((onto @ a[:, :, None])[:, :, 0], by_place, onto @ av @ Z, onto @ af, Z, onto)


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
