"""The steps that a refinement tries: what the refinements with and without constraints share."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from varpin.control.history import Status
from varpin.control.problem import OptimalControlProblem
from varpin.control.refined import Refined, Refinement, part
from varpin.control.solution import Solution
from varpin.control.verification import OnRobot, excess, true_costs
from varpin.errors import InputError
from varpin.signals.policy import LinearPolicy
from varpin.simulation.record import rollout
from varpin.simulation.spectrum import rate_at_rest

logger = logging.getLogger(__name__)

# Accuracy of true costs, and changes of the cost that do not count, relative to the allowed loss.
KNOWN = 0.1
# Bounds on the factor by which half the step lowers the excess of planned costs over the optimum: of smooth motions on
# coarse grids (on fine ones it is 0.25), and of controls that reach their limits.
FALLS = (0.4, 0.5)
# Number of halvings without gain, or of searches within the wish that have not converged, that end a refinement.
PATIENCE = 3
# Greatest rate of dampers and dry friction, times the step, from where on halvings must lower the loss.
_RESOLVED = 2.0


class StepsTried:
    """The steps that a refinement has tried, and its best plan.

    Attributes:
        wish: Greatest allowed :attr:`Verification.closed_loop_loss`, and excess over the optimum.
        time_left: Returns the time left [s].
        halvings: Greatest number of halvings of the step.
        tried: The records of the steps.
        best: The best plan; None before there is one.
        chosen: Index of the best plan's step.
        beyond: What the best plan violates on the continuous system.
    """

    def __init__(self, wish: float, time_left: Callable[[], float], halvings: int) -> None:
        self.wish, self.time_left, self.halvings = wish, time_left, halvings
        self.tried: list[Refined] = []
        self.best: Solution | None = None
        self.chosen = 0
        self.beyond = ""

    def may_go_on(self) -> bool:
        """Whether the step may be halved."""
        return len(self.tried) <= self.halvings and self.time_left() > 0.0

    def spent(self, problem: OptimalControlProblem) -> str:
        """Why the step may not be halved; empty if it may."""
        if self.time_left() <= 0.0:
            return f"the time limit came after dt = {problem.dt:g} s"
        if len(self.tried) > self.halvings:
            return f"the step has been halved {self.halvings} times"
        return ""

    def without_gain(self, problem: OptimalControlProblem, since: int) -> bool:
        """Whether PATIENCE halvings after the step ``since`` have gained nothing, on steps that resolve friction."""
        resolved = problem.dt * rate_at_rest(problem.scene, problem.q0) <= _RESOLVED
        return resolved and len(self.tried) - 1 - since >= PATIENCE

    def barely_changed(self) -> float | None:
        """Decrease of the planned cost by the last halving, where it does not count; else None."""
        if len(self.tried) < 2 or not all(row.status.converged for row in self.tried[-2:]):
            return None
        gained = self.tried[-2].cost - self.tried[-1].cost
        return gained if abs(gained) <= KNOWN * self.wish * abs(self.tried[-1].cost) else None

    def met(self, solution: Solution, chosen: int) -> Solution:
        """The plan that meets the wish, with the record of its refinement."""
        return recorded(solution, self.wish, self.tried, chosen, "", met=True)

    def given_up(self, ended: str) -> Solution:
        """The best plan of a refinement that ended without meeting the wish."""
        assert self.best is not None
        return recorded(self.best, self.wish, self.tried, self.chosen, ended, beyond=self.beyond)

    def interrupted(self, solution: Solution | None, ended: str) -> Solution:
        """The best plan of an interrupted refinement, or the only one.

        Raises:
            KeyboardInterrupt: There is no plan yet.
        """
        if self.best is not None:
            best = replace(self.best, status=Status.INTERRUPTED, reason=ended)
        elif solution is not None:
            best = replace(solution, status=Status.INTERRUPTED)
        else:
            raise KeyboardInterrupt
        return recorded(best, self.wish, self.tried, self.chosen, ended, beyond=self.beyond)


def excess_over(tried: list[Refined], finer: Solution, rest: float = 0.0) -> float:
    """Excess of the last row's true cost, less ``rest``, over the optimum, by a search with half the step."""
    optimum = finer.cost
    if not finer.status.converged and finer.history:
        optimum -= max(finer.history[-1].expected_decrease, 0.0)
    # Finer controls lower the planned cost further, by a geometric series.
    gained, falls = tried[-1].cost - rest - optimum, FALLS[0]
    if len(tried) > 1 and tried[-2].cost > tried[-1].cost:
        falls = float(np.clip(gained / (tried[-2].cost - tried[-1].cost), *FALLS))
    # Where the cost has fallen to a fraction, that says nothing about further falls.
    further = max(gained, 0.0) * falls / (1.0 - falls) if gained < abs(optimum) else 0.0
    return excess(tried[-1].true_cost - rest, optimum - further)


def on_robot(solution: Solution, wish: float) -> OnRobot:
    """The true costs of a plan, as accurate as a wish needs, and its violations on the continuous system."""
    accuracy = KNOWN * wish
    plan = (solution.problem, solution.trajectory, solution.cost, solution.policy_on)
    return true_costs(*plan, wish=wish, accuracy=accuracy)


def row_of(solution: Solution, costs: OnRobot, seconds: float) -> Refined:
    """The record of a plan's step."""
    problem = solution.problem
    return Refined(
        dt=problem.dt,
        steps=problem.steps,
        cost=solution.cost,
        true_cost=costs.closed,
        open_loop_cost=costs.opened,
        loss=excess(costs.closed, solution.cost) if costs.known else np.nan,
        iterations=solution.iterations,
        status=solution.status,
        seconds=seconds,
        violation=costs.violation,
    )


def is_within(row: Refined, wish: float) -> bool:
    """Whether a step's loss is within the wish."""
    return bool(abs(row.loss) <= wish)


def halved(problem: OptimalControlProblem) -> OptimalControlProblem:
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


def recorded(
    solution: Solution,
    wish: float,
    tried: list[Refined],
    chosen: int,
    reason: str,
    *,
    met: bool = False,
    beyond: str = "",
) -> Solution:
    """The solution with the record of its refinement; ``beyond`` is what it violates on the continuous system."""
    total = sum(row.seconds for row in tried) or 1.0
    rows = tuple(replace(row, share=row.seconds / total) for row in tried)
    if met:
        above = rows[chosen].excess
        compared = f"about {part(above)} above the optimum of finer controls" if np.isfinite(above) else ""
        if above <= 0.0:
            compared = "half the step is not cheaper"
        reason = f"dt = {rows[chosen].dt:g} s loses {part(rows[chosen].loss)}, within {part(wish)[1:]}; "
        reason += compared or "not compared with finer controls"
    elif rows:
        loss = rows[chosen].loss
        reached = f"the best plan loses {part(loss)}" if np.isfinite(loss) else "no plan's true cost is known"
        reason = f"true_cost = {wish:g} is not met: {reason}; {reached} at dt = {rows[chosen].dt:g} s"
        if beyond:
            reason += f", and on the continuous system {beyond}"
        if wish < rows[chosen].excess < np.inf:
            reason += f", and costs about {part(rows[chosen].excess)} more than the optimum of finer controls"
    logger.log(logging.INFO if met else logging.WARNING, "%s: %s", solution.problem.scene.robot.name, reason)
    return replace(solution, refinement=Refinement(wish, met, rows, chosen, reason))
