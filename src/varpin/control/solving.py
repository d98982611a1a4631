"""The function ``solve``: options, first motions, also along given states, resumed plans and refinement."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from varpin import core
from varpin.arrays import Floats
from varpin.control.checks import foreseen, looked_at
from varpin.control.history import Iteration, Status
from varpin.control.problem import FASTEST, OptimalControlProblem, require_problem
from varpin.control.refine import refine
from varpin.control.search import Report, Search
from varpin.control.sizes import FEASIBLE, NOTABLE, SLIGHT, TRACE
from varpin.control.solution import Solution
from varpin.core.arrays import Commands
from varpin.errors import InputError, VarpinError
from varpin.finding import announce
from varpin.mechanics.forces import of_kind
from varpin.model import in_degrees
from varpin.signals.commands import as_moved, with_ends
from varpin.signals.policy import LinearPolicy
from varpin.simulation.choice import STIFF
from varpin.simulation.spectrum import masses
from varpin.support.checks import (
    JointValues,
    as_floats,
    control_values,
    count,
    finite_array,
    flag,
    positive,
    real,
    told_motion,
)
from varpin.support.one_thread import one_thread
from varpin.trajectory import Trajectory

Callback = Callable[[Iteration], None] | Callable[[Iteration, Trajectory], None]
Progress = Callable[[int, int], None]
# States at a problem's nodes: q (N + 1, n) [rad or m] and v (N + 1, n) [rad/s or m/s].
_Path = tuple[Floats, Floats]

# Factor between the widths of dry friction from one search to the next; from 2 to 5.
_SHARPENED = 3.0

logger = logging.getLogger(__name__)


def solve(
    problem: OptimalControlProblem,
    controls: JointValues | LinearPolicy | Solution | None = None,
    *,
    tolerance: float = 1e-7,
    max_iterations: int = 500,
    second_order: bool = False,
    regularization: float = 0.0,
    time_limit: float = np.inf,
    callback: Callback | None = None,
    resume: Solution | None = None,
    progress: Progress | None = None,
    check: bool = True,
    true_cost: float | None = None,
    states: ArrayLike | tuple[ArrayLike, ArrayLike] | Trajectory | None = None,
) -> Solution:
    """Solve an optimal control problem by S-DDP (Algorithm 2 of the paper).

    Each iteration linearizes along the motion, runs a backward pass through the quadratic model of the cost to go, and
    searches along the new controls for a motion of lower expected cost: its cost plus what noise adds under the model.
    Where limits or constraints are in reach, the changes of the controls are those of one quadratic program over the
    horizon, and the search lowers the expected cost plus a penalty of the violations.

        robot = vp.load_robot("ur5")
        cost = vp.ControlCost(1e-3) + vp.Terminal(vp.TrackingCost([0.5, -1, 1, 0, 0.5, 0], 1e3) + vp.VelocityCost(10))
        problem = vp.OptimalControlProblem(vp.Scene(robot), cost, q0=np.zeros(6), v0=np.zeros(6), dt=0.01, steps=100)
        plan = vp.solve(problem, callback=print)  # a line for each iteration
        print(plan.table())
        print(plan.verify())

    Ctrl-C returns the best motion so far with ``status`` INTERRUPTED; ``solve(problem, plan)`` continues from there.

    Feedback is that of the costs and goals alone: limits and other constraints never enter it. The noise cost is that
    of linear feedback, without controls that noise drives into their limits; ``monte_carlo`` includes them.

    Main args:
        problem: What to minimize.
        controls: Initial controls: None to hold the robot at q0 (or, where dry friction is too sharp for the step, to
            follow plans under wider friction, each of at most ``max_iterations``); an array (R, m) or (m,), R the
            number of decisions; by joint name; a :class:`LinearPolicy`; or a :class:`Solution`, whose policy then runs
            on this problem. Controls outside the problem's limits are clipped.
        tolerance: Stop when the expected decrease is below this fraction of the cost at stake, (O9). For squared
            distances that is about their value; constants in the cost and the noise cost do not count.
        max_iterations: Greatest number of iterations.

    Other Args:
        second_order: Full differential dynamic programming: second derivatives of the dynamics too, wherever the
            model stays convex. Converges quadratically; needs an integrator that has them (:class:`Midpoint`).
        regularization: Initial value, relative to the diagonal of Quu; it increases and decreases as needed.
        time_limit: No iteration begins after this time since the call [s]. The result then depends on the machine.
        callback: Called with each :class:`Iteration`, which the log has at level INFO; ``callback=print`` prints the
            rows of :meth:`Solution.table`. A function of two arguments is also given the motion after the iteration, a
            :class:`varpin.Trajectory`.
        progress: Called after each iteration with (iterations done, max_iterations); few searches need them all.
        resume: A solution of the same problem, also one read from a file: the search continues where it stopped, for at
            most ``max_iterations`` more, as if it had not been interrupted. Give the other options as before;
            ``regularization`` is taken from the solution.
        check: Check the finished plan, in the time of a few motions, for ``Solution.warnings`` and the log.
        true_cost: Greatest difference between the plan's cost and its cost with feedback on the continuous system,
            relative to the former: 0.01 for a percent; and greatest excess of the latter over the optimum of finer
            controls, as estimated from the plan of half the step. Constraints must then hold on the continuous system
            to a thousandth of their range. The problem's step is halved, each search starting from the plan before,
            until all that is so. ``Solution.problem`` has the plan's step, ``Solution.refinement`` the steps tried, or
            why the accuracy cannot be reached. Controls that are held over several steps keep their period.
            ``max_iterations`` is for each step, ``time_limit`` for all; ``tolerance`` is at least a hundredth of
            ``true_cost``. Where dampers are far faster than the step, ``controls="linear"`` in the problem reaches the
            accuracy at much larger steps.
        states: Initial states, which need not be feasible: configurations at the nodes (N + 1, n), the first one q0; a
            pair (q, v) of such arrays; or a :class:`varpin.Trajectory`. The first motion is held on them by feedback,
            as far as controls can. ``controls`` are then those along the states, by default the inverse dynamics'
            clipped to their limits.

    Returns:
        The best motion found. ``status`` and ``reason`` tell how the search ended; ``warnings`` lists what keeps a
        robot from following the plan.

    Raises:
        InputError: Controls of a wrong shape, or options out of their range.
        NoiseFieldError: A custom noise field fails on the first motion.
        ForceError: A :class:`varpin.CustomForce` fails on the first motion; a later failure rejects a trial.
        StepFailure: The first motion cannot be integrated; the error holds the motion up to there.
        CostError: The cost of the first motion is not finite, or a custom cost fails there.
    """
    require_problem(problem)
    if not real("regularization", regularization) >= 0.0:
        raise InputError(f"regularization must be >= 0, got {regularization}")
    second_order, check = flag("second_order", second_order), flag("check", check)
    told: Any = callback
    with_motion = told_motion("callback", callback, "iteration", "motion")
    told_motion("progress", progress, "iterations done, max_iterations")
    positive("tolerance", tolerance, "1")
    unlimited = real("time_limit", time_limit) == np.inf
    limit = np.inf if unlimited else positive("time_limit", time_limit, "s")
    deadline, most = time.perf_counter() + limit, count("max_iterations", max_iterations)
    if resume is not None:
        for name, given in (("controls", controls), ("states", states), ("true_cost", true_cost)):
            if given is not None:
                raise InputError(f"resume goes on with the solution's own search: leave out either {name} or resume")
        if not isinstance(resume, Solution):
            raise InputError(f"resume must be a Solution, got {type(resume).__name__}")
    path = None if states is None else _path_of(problem, states)
    if check:
        # The search may take long where values are in wrong units.
        announce(logger, problem.scene.announced, problem.dt, foreseen(problem))

    def plan_of(
        problem: OptimalControlProblem, controls: JointValues | LinearPolicy | Solution | None, tolerance: float
    ) -> Solution:
        search = Search(problem, second_order=second_order, regularization=regularization)
        interrupted, last = False, most
        if resume is not None:
            search.resume(resume)
        elif controls is not None:
            search.begin(first_commands(problem, controls))
        else:
            commands, interrupted = _led_to(problem, tolerance, most, deadline)
            search.begin(commands)
            last = 0 if interrupted else most
        known = len(search.history)

        def report(item: Iteration, motion: Trajectory) -> None:
            if told is not None:
                told(*((item, motion) if with_motion else (item,)))
            if progress is not None:
                # A converged search reports once more after its last iteration.
                progress(min(item.index + 1 - known, most), most)

        plan = searched(search, tolerance, last, deadline, report)
        if interrupted:
            return replace(plan, status=Status.INTERRUPTED, reason="under dry friction that is wider than the scene's")
        if plan.status is Status.INFEASIBLE and controls is not None:
            advice = "; the default start, without controls= and states=, may have a plan"
            return replace(plan, reason=plan.reason + advice)
        return plan

    with one_thread():
        if path is not None:
            controls = _policy_along(problem, path, controls)
        if true_cost is None:
            solution = plan_of(problem, controls, tolerance)
        else:
            wish = positive("true_cost", true_cost, "1")

            def once(finer: OptimalControlProblem, start: Trajectory | None) -> Solution:
                given = controls
                if start is not None:
                    given = _policy_along(finer, (start.q, start.v), finer.decided(start))
                return plan_of(finer, given, max(tolerance, NOTABLE * wish))

            solution = refine(problem, once, wish, lambda: deadline - time.perf_counter())
    return looked_at(solution) if check else solution


def searched(search: Search, tolerance: float, most: int, deadline: float, report: Report) -> Solution:
    """What a search finds in at most so many iterations; Ctrl-C ends it with the best motion so far."""
    try:
        status = search.run(tolerance, most, deadline, report)
    except KeyboardInterrupt:
        status, search.reason = Status.INTERRUPTED, f"in iteration {len(search.history)}"
    return search.solution(status)


def _led_to(problem: OptimalControlProblem, tolerance: float, most: int, deadline: float) -> tuple[Commands, bool]:
    """The commands of the default first motion, and whether Ctrl-C has ended what leads to it.

    Where dry friction turns within a small part of a step's change of the velocity, its slope at rest tells little of
    it, and a search from rest goes astray. So the problem is first solved with friction wide enough for its step, and
    each plan's states lead to the next one with sharper friction.
    """
    commands, interrupted = first_commands(problem, None), False
    gentler = _gentler(problem)
    for easier, harder in pairwise([*gentler, problem] if gentler else []):
        try:
            search = Search(easier)
            search.begin(commands)
            plan = searched(search, max(tolerance, SLIGHT), most, deadline, lambda *_: None)
            commands = first_commands(harder, _policy_along(harder, (plan.trajectory.q, plan.trajectory.v), None))
        except VarpinError as error:
            logger.info("%s: under wider dry friction: %s", problem.scene.robot.name, error)
            continue
        if plan.status is Status.INTERRUPTED:
            most, interrupted = 0, True
    return commands, interrupted


def _gentler(problem: OptimalControlProblem) -> list[OptimalControlProblem]:
    """The problem with ever sharper dry friction, from widths that its steps resolve on."""
    scene = problem.scene
    rubbing = of_kind(scene.elements, "CoulombFriction")
    if not rubbing:
        return []
    slopes = np.zeros(scene.robot.dof)
    for own in rubbing:
        _, width, breakaway, _ = own.values
        slopes[own.coordinate] += breakaway / width
    # The rate is in inverse proportion to the widths.
    rate = float(np.linalg.eigvals(np.linalg.solve(masses(scene, problem.q0[None])[0], np.diag(slopes))).real.max())
    count = math.ceil(math.log(max(problem.dt * rate / STIFF, 1.0), _SHARPENED))

    def widened(factor: float) -> OptimalControlProblem:
        elements = list(scene.elements)
        for k, own in enumerate(elements):
            if own in rubbing:
                level, width, *stribeck = own.values
                elements[k] = own._replace(values=(level, factor * width, *stribeck))
        return problem.changed(scene=scene.changed(elements=tuple(elements)))

    return [widened(_SHARPENED**k) for k in range(count, 0, -1)]


def _path_of(problem: OptimalControlProblem, given: Any) -> _Path:
    """The states that a search starts from, checked."""
    robot, shape = problem.scene.robot, (problem.steps + 1, problem.scene.robot.dof)
    names = robot.joint_names
    if isinstance(given, Trajectory):
        if given.joint_names != names:
            raise InputError(f"states: the motion is of joints {given.joint_names}, the problem of {names}")
        if given.steps == problem.steps and not np.isclose(given.dt, problem.dt, rtol=TRACE):
            raise InputError(
                f"states: the motion has dt = {given.dt:g} s, the problem {problem.dt:g} s: give its q alone"
            )
        given = given.q, given.v
    q, v = given if isinstance(given, tuple) and len(given) == 2 else (given, None)
    positions = finite_array("states", q, shape).copy()
    units = in_degrees(robot, "states: the position", positions)
    announce(logger, problem.scene.announced, problem.dt, units)
    off = np.abs(positions[0] - problem.q0)
    joint = int(off.argmax())
    if off[joint] > FEASIBLE:
        sentence = (
            f"states must begin at the problem's q0: joint {names[joint]!r} is at {positions[0, joint]:.6g} in their "
            f"first row, and at {problem.q0[joint]:.6g} in q0"
        )
        raise InputError("; ".join((sentence, *units)))
    speeds = np.gradient(positions, problem.dt, axis=0) if v is None else finite_array("states: v", v, shape).copy()
    speeds[0] = problem.v0
    return positions, speeds


def _policy_along(problem: OptimalControlProblem, path: _Path, controls: object) -> LinearPolicy:
    """The policy whose motion keeps to states, under ``controls`` or, by default, those of inverse dynamics."""
    if isinstance(controls, Solution | LinearPolicy):
        raise InputError("controls beside states must be (R, m), (m,) or by joint name, without feedback")
    scene, hold, (q, v) = problem.scene, problem.hold, path
    if controls is None:
        at, rate = 0.5 * (q[:-1:hold] + q[hold::hold]), np.diff(q[::hold], axis=0) / problem.period
        # What servos add to the command that their springs need to hold their positions.
        still = at @ scene.holding.T @ scene.actuation.T
        forces = core.inverse_dynamics(scene.core, at, rate, np.diff(v[::hold], axis=0) / problem.period)
        forces -= scene.core.forces(at, rate, still)[0]
        u = as_moved(scene, q[hold::hold], v[hold::hold], forces @ np.linalg.pinv(scene.actuation).T)
    else:
        u = _rows_of(problem, controls)
    u = np.clip(u, *problem.control_limits)
    q, v = q[:-1:hold], v[:-1:hold]
    if problem.integrator.variational:
        v = (scene.core.jets(q, v)[0] @ v[:, :, None])[:, :, 0]
    gains = np.tile(problem.feedback(FASTEST / problem.period), (len(q), 1, 1))
    if not problem.linear:
        return problem.policy_of(u, gains, np.hstack([q, v]))
    if controls is None:
        # Lines through the means of neighbours.
        held, u = u, np.vstack([u[:1], 0.5 * (u[:-1] + u[1:]), u[-1:]])
        u[1:] = with_ends(scene, u[1:], held)
    u = problem.begun(u)
    # A line answers a state half a step later than a held control, so that feedback may do harm.
    tries = [problem.policy_of(u, own, np.hstack([q, v])) for own in (gains, 0.0 * gains)]
    return min(tries, key=lambda policy: _cost_under(problem, policy))


def _cost_under(problem: OptimalControlProblem, policy: LinearPolicy) -> float:
    """The cost of the motion under a policy; infinite where it fails."""
    try:
        return problem.cost_of(problem.simulate(policy))
    except VarpinError:
        return np.inf


def first_commands(problem: OptimalControlProblem, controls: JointValues | LinearPolicy | Solution | None) -> Commands:
    """The commands of the first motion under given controls, within the problem's limits.

    Raises:
        InputError: Controls of a wrong shape, or of another hold or kind than the problem's.
    """
    m, n, variational = problem.scene.controls, problem.scene.robot.dof, problem.integrator.variational
    limits, N = problem.control_limits, problem.decisions - problem.linear
    if isinstance(controls, Solution):
        controls = controls.policy_on("momentum" if variational else "velocity")
    if controls is None:
        controls = problem.holding_policy()
    if not isinstance(controls, LinearPolicy):
        controls = problem.policy_of(_rows_of(problem, controls), np.zeros((N, m, 2 * n)), np.zeros((N, 2 * n)))
    if (hold := controls.hold_at(problem.dt)) != problem.hold:
        raise InputError(f"the policy holds its controls over {hold} steps, the problem {problem.hold}")
    if controls.linear != problem.linear:
        policy, wanted = ("linear", "held") if controls.linear else ("held", "linear")
        raise InputError(f"the policy's controls are {policy}, the problem's {wanted}")
    commands = controls.commands(problem.steps, m, n, variational, problem.dt, problem.integrator.stage_times)
    commands = commands._replace(limits=np.clip(commands.limits, *limits))
    if problem.linear:
        return commands._replace(before=problem.begun(np.clip(commands.before, *limits)))
    if problem.rate is not None and problem.rate.before is not None:
        return commands._replace(before=problem.rate.before[None])
    return commands


def _rows_of(problem: OptimalControlProblem, controls: Any) -> Floats:
    """Given controls as rows (R, m)."""
    R, m = problem.decisions, problem.scene.controls
    if isinstance(controls, Mapping):
        controls = control_values("controls", controls, problem.scene.control_joints, m)
    rows = as_floats("controls", controls)
    return np.broadcast_to(finite_array("controls", rows, (m,) if rows.ndim == 1 else (R, m)), (R, m))
