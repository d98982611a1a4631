"""Checks of a finished plan: its cost in finer steps, its velocities and its constraints between nodes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from varpin.arrays import Floats
from varpin.control.chatter import alternation, restlessness
from varpin.control.hints import UNITS, hints
from varpin.control.history import ITERATIONS, Status
from varpin.control.margins import too_small
from varpin.control.multipliers import FEASIBLE, REPORTED, at_nodes
from varpin.control.noise import covariances, noise_cost
from varpin.control.problem import OptimalControlProblem, integrator_for
from varpin.control.solution import Solution
from varpin.control.stages import Feedback, Steps
from varpin.control.verification import accurate_cost, at_start, percent
from varpin.core.arrays import Commands
from varpin.errors import LinearizationError, VarpinError
from varpin.finding import Finding, announce
from varpin.integrators import Integrator
from varpin.linearization import wrong_variances
from varpin.mechanics.forces import of_kind
from varpin.model import joint_unit
from varpin.signals.commands import open_line, open_loop
from varpin.simulation.check import check
from varpin.simulation.record import rollout

logger = logging.getLogger(__name__)

# Parts of a step in which a plan is replayed.
PARTS = 4
# Greatest relative excess of the replay's cost over the plan's, and shortfall, without a warning.
LOSS, GAIN = 1e-3, 1e-2
# Kinds of findings about single steps; their effect on the whole plan is measured by the replay.
_OF_STEPS = ("error",)
# Greatest expected decrease of a stalled search, relative to its cost, without a warning.
_LITTLE = 1e-3
# Standard deviation of a velocity, in widths of its dry friction, up to which tanh is linear to 6 %.
_LINEAR_FRICTION = 0.25
# Parts of the expected cost and of the noise cost by which noise may cost other than planned in half steps without a
# warning, and the part of the expected cost that the noise cost has to have for the latter.
_NOISE_OFF, _OF_NOISE, _MATTERS = 0.05, 0.1, 0.01
# Violation between nodes, in scales of a constraint (a tenth of its range), from which narrower bounds do not help.
_NARROWED = 5.0
_ALTERNATION, _RESTLESS = "alternating velocities", "restless velocities"


@dataclass(frozen=True)
class Replay:
    """Excess cost of a plan replayed in parts of its steps, relative to its cost.

    NaN where the motion fails or its cost is not finite.

    Attributes:
        alone: With the controls alone.
        feedback: With feedback at the plan's own rate.
    """

    alone: float
    feedback: float

    @property
    def holds(self) -> bool:
        """Whether the replay with feedback costs about as much as the plan."""
        return -GAIN <= self.feedback <= LOSS


def looked_at(solution: Solution, before: Sequence[Finding] | None = None) -> tuple[Solution, tuple[Finding, ...]]:
    """Check a solution: returns it with its warnings, and the findings.

    The log has each warning once for a scene and a time step. Ctrl-C ends the checks and keeps the plan. ``before`` are
    the findings of :func:`foreseen` about its problem, where they are known.
    """
    try:
        found = findings(solution, before)
    except KeyboardInterrupt:
        found = (Finding("interrupted", "interrupted before the plan was replayed: its accuracy is not known"),)
    problem = solution.problem
    announce(logger, problem.scene.announced, problem.dt, found)
    return replace(solution, warnings=tuple(found)), found


def findings(solution: Solution, before: Sequence[Finding] | None = None) -> tuple[Finding, ...]:
    """Findings about a plan: its energy balance, velocities, constraints, convergence and cost in finer steps."""
    problem, motion = solution.problem, solution.trajectory
    policy = solution.policy_on("momentum" if problem.integrator.variational else "velocity")
    found = check(problem.scene, problem.integrator, motion, policy).warnings
    warnings = [*(foreseen(problem) if before is None else before)]
    warnings += [finding for finding in found if finding.kind not in (*_OF_STEPS, _ALTERNATION)]
    if solution.refinement is not None and not solution.refinement.met:
        warnings.append(Finding("true cost", solution.refinement.reason))
    warnings += (
        _unfinished(solution)
        + _margin_without_noise(solution)
        + _margins_of_velocities(solution)
        + too_small(solution)
        + _friction_under_noise(solution)
        + _noise_in_halves(solution)
        + (_alternating(solution) or _restless(solution))
        + _between(solution)
    )
    try:
        replay = replayed(solution)
    except VarpinError as error:
        steps = f"{1.0 / PARTS:g} dt"
        return *warnings, Finding("replay", f"the plan cannot be replayed in steps of {steps}: {error}")
    if replay.holds or _as_wished(solution, replay):
        return tuple(warnings)
    warnings.append(Finding("replay", _sentence(problem, replay)))
    return *warnings, *(finding for finding in found if finding.kind in _OF_STEPS)


def _as_wished(solution: Solution, replay: Replay) -> bool:
    """Whether the plan's refinement met its wish, and the replay with feedback confirms that."""
    refinement = solution.refinement
    if refinement is None or not refinement.met:
        return False
    return -max(GAIN, refinement.wish) <= replay.feedback <= max(LOSS, refinement.wish)


