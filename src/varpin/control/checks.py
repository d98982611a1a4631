"""Checks of a plan: of its problem before the search, and of its motion, played again in parts of its steps."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from varpin.arrays import Floats
from varpin.control.constraints import (
    KeepClear,
    KeepInBox,
    KeepInHalfSpace,
    KeepInSphere,
    KeepOutOfSphere,
    PlanConstraint,
    ReachFrame,
    WithinJointLimits,
)
from varpin.control.costs import FramePositionCost, TrackingCost, weight_matrix
from varpin.control.history import ITERATIONS, Status
from varpin.control.margins import too_small
from varpin.control.multipliers import FEASIBLE, REPORTED, at_nodes
from varpin.control.noise import covariances, noise_cost
from varpin.control.problem import OptimalControlProblem
from varpin.control.solution import Solution
from varpin.control.stages import Feedback, Steps
from varpin.control.verification import Played, at_start, excess, in_parts, percent, played
from varpin.errors import VarpinError
from varpin.finding import Finding, announce
from varpin.linearization import wrong_variances
from varpin.mechanics.forces import of_kind
from varpin.mechanics.scene import closest_controls
from varpin.model import (
    ADVICE,
    AFAR,
    ASIDE,
    IN_MILLIMETRES,
    Robot,
    degrees_hint,
    joint_unit,
    looks_like_degrees,
    millimetres_hint,
)
from varpin.model.kinematics import FrameKinematics, frame_kinematics
from varpin.simulation.check import check
from varpin.simulation.record import rollout
from varpin.simulation.start import in_other_units

logger = logging.getLogger(__name__)

# Kinds of findings about goals in wrong units.
_UNITS = ("goal in millimetres", "goal in degrees")
# Parts of a step in which a plan is played again.
PARTS = 4
# Greatest relative excess over the plan's cost, and shortfall, without a warning: in parts of its steps, and of what a
# stalled search foresees.
LOSS, GAIN = 1e-3, 1e-2
# Part of the expected cost by which noise may cost other than planned in half steps without a warning.
_NOISE_OFF = 0.02
# Standard deviation of a velocity, in widths of its dry friction, up to which tanh is linear to 6 %.
_LINEAR_FRICTION = 0.25
# Least change of a velocity that counts as restlessness, as a share of the joint's largest velocity, and of the largest
# of all joints. Changes of sign from which on a warning is given: a share of the decisions, and at least a number, as
# each end of a motion under held controls has five or six, whatever the number of steps.
_CHANGE, _IDLE, _RESTLESS, _FEWEST = 1e-3, 1e-6, 0.12, 13
# Share of the torque that holds a posture which limits may be short of without a word.
_SHARE_OF_WEIGHT = 0.01
# Tolerance on positions and joint limits [m or rad].
_SAME = 1e-6


def looked_at(solution: Solution, before: Sequence[Finding] | None = None) -> tuple[Solution, tuple[Finding, ...]]:
    """Check a solution: returns it with its warnings, and the findings.

    The log has each warning once for a scene and a time step. Ctrl-C ends the checks and keeps the plan. ``before`` are
    the findings of :func:`foreseen` about its problem, where they are known.
    """
    try:
        found = findings(solution, before)
    except KeyboardInterrupt:
        found = (Finding("interrupted", "interrupted before the plan was played again: its accuracy is not known"),)
    announce(logger, solution.problem.scene.announced, solution.problem.dt, found)
    return replace(solution, warnings=found), found


def findings(solution: Solution, before: Sequence[Finding] | None = None) -> tuple[Finding, ...]:
    """Findings about a plan: its limits, convergence, noise, velocities, and its cost and constraints within steps."""
    problem, motion = solution.problem, solution.trajectory
    policy = solution.policy_on("momentum" if problem.integrator.variational else "velocity")
    of_motion = check(problem.scene, problem.integrator, motion, policy).warnings
    found = [*(foreseen(problem) if before is None else before)]
    found += [finding for finding in of_motion if finding.kind != "error"]
    if solution.refinement is not None and not solution.refinement.met:
        found.append(Finding("true cost", solution.refinement.reason))
    found += [*_unfinished(solution), *_noise(solution), *_restless(motion.joint_names, motion.v[:: problem.hold])]
    try:
        again = _again(solution)
    except VarpinError as error:
        return *found, Finding("replay", f"the plan cannot be replayed in steps of {1.0 / PARTS:g} dt: {error}")
    found += _between(solution, again)
    # A plan that is as true as it was wished to be has been looked at already.
    if (solution.refinement is None or not solution.refinement.met) and (dearer := _dearer(solution, again)):
        found += [dearer, *(finding for finding in of_motion if finding.kind == "error")]
    return tuple(found)


def _unfinished(solution: Solution) -> Iterator[Finding]:
    """A finding if the search ended before it converged, though not as the user asked for few iterations."""
    history = solution.history
    ended = solution.status in (Status.STALLED, Status.INDEFINITE, Status.NOT_DIFFERENTIABLE)
    if not (ended or (solution.status is Status.MAX_ITERATIONS and len(history) >= ITERATIONS)) or not history:
        return
    # With a negligible expected decrease the plan is as good as converged, if it keeps to its constraints.
    little = history[-1].expected_decrease <= LOSS * abs(solution.cost) and solution.violation <= FEASIBLE
    if not (solution.status is Status.STALLED and little):
        yield Finding("not converged", f"the search ended before it converged: {solution.reason}")


# Before the search


def foreseen(problem: OptimalControlProblem) -> list[Finding]:
    """Findings about a problem before any search; where values are in wrong units, these alone."""
    units = [*in_other_units(problem.scene, problem.q0)]
    goals = [*_goals(problem), *_ends(problem)]
    units += [*_in_degrees(problem), *_in_millimetres(problem), *(own for own in goals if own.kind in _UNITS)]
    return units or [*_starts_outside(problem), *goals, *_weights(problem)]


def _starts_outside(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Constraints that the start violates, so that the first step has to satisfy them."""
    for bound in problem.bound_constraints:
        c = at_start(problem, bound)
        if c is None:
            continue
        row = int(np.argmax(c))
        if c[row] > REPORTED * bound.scale:
            sentence = (
                f"the start is outside {problem.label_of(bound.source)}, {bound.rows[row]} by {c[row]:.2g} "
                f"{bound.unit}, and the first node has to be inside: begin inside, or widen the bound"
            )
            yield Finding("start outside constraints", sentence, time=0.0, value=float(c[row]), unit=bound.unit)


