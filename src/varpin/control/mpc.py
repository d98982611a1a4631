"""Model predictive control: plan, apply the first decision, measure the state, replan."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.control import Kept, OptimalControlProblem, Solution, kept, looked_at, replan, solve
from varpin.control.checks import restlessness
from varpin.control.constraints import BoundRate
from varpin.control.costs import CostError
from varpin.control.history import ITERATIONS, Status
from varpin.control.multipliers import REPORTED
from varpin.control.solution import rest_of
from varpin.errors import InputError, LinearizationError, VarpinError
from varpin.finding import Finding, announce
from varpin.integrators import Integrator
from varpin.integrators.base import Failure
from varpin.mechanics.noise import NoiseFieldError
from varpin.mechanics.scene import Scene, closest_controls, require_scene
from varpin.mechanics.wiener import generator, wiener_increments
from varpin.model.units import joint_unit
from varpin.signals.inputs import in_parts_of_steps, with_ends
from varpin.signals.policy import FirstOrderHold
from varpin.simulation.check import check
from varpin.simulation.choice import usual_integrator
from varpin.simulation.failures import Interrupted, StepFailure
from varpin.simulation.limits import beyond_limits
from varpin.simulation.loop import unstable_loop
from varpin.simulation.progress import Progress
from varpin.simulation.simulate import noise_forgotten, simulate
from varpin.support.checks import JointValues, control_values, count, positive, real, told_motion
from varpin.support.frozen import Frozen
from varpin.support.markup import facts, warning_count
from varpin.support.one_thread import one_thread
from varpin.trajectory import Nodes, Trajectory, chained

logger = logging.getLogger(__name__)

# Share of late or slow ticks without a warning: other programs on the machine cause a few.
_FEW = 0.05
# Violation by the plant, in scales of a constraint (a tenth of its range), from which on no narrower bound is advised:
# it would leave less than half of the range.
_NARROWED = 2.5
# Speeds of plans or motions, as multiples of those that the first plan foresaw, above which a loop is unstable.
_FAR_FASTER = 20.0


@dataclass(frozen=True)
class Plant:
    """A simulated robot under control.

    Attributes:
        scene: Its scene, with the controls of the planned one; masses, friction and noise may differ.
        integrator: Any of varpin's. By default each run takes the one that :func:`varpin.simulate` chooses at the
            plant's step for the start, all joint stops included; ``motion.integrator`` names it.
        substeps: Steps per decision of the controller.
    """

    scene: Scene
    integrator: Integrator | None = None
    substeps: int = 10

    def __post_init__(self) -> None:
        require_scene(self.scene)
        if self.integrator is not None and not isinstance(self.integrator, Integrator):
            raise InputError(f"integrator must be one of varpin's, got {self.integrator!r}")
        count("substeps", self.substeps, least=1)


@dataclass(frozen=True, eq=False)
class MpcRun(Frozen):
    """The result of a controller's run on a plant.

    Attributes:
        motion: The plant's motion, at the plant's steps.
        plans: The plan that acted in each tick (K,).
        seconds: Planning time of each tick (K,) [s]; 0 in the first, whose plan is made before the run.
        iterations: Iterations of S-DDP in each tick (K,); 0 in the first.
        late: Ticks whose plan exceeded the budget (K,); the previous plan acted instead.
        failed: Ticks whose search ended within the budget without a plan (K,); the previous plan acted instead.
        period: Time of a tick [s].
        budget: Time for planning in a tick [s]; infinite without a budget.
        constraints: How well plans and motion satisfied each of the problem's constraints.
        warnings: Warnings about the first plan that do not recur in the plant's motion; about the motion, as in
            :attr:`Trajectory.warnings`, and its velocities from tick to tick; about planning that took longer than the
            period, or than the budget, in more than one tick of twenty, which depends on the machine; about failed
            ticks; about constraints that the motion violated; about ticks without a feasible plan; and about speeds, of
            plans or of the motion, that are many times those of the first plan.
    """

    motion: Trajectory
    plans: tuple[Solution, ...]
    seconds: Floats
    iterations: NDArray[np.int64]
    late: NDArray[np.bool_]
    failed: NDArray[np.bool_]
    period: float
    budget: float
    constraints: tuple[Kept, ...] = ()
    warnings: tuple[Finding, ...] = ()

    @property
    def infeasible(self) -> int:
        """Number of ticks without a plan that satisfies the constraints."""
        return sum(plan.status is Status.INFEASIBLE for plan in self.plans)

    def planned(self, ahead: float | None = None) -> Floats:
        """Planned configurations ``ahead`` seconds later (K + 1, n) [rad or m].

        Row k is from the plan that acts in tick k, ``ahead`` seconds after the beginning of the tick. The last row is
        from the last plan, ``ahead`` seconds after the end of the run.

        Args:
            ahead: Time ahead [s]; the horizon by default. Beyond its horizon a plan stays at its end.

        Raises:
            InputError: ``ahead`` is negative or not finite.
        """
        later = self.plans[0].problem.duration if ahead is None else real("ahead", ahead)
        if not 0.0 <= later < np.inf:
            raise InputError(f"ahead must be >= 0 [s], got {ahead!r}")
        begin = self.plans[0].problem.t0
        rows = []
        for tick, plan in enumerate([*self.plans, self.plans[-1]]):
            motion = plan.trajectory
            since = begin + tick * self.period + later - plan.problem.t0
            rows.append([np.interp(since, motion.t - motion.t[0], column) for column in motion.q.T])
        return np.array(rows)

    @property
    def misses(self) -> int:
        """Number of late plans."""
        return int(self.late.sum())

    @property
    def failures(self) -> int:
        """Number of ticks whose search failed."""
        return int(self.failed.sum())

    def __repr__(self) -> str:
        return f"MpcRun({str(self).splitlines()[0]}{warning_count(self.warnings)})"

    @property
    def _planning(self) -> str:
        """Planning times in words, without the first plan, which is made before the run."""
        if len(self.seconds) < 2:
            return "no time: the first plan was made before the run"
        milliseconds = 1e3 * self.seconds[1:]
        return (
            f"{milliseconds.mean():.2f} ms in the mean, {np.quantile(milliseconds, 0.95):.2f} in 95%, "
            f"{milliseconds.max():.2f} at most, for {self.iterations[1:].mean():.2f} iterations a tick"
        )

    @property
    def _within(self) -> str:
        return "no budget" if self.budget == np.inf else f"{self.misses} later than {1e3 * self.budget:.3g} ms"

    def _repr_html_(self) -> str:
        rows = [
            ("ticks", f"{len(self.plans)} of {1e3 * self.period:.3g} ms"),
            ("planning took", self._planning),
            ("late", self._within),
            *([("failed", self.failures)] if self.failed.any() else []),
            ("plant", self.motion),
            *(("constraint", report) for report in self.constraints),
            *(("warning", sentence) for sentence in self.warnings),
        ]
        return facts(f"Run of a controller of {self.motion.robot}", rows)

    def __str__(self) -> str:
        ticks = f"{len(self.plans)} ticks of {1e3 * self.period:.3g} ms"
        failed = f"; {self.failures} failed" if self.failed.any() else ""
        summary = f"{ticks}: planning took {self._planning}; {self._within}{failed}"
        warned = (f"warning: {sentence}" for sentence in self.warnings)
        return "\n".join([summary, *map(str, self.constraints), *warned])


@dataclass(frozen=True)
class Mpc:
    """A controller that solves an optimal control problem at every decision, from the measured state.

    The search of each tick starts from the last plan, shifted by one decision, with its feedback. References are
    evaluated at the plant's time: the horizon recedes. Costs and limits of changes of the controls start from the last
    applied control.

    Where the problem's controls are linear between nodes, they follow the plan's first line over the tick. The next
    plan's line begins at a control of its own, which reacts to the measured state at once; a
    :class:`ControlRateCost` makes the jump between the two small.

    Constraints hold along every horizon, and moving obstacles are predicted. Each iteration of a tick meets their
    linearization, so a plan satisfies them to the accuracy of few iterations; ``MpcRun.constraints`` has it for every
    tick. A goal (:class:`ReachFrame`) applies to the end of every horizon. The size of a margin is that of the first
    plan. Held controls keep to constraints at the nodes alone after the first plan, linear ones at the middles of
    steps, too.

    Main args:
        problem: The problem. Its horizon, discretization, noise, limits and constraints apply to every tick, its
            initial state and ``t0`` to the first.
        iterations: Greatest number of S-DDP iterations in a tick.

    Other Args:
        tolerance: Tolerance of S-DDP; see :func:`varpin.solve`.
        first_iterations: Greatest number of iterations in the first tick, which has no plan to start from.
        budget: Time for planning in a tick [s]. No iteration begins that would exceed it if it took as long as the
            longest one of the tick. A late plan is discarded, and so is a failure to find one by then: the previous
            plan acts with its feedback, and ``MpcRun.late`` marks the tick; more than one late tick in twenty gives a
            warning. Beyond that plan's horizon the robot is brought to rest where the plan ends, if every joint can be
            driven; else the last decision is repeated. Results then depend on the machine. With an infinite budget they
            do not.
    """

    problem: OptimalControlProblem
    iterations: int = 2
    tolerance: float = 1e-6
    first_iterations: int = ITERATIONS
    budget: float = np.inf

    def __post_init__(self) -> None:
        if not isinstance(self.problem, OptimalControlProblem):
            raise InputError(f"problem must be an OptimalControlProblem, got {type(self.problem).__name__}")
        count("iterations", self.iterations, least=1)
        count("first_iterations", self.first_iterations, least=1)
        positive("tolerance", self.tolerance, "1")
        if self.budget != np.inf:
            positive("budget", self.budget, "s")

    def _repr_html_(self) -> str:
        rows = [
            ("period", f"{1e3 * self.period:.3g} ms"),
            ("iterations", f"{self.iterations} a tick, {self.first_iterations} in the first"),
            ("budget", "any time" if self.budget == np.inf else f"{1e3 * self.budget:.3g} ms"),
        ]
        return facts("Model predictive control", rows, self.problem._repr_html_())

    @property
    def period(self) -> float:
        """Time of a tick: how long a decision is held, or the line between two decisions lasts [s]."""
        return self.problem.dt * self.problem.hold

    def plan(
        self,
        t: float,
        q: JointValues,
        v: JointValues,
        previous: Solution | None = None,
        decisions: int = 1,
        before: JointValues | None = None,
    ) -> Solution:
        """The plan at time ``t`` [s] from configuration ``q`` (n,) and velocity ``v`` (n,).

        With a ``previous`` plan each iteration takes one backward pass, and the gains are those of the last iteration.

        Args:
            t: Present time [s].
            q: (n,) or by joint name [rad or m].
            v: (n,) or by joint name [rad/s or m/s].
            previous: The plan to start from; None in the first tick.
            decisions: Number of decisions since ``previous`` was made.
            before: The last applied control, (m,) or by joint name, where changes of controls have a cost or a limit;
                where controls are linear, the one at which the last line ended. By default the control planned by
                ``previous``, and in the first tick that of the problem.

        Raises:
            InputError: q or v of a wrong shape, or not finite.
            StepFailure, CostError: The initial motion of the search cannot be integrated, or its cost is not finite.
        """
        deadline = np.inf if self.budget == np.inf else time.perf_counter() + self.budget
        if previous is not None and not isinstance(previous, Solution):
            raise InputError(f"previous must be the last plan, a Solution, got {type(previous).__name__}")
        scene, decisions = self.problem.scene, count("decisions", decisions)
        if before is not None:
            before = control_values("before", before, scene.control_joints, scene.controls)
        elif self.problem.remembers and previous is not None:
            before = previous.problem.before
            if decisions > 0:
                # With linear controls the last line has ended at the control of this tick's own node.
                last = decisions if self.problem.linear else decisions - 1
                before = previous.controls[min(last, len(previous.controls) - 1)]
        problem = self.problem.at(q0=q, v0=v, t0=t, before=before)
        if previous is None:
            return self._first_plan(problem)[0]
        # A tick does not check its plan; the run checks the motion that results.
        return replan(
            problem,
            previous,
            min(decisions, problem.decisions - 1),
            tolerance=self.tolerance,
            max_iterations=self.iterations,
            deadline=deadline,
        )

    def _first_plan(self, problem: OptimalControlProblem) -> tuple[Solution, tuple[Finding, ...]]:
        """The first plan of a run and the findings about it."""
        plan = solve(problem, tolerance=self.tolerance, max_iterations=self.first_iterations, check=False)
        return looked_at(plan)

    @one_thread()
    def run(
        self,
        plant: Plant | None = None,
        *,
        duration: float,
        rng: np.random.Generator | int | None = None,
        progress: Progress | None = None,
    ) -> MpcRun:
        """Control a simulated plant from the problem's initial state.

        In each tick the first decision of the plan made from the state at its beginning acts, or, where controls are
        linear between nodes, the line between its first two. The first plan is made before the run. Where a search
        finds no plan, the one before acts on with its feedback, up to its end, and a warning says so.

        Main args:
            plant: None for the problem's own scene, integrated more finely.
            duration: Time of the run [s], rounded to whole ticks, at least one; a warning reports rounding.
            rng: Generator or seed of the plant's noise. Without it the plant has none, and a noisy scene gives a
                warning.

        Other Args:
            progress: Called with (ticks done, ticks in all). A function of three arguments, such as a
                :class:`varpin.LiveView`, is also given the plant's motion in the last tick, a :class:`varpin.Nodes`.

        Raises:
            InputError: A plant with other controls or joints.
            StepFailure: The plant's motion cannot be integrated. Or no search has found a plan for the whole horizon of
                the last one: first motions cannot be integrated, plans not be linearized, or their models have no
                minimum. Its cause is the last search's error, if that raised one. It holds the plant's motion so far.
            CostError: A custom cost fails; from the second tick on it holds the plant's motion so far.
            Interrupted: Ctrl-C; holds the plant's motion so far. In the first plan, a plain KeyboardInterrupt.
        """
        problem = self.problem
        report: Any = progress
        moving = told_motion("progress", progress, "ticks done, ticks in all", "nodes")
        plant = Plant(problem.scene) if plant is None else plant
        if not isinstance(plant, Plant):
            raise InputError(f"plant must be a varpin.Plant, for example varpin.Plant(scene), got {plant!r}")
        _require_fit(plant, problem)
        ticks = max(1, round(positive("duration", duration, "s") / self.period))
        dt = self.period / plant.substeps
        drawn_by = None if rng is None else generator(rng)
        q, v = problem.q0, problem.v0
        before = applied = problem.before
        (active, of_plan), age = self._first_plan(problem), 0
        if active.status is Status.INTERRUPTED or any(finding.kind == "interrupted" for finding in of_plan):
            raise KeyboardInterrupt
        noisy = drawn_by is not None and plant.scene.processes > 0
        method = _method(plant, active.trajectory, dt, noisy=noisy)
        parts: list[Trajectory] = []
        plans, seconds, iterations = [], np.zeros(ticks), np.zeros(ticks, dtype=np.int64)
        late, failed, reasons = np.zeros(ticks, bool), np.zeros(ticks, bool), list[str]()
        decided = 1  # ticks whose plan is known

        def so_far(*last: Trajectory) -> Trajectory:
            planned = failed[:decided]
            return _so_far(plant, [*parts, *last], _failed(planned, reasons, self.period))

        try:
            for tick in range(ticks):
                if tick > 0:
                    begin = time.perf_counter()
                    fresh: Solution | None = None
                    failure: VarpinError | None = None
                    try:
                        fresh = self.plan(problem.t0 + tick * self.period, q, v, active, age + 1, before)
                    except (StepFailure, LinearizationError, NoiseFieldError) as error:
                        failure = error
                    except CostError as error:
                        raise CostError(error.cost, error.problem, so_far()) from error
                    if fresh is not None and fresh.status is Status.INTERRUPTED:
                        # A search keeps its best plan and returns; the run is what Ctrl-C is to end.
                        raise KeyboardInterrupt
                    seconds[tick] = time.perf_counter() - begin
                    iterations[tick] = 0 if fresh is None else fresh.iterations
                    # A late plan does not act, whether or not there is one.
                    late[tick] = seconds[tick] > self.budget
                    failed[tick] = not late[tick] and (fresh is None or _is_blank(fresh))
                    decided = tick + 1
                    if failed[tick]:
                        reasons.append(_why(failure) if fresh is None else fresh.reason)
                        if age + 1 >= len(active.gains) - problem.linear:
                            raise _unplanned(reasons[-1], failure, so_far()) from failure
                    active, age = (active, age + 1) if fresh is None or late[tick] or failed[tick] else (fresh, 0)
                plans.append(active)
                begun = None
                if problem.linear:
                    # A fresh plan begins at the measured state; one that acts on, where the line before ended.
                    begun = active.controls[0] if age == 0 or applied is None else applied
                applied = _decision(active, age, q, v, before if begun is None else begun)
                parts.append(_simulated(plant, method, dt, q, v, applied, drawn_by, begun, so_far))
                q, v = parts[-1].q[-1], parts[-1].v[-1]
                before = applied if problem.remembers else None
                if moving:
                    report(tick + 1, ticks, Nodes(tick * self.period + parts[-1].t, parts[-1].q, parts[-1].v))
                elif report is not None:
                    report(tick + 1, ticks)
        except KeyboardInterrupt:
            if not parts:
                raise
            raise Interrupted(so_far()) from None
        # The controller corrects the errors of a tick in the next.
        motion = check(plant.scene, method, chained(parts), restart=plant.substeps)
        found = (
            *noise_forgotten(plant.scene, rng),
            *unstable_loop(plant.scene, motion, plant.substeps),
            *motion.warnings,
        )
        found = (*found, *_restless(motion, plant.substeps))
        found = (*found, *_behind(seconds, self.period), *_late(late, self.budget))
        found = (*found, *_failed(failed, reasons, self.period))
        found = (*found, *_whole_ticks(duration, ticks, self.period), *_at_nodes_alone(problem))
        held = kept(problem, tuple(plans), motion, plant.substeps)
        found = (*found, *_outside(held, noisy=bool(motion.dw.any())), *_blown_up(plans, motion))
        announce(logger, plant.scene.announced, dt, found)
        again = {(finding.kind, finding.joint) for finding in found}
        first = [finding for finding in of_plan if (finding.kind, finding.joint) not in again]
        return MpcRun(
            motion,
            tuple(plans),
            seconds,
            iterations,
            late,
            failed,
            self.period,
            self.budget,
            constraints=held,
            warnings=(
                *(finding.about("the first plan: ") for finding in first),
                *(finding for finding in found),
            ),
        )


def _require_fit(plant: Plant, problem: OptimalControlProblem) -> None:
    """Raise an InputError unless the plant has the joints, servos and inputs of the problem."""
    joints, controls = plant.scene.robot.joint_names, plant.scene.controls
    if joints != problem.scene.robot.joint_names or controls != problem.scene.controls:
        raise InputError(
            f"the plant has joints {', '.join(joints)} and {controls} controls; the problem "
            f"{', '.join(problem.scene.robot.joint_names)} and {problem.scene.controls}"
        )
    if plant.scene.servo_joints != problem.scene.servo_joints:
        raise InputError(
            f"the plant has servos on {', '.join(plant.scene.servo_joints) or 'no joints'}; the problem on "
            f"{', '.join(problem.scene.servo_joints) or 'no joints'}"
        )
    for kind in ("linear", "cubic"):
        inputs = [_inputs(scene, cubic=kind == "cubic") for scene in (plant.scene, problem.scene)]
        if inputs[0] != inputs[1]:
            names_of = (", ".join(names) or "no joints" for names in inputs)
            raise InputError(
                f"the plant has {kind} KinematicInputs on {next(names_of)}; the problem on {next(names_of)}"
            )


def _outside(held: Sequence[Kept], *, noisy: bool) -> tuple[Finding, ...]:
    """Findings about constraints that the plant's motion violated, and about ticks without a feasible plan."""
    found = []
    for row in held:
        if row.infeasible.any():
            tick = int(np.argmax(np.where(row.infeasible, row.planned, 0.0)))
            found.append(
                Finding(
                    "infeasible ticks",
                    f"in {int(row.infeasible.sum())} of {len(row.planned)} ticks no plan was found that keeps to "
                    f"{row.label}; in tick {tick} it is violated by {row.planned[tick]:.2g} {row.unit}. These plans "
                    "act nevertheless: a longer horizon, wider limits or more iterations may help",
                )
            )
        if row.worst > row.tolerance:
            when = row.t[int(np.argmax(row.moved))]
            advice = ["a smaller dt", "more iterations", "a longer horizon"]
            if noisy:
                advice.insert(0, "a margin=")
            if row.worst < _NARROWED * row.tolerance / REPORTED:
                advice.insert(0, "a bound narrower by as much")
            found.append(
                Finding(
                    "motion outside constraints",
                    f"the plant's motion violates {row.label} by {row.worst:.2g} {row.unit} at t = {when:.4g} s: "
                    f"{', '.join(advice[:-1])} or {advice[-1]} may keep it inside",
                )
            )
    return tuple(found)