def replayed(solution: Solution) -> Replay:
    """Replay a plan in a quarter of its step, without noise and under the same held controls.

    The integrator is the plan's, whose error decreases with its order. Costs are integrated by Simpson's rule.
    :meth:`Solution.verify` does the same to many digits, in more time.

    Raises:
        VarpinError: A custom cost or noise field fails off the plan.
    """
    problem = solution.problem
    first = np.inf if solution.search is None else abs(solution.search.first)
    # Where the optimum costs nothing, the excess is relative to the cost at stake at the beginning.
    base = abs(solution.cost) + (1e-9 * first if np.isfinite(first) else 0.0)
    ways = _in_parts(solution)
    costs = [accurate_cost(problem, commands, PARTS, integrator=problem.integrator)[0] for commands in ways]
    # Richardson's correction for the error of the quarter steps.
    whole = 1.0 - float(PARTS) ** -problem.integrator.order
    lost = [0.0 if cost == solution.cost else (cost - solution.cost) / (whole * (base or 1.0)) for cost in costs]
    return Replay(*lost)


def _in_parts(solution: Solution, parts: int = PARTS) -> tuple[Commands, Commands]:
    """Commands in parts of the plan's steps: the controls alone, and with feedback."""
    problem = solution.problem
    variational, times = problem.integrator.variational, problem.integrator.stage_times
    alone = open_line(solution.controls, times) if problem.linear else open_loop(solution.controls)
    policy = solution.policy_on("momentum" if variational else "velocity", parts)
    m, n = problem.scene.controls, problem.scene.robot.dof
    fed = policy.commands(problem.steps * parts, m, n, variational=variational, stage_times=times)
    return alone._replace(hold=problem.hold * parts), fed


def _alternating(solution: Solution) -> list[Finding]:
    problem, motion = solution.problem, solution.trajectory
    found = alternation(motion.v)
    if found is None:
        return []
    if problem.sampling == "midpoint":
        why = "costs sampled at the midpoints of steps do not see it; sampling='gauss' does"
    elif problem.integrator.order < 4:
        why = f"{problem.integrator} is coarse at this dt; {_usual(problem)}, the default, is less so"
    else:
        why = "the optimum moves faster than the steps; a smaller dt, or a ControlRateCost, smooths it"
    return [Finding(_ALTERNATION, f"{found.sentence(motion.joint_names, motion.t)}: {why}")]


def _unfinished(solution: Solution) -> list[Finding]:
    """A finding if the search ended before it converged."""
    history = solution.history
    # No warning where the user asked for few iterations.
    cut = solution.status is Status.MAX_ITERATIONS and len(history) >= ITERATIONS
    ended = solution.status in (Status.STALLED, Status.INDEFINITE, Status.NOT_DIFFERENTIABLE)
    if not (cut or ended) or not history:
        return []
    expected_decrease = history[-1].expected_decrease
    # With a negligible expected decrease the plan is as good as converged, if it keeps to its constraints.
    little = expected_decrease <= _LITTLE * abs(solution.cost) and solution.violation <= FEASIBLE
    if solution.status is Status.STALLED and little:
        return []
    return [Finding("not converged", f"the search ended before it converged: {solution.reason}")]


def foreseen(problem: OptimalControlProblem) -> list[Finding]:
    """Findings about a problem before any search; values in wrong units come first."""
    found = hints(problem)
    units = [finding for finding in found if finding.kind in UNITS]
    return [*units, *starts_outside(problem), *(finding for finding in found if finding.kind not in UNITS)]


def starts_outside(problem: OptimalControlProblem) -> list[Finding]:
    """Findings about constraints that the start violates, so that the first step has to satisfy them."""
    found = []
    for bound in problem.bound_constraints:
        c = at_start(problem, bound)
        if c is None:
            continue
        row = int(np.argmax(c))
        if c[row] > REPORTED * bound.scale:
            found.append(
                Finding(
                    "start outside constraints",
                    f"the start is outside {problem.label_of(bound.source)}, {bound.rows[row]} by {c[row]:.2g} "
                    f"{bound.unit}, and the first node has to be inside. Begin inside, or widen the bound",
                    time=0.0,
                    value=float(c[row]),
                    unit=bound.unit,
                )
            )
    return found


