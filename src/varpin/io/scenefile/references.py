"""References over time in scene files: constants, sines, waypoints and files of numbers."""

from __future__ import annotations

import array
import csv
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.errors import FileError
from varpin.io.archive import read_npz
from varpin.io.scenefile.table import ByName, Table, shown, suggestion
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


@dataclass(frozen=True, eq=False)
class Sine:
    """amplitude sin(2 pi frequency t + phase), added to one component."""

    of: str
    amplitude: float
    frequency: float  # [Hz]
    phase: float  # [rad]


@dataclass(frozen=True, eq=False)
class ReferenceSignal:
    """A reference in a file, before it is applied to a robot.

    Attributes:
        table: The table that contains it.
        name: Its key.
        offset: Constant part of constants and sines; or the name of a posture, for constants of joints.
        sines: Sines added to the offset.
        times: Times of waypoints [s].
        values: Waypoints, one row each.
        smooth: Whether a monotone cubic, instead of straight lines, connects the waypoints.
        file: CSV or npz file.
    """

    table: Table
    name: str
    offset: ByName | str = 0.0
    sines: tuple[Sine, ...] = ()
    times: tuple[float, ...] = ()
    values: tuple[tuple[float, ...], ...] = ()
    smooth: bool = False
    file: Path | None = None

    def timeline(self, names: Sequence[str], duration: float, what: str, robot: Robot) -> Timeline:
        """Its values over time for the components ``names``.

        Raises:
            SceneFileError: It has other components or another length, or does not last for ``duration`` [s].
        """
        if self.file is not None:
            return self._of_file(self.file, names, duration, what)
        if self.times:
            for index, row in enumerate(self.values):
                if len(row) != len(names):
                    raise self.table.error(
                        f"{self.name}.values[{index}]",
                        f"must have {len(names)} numbers, for {', '.join(names)}; got {len(row)}",
                    )
            try:
                with np.errstate(all="ignore"):
                    return _between(np.array(self.times), np.array(self.values), smooth=self.smooth)
            except ValueError as error:
                raise self.table.error(f"{self.name}.values", f"no smooth curve goes through them: {error}") from None
        where = f"{self.name}.offset" if self.sines else self.name
        if isinstance(self.offset, str):
            return constant(self.table.positions(where, self.offset, robot))
        offset = self.table.spread(where, self.offset, names, what)
        if not self.sines:
            return constant(offset)
        for index, sine in enumerate(self.sines):
            if sine.of not in names:
                raise self.table.error(
                    f"{self.name}.sines[{index}].of",
                    f"there is no {what} {sine.of!r}; {suggestion(sine.of, names, what + 's')}",
                )
        columns = tuple(names.index(sine.of) for sine in self.sines)
        return Timeline(_Sines(offset, self.sines, columns), constant=False)

    def _of_file(self, path: Path, names: Sequence[str], duration: float, what: str) -> Timeline:
        def wrong(problem: str) -> Exception:
            return self.table.error(f"{self.name}.file", f"{path.name}: {problem}")

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
    numbers = array.array("d")
    head: list[str] = []
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            for number, row in enumerate(filter(None, csv.reader(stream)), start=1):
                if not head:
                    head = [name.strip() for name in row]
                    twice = [name for name, times in Counter(head).items() if times > 1]
                    if twice:
                        raise wrong(f"it has two columns {shown(twice[0])}")
                    continue
                if len(row) != len(head):
                    raise wrong(f"row {number} has {len(row)} entries, but there are {len(head)} columns")
                for column, word in zip(head, row, strict=True):
                    try:
                        value = float(word)
                    except ValueError:
                        raise wrong(
                            f"row {number}, column {shown(column)}: {shown(word.strip())} is not a number"
                        ) from None
                    if not math.isfinite(value):
                        raise wrong(f"row {number}, column {shown(column)} is not finite")
                    numbers.append(value)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise wrong(f"cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not len(numbers):
        raise wrong("it must have a line of column names and lines of numbers")
    return dict(zip(head, np.array(numbers).reshape(-1, len(head)).T, strict=True))


def _npz(path: Path, wrong: Callable[[str], Exception]) -> dict[str, Floats]:
    """The columns of an npz file: arrays of one length, or the joint positions of a saved trajectory."""
    try:
        arrays = read_npz(path)
    except FileError as error:
        raise wrong(f"cannot be read: {error}") from None
    if {"t", "q", "joint_names"} <= set(arrays) and arrays["q"].ndim == 2:
        joints = [str(name) for name in arrays["joint_names"].reshape(-1)]
        if len(joints) == arrays["q"].shape[1]:
            arrays = {"t": arrays["t"]} | dict(zip(joints, arrays["q"].T, strict=True))
    length = arrays["t"].shape if "t" in arrays else ()
    for name, values in arrays.items():
        if values.dtype.kind not in "fi" or values.ndim != 1 or values.shape != length:
            raise wrong(f"its array {shown(name)} must have the shape of t, {length}, got {values.shape}")
        if not np.isfinite(values).all():
            raise wrong(f"its array {shown(name)} is not finite")
    return {name: np.asarray(values, dtype=np.float64) for name, values in arrays.items()}
