"""Comparison of a plan with an accurate integration of the continuous system."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.control.constraints import BoundConstraint
from varpin.control.costs import BoundSum
from varpin.control.history import Status
from varpin.control.problem import OptimalControlProblem, bind_cost
from varpin.core import fastest_damping
from varpin.core.arrays import Commands
from varpin.integrators import Gauss, Integrator, Radau, RungeKutta4
from varpin.signals.commands import open_line, open_loop
from varpin.signals.policy import LinearPolicy
from varpin.simulation.record import rollout
from varpin.simulation.spectrum import rate_at_rest
from varpin.support.markup import facts, table
from varpin.trajectory import Trajectory

logger = logging.getLogger(__name__)

# Relative accuracy of the costs above which nothing can be concluded about the plan.
_UNKNOWN = 0.01
# Integrators of the continuous system, without and with fast damping.
_USUAL, _FAST = RungeKutta4(), Radau(3)
# Damping is fast if its rate times the plan's step exceeds _FASTER at one of _NODES nodes.
_FASTER, _NODES = 8.0, 8
_READING = (
    "where feedback loses less than a percent, the plan holds; where it loses more, dt is too coarse (controls alone "
    "also lose much where a motion is unstable)"
)
# A loss is far above a wish from this multiple of it on.
_FAR = 2.0
# Least number of parts of a step in which the constraints of a plan with a wished true cost are looked at.
_LOOKS = 8
# Stability limit of the Runge-Kutta method: greatest product of rate and step.
_STABLE = 2.78


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
        status: How the search for the plan ended.
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
    status: Status = Status.CONVERGED
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
        return self._diverges or self.accuracy <= _UNKNOWN

    @property
    def _diverges(self) -> bool:
        """Whether the motion diverges under the controls alone and with feedback."""
        return not np.isfinite([self.open_loop_cost, self.closed_loop_cost]).any()

    @property
    def open_loop_loss(self) -> float:
        """Excess cost under the controls alone, relative to the plan's cost; NaN where the motion diverges."""
        return excess(self.open_loop_cost, self.planned_cost)

    @property
    def closed_loop_loss(self) -> float:
        """The same with feedback."""
        return excess(self.closed_loop_cost, self.planned_cost)

    @property
    def _why_unknown(self) -> str:
        finer = f"give max_substeps of {2 * self.substeps} or more"
        if np.isinf(self.accuracy):
            return (
                f"these costs say nothing of the plan: those with {self.substeps} steps of {self.integrator} in one of "
                f"the plan's were compared with no others: {finer}"
            )
        return (
            f"these costs say nothing of the plan: with {self.substeps} steps of {self.integrator} in one of the "
            f"plan's they still change by {percent(self.accuracy)}. Springs, dampers, dry friction or stops are too "
            f"fast: {finer}, or friction a greater width"
        )

    @property
    def _rows(self) -> list[tuple[str, float, str, str]]:
        return [
            ("planned", self.planned_cost, "", ""),
            ("controls alone", self.open_loop_cost, percent(self.open_loop_loss), f"{self.open_loop_gap:.2e}"),
            ("with feedback", self.closed_loop_cost, percent(self.closed_loop_loss), f"{self.closed_loop_gap:.2e}"),
        ]

    def _repr_html_(self) -> str:
        rows = [row if np.isfinite(row[1]) else (row[0], "runs away", "", "") for row in self._rows]
        head = ("", "cost", "loss", "end off by [rad or m]")
        facts_ = [
            ("how to read it", _READING if self.told else self._why_unknown),
            ("a step is off by", f"{self.defect:.2e} rad or m"),
            *(("constraint", report) for report in self.constraints),
            *([] if self.status.converged else [("the plan is unfinished", self.status.value)]),
        ]
        return facts("Verification on the continuous system", facts_, table(head, rows))

    def __str__(self) -> str:
        lines = [f"{'':16}{'cost':>14}{'loss':>12}  end off by [rad or m]"]
        for name, cost, loss, gap in self._rows:
            values = (f"{cost:14.6e}{loss:>12}  {gap}" if np.isfinite(cost) else f"{'runs away':>14}").rstrip()
            lines.append(f"{name:16}{values}")
        if np.isfinite(self.accuracy):
            good = f"costs are good to {self.accuracy:.0e} of themselves"
        else:
            good = "all motions run away" if self._diverges else "how good the costs are is not known"
        return "\n".join(
            [
                *lines,
                f"a step is off by {self.defect:.2e} rad or m at most; {good} "
                f"({self.substeps} substeps a step, {self.integrator})",
                f"how to read it: {_READING}" if self.told else self._why_unknown,
                *map(str, self.constraints),
                *([] if self.status.converged else [f"the plan is unfinished, {self.status.value}"]),
            ]
        )


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
    policy: Callable[[Literal["momentum", "velocity"], int], LinearPolicy],
    *,
    status: Status,
    tolerance: float,
    max_substeps: int,
    progress: Callable[[int, int], None] | None,
) -> Verification:
    """Compare a plan, and its policy on (q, p) or (q, v), with accurate integrations.

    The substeps double until the relative change of both costs is at most ``tolerance``. Where the explicit method does
    not reach that because of fast dampers or dry friction, the L-stable one repeats the comparison.
    """
    found = _true_costs(problem, plan, policy, tolerance=tolerance, max_substeps=max_substeps, progress=progress)
    end = plan.q[-1]
    verified = Verification(
        planned_cost=planned_cost,
        open_loop_cost=found.opened[0],
        closed_loop_cost=found.closed[0],
        open_loop_gap=float(np.abs(found.opened[1] - end).max()),
        closed_loop_gap=float(np.abs(found.closed[1] - end).max()),
        defect=_defect(problem, plan, found.substeps, found.integrator),
        substeps=found.substeps,
        accuracy=found.accuracy,
        status=status,
        integrator=str(found.integrator),
        constraints=_violations(problem, plan, found.ways, found.substeps, found.integrator),
    )
    if not verified.told:
        logger.warning("%s", verified._why_unknown)
    return verified