def _friction_under_noise(solution: Solution) -> list[Finding]:
    """A finding if noise moves a joint by more than its dry friction is linear for."""
    problem, motion = solution.problem, solution.trajectory
    rubbing = of_kind(problem.scene.elements, "CoulombFriction")
    if not (problem.scene.processes and rubbing):
        return []
    try:
        steps = Steps(problem, motion)
        P, slopes = covariances(steps, Feedback(solution.gains, solution.previous_gains)), steps.slopes
    except LinearizationError:
        return []
    n = problem.scene.robot.dof
    worst, name, width, unit = 0.0, "", 0.0, ""
    for element in rubbing:
        c, own = element.coordinate, element.values[1]
        variance = np.einsum("kx,kxy,ky->k", slopes[:, n + c], P, slopes[:, n + c])
        spread = np.sqrt(np.maximum(variance, 0.0))
        # At speed dry friction is constant, and noise changes it little.
        slow = np.abs(motion.v[:, c]) < 3.0 * (own + spread)
        ratio = float((spread[slow] / own).max(initial=0.0))
        if ratio > worst:
            worst, name, width = ratio, motion.joint_names[c], own
            unit = joint_unit(problem.scene.robot, c, speed=True)
    if worst <= _LINEAR_FRICTION:
        return []
    return [
        Finding(
            "friction under noise",
            f"noise moves joint {name!r} by {worst:.2g} widths of its dry friction ({width:g} {unit}): noise_cost, "
            "gains and margins, which linearize it, may be wrong many times over. Use plan.monte_carlo()",
            name,
            value=worst,
            unit="widths",
        )
    ]


def _noise_in_halves(solution: Solution) -> list[Finding]:
    """A finding if noise costs other than planned in steps of half the length.

    One impulse a step is right to first order in the step, one held force to second order.
    """
    problem, scene = solution.problem, solution.problem.scene
    if not scene.processes or scene.inputs:
        return []
    dt, feedback = 0.5 * problem.dt, Feedback(solution.gains, solution.previous_gains)
    hold = 1 if problem.linear else 2 * problem.hold
    try:
        finer, failure = rollout(scene, problem.integrator, problem.q0, problem.v0, _in_parts(solution, 2)[1], dt)
        if failure is not None:
            return []
        in_halves = problem.at(dt=dt, hold=hold, integrator=problem.integrator)
        planned = noise_cost(Steps(problem, solution.trajectory), feedback)
        fine = noise_cost(Steps(in_halves, finer), feedback, halves=problem.linear)
    except VarpinError:
        # A custom noise or cost, or the linearization, may fail off the plan.
        return []
    off, most = abs(fine - planned), max(planned, fine)
    expected = abs(solution.cost) + most
    if off <= _NOISE_OFF * expected and (off <= _OF_NOISE * most or most <= _MATTERS * expected):
        return []
    closer = f"problem.at(dt={dt:g}, hold={hold}) is closer"
    if problem.linear:
        closer = f"problem.at(dt={dt:g}) is closer"
    return [
        Finding(
            "noise within steps",
            f"noise costs {fine:.3g} in half steps and {planned:.3g} in the plan's of dt = {problem.dt:g} s, as "
            f"plan.monte_carlo() does: the robot is nearer to the former, and {closer}",
            value=fine,
        )
    ]


def _margin_without_noise(solution: Solution) -> list[Finding]:
    """A finding about a margin without noise."""
    problem = solution.problem
    if problem.scene.processes or not any(constraint.margin > 0.0 for constraint in problem.constraints):
        return []
    text = "a constraint has a margin=, but the scene has no noise: the margin is zero"
    return [Finding("margin without noise", text)]


def _margins_of_velocities(solution: Solution) -> list[Finding]:
    """A finding where margins of velocities are wrong, as damping is fast for the step."""
    problem, motion = solution.problem, solution.trajectory
    n = problem.scene.robot.dof
    labels = {
        bound.source.label
        for bound in problem.bound_constraints
        if bound.source.margin > 0.0 and bound.jacobian(motion.q, motion.v)[:, :, n:].any()
    }
    if not labels:
        return []
    wrong = wrong_variances(problem.scene, motion, problem.integrator)
    where = ", ".join(sorted(labels))
    return [Finding("margins of velocities", f"the margin= of {where} may be wrong: {why}") for why in wrong]


