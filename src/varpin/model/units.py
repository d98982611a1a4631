"""Units of joints, and numbers that look as if they were given in other units."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats

if TYPE_CHECKING:
    from varpin.model.inertia import Payload
    from varpin.model.robot import Robot

# Largest plausible angle [rad]: two turns.
_TURNS = 4.0 * math.pi
ADVICE = "angles are in radians, np.deg2rad makes them of degrees"

# A joint whose limit is larger [rad or m] has none: exporters write 1e9, 1e16 or the largest double. Nobody types
# larger angles in degrees.
NO_LIMIT = 1e6

# Largest plausible length in a robot's surroundings, in units of its reach: a larger one looks like millimetres.
AFAR = 50.0
# Largest plausible clearance, in the same units.
ASIDE = 2.0
# Least reach that counts [m]: a wheel has none.
_LEAST = 0.1
# Longest plausible link [m], and largest plausible payload in masses of the robot: arms carry about their own mass.
_LONG, _BURDEN = 50.0, 10.0
IN_MILLIMETRES = "it may be in millimetres, and lengths are in metres"


def joint_unit(robot: Robot, coordinates: int | Sequence[int] | slice = slice(None), *, speed: bool = False) -> str:
    """The unit of the positions of some coordinates, by default of all: rad, m, or "rad or m" where they differ.

    Args:
        robot: The robot.
        coordinates: Index or indices.
        speed: The unit of velocities instead.
    """
    slides = np.atleast_1d(robot.slides[coordinates])
    turning, sliding = ("rad/s", "m/s") if speed else ("rad", "m")
    if slides.all():
        return sliding
    return f"{turning} or {sliding}" if slides.any() else turning


def looks_like_degrees(angle: float) -> bool:
    """Whether an angle [rad] is larger than two turns."""
    return abs(angle) > _TURNS


def typed_in_degrees(angles: Floats) -> NDArray[np.bool_]:
    """Whether angles [rad] are larger than two turns and have at most one decimal, as someone types degrees."""
    tenths = 10.0 * np.clip(angles, -NO_LIMIT, NO_LIMIT)
    return (np.abs(angles) > _TURNS) & (np.abs(angles) < NO_LIMIT) & (tenths == np.round(tenths))


def degrees_hint(robot: Robot, name: str, values: Floats, *, speed: bool = False) -> str:
    """A sentence about the joint whose value (n,) [rad or m, or that a second] looks most like degrees, or none.

    Joints without limits may have turned many times in an earlier motion. Of these only typed values count; of a
    ``speed`` only typed values beyond its limit.
    """
    lower, upper = (-robot.velocity_limit, robot.velocity_limit) if speed else robot.position_limits
    outside, typed = (values < lower) | (values > upper), typed_in_degrees(values)
    bounded = np.isfinite(lower) | np.isfinite(upper)
    wrong: NDArray[np.bool_] = ~robot.slides & (outside & typed if speed else np.where(bounded, outside, typed))
    angles = np.where(wrong, np.abs(values), 0.0)
    joint, per = int(np.argmax(angles)), "/s" if speed else ""
    if not looks_like_degrees(float(angles[joint])):
        return ""
    turns = f"{angles[joint] / (2.0 * math.pi):.0f} turns{per}"
    value, joint_name = values[joint], robot.joint_names[joint]
    return f"{name} of {joint_name!r} is {value:.4g} rad{per}, {turns}, and looks like degrees: {ADVICE}"


def longest_reach(robot: Robot, *, slides: bool = True, centers: bool = True) -> float:
    """Upper bound on the distance of a centre of mass from the root of its tree [m]; infinite on free rails."""
    tree = robot.tree
    lower, upper = robot.position_limits
    path = np.zeros(len(tree.parent))
    for body, parent in enumerate(tree.parent):
        if parent >= 0:
            path[body] = path[parent] + np.linalg.norm(tree.translation[body])
        if slides and tree.prismatic[body]:
            ends = np.array([lower[tree.coordinate[body]], upper[tree.coordinate[body]]])
            path[body] += float(np.abs(tree.ratio[body] * ends + tree.offset[body]).max())
    return float((path + (np.linalg.norm(tree.center, axis=1) if centers else 0.0)).max())


def odd_sizes(robot: Robot, payload: Sequence[Payload]) -> Iterator[str]:
    """Sentences about links and payloads whose sizes look like millimetres or grams."""
    tree, names = robot.tree, robot.model.names
    hops = np.where(tree.parent >= 0, np.linalg.norm(tree.translation, axis=1), 0.0)
    body = int(np.argmax(hops))
    if hops[body] > _LONG:
        joints = f"{names[int(tree.parent[body]) + 1]!r} and {names[body + 1]!r}"
        yield f"the link between joints {joints} is {hops[body]:.4g} m long: {IN_MILLIMETRES}"
    mass = sum(own.mass for own in robot.model.inertias) - sum(part.mass for part in payload)
    for part in payload:
        away = {f"the distance of the payload's centre from frame {part.frame!r}": float(np.linalg.norm(part.center))}
        if sentence := millimetres_hint(robot, away):
            yield sentence
        if part.mass > _BURDEN * mass > 0.0:
            heavy = f"the payload at frame {part.frame!r} weighs {part.mass:.4g} kg, and the robot {mass:.3g} kg"
            yield f"{heavy}: it may be in grams, and masses are in kg"


def millimetres_hint(robot: Robot, lengths: dict[str, float], plausible: float = AFAR) -> str:
    """A sentence about the largest of some named lengths [m] that look like millimetres; empty if none does.

    Lengths up to ``plausible`` times the robot's reach do not.
    """
    name, length = max(lengths.items(), key=lambda own: own[1])
    reach = longest_reach(robot, centers=False)
    if not length > plausible * max(reach, _LEAST):
        return ""
    return f"{name} is {length:.4g} m, and the reach of {robot.name} at most {reach:.3g} m: {IN_MILLIMETRES}"
