"""The plan of the coarsest step whose cost agrees with the cost on the continuous system."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from varpin.control.history import Status
from varpin.control.problem import OptimalControlProblem
from varpin.control.refined import Refined, Refinement, part
from varpin.control.solution import Solution
from varpin.control.verification import excess, true_costs
from varpin.errors import InputError, VarpinError
from varpin.mechanics.policy import LinearPolicy
from varpin.simulation.friction import rate_at_rest
from varpin.simulation.record import rollout

Search = Callable[[OptimalControlProblem, LinearPolicy | Solution | None], Solution]

logger = logging.getLogger(__name__)

# Tolerance of the searches, relative to the allowed loss.
SUFFICIENT = 0.01
# Accuracy of true costs, relative to the allowed loss.
_KNOWN = 0.1
# Iterations of a comparison with half the step.
COMPARISON = 3
# Bounds on the factor by which half the step lowers the excess of planned costs over the optimum: of smooth motions on
# coarse grids (on fine ones it is 0.25), and of controls that reach their limits.
_FALLS = (0.4, 0.5)
# Greatest number of halvings of the step.
_HALVINGS = 10
# Number of halvings without a smaller loss, or of searches within it that have not converged, that end the refinement.
_PATIENCE = 3
# Greatest rate of dampers and dry friction, times the step, from where on halvings must lower the loss.
_RESOLVED = 2.0


def refine(
    problem: OptimalControlProblem,
    search: Search,
    wish: float,
    time_left: Callable[[], float],
    compare: Search | None = None,
) -> Solution:
    """Plan with the problem's step, then halve the step, each time from the plan before, until the loss is small.

    Args:
        problem: The problem with the coarsest step.
        search: Makes a plan from first controls; interrupted, it returns one with status INTERRUPTED.
        wish: Greatest allowed :attr:`Verification.closed_loop_loss`, and excess over the optimum.
        time_left: Returns the time left [s].
        compare: A search of :data:`COMPARISON` iterations. With it, half the step must not lower the cost by more than
            the wish.
    """
    tried: list[Refined] = []
    best: Solution | None = None
    chosen = 0
    start: LinearPolicy | Solution | None = None
    while True:
        began = time.perf_counter()
        solution: Solution | None = None
        try:
            # A comparison that has converged is the plan of its step.
            done = isinstance(start, Solution) and start.status.converged
            solution = start if isinstance(start, Solution) and done else search(problem, start)
            costs = None if solution.status is Status.INTERRUPTED else _true_costs(solution, wish)
        except KeyboardInterrupt:
            if solution is None:
                if best is None:
                    raise
                solution = best
            solution, costs = replace(solution, status=Status.INTERRUPTED), None
        except VarpinError as error:
            if best is None:
                raise
            return _with(best, wish, tried, chosen, f"with dt = {problem.dt:g} s there is no plan: {error}")
        if costs is None:
            ended = f"interrupted with dt = {problem.dt:g} s"
            if best is None:
                return _with(solution, wish, tried, 0, ended)
            return _with(replace(best, status=Status.INTERRUPTED, reason=ended), wish, tried, chosen, ended)
        tried.append(_row(solution, costs, time.perf_counter() - began))
        logger.info("%s: true cost: %s", problem.scene.robot.name, tried[-1])
        meets = _within(tried[-1], wish) and solution.status.converged
        if best is None or meets or not abs(tried[-1].loss) >= abs(tried[chosen].loss):
            best, chosen = solution, len(tried) - 1
        finer = None
        if meets and (compare is None or (len(tried) <= _HALVINGS and time_left() > 0.0)):
            finer = compare and _in_half(problem, solution, compare)
            if finer is not None:
                if finer.status is Status.INTERRUPTED:
                    ended = f"interrupted while dt = {problem.dt:g} s was compared with half of it"
                    left = replace(solution, status=Status.INTERRUPTED, reason=ended)
                    return _with(left, wish, tried, chosen, ended)
                seconds = time.perf_counter() - began
                tried[-1] = replace(tried[-1], excess=_excess(tried, finer), seconds=seconds)
            if finer is None or tried[-1].excess <= wish:
                return _with(solution, wish, tried, chosen, "", met=True)
        ended = _ended(problem, solution, tried, chosen, wish, time_left())
        if ended:
            return _with(best, wish, tried, chosen, ended)
        if finer is not None:
            problem, start = finer.problem, finer
            continue
        try:
            problem = _halved(problem)
            start = start_of(problem, solution)
        except VarpinError as error:
            return _with(best, wish, tried, chosen, f"half the step cannot be taken: {error}")


def _ended(
    problem: OptimalControlProblem, solution: Solution, tried: list[Refined], chosen: int, wish: float, left: float
) -> str:
    """Why the refinement ends here; empty if it continues."""
    if solution.status is Status.INFEASIBLE:
        return f"with dt = {problem.dt:g} s there is no plan within the constraints: {solution.reason}"
    if left <= 0.0:
        return f"the time limit came after dt = {problem.dt:g} s"
    if len(tried) > _HALVINGS:
        return f"the step has been halved {_HALVINGS} times"
    resolved = problem.dt * rate_at_rest(problem.scene, problem.q0) <= _RESOLVED
    if resolved and len(tried) - 1 - chosen >= _PATIENCE:
        return f"the last {_PATIENCE} halvings of the step have not lowered the loss"
    if _within(tried[-1], wish) and solution.status in (Status.STALLED, Status.INDEFINITE, Status.NOT_DIFFERENTIABLE):
        return f"the loss is within the wish, but the search ended {solution.status.name}"
    if len(tried) >= _PATIENCE and all(_within(row, wish) and not row.status.converged for row in tried[-_PATIENCE:]):
        return f"losses are within the wish for {_PATIENCE} steps, but the searches ended {solution.status.name}"
    return ""


def _in_half(problem: OptimalControlProblem, solution: Solution, compare: Search) -> Solution | None:
    """The beginning of a search with half the step from a plan; None where there is none. It may be interrupted."""
    try:
        finer = _halved(problem)
        return compare(finer, start_of(finer, solution))
    except VarpinError:
        return None
    except KeyboardInterrupt:
        return replace(solution, status=Status.INTERRUPTED)


def _excess(tried: list[Refined], finer: Solution) -> float:
    """Excess of the last row's true cost over the optimum, by a search with half the step."""
    optimum = finer.cost
    if not finer.status.converged and finer.history:
        optimum -= max(finer.history[-1].expected_decrease, 0.0)
    # Finer controls lower the planned cost further, by a geometric series.
    gained, falls = tried[-1].cost - optimum, _FALLS[0]
    if len(tried) > 1 and tried[-2].cost > tried[-1].cost:
        falls = float(np.clip(gained / (tried[-2].cost - tried[-1].cost), *_FALLS))
    return excess(tried[-1].true_cost, optimum - max(gained, 0.0) * falls / (1.0 - falls))


