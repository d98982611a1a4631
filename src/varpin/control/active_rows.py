"""The minimum of a motion's model with the penalties that are active on its linearized motion."""

from __future__ import annotations

import time
from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.control.along import Along
from varpin.control.box import within_limits
from varpin.control.passes import Plan
from varpin.control.penalties import PenalizedProblem, PenalizedRate, controls_of_steps, flat, rate_columns

Mask = NDArray[np.bool_]


# Bisections of the line search between two passes.
_BISECTIONS = 40


def foreseeing(along: Along, regularization: float, curvature: Floats | None) -> Plan | None:
    """The pass with the penalties that are active on the linearized motion.

    A penalty is zero up to its bound and a parabola beyond. A model around the nominal motion has only the rows active
    there, not those that the step activates. So passes are repeated until their active rows are those of their
    linearized motion: Newton steps with exact line search to the minimum of the piecewise quadratic model. If these do
    not converge, the result is the best pass or the last point of the steps.
    """
    problem = along.problem
    if not (isinstance(problem, PenalizedProblem) and problem.passes) or len(along.blocks) > 1:
        return within_limits(along, regularization, curvature)
    rows = _Rows(along, problem)
    held, best, least = rows.begun, None, 0.0
    for done in range(1, problem.passes + 1):
        passing = rows.along(held)
        plan = within_limits(passing, regularization, curvature)
        if plan is None:
            break
        ahead = rows.ahead(passing, plan)
        change, slope = rows.change(plan, held, ahead)
        if slope < 0.0 and change < least:
            best, least = replace(plan, slope=slope, curvature=2.0 * (change - slope), limited=True), change
        met = [penalty.held(s) for penalty, s in zip(rows.penalties, ahead, strict=True)]
        if all(np.array_equal(a, b) for a, b in zip(met, held, strict=True)):
            break
        rows.move(plan, held, ahead, slope)
        held = [penalty.held(s) for penalty, s in zip(rows.penalties, rows.at, strict=True)]
        if done == problem.passes or time.perf_counter() > problem.until:
            if rows.slope < 0.0 and rows.lowered < least:
                best = rows.there(plan)
            break
    if best is None:
        return within_limits(along, regularization, curvature)
    return replace(best, model=along.model, factors=None)


