"""The minimum of the model along a motion whose penalties become active and inactive: a piecewise quadratic."""

from __future__ import annotations

import time

import numpy as np

from varpin.arrays import Floats, Mask
from varpin.control.active_rows import Rows, same_rows
from varpin.control.along import Along
from varpin.control.box import Box, free_pass, to_minimum, within_limits
from varpin.control.passes import Plan
from varpin.control.penalties import PenalizedProblem

# Greatest number of passes in a row without a line search, and of those with one before the interior-point method. This
# begins only if so many passes are left; its own, two for each of its steps, do not count.
_AT_ONCE, _SEARCHED, _INTERIOR = 8, 4, 40


def minimum(along: Along, regularization: float, curvature: Floats | None, likely: Mask | None) -> Plan | None:
    """The pass with the penalties that are active on the linearized motion.

    A penalty is zero up to its bound and a parabola beyond. A model around the nominal motion has only the rows active
    there, not those that the step activates. So passes are repeated until their active rows are those of their
    linearized motion, which leads to the minimum of the piecewise quadratic model. If they do not converge, the result
    is the best pass or the last point of the steps.

    Args:
        along: Expansions along the motion.
        regularization: Relative to the diagonal of Quu.
        curvature: Further Hessians of the steps.
        likely: Active rows to begin with.
    """
    problem = along.problem
    if (
        not (isinstance(problem, PenalizedProblem) and problem.all_penalties and problem.passes)
        or len(along.blocks) > 1
    ):
        return within_limits(along, regularization, curvature)
    steps = _Steps(along, problem, regularization, curvature)
    steps.run(likely)
    if steps.best is None:
        return within_limits(along, regularization, curvature)
    return steps.best._replace(model=along.model, rows=steps.rows.in_order(steps.met))


class _Steps:
    """Passes that differ in their active rows, and the best of them so far."""

    def __init__(
        self, along: Along, problem: PenalizedProblem, regularization: float, curvature: Floats | None
    ) -> None:
        self.problem, self.regularization, self.curvature = problem, regularization, curvature
        self.rows = Rows(along, problem)
        self.best: Plan | None = None
        self.least = 0.0  # change of the model by the best plan
        self.done = 0  # passes
        self.ended = False  # at the minimum, or as close as it gets
        # Whether limits of controls and rows are found together.
        self.together = True
        # The last pass: its plan, its active rows, the values of all rows on its motion, and those active there.
        self.plan: Plan | None = None
        self.held = self.met = self.rows.begun
        self.ahead: list[Floats] = self.rows.signed
        self.change = self.slope = 0.0
        self.passing = along

    def run(self, likely: Mask | None) -> None:
        """To the minimum: by likely rows, by Newton steps with line search, or by an interior-point method."""
        problem, rows = self.problem, self.rows
        if self.regularization > 0.0:
            found, stiffness = free_pass(rows.along(rows.begun), self.regularization, self.curvature)
            if found is None:
                return
            rows.proximal = self.regularization * np.abs(stiffness)
        if likely is not None and likely.size == rows.weights.size:
            self._settle(rows.from_order(likely))
        self._descend(self.done + _SEARCHED)
        left = problem.passes - self.done
        if not self.ended and self.together and left >= _INTERIOR and self.plan is not None:
            inner = self._box(self.held).active_inside(self.plan)
            if inner is not None:
                self._settle(inner)
        self._descend(problem.passes)

    def _passed(self, held: list[Mask]) -> Plan | None:
        """A pass with active rows; None if the model has no minimum with them."""
        rows, self.done = self.rows, self.done + 1
        self.passing = rows.along(held)
        self.plan, active = to_minimum(self._box(held if self.together else None), 0.0)
        if self.plan is None:
            return None
        self.held = held if active is None else active
        self.ahead = rows.ahead(self.passing, self.plan)
        self.change, self.slope = rows.change(self.plan, self.held, self.ahead)
        if self.slope < 0.0 and self.change < self.least:
            curvature = 2.0 * (self.change - rows.regularizing(rows.ahead_of[1]) - self.slope)
            self.best = self.plan._replace(slope=self.slope, curvature=curvature, limited=True)
            self.least = self.change
        self.met = rows.held(self.ahead)
        self.ended = same_rows(self.met, self.held)
        if not self.ended and active is not None:
            # The minimum to rounding errors, or nothing.
            self.ended, self.together = self.best is not None, False
        return self.plan

    def _box(self, active: list[Mask] | None) -> Box:
        """The model of the last pass, with its ``active`` rows if rows are to be found together with limits."""
        rows = None if active is None else self.rows
        return Box(self.passing, self.curvature, rows, active, until=self.problem.until)

    def _settle(self, held: list[Mask]) -> None:
        """Passes each with the active rows of the motion before, as long as ever fewer of them change."""
        most, together = self.rows.weights.size + 1, self.together
        for _ in range(min(_AT_ONCE, self.problem.passes - self.done)):
            if self._passed(held) is None or self.ended or self.together != together:
                break
            changed = sum(int((now != then).sum()) for now, then in zip(self.met, self.held, strict=True))
            if changed >= most or time.perf_counter() > self.problem.until:
                break
            held, most = self.met, changed
        if self.ended or self.plan is None:
            return
        if self.slope < 0.0 and self.change < self.rows.lowered:
            self.rows.move(self.plan, self.held, self.ahead, self.slope, whole=True)

    def _descend(self, most: int) -> None:
        """Newton steps with exact line search, up to a number of passes altogether."""
        rows, problem, held = self.rows, self.problem, self.rows.held(self.rows.at)
        while not self.ended and self.done < min(most, problem.passes):
            together = self.together
            plan = self._passed(held)
            if plan is None or self.ended:
                self.ended = True
                break
            if self.together != together:
                held = rows.begun
                continue
            rows.move(plan, self.held, self.ahead, self.slope)
            held = self.met = rows.held(rows.at)
            # Not the minimum only by rounding errors, and with the same rows the next pass would be the same.
            still = same_rows(held, self.held)
            if still or self.done == problem.passes or time.perf_counter() > problem.until:
                if rows.slope < 0.0 and rows.lowered < self.least:
                    self.best = rows.there(plan)
                self.ended = True
