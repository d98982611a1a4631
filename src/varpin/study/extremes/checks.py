"""Independent checks of a motion. None of them uses what the integrator that made it says of itself.

Each takes a record, whoever made it, and returns a number that is small if the record is right, NaN if the check does
not apply. What is small, :data:`LEVELS` says: an error is called wrong from there on, unless varpin said something.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from varpin.errors import LinearizationError, VarpinError
from varpin.integrators import Gauss, Integrator, Midpoint, Reference
from varpin.integrators.base import open_loop
from varpin.linearization import linearize
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.simulation.run import simulate
from varpin.study.extremes.periods import period_error
from varpin.study.extremes.trial import LEVELS, Setup
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# Growth of a small disturbance up to which motions are compared one by one; beyond it by their energies.
_PREDICTABLE = 10.0
_DISTURBANCE = 1e-7
# Ways shorter than this count as it [rad or m].
_SHORTEST = 1e-6
# A joint that moves less than others of its kind, and with less of the speed that would have their energy, than these
# parts is measured in these parts of theirs.
_LITTLE, _LIGHT = 1e-2, 1e-2
# Part of an even speed that counts as a change of it.
_EVEN = 1e-3
_SAMPLES, _DYING = 32, 4
# Steps from rest of which half a step is much.
_STARTING = 4
# Rounding of a sum, in units of its largest term, with room for a hundred of them.
_ROUNDING = 100.0 * np.finfo(np.float64).eps
# The exact motion may take this long, of the processor's time, so that what else it does changes nothing [s].
_PATIENCE = 3.0
_NODES = 12
_REVERSED = 8


@dataclass(frozen=True, eq=False)
class Exact:
    """The motion as it should be, at some nodes.

    Attributes:
        nodes: Their indices (K,).
        q: (K, n) [rad or m].
        way: How far it goes [rad or m].
        v: (K, n) [rad/s or m/s], or None where it is not known.
        ways: How far each joint goes (n,) [rad or m].
        speeds: How fast each joint gets (n,) [rad/s or m/s].
        cut: Whether it can be told over a part of the window only.
    """

    nodes: NDArray[np.int64]
    q: Floats
    way: float
    v: Floats | None
    ways: Floats
    speeds: Floats
    cut: bool = False


def exact_motion(setup: Setup, dt: float, steps: int, window: float, *, late: bool = False) -> Exact:
    """The exact motion over a window, as far as a small disturbance does not grow out of hand.

    In closed form where there is one; else by DOP853 at a tolerance of 1e-11, kicks of additive noise in between; it
    ends early where that takes too long, or cannot be integrated. A kick comes before its step, or after it if
    ``late``: to strong order one, which is what is promised of additive noise, that is the same
    motion.

    Raises:
        VarpinError: There is none at all.
    """
    steps = min(steps, max(1, round(window / dt)))
    varying = (setup.controls is not None and setup.controls.ndim == 2) or setup.increments is not None
    stride = 1 if varying else max(1, steps // _SAMPLES)
    if varying:
        steps = min(steps, 2 * _SAMPLES)
    # The first ones are where what is stiff dies out.
    nodes = np.union1d(np.arange(1, min(steps, _DYING) + 1), np.arange(stride, steps + 1, stride))
    if setup.exact is not None:
        q = np.array([setup.exact(k * dt) for k in nodes])
        v = None if setup.rate is None else np.array([setup.rate(k * dt) for k in nodes])
    else:
        q, v = _reference(setup, dt, nodes, late)
        q = q + setup.shift
    cut = len(q) < len(nodes)
    nodes = nodes[: len(q)]
    way = max(float(np.abs(q - setup.q0).max()), _SHORTEST)
    return Exact(nodes, q, way, v, *_units(setup, dt, nodes, q, v), cut)


def _units(setup: Setup, dt: float, nodes: NDArray[np.int64], q: Floats, v: Floats | None) -> tuple[Floats, Floats]:
    """Ways and speeds of :class:`Exact`: of each joint its own, or a small part of the others'."""
    way = np.abs(q - setup.q0).max(axis=0)
    known = np.vstack([setup.v0, np.diff(q, axis=0, prepend=setup.q0[None]) / dt if v is None else v])
    speed, duration = np.abs(known).max(axis=0), float(nodes[-1]) * dt
    slides = setup.scene.robot.slides
    inertia = np.sqrt(np.diag(lagrangian_jet(setup.scene, setup.q0, np.zeros_like(setup.q0), backend="pinocchio").Lvv))
    # What turns evenly, however fast, has next to no part in what the others do.
    change = np.clip(np.ptp(known, axis=0), _EVEN * speed, speed)
    light = _LIGHT * (inertia * change).max() / inertia
    for values, least in ((way, light * duration), (speed, light)):
        for kind in (slides, ~slides):
            others = _LITTLE * values[kind].max(initial=0.0)
            values[kind] = np.maximum(values[kind], np.minimum(others, least[kind]))
    return np.maximum(way, _SHORTEST), np.maximum(speed, _SHORTEST)