def _at_nodes_alone(problem: OptimalControlProblem) -> tuple[Finding, ...]:
    """A finding if the problem asks for constraints between nodes, which ticks with held controls leave out."""
    if not problem.between_nodes or problem.linear:
        return ()
    sentence = (
        "after the first plan, constraints hold at the nodes alone, although the problem has between_nodes=True: a "
        'smaller dt, or controls="linear", which keeps to them at the middles of steps, too, leaves less between nodes'
    )
    return (Finding("nodes alone", sentence),)


def _whole_ticks(duration: float, ticks: int, period: float) -> tuple[Finding, ...]:
    """A finding if the duration of a run was rounded to whole ticks."""
    if abs(ticks * period - duration) <= 1e-9 * duration:
        return ()
    sentence = (
        f"duration = {duration:g} s is no whole number of ticks of {period:g} s: the run has {ticks}, "
        f"{ticks * period:g} s"
    )
    return (Finding("rounded duration", sentence),)


def _so_far(plant: Plant, parts: Sequence[Trajectory], found: tuple[Finding, ...]) -> Trajectory:
    """The plant's motion so far, with its warnings and those of ``found``."""
    motion = chained(parts)
    return motion.changed(warnings=(*beyond_limits(plant.scene, motion), *found))


def _behind(seconds: Floats, period: float) -> tuple[Finding, ...]:
    """A finding if planning took longer than the period in more than a few ticks."""
    planned = seconds[1:]
    slow = int((planned > period).sum())
    if not slow > _FEW * len(planned):
        return ()
    sentence = (
        f"planning took longer than the period of {1e3 * period:.3g} ms in {slow} of {len(planned)} ticks "
        f"({1e3 * planned.mean():.3g} ms in the mean). Use fewer steps, fewer iterations or a longer period (hold=)"
    )
    return (Finding("slow planning", sentence),)


