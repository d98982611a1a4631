"""The same trade for optimal control: what a plan truly costs, against the time it takes to find it."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from varpin.control import OptimalControlProblem, Solution, solve
from varpin.control.problem import require_problem
from varpin.errors import InputError
from varpin.integrators import Integrator
from varpin.study.motion import fastest, integrators_of
from varpin.study.record import Progress, Study, collect
from varpin.support.checks import count, positive

_COSTS = ("planned_cost", "open_loop_cost", "closed_loop_cost", "accuracy")


@dataclass(frozen=True)
class OptimalControlRun:
    """A problem solved with an integrator at one step. Its measures are NaN where it failed.

    Attributes:
        integrator: As text.
        order: Of its error in dt.
        dt: Time step [s].
        steps: N.
        hold: Steps that share a control.
        seconds: Solve time, the best of the repetitions [s].
        iterations: Of the solver.
        planned_cost: What the solver believes, without noise.
        open_loop_cost: Of the controls on the continuous system.
        closed_loop_cost: The same with the plan's feedback.
        accuracy: Relative, of these two.
        status: Of the solver, in a word.
        failure: Reason of a failure; empty if there is none.
    """

    integrator: str
    order: int
    dt: float
    steps: int
    hold: int
    seconds: float = math.nan
    iterations: int = 0
    planned_cost: float = math.nan
    open_loop_cost: float = math.nan
    closed_loop_cost: float = math.nan
    accuracy: float = math.nan
    status: str = ""
    failure: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class OptimalControlTradeoff(Study[OptimalControlRun]):
    """Solutions of one problem, in the order of the integrators, each from its largest step down.

    Attributes:
        runs: The runs.
        duration: Of the plan [s].
    """

    headings: ClassVar = {"seconds": "solve time [s]"}
    shown: ClassVar = ("integrator", "dt", "seconds", "planned_cost", "open_loop_cost", "closed_loop_cost")
    quantities: ClassVar = {"cost": "open_loop_cost"}
    logarithmic: ClassVar = False

    duration: float

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the table has to know."""
        return (
            f"plans of {self.duration:g} s; true costs are those of the continuous robot",
            "Pareto: no other plan has both a smaller solve time and a smaller true cost in open loop",
        )

    def note(self, run: OptimalControlRun) -> str:
        """Whether a run is on the front, or how it ended otherwise."""
        return super().note(run) or ("" if run.status == "converged" else run.status)


def optimal_control_tradeoff(
    problem: OptimalControlProblem,
    integrators: Sequence[Integrator] | None = None,
    dts: Sequence[float] | None = None,
    *,
    period: float | None = None,
    repeats: int = 1,
    progress: Progress | None = None,
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
        options: Handed on to :func:`varpin.solve`.

    Raises:
        InputError: Wrong arguments.
        StudyInterrupted: Ctrl-C; holds the runs so far. It is a KeyboardInterrupt.
    """
    require_problem(problem)
    members, repeats = integrators_of(problem.scene, integrators), count("repeats", repeats, least=1)
    steps = (2.0 * problem.dt, problem.dt, 0.5 * problem.dt) if dts is None else tuple(dts)
    jobs = [_discretized(problem, member, dt, period) for member in members for dt in sorted(steps, reverse=True)]
    base = OptimalControlTradeoff((), problem.scene.robot.name, problem.duration)
    return collect(base, (_measured(job, repeats, options) for job in jobs), len(jobs), progress)


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


def _solved(problem: OptimalControlProblem, options: dict[str, Any]) -> tuple[Solution, float]:
    begin = time.perf_counter()
    solution = solve(problem, **{"check": False, **options})
    seconds = time.perf_counter() - begin
    # The solver returns its best motion at Ctrl-C; here that run does not count.
    if solution.status.name == "INTERRUPTED":
        raise KeyboardInterrupt
    return solution, seconds


def _measured(problem: OptimalControlProblem, repeats: int, options: dict[str, Any]) -> OptimalControlRun:
    run = OptimalControlRun(str(problem.integrator), problem.integrator.order, problem.dt, problem.steps, problem.hold)
    # An error of one run, whatever it is, does not stop the others.
    try:
        solution, seconds = fastest(lambda: _solved(problem, options), repeats)
        truth = solution.verify()
    except InputError:
        raise
    except Exception as error:
        return replace(run, failure=f"{type(error).__name__}: {error}")
    costs = {name: getattr(truth, name) for name in _COSTS}
    status = solution.status.name.lower()
    return replace(run, seconds=seconds, iterations=solution.iterations, status=status, **costs)
