"""The plan of the coarsest step whose cost agrees with the cost on the continuous system."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from varpin.control.history import Status
from varpin.control.problem import OptimalControlProblem
from varpin.control.solution import Solution
from varpin.control.steps_tried import (
    FALLS,
    KNOWN,
    PATIENCE,
    StepsTried,
    excess_over,
    halved,
    is_within,
    on_robot,
    recorded,
    row_of,
    start_of,
)
from varpin.control.verification import OnRobot, excess
from varpin.errors import VarpinError
from varpin.signals.policy import LinearPolicy

Search = Callable[[OptimalControlProblem, LinearPolicy | Solution | None], Solution]

# Tolerance of the searches, relative to the allowed loss.
SUFFICIENT = 0.01
# Decrease in a few iterations, relative to the allowed loss and the cost at stake, at which searches end early for slow
# progress. They are finished where half the step does not lower the cost by more than the wish.
SLOW = 0.3
# Iterations of a comparison with half the step.
COMPARISON = 3
# Greatest number of halvings of the step.
_HALVINGS = 10


def refine(
    problem: OptimalControlProblem,
    search: Search,
    wish: float,
    time_left: Callable[[], float],
    compare: Search,
    finish: Search,
) -> Solution:
    """Plan with the problem's step, then halve the step, each time from the plan before, until the loss is small.

    Args:
        problem: The problem with the coarsest step.
        search: Makes a plan from first controls, or continues one; interrupted, it returns one with status INTERRUPTED.
        wish: Greatest allowed :attr:`Verification.closed_loop_loss`, and excess over the optimum.
        time_left: Returns the time left [s].
        compare: A search of :data:`COMPARISON` iterations: half the step must not lower the cost by more than the wish.
        finish: Continues a plan of ``search`` that ended early to the end.
    """
    return _Refining(search, wish, time_left, compare, finish).run(problem)


class _Refining(StepsTried):
    """A refinement without constraints."""

    def __init__(
        self, search: Search, wish: float, time_left: Callable[[], float], compare: Search, finish: Search
    ) -> None:
        super().__init__(wish, time_left, _HALVINGS)
        self.search, self.compare, self.finish = search, compare, finish
        self.unconverged = 0  # searches in a row that have not converged, though their losses are within the wish

    def run(self, problem: OptimalControlProblem) -> Solution:
        start: LinearPolicy | Solution | None = None
        while True:
            began = time.perf_counter()
            # A comparison that has converged is the plan of its step.
            known = start if isinstance(start, Solution) and start.status.converged else None
            try:
                solution, costs = self._attempt(self.search, problem, start, known)
            except VarpinError as error:
                if self.best is None:
                    raise
                return self._finished(f"with dt = {problem.dt:g} s there is no plan: {error}")
            if solution is None or costs is None:
                return self.interrupted(solution, f"interrupted with dt = {problem.dt:g} s")
            self.tried.append(row_of(solution, costs, time.perf_counter() - began))
            finer, compared, waits = None, False, False
            if is_within(self.tried[-1], self.wish) and self.may_go_on():
                above = self._foreseen()
                finer = None if np.isfinite(above) else _in_half(problem, solution, self.compare)
                compared, waits = True, solution.status is Status.MAX_ITERATIONS
                if waits and self._promises(solution, finer):
                    waits, before = False, solution.cost
                    made, costs = self._attempt(self.finish, problem, solution)
                    if made is None or costs is None:
                        return self.interrupted(made or solution, f"interrupted with dt = {problem.dt:g} s")
                    solution, self.tried[-1] = made, row_of(made, costs, 0.0)
                    if before - solution.cost > KNOWN * self.wish * abs(solution.cost):
                        finer = _in_half(problem, solution, self.compare)
                if finer is not None and finer.status is Status.INTERRUPTED:
                    ended = f"interrupted while dt = {problem.dt:g} s was compared with half of it"
                    left = replace(solution, status=Status.INTERRUPTED, reason=ended)
                    return recorded(left, self.wish, self.tried, len(self.tried) - 1, ended)
                above = above if finer is None else excess_over(self.tried, finer)
                self.tried[-1] = replace(self.tried[-1], excess=above, seconds=time.perf_counter() - began)
            row = self.tried[-1]
            within = is_within(row, self.wish)
            meets = within and solution.status.converged
            if self.best is None or meets or not abs(row.loss) >= abs(self.tried[self.chosen].loss):
                self.best, self.chosen = solution, len(self.tried) - 1
            if meets and compared and (finer is None or row.excess <= self.wish):
                return self.met(solution, self.chosen)
            self.unconverged = self.unconverged + 1 if within and not (solution.status.converged or waits) else 0
            ended = self._ended(problem, solution)
            if ended:
                return self._finished(ended)
            if finer is not None:
                problem, start = finer.problem, finer
                continue
            try:
                problem = halved(problem)
                start = start_of(problem, solution)
            except VarpinError as error:
                return self._finished(f"half the step cannot be taken: {error}")

    def _attempt(
        self,
        search: Search,
        problem: OptimalControlProblem,
        start: LinearPolicy | Solution | None,
        known: Solution | None = None,
    ) -> tuple[Solution | None, OnRobot | None]:
        """A plan and its true costs; None for what an interrupt prevented."""
        solution = known
        try:
            if solution is None:
                solution = search(problem, start)
            if solution.status is Status.INTERRUPTED:
                return solution, None
            return solution, on_robot(solution, self.wish)
        except KeyboardInterrupt:
            return solution, None

    def _foreseen(self) -> float:
        """Excess of the last row, where the halving before has lowered the cost by little; else infinite."""
        gained, last = self.barely_changed(), self.tried[-1]
        if gained is None or gained < 0.0:
            return np.inf
        return excess(last.true_cost, last.cost - gained * FALLS[0] / (1.0 - FALLS[0]))

    def _promises(self, solution: Solution, finer: Solution | None) -> bool:
        """Whether a plan whose search ended early is to be finished, as it may then be within the wish."""
        if finer is None or finer.status is Status.INTERRUPTED:
            return finer is None
        costs = [*(row.cost for row in self.tried[-2:]), finer.cost]
        if len(costs) > 2 and max(costs[0] - costs[1], costs[1] - costs[2]) <= self.wish * abs(costs[1]):
            # Twice, half the step has hardly lowered the cost, whatever the model expects of it.
            return True
        rest = max(solution.history[-1].expected_decrease, 0.0) if solution.history else 0.0
        return excess_over(self.tried, finer, rest) <= self.wish

    def _finished(self, ended: str) -> Solution:
        """The best plan, its search finished."""
        assert self.best is not None
        if self.best.status is Status.MAX_ITERATIONS:
            began, row = time.perf_counter(), self.tried[self.chosen]
            made, costs = self._attempt(self.finish, self.best.problem, self.best)
            if made is None or costs is None:
                return self.interrupted(None, f"interrupted with dt = {row.dt:g} s")
            seconds = row.seconds + time.perf_counter() - began
            self.tried[self.chosen] = replace(row_of(made, costs, seconds), excess=row.excess)
            self.best = made
        return self.given_up(ended)

    def _ended(self, problem: OptimalControlProblem, solution: Solution) -> str:
        """Why the refinement ends here; empty if it continues."""
        row, spent = self.tried[-1], self.spent(problem)
        if spent:
            return spent
        if self.without_gain(problem, self.chosen):
            return f"the last {PATIENCE} halvings of the step have not lowered the loss"
        coarse = self.wish < row.excess < np.inf
        stuck = solution.status in (Status.STALLED, Status.INDEFINITE, Status.NOT_DIFFERENTIABLE)
        if is_within(row, self.wish) and stuck and not coarse:
            return f"the loss is within the wish, but the search ended {solution.status.name}"
        if self.unconverged >= PATIENCE:
            return f"losses are within the wish for {PATIENCE} steps, but the searches ended {solution.status.name}"
        return ""


def _in_half(problem: OptimalControlProblem, solution: Solution, compare: Search) -> Solution | None:
    """The beginning of a search with half the step from a plan; None where there is none. It may be interrupted."""
    try:
        finer = halved(problem)
        return compare(finer, start_of(finer, solution))
    except VarpinError:
        return None
    except KeyboardInterrupt:
        return replace(solution, status=Status.INTERRUPTED)