class OnRobot(NamedTuple):
    """A plan on the continuous system.

    Attributes:
        opened: True cost under its controls alone; NaN where the motion diverges.
        closed: The same with feedback.
        known: Whether the costs decide on a wish. Where the loss with feedback exceeds the wish by far, they are rough.
        violation: Largest violation of a constraint with feedback, relative to the constraint's range; NaN where the
            motion diverges.
        where: The constraint that is violated most, by how much and where, in words; empty where all hold.
    """

    opened: float
    closed: float
    known: bool
    violation: float = 0.0
    where: str = ""


def true_costs(
    problem: OptimalControlProblem,
    plan: Trajectory,
    planned_cost: float,
    policy: Callable[[Literal["momentum", "velocity"], int], LinearPolicy],
    *,
    wish: float,
    accuracy: float,
    max_substeps: int = 1024,
) -> OnRobot:
    """The true costs under a plan's controls alone and with feedback, whether they decide on a wish, and violations.

    Args:
        wish: Greatest allowed loss with feedback, relative to ``planned_cost``.
        accuracy: Relative accuracy of costs within the wish.
    """
    above = planned_cost + _FAR * wish * abs(planned_cost)
    found = _true_costs(problem, plan, policy, tolerance=accuracy, max_substeps=max_substeps, above=above)
    told = OnRobot(found.opened[0], found.closed[0], found.known)
    if not problem.constraints:
        return told
    substeps, feedback = found.substeps, found.ways[1]
    if substeps < _LOOKS:
        # Motions are seen at the ends of substeps only.
        substeps, feedback = _LOOKS, _feedback(problem, policy, found.integrator, _LOOKS)
    bound = problem.bound_constraints
    (beyond,) = _beyond(problem, (feedback,), substeps, found.integrator)
    shares = [by / (10.0 * item.scale) for (by, _), item in zip(beyond, bound, strict=True)]
    if not np.isfinite(shares).all():
        return told._replace(violation=np.nan)
    i = int(np.argmax(shares))
    (worst, where), item = beyond[i], bound[i]
    words = f"{item.source.label} is violated by {worst:.2g} {item.unit} ({where})" if where else ""
    return told._replace(violation=shares[i], where=words)


