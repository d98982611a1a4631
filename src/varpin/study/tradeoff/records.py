"""Tables of runs: rows that are dataclasses, kept as npz and written as CSV; and which of them nothing beats."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from varpin.io.archive import atomic_file, load_npz, save_npz
from varpin.support import markup

Row = TypeVar("Row")


class RunTable:
    """A frozen dataclass of ``runs`` and of the facts common to all of them, saved as npz and written as CSV.

    A subclass defines the format of its files, the headings of its columns, and the columns that a notebook shows.
    """

    runs: tuple[Any, ...]
    _format: ClassVar[str]
    _headings: ClassVar[Mapping[str, str]]
    _columns: ClassVar[Sequence[str]]

    def pareto(self) -> tuple[Any, ...]:
        """The runs than which no other is better in both columns."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        rows = [[_cell(getattr(run, name)) for name in self._columns] for run in self.runs]
        front = self.pareto()
        strong = [k for k, run in enumerate(self.runs) if run in front]
        title = f"{self!r}; nothing beats the bold runs" if strong else repr(self)
        return markup.facts(title, [], markup.table([self._headings[name] for name in self._columns], rows, strong))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the record as npz; returns its path.

        Raises:
            FileError: The path cannot be written.
        """
        return save_npz(path, self._format, self)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a record that :meth:`save` wrote.

        Raises:
            FileError: The file is missing, damaged or something else.
        """
        return load_npz(path, cls._format, cls)

    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write the runs as a table; returns its path.

        Raises:
            FileError: The path cannot be written.
        """
        return write_csv(path, self.runs, self._headings)


def _cell(value: object) -> object:
    """A field as a notebook shows it."""
    return "" if isinstance(value, float) and math.isnan(value) else value


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
) -> tuple[Row, ...]:
    """The rows than which no other is better in both cost and error, from the cheapest up; rows with NaN are out."""
    finite = [row for row in rows if np.isfinite(cost(row)) and np.isfinite(error(row))]

    def beats(other: Row, row: Row) -> bool:
        return error(other) < error(row) and cost(other) < cost(row)

    front = [row for row in finite if not any(beats(other, row) for other in finite)]
    return tuple(sorted(front, key=lambda row: (cost(row), error(row))))