def _reference(setup: Setup, dt: float, nodes: NDArray[np.int64], late: bool) -> tuple[Floats, Floats]:
    """Configurations and velocities of the twin at as many of the nodes as can be told, one at least, each (K, n)."""
    paths = [_reference_path(setup, dt, nodes, disturbance, late) for disturbance in (0.0, _DISTURBANCE)]
    found: list[tuple[Floats, Floats]] = []
    begin = time.process_time()
    try:
        for plain, moved in zip(*paths, strict=True):
            grown = np.abs(moved[0] - plain[0]).max() > _PREDICTABLE * _DISTURBANCE
            if not (grown and found):
                found.append(plain)
            if grown or time.process_time() - begin > _PATIENCE:
                break
    except VarpinError:
        if not found:
            raise
    return np.array([q for q, _ in found]), np.array([v for _, v in found])


def _reference_path(
    setup: Setup, dt: float, nodes: NDArray[np.int64], disturbance: float, late: bool
) -> Iterator[tuple[Floats, Floats]]:
    scene = setup.scene if setup.twin is None else setup.twin
    quiet = Scene(
        scene.robot,
        gravity=scene.gravity,
        damping=scene.damping,
        stiffness=scene.stiffness,
        rest=scene.rest,
        actuation=scene.actuation,
    )
    n = scene.robot.dof
    q, v = setup.q0 - setup.shift + disturbance, setup.v0.copy()
    reference = Reference(rtol=1e-11)
    before = 0
    for node in nodes:
        kick = np.zeros(n)
        if setup.increments is not None:
            field = scene.noise.fields(q[None], v[None], np.zeros((1, scene.controls)), setup.q0).F[0]
            mass = lagrangian_jet(scene, q, np.zeros(n), backend="pinocchio").Lvv
            kick = np.linalg.solve(mass, field @ setup.increments[before])
        v = v if late else v + kick
        u = np.zeros(scene.controls) if setup.controls is None else np.atleast_2d(setup.controls)[before % _rows(setup)]
        state, _ = reference.start(quiet, q[None], v[None])
        (segment,) = reference.rollout(quiet, state, open_loop(u[None]), np.zeros((0, 0, 0)), (node - before) * dt)
        if segment.failure is not None:
            raise VarpinError(f"no reference: {segment.failure.reason}")
        q, v, before = segment.q[0], segment.v[0] + (kick if late else 0.0), int(node)
        yield q, v


def _rows(setup: Setup) -> int:
    return 1 if setup.controls is None or setup.controls.ndim == 1 else len(setup.controls)


def reference_error(exact: Exact, trajectory: Trajectory) -> float:
    """Largest distance in q from the exact motion, in units of its way."""
    known = exact.nodes <= trajectory.steps
    if not known.any():
        return math.nan
    return float(np.abs(trajectory.q[exact.nodes[known]] - exact.q[known]).max() / exact.way)


def joint_error(exact: Exact, trajectory: Trajectory) -> float:
    """The same, each joint in units of its own way: what is far or fast does not hide the others."""
    known = exact.nodes <= trajectory.steps
    if not known.any():
        return math.nan
    return float((np.abs(trajectory.q[exact.nodes[known]] - exact.q[known]) / exact.ways).max())


def velocity_error(exact: Exact, trajectory: Trajectory) -> float:
    """Largest distance in v from the exact motion, each joint in units of its own largest velocity."""
    known = exact.nodes <= trajectory.steps
    if exact.v is None or not known.any():
        return math.nan
    return float((np.abs(trajectory.v[exact.nodes[known]] - exact.v[known]) / exact.speeds).max())


