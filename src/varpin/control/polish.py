"""The last step of a plan onto its constraints and to its optimum: Newton's method on the KKT conditions.

Equation (P4) of docs/plan-constraints.md. After the projected Newton step of Howell, Jackson and Manchester (2019), in
the metric of the cost to go: a step onto the constraints then keeps to the optimum within them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy

from varpin.arrays import Floats, Mask
from varpin.control.active_rows import same_rows
from varpin.control.along import states
from varpin.control.closed_loop import ClosedLoop, given_controls
from varpin.control.constraints import BoundBetween, BoundConstraint
from varpin.control.costs import CostError
from varpin.control.problem import OptimalControlProblem
from varpin.control.trials import MORE_HALVINGS, Trials, cut_less, few_halvings
from varpin.core.arrays import Commands
from varpin.errors import LinearizationError
from varpin.integrators.base import open_line, open_loop
from varpin.trajectory import Trajectory

# Greatest number of Newton steps, and how many of them, the last ones, lead onto the constraints only.
_STEPS, _LAST = 15, 3
# Greatest number of passes in a step that determine the active rows and the controls at their limits.
_PASSES = 12
# Violation that counts as rounding error, and decrease of the cost, relative to the cost at stake, that does.
_DONE, _FLAT = 1e-12, 1e-13
# Lengths of the part of a step along the constraints: its model is without second derivatives of the dynamics and of
# the constraints, but for those of sliding peaks. The part onto the constraints is whole.
_LENGTHS = (1.0, 0.5, 0.25, 0.0)
# Greatest number of steps onto the constraints that follow one along them.
_CORRECTIONS = 2
# Violation that steps along the constraints may cause; the next one removes it.
_TRANSIENT = 1e-9
# Distance from its bound at which a row counts as met, relative to the constraint's scale.
_NEAR = 1e-8
# Distance up to which the decrease of the cost at a motion counts with a row's bound.
_CLOSE = 1e-4
# Regularization of the dual problem for linearly dependent rows, relative to its diagonal; and its rounding error.
_LITTLE, _ROUNDED = 1e-13, 1e-12
# Least size of a control, relative to the largest one.
_SMALL = 1e-3
# Growth of changes of the controls without feedback, beside those with that of the cost, from which on they have it.
_UNSTABLE = 1e3
# Pivots of the dual problem: of whole blocks without progress, and greatest number of single ones for each row.
_TRIES, _PIVOTS = 4, 10


@dataclass(frozen=True, eq=False)
class Polished:
    """A motion and how far it is from the KKT conditions.

    Attributes:
        motion: The motion.
        violation: The largest violation over all constraints, each in its own unit.
        multipliers: For each constraint (K, rows), those of the Lagrangian's least slope in the controls.
        decrease: Decrease of the cost that its quadratic model expects within the linearized active constraints and the
            limits of the controls; zero at an optimum.
        stake: The cost at stake along the motion.
    """

    motion: Trajectory
    violation: float
    multipliers: list[Floats]
    decrease: float
    stake: float


def polished(
    problem: OptimalControlProblem,
    motion: Trajectory,
    multipliers: list[Floats],
    weights: Floats,
    backoff: list[Floats],
    until: float = math.inf,
    enough: tuple[float, float] | None = None,
) -> Polished:
    """The motion near a given one that satisfies its constraints, and the conditions of an optimum, most closely.

    Newton steps on the KKT conditions, equation (P4).

    Args:
        problem: The problem with its constraints.
        motion: A nearly feasible and nearly optimal motion.
        multipliers: For each constraint (K, rows); rows with positive multipliers are active.
        weights: Weights of the penalties (C,), which count in the feedback along the motion.
        backoff: For each constraint (K, rows).
        until: Time of ``time.perf_counter`` from which on no step begins.
        enough: Violation, and decrease of the cost relative to the cost at stake, that end the steps; by default those
            that are rounding errors.

    Raises:
        LinearizationError: A step of the given motion has no derivative.
        CostError: An expansion of the cost is not finite along it.
    """
    closely, level = (_DONE, _FLAT) if enough is None else (enough[0], max(enough[1], _FLAT))
    trials, longest = Trials(problem), 1.0
    step = _Step(problem, motion, multipliers, weights, backoff)
    for left in reversed(range(_STEPS)):
        there = step.found.violation <= closely and step.found.decrease <= level * step.found.stake
        if there or time.perf_counter() > until:
            break
        step.solve(until)
        # Where the model's curvature is too small, it is so in the next step, too.
        for length in (item for item in _LENGTHS if item <= (longest if left >= _LAST else 0.0)):
            after = step.after(trials, length)
            for _ in range(_CORRECTIONS if length > 0.0 else 0):
                if after is None or after.found.violation <= max(step.found.violation, _TRANSIENT):
                    break
                after.solve(until)
                after = after.after(trials, 0.0)
            if after is not None and _closer(after.found, step.found, length):
                step, longest = after, length or longest
                break
        else:
            break
    return replace(step.found, multipliers=step.least_slope())


def judged(
    problem: OptimalControlProblem,
    motion: Trajectory,
    multipliers: list[Floats],
    weights: Floats,
    backoff: list[Floats],
) -> Polished:
    """A motion as it is, and how far it is from the KKT conditions.

    See :func:`polished`.
    """
    step = _Step(problem, motion, multipliers, weights, backoff)
    return replace(step.found, multipliers=step.least_slope())


def _closer(after: Polished, before: Polished, length: float) -> bool:
    """Whether a motion is closer to the KKT conditions than another one, from which it is a step of given length."""
    if length == 0.0:
        return before.violation > _DONE and after.violation < before.violation
    return after.decrease < before.decrease and after.violation <= max(before.violation, _TRANSIENT)


class _Step:
    """A Newton step on the KKT conditions around a motion.

    Minimizes the cost's quadratic model in w within the linearized constraints G w <= -c: with W the inverse of its
    Hessian and g its gradient, w = -W (g + G' lambda), where lambda minimizes the dual problem.

    Attributes:
        found: The motion and its residuals.
        free: The controls (R, m) that are not fixed at their limits.
        limited: Those whose lower and whose upper limit are rows of the dual problem, each (R, m).
        pressed: Those (R, m) that the conditions of an optimum press against a limit on the motion.
        multipliers: For each constraint (K, rows); after :meth:`solve` those of the step.
        pressing: After :meth:`solve`, the controls that the step leads to their lower and to their upper limit.
        ahead: After :meth:`solve`, w of the step (R, m).
        onto: After :meth:`solve`, the least w (R, m) onto the constraints.
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        motion: Trajectory,
        multipliers: list[Floats],
        weights: Floats,
        backoff: list[Floats],
    ) -> None:
        self.problem, self.motion, self.multipliers = problem, motion, multipliers
        (lower, upper), decided = problem.control_limits, problem.decided(motion)
        self.free = (decided > lower) & (decided < upper) & ~given_controls(problem)
        self.weights, self.backoff = weights, backoff
        self.bound = problem.bound_constraints
        u = problem.control_rows(motion)
        self.c = [item.value(motion.q, motion.v, u) + b for item, b in zip(self.bound, backoff, strict=True)]
        active = [values != 0.0 for values in multipliers]
        # The rows that are met, or may be.
        self.rows = [
            rows | item.source.equality | (c > -_NEAR * item.scale)
            for item, rows, c in zip(self.bound, active, self.c, strict=True)
        ]
        self.loop = ClosedLoop(problem, motion, weights, multipliers)
        self.loop.close(self.free)
        self.found = self._judged()

    def _judged(self) -> Polished:
        """The residuals of the motion with its best multipliers, without a step.

        Rows that are close to their bounds may be met after a short way, so that the cost cannot fall by more.
        """
        problem, loop, motion = self.problem, self.loop, self.motion
        met = self.rows
        room = [np.where(rows & (item.source.equality | (c > 0.0)), 0.0, c)
                for rows, (item, c) in zip(met, self._values(), strict=True)]  # fmt: skip
        self.rows = [rows | (c > -_CLOSE * item.scale) for rows, (item, c) in zip(met, self._values(), strict=True)]
        none = np.zeros(self.free.shape, dtype=np.bool_)
        multipliers, pull, pressed = self._dual(room, loop.gradient, (none, none))
        # A control at its limit is free again where the cost decreases inwards, if there is a way inwards.
        u, (lower, upper) = problem.decided(motion), problem.control_limits
        may = ~self.free & (lower < upper) & ~given_controls(problem)
        low, high = may & (u <= lower) & (pull < 0.0), may & (u >= upper) & (pull > 0.0)
        if low.any() or high.any():
            self.free = self.free | low | high
            loop.close(self.free)
            multipliers, pull, pressed = self._dual(room, loop.gradient, (low, high))
        self.rows, self.limited, self.pressed = met, (low, high), pressed[0] | pressed[1]
        decrease = 0.5 * float(np.einsum("ki,kij,kj->", pull, loop.inverse, pull))
        decrease -= sum(float((lam * c).sum()) for lam, c in zip(multipliers, room, strict=True))
        violation = max(0.0, *(_violation(item, c) for item, c in self._values()))
        return Polished(motion, violation, multipliers, decrease, loop.stake.moved)

    def _values(self) -> Iterator[tuple[BoundConstraint, Floats]]:
        """Each constraint with its values (K, rows)."""
        return zip(self.bound, self.c, strict=True)

    def _dual(
        self, values: list[Floats], gradient: Floats, limited: tuple[Mask, Mask], still: Mask | None = None
    ) -> tuple[list[Floats], Floats, tuple[Mask, Mask]]:
        """Multipliers (K, rows) of the step for constraints' ``values``, and the pull g + G' lambda (R, m).

        The lower and the upper limits of the controls ``limited``, each (R, m), are rows, too; ``still`` ones of them
        (R, m) do not change at all. The last result tells which controls are pressed against the lower and the upper
        limit.
        """
        loop, u = self.loop, self.problem.decided(self.motion)
        still = np.zeros(u.shape, dtype=np.bool_) if still is None else still
        sides = list(zip((-1.0, 1.0), self.problem.control_limits, limited, strict=True))
        G = np.concatenate([loop.rows(self.rows), *(loop.rows_of_controls(side, sign) for sign, _, side in sides)])
        c = [value[rows] for value, rows in zip(values, self.rows, strict=True)]
        c += [np.where(still, 0.0, sign * (u - limit))[side] for sign, limit, side in sides]
        equal, active = self._kinds(self.rows)
        fixed = np.concatenate([still[side] for side in limited])
        flat = G.reshape(len(G), loop.gradient.size)
        weighed = np.einsum("akm,kmi->aki", G, loop.inverse).reshape(flat.shape)
        found = _least(
            weighed @ flat.T,
            np.concatenate(c) - weighed @ gradient.ravel(),
            np.concatenate([equal, fixed]),
            np.concatenate([active, fixed]),
        )
        of_rows, *of_limits = np.split(found, np.cumsum([len(equal), int(limited[0].sum())]))
        low, high = np.zeros(u.shape, dtype=np.bool_), np.zeros(u.shape, dtype=np.bool_)
        low[limited[0]], high[limited[1]] = (pushes > 0.0 for pushes in of_limits)
        return _in_rows(of_rows, self.rows), gradient + np.einsum("akm,a->km", G, found), (low, high)

    def least_slope(self) -> list[Floats]:
        """Multipliers (K, rows) with which the Lagrangian's gradient in the free controls is least.

        In the metric of the cost to go, or beside a feedback with penalties, the directions in which these are stiff
        would hardly count: there a tiny gradient in other directions changes the multipliers by any part. Where the
        motion is so unstable that changes grow manifold, they count beside the feedback of the cost alone.
        """
        loop = self.loop
        pushing = [lam > 0.0 for lam in self.found.multipliers]
        rows = [met | push for met, push in zip(self.rows, pushing, strict=True)]
        equal, active = self._kinds(rows)
        size = np.abs(self.problem.decided(self.motion)).max(axis=0)
        free = self.free & ~self.pressed
        size = np.where(free, np.maximum(size, _SMALL * size.max()), 0.0)
        loop.leave_penalties(free)
        calm, pull = loop.rows(rows), loop.gradient
        loop.open()
        G = loop.rows(rows)
        if np.abs(G).max(initial=0.0) <= _UNSTABLE * np.abs(calm).max(initial=0.0):
            calm, pull = G, loop.gradient
        slopes, gradient = (calm * size).reshape(len(equal), size.size), (pull * size).ravel()
        found = _least(slopes @ slopes.T, -slopes @ gradient, equal, active)
        # The same without the squares, in which digits are lost.
        pushed = equal | (found > 0.0)
        exact = np.linalg.lstsq(slopes[pushed].T, -gradient, rcond=None)[0]
        if (equal[pushed] | (exact > 0.0)).all():
            found[pushed] = exact
        return _in_rows(found, rows)

    def _kinds(self, rows: list[Mask]) -> tuple[Mask, Mask]:
        """Which of the given rows (a,) are equalities, and which had multipliers."""
        equal = [np.full(int(own.sum()), item.source.equality) for item, own in zip(self.bound, rows, strict=True)]
        active = [lam[own] != 0.0 for lam, own in zip(self.multipliers, rows, strict=True)]
        return np.concatenate(equal), np.concatenate(active)

    def solve(self, until: float) -> None:
        """Solve for the step, its active rows and the controls that it brings to their limits, until a time at most."""
        problem, loop = self.problem, self.loop
        lower, upper = problem.control_limits
        u = problem.decided(self.motion)
        for _ in range(_PASSES):
            self.multipliers, pull, self.pressing = self._dual(self.c, loop.gradient, self.limited)
            self.ahead = -np.einsum("kij,kj->ki", loop.inverse, pull)
            response, change = loop.response(self.ahead)
            met = [
                rows | (c > _DONE)
                for rows, c in zip(self.rows, loop.values_after(self.c, response, change), strict=True)
            ]
            low, high = self.limited
            reached = low | (self.free & (u + change < lower)), high | (self.free & (u + change > upper))
            settled = same_rows(met, self.rows) or self._crowded(met)
            if (settled and same_rows([*reached], [low, high])) or time.perf_counter() > until:
                break
            self.limited = reached
            if not settled:
                self.rows = met
        # The least step onto the constraints alone.
        _, pull, _ = self._dual(self.c, np.zeros(u.shape), self.limited, self.pressing[0] | self.pressing[1])
        self.onto = -np.einsum("kij,kj->ki", loop.inverse, pull)

    def _crowded(self, met: list[Mask]) -> bool:
        """Whether there are more rows than controls that could meet them, with rows between nodes among them."""
        between = any(isinstance(item, BoundBetween) for item in self.bound)
        return between and sum(int(rows.sum()) for rows in met) > self.free.size

    def after(self, trials: Trials, length: float) -> _Step | None:
        """The next step, after ``length`` of this one's part along the constraints.

        None where the motion fails, or has no derivative.
        """
        # Under stiff feedback a motion that leaves the neighbourhood may need any number of parts.
        near = cut_less(self.problem.integrator, few_halvings(self.motion) + MORE_HALVINGS)
        attempt = trials.attempt(self._commands(length), integrator=near)
        if not attempt.whole:
            return None
        try:
            return _Step(self.problem, attempt.trajectory(), self.multipliers, self.weights, self.backoff)
        except (CostError, LinearizationError):
            return None

    def _commands(self, length: float) -> Commands:
        """The commands of the motion after the step, ``length`` of its part along the constraints, with feedback."""
        problem, loop = self.problem, self.loop
        u = problem.decided(self.motion)
        response, change = loop.response(length * self.ahead + (1.0 - length) * self.onto)
        # Controls that end at a limit do so exactly, and have no feedback: after a shorter step those already there.
        (low, high), (lower, upper) = self.pressing, problem.control_limits
        if length < 1.0:
            low, high = low & (u <= lower), high & (u >= upper)
        after, ends = np.where(low, lower, np.where(high, upper, u + change)), low | high
        gains, previous = (np.where(ends[:, :, None], 0.0, each) for each in (loop.gains, loop.previous))
        reference = (states(problem, self.motion) + response)[: -1 : problem.hold]
        if problem.linear:
            m, x = change.shape[1], reference.shape[1]
            within = problem.begun(np.clip(after, *problem.control_limits))
            return open_line(within, problem.integrator.stage_times)._replace(
                limits=problem.control_limits.copy(),
                gains=np.ascontiguousarray(gains[1:, :, : x + m]),
                reference=np.hstack([reference, after[:-1]]),
            )
        if previous.any():
            before = np.vstack([u[:1], after[:-1]])
            gains, reference = np.concatenate([gains, previous], axis=2), np.hstack([reference, before])
        return open_loop(after)._replace(
            hold=problem.hold,
            limits=problem.control_limits.copy(),
            gains=np.ascontiguousarray(gains),
            reference=np.ascontiguousarray(reference),
        )


