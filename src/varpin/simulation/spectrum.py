"""How fast and how far: modes of a scene, what is damped faster than a step, travels and speeds of a motion."""

from __future__ import annotations

import math

import numpy as np

from varpin.arrays import Floats
from varpin.mechanics.forces import dissipates, limited_servos, of_kind
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene, tangent_basis
from varpin.model import longest_reach

# Nodes at which rates along a motion are looked for, beside those where joints are deepest in their stops.
_NODES = 12
# Accumulated rounding, relative to positions.
_ROUNDING = 1e3 * float(np.finfo(np.float64).eps)
# A joint travel below this counts as no motion [rad or m].
_SHORTEST = 1e-8
# Joints that hardly move are measured by the others: by this share of what those move at the robot's reach, and by this
# share of the largest speed of their kind.
_LITTLE, _SLOW = 1e-2, 5e-2
# Singular values of constraints that are rounding errors, relative to the largest; from 1e-12 to 1e-6.
_DEPENDENT = 1e-9
# Rates below count as zero [1/s].
_SLOWEST = 1e-6


def masses(scene: Scene, q: Floats) -> Floats:
    """M (K, n, n) at configurations (K, n)."""
    return scene.core.jets(q, np.zeros_like(q))[0]


def damping_matrices(scene: Scene, q: Floats, v: Floats, forces: Floats, *, custom: bool = False) -> Floats:
    """D (K, n, n) of M w' = -D w, of what acts at joints and between links; of custom forces on request.

    At states q, v (K, n) under constant forces (K, n); symmetric.
    """
    dampers = -np.minimum(scene.core.forces(q, v, forces)[2], 0.0)
    D: Floats = dampers[:, :, None] * np.eye(q.shape[1])
    if scene.couplings or (custom and scene.custom is not None):
        slopes = scene.core.coupled_forces(q, v)[2]
        D -= 0.5 * (slopes + np.swapaxes(slopes, 1, 2))
    return D


def fastest_damping(scene: Scene, q: Floats, v: Floats, forces: Floats, least: float) -> float:
    """The largest rate of damping [1/s] at states q, v (K, n) under constant forces (K, n); 0 if below ``least``."""
    try:
        root = np.linalg.cholesky(masses(scene, q))
        D = damping_matrices(scene, q, v, forces, custom=True)
        white = np.linalg.solve(root, np.swapaxes(np.linalg.solve(root, D), 1, 2))
        rate = float(np.linalg.eigvalsh(white).max())
    except np.linalg.LinAlgError:
        return math.inf
    return rate if rate > least else 0.0


def pulls_fast(scene: Scene, q: Floats, forces: Floats, dt: float) -> bool:
    """Whether springs, servos or gravity advance a mode by more than a radian in ``dt`` [s], at rest at q (K, n)."""
    still = np.zeros_like(q)
    K = np.array([scene.core.jet(x, still[0])[3] for x in q])
    K += scene.core.forces(q, still, forces)[1][:, :, None] * np.eye(q.shape[1])
    if scene.couplings:
        slopes = scene.core.coupled_forces(q, still)[1]
        K += 0.5 * (slopes + np.swapaxes(slopes, 1, 2))
    return bool(np.linalg.eigvalsh(masses(scene, q) + dt * dt * np.array([K, -K])).min() <= 0.0)


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


def natural_rate(scene: Scene, q: Floats, u: Floats) -> float:
    """The fastest rate [1/s] of swings or growth about a configuration (n,) where controls (m,) hold it."""
    still = np.zeros_like(q)
    jet, along = lagrangian_jet(scene, q, still), tangent_basis(scene, q)
    curvature = jet.Lqq
    if scene.constraints:
        # Constraint forces change with q, too.
        (C,) = scene.core.constraints(q[None])[2]
        forces = np.linalg.lstsq(C.T, scene.actuation @ u - scene.static_pull(q), rcond=_DEPENDENT)[0]
        curvature = curvature - scene.core.constraint_curvature(q, forces, still)[0]
    squares = np.linalg.eigvals(np.linalg.solve(along.T @ jet.Lvv @ along, along.T @ curvature @ along))
    return math.sqrt(float(np.abs(squares).max(initial=0.0)))


