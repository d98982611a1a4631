"""Runs trials with integrators, judges what comes of each, and keeps the record."""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Sequence
from functools import cache, cached_property
from pathlib import Path

import varpin
from battery.exact import before_step, exact_motion, period_error
from battery.plans import PLANS, Plan, judge_plan
from battery.scenes import TRIALS, trials_on
from battery.trial import Outcome, Setup, Trial
from varpin.errors import VarpinError
from varpin.integrators import Integrator
from varpin.model import Robot
from varpin.study.extremes import checks
from varpin.study.extremes.checks import condition, findings
from varpin.study.extremes.exact import Exact
from varpin.study.extremes.record import LEVELS, Cell, Kind, Record
from varpin.study.extremes.robot import INTEGRATORS, Progress, attempt, judge
from varpin.support.checks import positive, writable
from varpin.trajectory import Trajectory

# A motion gets this long, and the plain battery half a minute at most for one [s].
_PATIENCE, _DEEP_PATIENCE = 20.0, 900.0
# Between two looks at the disk [s].
_SAVED_EVERY = 2.0

_MEASURES = tuple(LEVELS)


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


def measures(setup: Setup, integrator: Integrator, trajectory: Trajectory, exact: Exact | None) -> dict[str, float]:
    """Every check of a motion by its name in :class:`Cell`: those of ``check_robot``, and from nodes all over it."""
    own = checks.measures(setup.scene, integrator, trajectory, exact)
    return own | {"period": period_error(setup.scene, integrator, trajectory)}


@cache
def _sources() -> str:
    """SHA-256 over varpin's own sources and these: no record outlives the code that made it."""
    digest = hashlib.sha256()
    for folder in (Path(varpin.__file__).parent, Path(__file__).parent):
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
        self._exact: dict[float | None, Exact | None] = {}

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
        setup = self._setup
        trajectory, error = attempt(
            patience, setup.scene, setup.q0, setup.v0, dt=trial.dt, steps=trial.steps,
            controls=setup.controls, increments=setup.increments, integrator=integrator,
        )  # fmt: skip
        found = measures(setup, integrator, trajectory, self._exact_motion(trial, integrator))
        kind, said, wrong = judge(trajectory, error, findings(found, integrator, condition(setup.scene, setup.q0)))
        return Outcome(kind, found, said, wrong, trajectory.steps)

    def _exact_motion(self, trial: Trial, integrator: Integrator) -> Exact | None:
        """The exact motion, computed once; None where even that cannot be integrated."""
        left = 1.0 if self._setup.increments is None else before_step(integrator)
        if left not in self._exact:
            try:
                self._exact[left] = exact_motion(self._setup, trial.dt, trial.steps, trial.window, left=left)
            except VarpinError:
                self._exact[left] = None
        return self._exact[left]
