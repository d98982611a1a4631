"""Tables of runs: rows that are dataclasses, kept as npz and written as CSV; and which of them nothing beats."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from varpin.archive import read_npz
from varpin.checks import path_like
from varpin.errors import FileError
from varpin.trajectory import atomic_file

Row = TypeVar("Row")

# What numpy keeps the types of fields in.
_DTYPES = {"int": "iu", "float": "fiu", "str": "U"}


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
    if not source.is_file():
        raise FileError(f"there is no file {source}")
    try:
        members = read_npz(source)
    except FileError as error:
        raise FileError(f"{source} is damaged, or no record of varpin.tradeoff: {error}") from None
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


def pareto_front(rows: Sequence[Row], cost: Callable[[Row], float], error: Callable[[Row], float]) -> tuple[Row, ...]:
    """The rows that no other row beats in both, from the cheapest to the most accurate; rows with NaN are out."""
    front: list[Row] = []
    finite = [row for row in rows if np.isfinite(cost(row)) and np.isfinite(error(row))]
    for row in sorted(finite, key=lambda row: (cost(row), error(row))):
        if not front or error(row) < error(front[-1]):
            front.append(row)
    return tuple(front)
