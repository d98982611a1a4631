"""Stochastic differential dynamic programming on the structured linearization of any integrator.

The iterations, their line search, equation (O13) of docs/mathematics.md, and when they end. The backward pass is in
:mod:`varpin.control.backward`; :mod:`varpin.control.augmented` puts hard constraints around this search.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.control.backward import Along, Plan, backward, noise_shares, states
from varpin.control.costs import CostError
from varpin.control.descent import rounding
from varpin.control.examination import looked_at
from varpin.control.history import ITERATIONS, Iteration, SearchState, Status
from varpin.control.multiple_shooting import GapClosing, path_of
from varpin.control.problem import OptimalControlProblem
from varpin.control.refinement import refine
from varpin.control.solution import Solution
from varpin.control.trials import Attempt, Trials
from varpin.core import Watch
from varpin.core.arrays import Commands
from varpin.errors import InputError, LinearizationError
from varpin.integrators import Integrator
from varpin.integrators.base import open_line, open_loop
from varpin.integrators.variational import Variational
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.noise import NoiseFieldError
from varpin.mechanics.policy import LinearPolicy
from varpin.simulation.failures import StepFailure, named
from varpin.simulation.record import located
from varpin.support.checks import (
    JointValues,
    as_floats,
    control_array,
    count,
    finite_array,
    fraction,
    is_one_of,
    positive,
    real,
    takes,
    told_motion,
)
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]
Callback = Callable[[Iteration], None] | Callable[[Iteration, Trajectory], None]
Report = Callable[[Iteration, Trajectory], None]
Progress = Callable[[int, int], None]

logger = logging.getLogger(__name__)

# What a step must keep of the promised slope, and the factor between trials.
ARMIJO, BACKTRACKING = 1e-5, 0.5
# A step that keeps less of the slope than this is poor: shorter ones are tried as long as they are better.
_POOR = 0.3
# The schedule of the regularization (Tassa, Erez and Todorov 2012), relative to the diagonal of Quu: it shrinks after
# long steps and grows after short ones.
_GROWTH, _LEAST, _MOST = 2.0, 1e-6, 1e10
_LONG, _SHORT = 0.5, 0.01
# What a cost, a noise field, a force or a step may raise somewhere off the motion that has been found.
_LOST = (CostError, NoiseFieldError, CustomForceError, LinearizationError)
# As much as this does not hide how far an optimum is; controls that do nothing need some.
_LITTLE = 1e-4
# Of Quu, what rounding may change without a word.
_LOSSY = 1e-8
# Iterations without a decrease worth the name before a search gives up: the cost jumps where guards cut steps.
_PATIENCE = 15
# Where the optimum costs nothing, there is nothing to be relative to but this part of what was at stake at first.
_NOTHING = 1e-9
# The shortest step of a line search, about, and its trials at most.
_SHORTEST, _TRIALS = 1e-6, 40
# A trial is given up where a step wants more halvings than this, or than the motion so far, and where it has taken more
# parts in all than so many times those of the motion so far. What was given up is tried again with more of both where
# nothing else has led far, and without a bound where nothing has helped; a search that stalls goes on without bounds.
_HALVINGS, _MORE_HALVINGS = 2, 3
_PARTS = 3
# What is at stake on a first motion that no pass has looked at.
UNKNOWN = -1.0
# A trial that costs more than any step may is given up; what rounding does to costs is far below this part of them.
_DEARER = 1e-9


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
    noise: Literal["held", "whole"] = "held",
    states: ArrayLike | tuple[ArrayLike, ArrayLike] | Trajectory | None = None,
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

    Where controls have limits, each decision minimizes the model within them at the state that the linearized motion
    will have then, and a control at a limit has no feedback (after Tassa, Mansard and Todorov, "Control-limited
    differential dynamic programming", 2014). Limits that the motions on the way do not run into cost no iterations.
    What noise adds is then that of the linear feedback: that noise may drive a control into its limit is not in the
    model. ``monte_carlo`` has it.

    Main args:
        problem: What to minimize.
        controls: To start from: None to hold the robot at q0; an array (R, m) or (m,), R the number of
            decisions; by joint name; a :class:`LinearPolicy`; or a :class:`Solution`, whose policy then runs on this
            problem. What leaves the problem's limits is brought within them.
        tolerance: Stop when the decrease that the quadratic model promises is below this part of the cost at stake:
            what the cost would lose by its own quadratic models along the motion if each state and control were free,
            and no more than it changes by over what moves. Of squared distances that is about their value; of
            constants, whatever their size, and of what noise adds it is nothing.
        max_iterations: At most; 100 if left out, of a problem with constraints 500 of all rounds together.

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
            they come. The log has them too, at level INFO, each after the robot and the horizon that it is of. A
            function that needs two arguments gets the motion that the iteration ended with, too, a
            :class:`varpin.Trajectory`; as :class:`varpin.LiveView` does.
        progress: Called after each iteration with (iterations done, max_iterations); few searches need them all.
        resume: A solution of this very problem, as solve returned it or as read from a file: the search goes on where
            it stopped, for at most ``max_iterations`` more, as if it had not been interrupted. Give the other options
            as before; ``regularization`` goes on by itself.
        check: Look at the finished plan, whether it costs in finer steps what it promises and its velocities neither
            alternate nor go up and down all the time, for ``Solution.warnings`` and the log. It takes as long as some
            motions of the search.
        true_cost: How far the cost of the plan with its feedback on the continuous system may be from what the plan
            says, relative to that: 0.01 for a percent. The problem's step is the coarsest; half of it follows, from
            the plan before, until :meth:`Solution.verify` says that the wish is met. ``Solution.problem`` has the step
            of the plan, ``Solution.refinement`` what it took, or why the wish cannot be met, which is a warning, too.
            Controls that are held over several steps keep their period. ``max_iterations`` is for each step,
            ``time_limit`` for all; Ctrl-C keeps the best plan so far.
        noise: Which gradient what noise adds has, where its strength depends on the state or the control. ``"held"``:
            as in the paper, with the Hessian of the value held; it leaves out what the motion's derivatives change, and
            ends next to the minimum of the expected cost. ``"whole"``: from there it goes on to that minimum, a local
            one of the model, for 10 to 50 times the time. With ``second_order`` and within control limits it is held.
            Problems with constraints are solved for the least cost without noise; it shapes their feedback and margins.
        states: To start from instead of a motion that the controls make: configurations at the nodes (N + 1, n), the
            first one q0; a pair (q, v) of such arrays; or a :class:`varpin.Trajectory`. A straight line or the path of
            another planner will do, though no controls make it: forces on the joints hold the first motion on it, and
            the first iterations take them away (multiple shooting). ``controls`` are then those that go with the
            states; left out, they are the inverse dynamics' within their limits. Single shooting goes on from there.
            Held controls only, and no :class:`KinematicInput`. A search that ends before the forces are gone is left
            with the controls alone: resumed, it goes on from these, and not as if it had not been interrupted.

    Returns:
        The best motion found, whatever happened; ``status`` says how it ended, ``reason`` with which numbers, and
        ``warnings`` what keeps a robot from following it.

    Raises:
        InputError: Controls of a wrong shape, or options out of their range.
        NoiseFieldError: A noise field of one's own fails on the first motion.
        ForceError: A :class:`varpin.CustomForce` fails on the first motion; elsewhere it costs a trial.
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
    if not is_one_of(noise, ("held", "whole")):
        raise InputError(f"noise must be 'held' or 'whole', got {noise!r}")
    tell = require_reports(callback, progress)
    if problem.linear and second_order:
        raise InputError("second_order is for held controls; the problem's are linear between nodes")
    positive("tolerance", tolerance, "1")
    deadline = time.perf_counter() + checked_time(time_limit)
    fraction("armijo", armijo)
    max_iterations = count("max_iterations", max_iterations)
    if states is not None and resume is not None:
        raise InputError("resume goes on from the solution's own states: leave out either states or resume")
    path = None if states is None else path_of(problem, states)
    known = len(resume.search.history) if isinstance(resume, Solution) and resume.search is not None else 0

    def report(item: Iteration, motion: Trajectory) -> None:
        tell(item, motion)
        if progress is not None:
            # Convergence may take a last look after the last iteration.
            progress(min(item.index + 1 - known, max_iterations), max_iterations)

    if true_cost is not None:
        if resume is not None:
            raise InputError("true_cost begins with a search of its own: leave out either resume or true_cost")

        def once(finer: OptimalControlProblem, start: LinearPolicy | None) -> Solution:
            return solve(
                finer,
                controls if start is None else start,
                tolerance=tolerance,
                max_iterations=max_iterations,
                second_order=second_order,
                forward=forward,
                armijo=armijo,
                backtracking=backtracking,
                regularization=regularization,
                time_limit=max(deadline - time.perf_counter(), 1e-9),
                callback=callback,
                progress=progress,
                check=False,
                noise=noise,
                states=states if start is None else None,
            )

        refined = refine(problem, once, positive("true_cost", true_cost, "1"), lambda: deadline - time.perf_counter())
        return looked_at(refined)[0] if check else refined

    search = _Search(problem, second_order, forward, armijo, backtracking, regularization, whole_noise=noise == "whole")
    if resume is not None:
        search.resume(_search_of(problem, controls, resume))
    elif path is None:
        search.begin(_first_commands(problem, controls))
    closing = None if path is None else GapClosing(problem, path, _controls_along(problem, controls))
    try:
        if closing is not None:
            search.close(closing, max_iterations, deadline, report)
        status = search.run(tolerance, max_iterations - (len(search.history) - known), deadline, report)
    except KeyboardInterrupt:
        status, search.reason = Status.INTERRUPTED, f"in iteration {len(search.history)}"
    solution = search.solution(status)
    return looked_at(solution)[0] if check else solution


def require_reports(callback: Any, progress: object) -> Report:
    """The callback as a function of an iteration and its motion, whichever of them it takes.

    Raises:
        InputError: It, or a progress, cannot be called with what it is told.
    """
    both = told_motion("callback", callback, "iteration", "motion")
    if progress is not None and not (callable(progress) and takes(progress, 2)):
        raise InputError(f"progress must be a function of (iterations done, max_iterations), got {progress!r}")

    def tell(item: Iteration, motion: Trajectory) -> None:
        if both:
            callback(item, motion)
        elif callback is not None:
            callback(item)

    return tell


def checked_time(limit: object) -> float:
    """A time limit [s] as a float > 0, infinite for none."""
    return np.inf if limit == np.inf else positive("time_limit", limit, "s")


def replan(
    problem: OptimalControlProblem,
    previous: Solution,
    decisions: int,
    *,
    tolerance: float,
    max_iterations: int,
    deadline: float,
) -> Solution:
    """A plan from the one made some ``decisions`` ago, with one backward pass for each iteration: a controller's tick.

    Where iterations or time end the search, gains are those that its last step followed, and are not made anew for the
    motion that came of it. Nobody looks at the finished plan. No iteration begins that would end after ``deadline``, on
    ``time.perf_counter``, if it took as long as those before. Other arguments, and errors, are those of :func:`solve`.
    """
    search = _Search(problem, second_order=False, anew=False)
    search.begin(_shifted_commands(problem, previous, decisions))
    try:
        status = search.run(tolerance, max_iterations, deadline, lambda *_: None)
    except KeyboardInterrupt:
        status, search.reason = Status.INTERRUPTED, f"in iteration {len(search.history)}"
    return search.solution(status)


def _first_commands(problem: OptimalControlProblem, controls: JointValues | LinearPolicy | Solution | None) -> Commands:
    m, variational = problem.scene.controls, problem.integrator.variational
    if isinstance(controls, Solution):
        controls = controls.policy_on("momentum" if variational else "velocity")
    if controls is None:
        controls = problem.holding_policy()
    if isinstance(controls, LinearPolicy):
        if (hold := controls.hold_at(problem.dt)) != problem.hold:
            raise InputError(f"the policy holds its controls over {hold} steps, the problem {problem.hold}")
        if controls.linear != problem.linear:
            policy, wanted = ("linear", "held") if controls.linear else ("held", "linear")
            raise InputError(f"the policy's controls are {policy}, the problem's {wanted}")
        commands = controls.commands(
            problem.steps, m, problem.scene.robot.dof, variational, problem.dt, problem.integrator.stage_times
        )
        narrowed = np.clip(commands.limits, *problem.control_limits)
        narrowed.setflags(write=False)
        if problem.linear:
            return commands._replace(limits=narrowed, before=np.clip(commands.before, *narrowed))
        if problem.rate is not None and problem.rate.before is not None:
            commands = commands._replace(before=problem.rate.before[None].copy())
        return commands._replace(limits=narrowed)
    return _held(_rows_of(problem, controls), problem)


def _controls_along(problem: OptimalControlProblem, controls: object) -> Floats | None:
    """Controls (R, m) that go with given states, within their limits."""
    if controls is None:
        return None
    if isinstance(controls, Solution | LinearPolicy):
        raise InputError("controls that go with states are rows (R, m) or (m,), or by joint name, without feedback")
    u = _rows_of(problem, controls)
    return np.asarray(np.clip(u, *problem.control_limits), dtype=np.float64)


def _rows_of(problem: OptimalControlProblem, controls: Any) -> Floats:
    """Given controls as rows (R, m)."""
    R, m = problem.decisions, problem.scene.controls
    if isinstance(controls, Mapping):
        controls = control_array("controls", controls, problem.scene.control_joints)
    rows = as_floats("controls", controls)
    return np.broadcast_to(finite_array("controls", rows, (m,) if rows.ndim == 1 else (R, m)), (R, m))


def _shifted_commands(problem: OptimalControlProblem, previous: Solution, decisions: int) -> Commands:
    """Those of :meth:`Solution.shifted` under the problem's limits and after its control before."""
    old, before = previous.problem, None if problem.rate is None else problem.rate.before
    R, m = problem.decisions, problem.scene.controls
    same = (
        old.scene is problem.scene
        and old.integrator == problem.integrator
        and old.control_limits is problem.control_limits
    )
    if not (same and (old.dt, old.steps, old.hold) == (problem.dt, problem.steps, problem.hold)):
        return _first_commands(problem, previous.shifted(decisions, before))
    rows = np.minimum(np.arange(R) + decisions, R - 1)
    u, gains, reference = previous.controls, previous.gains, states(old, previous.trajectory)[: -1 : old.hold]
    if previous.previous_gains is not None:
        start = None if old.rate is None else old.rate.before
        expected = np.vstack([u[:1] if start is None else start, u[:-1]])[rows[:1]]
        gains = np.concatenate([gains, previous.previous_gains], axis=2)
        # What is repeated expects itself before.
        reference = np.hstack([reference[rows], np.vstack([expected, u[rows[:-1]]])])
    else:
        reference = reference[rows]
    return Commands(
        u=u[rows],
        gains=gains[rows],
        reference=reference,
        hold=problem.hold,
        limits=problem.control_limits,
        before=np.zeros((0, m)) if before is None else before[None].copy(),
    )


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
    if problem.linear:
        return open_line(np.clip(u, *problem.control_limits), problem.integrator.stage_times)._replace(
            limits=problem.control_limits.copy()
        )
    return open_loop(u)._replace(hold=problem.hold, limits=problem.control_limits.copy())


