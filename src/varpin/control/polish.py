"""The last step of a plan onto its constraints and to its optimum: Newton's method on the KKT conditions.

Equation (P4) of docs/plan-constraints.md. After the projected Newton step of Howell, Jackson and Manchester (2019), in
the metric of the cost to go: a step onto the constraints then keeps to the optimum within them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from varpin.arrays import Floats, Mask
from varpin.control.active_rows import same_rows
from varpin.control.along import states
from varpin.control.closed_loop import ClosedLoop, given_controls
from varpin.control.constraints import BoundConstraint
from varpin.control.feedback import around
from varpin.control.line_search import TRIAL_ERRORS
from varpin.control.problem import OptimalControlProblem
from varpin.control.trials import MORE_HALVINGS, Trials, cut_less, few_halvings
from varpin.core.arrays import Commands
from varpin.trajectory import Trajectory

# Greatest number of Newton steps, of those to a motion that may be rough, and how many of the last ones of the former
# lead onto the constraints only.
_STEPS, _FEW, _LAST = 60, 8, 3
# Greatest number of passes in a step that determine the active rows and the controls at their limits.
_PASSES = 12
# Greatest number of rows in a step, relative to that of the controls. Where a motion keeps to a bound, a node and an
# instant between nodes have a row each.
_CROWDED = 2.0
# Greatest number of steps until the expected decrease has fallen to a half.
_WAITS = 8
# Violation that counts as rounding error, and decrease of the cost, relative to the cost at stake, that does.
_DONE, _FLAT = 1e-12, 1e-13
# The part of a step along the constraints is made shorter, by _SHARPEST to _BACK at a time and down to _SHORTEST: its
# model is without second derivatives of the dynamics and of the constraints, but for those of sliding peaks. The part
# onto the constraints is whole.
_BACK, _SHARPEST, _SHORTEST = 0.5, 0.04, 0.05
# Expected decrease, relative to the cost at stake, up to which it has to fall with a step if it can.
_CALM = 1e-6
# Greatest number of steps onto the constraints that follow one along them.
_CORRECTIONS = 4
# Weight of violations in the merit, relative to the largest multiplier; above 1 its minimum is within the constraints.
_STRICT = 2.0
# Least share of the expected decrease that the merit falls by with a step from a motion within the constraints.
_LOWERED = 1e-3
# Violation of a motion that is not looked at, relative to the constraint's scale, and to that of the motion before.
_WILD = (0.1, 10.0)
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
    """A motion from a given one on that satisfies its constraints, and the conditions of an optimum, most closely.

    Newton steps on the KKT conditions, equation (P4).

    Args:
        problem: The problem with its constraints.
        motion: A motion not far from the constraints. The closer it is to an optimum, the fewer steps follow.
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
    trials, longest, closed = Trials(problem), 1.0, True
    step = _Step(problem, motion, multipliers, weights, backoff)
    least, waited = math.inf, 0
    for left in reversed(range(_STEPS if enough is None else _FEW)):
        there = step.found.violation <= closely and step.found.decrease <= level * step.found.stake
        waited = 0 if step.found.decrease < 0.5 * least else waited + 1
        least = min(least, step.found.decrease)
        if there or waited > _WAITS + _LAST or time.perf_counter() > until:
            break
        step.solve(until)
        along = (left >= _LAST and waited <= _WAITS) or enough is not None
        length = longest if along else 0.0
        after = _next(step, trials, length, closed=closed, until=until)
        if after is None and not closed:
            after = _next(step, trials, length, closed=True, until=until)
        if after is None:
            break
        step, length, closed = after
        longest = min(2.0 * length, 1.0) or longest
    return replace(step.found, multipliers=step.least_slope())


def _next(
    step: _Step, trials: Trials, length: float, *, closed: bool, until: float
) -> tuple[_Step, float, bool] | None:
    """The next step, after the first length that leads closer, that length, and whether the motion had feedback.

    Feedback with penalties may be so stiff that a motion leaves the neighbourhood of the foreseen one just for that;
    then motions have none from there on. Close to an optimum the expected decrease tells more than the cost.
    """
    here, lower = step.found, None
    close = here.violation <= _TRANSIENT and here.decrease <= _CALM * here.stake
    while time.perf_counter() <= until:
        step.rise = math.inf
        for feedback in (True, False)[not closed :]:
            after = step.after(trials, length, closed=feedback)
            if after is None:
                continue
            found = after, length, feedback
            if length == 0.0 or not close or after.found.decrease < here.decrease:
                return found
            lower = lower or found
            break
        if (lower is not None and length < _SHORTEST) or length == 0.0:
            break
        length = step.shorter(length) if length >= _SHORTEST else 0.0
    return lower


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


class _Tried(NamedTuple):
    """A motion after a step.

    Attributes:
        motion: The motion.
        c: The constraints' values (K, rows) on it, margins included.
        violation: The largest violation.
        merit: Its cost and, with weights, the sum of its violations.
    """

    motion: Trajectory
    c: list[Floats]
    violation: float
    merit: float


