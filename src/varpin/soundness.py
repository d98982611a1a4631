"""What a finished motion says of itself: does its energy balance close, and do its steps resolve it?

Both are asked of every integrator after the run, from its record and a few of its steps; what the guards of a step
let pass, and integrators without guards, are told of here. Whoever makes a motion that a user sees calls
:func:`examined`, and :func:`announce` for the log.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from varpin.chatter import alternation
from varpin.errors import SingularMassMatrix
from varpin.integrators import Integrator, Reference
from varpin.integrators.base import open_loop
from varpin.integrators.explicit import accelerations
from varpin.lagrangian import lagrangian_jet
from varpin.scene import Scene
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# Error of the energy balance that is spoken of, in units of the energy there was to turn over.
ENERGY_BUDGET = 0.05
# Error of a step that is spoken of, in units of what the step does. Over a period that makes some percent.
COARSE = 0.005
# Steps looked at: those that change the velocity most, and as many spread over the motion.
_LOOKED_AT = 4
# Velocities below this count as none [rad/s or m/s]: what rounding leaves of a robot in equilibrium.
_STILL = 1e-9


# The kind of finding that says nothing against the motion as a solution of its equations.
JOINT_LIMITS = "joint limits"
# Beyond its limit by more than this a joint is spoken of [rad or m]; and so many of them with numbers.
_OUTSIDE, _NAMED = 1e-6, 6


@dataclass(frozen=True)
class Finding:
    """One thing to be said about a motion.

    Attributes:
        kind: What it is about, in a word or two; the log has each kind once for a scene and a time step.
        sentence: For the user, with numbers.
    """

    kind: str
    sentence: str


@dataclass(frozen=True)
class StepError:
    """How far a step is from the same in two halves, at its worst over the steps looked at.

    Attributes:
        step: Its index.
        error: The distance, in units of what the step does: of its way in q, or of its change of v; joints that turn
            and joints that slide each by themselves.
    """

    step: int
    error: float


def examined(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Trajectory, tuple[Finding, ...]]:
    """A motion with its energy balance, if the integrator keeps none, and its warnings; and what was found."""
    if not integrator.variational:
        own = replace(trajectory.statistics, energy_defect=energy_defects(scene, trajectory))
        trajectory = replace(trajectory, statistics=own)
    found = (*evident(scene, trajectory), *_looked_for(scene, integrator, trajectory), *alternating(scene, trajectory))
    return with_warnings(trajectory, found), found


def alternating(scene: Scene, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says if velocities alternate from step to step with neither controls nor noise that make them."""
    found = None if trajectory.dw.any() else alternation(trajectory.v, trajectory.u)
    if found is None:
        return ()
    sentence = (
        f"the velocity of {scene.robot.joint_names[found.joint]} alternates from step to step, {found.changes} times "
        f"in a row from t = {trajectory.t[found.first]:.4g} s on: dt = {trajectory.dt:g} s is too long for what is "
        "stiff, damped or fed back here"
    )
    return (Finding("alternating velocities", sentence),)


def with_warnings(trajectory: Trajectory, found: Iterable[Finding]) -> Trajectory:
    """The motion with what was found as its warnings."""
    sentences = tuple(finding.sentence for finding in found)
    return replace(trajectory, warnings=sentences) if sentences else trajectory


def announce(logger: logging.Logger, scene: Scene, dt: float, found: Iterable[Finding]) -> None:
    """Log what was found, each kind once for this scene and time step."""
    for finding in found:
        if (finding.kind, dt) not in scene.announced:
            scene.announced.add((finding.kind, dt))
            logger.warning(finding.sentence)


def evident(scene: Scene, trajectory: Trajectory) -> tuple[Finding, ...]:
    """What the record tells without taking steps again: dampers faster than the step, steps taken in parts."""
    found = list(_ringing(scene, trajectory.q, trajectory.dt))
    if split := trajectory.statistics.split_steps:
        most, steps, dt = trajectory.statistics.substeps.max(), trajectory.steps, trajectory.dt
        found.append(
            Finding(
                "split steps",
                f"{split} of {steps} steps were taken in up to {most} parts: dt = {dt:g} s is coarse here",
            )
        )
    return (*found, *_beyond_limits(scene, trajectory))