def unforced(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether nothing but gravity and springs acts."""
    return scene.conservative and not ((trajectory.u @ scene.actuation.T).any() or trajectory.dw.any())


def energy_error(scene: Scene, trajectory: Trajectory) -> float:
    """Largest error of the energy balance over all nodes, in units of the kinetic energy and work that change hands.

    What turns evenly, however fast, has next to no part in that. Of damped motions only what they gain counts, noisy
    ones have no balance.
    """
    if trajectory.dw.any() or not trajectory.steps:
        return math.nan
    kinetic = 0.5 * np.einsum("ki,ki->k", trajectory.p, trajectory.v)
    force = trajectory.u @ scene.actuation.T
    work = np.append(0.0, np.cumsum(np.einsum("ki,ki->k", force, np.diff(trajectory.q, axis=0))))
    off = trajectory.energy - trajectory.energy[0] - work
    off = np.maximum(off, 0.0) if scene.dissipates else np.abs(off)
    fastest = np.abs(trajectory.v).max(axis=0)
    change = np.clip(np.ptp(trajectory.v, axis=0), _EVEN * fastest, fastest)
    some = trajectory.q[np.unique(np.linspace(0, trajectory.steps, _DYING).astype(np.int64))]
    inertia = np.max([np.diag(_pinocchio(scene, q, np.zeros_like(q))[2]) for q in some], axis=0)
    scale = min(kinetic.max(), 0.5 * inertia @ change**2) + np.abs(work).max()
    # A robot at rest turns nothing over: there rounding of the potential is all there is.
    scale = max(scale, 1e-9 * np.abs(trajectory.energy).max())
    if not np.isfinite(scale):
        return math.inf
    return float(np.nan_to_num(off.max() / scale, nan=np.inf)) if scale > 0.0 else 0.0


def momentum_error(scene: Scene, trajectory: Trajectory) -> float:
    """Largest change of the momentum of the first joint, where nothing acts on it, in units of the largest one.

    The Lagrangian does not know that joint's position if there are neither gravity nor springs.
    """
    if scene.gravity.any() or scene.stiffness.any() or not unforced(scene, trajectory):
        return math.nan
    most = np.abs(trajectory.p).max()
    return float(np.abs(trajectory.p[:, 0] - trajectory.p[0, 0]).max() / most) if most > 0.0 else math.nan


def symmetric(integrator: Integrator) -> bool:
    """Whether a method undoes its own steps."""
    return isinstance(integrator, Gauss) or (isinstance(integrator, Midpoint) and integrator.alpha == 0.5)


def reversal_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> float:
    """Takes the last steps back, and returns how far from their start that ends, in units of the way.

    Only of symmetric methods, where nothing drives or damps and no step is taken in parts.
    """
    k = min(_REVERSED, trajectory.steps)
    if not (symmetric(integrator) and unforced(scene, trajectory) and k):
        return math.nan
    if (trajectory.statistics.substeps[-k:] > 1).any():
        return math.nan
    try:
        back = simulate(scene, trajectory.q[-1], -trajectory.v[-1], dt=trajectory.dt, steps=k, integrator=integrator)
    except VarpinError:
        return math.nan
    if back.statistics.split_steps:
        return math.nan
    legs = trajectory.q[-k - 1 :]
    way = max(float(np.abs(np.diff(legs, axis=0)).max()), _SHORTEST)
    return float(np.abs(back.q[::-1] - legs).max() / way)


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
    own = S[:, :, None] * A / S[:, None, :]
    off = np.abs(own.transpose(0, 2, 1) @ J @ own - J).max(axis=(1, 2))
    terms = (np.abs(own).transpose(0, 2, 1) @ np.abs(J) @ np.abs(own)).max(axis=(1, 2))
    return float(np.max(off / np.maximum(terms, 1.0)))


def linearized(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Floats:
    """A of some steps that were not taken in parts (K, 2n, 2n); of variational methods, where nothing damps."""
    n = scene.robot.dof
    nothing = np.zeros((0, 2 * n, 2 * n))
    if not integrator.variational or not scene.conservative or trajectory.dw.any():
        return nothing
    whole = np.flatnonzero(trajectory.statistics.substeps == 1)
    if not len(whole):
        return nothing
    found = []
    for step in whole[np.unique(np.linspace(0, len(whole) - 1, 4).astype(int))]:
        try:
            found.append(linearize(scene, trajectory.part(step, step + 1), integrator=integrator).A)
        except LinearizationError:
            continue
    return np.concatenate(found) if found else nothing


def record_error(scene: Scene, trajectory: Trajectory) -> float:
    """Largest distance of recorded momenta and energies from what Pinocchio makes of q and v.

    Beyond what rounding leaves of them: of q, by which states differ that are one and the same, and of the levers about
    joints far below, whose squares cancel in the inertias of what they carry.
    """
    count = _NODES if scene.robot.dof <= 32 else 2
    worst = 0.0
    start = trajectory.energy[0] - _pinocchio(scene, trajectory.q[0], trajectory.v[0])[1]
    for k in np.unique(np.linspace(0, trajectory.steps, count).astype(int)):
        q, v = trajectory.q[k], trajectory.v[k]
        momentum, energy, mass = _pinocchio(scene, q, v)
        kinetic = 0.5 * v @ momentum
        # Energies are known up to a constant, which the first node tells.
        scale = max(kinetic, abs(energy), 1e-3 * abs(trajectory.energy[0]))
        units = np.append(np.abs(mass) @ np.abs(v), scale)
        off = np.append(np.abs(momentum - trajectory.p[k]), abs(trajectory.energy[k] - energy - start))
        speed = np.abs(v).sum()
        sums = np.append(np.full(len(v), speed), speed**2)
        rounding = _ROUNDING * np.diag(mass).max() * sums + _of_last_bits(scene, q, v)
        # What overflows on the way there is not comparable.
        known = (units > 0.0) & np.isfinite(units) & np.isfinite(rounding)
        off = np.maximum(off - rounding, 0.0)
        shares = off[known] / units[known]
        worst = max(worst, float(np.nan_to_num(shares, nan=np.inf).max(initial=0.0)))
    return worst


def _pinocchio(scene: Scene, q: Floats, v: Floats) -> tuple[Floats, float, Floats]:
    """Momentum (n,), energy and mass matrix (n, n)."""
    jet = lagrangian_jet(scene, q, v, backend="pinocchio")
    kinetic = float(0.5 * v @ jet.Lv)
    return jet.Lv, kinetic + (kinetic - float(jet.L)), jet.Lvv


def _of_last_bits(scene: Scene, q: Floats, v: Floats) -> Floats:
    """By how much momenta and energy of states differ that are apart by rounding of q (n + 1,)."""
    spread = 2.0 * np.finfo(np.float64).eps
    low, high = (_pinocchio(scene, q * (1.0 + sign * spread), v) for sign in (-1.0, 1.0))
    return np.append(np.abs(high[0] - low[0]), abs(high[1] - low[1]))


def finite(trajectory: Trajectory) -> bool:
    """Whether the record holds numbers only."""
    arrays: list[Any] = [trajectory.t, trajectory.q, trajectory.v, trajectory.p, trajectory.energy, trajectory.u]
    return all(bool(np.isfinite(array).all()) for array in arrays)


def measures(setup: Setup, integrator: Integrator, trajectory: Trajectory, exact: Exact | None) -> dict[str, float]:
    """Every check of a motion by its name in :class:`Cell`."""
    scene = setup.scene
    if exact is not None and exact.cut and integrator.order == 1 and exact.nodes[-1] < _STARTING and not setup.v0.any():
        # What starts from rest is behind by half a step: much of what can be told of it, little of its motion.
        exact = None
    with np.errstate(over="ignore", invalid="ignore"):
        A = linearized(scene, integrator, trajectory)
        return {
            "error": math.nan if exact is None else reference_error(exact, trajectory),
            "joint": math.nan if exact is None else joint_error(exact, trajectory),
            "velocity": math.nan if exact is None else velocity_error(exact, trajectory),
            "period": period_error(scene, integrator, trajectory),
            "energy": energy_error(scene, trajectory),
            "momentum": momentum_error(scene, trajectory),
            "reversal": reversal_error(scene, integrator, trajectory),
            "symplecticity": symplecticity_error(A) if len(A) else math.nan,
            "record": record_error(scene, trajectory),
        }


def condition(setup: Setup) -> float:
    """Condition number of the mass matrix at the start: rounding in its solutions is as much larger."""
    mass = lagrangian_jet(setup.scene, setup.q0, np.zeros_like(setup.q0), backend="pinocchio").Lvv
    return float(np.linalg.cond(mass)) if mass.size else 1.0


def findings(found: dict[str, float], integrator: Integrator, condition: float = 1.0) -> tuple[str, ...]:
    """Which measures are beyond their level, in words; ``condition`` is that of the mass matrix."""
    levels = {name: LEVELS[name] for name in found}
    # Derivatives, and steps themselves, hold solutions of linear systems, and cannot be better than those.
    for name in ("symplecticity", "reversal"):
        levels[name] = max(LEVELS[name], 10.0 * np.finfo(np.float64).eps * condition)
    if integrator.variational:
        levels["momentum"] = LEVELS["kept momentum"]
    return tuple(
        f"{name} {value:.2g} (wrong from {levels[name]:g})"
        for name, value in found.items()
        if not (math.isnan(value) or value < levels[name])
    )