def _late(late: NDArray[np.bool_], budget: float) -> tuple[Finding, ...]:
    """A finding if more than a few plans exceeded their budget."""
    planned, missed = len(late) - 1, int(late[1:].sum())
    if not missed > _FEW * planned:
        return ()
    sentence = (
        f"{missed} of {planned} plans came later than the budget of {1e3 * budget:.3g} ms: the feedback of an older "
        "one acted. Use fewer steps, fewer iterations or a larger budget"
    )
    return (Finding("late plans", sentence),)


def _failed(failed: NDArray[np.bool_], reasons: Sequence[str], period: float) -> tuple[Finding, ...]:
    """A finding if the searches of ticks failed, for these reasons."""
    if not failed.any():
        return ()
    tick = int(np.argmax(failed))
    sentence = (
        f"in {int(failed.sum())} of {len(failed) - 1} ticks no plan was found, and the feedback of an older one acted "
        f"in its place, at t = {tick * period:.4g} s for the first time: {reasons[0]}"
    )
    return (Finding("failed ticks", sentence),)


def _restless(motion: Trajectory, substeps: int) -> tuple[Finding, ...]:
    """A finding if a velocity of the plant goes up and down from tick to tick."""
    found = None if motion.dw.any() else restlessness(motion.v[::substeps])
    if found is None:
        return ()
    joint, changes = found
    sentence = (
        f"under the controller the velocity of {motion.joint_names[joint]} goes up and down {changes} times in "
        f"{motion.steps // substeps} ticks: a smaller dt, or a greater weight on the controls, calms it"
    )
    return (Finding("restless ticks", sentence),)


