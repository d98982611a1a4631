"""The line search of an iteration: trials along its step, and the decrease of the merit that accepts one of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.trajectory import Trajectory

# Least share of the expected decrease that a step must reach (Armijo), from 1e-6 to 1e-3.
_ARMIJO = 1e-5
# Factor between trials, shortest length of a step, and the shortest next length by the parabola, relative to the last.
_BACKTRACKING, _SHORTEST, _SHARPEST = 0.5, 1e-6, 0.25
# Least share of the foreseen decrease below which shorter steps are tried while they are better, from 0.1 to 0.5.
_POOR = 0.3
# A full step is extended by this factor where it brings this share of what its slope gives: at a minimum it is half.
_EARLY, _EXTENSION = 0.85, 4.0
# Corrections of a full step for the curvature of rows and dynamics.
_CORRECTIONS = 2


class Trial(NamedTuple):
    """A trial motion: its change of the merit, infinite where it has none."""

    merit: float = np.inf
    motion: Trajectory | None = None
    shares: Floats | None = None


class Taken(NamedTuple):
    """The result of a line search: the motion it moves to, if any, and the last one that it tried."""

    best: Trial
    length: float
    trials: int
    last: Trial


class Lengths:
    """Step lengths of a line search: powers of one factor, the longest first.

    Powers are left out that are longer than the minimum of the parabola through the last trial's merit and slope, down
    to :data:`_SHARPEST` of the last length (J. E. Dennis and R. B. Schnabel, "Numerical Methods for Unconstrained
    Optimization and Nonlinear Equations", 1983, section 6.3).
    """

    def __init__(self) -> None:
        self._factor = _BACKTRACKING

    def learn(self, step: float, change: float, slope: float) -> None:
        """Learn from the change of the merit with a trial of length ``step``, infinite if it has no merit."""
        least = 0.5 / (1.0 - change / (step * slope)) if change > step * slope else 1.0
        powers = math.floor(math.log(max(least, _SHARPEST)) / math.log(_BACKTRACKING))
        self._factor = _BACKTRACKING ** max(1, powers)

    def __iter__(self) -> Iterator[float]:
        length = 1.0
        while length > _SHORTEST:
            yield length
            length *= self._factor


def line_search(
    attempt: Callable[[float], Trial], slope: float, correct: Callable[[Trajectory], Trial | None], *, extends: bool
) -> Taken:
    """The first trial along a step with a sufficient decrease of the merit, or a better one next to it.

    Args:
        attempt: Makes the trial of a length.
        slope: Of the merit along the step.
        correct: Makes a full step again, from the motion of one; None where there is no other.
        extends: Whether full steps may be extended.
    """
    best, length, trials, last = Trial(), 0.0, 0, Trial()
    lengths, corrections = Lengths(), _CORRECTIONS
    for a in lengths:
        trial = attempt(a)
        trials += 1
        while a == 1.0 and trial.merit > _ARMIJO * slope and corrections and trial.motion is not None:
            corrections -= 1
            other = correct(trial.motion)
            trials += other is not None
            if other is None or other.merit >= trial.merit:
                break
            trial = other
        lengths.learn(a, trial.merit, slope)
        last = trial if trial.motion is not None else last
        if trial.merit <= _ARMIJO * a * slope and trial.merit < best.merit:
            best, length = trial, a
            if trial.merit <= _POOR * a * slope:
                break
        elif length > 0.0:
            break
    while extends and length >= 1.0 and best.merit <= length * _EARLY * slope:
        longer = attempt(_EXTENSION * length)
        trials += 1
        if longer.merit >= best.merit:
            break
        best, length = longer, _EXTENSION * length
    return Taken(best, length, trials, last)
