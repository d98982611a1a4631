"""When a motion is wrong: the units of its errors and their thresholds."""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats
from varpin.mechanics.scene import Scene
from varpin.simulation.scales import largest_of_its_kind

# Thresholds of errors. Energy balance: share of the energy turned over. Position: share of the joint's travel, and of
# the largest joint travel of its kind. Velocity: share of the joint's largest, with a larger threshold, for a small
# shift in time changes a peak of the velocity by much.
WRONG_ENERGY = 0.1
WRONG_POSITION, WRONG_MOTION, WRONG_VELOCITY = 0.1, 0.05, 0.25
# Growth of a disturbance from which on a motion counts as unpredictable; and the disturbance, relative to q and v.
_PREDICTABLE, DISTURBANCE = 10.0, 1e-7
# For a joint that hardly moves, the unit of errors is at least the smaller of two: this share of the largest travel or
# speed among joints of its kind, and of the speed at which the joint would have their energy.
_LITTLE, _LIGHT = 1e-2, 1e-2
# Least change of a speed, as a share of it, for joints at constant speed.
_EVEN = 1e-3


def grown(plain: Floats, disturbed: Floats, disturbance: float) -> int:
    """Steps, one at least, until the distance of two motions' q (K + 1, n) is a multiple of the disturbance."""
    with np.errstate(over="ignore", invalid="ignore"):
        apart = ~(np.abs(disturbed - plain).max(axis=1) <= _PREDICTABLE * disturbance)
    return max(1, int(apart.argmax())) if apart.any() else len(plain) - 1


def velocity_change(v: Floats) -> Floats:
    """The change of velocities over the nodes (K, ...): the range they cover, at most the largest speed."""
    fastest = np.abs(v).max(axis=0)
    change: Floats = np.clip(np.ptp(v, axis=0), _EVEN * fastest, fastest)
    return change


def error_units(scene: Scene, travel: Floats, speed: Floats, light: Floats, duration: Floats) -> tuple[Floats, Floats]:
    """Units of errors (..., n): travels and largest velocities, bounded from below by those of the other joints.

    ``light`` are the velocities of :func:`light_joint_speed` (..., n), ``duration`` is the time of the judgement [s].
    """
    least = np.minimum(_LITTLE * largest_of_its_kind(scene, speed), light)
    least_travel = np.minimum(_LITTLE * largest_of_its_kind(scene, travel), light * duration)
    return np.maximum(travel, least_travel), np.maximum(speed, least)


def light_joint_speed(inertia: Floats, change: Floats) -> Floats:
    """``_LIGHT`` times the velocity at which each joint has the energy of the largest change (..., n)."""
    root = np.sqrt(inertia)
    light: Floats = _LIGHT * (root * change).max(axis=-1, keepdims=True) / root
    return light
