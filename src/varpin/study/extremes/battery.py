"""Runs trials with integrators, judges what comes of each, and keeps the record."""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

from varpin._version import __version__
from varpin.errors import VarpinError
from varpin.integrators import ExplicitEuler, Gauss, Integrator, Midpoint, RungeKutta4, SemiImplicitEuler
from varpin.io.archive import load_json, save_json
from varpin.model import Robot
from varpin.simulation import limits
from varpin.simulation.run import Interrupted, simulate
from varpin.study.extremes.checks import condition, findings, finite, measures
from varpin.study.extremes.exact import Exact, exact_motion
from varpin.study.extremes.plans import PLANS, Plan, judge_plan
from varpin.study.extremes.scenes import TRIALS, trials_on
from varpin.study.extremes.trial import LEVELS, Cell, Kind, Outcome, Setup, Trial, line_of
from varpin.support.checks import positive, writable
from varpin.trajectory import Trajectory

FORMAT = "varpin.extremes/3"

INTEGRATORS: tuple[Integrator, ...] = (
    *(Midpoint(alpha=alpha) for alpha in (0.0, 0.5, 1.0)),
    *(Gauss(stages=stages) for stages in (1, 2, 3, 4)),
    ExplicitEuler(),
    SemiImplicitEuler(),
    RungeKutta4(),
)

# A motion gets this long, and the plain battery half a minute at most for one [s].
_PATIENCE, _DEEP_PATIENCE = 20.0, 900.0
# Between two looks at the disk [s].
_SAVED_EVERY = 2.0

Progress = Callable[[int, int, str], None]
# What no coarse step excuses: a record that contradicts itself, and derivatives without their structure.
_STRUCTURE = ("record", "symplecticity")
_MEASURES = tuple(LEVELS)


class _OutOfTime(KeyboardInterrupt):
    """Ends a motion that takes too long, as Ctrl-C does."""


