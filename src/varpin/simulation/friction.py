"""Dry friction that is faster than the step: where joints come to rest or turn back, and its rate there.

Friction -g(v) tanh(v / width) is steep only near v = 0. Nodes of a motion rarely lie there even if joints come to rest,
so its derivatives at nodes do not show the rate.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg

from varpin.arrays import Floats, Integers
from varpin.core import fastest_damping
from varpin.mechanics.forces import dissipates, limited_servos, of_kind
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import masses

# Most steps in which friction is examined: of each joint, and in all.
_OF_A_JOINT, _MOST = 2, 6
# Rates below this share of the fastest count as none.
_UNDAMPED = 1e-9
# Rates below count as zero [1/s].
_SLOWEST = 1e-6


class Stop(NamedTuple):
    """A step in which a joint with dry friction comes to rest or turns back.

    Attributes:
        step: Its index.
        joint: The coordinate.
        width: The width of the joint's friction [rad/s or m/s].
        slope: The slope of the friction at rest [N m s/rad or N s/m].
    """

    step: int
    joint: int
    width: float
    slope: float


def stops(scene: Scene, velocities: Floats) -> list[Stop]:
    """Some of the steps in which joints with dry friction come to rest or turn back, the first and last of each.

    ``velocities`` are those of the nodes (N + 1, n).
    """
    found = []
    for element in of_kind(scene.elements, "CoulombFriction"):
        c, (_, width, breakaway, _) = element.coordinate, element.values
        v = velocities[:, c]
        before, after = v[:-1], v[1:]
        # The velocity changes its sign, or another step like this one would take it there.
        slows = (before * after <= 0.0) | ((np.abs(after) <= np.abs(after - before)) & (np.abs(after) < np.abs(before)))
        at = np.flatnonzero(slows & (np.abs(before) > width))
        chosen = at[np.unique(np.linspace(0, len(at) - 1, _OF_A_JOINT).astype(np.int64))] if len(at) else at
        found += [Stop(step, c, width, breakaway / width) for step in chosen.tolist()]
    # The narrowest first: there friction is steepest.
    return sorted(found, key=lambda stop: (stop.width, stop.step))[:_MOST]


def rate_at_stops(scene: Scene, q: Floats, v: Floats, u: Floats, at: list[Stop], least: float) -> float:
    """The fastest rate of damping [1/s] where joints come to rest, or 0 where none is faster than ``least``.

    q and v (N + 1, n) are those of the nodes, u (N, m) of the steps.
    """
    return float(fastest_damping(scene.core, *states_at_stops(scene, q, v, u, at), least)) if at else 0.0


def states_at_stops(scene: Scene, q: Floats, v: Floats, u: Floats, at: list[Stop]) -> tuple[Floats, Floats, Floats]:
    """States q, v (K, n) where joints come to rest, the joint's velocity zero in each, and the controls' forces."""
    steps = [stop.step for stop in at]
    v = v[steps]
    v[np.arange(len(at)), [stop.joint for stop in at]] = 0.0
    return q[steps], v, np.ascontiguousarray(u[steps] @ scene.actuation.T)


def rate_at_rest(scene: Scene, q: Floats) -> float:
    """The fastest rate of damping [1/s] at a configuration (n,) with all joints at rest, where friction is steepest.

    Servos are told to stay there: a drive at its limit would damp nothing.
    """
    if not any(map(dissipates, scene.elements)) and not any(map(dissipates, scene.couplings)):
        return 0.0
    still, force = np.zeros((1, q.size)), np.zeros((1, q.size))
    for servo in limited_servos(scene.elements):
        force[0, servo.coordinate] = servo.values[0] * q[servo.coordinate]
    return float(fastest_damping(scene.core, np.ascontiguousarray(q[None]), still, force, _SLOWEST))


def damping_matrices(scene: Scene, q: Floats, v: Floats, forces: Floats) -> Floats:
    """D (K, n, n) of M w' = -D w, of what acts at joints and between links, without custom forces.

    At states q, v (K, n) under constant forces (K, n); symmetric.
    """
    q, v = np.ascontiguousarray(q), np.ascontiguousarray(v)
    dampers = -np.minimum(scene.core.forces(q, v, np.ascontiguousarray(forces))[2], 0.0)
    D: Floats = dampers[:, :, None] * np.eye(q.shape[1])
    if scene.couplings:
        slopes = scene.core.coupled_forces(q, v)[2]
        D -= 0.5 * (slopes + np.swapaxes(slopes, 1, 2))
    return D


class JointRates(NamedTuple):
    """Rates of damping at K states [1/s].

    Attributes:
        own: The rate of the mode that is damped by a joint more than any other mode is (K, n).
        fastest: That of the fastest mode (K,).
        leading: The joint that damps the fastest mode most (K,).
    """

    own: Floats
    fastest: Floats
    leading: Integers


def joint_rates(scene: Scene, q: Floats, v: Floats, forces: Floats) -> JointRates:
    """Rates at which joints are damped by what acts at them, all at states q, v (K, n) under constant forces (K, n).

    The modes of M w' = -D w, D the damping, are orthogonal in M and in D. What a mode loses is the sum of what it
    loses at each joint.
    """
    D = damping_matrices(scene, q, v, forces)
    own, fastest, leading = np.zeros(q.shape), np.zeros(len(q)), np.zeros(len(q), dtype=np.int64)
    for k, M in enumerate(masses(scene, q)):
        rates, modes = scipy.linalg.eigh(D[k], M)
        lost = modes * (D[k] @ modes)
        # Modes that are not damped lose nothing but rounding.
        damped = rates > _UNDAMPED * rates[-1]
        share = np.where(damped, lost, 0.0) / np.where(damped, rates, 1.0)
        own[k], fastest[k], leading[k] = rates[share.argmax(axis=1)], rates[-1], share[:, -1].argmax()
    return JointRates(own, fastest, leading)
