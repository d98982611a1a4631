"""Replanning at a controller's ticks, by the same search, and how well runs keep constraints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.control.between_nodes import enforced, middles
from varpin.control.constraints import BoundConstraint
from varpin.control.history import Status
from varpin.control.multipliers import REPORTED, Multipliers, at_nodes, flat
from varpin.control.problem import OptimalControlProblem
from varpin.control.rollout import shifted_commands
from varpin.control.search import Search
from varpin.control.solution import Solution
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

# Share of the violation of the plan before that a tick has to remove.
_LOWERED = 0.9


def replan(
    problem: OptimalControlProblem,
    previous: Solution,
    decisions: int,
    *,
    tolerance: float,
    max_iterations: int,
    deadline: float,
) -> Solution:
    """Replan from the plan made ``decisions`` ago: a controller's tick.

    It is a search of at most ``max_iterations`` from the plan before, shifted with the horizon, with its margins. Where
    controls are linear, constraints of states hold at the middles of the steps, too. The gains are those of the last
    step. No iteration begins that would end after ``deadline`` (of ``time.perf_counter``) if it took as long as the
    longest before. The finished plan is not checked.
    """
    search = Search(problem, tick=True)
    search.begin(shifted_commands(problem, previous, decisions))
    if previous.search is not None:
        search.weight = previous.search.weight
    if previous.multipliers is not None and problem.constraints:
        search.take(_margins(problem, previous, previous.multipliers))
    try:
        status = search.run(tolerance, max_iterations, deadline, lambda *_: None)
    except KeyboardInterrupt:
        status, search.reason = Status.INTERRUPTED, f"in iteration {len(search.history)}"
    return _judged(search.solution(status), previous)


def _judged(plan: Solution, before: Solution) -> Solution:
    """The plan of a tick, INFEASIBLE where it violates a constraint clearly and no less than the plan before."""
    if plan.status in (Status.INTERRUPTED, Status.INFEASIBLE) or not plan.constraints:
        return plan
    told = max(
        zip(plan.constraints, plan.problem.bound_constraints, strict=True),
        key=lambda pair: pair[0].violation / pair[1].scale,
    )
    report, bound = told
    if report.violation <= max(REPORTED * bound.scale, _LOWERED * before.violation):
        return plan
    reason = f"{report.label} is violated by {report.violation:.3g} {report.unit}, {report.where}, no less than before"
    return replace(plan, status=Status.INFEASIBLE, reason=reason)


def _margins(problem: OptimalControlProblem, previous: Solution, known: Multipliers) -> Multipliers:
    """The rows of a tick, with the margins of the plan before."""
    instants = middles(problem)
    some = len(instants.rows) > 0
    bound = problem.bound_constraints
    backoff = [
        _at_places(old, new, part)
        for old, new, part in zip(
            previous.problem.bound_constraints, bound, at_nodes(previous.problem, known, known.backoff), strict=True
        )
    ]
    # Between nodes as at the end of the step.
    backoff += [backoff[i][instants.of(i)[:, 0]] for i in instants.constraints]
    sizes = [item.size for item in enforced(problem, instants).bound_constraints]
    return Multipliers(
        values=np.zeros(sum(sizes)),
        backoff=flat(backoff),
        instants=instants.rows if some else None,
        moments=instants.moments if some else None,
        cubic=instants.cubic,
    )


def _at_places(old: BoundConstraint, new: BoundConstraint, values: Floats) -> Floats:
    """Values (K, rows) at a constraint's places on another horizon; the last is repeated, a goal's stays."""
    rows = np.minimum(np.searchsorted(old.places, new.places), len(old.places) - 1)
    return values[rows]


@dataclass(frozen=True, eq=False)
class Kept(Frozen):
    """How well a controller and its plant satisfied a constraint.

    Attributes:
        label: The constraint.
        unit: Unit of its values.
        tolerance: Violation above which there is a warning: a thousandth of its range.
        planned: Largest violation in the plan that acts in each tick (K,), margin included.
        moved: Violation by the plant's motion at each of its nodes after the first (T,), without the margin; empty for
            goals, which apply to the end of each plan.
        t: Times of these nodes (T,) [s].
        infeasible: Ticks whose plan is INFEASIBLE and violates this constraint (K,).
        older: Ticks in which the plan of an earlier one acts on, whose violation is that of its own horizon (K,).
    """

    label: str
    unit: str
    tolerance: float
    planned: Floats
    moved: Floats
    t: Floats
    infeasible: NDArray[np.bool_]
    older: NDArray[np.bool_]

    @property
    def worst(self) -> float:
        """Largest violation by the plant's motion; 0 for goals."""
        return float(self.moved.max(initial=0.0))

    def __str__(self) -> str:
        plans = int((self.planned > self.tolerance).sum())
        most = self.planned.max()
        text = f"not violated in the plans of {len(self.planned)} ticks"
        if most > 0.0:
            text = f"violated by {most:.1e} {self.unit} at most in plans, in {plans} of {len(self.planned)} ticks by "
            text += f"more than {self.tolerance:.1g} {self.unit}"
        if self.older.any():
            text += f" (in {int(self.older.sum())} ticks an older plan acts on, as it was made)"
        if self.moved.size:
            where = f" at t = {self.t[int(np.argmax(self.moved))]:.4g} s" if self.worst > self.tolerance else ""
            text += f"; by {self.worst:.1e} {self.unit} at most in the plant's motion{where}"
        return f"{self.label}: {text}"

    __repr__ = __str__


def kept(
    problem: OptimalControlProblem, plans: tuple[Solution, ...], motion: Trajectory, substeps: int
) -> tuple[Kept, ...]:
    """Violations of each constraint by the plans of a run and by the plant's motion in ``substeps`` per tick."""
    if not problem.constraints:
        return ()
    # A plant's motion has the means of lines over its steps.
    hold = 1 if problem.linear else substeps
    fine = problem.constraints_on(motion.dt, motion.steps, hold, linear=False)
    infeasible = np.array([plan.status is Status.INFEASIBLE for plan in plans])
    older = np.array([False, *(plan is before for before, plan in pairwise(plans))])
    found = []
    for i, bound in enumerate(fine):
        planned = np.array([plan.constraints[i].violation for plan in plans])
        violated, t = np.zeros(0), np.zeros(0)
        if not bound.source.equality:
            c = bound.value(motion.q, motion.v, motion.u)
            violated, t = np.maximum(c, 0.0).max(axis=1), bound.times
        tolerance = REPORTED * bound.scale
        failed = infeasible & (planned > tolerance)
        found.append(Kept(bound.source.label, bound.unit, tolerance, planned, violated, t, failed, older))
    return tuple(found)
