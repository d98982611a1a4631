"""Tables of a TOML file, read key by key: what is wrong is said with the key it stands under."""

from __future__ import annotations

import difflib
import math
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from varpin.errors import VarpinError

Floats = NDArray[np.float64]
# One number for all, one for each in order, or a table by name in which those left out are 0.
ByName = float | tuple[float, ...] | Mapping[str, float]


class SceneFileError(VarpinError, ValueError):
    """A mistake in a scene file.

    Attributes:
        source: The file.
        key: Where in it, as in ``cost[1].weight``; empty for the file as a whole.
        problem: What was given, and what is allowed.
    """

    def __init__(self, source: str, key: str, problem: str) -> None:
        self.source = source
        self.key = key
        self.problem = problem
        super().__init__(": ".join(part for part in (source, key, problem) if part))


@dataclass(frozen=True, eq=False)
class Table:
    """A table of a scene file.

    Attributes:
        source: The file, for messages.
        key: Where the table stands; empty for the file's own.
        data: As parsed.
    """

    source: str
    key: str
    data: Mapping[str, Any]

    def path(self, name: str) -> str:
        """The whole key of ``name``."""
        return f"{self.key}.{name}" if self.key and name else self.key or name

    def error(self, name: str, problem: str) -> SceneFileError:
        """A mistake under ``name``, or in the table itself if it is empty."""
        return SceneFileError(self.source, self.path(name), problem)

    def __contains__(self, name: str) -> bool:
        return name in self.data

    def allow(self, *names: str) -> Table:
        """The table itself, if it has no other keys than ``names``."""
        for name in self.data:
            if name not in names:
                raise self.error(name, f"unknown key; {suggestion(name, names, 'keys')}")
        return self

    def one_of(self, *names: str, required: bool = True) -> str | None:
        """Which of keys that exclude each other is there."""
        given = [name for name in names if name in self]
        if len(given) > 1:
            raise self.error("", f"{' and '.join(given)} exclude each other: give one of them")
        if required and not given:
            raise self.error("", f"one of {', '.join(names)} is missing")
        return given[0] if given else None

    def require(self, name: str, what: str) -> Any:
        """What stands under ``name``."""
        if name not in self:
            raise self.error(name, f"is missing; {what} belongs here")
        return self.data[name]

    def text(self, name: str, default: str | None = None) -> str:
        """A string that is not empty."""
        value = self.data.get(name, default)
        if value is None:
            self.require(name, "a text")
        if not isinstance(value, str) or not value.strip() or "\0" in value:
            raise self.error(name, f"must be a text in quotes, got {shown(value)}")
        return value

    def choice(self, name: str, options: Iterable[str], default: str | None = None) -> str:
        """One of some words."""
        options = tuple(options)
        value = self.data.get(name, default)
        if value is None:
            self.require(name, f"one of {', '.join(options)}")
        if not isinstance(value, str):
            raise self.error(name, f"must be one of {', '.join(options)}, got {shown(value)}")
        if value not in options:
            raise self.error(name, f"there is no {value!r}; {suggestion(value, options, 'allowed')}")
        return value

    def flag(self, name: str, default: bool) -> bool:
        """True or false."""
        value = self.data.get(name, default)
        if not isinstance(value, bool):
            raise self.error(name, f"must be true or false, got {shown(value)}")
        return value

    def number(
        self,
        name: str,
        default: float | None = None,
        *,
        unit: str = "",
        above: float = -math.inf,
        least: float = -math.inf,
        most: float = math.inf,
    ) -> float:
        """A finite number > ``above``, >= ``least`` and <= ``most``."""
        value = self.data.get(name, default)
        if value is None:
            self.require(name, f"a number{_unit(unit)}")
        number = _number(value)
        if number is None:
            raise self.error(name, f"must be a number{_unit(unit)}, got {shown(value)}")
        if not math.isfinite(number):
            raise self.error(name, f"must be finite, got {number}")
        if not (number > above and number >= least and number <= most):
            bounds = [
                word
                for word, given in (
                    (f"> {above:g}", above > -math.inf),
                    (f">= {least:g}", least > -math.inf),
                    (f"<= {most:g}", most < math.inf),
                )
                if given
            ]
            raise self.error(name, f"must be {' and '.join(bounds)}{_unit(unit)}, got {number:g}")
        return number

    def whole(self, name: str, default: int | None = None, *, least: int = 0, most: int | None = None) -> int:
        """An integer >= ``least`` and <= ``most``."""
        value = self.data.get(name, default)
        if value is None:
            self.require(name, "an integer")
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.error(name, f"must be an integer, got {shown(value)}")
        if value < least or (most is not None and value > most):
            raise self.error(name, f"must be >= {least}{'' if most is None else f' and <= {most}'}, got {value}")
        return value

    def numbers(self, name: str, length: int | None = None) -> tuple[float, ...]:
        """A list of finite numbers, of a given length."""
        value = self.require(name, "a list of numbers")
        return self.as_numbers(name, value, length)

    def as_numbers(self, name: str, value: Any, length: int | None = None) -> tuple[float, ...]:
        """``value``, found under ``name``, as a list of finite numbers."""
        if not isinstance(value, list):
            of = "" if length is None else f"{length} "
            raise self.error(name, f"must be a list of {of}numbers, got {shown(value)}")
        found = []
        for index, entry in enumerate(value):
            number = _number(entry)
            if number is None:
                raise self.error(f"{name}[{index}]", f"must be a number, got {shown(entry)}")
            if not math.isfinite(number):
                raise self.error(f"{name}[{index}]", f"must be finite, got {number}")
            found.append(number)
        if length is not None and len(found) != length:
            raise self.error(name, f"must have {length} numbers, got {len(found)}")
        return tuple(found)

    def by_name(self, name: str, default: float | None = None, *, least: float = -math.inf, unit: str = "") -> ByName:
        """One number for all, a list of one for each, or a table by name."""
        value = self.data.get(name, default)
        if value is None:
            self.require(name, f"a number for all, a list, or a table by name{_unit(unit)}")
        if isinstance(value, dict):
            table = self.table(name)
            found: ByName = {entry: table.number(entry, unit=unit) for entry in value}
        elif isinstance(value, list):
            found = self.as_numbers(name, value)
        elif _number(value) is None:
            raise self.error(
                name, f"must be a number for all, a list, or a table by name{_unit(unit)}, got {shown(value)}"
            )
        else:
            found = self.number(name, default, unit=unit)
        for where, number in _entries(name, found):
            if number < least:
                raise self.error(where, f"must be >= {least:g}{_unit(unit)}, got {number:g}")
        return found

    def table(self, name: str) -> Table:
        """The table under ``name``; an empty one if there is none."""
        value = self.data.get(name, {})
        if not isinstance(value, dict):
            raise self.error(name, f"must be a table, got {shown(value)}")
        return Table(self.source, self.path(name), value)

    def tables(self, name: str) -> list[Table]:
        """The tables under ``name``, ``[[name]]`` in the file."""
        value = self.data.get(name, [])
        if isinstance(value, dict):
            raise self.error(
                name, f"there may be several of them: write [[{self.path(name)}]], not [{self.path(name)}]"
            )
        if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
            raise self.error(name, f"must be tables, [[{self.path(name)}]], got {shown(value)}")
        return [Table(self.source, f"{self.path(name)}[{index}]", entry) for index, entry in enumerate(value)]

    def texts(self, name: str) -> tuple[str, ...]:
        """A list of strings, none of them twice; empty if there is none."""
        value = self.data.get(name, [])
        if not isinstance(value, list):
            raise self.error(name, f"must be a list of texts, got {shown(value)}")
        for index, entry in enumerate(value):
            if not isinstance(entry, str) or not entry or "\0" in entry:
                raise self.error(f"{name}[{index}]", f"must be a text in quotes, got {shown(entry)}")
            if entry in value[:index]:
                raise self.error(f"{name}[{index}]", f"{entry!r} is there twice")
        return tuple(value)

    def spread(
        self, name: str, value: ByName, names: Sequence[str], what: str = "joint", *, absent: float = 0.0
    ) -> Floats:
        """``value``, read under ``name``, as one number for each of ``names``; ``absent`` for those left out."""
        if isinstance(value, Mapping):
            for entry in value:
                if entry not in names:
                    raise self.error(
                        f"{name}.{entry}", f"there is no such {what}; {suggestion(entry, names, what + 's')}"
                    )
            return np.array([value.get(entry, absent) for entry in names], dtype=np.float64)
        if isinstance(value, tuple):
            if len(value) != len(names):
                raise self.error(
                    name, f"must have {len(names)} numbers, for {', '.join(names) or 'nothing'}; got {len(value)}"
                )
            return np.array(value, dtype=np.float64)
        return np.full(len(names), float(value))


