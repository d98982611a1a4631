"""The iterations of S-DDP: their regularization and the stopping criteria.

The backward pass is in :mod:`varpin.control.backward`, the line search in :mod:`varpin.control.line_search`.
:mod:`varpin.control.unconstrained` begins and ends searches.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections.abc import Callable

import numpy as np

from varpin.arrays import Floats, Mask
from varpin.control.along import Along
from varpin.control.backward import backward
from varpin.control.commands import first_commands
from varpin.control.costs import CostError
from varpin.control.history import Iteration, SearchState, Status
from varpin.control.line_search import TRIAL_ERRORS, VERY_SHORT, LineSearch, Rated, Start, Step
from varpin.control.multiple_shooting import GapClosing
from varpin.control.noise_adjoint import is_exact
from varpin.control.passes import Plan, noise_shares
from varpin.control.problem import OptimalControlProblem
from varpin.control.solution import Solution
from varpin.control.spread import Feedback
from varpin.control.trials import Trials
from varpin.control.watchdog import Watchdog
from varpin.core.arrays import Commands
from varpin.errors import LinearizationError
from varpin.mechanics.custom import CustomForceError
from varpin.simulation.failures import StepFailure, named
from varpin.simulation.limits import saturates
from varpin.simulation.record import located
from varpin.trajectory import Trajectory

Report = Callable[[Iteration, Trajectory], None]

logger = logging.getLogger(__name__)

# Least share of the expected decrease that a step must reach (Armijo), and the factor between trials.
ARMIJO, BACKTRACKING = 1e-5, 0.5
# The schedule of the regularization (Tassa, Erez and Todorov 2012), relative to the diagonal of Quu: it decreases after
# long steps and increases after a very short one, or after two short ones in a row.
_GROWTH, _LEAST, _MOST = 2.0, 1e-6, 1e10
_LONG, _SHORT = 0.5, 0.1
# A step with clipped controls is preferred to a short one where its decrease is so many times as great, and where it
# brings no more than this share of the controls to limits.
_MUCH_MORE, _FEW = 3.0, 0.02
# Greatest regularization with which a search may converge. Controls without effect or cost need some.
_LITTLE = 1e-4
# Relative rounding error of Quu above which the gains are reported as unreliable.
_LOSSY = 1e-8
# Iterations without significant decrease before the search stalls. The cost is discontinuous where guards cut steps.
PATIENCE = 15
# Expected decrease, as a share of the cost at stake, from which a search takes the whole gradient of the noise cost.
_NEAR = 1e-4
# Iterations in a row without a lower expected cost, after which it takes that gradient, too, if it has it exactly.
_RISES = 2
# Iterations by whose decrease a search that may end early is judged.
_SLOW = 8
# Share of the first motion's cost at stake that is added to the current one: an optimum of cost zero has none.
NOTHING = 1e-9
# Marks a cost at stake that no backward pass has computed yet.
_UNKNOWN = -1.0


class Search:
    """The state of a search: the current motion, its plan and the history.

    Options are as of :func:`varpin.solve`. ``anew``: whether the final motion gets a backward pass of its own, which
    those of a controller's ticks do not.
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        second_order: bool,
        forward: str = "closed",
        armijo: float = ARMIJO,
        backtracking: float = BACKTRACKING,
        regularization: float = 0.0,
        *,
        anew: bool = True,
        whole_noise: bool = False,
    ) -> None:
        self.problem, self.second_order, self.forward = problem, second_order, forward
        self.regularization = regularization
        self.growth = 1.0
        self.exact = second_order
        # Whether drives of servos have come to their limits while steps were short: from then on changes of their
        # demands are regularized, and second derivatives are used.
        self.saturated = False
        # Whether plans leave out the limits now, and whether they may do so: no step of theirs has been rejected.
        self.clipping, self.clips = False, problem.limited
        self.follows = True  # whether trials may follow foreseen states: none of them has strayed
        self.overshot = False  # whether an extension of the last full step did not lower the cost
        self.history: list[Iteration] = []
        self.plan: Plan | None = None
        self.planned: tuple[Trajectory, float, bool] | None = None  # (motion, regularization, exact) of the plan
        self.trials = Trials(problem)
        self._around: Along | None = None
        self.trajectory: Trajectory
        self.shares: Floats  # the terms of the trajectory's cost
        self.cost = np.inf
        self.first = 0.0  # cost at stake on the first motion
        self.state: SearchState | None = None  # at the start of the last iteration, for resuming
        self.best: Trajectory | None = None
        self.best_cost = self.best_noise = np.inf
        self.above = 0.0  # cost of the trajectory minus that of the best one, without noise
        self.bounded = True  # whether trials stop at a number of substeps
        self.cut = False  # whether one did
        # The motion before the last step, its shares, cost, and cost above the best one.
        self.before: tuple[Trajectory, Floats, float, float] | None = None
        # The motion from which the last step led to the current one, and that one, if it was a full step.
        self.behind: tuple[Trajectory, Trajectory] | None = None
        # Whether the search has just gone back from a motion that cannot be linearized.
        self.returned = False
        self.watchdog = Watchdog()
        # Whether short trials of the last line searches were rejected where they divide other steps than the motion.
        self.jumps = False
        self.gains: list[float] = []  # decrease of the least expected cost in each iteration, those away left out
        self.reason = ""
        self.anew = anew  # whether the final motion gets a backward pass of its own
        self.followed = 0.0  # without one, the length of the last step
        self.rows: Mask | None = None  # active rows of penalties of the last plan
        self.steered = problem.steered
        self.all_steered, self.any_steered = bool(self.steered.all()), bool(self.steered.any())
        # Whether the search ends with the whole gradient of the noise cost, and whether it has come to that. Within
        # limits the noise cost is discontinuous where a control meets one and loses its gains, so it has no gradient.
        self.wants_whole = whole_noise and not (second_order or problem.limited) and self.any_steered
        self.whole = False
        self.rated: Rated | None = None  # of the current motion
        # Prefix of each log line: it tells several problems, and a controller's ticks, apart.
        robot, begin = problem.scene.robot.name, problem.t0
        self.label = f"{robot}, {problem.steps} steps of {problem.dt:g} s from t = {begin:g} s"
        self.line_search = LineSearch(
            problem,
            self.trials,
            armijo=armijo,
            backtracking=backtracking,
            closed=forward == "closed",
            label=self.label,
        )

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
            failure = named(self.problem.scene, attempt.failure)
            raise StepFailure(trajectory.steps, trajectory.t[-1], failure, trajectory)
        self.trajectory = trajectory
        self.shares = attempt.shares()
        self.cost = float(self.shares.sum())
        if not np.isfinite(self.cost):
            culprits = " + ".join(map(repr, problem.not_finite(trajectory) or problem.cost.terms))
            raise CostError(culprits, f"the cost of the first motion is {self.cost}")

    def close(self, closing: GapClosing, most: int, deadline: float, report: Report) -> None:
        """Remove the auxiliary forces of given states, in at most ``most`` iterations, and begin with the result."""
        try:
            closing.run(most, deadline, report)
        finally:
            self.history = list(closing.history)
            self.begin(first_commands(self.problem, closing.policy()))
            # The cost at stake is that of this motion, after however many iterations.
            self.first = _UNKNOWN
            self.state = self._state()

    def resume(self, state: SearchState) -> None:
        """Continue from ``state``."""
        self.trajectory, self.cost, self.above, self.first = state.trajectory, state.cost, state.above, state.first
        self.shares = self.problem.shares(state.trajectory)
        self.gains, self.history = list(state.gains), list(state.history)
        self.best, self.best_cost, self.best_noise = state.best, state.best_cost, state.best_noise
        self.regularization, self.growth = state.regularization, state.growth
        self.bounded, self.cut = state.bounded, state.cut
        self.whole = state.whole and self.wants_whole
        self.clips = state.clips and self.clips
        self.follows, self.overshot = state.follows, state.overshot
        self.returned = state.returned
        self.behind = None if state.behind is None else (state.behind, state.trajectory)
        self.watchdog, self.rows = state.watchdog, state.rows
        if state.saturated:
            self._take_saturation()

    def _state(self) -> SearchState:
        return SearchState(
            trajectory=self.trajectory,
            cost=self.cost,
            above=self.above,
            first=self.first,
            best=self.best,
            best_cost=self.best_cost,
            best_noise=self.best_noise,
            gains=tuple(self.gains),
            regularization=self.regularization,
            growth=self.growth,
            bounded=self.bounded,
            cut=self.cut,
            history=tuple(self.history),
            whole=self.whole,
            saturated=self.saturated,
            clips=self.clips,
            follows=self.follows,
            overshot=self.overshot,
            returned=self.returned,
            behind=self._behind(),
            watchdog=self.watchdog,
            rows=self.rows,
        )

    def run(
        self, tolerance: float, max_iterations: int, deadline: float, report: Report, *, slow: float | None = None
    ) -> Status:
        """Iterate to the end; with ``slow``, no longer than progress is faster than that, :meth:`_is_slow`."""
        last, longest = len(self.history) + max_iterations, 0.0
        while True:
            self.state = self._state()
            started = time.perf_counter()
            failed, passes = self._next_plan()
            if failed is not None or self.plan is None:
                return failed or Status.INDEFINITE
            self._compare_with_best(self.plan)
            if not self.history or self.first == _UNKNOWN:
                self.first = self._at_first()
            there = self._is_there(self.plan, tolerance)
            if self._is_back(there):
                continue
            if self._turns_whole(ends=there):
                self._take_whole()
                continue
            if there:
                self._note(report, started, passes)
                self.reason = self._numbers(tolerance)
                return Status.CONVERGED
            if slow is not None and self._is_slow(slow):
                self._note(report, started, passes)
                self.reason = "ended early for slow progress; " + self._numbers(tolerance)
                return Status.MAX_ITERATIONS
            ended, why = self._ended(tolerance, last, deadline)
            if ended is Status.STALLED and self._goes_on():
                continue
            if ended is not None:
                self._note(report, started, passes)
                self.reason = why + self._numbers(tolerance, afresh=True)
                return ended
            step, more = self._step()
            self._note(report, started, passes + more, step)
            if step.length == 0.0 and not self.watchdog.away and self._decrease_at_most(step.hidden):
                self.reason = f"{self._expected()}, and rounding hides {step.hidden:.1e} of the cost"
                return Status.CONVERGED
            # A tick's iteration begins only if it will end in time, should it take as long as the longest before.
            longest = max(longest, time.perf_counter() - started)
            ended = self._out_of(last, deadline if self.anew else deadline - longest)
            if not self.anew and step.length > 0.0 and ended is not None:
                self.followed = step.length
                self.reason = f"{self._expected()} before the last step"
                return ended
            self.watchdog = self.watchdog.stepped()
            if not self._regularized(step):
                self.reason = f"no step lowers the cost, whatever the regularization; {self._jump()}"
                self.reason += self._numbers(tolerance, afresh=True)
                return Status.STALLED

    def _next_plan(self) -> tuple[Status | None, int]:
        """Backward passes along the motion, or along an earlier one where they fail, and their number.

        The status is that of a search that has no plan, else None.
        """
        passes = 0
        while True:
            try:
                passes += self._plan()
            except TRIAL_ERRORS as error:
                if not self.history:
                    raise
                if not (self._returns() or (isinstance(error, LinearizationError) and self._go_back())):
                    logger.warning("%s: %s", self.label, error)
                    self.reason = str(error)
                    return Status.NOT_DIFFERENTIABLE, passes
            else:
                if self.plan is not None:
                    return None, passes
                if not self._returns():
                    self.reason = f"the regularization has reached {self.regularization:.1e} of the diagonal of Quu"
                    return Status.INDEFINITE, passes
            self.state = self._state()

    def _step(self) -> tuple[Step, int]:
        """A step along the plan, or along others where that is none or short, and the backward passes it took."""
        first, motion = self.plan, self.trajectory
        step, passes = self._departure()
        if step.length == 0.0:
            step = _after(step, self._line_search())
        if step.length == 0.0 and self.exact:
            passes += self._plan(exact=False)
            step = _after(step, self._line_search())
        if step.length <= _SHORT and first is not None and self._meets_limits(first, motion):
            step, more = self._clipped_instead(step)
            passes += more
        return step, passes

    def _goes_on(self) -> bool:
        """Whether a search that has stalled goes on in another way."""
        if self._returns() or self._lift():
            return True
        if self._turns_whole(ends=True):
            self._take_whole()
            return True
        return False

    def _regularized(self, step: Step) -> bool:
        """Adapt the regularization to the last step; False if no more of it helps."""
        if step.length <= VERY_SHORT and self._returns():
            return True
        if self.returned:
            # With less regularization the step might lead there again.
            self.returned = False
        elif step.length >= _LONG:
            self._relax()
        elif self._steps_short():
            return self._stiffen() or self._lift()
        return True

    def _departure(self) -> tuple[Step, int]:
        """A long step that may raise the cost, where steps have been short, (O16); and the backward passes it took."""
        dog = self.watchdog
        # Under noise that changes plans the costs of motions are not comparable from one plan to the next.
        if not self.anew or self.any_steered or not dog.departs(item.step for item in reversed(self.history)):
            return Step(), 0
        home, step, passes = (self.plan, self.planned, self.regularization, self.growth), Step(), 0
        if self.regularization > 0.0:
            self.regularization, self.growth = 0.0, 1.0
            passes = self._plan()
        if self.plan is not None:
            step = self._along_plan(functools.partial(self.line_search.leap, most=dog.rise * self.first))
            if step.length > 0.0:
                self.watchdog = dog.departed(*home[2:])
                logger.info("%s: steps stay short: departs from the best motion", self.label)
                return step, passes
        self.plan, self.planned, self.regularization, self.growth = home
        self.watchdog = dog.returned()
        return step, passes

    def _is_back(self, there: bool) -> bool:
        """Whether a search has returned to the best motion in vain; ``there``: it would converge where it is."""
        if self.watchdog.away and self.best is self.trajectory:
            self.watchdog = Watchdog()
            return False
        return (there or self.watchdog.overdue) and self._returns()

    def _returns(self) -> bool:
        """Return to the best motion if away; whether it was."""
        dog = self.watchdog
        if not dog.away or self.best is None:
            return False
        logger.info("%s: returns to the best motion", self.label)
        self._take_best()
        self.regularization, self.growth, self.watchdog = dog.regularization, dog.growth, dog.returned()
        return True

    def _take_best(self) -> None:
        """Go on from the best motion so far."""
        if self.best is not None and self.best is not self.trajectory:
            self.trajectory, self.cost, self.above = self.best, self.best_cost, 0.0
            self.shares = self.problem.shares(self.best)

    def _at_first(self) -> float:
        """The cost at stake on the first motion."""
        if not self.anew and self.problem.cost.nonnegative:
            # The value of a sum of squares bounds its cost at stake, and a tick saves the time to compute it.
            return self.cost
        stake = self.along.stake
        return stake.free if np.isfinite(stake.free) else stake.moved

    def _turns_whole(self, *, ends: bool) -> bool:
        """Whether the search with held noise ends, or is close to it, and the one with the whole gradient begins."""
        # The noise cost of exact passes is another.
        if not self.wants_whole or self.whole or self.second_order:
            return False
        # With the noise held, steps may lead to where it costs more than they save. The first gain is of no iteration.
        rises = len(self.gains) > _RISES and not any(self.gains[-_RISES:])
        return ends or (rises and is_exact(self.problem)) or self._decrease_at_most(self._share(_NEAR))

    def _take_whole(self) -> None:
        """Use the whole gradient of the noise cost from now on, starting at the best motion so far."""
        logger.info("%s: continues with the whole gradient of the noise cost", self.label)
        self._take_best()
        # Noise costs before and after this switch are not comparable.
        self.whole, self.best, self.best_cost, self.best_noise, self.above = True, None, np.inf, np.inf, 0.0
        self.gains, self._around, self.regularization, self.growth = [], None, 0.0, 1.0

    def _differentiate_noise(self) -> int:
        """Rate the motion, and add the whole gradient of its noise cost to backward passes along it.

        Returns the number of backward passes that took. Where the model has no minimum without regularization, the
        motion is rated with that of the search.
        """
        if not self.whole or self.along.noise_differentiated:
            return 0
        passes = 0
        if self.rated is None or self.rated.along is not self.along:
            self.rated = None
            for regularization in sorted({0.0, self.regularization}):
                plan, passes = backward(self.problem, self.trajectory, regularization, along=self.along), passes + 1
                if plan is not None:
                    self.rated = Rated(self.along, plan, regularization)
                    break
        if self.rated is not None:
            plan = self.rated.plan
            self.along.differentiate_noise(Feedback(plan.feedback, plan.previous), plan.spread, self.steered)
        return passes

    def _pass(self, regularization: float, *, exact: bool, demands: bool = False, clipped: bool = False) -> Plan | None:
        """A backward pass along the motion; with the whole gradient, regularization does not change the noise cost."""
        along, rated = self.along, self.rated
        if not (self.whole and rated is not None and rated.along is along and regularization > rated.regularization):
            rated = None
        plan = backward(
            self.problem,
            self.trajectory,
            regularization,
            exact,
            along=along if rated is None else along.with_noise_held(rated.plan.spread),
            demands=demands,
            clipped=clipped,
            rows=self.rows,
        )
        if plan is None or rated is None:
            return plan
        return plan._replace(noise=rated.plan.noise, jumps=rated.plan.jumps, spread=rated.plan.spread)

    def _compare_with_best(self, plan: Plan) -> None:
        noise = self._noise(plan)
        gain = self.best_noise - self.above - noise
        if self.best is None or gain > 0.0:
            self.gains.append(0.0 if self.best is None else gain)
            self.best, self.best_cost, self.best_noise, self.above = self.trajectory, self.cost, noise, 0.0
        elif not self.watchdog.away:
            self.gains.append(0.0)

    def _noise(self, plan: Plan) -> float:
        """Noise cost of the processes that change plans."""
        if self.all_steered:
            return plan.noise
        if not self.any_steered:
            return 0.0
        return float(noise_shares(self.problem, self.trajectory, plan, self.steered).sum())

    @property
    def along(self) -> Along:
        """Expansions for backward passes along the current motion."""
        if self._around is None or self._around.trajectory is not self.trajectory:
            self._around = Along(self.problem, self.trajectory)
        return self._around

    def _share(self, tolerance: float) -> float:
        """Tolerance on the expected decrease, in units of the cost."""
        return tolerance * (self.along.stake.moved + NOTHING * self.first)

    def _bound(self, tolerance: float) -> float:
        """A bound on :meth:`_share` that takes no time: the value of a sum of squares bounds its cost at stake."""
        return tolerance * (self.cost + NOTHING * self.first) if self.problem.cost.nonnegative else np.inf

    def _is_there(self, plan: Plan, tolerance: float) -> bool:
        least = tolerance * NOTHING * self.first
        if plan.expected_decrease > self._bound(tolerance):
            return False
        if not self.any_steered and self.along.stake.free <= least:
            # The cost is at its lower bound. Without costs on the controls the model may have no minimum even there.
            self.plan = self._least_regularized()[0] or plan
            return True
        return self._decrease_at_most(self._share(tolerance))

    def _is_slow(self, tolerance: float) -> bool:
        """Whether the last :data:`_SLOW` iterations have lowered the cost by no more than a tolerance."""
        return len(self.gains) > _SLOW and sum(self.gains[-_SLOW:]) <= self._share(tolerance)

    def _ended(self, tolerance: float, last: int, deadline: float) -> tuple[Status | None, str]:
        """The status of a search that ends without convergence and the reason; None if it continues."""
        if len(self.history) >= last:
            return self._out_of(last, deadline), ""
        if len(self.gains) > PATIENCE:
            recent = sum(self.gains[-PATIENCE:])
            if recent <= self._bound(tolerance) and recent <= self._share(tolerance):
                lowered = f"{PATIENCE} iterations have lowered the expected cost by {recent:.1e}; "
                return Status.STALLED, lowered + self._jump()
        return self._out_of(last, deadline), ""

    def _out_of(self, last: int, deadline: float) -> Status | None:
        """The status where iterations or time end the search, else None."""
        if len(self.history) >= last:
            return Status.MAX_ITERATIONS
        return Status.OUT_OF_TIME if time.perf_counter() > deadline else None

    def _decrease_at_most(self, bound: float) -> bool:
        """Whether the expected decrease is at most ``bound``, with little or no regularization.

        Regularization reduces the expected decrease, which must not pass for convergence.
        """
        if self.plan is None or not self.plan.expected_decrease <= bound:
            return False
        if self.regularization > 0.0:
            plan, least = self._least_regularized()
            if plan is None or least > _LITTLE or not plan.expected_decrease <= bound:
                return False
            self.plan = plan
        return True

    def _expected(self) -> str:
        return f"the expected decrease is {np.nan if self.plan is None else self.plan.expected_decrease:.1e}"

    def _numbers(self, tolerance: float, *, afresh: bool = False) -> str:
        """Expected decrease and tolerance in words; ``afresh`` with as little regularization as the model needs."""
        needed = ""
        if afresh and self.regularization > 0.0:
            with contextlib.suppress(*TRIAL_ERRORS):
                plan, least = self._least_regularized()
                if plan is not None:
                    self.plan = plan
                    needed = f" under a regularization of {least:.0e}, without which it has no minimum" if least else ""
        share = np.nan if self.plan is None else self._share(tolerance)
        return f"{self._expected()}{needed}; the tolerance of {tolerance:g} times the cost at stake is {share:.1e}"

    def _note(self, report: Report, started: float, passes: int, step: Step | None = None) -> None:
        if self.plan is None:
            return
        item = Iteration(
            index=len(self.history),
            cost=self.cost,
            noise_cost=self.plan.noise,
            expected_decrease=self.plan.expected_decrease,
            decrease=0.0 if step is None else step.decrease,
            step=0.0 if step is None else step.length,
            regularization=self.regularization,
            gradient=float(np.abs(self.plan.free_gradient(self.problem, self.trajectory)).max()),
            backward_passes=passes,
            rollouts=0 if step is None else step.trials,
            seconds=time.perf_counter() - started,
            second_order=self.exact,
        )
        self.history.append(item)
        logger.info("%s: %s", self.label, item)
        report(item, self.trajectory)

    def _go_back(self) -> bool:
        """Return to the motion before the last step, with more regularization; whether there is one."""
        if self.before is None or not self._stiffen():
            return False
        logger.info("%s: back to the motion before, as the last one cannot be linearized", self.label)
        (self.trajectory, self.shares, self.cost, self.above), self.before = self.before, None
        self.returned = True
        return True

    def _steps_short(self) -> bool:
        """Whether the last step is very short, or short like the one before it."""
        lengths = [item.step for item in self.history[-2:]]
        return lengths[-1] <= VERY_SHORT or (max(lengths) <= _SHORT and len(lengths) > 1)

    def _relax(self) -> None:
        self.growth = min(1.0 / _GROWTH, self.growth / _GROWTH)
        self.regularization *= self.growth
        if self.regularization < _LEAST:
            self.regularization = 0.0

    def _stiffen(self) -> bool:
        self.growth = max(_GROWTH, self.growth * _GROWTH)
        self.regularization = max(_LEAST, self.regularization * self.growth)
        return self.regularization <= _MOST

    def _lift(self) -> bool:
        """Remove the bounds on the substeps of trials if they stopped one; returns whether they did."""
        if not (self.bounded and self.cut):
            return False
        logger.info("%s: no progress with bounded substeps: trials from now on have no bound", self.label)
        self.bounded, self.regularization, self.growth = False, 0.0, 1.0
        # One line search without bounds before the search can stall again.
        self.gains = self.gains[1 - PATIENCE :]
        return True

    def _plan(self, *, exact: bool | None = None) -> int:
        """Backward passes with increasing regularization until one succeeds; returns their number.

        Where second derivatives of the dynamics make the model indefinite, they are left out.
        """
        passes = 0
        if self.regularization > 0.0 and self._saturates():
            self._take_saturation()
        self.exact = self.second_order if exact is None else exact
        while True:
            passes += 1 + self._differentiate_noise()
            self.plan = self._pass(self.regularization, exact=self.exact, demands=self.saturated, clipped=self.clipping)
            if self.plan is not None:
                self.rows = self.plan.rows
                self.planned = self.trajectory, self.regularization, self.exact
                return passes
            if self.exact:
                self.exact = False
            elif not self._stiffen():
                return passes

    def _saturates(self) -> bool:
        """Whether drives of servos are at their limits for the first time."""
        # A controller's ticks keep to first derivatives.
        watched = self.anew and not (self.saturated or self.wants_whole)
        return watched and saturates(self.problem.scene, self.trajectory)

    def _take_saturation(self) -> None:
        """From now on regularize changes of what servos demand, and use second derivatives where there are any."""
        problem = self.problem
        scene = problem.scene
        self.saturated = True
        exists = scene.custom is None and not scene.constraints and not scene.noise.velocity_dependent
        if problem.integrator.variational and exists and not self.second_order:
            self.second_order = True
            logger.info("%s: servos are at the limits of their drives: second derivatives from now on", self.label)

    def _least_regularized(self) -> tuple[Plan | None, float]:
        """The plan with the least regularization that gives the model a minimum, and that regularization."""
        for regularization in (0.0, *10.0 ** np.arange(-6, 11, 2)):
            self._differentiate_noise()
            for exact in (True, False) if self.second_order and regularization == 0.0 else (False,):
                plan = self._pass(float(regularization), exact=exact)
                if plan is not None:
                    return plan, float(regularization)
        return None, np.inf

    def _line_search(self, shortest: float = 0.0) -> Step:
        """Move to the first trial along the plan with sufficient decrease of the expected cost."""
        return self._along_plan(functools.partial(self.line_search.run, shortest=shortest))

    def _along_plan(self, search: Callable[[Start], Step]) -> Step:
        """Take the step that a line search finds along the plan."""
        if self.plan is None:
            return Step()
        step = search(
            Start(
                plan=self.plan,
                along=self.along,
                shares=self.shares,
                cost=self.cost,
                rating=0.0 if self.rated is None else self.rated.regularization,
                exact=self.exact,
                whole=self.whole,
                extends=self.anew,
                overshot=self.overshot,
                follows=self.anew and self.follows and not self.any_steered,
                bounded=self.bounded,
                behind=self._behind(),
            )
        )
        self.cut = self.cut or step.cut
        self.follows, self.overshot = self.follows and not step.strayed, step.overshot
        self.jumps = step.length < _LONG and (self.jumps or step.jumps)
        taken = step.taken
        if taken.motion is not None and taken.shares is not None:
            self.before = self.trajectory, self.shares, self.cost, self.above
            self.trajectory, self.shares = taken.motion.trajectory(), taken.shares
            if taken.rated is not None:
                self.trajectory = taken.rated.along.trajectory
                # Another motion may need no regularization, whatever this one was rated with.
                self._around, self.rated = taken.rated.along, None if taken.rated.regularization else taken.rated
            self.cost = float(taken.shares.sum())
            self.above += taken.cost
            self.behind = (self.before[0], self.trajectory) if step.length == 1.0 else None
        return step

    def _behind(self) -> Trajectory | None:
        """The motion from which a full step led to the current one, if one did."""
        return self.behind[0] if self.behind is not None and self.behind[1] is self.trajectory else None

    def _meets_limits(self, plan: Plan, motion: Trajectory) -> bool:
        """Whether a plan holds controls at their limits, and no control is there on the motion it is around."""
        return self.anew and self.clips and plan.holds and self._at_limits(motion) == 0.0

    def _at_limits(self, motion: Trajectory) -> float:
        """Share of a motion's controls that are at a limit."""
        lower, upper = self.problem.control_limits
        u = self.problem.decided(motion)
        return float(((u <= lower) | (u >= upper)).mean())

    def _clipped_instead(self, step: Step) -> tuple[Step, int]:
        """The better of a short step and one along the plan without limits, whose trials clip the controls.

        A control that a plan holds at a limit has no feedback, also on trials so short that it is far from there.
        """
        after = self.plan, self.planned, self.trajectory, self.shares, self.cost, self.above, self.before, self.jumps
        behind = self.behind
        if step.length > 0.0 and self.before is not None:
            self.trajectory, self.shares, self.cost, self.above = self.before
        self.clipping = True
        passes, self.planned = self._plan(), None
        other, self.clipping = self._line_search(_SHORT), False
        trials = step.trials + other.trials
        if other.decrease > _MUCH_MORE * step.decrease and self._at_limits(self.trajectory) <= _FEW:
            return other._replace(trials=trials), passes
        self.clips = False
        self.plan, self.planned, self.trajectory, self.shares, self.cost, self.above, self.before, self.jumps = after
        self.behind = behind
        return step._replace(trials=trials), passes

    def _jump(self) -> str:
        """What makes the motion jump, if it does."""
        if not self.jumps:
            return ""
        return (
            "motions close by divide other steps into parts, and differ by a jump that no derivative shows: a smaller "
            "dt, or a Radau integrator where dampers are fast, avoids that; "
        )

    def _last_plan(self) -> Plan | None:
        if self.plan is not None and self.planned == (self.trajectory, 0.0, self.second_order):
            return self.plan
        try:
            return self._least_regularized()[0]
        except TRIAL_ERRORS:
            return None

    def solution(self, status: Status) -> Solution:
        """The best motion, however the search ended."""
        problem, plan = self.problem, self.plan
        if plan is not None and self.followed > 0.0:
            plan = plan.followed(self.followed)
        elif status is not Status.CONVERGED:
            # With noise the fixed point of the search is not the minimum of the expected cost, so the last motion is
            # not always the best. The last plan may be of another motion, or have regularization.
            plan = self._last_plan()
            above = np.inf if plan is None else self.above + self._noise(plan) - self.best_noise
            if self.best is not None and self.best is not self.trajectory and not above <= 0.0:
                self.trajectory, self.cost = self.best, self.best_cost
                plan = self._last_plan()
        reason = self.reason
        if plan is not None and plan.loss > _LOSSY:
            lost = f"rounding may have changed Quu by {plan.loss:.0e} of itself: weights or inertias are too far apart"
            logger.warning("%s: the gains cannot be trusted: %s", self.label, lost)
            reason = f"{reason}; {lost}"
        R, m, n = problem.decisions, problem.scene.controls, problem.scene.robot.dof
        return Solution(
            problem=problem,
            trajectory=self.trajectory,
            gains=np.zeros((R, m, 2 * n)) if plan is None else plan.feedback,
            previous_gains=_previous_gains(problem, plan),
            feedforward=np.zeros((R, m)) if plan is None else plan.feedforward,
            gradient=np.full((R, m), np.nan) if plan is None else plan.gradient,
            cost=self.cost,
            noise_cost=(np.nan if problem.scene.processes else 0.0) if plan is None else plan.noise,
            status=status,
            reason=reason,
            history=tuple(self.history),
            search=self.state,
        )


def _after(failed: Step, step: Step) -> Step:
    """A step with the trials of the line search before, which found none."""
    if failed.trials == 0:
        return step
    return step._replace(trials=failed.trials + step.trials, hidden=max(failed.hidden, step.hidden))


def _previous_gains(problem: OptimalControlProblem, plan: Plan | None) -> Floats | None:
    if problem.rate is None and not problem.linear:
        return None
    m = problem.scene.controls
    return np.zeros((problem.decisions, m, m)) if plan is None else plan.previous
