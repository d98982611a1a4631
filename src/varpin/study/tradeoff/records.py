"""Tables of runs: rows that are dataclasses, kept as npz and written as CSV; and which of them nothing beats."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from varpin.errors import FileError
from varpin.io.archive import read_npz
from varpin.support import markup
from varpin.support.checks import is_file, path_like
from varpin.trajectory import atomic_file

Row = TypeVar("Row")

# What numpy keeps the types of fields in.
_DTYPES = {"int": "iu", "float": "fiu", "str": "U"}

# No record unpacks to as much.
_MOST_BYTES = 50_000_000

# Costs closer than this, relative, are the same.
MARGIN = 0.02


class Record:
    """A frozen dataclass of ``runs`` and of the facts that belong to them all, kept as npz and written as CSV.

    Whoever makes one of it says what a run is, what the file is called, the headings of its columns, and which of
    them a notebook shows.
    """

    runs: tuple[Any, ...]
    _run: ClassVar[type[Any]]
    _format: ClassVar[str]
    _headings: ClassVar[Mapping[str, str]]
    _shown: ClassVar[Sequence[str]]

    def pareto(self) -> tuple[Any, ...]:
        """The runs that no other beats."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        rows = [[_cell(getattr(run, name)) for name in self._shown] for run in self.runs]
        front = self.pareto()
        strong = [k for k, run in enumerate(self.runs) if run in front]
        title = f"{self!r}; nothing beats the bold runs" if strong else repr(self)
        return markup.facts(title, [], markup.table([self._headings[name] for name in self._shown], rows, strong))

    @classmethod
    def _facts(cls) -> list[str]:
        return [item.name for item in fields(cls) if item.name != "runs"]  # type: ignore[arg-type]

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the record as npz; returns its path.

        Raises:
            FileError: The path cannot be written.
        """
        facts = {name: getattr(self, name) for name in self._facts()}
        return write_table(path, self._format, self.runs, self._run, **facts)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a record that :meth:`save` wrote.

        Raises:
            FileError: The file is missing, damaged or something else.
        """
        runs, facts = read_table(path, cls._format, cls._run, cls, cls._facts())
        return cls(runs=runs, **facts)  # type: ignore[call-arg]

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the runs as a table; returns its path.

        Raises:
            FileError: The path cannot be written.
        """
        return write_csv(path, self.runs, self._headings)


def _cell(value: object) -> object:
    """A field as a notebook shows it."""
    return "" if isinstance(value, float) and math.isnan(value) else value


def write_table(path: str | os.PathLike[str], form: str, rows: Sequence[Any], kind: type[Any], **facts: Any) -> Path:
    """Write rows of one dataclass and what belongs to them all as npz, without pickle; the old file stays until then.

    Raises:
        FileError: The path cannot be written.
    """
    members: dict[str, Any] = {"format": form, **facts}
    for item in fields(kind):
        members[f"runs.{item.name}"] = np.array([getattr(row, item.name) for row in rows])
    with atomic_file(path) as stream:
        np.savez_compressed(stream, **members)
    return Path(path)


def read_table(
    path: str | os.PathLike[str], form: str, kind: type[Row], record: type[Any], facts: Collection[str]
) -> tuple[tuple[Row, ...], dict[str, Any]]:
    """What :func:`write_table` wrote: the rows, and by name the ``facts``, which are fields of ``record``.

    Raises:
        FileError: The file is missing, damaged, or something else.
    """
    source = path_like("path", path)
    if not is_file(source):
        raise FileError(f"there is no file {source}")
    try:
        members = read_npz(source, what="record", most=_MOST_BYTES)
    except FileError as error:
        raise FileError(f"{source} is damaged, or no record of varpin.study.tradeoff: {error}") from None
    found = str(members.pop("format", "missing"))
    if found != form:
        raise FileError(f"{source} is not what is expected: its format is {found}, not {form!r}")
    columns = {item.name: (f"runs.{item.name}", str(item.type)) for item in fields(kind)}  # type: ignore[arg-type]
    own = {item.name: (item.name, str(item.type)) for item in fields(record) if item.name in facts}
    wanted = {name for name, _ in (*columns.values(), *own.values())}
    if set(members) != wanted:
        odd = ", ".join(sorted(set(members) ^ wanted))
        raise FileError(f"{source} is damaged: it lacks, or has beyond what it should, {odd}")
    rows = members[columns[next(iter(columns))][0]].size
    for dimensions, places in (((rows,), columns), ((), own)):
        for name, wants in places.values():
            array = members[name]
            # A column of no rows has forgotten what it was to hold.
            if array.shape != dimensions or (array.size and array.dtype.kind not in _DTYPES[wants]):
                raise FileError(
                    f"{source} is damaged: {name} is {array.dtype} {array.shape}, where {wants} {dimensions} belongs"
                )
    runs = zip(*(members[name].tolist() for name, _ in columns.values()), strict=True)
    return tuple(kind(*values) for values in runs), {key: members[name].item() for key, (name, _) in own.items()}


def write_csv(path: str | os.PathLike[str], rows: Sequence[Any], headings: Mapping[str, str]) -> Path:
    """Write rows as CSV with units in the heading; ``headings`` are by attribute.

    Raises:
        FileError: The path cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(headings.values())
    writer.writerows([getattr(row, name) for name in headings] for row in rows)
    with atomic_file(path) as stream:
        stream.write(text.getvalue().encode())
    return Path(path)


def pareto_front(
    rows: Sequence[Row],
    cost: Callable[[Row], float],
    error: Callable[[Row], float],
    spread: Callable[[Row], float],
) -> tuple[Row, ...]:
    """The rows that no other row clearly beats, from the cheapest up; rows with NaN are out.

    One beats another that is no less accurate and cheaper by more than the spread of either cost and more than 2 %:
    costs are measured, and a difference that the next measurement may turn round decides nothing.
    """
    finite = [row for row in rows if np.isfinite(cost(row)) and np.isfinite(error(row))]

    def beats(other: Row, row: Row) -> bool:
        margin = max(MARGIN * cost(row), spread(row), spread(other))
        return error(other) <= error(row) and cost(other) < cost(row) - margin

    front = [row for row in finite if not any(beats(other, row) for other in finite)]
    return tuple(sorted(front, key=lambda row: (cost(row), error(row))))
