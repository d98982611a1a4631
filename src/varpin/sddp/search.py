"""Stochastic differential dynamic programming on the structured linearization of any integrator."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.checks import as_floats, count, finite_array, fraction, is_one_of, positive, real
from varpin.costs import CostError
from varpin.errors import InputError, LinearizationError
from varpin.integrators.base import open_loop
from varpin.kernels._compile import announced_compilation
from varpin.kernels.tree import Commands
from varpin.noise import NoiseFieldError
from varpin.policy import LinearPolicy
from varpin.sddp.backward import Plan, backward, noise_cost
from varpin.sddp.examination import looked_at
from varpin.sddp.history import Iteration, SearchState, Status
from varpin.sddp.problem import OptimalControlProblem
from varpin.sddp.solution import Solution
from varpin.simulation import Motions, StepFailure
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]
Callback = Callable[[Iteration], None]
Progress = Callable[[int, int], None]

logger = logging.getLogger(__name__)

# The schedule of the regularization (Tassa, Erez and Todorov 2012), relative to the diagonal of Quu: it shrinks after
# long steps and grows after short ones.
_GROWTH, _LEAST, _MOST = 2.0, 1e-6, 1e10
_LONG, _SHORT = 0.5, 0.01
# What a cost, a noise field or a step may raise somewhere off the motion that has been found.
_LOST = (CostError, NoiseFieldError, LinearizationError)
# As much as this does not hide how far an optimum is; controls that do nothing need some.
_LITTLE = 1e-4
# Of Quu, what rounding may change without a word.
_LOSSY = 1e-8
# Iterations without a decrease worth the name before a search gives up: the cost jumps where guards cut steps.
_PATIENCE = 15
# Part of a motion's own cost that the tolerance on the expected cost may hide with nothing said.
_HIDDEN = 1e-3
# Trials of a line search: 0.25^10 is 1e-6.
_TRIALS = 10


def solve(
    problem: OptimalControlProblem,
    controls: ArrayLike | LinearPolicy | Solution | None = None,
    *,
    tolerance: float = 1e-7,
    max_iterations: int = 100,
    second_order: bool = False,
    forward: Literal["closed", "open"] = "closed",
    armijo: float = 1e-5,
    backtracking: float = 0.25,
    regularization: float = 0.0,
    time_limit: float = np.inf,
    callback: Callback | None = None,
    resume: Solution | None = None,
    progress: Progress | None = None,
    check: bool = True,
) -> Solution:
    """Solve an optimal control problem by S-DDP (Algorithm 2 of the paper).

    Each iteration takes the derivatives along the motion, goes back through the quadratic model of the cost to go,
    noise terms included, and searches along the new controls for a motion of lower expected cost: the cost of the
    motion itself, and what noise adds to it under the model.

        robot = vp.load_robot("ur5")
        cost = vp.ControlCost(1e-3) + vp.Terminal(vp.TrackingCost([0.5, -1, 1, 0, 0.5, 0], 1e3) + vp.VelocityCost(10))
        problem = vp.OptimalControlProblem(vp.Scene(robot), cost, q0=np.zeros(6), v0=np.zeros(6), dt=0.01, steps=100)
        plan = vp.solve(problem, callback=print)  # a line for each iteration
        print(plan.table())
        print(plan.verify())

    Ctrl-C ends the search and returns the best motion so far, with ``status`` INTERRUPTED, as long as there is one: the
    first motion has been integrated. ``solve(problem, plan)`` goes on from there.

    Where controls have limits, each decision minimizes the model within them, and a control at a limit has no feedback
    (Tassa, Mansard and Todorov, "Control-limited differential dynamic programming", 2014). What noise adds is then that
    of the linear feedback: that noise may drive a control into its limit is not in the model. ``monte_carlo`` has it.

    Main args:
        problem: What to minimize.
        controls: To start from: None to hold the robot at q0; an array (R, m) or (m,), R the number of
            decisions; a :class:`LinearPolicy`; or a :class:`Solution`, whose policy then runs on this problem. What
            leaves the problem's limits is brought within them.
        tolerance: Stop when the decrease that the quadratic model promises is below this part of the cost.
        max_iterations: At most.

    Other Args:
        second_order: Full differential dynamic programming: second derivatives of the dynamics too, wherever they
            leave the model convex. Converges quadratically; needs an integrator that has them (:class:`Midpoint`).
        forward: ``"closed"``: the feedback gains act in the line search. ``"open"``: only the feed-forward part, as in
            the paper; it diverges where the open loop is unstable over the horizon.
        armijo: The part of the promised slope that a step must keep (the paper's alpha).
        backtracking: Factor between the trials of the line search (the paper's beta), in (0, 1).
        regularization: To begin with, relative to the diagonal of Quu; it grows where needed, and shrinks again.
        time_limit: No iteration begins when this time has passed since the call [s]. What is found then depends on the
            machine.
        callback: Called with each :class:`Iteration`; ``callback=print`` prints the rows of :meth:`Solution.table` as
            they come. The log has them too, at level INFO.
        progress: Called after each iteration with (iterations done, max_iterations); few searches need them all.
        resume: A solution of this very problem, as solve returned it or as read from a file: the search goes on where
            it stopped, for at most ``max_iterations`` more, as if it had not been interrupted. Give the other options
            as before; ``regularization`` goes on by itself.
        check: Look at the finished plan, whether it costs in finer steps what it promises and its velocities do not
            alternate, for ``Solution.warnings`` and the log. It takes as long as some motions of the search.

    Returns:
        The best motion found, whatever happened; ``status`` says how it ended, ``reason`` with which numbers, and
        ``warnings`` what keeps a robot from following it.

    Raises:
        InputError: Controls of a wrong shape, or options out of their range.
        NoiseFieldError: A noise field of one's own fails on the first motion.
        StepFailure: The first motion cannot be integrated; holds what came before.
        CostError: The cost of the first motion is not finite, or a cost of one's own fails there.
    """
    if not isinstance(problem, OptimalControlProblem):
        raise InputError(f"problem must be an OptimalControlProblem, got {type(problem).__name__}")
    if not is_one_of(forward, ("closed", "open")):
        raise InputError(f"forward must be 'closed' or 'open', got {forward!r}")
    if not 0.0 < real("backtracking", backtracking) < 1.0:
        raise InputError(f"backtracking must be in (0, 1), got {backtracking}")
    if not real("regularization", regularization) >= 0.0:
        raise InputError(f"regularization must be >= 0, got {regularization}")
    if callback is not None and not callable(callback):
        raise InputError(f"callback must be a function of one Iteration, got {callback!r}")
    if progress is not None and not callable(progress):
        raise InputError(f"progress must be a function of (iterations done, max_iterations), got {progress!r}")
    positive("tolerance", tolerance, "1")
    deadline = time.perf_counter() + (np.inf if time_limit == np.inf else positive("time_limit", time_limit, "s"))
    fraction("armijo", armijo)
    max_iterations = count("max_iterations", max_iterations)

    def report(item: Iteration) -> None:
        if callback is not None:
            callback(item)
        if progress is not None:
            # Convergence may take a last look after the last iteration.
            progress(min(item.index + 1 - known, max_iterations), max_iterations)

    with announced_compilation(f"solve with {type(problem.integrator).__name__}"):
        search = _Search(problem, second_order, forward, armijo, backtracking, regularization)
        if resume is None:
            search.begin(_first_commands(problem, controls))
        else:
            search.resume(_search_of(problem, controls, resume))
        known = len(search.history)
        try:
            status = search.run(tolerance, max_iterations, deadline, report)
        except KeyboardInterrupt:
            status, search.reason = Status.INTERRUPTED, f"in iteration {len(search.history)}"
    solution = search.solution(status)
    if status.converged and tolerance * solution.noise_cost > _HIDDEN * abs(solution.cost):
        logger.warning(
            "noise adds %.3g to a cost of %.3g: the tolerance is on their sum, and hides what the controls do to the "
            "motion's own cost; a smaller tolerance searches on",
            solution.noise_cost,
            solution.cost,
        )
    return looked_at(solution) if check else solution


def _first_commands(problem: OptimalControlProblem, controls: ArrayLike | LinearPolicy | Solution | None) -> Commands:
    R, m = problem.decisions, problem.scene.controls
    variational = problem.integrator.variational
    if isinstance(controls, Solution):
        controls = controls.policy_on("momentum" if variational else "velocity")
    if controls is None:
        controls = problem.holding_policy()
    if isinstance(controls, LinearPolicy):
        if controls.hold != problem.hold:
            raise InputError(f"the policy holds its controls over {controls.hold} steps, the problem {problem.hold}")
        commands = controls.commands(problem.steps, m, problem.scene.robot.dof, variational)
        narrowed = np.clip(commands.limits, *problem.control_limits)
        narrowed.setflags(write=False)
        if problem.rate is not None and problem.rate.before is not None:
            commands = commands._replace(before=problem.rate.before[None].copy())
        return commands._replace(limits=narrowed)
    rows = as_floats("controls", controls)
    rows = finite_array("controls", rows, (m,) if rows.ndim == 1 else (R, m))
    return _held(np.broadcast_to(rows, (R, m)), problem)


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


def _held(u: Floats, problem: OptimalControlProblem) -> Commands:
    return open_loop(u)._replace(hold=problem.hold, limits=problem.control_limits.copy())


def _onto_limits(u: Floats, limits: Floats) -> Floats:
    """Controls (R, m) that rounding keeps from a limit brought to it, so that they are known to be there."""
    room = 8.0 * np.finfo(float).eps * np.where(np.isfinite(limits), np.abs(limits), 0.0).max(axis=0)
    for limit in limits:
        u = np.where(np.abs(u - limit) <= room, limit, u)
    return u


class _Search:
    """The motion so far, and what is known around it."""

    def __init__(
        self,
        problem: OptimalControlProblem,
        second_order: bool,
        forward: str,
        armijo: float,
        backtracking: float,
        regularization: float,
    ) -> None:
        self.problem, self.second_order, self.forward = problem, second_order, forward
        self.armijo, self.backtracking, self.regularization = armijo, backtracking, regularization
        self.growth = 1.0
        self.exact = second_order
        self.history: list[Iteration] = []
        self.plan: Plan | None = None
        self.planned: tuple[Trajectory, float, bool] | None = None  # what it is a plan for, and how it was made
        self.motions = Motions(problem.scene, problem.integrator, problem.q0, problem.v0, problem.dt)
        self.trajectory: Trajectory
        self.cost = self.first = np.inf
        self.reached = np.inf  # the expected cost of the last step taken, by the plan it was taken with
        self.state: SearchState | None = None  # at the start of the last iteration, from where it can go on
        self.merits: list[float] = []  # the best so far, after each iteration
        self.best: tuple[float, float, Trajectory | None] = (np.inf, np.inf, None)
        self.reason = ""

    def begin(self, commands: Commands) -> None:
        trajectory, failure = self.motions.under(commands)
        if failure is not None:
            raise StepFailure(trajectory.steps, trajectory.t[-1], failure, trajectory)
        self.trajectory = trajectory
        self.cost = self.problem.cost_of(trajectory)
        if not np.isfinite(self.cost):
            raise CostError(repr(self.problem.cost), f"the cost of the first motion is {self.cost}")
        self.first = self.cost

    def resume(self, state: SearchState) -> None:
        """Stand where ``state`` was taken."""
        self.trajectory, self.cost, self.first = state.trajectory, state.cost, state.first
        self.merits, self.history = list(state.merits), list(state.history)
        self.best = state.best_merit, state.best_cost, state.best
        self.regularization, self.growth = state.regularization, state.growth

    def _state(self) -> SearchState:
        merit, cost, best = self.best
        return SearchState(
            trajectory=self.trajectory,
            cost=self.cost,
            first=self.first,
            best=best,
            best_merit=merit,
            best_cost=cost,
            merits=tuple(self.merits),
            regularization=self.regularization,
            growth=self.growth,
            history=tuple(self.history),
        )

    def run(self, tolerance: float, max_iterations: int, deadline: float, report: Callback) -> Status:
        last = len(self.history) + max_iterations
        while True:
            self.state = self._state()
            started = time.perf_counter()
            try:
                passes = self._plan()
            except _LOST as error:
                if not self.history:
                    raise
                logger.warning("%s", error)
                self.reason = str(error)
                return Status.NOT_DIFFERENTIABLE
            if self.plan is None:
                self.reason = f"the regularization has reached {self.regularization:.1e} of the diagonal of Quu"
                return Status.INDEFINITE
            merit = self.cost + self.plan.noise
            if merit < self.best[0]:
                self.best = merit, self.cost, self.trajectory
            self.merits.append(self.best[0])
            # Where the optimum costs nothing, there is nothing to be relative to but where it began.
            scale = abs(merit) + 1e-9 * abs(self.first)
            # Without costs on the controls the model may need regularization to have a minimum even there.
            nothing = self.problem.cost.nonnegative and merit <= tolerance * scale
            converged = nothing or self.plan.promise <= tolerance * scale
            if converged and self.regularization > 0.0:
                # Regularization makes promises smaller; it must not pass for an optimum.
                plan, least = self._least_regularized()
                if plan is not None and (nothing or (least <= _LITTLE and plan.promise <= tolerance * scale)):
                    self.plan = plan
                else:
                    converged = False
            promised = f"the model promises a decrease of {self.plan.promise:.1e}"
            share = f"the tolerance of {tolerance:g} times the cost is {tolerance * scale:.1e}"
            if converged or len(self.history) >= last:
                self._note(report, started, passes)
                self.reason = f"{promised}; {share}"
                return Status.CONVERGED if converged else Status.MAX_ITERATIONS
            if len(self.merits) > _PATIENCE and self.merits[-1 - _PATIENCE] - self.merits[-1] <= tolerance * scale:
                self._note(report, started, passes)
                self.reason = f"{_PATIENCE} iterations brought less than the tolerance; {promised}; {share}"
                return Status.STALLED
            if time.perf_counter() > deadline:
                self._note(report, started, passes)
                self.reason = f"{promised}; {share}"
                return Status.OUT_OF_TIME
            step, trials = self._line_search(merit)
            if step == 0.0 and self.exact:
                passes += self._plan(exact=False)
                more = self._line_search(merit)
                step, trials = more[0], trials + more[1]
            self._note(report, started, passes, trials, step, merit - self.reached if step > 0.0 else 0.0)
            if step >= _LONG:
                self._relax()
            elif step <= _SHORT and not self._stiffen():
                self.reason = f"no step lowers the cost, whatever the regularization; {promised}; {share}"
                return Status.STALLED

    def _note(
        self, report: Callback, started: float, passes: int, trials: int = 0, step: float = 0.0, decrease: float = 0.0
    ) -> None:
        if self.plan is None:
            return
        item = Iteration(
            index=len(self.history),
            cost=self.cost,
            noise_cost=self.plan.noise,
            promised_decrease=self.plan.promise,
            decrease=decrease,
            step=step,
            regularization=self.regularization,
            gradient=float(np.abs(self.plan.free_gradient(self.problem, self.trajectory)).max()),
            backward_passes=passes,
            rollouts=trials,
            seconds=time.perf_counter() - started,
        )
        self.history.append(item)
        logger.info("%s", item)
        report(item)

    def _relax(self) -> None:
        self.growth = min(1.0 / _GROWTH, self.growth / _GROWTH)
        self.regularization *= self.growth
        if self.regularization < _LEAST:
            self.regularization = 0.0

    def _stiffen(self) -> bool:
        self.growth = max(_GROWTH, self.growth * _GROWTH)
        self.regularization = max(_LEAST, self.regularization * self.growth)
        return self.regularization <= _MOST

    def _plan(self, *, exact: bool | None = None) -> int:
        """A backward pass, with as much regularization as it takes; returns how many it took.

        Second derivatives can make the model indefinite far from an optimum; there they are left out.
        """
        passes = 0
        self.exact = self.second_order if exact is None else exact
        while True:
            passes += 1
            self.plan = backward(self.problem, self.trajectory, self.regularization, self.exact)
            if self.plan is not None:
                self.planned = self.trajectory, self.regularization, self.exact
                return passes
            if self.exact:
                self.exact = False
            elif not self._stiffen():
                return passes

    def _least_regularized(self) -> tuple[Plan | None, float]:
        """The plan at the motion with as little regularization as leaves a minimum, and how much that is."""
        for regularization in (0.0, *10.0 ** np.arange(-6, 11, 2)):
            for exact in (True, False) if self.second_order and regularization == 0.0 else (False,):
                plan = backward(self.problem, self.trajectory, float(regularization), exact)
                if plan is not None:
                    return plan, float(regularization)
        return None, np.inf

    def _line_search(self, merit: float) -> tuple[float, int]:
        """Move to the first motion along the plan whose expected cost is low enough: its step, or 0, and trials."""
        if self.plan is None:
            return 0.0, 0
        problem, plan, step = self.problem, self.plan, 1.0
        for trial in range(_TRIALS):
            moved = self._move(step)
            if moved is not None:
                try:
                    cost = problem.cost_of(moved)
                    added = noise_cost(problem, moved, plan)
                except _LOST as error:
                    logger.info("trial of length %g: %s", step, error)
                    cost = added = np.inf
                if cost + added <= merit + self.armijo * step * plan.slope:
                    self.trajectory, self.cost = moved, cost
                    self.reached = cost + added
                    return step, trial + 1
            step *= self.backtracking
        return 0.0, _TRIALS

    def _move(self, step: float) -> Trajectory | None:
        if self.plan is None:
            return None
        problem, here = self.problem, self.trajectory
        u = here.u[:: problem.hold] + step * self.plan.feedforward
        if problem.limited:
            u = _onto_limits(u, problem.control_limits)
        if self.forward == "open":
            commands = _held(u, problem)
        else:
            gains, reference = self.plan.feedback, states(problem, here)[: -1 : problem.hold]
            if self.plan.previous is not None:
                before = here.u[: -problem.hold : problem.hold]
                gains = np.concatenate([gains, self.plan.previous], axis=2)
                # The first change is from a control that is given.
                reference = np.hstack([reference, np.vstack([here.u[:1], before])])
            commands = _held(u, problem)._replace(gains=gains, reference=reference)
        try:
            moved, failure = self.motions.under(commands)
        except NoiseFieldError as error:
            logger.info("trial of length %g: %s", step, error)
            return None
        return moved if failure is None else None

    def _last_plan(self) -> Plan | None:
        if self.plan is not None and self.planned == (self.trajectory, 0.0, self.second_order):
            return self.plan
        try:
            return self._least_regularized()[0]
        except _LOST:
            return None

    def solution(self, status: Status) -> Solution:
        problem, plan = self.problem, self.plan
        if status is not Status.CONVERGED:
            # With noise the fixed point of the search is not the minimum of the expected cost, and the last motion not
            # always the best; nor does the last plan belong to it, or hold without its regularization.
            plan = self._last_plan()
            merit, cost, best = self.best
            if best is not None and best is not self.trajectory and not (plan and self.cost + plan.noise <= merit):
                self.trajectory, self.cost = best, cost
                plan = self._last_plan()
        reason = self.reason
        if plan is not None and plan.loss > _LOSSY:
            lost = f"rounding may have changed Quu by {plan.loss:.0e} of itself: weights or inertias are too far apart"
            logger.warning("the gains cannot be trusted: %s", lost)
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


def _previous_gains(problem: OptimalControlProblem, plan: Plan | None) -> Floats | None:
    if problem.rate is None:
        return None
    m = problem.scene.controls
    return np.zeros((problem.decisions, m, m)) if plan is None else plan.previous


def states(problem: OptimalControlProblem, trajectory: Trajectory) -> Floats:
    """X (N + 1, 2n): (q, p) or (q, v)."""
    second = trajectory.p if problem.integrator.variational else trajectory.v
    return np.hstack([trajectory.q, second])
