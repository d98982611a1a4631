"""The backward pass along a motion: a quadratic model of the cost to go, and the change of the controls it gives."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin import core
from varpin.arrays import Floats
from varpin.control.costs import CostError, Expansion
from varpin.control.descent import Model, Stake, at_stake
from varpin.control.linear_controls import (
    RULE,
    Derivatives,
    LinearSteps,
    after_impulse,
    at_samples,
    curvature_on_lines,
    derivatives,
    in_step,
    linear_steps,
    noisy,
    size,
    widened,
    with_pull,
)
from varpin.control.moments import noise_gradient
from varpin.control.penalties import PenalizedProblem, PenalizedRate, controls_of_steps, flat, rate_columns
from varpin.control.problem import OptimalControlProblem
from varpin.control.spread import Feedback, state_slopes
from varpin.control.square_root import Squares, squares_of
from varpin.control.within_steps import beyond_samples
from varpin.errors import LinearizationError
from varpin.integrators.base import noise_fields
from varpin.linearization import (
    Linearization,
    linearize_steps,
    second_order_steps,
    velocity_at_nodes,
    velocity_curvature,
)
from varpin.mechanics.forces import limited_servos
from varpin.trajectory import Trajectory

Mask = NDArray[np.bool_]

# Number of nodes that are linearized at a time; longer motions do not keep their derivatives.
_BLOCK = 2048

# Bisections of the line search between two passes.
_BISECTIONS = 40

# Greatest numbers of active sets and of interior-point steps to the model's minimum within limits, its gap relative to
# the model's change, and rounding errors of changes and slopes relative to the largest ones.
_ACTIVE_SETS, _INTERIOR_STEPS, _GAP, _ROUNDED = 8, 40, 1e-5, 1e-11
# Active sets end where, after the first ones, a change is not smaller than this share of the one before.
_SETTLING, _SHRINKING = 1, 0.75

# Pivot of a control that cannot move.
_FIRM = 1e300

# Greatest relative rounding error of Quu; above, the pass is repeated on square roots.
TRUSTED = 1e-9


@dataclass(frozen=True, eq=False)
class Plan:
    """The result of a backward pass: gains, feed-forward changes of the controls, and the expected decrease."""

    feedforward: Floats  # (R, m)
    feedback: Floats  # (R, m, 2n)
    previous: Floats | None  # (R, m, m) gains on the previous control, with a rate cost or linear controls
    gradient: Floats  # (R, m)
    slope: float
    curvature: float
    noise: float  # cost of the noise along the motion
    jumps: Floats  # (N, 2n, n), empty without noise
    spread: Floats  # (N, 2n, 2n)
    limited: bool
    loss: float  # estimated relative rounding error of Quu, or of its root
    model: Model  # of the cost along the motion
    factors: Floats | None  # (R, m, m) L D L' of the regularized Quu, without limits and along motions of one block
    left: Floats | None = None  # (R, m) the model's gradient after a full step, which presses controls against limits

    @property
    def expected_decrease(self) -> float:
        """Decrease of the expected cost with a full step, by the model."""
        # Without limits the step is the model's minimum, where curvature = -slope.
        return -self.slope - 0.5 * self.curvature if self.limited else -0.5 * self.slope

    def followed(self, length: float) -> Plan:
        """The plan after a step of the given length, by the model: the same gains and the rest of the step."""
        left = 1.0 - length
        return replace(self, feedforward=left * self.feedforward, gradient=left * self.gradient)

    def free_gradient(self, problem: OptimalControlProblem, trajectory: Trajectory) -> Floats:
        """The gradient (R, m), zero where it pushes a control against its active limit; zero at an optimum."""
        if not problem.limited:
            return self.gradient
        u, (lower, upper) = problem.decided(trajectory), problem.control_limits
        held = ((u <= lower) & (self.gradient > 0.0)) | ((u >= upper) & (self.gradient < 0.0))
        return np.where(held, 0.0, self.gradient)


def states(problem: OptimalControlProblem, trajectory: Trajectory) -> Floats:
    """X (N + 1, 2n): (q, p) or (q, v)."""
    second = trajectory.p if problem.integrator.variational else trajectory.v
    return np.concatenate((trajectory.q, second), axis=1)


def noise_shares(
    problem: OptimalControlProblem, trajectory: Trajectory, plan: Plan, processes: NDArray[np.bool_] | None = None
) -> Floats:
    """Noise cost of each step of a motion (N,), with the noise's effect and value function of the plan's own motion.

    ``processes`` (K,) selects increments, by default all. Empty where there is no noise.
    """
    if problem.processes == 0:
        return np.zeros(0)
    g = impulses(problem, trajectory, plan.jumps)
    if processes is not None:
        g = g[:, :, processes]
    added: Floats = 0.5 * np.einsum("Nai,Nai->N", g, plan.spread @ g)
    return added


def impulses(problem: OptimalControlProblem, trajectory: Trajectory, jumps: Floats) -> Floats:
    """Effect of each increment on the state after each step of a motion (N, 2n, K), for given ``jumps``."""
    scene, n, left = problem.scene, problem.scene.robot.dof, problem.integrator.left
    q, v = trajectory.q, trajectory.v
    jump = noise_fields(scene, trajectory, q[:-1], v[:-1], problem.q0).F
    if not problem.integrator.variational:
        jump = velocity_at_nodes(scene, q[:-1], v[:-1])[:, :, n:] @ jump
    g: Floats = left * (jumps @ jump)
    if left < 1.0:
        g[:, n:] += (1.0 - left) * noise_fields(scene, trajectory, q[1:], v[1:], problem.q0).F
    return g


def _curvature(along: Along, plan: Plan, costate: Floats) -> Floats:
    """Second-derivative terms of dynamics and noise fields in the cost to go (N, 2n + m, 2n + m), in (x, u).

    With linear controls they are those of N + 1 steps in (X, u).
    """
    problem, trajectory = along.problem, along.trajectory
    scene, n, h = problem.scene, problem.scene.robot.dof, problem.dt
    N, samples, rule = problem.steps, len(problem.model_rule), problem.model_rule
    gradient = problem.expand_running(trajectory).gradient.reshape(N, samples, -1)
    by_q, by_v = gradient[:, :, :n], gradient[:, :, n : 2 * n]
    # The running cost's gradient in q0, v0, q1 and v1 of each step.
    pulls = [
        h * np.einsum("s,Nsi->Ni", rule[:, 0] * rule[:, 1 + c], by_q)
        + h * np.einsum("s,Nsi->Ni", rule[:, 0] * rule[:, 5 + c], by_v)
        for c in range(4)
    ]
    z = costate.copy()
    z[:, :n] += pulls[2]
    after = bool(rule[:, [4, 8]].any())
    if after:
        z += np.einsum("Ni,Nix->Nx", pulls[3], velocity_at_nodes(scene, trajectory.q[1:], trajectory.v[1:]))
    second = second_order_steps(scene, trajectory, z, problem.integrator)
    if problem.linear:
        total = curvature_on_lines(problem, trajectory, z, second.xx)
    else:
        total = np.block([[second.xx, np.swapaxes(second.ux, 1, 2)], [second.ux, second.uu]])
    if rule[:, [2, 6]].any():
        total[:, : 2 * n, : 2 * n] += velocity_curvature(scene, trajectory.q[:-1], trajectory.v[:-1], pulls[1])
    if after:
        J, _ = in_step(_linearize(problem, trajectory, 0))
        total += np.swapaxes(J, 1, 2) @ velocity_curvature(scene, trajectory.q[1:], trajectory.v[1:], pulls[3]) @ J
    if problem.processes and problem.integrator.variational:
        pull = plan.spread @ impulses(problem, trajectory, plan.jumps)
        weight = problem.integrator.left * np.swapaxes(plan.jumps, 1, 2) @ pull
        total[:, :n, :n] += scene.noise.curvature(weight[:, :, : scene.processes])
    return widened(total, scene.controls) if problem.linear else total


def backward(
    problem: OptimalControlProblem,
    trajectory: Trajectory,
    regularization: float,
    second_order: bool = False,
    *,
    along: Along | None = None,
    demands: bool = False,
    clipped: bool = False,
) -> Plan | None:
    """One backward pass along a motion; None where the model has no minimum in a control.

    ``along`` has the expansions of other passes along the motion. With ``demands``, ``regularization`` also applies to
    what servos demand of their drives, relative to the cost at stake. ``clipped`` leaves out the limits of controls.

    Raises:
        CostError: An expansion of the cost is not finite.
        LinearizationError: A step has no derivative.
    """
    along = Along(problem, trajectory) if along is None else along
    if clipped:
        along = copy(along)
        along.clipped = True
    damping = regularization * along.stake.moved * along.demands if demands and regularization > 0.0 else None
    if not second_order:
        return _foreseeing(along, regularization, damping)
    # First derivatives of the cost to go, then with them second derivatives of the dynamics (stagewise Newton).
    plan, costate = _pass(along, max(regularization, 1e-3), costates=True)
    if plan is None:
        return None
    curvature = _curvature(along, plan, costate)
    return _foreseeing(along, regularization, curvature if damping is None else curvature + damping)


def feedforward_beside(along: Along, plan: Plan, regularization: float, trajectory: Trajectory) -> Floats:
    """The feed-forward part (R, m) of a plan around a motion close to its own, of which it has ``factors``.

    The cost's gradients are those along the motion close by; its Hessians, those of the dynamics and the gains are the
    plan's.
    """
    problem, m = along.problem, along.problem.scene.controls
    terminal, x = along.terminal, along.states
    end = problem.expand_terminal(trajectory).gradient[0, :x]
    feedforward = np.empty_like(plan.feedforward)
    gains = core.Gains(
        feedforward=feedforward,
        feedback=plan.feedback,
        previous=np.zeros((0, m, m)) if plan.previous is None else plan.previous,
        control_gradient=plan.gradient,
        costate=np.zeros((0, x)),
        spread=plan.spread,
        factors=plan.factors,
    )
    steps = along.beside(trajectory).steps(0, problem.steps, None, _without_limits(m, x))
    core.run_gradients(problem.dt, problem.hold, regularization, steps, gains, terminal.slopes.T @ end)
    return feedforward


def _foreseeing(along: Along, regularization: float, curvature: Floats | None) -> Plan | None:
    """The pass with the penalties that are active on the linearized motion.

    A penalty is zero up to its bound and a parabola beyond. A model around the nominal motion has only the rows active
    there, not those that the step activates. So passes are repeated until their active rows are those of their
    linearized motion: Newton steps with exact line search to the minimum of the piecewise quadratic model. If these do
    not converge, the result is the best pass or the last point of the steps.
    """
    problem = along.problem
    if not (isinstance(problem, PenalizedProblem) and problem.passes) or len(along.blocks) > 1:
        return _within_limits(along, regularization, curvature)
    rows = _Rows(along, problem)
    held, best, least = rows.begun, None, 0.0
    for done in range(1, problem.passes + 1):
        passing = rows.along(held)
        plan = _within_limits(passing, regularization, curvature)
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
        return _within_limits(along, regularization, curvature)
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


def _within_limits(along: Along, regularization: float, curvature: Floats | None) -> Plan | None:
    """The pass to the model's minimum with controls within their limits.

    Around the nominal states, late decisions seem to reach their limits because each would have to make up for the
    earlier ones. So the first pass has no limits, and where its linearized motion reaches some, further passes lead to
    the minimum.
    """
    problem = along.problem
    if not problem.limited or along.clipped:
        return _pass(along, regularization, curvature=curvature)[0]
    stiffness = np.zeros((problem.decisions, problem.scene.controls))
    free = _at_limits(along.slack[:0], along.states)._replace(stiffness=stiffness)
    plan = _pass(along, regularization, curvature=curvature, limits=free)[0]
    if plan is not None:
        moves = _foreseen(along, plan)[1]
        lower, upper = along.slack[:, 0], along.slack[:, 1]
        if not ((moves <= lower) | (moves >= upper)).any():
            return _sloped(plan, moves)
        if problem.processes:
            plan = _matching(along, regularization, curvature, plan)
        else:
            plan = _Box(along, regularization * np.abs(stiffness), curvature).minimum(plan, moves)
        if plan is not None:
            return plan
    return _pass(along, regularization, curvature=curvature, limits=_at_limits(along.slack, along.states))[0]


def _sloped(plan: Plan, moves: Floats) -> Plan:
    """A plan with the slope of the controls' changes (R, m) on its linearized motion.

    The feed-forward parts belong together with the feedback, so the slope is that of both.
    """
    slope = float((plan.gradient * moves).sum())
    if not (plan.expected_decrease > 0.0 and slope < 0.0):
        return plan
    return replace(plan, slope=slope, curvature=-2.0 * (plan.expected_decrease + slope), limited=True)


def _matching(along: Along, regularization: float, curvature: Floats | None, plan: Plan) -> Plan | None:
    """Under noise: passes within the limits that the linearized motion reaches, until these do not change.

    None if ever more of them change. The noise cost depends on the gains, so passes have no common model.
    """
    held: NDArray[np.bool_] = np.zeros(plan.feedforward.shape, dtype=np.bool_)
    others, found, (expected, moves) = held.size + 1, plan, _foreseen(along, plan)
    while others > 0:
        limits = _Limits(along.slack, expected)
        passed = _pass(along, regularization, curvature=curvature, limits=limits)[0]
        if passed is None:
            return None
        found = passed
        now = np.logical_not(found.feedback.any(axis=2))
        # Where motions stay at limits for long, these passes may not converge.
        changed = int((now != held).sum())
        if changed >= others:
            return None
        held, others = now, changed
        expected, moves = _foreseen(along, found)
    made = _sloped(found, moves)
    return made if made is not found else None


class _Box:
    """The model of a motion in the changes of its controls (R, m), which have to stay within their limits.

    Its minimum is found by passes with the controls at limits fixed, whose set changes until no other control exceeds a
    limit and no fixed one would leave its own; where these do not end, after a primal-dual interior-point method, whose
    steps are passes, too. ``proximal`` (R, m) regularizes: the Hessian of a further cost of the changes.
    """

    def __init__(self, along: Along, proximal: Floats, curvature: Floats | None) -> None:
        self.along, self.proximal, self.curvature = along, proximal, curvature
        self.lower, self.upper = along.slack[:, 0], along.slack[:, 1]

    def minimum(self, plan: Plan, moves: Floats) -> Plan | None:
        """The plan to the minimum, from the plan without limits and the controls' changes of its linearized motion."""
        found = self._active_sets(plan, (moves <= self.lower, moves >= self.upper))
        if found is None:
            inner = self._interior(plan, np.clip(moves, self.lower, self.upper))
            if inner is None:
                return None
            at, held = inner
            found = self._active_sets(plan, held) or self._with_gains(at, held)
        if found is None or not found[1].value < 0.0:
            return None
        return self._leading(*found)

    def _active_sets(self, plan: Plan, held: tuple[Mask, Mask]) -> tuple[Plan, _Point] | None:
        """The last pass and the minimum by a primal-dual active set; None if it takes too many passes.

        It begins with the controls ``held`` at a lower and at an upper limit (Hintermueller, Ito and Kunisch 2002).
        """
        low, high, changed = self.lower, self.upper, math.inf
        for done in range(_ACTIVE_SETS):
            found = self._fixed(held)
            if found is None:
                return None
            at = self._at(plan, _foreseen(self.along, found, self._slack(held))[1])
            if at is None:
                return None
            size, force = _ROUNDED * np.abs(at.moves).max(axis=0), _ROUNDED * np.abs(at.pressure).max(axis=0)
            now = (
                np.where(held[0], at.pressure >= -force, at.moves < low - size),
                np.where(held[1], at.pressure <= force, at.moves > high + size),
            )
            fixed = low >= high
            now = now[0] | fixed, now[1] & ~fixed
            if np.array_equal(now[0], held[0]) and np.array_equal(now[1], held[1]):
                return found, at._replace(moves=np.clip(at.moves, low, high))
            before, changed = changed, int((now[0] != held[0]).sum() + (now[1] != held[1]).sum())
            if done >= _SETTLING and changed > _SHRINKING * before:
                return None
            held = now
        return None

    def _slack(self, held: tuple[Mask, Mask]) -> Floats:
        """Limits (R, 2, m) that fix the held controls only."""
        at = np.where(held[0], self.lower, np.where(held[1], self.upper, 0.0))
        either = held[0] | held[1]
        return np.stack([np.where(either, at, -np.inf), np.where(either, at, np.inf)], axis=1)

    def _fixed(self, held: tuple[Mask, Mask]) -> Plan | None:
        slack = self._slack(held)
        return self._passed(_at_limits(slack, self.along.states))

    def _with_gains(self, moves: Floats, held: tuple[Mask, Mask]) -> tuple[Plan, _Point] | None:
        """The pass with held controls, whose gains go with the given changes, and the model there."""
        found = self._fixed(held)
        at = None if found is None else self._at(found, moves)
        return None if found is None or at is None else (found, at)

    def _interior(self, plan: Plan, begin: Floats) -> tuple[Floats, tuple[Mask, Mask]] | None:
        """Changes near the minimum by a primal-dual interior-point method, and which controls are at each limit."""
        low, high = self.lower, self.upper
        fixed = low >= high
        bounded = [np.isfinite(low) & ~fixed, np.isfinite(high) & ~fixed]
        count = int(bounded[0].sum() + bounded[1].sum())
        if count == 0 or not plan.expected_decrease > 0.0:
            return None
        # The size of changes of each control.
        moved = np.abs(plan.feedforward).max(axis=0) + np.abs(begin).max(axis=0)
        both = bounded[0] & bounded[1]
        size = np.where(both, np.where(both, high, 0.0) - np.where(both, low, 0.0), np.where(moved > 0.0, moved, 1.0))
        z = np.where(fixed, low, np.clip(0.0, low + 0.1 * size, high - 0.1 * size))
        slack = self._slack((fixed, np.zeros_like(fixed)))
        gaps = [np.where(bounded[0], z - low, np.inf), np.where(bounded[1], high - z, np.inf)]
        mu = plan.expected_decrease / count
        duals = [mu / gap for gap in gaps]
        for _ in range(_INTERIOR_STEPS):
            # A step without centring, and one corrected by what that foresees (Mehrotra 1992).
            stiff = duals[0] / gaps[0] + duals[1] / gaps[1]
            limits = _at_limits(slack, self.along.states)._replace(factors=np.empty((*z.shape, z.shape[1])))
            found = self._passed(limits, stiff, -stiff * z)
            if found is None:
                return None
            to = _foreseen(self.along, found, slack)[1]
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
            length = min(1.0, 0.995 * _free_length((*gaps, *duals), (d, -d, *turning)))
            z = z + length * d
            gaps = [np.where(bounded[0], z - low, np.inf), np.where(bounded[1], high - z, np.inf)]
            duals = [dual + length * more for dual, more in zip(duals, turning, strict=True)]
            value = 0.5 * float(((plan.gradient - stiff * (to - z) - push) * to).sum())
            if length > 0.9 and _complementarity(gaps, duals, bounded) <= _GAP * abs(value):
                break
        # A limit binds where its multiplier exceeds its gap, each relative to its size.
        scale = np.maximum(duals[0] + duals[1], 1e-300).max(axis=0)
        held = gaps[0] / size < duals[0] / scale, gaps[1] / size < duals[1] / scale
        return z, (held[0] | fixed, held[1] & ~held[0] & ~fixed)

    def _pushed(
        self, plan: Plan, limits: _Limits, to: Floats, stiff: Floats, pull: Floats, push: Floats
    ) -> Floats | None:
        """Changes of the controls to the minimum with a further gradient ``push``, which brings its sum to ``pull``.

        ``to`` are those without it, of a pass with the factors of ``limits``.
        """
        along, factors, (_, m), x = self.along, limits.factors, to.shape, self.along.states
        if factors is None or len(along.blocks) > 1:
            passed = self._passed(limits, stiff, pull)
            return None if passed is None else _foreseen(along, passed, limits.slack)[1]
        problem, alone = along.problem, along.with_gradient_alone(push)
        decision, control = np.nonzero(self.lower >= self.upper)
        factors[decision, control, control] = _FIRM
        feedforward, (feedback, previous) = np.empty(to.shape), _gains_on_states(along, plan)
        gains = core.Gains(
            feedforward=feedforward,
            feedback=feedback,
            previous=previous,
            control_gradient=plan.gradient,
            costate=np.zeros((0, x)),
            spread=np.zeros((0, x, x)),
            factors=factors,
        )
        steps = alone.steps(0, problem.decisions * problem.hold, None, _without_limits(m, x))
        core.run_gradients(problem.dt, problem.hold, 0.0, steps, gains, np.zeros(x))
        more: Floats = _foreseen(alone, replace(plan, feedforward=feedforward), np.zeros((0, 2, m)))[1]
        return to + more

    def _passed(self, limits: _Limits, stiff: Floats | None = None, pull: Floats | None = None) -> Plan | None:
        """A pass with a further cost of the controls' changes: its Hessian's diagonal and its gradient (R, m)."""
        along = self.along
        if stiff is not None and pull is not None:
            along = along.with_cost_of_controls(self.proximal + stiff, pull)
        elif self.proximal.any():
            along = along.with_cost_of_controls(self.proximal)
        return _pass(along, 0.0, curvature=self.curvature, limits=limits)[0]

    def _at(self, plan: Plan, moves: Floats) -> _Point | None:
        """The model and its gradient at changes of the controls."""
        still = replace(plan, feedforward=moves, feedback=np.zeros(plan.feedback.shape))
        if plan.previous is not None:
            still = replace(still, previous=np.zeros(plan.previous.shape))
        slack, pressure = np.stack([moves, moves], axis=1), np.zeros(moves.shape)
        expected = _foreseen(self.along, still, slack)[0]
        found = self._passed(_Limits(slack, expected, pressure=pressure))
        return None if found is None else _Point(moves, expected, -found.expected_decrease, pressure)

    def _leading(self, plan: Plan, at: _Point) -> Plan:
        """The plan to a point of the model, with the feedback of ``plan``."""
        x = 2 * self.along.problem.scene.robot.dof
        ahead = at.moves - np.einsum("kmx,kx->km", plan.feedback, at.expected[:, :x])
        if plan.previous is not None:
            ahead -= np.einsum("kmi,ki->km", plan.previous, at.expected[:, x : x + at.moves.shape[1]])
        slope = float((plan.gradient * at.moves).sum())
        value = at.value - 0.5 * float((self.proximal * at.moves**2).sum())
        curvature, left = 2.0 * (value - slope), at.pressure - self.proximal * at.moves
        return replace(plan, feedforward=ahead, slope=slope, curvature=curvature, limited=True, left=left)


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


