"""Dry friction that is faster than the step: where joints come to rest or turn back, and its rate there.

Friction -g(v) tanh(v / width) is steep only near v = 0. Nodes of a motion rarely lie there even if joints come to rest,
so its derivatives at nodes do not show the rate.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.core import fastest_damping
from varpin.mechanics.forces import dissipates, of_kind
from varpin.mechanics.scene import Scene

# Most steps in which friction is examined: of each joint, and in all.
_OF_A_JOINT, _MOST = 2, 6
# Rates below count as zero [1/s].
_SLOWEST = 1e-6


class Stop(NamedTuple):
    """A step in which a joint with dry friction comes to rest or turns back.

    Attributes:
        step: Its index.
        joint: The coordinate.
        width: The width of the joint's friction [rad/s or m/s].
    """

    step: int
    joint: int
    width: float


def stops(scene: Scene, velocities: Floats) -> list[Stop]:
    """Some of the steps in which joints with dry friction come to rest or turn back, the first and last of each.

    ``velocities`` are those of the nodes (N + 1, n).
    """
    found = []
    for element in of_kind(scene.elements, "CoulombFriction"):
        c, width = element.coordinate, element.values[1]
        v = velocities[:, c]
        before, after = v[:-1], v[1:]
        # The velocity changes its sign, or another step like this one would take it there.
        slows = (before * after <= 0.0) | ((np.abs(after) <= np.abs(after - before)) & (np.abs(after) < np.abs(before)))
        at = np.flatnonzero(slows & (np.abs(before) > width))
        chosen = at[np.unique(np.linspace(0, len(at) - 1, _OF_A_JOINT).astype(np.int64))] if len(at) else at
        found += [Stop(step, c, width) for step in chosen.tolist()]
    # The narrowest first: there friction is steepest.
    return sorted(found, key=lambda stop: (stop.width, stop.step))[:_MOST]


def rate_at_stops(scene: Scene, q: Floats, v: Floats, u: Floats, at: list[Stop], least: float) -> float:
    """The fastest rate of damping [1/s] where joints come to rest, or 0 where none is faster than ``least``.

    q and v (N + 1, n) are those of the nodes, u (N, m) of the steps.
    """
    if not at:
        return 0.0
    steps = [stop.step for stop in at]
    v = v[steps]
    v[np.arange(len(at)), [stop.joint for stop in at]] = 0.0
    force = np.ascontiguousarray(u[steps] @ scene.actuation.T)
    return float(fastest_damping(scene.core, q[steps], v, force, least))


def rate_at_rest(scene: Scene, q: Floats) -> float:
    """The fastest rate of damping [1/s] at a configuration (n,) with all joints at rest, where friction is steepest."""
    if not any(map(dissipates, scene.elements)) and not any(map(dissipates, scene.couplings)):
        return 0.0
    still = np.zeros((1, q.size))
    return float(fastest_damping(scene.core, np.ascontiguousarray(q[None]), still, still, _SLOWEST))
