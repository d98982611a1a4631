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
from varpin.control.verification import OnRobot, excess, true_costs
from varpin.errors import InputError, VarpinError
from varpin.mechanics.policy import LinearPolicy
from varpin.simulation.friction import rate_at_rest
from varpin.simulation.record import rollout

Search = Callable[[OptimalControlProblem, LinearPolicy | Solution | None], Solution]

logger = logging.getLogger(__name__)

# Tolerance of the searches, relative to the allowed loss.
SUFFICIENT = 0.01
# Decrease in a few iterations, relative to the allowed loss and the cost at stake, at which searches end early for slow
# progress. They are finished where half the step does not lower the cost by more than the wish.
SLOW = 0.3
# Accuracy of true costs, and changes of the cost that do not count, relative to the allowed loss.
KNOWN = 0.1
# Iterations of a comparison with half the step.
COMPARISON = 3
# Bounds on the factor by which half the step lowers the excess of planned costs over the optimum: of smooth motions on
# coarse grids (on fine ones it is 0.25), and of controls that reach their limits.
_FALLS = (0.4, 0.5)
# Greatest number of halvings of the step.
HALVINGS = 10
# Number of halvings without a smaller loss, or of searches within it that have not converged, that end the refinement.
PATIENCE = 3
# Greatest rate of dampers and dry friction, times the step, from where on halvings must lower the loss.
RESOLVED = 2.0


def refine(
    problem: OptimalControlProblem,
    search: Search,
    wish: float,
    time_left: Callable[[], float],
    compare: Search | None = None,
    finish: Search | None = None,
) -> Solution:
    """Plan with the problem's step, then halve the step, each time from the plan before, until the loss is small.

    Args:
        problem: The problem with the coarsest step.
        search: Makes a plan from first controls, or continues one; interrupted, it returns one with status INTERRUPTED.
        wish: Greatest allowed :attr:`Verification.closed_loop_loss`, and excess over the optimum.
        time_left: Returns the time left [s].
        compare: A search of :data:`COMPARISON` iterations. With it, half the step must not lower the cost by more than
            the wish.
        finish: Continues a plan of ``search`` to the end; None where ``search`` never ends early.
    """
    return _Refining(search, wish, time_left, compare, finish).run(problem)


