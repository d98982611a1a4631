"""Reading TOML by rules: a dataclass is a table whose fields are its keys, and each mistake names its key."""

from __future__ import annotations

import difflib
import functools
import inspect
import math
import re
import reprlib
import tomllib
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from varpin.arrays import Floats
from varpin.errors import FileError, InputError, UnknownFrame, UnknownJoint, VarpinError
from varpin.model import Robot
from varpin.support.checks import is_file

# One number for all, one for each in order, or a table by name in which those left out are 0.
ByName = float | tuple[float, ...] | Mapping[str, float]
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
    """A place in a scene file.

    Attributes:
        path: The file.
        key: The key of a value or a table; empty for the top level.
    """

    path: Path
    key: str = ""

    def at(self, name: str | int) -> Where:
        """The place of an entry."""
        if isinstance(name, int):
            return Where(self.path, f"{self.key}[{name}]")
        return Where(self.path, f"{self.key}.{name}" if self.key else name)

    def error(self, problem: str) -> SceneFileError:
        """A mistake here."""
        return SceneFileError(self.path.name, self.key, problem)

    def of(self, error: VarpinError, given: Mapping[str, Any]) -> SceneFileError:
        """An error of the API about the keys ``given`` of this table: that of the key which the error is about."""
        name, known, what = "", tuple[str, ...](), ""
        match error:
            case UnknownJoint():
                name, known, what = error.joint, error.joints, "joint"
            case UnknownFrame():
                name, known, what = error.frame, error.frames, "frame"
        for key, value in given.items() if name else ():
            told = f"there is no {what} {name!r}; {suggestion(name, known, what + 's')}"
            if isinstance(value, Mapping) and name in value:
                return self.at(key).at(name).error(told)
            # A name, several of them, or a point in a frame.
            parts = value if isinstance(value, tuple) else (value,)
            if name in [part for part in parts if isinstance(part, str)]:
                return self.at(key).error(told)
        if isinstance(error, InputError) and error.argument is not None:
            return self.at(error.argument).error(str(error)) if error.argument else self.error(str(error))
        # A name of one letter is a word, too.
        found = {key: re.search(rf"\b{key}\b" if len(key) > 1 else rf"\b{key}(?=,| must)", str(error)) for key in given}
        places = sorted((place.start(), key) for key, place in found.items() if place)
        return (self.at(places[0][1]) if places else self).error(str(error))

    def spread(self, value: ByName, names: Sequence[str], what: str = "joint") -> Floats:
        """A value here as one number for each of ``names``."""
        if isinstance(value, Mapping):
            for entry in value:
                if entry not in names:
                    raise self.at(entry).error(f"there is no such {what}; {suggestion(entry, names, what + 's')}")
            return np.array([value.get(entry, 0.0) for entry in names], dtype=np.float64)
        if isinstance(value, tuple):
            if len(value) != len(names):
                told = ", ".join(names) or "nothing"
                raise self.error(f"must have {len(names)} numbers, for {told}; got {len(value)}")
            return np.array(value, dtype=np.float64)
        return np.full(len(names), float(value))

    def positions(self, value: ByName | str, robot: Robot) -> Floats:
        """Positions of the joints (n,) [rad or m]: a posture of the robot by its name, or as :meth:`spread`."""
        if not isinstance(value, str):
            return self.spread(value, robot.joint_names)
        try:
            return robot.posture(value)
        except InputError as error:
            raise self.error(str(error)) from None


