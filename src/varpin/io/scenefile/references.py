"""References over time in scene files: constants, sines, waypoints and files of numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.errors import FileError, InputError
from varpin.io.archive import read_npz
from varpin.io.scenefile.reading import Where
from varpin.model import Robot
from varpin.support.checks import as_floats, finite, positive, require_finite

# Share by which the first and the last time of a file may miss the ends of the horizon: rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Timeline:
    """Values over time, one column for each component."""

    at: Callable[[Floats], Floats]
    constant: bool = False

    def __call__(self, time: float) -> Floats:
        """Values (c,) at one time [s]."""
        row: Floats = self.at(np.array([time]))[0]
        return row

    def columns(self, keep: Sequence[int]) -> Timeline:
        """Some of the components."""
        return Timeline(_Columns(self.at, np.array(keep, dtype=np.int64)), self.constant)


def constant(values: Floats) -> Timeline:
    """The same values at all times."""
    return Timeline(_Sines(values), True)


# Functions of time are classes, because closures cannot be pickled.


@dataclass(frozen=True, eq=False)
class _Columns:
    of: Callable[[Floats], Floats]
    index: NDArray[np.int64]

    def __call__(self, t: Floats) -> Floats:
        return self.of(t)[:, self.index]


@dataclass(frozen=True, eq=False)
class _Sines:
    offset: Floats
    sines: tuple[tuple[int, Sine], ...] = ()

    def __call__(self, t: Floats) -> Floats:
        total = np.tile(self.offset, (len(t), 1))
        for column, sine in self.sines:
            total[:, column] += sine.amplitude * np.sin(2.0 * math.pi * sine.frequency * t + sine.phase)
        return total


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows over time, by straight lines or a curve; outside the first and the last row."""

    times: Floats
    rows: Floats
    curve: scipy.interpolate.PchipInterpolator | None = None

    def __call__(self, t: Floats) -> Floats:
        if self.curve is not None:
            return np.asarray(self.curve(np.clip(t, self.times[0], self.times[-1])))
        return np.column_stack([np.interp(t, self.times, column) for column in self.rows.T])


@dataclass(frozen=True)
class Sine:
    """amplitude sin(2 pi frequency t + phase), added to the component ``of``."""

    of: str
    amplitude: float
    frequency: float
    phase: float = 0.0

    def __post_init__(self) -> None:
        finite("amplitude", self.amplitude)
        finite("phase", self.phase)
        positive("frequency", self.frequency, "Hz")


@dataclass(frozen=True)
class Sines:
    """A reference of sines."""

    sines: Any = ()
    offset: Any = 0.0

    def timeline(self, where: Where, names: Sequence[str], what: str, horizon: tuple[float, float]) -> Timeline:
        """The sines about their offset; the horizon is the step and the duration [s]."""
        offset, found, (dt, _) = where.at("offset").numbers(self.offset, names, what), [], horizon
        for place, given in where.at("sines").tables(self.sines):
            sine = place.call(Sine, given)
            place.at("of").one_of(sine.of, names)
            if sine.frequency > 0.5 / dt:
                most = f"<= {0.5 / dt:g} [Hz], the most that dt = {dt:g} s resolves"
                raise place.at("frequency").error(f"must be {most}, got {sine.frequency:g}")
            found.append((names.index(sine.of), sine))
        return Timeline(_Sines(offset, tuple(found)), not found)


@dataclass(frozen=True)
class Waypoints:
    """A reference of waypoints: straight lines, or a monotone cubic, between them."""

    times: Any
    values: Any
    between: str = "lines"

    def timeline(self, where: Where, names: Sequence[str], what: str, _: tuple[float, float]) -> Timeline:
        """The rows at their times."""
        times = where.at("times").check(lambda name, given: require_finite(name, as_floats(name, given)), self.times)
        if times.ndim != 1 or len(times) < 2 or not (np.diff(times) > 0.0).all():
            raise where.at("times").error(f"must be two or more, and increase [s], got {self.times}")
        if not isinstance(self.values, list) or len(self.values) != len(times):
            raise where.at("values").error(f"must be {len(times)} rows, one for each of times")
        rows = np.array([where.at("values", k).numbers(row, names, what) for k, row in enumerate(self.values)])
        if where.at("between").one_of(self.between, ("lines", "smooth")) == "lines":
            return Timeline(_Rows(times, rows))
        try:
            with np.errstate(all="ignore"):
                return Timeline(_Rows(times, rows, scipy.interpolate.PchipInterpolator(times, rows)))
        except ValueError as error:
            raise where.at("values").error(f"no smooth curve goes through them: {error}") from None


