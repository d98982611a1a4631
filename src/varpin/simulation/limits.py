"""Limits of the robot's description that a motion passes, of joints and of motors; and loops that are open.

Limits do not act on the motion: it may be right for a robot without end stops and with motors that are strong enough.
"""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats
from varpin.finding import Finding, and_more
from varpin.mechanics.forces import drive_forces, limited_servos, of_kind
from varpin.mechanics.scene import Scene
from varpin.trajectory import Trajectory

# Kinds of these findings. The motion may still be a correct solution of its equations.
KINDS = ("position limits", "velocity limits", "effort limits", "open loops")
_UNITS = (("rad", "m"), ("rad/s", "m/s"), ("N m", "N"))
# Excess over a limit from which on it is told: rounding, of positions [rad or m], of others as a share of the limit.
_ROUNDING = 1e-6


def beyond_limits(scene: Scene, trajectory: Trajectory, extremes: Floats | None = None) -> list[Finding]:
    """Loops that the scene leaves open, and for each kind of limit the joint that passes it by most.

    ``extremes`` (2, N, m) are the least and largest controls in each step, where the record has means alone.
    """
    found = []
    if loops := scene.open_loops:
        a, b = loops[0]
        cure = "constraints='robot'" if scene.robot.equalities else f"constraints=[varpin.PointOnPoint({a!r}, {b!r})]"
        text = f"the robot's loop of {a!r} on {b!r} is open{and_more(len(loops) - 1, 'loop')}: the motion is a tree's. "
        found.append(Finding("open loops", f"{text}Use varpin.Scene(robot, {cure})"))
    kinds = np.flatnonzero(np.isfinite(scene.bounds).any(axis=(1, 2)))
    return found + [each for kind in kinds for each in _passed(scene, trajectory, int(kind), extremes)]


def _passed(scene: Scene, trajectory: Trajectory, kind: int, extremes: Floats | None) -> list[Finding]:
    """The finding about one kind of limits: the joint that passes its own by most, and when."""
    values = (trajectory.q, trajectory.v)[kind] if kind < 2 else _efforts(scene, trajectory, extremes)
    limits = least, most = scene.bounds[kind]
    with np.errstate(invalid="ignore"):
        excess = np.maximum(least - values, values - most)
        excess = np.where(excess > _ROUNDING * (most if kind else 1.0), excess, -np.inf)
    worst = excess.max(axis=0, initial=-np.inf)
    if not worst.max() > 0.0:
        return []
    joint = int(worst.argmax())
    name, peak = scene.robot.joint_names[joint], int(excess[:, joint].argmax())
    unit = _UNITS[kind][int(scene.robot.slides[joint])]
    upper = int(values[peak, joint] > 0.5 * (limits[0][joint] + limits[1][joint]))
    # Stops widen the bounds of positions: the limit is the robot's own.
    own = limits if kind else scene.robot.position_limits
    limit = float(abs(own[upper][joint]) if kind else own[upper][joint])
    by = worst[joint] + abs(own[upper][joint] - limits[upper][joint])
    what = ("position", "velocity", "effort")[kind]
    stops = [stop.values for stop in of_kind(scene.elements, "JointStop") if stop.coordinate == joint]
    stopped = kind == 0 and any((2 * upper - 1) * (stop[upper] - limit) < stop[-1] for stop in stops)
    soft = "; its JointStop gives way" if stopped else "; nothing stops it there" if kind == 0 else ""
    text = (
        f"joint {name!r} passes its {what} limit {limit:.4g} {unit} by up to {by:.3g} "
        f"(t = {trajectory.t[peak]:.3g} s{soft}){and_more(int((worst > 0).sum()) - 1, 'joint')}"
    )
    return [Finding(KINDS[kind], text, name, time=float(trajectory.t[peak]), value=float(by), unit=unit)]


def _efforts(scene: Scene, trajectory: Trajectory, extremes: Floats | None) -> Floats:
    """Forces of the motors (N, n) [N m or N], the largest of each step."""
    q, v = trajectory.q[:-1], trajectory.v[:-1]
    within = np.moveaxis(trajectory.u_stages, 1, 0) if extremes is None else extremes
    forces = drive_forces(scene.elements, q, v, trajectory.u @ scene.actuation.T)
    for u in within:
        other = drive_forces(scene.elements, q, v, u @ scene.actuation.T)
        forces = np.where(np.abs(other) > np.abs(forces), other, forces)
    # Controls of kinematic inputs are positions: their forces are those of the constraints.
    for row, c in scene.inputs.items():
        forces[:, c] = trajectory.constraint_forces[:, int(np.argmax(scene.constraint_order == row))]
    return forces


def saturates(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether a servo's drive comes to its effort limit along a motion."""
    force = trajectory.u @ scene.actuation.T
    for servo in limited_servos(scene.elements):
        c, (stiffness, damping, effort) = servo.coordinate, servo.values
        pull = -stiffness * trajectory.q[:, c] - damping * trajectory.v[:, c]
        if max(np.abs(force[:, c] + pull[:-1]).max(), np.abs(force[:, c] + pull[1:]).max()) >= effort:
            return True
    return False
