"""What a study returns: its runs as a table, in notebooks and as CSV; Ctrl-C keeps the runs that are done."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, cast

from varpin.errors import InputError
from varpin.io.archive import atomic_file
from varpin.support import markup
from varpin.support.checks import is_one_of
from varpin.support.tables import Table, csv_text

Row = TypeVar("Row")
Made = TypeVar("Made", bound="Study[Any]")
Progress = Callable[[int, int], None]

# Headings of attributes; those of others are their names.
_HEADINGS = {
    "dt": "dt [s]",
    "seconds": "wall time [s]",
    "error": "error in q [rad or m]",
    "energy_error": "energy error [J]",
    "open_loop_cost": "true cost, open loop",
    "closed_loop_cost": "true cost, feedback",
}


@dataclass(frozen=True, eq=False)
class Study(Generic[Row]):
    """Runs of one motion, one problem or one robot.

    Attributes:
        runs: The rows of the table.
        robot: The robot's name.
        missing: Runs that an interruption left out.
    """

    # The attributes of a run that screens and pages show, and headings of this study's own.
    shown: ClassVar[Sequence[str]]
    headings: ClassVar[Mapping[str, str]] = {}
    # The attributes that are set against wall time, by the words of ``quantity=``.
    quantities: ClassVar[Mapping[str, str]] = {}
    logarithmic: ClassVar[bool] = True  # whether a figure shows them so

    runs: tuple[Row, ...]
    robot: str
    missing: int = field(default=0, kw_only=True)

    def __repr__(self) -> str:
        left = f", {self.missing} missing" if self.missing else ""
        return f"{type(self).__name__}({self.robot}: {self.summary}{left})"

    @property
    def summary(self) -> str:
        """The result in a few words."""
        return f"{len(self.runs)} runs" + (f", {len(self.failures)} failed" if self.failures else "")

    @property
    def failures(self) -> tuple[str, ...]:
        """Why runs failed, each in a sentence."""
        runs: tuple[Any, ...] = self.runs
        return tuple(f"{r.integrator}, dt = {r.dt:g} s: {r.failure}" for r in runs if getattr(r, "failure", ""))

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the table has to know, in sentences."""
        raise NotImplementedError

    def value_of(self, run: Row, quantity: str = "") -> float:
        """A ``quantity`` of a run that is set against its wall time, the first if left out; NaN where it failed."""
        return float(getattr(run, self._attribute(quantity)))

    def pareto(self, quantity: str = "") -> tuple[Row, ...]:
        """The runs than which no other has both a smaller wall time and a smaller quantity, from the fastest up."""
        if not (quantity or self.quantities):
            return ()
        return pareto_front(self.runs, attrgetter("seconds"), lambda run: self.value_of(run, quantity))

    def axes(self, quantity: str = "") -> tuple[str, str]:
        """Labels of a figure; raises an InputError if there is none."""
        return self._heading("seconds"), self._heading(self._attribute(quantity))

    def _attribute(self, quantity: str) -> str:
        if not self.quantities:
            raise InputError(f"a {type(self).__name__} has no figure")
        words = tuple(self.quantities)
        if quantity and not is_one_of(quantity, words):
            raise InputError(f"quantity must be {' or '.join(map(repr, words))}, got {quantity!r}")
        return self.quantities[quantity or words[0]]

    def note(self, run: Row) -> str:
        """The last column of a run."""
        return "failed" if getattr(run, "failure", "") else "Pareto" if run in self.pareto() else ""

    def columns(self) -> tuple[str, ...]:
        """The headings of the columns that screens show."""
        return (*map(self._heading, self.shown), "note")

    def row(self, run: Row) -> tuple[str, ...]:
        """A run as entries of these columns."""
        return (*(_text(getattr(run, name)) for name in self.shown), self.note(run))

    def table(self, title: str = "") -> Table:
        """The runs as a table; those that nothing beats stand out."""
        front = self.pareto()
        strong = frozenset(k for k, run in enumerate(self.runs) if run in front)
        return Table(title, self.columns(), [self.row(run) for run in self.runs], strong)

    def _repr_html_(self) -> str:
        runs = self.table()
        table = markup.table(runs.columns, runs.rows, runs.strong)
        return markup.facts(repr(self), [("", note) for note in (*self.notes, *self.failures)], table)

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write all columns of the runs as CSV, with units in the heading; returns the path.

        Raises:
            FileError: The path cannot be written.
        """
        names = [item.name for item in fields(cast("Any", self.runs[0]))] if self.runs else self.shown
        rows = ([_plain(getattr(run, name)) for name in names] for run in self.runs)
        with atomic_file(path) as stream:
            stream.write(csv_text(map(self._heading, names), rows).encode())
        return Path(path)

    def _heading(self, name: str) -> str:
        return self.headings.get(name) or _HEADINGS.get(name, name.replace("_", " "))


class StudyInterrupted(KeyboardInterrupt):
    """Ctrl-C during a study.

    Attributes:
        record: What the study returns, with the runs that are done; ``record.missing`` counts the others.
    """

    def __init__(self, record: Study[Any]) -> None:
        self.record = record
        super().__init__(f"interrupted after {len(record.runs)} runs; they are in .record")


def collect(base: Made, runs: Generator[Any, None, None], total: int, progress: Progress | None) -> Made:
    """The study ``base`` with its runs, which are measured one by one; raises StudyInterrupted at Ctrl-C."""
    done: list[Any] = []
    try:
        with closing(runs):
            for run in runs:
                done.append(run)
                if progress is not None:
                    progress(len(done), total)
    except KeyboardInterrupt:
        raise StudyInterrupted(replace(base, runs=tuple(done), missing=total - len(done))) from None
    return replace(base, runs=tuple(done))


def pareto_front(rows: Sequence[Row], cost: Callable[[Row], float], error: Callable[[Row], float]) -> tuple[Row, ...]:
    """The rows than which no other is better in both cost and error, from the cheapest up; rows with NaN are out."""
    finite = [row for row in rows if math.isfinite(cost(row)) and math.isfinite(error(row))]

    def beats(other: Row, row: Row) -> bool:
        return error(other) < error(row) and cost(other) < cost(row)

    front = [row for row in finite if not any(beats(other, row) for other in finite)]
    return tuple(sorted(front, key=lambda row: (cost(row), error(row))))


def _text(value: object) -> str:
    """A value as a screen shows it."""
    if isinstance(value, float):
        return "" if math.isnan(value) else "unknown" if math.isinf(value) else f"{value:.3g}"
    return str(value)


def _plain(value: object) -> object:
    """A value as CSV has it."""
    if isinstance(value, tuple):
        return "; ".join(map(str, value))
    return value.value if isinstance(value, Enum) else value
