"""The search for a plan: stages along the motion, feedback, a quadratic program, and a line search on true motions.

Sequential quadratic programming in the form of differential dynamic programming, (O10) to (O12) of docs/mathematics.md:
feedback is that of the costs alone, and within limits and rows the changes of the controls come from one quadratic
program over the horizon. Merit is the expected cost plus an l1 penalty of the rows.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Sequence
from copy import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats, Mask
from varpin.control.between_nodes import NOWHERE, Instants, beyond, enforced, extended, seen, watched
from varpin.control.constraints import BoundBetween, BoundConstraint
from varpin.control.costs import CostError
from varpin.control.history import Iteration, SearchState, Status
from varpin.control.line_search import ARMIJO, BACKTRACKING, Lengths
from varpin.control.margins import widened
from varpin.control.multipliers import FEASIBLE, Multipliers, flat, split
from varpin.control.noise import deviations
from varpin.control.problem import OptimalControlProblem
from varpin.control.qp import Minimum, Program
from varpin.control.riccati import Plan, backward, foreseen, noise_shares
from varpin.control.rollout import around, held
from varpin.control.second_order import curvature_along
from varpin.control.solution import Solution
from varpin.control.stages import Feedback, Layout, Rows, Stages, Steps, states
from varpin.control.starts import holding_gains, joint_forces, states_on
from varpin.control.trials import Attempt, Trials
from varpin.core.arrays import Commands
from varpin.errors import LinearizationError, VarpinError
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.forces import limited_servos
from varpin.mechanics.noise import NoiseFieldError
from varpin.simulation.failures import StepFailure, named
from varpin.simulation.limits import saturates
from varpin.simulation.record import located
from varpin.trajectory import Trajectory

Report = Callable[[Iteration, Trajectory], None]

logger = logging.getLogger(__name__)

# Errors that reject a trial, or end a search that has made a step.
TRIAL_ERRORS = (CostError, NoiseFieldError, CustomForceError, LinearizationError)
# The schedule of the regularization (Tassa, Erez and Todorov 2012), relative to the diagonal of Quu: it falls after
# long steps and rises after a very short one, or after two short ones in a row.
_GROWTH, _LEAST, _MOST = 2.0, 1e-6, 1e16
_LONG, _SHORT, _VERY_SHORT = 0.25, 0.1, 0.01
# Greatest regularization with which a search may converge. Controls without effect or cost need some.
_LITTLE = 1e-4
# Iterations that together gain no more than the tolerance before the search stalls.
_PATIENCE = 15
# Share of the first motion's cost at stake that counts beside that of the present one.
_NOTHING = 1e-9
# Weight of the rows in the merit: this many times the largest multiplier; where rows cannot all be met, this many times
# what the cost is per violation.
_ABOVE, _ELASTIC = 1.5, 10.0
# The weight is no more than that many times the largest multiplier, where rows are met: heavy rows shorten steps.
_HEAVY = 10.0
# Slack of rows that are met, relative to the violations.
_MET = 1e-6
# Least weight of rows where nothing is at stake, relative to that of rows that are met.
_LIGHTEST = 1e-6
# Share of the violations from which on a step that leaves it makes the rows heavier.
_APPROACHED = 0.9
# A violation has not fallen where a step removes no more than this share of it.
_STAYS = 1e-6
# Share of the violations that a search expects to remove at the end, up to which the constraints are to blame.
_LITTLE_LESS = 1e-2
# Regularization from which on rows may be missed: it shortens steps only then.
_YIELDING = 1e-2
# Corrections of a full step for the curvature of rows and dynamics.
_CORRECTIONS = 2
# Decrease, as a share of the cost at stake, from which on rows between nodes and margins are looked at.
_CLOSE = 1e-3
# Violation between nodes from which rows are added: where the problem asks for them, and in tenths of a constraint's
# range with linear controls, which lead around nodes.
_BETWEEN, _SHARE = 1e-6, 1e-3
# How often margins are widened by counting motions.
_COUNTS = 3
# How often rows between nodes may follow the motion at its end.
_LOOKS = 30
# A goal's weight in the feedback: a violation of a tenth of its range costs this many times the cost.
_GOAL = 1.0
# Least share of the foreseen decrease below which shorter steps are tried while they are better.
_POOR = 0.3
# A full step is extended by this factor where it brings this share of what its slope gives: at a minimum it is half.
_EARLY, _EXTENSION = 0.85, 4.0
# Share of the foreseen decrease from which on a full step is as foreseen; else a trial follows the foreseen states, by
# one of these lengths, if no joint moves by more than _FAR [rad or m]. It follows them with this share of their gain.
_AS_FORESEEN, _LENGTHS, _FAR, _FOLLOWS = 0.7, (1.0, 0.75, 0.5), 2.0, 0.8
# Greatest number of substeps of a trial, relative to the motion.
_SUBSTEPS = 4.0
# Multipliers that are no more than that, relative to the largest, are of rows that are not active.
_TRACE = 1e-6
# Distance from a limit, relative to it, at which a control is at it: quadratic programs end inside their bounds.
_AT_LIMIT = 1e-6
# Relative rounding error of Quu above which the gains are reported as unreliable.
_LOSSY = 1e-8


class Step(NamedTuple):
    """What a quadratic program or a backward pass gives."""

    feedforward: Floats  # changes of the controls (R, m), without feedback
    slope: float  # of the merit
    decrease: float  # of the merit by a full step, foreseen
    minimum: Minimum | None  # of the program; None without limits and rows in reach
    stages: Stages | None = None  # those of the program, and its rows
    rows: Sequence[Rows] = ()


class Taken(NamedTuple):
    """The result of a line search."""

    length: float = 0.0
    trials: int = 0
    decrease: float = 0.0  # of the merit
    hidden: float = 0.0  # rounding error of a difference of costs; 0 if a step was taken


class Here(NamedTuple):
    """The motion that trials are compared with."""

    noise: Floats  # noise cost of each step
    bad: float  # sum of its violations, in tenths of ranges


class Trial(NamedTuple):
    """A trial motion: its change of the merit, infinite where it has none."""

    merit: float = np.inf
    attempt: Attempt | None = None
    shares: Floats | None = None


class Search:
    """The state of a search: the motion, its multipliers and the history.

    Args:
        problem: The problem.
        second_order: Whether second derivatives of the steps count where the model stays convex.
        closed: Whether feedback acts in trials.
        armijo: Least share of the expected decrease that a step must reach.
        backtracking: Factor between the lengths of trials.
        regularization: The first one, relative to the diagonal of Quu.
        tick: Whether it is a controller's: margins stay, and there are rows in the middles of steps alone.
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        *,
        second_order: bool = False,
        closed: bool = True,
        armijo: float = ARMIJO,
        backtracking: float = BACKTRACKING,
        regularization: float = 0.0,
        tick: bool = False,
    ) -> None:
        self.problem, self.second_order, self.closed = problem, second_order, closed
        self.armijo, self.backtracking, self.tick = armijo, backtracking, tick
        self.trials = Trials(problem)
        self.regularization, self.growth = regularization, 1.0
        self.weight = 0.0  # of the rows in the merit, in tenths of their ranges
        self.first = -1.0  # cost at stake on the first motion; -1 before it is known
        self.between: Instants = NOWHERE
        self.added: list[Floats] | None = None  # to margins at the nodes
        self.counts = 0
        self._looks, self._near = 0, False
        self._passes = 0  # backward passes since the last entry of the history
        self._elastic = self.exact = self.unsolved = False
        self.backoff: list[Floats] = []  # margins of all rows
        self.multipliers: list[Floats] = []
        self.history: list[Iteration] = []
        self.trajectory: Trajectory
        self.shares: Floats
        self.cost = np.inf
        self.reason, self.deadline = "", np.inf
        self.best: tuple[tuple[float, float], Trajectory, Floats] | None = None
        self.state: SearchState | None = None
        self.plan: Plan | None = None
        self.noise: Plan | None = None  # the pass whose value function tells what noise costs
        self.step: Step | None = None
        robot = problem.scene.robot.name
        self.label = f"{robot}, {problem.steps} steps of {problem.dt:g} s from t = {problem.t0:g} s"
        self._expansions: Steps | None = None
        self._enforce(NOWHERE)

    def begin(self, commands: Commands) -> None:
        """Begin with the motion under commands.

        Raises:
            NoiseFieldError, ForceError, StepFailure, CostError: As :func:`varpin.solve`.
        """
        problem = self.problem
        try:
            attempt = self.trials.attempt(commands)
        except CustomForceError as error:
            start = problem.q0, problem.v0
            raise located(problem.scene, problem.integrator, start, commands, problem.dt, None, error) from error
        trajectory = attempt.trajectory()
        if attempt.failure is not None:
            failure = named(problem.scene, attempt.failure)
            raise StepFailure(trajectory.steps, trajectory.t[-1], failure, trajectory)
        self._move(trajectory, attempt.shares())
        if not np.isfinite(self.cost):
            culprits = " + ".join(map(repr, problem.not_finite(trajectory) or problem.cost.terms))
            raise CostError(culprits, f"the cost of the first motion is {self.cost}")

    def resume(self, plan: Solution) -> None:
        """Continue from the state of a plan."""
        state, known = plan.search, plan.multipliers
        assert state is not None
        self._move(plan.trajectory, self.problem.shares(plan.trajectory))
        self.weight, self.first, self.counts = state.weight, state.first, state.counts
        self.regularization, self.growth = state.regularization, state.growth
        self.second_order = self.second_order or state.second_order
        self.history = list(plan.history[: state.iterations])
        if known is not None:
            self.take(known)

    def take(self, known: Multipliers) -> None:
        """Take over rows between nodes, multipliers and margins."""
        self._enforce(known.between)
        self.multipliers, self.backoff = split(self.bound, known.values), split(self.bound, known.backoff)
        if known.added is not None:
            self.added = split(self.problem.bound_constraints, known.added)

    def run(self, tolerance: float, max_iterations: int, deadline: float, report: Report) -> Status:
        """Iterate to the end."""
        last, longest, self.deadline = len(self.history) + max_iterations, 0.0, deadline
        while True:
            self.state = self._state()
            started = time.perf_counter()
            try:
                found = self._next_step()
            except TRIAL_ERRORS as error:
                if not self.history:
                    raise
                logger.warning("%s: %s", self.label, error)
                self.reason = str(error)
                return Status.NOT_DIFFERENTIABLE
            if not found:
                self.reason = f"the regularization has reached {self.regularization:.1e} of the diagonal of Quu"
                if self.unsolved:
                    self.reason = "the quadratic program within limits and constraints cannot be solved accurately"
                return Status.STALLED if self.unsolved else Status.INDEFINITE
            if self.first < 0.0:
                stake = self.along.stake
                self.first = stake.free if np.isfinite(stake.free) else stake.moved
            self._keep_best()
            ended = self._ended(tolerance)
            if ended is Status.CONVERGED and self._goes_on():
                continue
            if ended is None and self._near and self._looks_between():
                continue
            ended = ended or self._out_of(last, deadline)
            if ended is not None:
                self._go_to_best(ended)
                self._calm()
                self._note(report, started)
                self.reason = self.reason or self._numbers(tolerance)
                return ended
            step = self._known
            self._near = step.decrease <= _CLOSE * self.along.stake.moved
            taken = self._line_search()
            self._note(report, started, taken)
            longest = max(longest, time.perf_counter() - started)
            if taken.length == 0.0 and step.decrease <= taken.hidden and self.violation <= FEASIBLE:
                if self._goes_on():
                    continue
                self.reason = f"{self._expected()}, and rounding hides {taken.hidden:.1e} of the cost"
                return Status.CONVERGED
            if self.tick and taken.length > 0.0 and (out := self._out_of(last, deadline - longest)) is not None:
                # Without a further pass: the rest of the step is left.
                self.step = step._replace(feedforward=(1.0 - min(taken.length, 1.0)) * step.feedforward)
                self.reason = f"{self._expected()} before the last step"
                return out
            if not self._regularize():
                self._calm()
                if self._elastic and step.decrease <= _LITTLE_LESS * self.weight * self._badness:
                    return self._infeasible()
                self.reason = f"no step lowers the cost, whatever the regularization; {self._numbers(tolerance)}"
                return Status.STALLED

    def _out_of(self, last: int, deadline: float) -> Status | None:
        """The status where iterations or time end the search, else None."""
        if len(self.history) >= last:
            return Status.MAX_ITERATIONS
        return Status.OUT_OF_TIME if time.perf_counter() > deadline else None

    @property
    def along(self) -> Steps:
        """The expansions along the motion."""
        if self._expansions is None or self._expansions.trajectory is not self.trajectory:
            self._expansions = Steps(self.problem, self.trajectory)
        return self._expansions

    @property
    def violation(self) -> float:
        """The largest violation of a row, margins included, in its unit."""
        return max(
            (float(part.max(initial=0.0)) * b.scale for part, b in zip(self._excess, self.bound, strict=True)),
            default=0.0,
        )

    @property
    def _known(self) -> Step:
        assert self.step is not None
        return self.step

    def _move(self, motion: Trajectory, shares: Floats) -> None:
        self.trajectory, self.shares, self.cost = motion, shares, float(shares.sum())

    def _enforce(self, between: Instants) -> None:
        self.between, self.whole = between, enforced(self.problem, between)
        self.bound: tuple[BoundConstraint, ...] = self.whole.bound_constraints
        self.multipliers = [np.zeros(item.shape) for item in self.bound]
        self.backoff = [np.zeros(item.shape) for item in self.bound]
        self._excess: list[Floats] = []

    def _state(self) -> SearchState:
        return SearchState(
            weight=self.weight,
            regularization=self.regularization,
            growth=self.growth,
            first=self.first,
            counts=self.counts,
            second_order=self.second_order,
            iterations=len(self.history),
        )

    def _next_step(self) -> bool:
        """Make the step of the motion, with more regularization where there is none; whether there is one."""
        while not self._made():
            if not self._stiffen():
                return False
        return True

    def _made(self) -> bool:
        """Make the feedback and the step of the motion with the present regularization; whether there is one."""
        problem, along = self.problem, self.along
        if self.regularization > 0.0 and not self.second_order and self._is_saturated():
            self.second_order = True
            logger.info("%s: servos are at the limits of their drives: second derivatives from now on", self.label)
        curvature = curvature_along(along, self._costates()) if self.second_order else None
        # Within limits and rows the regularization is a cost of the quadratic program, whose model stays exact.
        free = not (self.bound or problem.limited)
        plan = self._pass(self.regularization if free else 0.0, curvature) or self._pass(self.regularization, curvature)
        if plan is None and curvature is not None:
            curvature = None
            plan = self._pass(self.regularization)
        if plan is None:
            return False
        self.plan = self.noise = plan
        self.exact = curvature is not None
        if problem.processes:
            # Noise grows under regularized gains.
            self.noise = (self._pass(0.0) if self.regularization > 0.0 else plan) or plan
        if self._has_goals:
            self._passes += 1
            self.plan = backward(self._with_goals(along), 0.0) or plan
        if problem.processes and not self.tick:
            self._take_margins(self.plan)
        if free:
            self.step = Step(plan.feedforward, plan.slope, plan.expected_decrease, None)
            return True
        calm = self.regularization == 0.0 and not self._has_goals
        if calm and not self.bound and self._is_free(plan, ()):
            self.step = Step(plan.feedforward, plan.slope, plan.expected_decrease, None)
            return True
        spread = self.noise.spread if problem.processes else None
        stages = Stages.along(along, spread, curvature)
        rows = [stages.rows(*pair) for pair in zip(self.bound, self.backoff, strict=True)]
        self._excess = [_excess(row.values, equality=row.equality) for row in rows]
        self.stages, self.rows = stages, rows
        if calm and self.bound and self._is_free(plan, rows):
            self.step = Step(plan.feedforward, plan.slope, plan.expected_decrease, None)
            self.multipliers = [np.zeros(item.shape) for item in self.bound]
            return True
        u, (lower, upper) = problem.decided(self.trajectory), problem.control_limits
        least, most = np.minimum(lower - u, 0.0), np.maximum(upper - u, 0.0)
        given = problem.begin
        if given is not None:
            least[0], most[0] = (np.where(np.isnan(given), part[0], 0.0) for part in (least, most))
        self.program = Program(stages, rows, (least, most), plan, self.regularization)
        return self._solve_program()

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

    def _at_limits(self) -> Mask | None:
        """Which controls of the motion are at their limits (R, m); None where there are none."""
        u, (lower, upper) = self.problem.decided(self.trajectory), self.problem.control_limits
        found = (u <= lower) | (u >= upper)
        return found if found.any() else None

    def _solve_program(self) -> bool:
        program, rows = self.program, self.rows
        values = [row.values for row in rows]
        bad, dear = self._badness, _ELASTIC * max(abs(self.cost), self.first)

        self._elastic = bool(rows) and self.regularization > _YIELDING
        found = None if self._elastic else program.minimum(values)
        # Rows that cost far more than what is at stake are approached step by step.
        needed = np.inf if found is None else _ABOVE * _largest(found.multipliers)
        dear = max(dear, _LIGHTEST * needed if needed < np.inf else _ELASTIC * program.stiffness)
        if rows and needed > max(self.weight, dear):
            self._elastic = True
            self.weight = max(self.weight, dear)
            missed = program.minimum(values, weight=self.weight)
            while missed is not None and missed.slack > _APPROACHED * bad and self.weight < needed < np.inf:
                self.weight *= _ELASTIC
                missed = program.minimum(values, weight=self.weight)
            found = missed or found
        self.unsolved = found is None
        if found is None:
            return False
        most = _largest(found.multipliers)
        if not self._elastic or found.slack <= _MET * max(bad, 1.0):
            self.weight = max(min(self.weight, _HEAVY * most), _ABOVE * most)
        # Interior points leave a trace of a multiplier at each row that is not active.
        self.multipliers = [
            (np.where(np.abs(part) > _TRACE * most, part, 0.0) / item.scale).reshape(item.shape)
            for part, item in zip(found.multipliers, self.bound, strict=True)
        ]
        linear, whole = self.stages.change(found.z)
        lower = self.weight * (bad - found.slack)
        self.step = Step(self._feedforward(found.z), linear - lower, lower - whole, found, self.stages, rows)
        return True

    @property
    def _badness(self) -> float:
        """Sum of all violations, in tenths of ranges."""
        return float(sum(part.sum() for part in self._excess))

    @property
    def _has_goals(self) -> bool:
        return any(item.source.equality for item in self.bound)

    def _with_goals(self, along: Steps) -> Steps:
        """The expansions with the goals at the end as a cost, for the feedback."""
        if not self._has_goals:
            return along
        made, end = copy(along), along.terminal
        hessian = end.hessian.copy()
        for item in self.bound:
            if item.source.equality:
                J = item.jacobian(self.trajectory.q, self.trajectory.v)[-1] @ end.slopes / item.scale
                hessian += _GOAL * max(abs(self.cost), self.first, 0.0) * J.T @ J
        vars(made)["terminal"] = end._replace(hessian=hessian)
        return made

    def _foreseen_states(self) -> Floats | None:
        """The changes of q and v at the nodes (N + 1, 2n) with a full step, by the linear model."""
        problem, along, plan = self.problem, self.along, self.plan
        if self._known.minimum is not None or plan is None:
            return None
        z, _ = foreseen(along, plan)
        change: Floats = (along.slopes @ Layout.of(problem).states_of(z)[:, :, None])[:, :, 0]
        return change

    def _is_free(self, plan: Plan, rows: Sequence[Rows]) -> bool:
        """Whether the full step of a backward pass keeps to all limits and rows, by the linear model."""
        z, limited = foreseen(self.along, plan)
        padded = np.append(z, 0.0)
        return not limited and all(
            (row.values + (row.slopes * np.where(row.at >= 0, padded[row.at], 0.0)).sum(axis=1) <= 0.0).all()
            for row in rows
        )

    def _feedforward(self, z: Floats) -> Floats:
        """The changes of the controls in z, without what feedback gives for its states."""
        plan, layout, problem = self.plan, self.stages.layout, self.problem
        assert plan is not None
        x, u = layout.states_of(z)[: -1 : problem.hold], layout.controls_of(z)
        before = np.vstack([np.zeros((1, u.shape[1])), u[:-1]])
        if problem.linear:
            # A control reacts to the state where its line begins.
            x = np.vstack([np.zeros((1, x.shape[1])), x])
        found: Floats = u - np.einsum("rmx,rx->rm", plan.feedback, x)
        if plan.previous is not None:
            found -= np.einsum("rmx,rx->rm", plan.previous, before)
        return found

    def _costates(self) -> Floats:
        """Derivatives (N, 2n) of the Lagrangian in the state after each step, with the known multipliers."""
        stages, rows, pushes = Stages.along(self.along), [], []
        for item, margin, push in zip(self.bound, self.backoff, self.multipliers, strict=True):
            if push.any() and not item.of_controls:
                rows.append(stages.rows(item, margin))
                pushes.append(push.ravel() * item.scale)
        return stages.costates(rows, pushes)

    def _take_margins(self, plan: Plan) -> None:
        """Margins of all rows, in their units: standard deviations under the plan's feedback, and what is added."""
        kept = [item for item in self.bound if item.source.margin > 0.0]
        if not kept:
            return
        spreads = iter(deviations(self.along, Feedback(plan.feedback, plan.previous), kept))
        own = [
            item.source.margin * next(spreads) if item.source.margin > 0.0 else np.zeros(item.shape)
            for item in self.bound
        ]
        if self.added is not None:
            more = [*self.added, *(self.added[i][self.between.of(i)[:, 0]] for i in self.between.constraints)]
            own = [part + extra for part, extra in zip(own, more, strict=True)]
        self.backoff = [
            np.where(item.in_force, part, 0.0) if isinstance(item, BoundBetween) else part
            for item, part in zip(self.bound, own, strict=True)
        ]

    def _ended(self, tolerance: float) -> Status | None:
        """The status of a search whose step gains no more than the tolerance; None if it goes on."""
        problem, step, share = self.problem, self._known, self._share(tolerance)
        met = self.violation <= FEASIBLE
        if not met and step.minimum is not None and self._elastic:
            bad = self._badness
            if self.weight * (bad - step.minimum.slack) <= _STAYS * self.weight * bad and step.decrease <= max(
                share, _STAYS * self.weight * bad
            ):
                return self._infeasible()
        if met and not problem.steered.any() and self.along.stake.free <= tolerance * _NOTHING * self.first:
            # The cost is at its lower bound. Without costs of the controls the model may have no minimum even there.
            return Status.CONVERGED
        if met and step.decrease <= share:
            if self.regularization > _LITTLE and self._gains_more(share):
                return None
            return Status.CONVERGED
        if len(self.history) > _PATIENCE:
            recent = sum(item.decrease for item in self.history[-_PATIENCE:])
            if recent <= share:
                self.reason = (
                    f"{_PATIENCE} iterations have lowered the merit by {recent:.1e}; {self._numbers(tolerance)}"
                )
                return Status.STALLED
        return None

    def _keep_best(self) -> None:
        """Remember the motion that violates rows least, or costs least within them, where margins move with it."""
        if not any(item.source.margin > 0.0 for item in self.bound) or not self.problem.processes:
            return
        assert self.noise is not None
        rank = max(self.violation, FEASIBLE), self.cost + self.noise.noise
        if self.best is None or rank < self.best[0]:
            self.best = rank, self.trajectory, self.shares

    def _go_to_best(self, ended: Status) -> None:
        """Return to the best motion of a search that has not converged."""
        if self.best is not None and not ended.converged and self.best[1] is not self.trajectory:
            self._move(*self.best[1:])
            with contextlib.suppress(*TRIAL_ERRORS):
                self._made()

    def _calm(self) -> None:
        """Make the last feedback and step without regularization, where the model has a minimum."""
        kept = self.regularization
        if kept > 0.0 and not self.tick:
            self.regularization = 0.0
            with contextlib.suppress(*TRIAL_ERRORS):
                if not self._made():
                    self.regularization = kept
                    self._made()
        margins = any(item.source.margin > 0.0 for item in self.bound)
        if self.problem.processes and self.problem.limited and not (margins or self._has_goals or self.tick):
            # Controls at their limits do not react to noise, and the plan tells what it costs then.
            held = self._pass(0.0, fixed=self._at_limits())
            self.plan, self.noise = held or self.plan, held or self.noise

    def _gains_more(self, share: float) -> bool:
        """Whether the step without regularization gains more than that; if not, it becomes the step."""
        kept = self.regularization, self.growth
        self.regularization = 0.0
        if self._made() and self._known.decrease <= share:
            return False
        self.regularization, self.growth = kept
        self._made()
        return True

    def _goes_on(self) -> bool:
        """Whether a search that has converged goes on with further rows between nodes, or wider margins."""
        if self.tick:
            return False
        if self._looks_between():
            return True
        return self._counts_motions()

    def _looks_between(self) -> bool:
        """Whether there are other rows between nodes, at the peaks of the motion."""
        problem = self.problem
        if self.tick or not any(watched(problem)) or not (problem.linear or problem.between_nodes):
            return False
        looked = seen(problem, self.trajectory)
        if looked is None:
            return False
        count = len(problem.bound_constraints)
        backoff = self.backoff[:count]
        left = beyond(looked, backoff)
        bounds = np.array(
            [_BETWEEN if problem.between_nodes else _SHARE * item.scale for item in problem.bound_constraints]
        )
        if not (left > bounds).any():
            return False
        made = extended(problem, self.between, looked, backoff)
        if self._looks >= _LOOKS:
            return False
        self._looks, self._near = self._looks + 1, False
        if len(made.rows):
            kept = self.multipliers[:count]
            self._enforce(made)
            self.multipliers[:count] = kept
            self.backoff[:count] = backoff
        return len(made.rows) > 0

    def _counts_motions(self) -> bool:
        """Whether margins become wider, as motions under noise violate bounds more often than these promise."""
        problem = self.problem
        if self.counts >= _COUNTS or not problem.processes:
            return False
        if not any(item.source.margin > 0.0 for item in self.bound):
            return False
        self.counts += 1
        try:
            more = widened(self.solution(Status.CONVERGED), self.deadline)
        except VarpinError:
            return False
        if more is None:
            return False
        self.added = more
        return True

    def _line_search(self) -> Taken:
        """Move to the first trial along the step with a sufficient decrease of the merit."""
        step = self._known
        here = self._merit_here()
        best, length, trials, tried = Trial(), 0.0, 0, None
        ff, corrections = step.feedforward, _CORRECTIONS
        z = None if step.minimum is None else step.minimum.z
        lengths = Lengths(self.backtracking)
        for a in lengths:
            trial = self._try(a, ff, here, z)
            trials += 1
            while a == 1.0 and trial.merit > self.armijo * step.slope and corrections and trial.attempt is not None:
                corrections -= 1
                again = self._corrected(trial.attempt)
                if again is None:
                    break
                other = self._try(1.0, self._feedforward(again), here, again)
                trials += 1
                if other.merit >= trial.merit:
                    break
                trial = other
            lengths.learn(a, trial.merit, step.slope)
            if a == 1.0 and -trial.merit < _AS_FORESEEN * step.decrease and (path := self._foreseen_path()) is not None:
                other, along_path, more = self._follow(*path, here)
                trials += more
                if other.merit < trial.merit and other.merit <= self.armijo * along_path * step.slope:
                    best, length = other, along_path
                    break
            if trial.shares is not None:
                tried = trial.shares
            if trial.merit <= self.armijo * a * step.slope and trial.merit < best.merit:
                best, length = trial, a
                if trial.merit <= _POOR * a * step.slope:
                    break
                continue
            if length > 0.0:
                break
        early = -_EARLY * step.slope
        while length >= 1.0 and step.minimum is None and -best.merit >= length * early and not self.tick:
            longer = self._try(_EXTENSION * length, ff, here, None)
            trials += 1
            if longer.merit >= best.merit:
                break
            best, length = longer, _EXTENSION * length
        if length == 0.0:
            hidden = 0.0
            if tried is not None:
                hidden = self.along.rounding(self.shares, tried)
            return Taken(trials=trials, hidden=hidden)
        assert best.attempt is not None
        assert best.shares is not None
        self._move(best.attempt.trajectory(), best.shares)
        return Taken(length, trials, -best.merit)

    def _merit_here(self) -> Here:
        assert self.noise is not None
        return Here(noise_shares(self.problem, self.trajectory, self.noise), self._badness)

    def _try(self, length: float, feedforward: Floats, here: Here, z: Floats | None) -> Trial:
        """A trial of a length along the step; with ``z``, the controls that it brings to a limit stay there."""
        problem = self.problem
        u = problem.decided(self.trajectory)
        if not self.closed:
            return self._run(held(u, problem)._replace(u=u + length * feedforward), here)
        commands = self._around(u, states(problem, self.trajectory)[: -1 : problem.hold])
        u = u + length * feedforward
        if z is not None and problem.limited:
            aim = problem.decided(self.trajectory) + length * self.stages.layout.controls_of(z)
            for limit, sign in zip(problem.control_limits, (-1.0, 1.0), strict=True):
                there = np.isfinite(limit) & (sign * (aim - limit) >= -_AT_LIMIT * np.abs(limit))
                u = np.where(there, limit, u)
                gains = commands.gains if not problem.linear else np.concatenate([commands.gains[:1], commands.gains])
                gains = np.where(there[:, :, None], 0.0, gains)
                commands = commands._replace(gains=np.ascontiguousarray(gains[1:] if problem.linear else gains))
        return self._run(commands._replace(u=u), here)

    def _around(self, u: Floats, x: Floats) -> Commands:
        """Controls with the plan's feedback around states."""
        assert self.plan is not None
        return around(self.problem, u, x, self.plan.feedback, self.plan.previous)

    def _run(self, commands: Commands, here: Here) -> Trial:
        """A trial under commands, with its change of the merit, (O11)."""
        problem = self.problem
        assert self.noise is not None
        if problem.linear:
            # The first control has no feedback: its state is given.
            first = problem.begun(np.clip(commands.u[:1], *problem.control_limits))
            commands = commands._replace(u=commands.u[1:], before=first)
        parts = _SUBSTEPS * max(1, int(self.trajectory.statistics.substeps[: self.trials.third].sum()))
        try:
            attempt = self.trials.attempt(commands, parts=parts)
            if not attempt.whole:
                return Trial()
            shares, noise, bad = attempt.shares(), 0.0, 0.0
            motion = attempt.trajectory()
            if problem.processes:
                noise = float((noise_shares(problem, motion, self.noise) - here.noise).sum())
            if self.bound:
                bad = sum(float(part.sum()) for part in self._violations(motion)) - here.bad
        except TRIAL_ERRORS as error:
            logger.info("%s: trial: %s", self.label, error)
            return Trial()
        merit = float((shares - self.shares).sum()) + noise + (self.weight * bad if bad else 0.0)
        return Trial(merit, attempt, shares) if np.isfinite(merit) else Trial()

    @cached_property
    def _follows(self) -> bool:
        """Whether there are controls, just one for each motion, that give all joints the forces it needs."""
        problem, scene = self.problem, self.problem.scene
        if problem.linear or self.tick or not self.closed:
            return False
        if scene.inputs or scene.constraints or scene.custom is not None or limited_servos(scene.elements):
            return False
        n = scene.robot.dof
        return scene.direct or (scene.controls == n and int(np.linalg.matrix_rank(scene.actuation)) == n)

    def _follow(self, commands: Commands, length: float, cost: float, here: Here) -> tuple[Trial, float, int]:
        """The better motion along foreseen states: under feedback that holds it there, or the plan's."""
        gains = np.tile(holding_gains(self.problem), (len(commands.u), 1, 1))
        x = commands.reference[:, : gains.shape[2]]
        best = self._run(commands._replace(gains=gains, reference=np.ascontiguousarray(x)), here)
        if best.merit <= _FOLLOWS * cost:
            return best, length, 1
        return min(best, self._run(commands, here), key=lambda trial: trial.merit), length, 2

    def _foreseen_path(self) -> tuple[Commands, float, float] | None:
        """Commands along the states that the step foresees, (O12), its length and the foreseen change of the cost.

        The controls are those of the inverse dynamics: what it is off by on the motion itself cancels. None where the
        states cost no less than the motion, or far from it.
        """
        problem, motion, n = self.problem, self.trajectory, self.problem.scene.robot.dof
        if not self._follows or self.bound:
            return None
        change = self._foreseen_states()
        if change is None:
            return None
        far = float(np.abs(change[:, :n]).max())
        lengths = [length for length in _LENGTHS if length * far <= _FAR]
        if not lengths:
            return None
        parts = np.array([0.0, *lengths])[:, None, None]
        q, v = motion.q + parts * change[:, :n], motion.v + parts * change[:, n:]
        force = joint_forces(problem, q, v)
        u = problem.decided(motion) + (force[1:] - force[:1]) @ problem.scene.allocation.T
        u = np.clip(u, *problem.control_limits)
        costs = problem.costs(q[1:], v[1:], np.repeat(u, problem.hold, axis=1)) - self.cost
        best = int(np.argmin(costs))
        if not costs[best] < 0.0:
            return None
        commands = self._around(u[best], states_on(problem, q[1 + best], v[1 + best]))
        return commands, lengths[best], float(costs[best])

    def _values(self, motion: Trajectory) -> list[Floats]:
        """Values (P,) of all rows on a motion, margins included, in tenths of ranges."""
        u = self.problem.control_rows(motion)
        return [
            (item.value(motion.q, motion.v, u) + margin).ravel() / item.scale
            for item, margin in zip(self.bound, self.backoff, strict=True)
        ]

    def _violations(self, motion: Trajectory) -> list[Floats]:
        return [
            _excess(values, equality=item.source.equality)
            for values, item in zip(self._values(motion), self.bound, strict=True)
        ]

    def _corrected(self, attempt: Attempt) -> Floats | None:
        """The step with rows and dynamics as a full step found them; None where there is none."""
        problem, step = self.problem, self._known
        if step.minimum is None or not self.bound:
            return None
        motion, layout = attempt.trajectory(), self.stages.layout
        moved = states(problem, motion) - states(problem, self.trajectory)
        z = layout.joined(moved, problem.decided(motion) - problem.decided(self.trajectory))
        values = [
            there - change for there, change in zip(self._values(motion), self.program.after_rows(z), strict=True)
        ]
        weight = self.weight if self._elastic else None
        found = self.program.minimum(values, self.stages.gaps_of(z), weight)
        return None if found is None else found.z

    def _share(self, tolerance: float) -> float:
        """Tolerance on the expected decrease, in units of the cost."""
        return tolerance * (self.along.stake.moved + _NOTHING * self.first)

    def _expected(self) -> str:
        return f"the expected decrease is {np.nan if self.step is None else self.step.decrease:.1e}"

    def _numbers(self, tolerance: float) -> str:
        share = np.nan if self.step is None else self._share(tolerance)
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
        margin = float(self.backoff[k][place, row])
        if margin > 0.0:
            self.reason += f", its margin of {margin:.3g} {item.unit} included"
        return Status.INFEASIBLE

    def _note(self, report: Report, started: float, taken: Taken | None = None) -> None:
        step, noise = self._known, self.noise
        item = Iteration(
            index=len(self.history),
            cost=self.cost,
            noise_cost=0.0 if noise is None else noise.noise,
            expected_decrease=step.decrease,
            decrease=0.0 if taken is None else taken.decrease,
            step=0.0 if taken is None else taken.length,
            regularization=self.regularization,
            gradient=float(np.abs(self._gradient()).max()),
            backward_passes=self._passes,
            rollouts=0 if taken is None else taken.trials,
            seconds=time.perf_counter() - started,
            second_order=self.exact,
        )
        self.history.append(item)
        self._passes = 0
        logger.info("%s: %s", self.label, item)
        report(item, self.trajectory)

    def _gradient(self) -> Floats:
        """The gradient of the Lagrangian in the controls (R, m), by the costates of the program."""
        step, plan = self._known, self.plan
        assert plan is not None
        if step.minimum is None or step.stages is None:
            return plan.gradient
        return step.stages.slopes(step.rows, step.minimum.multipliers)

    def _regularize(self) -> bool:
        """Adapt the regularization to the last step; False if no more of it helps."""
        lengths = [item.step for item in self.history[-2:]]
        if lengths[-1] >= _LONG:
            self.growth = min(1.0 / _GROWTH, self.growth / _GROWTH)
            self.regularization *= self.growth
            if self.regularization < _LEAST:
                self.regularization = 0.0
        elif lengths[-1] <= _VERY_SHORT or (max(lengths) <= _SHORT and len(lengths) > 1):
            return self._stiffen()
        return True

    def _stiffen(self) -> bool:
        self.growth = max(_GROWTH, self.growth * _GROWTH)
        self.regularization = max(_LEAST, self.regularization * self.growth)
        return self.regularization <= _MOST

    def solution(self, status: Status) -> Solution:
        """The motion, however the search ended, with the feedback around it."""
        problem, plan, step = self.problem, self.plan, self.step
        R, m, n = problem.decisions, problem.scene.controls, problem.scene.robot.dof
        previous = None
        if problem.rate is not None or problem.linear:
            previous = np.zeros((R, m, m))
            if plan is not None and plan.previous is not None:
                previous = plan.previous
        known = None
        if problem.constraints:
            known = Multipliers(
                values=flat(self.multipliers),
                backoff=flat(self.backoff),
                instants=self.between.rows if len(self.between.rows) else None,
                moments=self.between.moments if len(self.between.rows) else None,
                cubic=self.between.cubic,
                added=None if self.added is None else flat(self.added),
            )
        reason = self.reason
        if plan is not None and plan.loss > _LOSSY:
            lost = f"rounding may have changed Quu by {plan.loss:.0e} of itself: weights or inertias are too far apart"
            logger.warning("%s: the gains cannot be trusted: %s", self.label, lost)
            reason = f"{reason}; {lost}"
        known_noise = np.nan if problem.scene.processes else 0.0
        return Solution(
            problem=problem,
            trajectory=self.trajectory,
            gains=np.zeros((R, m, 2 * n)) if plan is None else plan.feedback,
            previous_gains=previous,
            feedforward=np.zeros((R, m)) if step is None else step.feedforward,
            gradient=np.full((R, m), np.nan) if step is None else self._gradient(),
            cost=self.cost,
            noise_cost=known_noise if self.noise is None else self.noise.noise,
            status=status,
            reason=reason,
            history=tuple(self.history),
            search=self.state,
            multipliers=known,
        )


def _largest(multipliers: Sequence[Floats]) -> float:
    return max((float(np.abs(part).max(initial=0.0)) for part in multipliers), default=0.0)


def _excess(values: Floats, *, equality: bool) -> Floats:
    return np.abs(values) if equality else np.maximum(values, 0.0)
