"""Stochastic differential dynamic programming on the structured linearization of any integrator.

The iterations, their regularization and the stopping criteria. The backward pass is in :mod:`varpin.control.backward`,
the line search in :mod:`varpin.control.line_search`; :mod:`varpin.control.augmented` adds hard constraints.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats, Mask
from varpin.control.along import Along
from varpin.control.backward import backward
from varpin.control.commands import controls_along, first_commands, shifted_commands
from varpin.control.costs import CostError
from varpin.control.examination import foreseen, looked_at
from varpin.control.history import ITERATIONS, Iteration, SearchState, Status
from varpin.control.line_search import TRIAL_ERRORS, VERY_SHORT, LineSearch, Rated, Start, Step
from varpin.control.multiple_shooting import GapClosing, Path, path_of
from varpin.control.noise_adjoint import is_exact
from varpin.control.passes import Plan, noise_shares
from varpin.control.problem import OptimalControlProblem
from varpin.control.refinement import COMPARISON, SLOW, SUFFICIENT, refine
from varpin.control.solution import Solution
from varpin.control.spread import Feedback
from varpin.control.trials import Trials
from varpin.control.watchdog import Watchdog
from varpin.core.arrays import Commands
from varpin.errors import InputError, LinearizationError
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.policy import LinearPolicy
from varpin.simulation.failures import StepFailure, named
from varpin.simulation.kinks import saturates
from varpin.simulation.record import located
from varpin.simulation.soundness import announce
from varpin.support.checks import (
    JointValues,
    count,
    flag,
    fraction,
    is_one_of,
    positive,
    real,
    takes,
    told_motion,
)
from varpin.trajectory import Trajectory

Callback = Callable[[Iteration], None] | Callable[[Iteration, Trajectory], None]
Report = Callable[[Iteration, Trajectory], None]
Progress = Callable[[int, int], None]

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
UNKNOWN = -1.0


def solve(
    problem: OptimalControlProblem,
    controls: JointValues | LinearPolicy | Solution | None = None,
    *,
    tolerance: float = 1e-7,
    max_iterations: int = ITERATIONS,
    second_order: bool = False,
    forward: Literal["closed", "open"] = "closed",
    armijo: float = ARMIJO,
    backtracking: float = BACKTRACKING,
    regularization: float = 0.0,
    time_limit: float = np.inf,
    callback: Callback | None = None,
    resume: Solution | None = None,
    progress: Progress | None = None,
    check: bool = True,
    true_cost: float | None = None,
    noise: Literal["held", "whole"] | None = None,
    states: ArrayLike | tuple[ArrayLike, ArrayLike] | Trajectory | None = None,
) -> Solution:
    """Solve an optimal control problem by S-DDP (Algorithm 2 of the paper).

    Each iteration linearizes along the motion, runs a backward pass through the quadratic model of the cost to go,
    noise terms included, and searches along the new controls for a motion of lower expected cost. The expected cost is
    the cost of the motion plus what noise adds to it under the model.

        robot = vp.load_robot("ur5")
        cost = vp.ControlCost(1e-3) + vp.Terminal(vp.TrackingCost([0.5, -1, 1, 0, 0.5, 0], 1e3) + vp.VelocityCost(10))
        problem = vp.OptimalControlProblem(vp.Scene(robot), cost, q0=np.zeros(6), v0=np.zeros(6), dt=0.01, steps=100)
        plan = vp.solve(problem, callback=print)  # a line for each iteration
        print(plan.table())
        print(plan.verify())

    Ctrl-C ends the search once the first motion has been integrated, and returns the best motion so far with ``status``
    INTERRUPTED. ``solve(problem, plan)`` continues from there.

    Where controls have limits, each decision minimizes the model within them at the state that the linearized motion
    will have then, and a control at a limit has no feedback (after Tassa, Mansard and Todorov, "Control-limited
    differential dynamic programming", 2014). Limits that no motion of the search meets do not change it; those
    that bind on the way may take more iterations, though the plan keeps clear of them. The noise cost is that of the
    linear feedback: the model does not include controls that noise drives into their limits. ``monte_carlo`` does.

    Main args:
        problem: What to minimize.
        controls: Initial controls: None to hold the robot at q0; an array (R, m) or (m,), R the number of
            decisions; by joint name; a :class:`LinearPolicy`; or a :class:`Solution`, whose policy then runs on this
            problem. Controls outside the problem's limits are clipped.
        tolerance: Stop when the expected decrease is below this fraction of the cost at stake, (O9): the decrease of
            the cost's own quadratic models along the motion if each state and control were free, and at most their
            change over the motion's displacement. For squared distances it is about their value. Constants in the cost
            and the noise cost do not count.
        max_iterations: Greatest number of iterations, over all rounds for a problem with constraints.

    Other Args:
        second_order: Full differential dynamic programming: second derivatives of the dynamics too, wherever the
            model stays convex. Converges quadratically; needs an integrator that has them (:class:`Midpoint`). The
            search switches to them by itself where steps get short while drives of servos are at their limits.
        forward: ``"closed"``: the feedback gains act in the line search. ``"open"``: only the feed-forward part, as in
            the paper; it diverges where the open loop is unstable over the horizon.
        armijo: Least share of the expected decrease that a step must reach (the paper's alpha).
        backtracking: Factor between the trials of the line search (the paper's beta), in (0, 1). Where the parabola
            through a trial's cost and the slope has its minimum far below the next length, that length is left out.
        regularization: Initial value, relative to the diagonal of Quu; it increases and decreases as needed.
        time_limit: No iteration begins after this time since the call [s]. The result then depends on the machine.
        callback: Called with each :class:`Iteration`; ``callback=print`` prints the rows of :meth:`Solution.table`. The
            log has them at level INFO, preceded by the robot and the horizon. A function of two arguments, such as a
            :class:`varpin.LiveView`, is also given the motion after the iteration, a :class:`varpin.Trajectory`.
        progress: Called after each iteration with (iterations done, max_iterations); few searches need them all.
        resume: A solution of the same problem, as solve returned it or as read from a file: the search continues where
            it stopped, for at most ``max_iterations`` more, as if it had not been interrupted. Give the other options
            as before; ``regularization`` is taken from the solution.
        check: Check the finished plan: whether its cost in finer steps agrees, and whether its velocities alternate or
            oscillate. ``Solution.warnings`` and the log have the result. It takes as long as a few motions of the
            search.
        true_cost: Greatest difference between the plan's cost and its cost with feedback on the continuous system,
            relative to the former: 0.01 for a percent; and greatest excess of the latter over the optimum of finer
            controls, as estimated from a few iterations with half the step, or with constraints from the plan of half
            the step. Constraints must then hold on the continuous system to a thousandth of their range. The problem's
            step is the coarsest; it is halved, each search starting from the plan before, until all that is so.
            ``Solution.problem`` has the plan's step. ``Solution.refinement`` lists the steps tried, or why the accuracy
            cannot be reached; a warning reports that, too. Controls that are held over several steps keep their period,
            and their optimum is that of the period. ``max_iterations`` is for each step, ``time_limit`` for all;
            ``tolerance`` is at least a hundredth of ``true_cost``. Without constraints a search whose progress is
            slow leaves the rest to half the step, where that lowers the cost by more than ``true_cost``. Ctrl-C keeps
            the best plan so far. Where dampers are far faster than the step, ``controls="linear"`` in the problem
            reaches the accuracy at much larger steps.
        noise: Gradient of the noise cost, where the noise's strength depends on the state or the control. ``"whole"``:
            once the search is close to its end, it takes the whole gradient of the expected cost, and ends at a minimum
            of it, a local one of the model. ``"held"``: as in the paper, with the Hessian of the value function held;
            it neglects the derivatives of that Hessian, and ends next to the minimum. By default it is the whole one
            where steps have second derivatives: with a variational integrator, constant controls and a kick that is
            left or held, without custom forces, custom noise, kinematic inputs and constraints of the scene, and
            without servos with an effort limit if the kick is held. It then takes two to four times as long as the
            search with it held, more where that ends far from the minimum; elsewhere, by differences, ``"whole"`` takes
            10 to 50 times as long. With ``second_order`` and within control limits it is held. Problems with
            constraints are solved for the least cost without noise, which then affects only their feedback and margins.
        states: Initial states, which need not be feasible: configurations at the nodes (N + 1, n), the first one q0; a
            pair (q, v) of such arrays; or a :class:`varpin.Trajectory`. A straight line or the path of another planner
            will do: auxiliary joint forces hold the first motion on it, and the first iterations remove them (multiple
            shooting). ``controls`` are then those along the states, by default the inverse dynamics' clipped to their
            limits. Single shooting continues from there. Linear controls are held ones until then. There must be no
            :class:`KinematicInput`. A search that ends with auxiliary forces left drops them: resumed, it continues
            from the controls alone, not as if it had not been interrupted.

    Returns:
        The best motion found, however the search ended. ``status`` and ``reason`` tell how it ended; ``warnings`` lists
        what keeps a robot from following the plan.

    Raises:
        InputError: Controls of a wrong shape, or options out of their range.
        NoiseFieldError: A custom noise field fails on the first motion.
        ForceError: A :class:`varpin.CustomForce` fails on the first motion; a later failure rejects a trial.
        StepFailure: The first motion cannot be integrated; the error holds the motion up to there.
        CostError: The cost of the first motion is not finite, or a custom cost fails there.
    """
    if not isinstance(problem, OptimalControlProblem):
        raise InputError(f"problem must be an OptimalControlProblem, got {type(problem).__name__}")
    if not is_one_of(forward, ("closed", "open")):
        raise InputError(f"forward must be 'closed' or 'open', got {forward!r}")
    if not 0.0 < real("backtracking", backtracking) < 1.0:
        raise InputError(f"backtracking must be in (0, 1), got {backtracking}")
    if not real("regularization", regularization) >= 0.0:
        raise InputError(f"regularization must be >= 0, got {regularization}")
    if noise is not None and not is_one_of(noise, ("held", "whole")):
        raise InputError(f"noise must be 'held', 'whole' or None, got {noise!r}")
    whole_noise = noise == "whole" or (noise is None and is_exact(problem))
    second_order, check = flag("second_order", second_order), flag("check", check)
    report_all = require_reports(callback, progress)
    positive("tolerance", tolerance, "1")
    deadline = time.perf_counter() + checked_time(time_limit)
    fraction("armijo", armijo)
    max_iterations = count("max_iterations", max_iterations)
    if states is not None and resume is not None:
        raise InputError("resume goes on from the solution's own states: leave out either states or resume")
    path = None if states is None else path_of(problem, states)
    # Before the search, which may take long where values are in wrong units.
    before = foreseen(problem) if check else []
    announce(logger, problem.scene, problem.dt, before)

    def searched(
        problem: OptimalControlProblem,
        controls: JointValues | LinearPolicy | Solution | None,
        resume: Solution | None,
        *,
        path: Path | None = None,
        tolerance: float = tolerance,
        most: int = max_iterations,
        slow: float | None = None,
    ) -> Solution:
        """One search, of at most ``most`` iterations after those of ``resume``."""
        search = _Search(problem, second_order, forward, armijo, backtracking, regularization, whole_noise=whole_noise)
        if resume is not None:
            search.resume(_search_of(problem, controls, resume))
        elif path is None:
            search.begin(first_commands(problem, controls))
            if isinstance(controls, Solution) and controls.search is not None:
                search.rows = controls.search.rows
        closing = None if path is None else closing_of(problem, path, controls)
        known = len(search.history)

        def report(item: Iteration, motion: Trajectory) -> None:
            report_all(item, motion)
            if progress is not None:
                # A converged search reports once more after its last iteration.
                progress(min(item.index + 1 - known, max_iterations), max_iterations)

        try:
            if closing is not None:
                search.close(closing, most, deadline, report)
            left = most - (len(search.history) - known)
            status = search.run(tolerance, left, deadline, report, slow=slow)
        except KeyboardInterrupt:
            status, search.reason = Status.INTERRUPTED, f"in iteration {len(search.history)}"
        return search.solution(status)

    if true_cost is not None:
        if resume is not None:
            raise InputError("true_cost begins with a search of its own: leave out either resume or true_cost")

        wish = positive("true_cost", true_cost, "1")
        sufficient = max(tolerance, SUFFICIENT * wish)

        def once(
            finer: OptimalControlProblem,
            start: LinearPolicy | Solution | None,
            most: int = max_iterations,
            slow: float | None = None,
        ) -> Solution:
            own = start if isinstance(start, Solution) else None
            given = controls if start is None else None if own is not None else start
            done = 0 if own is None or own.search is None else len(own.search.history)
            return searched(
                finer,
                given,
                own,
                path=path if start is None else None,
                tolerance=sufficient,
                most=max(most - done, 0),
                slow=slow,
            )

        hasty = functools.partial(once, slow=SLOW * wish)
        compare = functools.partial(once, most=min(COMPARISON, max_iterations))
        refined = refine(problem, hasty, wish, lambda: deadline - time.perf_counter(), compare, once)
        return looked_at(refined)[0] if check else refined

    solution = searched(problem, controls, resume, path=path)
    return looked_at(solution, before)[0] if check else solution


def closing_of(problem: OptimalControlProblem, states: object, controls: object) -> GapClosing:
    """The start of a search on given states, as :func:`solve` takes them, with its first motion."""
    path = states if isinstance(states, Path) else path_of(problem, states)
    return GapClosing(problem, path, controls_along(problem, controls))


def require_reports(callback: Any, progress: object) -> Report:
    """The callback as a function of an iteration and its motion, whether or not it takes the motion.

    Raises:
        InputError: The callback or ``progress`` has the wrong number of arguments.
    """
    both = told_motion("callback", callback, "iteration", "motion")
    if progress is not None and not (callable(progress) and takes(progress, 2)):
        raise InputError(f"progress must be a function of (iterations done, max_iterations), got {progress!r}")

    def report_all(item: Iteration, motion: Trajectory) -> None:
        if both:
            callback(item, motion)
        elif callback is not None:
            callback(item)

    return report_all


def checked_time(limit: object) -> float:
    """A time limit [s] as a float > 0, infinite for none."""
    return np.inf if isinstance(limit, float) and limit == np.inf else positive("time_limit", limit, "s")


def replan(
    problem: OptimalControlProblem,
    previous: Solution,
    decisions: int,
    *,
    tolerance: float,
    max_iterations: int,
    deadline: float,
    rows: Mask | None = None,
) -> tuple[Solution, Mask | None]:
    """Replan from the plan made ``decisions`` ago, with one backward pass per iteration: a controller's tick.

    Where iterations or time end the search, the gains are those of its last step, without a further backward pass at
    the final motion. The finished plan is not checked. No iteration begins that would end after ``deadline`` (of
    ``time.perf_counter``) if it took as long as the longest before. The backward pass begins with active ``rows`` of
    penalties; those of the last pass are returned beside the plan. Other arguments and errors are as in :func:`solve`.
    """
    search = _Search(problem, second_order=False, anew=False)
    search.rows = rows
    search.begin(shifted_commands(problem, previous, decisions))
    try:
        status = search.run(tolerance, max_iterations, deadline, lambda *_: None)
    except KeyboardInterrupt:
        status, search.reason = Status.INTERRUPTED, f"in iteration {len(search.history)}"
    return search.solution(status), search.rows


def _search_of(problem: OptimalControlProblem, controls: object, resume: Solution) -> SearchState:
    if not isinstance(resume, Solution):
        raise InputError(f"resume must be a Solution, got {type(resume).__name__}")
    if controls is not None:
        raise InputError("resume goes on from the solution's own controls: leave out either controls or resume")
    if resume.search is None:
        raise InputError("resume: the solution does not hold the state of its search; give it as controls")
    difference = problem.differs(resume.problem)
    if difference:
        raise InputError(f"resume: the solution is of another problem: {difference}; give it as controls")
    found, known = problem.cost_of(resume.search.trajectory), resume.search.cost
    if not abs(found - known) <= 1e-9 * max(abs(found), abs(known)):
        raise InputError(f"resume: the solution is of another cost: {known:.9g}, and here {found:.9g}")
    return resume.search


class _Search:
    """The state of a search: the current motion, its plan and the history."""

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
            self.first = UNKNOWN
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
        self.returned = state.returned
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
            returned=self.returned,
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
            if not self.history or self.first == UNKNOWN:
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
        meets = self.plan is not None and self._meets_limits(self.plan)
        step, passes = self._departure()
        if step.length == 0.0:
            step = _after(step, self._line_search())
        if step.length == 0.0 and self.exact:
            passes += self._plan(exact=False)
            step = _after(step, self._line_search())
        if step.length <= _SHORT and meets:
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
        if not self.anew or self.any_steered or not dog.departs([item.step for item in self.history]):
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
        return replace(plan, noise=rated.plan.noise, jumps=rated.plan.jumps, spread=rated.plan.spread)

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
                trajectory=self.trajectory,
                shares=self.shares,
                cost=self.cost,
                rating=0.0 if self.rated is None else self.rated.regularization,
                exact=self.exact,
                whole=self.whole,
                extends=self._extends(),
                bounded=self.bounded,
            )
        )
        self.cut = self.cut or step.cut
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
        return step

    def _extends(self) -> bool:
        """Whether full steps that end early are extended: not after a last extension that did not lower the cost."""
        last = self.history[-1:]
        return self.anew and not any(item.step == 1.0 and item.rollouts == 2 for item in last)

    def _meets_limits(self, plan: Plan) -> bool:
        """Whether a plan holds controls at their limits, and no control is there on the motion it is around."""
        return self.anew and self.clips and not plan.feedback.any(axis=2).all() and self._at_limits() == 0.0

    def _at_limits(self) -> float:
        """Share of the motion's controls that are at a limit."""
        lower, upper = self.problem.control_limits
        u = self.problem.decided(self.trajectory)
        return float(((u <= lower) | (u >= upper)).mean())

    def _clipped_instead(self, step: Step) -> tuple[Step, int]:
        """The better of a short step and one along the plan without limits, whose trials clip the controls.

        A control that a plan holds at a limit has no feedback, also on trials so short that it is far from there.
        """
        after = self.plan, self.planned, self.trajectory, self.shares, self.cost, self.above, self.before, self.jumps
        if step.length > 0.0 and self.before is not None:
            self.trajectory, self.shares, self.cost, self.above = self.before
        self.clipping = True
        passes, self.planned = self._plan(), None
        other, self.clipping = self._line_search(_SHORT), False
        trials = step.trials + other.trials
        if other.decrease > _MUCH_MORE * step.decrease and self._at_limits() <= _FEW:
            return other._replace(trials=trials), passes
        self.clips = False
        self.plan, self.planned, self.trajectory, self.shares, self.cost, self.above, self.before, self.jumps = after
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
    return step._replace(trials=failed.trials + step.trials, hidden=max(failed.hidden, step.hidden))


def _previous_gains(problem: OptimalControlProblem, plan: Plan | None) -> Floats | None:
    if problem.rate is None and not problem.linear:
        return None
    m = problem.scene.controls
    return np.zeros((problem.decisions, m, m)) if plan is None else plan.previous
