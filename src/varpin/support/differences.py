"""Central differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from varpin.arrays import Floats

# Weights of differences of eighth order between points that are so many steps away on either side.
WEIGHTS = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}


def slopes(function: Callable[[Floats], Floats], x: Floats, size: float | Floats) -> Floats:
    """Derivatives (..., d) of a function of (d,) at x, by differences of eighth order with steps ``size``."""
    steps = np.diag(np.broadcast_to(size, x.shape))
    columns = [
        sum(weight * (function(x + k * step) - function(x - k * step)) for k, weight in WEIGHTS.items()) / step.sum()
        for step in steps
    ]
    return np.stack(columns, axis=-1)
