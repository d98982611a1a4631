"""Comparison of a plan with an accurate integration of the continuous system."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from varpin.arrays import Floats
from varpin.control.constraints import BoundConstraint
from varpin.control.problem import OptimalControlProblem
from varpin.core.arrays import Commands
from varpin.integrators import Gauss, Integrator, Radau, RungeKutta4
from varpin.mechanics.scene import quiet
from varpin.signals.commands import open_line, open_loop
from varpin.signals.policy import LinearPolicy
from varpin.simulation.record import rollout
from varpin.simulation.spectrum import rate_at_rest
from varpin.support.markup import facts, table
from varpin.trajectory import Trajectory

logger = logging.getLogger(__name__)

# A plan's policy on (q, p) or (q, v), in parts of its steps.
Policy: TypeAlias = Callable[[Literal["momentum", "velocity"], int], LinearPolicy]

# Relative accuracy of the costs above which nothing can be concluded about the plan.
_UNKNOWN = 0.01
# Integrators of the continuous system: without and with fast damping, and with constraints of the scene.
_USUAL, _FAST, _CLOSED = RungeKutta4(), Radau(3), Gauss(stages=3)
# Damping is fast if its rate times the plan's step is greater. Up to twice that, both integrators take as long.
_FASTER = 8.0
_READING = (
    "where feedback loses less than a percent, the plan holds; where it loses more, dt is too coarse (controls alone "
    "also lose much where a motion is unstable)"
)


@dataclass(frozen=True)
class ViolationOnRobot:
    """Largest violation of a constraint, in its own unit.

    Attributes:
        label: The constraint.
        unit: Unit of the values.
        planned: In the plan, at the constraint's places.
        open_loop: On the continuous system under the plan's controls alone, also between nodes; for a goal, at the end.
            NaN where the motion diverges.
        closed_loop: The same with feedback.
        where: The worst row and time with feedback, in words; empty without violation or where the motion diverges.
    """

    label: str
    unit: str
    planned: float
    open_loop: float
    closed_loop: float
    where: str

    def __str__(self) -> str:
        ways = [("planned", self.planned), ("controls alone", self.open_loop), ("with feedback", self.closed_loop)]
        violations = ", ".join(f"{name} {x:.1e}" if np.isfinite(x) else f"{name} runs away" for name, x in ways)
        return f"{self.label} is violated by [{self.unit}]: {violations}{f' ({self.where})' if self.where else ''}"


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
        defect: Largest distance in q of an accurately integrated step from the plan's [rad or m].
        substeps: Substeps of the accurate integration in one step of the plan.
        accuracy: Relative change over the last doubling of the substeps, of the cost that changed more. Infinite where
            no cost could be compared: all motions diverge, or they diverged with fewer substeps, or ``max_substeps``
            allowed no doubling.
        integrator: The accurate integrator: ``Radau(stages=3)`` where dampers, friction or servos are much faster than
            the plan's step.
        constraints: Violations of the problem's constraints on the continuous system, without margins, at the nodes of
            the accurate integration from the plan's first one on. Rate limits of controls apply to decisions.
    """

    planned_cost: float
    open_loop_cost: float
    closed_loop_cost: float
    open_loop_gap: float
    closed_loop_gap: float
    defect: float
    substeps: int
    accuracy: float
    integrator: str = str(_USUAL)
    constraints: tuple[ViolationOnRobot, ...] = ()

    @property
    def violation(self) -> float:
        """The largest violation of a constraint with feedback on the continuous system, in its own unit.

        NaN where that motion diverges.
        """
        return float(np.max([item.closed_loop for item in self.constraints], initial=0.0))

    @property
    def told(self) -> bool:
        """Whether the costs are known to a percent; if not, nothing can be concluded about the plan."""
        return self.accuracy <= _UNKNOWN or self._diverges

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
        """Whether the motion diverges under the controls alone and with feedback."""
        return not np.isfinite([self.open_loop_cost, self.closed_loop_cost]).any()

    @property
    def _reading(self) -> str:
        """How to read the costs, or why they say nothing."""
        if self.told:
            return f"how to read it: {_READING}"
        how = "were compared with no others"
        if np.isfinite(self.accuracy):
            how = f"still change by {percent(self.accuracy)}, as something is too fast"
        return (
            f"these costs say nothing of the plan: those of {self.substeps} steps of {self.integrator} in one of the "
            f"plan's {how}: give max_substeps of {2 * self.substeps} or more"
        )

    def _rows(self) -> list[tuple[str, str, str, str]]:
        """The costs, losses and gaps of the plan and of both motions, by their names."""
        rows = [("planned", f"{self.planned_cost:.6e}", "", "")]
        opened = ("controls alone", self.open_loop_cost, self.open_loop_loss, self.open_loop_gap)
        closed = ("with feedback", self.closed_loop_cost, self.closed_loop_loss, self.closed_loop_gap)
        for name, cost, loss, gap in (opened, closed):
            known = np.isfinite(cost)
            rows.append((name, f"{cost:.6e}", percent(loss), f"{gap:.2e}") if known else (name, "runs away", "", ""))
        return rows

    def _notes(self) -> list[str]:
        """What is below the table."""
        good = "how good the costs are is not known"
        if np.isfinite(self.accuracy):
            good = f"costs are good to {self.accuracy:.0e} of themselves"
        elif self._diverges:
            good = "all motions run away"
        off = f"a step is off by {self.defect:.2e} rad or m at most; {good} ({self.substeps} substeps a step, "
        return [f"{off}{self.integrator})", self._reading, *map(str, self.constraints)]

    def _repr_html_(self) -> str:
        head = ("", "cost", "loss", "end off by [rad or m]")
        notes = [("", note) for note in self._notes()]
        return facts("Verification on the continuous system", notes, table(head, self._rows()))

    def __str__(self) -> str:
        rows = [("", "cost", "loss", "end off by [rad or m]"), *self._rows()]
        lines = (f"{name:16}{cost:>14}{loss:>12}  {gap}".rstrip() for name, cost, loss, gap in rows)
        return "\n".join([*lines, *self._notes()])