def fastest_rate(scene: Scene, q: Floats, v: Floats, u: Floats, least: float) -> float:
    """The fastest rate of damping along a motion q, v (N + 1, n), u (N, m) [1/s]; 0 if none is faster than ``least``.

    It is looked for at some nodes and in the stops that joints reach, with dry friction where it is steepest, as joints
    come to rest or turn back.
    """
    if not scene.dissipates or not len(u):
        return 0.0
    at = np.array([*np.linspace(0, len(u), _NODES).astype(np.int64), *_deepest(scene, q)])
    speeds = v[at]
    for c in (own.coordinate for own in of_kind(scene.elements, "CoulombFriction")):
        speeds[:, c] = 0.0 if v[:, c].min() < 0.0 < v[:, c].max() else np.abs(v[:, c]).min()
    return fastest_damping(scene, q[at], speeds, u[np.minimum(at, len(u) - 1)] @ scene.actuation.T, least)


def contact_rate(scene: Scene, q: Floats, v: Floats, dt: float) -> float:
    """The fastest rate [1/s] of a spring or damper, in the stops that joints reach; 0 where they reach none.

    ``q`` and ``v`` are the nodes of a motion (N + 1, n) in steps of ``dt`` [s], within which a joint may come and go.
    """
    q, v = np.concatenate([q, q + dt * v]), np.concatenate([v, v])
    at = _deepest(scene, q)
    if not at:
        return 0.0
    q, v = q[at], v[at]
    # Springs of stops are in the potential, their dampers among the forces.
    jets = [lagrangian_jet(scene, place, np.zeros_like(place)) for place in q]
    eased = np.array([np.diag(np.linalg.inv(jet.Lvv)) for jet in jets])
    by_q = np.array([np.diag(jet.Lqq) for jet in jets])
    by_v = scene.core.forces(q, v, np.zeros_like(q))[2]
    return float(np.maximum(np.sqrt(np.maximum(-by_q * eased, 0.0)), -by_v * eased).max())


def _deepest(scene: Scene, q: Floats) -> list[int]:
    """The nodes of q (K, n) at which joints are deepest in each stop that they reach."""
    deepest = [(c, end, side, int((side * q[:, c]).argmax())) for c, end, side, _ in _ends(scene)]
    return [node for c, end, side, node in deepest if side * (q[node, c] - end) > 0.0]


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
    """For each node of q (K, n) and coordinate, the travel up to it of which errors are shares.

    It is the largest travel of the coordinate's kind; where joints turn and slide, at least ``_LITTLE`` of what the
    others move at the robot's reach.
    """
    travel = largest_of_its_kind(scene, np.maximum.accumulate(q) - np.minimum.accumulate(q))
    sliding = scene.robot.slides
    if sliding.any() and not sliding.all():
        reach = longest_reach(scene.robot)
        # On rails without ends: a metre.
        lever = reach if 0.0 < reach < np.inf else 1.0
        turns, slides = (travel[:, kind].max(axis=1, keepdims=True) for kind in (~sliding, sliding))
        travel = np.maximum(travel, _LITTLE * np.where(sliding, turns * lever, slides / lever))
    scales: Floats = np.maximum(travel, max(_SHORTEST, _ROUNDING * (1.0 + float(np.abs(q).max(initial=0.0)))))
    return scales


def speed_scales(scene: Scene, v: Floats) -> Floats:
    """For each coordinate (n,), the speed of which errors of v are shares, from the nodes v (K, n)."""
    speed = np.abs(v).max(axis=0, initial=0.0)
    scales: Floats = np.maximum(np.maximum(speed, _SLOW * largest_of_its_kind(scene, speed)), _SHORTEST)
    return scales
