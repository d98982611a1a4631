"""Exact motions of trials, and errors from nodes all over a motion."""

from __future__ import annotations

import math
import time

import numpy as np
from numpy.typing import NDArray

from battery.trial import Setup
from varpin.integrators import Integrator
from varpin.mechanics.scene import Scene
from varpin.simulation.spectrum import speed_scales, travel_scales
from varpin.study import exact
from varpin.study.checks import LEVELS
from varpin.study.exact import DISTURBANCE, NODES, Exact, before_step, grown, in_units, nodes_of, path
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# Processor time, which other programs do not change [s]: for all periods, for one of them.
_PATIENCE_PERIODS, _PATIENCE_PERIOD = 4.0, 1.0
# Nodes from which the motion is repeated, and steps from each.
_BEGINS, _STEPS = 8, 64


def exact_motion(setup: Setup, dt: float, steps: int, window: float, *, left: float | None = 1.0) -> Exact | None:
    """The exact motion over a window [s], in closed form where there is one.

    ``left`` is that of :func:`varpin.study.exact.path`: to strong order one, which is what is promised of additive
    noise, all are the same motion.
    """
    steps = min(steps, max(1, round(window / dt)))
    if setup.exact is not None:
        nodes = nodes_of(steps, max(1, steps // NODES))
        q, v = (np.array(part) for part in zip(*(setup.exact(k * dt) for k in nodes), strict=True))
        return in_units(setup.scene, setup.q0, setup.v0, dt, nodes, q, v)
    scene = setup.scene if setup.twin is None else setup.twin
    controls = np.zeros(scene.controls) if setup.controls is None else setup.controls
    u = np.broadcast_to(controls, (steps, scene.controls)) if controls.ndim == 1 else controls[:steps]
    dw = np.zeros((steps, 0)) if setup.increments is None else setup.increments[:steps]
    return exact.exact_motion(scene, setup.q0, setup.v0, u, dw, dt=dt, left=left, ahead=setup.shift)


def period_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> float:
    """The largest error from any of some nodes on, in units of what is wrong; NaN where none is known.

    Errors are shares of the scales by which motions are told of, as far as a small disturbance does not grow out of
    hand, and of velocities the smaller of two successive ones, as a small shift in time changes a peak by much.
    """
    if not trajectory.steps or scene.noise.diffusion is None or not np.abs(trajectory.v).max() > 0.0:
        return math.nan
    units = travel_scales(scene, trajectory.q), speed_scales(scene, trajectory.v)
    worst, end = math.nan, time.process_time() + _PATIENCE_PERIODS
    for step in np.unique(np.linspace(0, max(0, trajectory.steps - _STEPS), _BEGINS).astype(np.int64)).tolist():
        worst = np.fmax(worst, _error_from(scene, integrator, trajectory, step, units))
        if worst >= 1.0 or time.process_time() > end:
            break
    return float(worst)


def _error_from(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, step: int, units: tuple[Floats, Floats]
) -> float:
    """The error from one node on; NaN where the exact motion ends before."""
    n, ahead = scene.robot.dof, slice(step, step + min(_STEPS, trajectory.steps - step))
    u, dw, begin = trajectory.u[ahead], trajectory.dw[ahead], (trajectory.q[step], trajectory.v[step])
    inputs = {"dt": trajectory.dt, "left": before_step(integrator), "origin": trajectory.q[0]}
    inputs["end"] = time.process_time() + _PATIENCE_PERIOD
    by = DISTURBANCE * max(1e-3, float(np.ptp(trajectory.q, axis=0).max()))
    plain, disturbed = (path(scene, np.append(begin[0] + off, begin[1]), u, dw, **inputs) for off in (0.0, by))
    known = grown(plain, disturbed, by)
    if known == min(len(plain), len(disturbed)) - 1 < len(u):
        return math.nan
    nodes, plain = slice(step, step + known + 1), plain[: known + 1]
    with np.errstate(over="ignore", invalid="ignore"):
        q = np.abs(plain[:, :n] - trajectory.q[nodes]) / units[0] / LEVELS["error"]
        v = np.abs(plain[:, n:] - trajectory.v[nodes]) / units[1] / LEVELS["velocity"]
    return float(max(q.max(), np.minimum(v[:-1], v[1:]).max()))