class _Refining:
    """The state of a refinement: the steps tried, and the best plan."""

    def __init__(
        self,
        search: Search,
        wish: float,
        time_left: Callable[[], float],
        compare: Search | None,
        finish: Search | None,
    ) -> None:
        self.search, self.wish, self.time_left = search, wish, time_left
        self.compare, self.finish = compare, finish
        self.tried: list[Refined] = []
        self.best: Solution | None = None
        self.chosen = 0
        self.unconverged = 0  # searches in a row that have not converged, though their losses are within the wish

    def run(self, problem: OptimalControlProblem) -> Solution:
        start: LinearPolicy | Solution | None = None
        while True:
            began = time.perf_counter()
            # A comparison that has converged is the plan of its step.
            known = start if isinstance(start, Solution) and start.status.converged else None
            try:
                solution, costs = self._attempt(self.search, problem, start, known)
            except VarpinError as error:
                if self.best is None:
                    raise
                return self._given_up(f"with dt = {problem.dt:g} s there is no plan: {error}")
            if solution is None or costs is None:
                return self._interrupted(solution, f"interrupted with dt = {problem.dt:g} s")
            self.tried.append(row_of(solution, costs, time.perf_counter() - began))
            finer, compared, waits = None, self.compare is None, False
            if is_within(self.tried[-1], self.wish) and self.compare is not None and self._may_go_on():
                above = self._foreseen()
                finer = None if np.isfinite(above) else _in_half(problem, solution, self.compare)
                compared, waits = True, self.finish is not None and solution.status is Status.MAX_ITERATIONS
                if waits and self._promises(solution, finer):
                    waits, before = False, solution.cost
                    made, costs = self._attempt(self.finish, problem, solution)
                    if made is None or costs is None:
                        return self._interrupted(made or solution, f"interrupted with dt = {problem.dt:g} s")
                    solution, self.tried[-1] = made, row_of(made, costs, 0.0)
                    if before - solution.cost > KNOWN * self.wish * abs(solution.cost):
                        finer = _in_half(problem, solution, self.compare)
                if finer is not None and finer.status is Status.INTERRUPTED:
                    ended = f"interrupted while dt = {problem.dt:g} s was compared with half of it"
                    left = replace(solution, status=Status.INTERRUPTED, reason=ended)
                    return recorded(left, self.wish, self.tried, len(self.tried) - 1, ended)
                above = above if finer is None else excess_over(self.tried, finer)
                self.tried[-1] = replace(self.tried[-1], excess=above, seconds=time.perf_counter() - began)
            row = self.tried[-1]
            within = is_within(row, self.wish)
            meets = within and solution.status.converged
            if self.best is None or meets or not abs(row.loss) >= abs(self.tried[self.chosen].loss):
                self.best, self.chosen = solution, len(self.tried) - 1
            if meets and compared and (finer is None or row.excess <= self.wish):
                return recorded(solution, self.wish, self.tried, self.chosen, "", met=True)
            self.unconverged = self.unconverged + 1 if within and not (solution.status.converged or waits) else 0
            ended = self._ended(problem, solution)
            if ended:
                return self._given_up(ended)
            if finer is not None:
                problem, start = finer.problem, finer
                continue
            try:
                problem = halved(problem)
                start = start_of(problem, solution)
            except VarpinError as error:
                return self._given_up(f"half the step cannot be taken: {error}")

    def _attempt(
        self,
        search: Search | None,
        problem: OptimalControlProblem,
        start: LinearPolicy | Solution | None,
        known: Solution | None = None,
    ) -> tuple[Solution | None, OnRobot | None]:
        """A plan and its true costs; None for what an interrupt prevented."""
        solution = known
        try:
            if solution is None and search is not None:
                solution = search(problem, start)
            if solution is None or solution.status is Status.INTERRUPTED:
                return solution, None
            return solution, on_robot(solution, self.wish)
        except KeyboardInterrupt:
            return solution, None

    def _may_go_on(self) -> bool:
        return len(self.tried) <= HALVINGS and self.time_left() > 0.0

    def _foreseen(self) -> float:
        """Excess of the last row, where the halving before has lowered the cost by little; else infinite."""
        if len(self.tried) < 2 or not all(row.status.converged for row in self.tried[-2:]):
            return np.inf
        before, last = self.tried[-2:]
        gained = before.cost - last.cost
        if not 0.0 <= gained <= KNOWN * self.wish * abs(last.cost):
            return np.inf
        return excess(last.true_cost, last.cost - gained * _FALLS[0] / (1.0 - _FALLS[0]))

    def _promises(self, solution: Solution, finer: Solution | None) -> bool:
        """Whether a plan whose search ended early is to be finished, as it may then be within the wish."""
        if finer is None or finer.status is Status.INTERRUPTED:
            return finer is None
        costs = [*(row.cost for row in self.tried[-2:]), finer.cost]
        if len(costs) > 2 and max(costs[0] - costs[1], costs[1] - costs[2]) <= self.wish * abs(costs[1]):
            # Twice, half the step has hardly lowered the cost, whatever the model expects of it.
            return True
        rest = max(solution.history[-1].expected_decrease, 0.0) if solution.history else 0.0
        return excess_over(self.tried, finer, rest) <= self.wish

    def _given_up(self, ended: str) -> Solution:
        """The best plan, its search finished."""
        assert self.best is not None
        if self.finish is not None and self.best.status is Status.MAX_ITERATIONS:
            began, row = time.perf_counter(), self.tried[self.chosen]
            made, costs = self._attempt(self.finish, self.best.problem, self.best)
            if made is None or costs is None:
                return self._interrupted(None, f"interrupted with dt = {row.dt:g} s")
            seconds = row.seconds + time.perf_counter() - began
            self.tried[self.chosen] = replace(row_of(made, costs, seconds), excess=row.excess)
            self.best = made
        return recorded(self.best, self.wish, self.tried, self.chosen, ended)

    def _interrupted(self, solution: Solution | None, ended: str) -> Solution:
        """The best plan of an interrupted refinement, or the only one."""
        if self.best is not None:
            best = replace(self.best, status=Status.INTERRUPTED, reason=ended)
        elif solution is not None:
            best = replace(solution, status=Status.INTERRUPTED)
        else:
            raise KeyboardInterrupt
        return recorded(best, self.wish, self.tried, self.chosen, ended)

    def _ended(self, problem: OptimalControlProblem, solution: Solution) -> str:
        """Why the refinement ends here; empty if it continues."""
        tried, row = self.tried, self.tried[-1]
        if solution.status is Status.INFEASIBLE:
            return f"with dt = {problem.dt:g} s there is no plan within the constraints: {solution.reason}"
        if self.time_left() <= 0.0:
            return f"the time limit came after dt = {problem.dt:g} s"
        if len(tried) > HALVINGS:
            return f"the step has been halved {HALVINGS} times"
        resolved = problem.dt * rate_at_rest(problem.scene, problem.q0) <= RESOLVED
        if resolved and len(tried) - 1 - self.chosen >= PATIENCE:
            return f"the last {PATIENCE} halvings of the step have not lowered the loss"
        coarse = self.wish < row.excess < np.inf
        stuck = solution.status in (Status.STALLED, Status.INDEFINITE, Status.NOT_DIFFERENTIABLE)
        if is_within(row, self.wish) and stuck and not coarse:
            return f"the loss is within the wish, but the search ended {solution.status.name}"
        if self.unconverged >= PATIENCE:
            return f"losses are within the wish for {PATIENCE} steps, but the searches ended {solution.status.name}"
        return ""


def _in_half(problem: OptimalControlProblem, solution: Solution, compare: Search) -> Solution | None:
    """The beginning of a search with half the step from a plan; None where there is none. It may be interrupted."""
    try:
        finer = halved(problem)
        return compare(finer, start_of(finer, solution))
    except VarpinError:
        return None
    except KeyboardInterrupt:
        return replace(solution, status=Status.INTERRUPTED)


def excess_over(tried: list[Refined], finer: Solution, rest: float = 0.0) -> float:
    """Excess of the last row's true cost, less ``rest``, over the optimum, by a search with half the step."""
    optimum = finer.cost
    if not finer.status.converged and finer.history:
        optimum -= max(finer.history[-1].expected_decrease, 0.0)
    # Finer controls lower the planned cost further, by a geometric series.
    gained, falls = tried[-1].cost - rest - optimum, _FALLS[0]
    if len(tried) > 1 and tried[-2].cost > tried[-1].cost:
        falls = float(np.clip(gained / (tried[-2].cost - tried[-1].cost), *_FALLS))
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
