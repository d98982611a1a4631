"""The runs, one for each cell (setting, case, method, dt). They are kept on disk, to continue after an interruption.

Equation (O14) of docs/mathematics.md.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from paper import cases
from paper.cases import CASES, MAIN, METHODS, VARIATIONS, Case, Setting
from varpin._version import __version__
from varpin.arrays import Floats
from varpin.control import Solution, solve
from varpin.errors import VarpinError
from varpin.integrators import RungeKutta4
from varpin.io.archive import read_npz, record_of, save_npz
from varpin.linearization import linearize

Progress = Callable[[int, int, str], None]

# The search's parameters: epsilon of the paper, relative to the cost.
SEARCH = {"tolerance": 1e-4, "max_iterations": 60}
# Longest step of the accurate integrator inside an interval, where the sampled-data optimum is computed [s].
FINEST = 1.25e-4
OPTIMUM = "optimum"
# With the noise in the search, and with a search that knows nothing of it.
STOCHASTIC, PLAIN = "S-DDP", "DDP"
_FORMAT = "varpin.paper/1"
_PATHS = 400
_MORE_PATHS = 1000
# Where gains of different time steps are compared [s].
GAIN_TIMES = np.linspace(0.02, 1.4, 47)


@dataclass(frozen=True)
class Cell:
    """What one solve gave. Costs that do not exist (runaway motion, no noise) are NaN.

    Attributes:
        setting: Its key.
        case: Its key, or "0" without noise.
        method: one of ``METHODS``, "fourth-order", or "optimum" for the sampled-data optimum; or "S-DDP", "DDP".
        dt: Time between two controls [s].
        cost: The optimizer's own cost of the mean motion.
        noise_cost: What noise adds to it, by the optimizer's model.
        iterations: Of the search.
        status: Its name.
        seconds: Wall time of the search [s].
        open_loop: True cost of the controls on the continuous system.
        closed_loop: The same with feedback.
        accuracy: Of the true costs.
        sampled: Expected cost by Monte Carlo with the method's own steps, and its standard error.
        t: Times of the nodes [s].
        q: Configurations there.
        u: Controls.
        gains: Feedback on x at ``GAIN_TIMES``, referred to the middle of the steps; only of the two methods.
    """

    setting: str
    case: str
    method: str
    dt: float
    cost: float
    noise_cost: float
    iterations: int
    status: str
    seconds: float
    open_loop: float
    closed_loop: float
    accuracy: float
    sampled: Floats = field(default_factory=lambda: np.full(2, np.nan))
    t: Floats = field(default_factory=lambda: np.zeros(0), repr=False)
    q: Floats = field(default_factory=lambda: np.zeros((0, 3)), repr=False)
    u: Floats = field(default_factory=lambda: np.zeros((0, 3)), repr=False)
    gains: Floats = field(default_factory=lambda: np.zeros((0, 3, 6)), repr=False)

    @property
    def true_cost(self) -> float:
        """The better of open and closed loop: what a user gets who chooses well."""
        return float(np.nanmin([self.open_loop, self.closed_loop, np.inf]))


@dataclass(frozen=True)
class Task:
    """A cell to be filled."""

    setting: Setting
    case: Case | None
    method: str
    dt: float

    @property
    def name(self) -> str:
        """For its file."""
        case = "0" if self.case is None else self.case.key
        return f"{self.setting.key}_{case}_{self.method}_{self.dt:g}"


def tasks(*, quick: bool) -> Iterator[Task]:
    """Every cell, the paper's own first."""
    steps = cases.QUICK_STEPS if quick else cases.STEPS
    for case in CASES:
        for dt in steps:
            for method in METHODS:
                yield Task(MAIN, case, method, dt)
    for setting in (MAIN,) if quick else (MAIN, *VARIATIONS):
        for dt in steps:
            for method in (*METHODS, cases.FOURTH_ORDER, OPTIMUM):
                yield Task(setting, None, method, dt)
    for strength in cases.QUICK_STRENGTHS if quick else cases.NOISY_STRENGTHS:
        for method in (STOCHASTIC, PLAIN):
            yield Task(cases.NOISY, cases.noisy_case(strength), method, cases.NOISY_STEP)


def run(task: Task) -> Cell:
    """Fill a cell."""
    if task.method == OPTIMUM:
        return _optimum(task)
    if task.method in (STOCHASTIC, PLAIN):
        return _under_noise(task)
    problem = cases.problem(task.setting, task.case, task.method, task.dt)
    started = time.perf_counter()
    solution = solve(problem, **SEARCH, check=False)  # type: ignore[arg-type]
    seconds = time.perf_counter() - started
    sampled = (np.nan, np.nan)
    if task.case is not None and task.dt >= 1e-3:
        estimate = solution.monte_carlo(_PATHS, 1)
        sampled = (estimate.cost, estimate.standard_error)
    return _cell(task, solution, seconds, sampled)


