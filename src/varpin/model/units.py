"""Units of joints in messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from varpin.model.robot import Robot


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
