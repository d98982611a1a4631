"""Central differences."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from varpin.arrays import Floats

# Weights of differences between points that are so many steps away on either side, of eighth and of fourth order.
EIGHTH = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
FOURTH = {1: 2 / 3, 2: -1 / 12}


def slopes(
    function: Callable[[Floats], Floats], x: Floats, size: float | Floats, weights: Mapping[int, float] = EIGHTH
) -> Floats:
    """Derivatives (..., d) of a function of (d,) at x, by differences with steps ``size``."""
    steps = np.diag(np.broadcast_to(size, x.shape))
    columns = [
        sum(weight * (function(x + k * step) - function(x - k * step)) for k, weight in weights.items()) / step.sum()
        for step in steps
    ]
    return np.stack(columns, axis=-1)