def _optimum(task: Task) -> Cell:
    """The optimum over controls that are held for dt, with an accurate integrator inside each interval."""
    hold = max(8, int(np.ceil(task.dt / FINEST)))
    base = cases.problem(task.setting, None, "variational", task.dt)
    problem = base.at(
        dt=task.dt / hold, steps=base.steps * hold, hold=hold, integrator=RungeKutta4(), sampling="midpoint"
    )
    started = time.perf_counter()
    most = int(SEARCH["max_iterations"])
    solution = solve(problem, tolerance=1e-9, max_iterations=most, check=False)
    return _cell(task, solution, time.perf_counter() - started, (np.nan, np.nan))


def _under_noise(task: Task) -> Cell:
    """A policy in the noisy scene, by Monte Carlo: of S-DDP, or of DDP on the scene without noise."""
    problem = cases.problem(task.setting, task.case, "variational", task.dt)
    known = problem if task.method == STOCHASTIC else cases.problem(task.setting, None, "variational", task.dt)
    started = time.perf_counter()
    plan = replace(solve(known, check=False), problem=problem)
    seconds = time.perf_counter() - started
    try:
        estimate = plan.monte_carlo(_MORE_PATHS, 1)
    except VarpinError:  # every path ran away
        return _cell(task, plan, seconds, (np.inf, np.nan))
    mean = estimate.cost if estimate.failures == 0 else np.inf
    return _cell(task, plan, seconds, (mean, estimate.standard_error))


def _cell(task: Task, solution: Solution, seconds: float, sampled: tuple[float, float]) -> Cell:
    truth = solution.verify(max_substeps=max(16, 300_000 // solution.problem.steps))
    trajectory, hold = solution.trajectory, solution.problem.hold
    return Cell(
        setting=task.setting.key,
        case="0" if task.case is None else task.case.key,
        method=task.method,
        dt=task.dt,
        cost=solution.cost,
        noise_cost=solution.noise_cost,
        iterations=solution.iterations,
        status=solution.status.name,
        seconds=seconds,
        open_loop=truth.open_loop_cost,
        closed_loop=truth.closed_loop_cost,
        accuracy=truth.accuracy,
        sampled=np.array(sampled),
        t=trajectory.t[::hold],
        q=trajectory.q[::hold],
        u=solution.controls,
        gains=_middle_gains(solution) if task.method in METHODS else np.zeros((0, 3, 6)),
    )


def _middle_gains(solution: Solution) -> Floats:
    """The feedback gains on x, referred to the state in the middle of each step, (O14), at ``GAIN_TIMES``.

    A held control reacts half a step late on average. Its gain on the state at the beginning of the step therefore
    differs from the continuous gain in first order, for every integrator; its gain on the state in the middle differs
    in second order.
    """
    problem = solution.problem
    lin = linearize(problem.scene, solution.trajectory, integrator=problem.integrator)
    closed = lin.A + lin.B @ solution.gains
    middle = 0.5 * (np.eye(closed.shape[1]) + closed)
    gains = np.swapaxes(np.linalg.solve(np.swapaxes(middle, 1, 2), np.swapaxes(solution.gains, 1, 2)), 1, 2)
    times = solution.trajectory.t[:-1] + 0.5 * problem.dt
    rows = [np.interp(GAIN_TIMES, times, entry) for entry in gains.reshape(len(gains), -1).T]
    return np.array(rows).T.reshape(len(GAIN_TIMES), *gains.shape[1:])


def fill(folder: Path, *, quick: bool, progress: Progress | None = None) -> dict[str, Cell]:
    """All cells, by the names of their tasks; those of this version in the folder are not computed again.

    Ctrl-C loses the cell it interrupts and no other.

    Raises:
        FileError: A cell in the folder is damaged; without its file it is computed again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    todo = list(tasks(quick=quick))
    cells: dict[str, Cell] = {}
    for number, task in enumerate(todo):
        if progress is not None:
            progress(number, len(todo), task.name)
        path = folder / f"{task.name}_{__version__}.npz"
        if not path.is_file():
            save_npz(path, _FORMAT, run(task))
        cells[task.name] = record_of(Cell, read_npz(path, _FORMAT), path)
    return cells
