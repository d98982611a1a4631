"""Runs trials with integrators, judges what comes of each, and keeps the record."""

from __future__ import annotations

import hashlib
import json
import math
import os
import reprlib
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from varpin._version import __version__
from varpin.errors import FileError, VarpinError
from varpin.integrators import ExplicitEuler, Gauss, Integrator, Midpoint, RungeKutta4, SemiImplicitEuler
from varpin.model import Robot
from varpin.simulation import limits
from varpin.simulation.run import Interrupted, simulate
from varpin.study.extremes import plans
from varpin.study.extremes.checks import Exact, condition, exact_motion, findings, finite, measures
from varpin.study.extremes.plans import PLANS, Plan
from varpin.study.extremes.scenes import TRIALS, trials_on
from varpin.study.extremes.trial import Cell, Kind, Setup, Trial
from varpin.support.checks import is_file, path_like, positive, writable
from varpin.trajectory import Trajectory, atomic_file

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
_MEASURES = ("error", "joint", "velocity", "period", "energy", "momentum", "reversal", "symplecticity", "record")


class _OutOfTime(KeyboardInterrupt):
    """Ends a motion that takes too long, through the door for Ctrl-C."""


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
        facts = {"format": FORMAT} | {name: getattr(self, name) for name in ("version", "robot", "deep", "missing")}
        text = json.dumps(facts | {"cells": [_plain(cell) for cell in self.cells]}, indent=1, allow_nan=False)
        with atomic_file(path) as stream:
            stream.write(text.encode())
        return Path(path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Record:
        """Read a record that :meth:`save` wrote.

        Raises:
            FileError: The file is missing, damaged or something else.
        """
        source = path_like("path", path)
        if not is_file(source):
            raise FileError(f"there is no file {source}")
        try:
            with source.open("rb") as stream:
                content = stream.read(_MOST_BYTES + 1)
            if len(content) > _MOST_BYTES:
                raise ValueError(f"it is larger than {_MOST_BYTES / 1e6:g} MB")
            facts = _typed("the record", json.loads(content), _FACTS)
            if facts["format"] != FORMAT:
                raise ValueError(f"its format is {reprlib.repr(facts['format'])}, not {FORMAT!r}")
            cells = tuple(_cell(entry) for entry in facts["cells"])
        except OSError as error:
            raise FileError(f"cannot read {source}: {error.strerror or error}") from None
        except (ValueError, RecursionError) as error:
            raise FileError(f"{source} is damaged, or no record of varpin.study.extremes: {error}") from None
        return cls(cells, facts["robot"], facts["deep"], facts["missing"], facts["version"])


# What a record's file holds; larger than that of any battery is none.
_MOST_BYTES = 5_000_000
_FACTS: dict[str, type] = {
    "format": str, "version": str, "robot": str, "deep": bool, "missing": int, "cells": list,
}  # fmt: skip
_KINDS: dict[str, type] = {"str": str, "int": int, "float": float, "Kind": str, "tuple[str, ...]": list}


def _typed(what: str, found: Any, kinds: Mapping[str, type]) -> dict[str, Any]:
    """A table of JSON with a value of each kind and nothing else; whole numbers are taken for floats.

    Raises:
        ValueError: It says what is wrong.
    """
    if not isinstance(found, dict) or set(found) != set(kinds):
        raise ValueError(f"{what} does not have {', '.join(kinds)}")
    values = {}
    for name, kind in kinds.items():
        value = found[name]
        if kind is float and isinstance(value, int) and abs(value) < 2**53:
            value = float(value)
        if type(value) is not kind or (isinstance(value, int) and not 0 <= value < 2**63):
            raise ValueError(f"{name} of {what} is {reprlib.repr(value)}")
        values[name] = value
    return values


def _plain(cell: Cell) -> dict[str, Any]:
    entry = {item.name: getattr(cell, item.name) for item in fields(Cell)} | {"kind": cell.kind.value}
    for name in _MEASURES:
        value = entry[name]
        entry[name] = None if math.isnan(value) else "inf" if math.isinf(value) else value
    return entry


def _cell(entry: Any) -> Cell:
    if isinstance(entry, dict):
        absent = [name for name in _MEASURES if name in entry and entry[name] is None]
        endless = [name for name in _MEASURES if entry.get(name) == "inf"]
        entry = entry | dict.fromkeys(absent, math.nan) | dict.fromkeys(endless, math.inf)
    values = _typed("a cell", entry, {item.name: _KINDS[str(item.type)] for item in fields(Cell)})
    for name in ("said", "found"):
        if not all(isinstance(sentence, str) for sentence in values[name]):
            raise ValueError(f"{name} of a cell is {reprlib.repr(values[name])}")
        values[name] = tuple(values[name])
    if not math.isfinite(values["seconds"]):
        raise ValueError(f"seconds of a cell is {values['seconds']}")
    return Cell(**values | {"kind": Kind(values["kind"])})


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
    chores = {
        fingerprint(trial, member, name, limit): (trial, member)
        for trial in trials
        for member in members
        if trial.takes(member)
    }
    cells = {mark: done[mark] for mark in chores if mark in done}
    said = time.monotonic()

    def now() -> Record:
        # What is known already stays known, however early an interruption comes.
        return Record(tuple(cells[mark] for mark in chores if mark in cells), name, deep, len(chores) - len(cells))

    try:
        bench = None
        for mark, (trial, member) in chores.items():
            if mark in cells:
                continue
            if progress is not None:
                progress(len(cells), len(chores), f"{trial.name}, {member}")
            if bench is None or bench.trial is not trial:
                bench = Bench(trial)
            # A plan cut short is another plan; it has its number of iterations.
            cells[mark] = bench.run(member, limit if isinstance(trial, Trial) or patience else math.inf, mark)
            if path is not None and time.monotonic() - said > _SAVED_EVERY:
                now().save(path)
                said = time.monotonic()
    except KeyboardInterrupt:
        pass
    if path is not None:
        now().save(path)
    return now()


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
        self._setup: Setup | None = None
        self._exact: dict[bool, Exact | None] = {}

    def run(self, integrator: Integrator, patience: float, mark: str = "") -> Cell:
        """The trial with one integrator."""
        begin = time.perf_counter()
        if isinstance(self.trial, Plan):
            outcome = plans.attempt(self.trial, integrator, patience)
        else:
            outcome = self._motion(self.trial, integrator, patience)
        return Cell(
            family=self.trial.family,
            trial=self.trial.name,
            integrator=str(integrator),
            steps=self.trial.steps,
            seconds=round(time.perf_counter() - begin, 3),
            fingerprint=mark,
            **outcome,
        )

    def _motion(self, trial: Trial, integrator: Integrator, patience: float) -> dict[str, Any]:
        nothing = dict.fromkeys(_MEASURES, math.nan)
        try:
            trajectory, complaint = self._simulate(trial, integrator, patience)
            found = measures(self._setup, integrator, trajectory, self._truth(trial, integrator))  # type: ignore[arg-type]
        except VarpinError as error:
            return nothing | {"kind": Kind.REFUSED, "said": (_line(error),), "found": (), "done": 0}
        except Exception as error:
            # Whatever has no name of varpin's own is a fault, and the others are worth having.
            text = (f"unnamed error: {type(error).__name__}: {error}",)
            return nothing | {"kind": Kind.WRONG, "said": (), "found": text, "done": 0}
        wrong = findings(found, integrator, condition(self._setup))  # type: ignore[arg-type]
        said = tuple(sentence for sentence in trajectory.warnings if not sentence.startswith(limits.KINDS))
        if not finite(trajectory):
            kind, wrong = Kind.WRONG, ("the record is not finite", *wrong)
        elif any(sentence.startswith(_STRUCTURE) for sentence in wrong):
            kind = Kind.WRONG
        elif complaint is not None:
            kind = Kind.STOPPED
        elif said:
            kind = Kind.DEGRADED
        else:
            kind = Kind.WRONG if wrong else Kind.ACCURATE
        said = said if complaint is None else (complaint, *said)
        return found | {"kind": kind, "said": said, "found": wrong, "done": trajectory.steps}

    def _simulate(self, trial: Trial, integrator: Integrator, patience: float) -> tuple[Trajectory, str | None]:
        """The motion, as far as it goes, and the named error that stopped it."""
        if self._setup is None:
            self._setup = trial.build()
        setup, begin = self._setup, time.process_time()

        def watch(done: int, steps: int) -> None:
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
                progress=watch,
            ), None
        except Interrupted as error:
            if time.process_time() - begin <= patience:
                raise
            return error.trajectory, None
        except VarpinError as error:
            kept = getattr(error, "trajectory", None)
            if kept is None:
                raise
            return kept, _line(error)

    def _truth(self, trial: Trial, integrator: Integrator) -> Exact | None:
        """The exact motion, computed once; None where even the reference cannot."""
        # The explicit Euler method kicks beside its step: the way of that step does not know of it.
        late = isinstance(integrator, ExplicitEuler) and self._setup is not None and self._setup.increments is not None
        if late not in self._exact and self._setup is not None:
            try:
                self._exact[late] = exact_motion(self._setup, trial.dt, trial.steps, trial.window, late=late)
            except VarpinError:
                self._exact[late] = None
        return self._exact.get(late)


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def families(cells: Iterable[Cell]) -> dict[str, list[str]]:
    """The trials of each family, in their order."""
    found: dict[str, list[str]] = {}
    for cell in cells:
        names = found.setdefault(cell.family, [])
        if cell.trial not in names:
            names.append(cell.trial)
    return found