def _true_costs(solution: Solution, wish: float) -> tuple[float, float, bool]:
    accuracy = _KNOWN * wish
    plan = (solution.problem, solution.trajectory, solution.cost, solution.policy_on)
    return true_costs(*plan, wish=wish, accuracy=accuracy)


def _row(solution: Solution, costs: tuple[float, float, bool], seconds: float) -> Refined:
    problem = solution.problem
    opened, closed, known = costs
    return Refined(
        dt=problem.dt,
        steps=problem.steps,
        cost=solution.cost,
        true_cost=closed,
        open_loop_cost=opened,
        loss=excess(closed, solution.cost) if known else np.nan,
        iterations=solution.iterations,
        status=solution.status,
        seconds=seconds,
    )


def _within(row: Refined, wish: float) -> bool:
    return bool(abs(row.loss) <= wish)


def _with(
    solution: Solution, wish: float, tried: list[Refined], chosen: int, reason: str, *, met: bool = False
) -> Solution:
    """The solution with the record of its refinement."""
    total = sum(row.seconds for row in tried) or 1.0
    rows = tuple(replace(row, share=row.seconds / total) for row in tried)
    if met:
        above = rows[chosen].excess
        compared = f"about {part(above)} above the optimum of finer controls" if np.isfinite(above) else ""
        reason = f"dt = {rows[chosen].dt:g} s loses {part(rows[chosen].loss)}, within {part(wish)[1:]}; "
        reason += compared or "not compared with finer controls"
    elif rows:
        loss = rows[chosen].loss
        reached = f"the best plan loses {part(loss)}" if np.isfinite(loss) else "no plan's true cost is known"
        reason = f"true_cost = {wish:g} is not met: {reason}; {reached} at dt = {rows[chosen].dt:g} s"
        if wish < rows[chosen].excess < np.inf:
            reason += f", and costs about {part(rows[chosen].excess)} more than the optimum of finer controls"
    logger.log(logging.INFO if met else logging.WARNING, "%s: %s", solution.problem.scene.robot.name, reason)
    return replace(solution, refinement=Refinement(wish, met, rows, chosen, reason))


def _halved(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The problem with half the step; controls that are held over several steps keep their period."""
    hold = problem.hold if problem.hold == 1 else 2 * problem.hold
    return problem.at(dt=0.5 * problem.dt, steps=2 * problem.steps, hold=hold)


def start_of(problem: OptimalControlProblem, coarse: Solution) -> LinearPolicy:
    """First controls of a problem with half the step: a coarse plan's policy applied on the finer grid.

    Raises:
        InputError: The motion under the policy fails before the end of the horizon.
    """
    integrator, n, m = problem.integrator, problem.scene.robot.dof, problem.scene.controls
    on: Literal["momentum", "velocity"] = "momentum" if integrator.variational else "velocity"
    policy = coarse.policy_on(on, 2)
    commands = policy.commands(
        problem.steps, m, n, integrator.variational, dt=problem.dt, stage_times=integrator.stage_times
    )
    motion, failure = rollout(problem.scene, integrator, problem.q0, problem.v0, commands, problem.dt)
    if failure is not None:
        raise InputError(f"the plan before does not get to its end in half the step: {failure.reason}")
    u = problem.decided(motion)
    x = np.hstack([motion.q, motion.p if integrator.variational else motion.v])[: -1 : problem.hold]
    # Feedback suppresses rounding errors of unstable motions; with linear controls it would act too late.
    gains = np.zeros((len(x), m, 2 * n)) if problem.linear else np.repeat(policy.gains, len(x) // len(policy.gains), 0)
    return LinearPolicy(
        u[1:] if problem.linear else u,
        gains,
        x,
        problem.hold,
        on,
        (problem.control_limits[0], problem.control_limits[1]),
        before=u[0] if problem.linear else None,
        period=problem.period,
        linear=problem.linear,
    )
