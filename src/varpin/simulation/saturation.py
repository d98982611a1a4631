"""Servos that reach the limit of their drives, or leave it, within a step: there forces bend faster than the step.

Collocation of any order misses what a force does that bends within a step. Steps in which it does are taken again in
many parts; what their velocities are off by goes on for as long as the drive stays at its limit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.integrators import Integrator, Reference
from varpin.mechanics.forces import of_kind
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import ROUNDING, largest_of_its_kind
from varpin.simulation.retaking import stopping, taken_again
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# Steps that are taken again, of how many, in how many parts each, and with how many stages.
_PLACES, _LENGTH, _PARTS, _STAGES = 12, 2, 16, 4
# What is spoken of, in units of the way of the joint that goes furthest.
_SHOWS = 0.003


class Bend(NamedTuple):
    """What the limits of drives do to a motion.

    Attributes:
        joint: The coordinate that is off most.
        off: About by how much [rad or m].
        share: The same, in units of the way of the joint that goes furthest.
        steps: In how many steps drives come to their limit or leave it.
    """

    joint: int
    off: float
    share: float
    steps: int


def bent(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Bend | None:
    """What is missed where drives of servos come to their limits or leave them, if that is worth a word."""
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
        # At its limit a drive lets errors go on; elsewhere it takes them back.
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
    return Bend(joint, float(off[joint]), float(shares[joint]), len(at)) if shares[joint] > _SHOWS else None
