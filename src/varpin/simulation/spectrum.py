"""How fast and how far: modes of a scene, what is damped faster than a step, travels and speeds of a motion.

A motion linearized at one of its states: d/dt (dq, dv) = (dv, aq dq + av dv). Under constraints dq = Z y on the tangent
space, with Z'MZ = 1 and C Z = 0, and y follows the same equation: the constraint forces C' lam are constant to first
order in it, but for their curvature lam . g_qq.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.errors import LinearizationError
from varpin.integrators.explicit import accelerations
from varpin.mechanics.forces import dissipates, limited_servos, of_kind
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.model import longest_reach

# Rank tolerance of the constraints in the metric of the kinetic energy, relative to the largest singular value.
_RANK = 1e-9
# Nodes at which rates along a motion are looked for, beside those where joints are slowest or in their stops.
_NODES = 12
# Accumulated rounding, relative to positions.
_ROUNDING = 1e3 * float(np.finfo(np.float64).eps)
# A joint travel below this counts as no motion [rad or m].
_SHORTEST = 1e-8
# Joints that hardly move are measured by the others: by this share of what those move at the robot's reach, and by this
# share of the largest speed of their kind.
_LITTLE, _SLOW = 1e-2, 5e-2
# Rates below count as zero [1/s].
_SLOWEST = 1e-6


class Linearized(NamedTuple):
    """Motions linearized at K states, in f coordinates y of their tangent spaces, with dq = Z y; y = q without any."""

    a: Floats  # accelerations of y (K, f)
    aq: Floats  # their derivatives in y (K, f, f)
    av: Floats  # in the rate of y (K, f, f)
    af: Floats  # in a force (K, f, n)
    Z: Floats  # (K, n, f)
    onto: Floats  # the rate of y is onto @ v (K, f, n)


def linearized(scene: Scene, q: Floats, v: Floats, forces: Floats, accelerated: Floats | None = None) -> Linearized:
    """Linearize the motions at states q, v (K, n) on the constraints, under constant forces (K, n).

    ``accelerated`` (K, n) are the accelerations of joints with kinematic inputs, zero if left out. Raises a
    LinearizationError where a mass matrix is not positive definite, or a matrix of the constraints not finite.
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


def masses(scene: Scene, q: Floats) -> Floats:
    """M (K, n, n) at configurations (K, n)."""
    q = np.ascontiguousarray(q)
    return scene.core.jets(q, np.zeros_like(q))[0]


def damping_matrices(scene: Scene, q: Floats, v: Floats, forces: Floats, *, custom: bool = False) -> Floats:
    """D (K, n, n) of M w' = -D w, of what acts at joints and between links; of custom forces on request.

    At states q, v (K, n) under constant forces (K, n); symmetric.
    """
    q, v = np.ascontiguousarray(q), np.ascontiguousarray(v)
    dampers = -np.minimum(scene.core.forces(q, v, np.ascontiguousarray(forces))[2], 0.0)
    D: Floats = dampers[:, :, None] * np.eye(q.shape[1])
    if scene.couplings or (custom and scene.custom is not None):
        slopes = scene.core.coupled_forces(q, v)[2]
        D -= 0.5 * (slopes + np.swapaxes(slopes, 1, 2))
    return D


def _definite(matrices: Floats) -> bool:
    """Whether all of some symmetric matrices (K, n, n) are positive definite."""
    try:
        np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        return False
    return True


def fastest_damping(scene: Scene, q: Floats, v: Floats, forces: Floats, least: float) -> float:
    """The largest rate of damping [1/s] at states q, v (K, n) under constant forces (K, n); 0 if below ``least``."""
    M, D = masses(scene, q), damping_matrices(scene, q, v, forces, custom=True)
    if _definite(least * M - D):
        return 0.0
    if not _definite(M):
        return math.inf
    root = np.linalg.cholesky(M)
    white = np.linalg.solve(root, np.swapaxes(np.linalg.solve(root, D), 1, 2))
    return float(np.linalg.eigvalsh(white).max())


def pulls_fast(scene: Scene, q: Floats, forces: Floats, dt: float) -> bool:
    """Whether springs, servos or gravity advance a mode by more than a radian in ``dt`` [s], at rest at q (K, n)."""
    q, still = np.ascontiguousarray(q), np.zeros_like(q)
    K = np.array([scene.core.jet(x, still[0])[3] for x in q])
    K += scene.core.forces(q, still, np.ascontiguousarray(forces))[1][:, :, None] * np.eye(q.shape[1])
    if scene.couplings:
        slopes = scene.core.coupled_forces(q, still)[1]
        K += 0.5 * (slopes + np.swapaxes(slopes, 1, 2))
    return not _definite(masses(scene, q) + dt**2 * np.array([K, -K]))


def rate_at_rest(scene: Scene, q: Floats) -> float:
    """The fastest rate of damping [1/s] at a configuration (n,) with all joints at rest, where friction is steepest.

    Servos are told to stay there: a drive at its limit would damp nothing.
    """
    if not any(map(dissipates, scene.elements)) and not any(map(dissipates, scene.couplings)):
        return 0.0
    still, force = np.zeros((1, q.size)), np.zeros((1, q.size))
    for servo in limited_servos(scene.elements):
        force[0, servo.coordinate] = servo.values[0] * q[servo.coordinate]
    return fastest_damping(scene, q[None], still, force, _SLOWEST)


