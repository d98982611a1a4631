"""Stochastic differential dynamic programming on the structured linearization of any integrator.

Problems without constraints, and a controller's ticks. The iterations are in :mod:`varpin.control.search`;
:mod:`varpin.control.augmented` adds hard constraints.
"""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Mask
from varpin.control.commands import controls_along, first_commands, shifted_commands
from varpin.control.examination import foreseen, looked_at
from varpin.control.following import Path
from varpin.control.history import ITERATIONS, Iteration, SearchState, Status
from varpin.control.multiple_shooting import GapClosing, path_of
from varpin.control.noise_adjoint import is_exact
from varpin.control.problem import OptimalControlProblem
from varpin.control.refinement import COMPARISON, SLOW, SUFFICIENT, refine
from varpin.control.search import ARMIJO, BACKTRACKING, Report, Search
from varpin.control.solution import Solution
from varpin.errors import InputError
from varpin.finding import announce
from varpin.signals.policy import LinearPolicy
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
Progress = Callable[[int, int], None]

logger = logging.getLogger(__name__)


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
    announce(logger, problem.scene.announced, problem.dt, before)

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
        search = Search(problem, second_order, forward, armijo, backtracking, regularization, whole_noise=whole_noise)
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
    search = Search(problem, second_order=False, anew=False)
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
