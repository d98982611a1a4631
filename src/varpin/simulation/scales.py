"""Scales of a motion's errors: the largest travel and speed of joints of one kind."""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats
from varpin.mechanics.scene import Scene
from varpin.model import longest_reach

# Accumulated rounding, relative to positions.
_ROUNDING = 1e3 * float(np.finfo(np.float64).eps)
# A joint travel below this counts as no motion [rad or m].
SHORTEST = 1e-8
# Joints that hardly move are measured by the others: by this share of what those move at the robot's reach, and by this
# share of the largest speed of their kind.
_LITTLE, _SLOW = 1e-2, 5e-2


def largest_of_its_kind(scene: Scene, values: Floats) -> Floats:
    """For each coordinate (..., n), the largest value of all revolute joints, or of all prismatic ones."""
    sliding = scene.robot.slides
    largest = [values[..., kind].max(axis=-1, initial=0.0, keepdims=True) for kind in (sliding, ~sliding)]
    each: Floats = np.where(sliding, *largest)
    return each


def travel_scales(scene: Scene, q: Floats) -> Floats:
    """For each coordinate (n,), the travel of which errors are shares, from the nodes q (K, n).

    It is the largest travel of the coordinate's kind; where joints turn and slide, at least ``_LITTLE`` of what the
    others move at the robot's reach.
    """
    travel = largest_of_its_kind(scene, q.max(axis=0) - q.min(axis=0))
    sliding = scene.robot.slides
    if sliding.any() and not sliding.all():
        reach = longest_reach(scene.robot)
        # On rails without ends: a metre.
        lever = reach if 0.0 < reach < np.inf else 1.0
        turns, slides = float(travel[~sliding].max()), float(travel[sliding].max())
        travel = np.maximum(travel, _LITTLE * np.where(sliding, turns * lever, slides / lever))
    scales: Floats = np.maximum(travel, max(SHORTEST, _ROUNDING * (1.0 + float(np.abs(q).max(initial=0.0)))))
    return scales


def speed_scales(scene: Scene, v: Floats) -> Floats:
    """For each coordinate (n,), the speed of which errors of v are shares, from the nodes v (K, n)."""
    speed = np.abs(v).max(axis=0, initial=0.0)
    scales: Floats = np.maximum(np.maximum(speed, _SLOW * largest_of_its_kind(scene, speed)), SHORTEST)
    return scales
