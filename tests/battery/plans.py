"""Optimal control at the extremes, and what is checked of a plan: its cost, and that nothing near is better."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from battery.trial import Outcome
from varpin.control import OptimalControlProblem, Solution, Status, solve
from varpin.control.costs import ControlCost, Cost, Terminal, TrackingCost
from varpin.errors import VarpinError
from varpin.integrators import ExplicitEuler, Gauss, Integrator, Midpoint, Reference
from varpin.mechanics.noise import AdditiveNoise, ControlNoise, Noise
from varpin.mechanics.scene import Scene
from varpin.model import Robot
from varpin.model.chain import rod_chain
from varpin.simulation.simulate import simulate
from varpin.study.checks import LEVELS, energy_error
from varpin.study.extremes import Kind
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# Part of a plan's cost that single controls may still take off it, and relative error of the cost itself.
LEFT_LEVEL, COST_LEVEL = 1e-2, 1e-6
# Part of a plan's cost that a robot may pay beyond it without a word.
PAID_LEVEL = 1e-3
# Parts of a step over which that is summed up.
_FINER = 16
# Changes between speeding up and slowing down in a hundred steps that a plan may have without a word, and how many need
# no word in any; of those that a thousandth of a joint's largest velocity shows.
_RESTLESS, _FEW, _SHOWN = 12.0, 12, 1e-3
_PLANNERS = (Midpoint(), Gauss(stages=4), ExplicitEuler())
# Part of a cost up to which noise does not move its optimum to speak of.
_QUIET = 1e-4
# Controls that are varied one by one.
_VARIED = 12
# Angle of a rod that stands upright: at 0 it lies along x, and turns down.
UP = -0.5 * math.pi


@dataclass(frozen=True, eq=False)
class Task:
    """A problem of optimal control whose cost is a weight on the distance from a reference and one on the controls.

    Attributes:
        scene: The scene.
        q0: (n,) [rad or m].
        reference: Rows (N + 1, n), or one (n,).
        tracking: Weight.
        effort: Weight.
        final: Weight at the end.
        controls: To start from, or None.
    """

    scene: Scene
    q0: Floats
    reference: Floats
    tracking: float = 10.0
    effort: float = 0.1
    final: float = 1.0
    controls: Floats | None = None

    def problem(self, dt: float, steps: int, integrator: Integrator) -> OptimalControlProblem:
        """The same for varpin."""
        cost: Cost = TrackingCost(self.reference, self.tracking) + ControlCost(self.effort)
        cost = cost + Terminal(TrackingCost(np.atleast_2d(self.reference)[-1], self.final))
        v0 = np.zeros(len(self.q0))
        return OptimalControlProblem(self.scene, cost, self.q0, v0, dt=dt, steps=steps, integrator=integrator)

    def cost(self, motion: Trajectory) -> float:
        """The cost of a motion, summed by hand at two Gauss points of each step, on the cubic through its nodes."""
        t, q, u, dt = motion.t, motion.q, motion.u, motion.dt
        given = np.atleast_2d(self.reference)
        # Between its rows a reference is straight.
        at = np.linspace(0.0, len(given) - 1.0, len(q))
        rows = np.stack([np.interp(at, np.arange(len(given)), column) for column in given.T], axis=1)
        path, tracking = scipy.interpolate.CubicHermiteSpline(t, q, motion.v), 0.0
        for part in (0.5 - math.sqrt(3.0) / 6.0, 0.5 + math.sqrt(3.0) / 6.0):
            off = path(t[:-1] + part * dt) - ((1.0 - part) * rows[:-1] + part * rows[1:])
            tracking += 0.5 * (off**2).sum()
        running = dt * (self.tracking * tracking + self.effort * (u**2).sum())
        return float(running + self.final * ((q[-1] - rows[-1]) ** 2).sum())


@dataclass(frozen=True)
class Plan:
    """A task at an extreme; attributes as of :class:`battery.Trial`."""

    name: str
    family: str
    build: Callable[[], Task]
    dt: float
    steps: int
    iterations: int = 50
    deep: bool = False

    def takes(self, integrator: Integrator) -> bool:
        """Whether it is solved with an integrator: with three of them."""
        return integrator in _PLANNERS


def judge_plan(plan: Plan, integrator: Integrator, patience: float = math.inf) -> Outcome:
    """Solve it, within about this time [s], and judge the solution."""
    try:
        task = plan.build()
        problem = task.problem(plan.dt, plan.steps, integrator)
    except VarpinError as error:
        return Outcome.of_error(error, Kind.REFUSED)
    try:
        with _logged() as warnings:
            solution = solve(problem, task.controls, max_iterations=plan.iterations, time_limit=patience)
    except Exception as error:
        done = getattr(getattr(error, "trajectory", None), "steps", 0)
        return Outcome.of_error(error, Kind.STOPPED, done)
    converged = solution.status.converged
    said = (*(() if converged else (solution.status.value,)), *warnings)
    record, left = cost_error(task, solution), part_left(task, solution)
    energy, restless = energy_error(problem.scene, solution.trajectory), changes(solution.trajectory)
    # Each rule: what is wrong, and whether what was said does not excuse it. No word excuses a cost that is not the
    # plan's own; one that is not the least, that it is not claimed to be. Written such that NaN is wrong.
    rules = (
        (not record <= COST_LEVEL, f"cost off by {record:.2g} of itself (wrong from {COST_LEVEL:g})", True),
        (
            not (np.isfinite(solution.gains).all() and np.isfinite(solution.feedforward).all()),
            "the policy is not finite",
            True,
        ),
        (
            not (math.isnan(left) or left <= LEFT_LEVEL),
            f"single controls take {left:.2g} off the cost (wrong from {LEFT_LEVEL:g})",
            converged,
        ),
        (energy > LEVELS["energy"], f"energy {energy:.2g} (wrong from {LEVELS['energy']:g})", not said),
        (
            restless > max(_RESTLESS * plan.steps / 100.0, _FEW),
            f"a velocity goes up and down {restless} times in {plan.steps} steps",
            not said,
        ),
    )
    found = [text for broken, text, _ in rules if broken]
    # Most warnings of a plan are of what the robot pays, which takes a while to find out.
    if said and not abs(paid := paid_by_robot(task, solution)) <= PAID_LEVEL:
        found.append(f"the robot pays {paid:+.2g} of the cost more for its controls (worth a word from {PAID_LEVEL:g})")
    if any(broken and unexcused for broken, _, unexcused in rules):
        kind = Kind.WRONG
    elif solution.status is Status.MAX_ITERATIONS:
        # Plans have a number of iterations here; one that it cuts short is no better and no worse than that.
        kind = Kind.STOPPED
    else:
        kind = Kind.DEGRADED if said else Kind.ACCURATE
    return Outcome(kind, {"error": left, "energy": energy, "record": record}, said, tuple(found), plan.steps)


@contextlib.contextmanager
def _logged() -> Iterator[list[str]]:
    """The solver's warnings within this context."""
    messages: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            messages.append(record.getMessage())

    logger, collector = logging.getLogger("varpin.control"), Collector(logging.WARNING)
    logger.addHandler(collector)
    try:
        yield messages
    finally:
        logger.removeHandler(collector)


