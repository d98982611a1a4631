"""Costs as descent sees them: their differences, digit by digit, and how much of them is at stake.

Equation (O9) of docs/mathematics.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.control.costs import Expansion
from varpin.control.problem import OptimalControlProblem
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

_EPS = float(np.finfo(np.float64).eps)
# Rounding errors of costs and states, in units of the last digit: functions are evaluated and steps solved with some.
_ROUNDED = 16.0


def rounding(
    problem: OptimalControlProblem, trajectory: Trajectory, here: Floats, there: Floats, model: Model
) -> float:
    """What rounding alone may do to the difference between the cost of a motion and that of one next to it.

    Args:
        problem: The problem.
        trajectory: The motion.
        here: Its shares.
        there: The other's.
        model: The quadratic model of the cost along the motion.
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
        running: At its samples, in (q, v, u).
        terminal: At its end, in (q, v).
    """

    running: Expansion
    terminal: Expansion


@dataclass(frozen=True)
class Stake:
    """How much of a cost is at stake, whatever constants there are in it.

    Attributes:
        free: What the cost would lose by its quadratic models along the motion if each state and control were free;
            infinite where a model has no minimum. Zero where nothing can be better.
        moved: The same, but from each model no more than it changes by over the motion's own displacement: states far
            beyond what moves at all do not count. A tolerance is relative to it.
    """

    free: float
    moved: float


def at_stake(problem: OptimalControlProblem, trajectory: Trajectory, model: Model) -> Stake:
    """How much of the cost of a motion is at stake.

    A squared distance is all at stake, as long as motion can change it: the stake of bundled costs is about their
    value. A constant is not; nor is what noise adds.
    """
    weight = problem.dt * float(problem.rule[0, 0])
    along, end = _variables(problem, trajectory)
    start = np.concatenate([problem.q0, problem.v0])
    free = moved = 0.0
    for factor, expansion, z in ((weight, model.running, along), (1.0, model.terminal, end)):
        change = z.copy()
        change[:, : len(start)] -= start
        could, does = _falls(expansion), np.maximum(0.5 * _forms(expansion.hessian, change), 0.0)
        free += factor * float(could.sum())
        moved += factor * float(np.minimum(could, does).sum())
    if problem.rate is not None:
        rate = float(problem.rate.value(trajectory.u[:: problem.hold], problem.period))
        free, moved = free + rate, moved + rate
    return Stake(free, moved)


def _variables(problem: OptimalControlProblem, trajectory: Trajectory) -> tuple[Floats, Floats]:
    """(q, v, u) at the samples of a motion, and (q, v) at its end."""
    along = np.concatenate(problem.samples(trajectory.q, trajectory.v, trajectory.u), axis=1)
    return along, np.concatenate([trajectory.q[-1:], trajectory.v[-1:]], axis=1)


def _forms(hessian: Floats, z: Floats) -> Floats:
    """The quadratic form z' H z at each point."""
    product = z @ hessian[0] if len(hessian) == 1 else (hessian @ z[:, :, None])[:, :, 0]
    total: Floats = (product * z).sum(axis=1)
    return total


def _falls(expansion: Expansion) -> Floats:
    """What the quadratic model of each point falls by along its steepest descent, in units of its own curvatures.

    That is all where no two variables are coupled. Infinite where the model falls without end.
    """
    gradient, hessian = expansion.gradient, expansion.hessian
    diagonal = np.diagonal(hessian, axis1=1, axis2=2)
    curved = diagonal > 0.0
    step = np.where(curved, gradient / np.where(curved, diagonal, 1.0), 0.0)
    slope, curvature = (gradient * step).sum(axis=1), _forms(hessian, step)
    endless = ((gradient != 0.0) & ~curved).any(axis=1) | ((slope > 0.0) & (curvature <= 0.0))
    fall: Floats = np.where(slope > 0.0, 0.5 * slope**2 / np.where(curvature > 0.0, curvature, 1.0), 0.0)
    return np.where(endless, np.inf, fall)
