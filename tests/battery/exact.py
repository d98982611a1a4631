"""Exact motions with noise, in closed form and from nodes all over a motion, beside those of varpin's own check.

The exact motion is LSODA's at 1e-11: it takes stiff dampers, and shares nothing with the integrator. Where it is
compared and from which error on a motion is wrong are :mod:`varpin.simulation.accuracy`'s, as for the warnings.
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
from varpin.simulation.accuracy import (
    CLOSE,
    DISTURBANCE,
    Window,
    disturbance,
    examined_nodes,
    grown,
    inertias,
    nodes_between,
)
from varpin.study.extremes.exact import (
    NODES,
    PATIENCE,
    START,
    EndsHereError,
    Exact,
    impulse,
    in_units,
    integrated,
    kicked,
)
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# Ways shorter than this are the tolerance's own over a period [rad or m].
_SHORTEST_PERIOD = 1e-8
# Steps integrated between two tests of whether the motion is still predictable.
_CHUNK = 32
# Processor time, which other programs do not change [s]: for all periods, for one of them.
_PATIENCE_PERIODS, _PATIENCE_PERIOD = 4.0, 1.0


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
    """The largest error over a period from any of some nodes, in units of what is wrong; NaN where none is known.

    From the nodes of :func:`varpin.simulation.accuracy.examined_nodes` and three more; from many more where the error
    comes close to what is wrong. One of them that is wrong makes the motion wrong.
    """
    if not trajectory.steps or scene.noise.diffusion is None or not np.abs(trajectory.v).max() > 0.0:
        return math.nan
    quarters = np.linspace(0, trajectory.steps, 5)[1:-1].astype(np.int64)
    first = examined_nodes(scene, trajectory)
    inertia = inertias(scene, trajectory.q[first])
    first = np.concatenate([first, np.setdiff1d(quarters, first)])
    worst, end = math.nan, time.process_time() + _PATIENCE_PERIODS
    for steps in (first, nodes_between(trajectory.steps, first)):
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
    n, node = scene.robot.dof, Window.at(scene, trajectory, step)
    count = int(node.judged.max())
    by = disturbance(trajectory, step, count)
    end = time.process_time() + _PATIENCE_PERIOD
    ahead = slice(step, step + count)

    def path(in_q: float, in_v: float) -> Iterator[Floats]:
        x = np.concatenate([trajectory.q[step] + in_q, trajectory.v[step] + in_v])
        dw = trajectory.dw[ahead] if trajectory.dw.any() else None
        u, dt, left = trajectory.u[ahead], trajectory.dt, before_step(integrator)
        return motion_of(scene, x, u, dt, dw=dw, left=left, origin=trajectory.q[0], end=end)

    plain, known = _predictable(path(0.0, 0.0), path(*by), by[0])
    if known == len(plain) - 1 < count:
        return math.nan
    nodes, plain = slice(step, step + known + 1), plain[: known + 1]
    if max(np.ptp(q, axis=0).max() for q in (plain[:, :n], trajectory.q[nodes])) < _SHORTEST_PERIOD:
        return math.nan
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(plain[:, :n] - trajectory.q[nodes]), np.abs(plain[:, n:] - trajectory.v[nodes])
    return node.error(scene, trajectory, inertia, off, cut=known < count).worst
