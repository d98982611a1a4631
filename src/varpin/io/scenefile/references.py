"""References over time in scene files: constants, sines, waypoints and files of numbers."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.errors import FileError, InputError
from varpin.io.archive import read_npz
from varpin.io.scenefile.reading import (
    TEXT,
    ByName,
    Rule,
    Where,
    checked,
    entries,
    existing,
    number,
    rules_of,
    shown,
    suggestion,
    table,
    values,
    word,
)
from varpin.model import Robot


@dataclass(frozen=True, eq=False)
class Timeline:
    """Values over time, one column for each component.

    Attributes:
        at: Function from times (N,) [s] to values (N, c).
        constant: Whether the values are the same at all times.
    """

    at: Callable[[Floats], Floats]
    constant: bool

    def __call__(self, time: float) -> Floats:
        """Values (c,) at one time [s]."""
        row: Floats = self.at(np.array([time]))[0]
        return row

    def columns(self, keep: Sequence[int]) -> Timeline:
        """Some of the components."""
        return Timeline(_Columns(self.at, np.array(keep, dtype=np.int64)), self.constant)


def constant(values: Floats) -> Timeline:
    """The same values at all times."""
    return Timeline(_Constant(values), True)


# Functions of time are classes, because closures cannot be pickled.


@dataclass(frozen=True, eq=False)
class _Constant:
    values: Floats

    def __call__(self, t: Floats) -> Floats:
        return np.tile(self.values, (len(t), 1))


@dataclass(frozen=True, eq=False)
class _Columns:
    of: Callable[[Floats], Floats]
    index: NDArray[np.int64]

    def __call__(self, t: Floats) -> Floats:
        return self.of(t)[:, self.index]


@dataclass(frozen=True, eq=False)
class _Sines:
    offset: Floats
    sines: tuple[Sine, ...]
    columns: tuple[int, ...]

    def __call__(self, t: Floats) -> Floats:
        total = np.tile(self.offset, (len(t), 1))
        for column, sine in zip(self.columns, self.sines, strict=True):
            total[:, column] += sine.amplitude * np.sin(2.0 * math.pi * sine.frequency * t + sine.phase)
        return total


@dataclass(frozen=True, eq=False)
class _Smooth:
    curve: scipy.interpolate.PchipInterpolator
    first: float
    last: float

    def __call__(self, t: Floats) -> Floats:
        return np.asarray(self.curve(np.clip(t, self.first, self.last)))


@dataclass(frozen=True, eq=False)
class _Linear:
    times: Floats
    rows: Floats

    def __call__(self, t: Floats) -> Floats:
        return np.column_stack([np.interp(t, self.times, column) for column in self.rows.T])


@dataclass(frozen=True)
class Sine:
    """amplitude sin(2 pi frequency t + phase), added to one component."""

    of: Annotated[str, TEXT]
    amplitude: Annotated[float, number()]
    frequency: Annotated[float, number("Hz", above=0.0)]
    phase: Annotated[float, number("rad")] = 0.0


@dataclass(frozen=True)
class Sines:
    """A reference of sines."""

    sines: Annotated[tuple[Sine, ...], entries(table(Sine))]
    offset: Annotated[ByName, values()] = 0.0


@dataclass(frozen=True)
class Waypoints:
    """A reference of waypoints: straight lines, or a monotone cubic, between them."""

    times: Annotated[tuple[float, ...], entries(number("s"))]
    values: Annotated[tuple[tuple[float, ...], ...], entries(entries(number()))]
    between: Annotated[str, word("lines", "smooth")] = "lines"

    def __post_init__(self) -> None:
        if len(self.times) < 2 or not all(b > a for a, b in itertools.pairwise(self.times)):
            raise InputError(f"must be two or more, and increase [s], got {list(self.times)}", "times")
        if len(self.values) != len(self.times):
            raise InputError(
                f"must have {len(self.times)} rows, one for each of times; got {len(self.values)}", "values"
            )


def _values_file(text: str, where: Where) -> Path:
    if Path(text).suffix not in (".csv", ".npz"):
        raise where.error(f"must be a .csv or .npz file, got {text!r}")
    return existing(text, where)


@dataclass(frozen=True)
class Samples:
    """A reference in a file."""

    file: Annotated[Path, checked(TEXT, _values_file)]


REFERENCES: tuple[Any, ...] = (Samples, Waypoints, Sines)


def reference(**others: Any) -> Rule:
    """A reference: constant values, one of ``REFERENCES``, or one of ``others`` by type."""
    constants = values(**others)

    def read(value: Any, where: Where) -> Any:
        given = set(value) if isinstance(value, dict) else set()
        if any(isinstance(value[key], list | dict) for key in given & {"constant", "value"}):
            raise where.error("constant values are given without a table, as in target = [0.4, 0.2, 0.3]")
        kind = next((kind for kind in REFERENCES if given & set(rules_of(kind))), None)
        return constants.read(value, where) if kind is None else table(kind).read(value, where)

    return Rule("a number for all, a list, a table by name, sines, waypoints or a file", read)


def timeline(
    given: Any, where: Where, names: Sequence[str], what: str, robot: Robot, dt: float, duration: float
) -> Timeline:
    """The values over time of a reference that was read at ``where``, for the components ``names``.

    Raises:
        SceneFileError: It has other components or another length, or does not last for the horizon.
    """
    if isinstance(given, Samples):
        return _of_file(given.file, where.at("file"), names, duration, what)
    if isinstance(given, Waypoints):
        for index, row in enumerate(given.values):
            where.at("values").at(index).spread(row, names)
        try:
            with np.errstate(all="ignore"):
                return _between(np.array(given.times), np.array(given.values), smooth=given.between == "smooth")
        except ValueError as error:
            raise where.at("values").error(f"no smooth curve goes through them: {error}") from None
    if not isinstance(given, Sines):
        is_posture = isinstance(given, str)
        return constant(where.positions(given, robot) if is_posture else where.spread(given, names, what))
    offset = where.at("offset").spread(given.offset, names, what)
    for index, sine in enumerate(given.sines):
        place = where.at("sines").at(index)
        if sine.of not in names:
            raise place.at("of").error(f"there is no {what} {sine.of!r}; {suggestion(sine.of, names, what + 's')}")
        if sine.frequency > 0.5 / dt:
            most = f"<= {0.5 / dt:g} [Hz], the most that dt = {dt:g} s resolves"
            raise place.at("frequency").error(f"must be {most}, got {sine.frequency:g}")
    if not given.sines:
        return constant(offset)
    return Timeline(_Sines(offset, given.sines, tuple(names.index(sine.of) for sine in given.sines)), constant=False)


def _of_file(path: Path, where: Where, names: Sequence[str], duration: float, what: str) -> Timeline:
    def wrong(problem: str) -> Exception:
        return where.error(f"{path.name}: {problem}")

    columns = _npz(path, wrong) if path.suffix == ".npz" else _csv(path, wrong)
    if "t" not in columns:
        raise wrong(f"it has no column t of times [s]; it has {', '.join(columns)}")
    missing = [name for name in names if name not in columns]
    if missing:
        raise wrong(f"it has no column {missing[0]!r}; {what}s: {', '.join(names)}; columns: {', '.join(columns)}")
    t = columns["t"]
    rows = np.column_stack([columns[name] for name in names])
    if len(t) < 2 or not (np.diff(t) > 0.0).all():
        raise wrong("it must have two or more increasing times")
    if t[0] > 1e-9 * duration or t[-1] < duration * (1.0 - 1e-9):
        raise wrong(f"its times go from {t[0]:g} to {t[-1]:g} s, but the scene lasts from 0 to {duration:g} s")
    return _between(t, rows, smooth=False)


def _between(times: Floats, rows: Floats, *, smooth: bool) -> Timeline:
    """Rows over time; before the first time and after the last, the first and the last row."""
    if smooth:
        return Timeline(_Smooth(scipy.interpolate.PchipInterpolator(times, rows), times[0], times[-1]), constant=False)
    return Timeline(_Linear(times, rows), constant=False)


def _csv(path: Path, wrong: Callable[[str], Exception]) -> dict[str, Floats]:
    """The columns of a CSV file: a line of names, then lines of numbers."""
    try:
        head, *lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()] or [""]
        names = [name.strip(' "\t') for name in head.split(",")]
        numbers = np.loadtxt(lines, delimiter=",", comments=None, ndmin=2) if lines else np.zeros((0, 0))
    except (OSError, ValueError) as error:
        told = getattr(error, "strerror", None) or f"{str(error).partition(';')[0]} (row 0 is the first of numbers)"
        raise wrong(f"cannot be read: {told}") from None
    if twice := [name for name, times in Counter(names).items() if times > 1]:
        raise wrong(f"it has two columns {shown(twice[0])}")
    if not numbers.size:
        raise wrong("it must have a line of column names and lines of numbers")
    if numbers.shape[1] != len(names):
        raise wrong(f"its rows have {numbers.shape[1]} entries, but there are {len(names)} columns")
    if not np.isfinite(numbers).all():
        row, column = np.argwhere(~np.isfinite(numbers))[0].tolist()
        raise wrong(f"row {row + 2}, column {shown(names[column])} is not finite")
    return dict(zip(names, numbers.T, strict=True))


def _npz(path: Path, wrong: Callable[[str], Exception]) -> dict[str, Floats]:
    """The columns of an npz file: arrays of one length, or the joint positions of a saved trajectory."""
    try:
        arrays = read_npz(path)
        found: dict[str, Any] = dict(arrays.entries)
        if {"t", "q", "joint_names"} <= found.keys() and len(found["q"].shape) == 2:
            joints = [str(name) for name in arrays["joint_names"].reshape(-1)]
            if len(joints) == found["q"].shape[1]:
                found = {"t": found["t"]} | dict(zip(joints, arrays["q"].T, strict=True))
        length = found["t"].shape if "t" in found else ()
        for name, column in found.items():
            if column.dtype.kind not in "fi" or len(column.shape) != 1 or column.shape != length:
                raise wrong(f"its array {shown(name)} must have the shape of t, {length}, got {column.shape}")
        columns = {name: np.asarray(column, dtype=np.float64) for name, column in found.items()}
    except FileError as error:
        raise wrong(f"cannot be read: {error}") from None
    for name, column in columns.items():
        if not np.isfinite(column).all():
            raise wrong(f"its array {shown(name)} is not finite")
    return columns
