"""The minimum of a model with controls within their limits, and the rows of penalties that are active there."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np

from varpin import core
from varpin.arrays import Floats, Mask
from varpin.control.active_rows import Pushes, Rows, same_rows
from varpin.control.along import Along, Limits, around_nominal, without_limits
from varpin.control.passes import Plan, foreseen, gains_on_states, single_pass, without_feedback
from varpin.control.penalties import flat

# Greatest numbers of active sets and of interior-point steps to the model's minimum within limits, its gap relative to
# the model's change, and rounding errors of changes and slopes relative to the largest ones.
_ACTIVE_SETS, _INTERIOR_STEPS, _GAP, _ROUNDED = 8, 40, 1e-5, 1e-11


# Active sets end where, after the first ones, a change is not smaller than this share of the one before.
_SETTLING, _SHRINKING = 1, 0.75


# Pivot of a control that cannot move.
_FIRM = 1e300


# With rows of penalties: the greatest number of interior-point steps, the gap, relative to the model's change and to
# the cost at stake, and the first gap, relative to the latter. They end, too, where the last _STILL of them have left
# more than _STANDS of the gap, and it is below _SMALL of that after the first: then rounding errors keep it up. After a
# pass that fails the last point is the result if its gap is below _SMALL of the model's change.
_STEPS_WITH_ROWS, _CLOSE, _NOTHING, _LARGE = 60, 1e-9, 1e-12, 1e3
_STILL, _STANDS, _SMALL = 4, 0.3, 1e-3


# Greatest share of the way to a limit in an interior-point step.
_INSIDE = 0.995


def within_limits(along: Along, regularization: float, curvature: Floats | None) -> Plan | None:
    """The pass to the model's minimum with controls within their limits."""
    return to_minimum(Box(along, curvature), regularization)[0]


def to_minimum(box: Box, regularization: float) -> tuple[Plan | None, list[Mask] | None]:
    """The pass to the minimum of a model with controls within their limits, and its active rows if limits are reached.

    Around the nominal states, late decisions seem to reach their limits because each would have to make up for the
    earlier ones. So the first pass has no limits, and where its linearized motion reaches some, further passes lead to
    the minimum. Where no limits are reached, the model is that with the rows of ``box``.
    """
    along, curvature = box.along, box.curvature
    problem = along.problem
    if not problem.limited or along.clipped:
        return single_pass(along, regularization, curvature=curvature)[0], None
    plan, stiffness = free_pass(along, regularization, curvature)
    if plan is not None:
        ahead = foreseen(along, plan)
        if not ahead.limited:
            return _sloped(plan, ahead.moves), None
        if problem.processes:
            plan, active = _matching(along, regularization, curvature, plan), None
        else:
            plan, active = box.with_proximal(regularization * np.abs(stiffness)).minimum(plan, ahead.moves)
        if plan is not None:
            return _holding(plan), active
    limits = around_nominal(along.slack, along.states)
    plan = single_pass(along, regularization, curvature=curvature, limits=limits)[0]
    return None if plan is None else _holding(plan), None


def _holding(plan: Plan) -> Plan:
    """A plan within limits that knows whether it holds controls at them.

    Controls without effect have no feedback, either, and count as held: that changes nothing.
    """
    return plan._replace(holds=not bool(plan.feedback.any(axis=2).all()))


def free_pass(along: Along, regularization: float, curvature: Floats | None) -> tuple[Plan | None, Floats]:
    """The pass without limits, and the diagonals of its Quu (R, m)."""
    stiffness = np.zeros((along.problem.decisions, along.problem.scene.controls))
    free = around_nominal(along.slack[:0], along.states)._replace(stiffness=stiffness)
    return single_pass(along, regularization, curvature=curvature, limits=free)[0], stiffness