def _foreseen(along: Along, plan: Plan, slack: Floats | None = None) -> tuple[Floats, Floats]:
    """The linearized motion under a plan whose controls are clipped to their limits, or to ``slack`` (R, 2, m).

    Returns the state and the change of the previous control before each decision (R, 2n + m), and the controls' changes
    (R, m). Where controls are linear between nodes the state is X of :mod:`varpin.control.linear_controls`.
    """
    problem, (R, m, _), x = along.problem, plan.feedback.shape, along.states
    feedback, previous = _gains_on_states(along, plan)
    expected, moves, state = np.empty((R, x + m)), np.empty((R, m)), np.zeros(x + m)
    spread = np.zeros((R if plan.spread.size else 0, x, x)) if problem.linear else plan.spread
    for begin, end in along.blocks:
        rows = slice(begin // problem.hold, end // problem.hold)
        gains = core.Gains(
            feedforward=plan.feedforward[rows],
            feedback=feedback[rows],
            previous=previous[rows],
            control_gradient=plan.gradient[rows],
            costate=np.zeros((0, x)),
            spread=spread[begin:end],
        )
        within = _at_limits(along.slack if slack is None else slack, x)
        steps = along.steps(begin, end, None, within)
        core.foresee(problem.hold, steps, gains, state, expected[rows], moves[rows])
    return expected, moves


def _gains_on_states(along: Along, plan: Plan) -> tuple[Floats, Floats]:
    """A plan's feedback on the states of its pass, and on previous controls where these are no part of the state."""
    (R, m, n), x = plan.feedback.shape, along.states
    if plan.previous is None or not along.problem.linear:
        return plan.feedback, np.zeros((0, m, m)) if plan.previous is None else plan.previous
    feedback = np.zeros((R, m, x))
    feedback[:, :, :n] = plan.feedback
    feedback[:, :, n : n + m] = plan.previous
    return feedback, np.zeros((0, m, m))


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


class _Limits(NamedTuple):
    """Control limits for a pass: their ``slack`` (R, 2, m), and the ``expected`` states (R, 2n + m).

    The slack is empty without limits, the expected states around the nominal ones. The pass fills in the diagonal of
    Quu without regularization in ``stiffness`` (R, m), the gradient at the expected states in ``pressure`` (R, m), and
    L D L' of the regularized Quu of free controls in ``factors`` (R, m, m).
    """

    slack: Floats
    expected: Floats
    stiffness: Floats | None = None
    pressure: Floats | None = None
    factors: Floats | None = None

    def part(self, rows: slice) -> dict[str, Floats | None]:
        """What the pass fills in for some decisions."""
        return {
            "stiffness": None if self.stiffness is None else self.stiffness[rows],
            "pressure": None if self.pressure is None else self.pressure[rows],
            "factors": None if self.factors is None else self.factors[rows],
        }


def _without_limits(controls: int, states: int) -> _Limits:
    return _at_limits(np.zeros((0, 2, controls)), states)


def _at_limits(slack: Floats, states: int) -> _Limits:
    """Limits around the nominal states, with ``slack`` (R, 2, m)."""
    return _Limits(slack, np.zeros((0, states + slack.shape[2])))


class Along:
    """Expansions along a motion that all its passes share; the linearization is kept where it is one block."""

    def __init__(self, problem: OptimalControlProblem, trajectory: Trajectory) -> None:
        self.problem, self.trajectory = problem, trajectory
        m = problem.scene.controls
        self.rate, self.pull = np.zeros((0, m, m)), np.zeros((0, m))
        if problem.rate is not None:
            self.pull, self.rate = problem.rate.expand(problem.decided(trajectory), problem.period)
        self.slack = np.zeros((0, 2, m))
        self.clipped = False  # whether passes leave the limits to the motion, which clips controls
        if problem.limited:
            self.slack = problem.control_limits - problem.decided(trajectory)[:, None]
        block = max(1, _BLOCK // problem.hold) * problem.hold
        self.blocks = [(max(0, end - block), end) for end in range(problem.steps, 0, -block)][::-1]
        # The number of states of the pass; with linear controls the state contains the control.
        self.states = 2 * problem.scene.robot.dof
        if problem.linear:
            self.blocks, self.states = [(0, problem.decisions)], size(problem)
        self.kept: tuple[Linearization, Floats] | None = None
        # Gradient of the noise cost, added to the cost's gradient at its samples (N s, 2n + m) once it is known.
        self.added: Floats | None = None
        # With linear controls in (x, w, u) of each step (N, 2n + 2m).
        self.pulled: Floats | None = None
        self.noise_differentiated = False
        # Hessians of a further cost of controls, added to those of steps (N, 2n + m, 2n + m).
        self.firm: Floats | None = None

    def beside(self, trajectory: Trajectory) -> Along:
        """The expansions with the gradients of the running cost along a motion close by."""
        made, problem = copy(self), self.problem
        made.running = Expansion(problem.expand_running(trajectory).gradient, self.running.hessian)
        if problem.rate is not None:
            made.pull, _ = problem.rate.expand(problem.decided(trajectory), problem.period)
        return made

    @cached_property
    def running(self) -> Expansion:
        """The running cost at its samples."""
        problem, found = self.problem, self.problem.expand_running(self.trajectory)
        for name, array in (("gradient", found.gradient), ("Hessian", found.hessian)):
            if not np.isfinite(array).all():
                raise CostError(repr(problem.cost), f"its {name} along the motion is not finite")
        return found

    def differentiate_noise(self, plan: Plan, processes: NDArray[np.bool_]) -> None:
        """Add the whole gradient of the noise cost of ``processes`` (K,) under the plan's gains to later passes."""
        problem, N = self.problem, self.problem.steps
        feedback = Feedback(plan.feedback, plan.previous)
        lin = self.linearized(0, N)[0] if len(self.blocks) == 1 else None
        pull = noise_gradient(problem, self.trajectory, feedback, self.rate, processes, lin, plan.spread)
        if problem.linear:
            self.pulled, self.noise_differentiated = pull, True
            vars(self).pop("line", None)
            return
        # A gradient in (x, u) is one in (q, v, u) at the step's first sample.
        lin, velocity = self.linearized(0, N)
        rule, x, m = problem.model_rule, 2 * problem.scene.robot.dof, problem.scene.controls
        D = np.zeros((N, x + m, x + m))
        D[:, :x] = at_samples(rule[:1], np.concatenate([lin.A, lin.B], axis=2), velocity)[0]
        D[:, x:, x:] = np.eye(m)
        added = np.zeros((N, len(rule), x + m))
        added[:, 0] = np.linalg.solve(np.swapaxes(D, 1, 2), pull[:, :, None])[:, :, 0] / (problem.dt * rule[0, 0])
        self.added, self.noise_differentiated = added.reshape(-1, x + m), True

    def with_cost_of_controls(self, diagonal: Floats, gradient: Floats | None = None) -> Along:
        """These expansions with a further cost of the changes of decided controls: both (R, m)."""
        made, problem, (R, m), x = copy(self), self.problem, diagonal.shape, self.states
        made.firm = np.zeros((R * problem.hold, x + m, x + m))
        entries = np.arange(x, x + m)
        made.firm[:, entries, entries] = np.repeat(diagonal / problem.hold, problem.hold, axis=0)
        if gradient is None:
            return made
        if problem.linear:
            total = self.line.gradient.copy()
            total[:, -m:] += gradient / problem.dt
            vars(made)["line"] = self.line._replace(gradient=total)
            return made
        rule = problem.model_rule
        added = np.zeros((problem.steps, len(rule), x + m))
        added[:, 0, x:] = np.repeat(gradient / problem.hold, problem.hold, axis=0) / (problem.dt * rule[0, 0])
        made.added = added.reshape(-1, x + m) if self.added is None else self.added + added.reshape(-1, x + m)
        return made

    def with_gradient_alone(self, gradient: Floats) -> Along:
        """These steps with a gradient of the changes of decided controls (R, m) as the only one."""
        made = copy(self)
        if self.problem.linear:
            vars(made)["line"] = self.line._replace(gradient=np.zeros(self.line.gradient.shape))
        else:
            made.running = Expansion(np.zeros(self.running.gradient.shape), self.running.hessian)
        made.added, made.pull = None, np.zeros(self.pull.shape)
        return made.with_cost_of_controls(np.zeros(gradient.shape), gradient)

    @property
    def slopes(self) -> Floats:
        """The gradient of the running cost at its samples, with that of the noise cost if it was added."""
        return self.running.gradient if self.added is None else self.running.gradient + self.added

    @cached_property
    def within(self) -> Floats | None:
        """The Hessian (N, 2n, 2n), in the noise's jumps, of what their velocities cost beyond the samples."""
        problem, hessian, samples = self.problem, self.running.hessian, len(self.problem.model_rule)
        if not (problem.processes and problem.integrator.holds_noise):
            return None
        found: list[Floats] = []
        for begin, end in [(0, problem.steps)] if problem.linear else self.blocks:
            part, points = self.trajectory.part(begin, end), slice(begin * samples, end * samples)
            own = hessian[points] if len(hessian) > 1 else hessian
            lin = self.linearized(begin, end)[0]
            try:
                more = beyond_samples(problem, part, lin, own, samples)
            except LinearizationError as error:
                raise _in_whole(error, begin, problem.dt) from None
            if more is None:
                return None
            found.append(more)
        return np.concatenate(found)

    @cached_property
    def stake(self) -> Stake:
        """The cost at stake along the motion."""
        return at_stake(self.problem, self.trajectory, self.model)

    @cached_property
    def model(self) -> Model:
        """The quadratic model of the cost along the motion."""
        return Model(self.running, self.terminal.cost)

    @cached_property
    def terminal(self) -> _Terminal:
        """The terminal cost at the end of the motion."""
        problem, q, v = self.problem, self.trajectory.q[-1:], self.trajectory.v[-1:]
        n = problem.scene.robot.dof
        end, x = problem.expand_terminal(self.trajectory), slice(0, 2 * n)
        cost = Expansion(end.gradient[:1, x], end.hessian[:1, x, x])
        g, H, D = cost.gradient[0], cost.hessian[0], np.eye(2 * n)
        if problem.integrator.variational:
            # The linearization of a motion of one block is kept, and includes the last node.
            slopes = self.linearized(0, problem.steps)[1] if len(self.blocks) == 1 else D[:0, n:]
            D[n:] = slopes[-1] if len(slopes) else velocity_at_nodes(problem.scene, q, v)[0]
            g, H = D.T @ g, D.T @ H @ D
        return _Terminal(cost, D, g, H)

    @cached_property
    def line(self) -> LinearSteps:
        """The steps with the control in the state, where controls are linear between nodes."""
        problem, found, lines = self.problem, self.running, self.of_lines
        steps = linear_steps(problem, lines, found, self.rate, self.pull)
        if problem.processes:
            x = lines.A.shape[1]
            kicked = after_impulse(problem.model_rule, found.hessian, lines.velocity, problem.steps, x, problem.dt)
            if self.within is not None:
                kicked = kicked + self.within
            steps = noisy(steps, lines, kicked)
        return steps if self.pulled is None else with_pull(steps, self.pulled, problem.dt)

    @cached_property
    def of_lines(self) -> Derivatives:
        """Derivatives of the steps whose controls are linear between nodes."""
        return derivatives(*self.linearized(0, self.problem.steps))

    @cached_property
    def demands(self) -> Floats:
        """Hessians (N, 2n + m, 2n + m) in (x, u) of the squared changes of what servos demand of their drives.

        The demand is that at the begin of a step, with linear controls of the step's mean control, in units of the
        effort limit. With linear controls they are those of N + 1 steps in (X, u).
        """
        problem, motion, scene = self.problem, self.trajectory, self.problem.scene
        n, m, N = problem.scene.robot.dof, problem.scene.controls, problem.steps
        speed = state_slopes(problem, motion)[:-1, n:]
        ends = 2 if problem.linear else 1
        found = np.zeros((N, 2 * n + ends * m, 2 * n + ends * m))
        for servo in limited_servos(scene.elements):
            c, (stiffness, damping, effort) = servo.coordinate, servo.values
            row = np.zeros((N, 2 * n + ends * m))
            row[:, : 2 * n] = -damping * speed[:, c]
            row[:, c] -= stiffness
            row[:, 2 * n :] = np.tile(scene.actuation[c] / ends, ends)
            found += np.einsum("Na,Nb->Nab", row, row) / effort**2
        return widened(found, m) if problem.linear else found

    @property
    def maps(self) -> tuple[Floats, Floats]:
        """A and B of all steps of a pass whose motion is one block, with the control in the state if it is linear."""
        if self.problem.linear:
            return self.line.A, self.line.B
        lin, _ = self.linearized(0, self.problem.steps)
        return lin.A, lin.B

    def linearized(self, begin: int, end: int) -> tuple[Linearization, Floats]:
        """A block of steps, and dv/dx at its nodes where they are needed."""
        if self.kept is not None:
            return self.kept
        problem, part = self.problem, self.trajectory.part(begin, end)
        # dv/dx is needed where the cost samples velocities of nodes and x holds momenta.
        nodes = problem.integrator.variational and problem.at_velocities
        lin = _linearize(problem, part, begin)
        n = problem.scene.robot.dof
        velocity = velocity_at_nodes(problem.scene, part.q, part.v) if nodes else np.zeros((0, n, 2 * n))
        if len(self.blocks) == 1:
            self.kept = lin, velocity
        return lin, velocity

    def steps(self, begin: int, end: int, curvature: Floats | None, limits: _Limits) -> core.ExpandedSteps:
        """The expansions of a block of steps for the core."""
        if self.firm is not None:
            curvature = self.firm if curvature is None else curvature + self.firm
        if self.problem.linear:
            return self._on_lines(curvature, limits)
        problem, hessian, samples = self.problem, self.running.hessian, len(self.problem.model_rule)
        size = hessian.shape[-1]
        rows, points = slice(begin // problem.hold, end // problem.hold), slice(begin * samples, end * samples)
        lin, velocity = self.linearized(begin, end)
        G, Gx, Gu, count = lin.G, lin.Gx, lin.Gu, problem.processes
        if count < G.shape[2]:
            G, Gx, Gu = (np.ascontiguousarray(array[:, :, :count]) for array in (G, Gx, Gu))
        return core.ExpandedSteps(
            A=lin.A,
            B=lin.B,
            G=G,
            Gx=Gx,
            Gu=Gu,
            rule=problem.model_rule,
            gradient=self.slopes[points],
            hessian=hessian[points] if len(hessian) > 1 else hessian,
            velocity=velocity,
            curvature=np.zeros((0, size, size)) if curvature is None else curvature[begin:end],
            slack=limits.slack[rows],
            expected=limits.expected[rows],
            rate=self.rate[rows],
            pull=self.pull[rows],
            within=None if self.within is None else self.within[begin:end],
        )

    def _on_lines(self, curvature: Floats | None, limits: _Limits) -> core.ExpandedSteps:
        X, m = self.line.B.shape[1:]
        return core.ExpandedSteps(
            A=self.line.A,
            B=self.line.B,
            G=self.line.G,
            Gx=self.line.Gx,
            Gu=self.line.Gu,
            rule=RULE,
            gradient=self.line.gradient,
            hessian=self.line.hessian,
            velocity=np.zeros((0, X // 2, X)),
            curvature=np.zeros((0, X + m, X + m)) if curvature is None else curvature,
            slack=limits.slack,
            expected=limits.expected,
            rate=np.zeros((0, m, m)),
            pull=np.zeros((0, m)),
        )


def _pass(
    along: Along,
    regularization: float,
    *,
    costates: bool = False,
    curvature: Floats | None = None,
    limits: _Limits | None = None,
) -> tuple[Plan | None, Floats]:
    """The plain recursion, or, where its rounding errors are large and the model is convex, that on square roots."""
    plain = _one_pass(along, regularization, costates, curvature, limits, roots=False)
    curved = curvature is not None or along.firm is not None
    if curved or (plain[0] is not None and plain[0].loss <= TRUSTED):
        return plain
    by_roots = _one_pass(along, regularization, costates, None, limits, roots=True)
    return plain if by_roots[0] is None else by_roots


class _Terminal(NamedTuple):
    """The terminal cost in (q, v), d(q, v)/dx, and the cost's gradient (2n,) and Hessian (2n, 2n) in x."""

    cost: Expansion
    slopes: Floats
    gradient: Floats
    hessian: Floats


class _ByRoots(NamedTuple):
    """A pass on square roots, with the costs of samples, of control changes and within steps as squares."""

    run: core.RootPass
    running: Squares
    change: Squares
    within: Squares | None


def _one_pass(
    along: Along,
    regularization: float,
    costates: bool,
    curvature: Floats | None,
    limits: _Limits | None,
    *,
    roots: bool,
) -> tuple[Plan | None, Floats]:
    problem, running = along.problem, along.running
    scene = problem.scene
    n, m, k, N, R = scene.robot.dof, scene.controls, problem.processes, problem.steps, problem.decisions
    _, D, by_state, by_states = along.terminal
    if curvature is not None and problem.integrator.variational:
        pull = along.terminal.cost.gradient[:, n:]
        by_states = by_states + velocity_curvature(scene, along.trajectory.q[-1:], along.trajectory.v[-1:], pull)[0]
    if problem.linear:
        return _one_pass_on_lines(along, regularization, costates, curvature, by_states, limits, roots=roots)
    noisy = N if k else 0
    jumps, spread = np.empty((noisy, 2 * n, n)), np.empty((noisy, 2 * n, 2 * n))
    feedforward, feedback, gradient = np.empty((R, m)), np.empty((R, m, 2 * n)), np.empty((R, m))
    previous = np.empty(along.rate.shape)
    costate = np.empty((N if costates else 0, 2 * n))
    plain, by_roots = core.BackwardPass(m, by_state, by_states), None
    if roots:
        final, squares = (
            squares_of(along.terminal.cost.gradient, along.terminal.cost.hessian),
            squares_of(along.slopes, running.hessian),
        )
        change = squares_of(along.pull, along.rate)
        within = None if along.within is None else squares_of(np.zeros((N, 2 * n)), along.within)
        if final is None or squares is None or change is None or (within is None and along.within is not None):
            return None, costate
        by_roots = _ByRoots(core.RootPass(m, final.after(D).core, by_state), squares, change, within)
    factors = None
    if limits is None:
        factors = np.empty((R, m, m)) if len(along.blocks) == 1 else None
        limits = _without_limits(m, 2 * n)._replace(factors=factors)
    samples = len(problem.model_rule)
    for begin, end in reversed(along.blocks):
        steps, points = slice(begin, end), slice(begin * samples, end * samples)
        rows = slice(begin // problem.hold, end // problem.hold)
        if k:
            jumps[steps] = along.linearized(begin, end)[0].J
        given = along.steps(begin, end, curvature, limits)
        gains = core.Gains(
            feedforward=feedforward[rows],
            feedback=feedback[rows],
            previous=previous[rows],
            control_gradient=gradient[rows],
            costate=costate[steps] if costates else costate,
            spread=spread[steps],
            **limits.part(rows),
        )
        how = (problem.dt, problem.hold, float(regularization))
        if by_roots is None:
            failed = plain.run(*how, given, gains)
        else:
            running_squares, change_squares = by_roots.running[points].core, by_roots.change[rows].core
            within_squares = None if by_roots.within is None else by_roots.within[steps].core
            failed = by_roots.run.run(*how, given, gains, running_squares, change_squares, within_squares)
        if failed >= 0:
            return None, costate
    found = plain if by_roots is None else by_roots.run
    if not (math.isfinite(found.slope) and math.isfinite(found.curvature)):
        return None, costate
    plan = Plan(
        feedforward,
        feedback,
        None if problem.rate is None else previous,
        gradient,
        found.slope,
        found.curvature,
        found.noise,
        jumps,
        spread,
        limits.slack.size > 0,
        found.loss,
        along.model,
        factors,
    )
    return plan, costate


def _one_pass_on_lines(
    along: Along,
    regularization: float,
    costates: bool,
    curvature: Floats | None,
    by_states: Floats,
    limits: _Limits | None,
    *,
    roots: bool,
) -> tuple[Plan | None, Floats]:
    """The pass of a plan whose controls are linear between nodes; ``by_states`` is the terminal Hessian (2n, 2n)."""
    problem, X, x = along.problem, along.states, 2 * along.problem.scene.robot.dof
    R, m = problem.decisions, problem.scene.controls
    cost, D, by_state, _ = along.terminal
    end_gradient, end_hessian = np.zeros(X), np.zeros((X, X))
    end_gradient[:x], end_hessian[:x, :x] = by_state, by_states
    feedforward, feedback, gradient = np.empty((R, m)), np.empty((R, m, X)), np.empty((R, m))
    line, k = along.line, problem.processes
    spread, costate = np.empty((R if k else 0, X, X)), np.empty((R if costates else 0, X))
    of_states = costate[1:, :x]
    limits = _without_limits(m, X) if limits is None else limits
    gains = core.Gains(
        feedforward=feedforward,
        feedback=feedback,
        previous=np.empty((0, m, m)),
        control_gradient=gradient,
        costate=costate,
        spread=spread,
        **limits.part(slice(0, R)),
    )
    steps = along.steps(0, R, curvature, limits)
    how = (problem.dt, 1, float(regularization))
    found: core.BackwardPass | core.RootPass
    if roots:
        final = squares_of(cost.gradient, cost.hessian)
        squares = squares_of(line.gradient, line.hessian)
        change = squares_of(np.zeros((0, m)), np.zeros((0, m, m)))
        if final is None or squares is None or change is None:
            return None, of_states
        wide = np.concatenate([D, np.zeros((x, X - x))], axis=1)
        found = core.RootPass(m, final.after(wide).padded(X).core, end_gradient)
        failed = found.run(*how, steps, gains, squares.core, change.core)
    else:
        found = core.BackwardPass(m, end_gradient, end_hessian)
        failed = found.run(*how, steps, gains)
    if failed >= 0 or not (math.isfinite(found.slope) and math.isfinite(found.curvature)):
        return None, of_states
    jumps, noise = np.empty((0, x, x // 2)), found.noise
    after = spread[1:, :x, :x] + problem.dt * line.kicked
    if k:
        jumps, G = along.linearized(0, problem.steps)[0].J, line.G[1:, :x]
        noise += 0.5 * problem.dt * float((G * (line.kicked @ G)).sum())
    plan = Plan(
        feedforward,
        feedback[:, :, :x].copy(),
        feedback[:, :, x : x + m].copy(),
        gradient,
        found.slope,
        found.curvature,
        noise,
        jumps,
        after,
        limits.slack.size > 0,
        found.loss,
        along.model,
        None,
    )
    return plan, of_states


def _linearize(problem: OptimalControlProblem, part: Trajectory, begin: int) -> Linearization:
    try:
        return linearize_steps(problem.scene, part, problem.integrator, problem.q0, ramps=problem.linear)
    except LinearizationError as error:
        raise _in_whole(error, begin, problem.dt) from None


def _in_whole(error: LinearizationError, begin: int, dt: float) -> LinearizationError:
    """An error of a part of a motion, with the step's number in the whole motion."""
    step = begin + error.step
    return LinearizationError(step, step * dt, error.reason)
