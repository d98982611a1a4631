"""Checks of a plan: of its problem before the search, and of its motion, played again in parts of its steps."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from varpin.arrays import Floats
from varpin.control.constraints import ReachFrame, WithinJointLimits
from varpin.control.costs import TrackingCost
from varpin.control.costs.base import BoundTerm
from varpin.control.history import percent
from varpin.control.margins import too_small
from varpin.control.noise import covariances, noise_cost
from varpin.control.problem import OptimalControlProblem
from varpin.control.sizes import FEASIBLE, HARMLESS, NOTABLE, SLIGHT, TRACE
from varpin.control.solution import Solution
from varpin.control.stages import Feedback, Steps
from varpin.control.verification import Played, excess, in_parts, replays
from varpin.core import Subject
from varpin.errors import VarpinError
from varpin.finding import Finding, announce, ranked
from varpin.mechanics.forces import of_kind
from varpin.mechanics.scene import closest_controls
from varpin.model import in_degrees, joint_unit
from varpin.model.kinematics import FrameKinematics, reach
from varpin.simulation.check import Case, check
from varpin.simulation.record import rollout
from varpin.simulation.start import start_in_degrees
from varpin.simulation.velocity_noise import wrong_spread

logger = logging.getLogger(__name__)

# Parts of a step in which a plan is played again; from 2 to 8.
_PARTS = 4
# Standard deviation of a velocity, in widths of its dry friction, up to which tanh is linear to 6 %.
_LINEAR_FRICTION = 0.25


def looked_at(solution: Solution) -> Solution:
    """A solution with its warnings. The log has each once for a scene and a step. Ctrl-C ends the checks alone."""
    try:
        found = findings(solution)
    except KeyboardInterrupt:
        found = (Finding("interrupted", "interrupted before the plan was played again: its accuracy is not known"),)
    announce(logger, solution.problem.scene.announced, solution.problem.dt, found)
    return replace(solution, warnings=found)


def findings(solution: Solution) -> tuple[Finding, ...]:
    """Findings about a plan: its limits, its noise, and its cost and constraints within steps."""
    problem, motion = solution.problem, solution.trajectory
    of_motion = check(Case(problem.scene, problem.integrator, motion, solution.policy)).warnings
    found = [*foreseen(problem), *(finding for finding in of_motion if finding.kind != "error")]
    met = solution.refinement is not None and solution.refinement.met
    if solution.refinement is not None and not met:
        found.append(Finding("true cost", solution.refinement.reason))
    found += _noise(solution)
    try:
        again = replays(solution, problem.integrator, _PARTS)
    except VarpinError as error:
        return *found, Finding("replay", f"the plan cannot be replayed in steps of {1.0 / _PARTS:g} dt: {error}")
    found += _between(solution, again)
    # A plan that is as true as it was wished to be has been looked at already.
    if not met and (dearer := _dearer(solution, again)):
        found += [dearer, *(finding for finding in of_motion if finding.kind == "error")]
    return tuple(found)


# Before the search


def foreseen(problem: OptimalControlProblem) -> list[Finding]:
    """Findings about a problem before any search; where values look like degrees, these alone."""
    return [*ranked(_in_degrees(problem))] or [
        *_starts_outside(problem),
        *_goals(problem),
        *_outside(problem),
        *_weights(problem),
    ]


def _starts_outside(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Constraints that the start violates, so that the first step has to satisfy them."""
    for i in problem.throughout:
        bound, c = problem.bound_constraints[i], problem.at_start(i)
        if c[row := int(np.argmax(c))] > NOTABLE * bound.scale:
            sentence = (
                f"the start is outside {problem.label_of(bound.source)}, {bound.rows[row]} by {c[row]:.2g} "
                f"{bound.unit}, and the first node after it has to be inside: begin inside, or widen the bound"
            )
            yield Finding("start outside constraints", sentence, time=0.0, value=float(c[row]), unit=bound.unit)


