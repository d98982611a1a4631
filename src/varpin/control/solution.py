"""The result of a solver: its policy, verification, Monte Carlo simulation, and files, which leave the problem out."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from varpin.arrays import Floats
from varpin.control.between_nodes import enforced
from varpin.control.history import Iteration, Refinement, SearchState, Status
from varpin.control.monte_carlo import MonteCarlo, PolicyPaths
from varpin.control.multipliers import ConstraintReport, Multipliers, reports
from varpin.control.noise import left_within_steps
from varpin.control.problem import OptimalControlProblem, require_problem
from varpin.control.stages import Feedback, Steps
from varpin.control.verification import Verification, verify
from varpin.errors import FileError, InputError, VarpinError
from varpin.finding import Finding, announce
from varpin.io.archive import Axes, members_of, read_npz, record_of, save_npz
from varpin.linearization import velocity_at_nodes
from varpin.signals.policy import LinearPolicy
from varpin.support.checks import JointValues, count, flag, path_like, positive, word
from varpin.support.frozen import Frozen
from varpin.support.markup import facts, folded, listed, table, warning_count, warning_lines
from varpin.trajectory import PLAN_FORMAT, Trajectory

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Solution(Frozen):
    """The best motion a solver found, with the policy around it.

    ``print(plan.table())`` shows a row for each :class:`Iteration`, with a * where second derivatives of the dynamics
    count, then how the search ended and why. A step of 0 is none, as at the end; one above 1 went beyond the model's
    minimum.

    ``print(plan.verify())`` shows the plan's cost on the continuous system, ``print(plan.monte_carlo(200, rng=0))`` its
    cost under the scene's noise.

    Attributes:
        problem: The problem that was solved.
        trajectory: The motion without noise.
        gains: Feedback (R, m, 2n) on x = (q, p) or (q, v), for each of R decisions. Where controls are linear between
            nodes, decision k > 0 is the control at node k, and reacts to the state at node k - 1, where its line
            begins; the first has gains on the initial state.
        previous_gains: Feedback (R, m, m) on the previous control, where its changes have a cost
            (:class:`ControlRateCost`) or controls are linear between nodes:
            u_k + gains_k (x - x_k) + previous_gains_k (u_before - u_(k-1)). Else None.
        feedforward: Change of the controls (R, m) by the last backward pass; zero at an optimum.
        gradient: Gradient of the expected cost in the controls (R, m), under the solver's model of the noise, with the
            multipliers of constraints. At an optimum it is zero except where it pushes a control against its limit.
        cost: Cost of the motion without noise.
        noise_cost: Cost added by noise, by the solver's model, with what velocities do within steps of held noise.
        status: How the solver ended.
        reason: Why it ended, with numbers.
        history: One entry for each iteration.
        search: State of the search, from which :func:`varpin.solve` continues with ``resume``.
        warnings: Warnings about the plan, each with what to change: its cost is higher when its steps are taken in
            quarters, it passes limits, the requested true cost is not met.
        refinement: The steps tried where ``true_cost`` was given; else None.
        multipliers: Multipliers of the problem's constraints, with their margins; None without constraints.
    """

    problem: OptimalControlProblem = field(metadata={"entry": None})
    trajectory: Trajectory = field(metadata={"entry": None})
    gains: Annotated[Floats, Axes("decisions", "controls", "states", finite=True)]
    feedforward: Annotated[Floats, Axes("decisions", "controls", finite=True)]
    gradient: Annotated[Floats, Axes("decisions", "controls")]
    cost: float
    noise_cost: float
    status: Status
    reason: str
    history: tuple[Iteration, ...]
    search: SearchState | None = None
    previous_gains: Annotated[Floats, Axes("decisions", "controls", "controls", finite=True)] | None = None
    warnings: tuple[Finding, ...] = field(default=(), metadata={"entry": "plan.warnings"})
    refinement: Refinement | None = None
    multipliers: Multipliers | None = None

    def __post_init__(self) -> None:
        for array in (self.gains, self.feedforward, self.gradient, self.previous_gains):
            if array is not None:
                array.setflags(write=False)

    @property
    def expected_cost(self) -> float:
        """Cost of the motion plus the noise cost, by the solver's model."""
        return self.cost + self.noise_cost

    @property
    def controls(self) -> Floats:
        """The controls (R, m), one row per decision."""
        return self.problem.decided(self.trajectory)

    @property
    def iterations(self) -> int:
        """Number of iterations with a line search."""
        return sum(item.rollouts > 0 for item in self.history)

    @cached_property
    def constraints(self) -> tuple[ConstraintReport, ...]:
        """How well the motion satisfies each of the problem's constraints, in their order."""
        return () if self.multipliers is None else reports(self.problem, self.trajectory, self.multipliers)

    @property
    def violation(self) -> float:
        """The largest violation of a constraint, in its own unit; 0 where all hold or there are none."""
        return max((item.violation for item in self.constraints), default=0.0)

    @property
    def policy(self) -> LinearPolicy:
        """Controls with feedback, on the x of the problem's integrator."""
        return self.policy_on()

    def __repr__(self) -> str:
        noise = f" + {self.noise_cost:.4g} by noise" if self.noise_cost else ""
        ended = f"{self.iterations} iterations, {self.status.value}{warning_count(self.warnings)}"
        return f"Solution(cost {self.cost:.6g}{noise}, {ended})"

    def __str__(self) -> str:
        told = [] if self.status.converged or not self.reason else [f"why: {self.reason}"]
        return "\n".join([repr(self), *told, *map(str, self.constraints), *warning_lines(self.warnings)])

    def _repr_html_(self) -> str:
        problem = self.problem
        most = np.abs(problem.control_rows(self.trajectory)).max(axis=0, initial=0.0)
        rows: list[tuple[str, object]] = [
            ("status", self.status.value),
            ("why", self.reason),
            ("cost", f"{self.cost:.6g}" + (f", and {self.noise_cost:.4g} by noise" if self.noise_cost else "")),
            ("iterations", f"{self.iterations} in {sum(item.seconds for item in self.history):.3g} s"),
            ("horizon", f"{problem.steps} steps of {problem.dt:g} s, {problem.integrator}"),
            *(("constraint", report) for report in self.constraints),
            *(("warning", warning) for warning in self.warnings),
            ("largest controls", listed(f"{value:.4g}" for value in most)),
        ]
        history = [str(item).rstrip(" *").split() for item in self.history]
        columns = Iteration.HEADER.replace("noise cost", "noise").split()
        return facts(f"Plan for {problem.scene.robot.name}", rows, folded("iterations", table(columns, history)))

    def table(self) -> str:
        """The iterations, one row each, and how and why they ended; :class:`Solution` explains the columns."""
        refined = [] if self.refinement is None else str(self.refinement).splitlines()
        rows = [*map(str, self.history), *map(str, self.constraints), *refined, *warning_lines(self.warnings)]
        return "\n".join([Iteration.HEADER, *rows, self.status.value, f"({self.reason})"])

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the solution as a compressed npz file without pickle; returns its path.

        The file has the state of the search, but not the problem: :meth:`load` takes it.

        Raises:
            FileError: The path cannot be written.
        """
        members = members_of(replace(self.trajectory, scene_values={})) | members_of(self)
        # The numbers of the scene are those of the motion.
        for name, value in self.problem.setting.items():
            members[name if name.startswith("scene.") else f"problem.{name}"] = value
        return save_npz(path, PLAN_FORMAT, members)

    @classmethod
    def load(cls, path: str | os.PathLike[str], problem: OptimalControlProblem) -> Solution:
        """Read a solution of ``problem`` that :meth:`save` wrote.

        Raises:
            FileError: The file is missing, truncated, no npz, written by something else, holds pickled objects, arrays
                that do not fit together or are not finite, or is of another problem.
        """
        source = path_like("path", path)
        members, scene = read_npz(source, PLAN_FORMAT), require_problem(problem).scene
        # First the motion, whose masses give a clearer message for another robot.
        motion = replace(Trajectory.of_members(source, members, scene.robot), scene_values=scene.values)
        known = [name for name in members if name.startswith(("problem.", "scene."))]
        setting = {name.removeprefix("problem."): np.asarray(members[name]) for name in known}
        if difference := problem.differs(setting):
            raise FileError(f"{source} is of another problem: {difference}")
        sizes = {"decisions": problem.decisions, "controls": scene.controls, "states": 2 * scene.robot.dof}
        sizes["node_rows"] = sum(item.size for item in problem.bound_constraints)
        plan = record_of(cls, members, source, sizes=sizes, known={"problem": problem, "trajectory": motion})
        if other := problem.mismatch(setting, motion, plan.cost):
            raise FileError(f"{source} is {other}")
        if bool(problem.constraints) != (plan.multipliers is not None):
            raise FileError(f"{source}: multipliers of the problem's constraints do not belong to it, or are missing")
        if plan.multipliers is not None:
            _require_rows(source, plan.multipliers, problem)
        if (problem.rate is not None or problem.linear) and plan.previous_gains is None:
            raise FileError(f"{source}: previous_gains is missing")
        made = len(plan.history)
        if plan.search is not None and not 0 <= plan.search.iterations <= made:
            raise FileError(f"{source}: search.iterations is {plan.search.iterations}, where 0 to {made} belongs")
        return plan

    def shifted(
        self, decisions: int, before: JointValues | None = None, x: Literal["momentum", "velocity"] | None = None
    ) -> LinearPolicy:
        """The policy from a later decision on, its last row repeated, to start the next horizon with.

        Where controls are linear between nodes, the last control is held with the feedback of the plan's middle about
        its last state: near the end of a plan the feedback of linear controls is no stable law.

        ``before`` is the control before that decision, (m,) or by joint name; by default the plan's own. Where controls
        are linear between nodes, it is the control of that decision itself, with which the first line begins. ``x`` is
        what the policy reacts to, by default that of the problem's integrator; see :meth:`policy_on`.

        Raises:
            InputError: ``decisions`` is not from 0 to R - 1, or a control has a wrong shape.
        """
        if not 0 <= count("decisions", decisions) < len(self.gains):
            raise InputError(f"decisions must be from 0 to {len(self.gains) - 1}, got {decisions}")
        policy, motion, N = self.policy_on(x), self.trajectory, self.problem.decisions - self.problem.linear
        later = np.arange(N) + decisions
        rows = np.minimum(later, N - 1)
        u, reference, expected = policy.u[rows], policy.reference[rows], policy.u[:0]
        if self.problem.linear:
            second = motion.p if policy.on == "momentum" else motion.v
            reference = np.where((later >= N)[:, None], np.append(motion.q[-1], second[-1]), reference)
            rows = np.where(later >= N, N // 2, rows)
            expected = self.controls[decisions, None]
            before = expected[0] if before is None else before
        elif policy.previous is not None:
            expected = policy.previous[rows[:1]]
        previous_gains = None if policy.previous_gains is None else policy.previous_gains[rows]
        # A repeated control has itself as its previous one.
        previous = None if previous_gains is None else np.vstack([expected, u[:-1]])
        given = u, policy.gains[rows], reference, policy.on
        return self.problem.policy_of(*given, before=before, previous_gains=previous_gains, previous=previous)

    def policy_on(self, x: Literal["momentum", "velocity"] | None = None) -> LinearPolicy:
        """The policy on (q, p) or on (q, v), by default the integrator's.

        Where x is not that of the problem's integrator, dp = L_vq dq + M dv converts the gains, to first order.

        Raises:
            InputError: ``x`` is neither "momentum" nor "velocity".
        """
        own: Literal["momentum", "velocity"] = "momentum" if self.problem.integrator.variational else "velocity"
        x = own if x is None else x
        word("x", x, ("momentum", "velocity"))
        gains, trajectory, hold = self.gains, self.trajectory, self.problem.hold
        rows, n = slice(0, -1, hold), self.problem.scene.robot.dof
        linear, previous_gains = self.problem.linear, self.previous_gains
        if linear:
            # The first control is the value at the beginning of the first line.
            gains = gains[1:]
            previous_gains = None if previous_gains is None else previous_gains[1:]
        if x != own:
            rates = velocity_at_nodes(self.problem.scene, trajectory.q[rows], trajectory.v[rows])
            by_q, by_p = rates[:, :, :n], rates[:, :, n:]
            second = gains[:, :, n:]
            if x == "velocity":
                second = second @ np.linalg.inv(by_p)
                gains = np.concatenate([gains[:, :, :n] - second @ by_q, second], axis=2)
            else:
                gains = np.concatenate([gains[:, :, :n] + second @ by_q, second @ by_p], axis=2)
        reference = np.hstack([trajectory.q[rows], (trajectory.p if x == "momentum" else trajectory.v)[rows]])
        u, before = (self.controls[1:], self.controls[0]) if linear else (self.controls, self.problem.before)
        return self.problem.policy_of(u, gains, reference, x, before=before, previous_gains=previous_gains)

    def verify(
        self, *, tolerance: float = 1e-10, max_substeps: int = 1024, progress: Callable[[int, int], None] | None = None
    ) -> Verification:
        """Replay the plan through an accurate integration of the continuous system.

        Costs are integrated by Simpson's rule, the motion by the classical Runge-Kutta method, or by ``Radau(3)`` where
        dampers, dry friction or servos are much faster than the plan's step. In scenes with constraints it is
        ``Gauss(3)``, of order 6, which maintains them.

        Main args:
            tolerance: On the relative change of the cost when the substeps are doubled.
            max_substeps: Greatest number of substeps in a step of the plan, >= 2; ``accuracy`` tells if the tolerance
                was missed. They double from 2 on, so with less than 4 there is nothing to compare.

        Other Args:
            progress: Called before each doubling with (substeps, max_substeps).
        """
        positive("tolerance", tolerance, "1")
        count("max_substeps", max_substeps, least=2)
        found = verify(self, tolerance=tolerance, max_substeps=max_substeps, progress=progress)
        if not found.told:
            logger.warning("%s", found.reading)
        return found

    def monte_carlo(
        self,
        paths: int,
        rng: np.random.Generator | int,
        *,
        feedback: bool = True,
        workers: int | None = None,
        executor: Executor | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> MonteCarlo:
        """Expected cost of the policy under the scene's noise, with the problem's own integrator and step.

        Path i draws its noise from the i-th child of ``rng``, so results are the same bytes for any number of workers,
        threads, processes or machines of one kind. Workers return only costs. Noise that only Python evaluates
        (:class:`varpin.CustomNoise`) is simulated path by path, which is slow.

        Main args:
            paths: Number of paths.
            rng: Seed or generator.
            feedback: False for the controls alone.

        Other Args:
            workers: Number of threads; by default one per core, and one under a ``CustomNoise``.
            executor: Any ``concurrent.futures.Executor`` instead of threads; see :func:`varpin.simulate_ensemble`.
            progress: Called after each chunk of paths with (paths done, paths in all).

        Raises:
            InputError: Wrong arguments.
            ForceError, ConstraintError, NoiseError: A user's function failed in a path, which the error names.
            VarpinError: Fewer than two paths succeeded, or workers were lost.
            PathsInterrupted: Ctrl-C; holds the result of the paths done. It is a KeyboardInterrupt.
        """
        policy, gains = self.policy, Feedback(self.gains, self.previous_gains)
        if not flag("feedback", feedback):
            policy, gains = policy.without_feedback(), Feedback(np.zeros(self.gains.shape), None)
        paths, known = count("paths", paths, least=2), np.isfinite(self.noise_cost)
        within = left_within_steps(Steps(self.problem, self.trajectory), gains) if known else 0.0
        every = PolicyPaths(self.problem, policy, paths, rng, predicted=self.expected_cost, within=within)
        found = every.result(every.run(executor, workers, progress))
        if found is None:
            raise VarpinError(f"fewer than two of {paths} paths got to the end; a smaller dt may help")
        announce(logger, self.problem.scene.announced, self.problem.dt, found.warnings)
        return found


def _require_rows(source: Path, multipliers: Multipliers, problem: OptimalControlProblem) -> None:
    """Refuse multipliers of another number of rows, or of instants that the problem does not have."""
    between, found = multipliers.between, multipliers.values.size
    if not ((between.rows >= 0) & (between.rows < (len(problem.constraints), problem.steps))).all():
        raise FileError(f"{source}: multipliers.between.rows are not in the problem's steps")
    expected = sum(item.size for item in enforced(problem, between).bound_constraints)
    if found != expected:
        raise FileError(f"{source}: multipliers.values has shape ({found},), where ({expected},) belongs")