def _sloped(plan: Plan, moves: Floats) -> Plan:
    """A plan with the slope of the controls' changes (R, m) on its linearized motion.

    The feed-forward parts belong together with the feedback, so the slope is that of both.
    """
    slope = float(np.vdot(plan.gradient, moves))
    if not (plan.expected_decrease > 0.0 and slope < 0.0):
        return plan
    return plan._replace(slope=slope, curvature=-2.0 * (plan.expected_decrease + slope), limited=True)


def _matching(along: Along, regularization: float, curvature: Floats | None, plan: Plan) -> Plan | None:
    """Under noise: passes within the limits that the linearized motion reaches, until these do not change.

    None if ever more of them change. The noise cost depends on the gains, so passes have no common model.
    """
    held: Mask = np.zeros(plan.feedforward.shape, dtype=np.bool_)
    others, found, (expected, moves, _) = held.size + 1, plan, foreseen(along, plan)
    while others > 0:
        limits = Limits(along.slack, expected)
        passed = single_pass(along, regularization, curvature=curvature, limits=limits)[0]
        if passed is None:
            return None
        found = passed
        now = np.logical_not(found.feedback.any(axis=2))
        # Where motions stay at limits for long, these passes may not converge.
        changed = int((now != held).sum())
        if changed >= others:
            return None
        held, others = now, changed
        expected, moves, _ = foreseen(along, found)
    made = _sloped(found, moves)
    return made if made is not found else None


