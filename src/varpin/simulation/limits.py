"""Limits of the robot's description that a motion exceeds, of joints and of motors; and loops that are open.

The limits do not act on the motion. It may be right for a robot without end stops and with motors that are strong
enough.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from varpin.arrays import Floats
from varpin.core import inside_bounds
from varpin.mechanics.forces import drive_forces, of_kind
from varpin.mechanics.scene import Scene
from varpin.trajectory import Trajectory

# First words of the warnings. The motion may still be a correct solution of its equations.
POSITION = "joints leave their limits"
VELOCITY = "joints pass their velocity limits"
EFFORT = "controls pass the joints' effort limits"
LOOPS = "loops of the robot's description are open"
KINDS = (POSITION, VELOCITY, EFFORT, LOOPS)
# Excess over a limit from which on a warning is given: of positions [rad or m], of others as a share of the limit.
_OUTSIDE, _SHARE = 1e-6, 1e-6
# Most joints that a warning names.
_NAMED = 6


def left(scene: Scene, trajectory: Trajectory) -> Iterator[tuple[str, str]]:
    """The kinds of limits that a motion exceeds, each with a sentence: which joints, by how much, and when.

    Loops that the scene leaves open come first.
    """
    if loops := scene.open_loops:
        (a, b), pairs = loops[0], ", ".join(f"{a!r} on {b!r}" for a, b in loops)
        closed = f"varpin.Scene(robot, constraints=[varpin.PointOnPoint({a!r}, {b!r}), ...])"
        if scene.robot.equalities:
            closed = "varpin.Scene(robot, constraints='robot')"
        yield LOOPS, f"{LOOPS}, and the motion is that of a tree: {pairs}; {closed} closes them"
    if not any(scene.bounded):
        return
    q, v, u = trajectory.q, trajectory.v, trajectory.u
    inside = inside_bounds(scene.core, q, v, u, trajectory.u_stages, scene.bound_rows)
    if all(inside) and scene.direct_efforts:
        return
    robot, t = scene.robot, trajectory.t
    stopped = {element.coordinate for element in of_kind(scene.elements, "JointStop")}
    for bounded, kept, (kind, why, of, (least, most), beyond, units) in zip(
        scene.bounded,
        (*inside[:2], inside[2] and scene.direct_efforts),
        (
            (POSITION, "which nothing stops", _positions, scene.bounds.position, _OUTSIDE, ("rad", "m")),
            (VELOCITY, "which nothing holds back", _velocities, scene.bounds.velocity, None, ("rad/s", "m/s")),
            (EFFORT, "which nothing cuts off", _efforts, scene.bounds.effort, None, ("N m", "N")),
        ),
        strict=True,
    ):
        if kept or not bounded:
            continue
        values = of(scene, trajectory)
        slides = robot.slides
        with np.errstate(invalid="ignore"):
            excess = np.maximum(least - values, values - most)
            excess = np.where(excess > (_SHARE * most if beyond is None else beyond), excess, -np.inf)
        worst = excess.max(axis=0, initial=-np.inf)
        if not (worst > 0.0).any():
            continue
        parts, joints = [], [int(c) for c in np.argsort(-worst, kind="stable") if worst[c] > 0.0]
        for c in joints[:_NAMED]:
            first, peak = int(np.argmax(excess[:, c] > 0.0)), int(np.argmax(excess[:, c]))
            since = "from the start" if first == 0 else f"from t = {t[first]:.4g} s"
            side, limit = ("above", most[c]) if values[peak, c] > most[c] else ("below", least[c])
            amount = f"at most {worst[c]:.3g} {units[int(slides[c])]} {side} {limit:.4g} at t = {t[peak]:.4g} s"
            softly = " (its stop gives way)" if kind == POSITION and c in stopped else ""
            parts.append(f"{robot.joint_names[c]!r} {since}, {amount}{softly}")
        more = f"; and {len(joints) - _NAMED} more" if len(joints) > _NAMED else ""
        reason = "" if kind == POSITION and set(joints) <= stopped else f", {why}"
        yield kind, f"{kind}{reason}: {'; '.join(parts)}{more}"


def _positions(_: Scene, trajectory: Trajectory) -> Floats:
    return trajectory.q


def _velocities(_: Scene, trajectory: Trajectory) -> Floats:
    return trajectory.v


def _efforts(scene: Scene, trajectory: Trajectory) -> Floats:
    """Forces of the motors (N, n) [N m or N]."""
    q, v = trajectory.q[:-1], trajectory.v[:-1]
    forces = drive_forces(scene.elements, q, v, trajectory.u @ scene.actuation.T)
    # Where controls change within a step, the largest of its stages counts.
    for stage in range(trajectory.u_stages.shape[1]):
        at_stage = drive_forces(scene.elements, q, v, trajectory.u_stages[:, stage] @ scene.actuation.T)
        forces = np.where(np.abs(at_stage) > np.abs(forces), at_stage, forces)
    # Controls of kinematic inputs are positions: their forces are those of the constraints.
    for row, c in scene.inputs.items():
        forces[:, c] = trajectory.constraint_forces[:, int(np.argmax(scene.constraint_order == row))]
    return forces
