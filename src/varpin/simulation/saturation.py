"""Servos that reach or leave the limit of their drives within a step.

There the force has a kink within the step, which collocation of any order does not resolve. Such steps are repeated in
many parts. The error of the velocity lasts for as long as the drive stays at its limit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from varpin.integrators import Integrator, Reference
from varpin.mechanics.forces import of_kind
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import ROUNDING, largest_of_its_kind
from varpin.simulation.retaking import stopping, taken_again
from varpin.trajectory import Trajectory

# Most places with repeated steps, the steps of each, the parts of each step, and the stages of the method.
_PLACES, _LENGTH, _PARTS, _STAGES = 12, 2, 16, 4
# Threshold of the warning, as a share of the largest joint travel.
_WARNED = 0.003


class Bend(NamedTuple):
    """The error of a motion by the limits of drives.

    Attributes:
        joint: The coordinate with the largest error.
        off: The estimated error [rad or m].
        share: The error as a share of the largest joint travel.
        steps: Number of steps in which drives reach or leave their limit.
    """

    joint: int
    off: float
    share: float
    steps: int


def bent(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Bend | None:
    """The error where drives of servos reach or leave their limits, if it exceeds the threshold of the warning."""
    if isinstance(integrator, Reference) or trajectory.dw.any() or scene.custom is not None or not trajectory.steps:
        return None
    servos = of_kind(scene.elements, "PositionServo")
    if not servos:
        return None
    steps, lasting = trajectory.steps, np.zeros(trajectory.steps)
    force = trajectory.u @ scene.actuation.T
    for servo in servos:
        c, (stiffness, damping, effort) = servo.coordinate, servo.values
        if not np.isfinite(effort):
            continue
        pull = -stiffness * trajectory.q[:, c] - damping * trajectory.v[:, c]
        ends_of_steps = pull[:-1], pull[1:]
        before, after = (np.clip((force[:, c] + part) / effort, -1.0, 1.0) for part in ends_of_steps)
        crossed = np.flatnonzero(np.trunc(before) != np.trunc(after))
        # At the limit of a drive errors of the velocity last; elsewhere the servo corrects them.
        ends = np.append(crossed[1:], steps)
        held = np.where(np.abs(after[crossed]) < 1.0, damping / stiffness, trajectory.dt * (ends - crossed))
        lasting[crossed] = np.maximum(lasting[crossed], np.minimum(held, trajectory.dt * (steps - crossed)))
    at = np.flatnonzero(lasting)
    if not len(at):
        return None
    chosen = at[np.unique(np.linspace(0, len(at) - 1, _PLACES).astype(np.int64))]
    off, finely = np.zeros(scene.robot.dof), stopping(scene, _STAGES)
    for step in chosen.tolist():
        count = min(_LENGTH, steps - step)
        again = taken_again(scene, finely, trajectory, integrator.stage_times, step, count, _PARTS)
        if again is None or not np.isfinite(again[0]).all():
            continue
        q, v = (
            known[step + count] - found[-1] for known, found in zip((trajectory.q, trajectory.v), again, strict=True)
        )
        off += np.abs(q) + np.abs(v) * lasting[step]
    off *= len(at) / len(chosen)
    way = largest_of_its_kind(scene, np.ptp(trajectory.q, axis=0))
    shares = off / np.maximum(way, ROUNDING * (1.0 + np.abs(trajectory.q).max()))
    joint = int(shares.argmax())
    return Bend(joint, float(off[joint]), float(shares[joint]), len(at)) if shares[joint] > _WARNED else None
