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

from varpin.control import OptimalControlProblem, Solution, Status, solve
from varpin.control.costs import ControlCost, Cost, Terminal, TrackingCost
from varpin.errors import VarpinError
from varpin.integrators import ExplicitEuler, Gauss, Integrator, Midpoint, Reference
from varpin.mechanics.noise import AdditiveNoise, ControlNoise, Noise
from varpin.mechanics.scene import Scene
from varpin.model import Robot
from varpin.model.chain import rod_chain
from varpin.simulation.run import simulate
from varpin.study.extremes.checks import energy_error
from varpin.study.extremes.trial import LEVELS, Kind
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
_UP = -0.5 * math.pi  # of a rod whose angle is 0 along x and turns down


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
        places = np.linspace(0.0, len(given) - 1.0, len(q))
        rows = np.stack([np.interp(places, np.arange(len(given)), column) for column in given.T], axis=1)
        path, tracking = scipy.interpolate.CubicHermiteSpline(t, q, motion.v), 0.0
        for place in (0.5 - math.sqrt(3.0) / 6.0, 0.5 + math.sqrt(3.0) / 6.0):
            off = path(t[:-1] + place * dt) - ((1.0 - place) * rows[:-1] + place * rows[1:])
            tracking += 0.5 * (off**2).sum()
        running = dt * (self.tracking * tracking + self.effort * (u**2).sum())
        return float(running + self.final * ((q[-1] - rows[-1]) ** 2).sum())


@dataclass(frozen=True)
class Plan:
    """A task at an extreme; attributes as of :class:`varpin.study.extremes.Trial`."""

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


def attempt(plan: Plan, integrator: Integrator, patience: float = math.inf) -> dict[str, Any]:
    """Solve it, within about this time [s], and judge the solution: what a cell holds."""
    outcome: dict[str, Any] = dict.fromkeys(
        ("error", "joint", "velocity", "period", "energy", "momentum", "reversal", "symplecticity", "record"), math.nan
    ) | {"said": (), "found": (), "done": 0}
    try:
        task = plan.build()
        problem = task.problem(plan.dt, plan.steps, integrator)
    except VarpinError as error:
        return outcome | {"kind": Kind.REFUSED, "said": (_line(error),)}
    try:
        with _heard() as warnings:
            solution = solve(problem, task.controls, max_iterations=plan.iterations, time_limit=patience)
    except VarpinError as error:
        done = getattr(getattr(error, "trajectory", None), "steps", 0)
        return outcome | {"kind": Kind.STOPPED, "said": (_line(error),), "done": done}
    except Exception as error:
        return outcome | {"kind": Kind.WRONG, "found": (f"unnamed error: {type(error).__name__}: {error}",)}
    record, left = cost_error(task, solution), part_left(task, solution)
    found = []
    # Written such that NaN is found.
    if not record <= COST_LEVEL:
        found.append(f"cost off by {record:.2g} of itself (wrong from {COST_LEVEL:g})")
    if not (np.isfinite(solution.gains).all() and np.isfinite(solution.feedforward).all()):
        found.append("the policy is not finite")
    # No word excuses a cost that is not the plan's own; one that is not the least, that it is not claimed to be.
    wrong = bool(found)
    if not (math.isnan(left) or left <= LEFT_LEVEL):
        wrong = wrong or solution.status.converged
        found.append(f"single controls take {left:.2g} off the cost (wrong from {LEFT_LEVEL:g})")
    said = (*(() if solution.status.converged else (solution.status.value,)), *warnings)
    energy = energy_error(problem.scene, solution.trajectory)
    if energy > LEVELS["energy"]:
        wrong = wrong or not said
        found.append(f"energy {energy:.2g} (wrong from {LEVELS['energy']:g})")
    # What is said of a plan is mostly of what the robot pays, which takes a while to find out.
    if said and not abs(paid := paid_by_robot(task, solution)) <= PAID_LEVEL:
        found.append(f"the robot pays {paid:+.2g} of the cost more for its controls (worth a word from {PAID_LEVEL:g})")
    restless = changes(solution.trajectory)
    if restless > max(_RESTLESS * plan.steps / 100.0, _FEW):
        wrong = wrong or not said
        found.append(f"a velocity goes up and down {restless} times in {plan.steps} steps")
    # Plans have a number of iterations here; one that it cuts short is no better and no worse than that.
    cut = solution.status is Status.MAX_ITERATIONS
    kind = Kind.WRONG if wrong else Kind.STOPPED if cut else Kind.DEGRADED if said else Kind.ACCURATE
    return outcome | {
        "kind": kind,
        "error": left,
        "energy": energy,
        "record": record,
        "said": said,
        "found": tuple(found),
        "done": plan.steps,
    }


@contextlib.contextmanager
def _heard() -> Iterator[list[str]]:
    """What the solver warns of within this context."""
    heard: list[str] = []

    class Ear(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            heard.append(record.getMessage())

    logger, ear = logging.getLogger("varpin.control"), Ear(logging.WARNING)
    logger.addHandler(ear)
    try:
        yield heard
    finally:
        logger.removeHandler(ear)


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


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


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
    for weight in (1e-9, 1e-3, 1e3, 1e9):
        yield Plan(f"tracking weight {weight:g}", "plans: weights", _arm(tracking=weight, final=weight), 1e-2, 100)
    for weight in (0.0, 1e-9, 1e9):
        yield Plan(f"control weight {weight:g}", "plans: weights", _arm(effort=weight), 1e-2, 100)
    yield Plan("all weights 1e-9", "plans: weights", _arm(tracking=1e-9, effort=1e-9, final=1e-9), 1e-2, 100)
    yield Plan("all weights 1e9", "plans: weights", _arm(tracking=1e9, effort=1e9, final=1e9), 1e-2, 100)
    jumps = np.where(np.arange(101) % 2 == 0, 10.0, -10.0)[:, None] * np.ones(2)
    yield Plan("reference jumps by 20 rad a step", "plans: request", _arm(reference=jumps), 1e-2, 100)
    yield Plan("reference at 1e6 rad", "plans: request", _arm(reference=1e6), 1e-2, 100)
    up = _arm(q0=[_UP, 0.0], reference=[_UP, 0.0], controls=np.array([2.0, -1.0]))
    yield Plan("upright, pushed over at first", "plans: request", up, 1e-2, 200)
    wild = _arm(controls=np.array([1e4, -1e4]))
    yield Plan("first controls of 1e4 N m", "plans: request", wild, 1e-2, 100)
    yield Plan("a joint without motor", "plans: actuation", _arm(actuation=[[1.0], [0.0]]), 1e-2, 100)
    yield Plan("motors that do nothing", "plans: actuation", _arm(actuation=[[0.0], [0.0]]), 1e-2, 100)
    yield Plan("two motors on one joint", "plans: actuation", _arm(actuation=[[1.0, 1.0], [0.0, 0.0]]), 1e-2, 100)
    for strength in (1e-9, 1.0, 1e6):
        name = f"added noise of {strength:g}"
        yield Plan(name, "plans: noise", _arm(noise=AdditiveNoise(strength)), 1e-2, 100)
    for strength in (0.1, 10.0, 1e4):
        name = f"controls tremble by {strength:g}"
        yield Plan(name, "plans: noise", _arm(noise=ControlNoise(strength)), 1e-2, 100)


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
