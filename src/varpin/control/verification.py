"""Comparison of a plan with an accurate integration of the continuous system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from varpin.arrays import Floats
from varpin.control.constraints import BoundConstraint
from varpin.control.history import percent
from varpin.control.multipliers import ConstraintReport
from varpin.control.problem import OptimalControlProblem
from varpin.control.sizes import NOTABLE
from varpin.core.arrays import Commands
from varpin.integrators import Gauss, Integrator, Radau, RungeKutta4
from varpin.signals.commands import open_line, open_loop
from varpin.simulation.choice import STIFF
from varpin.simulation.record import rollout
from varpin.simulation.spectrum import rate_at_rest
from varpin.support.markup import facts, table
from varpin.trajectory import Trajectory

if TYPE_CHECKING:
    from varpin.control.solution import Solution

# Integrators of the continuous system: without and with fast damping, and with constraints of the scene.
_USUAL, _FAST, _CLOSED = RungeKutta4(), Radau(3), Gauss(stages=3)
_READING = (
    "how to read it: where feedback loses less than a percent, the plan holds; where it loses more, dt is too coarse "
    "(controls alone also lose much where a motion is unstable)"
)


@dataclass(frozen=True, eq=False)
class Played:
    """A motion under commands in parts of a plan's steps.

    Attributes:
        problem: The plan's.
        fine: The same :meth:`in_parts`.
        motion: None where it diverges.
        cost: NaN where it diverges.
    """

    problem: OptimalControlProblem
    fine: OptimalControlProblem
    motion: Trajectory | None
    cost: float

    @property
    def nodes(self) -> Floats:
        """Configurations at the plan's nodes (N + 1, n); NaN where it diverges."""
        motion, N = self.motion, self.problem.steps
        return np.full((1, 1), np.nan) if motion is None else motion.q[:: motion.steps // N]

    @property
    def reports(self) -> tuple[ConstraintReport, ...]:
        """How well it satisfies each constraint, without margins; all NaN where it diverges."""
        parts, found = self.fine.steps // self.problem.steps, []
        for i, bound in enumerate(self.fine.bound_constraints):
            c = np.full(bound.shape, np.nan)
            if self.motion is not None:
                c = bound.value(self.motion.q, self.motion.v, self.fine.control_rows(self.motion))
            if i in self.problem.throughout:
                # A row that is violated at the start cannot hold before the first node.
                early = np.arange(len(c)) < parts - 1
                c = np.where(early[:, None] & (self.problem.at_start(i) > 0.0), np.minimum(c, 0.0), c)
            found.append(report_of(self.problem, bound, c))
        return tuple(found)


@dataclass(frozen=True)
class Verification:
    """Comparison of a plan with an accurate integration of the continuous system.

    Costs are integrals over the continuous motion, without noise; NaN where that motion diverges.

    Attributes:
        planned_cost: Cost by the solver.
        open_loop_cost: Cost under the plan's controls alone.
        closed_loop_cost: Cost with feedback at the plan's own rate.
        open_loop_gap: Largest distance of the end from the plan's, in q, under the controls alone [rad or m].
        closed_loop_gap: The same with feedback.
        substeps: Substeps of the accurate integration in one step of the plan.
        accuracy: Relative change over the last doubling of the substeps, of the cost that changed more. Infinite where
            no cost could be compared: all motions diverge, or they diverged with fewer substeps, or ``max_substeps``
            allowed no doubling.
        integrator: The accurate integrator: ``Radau(stages=3)`` where dampers, friction or servos are much faster than
            the plan's step.
        constraints: How well the continuous motion with feedback satisfies each of the problem's constraints, without
            margins, at the nodes of the accurate integration from the plan's first one on; a goal at the end, and rate
            limits of controls at decisions. All NaN where the motion diverges.
        open_loop_constraints: The same under the plan's controls alone.
    """

    planned_cost: float
    open_loop_cost: float
    closed_loop_cost: float
    open_loop_gap: float
    closed_loop_gap: float
    substeps: int
    accuracy: float
    integrator: str = str(_USUAL)
    constraints: tuple[ConstraintReport, ...] = ()
    open_loop_constraints: tuple[ConstraintReport, ...] = ()

    @property
    def violation(self) -> float:
        """The largest violation of a constraint with feedback on the continuous system, in its own unit.

        NaN where that motion diverges.
        """
        return float(np.max([own.violation for own in self.constraints], initial=0.0))

    @property
    def told(self) -> bool:
        """Whether the costs are known to a percent; if not, nothing can be concluded about the plan."""
        return self.accuracy <= NOTABLE or self._diverges

    @property
    def open_loop_loss(self) -> float:
        """Excess cost under the controls alone, relative to the plan's cost; NaN where the motion diverges."""
        return excess(self.open_loop_cost, self.planned_cost)

    @property
    def closed_loop_loss(self) -> float:
        """The same with feedback."""
        return excess(self.closed_loop_cost, self.planned_cost)

    @property
    def _diverges(self) -> bool:
        return not np.isfinite([self.open_loop_cost, self.closed_loop_cost]).any()

    @property
    def reading(self) -> str:
        """How to read the costs, or why they say nothing."""
        if self.told:
            return _READING
        changed = f", and still change by {percent(self.accuracy)}" if np.isfinite(self.accuracy) else ""
        return (
            f"these costs say nothing of the plan: those of {self.substeps} steps of {self.integrator} in one of the "
            f"plan's are not known to a percent{changed}: give max_substeps of {2 * self.substeps} or more"
        )

    def _rows(self) -> list[tuple[str, str, str, str]]:
        """The costs, losses and gaps of the plan and of both motions, below their names."""
        rows = [("", "cost", "loss", "end off by [rad or m]"), ("planned", f"{self.planned_cost:.6e}", "", "")]
        opened = ("controls alone", self.open_loop_cost, self.open_loop_loss, self.open_loop_gap)
        closed = ("with feedback", self.closed_loop_cost, self.closed_loop_loss, self.closed_loop_gap)
        for name, cost, loss, gap in (opened, closed):
            known = np.isfinite(cost)
            rows.append((name, f"{cost:.6e}", percent(loss), f"{gap:.2e}") if known else (name, "runs away", "", ""))
        return rows

    def _notes(self) -> list[str]:
        """What is below the table."""
        good = "all motions run away" if self._diverges else "how good the costs are is not known"
        if np.isfinite(self.accuracy):
            good = f"costs are good to {self.accuracy:.0e} of themselves"
        notes = [f"{good} ({self.substeps} substeps a step, {self.integrator})", self.reading]
        for alone, fed in zip(self.open_loop_constraints, self.constraints, strict=True):
            ways = ("controls alone", alone.violation), ("with feedback", fed.violation)
            worst = ", ".join(f"{name} {x:.1e}" if np.isfinite(x) else f"{name} runs away" for name, x in ways)
            where = f" ({fed.where})" if fed.violation > 0.0 else ""
            notes.append(f"{fed.label} is violated by [{fed.unit}]: {worst}{where}")
        return notes

    def _repr_html_(self) -> str:
        head, *rows = self._rows()
        notes = [("", note) for note in self._notes()]
        return facts("Verification on the continuous system", notes, table(head, rows))

    def __str__(self) -> str:
        lines = (f"{name:16}{cost:>14}{loss:>12}  {gap}".rstrip() for name, cost, loss, gap in self._rows())
        return "\n".join([*lines, *self._notes()])


def excess(cost: float, base: float) -> float:
    """Excess of ``cost`` over ``base``, relative to ``base``; infinite where ``base`` is zero."""
    if cost == base:
        return 0.0
    return (cost - base) / abs(base) if base != 0.0 else float(np.copysign(np.inf, cost - base))


def verify(
    plan: Solution,
    *,
    tolerance: float,
    max_substeps: int,
    substeps: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> Verification:
    """Compare a plan with accurate integrations.

    The parts of steps, ``substeps`` at first, double until the relative change of both costs is at most ``tolerance``.
    Where the explicit method does not reach that because of fast dampers or dry friction, the L-stable one repeats the
    comparison.
    """
    problem, end = plan.problem, plan.trajectory.q[-1]
    stiff = problem.dt * rate_at_rest(problem.scene, problem.q0) > STIFF
    members = (_FAST,) if stiff else (_USUAL, _FAST)
    for integrator in (_CLOSED,) if problem.scene.constraints else members:
        parts, before = substeps, (np.nan, np.nan)
        while True:
            if progress is not None:
                progress(parts, max_substeps)
            opened, closed = replays(plan, integrator, parts)
            changes = [
                abs(now.cost - then) / max(abs(now.cost), np.finfo(float).tiny)
                for now, then in zip((opened, closed), before, strict=True)
                if np.isfinite(now.cost) and np.isfinite(then)
            ]
            before, accuracy = (opened.cost, closed.cost), max(changes, default=np.inf)
            if accuracy <= tolerance or 2 * parts > max_substeps:
                break
            parts *= 2
        found = Verification(
            planned_cost=plan.cost,
            open_loop_cost=opened.cost,
            closed_loop_cost=closed.cost,
            open_loop_gap=float(np.abs(opened.nodes[-1] - end).max()),
            closed_loop_gap=float(np.abs(closed.nodes[-1] - end).max()),
            substeps=parts,
            accuracy=accuracy,
            integrator=str(integrator),
            constraints=closed.reports,
            open_loop_constraints=opened.reports,
        )
        if found.told or not problem.scene.dissipates:
            break
    return found


def replays(plan: Solution, integrator: Integrator, parts: int) -> tuple[Played, Played]:
    """A plan in parts of its steps, without noise: under its controls alone, and with feedback at its own rate.

    Raises:
        VarpinError: A custom cost or noise field fails off the plan.
    """
    problem, fine = plan.problem, plan.problem.in_parts(parts)
    opened, closed = in_parts(plan, integrator, parts)
    return played(problem, fine, opened, integrator), played(problem, fine, closed, integrator)


def played(
    problem: OptimalControlProblem, fine: OptimalControlProblem, commands: Commands, integrator: Integrator
) -> Played:
    """The motion of a problem under commands on ``fine``, the same :meth:`in_parts`."""
    motion, failure = rollout(fine.scene, integrator, fine.q0, fine.v0, commands, fine.dt)
    if failure is not None:
        return Played(problem, fine, None, np.nan)
    return Played(problem, fine, motion, float(fine.costs(motion.q, motion.v, fine.control_rows(motion))))


def report_of(problem: OptimalControlProblem, bound: BoundConstraint, c: Floats) -> ConstraintReport:
    """The report of a constraint with values c (K, rows), without multipliers."""
    given = problem.label_of(bound.source), bound.rows, bound.unit, bound.times
    return ConstraintReport(*given, c, np.zeros_like(c), bound.source.equality)


def in_parts(plan: Solution, integrator: Integrator, parts: int) -> tuple[Commands, Commands]:
    """Commands in parts of a plan's steps: its controls alone, and with feedback."""
    problem, variational, times = plan.problem, integrator.variational, integrator.stage_times
    alone = open_line(plan.controls, times) if problem.linear else open_loop(plan.controls)
    size = problem.steps * parts, problem.scene.controls, problem.scene.robot.dof
    fed = plan.policy_on("momentum" if variational else "velocity")
    closed = fed.commands(*size, variational=variational, dt=problem.dt / parts, stage_times=times)
    return alone._replace(hold=problem.hold * parts), closed
