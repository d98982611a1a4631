"""Model predictive control: plan, apply the first decision, measure the state, replan."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.control import OptimalControlProblem, Solution, solve
from varpin.control.between_nodes import enforced, middles
from varpin.control.constraints import BoundRate
from varpin.control.costs import CostError
from varpin.control.history import Status
from varpin.control.multipliers import ConstraintReport, Multipliers, at_nodes, flat
from varpin.control.problem import require_problem
from varpin.control.search import Search
from varpin.control.sizes import NOTABLE, TENTH
from varpin.control.solving import first_commands, searched
from varpin.control.verification import report_of
from varpin.errors import ControlError, InputError, LinearizationError
from varpin.finding import Finding, announce
from varpin.integrators import Integrator
from varpin.mechanics.noise import NoiseFieldError
from varpin.mechanics.scene import Scene, require_scene
from varpin.mechanics.wiener import generator
from varpin.signals.commands import in_parts_of_steps, on_lines, with_ends
from varpin.simulation.check import Case, check
from varpin.simulation.choice import given_integrator, usual_integrator
from varpin.simulation.failures import Interrupted, StepFailure
from varpin.simulation.limits import beyond_limits
from varpin.simulation.loop import Gains, unstable_loop
from varpin.simulation.record import Progress
from varpin.simulation.simulate import noise_forgotten, simulate
from varpin.support.checks import JointValues, control_values, count, positive, real, told_motion
from varpin.support.frozen import Frozen
from varpin.support.markup import Printed, facts, warning_count, warning_lines
from varpin.support.one_thread import one_thread
from varpin.trajectory import Nodes, Trajectory

logger = logging.getLogger(__name__)

# Share of late ticks without a warning: other programs on the machine cause a few; from 0.02 to 0.2.
_FEW = 0.05


@dataclass(frozen=True)
class Plant:
    """A simulated robot under control.

    Attributes:
        scene: Its scene, with the controls of the planned one; masses, friction and noise may differ.
        integrator: Any of varpin's. By default each run takes the one that :func:`varpin.simulate` chooses at the
            plant's step for the start, all joint stops included; ``motion.integrator`` names it.
        substeps: Steps per decision of the controller; each holds the mean of a line of linear controls.
    """

    scene: Scene
    integrator: Integrator | None = None
    substeps: int = 10

    def __post_init__(self) -> None:
        require_scene(self.scene)
        given_integrator(self.integrator)
        count("substeps", self.substeps, least=1)


@dataclass(frozen=True, eq=False)
class MpcRun(Printed, Frozen):
    """The result of a controller's run on a plant.

    Attributes:
        motion: The plant's motion, at the plant's steps.
        plans: The plan that acted in each tick (K,).
        seconds: Planning time of each tick (K,) [s]; 0 in the first, whose plan is made before the run.
        iterations: Iterations of the search in each tick (K,); 0 in the first.
        late: Ticks whose plan exceeded the budget (K,); the previous plan acted instead.
        failed: Ticks whose search ended within the budget without a plan (K,); the previous plan acted instead.
        period: Time of a tick [s].
        budget: Time for planning in a tick [s]; infinite without a budget.
        constraints: How well the plant's motion satisfied each of the problem's constraints at its nodes, without
            margins; goals, which apply to the end of each plan, are left out.
        warnings: Warnings about the first plan that do not recur in the plant's motion; about the motion, as in
            :attr:`Trajectory.warnings`; about planning that took longer than the budget or the period in more than one
            tick of twenty; about failed ticks; and about constraints that plans or the motion violated.
    """

    motion: Trajectory
    plans: tuple[Solution, ...]
    seconds: Floats
    iterations: NDArray[np.int64]
    late: NDArray[np.bool_]
    failed: NDArray[np.bool_]
    period: float
    budget: float
    constraints: tuple[ConstraintReport, ...] = ()
    warnings: tuple[Finding, ...] = ()

    @property
    def infeasible(self) -> NDArray[np.bool_]:
        """Ticks whose plan violates a constraint by more than a hundredth of its range (K,)."""
        return np.array([any(_violated(plan)) for plan in self.plans])

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

    def __repr__(self) -> str:
        text, took = f"{len(self.plans)} ticks of {1e3 * self.period:.3g} ms", 1e3 * self.seconds[1:]
        if took.size:
            text += (
                f": planning took {took.mean():.2f} ms in the mean, {np.quantile(took, 0.95):.2f} in 95%, "
                f"{took.max():.2f} at most, for {self.iterations[1:].mean():.2f} iterations a tick"
            )
        if self.budget < np.inf:
            text += f"; {int(self.late.sum())} later than {1e3 * self.budget:.3g} ms"
        text += f"; {int(self.failed.sum())} failed" if self.failed.any() else ""
        return f"MpcRun({text}{warning_count(self.warnings)})"

    def __str__(self) -> str:
        return "\n".join([repr(self), *map(str, self.constraints), *warning_lines(self.warnings)])


@dataclass(frozen=True)
class Mpc:
    """A controller that solves an optimal control problem at every decision, from the measured state.

    The search of each tick starts from the last plan, shifted by one decision, with its feedback. References are
    evaluated at the plant's time: the horizon recedes. Costs and limits of changes of the controls start from the last
    applied control.

    Controls that are linear between nodes follow the plan's first line over the tick. The next plan's line begins at a
    control of its own, which reacts to the measured state at once; a :class:`ControlRateCost` makes the jump small.

    Constraints hold along every horizon to the accuracy of few iterations, which ``Solution.violation`` has: at the
    nodes, and in the middles of steps with ``between_nodes`` or linear controls. A goal (:class:`ReachFrame`) applies
    to the end of every horizon. The size of a margin is that of the first plan.

    The warning ``unstable loop`` is from the plans' feedback. With linear controls there is none for plans that are
    older than a tick, or that have costs or limits of changes of the controls.

    Main args:
        problem: The problem. Its horizon, discretization, noise, limits and constraints apply to every tick, its
            initial state and ``t0`` to the first.
        iterations: Greatest number of iterations in a tick after the first, which is :func:`varpin.solve`'s.

    Other Args:
        tolerance: Tolerance of the search; see :func:`varpin.solve`.
        budget: Time for planning in a tick [s]. No iteration begins that would exceed it if it took as long as the
            longest one of the tick. A late plan is discarded, and so is a failure to find one by then: the previous
            plan acts with its feedback, and ``MpcRun.late`` marks the tick. Results then depend on the machine. With
            an infinite budget they do not.
    """

    problem: OptimalControlProblem
    iterations: int = 2
    tolerance: float = 1e-6
    budget: float = np.inf

    def __post_init__(self) -> None:
        require_problem(self.problem)
        count("iterations", self.iterations, least=1)
        positive("tolerance", self.tolerance, "1")
        if real("budget", self.budget) != np.inf:
            positive("budget", self.budget, "s")

    def _repr_html_(self) -> str:
        rows = [
            ("period", f"{1e3 * self.period:.3g} ms"),
            ("iterations", f"{self.iterations} a tick"),
            ("budget", "any time" if self.budget == np.inf else f"{1e3 * self.budget:.3g} ms"),
        ]
        return facts("Model predictive control", rows, self.problem._repr_html_())

    @property
    def period(self) -> float:
        """Time of a tick: how long a decision is held, or the line between two decisions lasts [s]."""
        return self.problem.period

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
            return solve(problem, tolerance=self.tolerance)
        search = Search(problem, tick=True)
        rest = previous.shifted(min(decisions, problem.decisions - 1), None if problem.rate is None else before)
        search.begin(first_commands(problem, rest))
        if previous.search is not None:
            search.weight = previous.search.weight
        if previous.multipliers is not None and problem.constraints:
            search.take(_margins(problem, previous, previous.multipliers))
        # A tick does not check its plan; the run checks the motion that results.
        return searched(search, self.tolerance, self.iterations, deadline, lambda *_: None)

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
        finds no plan in time, the one before acts on with its feedback, and at its end the last control is held.

        Main args:
            plant: None for the problem's own scene, integrated more finely.
            duration: Time of the run [s], rounded to whole ticks, at least one.
            rng: Generator or seed of the plant's noise. Without it the plant has none, and a noisy scene gives a
                warning.

        Other Args:
            progress: Called with (ticks done, ticks in all). A function of three arguments, such as a
                :class:`varpin.LiveView`, is also given the plant's motion in the last tick, a :class:`varpin.Nodes`.

        Raises:
            InputError: A plant with other controls or joints.
            StepFailure: The plant's motion cannot be integrated; it holds the motion so far.
            CostError: A custom cost fails; from the second tick on it holds the plant's motion so far.
            Interrupted: Ctrl-C; holds the plant's motion so far. In the first plan, a plain KeyboardInterrupt.
        """
        plant = Plant(self.problem.scene) if plant is None else plant
        if not isinstance(plant, Plant):
            raise InputError(f"plant must be a varpin.Plant, for example varpin.Plant(scene), got {plant!r}")
        _require_fit(plant.scene, self.problem.scene)
        ticks = max(1, round(positive("duration", duration, "s") / self.period))
        drawn = None if rng is None else generator(rng)
        loop = _Loop(self, plant, ticks, progress)
        scene, start, dt = plant.scene, (self.problem.q0, self.problem.v0), self.period / plant.substeps
        noisy = drawn is not None and scene.processes > 0
        method = plant.integrator or usual_integrator(scene, *start, dt, noisy=noisy)
        noise: dict[str, Any] = {"rng": drawn} if noisy else {"increments": 0.0}
        try:
            # The run is checked, and its findings logged, at the end.
            steps = ticks * plant.substeps
            motion = simulate(scene, *start, dt=dt, steps=steps, controls=loop, integrator=method, check=False, **noise)
        except ControlError as error:
            cause = error.__cause__
            if isinstance(cause, CostError):
                raise CostError(cause.cost, cause.problem, loop.told(error.trajectory)) from cause
            raise cause or error from None
        except StepFailure as error:
            rings = Case(scene, method, error.trajectory, restart=plant.substeps).rings
            raise error.along(loop.told(error.trajectory), rings or "Use more Plant(substeps=)") from None
        except Interrupted as error:
            error.trajectory = loop.told(error.trajectory)
            raise
        loop.report(motion.t[-1], motion.q[-1], motion.v[-1])
        # The controller corrects the errors of a tick in the next.
        motion = check(Case(scene, method, motion.changed(warnings=()), restart=plant.substeps))
        constraints, violated = loop.constraints(motion)
        found = (
            *noise_forgotten(scene, rng),
            *loop.unstable(motion),
            *motion.warnings,
            *loop.without_plans(),
            *violated,
        )
        announce(logger, scene.announced, dt, found)
        again = {(finding.kind, finding.joint) for finding in found}
        first = (finding for finding in loop.ticks[0].plan.warnings if (finding.kind, finding.joint) not in again)
        plans, _, seconds, iterations, late, failures = zip(*loop.ticks, strict=True)
        return MpcRun(
            motion,
            plans,
            np.array(seconds),
            np.array(iterations, dtype=np.int64),
            np.array(late),
            np.array(failures) != "",
            self.period,
            self.budget,
            constraints=constraints,
            warnings=(*(finding.about("the first plan: ") for finding in first), *found),
        )


