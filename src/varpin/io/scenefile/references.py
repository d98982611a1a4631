"""References over time in scene files: constants, sines, waypoints and files of numbers."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from varpin.arrays import Floats, Integers
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


# Functions of time are parts of functions of this module, because closures cannot be pickled.
def _columns(of: Timeline, keep: Integers | slice, t: Floats) -> Floats:
    return of.at(t)[:, keep]


def _waves(offset: Floats, waves: Sequence[tuple[int, float, float, float]], t: Floats) -> Floats:
    total = np.tile(offset, (len(t), 1))
    for column, amplitude, frequency, phase in waves:
        total[:, column] += amplitude * np.sin(2.0 * math.pi * frequency * t + phase)
    return total


def _lines(times: Floats, rows: Floats, t: Floats) -> Floats:
    return np.column_stack([np.interp(t, times, column) for column in rows.T])


def _curve(times: Floats, curve: scipy.interpolate.PchipInterpolator, t: Floats) -> Floats:
    return np.asarray(curve(np.clip(t, times[0], times[-1])))


@dataclass(frozen=True)
class Reader:
    """What the values of a reference are of."""

    where: Where
    robot: Robot  # of the file, whose postures have names
    names: Sequence[str]  # the components
    what: str  # one of them, in a word
    dt: float  # time step [s]
    end: float  # of the horizon [s]


def _sine(of: str, amplitude: float, frequency: float, phase: float = 0.0) -> tuple[str, float, float, float]:
    """A wave, amplitude sin(2 pi frequency t + phase), added to the component ``of``."""
    return of, finite("amplitude", amplitude), positive("frequency", frequency, "Hz"), finite("phase", phase)


def _sines(reader: Reader, sines: Any = None, offset: Any = 0.0) -> Timeline:
    """Sines about an offset."""
    where, names, found = reader.where, list(reader.names), []
    values = where.at("offset").numbers(offset, names, reader.what)
    for place, table in where.tables({} if sines is None else {"sines": sines}, "sines"):
        of, amplitude, frequency, phase = place.call(_sine, table)
        place.at("of").one_of(of, names)
        if frequency > 0.5 / reader.dt:
            most = f"<= {0.5 / reader.dt:g} [Hz], the most that dt = {reader.dt:g} s resolves"
            raise place.at("frequency").error(f"must be {most}, got {frequency:g}")
        found.append((names.index(of), amplitude, frequency, phase))
    return Timeline(partial(_waves, values, found), not found)


def _waypoints(reader: Reader, times: Any, values: Any, between: str = "lines") -> Timeline:
    """Waypoints: straight lines, or a monotone cubic, between them."""
    where = reader.where
    t = where.at("times").check(lambda name, own: require_finite(name, as_floats(name, own)), times)
    if t.ndim != 1 or len(t) < 2 or not (np.diff(t) > 0.0).all():
        raise where.at("times").error(f"must be two or more, and increase [s], got {times}")
    if not isinstance(values, list) or len(values) != len(t):
        raise where.at("values").error(f"must be {len(t)} rows, one for each of times")
    rows = np.array([where.at("values", k).numbers(row, reader.names, reader.what) for k, row in enumerate(values)])
    if where.at("between").one_of(between, ("lines", "smooth")) == "lines":
        return Timeline(partial(_lines, t, rows))
    try:
        with np.errstate(all="ignore"):
            return Timeline(partial(_curve, t, scipy.interpolate.PchipInterpolator(t, rows)))
    except ValueError as error:
        raise where.at("values").error(f"no smooth curve goes through them: {error}") from None


def _samples(reader: Reader, file: Any) -> Timeline:
    """The columns of the components over the column t of a CSV or npz file."""
    place, end = reader.where.at("file"), reader.end
    path = place.file(file)
    try:
        columns = _npz(path) if path.suffix == ".npz" else _csv(path)
        for name in ("t", *reader.names):
            if name not in columns:
                owner = "times [s]" if name == "t" else f"the {reader.what} {name!r}"
                raise InputError(f"it has no column {name!r} of {owner}; columns: {', '.join(columns)}")
        t, rows = columns["t"], np.column_stack([columns[name] for name in reader.names])
        if len(t) < 2 or not (np.diff(t) > 0.0).all():
            raise InputError("it must have two or more increasing times")
        if t[0] > _ROUNDING * end or t[-1] < end * (1.0 - _ROUNDING):
            raise InputError(f"its times go from {t[0]:g} to {t[-1]:g} s, the scene lasts from 0 to {end:g} s")
    except (InputError, FileError) as error:
        raise place.error(f"{path.name}: {error}") from None
    return Timeline(partial(_lines, t, rows))


def timeline(given: Any, reader: Reader, keep: Integers | slice) -> Timeline:
    """The values over time of a reference, of the components to ``keep``."""
    where, names = reader.where, reader.names
    for kind in (_samples, _waypoints, _sines):
        if isinstance(given, Mapping) and given.keys() & inspect.signature(kind).parameters.keys():
            found: Timeline = where.call(kind, given, reader=reader)
            break
    else:
        posture = isinstance(given, str) and tuple(names) == reader.robot.joint_names
        values = where.positions(given, reader.robot) if posture else where.numbers(given, names, reader.what)
        found = Timeline(partial(_waves, values, ()), True)
    return replace(found, at=partial(_columns, found, keep))


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
