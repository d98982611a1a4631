"""The line search of an iteration: trials along its step, and the decrease of the merit that accepts one of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.control.sizes import TRACE
from varpin.trajectory import Trajectory

# Factor between the lengths of trials; from 0.3 to 0.7.
_BACKTRACKING = 0.5
# Shortest next length by the parabola, relative to the last; full steps are extended by its inverse. From 0.1 to 0.5.
_SHARPEST = 0.25
# Least share of the foreseen decrease below which shorter steps are tried while they are better; from 0.1 to 0.5.
_POOR = 0.3
# Share of what its slope gives from which on a full step is extended: at a minimum it is half. From 0.7 to 0.95.
_EARLY = 0.85
# Corrections of a full step for the curvature of rows and dynamics; from 1 to 3.
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


def line_search(
    attempt: Callable[[float], Trial], slope: float, correct: Callable[[Trajectory], Trial | None], *, extends: bool
) -> Taken:
    """The first trial along a step with a sufficient decrease of the merit, or a better one next to it.

    ``attempt`` makes the trial of a length, ``correct`` a full step again from the motion of one, if it can, and
    ``slope`` is that of the merit. Lengths are halved, or quartered where the parabola through the last trial's merit
    and slope has its minimum there or before (J. E. Dennis and R. B. Schnabel, "Numerical Methods for Unconstrained
    Optimization and Nonlinear Equations", 1983, section 6.3).
    """
    best, length, trials, last = Trial(), 0.0, 0, Trial()
    corrections = _CORRECTIONS
    a = 1.0
    while a > TRACE:
        trial = attempt(a)
        trials += 1
        while a == 1.0 and trial.merit > TRACE * slope and corrections and trial.motion is not None:
            corrections -= 1
            other = correct(trial.motion)
            trials += other is not None
            if other is None or other.merit >= trial.merit:
                break
            trial = other
        last = trial if trial.motion is not None else last
        if trial.merit <= TRACE * a * slope and trial.merit < best.merit:
            best, length = trial, a
            if trial.merit <= _POOR * a * slope:
                break
        elif length > 0.0:
            break
        least = 0.5 / (1.0 - trial.merit / (a * slope)) if trial.merit > a * slope else 1.0
        a *= _SHARPEST if least <= _SHARPEST else _BACKTRACKING
    while extends and length >= 1.0 and best.merit <= length * _EARLY * slope:
        longer = attempt(length / _SHARPEST)
        trials += 1
        if longer.merit >= best.merit:
            break
        best, length = longer, length / _SHARPEST
    return Taken(best, length, trials, last)