def _goals(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Goals and targets that their frame cannot reach."""
    robot, places = problem.scene.robot, list[tuple[str, FrameKinematics, Floats, Floats]]()
    for term in _terms(problem):
        if term.subject == Subject.position and isinstance(term.of, FrameKinematics):
            strengths, axes = np.linalg.eigh(term.weight)
            weighed = axes[:, strengths > TRACE * strengths[-1]]
            places.append((f"FramePositionCost({term.of.frame!r})", term.of, weighed, term.target))
    for goal in problem.constraints:
        if isinstance(goal, ReachFrame) and goal.position is not None:
            places.append((goal.label, goal.kinematics, np.eye(3), goal.position[None]))
    for label, kinematics, axes, place in places:
        most, root = reach(robot, kinematics), kinematics.links.tree.translation[0]
        away = float(np.linalg.norm((place - root) @ axes, axis=1).max())
        if away > most * (1.0 + TRACE):
            sentence = (
                f"{label} has its goal {away:.4g} m from the first joint, and the frame gets {most:.4g} m from there "
                "at most: no motion gets there"
            )
            yield Finding("goal out of reach", sentence)


def _terms(problem: OptimalControlProblem) -> Iterator[BoundTerm]:
    """The terms of the cost that the core evaluates, with their targets at the samples."""
    for _, part in (*problem.running.parts, *problem.terminal.parts):
        if isinstance(part, BoundTerm):
            yield part


def _postures(problem: OptimalControlProblem) -> Iterator[Floats]:
    """Goal configurations (n,) of terminal costs."""
    for term in problem.cost.terms:
        end = term.reference if isinstance(term, TrackingCost) and term.at_end else None
        if isinstance(end, np.ndarray) and end.shape == problem.q0.shape:
            yield end


def _outside(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Goal configurations outside of joint limits."""
    robot = problem.scene.robot
    for end, own in itertools.product(_postures(problem), problem.constraints):
        if not isinstance(own, WithinJointLimits):
            continue
        beyond = np.maximum(end - own.limits[1], own.limits[0] - end)
        joint = int(np.argmax(beyond))
        if beyond[joint] > FEASIBLE:
            sentence = (
                f"the terminal TrackingCost has its goal for {robot.joint_names[joint]} {beyond[joint]:.4g} "
                f"{joint_unit(robot, joint)} outside {own.label}, where the plan will not end"
            )
            yield Finding("goal outside constraints", sentence)


def _weights(problem: OptimalControlProblem) -> Iterator[Finding]:
    """Limits of joint torques that cannot hold the arm at rest where it starts, or where it is to end."""
    scene, names = problem.scene, problem.scene.robot.joint_names
    if not problem.limited or scene.constraints or not scene.direct or scene.servo_joints or scene.inputs:
        return
    postures: list[tuple[str, Floats]] = [] if problem.v0.any() else [("the start", problem.q0)]
    postures += [("the goal of the terminal TrackingCost", end) for end in _postures(problem)]
    for where, q in postures:
        needed, (lower, upper) = closest_controls(scene, q), problem.control_limits
        beyond = np.maximum(needed - upper, lower - needed)
        joint = int(np.argmax(beyond))
        if beyond[joint] > NOTABLE * abs(needed[joint]):
            sentence = (
                f"control limits cannot hold the arm at rest at {where}: joint {names[joint]!r} needs "
                f"{needed[joint]:.3g}, and its limits are {lower[joint]:.3g} and {upper[joint]:.3g}"
            )
            yield Finding("limits below the weight", sentence, joint=names[joint], value=float(needed[joint]))


def _in_degrees(problem: OptimalControlProblem) -> Iterator[Finding]:
    """The start, references and limits of joints that look like degrees."""
    robot = problem.scene.robot
    yield from start_in_degrees(problem.scene, problem.q0, problem.v0)
    for term in _terms(problem):
        if term.subject == Subject.entries and term.of == 0:
            yield from in_degrees(robot, "the reference of a TrackingCost", term.target)
    for own in problem.constraints:
        if isinstance(own, WithinJointLimits):
            yield from in_degrees(robot, f"{own.label}: the limit", own.limits)


# The finished plan


def _dearer(solution: Solution, again: Sequence[Played]) -> Finding | None:
    """A finding if a plan with feedback costs other than planned in parts of its steps."""
    problem = solution.problem
    first = np.inf if solution.search is None else abs(solution.search.first)
    # Where the optimum costs nothing, the excess is relative to the cost at stake at the beginning.
    base = abs(solution.cost) + (HARMLESS * first if np.isfinite(first) else 0.0)
    lost = [excess(base + own.cost - solution.cost, base) for own in again]
    if -NOTABLE <= lost[1] <= SLIGHT:
        return None
    alone, fed = (percent(part) if np.isfinite(part) else "runs away" for part in lost)
    advice = f"{_finer(problem, _PARTS)} has finer steps"
    if problem.sampling != "gauss":
        advice = f"sampling='gauss' sees the motion within steps, {problem.sampling!r} does not"
    sentence = (
        f"in quarters of dt = {problem.dt:g} s the plan costs other than planned, with feedback {fed}, with its "
        f"controls alone {alone}: {advice}"
    )
    return Finding("replay", sentence)


def _finer(problem: OptimalControlProblem, parts: int) -> str:
    """The call that gives the problem finer steps and as many decisions."""
    hold = "" if problem.linear or problem.scene.inputs else f", hold={problem.hold * parts}"
    return f"problem.at(dt={problem.dt / parts:g}{hold})"


def _between(solution: Solution, again: Sequence[Played]) -> Iterator[Finding]:
    """Constraints that hold at the nodes and are violated between them."""
    problem = solution.problem
    if solution.multipliers is None or solution.violation > FEASIBLE:
        return
    # In parts of steps the controls alone may leave an unstable motion, and so may a feedback that is too fast.
    away = [np.abs(own.nodes - solution.trajectory.q).max() for own in again]
    if np.isnan(away).all():
        return
    reports = again[int(np.nanargmin(away))].reports
    for bound, outside in ((problem.bound_constraints[i], reports[i]) for i in problem.throughout):
        if outside.violation <= NOTABLE * bound.scale:
            continue
        advice = "a smaller dt or a bound narrower by that much keeps it there"
        if not (problem.linear or problem.between_nodes):
            advice = f"between_nodes=True, {advice}"
        sentence = (
            f"{outside.label} holds at the nodes, but between nodes it is violated by {outside.violation:.2g} "
            f"{bound.unit}, {outside.where}: {advice}"
        )
        time = float(outside.t[outside.excess.max(axis=1).argmax()])
        yield Finding("constraints between nodes", sentence, time=time, value=outside.violation, unit=bound.unit)


# Noise


def _noise(solution: Solution) -> Iterator[Finding]:
    """Findings about noise that the linear model of a plan does not have as it is."""
    problem, motion, n = solution.problem, solution.trajectory, solution.problem.scene.robot.dof
    margins = [bound for bound in problem.bound_constraints if bound.source.margin > 0.0]
    if not problem.scene.processes:
        if margins:
            yield Finding("margin without noise", "a constraint has a margin=, but the scene has no noise: it is zero")
        return
    of_speeds = {own.source.label for own in margins if own.jacobian(motion.q, motion.v)[:, :, n:].any()}
    for why in wrong_spread(problem.scene, problem.integrator, motion) if of_speeds else ():
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
    problem, motion, n = solution.problem, solution.trajectory, solution.problem.scene.robot.dof
    rubbing = of_kind(problem.scene.elements, "CoulombFriction")
    if not rubbing:
        return
    steps = Steps(problem, motion)
    of_speeds = steps.slopes[:, n:]
    P = covariances(steps, Feedback(solution.gains, solution.previous_gains))
    spread = np.sqrt(np.maximum(np.einsum("kvx,kxy,kvy->kv", of_speeds, P, of_speeds), 0.0))
    joints, widths = [own.coordinate for own in rubbing], np.array([own.values[1] for own in rubbing])
    # At speed dry friction is constant, and noise changes it little.
    slow = np.abs(motion.v[:, joints]) < 3.0 * (widths + spread[:, joints])
    ratios = np.where(slow, spread[:, joints] / widths, 0.0).max(axis=0)
    worst = int(ratios.argmax())
    if ratios[worst] > _LINEAR_FRICTION:
        name, unit = motion.joint_names[joints[worst]], joint_unit(problem.scene.robot, joints[worst], speed=True)
        sentence = (
            f"noise moves joint {name!r} by {ratios[worst]:.2g} widths of its dry friction ({widths[worst]:g} {unit}), "
            "which noise_cost, gains and margins take as linear: use plan.monte_carlo()"
        )
        yield Finding("friction under noise", sentence, name, value=float(ratios[worst]), unit="widths")


def _in_halves(solution: Solution) -> Iterator[Finding]:
    """A finding if noise costs other than planned in steps of half the length.

    One impulse a step is right to first order in the step, one held force to second order.
    """
    problem, feedback = solution.problem, Feedback(solution.gains, solution.previous_gains)
    if problem.scene.inputs:
        return
    fine, by = problem.in_parts(2), problem.integrator
    commands = in_parts(solution, by, 2)[1]
    finer, failure = rollout(problem.scene, by, problem.q0, problem.v0, commands, fine.dt)
    if failure is not None:
        return
    planned = noise_cost(Steps(problem, solution.trajectory), feedback)
    cost = noise_cost(Steps(fine, finer), feedback, halves=problem.linear)
    if abs(cost - planned) > NOTABLE * (abs(solution.cost) + max(planned, cost)):
        sentence = (
            f"noise costs {cost:.3g} in half steps and {planned:.3g} in the plan's of dt = {problem.dt:g} s, as "
            f"plan.monte_carlo() does: the robot is nearer to the former, and {_finer(problem, 2)} is closer"
        )
        yield Finding("noise within steps", sentence, value=cost)
