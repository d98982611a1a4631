"""Units of joints, and angles that look as if they were given in degrees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.finding import Finding

if TYPE_CHECKING:
    from varpin.model.robot import Robot

# Largest plausible angle [rad]: two turns.
TURNS = 4.0 * math.pi
ADVICE = "angles are in radians, np.deg2rad makes them of degrees"

# A joint whose limit is larger [rad or m] has none: exporters write 1e9, 1e16 or the largest double. Nobody types
# larger angles in degrees.
NO_LIMIT = 1e6


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


def typed_in_degrees(angles: Floats) -> NDArray[np.bool_]:
    """Whether angles [rad] are larger than two turns and have at most one decimal, as someone types degrees."""
    tenths = 10.0 * np.clip(angles, -NO_LIMIT, NO_LIMIT)
    return (np.abs(angles) > TURNS) & (np.abs(angles) < NO_LIMIT) & (tenths == np.round(tenths))


def in_degrees(robot: Robot, name: str, values: Floats, *, speed: bool = False) -> tuple[Finding, ...]:
    """A finding about the joint whose value, of some (..., n) [rad or m, or that a second], looks most like degrees.

    Of each joint the largest value counts, where it is beyond two turns and the joint's limits. Joints without limits
    may have turned many times in an earlier motion: of these only typed values count, of a ``speed`` those of joints
    with a limit.
    """
    lower, upper = (-robot.velocity_limit, robot.velocity_limit) if speed else robot.position_limits
    rows = np.vstack([np.zeros(robot.dof), np.reshape(np.where(np.isfinite(values), values, 0.0), (-1, robot.dof))])
    most = rows[np.abs(rows).argmax(axis=0), np.arange(robot.dof)]
    outside, typed = (most < lower) | (most > upper), typed_in_degrees(most)
    bounded = np.isfinite(lower) | np.isfinite(upper)
    wrong = ~robot.slides & (outside & typed if speed else np.where(bounded, outside, typed))
    joint = int(np.argmax(np.where(wrong, np.abs(most), 0.0)))
    value, name_of, per = float(most[joint]), robot.joint_names[joint], "/s" if speed else ""
    if not (wrong[joint] and abs(value) > TURNS):
        return ()
    turns = f"{abs(value) / (2.0 * math.pi):.0f} turns{per}"
    text = f"{name} of {name_of!r} is {value:.4g} rad{per}, {turns}, and looks like degrees: {ADVICE}"
    return (Finding("degrees", text, name_of, value=value, unit=f"rad{per}"),)


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
