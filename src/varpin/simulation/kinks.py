"""Steps in which a force has a kink: drives that come to their limits, joints that come to stops, dry friction at rest.

Collocation of any order does not resolve a kink within a step.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers
from varpin.mechanics.forces import limited_servos, of_kind
from varpin.mechanics.scene import Scene
from varpin.trajectory import Trajectory

# Least change of dry friction in a step that counts as a kink, as a share of its level.
_TURNS = 0.5


class Kinks(NamedTuple):
    """Steps with a kink.

    Attributes:
        steps: Their indices (K,).
        causes: What happens there, in words.
    """

    steps: Integers
    causes: tuple[str, ...]


def kinks(scene: Scene, trajectory: Trajectory) -> Kinks:
    """The steps of a motion in which a force of a joint has a kink."""
    found = np.zeros(trajectory.steps, dtype=np.bool_)
    causes = []
    for cause, look in (
        ("servos come to the limits of their drives, or leave them", _saturating),
        ("joints come to their stops, or leave them", _stopping),
        ("dry friction changes sides", _turning),
    ):
        steps = look(scene, trajectory)
        if steps.any():
            causes.append(cause)
        found |= steps
    return Kinks(np.flatnonzero(found), tuple(causes))


def _saturating(scene: Scene, trajectory: Trajectory) -> NDArray[np.bool_]:
    """Steps (N,) in which a drive reaches or leaves its limit."""
    found = np.zeros(trajectory.steps, dtype=np.bool_)
    for before, after in _demands(scene, trajectory):
        found |= np.trunc(np.clip(before, -1.0, 1.0)) != np.trunc(np.clip(after, -1.0, 1.0))
    return found


def saturates(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether a drive comes to its limit along a motion."""
    return any(max(np.abs(before).max(), np.abs(after).max()) >= 1.0 for before, after in _demands(scene, trajectory))


def _demands(scene: Scene, trajectory: Trajectory) -> Iterator[tuple[Floats, Floats]]:
    """For each servo with an effort limit, its demand at the begin and the end of steps (N,), in units of the limit."""
    servos = limited_servos(scene.elements)
    if not servos:
        return
    force = trajectory.u @ scene.actuation.T
    for servo in servos:
        c, (stiffness, damping, effort) = servo.coordinate, servo.values
        pull = -stiffness * trajectory.q[:, c] - damping * trajectory.v[:, c]
        yield (force[:, c] + pull[:-1]) / effort, (force[:, c] + pull[1:]) / effort


def _stopping(scene: Scene, trajectory: Trajectory) -> NDArray[np.bool_]:
    """Steps (N,) in which a joint enters or leaves a stop or its transition, or may do both."""
    found = np.zeros(trajectory.steps, dtype=np.bool_)
    for stop in of_kind(scene.elements, "JointStop"):
        c, (lower, upper, *_, width) = stop.coordinate, stop.values
        q, reach = trajectory.q[:, c], np.abs(trajectory.v[:, c]) * trajectory.dt
        for depth in (lower - q, q - upper):
            zone = np.clip(np.ceil(depth / width), 0.0, 2.0)
            bounces = (depth[:-1] <= 0.0) & (depth[1:] <= 0.0) & (depth[:-1] + reach[:-1] > 0.0)
            found |= (zone[:-1] != zone[1:]) | bounces
    return found


def turns_over(scene: Scene, trajectory: Trajectory, most: float) -> bool:
    """Whether the dry friction of a joint changes by more than a share of its level in a step."""
    return any(np.abs(change).max() > most for change in _turns(scene, trajectory))


def _turning(scene: Scene, trajectory: Trajectory) -> NDArray[np.bool_]:
    """Steps (N,) in which dry friction changes by much."""
    found = np.zeros(trajectory.steps, dtype=np.bool_)
    for change in _turns(scene, trajectory):
        found |= np.abs(change) > _TURNS
    return found


def _turns(scene: Scene, trajectory: Trajectory) -> Iterator[Floats]:
    """For each joint with dry friction, its changes over the steps (N,), in units of its level."""
    for friction in of_kind(scene.elements, "CoulombFriction"):
        yield np.diff(np.tanh(trajectory.v[:, friction.coordinate] / friction.values[1]))