def _blown_up(plans: Sequence[Solution], motion: Trajectory) -> tuple[Finding, ...]:
    """A finding if plans or motion are far faster than the first plan, whose search has converged.

    A first plan that is nearly at rest tells nothing: a tenth of the joint's velocity limit, or, without one, of a full
    turn in a horizon, counts as foreseen, too.
    """
    robot, first = plans[0].problem.scene.robot, plans[0]
    usual = np.where(np.isfinite(robot.velocity_limit), robot.velocity_limit, 2.0 * np.pi / first.problem.duration)
    fastest = float(np.abs(first.trajectory.v).max())
    foreseen = np.maximum(fastest, 0.1 * usual)
    planned = np.array([np.abs(plan.trajectory.v).max(axis=0) for plan in plans])
    moved = np.abs(motion.v).max(axis=0)
    share = np.maximum(planned.max(axis=0), moved) / foreseen
    joint = int(np.argmax(share))
    if not share[joint] > _FAR_FASTER:
        return ()
    plan, unit = plans[int(np.argmax(planned[:, joint]))], joint_unit(robot, joint, speed=True)
    sentence = (
        f"the loop is unstable: {robot.joint_names[joint]} moves at up to {moved[joint]:.3g} {unit}, in the plan of "
        f"t = {plan.problem.t0:.4g} s at up to {planned[:, joint].max():.3g}, and no joint at more than "
        f"{fastest:.3g} in the first plan. Use more iterations a tick, or greater weights"
    )
    return (Finding("unstable loop", sentence, robot.joint_names[joint]),)


