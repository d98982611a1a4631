"""The look that is taken at a finished plan: does the robot do, at finer steps, what the plan promises?"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from varpin.control.history import ITERATIONS, Status
from varpin.control.problem import OptimalControlProblem, default_integrator
from varpin.control.solution import Solution
from varpin.control.verification import accurate_cost, percent
from varpin.errors import VarpinError
from varpin.integrators.base import open_loop
from varpin.simulation.chatter import alternation, restlessness
from varpin.simulation.soundness import Finding, announce, evident, examined

logger = logging.getLogger(__name__)

# Parts of a step in which a plan is played again.
PARTS = 4
# Of a plan's cost, what a robot may pay above it, and below it, without a word.
LOSS, GAIN = 1e-3, 1e-2
# Findings about single steps; what they come to over a whole plan, playing it again tells.
_OF_STEPS = ("coarse steps", "fast damping", "split steps")
# Of its cost, what a search that stalls may still promise without a word.
_LITTLE = 1e-3
_ALTERNATION, _RESTLESS = "alternating velocities", "restless velocities"


@dataclass(frozen=True)
class Replay:
    """What a plan costs beyond its promise when its steps are taken in parts, relative to its cost.

    NaN where the motion cannot go on, or has no cost.

    Attributes:
        alone: With its controls alone.
        feedback: With its feedback, at the plan's own rate.
    """

    alone: float
    feedback: float

    @property
    def holds(self) -> bool:
        """Whether the plan with its feedback costs what it promises."""
        return -GAIN <= self.feedback <= LOSS


def looked_at(solution: Solution) -> tuple[Solution, tuple[Finding, ...]]:
    """The solution with its warnings, which the log has once for a scene and a time step; and what was found.

    Ctrl-C ends the look and not the plan.
    """
    try:
        found = findings(solution)
    except KeyboardInterrupt:
        found = (Finding("interrupted", "interrupted before the plan was played again: what it is worth is not known"),)
    problem = solution.problem
    announce(logger, problem.scene, problem.dt, found)
    return replace(solution, warnings=tuple(finding.sentence for finding in found)), found


def findings(solution: Solution) -> tuple[Finding, ...]:
    """What is to be said of a plan: its energy, its velocities if they are restless, and what the robot makes of it."""
    problem, motion = solution.problem, solution.trajectory
    _, found = examined(problem.scene, problem.integrator, motion)
    told = [finding for finding in found if finding.kind not in (*_OF_STEPS, _ALTERNATION)]
    told += _unfinished(solution) + (_alternating(solution) or _restless(solution))
    try:
        replay = replayed(solution)
    except VarpinError as error:
        steps = f"{1.0 / PARTS:g} dt"
        return *told, Finding("replay", f"the plan cannot be played again in steps of {steps}: {error}")
    if replay.holds:
        return tuple(told)
    told.append(Finding("replay", _sentence(problem, replay)))
    reasons = [finding for finding in found if finding.kind in _OF_STEPS]
    # What is no fault of the motion may be one of the plan.
    record = evident(problem.scene, problem.integrator, motion)
    return *told, *(reasons or [finding for finding in record if finding.kind in _OF_STEPS])


def replayed(solution: Solution) -> Replay:
    """Play a plan again, without noise and under the same held controls, in steps of a quarter of its own.

    The integrator is the plan's: what it has wrong at dt it has less wrong at a quarter of that, by its order. Costs
    are integrated by Simpson's rule. :meth:`Solution.verify` tells the same to many digits, for more time.

    Raises:
        VarpinError: A cost or a noise field of one's own fails off the plan.
    """
    problem = solution.problem
    variational = problem.integrator.variational
    alone = open_loop(solution.controls)._replace(hold=problem.hold * PARTS)
    policy = solution.policy_on("momentum" if variational else "velocity", PARTS)
    m, n = problem.scene.controls, problem.scene.robot.dof
    fed = policy.commands(problem.steps * PARTS, m, n, variational=variational)
    first = np.inf if solution.search is None else abs(solution.search.first)
    # Where the optimum costs nothing, there is nothing to be relative to but where the search began.
    base = abs(solution.cost) + (1e-9 * first if np.isfinite(first) else 0.0)
    costs = [accurate_cost(problem, commands, PARTS, integrator=problem.integrator)[0] for commands in (alone, fed)]
    # What the quarters still have wrong themselves.
    whole = 1.0 - float(PARTS) ** -problem.integrator.order
    lost = [0.0 if cost == solution.cost else (cost - solution.cost) / (whole * (base or 1.0)) for cost in costs]
    return Replay(*lost)


def _alternating(solution: Solution) -> list[Finding]:
    problem, motion = solution.problem, solution.trajectory
    found = alternation(motion.v)
    if found is None:
        return []
    name = problem.scene.robot.joint_names[found.joint]
    if problem.sampling == "midpoint":
        why = "costs sampled at the midpoints of steps do not see it; sampling='gauss' does"
    elif problem.integrator.order < 4:
        why = f"{problem.integrator} is coarse at this dt; {default_integrator()}, the default, is less so"
    else:
        why = "the optimum moves faster than the steps; a smaller dt, or a ControlRateCost, smooths it"
    return [
        Finding(
            _ALTERNATION,
            f"the velocity of {name} alternates from step to step, {found.changes} times in a row from "
            f"t = {motion.t[found.first]:.4g} s on: {why}",
        )
    ]


def _unfinished(solution: Solution) -> list[Finding]:
    """Says if the search ended without a plan that it could call the best."""
    history = solution.history
    # Who asks for few iterations knows that there were few.
    cut = solution.status is Status.MAX_ITERATIONS and len(history) >= ITERATIONS
    ended = solution.status in (Status.STALLED, Status.INDEFINITE, Status.NOT_DIFFERENTIABLE)
    if not (cut or ended) or not history:
        return []
    promised = history[-1].expected_decrease
    # What promises next to nothing is as good as the best.
    if solution.status is Status.STALLED and promised <= _LITTLE * abs(solution.cost):
        return []
    return [Finding("not converged", solution.reason)]


def _restless(solution: Solution) -> list[Finding]:
    """Says if a velocity goes up and down all the time: what costs hardly weigh, an optimum makes use of."""
    problem = solution.problem
    # Between decisions a velocity does what held controls leave it to.
    decided = solution.trajectory.v[:: problem.hold]
    found = restlessness(decided)
    if found is None:
        return []
    name = problem.scene.robot.joint_names[found.joint]
    return [
        Finding(
            _RESTLESS,
            f"the velocity of {name} goes up and down {found.changes} times in {len(decided) - 1} decisions: where "
            "the task does not ask for it, the cost hardly weighs it; a running VelocityCost, even a small one, calms "
            "it",
            found.joint,
        )
    ]


def _sentence(problem: OptimalControlProblem, replay: Replay) -> str:
    """What a plan loses in finer steps, why, and what to change."""
    fed, alone = (percent(part) if np.isfinite(part) else "runs away" for part in (replay.feedback, replay.alone))
    finer = f"problem.at(dt={problem.dt / PARTS:g}, hold={problem.hold * PARTS}) decides as often in finer steps"
    if -GAIN <= replay.alone <= LOSS:
        why = f"the feedback is too fast for the step; {finer}, and a greater weight on the controls slows it"
    elif problem.sampling != "gauss":
        why = (
            f"costs sampled by the rule {problem.sampling!r} miss what happens within steps; sampling='gauss' does not"
        )
    elif problem.integrator.order < default_integrator().order:
        why = f"{problem.integrator} is too coarse; {default_integrator()}, the default, is closer, and {finer}"
    else:
        why = f"what is fast here is not resolved; {finer}"
    return (
        f"in quarters of dt = {problem.dt:g} s the plan costs other than planned, with feedback {fed}, "
        f"with its controls alone {alone}: {why}"
    )
