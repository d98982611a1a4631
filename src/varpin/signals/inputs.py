"""Controls of kinematic inputs: for divided steps, and as they are recorded."""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.mechanics.scene import Scene


def in_parts_of_steps(scene: Scene, u: Floats, q: Floats, v: Floats, dt: float, parts: int) -> Floats:
    """Controls (N * parts, m) of steps divided into ``parts`` equal parts, for the same prescribed motion.

    Forces stay constant; positions and velocities of kinematic inputs follow the lines and cubics of their steps.

    Args:
        scene: The scene.
        u: Controls of the whole steps (N, m).
        q: Configurations at the start of the steps (N, n) [rad or m].
        v: Velocities there (N, n) [rad/s or m/s], for cubics.
        dt: Length of a whole step [s].
        parts: Number of parts.
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
