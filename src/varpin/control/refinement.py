"""The plan of the coarsest step whose cost agrees with the cost on the continuous system."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from varpin.control.history import Status
from varpin.control.multipliers import FEASIBLE, REPORTED
from varpin.control.problem import OptimalControlProblem
from varpin.control.refined import Refined
from varpin.control.solution import Solution
from varpin.control.steps_tried import (
    PATIENCE,
    StepsTried,
    excess_over,
    halved,
    is_within,
    on_robot,
    row_of,
    start_of,
)
from varpin.control.verification import excess
from varpin.errors import VarpinError
from varpin.signals.policy import LinearPolicy

# Tolerance of the searches, relative to the allowed loss.
SUFFICIENT = 0.01
# Greatest number of halvings of the step: plans within many bounds take long on fine grids.
_HALVINGS = 7
# Greatest violation of a constraint on the continuous system, relative to its range.
_HOLDS = 0.1 * REPORTED
# Number of steps in a row without a plan within the constraints, or with one that has stalled, that end the refinement.
_WITHOUT = 2
# Factor by which the violation, the loss or the excess has to fall in PATIENCE halvings.
_LOWER = 0.9


Search = Callable[[OptimalControlProblem, LinearPolicy | None], Solution]


def refine(problem: OptimalControlProblem, search: Search, wish: float, time_left: Callable[[], float]) -> Solution:
    """Plan with the problem's step, then halve it, each time from the plan before, until the loss is small.

    A plan whose loss is within the wish, and that keeps to the constraints on the continuous system, is compared with
    the plan of half the step, which is the next one where that is cheaper by more than the wish.

    Args:
        problem: The problem with the coarsest step.
        search: Makes a plan; interrupted, it returns one with status INTERRUPTED.
        wish: Greatest allowed :attr:`Verification.closed_loop_loss`, and excess over the optimum.
        time_left: Returns the time left [s].
    """
    return _Refining(search, wish, time_left).run(problem)


class _Refining(StepsTried):
    """A refinement."""

    def __init__(self, search: Search, wish: float, time_left: Callable[[], float]) -> None:
        super().__init__(wish, time_left, _HALVINGS)
        self.search = search
        self.rank: tuple[float, ...] = ()
        self.without = 0  # steps in a row without a converged plan, whose loss is within the wish, in the constraints
        self.least: tuple[int, float] = (9, np.inf)  # the best of what has to fall, and the step that had it
        self.since = 0

    def run(self, problem: OptimalControlProblem) -> Solution:
        known: Solution | None = None
        start: LinearPolicy | None = None
        while True:
            solution, finer, began = known, None, time.perf_counter()
            doing = f"with dt = {problem.dt:g} s"
            try:
                if solution is None:
                    solution = self.search(problem, start)
                if solution.status is Status.INTERRUPTED:
                    return self.interrupted(solution, f"interrupted {doing}")
                told = on_robot(solution, self.wish)
                self.tried.append(row_of(solution, told, time.perf_counter() - began))
                row = self.tried[-1]
                self._keep_better(row, solution, told.where)
                ready = _meets(row, solution, self.wish)
                doing = f"with half of dt = {problem.dt:g} s"
                if ready and self.may_go_on():
                    above = self._foreseen()
                    if not np.isfinite(above):
                        finer = self._in_half(problem, solution)
                        if finer is not None and finer.status is Status.INTERRUPTED:
                            raise KeyboardInterrupt
                        above = self._above(solution, finer)
                    row = replace(row, excess=above, seconds=time.perf_counter() - began)
                    self.tried[-1] = row
                    if above <= self.wish or (finer is None and not np.isfinite(above)):
                        return self.met(solution, len(self.tried) - 1)
                ended = self._ended(problem, solution)
                if ended:
                    return self.given_up(ended)
                if finer is not None:
                    problem, known = finer.problem, finer
                    continue
                problem, known = halved(problem), None
                start = start_of(problem, solution)
            except VarpinError as error:
                if self.best is None:
                    raise
                return self.given_up(f"{doing} there is no plan: {error}")
            except KeyboardInterrupt:
                return self.interrupted(solution, f"interrupted {doing}")

    def _in_half(self, problem: OptimalControlProblem, solution: Solution) -> Solution | None:
        """The plan with half the step; None where the problem is not defined there."""
        try:
            finer = halved(problem)
        except VarpinError:
            return None
        return self.search(finer, start_of(finer, solution))

    def _foreseen(self) -> float:
        """Excess of the last row, where the halving before has hardly changed the cost; else infinite."""
        gained, last = self.barely_changed(), self.tried[-1]
        if gained is None:
            return np.inf
        return self._over_known(excess(last.true_cost, last.cost - max(gained, 0.0)))

    def _above(self, solution: Solution, finer: Solution | None) -> float:
        """Excess of the last row over the optimum of finer controls by a plan with half the step; infinite if unknown.

        A search that has not converged only tells something where it found a cheaper plan within the constraints.
        """
        if finer is None or finer.violation > FEASIBLE:
            return np.inf
        if not finer.status.converged and finer.cost >= solution.cost:
            return np.inf
        return self._over_known(excess_over(self.tried, finer))

    def _over_known(self, above: float) -> float:
        """The excess of the last row, at least that over the true costs of other steps that keep to the constraints."""
        others = [row.true_cost for row in self.tried if row.violation <= _HOLDS and np.isfinite(row.loss)]
        return max([above, *(excess(self.tried[-1].true_cost, other) for other in others)])

    def _keep_better(self, row: Refined, solution: Solution, beyond: str) -> None:
        """Keep the better plan: within the constraints, on the continuous system, too, then within the wish."""
        if solution.violation > FEASIBLE:
            rank: tuple[float, ...] = (3.0, solution.violation)
        elif not row.violation <= _HOLDS:
            rank = (2.0, float(not is_within(row, self.wish)), row.violation if np.isfinite(row.violation) else np.inf)
        elif _meets(row, solution, self.wish):
            rank = (0.0, row.true_cost)
        else:
            rank = (1.0, abs(row.loss) if np.isfinite(row.loss) else np.inf)
        if self.best is None or rank < self.rank:
            self.best, self.chosen, self.rank = solution, len(self.tried) - 1, rank
            self.beyond = beyond if rank[0] >= 2.0 else ""

    def _ended(self, problem: OptimalControlProblem, solution: Solution) -> str:
        """Why the refinement ends here; empty if it continues."""
        row, at = self.tried[-1], f"dt = {problem.dt:g} s"
        feasible = solution.violation <= FEASIBLE
        fails = not feasible or (is_within(row, self.wish) and not solution.status.converged)
        self.without = self.without + 1 if fails else 0
        spent = self.spent(problem)
        if spent:
            return spent
        if self.without >= (PATIENCE if solution.status is Status.MAX_ITERATIONS else _WITHOUT):
            if solution.status is Status.INFEASIBLE:
                return f"with {at} there is no plan within the constraints, nor with twice that: {solution.reason}"
            return f"for {self.without} steps in a row the searches ended {solution.status.name}"
        kind, value = 3, solution.violation
        if feasible:
            kind, value = 0, row.excess
            if not row.violation <= _HOLDS:
                kind, value = 2, row.violation
            elif not is_within(row, self.wish):
                kind, value = 1, abs(row.loss)
        if kind < self.least[0] or (kind == self.least[0] and value < _LOWER * self.least[1]):
            self.least, self.since = (kind, value), len(self.tried) - 1
        if self.without_gain(problem, self.since):
            what = ("excess over finer controls", "loss", "violation", "violation")[kind]
            return f"the last {PATIENCE} halvings of the step have not lowered the {what}"
        return ""


def _meets(row: Refined, solution: Solution, wish: float) -> bool:
    """Whether a converged plan keeps to the constraints, and its loss is within the wish."""
    keeps = solution.violation <= FEASIBLE and row.violation <= _HOLDS
    return keeps and solution.status.converged and is_within(row, wish)
