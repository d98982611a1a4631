"""Angles that were given in degrees instead of radians."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.model.angles import ADVICE, looks_like_degrees
from varpin.model.robot import Robot

# Largest plausible angle in degrees, or in degrees per second.
_DEGREES = 1e6
# Velocities beyond this multiple of a joint's limit are implausible in radians.
_SEVERAL = 6.0


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
    wrong: NDArray[np.bool_] = ~robot.slides & np.where(bounded, (q < lower) | (q > upper), _typed(q))
    angles = np.where(wrong, np.abs(q), 0.0)
    joint = int(np.argmax(angles))
    if not looks_like_degrees(float(angles[joint])):
        return ""
    turns = f"{angles[joint] / (2.0 * math.pi):.0f} turns"
    return f"{name} of {robot.joint_names[joint]!r} is {q[joint]:.4g} rad, {turns}, and looks like degrees: {ADVICE}"


def degrees_per_second_hint(robot: Robot, name: str, v: Floats) -> str:
    """A sentence about the joint of a velocity that looks most like degrees per second; empty if none does.

    That is a number of at most two decimals, several times the joint's limit, where the angles of all joints with
    limits are within them if they are in degrees per second.

    Args:
        robot: The robot.
        name: Name of the velocity, for the sentence.
        v: Velocity (n,) [rad/s or m/s].
    """
    if not v.any():
        return ""
    limit = robot.velocity_limit
    limited = ~robot.slides & np.isfinite(limit) & (limit > 0.0)
    times = np.where(limited, np.abs(v), 0.0) / np.where(limited, limit, 1.0)
    joint = int(np.argmax(np.where(_typed(v), times, 0.0)))
    if not times[joint] > _SEVERAL or np.deg2rad(times.max()) > 1.0:
        return ""
    return (
        f"{name} of {robot.joint_names[joint]!r} is {v[joint]:.4g} rad/s, {times[joint]:.3g} times its limit of "
        f"{limit[joint]:.4g}, and looks like degrees per second: {ADVICE}"
    )


def _typed(values: Floats) -> NDArray[np.bool_]:
    """Whether numbers have at most two decimals, as someone types them."""
    hundredths = 100.0 * np.clip(values, -_DEGREES, _DEGREES)
    whole: NDArray[np.bool_] = np.abs(hundredths - np.round(hundredths)) <= 1e-9 * np.abs(hundredths)
    return (np.abs(values) < _DEGREES) & whole