def _in_rows(numbers: Floats, rows: list[Mask]) -> list[Floats]:
    """Numbers (a,) of the given rows of all constraints, in arrays (K, rows); others are zero."""
    found = [np.zeros(own.shape) for own in rows]
    ends = np.cumsum([int(own.sum()) for own in rows])
    for array, own, part in zip(found, rows, np.split(numbers, ends[:-1]), strict=True):
        array[own] = part
    return found


def _violation(item: BoundConstraint, c: Floats) -> float:
    """The largest violation of a constraint with the values ``c``, in its own unit."""
    return float(np.abs(c).max() if item.source.equality else c.max())


def _least(S: Floats, d: Floats, equal: Mask, active: Mask) -> Floats:
    """The x (a,) of least x' S x / 2 - d' x, nonnegative where not ``equal``, for S positive semidefinite (a, a).

    Block principal pivoting, after Portugal, Judice and Vicente, "A comparison of block pivoting and interior-point
    algorithms for linear least squares problems with nonnegative variables" (1994). Begins with the ``active`` rows.
    Where that does not progress, as with more rows than controls that could meet them, the algorithm of Lawson and
    Hanson on a triangular factor, which has half the digits of S to lose.
    """
    length = np.sqrt(np.maximum(np.diagonal(S), 0.0))
    length = np.where(length > 0.0, length, 1.0)
    S, d = S / np.outer(length, length), d / length
    S[np.diag_indices(len(S))] += _LITTLE * len(S)
    active = active | equal
    least, tries = len(d) + 1, _TRIES
    while tries:
        x = np.zeros(len(d))
        x[active] = np.linalg.solve(S[np.ix_(active, active)], d[active])
        y = S @ x - d
        rounding = _ROUNDED * max(np.abs(x).max(initial=0.0), np.abs(d).max(initial=0.0))
        wrong = np.where(active, (x < -rounding) & ~equal, y < -rounding)
        count = int(wrong.sum())
        if not count:
            break
        tries = _TRIES if count < least else tries - 1
        least, active = min(least, count), active ^ wrong
    else:
        x = _nonnegative(S, d, equal)
    found: Floats = np.where(equal, x, np.maximum(x, 0.0)) / length
    return found


