"""The same trade for optimal control: what a plan truly costs, against the time it takes to find it."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from varpin.control import OptimalControlProblem, Solution, solve
from varpin.errors import FileError, InputError
from varpin.integrators import Integrator
from varpin.mechanics.scene import refuse_inputs
from varpin.study.tradeoff.records import pareto_front
from varpin.study.tradeoff.runs import Progress, Run, Tradeoff, complete
from varpin.study.tradeoff.setting import Setting, digest, fastest, integrators_of
from varpin.support.checks import count, positive, writable

# Options of solve that observe a search and do not change it.
_ONLOOKERS = ("callback", "progress")

HEADINGS = {
    "integrator": "integrator",
    "order": "order",
    "dt": "dt [s]",
    "steps": "steps",
    "hold": "steps a decision",
    "seconds": "solve time [s]",
    "spread": "spread of solve time [s]",
    "iterations": "iterations",
    "planned_cost": "planned cost",
    "open_loop_cost": "true cost, open loop",
    "closed_loop_cost": "true cost, with feedback",
    "accuracy": "accuracy of true cost",
    "status": "status",
    "failure": "failure",
}


@dataclass(frozen=True)
class OptimalControlRun(Run):
    """A problem solved with an integrator at one step, with the attributes of :class:`varpin.study.tradeoff.runs.Run`.

    Attributes:
        hold: Steps that share a control.
        iterations: Of the solver.
        planned_cost: What the solver believes, without noise.
        open_loop_cost: Of the controls on the continuous system.
        closed_loop_cost: The same with the plan's feedback.
        accuracy: Relative, of these two.
        status: Of the solver, in a word.
    """

    hold: int
    iterations: int
    planned_cost: float
    open_loop_cost: float
    closed_loop_cost: float
    accuracy: float
    status: str

    @property
    def key(self) -> Hashable:
        """Identity of the run in its record."""
        return self.options, self.steps, self.hold


@dataclass(frozen=True, eq=False, repr=False)
class OptimalControlTradeoff(Tradeoff):
    """Solutions of one problem, :class:`OptimalControlRun`, with the attributes of a :class:`Tradeoff`."""

    _format = "varpin.optimal-control-tradeoff/2"
    _headings = HEADINGS
    _columns = ("integrator", "dt", "seconds", "planned_cost", "open_loop_cost", "closed_loop_cost", "failure")

    runs: tuple[OptimalControlRun, ...]

    def pareto(self) -> tuple[OptimalControlRun, ...]:
        """The runs than which no other is better in both solve time and true open-loop cost, from the fastest up."""
        return pareto_front(self.runs, lambda run: run.seconds, lambda run: run.open_loop_cost)


def optimal_control_tradeoff(
    problem: OptimalControlProblem,
    integrators: Sequence[Integrator] | None = None,
    dts: Sequence[float] | None = None,
    *,
    period: float | None = None,
    repeats: int = 1,
    progress: Progress | None = None,
    save: str | os.PathLike[str] | None = None,
    **options: Any,
) -> OptimalControlTradeoff:
    """Solve a problem with different integrators and steps, and replay each plan on the continuous system.

    Main args:
        problem: What to solve; its own integrator and step do not count.
        integrators: varpin's own fixed-step ones if left out.
        dts: Time steps [s] that divide the horizon; the problem's own and its double and half if left out.
        period: Time between decisions [s], kept at all steps, so that only the integration differs. Left out, every
            step decides.

    Other Args:
        repeats: Of each solution; the fastest counts. One more goes before them where they are short.
        progress: Called with (runs done, runs in all).
        save: Keep the record in this npz, run by run; runs that it holds already are not run again.
        options: Handed on to :func:`varpin.solve`. Runs with other options are other runs; ``callback`` and
            ``progress`` do not count.

    Raises:
        InputError: Wrong arguments.
        FileError: ``save`` cannot be written, or holds another problem's runs.
    """
    if not isinstance(problem, OptimalControlProblem):
        raise InputError(f"problem must be an OptimalControlProblem, got {type(problem).__name__}")
    refuse_inputs(problem.scene, "optimal_control_tradeoff")
    members, repeats = integrators_of(problem.scene, integrators), count("repeats", repeats, least=1)
    steps = (2.0 * problem.dt, problem.dt, 0.5 * problem.dt) if dts is None else tuple(dts)
    plan = [_discretized(problem, member, dt, period) for member in members for dt in sorted(steps, reverse=True)]
    path = None if save is None else writable(save)
    mark = _fingerprint(problem, options)
    base = OptimalControlTradeoff((), problem.scene.robot.name, problem.duration, fingerprint=mark)
    if path is not None and path.exists():
        base = OptimalControlTradeoff.load(path)
        if base.fingerprint != mark:
            raise FileError(f"{path} holds runs of another problem: choose another file")
    return complete(
        base,
        {(repr(each.integrator), each.steps, each.hold): each for each in plan},
        lambda record, missing: (record, (_measured(each, repeats, options) for each in missing)),
        path=path,
        progress=progress,
    )


def _discretized(
    problem: OptimalControlProblem, member: Integrator, dt: float, period: float | None
) -> OptimalControlProblem:
    hold = 1
    if period is not None:
        ratio = positive("period", period, "s") / positive("dts", dt, "s")
        hold = round(ratio)
        if hold < 1 or abs(hold - ratio) > 1e-9 * ratio:
            raise InputError(f"period = {period:g} s is no multiple of dt = {dt:g} s")
    return problem.at(dt=dt, integrator=member, hold=hold)


def _fingerprint(problem: OptimalControlProblem, options: dict[str, Any]) -> str:
    """SHA-256 over the scene, the state, the horizon, the options, and the cost of a motion that visits many states."""
    scene, steps = problem.scene, 64
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=(2, steps + 1, scene.robot.dof))
    u = rng.normal(size=(steps, scene.controls))
    costs = problem.at(dt=problem.duration / steps, steps=steps, hold=1).costs(q, v, u)
    quiet = Setting(scene, problem.q0, problem.v0, np.zeros((1, scene.controls)), problem.duration).fingerprint
    given = {
        name: value.policy if isinstance(value, Solution) else value
        for name, value in sorted(options.items())
        if name not in _ONLOOKERS
    }
    return digest((quiet, f"{float(costs):.12e}", problem.sampling, given))


def _solved(problem: OptimalControlProblem, options: dict[str, Any]) -> tuple[Solution, float]:
    begin = time.perf_counter()
    solution = solve(problem, **{"check": False, **options})
    seconds = time.perf_counter() - begin
    # The solver returns its best motion at Ctrl-C; here that run does not count.
    if solution.status.name == "INTERRUPTED":
        raise KeyboardInterrupt
    return solution, seconds


def _measured(problem: OptimalControlProblem, repeats: int, options: dict[str, Any]) -> OptimalControlRun:
    costs = {"planned_cost": math.nan, "open_loop_cost": math.nan, "closed_loop_cost": math.nan, "accuracy": math.nan}
    seconds, spread, iterations, status, failure = math.nan, 0.0, 0, "", ""
    # An error of one run, whatever it is, does not stop the others.
    try:
        solution, best, scatter = fastest(lambda: _solved(problem, options), repeats)
        truth = solution.verify()
        costs = {name: getattr(truth, name) for name in costs}
        seconds, spread, iterations, status = best, scatter, solution.iterations, solution.status.name.lower()
    except InputError:
        raise
    except Exception as error:
        failure = f"{type(error).__name__}: {error}"
    return OptimalControlRun(
        integrator=str(problem.integrator),
        options=repr(problem.integrator),
        order=problem.integrator.order,
        dt=problem.dt,
        steps=problem.steps,
        hold=problem.hold,
        seconds=seconds,
        spread=spread,
        iterations=iterations,
        status=status,
        failure=failure,
        **costs,
    )