def _beyond_limits(scene: Scene, trajectory: Trajectory) -> tuple[Finding, ...]:
    """Says which joints leave their limits, which no motion is stopped by; the motion itself may be right."""
    lower, upper = scene.robot.position_limits
    # Limits that leave no room are a fault of the description, which inspect_robot tells of.
    sound = lower < upper
    with np.errstate(invalid="ignore"):
        excess = np.where(sound, np.maximum(lower - trajectory.q, trajectory.q - upper), -np.inf)
    most = excess.max(axis=0)
    joints = [int(c) for c in np.argsort(-most, kind="stable") if most[c] > _OUTSIDE]
    if not joints:
        return ()
    tree = scene.robot.tree
    slides = np.isin(np.arange(len(most)), tree.coordinate[tree.prismatic > 0])
    parts = []
    for c in joints[:_NAMED]:
        first, peak = int(np.argmax(excess[:, c] > _OUTSIDE)), int(np.argmax(excess[:, c]))
        since = "from the start" if first == 0 else f"from t = {trajectory.t[first]:.4g} s"
        unit, t = "m" if slides[c] else "rad", trajectory.t[peak]
        name, side = scene.robot.joint_names[c], "above" if trajectory.q[peak, c] > upper[c] else "below"
        limit = upper[c] if side == "above" else lower[c]
        parts.append(f"{name!r} {since}, at most {most[c]:.3g} {unit} {side} {limit:.4g} at t = {t:.4g} s")
    more = f"; and {len(joints) - _NAMED} more" if len(joints) > _NAMED else ""
    return (Finding(JOINT_LIMITS, f"joints leave their limits, which nothing stops: {'; '.join(parts)}{more}"),)


def _ringing(scene: Scene, q: Floats, dt: float) -> tuple[Finding, ...]:
    """Says if dampers are too fast for the step: the midpoint rule keeps stable, but turns velocities round."""
    if not scene.damping.any():
        return ()
    # Rates change along the motion as the inertia does.
    fastest = max(
        _damping_rate(scene, q[k]) for k in np.unique(np.linspace(0, len(q) - 1, _LOOKED_AT).astype(np.int64))
    )
    if 0.5 * dt * fastest <= 1.0:
        return ()
    return (
        Finding(
            "fast damping",
            f"damping is faster than the step (dt * {fastest:.3g}/s > 2): velocities that it should stop will ring; "
            f"dt below {2.0 / fastest:.3g} s resolves it",
        ),
    )


def _damping_rate(scene: Scene, q: Floats) -> float:
    """The fastest rate at which dampers stop a motion at a configuration [1/s]."""
    rate = np.linalg.solve(lagrangian_jet(scene, q, np.zeros_like(q)).Lvv, np.diag(scene.damping))
    return float(np.abs(np.linalg.eigvals(rate)).max()) if np.isfinite(rate).all() else np.inf