def _between(solution: Solution) -> list[Finding]:
    """Findings about constraints that hold at the nodes and are violated between them."""
    problem, known = solution.problem, solution.multipliers
    if known is None or solution.violation > FEASIBLE:
        return []
    dt = problem.dt / PARTS
    # In parts of steps the controls alone may leave an unstable motion, and so may a feedback that is too fast.
    kept, least = None, np.inf
    for commands in _in_parts(solution):
        motion, failure = rollout(problem.scene, problem.integrator, problem.q0, problem.v0, commands, dt)
        if failure is None:
            away = float(np.abs(motion.q[::PARTS] - solution.trajectory.q).max())
            if away < least:
                kept, least = motion, away
    if kept is None:
        return []
    motion = kept
    found = []
    fine = problem.constraints_on(dt, problem.steps * PARTS, problem.hold * PARTS)
    margins = at_nodes(problem, known, known.backoff)
    for bound, whole, margin in zip(fine, problem.bound_constraints, margins, strict=True):
        if bound.of_controls or bound.source.equality:
            continue
        c = bound.value(motion.q, motion.v, problem.control_rows(motion))
        c = c + _within_steps(margin)
        outside = at_start(problem, whole)
        if outside is not None:
            # A row that is violated at the start cannot hold before the first node, so it is not reported there.
            c[: PARTS - 1, outside > 0.0] = -np.inf
        sample, row = np.unravel_index(int(np.argmax(c)), c.shape)
        if c[sample, row] > REPORTED * bound.scale:
            if c[sample, row] < _NARROWED * bound.scale:
                advice = "make the bound narrower by that much, or dt smaller"
                if not (problem.linear or problem.between_nodes):
                    advice = "between_nodes=True keeps it there, too; or " + advice
            else:
                advice = "the motion goes around the nodes; take a smaller dt"
                advice += ", or controls='held'" if problem.linear else ""
            found.append(
                Finding(
                    "constraints between nodes",
                    f"{problem.label_of(bound.source)} holds at the nodes, but between nodes {bound.rows[row]} is "
                    f"violated by {c[sample, row]:.2g} {bound.unit} at t = {bound.times[sample]:.4g} s: {advice}",
                    time=float(bound.times[sample]),
                    value=float(c[sample, row]),
                    unit=bound.unit,
                )
            )
    return found


def _within_steps(margin: Floats) -> Floats:
    """Margins (K PARTS, rows) in parts of steps, from those at the nodes after the first (K, rows).

    Their squares are linear in time, as variances under constant noise are, and no margin is larger than at the end.
    """
    squares = np.concatenate([np.zeros_like(margin[:1]), margin**2])
    share = np.arange(1, PARTS + 1)[:, None] / PARTS
    inner = squares[:-1, None] + share * (squares[1:] - squares[:-1])[:, None]
    found: Floats = np.minimum(np.sqrt(inner), margin[:, None]).reshape(-1, margin.shape[1])
    return found


def _restless(solution: Solution) -> list[Finding]:
    """A finding if a velocity oscillates, as it does at an optimum where the cost hardly weighs it."""
    problem = solution.problem
    # Velocities at the decisions: between them the controls are held.
    decided = solution.trajectory.v[:: problem.hold]
    found = restlessness(decided)
    if found is None:
        return []
    name = problem.scene.robot.joint_names[found.joint]
    return [
        Finding(
            _RESTLESS,
            f"the velocity of {name} goes up and down {found.changes} times in {len(decided) - 1} decisions, which the "
            "cost hardly weighs. A larger running VelocityCost calms it",
            name,
            value=float(found.changes),
        )
    ]


def _usual(problem: OptimalControlProblem) -> Integrator:
    return integrator_for(problem.scene, problem.q0, problem.dt)


def _sentence(problem: OptimalControlProblem, replay: Replay) -> str:
    """A plan's loss in finer steps, its reason, and what to change."""
    fed, alone = (percent(part) if np.isfinite(part) else "runs away" for part in (replay.feedback, replay.alone))
    dt = f"{problem.dt / PARTS:g}"
    finer = f"problem.at(dt={dt}, hold={problem.hold * PARTS}) decides as often in finer steps"
    if problem.linear or problem.scene.inputs:
        # Kinematic inputs cannot be held over several steps.
        finer = f"problem.at(dt={dt}) has finer steps"
    if -GAIN <= replay.alone <= LOSS:
        why = f"the feedback is too fast for the step; {finer}, and a greater weight on the controls slows it"
    elif problem.sampling != "gauss":
        why = f"costs sampled by the rule {problem.sampling!r} miss motion within steps; sampling='gauss' does not"
    elif problem.integrator.order < _usual(problem).order:
        why = f"{problem.integrator} is too coarse; {_usual(problem)}, the default, is closer, and {finer}"
    else:
        why = f"the steps do not resolve fast motion; {finer}"
    return (
        f"in quarters of dt = {problem.dt:g} s the plan costs other than planned: with feedback {fed}, "
        f"with its controls alone {alone}: {why}"
    )
