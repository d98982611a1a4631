"""Plans to a wished true cost: the step is halved, each time from the plan before, until the loss is small."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from varpin.control.between_nodes import PARTS
from varpin.control.history import Refined, Refinement, Status, percent
from varpin.control.problem import OptimalControlProblem
from varpin.control.sizes import FEASIBLE, SLIGHT, TENTH
from varpin.control.solution import Solution
from varpin.control.verification import excess, verify
from varpin.errors import VarpinError
from varpin.trajectory import Trajectory

logger = logging.getLogger(__name__)

# Greatest number of halvings of the step; from 6 to 20.
_HALVINGS = 10
# Greatest number of parts of a step in which the true cost of a plan is sought; from 256 to 1024.
_FINEST = 1024
# Halvings without a better plan before the refinement ends: on steps that do not resolve dampers losses rise at first.
# From 4 to 6. A search that has ended otherwise than with its last iteration gets one of them.
_WITHOUT = 4
# Share of what half the step gains that further halvings gain together: 1/3 of smooth motions on fine grids, 2/3 on
# coarse ones and 1 of controls that reach their limits.
_FURTHER = 2.0 / 3.0

Search = Callable[[OptimalControlProblem, Trajectory | None], Solution]


def refine(problem: OptimalControlProblem, search: Search, wish: float, time_left: Callable[[], float]) -> Solution:
    """Plan with the problem's step, then halve it, each time from the plan before, until the loss is small.

    A plan whose loss is within the wish, and that keeps to the constraints on the continuous system, is compared with
    the plan of half the step, which is the next one where that is cheaper by more than the wish. A ``search`` makes a
    plan from a motion; interrupted, it returns one with status INTERRUPTED.
    """
    record = _Record(wish, search)
    plan: Solution | None = None
    start: Trajectory | None = None
    while True:
        began, doing = time.perf_counter(), f"with dt = {problem.dt:g} s"
        try:
            plan = plan or record.search(problem, start)
            compares = record.add(plan, began) and time_left() > 0.0
            ended = record.ended(plan.reason) if time_left() > 0.0 else f"the time limit came {doing}"
            if ended and not compares:
                return record.result(record.best, record.chosen, ended)
            doing = f"with half of dt = {problem.dt:g} s"
            try:
                # Held controls keep their period.
                hold = problem.hold if problem.hold == 1 else 2 * problem.hold
                problem = problem.at(dt=0.5 * problem.dt, steps=2 * problem.steps, hold=hold)
            except VarpinError:
                if compares:
                    return record.result(plan, len(record.tried) - 1, "")
                raise
            start = problem.simulate(plan.policy)
            finer = record.search(problem, start) if compares else None
            if finer is not None and record.compare(finer, began):
                return record.result(plan, len(record.tried) - 1, "")
            if ended:
                return record.result(record.best, record.chosen, ended)
            plan = finer
        except VarpinError as error:
            if record.best is None:
                raise
            return record.result(record.best, record.chosen, f"{doing} there is no plan: {error}")
        except KeyboardInterrupt:
            if record.best is None:
                raise
            reason = f"interrupted {doing}"
            best = replace(record.best, status=Status.INTERRUPTED, reason=reason)
            return record.result(best, record.chosen, reason)


class _Record:
    """The steps tried so far, and the best of their plans, ``chosen``."""

    def __init__(self, wish: float, search: Search) -> None:
        self.wish, self._search = wish, search
        self.tried: list[Refined] = []
        self.best: Solution | None = None
        self.rank, self.chosen = (np.inf, np.inf), 0
        self.beyond = ""  # what the best plan violates on the continuous system, in words

    def search(self, problem: OptimalControlProblem, start: Trajectory | None) -> Solution:
        """The plan of a step from a motion; interrupted, it is the best where there is no other."""
        found = self._search(problem, start)
        if found.status is Status.INTERRUPTED:
            self.best = self.best or found
            raise KeyboardInterrupt
        return found

    def add(self, plan: Solution, began: float) -> bool:
        """Take the plan of a step; whether it lacks nothing but the comparison with half of it.

        Plans rank by what they lack, and by how much of it: constraints (3), constraints on the continuous system (2),
        a known loss within the wish or convergence (1), or nothing (0), with their true costs.
        """
        problem = plan.problem
        # Constraints are looked at where parts end.
        first = PARTS if problem.constraints else 2
        found = verify(plan, tolerance=TENTH * self.wish, substeps=first, max_substeps=_FINEST)
        shares = [
            own.violation / (10.0 * bound.scale)
            for own, bound in zip(found.constraints, problem.bound_constraints, strict=True)
        ]
        row = Refined(
            dt=problem.dt,
            steps=problem.steps,
            cost=plan.cost,
            true_cost=found.closed_loop_cost,
            open_loop_cost=found.open_loop_cost,
            loss=found.closed_loop_loss if found.told else np.nan,
            iterations=plan.iterations,
            status=plan.status,
            seconds=time.perf_counter() - began,
            violation=float(np.max(shares, initial=0.0)),
        )
        self.tried.append(row)
        kind, value = 0, row.true_cost
        if plan.violation > FEASIBLE:
            kind, value = 3, plan.violation
        elif not row.violation <= SLIGHT:
            kind, value = 2, row.violation
        elif not abs(row.loss) <= self.wish or not plan.status.converged:
            kind, value = 1, abs(row.loss)
        rank = kind, value if np.isfinite(value) else np.inf
        if rank < self.rank:
            self.best, self.rank, self.chosen = plan, rank, len(self.tried) - 1
            self.beyond = ""
            if kind >= 2 and row.violation > 0.0:
                worst = found.constraints[int(np.argmax(shares))]
                size = f"{worst.violation:.2g} {worst.unit} ({worst.where})"
                self.beyond = f"violates {worst.label} on the continuous system by {size}"
        return kind == 0

    def compare(self, finer: Solution, began: float) -> bool:
        """Compare the last plan with that of half its step; whether finer controls gain no more than the wish.

        A search that has not converged only tells something where it found a cheaper plan within the constraints.
        """
        row, above = self.tried[-1], np.inf
        if finer.violation <= FEASIBLE and (finer.status.converged or finer.cost < row.cost):
            optimum = finer.cost
            if not finer.status.converged and finer.history:
                optimum -= max(finer.history[-1].expected_decrease, 0.0)
            gained = row.cost - optimum
            # Where the cost has fallen to a fraction, that says nothing about further falls.
            further = _FURTHER * max(gained, 0.0) if gained < abs(optimum) else 0.0
            others = [one.true_cost for one in self.tried if one.violation <= SLIGHT and np.isfinite(one.loss)]
            above = excess(row.true_cost, min(optimum - further, *others))
        self.tried[-1] = replace(row, excess=above, seconds=time.perf_counter() - began)
        return above <= self.wish

    def ended(self, reason: str) -> str:
        """Why the step may not be halved after a search that ended for a ``reason``; empty if it may."""
        row, without = self.tried[-1], len(self.tried) - 1 - self.chosen
        if len(self.tried) > _HALVINGS:
            return f"the step has been halved {_HALVINGS} times"
        if without < (_WITHOUT if row.status in (Status.CONVERGED, Status.MAX_ITERATIONS) else 1):
            return ""
        if row.status is Status.INFEASIBLE:
            return f"with dt = {row.dt:g} s there is no plan within the constraints: {reason}"
        return f"{without} halvings of the step have brought no better plan, the last search {row.status.name}"

    def result(self, plan: Solution | None, chosen: int, ended: str) -> Solution:
        """A plan with the record; ``ended`` says why the wish is not met, and is empty where it is."""
        assert plan is not None
        reason = f"true_cost = {self.wish:g} is not met: {ended}; " if ended else ""
        if self.tried:
            row = self.tried[chosen]
            lost = f"loses {percent(row.loss)}" if np.isfinite(row.loss) else "has no known true cost"
            above = f"costs about {percent(row.excess)} more than the optimum of finer controls"
            above = above if np.isfinite(row.excess) else "is not compared with finer controls"
            # A plan that violates constraints is not compared.
            above = self.beyond if ended and self.beyond else above
            reason += f"the plan of dt = {row.dt:g} s {lost} and {above}"
        logger.log(logging.WARNING if ended else logging.INFO, "%s: %s", plan.problem.scene.robot.name, reason)
        return replace(plan, refinement=Refinement(self.wish, not ended, tuple(self.tried), chosen, reason))