def _onto_limits(u: Floats, limits: Floats) -> Floats:
    """Controls (R, m) that rounding keeps from a limit brought to it, so that they are known to be there."""
    room = 8.0 * np.finfo(float).eps * np.where(np.isfinite(limits), np.abs(limits), 0.0).max(axis=0)
    for limit in limits:
        u = np.where(np.abs(u - limit) <= room, limit, u)
    return u


@functools.lru_cache(maxsize=16)
def _lengths(backtracking: float) -> tuple[float, ...]:
    """Of the steps that a line search tries, the longest first."""
    shorter = max(1, round(np.log(_SHORTEST) / np.log(backtracking)))
    return tuple(backtracking**i for i in range(min(1 + shorter, _TRIALS)))


@functools.lru_cache(maxsize=256)
def _cut_less(integrator: Variational, halvings: int) -> Variational:
    """An integrator, a dataclass with a guard, whose steps are halved no more often than this."""
    guard = integrator.guard
    if guard is None or not is_dataclass(integrator):
        return integrator
    return replace(integrator, guard=replace(guard, max_halvings=min(halvings, guard.max_halvings)))


@dataclass(frozen=True)
class _Bounds:
    """What a trial of the line search may take.

    Attributes:
        integrator: With the halvings that a step may take.
        parts: Of all steps, by those of the motion so far.
        watched: Whether even a trial of the whole step is looked at on its way. Most searches take it, and looking
            takes time.
    """

    integrator: Integrator
    parts: float
    watched: bool


