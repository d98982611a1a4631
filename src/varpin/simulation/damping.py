"""Damping that is faster than the step, and modes that turn by too much in one, anywhere along a motion.

Rates change with the inertia, with the lever arms of dampers between frames, with the velocity where there is dry
friction, and with every stop that a joint runs into. They are evaluated at a few nodes all over the motion, where
joints with dry friction are slowest or come to rest within a step, and in the stops that joints reach, or would reach
within a step.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.core import fastest_damping, pulls_fast
from varpin.mechanics.forces import of_kind
from varpin.mechanics.scene import Scene
from varpin.simulation.friction import JointRates, Stop, joint_rates, rate_at_stops, states_at_stops, stops

# Largest rate times the step that a step resolves.
_RESOLVED = 2.0
# Nodes spread over the motion: one of this many, and the least and the largest number.
_OF, _LEAST, _MOST = 16, 4, 12
# Most joints with dry friction, and most stops, with nodes of their own.
_SLOW, _REACHED = 6, 6


class Fast(NamedTuple):
    """Damping that is faster than a step can resolve.

    Attributes:
        rate: The fastest rate [1/s]; 0 for none.
        stop: Where a joint comes to rest, if the rate is that of its dry friction; else None.
        joint: The coordinate whose damping it is, where that was looked for.
    """

    rate: float
    stop: Stop | None = None
    joint: int | None = None


def fast_damping(scene: Scene, q: Floats, v: Floats, u: Floats, dt: float) -> Fast:
    """The fastest damping along a motion, if steps of ``dt`` [s] cannot resolve it.

    q and v (N + 1, n) are those of the nodes, u (N, m) of the steps.
    """
    if not scene.dissipates or not len(u):
        return Fast(0.0)
    least = _RESOLVED / dt
    at, slowest = _spread(len(v) - 1), _slowest(scene, v)
    if len(slowest):
        at = np.union1d(at, slowest)
    fastest = Fast(fastest_damping(scene.core, q[at], v[at], _forces(scene, u, at), least))
    nodes, reached = _in_stops(scene, q, v, dt)
    if len(nodes):
        rate = fastest_damping(scene.core, reached, v[nodes], _forces(scene, u, nodes), max(least, fastest.rate))
        fastest = Fast(max(rate, fastest.rate))
    for stop in stops(scene, v):
        if rate := rate_at_stops(scene, q, v, u, [stop], max(least, fastest.rate)):
            fastest = Fast(rate, stop)
    return fastest


def damping_of(scene: Scene, q: Floats, v: Floats, u: Floats, dt: float, joint: int | None = None) -> Fast:
    """The fastest damping along a motion of one joint, with its own rate; where :func:`fast_damping` looks for it.

    The joint is ``joint``, if steps of ``dt`` [s] cannot resolve its damping; else the one with the fastest.
    """
    at = np.union1d(_spread(len(v) - 1), _slowest(scene, v))
    nodes, reached = _in_stops(scene, q, v, dt)
    resting = stops(scene, v)
    parts = [(q[at], v[at], _forces(scene, u, at)), (reached, v[nodes], _forces(scene, u, nodes))]
    if resting:
        parts.append(states_at_stops(scene, q, v, u, resting))
    marks = [None] * (len(at) + len(nodes)) + resting
    return _named(joint_rates(scene, *(np.concatenate(part) for part in zip(*parts, strict=True))), marks, dt, joint)


def damping_at_stop(scene: Scene, q: Floats, v: Floats, u: Floats, dt: float, stop: Stop) -> Fast:
    """The damping where a joint comes to rest: its own, if steps of ``dt`` [s] cannot resolve it, else the fastest."""
    return _named(joint_rates(scene, *states_at_stops(scene, q, v, u, [stop])), [stop], dt, stop.joint)


def _named(rates: JointRates, stops: list[Stop | None], dt: float, joint: int | None) -> Fast:
    """Of rates at some states, with their stops, the fastest of a joint, or of all if the joint's are slow."""
    if joint is not None and dt * float(rates.own[:, joint].max()) > _RESOLVED:
        state = int(rates.own[:, joint].argmax())
        rate = float(rates.own[state, joint])
    else:
        state = int(rates.fastest.argmax())
        rate, joint = float(rates.fastest[state]), int(rates.leading[state])
    stop = stops[state]
    return Fast(rate, stop if stop is not None and stop.joint == joint else None, joint)


def turns_fast(scene: Scene, q: Floats, v: Floats, u: Floats, h: float) -> bool:
    """Whether stops and springs between frames turn a mode by more than a radian over h [s] along a motion.

    Rates of all other springs are those at the start, except for changes of the inertia.
    """
    if not len(u):
        return False
    nodes, reached = _in_stops(scene, q, v, h)
    if len(nodes) and pulls_fast(scene.core, reached, v[nodes], _forces(scene, u, nodes), h):
        return True
    if not scene.couplings:
        return False
    at = _spread(len(v) - 1)
    return bool(pulls_fast(scene.core, q[at], v[at], _forces(scene, u, at), h))


def stops_ahead(scene: Scene, q: Floats) -> Floats:
    """Configurations (K, n): ``q`` (n,) with one joint each in a stop, deep enough for the stop's full stiffness."""
    rows = []
    for own in of_kind(scene.elements, "JointStop"):
        lower, upper, *_, width = own.values
        for end in (lower - width, upper + width):
            if np.isfinite(end):
                rows.append(q.copy())
                rows[-1][own.coordinate] = end
    return np.array(rows).reshape(-1, q.size)


@functools.lru_cache(maxsize=64)
def _spread(steps: int) -> Integers:
    """Nodes spread over a motion, with its ends; read-only."""
    count = min(max(steps // _OF, _LEAST), _MOST, steps + 1)
    nodes: Integers = np.linspace(0, steps, count).astype(np.int64)
    nodes.setflags(write=False)
    return nodes


def _slowest(scene: Scene, v: Floats) -> Integers:
    """Nodes at which joints with dry friction are slowest: there it is steepest."""
    joints = [own.coordinate for own in of_kind(scene.elements, "CoulombFriction")][:_SLOW]
    slowest: Integers = np.abs(v[:, joints]).argmin(axis=0).astype(np.int64)
    return slowest


def _in_stops(scene: Scene, q: Floats, v: Floats, h: float) -> tuple[Integers, Floats]:
    """Nodes at which joints are deepest in their stops, or reach them within h [s]; q (K, n) with that joint in it."""
    found = []
    for own in of_kind(scene.elements, "JointStop"):
        c, (lower, upper, *_, width) = own.coordinate, own.values
        for end, side in ((lower, -1.0), (upper, 1.0)):
            # A joint may enter and leave its stop between two nodes.
            depth = side * (q[:, c] - end)
            reach = depth + np.abs(v[:, c]) * h
            node = int(reach.argmax())
            if reach[node] > 0.0:
                found.append((float(reach[node]), node, c, end + side * max(depth[node], min(width, reach[node]))))
    found = sorted(found, key=lambda own: -own[0])[:_REACHED]
    nodes = np.array([node for _, node, _, _ in found], dtype=np.int64)
    reached = q[nodes]
    for row, (_, _, c, place) in zip(reached, found, strict=True):
        row[c] = place
    return nodes, reached


def _forces(scene: Scene, u: Floats, at: Integers) -> Floats:
    """Constant forces (K, n) of the controls in the steps that begin at some nodes."""
    return np.ascontiguousarray(u[np.minimum(at, len(u) - 1)] @ scene.actuation.T)