class _TrueCosts(NamedTuple):
    """True costs and ends (n,) under the controls alone and with feedback, and how they were found."""

    opened: tuple[float, Floats]
    closed: tuple[float, Floats]
    ways: tuple[Commands, Commands]
    substeps: int
    accuracy: float
    decided: bool
    integrator: Integrator

    @property
    def known(self) -> bool:
        """Whether the costs are good enough, greater than a bound, or infinite."""
        return self.accuracy <= _UNKNOWN or self.decided or not np.isfinite([self.opened[0], self.closed[0]]).any()


def _true_costs(
    problem: OptimalControlProblem,
    plan: Trajectory,
    policy: Callable[[Literal["momentum", "velocity"], int], LinearPolicy],
    *,
    tolerance: float,
    max_substeps: int,
    progress: Callable[[int, int], None] | None = None,
    above: float = np.inf,
) -> _TrueCosts:
    """True costs by the explicit integrator, or by the L-stable one where dissipation keeps that from an answer."""
    for integrator in _members(problem, plan, max_substeps):
        found = _costs_by(
            integrator,
            problem,
            plan,
            policy,
            tolerance=tolerance,
            max_substeps=max_substeps,
            progress=progress,
            above=above,
        )
        if found.known or not problem.scene.dissipates:
            break
    return found


def _members(problem: OptimalControlProblem, plan: Trajectory, max_substeps: int) -> tuple[Integrator, ...]:
    """The integrators of the continuous system, in the order in which they are tried."""
    if problem.scene.constraints:
        return (accurate(problem),)
    fast = _fast(problem, plan) or problem.dt * rate_at_rest(problem.scene, problem.q0) >= _STABLE * max_substeps
    return (_FAST,) if fast else (_USUAL, _FAST)


def _costs_by(
    integrator: Integrator,
    problem: OptimalControlProblem,
    plan: Trajectory,
    policy: Callable[[Literal["momentum", "velocity"], int], LinearPolicy],
    *,
    tolerance: float,
    max_substeps: int,
    progress: Callable[[int, int], None] | None,
    above: float,
) -> _TrueCosts:
    """True costs by one integrator, also where the one with feedback is surely greater than ``above``."""
    substeps, before, decided = 2, (np.nan, np.nan), False
    times = integrator.stage_times
    blind = open_line(problem.decided(plan), times) if problem.linear else open_loop(problem.decided(plan))
    while True:
        if progress is not None:
            progress(substeps, max_substeps)
        costs = _fine_costs(problem, substeps)
        opened = accurate_cost(problem, blind._replace(hold=problem.hold * substeps), substeps, costs, integrator)
        feedback = _feedback(problem, policy, integrator, substeps)
        closed = accurate_cost(problem, feedback, substeps, costs, integrator)
        changes = [
            abs(now[0] - then) / max(abs(now[0]), 1e-300)
            for now, then in zip((opened, closed), before, strict=True)
            if np.isfinite(now[0]) and np.isfinite(then)
        ]
        decided = closed[0] - above > abs(closed[0] - before[1])
        before = opened[0], closed[0]
        accuracy = max(changes, default=np.inf)
        if decided or accuracy <= tolerance or 2 * substeps > max_substeps:
            break
        substeps *= 2
    blind = blind._replace(hold=problem.hold * substeps)
    return _TrueCosts(opened, closed, (blind, feedback), substeps, accuracy, bool(decided), integrator)


