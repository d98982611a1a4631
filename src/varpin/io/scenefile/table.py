"""Keys of scene files in messages, and values by joint."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from varpin.arrays import Floats
from varpin.errors import InputError, VarpinError
from varpin.model import Robot

# One number for all, one for each in order, or a table by name in which those left out are 0.
ByName = float | tuple[float, ...] | Mapping[str, float]


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
class Table:
    """The key of a table of a scene file, for messages.

    Attributes:
        source: Name of the file.
        key: Key of the table; empty for the top level.
    """

    source: str
    key: str

    def path(self, name: str) -> str:
        """The full key of ``name``."""
        return f"{self.key}.{name}" if self.key and name else self.key or name

    def error(self, name: str, problem: str) -> SceneFileError:
        """An error at the key ``name``, or in the table itself if it is empty."""
        return SceneFileError(self.source, self.path(name), problem)

    def table(self, name: str) -> Table:
        """The table under ``name``."""
        return Table(self.source, self.path(name))

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

    def positions(self, name: str, value: ByName | str, robot: Robot) -> Floats:
        """Positions of the joints (n,) [rad or m]: a posture of the robot by its name, or as :meth:`spread`."""
        if not isinstance(value, str):
            return self.spread(name, value, robot.joint_names)
        try:
            return robot.posture(value)
        except InputError as error:
            raise self.error(name, str(error)) from None


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
    """A hint with similar names, and the list of all names."""
    names = tuple(names)
    matches = difflib.get_close_matches(word, names, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(map(repr, matches))}? " if matches else ""
    return f"{hint}{what}: {', '.join(names) or 'none'}"


def inside(text: str, folder: Path, what: str) -> Path:
    """A path in a file. A relative path must stay below ``folder``, links resolved; an absolute one may be anywhere.

    Raises:
        ValueError: It is not a path, or leads out of the folder.
    """
    path = Path(text)
    if path.is_absolute():
        return path
    try:
        found, root = (folder / path).resolve(), folder.resolve()
    except (OSError, RuntimeError) as error:
        raise ValueError(f"{text!r} is not a path: {error}") from None
    if not found.is_relative_to(root):
        raise ValueError(f"{text!r} leads out of {what} {root}; name files below it, or give an absolute path")
    return found