def _decision(plan: Solution, age: int, q: Floats, v: Floats, before: Floats | None = None) -> Floats:
    """Control (m,) of the plan's decision ``age`` with feedback at the state (q, v), after the control ``before``.

    Where controls are linear between nodes it is the control at the end of the tick, and ``before`` that at its begin.
    """
    policy, last, x = plan.policy_on("velocity"), len(plan.gains) - 1, np.concatenate([q, v])
    beyond = age >= last if plan.problem.linear else age > last
    rest = _at_rest(plan, q, v) if beyond else None
    if rest is not None:
        u = rest
    elif plan.problem.linear:
        u = rest_of(plan, policy, min(age, last)).control(0, x, before)
    elif beyond and before is not None and policy.previous is not None:
        # The last decision is repeated, with itself as the previous control.
        u = policy.control(last, x, before - policy.u[last] + policy.previous[last])
    else:
        u = policy.control(min(age, last), x, before)
    return u if before is None else _within_rates(plan, u, before)


def _at_rest(plan: Solution, q: Floats, v: Floats) -> Floats | None:
    """Control (m,) that brings the robot to rest where the plan ends; None where not every joint can be driven.

    The plan's own last gains are of one step before its end. Repeated, those of steep terminal costs do not stabilize.
    """
    end = plan.problem.at(q0=plan.trajectory.q[-1], v0=np.zeros_like(v))
    gains = end.holding_feedback("velocity", slower=True)
    if gains is None:
        return None
    away = np.concatenate([q - end.q0, v])
    if end.linear:
        # A line ends a tick later, and the next begins there: without a look ahead springs would be driven.
        away = end.coasting(end.period) @ away
    u = closest_controls(end.scene, end.q0) + gains @ away
    return np.asarray(np.clip(u, *end.control_limits), dtype=np.float64)