def cost_error(task: Task, solution: Solution) -> float:
    """Distance of a solution's cost from that of its motion, summed by hand, in units of the cost."""
    motion = solution.trajectory
    cost = task.cost(motion)
    return abs(cost - solution.cost) / max(abs(cost), np.finfo(np.float64).tiny) if cost != solution.cost else 0.0


def paid_by_robot(task: Task, solution: Solution) -> float:
    """What the plan's controls cost on the continuous robot beyond what the plan has them cost, relative to that.

    Without noise. Infinite where there is no such motion.
    """
    problem, motion = solution.problem, solution.trajectory
    try:
        exact = simulate(
            problem.scene, problem.q0, problem.v0, dt=motion.dt / _FINER, steps=_FINER * motion.steps,
            controls=np.repeat(motion.u, _FINER, axis=0), increments=0 if problem.scene.processes else None,
            integrator=Reference(), check=False,
        )  # fmt: skip
    except VarpinError:
        return math.inf
    return (task.cost(exact) - solution.cost) / max(abs(solution.cost), np.finfo(np.float64).tiny)


def changes(motion: Trajectory) -> int:
    """How often the velocity of the most restless joint goes from rising to falling, or back, as far as it shows."""
    most = 0
    for v in motion.v.T:
        step = np.diff(v)
        step = np.where(np.abs(step) > _SHOWN * np.abs(v).max(), np.sign(step), 0.0)
        most = max(most, int((step[1:] * step[:-1] < 0.0).sum()))
    return most


def part_left(task: Task, solution: Solution) -> float:
    """The part of the cost that changes of single controls would take off, by simulating them.

    Some controls spread over time are each put where a parabola through three costs has its least; what that takes off
    stands for all. NaN where noise makes the expected cost another one, with its own optimum: where it has a part in
    the cost, or depends on the controls; and where motions fail however little is changed.
    """
    diffusion = solution.problem.scene.noise.diffusion
    if diffusion is None or diffusion.control.any() or not solution.noise_cost <= _QUIET * abs(solution.cost):
        return math.nan
    size = max(float(np.abs(solution.trajectory.u).max()), 1e-3)
    for change in (1e-3 * size, 1e-6 * size):
        with contextlib.suppress(VarpinError):
            return _gain(task, solution, change)
    return math.nan