@dataclass(frozen=True, eq=False)
class Record:
    """What came of a battery.

    Attributes:
        cells: In the order of the trials, and of the integrators within.
        robot: The robot's name, or that of the battery of scenes.
        deep: Whether the long trials were among them.
        missing: Cells that an interruption left out.
        version: The varpin that made it.
    """

    cells: tuple[Cell, ...]
    robot: str
    deep: bool
    missing: int = 0
    version: str = __version__

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {kind.value}" for kind, count in self.counts().items() if count)
        return f"Record({self.robot}: {counts or 'no cells'}{f', {self.missing} missing' if self.missing else ''})"

    def counts(self) -> dict[Kind, int]:
        """How many cells there are of each kind."""
        return {kind: sum(cell.kind is kind for cell in self.cells) for kind in Kind}

    def wrong(self) -> tuple[Cell, ...]:
        """The cells that are wrong with nothing said."""
        return tuple(cell for cell in self.cells if cell.kind is Kind.WRONG)

    def needless(self) -> tuple[Cell, ...]:
        """The cells that varpin warns of although every check passes: false alarms."""
        return tuple(cell for cell in self.cells if cell.needless)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the record as JSON; returns its path. What is not a finite number stands there as null.

        Raises:
            FileError: The path cannot be written.
        """
        return save_json(path, FORMAT, self)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Record:
        """Read a record that :meth:`save` wrote.

        Raises:
            FileError: The file is missing, damaged or something else.
        """
        return load_json(path, FORMAT, cls)


def run(
    robot: Robot | None = None,
    *,
    deep: bool = False,
    trials: Sequence[Trial | Plan] | None = None,
    integrators: Sequence[Integrator] | None = None,
    save: str | os.PathLike[str] | None = None,
    patience: float | None = None,
    progress: Progress | None = None,
) -> Record:
    """Run scenes at the extremes with every integrator, and judge each.

    Main args:
        robot: Run what makes sense for any robot on this one, instead of the scenes made up for it.
        deep: The long trials too: hours.

    Other Args:
        trials: These instead.
        integrators: These instead of all.
        save: Keep the record in this JSON file; cells that it holds already are not run again.
        patience: Processor time that a motion may take before it is judged by what there is [s]; if given, plans get
            as much.
        progress: Called with (cells done, cells in all, the next one's name).

    Returns:
        The record; after Ctrl-C, of what was done.

    Raises:
        FileError: ``save`` cannot be written, or holds something else.
    """
    if trials is None:
        trials = (*TRIALS, *PLANS) if robot is None else trials_on(robot)
        trials = [trial for trial in trials if deep or not trial.deep]
    members = INTEGRATORS if integrators is None else tuple(integrators)
    limit = positive("patience", patience or (_DEEP_PATIENCE if deep else _PATIENCE), "s")
    name = "the battery" if robot is None else robot.name
    path = None if save is None else writable(save)
    known = Record.load(path).cells if path is not None and path.exists() else ()
    done = {cell.fingerprint: cell for cell in known}
    jobs = {
        fingerprint(trial, member, name, limit): (trial, member)
        for trial in trials
        for member in members
        if trial.takes(member)
    }
    cells = {key: done[key] for key in jobs if key in done}
    saved = time.monotonic()

    def current() -> Record:
        # Cells of an earlier run stay, however early an interruption comes.
        return Record(tuple(cells[key] for key in jobs if key in cells), name, deep, len(jobs) - len(cells))

    try:
        bench = None
        for key, (trial, member) in jobs.items():
            if key in cells:
                continue
            if progress is not None:
                progress(len(cells), len(jobs), f"{trial.name}, {member}")
            if bench is None or bench.trial is not trial:
                bench = Bench(trial)
            # A plan cut short is another plan; it has its number of iterations.
            cells[key] = bench.run(member, limit if isinstance(trial, Trial) or patience else math.inf, key)
            if path is not None and time.monotonic() - saved > _SAVED_EVERY:
                current().save(path)
                saved = time.monotonic()
    except KeyboardInterrupt:
        pass
    if path is not None:
        current().save(path)
    return current()


@cache
def _sources() -> str:
    """SHA-256 over varpin's own sources: no record outlives the code that made it."""
    digest = hashlib.sha256()
    folder = Path(__file__).parents[2]
    for source in sorted(folder.rglob("*.py")):
        digest.update(str(source.relative_to(folder)).encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()


def fingerprint(trial: Trial | Plan, integrator: Integrator, robot: str, patience: float) -> str:
    """What a cell is known by when a run goes on."""
    parts = robot, patience, trial.family, trial.name, trial.dt, trial.steps, repr(integrator), _sources()
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:24]


class Bench:
    """A trial with what all integrators share of it: its setup and its exact motion."""

    def __init__(self, trial: Trial | Plan) -> None:
        self.trial = trial
        self._exact: dict[bool, Exact | None] = {}

    def run(self, integrator: Integrator, patience: float, key: str = "") -> Cell:
        """The trial with one integrator."""
        trial, begin = self.trial, time.perf_counter()
        if isinstance(trial, Plan):
            outcome = judge_plan(trial, integrator, patience)
        else:
            try:
                outcome = self._judge_motion(trial, integrator, patience)
            except Exception as error:
                outcome = Outcome.of_error(error, Kind.REFUSED)
        return Cell(
            family=trial.family,
            trial=trial.name,
            integrator=str(integrator),
            kind=outcome.kind,
            said=outcome.said,
            found=outcome.found,
            done=outcome.done,
            steps=trial.steps,
            seconds=round(time.perf_counter() - begin, 3),
            fingerprint=key,
            **dict.fromkeys(_MEASURES, math.nan) | outcome.measures,
        )

    @cached_property
    def _setup(self) -> Setup:
        assert isinstance(self.trial, Trial)
        return self.trial.build()

    def _judge_motion(self, trial: Trial, integrator: Integrator, patience: float) -> Outcome:
        trajectory, error = _simulated(self._setup, trial, integrator, patience)
        found = measures(self._setup, integrator, trajectory, self._exact_motion(trial, integrator))
        wrong = findings(found, integrator, condition(self._setup))
        warnings = (warning for warning in trajectory.warnings if not warning.startswith(limits.KINDS))
        said = (*(() if error is None else (line_of(error),)), *warnings)
        if not finite(trajectory):
            kind, wrong = Kind.WRONG, ("the record is not finite", *wrong)
        elif any(text.startswith(_STRUCTURE) for text in wrong):
            kind = Kind.WRONG
        elif error is not None:
            kind = Kind.STOPPED
        elif said:
            kind = Kind.DEGRADED
        else:
            kind = Kind.WRONG if wrong else Kind.ACCURATE
        return Outcome(kind, found, said, wrong, trajectory.steps)

    def _exact_motion(self, trial: Trial, integrator: Integrator) -> Exact | None:
        """The exact motion, computed once; None where even that cannot be integrated."""
        # The explicit Euler method kicks beside its step: the way of that step does not know of it.
        late = isinstance(integrator, ExplicitEuler) and self._setup.increments is not None
        if late not in self._exact:
            try:
                self._exact[late] = exact_motion(self._setup, trial.dt, trial.steps, trial.window, late=late)
            except VarpinError:
                self._exact[late] = None
        return self._exact[late]


def _simulated(
    setup: Setup, trial: Trial, integrator: Integrator, patience: float
) -> tuple[Trajectory, VarpinError | None]:
    """The motion, as far as it goes, and the error that stopped it.

    Raises:
        VarpinError: It is refused before anything ran.
    """
    begin = time.process_time()

    def stop_late(done: int, steps: int) -> None:
        if done < steps and time.process_time() - begin > patience:
            raise _OutOfTime

    try:
        return simulate(
            setup.scene,
            setup.q0,
            setup.v0,
            dt=trial.dt,
            steps=trial.steps,
            controls=setup.controls,
            increments=setup.increments,
            integrator=integrator,
            progress=stop_late,
        ), None
    except Interrupted as error:
        if time.process_time() - begin <= patience:
            raise
        return error.trajectory, None
    except VarpinError as error:
        if getattr(error, "trajectory", None) is None:
            raise
        return error.trajectory, error  # type: ignore[attr-defined]
