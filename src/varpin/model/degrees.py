"""Angles that were given in degrees instead of radians."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.model.angles import ADVICE, looks_like_degrees
from varpin.model.robot import Robot

# Largest plausible angle in degrees.
_DEGREES = 1e6


def degrees_hint(robot: Robot, name: str, q: Floats) -> str:
    """A sentence about the joint of a configuration that looks most like degrees; empty if none does.

    Joints without limits may have turned many times in an earlier motion. Of these joints only values with at most two
    decimals count, as someone types them.

    Args:
        robot: The robot.
        name: Name of the configuration, for the sentence.
        q: Configuration (n,) [rad or m].
    """
    if not looks_like_degrees(float(np.abs(q).max(initial=0.0))):
        return ""
    lower, upper = robot.position_limits
    bounded = np.isfinite(lower) | np.isfinite(upper)
    hundredths = 100.0 * np.clip(q, -_DEGREES, _DEGREES)
    typed = (np.abs(q) < _DEGREES) & (np.abs(hundredths - np.round(hundredths)) <= 1e-9 * np.abs(hundredths))
    wrong: NDArray[np.bool_] = ~robot.slides & np.where(bounded, (q < lower) | (q > upper), typed)
    angles = np.where(wrong, np.abs(q), 0.0)
    joint = int(np.argmax(angles))
    if not looks_like_degrees(float(angles[joint])):
        return ""
    turns = f"{angles[joint] / (2.0 * math.pi):.0f} turns"
    return f"{name} of {robot.joint_names[joint]!r} is {q[joint]:.4g} rad, {turns}, and looks like degrees: {ADVICE}"