@dataclass(frozen=True, eq=False)
class _Trial:
    """A motion that the line search tried.

    Attributes:
        motion: None where it was given up, or has no cost.
        shares: Of its cost.
        cost: By how much it is dearer without noise.
        expected: By how much it is dearer with noise.
        cut: Whether it was given up for being cut into many parts.
    """

    motion: Attempt | None = None
    shares: Floats | None = None
    cost: float = np.inf
    expected: float = np.inf
    cut: bool = False


@dataclass(frozen=True)
class _Step:
    """What a line search did.

    Attributes:
        length: Of the step taken; 0 if none was.
        trials: How many it took.
        decrease: Of the expected cost.
        hidden: What rounding may do to a difference of costs; 0 where no trial has a cost.
    """

    length: float
    trials: int
    decrease: float
    hidden: float


class _Search:
    """The motion so far, and what is known around it."""

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
        self.armijo, self.backtracking, self.regularization = armijo, backtracking, regularization
        self.growth = 1.0
        self.exact = second_order
        self.history: list[Iteration] = []
        self.plan: Plan | None = None
        self.planned: tuple[Trajectory, float, bool] | None = None  # what it is a plan for, and how it was made
        self.trials = Trials(problem)
        self._around: Along | None = None
        self.trajectory: Trajectory
        self.shares: Floats  # of the cost of the trajectory
        self.cost = np.inf
        self.first = 0.0  # what was at stake on the first motion
        self.state: SearchState | None = None  # at the start of the last iteration, from where it can go on
        self.best: Trajectory | None = None
        self.best_cost = self.best_noise = np.inf
        self.above = 0.0  # what the trajectory costs more than the best one, without noise
        self.bounded = True  # whether trials are given up for their parts
        self.cut = False  # whether one was
        self.gains: list[float] = []  # by how much each iteration lowered the least expected cost
        self.reason = ""
        self.anew = anew  # whether a plan is made for the last motion, too
        self.followed = 0.0  # the length of the last step, if none was
        self.steered = problem.steered
        # Whether the whole gradient of what noise adds is to be followed in the end, and whether it is. Within limits
        # what it adds jumps where a control meets one and loses its gains: there is no gradient to follow.
        self.wants_whole = whole_noise and not (second_order or problem.limited) and bool(self.steered.any())
        self.whole = False
        # Before each line of the log, where searches of several problems and of a controller's ticks may stand.
        robot, begin = problem.scene.robot.name, problem.t0
        self.label = f"{robot}, {problem.steps} steps of {problem.dt:g} s from t = {begin:g} s"

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
        """Begin with what is found on the way from given states, in so many iterations at most."""
        try:
            closing.run(most, deadline, report)
        finally:
            self.history = list(closing.history)
            self.begin(_first_commands(self.problem, closing.policy()))
            # What is at stake is that of this motion, however many iterations it took.
            self.first = UNKNOWN
            self.state = self._state()

    def resume(self, state: SearchState) -> None:
        """Stand where ``state`` was taken."""
        self.trajectory, self.cost, self.above, self.first = state.trajectory, state.cost, state.above, state.first
        self.shares = self.problem.shares(state.trajectory)
        self.gains, self.history = list(state.gains), list(state.history)
        self.best, self.best_cost, self.best_noise = state.best, state.best_cost, state.best_noise
        self.regularization, self.growth = state.regularization, state.growth
        self.bounded, self.cut = state.bounded, state.cut
        self.whole = state.whole and self.wants_whole

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
        )

    def run(self, tolerance: float, max_iterations: int, deadline: float, report: Report) -> Status:
        last, longest = len(self.history) + max_iterations, 0.0
        while True:
            self.state = self._state()
            started = time.perf_counter()
            try:
                passes = self._plan()
            except _LOST as error:
                if not self.history:
                    raise
                logger.warning("%s: %s", self.label, error)
                self.reason = str(error)
                return Status.NOT_DIFFERENTIABLE
            if self.plan is None:
                self.reason = f"the regularization has reached {self.regularization:.1e} of the diagonal of Quu"
                return Status.INDEFINITE
            self._compare_with_best(self.plan)
            if not self.history or self.first == UNKNOWN:
                self.first = self._at_first()
            there = self._is_there(self.plan, tolerance)
            if self._turns_whole(there=there):
                self._take_whole()
                continue
            if there:
                self._note(report, started, passes)
                self.reason = self._numbers(tolerance)
                return Status.CONVERGED
            ended, why = self._ended(tolerance, last, deadline)
            if ended is Status.STALLED and self._lift():
                continue
            if ended is not None:
                self._note(report, started, passes)
                self.reason = why + self._numbers(tolerance, afresh=True)
                return ended
            step = self._line_search()
            if step.length == 0.0 and self.exact:
                passes += self._plan(exact=False)
                more = self._line_search()
                step = replace(more, trials=step.trials + more.trials, hidden=max(step.hidden, more.hidden))
            self._note(report, started, passes, step)
            if step.length == 0.0 and self._keeps_no_promise_above(step.hidden):
                self.reason = f"{self._promised()}, and rounding hides {step.hidden:.1e} of the cost"
                return Status.CONVERGED
            # A tick's plan has to be there in time: none begins that would be late if it took as long as those before.
            longest = max(longest, time.perf_counter() - started)
            ended = self._out_of(last, deadline if self.anew else deadline - longest)
            if not self.anew and step.length > 0.0 and ended is not None:
                self.followed = step.length
                self.reason = f"{self._promised()} before the last step"
                return ended
            if step.length >= _LONG:
                self._relax()
            elif step.length <= _SHORT and not self._stiffen() and not self._lift():
                self.reason = "no step lowers the cost, whatever the regularization; "
                self.reason += self._numbers(tolerance, afresh=True)
                return Status.STALLED

    def _at_first(self) -> float:
        """What is at stake on the first motion."""
        if not self.anew and self.problem.cost.nonnegative:
            # Of squares no more is at stake than they cost, and a tick has no time to find out how much.
            return self.cost
        stake = self.along.stake
        return stake.free if np.isfinite(stake.free) else stake.moved

    def _turns_whole(self, *, there: bool) -> bool:
        """Whether the search with held noise is as far as it gets, and goes on with the whole gradient."""
        if not self.wants_whole or self.whole:
            return False
        return there or (len(self.gains) > 1 and self.gains[-1] <= 0.0)

    def _take_whole(self) -> None:
        """Follow the whole gradient of what noise adds from here on, from the best motion so far."""
        logger.info("%s: from here on with the whole gradient of what noise adds", self.label)
        if self.best is not None and self.best is not self.trajectory:
            self.trajectory, self.cost = self.best, self.best_cost
            self.shares = self.problem.shares(self.best)
        # What noise adds is rated otherwise from here on.
        self.whole, self.best, self.best_cost, self.best_noise, self.above = True, None, np.inf, np.inf, 0.0
        self.gains, self._around = [], None

    def _differentiate_noise(self, regularization: float) -> int:
        """Give passes along the motion the whole gradient of what noise adds; how many passes that took."""
        if not self.whole or self.along.noise_differentiated:
            return 0
        plan = backward(self.problem, self.trajectory, regularization, along=self.along)
        if plan is not None:
            self.along.differentiate_noise(plan, self.steered)
        return 1

    def _compare_with_best(self, plan: Plan) -> None:
        noise = self._noise(plan)
        gain = self.best_noise - self.above - noise
        if self.best is None or gain > 0.0:
            self.gains.append(0.0 if self.best is None else gain)
            self.best, self.best_cost, self.best_noise, self.above = self.trajectory, self.cost, noise, 0.0
        else:
            self.gains.append(0.0)

    def _noise(self, plan: Plan) -> float:
        """What the noise that plans take into account adds to the cost."""
        if self.steered.all():
            return plan.noise
        if not self.steered.any():
            return 0.0
        return float(noise_shares(self.problem, self.trajectory, plan, self.steered).sum())

    @property
    def along(self) -> Along:
        """What passes along the motion are made from."""
        if self._around is None or self._around.trajectory is not self.trajectory:
            self._around = Along(self.problem, self.trajectory)
        return self._around

    def _share(self, tolerance: float) -> float:
        """The tolerance on the promised decrease."""
        return tolerance * (self.along.stake.moved + _NOTHING * self.first)

    def _is_there(self, plan: Plan, tolerance: float) -> bool:
        least = tolerance * _NOTHING * self.first
        if self.problem.cost.nonnegative and plan.expected_decrease > tolerance * self.cost + least:
            # Of squares no more is at stake than they cost.
            return False
        if not self.steered.any() and self.along.stake.free <= least:
            # No motion at all costs less. Without costs on the controls the model may have no minimum even there.
            self.plan = self._least_regularized()[0] or plan
            return True
        return self._keeps_no_promise_above(self._share(tolerance))

    def _ended(self, tolerance: float, last: int, deadline: float) -> tuple[Status | None, str]:
        """How a search ends that has not converged, if it does, and the reason."""
        if len(self.history) >= last:
            return self._out_of(last, deadline), ""
        if len(self.gains) > _PATIENCE:
            recent = sum(self.gains[-_PATIENCE:])
            if recent <= self._share(tolerance):
                return Status.STALLED, f"{_PATIENCE} iterations have lowered the expected cost by {recent:.1e}; "
        return self._out_of(last, deadline), ""

    def _out_of(self, last: int, deadline: float) -> Status | None:
        """Whether iterations or time end the search."""
        if len(self.history) >= last:
            return Status.MAX_ITERATIONS
        return Status.OUT_OF_TIME if time.perf_counter() > deadline else None

    def _keeps_no_promise_above(self, bound: float) -> bool:
        """Whether the model promises no more than ``bound``; the plan is then one that can be trusted with that.

        Regularization makes promises smaller; it must not pass for an optimum.
        """
        if self.plan is None or not self.plan.expected_decrease <= bound:
            return False
        if self.regularization > 0.0:
            plan, least = self._least_regularized()
            if plan is None or least > _LITTLE or not plan.expected_decrease <= bound:
                return False
            self.plan = plan
        return True

    def _promised(self) -> str:
        return f"the model promises a decrease of {np.nan if self.plan is None else self.plan.expected_decrease:.1e}"

    def _numbers(self, tolerance: float, *, afresh: bool = False) -> str:
        """What the status rests on; ``afresh`` with as little regularization as the model needs."""
        needed = ""
        if afresh and self.regularization > 0.0:
            with contextlib.suppress(*_LOST):
                plan, least = self._least_regularized()
                if plan is not None:
                    self.plan = plan
                    needed = f" under a regularization of {least:.0e}, without which it has no minimum" if least else ""
        share = np.nan if self.plan is None else self._share(tolerance)
        return f"{self._promised()}{needed}; the tolerance of {tolerance:g} times the cost at stake is {share:.1e}"

    def _note(self, report: Report, started: float, passes: int, step: _Step | None = None) -> None:
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
        )
        self.history.append(item)
        logger.info("%s: %s", self.label, item)
        report(item, self.trajectory)

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
        """Go on without bounds on what trials may take, if there were any and one was given up."""
        if not (self.bounded and self.cut):
            return False
        logger.info(
            "%s: no progress with trials of few parts: from here on they may take as many as they need", self.label
        )
        self.bounded, self.regularization, self.growth = False, 0.0, 1.0
        # One line search without bounds, before what was gained lately is looked at again.
        self.gains = self.gains[1 - _PATIENCE :]
        return True

    def _plan(self, *, exact: bool | None = None) -> int:
        """A backward pass, with as much regularization as it takes; returns how many it took.

        Second derivatives can make the model indefinite far from an optimum; there they are left out.
        """
        passes = 0
        self.exact = self.second_order if exact is None else exact
        while True:
            passes += 1 + self._differentiate_noise(self.regularization)
            self.plan = backward(self.problem, self.trajectory, self.regularization, self.exact, along=self.along)
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
            self._differentiate_noise(float(regularization))
            for exact in (True, False) if self.second_order and regularization == 0.0 else (False,):
                plan = backward(self.problem, self.trajectory, float(regularization), exact, along=self.along)
                if plan is not None:
                    return plan, float(regularization)
        return None, np.inf

    def _line_search(self) -> _Step:
        """Move to the first motion along the plan whose expected cost is low enough, (O13)."""
        if self.plan is None:
            return _Step(0.0, 0, 0.0, 0.0)
        added = noise_shares(self.problem, self.trajectory, self.plan)
        taken, length, tried, trials = _Trial(), 0.0, None, 0
        feedback = self._feedback(self.plan)
        left: Sequence[float] = _lengths(self.backtracking)
        for bounds in self._bounds():
            cut = []
            for step in left:
                trials += 1
                trial = self._try(step, feedback, added, bounds)
                if trial.expected <= self.armijo * step * self.plan.slope and trial.expected < taken.expected:
                    taken, length = trial, step
                    if trial.expected <= _POOR * step * self.plan.slope:
                        break
                    continue
                if length > 0.0:
                    break
                if trial.cut:
                    cut.append(step)
                    self.cut = True
                elif trial.shares is not None:
                    tried = trial.shares
            left = [step for step in cut if step > length]
            if not left or length > (_SHORT if bounds.parts == _PARTS else 0.0):
                break
        hidden = 0.0
        if taken.motion is not None and taken.shares is not None:
            self.trajectory, self.shares = taken.motion.trajectory(), taken.shares
            self.cost = float(taken.shares.sum())
            self.above += taken.cost
        elif tried is not None:
            hidden = rounding(self.problem, self.trajectory, self.shares, tried, self.plan.model)
        return _Step(length, trials, -taken.expected if length > 0.0 else 0.0, hidden)

    def _bounds(self) -> Iterator[_Bounds]:
        """What trials may take, one after another while nothing else helps."""
        integrator = self.problem.integrator
        guard = integrator.guard if isinstance(integrator, Variational) else None
        if not (self.bounded and guard is not None and is_dataclass(integrator)):
            yield _Bounds(integrator, np.inf, watched=False)
            return
        # As many parts as a step of the motion so far has take fewer halvings of halves.
        few = max(_HALVINGS, int(self.trajectory.statistics.substeps.max()) - 1)
        for halvings, parts in ((few, _PARTS), (few + _MORE_HALVINGS, _PARTS**2)):
            yield _Bounds(_cut_less(integrator, halvings), parts, watched=halvings > _HALVINGS)
        yield _Bounds(integrator, np.inf, watched=True)

    def _try(self, step: float, feedback: Commands, added: Floats, bounds: _Bounds) -> _Trial:
        """A motion so far along the plan, given up where it is cut to pieces or too dear already."""
        problem, plan = self.problem, self.plan
        if plan is None:
            return _Trial()
        # What is to come of the cost, and what noise adds to it, is known not to be below zero.
        bounded = problem.cost.nonnegative and not (self.exact and problem.processes)
        most = float(self.shares.sum() + added.sum()) + self.armijo * step * plan.slope if bounded else np.inf
        parts = np.inf
        if bounds.parts < np.inf and (bounds.watched or step < 1.0):
            # Explicit methods count no parts.
            parts = bounds.parts * max(1, int(self.trajectory.statistics.substeps[: self.trials.third].sum()))
        u = problem.decided(self.trajectory) + step * plan.feedforward
        if problem.limited:
            u = _onto_limits(u, problem.control_limits)
        commands = feedback._replace(u=u)
        if problem.linear:
            # Nothing is fed back to the first control: its state is given.
            commands = feedback._replace(u=u[1:], before=np.clip(u[:1], *problem.control_limits))
        try:
            attempt = self.trials.attempt(
                commands, integrator=bounds.integrator, most=most + _DEARER * abs(most), parts=parts
            )
            if not attempt.whole:
                # Whatever makes a step of few halvings fail, more may mend.
                few = attempt.failure is not None and bounds.integrator != problem.integrator
                return _Trial(cut=few or attempt.verdict is Watch.Verdict.cut)
            there = attempt.shares()
            noise = noise_shares(problem, attempt.trajectory(), plan) if problem.processes else added
            more = self._noise_beyond(attempt.trajectory(), plan) if self.whole else 0.0
        except _LOST as error:
            logger.info("%s: trial of length %g: %s", self.label, step, error)
            return _Trial()
        if not np.isfinite(there).all():
            return _Trial()
        cost = float((there - self.shares).sum())
        return _Trial(attempt, there, cost, cost + float((noise - added).sum()) + more)

    def _noise_beyond(self, trial: Trajectory, plan: Plan) -> float:
        """What noise adds along a trial beyond what it adds where it acts and costs as along the motion so far."""
        found = backward(self.problem, trial, self.regularization)
        if found is None:
            return np.inf
        shares, held = (noise_shares(self.problem, trial, each, self.steered).sum() for each in (found, plan))
        return float(shares - held)

    def _feedback(self, plan: Plan) -> Commands:
        """The commands of trials, but for the feed-forward part that theirs is on top of."""
        problem, here = self.problem, self.trajectory
        if self.forward == "open":
            return _held(problem.decided(here), problem)
        gains, reference = plan.feedback, states(problem, here)[: -1 : problem.hold]
        if problem.linear and plan.previous is not None:
            gains = np.concatenate([plan.feedback, plan.previous], axis=2)[1:]
            reference = np.hstack([reference, here.u_nodes[:-1]])
        elif plan.previous is not None:
            before = here.u[: -problem.hold : problem.hold]
            gains = np.concatenate([gains, plan.previous], axis=2)
            # The first change is from a control that is given.
            reference = np.hstack([reference, np.vstack([here.u[:1], before])])
        if problem.linear:
            commands = _held(problem.decided(here), problem)
            return commands._replace(gains=gains, reference=np.ascontiguousarray(reference))
        return Commands(
            u=problem.decided(here),
            gains=gains,
            reference=np.ascontiguousarray(reference),
            hold=problem.hold,
            limits=problem.control_limits,
            before=np.zeros((0, problem.scene.controls)),
        )

    def _last_plan(self) -> Plan | None:
        if self.plan is not None and self.planned == (self.trajectory, 0.0, self.second_order):
            return self.plan
        try:
            return self._least_regularized()[0]
        except _LOST:
            return None

    def solution(self, status: Status) -> Solution:
        problem, plan = self.problem, self.plan
        if plan is not None and self.followed > 0.0:
            plan = plan.followed(self.followed)
        elif status is not Status.CONVERGED:
            # With noise the fixed point of the search is not the minimum of the expected cost, and the last motion not
            # always the best; nor does the last plan belong to it, or hold without its regularization.
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


def _previous_gains(problem: OptimalControlProblem, plan: Plan | None) -> Floats | None:
    if problem.rate is None and not problem.linear:
        return None
    m = problem.scene.controls
    return np.zeros((problem.decisions, m, m)) if plan is None else plan.previous
