"""Plans to a wished true cost: the step is halved, each time from the plan before, until the loss is small."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from varpin.control.history import Refined, Refinement, Status, part
from varpin.control.multipliers import FEASIBLE, REPORTED
from varpin.control.problem import OptimalControlProblem
from varpin.control.solution import Solution
from varpin.control.verification import Verification, excess, verify
from varpin.errors import VarpinError
from varpin.trajectory import Trajectory

logger = logging.getLogger(__name__)

# Tolerance of the searches, accuracy of true costs and change of the cost that does not count, relative to the wish.
SUFFICIENT, _KNOWN = 0.01, 0.1
# A loss is far above a wish from this multiple of it on: no accurate cost is needed.
_FAR = 2.0
# Least number of parts of a step in which constraints are looked at: motions are seen at the ends of parts only.
_LOOKS = 8
# Greatest number of halvings of the step.
_HALVINGS = 10
# Greatest violation of a constraint on the continuous system, relative to its range.
_HOLDS = 0.1 * REPORTED
# Halvings without a better plan before the refinement ends: on steps that do not resolve dampers losses rise at first.
# From 4 to 6. A search that has ended otherwise than with its last iteration gets one of them.
_PATIENCE = 4
# Share of what half the step gains that further halvings gain together: 1/3 of smooth motions on fine grids, 2/3 on
# coarse ones and 1 of controls that reach their limits.
_FURTHER = 2.0 / 3.0

Search = Callable[[OptimalControlProblem, Trajectory | None], Solution]


class _Best(NamedTuple):
    """The best plan so far, its step, and what it violates on the continuous system."""

    rank: tuple[int, float]
    solution: Solution
    chosen: int
    beyond: str


def refine(problem: OptimalControlProblem, search: Search, wish: float, time_left: Callable[[], float]) -> Solution:
    """Plan with the problem's step, then halve it, each time from the plan before, until the loss is small.

    A plan whose loss is within the wish, and that keeps to the constraints on the continuous system, is compared with
    the plan of half the step, which is the next one where that is cheaper by more than the wish. A ``search`` makes a
    plan from a motion; interrupted, it returns one with status INTERRUPTED.
    """
    tried: list[Refined] = []
    best: _Best | None = None
    finer: Solution | None = None
    start: Trajectory | None = None
    while True:
        began, doing = time.perf_counter(), f"with dt = {problem.dt:g} s"
        try:
            solution = finer or search(problem, start)
            if solution.status is Status.INTERRUPTED:
                best = best or _Best((9, 0.0), solution, 0, "")
                raise KeyboardInterrupt
            found = verify(
                problem,
                solution.trajectory,
                solution.cost,
                solution.policy_on,
                tolerance=_KNOWN * wish,
                above=solution.cost + _FAR * wish * abs(solution.cost),
                substeps=_LOOKS if problem.constraints else 2,
            )
            row = Refined(
                dt=problem.dt,
                steps=problem.steps,
                cost=solution.cost,
                true_cost=found.closed_loop_cost,
                open_loop_cost=found.open_loop_cost,
                loss=found.closed_loop_loss if found.told else np.nan,
                iterations=solution.iterations,
                status=solution.status,
                seconds=time.perf_counter() - began,
                violation=float(np.max([own.share for own in found.constraints], initial=0.0)),
            )
            tried.append(row)
            kind, value = _failing(row, solution, wish)
            rank = kind, value if kind else row.true_cost
            if best is None or rank < best.rank:
                best = _Best(rank, solution, len(tried) - 1, _beyond(found) if kind >= 2 else "")
            finer, ended = None, _ended(tried, best.chosen, solution, time_left())
            doing = f"with half of dt = {problem.dt:g} s"
            half, fails = _halved(problem)
            if kind == 0 and time_left() > 0.0:
                if half is not None:
                    finer = search(half, _motion_of(solution, half))
                    if finer.status is Status.INTERRUPTED:
                        raise KeyboardInterrupt
                    above = _above(tried, solution, finer)
                    tried[-1] = replace(row, excess=above, seconds=time.perf_counter() - began)
                if half is None or tried[-1].excess <= wish:
                    return _recorded(solution, wish, tried, len(tried) - 1, "", met=True)
            if ended or half is None:
                return _given_up(best, wish, tried, ended or fails)
            start, problem = _motion_of(solution, half) if finer is None else None, half
        except VarpinError as error:
            if best is None:
                raise
            return _given_up(best, wish, tried, f"{doing} there is no plan: {error}")
        except KeyboardInterrupt:
            if best is None:
                raise
            interrupted = replace(best.solution, status=Status.INTERRUPTED, reason=f"interrupted {doing}")
            return _given_up(best._replace(solution=interrupted), wish, tried, interrupted.reason)


def _beyond(found: Verification) -> str:
    """The constraint that is violated most, by how much and where, in words; empty where all hold."""
    worst = max(found.constraints, key=lambda own: own.share, default=None)
    if worst is None or not worst.where:
        return ""
    return f"{worst.label} is violated by {worst.closed_loop:.2g} {worst.unit} ({worst.where})"


def _motion_of(coarse: Solution, problem: OptimalControlProblem) -> Trajectory:
    """The motion of a plan in half its steps."""
    return problem.simulate(coarse.policy_on(substeps=2))


def _halved(problem: OptimalControlProblem) -> tuple[OptimalControlProblem | None, str]:
    """The problem with half the step, held controls with their period; or why there is none."""
    hold = problem.hold if problem.hold == 1 else 2 * problem.hold
    try:
        return problem.at(dt=0.5 * problem.dt, steps=2 * problem.steps, hold=hold), ""
    except VarpinError as error:
        return None, f"with half of dt = {problem.dt:g} s there is no plan: {error}"


def _failing(row: Refined, solution: Solution, wish: float) -> tuple[int, float]:
    """What a plan lacks, and how much of it.

    Constraints (3), constraints on the continuous system (2), a known loss within the wish or convergence (1), or
    nothing (0).
    """
    if solution.violation > FEASIBLE:
        return 3, solution.violation
    if not row.violation <= _HOLDS:
        return 2, row.violation if np.isfinite(row.violation) else np.inf
    if not abs(row.loss) <= wish or not solution.status.converged:
        return 1, abs(row.loss) if np.isfinite(row.loss) else np.inf
    return 0, np.inf


def _ended(tried: list[Refined], chosen: int, solution: Solution, left: float) -> str:
    """Why the step may not be halved, with the best plan so far ``chosen``; empty if it may."""
    row, without = tried[-1], len(tried) - 1 - chosen
    if left <= 0.0:
        return f"the time limit came after dt = {row.dt:g} s"
    if len(tried) > _HALVINGS:
        return f"the step has been halved {_HALVINGS} times"
    if without < (_PATIENCE if row.status in (Status.CONVERGED, Status.MAX_ITERATIONS) else 1):
        return ""
    if row.status is Status.INFEASIBLE:
        return f"with dt = {row.dt:g} s there is no plan within the constraints: {solution.reason}"
    return f"{without} halvings of the step have brought no better plan, the last search {row.status.name}"


def _above(tried: list[Refined], solution: Solution, finer: Solution) -> float:
    """Excess of the last row over the optimum of finer controls by a plan with half the step; infinite if unknown.

    A search that has not converged only tells something where it found a cheaper plan within the constraints.
    """
    if finer.violation > FEASIBLE or (not finer.status.converged and finer.cost >= solution.cost):
        return np.inf
    optimum = finer.cost
    if not finer.status.converged and finer.history:
        optimum -= max(finer.history[-1].expected_decrease, 0.0)
    gained = tried[-1].cost - optimum
    # Where the cost has fallen to a fraction, that says nothing about further falls.
    further = _FURTHER * max(gained, 0.0) if gained < abs(optimum) else 0.0
    return _over_known(tried, excess(tried[-1].true_cost, optimum - further))


def _over_known(tried: list[Refined], above: float) -> float:
    """The excess of the last row, at least that over the true costs of other steps that keep to the constraints."""
    others = [row.true_cost for row in tried if row.violation <= _HOLDS and np.isfinite(row.loss)]
    return max([above, *(excess(tried[-1].true_cost, other) for other in others)])


def _given_up(best: _Best, wish: float, tried: list[Refined], ended: str) -> Solution:
    """The best plan of a refinement that has not met the wish."""
    reason = f"true_cost = {wish:g} is not met: {ended}"
    if tried:
        row = tried[best.chosen]
        lost = f"the best plan loses {part(row.loss)}" if np.isfinite(row.loss) else "no plan's true cost is known"
        reason += f"; {lost} at dt = {row.dt:g} s"
        if best.beyond:
            reason += f", and on the continuous system {best.beyond}"
        if wish < row.excess < np.inf:
            reason += f", and costs about {part(row.excess)} more than the optimum of finer controls"
    return _recorded(best.solution, wish, tried, best.chosen, reason)


def _recorded(
    solution: Solution, wish: float, tried: list[Refined], chosen: int, reason: str, *, met: bool = False
) -> Solution:
    """The solution with the record of its refinement."""
    if met:
        row, compared = tried[chosen], "not compared with finer controls"
        if np.isfinite(row.excess):
            above = f"about {part(row.excess)} above the optimum of finer controls"
            compared = above if row.excess > 0.0 else "half the step is not cheaper"
        reason = f"dt = {row.dt:g} s loses {part(row.loss)}, within {part(wish)[1:]}; {compared}"
    logger.log(logging.INFO if met else logging.WARNING, "%s: %s", solution.problem.scene.robot.name, reason)
    return replace(solution, refinement=Refinement(wish, met, tuple(tried), chosen, reason))