def _goals(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Goals and targets that their frame cannot reach."""
    robot, places = problem.scene.robot, []
    for goal in problem.constraints:
        if isinstance(goal, ReachFrame) and goal.position is not None:
            places.append((goal.label, goal.frame, np.eye(3), goal.position))
    for term in problem.cost.terms:
        if isinstance(term, FramePositionCost) and not callable(term.target):
            strengths, axes = np.linalg.eigh(weight_matrix("FramePositionCost", term.weight, 3))
            weighed = axes[:, strengths > _SAME * strengths[-1]]
            places.append((f"FramePositionCost({term.frame!r})", term.frame, weighed, np.asarray(term.target)))
    told = set()
    for label, frame, axes, place in places:
        kinematics = frame_kinematics(robot, frame)
        most, root = reach(robot, kinematics), kinematics.links.tree.translation[0]
        away = float(np.linalg.norm((np.atleast_2d(place) - root) @ axes, axis=1).max())
        if away > most * (1.0 + _SAME) and label not in told:
            told.add(label)
            kind, why = "goal out of reach", "no motion gets there"
            if away > AFAR * most:
                kind, why = "goal in millimetres", IN_MILLIMETRES
            sentence = (
                f"{label} has its goal {away:.4g} m from the first joint, and the frame gets {most:.4g} m from there "
                f"at most: {why}"
            )
            yield Finding(kind, sentence)


def reach(robot: Robot, frame: FrameKinematics) -> float:
    """Upper bound on a frame's distance from its first joint [m]; infinite on free rails.

    It is the shortest chain of hops from joint to joint, or over one revolute joint to the next but one.
    """
    links = frame.links.tree
    hops = [*links.translation[1:], frame.translation]
    lower, upper = robot.position_limits
    ends = np.array([lower, upper])[:, links.coordinate]
    slides = np.where(links.prismatic, np.abs(links.ratio * ends + links.offset).max(axis=0), 0.0)
    most = [0.0]
    for k, hop in enumerate(hops):
        ways = [most[k] + slides[k] + np.linalg.norm(hop)]
        if k > 0 and not links.prismatic[k]:
            # Turned about joint k, the hop leads farthest away where it points away from its axis as the one before.
            before = links.rotation[k].T @ hops[k - 1]
            across = np.hypot(*before[:2]) + np.hypot(*hop[:2])
            ways.append(most[k - 1] + slides[k - 1] + np.hypot(across, before[2] + hop[2]))
        most.append(float(min(ways)))
    return most[-1]


def _postures(problem: OptimalControlProblem) -> Iterator[Floats]:
    """Goal configurations (n,) of terminal costs."""
    for term in problem.cost.terms:
        end = term.reference if isinstance(term, TrackingCost) and term.at_end else None
        if isinstance(end, np.ndarray) and end.shape == problem.q0.shape:
            yield end


def _ends(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Goal configurations that look like degrees, or are outside of joint limits."""
    robot = problem.scene.robot
    for end in _postures(problem):
        if sentence := degrees_hint(robot, "the goal of the terminal TrackingCost", end):
            yield Finding("goal in degrees", sentence)
        for limits in problem.constraints:
            if isinstance(limits, WithinJointLimits):
                beyond = np.maximum(end - limits.limits[1], limits.limits[0] - end)
                joint = int(np.argmax(beyond))
                if beyond[joint] > _SAME:
                    sentence = (
                        f"the terminal TrackingCost has its goal for {robot.joint_names[joint]} {beyond[joint]:.4g} "
                        f"{joint_unit(robot, joint)} outside {limits.label}, where the plan will not end"
                    )
                    yield Finding("goal outside constraints", sentence)


def _weights(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Limits of joint torques that cannot hold the arm at rest where it starts, or where it is to end."""
    scene, names = problem.scene, problem.scene.robot.joint_names
    if not problem.limited or scene.constraints or not (scene.direct and scene.direct_efforts):
        return
    postures: list[tuple[str, Floats]] = [] if problem.v0.any() else [("the start", problem.q0)]
    postures += [("the goal of the terminal TrackingCost", end) for end in _postures(problem)]
    for where, q in postures:
        needed, (lower, upper) = closest_controls(scene, q), problem.control_limits
        beyond = np.maximum(needed - upper, lower - needed)
        joint = int(np.argmax(beyond))
        if beyond[joint] > _SHARE_OF_WEIGHT * abs(needed[joint]):
            sentence = (
                f"control limits cannot hold the arm at rest at {where}: joint {names[joint]!r} needs "
                f"{needed[joint]:.3g}, and its limits are {lower[joint]:.3g} and {upper[joint]:.3g}"
            )
            yield Finding("limits below the weight", sentence, joint=names[joint], value=float(needed[joint]))


def _in_degrees(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Limits of joints that look like degrees."""
    robot = problem.scene.robot
    for limits in problem.constraints:
        if not isinstance(limits, WithinJointLimits):
            continue
        # Limits of the robot's description are in radians, however wide.
        given = np.isfinite(limits.limits) & (limits.limits != robot.position_limits) & ~robot.slides
        most = np.where(given, np.abs(limits.limits), 0.0).max(axis=0)
        joint = int(np.argmax(most))
        if looks_like_degrees(most[joint]):
            sentence = (
                f"{limits.label} lets {robot.joint_names[joint]} turn to {most[joint]:.4g} rad, "
                f"{most[joint] / (2.0 * np.pi):.0f} turns, and looks like degrees: {ADVICE}"
            )
            yield Finding("limits in degrees", sentence)


def _in_millimetres(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Obstacles and regions whose places or sizes look like millimetres."""
    robot = problem.scene.robot
    for constraint in problem.constraints:
        lengths = _lengths(constraint)
        sentence = millimetres_hint(robot, lengths) if lengths else ""
        if isinstance(constraint, KeepClear) and not sentence:
            sentence = millimetres_hint(robot, {"KeepClear: distance": abs(constraint.distance)}, ASIDE)
        if sentence:
            yield Finding("places in millimetres", sentence)


def _lengths(constraint: PlanConstraint) -> dict[str, float]:
    """Names of a constraint's lengths, and their sizes [m]; places count by their distance from the robot's root."""
    name, found = type(constraint).__name__, {}
    if isinstance(constraint, KeepClear):
        root = constraint.robot.tree.translation[0]
        for body in constraint.obstacles:
            label = f"{name}: the obstacle {body.name!r}"
            found[f"{label}: its distance"] = float(min(np.linalg.norm(x - root) for x in (body.begin, body.end)))
            sides = body.sides if body.hull is None else body.hull.sides
            found[f"{label}: its radius or side"] = body.radius if sides is None else float(sides.max())
    elif isinstance(constraint, KeepInSphere | KeepOutOfSphere):
        found = {f"{name}: radius": constraint.radius}
        if not callable(constraint.center):
            root = constraint.robot.tree.translation[0]
            found[f"{name}: the distance of its centre"] = float(np.linalg.norm(constraint.center - root))
    elif isinstance(constraint, KeepInHalfSpace):
        found = {f"{name}: offset": abs(constraint.offset)}
    elif isinstance(constraint, KeepInBox):
        # One far side may stand for none.
        sides = np.abs(constraint.limits[np.isfinite(constraint.limits)])
        found = {f"{name}: its nearest side": float(sides[sides > 0.0].min(initial=np.inf)) if sides.any() else 0.0}
    return found


# The finished plan


def _restless(joints: Sequence[str], v: Floats) -> Iterator[Finding]:
    """A finding if a velocity goes up and down at decisions (R, n), as it does where the cost hardly weighs it."""
    if (restless := restlessness(v)) is not None:
        joint, changes = restless
        sentence = (
            f"the velocity of {joints[joint]} goes up and down {changes} times in {len(v) - 1} decisions, which the "
            "cost hardly weighs: a larger running VelocityCost, or sampling='gauss', calms it"
        )
        yield Finding("restless velocities", sentence, joints[joint], value=float(changes))


def restlessness(v: Floats) -> tuple[int, int] | None:
    """The joint whose velocity (N + 1, n) turns round most often and how often, if that is worth a warning."""
    fastest, change = np.abs(v).max(axis=0, initial=0.0), np.diff(v, axis=0)
    counts = np.abs(change) > np.maximum(_CHANGE * fastest, _IDLE * fastest.max(initial=0.0))
    turns = ((change[1:] * change[:-1] < 0.0) & counts[1:] & counts[:-1]).sum(axis=0)
    most = int(turns.max(initial=0))
    return (int(turns.argmax()), most) if most >= max(_FEWEST, _RESTLESS * len(change)) else None


def _again(solution: Solution) -> list[Played]:
    """A plan in parts of its steps, without noise: under its controls alone, and with feedback at its own rate.

    The integrator is the plan's, whose error falls with its order. :meth:`Solution.verify` does the same to many
    digits, in more time.

    Raises:
        VarpinError: A custom cost or noise field fails off the plan.
    """
    problem, known = solution.problem, solution.multipliers
    margins = None if known is None else at_nodes(problem, known, known.backoff)
    fine, by = problem.in_parts(PARTS), problem.integrator
    commands = in_parts(problem, solution.controls, solution.policy_on, by, PARTS)
    return [played(problem, fine, each, by, margins) for each in commands]


def _dearer(solution: Solution, again: Sequence[Played]) -> Finding | None:
    """A finding if a plan with feedback costs other than planned in parts of its steps."""
    problem = solution.problem
    first = np.inf if solution.search is None else abs(solution.search.first)
    # Where the optimum costs nothing, the excess is relative to the cost at stake at the beginning.
    base = abs(solution.cost) + (1e-9 * first if np.isfinite(first) else 0.0)
    lost = [excess(base + own.cost - solution.cost, base) for own in again]
    if -GAIN <= lost[1] <= LOSS:
        return None
    alone, fed = (percent(part) if np.isfinite(part) else "runs away" for part in lost)
    advice = f"problem.at(dt={problem.dt / PARTS:g}, hold={problem.hold * PARTS}) decides as often in finer steps"
    if problem.linear or problem.scene.inputs:
        advice = f"problem.at(dt={problem.dt / PARTS:g}) has finer steps"
    if problem.sampling != "gauss":
        advice = f"sampling='gauss' sees the motion within steps, {problem.sampling!r} does not"
    sentence = (
        f"in quarters of dt = {problem.dt:g} s the plan costs other than planned, with feedback {fed}, with its "
        f"controls alone {alone}: {advice}"
    )
    return Finding("replay", sentence)


def _between(solution: Solution, again: Sequence[Played]) -> Iterator[Finding]:
    """Constraints that hold at the nodes and are violated between them."""
    problem = solution.problem
    if solution.multipliers is None or solution.violation > FEASIBLE:
        return
    # In parts of steps the controls alone may leave an unstable motion, and so may a feedback that is too fast.
    away = [np.abs(own.nodes - solution.trajectory.q).max() for own in again]
    if np.isnan(away).all():
        return
    for bound, outside in zip(problem.bound_constraints, again[int(np.nanargmin(away))].outside, strict=True):
        if bound.of_controls or bound.source.equality or outside.worst <= REPORTED * bound.scale:
            continue
        advice = "a smaller dt or a bound narrower by that much keeps it there"
        if not (problem.linear or problem.between_nodes):
            advice = f"between_nodes=True, {advice}"
        sentence = (
            f"{problem.label_of(bound.source)} holds at the nodes, but between nodes {outside.row} is violated by "
            f"{outside.worst:.2g} {bound.unit} at t = {outside.time:.4g} s: {advice}"
        )
        kind = "constraints between nodes"
        yield Finding(kind, sentence, time=outside.time, value=outside.worst, unit=bound.unit)


# Noise


def _noise(solution: Solution) -> Iterator[Finding]:
    """Findings about noise that the linear model of a plan does not have as it is."""
    problem, motion = solution.problem, solution.trajectory
    margins = [bound for bound in problem.bound_constraints if bound.source.margin > 0.0]
    if not problem.scene.processes:
        if margins:
            yield Finding("margin without noise", "a constraint has a margin=, but the scene has no noise: it is zero")
        return
    n = problem.scene.robot.dof
    of_speeds = {own.source.label for own in margins if own.jacobian(motion.q, motion.v)[:, :, n:].any()}
    if of_speeds:
        for why in wrong_variances(problem.scene, motion, problem.integrator):
            sentence = f"the margin= of {', '.join(sorted(of_speeds))} may be wrong: {why}"
            yield Finding("margins of velocities", sentence)
    yield from too_small(solution)
    # A custom noise or cost, or the linearization, may fail off the plan.
    for look in (_friction, _in_halves):
        try:
            yield from look(solution)
        except VarpinError as error:
            logger.info("%s: %s", problem.scene.robot.name, error)


def _friction(solution: Solution) -> Iterator[Finding]:
    """A finding if noise moves a joint by more than its dry friction is linear for."""
    problem, motion, worst = solution.problem, solution.trajectory, _LINEAR_FRICTION
    rubbing, n = of_kind(problem.scene.elements, "CoulombFriction"), problem.scene.robot.dof
    if not rubbing:
        return
    steps = Steps(problem, motion)
    P, slopes = covariances(steps, Feedback(solution.gains, solution.previous_gains)), steps.slopes
    spread = np.sqrt(np.maximum(np.einsum("kvx,kxy,kvy->kv", slopes[:, n:], P, slopes[:, n:]), 0.0))
    found = None
    for element in rubbing:
        c, width = element.coordinate, element.values[1]
        # At speed dry friction is constant, and noise changes it little.
        slow = np.abs(motion.v[:, c]) < 3.0 * (width + spread[:, c])
        ratio = float((spread[slow, c] / width).max(initial=0.0))
        if ratio > worst:
            worst, name = ratio, motion.joint_names[c]
            sentence = (
                f"noise moves joint {name!r} by {ratio:.2g} widths of its dry friction ({width:g} "
                f"{joint_unit(problem.scene.robot, c, speed=True)}), which noise_cost, gains and margins take as "
                "linear: use plan.monte_carlo()"
            )
            found = Finding("friction under noise", sentence, name, value=ratio, unit="widths")
    if found is not None:
        yield found


def _in_halves(solution: Solution) -> Iterator[Finding]:
    """A finding if noise costs other than planned in steps of half the length.

    One impulse a step is right to first order in the step, one held force to second order.
    """
    problem, feedback = solution.problem, Feedback(solution.gains, solution.previous_gains)
    if problem.scene.inputs:
        return
    fine, by = problem.in_parts(2), problem.integrator
    commands = in_parts(problem, solution.controls, solution.policy_on, by, 2)[1]
    finer, failure = rollout(problem.scene, by, problem.q0, problem.v0, commands, fine.dt)
    if failure is not None:
        return
    planned = noise_cost(Steps(problem, solution.trajectory), feedback)
    cost = noise_cost(Steps(fine, finer), feedback, halves=problem.linear)
    if abs(cost - planned) > _NOISE_OFF * (abs(solution.cost) + max(planned, cost)):
        closer = f"problem.at(dt={fine.dt:g}{'' if problem.linear else f', hold={fine.hold}'})"
        sentence = (
            f"noise costs {cost:.3g} in half steps and {planned:.3g} in the plan's of dt = {problem.dt:g} s, as "
            f"plan.monte_carlo() does: the robot is nearer to the former, and {closer} is closer"
        )
        yield Finding("noise within steps", sentence, value=cost)