def _nonnegative(S: Floats, d: Floats, equal: Mask) -> Floats:
    """The x (a,) of :func:`_least` as nonnegative least squares, with the unknowns of equalities eliminated first."""
    order = np.argsort(~equal, kind="stable")
    first = int(equal.sum())
    values, vectors = np.linalg.eigh(S[np.ix_(order, order)])
    # Rounding errors may leave S without a Cholesky factor; this one has values of the size of these errors instead.
    root = np.sqrt(np.maximum(values, _LITTLE * len(S) * values[-1]))[:, None] * vectors.T
    upper: Floats = np.linalg.qr(root)[1]
    goal = scipy.linalg.solve_triangular(upper, d[order], trans="T")
    x = np.zeros(len(d))
    A, b = upper[first:, first:], goal[first:]
    try:
        x[first:] = scipy.optimize.nnls(A, b, maxiter=_PIVOTS * len(d))[0]
    except RuntimeError:
        # Its pivots did not end; an interior method has fewer digits.
        x[first:] = scipy.optimize.lsq_linear(A, b, bounds=(0.0, np.inf)).x
    x[:first] = scipy.linalg.solve_triangular(upper[:first, :first], goal[:first] - upper[:first, first:] @ x[first:])
    found = np.empty(len(d))
    found[order] = x
    return found
