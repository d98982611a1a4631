"""Controls over time as commands of the core: held, linear between nodes, fed back, or changing within steps.

Within a step that changes, the control is the polynomial of degree s - 1 through the s stages, which keeps the order of
the method in whole and in divided steps: it differs from the control only by terms that the method's quadrature does
not resolve.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.mechanics.scene import Scene

Times = tuple[float, ...]


def open_loop(u: Floats) -> Commands:
    """Controls (N, m) without feedback."""
    return Commands(np.ascontiguousarray(u), *_without_feedback(u.shape[1]))


def open_line(u: Floats, times: Sequence[float]) -> Commands:
    """Controls (N + 1, m) at nodes without feedback, linear between them, for a method with stages at ``times``."""
    return open_loop(u[1:])._replace(before=u[:1].copy(), stage_times=np.array(tuple(times) or (0.5,)))


@functools.cache
def _without_feedback(controls: int) -> tuple[Floats, Floats, int, Floats, Floats]:
    """Gains, reference, hold, limits and control before the first of :func:`open_loop`, read-only."""
    gains, reference, before = np.zeros((0, controls, 0)), np.zeros((0, 0)), np.zeros((0, controls))
    for array in (gains, reference, before):
        array.setflags(write=False)
    return gains, reference, 1, no_limits(controls), before


@functools.cache
def no_limits(controls: int) -> Floats:
    """Infinite limits (2, m) for controls without limits, read-only."""
    limits = np.outer([-np.inf, np.inf], np.ones(controls))
    limits.setflags(write=False)
    return limits


class Lines(NamedTuple):
    """Controls of N steps that are linear between nodes."""

    mean: Floats  # over each step (N, m)
    stages: Floats  # at the stages of each step (N, s, m), (N, 0, m) for methods that hold the mean
    nodes: Floats  # (N + 1, m)


def lines(commands: Commands, ends: Floats, times: Sequence[float]) -> Lines:
    """The controls within each step of ``commands`` that are linear between nodes.

    ``ends`` (N, m) are the recorded controls at the end of each step's decision, ``times`` those of
    the method's stages.
    """
    steps = np.arange(len(ends))
    begins = np.vstack([commands.before[:1], ends])[steps - steps % commands.hold]
    mean, after = on_lines(begins, ends, commands.hold, (0.5, 1.0)).swapaxes(0, 1)
    return Lines(mean.copy(), on_lines(begins, ends, commands.hold, times), np.vstack([commands.before[:1], after]))


def on_lines(begins: Floats, ends: Floats, hold: int, times: Sequence[float]) -> Floats:
    """Controls (N, s, m) at ``times`` (s,) in N steps of unit length, every ``hold`` of which are on one line.

    ``begins`` and ``ends`` (N, m) are those of each step's line.
    """
    share = ((np.arange(len(ends)) % hold)[:, None] + np.array(times))[:, :, None] / hold
    found: Floats = (1.0 - share) * begins[:, None] + share * ends[:, None]
    return found


def control_of(commands: Commands, decision: int, x: Floats, before: Floats) -> Floats:
    """The control (m,) of a decision at a state x (2n,), by the formula of the core.

    ``before`` is the previous control (1, m), or (0, m) for that of the reference.
    """
    u = commands.u[decision]
    if len(commands.gains):
        gains, change = commands.gains[decision], x - commands.reference[decision, : x.size]
        u = u + gains[:, : x.size] @ change
        if len(before) and gains.shape[1] > x.size:
            u = u + gains[:, x.size :] @ (before[0] - commands.reference[decision, x.size :])
    limited: Floats = np.clip(u, *commands.limits)
    return limited


def contiguous(commands: Commands) -> Commands:
    """Commands with C-contiguous arrays, as the core requires."""
    return commands._replace(
        u=np.ascontiguousarray(commands.u),
        gains=np.ascontiguousarray(commands.gains),
        reference=np.ascontiguousarray(commands.reference),
        limits=np.ascontiguousarray(commands.limits),
        within=np.ascontiguousarray(commands.within),
    )


def steps_of(commands: Commands) -> int:
    """Number of steps of the commands, for each path."""
    return (commands.own or len(commands.u)) * commands.hold


def rows(commands: Commands, begin: int, end: int, before: Floats | None = None) -> Commands:
    """The commands of decisions begin, ..., end - 1; ``before`` (P, m) replaces the previous control of each path."""
    if begin == 0 and end >= len(commands.u) and before is None:
        return commands
    part = slice(begin, end)
    return commands._replace(
        u=commands.u[part],
        gains=commands.gains[part],
        reference=commands.reference[part],
        before=commands.before if before is None else before.copy(),
        within=commands.within[begin * commands.hold : end * commands.hold],
    )


def interpolation(nodes: Floats, at: Floats) -> Floats:
    """Values at ``at`` (r,) of the Lagrange polynomials on ``nodes`` (s,): (r, s)."""
    values = np.ones((at.size, nodes.size))
    for j in range(nodes.size):
        for k in range(nodes.size):
            if k != j:
                values[:, j] *= (at - nodes[k]) / (nodes[j] - nodes[k])
    return values


def cubics(places: Floats, dt: float) -> Floats:
    """Coefficients (s, 8) of (q0, v0, q1, v1) for q, then for v, at ``places`` (s,) on the cubic through a step."""
    rows = []
    for s in places:
        position = [(1 + 2 * s) * (1 - s) ** 2, dt * s * (1 - s) ** 2, s**2 * (3 - 2 * s), dt * s**2 * (s - 1)]
        slope = 6 * s * (1 - s) / dt
        rows.append([*position, -slope, (1 - s) * (1 - 3 * s), slope, s * (3 * s - 2)])
    return np.array(rows)


@functools.cache
def shares(times: Times) -> Floats:
    """The weight of each stage (s,) in the mean over the step; read-only."""
    x, weights = np.polynomial.legendre.leggauss(max(1, -(-len(times) // 2)))
    shares: Floats = 0.5 * weights @ interpolation(np.array(times), 0.5 * (1.0 + x))
    shares.setflags(write=False)
    return shares


def changing(values: Floats, times: Times) -> Commands:
    """Commands of controls (N, s, m) at the stages of N steps, at ``times`` (s,) in units of a step."""
    values = np.ascontiguousarray(values)
    return open_loop(shares(times) @ values)._replace(within=values)


def in_parts(values: Floats, times: Times, parts: int, at: Times) -> Floats:
    """Controls (N parts, r, m) at times ``at`` (r,) of each of ``parts`` equal parts of N steps.

    ``values`` (N, s, m) are the controls at ``times`` of the whole steps.
    """
    N, _, m = values.shape
    points = (np.arange(parts)[:, None] + np.array(at)).ravel() / parts
    found: Floats = interpolation(np.array(times), points) @ values
    return found.reshape(N * parts, len(at), m)


def in_parts_of_steps(scene: Scene, u: Floats, q: Floats, v: Floats, dt: float, parts: int) -> Floats:
    """Controls (N * parts, m) of steps divided into ``parts`` equal parts, for the same prescribed motion.

    Forces u (N, m) stay constant; positions and velocities of kinematic inputs follow the lines and cubics of their
    steps of ``dt`` [s], from q and v (N, n) at their starts.
    """
    fine = np.repeat(u, parts, axis=0)
    share = np.arange(1, parts + 1) / parts
    for c, rate in zip(scene.inputs.values(), scene.rates, strict=True):
        own = int(np.argmax(scene.actuation[c]))
        begin, end = q[:, c, None], u[:, own, None]
        if rate < 0:
            fine[:, own] = (begin + share * (end - begin)).ravel()
        else:
            way, before, after = end - begin, dt * v[:, c, None], dt * u[:, rate, None]
            square, cube = 3.0 * way - 2.0 * before - after, before + after - 2.0 * way
            fine[:, own] = (begin + share * (before + share * (square + share * cube))).ravel()
            fine[:, rate] = ((before + share * (2.0 * square + share * 3.0 * cube)) / dt).ravel()
        # No rounding error at the end of the whole steps.
        fine[parts - 1 :: parts] = u
    return fine


def held_in_parts(scene: Scene, u: Floats, q0: Floats, v0: Floats, dt: float, parts: int) -> Floats:
    """:func:`in_parts_of_steps` for consecutive steps from q0 and v0 (n,) on."""
    q, v = np.tile(q0, (len(u), 1)), np.tile(v0, (len(u), 1))
    for c, rate in zip(scene.inputs.values(), scene.rates, strict=True):
        q[1:, c] = u[:-1, int(np.argmax(scene.actuation[c]))]
        if rate >= 0:
            v[1:, c] = u[:-1, rate]
    return in_parts_of_steps(scene, u, q, v, dt, parts)


def prescribing(scene: Scene, commands: Commands, ends: Floats) -> Commands:
    """Commands that bring the scene's kinematic inputs to the controls ``ends`` (N, m) at the ends of N steps.

    All other controls stay as they are. Inputs have the same control at all stages of a step.
    """
    within = with_ends(scene, commands.within, ends) if len(commands.within) else commands.within
    return commands._replace(u=with_ends(scene, commands.u, ends), within=within)


def with_ends(scene: Scene, values: Floats, ends: Floats) -> Floats:
    """Controls (N, ..., m) within N steps with those of kinematic inputs replaced by the ones at their ends (N, m)."""
    own = scene.prescribed
    if not len(own):
        return values
    values = values.copy()
    values[..., own] = ends[:, own].reshape(len(ends), *(1,) * (values.ndim - 2), len(own))
    return values


def as_moved(scene: Scene, q: Floats, v: Floats, u: Floats) -> Floats:
    """Controls u (..., m) with those of kinematic inputs replaced by where these are, q and v (..., n).

    Where a decision takes several steps, an input is on its way at the end of most of them.
    """
    u = u.copy()
    for c, rate in zip(scene.inputs.values(), scene.rates, strict=True):
        u[..., int(np.argmax(scene.actuation[c]))] = q[..., c]
        if rate >= 0:
            u[..., rate] = v[..., c]
    return u