class _Tick(NamedTuple):
    """The plan that acts in a tick, which decision of it, and how planning went."""

    plan: Solution
    age: int = 0
    seconds: float = 0.0
    iterations: int = 0
    late: bool = False
    failure: str = ""  # why there is no plan in time; empty if there is one, or it is late


class _Loop:
    """A controller as the control law of its plant: at the beginning of each tick a plan, within it a decision."""

    def __init__(self, controller: Mpc, plant: Plant, ticks: int, progress: Progress | None) -> None:
        self.controller, self.problem, self.plant = controller, controller.problem, plant
        self.count, self.progress = ticks, progress
        self.moving = told_motion("progress", progress, "ticks done, ticks in all", "nodes")
        self.ticks = [_Tick(solve(self.problem, tolerance=controller.tolerance))]
        plan = self.ticks[0].plan
        if plan.status is Status.INTERRUPTED or any(told.kind == "interrupted" for told in plan.warnings):
            raise KeyboardInterrupt
        self.applied = self.problem.before
        self.nodes: list[tuple[float, Floats, Floats]] = []  # of the tick so far
        self.rows = np.zeros((0, plant.scene.controls))  # controls of its steps

    def __call__(self, t: float, q: Floats, v: Floats) -> Floats:
        """The control (m,) of the plant's next step, at time ``t`` since the beginning of the run [s]."""
        if len(self.nodes) == self.plant.substeps:
            self.report(t, q, v)
            self.replan(t, q, v)
        if not self.nodes:
            self.decide(q, v)
        self.nodes.append((t, q, v))
        return np.asarray(self.rows[len(self.nodes) - 1])

    def report(self, t: float, q: Floats, v: Floats) -> None:
        """Tell of a tick that has ended at time ``t`` [s]."""
        told: Any = self.progress
        nodes, self.nodes = Nodes(*map(np.array, zip(*self.nodes, (t, q, v), strict=True))), []
        if told is not None:
            told(len(self.ticks), self.count, *([nodes] if self.moving else []))

    def replan(self, t: float, q: Floats, v: Floats) -> None:
        """Plan from the present state; where there is no plan in time, the one before acts on."""
        begin, fresh, failure, last = time.perf_counter(), None, "", self.ticks[-1]
        before = self.applied if self.problem.remembers else None
        try:
            fresh = self.controller.plan(self.problem.t0 + t, q, v, last.plan, last.age + 1, before)
        except (StepFailure, LinearizationError, NoiseFieldError) as error:
            failure = str(error)
        if fresh is not None and fresh.status is Status.INTERRUPTED:
            # A search keeps its best plan and returns; the run is what Ctrl-C is to end.
            raise KeyboardInterrupt
        seconds, iterations = time.perf_counter() - begin, 0 if fresh is None else fresh.iterations
        if fresh is not None and np.isnan(fresh.gradient).all():
            # Without gains a search has found no plan.
            failure, fresh = fresh.reason, None
        late = seconds > self.controller.budget
        plan, age = (last.plan, last.age + 1) if late or fresh is None else (fresh, 0)
        self.ticks.append(_Tick(plan, age, seconds, iterations, late, "" if late else failure))

    def decide(self, q: Floats, v: Floats) -> None:
        """Make the controls of a tick: the decision of the plan that acts, or the line to it, at means of the steps.

        Where controls are linear between nodes it is the control at the end of the tick.
        """
        (plan, age, *_), scene, before, substeps = self.ticks[-1], self.plant.scene, self.applied, self.plant.substeps
        if self.problem.linear and age == 0:
            # A fresh plan begins at the measured state; one that acts on, where the line before ended.
            before = plan.controls[0]
        ended = age >= _lines(plan)
        policy = plan.shifted(plan.problem.decisions - 1, x="velocity") if ended else plan.policy_on("velocity")
        row = 0 if ended else age
        self.applied = policy.control(row, np.concatenate([q, v]), before)
        for bound in plan.problem.bound_constraints:
            if isinstance(bound, BoundRate) and before is not None:
                most = bound.limit * bound.period
                self.applied = np.clip(self.applied, before - most, before + most)
        # Joints with kinematic inputs move on one line or cubic to their next positions over the tick.
        self.rows = in_parts_of_steps(scene, self.applied[None], q[None], v[None], self.controller.period, substeps)
        if self.problem.linear and before is not None:
            begin, end = (np.tile(u, (substeps, 1)) for u in (before, self.applied))
            self.rows = with_ends(scene, on_lines(begin, end, substeps, (0.5,))[:, 0], self.rows)

    def told(self, motion: Trajectory) -> Trajectory:
        """The plant's motion up to where it ended early, with its warnings and those of ticks without a plan."""
        limits = beyond_limits(self.plant.scene, motion)
        return motion.changed(warnings=(*self.unstable(motion), *limits, *self.without_plans()))

    def unstable(self, motion: Trajectory) -> tuple[Finding, ...]:
        """The warning of a loop that is unstable at its period, under the feedback of each tick."""
        rows, reference = map(np.array, zip(*map(_feedback, self.ticks), strict=True))
        planned = self.problem.scene if self.problem.integrator.variational else None
        return unstable_loop(self.plant.scene, motion, self.plant.substeps, Gains(rows, planned, reference))

    def without_plans(self) -> Iterator[Finding]:
        """Warnings if more than a few plans took longer than the budget or the period, or searches found no plan."""
        ticks, period = self.ticks[1:], self.controller.period
        seconds, limit = np.array([tick.seconds for tick in ticks]), min(period, self.controller.budget)
        slow, failed = int((seconds > limit).sum()), [tick.failure for tick in ticks if tick.failure]
        if slow > _FEW * len(ticks):
            text = (
                f"planning took longer than {1e3 * limit:.3g} ms in {slow} of {len(ticks)} ticks "
                f"({1e3 * seconds.mean():.3g} ms in the mean). Use fewer steps, fewer iterations or a longer "
                "period (hold=)"
            )
            yield Finding("late plans", text)
        if failed:
            first = [bool(tick.failure) for tick in self.ticks].index(True) * period
            text = (
                f"in {len(failed)} of {len(ticks)} ticks no plan was found and an older one acted, at t = {first:.4g} "
                f"s for the first time: {failed[0]}"
            )
            yield Finding("failed ticks", text)
        ended = [tick.age >= _lines(tick.plan) for tick in self.ticks]
        if any(ended):
            text = (
                f"no plan came for a whole horizon, and from t = {ended.index(True) * period:.4g} s on the last "
                "control was held: use a longer horizon, a larger budget, or more iterations a tick"
            )
            yield Finding("plan at its end", text)

    def constraints(self, motion: Trajectory) -> tuple[tuple[ConstraintReport, ...], list[Finding]]:
        """How well the plant's motion satisfied each constraint, and warnings about it and about plans."""
        problem, reports, found = self.problem, [], []
        # A plant's motion has the means of lines over its steps.
        hold = 1 if problem.linear else self.plant.substeps
        plans = [tick.plan for tick in self.ticks]
        violated = np.array([_violated(plan) for plan in plans])
        for i, bound in enumerate(problem.constraints_on(motion.dt, motion.steps, hold, linear=False)):
            label = problem.label_of(bound.source)
            if violated[:, i].any():
                planned = [plan.constraints[i].violation for plan in plans]
                tick = int(np.argmax(planned))
                text = (
                    f"in {int(violated[:, i].sum())} of {len(planned)} ticks no plan was found that keeps to {label}; "
                    f"in tick {tick} it is violated by {planned[tick]:.2g} {bound.unit}. Use a longer horizon, wider "
                    "limits or more iterations"
                )
                found.append(Finding("infeasible ticks", text))
            if bound.source.equality:
                continue
            reports.append(report_of(problem, bound, bound.value(motion.q, motion.v, motion.u)))
            if (worst := reports[-1].violation) > NOTABLE * bound.scale:
                text = (
                    f"the plant's motion violates {label} by {worst:.2g} {bound.unit}, {reports[-1].where}. Use a "
                    "narrower bound, margin= against noise, a smaller dt or more iterations"
                )
                found.append(Finding("motion outside constraints", text, value=worst, unit=bound.unit))
        return tuple(reports), found


