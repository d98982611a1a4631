"""Rounding errors of cost differences, and the cost at stake, for the stopping criteria.

Equation (O9) of docs/mathematics.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats
from varpin.control.costs import Expansion
from varpin.control.problem import OptimalControlProblem
from varpin.core import stake_of
from varpin.trajectory import Trajectory

_EPS = float(np.finfo(np.float64).eps)
# Rounding errors of costs and states, in units of the last digit.
_ROUNDED = 16.0


def rounding(
    problem: OptimalControlProblem, trajectory: Trajectory, here: Floats, there: Floats, model: Model
) -> float:
    """Rounding error of the difference between the costs of two neighbouring motions.

    Args:
        problem: The problem.
        trajectory: The first motion.
        here: Its shares.
        there: The shares of the other motion.
        model: The quadratic model of the cost along the first motion.
    """
    moved = here != there
    values = np.abs(here[moved]).sum() + np.abs(there[moved]).sum()
    weight = problem.dt * problem.rule[0, 0]
    along, end = _variables(problem, trajectory)
    slopes = weight * (np.abs(model.running.gradient) * np.abs(along)).sum()
    slopes += (np.abs(model.terminal.gradient) * np.abs(end)).sum()
    return _ROUNDED * _EPS * float(values + slopes)


@dataclass(frozen=True, eq=False)
class Model:
    """The quadratic model of a cost along a motion.

    Attributes:
        running: Expansion at the samples, in (q, v, u).
        terminal: Expansion at the end, in (q, v).
    """

    running: Expansion
    terminal: Expansion


@dataclass(frozen=True)
class Stake:
    """The cost at stake along a motion, without constants.

    Attributes:
        free: Decrease of the cost's quadratic models along the motion if each state and control were free; infinite
            where a model has no minimum, zero where the cost is least.
        moved: The same, with each model's decrease bounded by its change over the motion's displacement, so that
            unreachable states do not count. Tolerances are relative to it.
    """

    free: float
    moved: float


def at_stake(problem: OptimalControlProblem, trajectory: Trajectory, model: Model) -> Stake:
    """The cost at stake along a motion, (O9).

    For squared distances that the motion can change it is about their value. Constants and the noise cost do not count.
    """
    weight = problem.dt * float(problem.rule[0, 0])
    along, end = _variables(problem, trajectory)
    start = np.concatenate([problem.q0, problem.v0])
    free = moved = 0.0
    for factor, expansion, z in ((weight, model.running, along), (1.0, model.terminal, end)):
        change = z.copy()
        change[:, : len(start)] -= start
        could, does = stake_of(expansion.gradient, expansion.hessian, change)
        free, moved = free + factor * could, moved + factor * does
    if problem.rate is not None:
        rate = float(problem.rate.value(problem.decided(trajectory), problem.period))
        free, moved = free + rate, moved + rate
    return Stake(free, moved)


def _variables(problem: OptimalControlProblem, trajectory: Trajectory) -> tuple[Floats, Floats]:
    """(q, v, u) at the samples of a motion, and (q, v) at its end."""
    along = np.concatenate(problem.samples(trajectory.q, trajectory.v, problem.control_rows(trajectory)), axis=1)
    return along, np.concatenate([trajectory.q[-1:], trajectory.v[-1:]], axis=1)
