"""Lengths of the steps that a line search tries."""

from __future__ import annotations

import math
from collections.abc import Iterator

# Least share of the expected decrease that a step must reach (Armijo), and the factor between trials.
ARMIJO, BACKTRACKING = 1e-5, 0.5
# Least length of a step, greatest number of trials, and the shortest next length by the parabola, relative to the last.
_SHORTEST, _TRIALS, _SHARPEST = 1e-6, 40, 0.25


class Lengths:
    """Step lengths of a line search: powers of the factor ``backtracking``, the longest first.

    Powers are left out that are longer than the minimum of the parabola through the last trial's cost and slope, down
    to :data:`_SHARPEST` of the last length (J. E. Dennis and R. B. Schnabel, "Numerical Methods for Unconstrained
    Optimization and Nonlinear Equations", 1983, section 6.3).
    """

    def __init__(self, backtracking: float) -> None:
        self._backtracking = backtracking
        self._powers = 1

    def learn(self, step: float, change: float, slope: float) -> None:
        """Learn from the change of the cost with a trial of length ``step``, infinite if it has no cost."""
        least = 0.5 / (1.0 - change / (step * slope)) if change > step * slope else 1.0
        self._powers = 1
        if least < self._backtracking:
            powers = math.log(max(least, _SHARPEST)) / math.log(self._backtracking)
            self._powers = max(1, math.floor(powers))

    def __iter__(self) -> Iterator[float]:
        length, count = 1.0, 0
        while length > _SHORTEST and count < _TRIALS:
            yield length
            count += 1
            length *= self._backtracking**self._powers