def excess(cost: float, base: float) -> float:
    """Excess of ``cost`` over ``base``, relative to ``base``; infinite where ``base`` is zero."""
    if cost == base:
        return 0.0
    return (cost - base) / abs(base) if base != 0.0 else float(np.copysign(np.inf, cost - base))


def percent(part: float) -> str:
    """A fraction as text: in percent, or as a multiple where it is large."""
    if abs(part) >= 1e4:
        return f"{part:+.1e} x"
    return f"{100.0 * part:+.2f} %" if abs(part) < 1.0 else f"{100.0 * part:+.0f} %"


def verify(
    problem: OptimalControlProblem,
    plan: Trajectory,
    planned_cost: float,
    policy: Policy,
    *,
    tolerance: float,
    max_substeps: int,
    progress: Callable[[int, int], None] | None,
) -> Verification:
    """Compare a plan, and its policy on (q, p) or (q, v), with accurate integrations: see :func:`on_robot`."""
    found = on_robot(problem, plan, policy, tolerance=tolerance, max_substeps=max_substeps, progress=progress)
    both = zip(_outside(problem, problem, plan), found.opened.outside, found.closed.outside, strict=True)
    verified = Verification(
        planned_cost=planned_cost,
        open_loop_cost=found.opened.cost,
        closed_loop_cost=found.closed.cost,
        open_loop_gap=float(np.abs(found.opened.nodes[-1] - plan.q[-1]).max()),
        closed_loop_gap=float(np.abs(found.closed.nodes[-1] - plan.q[-1]).max()),
        defect=_defect(problem, plan, found.substeps, found.integrator),
        substeps=found.substeps,
        accuracy=found.accuracy,
        integrator=str(found.integrator),
        constraints=tuple(
            ViolationOnRobot(
                problem.label_of(own.bound.source), own.bound.unit, own.worst, alone.worst, fed.worst, fed.where
            )
            for own, alone, fed in both
        ),
    )
    if not verified.told:
        logger.warning("%s", verified._reading)
    return verified


