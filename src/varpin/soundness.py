"""What a finished motion says of itself: does its energy balance close, and do its steps resolve it?

Both are asked of every integrator after the run, from its record and a few of its steps; what the guards of a step
let pass, and integrators without guards, are told of here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.errors import SingularMassMatrix
from varpin.integrators import Integrator, Reference
from varpin.integrators.base import open_loop
from varpin.integrators.explicit import accelerations
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


def warnings_of(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> tuple[str, ...]:
    """What is to be said about a motion, a sentence each; none if nothing is."""
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
            f"the energy is off by {defect[worst]:.3g} J at t = {trajectory.t[worst + 1]:.4g} s{share}: "
            f"dt = {trajectory.dt:g} s is too long for {integrator}"
        )
    step = step_error(scene, integrator, trajectory)
    if step is not None and not step.error <= COARSE:
        found.append(
            f"dt = {trajectory.dt:g} s is coarse for {integrator} here: halving it moves the step at "
            f"t = {trajectory.t[step.step]:.4g} s by {100 * step.error:.3g}% of what the step does"
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