def _looked_for(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[Finding, ...]:
    """What the balance of the energy and steps taken again tell."""
    if not trajectory.steps:
        return ()
    found = []
    defect = np.abs(trajectory.statistics.energy_defect)
    scale = energy_scale(scene, trajectory)
    worst = int(np.argmax(defect))
    rounding = 1e-12 * float(np.abs(trajectory.energy).max())
    # Written such that what is not finite is spoken of.
    if not defect[worst] <= ENERGY_BUDGET * scale + rounding:
        share = f", {100 * defect[worst] / scale:.3g}% of what there was to turn over" if scale > 0.0 else ""
        found.append(
            Finding(
                "energy",
                f"the energy is off by {defect[worst]:.3g} J at t = {trajectory.t[worst + 1]:.4g} s{share}: "
                f"dt = {trajectory.dt:g} s is too long for {integrator}",
            )
        )
    step = step_error(scene, integrator, trajectory)
    if step is not None and not step.error <= COARSE:
        found.append(
            Finding(
                "coarse steps",
                f"dt = {trajectory.dt:g} s is coarse for {integrator} here: halving it moves the step at "
                f"t = {trajectory.t[step.step]:.4g} s by {100 * step.error:.3g}% of what the step does",
            )
        )
    return tuple(found)


def energy_scale(scene: Scene, trajectory: Trajectory) -> float:
    """The energy that a motion has to turn over [J]: its largest kinetic energy, and the work of the controls."""
    kinetic = 0.5 * np.einsum("ki,ki->k", trajectory.p, trajectory.v)
    work, _ = _works(scene, trajectory)
    return float(kinetic.max() + np.abs(np.cumsum(work)).max(initial=0.0))


def energy_defects(scene: Scene, trajectory: Trajectory) -> Floats:
    """What the energy is off by after each step (N,) [J], of what no control, damper or kick accounts for.

    From the record alone, for integrators that keep no ledger of their own. Velocities are taken for linear over a
    step. Zeros with noise that only Python can evaluate.
    """
    if scene.noise.diffusion is None:
        return np.zeros(trajectory.steps)
    kicked, given = _kicks(scene, trajectory)
    work, heat = _works(scene, trajectory, kicked)
    gained: Floats = trajectory.energy[1:] - trajectory.energy[0] - np.cumsum(work - heat + given)
    return np.nan_to_num(gained, nan=np.inf)


def _works(scene: Scene, trajectory: Trajectory, kicked: Floats | float = 0.0) -> tuple[Floats, Floats]:
    """Work of the controls, and what the dampers take, in each step (N,) [J], which a kick of v (N, n) begins."""
    h, before, after = trajectory.dt, trajectory.v[:-1] + kicked, trajectory.v[1:]
    force = trajectory.u @ scene.actuation.T
    with np.errstate(over="ignore", invalid="ignore"):
        work = 0.5 * h * np.einsum("ki,ki->k", force, before + after)
        heat = h / 3.0 * ((before**2 + before * after + after**2) @ scene.damping)
    return work, heat


def _kicks(scene: Scene, trajectory: Trajectory) -> tuple[Floats | float, Floats | float]:
    """What each step's kick does to v (N, n) and to the energy (N,) [J], if it comes all at once before the step."""
    if not trajectory.dw.any():
        return 0.0, 0.0
    q, v = trajectory.q[:-1], trajectory.v[:-1]
    fields = scene.noise.fields(q, v, trajectory.u, trajectory.q[0]).F
    impulse = np.einsum("kij,kj->ki", fields, trajectory.dw)
    change = np.einsum("kij,kj->ki", accelerations(scene, q, v, np.zeros_like(q))[3], impulse)
    return change, np.einsum("ki,ki->k", impulse, v + 0.5 * change)


def step_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> StepError | None:
    """The error of single steps, by taking some of them again, whole and in two halves and without noise.

    It says nothing of how errors grow. None where nothing moves, and for an integrator that chooses its own steps.
    """
    fastest = _of_its_kind(scene, np.abs(trajectory.v).max(axis=0))
    if isinstance(integrator, Reference) or not fastest.max() > _STILL:
        return None
    change = np.abs(np.diff(trajectory.v, axis=0)).max(axis=1)
    last = len(change) - 1
    most = np.argpartition(change, max(0, last - _LOOKED_AT + 1))[-_LOOKED_AT:]
    spread = np.linspace(0, last, _LOOKED_AT + 1)[1:].astype(np.int64)
    at = np.unique(np.concatenate([[0], most, spread]))
    q, v, h = trajectory.q[at], trajectory.v[at], trajectory.dt
    force = trajectory.u[at] @ scene.actuation.T
    try:
        whole, halves = (_end(scene, integrator, q, v, force, h / parts, parts) for parts in (1, 2))
    except SingularMassMatrix:
        return None
    moves = np.where(fastest > _STILL, fastest, np.inf)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(whole - halves)
        turned = _of_its_kind(scene, np.nan_to_num(np.abs(halves[1] - v)).max(axis=0))
        rounding = 1e3 * np.finfo(np.float64).eps * (1.0 + np.abs(q).max(axis=1)), 1e-12 * fastest
        error = np.maximum(
            np.where(off[0] <= rounding[0][:, None], 0.0, off[0] / (h * moves)),
            np.where(off[1] <= rounding[1], 0.0, off[1] / np.maximum(turned, 1e-3 * moves)),
        ).max(axis=1)
    # A step that cannot be taken again, without the kick that came with it, says nothing.
    if np.isnan(error).all():
        return None
    worst = int(np.nanargmax(error))
    return StepError(int(at[worst]), float(error[worst]))


def _of_its_kind(scene: Scene, values: Floats) -> Floats:
    """For each coordinate (n,), the largest value of all that turn, or of all that slide: units do not compare."""
    tree = scene.robot.tree
    slides = np.zeros(len(values), dtype=bool)
    slides[tree.coordinate[tree.prismatic > 0]] = True
    largest: Floats = np.where(slides, values[slides].max(initial=0.0), values[~slides].max(initial=0.0))
    return largest


def _end(scene: Scene, integrator: Integrator, q: Floats, v: Floats, force: Floats, dt: float, steps: int) -> Floats:
    """Where ``steps`` steps under constant forces end, as (q, v) (2, P, n); NaN where they fail."""
    paths, n = q.shape
    state, _ = integrator.start(scene, q, v)
    nothing = np.zeros((0, 0, scene.mechanism.diffusion.constant.shape[1]))
    drift = np.repeat(force[:, None], steps, axis=1)
    commands = open_loop(np.zeros((steps, scene.controls)))
    segments = integrator.rollout_compiled(scene, state, commands, nothing, drift, dt)
    end = np.full((2, paths, n), np.nan)
    for i, segment in enumerate(segments):
        if segment.failure is None:
            end[:, i] = segment.q[-1], segment.v[-1]
    return end