def _unit(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def _entries(name: str, value: ByName) -> list[tuple[str, float]]:
    if isinstance(value, Mapping):
        return [(f"{name}.{entry}", number) for entry, number in value.items()]
    if isinstance(value, tuple):
        return [(f"{name}[{index}]", number) for index, number in enumerate(value)]
    return [(name, value)]


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf


def shown(value: object) -> str:
    """A value from a file, in short."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "a table"
    if value is None:
        return "nothing"
    return reprlib.repr(value) if isinstance(value, str | int | float | list) else f"{value} ({type(value).__name__})"


def suggestion(word: str, names: Iterable[str], what: str) -> str:
    """Which names come close, and all of them."""
    names = tuple(names)
    matches = difflib.get_close_matches(word, names, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(map(repr, matches))}? " if matches else ""
    return f"{hint}{what}: {', '.join(names) or 'none'}"


def inside(table: Table, name: str, text: str, folder: Path, what: str) -> Path:
    """A path that a file names: below ``folder`` if it is relative, links followed, and anywhere if it is absolute."""
    path = Path(text)
    if path.is_absolute():
        return path
    try:
        found = (folder / path).resolve()
        root = folder.resolve()
    except (OSError, RuntimeError) as error:
        raise table.error(name, f"{text!r} is no path: {error}") from None
    if not found.is_relative_to(root):
        raise table.error(name, f"{text!r} leads out of {what} {root}; name files below it, or give an absolute path")
    return found