class _Step:
    """A Newton step on the KKT conditions around a motion.

    Minimizes the cost's quadratic model in w within the linearized constraints G w <= -c: with W the inverse of its
    Hessian and g its gradient, w = -W (g + G' lambda), where lambda minimizes the dual problem.

    Attributes:
        found: The motion and its residuals.
        cost: The cost of the motion.
        free: The controls (R, m) that are not fixed at their limits.
        limited: Those whose lower and whose upper limit are rows of the dual problem, each (R, m).
        pressed: Those (R, m) that the conditions of an optimum press against a limit on the motion.
        multipliers: For each constraint (K, rows); after :meth:`solve` those of the step.
        pressing: After :meth:`solve`, the controls that the step leads to their lower and to their upper limit.
        ahead: After :meth:`solve`, w of the step (R, m).
        rise: Least rise of the merit after the length that was tried last; infinite where no motion was looked at.
        expected: After :meth:`solve`, decrease of the cost that the step expects.
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
        self.cost = problem.cost_of(motion)
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
        # The rows of the last dual problem, and its matrices.
        self._known: tuple[list[Mask], tuple[Floats, Floats, Floats]] | None = None
        self.loop = ClosedLoop(problem, motion, weights, multipliers)
        self.loop.close(self.free)
        self.rise = math.inf
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
            self._known = None
            multipliers, pull, pressed = self._dual(room, loop.gradient, (low, high))
        self.rows = self._met = met
        self.limited, self.pressed = (low, high), pressed[0] | pressed[1]
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
        u = self.problem.decided(self.motion)
        still = np.zeros(u.shape, dtype=np.bool_) if still is None else still
        sides = list(zip((-1.0, 1.0), self.problem.control_limits, limited, strict=True))
        G, weighed, S = self._quadratic(limited)
        c = [value[rows] for value, rows in zip(values, self.rows, strict=True)]
        c += [np.where(still, 0.0, sign * (u - limit))[side] for sign, limit, side in sides]
        equal, active = self._kinds(self.rows)
        fixed = np.concatenate([still[side] for side in limited])
        found = _least(
            S,
            np.concatenate(c) - weighed @ gradient.ravel(),
            np.concatenate([equal, fixed]),
            np.concatenate([active, fixed]),
        )
        of_rows, *of_limits = np.split(found, np.cumsum([len(equal), int(limited[0].sum())]))
        low, high = np.zeros(u.shape, dtype=np.bool_), np.zeros(u.shape, dtype=np.bool_)
        low[limited[0]], high[limited[1]] = (pushes > 0.0 for pushes in of_limits)
        return _in_rows(of_rows, self.rows), gradient + np.einsum("akm,a->km", G, found), (low, high)

    def _quadratic(self, limited: tuple[Mask, Mask]) -> tuple[Floats, Floats, Floats]:
        """The derivatives G (a, R, m) of rows and ``limited`` controls in w, G W (a, R m), and G W G' (a, a)."""
        rows, loop = [*self.rows, *limited], self.loop
        if self._known is None or not same_rows(rows, self._known[0]):
            sides = zip((-1.0, 1.0), limited, strict=True)
            G = np.concatenate([loop.rows(self.rows), *(loop.rows_of_controls(side, sign) for sign, side in sides)])
            flat = G.reshape(len(G), loop.gradient.size)
            weighed = np.einsum("akm,kmi->aki", G, loop.inverse).reshape(flat.shape)
            self._known = rows, (G, weighed, weighed @ flat.T)
        return self._known[1]

    def least_slope(self) -> list[Floats]:
        """Multipliers (K, rows) with which the Lagrangian's gradient in the free controls is least.

        In the metric of the cost to go, or beside a feedback with penalties, the directions in which these are stiff
        would hardly count: there a tiny gradient in other directions changes the multipliers by any part. Where the
        motion is so unstable that changes grow manifold, they count beside the feedback of the cost alone.
        """
        loop = self.loop
        pushing = [lam > 0.0 for lam in self.found.multipliers]
        rows = [met | push for met, push in zip(self._met, pushing, strict=True)]
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
            # So many rows are not met by any change.
            crowded = sum(int(rows.sum()) for rows in met) > _CROWDED * self.free.size
            settled = same_rows(met, self.rows) or crowded
            if (settled and same_rows([*reached], [low, high])) or time.perf_counter() > until:
                break
            self.limited = reached
            if not settled:
                self.rows = met
        self.expected = 0.5 * float((self.ahead * pull).sum()) - float((self.ahead * loop.gradient).sum())
        self.onto = self._back(self.c)

    def after(self, trials: Trials, length: float, *, closed: bool = True) -> _Step | None:
        """The next step, after ``length`` of this one's part along the constraints, with or without feedback.

        Where violations grow, corrections lead back onto the constraints, with the derivatives along this motion. None
        where the motion fails, has no derivative, or is no closer to an optimum within the constraints: neither its
        merit is less, nor the decrease that its own model expects.
        """
        w = length * self.ahead + (1.0 - length) * self.onto
        here, least = self.found, max(self.found.violation, _TRANSIENT)
        tried = self._tried(trials, w, length, closed=closed)
        for _ in range(_CORRECTIONS):
            if tried is None or self._lower(tried, length) or tried.violation <= least:
                break
            w = w + self._back(tried.c)
            tried = self._tried(trials, w, length, closed=closed)
        if tried is None:
            return None
        self.rise = min(self.rise, tried.merit - self._merit(self.cost, self.c))
        lower = self._lower(tried, length)
        if not lower and tried.violation > least:
            return None
        try:
            after = _Step(self.problem, tried.motion, self.multipliers, self.weights, self.backoff)
        except TRIAL_ERRORS:
            return None
        return after if lower or (length > 0.0 and after.found.decrease < here.decrease) else None

    def shorter(self, length: float) -> float:
        """A shorter length than one whose motion was not closer: the minimum of a parabola through its merit."""
        here = self._merit(self.cost, self.c)
        slope = 2.0 * self.expected + here - self.cost
        least = 0.5 * slope * length / (self.rise / length + slope) if self.rise > -slope * length else 1.0
        return float(np.clip(least, _SHARPEST * length, _BACK * length))

    def _tried(self, trials: Trials, w: Floats, length: float, *, closed: bool) -> _Tried | None:
        """The motion after a step w (R, m); None where it fails, or violates a constraint by far more."""
        # Under stiff feedback a motion that leaves the neighbourhood may need any number of parts.
        near = cut_less(self.problem.integrator, few_halvings(self.motion) + MORE_HALVINGS)
        commands = self._commands(w, length)
        if not closed:
            commands = commands._replace(gains=np.zeros(commands.gains.shape))
        try:
            attempt = trials.attempt(commands, integrator=near)
            if not attempt.whole:
                return None
            motion, c, worst = attempt.trajectory(), [], 0.0
            u = self.problem.control_rows(motion)
            for item, here, b in zip(self.bound, self.c, self.backoff, strict=True):
                c.append(item.value(motion.q, motion.v, u) + b)
                violation = _violation(item, c[-1])
                if not violation <= max(_WILD[0] * item.scale, _WILD[1] * _violation(item, here)):
                    return None
                worst = max(worst, violation)
            return _Tried(motion, c, worst, self._merit(self.problem.cost_of(motion), c))
        except TRIAL_ERRORS:
            return None

    def _merit(self, cost: float, c: list[Floats]) -> float:
        """The exact penalty function: cost, and violations with more than the multipliers of the step."""
        for item, lam, values in zip(self.bound, self.multipliers, c, strict=True):
            beyond = np.abs(values) if item.source.equality else np.maximum(values, 0.0)
            cost += _STRICT * float(np.abs(lam).max(initial=0.0)) * float(beyond.sum())
        return cost

    def _lower(self, tried: _Tried, length: float) -> bool:
        """Whether a motion after ``length`` of the step has less merit, or is clearly closer to the constraints."""
        if length == 0.0:
            return self.found.violation > _DONE and tried.violation < self.found.violation
        here = self._merit(self.cost, self.c)
        return tried.merit < here - _LOWERED * length * (self.expected + here - self.cost)

    def _back(self, c: list[Floats]) -> Floats:
        """The least w (R, m) that leads from values ``c`` (K, rows) onto the constraints."""
        self.rows = [rows | (values > _DONE) for rows, values in zip(self.rows, c, strict=True)]
        _, pull, _ = self._dual(c, np.zeros(self.ahead.shape), self.limited, self.pressing[0] | self.pressing[1])
        onto: Floats = -np.einsum("kij,kj->ki", self.loop.inverse, pull)
        return onto

    def _commands(self, w: Floats, length: float) -> Commands:
        """The commands of the motion after a step w (R, m), ``length`` along the constraints, with feedback."""
        problem, loop = self.problem, self.loop
        u = problem.decided(self.motion)
        response, change = loop.response(w)
        # Controls that end at a limit do so exactly, and have no feedback: after a shorter step those already there.
        (low, high), (lower, upper) = self.pressing, problem.control_limits
        if length < 1.0:
            low, high = low & (u <= lower), high & (u >= upper)
        after, ends = np.where(low, lower, np.where(high, upper, u + change)), low | high
        gains, previous = (np.where(ends[:, :, None], 0.0, each) for each in (loop.gains, loop.previous))
        x = (states(problem, self.motion) + response)[: -1 : problem.hold]
        if problem.linear:
            # The control at the begin of a step is a part of its state.
            size, m = x.shape[1], after.shape[1]
            gains, previous = gains[:, :, :size], gains[:, :, size : size + m]
        return around(problem, after, x, gains, previous if previous.any() else None)


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