def _feedback(
    problem: OptimalControlProblem,
    policy: Callable[[Literal["momentum", "velocity"], int], LinearPolicy],
    integrator: Integrator,
    substeps: int,
) -> Commands:
    """The commands of a plan's policy in ``substeps`` parts of each of its steps."""
    return policy("momentum" if integrator.variational else "velocity", substeps).commands(
        problem.steps * substeps,
        problem.scene.controls,
        problem.scene.robot.dof,
        variational=integrator.variational,
        stage_times=integrator.stage_times,
    )


def _violations(
    problem: OptimalControlProblem,
    plan: Trajectory,
    laws: tuple[Commands, Commands],
    substeps: int,
    integrator: Integrator,
) -> tuple[ViolationOnRobot, ...]:
    """Violations of each constraint on the continuous system, under the controls alone and with feedback."""
    if not problem.constraints:
        return ()
    opened, closed = _beyond(problem, laws, substeps, integrator)
    found = []
    for whole, (alone, _), (fed, where) in zip(problem.bound_constraints, opened, closed, strict=True):
        planned = _excess(whole, whole.value(plan.q, plan.v, problem.control_rows(plan)))
        label, unit = problem.label_of(whole.source), whole.unit
        found.append(ViolationOnRobot(label, unit, float(planned.max(initial=0.0)), alone, fed, where))
    return tuple(found)


def _beyond(
    problem: OptimalControlProblem, laws: Sequence[Commands], substeps: int, integrator: Integrator
) -> list[list[tuple[float, str]]]:
    """The largest violation of each constraint under each of some commands, and the row and time in words.

    NaN where the motion diverges.
    """
    h = problem.dt / substeps
    fine = problem.constraints_on(h, problem.steps * substeps, problem.hold * substeps)
    starts = [at_start(problem, whole) for whole in problem.bound_constraints]
    found = []
    for law in laws:
        motion, failure = rollout(problem.scene, integrator, problem.q0, problem.v0, law, h)
        if failure is not None:
            found.append([(np.nan, "")] * len(fine))
            continue
        of_law = []
        for bound, outside in zip(fine, starts, strict=True):
            excess = _excess(bound, bound.value(motion.q, motion.v, problem.control_rows(motion)))
            if outside is not None:
                # A row that is violated at the start cannot hold before the first node.
                excess[: substeps - 1, outside > 0.0] = 0.0
            sample, row = np.unravel_index(int(np.argmax(excess)), excess.shape)
            worst = float(excess[sample, row])
            of_law.append((worst, f"{bound.rows[row]} at t = {bound.times[sample]:.4g} s" if worst > 0.0 else ""))
        found.append(of_law)
    return found


def at_start(problem: OptimalControlProblem, bound: BoundConstraint) -> Floats | None:
    """Rows of a state inequality at the fixed start; None for other constraints."""
    if bound.of_controls or bound.source.equality:
        return None
    q, v = (np.tile(state, (problem.steps + 1, 1)) for state in (problem.q0, problem.v0))
    c: Floats = bound.value(q, v, np.zeros((problem.steps, problem.scene.controls)))[0]
    return c


def _excess(bound: BoundConstraint, c: Floats) -> Floats:
    """Violation of a constraint with values ``c`` (K, rows)."""
    found: Floats = np.abs(c) if bound.source.equality else np.maximum(c, 0.0)
    return found


def _fast(problem: OptimalControlProblem, plan: Trajectory) -> bool:
    """Whether dampers or friction are so fast that an explicit method would need many substeps."""
    if not problem.scene.dissipates or not plan.steps:
        return False
    at = np.unique(np.linspace(0, plan.steps, _NODES, dtype=np.int64))
    forces = np.ascontiguousarray(plan.u[np.minimum(at, plan.steps - 1)] @ problem.scene.actuation.T)
    least = _FASTER / problem.dt
    return fastest_damping(problem.scene.core, plan.q[at], plan.v[at], forces, least) > 0.0