@dataclass(frozen=True)
class Samples:
    """A reference in a CSV or npz file."""

    file: Any

    def timeline(self, where: Where, names: Sequence[str], what: str, horizon: tuple[float, float]) -> Timeline:
        """The columns of the components over the column t."""
        place = where.at("file")
        path = place.file(self.file)
        try:
            columns = _npz(path) if path.suffix == ".npz" else _csv(path)
            for name in ("t", *names):
                if name not in columns:
                    owner = "times [s]" if name == "t" else f"the {what} {name!r}"
                    raise InputError(f"it has no column {name!r} of {owner}; columns: {', '.join(columns)}")
            t, rows = columns["t"], np.column_stack([columns[name] for name in names])
            if len(t) < 2 or not (np.diff(t) > 0.0).all():
                raise InputError("it must have two or more increasing times")
            end = horizon[1]
            if t[0] > _ROUNDING * end or t[-1] < end * (1.0 - _ROUNDING):
                raise InputError(f"its times go from {t[0]:g} to {t[-1]:g} s, the scene lasts from 0 to {end:g} s")
        except (InputError, FileError) as error:
            raise place.error(f"{path.name}: {error}") from None
        return Timeline(_Rows(t, rows))


KINDS: tuple[Any, ...] = (Samples, Waypoints, Sines)


def timeline(
    given: Any, where: Where, names: Sequence[str], what: str, robot: Robot, horizon: tuple[float, float]
) -> Timeline:
    """The values over time of a reference; ``what`` is one of its components, the horizon the step and the duration."""
    for kind in KINDS:
        if isinstance(given, Mapping) and given.keys() & {item.name for item in fields(kind)}:
            found: Timeline = where.call(kind, given).timeline(where, names, what, horizon)
            return found
    if isinstance(given, str) and tuple(names) == robot.joint_names:
        return constant(where.positions(given, robot))
    return constant(where.numbers(given, names, what))


def _csv(path: Path) -> dict[str, Floats]:
    """The columns of a CSV file: a line of names, then lines of numbers."""
    try:
        head, *lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()] or [""]
        names = [name.strip(' "\t') for name in head.split(",")]
        rows = np.loadtxt(lines, delimiter=",", comments=None, ndmin=2) if lines else np.zeros((0, len(names)))
    except (OSError, ValueError) as error:
        told = getattr(error, "strerror", None) or f"{str(error).partition(';')[0]} (row 0 is the first of numbers)"
        raise InputError(f"cannot be read: {told}") from None
    if len(set(names)) < len(names) or rows.shape[1] != len(names):
        raise InputError(f"its rows have {rows.shape[1]} entries, for the columns {', '.join(names)}, each once")
    return dict(zip(names, require_finite("its numbers", rows).T, strict=True))


def _npz(path: Path) -> dict[str, Floats]:
    """The columns of an npz file: arrays of one length, or the joint positions of a saved trajectory."""
    found: dict[str, Any] = dict(read_npz(path))
    if {"t", "q", "joint_names"} <= found.keys():
        joints = [str(name) for name in np.ravel(found["joint_names"])]
        if len(found["q"].shape) == 2 and found["q"].shape[1] == len(joints):
            found = {"t": found["t"]} | dict(zip(joints, np.asarray(found["q"]).T, strict=True))
    length = found["t"].shape if "t" in found else ()
    for name, column in found.items():
        if column.dtype.kind not in "fi" or len(column.shape) != 1 or column.shape != length:
            raise InputError(f"its array {name!r} must have the shape of t, {length}, got {column.shape}")
    return {name: require_finite(f"its array {name!r}", np.asarray(a, dtype=np.float64)) for name, a in found.items()}