def shown(value: object) -> str:
    """A short text for a value from a file."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "a table"
    if value is None:
        return "nothing"
    return reprlib.repr(value) if isinstance(value, str | int | float | list) else f"{value} ({type(value).__name__})"


def suggestion(word: str, names: Iterable[str], what: str) -> str:
    """A hint with similar names, and the list of names."""
    names = tuple(names)
    matches = difflib.get_close_matches(word, names, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(map(repr, matches))}? " if matches else ""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"{hint}{what}: {', '.join(names[:_NAMED]) or 'none'}{more}"


def word_of(name: str) -> str:
    """The name of a class in scene files: point_on_line for PointOnLine, runge_kutta_4 for RungeKutta4."""
    return re.sub(r"(?<!^)([A-Z0-9])", r"_\1", name).lower()


@dataclass(frozen=True)
class Rule:
    """What a key takes.

    Attributes:
        what: The allowed values in words.
        read: Function of a value and its place that returns the value read, or raises a :class:`SceneFileError`.
    """

    what: str
    read: Callable[[Any, Where], Any]


def _rule(what: str, takes: Callable[[Any], bool], made: Callable[[Any], Any] = lambda value: value) -> Rule:
    def read(value: Any, where: Where) -> Any:
        if not takes(value):
            raise where.error(f"must be {what}, got {shown(value)}")
        return made(value)

    return Rule(what, read)


def number(unit: str = "", *, above: float = -math.inf, least: float = -math.inf, most: float = math.inf) -> Rule:
    """A finite number > ``above``, >= ``least`` and <= ``most``."""
    given = ((">", above), (">=", least), ("<=", most))
    bounds = [f"{sign} {bound:g}" for sign, bound in given if math.isfinite(bound)]
    largest = min(most, float(np.finfo(float).max))

    def takes(value: Any) -> bool:
        return type(value) in (int, float) and above < value <= largest and value >= max(least, -largest)

    return _rule(f"a finite number{' ' if bounds else ''}{' and '.join(bounds)}{_in(unit)}", takes, float)


def whole(least: int = 0, most: int = 2**63 - 1) -> Rule:
    """An integer >= ``least`` and <= ``most``."""
    what = f"an integer >= {least}{'' if most == 2**63 - 1 else f' and <= {most}'}"
    return _rule(what, lambda value: type(value) is int and least <= value <= most)


FLAG = _rule("true or false", lambda value: isinstance(value, bool))
TRUE = _rule("true", lambda value: value is True)
TEXT = _rule("a text in quotes", lambda value: isinstance(value, str) and bool(value.strip()) and "\0" not in value)


def word(*options: str) -> Rule:
    """One of the strings ``options``."""
    what = f"one of {', '.join(options)}"

    def read(value: Any, where: Where) -> str:
        if not isinstance(value, str):
            raise where.error(f"must be {what}, got {shown(value)}")
        if value not in options:
            raise where.error(f"there is no {value!r}; {suggestion(value, options, 'allowed')}")
        return value

    return Rule(what, read)


def entries(rule: Rule, length: int | None = None, *, distinct: bool = False) -> Rule:
    """A list of values, of a given length if any."""
    what = f"a list{'' if length is None else f' of {length}'}, each {rule.what}"

    def read(value: Any, where: Where) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise where.error(f"must be {what}, got {shown(value)}; tables in a list are written [[{where.key}]]")
        if length not in (None, len(value)):
            raise where.error(f"must have {length} entries, got {len(value)}")
        for index, entry in enumerate(value if distinct else ()):
            if entry in value[:index]:
                raise where.at(index).error(f"{entry!r} is a duplicate")
        return tuple(rule.read(entry, where.at(index)) for index, entry in enumerate(value))

    return Rule(what, read)


def by_name(rule: Rule) -> Rule:
    """A table of values under any names."""
    what = f"a table by name, each {rule.what}"

    def read(value: Any, where: Where) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise where.error(f"must be {what}, got {shown(value)}")
        return {name: rule.read(entry, where.at(name)) for name, entry in value.items()}

    return Rule(what, read)


_TYPES = {bool: "flag", str: "text", list: "list", dict: "table", int: "number", float: "number"}


def either(what: str, **kinds: Rule) -> Rule:
    """One of several rules, by the type of a value in TOML."""

    def read(value: Any, where: Where) -> Any:
        kind = _TYPES.get(type(value), "")
        if kind not in kinds:
            raise where.error(f"must be {what}, got {shown(value)}")
        return kinds[kind].read(value, where)

    return Rule(what, read)


def values(unit: str = "", *, least: float = -math.inf, **others: Any) -> Rule:
    """One number for all, a list with one for each, or a table by name; or one of ``others`` by type."""
    one = number(unit, least=least)
    what = f"a number for all, a list, or a table by name{_in(unit)}"
    return either(what, number=one, list=entries(one), table=by_name(one), **others)


def checked(rule: Rule, check: Callable[[Any, Where], Any]) -> Rule:
    """A value converted by ``check``."""
    return Rule(rule.what, lambda value, where: check(rule.read(value, where), where))


def keys(rules: Mapping[str, tuple[Rule, bool]]) -> Rule:
    """A table of keys, each with its rule and whether it is required; read as a dict."""

    def read(value: Any, where: Where) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise where.error(f"must be a table, got {shown(value)}")
        for name in value:
            if name not in rules:
                raise where.at(name).error(f"unknown key; {suggestion(name, rules, 'keys')}")
        for name, (rule, required) in rules.items():
            if required and name not in value:
                raise where.at(name).error(f"is missing; {rule.what} belongs here")
        return {name: rules[name][0].read(entry, where.at(name)) for name, entry in value.items()}

    return Rule("a table", read)


def table(kind: Callable[..., _T], **filled: Any) -> Rule:
    """A table whose keys are the fields of a dataclass, which is made of them and of ``filled``."""

    def read(value: Any, where: Where) -> _T:
        given = keys(rules_of(kind)).read(value, where)
        try:
            return kind(**filled, **given)
        except VarpinError as error:
            raise where.of(error, given) from None

    return Rule("a table", read)


def typed(kinds: Mapping[str, Rule], default: str | None = None) -> Rule:
    """A table of one of several kinds, selected by its key ``type``."""
    what = f"one of {', '.join(kinds)}"

    def read(value: Any, where: Where) -> Any:
        if not isinstance(value, dict):
            raise where.error(f"must be a table, got {shown(value)}")
        if "type" not in value and default is None:
            raise where.at("type").error(f"is missing; {what} belongs here")
        kind = word(*kinds).read(value.get("type", default), where.at("type"))
        rest = {name: entry for name, entry in value.items() if name != "type"}
        return kinds[kind].read(rest, where)

    return Rule("a table", read)


def point(what: str, **others: Rule) -> Rule:
    """A point: a frame's name, { frame, place }, or one of ``others``."""
    placed = keys({"frame": (TEXT, True), "place": (entries(number("m"), 3), True)})
    in_frame = checked(placed, lambda given, _: (given["frame"], list(given["place"])))
    return either(what, text=TEXT, table=in_frame, **others)