def _gain(task: Task, solution: Solution, change: float) -> float:
    """:func:`part_left` with parabolas of this width in u."""
    problem, u = solution.problem, solution.trajectory.u
    cells = np.argwhere(np.ones(u.shape, dtype=bool))
    chosen = cells[np.unique(np.linspace(0, len(cells) - 1, _VARIED).astype(int))]

    def cost(cell: NDArray[np.int64] | None = None, by: float = 0.0) -> float:
        controls = u.copy()
        if cell is not None:
            controls[tuple(cell)] += by
        return task.cost(problem.simulate(controls))

    here, gain = cost(), 0.0
    for cell in chosen:
        more, less = cost(cell, change) - here, cost(cell, -change) - here
        best = min(0.0, more, less)
        if more + less > 0.0:
            best = min(best, cost(cell, -0.5 * change * (more - less) / (more + less)) - here)
        gain -= best
    return gain * len(cells) / len(chosen) / max(here, np.finfo(np.float64).tiny)


def _arm(
    links: int = 2,
    *,
    q0: ArrayLike = 0.0,
    reference: ArrayLike = 0.5,
    actuation: ArrayLike | None = None,
    gravity: bool = True,
    noise: Noise | None = None,
    **task: Any,
) -> Callable[[], Task]:
    def build() -> Task:
        robot = rod_chain([0.3] * links, [1.0] * links)
        scene = Scene(robot, gravity=gravity, actuation=actuation, noise=noise)
        start = np.broadcast_to(np.asarray(q0, dtype=np.float64), (links,)).copy()
        rows = np.asarray(reference, dtype=np.float64)
        return Task(scene, start, np.broadcast_to(rows, (links,)) if rows.ndim < 2 else rows, **task)

    return build


def _plans() -> Iterator[Plan]:
    for steps in (1, 10, 1000):
        yield Plan(f"{steps} nodes", "plans: horizon", _arm(), 1e-2, steps)
    yield Plan("1e4 nodes", "plans: horizon", _arm(1), 1e-2, 10_000)
    yield Plan("1e5 nodes", "plans: horizon", _arm(1), 1e-2, 100_000, deep=True)
    weights, request, actuation, noise = (f"plans: {part}" for part in ("weights", "request", "actuation", "noise"))
    jumps = np.where(np.arange(101) % 2 == 0, 10.0, -10.0)[:, None] * np.ones(2)
    up = _arm(q0=[UP, 0.0], reference=[UP, 0.0], controls=np.array([2.0, -1.0]))
    tasks = (
        *((weights, f"tracking weight {x:g}", _arm(tracking=x, final=x)) for x in (1e-9, 1e-3, 1e3, 1e9)),
        *((weights, f"control weight {x:g}", _arm(effort=x)) for x in (0.0, 1e-9, 1e9)),
        (weights, "all weights 1e-9", _arm(tracking=1e-9, effort=1e-9, final=1e-9)),
        (weights, "all weights 1e9", _arm(tracking=1e9, effort=1e9, final=1e9)),
        (request, "reference jumps by 20 rad a step", _arm(reference=jumps)),
        (request, "reference at 1e6 rad", _arm(reference=1e6)),
        (request, "upright, pushed over at first", up),
        (request, "first controls of 1e4 N m", _arm(controls=np.array([1e4, -1e4]))),
        (actuation, "a joint without motor", _arm(actuation=[[1.0], [0.0]])),
        (actuation, "motors that do nothing", _arm(actuation=[[0.0], [0.0]])),
        (actuation, "two motors on one joint", _arm(actuation=[[1.0, 1.0], [0.0, 0.0]])),
        *((noise, f"added noise of {x:g}", _arm(noise=AdditiveNoise(x))) for x in (1e-9, 1.0, 1e6)),
        *((noise, f"controls tremble by {x:g}", _arm(noise=ControlNoise(x))) for x in (0.1, 10.0, 1e4)),
    )
    for family, name, build in tasks:
        yield Plan(name, family, build, 1e-2, 200 if build is up else 100)


PLANS: tuple[Plan, ...] = tuple(_plans())


def plans_on(robot: Robot) -> list[Plan]:
    """Plans that make sense for any robot."""

    def task(**options: Any) -> Callable[[], Task]:
        def build() -> Task:
            scene = Scene(robot, damping=0.0, noise=options.pop("noise", None))
            return Task(scene, np.full(robot.dof, 0.3), np.zeros(robot.dof), **options)

        return build

    return [
        Plan("1 node", "plans", task(), 1e-2, 1),
        Plan("100 nodes", "plans", task(), 1e-2, 100),
        Plan("tracking weight 1e9", "plans", task(tracking=1e9, final=1e9), 1e-2, 50),
        Plan("no control weight", "plans", task(effort=0.0), 1e-2, 50),
    ]
