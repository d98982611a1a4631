"""A motion held against exact ones that begin at its own nodes: how far it is off after a period, from all over it.

Where one looks and what is wrong are :mod:`varpin.simulation.accuracy`'s, as for the warnings. The exact motion is
LSODA's at 1e-11: it takes stiff dampers, and shares nothing with the integrator.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator

import numpy as np
import scipy
from numpy.typing import NDArray

from varpin.core import ForwardDynamics
from varpin.integrators import ExplicitEuler, Integrator
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import CLOSE, Place, between, disturbance, grown, inertias, masses, places
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

_TOLERANCE = 1e-11
# Speeds below this count as it [rad/s or m/s]; ways shorter than this are the tolerance's [rad or m].
_SLOWEST, _SHORTEST = 1e-3, 1e-8
# Steps integrated between two looks whether the motion can still be told.
_CHUNK = 32
# Processor time for the exact motions from all nodes, and from one [s].
_PATIENCE, _PATIENCE_EACH = 4.0, 1.0


class _EndsHereError(ArithmeticError):
    """The exact motion goes no further, or takes too long."""


def period_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> float:
    """The largest error over a period from any of some nodes, in units of what is wrong; NaN where none can be told.

    From the nodes that :func:`varpin.simulation.accuracy.places` names, and some that it does not; many more where that
    comes close to what is wrong. What is wrong from one of them on is wrong.
    """
    if not trajectory.steps or scene.noise.diffusion is None or not np.abs(trajectory.v).max() > 0.0:
        return math.nan
    own = np.linspace(0, trajectory.steps, 5)[1:-1].astype(np.int64)
    first = places(scene, trajectory)
    inertia = inertias(scene, trajectory.q[first])
    first = np.concatenate([first, np.setdiff1d(own, first)])
    worst, end = math.nan, time.process_time() + _PATIENCE
    for steps in (first, between(trajectory.steps, first)):
        for step in steps.tolist():
            worst = np.fmax(worst, _error_from(scene, integrator, trajectory, step, inertia))
            if worst >= 1.0 or time.process_time() > end:
                return float(worst)
        if not worst >= CLOSE:
            break
    return float(worst)


def _error_from(scene: Scene, integrator: Integrator, trajectory: Trajectory, step: int, inertia: Floats) -> float:
    """The error over a period from one node, as far as a small disturbance does not grow out of hand.

    NaN where the exact motion ends before: of a part of a start, even half a step is much; and where nothing moves
    to speak of.
    """
    n, place = scene.robot.dof, Place.at(scene, trajectory, step)
    count = int(place.judged.max())
    moved = disturbance(trajectory, step, count)
    end = time.process_time() + _PATIENCE_EACH
    rows: list[list[Floats]] = [[], []]
    paths = [_path(scene, integrator, trajectory, step, count, by, end) for by in ((0.0, 0.0), moved)]
    known = told = 0
    for parts in zip(*paths, strict=False):
        for row, part in zip(rows, parts, strict=True):
            row.append(part)
        plain, other = (np.concatenate(row) for row in rows)
        told, known = len(plain) - 1, grown(plain[:, :n], other[:, :n], moved[0])
        if known < told:
            break
    if known == told < count:
        return math.nan
    nodes = slice(step, step + known + 1)
    if max(np.ptp(q[: known + 1], axis=0).max() for q in (plain[:, :n], trajectory.q[nodes])) < _SHORTEST:
        return math.nan
    with np.errstate(over="ignore", invalid="ignore"):
        off = (
            np.abs(plain[: known + 1, :n] - trajectory.q[nodes]),
            np.abs(plain[: known + 1, n:] - trajectory.v[nodes]),
        )
    return place.error(scene, trajectory, inertia, off, cut=known < count).worst


def _path(
    scene: Scene,
    integrator: Integrator,
    trajectory: Trajectory,
    step: int,
    count: int,
    moved: tuple[float, float],
    end: float,
) -> Iterator[Floats]:
    """States (K, 2n) of the exact motion from a node on, the node itself first, then step by step or many at once.

    It ends where it cannot be integrated, or at this processor time [s].
    """
    dt = trajectory.dt
    dynamics = ForwardDynamics(scene.core)
    # Explicit Euler's kicks come after the step.
    left = 0.0 if isinstance(integrator, ExplicitEuler) else integrator.left
    x = np.concatenate([trajectory.q[step] + moved[0], trajectory.v[step] + moved[1]])
    noisy = bool(trajectory.dw.any())
    held = trajectory.u[step : step + count]
    done, length = 0, 1

    def kicked(x: Floats, part: float) -> Floats:
        if not (noisy and part):
            return x
        q, v = np.split(x, 2)
        field = scene.noise.fields(q[None], v[None], held[done : done + 1], trajectory.q[0]).F[0]
        return np.append(q, v + part * np.linalg.solve(masses(scene, q[None])[0], field @ trajectory.dw[step + done]))

    yield x[None]
    while done < count:
        same = (held[done : done + length] == held[done]).all(axis=1)
        ahead = 1 if noisy else len(same) if same.all() else int(same.argmin())
        try:
            states = _integrated(dynamics, scene.actuation @ held[done], kicked(x, left), dt, ahead, end)
        except _EndsHereError:
            return
        states[-1] = kicked(states[-1], 1.0 - left)
        yield states
        x, done, length = states[-1], done + ahead, min(2 * length, _CHUNK)


def _integrated(dynamics: ForwardDynamics, force: Floats, x: Floats, dt: float, steps: int, end: float) -> Floats:
    """(q, v) after each of some steps (K, 2n) under one force."""

    def rate(_: float, x: Floats) -> Floats:
        slope, regular = dynamics.rate(x, force)
        if not (regular and np.isfinite(slope).all()) or time.process_time() > end:
            raise _EndsHereError
        return slope

    n = len(force)
    speed = max(float(np.abs(x[n:]).max() + dt * np.abs(rate(0.0, x)[n:]).max()), _SLOWEST)
    atol = _TOLERANCE * np.append(np.ones(n), np.full(n, speed))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.integrate.ODEintWarning)
        states, told = scipy.integrate.odeint(
            rate, x, dt * np.arange(steps + 1), rtol=_TOLERANCE, atol=atol, tfirst=True, mxstep=10**6, full_output=True
        )
    if told["message"] != "Integration successful.":
        raise _EndsHereError
    return np.asarray(states[1:])