def fastest_rate(scene: Scene, q: Floats, v: Floats, u: Floats, least: float) -> float:
    """The fastest rate of damping along a motion q, v (N + 1, n), u (N, m) [1/s]; 0 if none is faster than ``least``.

    It is looked for at some nodes, where dry friction is steepest, as joints come to rest or turn back, and in the
    stops that joints reach.
    """
    if not scene.dissipates or not len(u):
        return 0.0
    at = np.unique(np.linspace(0, len(u), _NODES).astype(np.int64))
    states = [(q[at], v[at], at)]
    for friction in of_kind(scene.elements, "CoulombFriction"):
        c = friction.coordinate
        node = np.array([int(np.abs(v[:, c]).argmin())])
        still = v[node]
        if v[:, c].min() < 0.0 < v[:, c].max():
            still[:, c] = 0.0
        states.append((q[node], still, node))
    states += _in_stops(scene, q, v)
    q, v, at = (np.concatenate(rows) for rows in zip(*states, strict=True))
    return fastest_damping(scene, q, v, u[np.minimum(at, len(u) - 1)] @ scene.actuation.T, least)


def contact_rate(scene: Scene, q: Floats, v: Floats, dt: float) -> float:
    """The fastest rate [1/s] of a spring or damper, in the stops that joints reach; 0 where they reach none.

    ``q`` and ``v`` are the nodes of a motion (N + 1, n) in steps of ``dt`` [s], within which a joint may come and go.
    """
    states = _in_stops(scene, np.concatenate([q, q + dt * v]), np.concatenate([v, v]))
    if not states:
        return 0.0
    q, v, _ = (np.concatenate(rows) for rows in zip(*states, strict=True))
    # Springs of stops are in the potential, their dampers among the forces.
    jets = [lagrangian_jet(scene, place, np.zeros_like(place)) for place in q]
    eased = np.array([np.diag(np.linalg.inv(jet.Lvv)) for jet in jets])
    by_q = np.array([np.diag(jet.Lqq) for jet in jets])
    by_v = scene.core.forces(q, v, np.zeros_like(q))[2]
    return float(np.maximum(np.sqrt(np.maximum(-by_q * eased, 0.0)), -by_v * eased).max())


def _in_stops(scene: Scene, q: Floats, v: Floats) -> list[tuple[Floats, Floats, Integers]]:
    """States (1, n), (1, n) and nodes (1,) of a motion where joints are deepest in each stop, at full stiffness."""
    states = []
    for c, end, side, width in _ends(scene):
        deepest = int((side * q[:, c]).argmax())
        if (depth := side * (q[deepest, c] - end)) > 0.0:
            pressed = q[deepest][None].copy()
            pressed[0, c] = end + side * max(depth, width)
            states.append((pressed, v[deepest][None], np.array([deepest])))
    return states


def _ends(scene: Scene) -> list[tuple[int, float, float, float]]:
    """The finite ends of joint stops: coordinate, place, -1 for a lower and 1 for an upper one, and width."""
    found = []
    for stop in of_kind(scene.elements, "JointStop"):
        lower, upper, *_, width = stop.values
        both = ((lower, -1.0), (upper, 1.0))
        found += [(stop.coordinate, end, side, width) for end, side in both if np.isfinite(end)]
    return found


def stops_ahead(scene: Scene, q: Floats) -> Floats:
    """Configurations (K, n): ``q`` (n,) with one joint each in a stop, deep enough for the stop's full stiffness."""
    ends = _ends(scene)
    rows = np.tile(q, (len(ends), 1))
    for row, (c, end, side, width) in zip(rows, ends, strict=True):
        row[c] = end + side * width
    return rows


def largest_of_its_kind(scene: Scene, values: Floats) -> Floats:
    """For each coordinate (..., n), the largest value of all revolute joints, or of all prismatic ones."""
    sliding = scene.robot.slides
    largest = [values[..., kind].max(axis=-1, initial=0.0, keepdims=True) for kind in (sliding, ~sliding)]
    each: Floats = np.where(sliding, *largest)
    return each


def travel_scales(scene: Scene, q: Floats) -> Floats:
    """For each coordinate (n,), the travel of which errors are shares, from the nodes q (K, n).

    It is the largest travel of the coordinate's kind; where joints turn and slide, at least ``_LITTLE`` of what the
    others move at the robot's reach.
    """
    travel = largest_of_its_kind(scene, q.max(axis=0) - q.min(axis=0))
    sliding = scene.robot.slides
    if sliding.any() and not sliding.all():
        reach = longest_reach(scene.robot)
        # On rails without ends: a metre.
        lever = reach if 0.0 < reach < np.inf else 1.0
        turns, slides = float(travel[~sliding].max()), float(travel[sliding].max())
        travel = np.maximum(travel, _LITTLE * np.where(sliding, turns * lever, slides / lever))
    scales: Floats = np.maximum(travel, max(_SHORTEST, _ROUNDING * (1.0 + float(np.abs(q).max(initial=0.0)))))
    return scales


def speed_scales(scene: Scene, v: Floats) -> Floats:
    """For each coordinate (n,), the speed of which errors of v are shares, from the nodes v (K, n)."""
    speed = np.abs(v).max(axis=0, initial=0.0)
    scales: Floats = np.maximum(np.maximum(speed, _SLOW * largest_of_its_kind(scene, speed)), _SHORTEST)
    return scales
