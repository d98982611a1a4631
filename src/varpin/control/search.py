"""The search for a plan: stages along the motion, feedback, a quadratic program, and a line search on true motions.

Sequential quadratic programming in the form of differential dynamic programming, (O10) and (O11) of
docs/mathematics.md: feedback is that of the costs alone, and within limits and rows the changes of the controls come
from one quadratic program over the horizon. Merit is the expected cost plus an l1 penalty of the rows.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np

from varpin.arrays import Floats, Mask
from varpin.control.between_nodes import NOWHERE, Instants, enforced, followed
from varpin.control.constraints import BoundConstraint
from varpin.control.costs import CostError
from varpin.control.history import Iteration, SearchState, Status
from varpin.control.line_search import Taken, Trial, line_search
from varpin.control.margins import Tightening
from varpin.control.multipliers import Multipliers, flat, split
from varpin.control.problem import OptimalControlProblem
from varpin.control.qp import Minimum, Program, changes
from varpin.control.riccati import Plan, backward, foreseen, noise_shares
from varpin.control.second_order import curvature_along
from varpin.control.sizes import FEASIBLE, HARMLESS, NOTABLE, ROUNDING, SLIGHT, TRACE
from varpin.control.solution import Solution
from varpin.control.stages import Cost, Rows, Steps, change, states
from varpin.core.arrays import Commands
from varpin.errors import InputError, LinearizationError, StepError
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.noise import NoiseFieldError
from varpin.signals.commands import open_line, open_loop
from varpin.simulation.failures import StepFailure, named
from varpin.simulation.limits import saturates
from varpin.simulation.record import Motions
from varpin.trajectory import Trajectory

Report = Callable[[Iteration, Trajectory], None]

logger = logging.getLogger(__name__)

# Errors that reject a trial, or end a search that has made a step.
TRIAL_ERRORS = (CostError, NoiseFieldError, CustomForceError, StepError, LinearizationError)
# Factor by which the regularization grows, and lengths of steps from which on it falls, and up to which it rises; from
# 1.5 to 3, 0.1 to 0.5 and 0.05 to 0.3.
_GROWTH, _LONG, _SHORT = 2.0, 0.25, 0.1
# Iterations that together gain no more than the tolerance, or hardly lower violations, before a search ends; from 6 to
# 20.
_PATIENCE = 10
# Weight of the rows in the merit: this many times the largest multiplier, and at most _HEAVY times, as heavy rows
# shorten steps; where rows cannot all be met, this many times what the cost is per violation. From 3 to 100.
_ABOVE, _HEAVY = 1.5, 10.0
# Greatest number of halvings of a trial's steps beyond those that the present motion needs; from 3 to 7.
_HALVINGS = 5


# What a search keeps in its :class:`SearchState`, and what its margins do.
_KEPT, _OF_MARGINS = ("weight", "regularization", "growth", "first", "second_order"), ("counts", "since", "rounds")


class Step(NamedTuple):
    """What a quadratic program or a backward pass gives."""

    feedforward: Floats  # changes of the controls (R, m), without feedback
    gradient: Floats  # of the Lagrangian in the controls (R, m), by the costates
    slope: float  # of the merit
    decrease: float  # of the merit by a full step, foreseen
    minimum: Minimum | None = None  # of the program; None without limits and rows in reach
    elastic: bool = False  # whether rows may be missed

    @classmethod
    def of(cls, plan: Plan) -> Step:
        """That of a backward pass."""
        return cls(plan.feedforward, plan.gradient, plan.slope, plan.expected_decrease)


class Search:
    """The state of a search: the motion, its multipliers and the history.

    Options are those of :func:`varpin.solve`. In a controller's ``tick`` margins stay, and there are rows in the
    middles of steps alone.
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        *,
        second_order: bool = False,
        regularization: float = 0.0,
        tick: bool = False,
    ) -> None:
        self.problem, self.second_order, self.tick = problem, second_order, tick
        self.motions = Motions(problem.scene, problem.integrator, problem.q0, problem.v0, problem.dt)
        self.regularization, self.growth = regularization, 1.0
        self.weight = 0.0  # of the rows in the merit, in tenths of their ranges
        self.first = -1.0  # cost at stake on the first motion; -1 before it is known
        self.tightening = Tightening(problem)
        self.history: list[Iteration] = []
        self.cost = np.inf
        self.reason = ""
        self.state: SearchState | None = None
        self.plan = Plan.none(problem)
        self.noise = self.plan  # the pass whose value function tells what noise costs
        self.step = Step.of(self.plan)
        self.exact = self.unsolved = False
        self.quadratic: list[Cost] = []
        self._values: list[Floats] = []  # of all rows, margins included, in tenths of ranges
        self._passes = 0  # backward passes since the last entry of the history
        robot = problem.scene.robot.name
        self.label = f"{robot}, {problem.steps} steps of {problem.dt:g} s from t = {problem.t0:g} s"
        self._enforce(NOWHERE)
        if not tick:
            self.tightening.renew(0)

    def begin(self, commands: Commands) -> None:
        """Begin with the motion under commands.

        Raises:
            NoiseFieldError, ForceError, StepFailure, CostError: As :func:`varpin.solve`.
        """
        problem = self.problem
        trajectory, failure = self.motions.under(commands)
        if failure is not None:
            raise StepFailure(trajectory.steps, trajectory.t[-1], named(problem.scene, failure), trajectory)
        self._move(trajectory, problem.shares(trajectory))
        if not np.isfinite(self.cost):
            culprits = " + ".join(map(repr, problem.not_finite(trajectory) or problem.cost.terms))
            raise CostError(culprits, f"the cost of the first motion is {self.cost}")

    def resume(self, plan: Solution) -> None:
        """Continue from the state of a plan.

        Raises:
            InputError: The plan is of another problem, or does not hold the state of its search.
        """
        state, known, second_order = plan.search, plan.multipliers, self.second_order
        if state is None:
            raise InputError("resume: the solution does not hold the state of its search; give it as controls")
        if other := self.problem.mismatch(plan.problem.setting, plan.trajectory, plan.cost):
            raise InputError(f"resume: the solution is {other}; give it as controls")
        self._move(plan.trajectory, self.problem.shares(plan.trajectory))
        for owner, names in ((self, _KEPT), (self.tightening, _OF_MARGINS)):
            for name in names:
                setattr(owner, name, getattr(state, name))
        self.second_order |= second_order
        self.history = list(plan.history[: state.iterations])
        if known is not None:
            self.take(known)

    def take(self, known: Multipliers) -> None:
        """Take over rows between nodes, multipliers and margins."""
        self._enforce(known.between)
        self.multipliers, self.tightening.margins = split(self.bound, known.values), split(self.bound, known.backoff)
        if known.added is not None:
            self.tightening.added = split(self.problem.bound_constraints, known.added)

    def run(self, tolerance: float, max_iterations: int, deadline: float, report: Report) -> Status:
        """Iterate to the end."""
        last, longest = len(self.history) + max_iterations, 0.0
        while True:
            own: dict[str, Any] = {name: getattr(self, name) for name in _KEPT}
            margins = {name: getattr(self.tightening, name) for name in _OF_MARGINS}
            self.state = SearchState(**own, **margins, iterations=len(self.history))
            started = time.perf_counter()
            try:
                while not self._made():
                    if not self._stiffen():
                        return self._without_step()
                stake = self.along.stake
                if self.first < 0.0:
                    self.first = stake.free if np.isfinite(stake.free) else stake.moved
                ended = self._ended(tolerance)
            except TRIAL_ERRORS as error:
                if not self.history:
                    raise
                logger.warning("%s: %s", self.label, error)
                self.reason = str(error)
                return Status.NOT_DIFFERENTIABLE
            close = ended is None and self.step.decrease <= SLIGHT * stake.moved
            if (close or ended in (Status.CONVERGED, Status.INFEASIBLE)) and self._goes_on(ended):
                continue
            ended = ended or self._out_of(last, deadline)
            if ended is not None:
                self._calm()
                self._note(report, started)
                self.reason = self.reason or self._numbers(tolerance)
                return ended
            step = self.step
            taken = self._line_search()
            self._note(report, started, taken)
            longest = max(longest, time.perf_counter() - started)
            if taken.length == 0.0 and self.violation <= FEASIBLE and taken.last.shares is not None:
                hidden = self.along.rounding(self.shares, taken.last.shares)
                if abs(step.decrease) <= hidden:
                    if self._goes_on(Status.CONVERGED):
                        continue
                    self.reason = f"{self._expected()}, and rounding hides {hidden:.1e} of the cost"
                    return Status.CONVERGED
            if self.tick and taken.length > 0.0 and (out := self._out_of(last, deadline - longest)) is not None:
                # Without a further pass: the rest of the step is left.
                self.step = step._replace(feedforward=(1.0 - min(taken.length, 1.0)) * step.feedforward)
                self.reason = f"{self._expected()} before the last step"
                return out
            if not self._regularize():
                self._calm()
                dear = self.weight * self._badness
                if self.violation > FEASIBLE and step.elastic and step.decrease <= NOTABLE * dear:
                    return self._infeasible()
                self.reason = f"no step lowers the cost, whatever the regularization; {self._numbers(tolerance)}"
                return Status.STALLED

    def _out_of(self, last: int, deadline: float) -> Status | None:
        """The status where iterations or time end the search, else None."""
        if len(self.history) >= last:
            return Status.MAX_ITERATIONS
        return Status.OUT_OF_TIME if time.perf_counter() > deadline else None

    def _without_step(self) -> Status:
        """The status where there is no step, whatever the regularization."""
        if self.unsolved:
            self.reason = "the quadratic program within limits and constraints cannot be solved accurately"
            return Status.STALLED
        self.reason = f"the regularization has reached {self.regularization:.1e} of the diagonal of Quu"
        return Status.INDEFINITE

    @property
    def violation(self) -> float:
        """The largest violation of a row, margins included, in its unit."""
        pairs = zip(self._excess, self.bound, strict=True)
        return max((float(part.max(initial=0.0)) * item.scale for part, item in pairs), default=0.0)

    @property
    def _badness(self) -> float:
        """Sum of all violations, in tenths of ranges."""
        return float(sum(part.sum() for part in self._excess))

    def _move(self, motion: Trajectory, shares: Floats) -> None:
        self.trajectory, self.shares, self.cost = motion, shares, float(shares.sum())
        self.along = Steps(self.problem, motion)

    def _enforce(self, between: Instants) -> None:
        self.between = between
        self.bound: tuple[BoundConstraint, ...] = enforced(self.problem, between).bound_constraints
        self.multipliers = [np.zeros(item.shape) for item in self.bound]
        self.tightening.enforce(self.bound, between)
        self._excess: list[Floats] = [np.zeros(item.size) for item in self.bound]  # in tenths of ranges

    def _made(self) -> bool:
        """Make feedback, rows and the step of the motion with the present regularization; whether there is one."""
        problem, along = self.problem, self.along
        if self.regularization > 0.0 and not self.second_order and self._is_saturated():
            self.second_order = True
            logger.info("%s: servos are at the limits of their drives: second derivatives from now on", self.label)
        curvature = curvature_along(along, self._costates()) if self.second_order else None
        # Within limits and rows the regularization is a cost of the quadratic program, whose model stays exact.
        plan = self._pass(0.0 if self.bound else self.regularization, curvature) or self._pass(
            self.regularization, curvature
        )
        if plan is None and curvature is not None:
            curvature = None
            plan = self._pass(self.regularization)
        if plan is None:
            return False
        self.plan = self.noise = plan
        self.exact = curvature is not None
        if problem.scene.processes and self.regularization > 0.0:
            # Noise grows under regularized gains.
            self.noise = self._pass(0.0) or plan
        if self._has_goals:
            self.plan = self._pass_to_goals() or plan
        self.tightening.follow(along, self.plan, len(self.history), grow=not self.step.elastic)
        # The step is the pass's own, where that keeps to all limits and rows.
        plain = self.regularization == 0.0 and not self._has_goals
        free = not self.bound and (not problem.limited or self._is_free(plan, ()))
        if not free:
            self.quadratic = along.quadratic(self.noise.spread if problem.scene.processes else None, curvature)
            self.rows = [along.rows(item) for item in self.bound]
            self._values = self._values_of(self.trajectory)
            self._excess = self._excess_of(self._values)
            free = bool(self.bound) and plain and self._is_free(plan, self.rows)
        if not free:
            return self._solve(plan)
        self.step = Step.of(plan)
        self.multipliers = [np.zeros(item.shape) for item in self.bound]
        return True

    def _is_saturated(self) -> bool:
        """Whether drives of servos are at their limits, and there are the second derivatives that tell of it."""
        scene = self.problem.scene
        smooth = scene.custom is None and not scene.constraints and not scene.noise.velocity_dependent
        exists = smooth and self.problem.integrator.variational and not self.tick
        return exists and saturates(scene, self.trajectory)

    def _pass(self, regularization: float, curvature: Floats | None = None, fixed: Mask | None = None) -> Plan | None:
        """A backward pass of the costs, in which some controls (R, m) may stay as they are."""
        self._passes += 1
        return backward(self.along, regularization, curvature=curvature, fixed=fixed)

    def _solve(self, plan: Plan) -> bool:
        """Make the step by a quadratic program within limits and rows; whether it has a solution."""
        problem, along, rows = self.problem, self.along, self.rows
        u, (lower, upper) = problem.decided(self.trajectory), problem.control_limits
        least, most = np.minimum(lower - u, 0.0), np.maximum(upper - u, 0.0)
        free = np.isnan(problem.begin)
        least[0], most[0] = (np.where(free, part[0], 0.0) for part in (least, most))
        program = Program(along, rows, (least, most), plan, self.regularization if rows else 0.0)
        self.program = program
        values, bad = self._values, self._badness
        found = program.minimum(values)
        needed = np.inf if found is None else _ABOVE * _largest(found.multipliers)
        # Rows that cost far more than what is at stake are approached step by step.
        stake = max(abs(self.cost), self.first)
        dear = max(self.weight, _HEAVY * (stake if stake > ROUNDING**2 * program.stiffness else program.stiffness))
        elastic = bool(rows) and needed > dear
        if elastic:
            missed = program.minimum(values, weight=dear)
            elastic = missed is not None and (found is None or missed.slack <= (1.0 - NOTABLE) * bad)
            found, self.weight = (missed, dear) if elastic else (found, self.weight)
        self.unsolved = found is None
        if found is None:
            return False
        largest = _largest(found.multipliers)
        if not elastic or found.slack <= TRACE * max(bad, 1.0):
            self.weight = max(min(self.weight, _HEAVY * largest), _ABOVE * largest)
        self.multipliers = [
            (np.where(np.abs(part) > TRACE * largest, part, 0.0) / item.scale).reshape(item.shape)
            for part, item in zip(found.multipliers, self.bound, strict=True)
        ]
        linear, whole = change(self.quadratic, found.z)
        removed = self.weight * (bad - found.slack)
        gradient = along.lagrangian(self.quadratic, rows, found.multipliers)[along.layout.control[:-1]]
        self.step = Step(self._feedforward(found.z), gradient, linear - removed, removed - whole, found, elastic)
        return True

    @property
    def _has_goals(self) -> bool:
        return any(item.source.equality for item in self.bound)

    def _pass_to_goals(self) -> Plan | None:
        """A backward pass for feedback: missing a goal by a tenth of its range costs as much as the motion."""
        made, end = copy(self.along), self.along.terminal
        hessian = end.hessian.copy()
        for item in self.bound:
            if item.source.equality:
                J = item.jacobian(self.trajectory.q, self.trajectory.v)[-1] @ made.slopes[-1] / item.scale
                hessian += max(abs(self.cost), self.first) * J.T @ J
        vars(made)["terminal"] = end._replace(hessian=hessian)
        self._passes += 1
        return backward(made, 0.0)

    def _is_free(self, plan: Plan, rows: Sequence[Rows]) -> bool:
        """Whether the full step of a backward pass keeps to all limits and rows, by the linear model."""
        z, limited = foreseen(self.along, plan)
        moves = zip(self._values, changes(rows, z), strict=True)
        return not limited and all((c + move <= 0.0).all() for c, move in moves)

    def _feedforward(self, z: Floats) -> Floats:
        """The changes of the controls in z, without what feedback gives for its states."""
        changes = self.plan.beside @ np.append(z, 0.0)[self.along.layout.decision][:, :, None]
        feedforward: Floats = changes[:, :, 0]
        return feedforward

    def _costates(self) -> Floats:
        """Derivatives (N, 2n) of the Lagrangian in the state after each step, with the known multipliers."""
        along, rows, pushes = self.along, [], []
        for item, push in zip(self.bound, self.multipliers, strict=True):
            if push.any() and not item.of_controls:
                rows.append(along.rows(item))
                pushes.append(push.ravel() * item.scale)
        return along.lagrangian(along.quadratic(), rows, pushes)[along.layout.state[1:]]

    def _ended(self, tolerance: float) -> Status | None:
        """The status of a search whose step gains no more than the tolerance; None if it goes on."""
        least = not self.problem.steered and self.along.stake.free <= tolerance * HARMLESS * self.first
        if least and self.violation <= FEASIBLE:
            # The cost is at its lower bound. Without costs of the controls the model may have no minimum even there.
            return Status.CONVERGED
        found = self._verdict(tolerance)
        if found is not None and self.regularization > 0.0:
            # Not if the step without regularization gains more.
            kept = self.regularization, self.growth
            self.regularization = 0.0
            if not self._made() or self._verdict(tolerance) is not found:
                self.regularization, self.growth = kept
                self._made()
                return None
        if found is Status.INFEASIBLE:
            return self._infeasible()
        return found

    def _verdict(self, tolerance: float) -> Status | None:
        step, share, bad = self.step, self._share(tolerance), self._badness
        if self.violation > FEASIBLE:
            # By the program, or by what the search has done.
            dear, merits = self.weight * bad, self._merits()
            left = step.minimum is not None and step.elastic and step.minimum.slack >= (1.0 - TRACE) * bad
            if left and step.decrease <= max(share, TRACE * dear):
                return Status.INFEASIBLE
            stays = len(merits) > _PATIENCE and merits[-_PATIENCE - 1] - min(merits[-_PATIENCE:]) <= NOTABLE * dear
            if not stays or step.elastic or self.tightening.needed:
                return Status.INFEASIBLE if stays else None
            # Rows that the model can meet are not known to be infeasible, unless margins move with the motion.
            self.reason = f"{_PATIENCE} iterations have hardly lowered violations; {self._numbers(tolerance)}"
            return Status.STALLED
        if step.decrease <= share:
            return Status.CONVERGED
        gained = sum(item.decrease for item in self.history[-_PATIENCE:])
        if len(self.history) > _PATIENCE and gained <= share:
            self.reason = f"{_PATIENCE} iterations have lowered the merit by {gained:.1e}; {self._numbers(tolerance)}"
            return Status.STALLED
        return None

    def _merits(self) -> list[float]:
        """The merit of the last motions by the present weight, since rows and margins are what they are."""
        past = self.history[self.tightening.since :]
        costs = [item.cost for item in past[:-1]]
        then = [(item.noise_cost, item.violation) for item in past[1:]]
        here = self.cost + self.noise.noise + self.weight * self._badness
        return [cost + noise + self.weight * bad for cost, (noise, bad) in zip(costs, then, strict=True)] + [here]

    def _calm(self) -> None:
        """Make the last feedback and step without regularization, where the model has a minimum."""
        kept, problem = self.regularization, self.problem
        if kept > 0.0 and not self.tick:
            self.regularization = 0.0
            with contextlib.suppress(*TRIAL_ERRORS):
                if not self._made():
                    self.regularization = kept
                    self._made()
        if problem.scene.processes and problem.limited and not (self.tightening.needed or self._has_goals or self.tick):
            # Controls at their limits do not react to noise, and the plan tells what it costs then.
            u, (lower, upper) = problem.decided(self.trajectory), problem.control_limits
            held = self._pass(0.0, fixed=(u <= lower) | (u >= upper))
            self.plan, self.noise = held or self.plan, held or self.noise

    def _goes_on(self, ended: Status | None) -> bool:
        """Whether there are further rows between nodes, or other margins, before a search ends."""
        if self.tick:
            return False
        plan, margins, iteration = self.plan, self.tightening, len(self.history)
        # What cannot be met is violent, and does not widen margins.
        grow = ended is not Status.INFEASIBLE
        if ended is not None and margins.settle(self.along, plan, iteration, grow=grow):
            self.reason = ""
            return True
        if ended is Status.INFEASIBLE:
            return False
        count = len(self.problem.bound_constraints)
        made = followed(self.problem, self.between, self.trajectory, margins.margins[:count])
        if made is not self.between:
            multipliers, used = self.multipliers[:count], margins.margins[:count]
            self._enforce(made)
            self.multipliers[:count], margins.margins[:count] = multipliers, used
        elif ended is None or not (margins.countable and margins.widen(self.solution(Status.CONVERGED))):
            return False
        margins.renew(iteration)
        return True

    def _line_search(self) -> Taken:
        """Move to the trial along the step whose merit, (O11), a line search accepts, if any."""
        step, noise, problem, motion = self.step, self.noise, self.problem, self.trajectory
        z = None if step.minimum is None else step.minimum.z
        shares, bad = noise_shares(problem, motion, noise), self._badness
        # Steps of trials may not be halved much more often than those of the motion.
        integrator = self.problem.integrator.halving(int(motion.statistics.halvings.max(initial=0)) + _HALVINGS)

        def attempt(length: float, feedforward: Floats = step.feedforward, z: Floats | None = z) -> Trial:
            commands = self._along_step(length, feedforward, z)
            try:
                moved, failure = self.motions.under(commands, integrator=integrator)
                if failure is not None:
                    return Trial()
                terms = problem.shares(moved)
                merit = float((terms - self.shares).sum())
                if problem.scene.processes:
                    merit += float((noise_shares(problem, moved, noise) - shares).sum())
                if self.bound:
                    excess = self._excess_of(self._values_of(moved))
                    merit += self.weight * (sum(float(part.sum()) for part in excess) - bad)
            except TRIAL_ERRORS as error:
                logger.info("%s: trial: %s", self.label, error)
                return Trial()
            return Trial(merit, moved, terms) if np.isfinite(merit) else Trial()

        def correct(moved: Trajectory) -> Trial | None:
            again = self._corrected(moved)
            return None if again is None else attempt(1.0, self._feedforward(again), again)

        taken = line_search(attempt, step.slope, correct, extends=z is None and not self.tick)
        if taken.best.motion is not None and taken.best.shares is not None:
            self._move(taken.best.motion, taken.best.shares)
        return taken

    def _along_step(self, length: float, feedforward: Floats, z: Floats | None) -> Commands:
        """Commands of a length along a step with changes z, whose controls that it brings to a limit stay there."""
        problem, plan = self.problem, self.plan
        now = problem.decided(self.trajectory)
        u, gains, previous = now + length * feedforward, plan.feedback, plan.previous
        if z is not None and problem.limited:
            aim = now + length * z[self.along.layout.control[:-1]]
            for limit, sign in zip(problem.control_limits, (-1.0, 1.0), strict=True):
                there = np.isfinite(limit) & (sign * (aim - limit) >= -TRACE * np.abs(limit))
                u, gains = np.where(there, limit, u), np.where(there[:, :, None], 0.0, gains)
                previous = None if previous is None else np.where(there[:, :, None], 0.0, previous)
        x, limits = states(problem, self.trajectory)[: -1 : problem.hold], problem.control_limits
        if previous is not None:
            # The control before the first one is given.
            x = np.hstack([x, now[:-1] if problem.linear else np.vstack([now[:1], now[:-1]])])
            gains = np.concatenate([gains, previous], axis=2)
        if not problem.linear:
            return open_loop(u)._replace(gains=gains, reference=x, hold=problem.hold, limits=limits)
        # The first control has no feedback: its state is given.
        u = np.vstack([problem.begun(np.clip(u[:1], *limits)), u[1:]])
        line = open_line(u, problem.integrator.stage_times)
        return line._replace(gains=gains[1:], reference=x, limits=limits)

    def _excess_of(self, values: Sequence[Floats]) -> list[Floats]:
        """Violations (P,) by values of all rows."""
        pairs = zip(values, self.bound, strict=True)
        return [np.abs(c) if item.source.equality else np.maximum(c, 0.0) for c, item in pairs]

    def _values_of(self, motion: Trajectory) -> list[Floats]:
        """Values (P,) of all rows on a motion, margins included, in tenths of ranges."""
        u = self.problem.control_rows(motion)
        return [
            (item.value(motion.q, motion.v, u) + margin).ravel() / item.scale
            for item, margin in zip(self.bound, self.tightening.margins, strict=True)
        ]

    def _corrected(self, motion: Trajectory) -> Floats | None:
        """The changes with rows and dynamics as a full step found them; None where there are none."""
        problem, step, along = self.problem, self.step, self.along
        if step.minimum is None or not self.bound:
            return None
        moved = states(problem, motion) - states(problem, self.trajectory)
        z = along.layout.joined(moved, problem.decided(motion) - problem.decided(self.trajectory))
        values = [there - change for there, change in zip(self._values_of(motion), changes(self.rows, z), strict=True)]
        found = self.program.minimum(values, along.gaps_of(z), self.weight if step.elastic else None)
        return None if found is None else found.z

    def _share(self, tolerance: float) -> float:
        """Tolerance on the expected decrease, in units of the cost."""
        return tolerance * (self.along.stake.moved + HARMLESS * self.first)

    def _expected(self) -> str:
        return f"the expected decrease is {self.step.decrease:.1e}"

    def _numbers(self, tolerance: float) -> str:
        share = self._share(tolerance)
        text = f"{self._expected()}; the tolerance of {tolerance:g} times the cost at stake is {share:.1e}"
        return f"{text}; constraints hold to {self.violation:.1e}" if self.bound else text

    def _infeasible(self) -> Status:
        """The status where rows cannot be met, with the worst of them in the reason."""
        k = int(np.argmax([part.max(initial=0.0) for part in self._excess]))
        item, excess = self.bound[k], self._excess[k].reshape(self.bound[k].shape)
        place, row = np.unravel_index(int(excess.argmax()), excess.shape)
        left = float(excess.max()) * item.scale
        self.reason = (
            f"{self.problem.label_of(item.source)} cannot be met from here: {item.rows[row]} at "
            f"t = {item.times[place]:.4g} s stays violated by {left:.3g} {item.unit}"
        )
        margin = float(self.tightening.margins[k][place, row])
        if margin > 0.0:
            self.reason += f", its margin of {margin:.3g} {item.unit} included"
        return Status.INFEASIBLE

    def _note(self, report: Report, started: float, taken: Taken | None = None) -> None:
        item = Iteration(
            index=len(self.history),
            cost=self.cost,
            noise_cost=self.noise.noise,
            violation=self._badness,
            expected_decrease=self.step.decrease,
            decrease=0.0 if taken is None or taken.length == 0.0 else -taken.best.merit,
            step=0.0 if taken is None else taken.length,
            regularization=self.regularization,
            gradient=float(np.abs(self.step.gradient).max()),
            backward_passes=self._passes,
            rollouts=0 if taken is None else taken.trials,
            seconds=time.perf_counter() - started,
            second_order=self.exact,
        )
        self.history.append(item)
        self._passes = 0
        logger.info("%s: %s", self.label, item)
        report(item, self.trajectory)

    def _regularize(self) -> bool:
        """Adapt the regularization to the last step; False if no more of it helps (Tassa, Erez and Todorov 2012).

        It falls after long steps, and rises after none or two short ones in a row.
        """
        lengths = [item.step for item in self.history[-2:]]
        if lengths[-1] >= _LONG:
            self.growth = min(1.0 / _GROWTH, self.growth / _GROWTH)
            self.regularization *= self.growth
            if self.regularization < TRACE:
                self.regularization = 0.0
        elif lengths[-1] == 0.0 or (max(lengths) <= _SHORT and len(lengths) > 1):
            return self._stiffen()
        return True

    def _stiffen(self) -> bool:
        self.growth = max(_GROWTH, self.growth * _GROWTH)
        self.regularization = max(TRACE, self.regularization * self.growth)
        return self.regularization <= 1.0 / ROUNDING

    def solution(self, status: Status) -> Solution:
        """The motion, however the search ended, with the feedback around it."""
        problem, plan = self.problem, self.plan
        known = None
        if problem.constraints:
            known = Multipliers(
                values=flat(self.multipliers),
                backoff=flat(self.tightening.margins),
                between=self.between,
                added=None if self.tightening.added is None else flat(self.tightening.added),
            )
        reason = self.reason
        if plan.loss > HARMLESS:
            lost = f"rounding may have changed Quu by {plan.loss:.0e} of itself: weights or inertias are too far apart"
            logger.warning("%s: the gains cannot be trusted: %s", self.label, lost)
            reason = f"{reason}; {lost}"
        return Solution(
            problem=problem,
            trajectory=self.trajectory,
            gains=plan.feedback,
            previous_gains=plan.previous,
            feedforward=self.step.feedforward,
            gradient=self.step.gradient,
            cost=self.cost,
            noise_cost=self.noise.noise,
            status=status,
            reason=reason,
            history=tuple(self.history),
            search=self.state,
            multipliers=known,
        )


def _largest(multipliers: Sequence[Floats]) -> float:
    return max((float(np.abs(part).max(initial=0.0)) for part in multipliers), default=0.0)