def _fine_costs(problem: OptimalControlProblem, substeps: int) -> tuple[BoundSum, BoundSum]:
    """Running and terminal costs at the nodes of a finer grid."""
    times = np.arange(problem.steps * substeps + 1, dtype=np.float64) * (problem.dt / substeps)
    return bind_cost(problem.cost, problem.t0 + times, problem.running.points)


def accurate(problem: OptimalControlProblem) -> Integrator:
    """The integrator of the continuous system: classical Runge-Kutta; with scene constraints ``Gauss(3)``."""
    return Gauss(stages=3) if problem.scene.constraints else RungeKutta4()


def accurate_cost(
    problem: OptimalControlProblem,
    commands: Commands,
    substeps: int,
    costs: tuple[BoundSum, BoundSum] | None = None,
    integrator: Integrator | None = None,
) -> tuple[float, Floats]:
    """True cost under given commands, and the end configuration; NaN where the motion diverges.

    Each of the plan's steps has ``substeps`` steps, an even number, of the integrator, by default :func:`accurate`.
    """
    scene, h = problem.scene, problem.dt / substeps
    n, m = scene.robot.dof, scene.controls
    motion, failure = rollout(scene, integrator or accurate(problem), problem.q0, problem.v0, commands, h)
    if failure is not None:
        return np.nan, np.full(n, np.nan)
    running, terminal = _fine_costs(problem, substeps) if costs is None else costs
    # Simpson's rule within each step of the plan, since held controls jump between steps.
    if problem.linear:
        before = after = running.value(motion.q, motion.v, motion.u_nodes)
    else:
        after = running.value(motion.q, motion.v, np.vstack([motion.u, motion.u[-1:]]))
        before = running.value(motion.q, motion.v, np.vstack([motion.u[:1], motion.u]))
    integral = h / 3.0 * (after[:-1:2] + 4.0 * after[1::2] + before[2::2]).sum()
    end = terminal.value(motion.q[-1:], motion.v[-1:], np.zeros((1, m)))[0]
    smooth = 0.0
    if problem.rate is not None:
        decided = motion.u_nodes[::substeps] if problem.linear else motion.u
        smooth = float(problem.rate.value(decided, problem.period))
    return float(integral + end + smooth), motion.q[-1]


def _defect(problem: OptimalControlProblem, trajectory: Trajectory, substeps: int, integrator: Integrator) -> float:
    """Largest distance in q between the plan's steps and accurate ones from the same nodes."""
    scene, h, n = problem.scene, problem.dt / substeps, problem.scene.robot.dof
    state, _ = integrator.start(scene, trajectory.q[:-1].copy(), trajectory.v[:-1].copy())
    if problem.linear or scene.inputs:
        off = []
        for k in range(trajectory.steps):
            if problem.linear:
                line = open_line(trajectory.u_nodes[k : k + 2], integrator.stage_times)._replace(hold=substeps)
            else:
                line = open_loop(trajectory.u[k : k + 1])._replace(hold=substeps)
            motion, failure = rollout(scene, integrator, trajectory.q[k], trajectory.v[k], line, h)
            off.append(np.nan if failure else float(np.abs(motion.q[-1] - trajectory.q[k + 1]).max()))
        return float(np.max(off))
    # Every step is a separate path, with its control given as a force.
    commands = open_loop(np.zeros((1, scene.controls)))._replace(hold=substeps)
    force = trajectory.u @ scene.actuation.T
    forces = np.ascontiguousarray(np.broadcast_to(force[:, None], (trajectory.steps, substeps, n)))
    segments = integrator.rollout_compiled(scene, state, commands, np.zeros((0, 0, scene.processes)), forces, h)
    lost = np.full(n, np.nan)
    ends = np.array([segment.q[-1] if segment.failure is None else lost for segment in segments])
    return float(np.abs(ends - trajectory.q[1:]).max())
