"""Replanning with hard constraints: multipliers are kept from tick to tick, with few rounds in each.

The multipliers are safeguarded after Andreani, Birgin, Martinez and Schuverdt, "On augmented Lagrangian methods with
general lower-level constraints" (2007).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.control import unconstrained
from varpin.control.between_nodes import Instants, carried, enforced, middles
from varpin.control.constraints import BoundConstraint
from varpin.control.history import Iteration, Status
from varpin.control.multipliers import FEASIBLE, REPORTED, Multipliers, at_nodes, reports_of
from varpin.control.penalties import T, flat, penalized, split, weights_for
from varpin.control.problem import OptimalControlProblem
from varpin.control.solution import Solution
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

# A penalty's weight grows by _GROWTH after a tick that leaves more than _ENOUGH of its constraint's violation, up to
# _HEAVIEST times its first weight: stiffer penalties take more iterations than a tick has.
_GROWTH, _ENOUGH, _HEAVIEST = 10.0, 0.5, 100.0
# The share of the time left that passes which look for active rows take at most; the rest is for the linearization and
# trials.
_SHARE = 0.5
# Bound on multipliers, times the first weight and the constraint's scale: those of an infeasible constraint wind up.
_LARGEST = 1e3
# A tick is infeasible when _STUCK ticks in a row have left more than _LOWERED of a violation.
_LOWERED, _STUCK = 0.9, 3
# Least step of an iteration after which multipliers and weights of linear controls are updated.
_LONG = 0.5
# Violation, relative to a tenth of a constraint's range, below which its penalty does not grow.
_SMALL = 1e-3


def replan(
    problem: OptimalControlProblem,
    previous: Solution,
    decisions: int,
    *,
    tolerance: float,
    max_iterations: int,
    deadline: float,
) -> Solution:
    """:func:`varpin.control.unconstrained.replan` for problems with or without constraints.

    With constraints each iteration is one of the augmented Lagrangian, followed by an update of the multipliers. They
    start from those of the previous plan, shifted with the horizon, and so do the active rows of the first pass. Where
    controls are linear, constraints of states hold at the middles of the steps, too, and multipliers and weights stay
    after short steps. Margins are those of the first plan. A tick is INFEASIBLE where it violates a constraint by more
    than a thousandth of its range and several ticks in a row have not lowered the violation.
    """
    known = previous.multipliers
    if not problem.constraints or known is None:
        return unconstrained.replan(
            problem,
            previous,
            decisions,
            tolerance=tolerance,
            max_iterations=max_iterations,
            deadline=deadline,
        )[0]
    instants = middles(problem)
    hold, known = problem.hold, _at(previous.problem, known, instants)
    whole = enforced(problem, instants)
    old, new = enforced(previous.problem, instants).bound_constraints, whole.bound_constraints
    multipliers = [
        _shifted_to(*parts, decisions, hold) for parts in zip(old, new, split(old, known.values), strict=True)
    ]
    backoff = [_shifted_to(*parts, 0, hold) for parts in zip(old, new, split(old, known.backoff), strict=True)]
    first_weights = np.maximum(known.first_weights, weights_for(abs(previous.cost), new))
    weights = np.clip(known.weights, first_weights, _HEAVIEST * first_weights)
    rows = None
    if known.active is not None:
        rows = flat(
            [_shifted_to(*parts, decisions, hold) for parts in zip(old, new, split(old, known.active), strict=True)]
        )
    begun = flat(multipliers)
    found = kept = previous
    history: list[Iteration] = []
    longest = 0.0
    for k in range(max_iterations):
        started = time.perf_counter()
        until = started + _SHARE * (deadline - started)
        goal = penalized(whole, multipliers, weights, backoff, until=until)
        found, rows = unconstrained.replan(
            goal,
            found,
            decisions if k == 0 else 0,
            tolerance=tolerance,
            max_iterations=1,
            deadline=deadline,
            rows=rows,
        )
        history += [replace(item, index=len(history)) for item in found.history]
        motion = found.trajectory
        u = problem.control_rows(motion)
        c = [item.value(motion.q, motion.v, u) for item in new]
        most = [_LARGEST * w * item.scale for item, w in zip(new, first_weights, strict=True)]
        if _is_close(problem, found):
            multipliers = [
                np.clip(part.updated(values), -limit, limit)
                for part, values, limit in zip(goal.all_penalties, c, most, strict=True)
            ]
        state = replace(
            known,
            values=flat(multipliers),
            backoff=flat(backoff),
            begun=begun,
            weights=weights,
            first_weights=first_weights,
            iterations=0,
            active=rows,
        )
        kept = replace(
            found, problem=problem, cost=problem.cost_of(motion), history=tuple(history), search=None, multipliers=state
        )
        done = found.status is Status.CONVERGED and kept.violation <= FEASIBLE
        longest = max(longest, time.perf_counter() - started)
        if done or found.status is Status.INTERRUPTED or time.perf_counter() > deadline - longest:
            break
    return _judged(kept, known)


def _is_close(problem: OptimalControlProblem, found: Solution) -> bool:
    """Whether an iteration has ended close enough to the minimum of its penalties to update multipliers and weights.

    After short steps violations are large, and multipliers would wind up by heavy weights times these. Held controls,
    which respond at once, do as well without this.
    """
    if not problem.linear or found.status is Status.CONVERGED:
        return True
    return bool(found.history) and found.history[-1].step >= _LONG


def _at(problem: OptimalControlProblem, known: Multipliers, instants: Instants) -> Multipliers:
    """Multipliers of the rows at nodes and at ``instants``; those of the latter go on where ``known`` has them."""
    before, count = known.between, len(problem.bound_constraints)
    if before.cubic == instants.cubic and np.array_equal(before.rows, instants.rows):
        return known
    bound, source = enforced(problem, before).bound_constraints, instants.constraints
    backoff = at_nodes(problem, known, known.backoff)

    def kept(values: Floats) -> Floats:
        return flat(carried(problem, before, instants, split(bound, values)))

    def of_constraints(values: Floats) -> Floats:
        return np.concatenate([values[:count], values[source]])

    some = len(instants.rows) > 0
    return replace(
        known,
        values=kept(known.values),
        # As at the end of the step.
        backoff=flat([*backoff, *(backoff[i][instants.of(i)[:, 0]] for i in source)]),
        begun=kept(known.begun),
        # Only ticks have them, all at the same instants.
        active=None,
        weights=of_constraints(known.weights),
        first_weights=of_constraints(known.first_weights),
        worst=of_constraints(known.worst),
        instants=instants.rows if some else None,
        moments=instants.moments if some else None,
        bends=instants.bends if some else None,
        begun_moments=None,
        begun_bends=None,
        cubic=instants.cubic,
    )


def _shifted_to(
    old: BoundConstraint, new: BoundConstraint, values: NDArray[T], decisions: int, hold: int
) -> NDArray[T]:
    """Values at a constraint's places (K, rows), shifted by ``decisions``; the last is repeated, a goal's stays."""
    by = decisions if new.of_controls else decisions * hold
    rows = np.minimum(np.searchsorted(old.places, new.places + by), len(old.places) - 1)
    return values[rows]


def _judged(plan: Solution, before: Multipliers) -> Solution:
    """The plan of a tick with the penalty weights of the next one; INFEASIBLE where violations persist."""
    known = plan.multipliers
    assert known is not None
    whole = enforced(plan.problem, known.between)
    bound = whole.bound_constraints
    found = reports_of(whole, plan.trajectory, split(bound, known.values), split(bound, known.backoff))
    violation = np.array([item.violation for item in found])
    scale = np.array([item.scale for item in bound])
    close = _is_close(plan.problem, plan)
    stays = violation > np.maximum(REPORTED * scale, _LOWERED * before.worst)
    heavier = close & (violation > np.maximum(_SMALL * scale, _ENOUGH * before.worst))
    weights = np.where(heavier, np.minimum(_GROWTH * known.weights, _HEAVIEST * known.first_weights), known.weights)
    stuck = before.stuck + 1 if stays.any() else 0
    plan = replace(plan, multipliers=replace(known, weights=weights, worst=violation, stuck=stuck))
    if stuck < _STUCK or plan.status is Status.INTERRUPTED:
        return plan
    worst = found[int(np.argmax(np.where(stays, violation / scale, -np.inf)))]
    reason = (
        f"{worst.label} is violated by {worst.violation:.3g} {worst.unit}, {worst.where}, and {stuck} ticks in a row "
        "have not lowered that"
    )
    return replace(plan, status=Status.INFEASIBLE, reason=reason)


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
