"""Limits of the robot's description that a motion leaves: of joints' positions and velocities, and of their motors.

No motion is stopped by them; as a motion of the robot without end stops, and with motors as strong as it takes, it may
be right.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from varpin.forces import drive_forces, of_kind
from varpin.scene import Scene
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# How the sentences begin, none of which says anything against the motion as a solution of its equations.
POSITION = "joints leave their limits"
VELOCITY = "joints pass their velocity limits"
EFFORT = "controls pass the joints' effort limits"
KINDS = (POSITION, VELOCITY, EFFORT)
# Beyond its limit by more than this a joint is spoken of: of position [rad or m], of others as a share of the limit.
_OUTSIDE, _SHARE = 1e-6, 1e-6
# How far a joint may go into a stop, in units of the width over which that becomes stiff.
_GIVES = 2.0
# So many joints are told of with numbers.
_NAMED = 6


def left(scene: Scene, trajectory: Trajectory) -> Iterator[tuple[str, str]]:
    """Which kinds of limits a motion leaves, and for each a sentence: which joints, by how much, and when."""
    robot, t = scene.robot, trajectory.t
    slides = robot.slides
    lower, upper = robot.position_limits
    # Limits that leave no room are a fault of the description, which inspect_robot tells of.
    none = ~(lower < upper)
    lower, upper = np.where(none, -np.inf, lower), np.where(none, np.inf, upper)
    for stop in of_kind(scene.elements, "JointStop"):
        # What goes on against a stop is no motion that nothing stops, as far as the stop does not give way.
        c, (first, last, *_, width) = stop.coordinate, stop.values
        lower[c] = min(lower[c], first - _GIVES * width) if first > lower[c] - width else lower[c]
        upper[c] = max(upper[c], last + _GIVES * width) if last < upper[c] + width else upper[c]
    speed, effort = robot.velocity_limit, robot.effort_limit
    force = drive_forces(scene.elements, trajectory.q[:-1], trajectory.v[:-1], trajectory.u @ scene.actuation.T)
    for kind, why, values, least, most, beyond, units in (
        (POSITION, "which nothing stops", trajectory.q, lower, upper, _OUTSIDE, ("rad", "m")),
        (VELOCITY, "which nothing holds back", trajectory.v, -speed, speed, _SHARE * speed, ("rad/s", "m/s")),
        (EFFORT, "which nothing cuts off", force, -effort, effort, _SHARE * effort, ("N m", "N")),
    ):
        with np.errstate(invalid="ignore"):
            excess = np.maximum(least - values, values - most)
            excess = np.where(excess > beyond, excess, -np.inf)
        parts = []
        worst = excess.max(axis=0, initial=-np.inf)
        joints = [int(c) for c in np.argsort(-worst, kind="stable") if worst[c] > 0.0]
        for c in joints[:_NAMED]:
            first, peak = int(np.argmax(excess[:, c] > 0.0)), int(np.argmax(excess[:, c]))
            since = "from the start" if first == 0 else f"from t = {t[first]:.4g} s"
            side, limit = ("above", most[c]) if values[peak, c] > most[c] else ("below", least[c])
            amount = f"at most {worst[c]:.3g} {units[int(slides[c])]} {side} {limit:.4g} at t = {t[peak]:.4g} s"
            parts.append(f"{robot.joint_names[c]!r} {since}, {amount}")
        if parts:
            more = f"; and {len(joints) - _NAMED} more" if len(joints) > _NAMED else ""
            yield kind, f"{kind}, {why}: {'; '.join(parts)}{more}"
