"""Exact motions with noise, in closed form and from nodes all over a motion, beside those of varpin's own check.

The exact motion is LSODA's at 1e-11: it takes stiff dampers, and shares nothing with the integrator. From which error
on a motion is wrong is in :data:`varpin.study.checks.LEVELS`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from battery.trial import Setup
from varpin.core import ForwardDynamics
from varpin.errors import VarpinError
from varpin.integrators import ExplicitEuler, Integrator
from varpin.mechanics.scene import Scene
from varpin.study.checks import LEVELS
from varpin.study.exact import (
    DISTURBANCE,
    NODES,
    PATIENCE,
    START,
    EndsHereError,
    Exact,
    grown,
    impulse,
    in_units,
    integrated,
    kicked,
)
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# Steps integrated between two tests of whether the motion is still predictable.
_CHUNK = 32
# Processor time, which other programs do not change [s]: for all periods, for one of them.
_PATIENCE_PERIODS, _PATIENCE_PERIOD = 4.0, 1.0
# Nodes from which the motion is repeated, and steps from each.
_BEGINS, _STEPS = 8, 64


def motion_of(
    scene: Scene, x: Floats, u: Floats, dt: float, *, dw: Floats | None, left: float | None, origin: Floats, end: float
) -> Iterator[Floats]:
    """States (K, 2n) of the exact motion, the first itself, then step by step or many at once.

    It ends where it cannot be integrated, or at a processor time.

    Args:
        scene: The scene.
        x: q and v at first (2n,).
        u: Controls of each step (N, m).
        dt: Time step [s].
        dw: Increments of the Wiener processes (N, k), or None.
        left: Part of each kick that comes before its step; the rest comes after it. None for a constant force over the
            step instead.
        origin: Configuration that diffusion fields are relative to (n,).
        end: Processor time at which it ends [s].
    """
    dynamics, done, length = ForwardDynamics(scene.core), 0, 1
    before, after = (0.0, 0.0) if left is None else (left, 1.0 - left)

    def after_kick(x: Floats, part: float) -> Floats:
        return x if dw is None or not part else kicked(scene, x, u[done], part * dw[done], origin)

    def force(x: Floats) -> Floats:
        of_noise = impulse(scene, x, u[done], dw[done], origin) / dt if left is None and dw is not None else 0.0
        return scene.actuation @ u[done] + of_noise

    yield x[None]
    while done < len(u):
        same = (u[done : done + length] == u[done]).all(axis=1)
        ahead = 1 if dw is not None else len(same) if same.all() else int(same.argmin())
        try:
            states = integrated(dynamics, force(x), after_kick(x, before), dt, ahead, end)
        except EndsHereError:
            return
        states[-1] = after_kick(states[-1], after)
        yield states
        x, done, length = states[-1], done + ahead, min(2 * length, _CHUNK)


def _predictable(plain: Iterator[Floats], disturbed: Iterator[Floats], by: float) -> tuple[Floats, int]:
    """States (K + 1, 2n) of a motion, and after how many steps a disturbance of q has grown out of hand, K if never."""
    rows: list[list[Floats]] = [[], []]
    states, known = np.zeros((0, 0)), 0
    for parts in zip(plain, disturbed, strict=False):
        for row, part in zip(rows, parts, strict=True):
            row.append(part)
        states, other = (np.concatenate(row) for row in rows)
        n = states.shape[1] // 2
        known = grown(states[:, :n], other[:, :n], by) if len(states) > 1 else 0
        if known < len(states) - 1:
            break
    return states, known


def before_step(integrator: Integrator) -> float | None:
    """The part of the noise's kicks that comes before an integrator's steps; None where it is held over them."""
    if integrator.holds_noise:
        return None
    # Explicit Euler's kicks come after the step.
    return 0.0 if isinstance(integrator, ExplicitEuler) else integrator.left


# --- from the start ------------------------------------------------------------------------------------------------


def exact_motion(setup: Setup, dt: float, steps: int, window: float, *, left: float | None = 1.0) -> Exact:
    """The exact motion over a window, as far as a small disturbance does not grow out of hand.

    In closed form where there is one. ``left`` is that of :func:`motion_of`: to strong order one, which is what is
    promised of additive noise, all are the same motion.

    Raises:
        VarpinError: It cannot be integrated over a single step.
    """
    steps = min(steps, max(1, round(window / dt)))
    varying = (setup.controls is not None and setup.controls.ndim == 2) or setup.increments is not None
    stride = 1 if varying else max(1, steps // NODES)
    if varying:
        steps = min(steps, 2 * NODES)
    nodes = np.union1d(np.arange(1, min(steps, START) + 1), np.arange(stride, steps + 1, stride))
    if setup.exact is not None:
        q, v = (np.array(part) for part in zip(*(setup.exact(k * dt) for k in nodes), strict=True))
        known = steps
    else:
        states, known = _reference(setup, dt, int(nodes[-1]), left)
        if not known:
            raise VarpinError("there is no exact motion of a single step")
        q, v = np.split(states[nodes[nodes < len(states)]], 2, axis=1)
        q = q + setup.shift
    # At the last of the known steps the disturbance has grown already, if they are not all.
    count = int((nodes <= (known if known >= nodes[-1] else max(1, known - 1))).sum())
    return in_units(setup.scene, setup.q0, setup.v0, dt, nodes[:count], q[:count], v[:count], cut=count < len(nodes))


def _reference(setup: Setup, dt: float, steps: int, left: float | None) -> tuple[Floats, int]:
    scene = setup.scene if setup.twin is None else setup.twin
    origin, end = setup.q0 - setup.shift, time.process_time() + PATIENCE
    controls = np.zeros(scene.controls) if setup.controls is None else setup.controls
    u = np.broadcast_to(controls, (steps, scene.controls)) if controls.ndim == 1 else controls[:steps]

    def path(by: float) -> Iterator[Floats]:
        x = np.append(origin + by, setup.v0)
        return motion_of(scene, x, u, dt, dw=setup.increments, left=left, origin=setup.q0, end=end)

    return _predictable(path(0.0), path(DISTURBANCE), DISTURBANCE)


# --- from nodes all over the motion --------------------------------------------------------------------------------


def period_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> float:
    """The largest error from any of some nodes on, in units of what is wrong; NaN where none is known.

    Errors are shares of the joint's travel and largest speed over the whole motion, as far as a small disturbance does
    not grow out of hand.
    """
    if not trajectory.steps or scene.noise.diffusion is None or not np.abs(trajectory.v).max() > 0.0:
        return math.nan
    whole = np.arange(trajectory.steps + 1)
    units = in_units(
        scene, trajectory.q[0], trajectory.v[0], trajectory.dt, whole, trajectory.q, trajectory.v, cut=False
    )
    worst, end = math.nan, time.process_time() + _PATIENCE_PERIODS
    for step in np.unique(np.linspace(0, max(0, trajectory.steps - _STEPS), _BEGINS).astype(np.int64)).tolist():
        worst = np.fmax(worst, _error_from(scene, integrator, trajectory, step, units))
        if worst >= 1.0 or time.process_time() > end:
            break
    return float(worst)


def _error_from(scene: Scene, integrator: Integrator, trajectory: Trajectory, step: int, units: Exact) -> float:
    """The error from one node on; NaN where the exact motion ends before."""
    n, ahead = scene.robot.dof, slice(step, step + min(_STEPS, trajectory.steps - step))
    end = time.process_time() + _PATIENCE_PERIOD

    def path(by: float) -> Iterator[Floats]:
        x = np.concatenate([trajectory.q[step] + by, trajectory.v[step]])
        dw = trajectory.dw[ahead] if trajectory.dw.any() else None
        u, dt, left = trajectory.u[ahead], trajectory.dt, before_step(integrator)
        return motion_of(scene, x, u, dt, dw=dw, left=left, origin=trajectory.q[0], end=end)

    by = DISTURBANCE * max(1e-3, float(np.ptp(trajectory.q, axis=0).max()))
    plain, known = _predictable(path(0.0), path(by), by)
    if known == len(plain) - 1 < ahead.stop - step:
        return math.nan
    nodes, plain = slice(step, step + known + 1), plain[: known + 1]
    with np.errstate(over="ignore", invalid="ignore"):
        q = np.abs(plain[:, :n] - trajectory.q[nodes]) / units.travels / LEVELS["error"]
        v = np.abs(plain[:, n:] - trajectory.v[nodes]) / units.speeds / LEVELS["velocity"]
    return float(max(q.max(), v.max()))
