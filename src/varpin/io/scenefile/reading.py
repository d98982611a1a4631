"""Reading TOML for the API: the keys of a table are the arguments of a function, and each mistake names its key."""

from __future__ import annotations

import contextlib
import inspect
import re
import reprlib
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from varpin.arrays import Floats
from varpin.errors import FileError, InputError, VarpinError, suggestion
from varpin.model import Robot
from varpin.support.checks import finite, is_file

_T = TypeVar("_T")
# Most names that a message lists: all keys and types.
_NAMED = 20


class SceneFileError(VarpinError, ValueError):
    """A mistake in a scene file.

    Attributes:
        source: Name of the file.
        key: Key of the mistake, as in ``cost[1].weight``; empty for the file as a whole.
        problem: The given value and the allowed ones, in words.
    """

    def __init__(self, source: str, key: str, problem: str) -> None:
        self.source = source
        self.key = key
        self.problem = problem
        super().__init__(": ".join(part for part in (source, key, problem) if part))


@dataclass(frozen=True)
class Where:
    """A place in a scene file."""

    path: Path
    key: str = ""  # of a value or a table; empty for the top level

    def at(self, *names: str | int) -> Where:
        """The place of an entry."""
        parts = [f"[{name}]" if isinstance(name, int) else f".{name}" for name in names]
        return Where(self.path, (self.key + "".join(parts)).removeprefix("."))

    def error(self, problem: str) -> SceneFileError:
        """A mistake here."""
        return SceneFileError(self.path.name, self.key, problem)

    def of(self, error: VarpinError, given: Mapping[str, Any]) -> SceneFileError:
        """An error of the API about the keys ``given`` of this table: that of the key which the error is about."""
        name = getattr(error, "name", "")
        for key, value in given.items() if name else ():
            if isinstance(value, Mapping) and name in value:
                return self.at(key, name).error(str(error))
            # A name, several of them, or a point in a frame.
            parts = value if isinstance(value, list | tuple) else (value,)
            if name in [part for own in parts if isinstance(part := getattr(own, "frame", own), str)]:
                return self.at(key).error(str(error))
        # A name of one letter is a word, too.
        found = {key: re.search(rf"\b{key}\b" if len(key) > 1 else rf"\b{key}(?=,| must)", str(error)) for key in given}
        places = sorted((place.start(), key) for key, place in found.items() if place)
        return (self.at(places[0][1]) if places else self).error(str(error))

    @contextlib.contextmanager
    def named(self, given: Mapping[str, Any] | None = None) -> Iterator[None]:
        """A block whose errors are mistakes here, or :meth:`of` the keys ``given`` of this table."""
        try:
            yield
        except SceneFileError:
            raise
        except VarpinError as error:
            raise self.of(error, given or {}) from None

    def table(self, given: Any, keys: Collection[str] | None = None, required: Iterable[str] = ()) -> dict[str, Any]:
        """A table with no other keys than these, if there are any."""
        if not isinstance(given, dict):
            raise self.error(f"must be a table, got {_shown(given)}")
        for name in given:
            if keys is not None and name not in keys:
                raise self.at(name).error(f"unknown key; {suggestion(name, keys, 'keys', _NAMED)}")
        for name in required:
            if name not in given:
                raise self.at(name).error("is missing")
        return given

    def tables(self, given: Mapping[str, Any], name: str) -> list[tuple[Where, Any]]:
        """The tables of a list under a key, each with its place; none where the key is left out."""
        at, found = self.at(name), given.get(name, [])
        if not isinstance(found, list):
            raise at.error(f"must be a list of tables, written [[{at.key}]], got {_shown(found)}")
        return [(at.at(index), entry) for index, entry in enumerate(found)]

    def entries(
        self, given: Mapping[str, Any], name: str, kinds: Mapping[str, _T]
    ) -> list[tuple[Where, str, _T, dict[str, Any]]]:
        """The tables of a list under a key: the place of each, and what :meth:`kind` tells of it."""
        return [(place, *place.kind(entry, kinds)) for place, entry in self.tables(given, name)]

    def call(self, make: Callable[..., _T], given: Any, without: Collection[str] = (), **others: Any) -> _T:
        """What a function of the API makes of the keys of a table and of ``others``; ``without`` are none."""
        arguments = inspect.signature(make).parameters
        keys = [name for name in arguments if name not in {*others, *without}]
        self.table(given, keys, [name for name in keys if arguments[name].default is inspect.Parameter.empty])
        with self.named(given):
            return make(**given, **others)

    def kind(self, given: Any, kinds: Mapping[str, _T], default: str = "") -> tuple[str, _T, dict[str, Any]]:
        """The word of a table's key ``type``, its kind, and the other keys."""
        own = dict(self.table(given, None, () if default else ["type"]))
        word = self.at("type").one_of(own.pop("type", default), kinds)
        return word, kinds[word], own

    def one_of(self, given: Any, words: Iterable[str]) -> str:
        """One of some words."""
        if not isinstance(given, str) or given not in (words := list(words)):
            raise self.error(f"there is no {_shown(given)}; {suggestion(str(given), words, 'allowed', _NAMED)}")
        return given

    def check(self, check: Callable[..., _T], given: Any, *options: Any) -> _T:
        """A value here by one of the checks of arguments."""
        with self.named():
            return check("it", given, *options)

    def text(self, given: Any) -> str:
        """A text."""
        if not isinstance(given, str) or not given.strip() or "\0" in given:
            raise self.error(f"must be a text in quotes, got {_shown(given)}")
        return given

    def beside(self, given: Any) -> Path:
        """A path, relative to the folder of the scene file."""
        return self.path.resolve().parent / self.text(given)

    def file(self, given: Any) -> Path:
        """The path of an existing file, by :meth:`beside`."""
        path = self.beside(given)
        if not is_file(path):
            raise self.error(f"there is no file {path}")
        return path

    def numbers(self, given: Any, names: Sequence[str], what: str = "joint") -> Floats:
        """A number for each of some names: one for all, a list, or a table by name, in which those left out are 0."""
        if isinstance(given, Mapping):
            for name in given:
                if name not in names:
                    raise self.at(name).error(f"there is no such {what}; {suggestion(name, names, what + 's', _NAMED)}")
            found = {name: self.at(name).check(finite, value) for name, value in given.items()}
            return np.array([found.get(name, 0.0) for name in names], dtype=np.float64)
        if not isinstance(given, list):
            return np.full(len(names), self.check(finite, given))
        if len(given) != len(names):
            raise self.error(f"must have {len(names)} numbers, for {', '.join(names) or 'nothing'}; got {len(given)}")
        return np.array([self.check(finite, value) for value in given], dtype=np.float64)

    def positions(self, given: Any, robot: Robot) -> Floats:
        """Positions of the joints (n,) [rad or m]: a posture of the robot by its name, or as :meth:`numbers`."""
        if isinstance(given, str):
            with self.named():
                return robot.posture(given)
        return self.numbers(given, robot.joint_names)


def _shown(value: object) -> str:
    """A short text for a value from a file."""
    if isinstance(value, Mapping):
        return "a table"
    return str(value).lower() if isinstance(value, bool) else reprlib.repr(value)


def find_scene(source: str | Path, bundled: Mapping[str, Path]) -> Path:
    """The scene file at a path, or the bundled one of that name."""
    if not isinstance(source, str | Path) or "\0" in str(source):
        raise InputError(f"a scene must be the path of a TOML file or a name, got {type(source).__name__}")
    path = bundled.get(str(source), Path(source).expanduser())
    if not is_file(path):
        raise FileError(f"no scene file {str(source)!r}; {suggestion(path.stem, bundled, 'bundled scenes', _NAMED)}")
    return path


def toml_of(path: Path) -> dict[str, Any]:
    """The content of a TOML file."""
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8").replace("\r\n", "\n"))
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from None
    except RecursionError:
        raise SceneFileError(path.name, "", "it is nested too deeply") from None
    except ValueError as error:  # of decoding, of TOML, or of Python's number parsing
        raise SceneFileError(path.name, "", f"it is not TOML in UTF-8: {error}") from None
