"""Whether a number that should be an angle in radians was given in degrees."""

from __future__ import annotations

import math

# Largest plausible angle [rad]: two turns.
_TURNS = 4.0 * math.pi
ADVICE = "angles are in radians, np.deg2rad makes them of degrees"


def looks_like_degrees(angle: float) -> bool:
    """Whether an angle [rad] is larger than two turns."""
    return abs(angle) > _TURNS