class Box:
    """The model of a motion in the changes of its controls (R, m), which have to stay within their limits.

    Its minimum is found by passes with the controls at limits fixed, whose set changes until no other control exceeds a
    limit and no fixed one would leave its own; where these do not end, after a primal-dual interior-point method, whose
    steps are passes, too. ``proximal`` (R, m) regularizes: the Hessian of a further cost of the changes.

    With ``rows`` the model is piecewise quadratic: the rows of the penalties that are active at its minimum are found
    together with the controls at limits. Around a point it has the rows ``active``. No further step begins after the
    time ``until`` (of ``time.perf_counter``).
    """

    def __init__(
        self,
        along: Along,
        curvature: Floats | None,
        rows: Rows | None = None,
        active: list[Mask] | None = None,
        *,
        until: float = math.inf,
    ) -> None:
        self.along, self.curvature, self.rows, self.active, self.until = along, curvature, rows, active, until
        self.proximal = np.zeros((along.problem.decisions, along.problem.scene.controls))
        self.lower, self.upper = along.slack[:, 0], along.slack[:, 1]

    def with_proximal(self, proximal: Floats) -> Box:
        """The model with a further cost of the changes."""
        made = copy(self)
        made.proximal = proximal
        return made

    def minimum(self, plan: Plan, moves: Floats) -> tuple[Plan | None, list[Mask] | None]:
        """The plan to the minimum, from the plan without limits and the controls' changes of its linearized motion.

        Also the rows that are active at the minimum, if these were to be found.
        """
        found = self._active_sets(plan, (moves <= self.lower, moves >= self.upper))
        found = self._inside(plan) if found is None else found
        if found is None or not (found.at.value < 0.0 or found.box.rows is not None):
            return None, None
        return found.box.leading(found), found.box.active

    def _inside(self, plan: Plan) -> _Least | None:
        """The minimum by the interior-point method; see :meth:`minimum`."""
        inner = self._interior(plan)
        if inner is None:
            return None
        at, held, box = inner
        return box._active_sets(plan, held) or box._with_gains(at, held)

    def _active_sets(self, plan: Plan, held: tuple[Mask, Mask]) -> _Least | None:
        """The last pass and the minimum by a primal-dual active set; None if it takes too many passes.

        It begins with the controls ``held`` at a lower and at an upper limit (Hintermueller, Ito and Kunisch 2002).
        """
        low, high, box, changed = self.lower, self.upper, self, math.inf
        for done in range(_ACTIVE_SETS):
            if done > 0 and time.perf_counter() > self.until:
                return None
            found = box._fixed(held)
            if found is None:
                return None
            at = box._at(plan, foreseen(box.along, found, box._slack(held)).moves)
            if at is None:
                return None
            size, force = _ROUNDED * np.abs(at.moves).max(axis=0), _ROUNDED * np.abs(at.pressure).max(axis=0)
            now = (
                np.where(held[0], at.pressure >= -force, at.moves < low - size),
                np.where(held[1], at.pressure <= force, at.moves > high + size),
            )
            fixed = low >= high
            now = now[0] | fixed, now[1] & ~fixed
            active = box._met(found, held)
            if np.array_equal(now[0], held[0]) and np.array_equal(now[1], held[1]) and active is None:
                return _Least(box, found, at._replace(moves=np.clip(at.moves, low, high)))
            before, changed = changed, int((now[0] != held[0]).sum() + (now[1] != held[1]).sum())
            if self.rows is None and done >= _SETTLING and changed > _SHRINKING * before:
                return None
            held, box = now, box if active is None else box._with_active(active)
        return None

    def _met(self, plan: Plan, held: tuple[Mask, Mask]) -> list[Mask] | None:
        """The active rows of the linearized motion under a plan, or None if they are those of the model."""
        rows, active = self.rows, self.active
        if rows is None or active is None:
            return None
        met = rows.held(rows.ahead(self.along, plan, self._slack(held)))
        return None if same_rows(met, active) else met

    def _with_active(self, active: list[Mask]) -> Box:
        """The model around points with other active rows."""
        assert self.rows is not None
        made = copy(self)
        made.along, made.active = self.rows.along(active), active
        return made

    def _slack(self, held: tuple[Mask, Mask]) -> Floats:
        """Limits (R, 2, m) that fix the held controls only."""
        at = np.where(held[0], self.lower, np.where(held[1], self.upper, 0.0))
        either = held[0] | held[1]
        return np.stack([np.where(either, at, -np.inf), np.where(either, at, np.inf)], axis=1)

    def _fixed(self, held: tuple[Mask, Mask]) -> Plan | None:
        slack = self._slack(held)
        return self._passed(around_nominal(slack, self.along.states))

    def _with_gains(self, moves: Floats, held: tuple[Mask, Mask]) -> _Least | None:
        """The pass with held controls, whose gains go with the given changes, and the model there."""
        found = self._fixed(held)
        at = None if found is None else self._at(found, moves)
        return None if found is None or at is None else _Least(self, found, at)

    def _interior(self, plan: Plan) -> tuple[Floats, tuple[Mask, Mask], Box] | None:
        """Changes near the minimum by a primal-dual interior-point method.

        Also which controls are at each limit, and the model with the rows that are active there.
        """
        if self.rows is not None:
            return self._interior_with_rows(plan, self.rows)
        fixed, bounded, size, z = self._begin(plan)
        count = int(bounded[0].sum() + bounded[1].sum())
        if count == 0 or not plan.expected_decrease > 0.0:
            return None
        slack = self._slack((fixed, np.zeros_like(fixed)))
        mu = plan.expected_decrease / count
        gaps = self._gaps(z, bounded)
        duals = [mu / gap for gap in gaps]
        for _ in range(_INTERIOR_STEPS):
            if time.perf_counter() > self.until:
                return None
            # A step without centring, and one corrected by what that foresees (Mehrotra 1992).
            stiff = duals[0] / gaps[0] + duals[1] / gaps[1]
            limits = around_nominal(slack, self.along.states)._replace(factors=np.empty((*z.shape, z.shape[1])))
            found = self._passed(limits, stiff, -stiff * z)
            if found is None:
                return None
            to = foreseen(self.along, found, slack).moves
            d = np.where(fixed, 0.0, to - z)
            opening, turning = (d, -d), (-duals[0] * (1.0 + d / gaps[0]), -duals[1] * (1.0 - d / gaps[1]))
            length = min(1.0, _free_length((*gaps, *duals), (*opening, *turning)))
            mu = _complementarity(gaps, duals, bounded) / count
            ahead = [gap + length * more for gap, more in zip(gaps, opening, strict=True)]
            aims = [dual + length * more for dual, more in zip(duals, turning, strict=True)]
            mu *= (_complementarity(ahead, aims, bounded) / (count * mu)) ** 3
            aims = [np.where(rows, mu - a * b, 0.0) for rows, a, b in zip(bounded, opening, turning, strict=True)]
            push = aims[1] / gaps[1] - aims[0] / gaps[0]
            corrected = self._pushed(found, limits, to, stiff, push - stiff * z, push)
            if corrected is None:
                return None
            to = corrected
            d = np.where(fixed, 0.0, to - z)
            after = [(aims[0] - duals[0] * d) / gaps[0], (aims[1] + duals[1] * d) / gaps[1]]
            turning = after[0] - duals[0], after[1] - duals[1]
            length = min(1.0, _INSIDE * _free_length((*gaps, *duals), (d, -d, *turning)))
            z = z + length * d
            gaps = self._gaps(z, bounded)
            duals = [dual + length * more for dual, more in zip(duals, turning, strict=True)]
            value = 0.5 * float(((plan.gradient - stiff * (to - z) - push) * to).sum())
            if length > 0.9 and _complementarity(gaps, duals, bounded) <= _GAP * abs(value):
                break
        # A limit binds where its multiplier exceeds its gap, each relative to its size.
        scale = np.maximum(duals[0] + duals[1], 1e-300).max(axis=0)
        held = gaps[0] / size < duals[0] / scale, gaps[1] / size < duals[1] / scale
        return z, (held[0] | fixed, held[1] & ~held[0] & ~fixed), self

    def _pushed(
        self, plan: Plan, limits: Limits, to: Floats, stiff: Floats, pull: Floats, push: Floats
    ) -> Floats | None:
        """Changes of the controls to the minimum with a further gradient ``push``, which brings its sum to ``pull``.

        ``to`` are those without it, of a pass with the factors of ``limits``.
        """
        along, factors, (_, m), x = self.along, limits.factors, to.shape, self.along.states
        if factors is None or len(along.blocks) > 1:
            passed = self._passed(limits, stiff, pull)
            return None if passed is None else foreseen(along, passed, limits.slack).moves
        problem, alone = along.problem, along.with_gradient_alone(push)
        decision, control = np.nonzero(self.lower >= self.upper)
        factors[decision, control, control] = _FIRM
        feedforward, (feedback, previous) = np.empty(to.shape), gains_on_states(along, plan)
        gains = core.Gains(
            feedforward=feedforward,
            feedback=feedback,
            previous=previous,
            control_gradient=plan.gradient,
            costate=np.zeros((0, x)),
            spread=np.zeros((0, x, x)),
            factors=factors,
        )
        steps = alone.steps(0, problem.decisions * problem.hold, None, without_limits(m, x))
        core.run_gradients(problem.dt, problem.hold, 0.0, steps, gains, np.zeros(x))
        more: Floats = foreseen(alone, plan._replace(feedforward=feedforward), np.zeros((0, 2, m))).moves
        return to + more

    def _begin(self, plan: Plan) -> tuple[Mask, list[Mask], Floats, Floats]:
        """The beginning of an interior-point method.

        Returns the controls that cannot move, those with a lower and with an upper limit, the sizes of changes of each
        control, and changes close to none that are within the limits, all (R, m).
        """
        low, high = self.lower, self.upper
        fixed = low >= high
        bounded = [np.isfinite(low) & ~fixed, np.isfinite(high) & ~fixed]
        moved = np.abs(plan.feedforward).max(axis=0)
        both = bounded[0] & bounded[1]
        size = np.where(both, np.where(both, high, 0.0) - np.where(both, low, 0.0), np.where(moved > 0.0, moved, 1.0))
        return fixed, bounded, size, np.where(fixed, low, np.clip(0.0, low + 0.1 * size, high - 0.1 * size))

    def _gaps(self, z: Floats, bounded: list[Mask]) -> list[Floats]:
        """Distances of changes to the lower and the upper limits, infinite where there is none."""
        return [np.where(bounded[0], z - self.lower, np.inf), np.where(bounded[1], self.upper - z, np.inf)]

    def active_inside(self, plan: Plan) -> list[Mask] | None:
        """The active rows near the minimum without limits by an interior-point method, after a plan of the model."""
        free = copy(self)
        free.lower, free.upper = (np.full(self.proximal.shape, side) for side in (-np.inf, np.inf))
        inner = None if self.rows is None else free._interior_with_rows(plan, self.rows)
        return None if inner is None else inner[2].active

    def _interior_with_rows(self, plan: Plan, rows: Rows) -> tuple[Floats, tuple[Mask, Mask], Box] | None:
        """The same with the rows of penalties; it begins at the motion, as those far away would be far from bounds."""
        fixed, bounded, _, z = self._begin(plan)
        count = int(bounded[0].sum() + bounded[1].sum()) + int((~rows.equal).sum())
        if count == 0:
            return None
        slack = self._slack((fixed, np.zeros_like(fixed)))
        # Around a motion near the minimum multipliers have to grow, which takes large products.
        stake = rows.whole.stake.moved
        mu = max(plan.expected_decrease, _LARGE * stake) / count
        gaps = self._gaps(z, bounded)
        duals = [mu / gap for gap in gaps]
        begun = rows.ahead(self.along, without_feedback(plan, z), np.stack([z, z], axis=1))
        pushes = Pushes(rows, flat(begun), mu)
        past: list[float] = []  # gaps after the steps
        before: tuple[list[Floats], list[Floats]] | None = None
        for _ in range(_STEPS_WITH_ROWS):
            if time.perf_counter() > self.until:
                return None
            # Products of multipliers and gaps: now, and where a step should lead.
            mu = (_complementarity(gaps, duals, bounded) + float(pushes.products.sum())) / count
            aims = [np.zeros(z.shape)] * 2
            aim = np.zeros(1)
            stiff = duals[0] / gaps[0] + duals[1] / gaps[1]
            # First towards zero, then towards a multiple of mu that goes by how far this leads, with the products'
            # second-order terms (Mehrotra 1992).
            for centered in (False, True):
                pull = aims[1] / gaps[1] - aims[0] / gaps[0] - stiff * z
                box = Box(pushes.along(aim), self.curvature).with_proximal(self.proximal)
                found = box._passed(around_nominal(slack, self.along.states), stiff, pull)
                if found is None:
                    break
                towards = rows.ahead(box.along, found, slack)
                to = rows.ahead_of[1]
                d = np.where(fixed, 0.0, to - z)
                after = [(aims[0] - duals[0] * d) / gaps[0], (aims[1] + duals[1] * d) / gaps[1]]
                value = -found.expected_decrease - float(((0.5 * stiff * to + pull) * to).sum())
                value += pushes.towards(towards, aim)
                turning = after[0] - duals[0], after[1] - duals[1]
                values, changes = pushes.signs
                length = min(1.0, _INSIDE * _free_length((*gaps, *duals, *values), (d, -d, *turning, *changes)))
                if centered:
                    break
                opening = d, -d
                ahead = [gap + length * more for gap, more in zip(gaps, opening, strict=True)]
                aims = [dual + length * more for dual, more in zip(duals, turning, strict=True)]
                left = _complementarity(ahead, aims, bounded) + pushes.left(length)
                center = mu * (left / (count * mu)) ** 3
                aims = [
                    np.where(some, center - a * b, 0.0) for some, a, b in zip(bounded, opening, turning, strict=True)
                ]
                aim = center - pushes.bent
            if found is None:
                break
            z, before = z + length * d, (gaps, duals)
            gaps = self._gaps(z, bounded)
            duals = [dual + length * more for dual, more in zip(duals, turning, strict=True)]
            pushes.move(length)
            left = _complementarity(gaps, duals, bounded) + float(pushes.products.sum())
            if length > 0.9 and left <= _CLOSE * abs(value) + _NOTHING * stake:
                break
            past.append(left)
            if len(past) > _STILL and _STANDS * past[-1 - _STILL] < left < _SMALL * past[0]:
                break
        # Rounding errors of large products and small gaps may leave a pass no minimum.
        if before is None or (found is None and past[-1] > _SMALL * abs(value)):
            return None
        # In the last step the gap of a limit that binds fell by more than its multiplier, and that of others by less.
        held = [
            some & (np.where(some, gap, 0.0) * old_dual < dual * np.where(some, old_gap, 0.0))
            for some, gap, dual, old_gap, old_dual in zip(bounded, gaps, duals, *before, strict=True)
        ]
        return z, (held[0] | fixed, held[1] & ~held[0] & ~fixed), self._with_active(pushes.active)

    def _passed(self, limits: Limits, stiff: Floats | None = None, pull: Floats | None = None) -> Plan | None:
        """A pass with a further cost of the controls' changes: its Hessian's diagonal and its gradient (R, m)."""
        along = self.along
        if stiff is not None and pull is not None:
            along = along.with_cost_of_controls(self.proximal + stiff, pull)
        elif self.proximal.any():
            along = along.with_cost_of_controls(self.proximal)
        return single_pass(along, 0.0, curvature=self.curvature, limits=limits)[0]

    def _at(self, plan: Plan, moves: Floats) -> _Point | None:
        """The model and its gradient at changes of the controls."""
        still = without_feedback(plan, moves)
        slack, pressure = np.stack([moves, moves], axis=1), np.zeros(moves.shape)
        expected = foreseen(self.along, still, slack).expected
        found = self._passed(Limits(slack, expected, pressure=pressure))
        return None if found is None else _Point(moves, expected, -found.expected_decrease, pressure)

    def leading(self, least: _Least) -> Plan:
        """The plan to a minimum, with the feedback of its pass."""
        plan, at = least.plan, least.at
        x = 2 * self.along.problem.scene.robot.dof
        ahead = at.moves - np.einsum("kmx,kx->km", plan.feedback, at.expected[:, :x])
        if plan.previous is not None:
            ahead -= np.einsum("kmi,ki->km", plan.previous, at.expected[:, x : x + at.moves.shape[1]])
        slope = float((plan.gradient * at.moves).sum())
        value = at.value - 0.5 * float((self.proximal * at.moves**2).sum())
        curvature, left = 2.0 * (value - slope), at.pressure - self.proximal * at.moves
        return plan._replace(feedforward=ahead, slope=slope, curvature=curvature, limited=True, left=left)


class _Least(NamedTuple):
    """A minimum of a model within limits: the model with the rows active there, the pass, and the point."""

    box: Box
    plan: Plan
    at: _Point


class _Point(NamedTuple):
    """A point of a model within limits.

    Attributes:
        moves: Changes of the controls (R, m).
        expected: States and previous controls before each decision (R, 2n + m).
        value: The model's change.
        pressure: Its gradient in the controls (R, m).
    """

    moves: Floats
    expected: Floats
    value: float
    pressure: Floats


def _free_length(values: Sequence[Floats], changes: Sequence[Floats]) -> float:
    """The greatest length of a step at which positive values do not become negative."""
    length = math.inf
    for value, change in zip(values, changes, strict=True):
        closing = change < 0.0
        if closing.any():
            length = min(length, float((value[closing] / -change[closing]).min()))
    return length


def _complementarity(gaps: Sequence[Floats], duals: Sequence[Floats], bounded: Sequence[Mask]) -> float:
    return sum(float((dual[rows] * gap[rows]).sum()) for gap, dual, rows in zip(gaps, duals, bounded, strict=True))