def _violated(plan: Solution) -> list[bool]:
    """Whether a plan violates each of its constraints by more than what few iterations may leave."""
    bounds = plan.problem.bound_constraints
    return [told.violation > TENTH * bound.scale for told, bound in zip(plan.constraints, bounds, strict=True)]


def _require_fit(plant: Scene, planned: Scene) -> None:
    """Raise an InputError unless the plant has the joints, controls, servos and inputs of the problem."""
    for what, of in (
        ("joints", lambda scene: scene.robot.joint_names),
        ("controls", lambda scene: scene.controls),
        ("servos", lambda scene: scene.servo_joints),
        ("kinematic inputs", lambda scene: (tuple(scene.inputs.values()), tuple(rate >= 0 for rate in scene.rates))),
    ):
        if of(plant) != of(planned):
            raise InputError(f"the plant has other {what} than the problem: {of(plant)}, not {of(planned)}")


def _lines(plan: Solution) -> int:
    """How many ticks a plan lasts."""
    return plan.problem.decisions - plan.problem.linear


def _feedback(tick: _Tick) -> tuple[Floats, Floats]:
    """The gains of a tick, (m, 2n) or (m, 2n + m), and the configuration (n,) that they are about.

    Those of a line are of its mean, to whose two ends a fresh plan reacts. Lines of older plans, and those that
    remember the control before, count as none.
    """
    plan, age, *_ = tick
    policy, row = plan.policy, min(age, _lines(plan) - 1)
    gains, begin = policy.feedback[row], plan.gains[0]
    if policy.linear:
        end, kept = np.split(policy.feedback[0], [begin.shape[1]], axis=1)
        gains = 0.5 * (age == 0 and not plan.problem.remembers) * (begin + end + kept @ begin)
    return gains, policy.reference[row, : plan.problem.scene.robot.dof]


def _margins(problem: OptimalControlProblem, previous: Solution, known: Multipliers) -> Multipliers:
    """The rows of a tick, with the margins of the plan before: at its places, of which the last is repeated."""
    instants, backoff = middles(problem), []
    of_nodes = at_nodes(previous.problem, known, known.backoff)
    for old, new, values in zip(previous.problem.bound_constraints, problem.bound_constraints, of_nodes, strict=True):
        rows = np.searchsorted(old.places, new.places)
        backoff.append(values[np.minimum(rows, len(old.places) - 1)])
    # Between nodes as at the end of the step.
    backoff += [backoff[i][instants.of(i)[0]] for i in instants.constraints]
    size = sum(item.size for item in enforced(problem, instants).bound_constraints)
    return Multipliers(values=np.zeros(size), backoff=flat(backoff), between=instants)