def _listed(rule: Rule) -> Rule:
    return checked(rule, lambda value, _: list(value) if isinstance(value, tuple) else value)


def _numbers(unit: str) -> Rule:
    one = number(unit)
    return _listed(either(f"a number or a list of numbers{_in(unit)}", number=one, list=entries(one)))


# Rules by the annotation of a field of the API, from its unit.
_BY_ANNOTATION: Mapping[str, Callable[[str], Rule]] = {
    "JointValues": lambda unit: _listed(values(unit)),
    "Point": lambda _: point("a frame's name, { frame, place } or a place in the world [m]", list=_numbers("m")),
    "FramePoint": lambda _: point("a frame's name, or { frame, place }"),
    "ArrayLike": _numbers,
    "str": lambda _: TEXT,
    "float": number,
    "int": lambda _: whole(0),
}


@functools.cache
def rules_of(kind: Any) -> dict[str, tuple[Rule, bool]]:
    """The keys of a table: the fields of a dataclass, each with its rule, and whether it is required.

    The rule is in the annotation, or follows from it and from the unit in the docstring of the class. Fields without a
    rule are no keys.
    """
    own = kind.__module__.startswith(f"{__package__}.")
    hints = typing.get_type_hints(kind, include_extras=True) if own else {}
    found: dict[str, tuple[Rule, bool]] = {}
    for item in fields(kind):
        text = str(item.type).removesuffix(" | None")
        rules = [rule for rule in getattr(hints.get(item.name), "__metadata__", ()) if isinstance(rule, Rule)]
        if not own and text in _BY_ANNOTATION:
            rules = [_BY_ANNOTATION[text](_unit_of(kind, item.name))]
        elif not own and text.startswith("Literal["):
            rules = [word(*re.findall(r"['\"](\w+)['\"]", text))]
        if rules:
            found[item.name] = rules[0], item.default is MISSING and item.default_factory is MISSING
    return found


def _unit_of(kind: Any, name: str) -> str:
    """The unit of an attribute in the docstring of its class."""
    about = re.search(rf"^ +{name}: (.*?)(?=^ +\w+: |\Z)", inspect.getdoc(kind) or "", re.M | re.S)
    return " and ".join(re.findall(r"\[(.*?)\]", about[1])) if about else ""


def _in(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def toml_of(path: Path) -> dict[str, Any]:
    """The content of a TOML file.

    Raises:
        FileError: The file cannot be read.
        SceneFileError: It is no TOML.
    """
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8").replace("\r\n", "\n"))
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise SceneFileError(path.name, "", "it is not a text in UTF-8") from None
    except RecursionError:
        raise SceneFileError(path.name, "", "it is nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError, or an error of Python's number parsing
        raise SceneFileError(path.name, "", f"it is not TOML: {error}") from None


def beside(text: str, where: Where) -> Path:
    """A path in a scene file, relative to the folder of the file."""
    return where.path.resolve().parent / text


def existing(text: str, where: Where) -> Path:
    """The path of an existing file, by :func:`beside`."""
    path = beside(text, where)
    if not is_file(path):
        raise where.error(f"there is no file {path}")
    return path


FILE = checked(TEXT, existing)
