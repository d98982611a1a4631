"""Lengths that were given in millimetres instead of metres."""

from __future__ import annotations

import numpy as np

from varpin.model.robot import Robot

# Largest plausible length in a robot's surroundings, in units of its reach: a larger one looks like millimetres.
AFAR = 50.0
# Largest plausible clearance, in the same units.
ASIDE = 2.0
# Least reach that counts [m]: a wheel has none.
_LEAST = 0.1
IN_MILLIMETRES = "it may be in millimetres, and lengths are in metres"


def longest_reach(robot: Robot) -> float:
    """Upper bound on the distance of a centre of mass from the root of its tree [m]; infinite on free rails."""
    tree = robot.tree
    lower, upper = robot.position_limits
    path = np.zeros(len(tree.parent))
    for body, parent in enumerate(tree.parent):
        if parent >= 0:
            path[body] = path[parent] + np.linalg.norm(tree.translation[body])
        if tree.prismatic[body]:
            ends = np.array([lower[tree.coordinate[body]], upper[tree.coordinate[body]]])
            path[body] += float(np.abs(tree.ratio[body] * ends + tree.offset[body]).max())
    return float((path + np.linalg.norm(tree.center, axis=1)).max())


def millimetres_hint(robot: Robot, lengths: dict[str, float], plausible: float = AFAR) -> str:
    """A sentence about the largest of some named lengths [m] that look like millimetres; empty if none does.

    Lengths up to ``plausible`` times the robot's reach do not.
    """
    name, length = max(lengths.items(), key=lambda own: own[1])
    reach = longest_reach(robot)
    if not length > plausible * max(reach, _LEAST):
        return ""
    return f"{name} is {length:.4g} m, and the reach of {robot.name} at most {reach:.3g} m: {IN_MILLIMETRES}"