def _within_rates(plan: Solution, u: Floats, before: Floats) -> Floats:
    """The control nearest to ``u`` (m,) that limits of control rates allow after the control ``before`` (m,)."""
    for bound in plan.problem.bound_constraints:
        if isinstance(bound, BoundRate):
            most = bound.limit * bound.period
            u = np.clip(u, before - most, before + most)
    return u


def _is_blank(plan: Solution) -> bool:
    """Whether a search found no plan along its motion: the gains are zeros."""
    return bool(np.isnan(plan.gradient).all())


def _why(failure: VarpinError | None) -> str:
    """Why a search has no plan, in words."""
    if isinstance(failure, StepFailure):
        return f"step {failure.step} of the search's first motion fails: {failure.reason}"
    return str(failure)


def _unplanned(reason: str, failure: VarpinError | None, motion: Trajectory) -> StepFailure:
    """The failure of a run that has no plan left; it holds the plant's motion so far."""
    residual = failure.residual if isinstance(failure, StepFailure) else np.nan
    told = f"no plan can be made from here, and the last plan is at its end; {reason}"
    cause = "Use a longer horizon, or more iterations a tick"
    return StepFailure(motion.steps, motion.t[-1], Failure(told, residual), motion, cause)


def _method(plant: Plant, plan: Trajectory, dt: float, *, noisy: bool) -> Integrator:
    """The plant's integrator for steps of ``dt`` [s] along the first plan."""
    if plant.integrator is not None:
        return plant.integrator
    scene = plant.scene
    return usual_integrator(scene, plan.q[0], plan.v[0], dt, noisy=noisy)