class _Rows:
    """The rows of all penalties around a motion; passes along it differ in their active rows."""

    def __init__(self, along: Along, problem: PenalizedProblem) -> None:
        self.whole, self.problem, motion = along, problem, along.trajectory
        # Linearized once, before the expansions are copied for each pass.
        velocity = along.of_lines.velocity if problem.linear else along.linearized(0, problem.steps)[1]
        q, v, u = motion.q, motion.v, problem.control_rows(motion)
        self.of_nodes = problem.penalties
        self.of_rate = tuple(item for item in problem.all_penalties if item.bound.of_controls)
        self.penalties = (*self.of_nodes, *self.of_rate)
        self.unpenalized = problem.expand_cost(motion)
        self.signed = [item.signed(item.bound.value(q, v, u)) for item in self.penalties]
        self.begun = [item.held(s) for item, s in zip(self.penalties, self.signed, strict=True)]
        self.slopes = [item.bound.slopes(q, v, u) for item in self.of_nodes]
        # The present point of the steps to the model's minimum: its rows, and the change of the cost without penalties.
        self.at, self.cost = self.signed, 0.0
        # Changes of controls and states at this point, and the model's slope from its start in that direction.
        self.moves = np.zeros((problem.decisions, u.shape[1]))
        self.states, self.slope = np.zeros((len(q), 2 * q.shape[1])), 0.0
        # d(q, v)/dx at the nodes.
        n = problem.scene.robot.dof
        slopes = np.tile(np.eye(2 * n), (len(q), 1, 1))
        if problem.integrator.variational:
            slopes[:, n:] = velocity
        self.by_state = [found.by_state @ slopes[found.nodes] for found in self.slopes]

    def along(self, held: list[Mask]) -> Along:
        """Expansions for a pass with the active rows ``held``."""
        passing = copy(self.whole)
        for name in ("model", "line"):
            vars(passing).pop(name, None)
        count = len(self.of_nodes)
        passing.running = self.problem.with_held(self.unpenalized, self.signed[:count], self.slopes, held[:count])
        rate = self.problem.rate
        if isinstance(rate, PenalizedRate):
            u = self.problem.decided(self.whole.trajectory)
            passing.pull, passing.rate = rate.expand(u, self.problem.period, held[count:])
        return passing

    def ahead(self, passing: Along, plan: Plan) -> list[Floats]:
        """The penalties' shifted values on the linearized motion under a plan."""
        problem, hold = self.problem, self.problem.hold
        (A, B), x = passing.maps, self.states.shape[1]
        slack = passing.slack
        states, moves = np.zeros((len(A) + 1, A.shape[1])), np.zeros(plan.feedforward.shape)
        for j in range(len(A)):
            k = j // hold
            if j % hold == 0:
                move = plan.feedforward[k] + plan.feedback[k] @ states[j, :x]
                if plan.previous is not None and k > 0:
                    move = move + plan.previous[k] @ moves[k - 1]
                moves[k] = np.clip(move, slack[k, 0], slack[k, 1]) if slack.size else move
            states[j + 1] = A[j] @ states[j] + B[j] @ moves[k]
        # With linear controls the first step is the one that sets the first control.
        states = states[len(A) - problem.steps :, :x]
        self.ahead_of = states, moves
        found = []
        for s, J, rows in zip(self.signed[: len(self.of_nodes)], self.by_state, self.slopes, strict=True):
            after = s + np.einsum("krx,kx->kr", J, states[rows.nodes])
            if rows.by_controls.size:
                after += np.einsum("krc,kc->kr", rows.by_controls, controls_of_steps(problem, moves, rows.nodes))
            found.append(after)
        for item, s in zip(self.of_rate, self.signed[len(self.of_nodes) :], strict=True):
            bound = item.bound
            rate = np.diff(moves, axis=0, prepend=np.zeros_like(moves[:1])) / problem.period
            rate = rate[bound.places][:, rate_columns(item)]
            found.append(s + np.concatenate([rate, -rate], axis=1))
        return found

    def move(self, plan: Plan, held: list[Mask], ahead: list[Floats], along: float) -> None:
        """Exact line search towards ``ahead``, the minimum of the model with active rows ``held``.

        ``along`` is the slope of the model at its start in the direction of ``ahead``.
        """
        at, to = flat(self.at), flat(ahead)
        counts = np.concatenate([rows.ravel() for rows in held])
        weights = np.concatenate(
            [np.full(s.size, item.weight) for item, s in zip(self.penalties, self.at, strict=True)]
        )
        equal = np.concatenate(
            [np.full(s.size, item.equality) for item, s in zip(self.penalties, self.at, strict=True)]
        )
        way, of_held = to - at, np.where(counts, weights, 0.0)
        least = 0.5 * float(of_held @ flat(self.signed) ** 2) - plan.expected_decrease
        gap = self.cost + 0.5 * float(of_held @ at**2) - least
        states, moves = self.ahead_of
        # Within limits the model's slope at its minimum is that of the controls pressed against them.
        last = 0.0 if plan.left is None else min(float((plan.left * (moves - self.moves)).sum()), 0.0)
        curved = max(gap + last, 0.0)

        def slope(t: float) -> float:
            s = at + t * way
            pull = np.where(equal | (s > 0.0), weights, 0.0) - of_held
            return float((pull * s) @ way) + last - 2.0 * (1.0 - t) * curved

        low, high = 0.0, 1.0
        if slope(high) <= 0.0:
            low = high
        for _ in range(_BISECTIONS if low < high else 0):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if slope(middle) <= 0.0 else (low, middle)
        self.at = [a + low * (b - a) for a, b in zip(self.at, ahead, strict=True)]
        rest = 1.0 - low
        self.cost = least - rest * last + rest**2 * curved - 0.5 * float(of_held @ (at + low * way) ** 2)
        self.states, self.moves = self.states + low * (states - self.states), self.moves + low * (moves - self.moves)
        self.slope += low * (along - self.slope)

    @property
    def lowered(self) -> float:
        """Change of the model at the present point of the steps; negative where it is lower."""
        total = self.cost
        for item, s, now, t in zip(self.penalties, self.signed, self.begun, self.at, strict=True):
            total += 0.5 * item.weight * float((t[item.held(t)] ** 2).sum() - (s[now] ** 2).sum())
        return total

    def there(self, plan: Plan) -> Plan:
        """A plan that leads to the present point of the steps, with the feedback of ``plan``."""
        at = self.states[: -1 : self.problem.hold]
        if self.problem.linear:
            # A line is decided at its beginning, and so is the first control.
            at = np.concatenate([self.states[:1], at])
        ahead = self.moves - np.einsum("kmx,kx->km", plan.feedback, at)
        if plan.previous is not None:
            ahead[1:] -= np.einsum("kmi,ki->km", plan.previous[1:], self.moves[:-1])
        curvature = 2.0 * (self.lowered - self.slope)
        return replace(plan, feedforward=ahead, slope=self.slope, curvature=curvature, limited=True)

    def change(self, plan: Plan, held: list[Mask], ahead: list[Floats]) -> tuple[float, float]:
        """Change of the piecewise model over a plan's full step, and its slope at the start."""
        change, slope = -plan.expected_decrease, plan.slope
        for item, s, t, now, rows in zip(self.penalties, self.signed, ahead, self.begun, held, strict=True):
            half = 0.5 * item.weight
            before, after = s * s, t * t
            then = item.held(t)
            change += half * float(before[rows].sum() - before[now].sum() + after[then].sum() - after[rows].sum())
            pull = item.weight * s * (t - s)
            slope += float(pull[now].sum() - pull[rows].sum())
        return change, slope