class Outside(NamedTuple):
    """The worst violation of a constraint by a motion."""

    bound: BoundConstraint
    worst: float = np.nan  # in the constraint's unit; NaN where the motion diverges
    time: float = np.nan
    row: str = ""

    @property
    def share(self) -> float:
        """The violation relative to the constraint's range."""
        return self.worst / (10.0 * self.bound.scale)

    @property
    def where(self) -> str:
        """The row and the time in words; empty without violation."""
        return f"{self.row} at t = {self.time:.4g} s" if self.worst > 0.0 else ""


class Played(NamedTuple):
    """A motion under commands in parts of a plan's steps: its cost, violations and configurations at the plan's nodes.

    All are NaN where it diverges.
    """

    cost: float
    outside: list[Outside]
    nodes: Floats


def played(
    problem: OptimalControlProblem, fine: OptimalControlProblem, commands: Commands, integrator: Integrator
) -> Played:
    """The motion of a problem under commands on ``fine``, the same :meth:`in_parts`."""
    motion, failure = rollout(fine.scene, integrator, fine.q0, fine.v0, commands, fine.dt)
    if failure is not None:
        lost = np.full((1, fine.q0.size), np.nan)
        return Played(np.nan, [Outside(bound) for bound in fine.bound_constraints], lost)
    cost = float(fine.costs(motion.q, motion.v, fine.control_rows(motion)))
    return Played(cost, _outside(problem, fine, motion), motion.q[:: fine.steps // problem.steps])


def _outside(problem: OptimalControlProblem, fine: OptimalControlProblem, motion: Trajectory) -> list[Outside]:
    """The worst violation of each constraint, without margins, by a motion on ``fine``."""
    found = []
    for whole, bound in zip(problem.bound_constraints, fine.bound_constraints, strict=True):
        c = bound.value(motion.q, motion.v, fine.control_rows(motion))
        excess = np.abs(c) if bound.source.equality else np.maximum(c, 0.0)
        outside = at_start(problem, whole)
        if outside is not None:
            # A row that is violated at the start cannot hold before the first node.
            excess[: fine.steps // problem.steps - 1, outside > 0.0] = 0.0
        sample, row = np.unravel_index(int(np.argmax(excess)), excess.shape)
        found.append(Outside(bound, float(excess[sample, row]), float(bound.times[sample]), bound.rows[row]))
    return found


def at_start(problem: OptimalControlProblem, bound: BoundConstraint) -> Floats | None:
    """Rows of a state inequality at the fixed start; None for other constraints."""
    if bound.of_controls or bound.source.equality:
        return None
    q, v = (np.tile(state, (problem.steps + 1, 1)) for state in (problem.q0, problem.v0))
    c: Floats = bound.value(q, v, np.zeros((problem.steps, problem.scene.controls)))[0]
    return c


class OnRobot(NamedTuple):
    """A plan on the continuous system, and how it was found.

    Attributes:
        opened: Under its controls alone.
        closed: With feedback.
        substeps: Parts of the plan's steps.
        accuracy: Relative change of the cost that changed more by the last doubling of the parts.
        decided: Whether the cost with feedback is surely greater than a bound.
        integrator: The accurate integrator.
    """

    opened: Played
    closed: Played
    substeps: int
    accuracy: float
    decided: bool
    integrator: Integrator

    @property
    def known(self) -> bool:
        """Whether the costs are good enough, greater than a bound, or infinite."""
        return self.accuracy <= _UNKNOWN or self.decided or not np.isfinite([self.opened.cost, self.closed.cost]).any()

    @property
    def violation(self) -> float:
        """Largest violation with feedback, relative to the constraint's range; NaN where the motion diverges."""
        return float(np.max([own.share for own in self.closed.outside], initial=0.0))

    @property
    def beyond(self) -> str:
        """The constraint that is violated most, by how much and where, in words; empty where all hold."""
        worst = max(self.closed.outside, key=lambda own: own.share, default=None)
        if worst is None or not worst.where:
            return ""
        return f"{worst.bound.source.label} is violated by {worst.worst:.2g} {worst.bound.unit} ({worst.where})"


def on_robot(
    problem: OptimalControlProblem,
    plan: Trajectory,
    policy: Policy,
    *,
    tolerance: float,
    max_substeps: int = 1024,
    progress: Callable[[int, int], None] | None = None,
    above: float = np.inf,
    substeps: int = 2,
) -> OnRobot:
    """A plan on the continuous system.

    The parts of steps, ``substeps`` at first, double until the relative change of both costs is at most ``tolerance``,
    or the cost with feedback is surely greater than ``above``. Where the explicit method does not reach that because of
    fast dampers or dry friction, the L-stable one repeats the comparison.
    """
    fastest = problem.dt * rate_at_rest(problem.scene, problem.q0)
    members = (_FAST,) if fastest > _FASTER else (_USUAL, _FAST)
    for integrator in (_CLOSED,) if problem.scene.constraints else members:
        parts, before = substeps, (np.nan, np.nan)
        while True:
            if progress is not None:
                progress(parts, max_substeps)
            fine = problem.in_parts(parts)
            commands = in_parts(problem, problem.decided(plan), policy, integrator, parts)
            opened, closed = (played(problem, fine, each, integrator) for each in commands)
            changes = [
                abs(now.cost - then) / max(abs(now.cost), np.finfo(float).tiny)
                for now, then in zip((opened, closed), before, strict=True)
                if np.isfinite(now.cost) and np.isfinite(then)
            ]
            decided = bool(closed.cost - above > abs(closed.cost - before[1]))
            before, accuracy = (opened.cost, closed.cost), max(changes, default=np.inf)
            if decided or accuracy <= tolerance or 2 * parts > max_substeps:
                break
            parts *= 2
        found = OnRobot(opened, closed, parts, accuracy, decided, integrator)
        if found.known or not problem.scene.dissipates:
            break
    return found


def in_parts(
    problem: OptimalControlProblem, controls: Floats, policy: Policy, integrator: Integrator, parts: int
) -> tuple[Commands, Commands]:
    """Commands in parts of a plan's steps: the controls (R, m) alone, and with feedback."""
    variational, times = integrator.variational, integrator.stage_times
    alone = open_line(controls, times) if problem.linear else open_loop(controls)
    m, n = problem.scene.controls, problem.scene.robot.dof
    fed = policy("momentum" if variational else "velocity", parts)
    closed = fed.commands(problem.steps * parts, m, n, variational=variational, stage_times=times)
    return alone._replace(hold=problem.hold * parts), closed


def _defect(problem: OptimalControlProblem, plan: Trajectory, substeps: int, integrator: Integrator) -> float:
    """Largest distance in q between the plan's steps and accurate ones from the same nodes; NaN where one diverges."""
    u = plan.u_nodes[1:] if problem.linear else plan.u
    commands = open_loop(u)._replace(hold=substeps, own=1)
    if problem.linear:
        times = np.array(integrator.stage_times or (0.5,))
        commands = commands._replace(before=plan.u_nodes[:-1].copy(), stage_times=times)
    begins = plan.q[:-1].copy(), plan.v[:-1].copy()
    found = integrator.motions(quiet(problem.scene), *begins, commands, problem.dt / substeps)
    return np.nan if found is None else float(np.abs(found[0][:, -1] - plan.q[1:]).max(initial=0.0))
