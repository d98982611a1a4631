"""Modes of a motion linearized at its nodes: d/dt (dq, dv) = (dv, aq dq + av dv).

Under constraints dq = Z y on the tangent space, with Z'MZ = 1 and C Z = 0, and y follows the same equation: the
constraint forces C' lam are constant to first order in it, but for their curvature lam . g_qq.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.errors import LinearizationError
from varpin.integrators.explicit import accelerations
from varpin.mechanics.scene import Scene
from varpin.trajectory import Trajectory

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


def linearized(scene: Scene, q: Floats, v: Floats, forces: Floats, accelerated: Floats | None = None) -> Linearized:
    """Linearize the motions at states q, v (K, n) under constant forces (K, n).

    Args:
        scene: The scene.
        q: Configurations (K, n), on the constraints [rad or m].
        v: Velocities (K, n) that the constraints allow.
        forces: (K, n) [N m or N].
        accelerated: Accelerations of the joints (K, n), read for those with kinematic inputs; zero if left out.

    Raises:
        LinearizationError: A mass matrix is not positive definite, or a matrix of the constraints is not finite.
    """
    a, aq, av, af = accelerations(scene, q, v, forces)
    if not scene.constraints:
        unit = np.broadcast_to(np.eye(q.shape[1]), aq.shape)
        return Linearized(a, aq, av, af, unit, unit)
    C = scene.core.constraints(np.ascontiguousarray(q))[2]
    try:
        at = [
            _onto_constraints(scene, q[k], v[k], C[k], a[k], af[k], None if accelerated is None else accelerated[k])
            for k in range(len(q))
        ]
    except np.linalg.LinAlgError:
        raise LinearizationError(0, 0.0, "the constraints cannot be linearized") from None
    if len({each.Z.shape for each in at}) > 1:
        raise LinearizationError(0, 0.0, "the constraints have another rank at each node")
    lam = np.array([each.lam for each in at])
    a, aq, av, af = accelerations(scene, q, v, forces + np.einsum("kri,kr->ki", C, lam))
    Z = np.array([each.Z for each in at])
    M = np.linalg.inv(af)
    onto = np.swapaxes(Z, 1, 2) @ M
    curved = np.array([scene.core.constraint_curvature(x, y, x)[0] for x, y in zip(q, lam, strict=True)])
    # A velocity stays on the constraints: its part across them changes with y.
    turned = -np.array([each.across @ each.bend for each in at]) @ Z
    by_place = onto @ (aq + af @ curved) @ Z + onto @ av @ turned
    return Linearized((onto @ a[:, :, None])[:, :, 0], by_place, onto @ av @ Z, onto @ af, Z, onto)


def first_order(aq: Floats, av: Floats) -> Floats:
    """Matrices (K, 2n, 2n) of the linearized motion from derivatives of the accelerations (K, n, n)."""
    n = aq.shape[-1]
    A = np.zeros((len(aq), 2 * n, 2 * n))
    A[:, range(n), range(n, 2 * n)] = 1.0
    A[:, n:, :n], A[:, n:, n:] = aq, av
    return A


def of_inputs(scene: Scene, trajectory: Trajectory, at: Integers) -> Floats:
    """Mean accelerations (K, n) of joints with cubic kinematic inputs in the steps at nodes (K,); zero for others."""
    step = np.minimum(at, trajectory.steps - 1)
    found = np.zeros((len(at), scene.robot.dof))
    for c, rate in zip(scene.inputs.values(), scene.rates, strict=True):
        if rate >= 0:
            found[:, c] = np.diff(trajectory.v[:, c])[step] / trajectory.dt
    return found


class _Node(NamedTuple):
    lam: Floats  # the constraint forces (c,)
    Z: Floats  # (n, f)
    across: Floats  # the velocity (n, c) across the tangent space for a velocity of each row
    bend: Floats  # g_qq v (c, n)


def _onto_constraints(
    scene: Scene, q: Floats, v: Floats, C: Floats, a: Floats, af: Floats, accelerated: Floats | None
) -> _Node:
    """The tangent space at a state, and the constraint forces beside the accelerations a (n,) without them."""
    root = np.linalg.cholesky(af)
    left, sizes, right = np.linalg.svd(C @ root)
    rank = int((sizes > _RANK * sizes.max(initial=0.0)).sum())
    left, sizes = left[:, :rank], sizes[:rank]
    bend = scene.core.constraint_curvature(q, np.zeros(len(C)), v)[1]
    wanted = -bend @ v
    for row, c in scene.inputs.items():
        wanted[row] = 0.0 if accelerated is None else accelerated[c]
    lam = left @ ((left.T @ (wanted - C @ a)) / sizes**2)
    return _Node(lam, root @ right[rank:].T, root @ (right[:rank].T / sizes) @ left.T, bend)


def rate_bounds(aq: Floats, av: Floats) -> Floats:
    """Upper bounds (K,) of the rates of all modes [1/s], from norms."""
    of_q, of_v = (np.abs(slope).sum(axis=2).max(axis=1) for slope in (aq, av))
    bounds: Floats = np.sqrt(of_q) + of_v
    return bounds
