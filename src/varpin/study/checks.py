"""Independent checks of a motion. None of them uses the integrator's own statistics.

Each check takes a trajectory of any integrator. It returns a number that is small if the trajectory is right, and NaN
if the check does not apply. An error of at least the value in :data:`LEVELS` is wrong, unless varpin warned.
"""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.errors import LinearizationError
from varpin.integrators import Integrator
from varpin.linearization import linearize
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.study.exact import START, Exact, lasting, velocity_change
from varpin.trajectory import Trajectory

# The measures of a motion, and the value from which on each of them is wrong. Accuracy in units of the motion itself:
# of q shares of the largest travel and of each joint's, of v of each joint's largest, with a larger level, for a small
# shift in time changes a peak of the velocity by much (told of from an estimate of 0.25 on, which may be a quarter too
# small); of the energy a share of what is turned over. Structure in units of rounding, with a margin for
# ill-conditioned mass matrices.
LEVELS = {
    "error": 0.05,
    "joint": 0.1,
    "velocity": 0.35,
    "energy": 0.1,
    "symplecticity": 1e-7,
    "record": 1e-6,
}
# Rounding of a sum of a hundred terms at most, in units of its largest one.
_ROUNDING = 100.0 * np.finfo(np.float64).eps
# Nodes whose energies and momenta are compared, and nodes of the inertia in the energy's unit.
_NODES, _FEW_NODES = 12, 4


def _spread(last: int, count: int) -> NDArray[np.int64]:
    """Indices from 0 to the last, evenly spread, at most so many."""
    return np.unique(np.linspace(0, last, count).astype(np.int64))


def energy_error(scene: Scene, trajectory: Trajectory) -> float:
    """Largest error of the energy balance over all nodes, in units of the kinetic energy and work that change hands.

    What turns evenly, however fast, has next to no part in that. Of damped motions only what they gain counts, noisy
    ones have no balance.
    """
    if trajectory.dw.any() or not trajectory.steps:
        return math.nan
    kinetic = 0.5 * np.einsum("ki,ki->k", trajectory.p, trajectory.v)
    force = trajectory.u @ scene.actuation.T
    # By mean velocities: an explicit step moves q by the velocity before its force has acted.
    way = 0.5 * trajectory.dt * (trajectory.v[1:] + trajectory.v[:-1])
    work = np.append(0.0, np.cumsum(np.einsum("ki,ki->k", force, way)))
    off = trajectory.energy - trajectory.energy[0] - work
    off = np.maximum(off, 0.0) if scene.dissipates else np.abs(off)
    off = lasting(off, np.arange(len(off)))
    some = trajectory.q[_spread(trajectory.steps, _FEW_NODES)]
    inertia = np.max([np.diag(_pinocchio(scene, q, np.zeros_like(q))[2]) for q in some], axis=0)
    scale = min(kinetic.max(), 0.5 * inertia @ velocity_change(trajectory.v) ** 2) + np.abs(work).max()
    # A robot at rest turns nothing over: there rounding of the potential is all there is.
    scale = max(scale, 1e-9 * np.abs(trajectory.energy).max())
    if not np.isfinite(scale):
        return math.inf
    return float(np.nan_to_num(off.max() / scale, nan=np.inf)) if scale > 0.0 else 0.0


def symplecticity_error(A: Floats) -> float:
    """Largest entry of A' J A - J over all A (N, 2n, 2n), in units of the largest magnitude that cancels in it.

    In coordinates of each A's own scale: with q_i / s_i and p_i s_i for q and p, where what a kick does is of size one.
    """
    n = A.shape[1] // 2
    J = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    # Sums over i of |dq_i/dp_j| |dp_i/dp_j|: the scales of the other joints cancel in them.
    s = np.sqrt(np.einsum("kij,kij->kj", np.abs(A[:, :n, n:]), np.abs(A[:, n:, n:])))
    s = np.where(s > 0.0, s, 1.0)
    S = np.concatenate([1.0 / s, s], axis=1)
    scaled = S[:, :, None] * A / S[:, None, :]
    off = np.abs(scaled.transpose(0, 2, 1) @ J @ scaled - J).max(axis=(1, 2))
    terms = (np.abs(scaled).transpose(0, 2, 1) @ np.abs(J) @ np.abs(scaled)).max(axis=(1, 2))
    return float(np.max(off / np.maximum(terms, 1.0)))


