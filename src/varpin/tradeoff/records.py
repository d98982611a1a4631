"""Tables of runs: rows that are dataclasses, kept as npz and written as CSV; and which of them nothing beats."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from varpin.checks import path_like
from varpin.errors import FileError
from varpin.trajectory import atomic_file

Row = TypeVar("Row")

# Costs closer than this, relative, are the same.
MARGIN = 0.02


class Record:
    """A frozen dataclass of ``runs`` and of the facts that belong to them all, kept as npz and written as CSV.

    Whoever makes one of it says what a run is, what the file is called, and the headings of its columns.
    """

    runs: tuple[Any, ...]
    _run: ClassVar[type[Any]]
    _format: ClassVar[str]
    _headings: ClassVar[Mapping[str, str]]

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
        runs, facts = read_table(path, cls._format, cls._run)
        if set(facts) != set(cls._facts()):
            raise FileError(f"{path} is damaged: it has {', '.join(sorted(facts))}")
        return cls(runs=runs, **{name: value.item() for name, value in facts.items()})  # type: ignore[call-arg]

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the runs as a table; returns its path.

        Raises:
            FileError: The path cannot be written.
        """
        return write_csv(path, self.runs, self._headings)


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


def read_table(path: str | os.PathLike[str], form: str, kind: type[Row]) -> tuple[tuple[Row, ...], dict[str, Any]]:
    """What :func:`write_table` wrote: the rows, and the rest by name.

    Raises:
        FileError: The file is missing, damaged, or something else.
    """
    source = path_like("path", path)
    if not source.is_file():
        raise FileError(f"there is no file {source}")
    # A damaged archive raises whatever zipfile, zlib and numpy stumble over: there is no list of it.
    try:
        with np.load(source, allow_pickle=False) as archive:
            members = {name: archive[name] for name in archive.files}
        found = str(members.pop("format"))
        columns = [members.pop(f"runs.{item.name}", np.zeros(0)).tolist() for item in fields(kind)]  # type: ignore[arg-type]
    except Exception as error:
        raise FileError(f"{source} is damaged, or no record of varpin.tradeoff: {error}") from None
    if found != form:
        raise FileError(f"{source} is not what is expected: its format is {found}, not {form!r}")
    return tuple(kind(*values) for values in zip(*columns, strict=True)), members


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