def _inputs(scene: Scene, *, cubic: bool) -> tuple[str, ...]:
    """Names of the joints with linear, or with cubic, kinematic inputs."""
    inputs = zip(scene.inputs.values(), scene.rates, strict=True)
    return tuple(scene.robot.joint_names[c] for c, rate in inputs if (rate >= 0) == cubic)


def _simulated(
    plant: Plant,
    method: Integrator,
    dt: float,
    q: Floats,
    v: Floats,
    u: Floats,
    rng: np.random.Generator | None,
    begun: Floats | None,
    joined: Callable[[Trajectory], Trajectory],
) -> Trajectory:
    """The plant's motion in one tick.

    A StepFailure holds the whole motion, which ``joined`` makes from that of this tick.

    Controls are linear in time from ``begun`` to ``u``, or hold ``u`` where ``begun`` is None.
    """
    controls: Floats | FirstOrderHold
    if begun is None:
        # Joints with kinematic inputs move on one line or cubic to their next positions over the tick.
        controls = in_parts_of_steps(plant.scene, u[None], q[None], v[None], dt * plant.substeps, plant.substeps)
    else:
        line = FirstOrderHold(np.vstack([begun, u])).refined(plant.substeps).u
        moved = in_parts_of_steps(plant.scene, u[None], q[None], v[None], dt * plant.substeps, plant.substeps)
        controls = FirstOrderHold(np.vstack([line[:1], with_ends(plant.scene, line[1:], moved)]))
    options: dict[str, Any] = {"dt": dt, "steps": plant.substeps, "controls": controls, "integrator": method}
    # Plants of many steps a tick hardly see the slopes of controls within a step: their noise is of the mean control.
    drawn = wiener_increments(plant.scene.processes, dt, plant.substeps, rng)
    options |= {"increments": drawn if len(drawn) else 0.0}
    try:
        # The whole run is checked, and its findings logged, at the end.
        return simulate(plant.scene, q, v, **options, check=False)
    except StepFailure as failure:
        whole = joined(failure.trajectory)
        raise StepFailure(whole.steps, whole.t[-1], Failure(failure.reason, failure.residual), whole) from None