def linearized(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Floats:
    """A of some steps that were not taken in parts (K, 2n, 2n); of variational methods, where nothing damps."""
    found = [np.zeros((0, 2 * scene.robot.dof, 2 * scene.robot.dof))]
    whole = np.flatnonzero(trajectory.statistics.substeps == 1)
    if integrator.variational and scene.conservative and not trajectory.dw.any() and len(whole):
        for step in whole[_spread(len(whole) - 1, _FEW_NODES)]:
            with contextlib.suppress(LinearizationError):
                found.append(linearize(scene, trajectory.part(int(step), int(step) + 1), integrator=integrator).A)
    return np.concatenate(found)


def record_error(scene: Scene, trajectory: Trajectory) -> float:
    """Largest distance of recorded momenta and energies from what Pinocchio makes of q and v.

    Beyond what rounding leaves of the levers about joints far below, whose squares cancel in the inertias of what they
    carry.
    """
    count = _NODES if scene.robot.dof <= 32 else 2
    worst = 0.0
    start = trajectory.energy[0] - _pinocchio(scene, trajectory.q[0], trajectory.v[0])[1]
    for k in _spread(trajectory.steps, count):
        v = trajectory.v[k]
        momentum, energy, mass = _pinocchio(scene, trajectory.q[k], v)
        # Energies are known up to a constant, which the first node tells.
        scale = max(0.5 * v @ momentum, abs(energy), 1e-3 * abs(trajectory.energy[0]))
        units = np.append(np.abs(mass) @ np.abs(v), scale)
        off = np.append(np.abs(momentum - trajectory.p[k]), abs(trajectory.energy[k] - energy - start))
        speed = np.abs(v).sum()
        rounding = _ROUNDING * np.diag(mass).max() * np.append(np.full(len(v), speed), speed**2)
        # What overflows on the way there, or is at rest to the last bit, is not comparable.
        known = (units > np.finfo(np.float64).tiny) & np.isfinite(units) & np.isfinite(rounding)
        shares = np.maximum(off - rounding, 0.0)[known] / units[known]
        worst = max(worst, float(np.nan_to_num(shares, nan=np.inf).max(initial=0.0)))
    return worst


def _pinocchio(scene: Scene, q: Floats, v: Floats) -> tuple[Floats, float, Floats]:
    """Momentum (n,), energy and mass matrix (n, n)."""
    jet = lagrangian_jet(scene, q, v, backend="pinocchio")
    kinetic = float(0.5 * v @ jet.Lv)
    return jet.Lv, kinetic + (kinetic - float(jet.L)), jet.Lvv


def finite(trajectory: Trajectory) -> bool:
    """Whether the record holds numbers only."""
    arrays: list[Any] = [trajectory.t, trajectory.q, trajectory.v, trajectory.p, trajectory.energy, trajectory.u]
    return all(bool(np.isfinite(array).all()) for array in arrays)


def measures(scene: Scene, integrator: Integrator, trajectory: Trajectory, exact: Exact | None) -> dict[str, float]:
    """Every check of a motion by its name in :data:`LEVELS`."""
    if exact is not None and integrator.order == 1 and exact.nodes[-1] < START:
        # From rest, such methods lag by half a step: much of few steps, little of the whole motion.
        exact = None
    with np.errstate(over="ignore", invalid="ignore"):
        A = linearized(scene, integrator, trajectory)
        return ({} if exact is None else exact.errors(trajectory)) | {
            "energy": energy_error(scene, trajectory),
            # Methods that damp fast modes within a step are not symplectic.
            "symplecticity": symplecticity_error(A) if len(A) and not integrator.l_stable else math.nan,
            "record": record_error(scene, trajectory),
        }


def condition(scene: Scene, q0: Floats) -> float:
    """Condition number of the mass matrix at the start: rounding in its solutions is as much larger."""
    mass = lagrangian_jet(scene, q0, np.zeros_like(q0), backend="pinocchio").Lvv
    return float(np.linalg.cond(mass)) if mass.size else 1.0


def findings(found: dict[str, float], condition: float = 1.0) -> tuple[str, ...]:
    """Which measures are beyond their level, or 1 without one, in words; ``condition`` is that of the mass matrix."""
    # Derivatives hold solutions of linear systems, and cannot be better than those.
    solved = max(LEVELS["symplecticity"], 10.0 * np.finfo(np.float64).eps * condition)
    levels = LEVELS | {"symplecticity": solved}
    return tuple(
        f"{name} {value:.2g} (wrong from {levels.get(name, 1.0):g})"
        for name, value in found.items()
        if value >= levels.get(name, 1.0)
    )
