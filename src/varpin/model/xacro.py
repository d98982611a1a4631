"""Xacro files: expanded to URDF or SRDF by the package xacro, with or without ROS."""

import contextlib
import importlib
import io
import logging
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.parsers import expat

from varpin.errors import InputError, RobotError
from varpin.model.packages import Packages, content, optional

logger = logging.getLogger(__name__)

# What xacro says of an argument that has no value.
_UNDEFINED = re.compile(r"(?:Undefined substitution argument,? *'?|xacro\.arg\(')([\w.-]+)")

# The package xacro keeps its state in its modules: one expansion at a time.
_LOCK = threading.Lock()


class _Arguments(dict[str, str]):
    """Arguments of an expansion, with a record of those that the file uses."""

    def __init__(self, given: Mapping[str, str]) -> None:
        super().__init__(given)
        self.used: set[str] = set()

    def __contains__(self, name: object) -> bool:
        self.used.add(str(name))
        return super().__contains__(name)

    def __getitem__(self, name: str) -> str:
        self.used.add(name)
        return super().__getitem__(name)


def is_xacro(path: Path) -> bool:
    """Whether a file is a xacro file by its suffix."""
    return path.suffix == ".xacro"


def plain_name(path: Path) -> str:
    """The name of a file without its suffixes: ``arm`` for ``arm.urdf.xacro``."""
    return Path(path.name.removesuffix(".xacro")).stem if is_xacro(path) else path.stem


def expand(packages: Packages, arguments: Mapping[str, object], *, strict: bool = True) -> str:
    """The XML to which the file of ``packages``, a xacro file, expands.

    Its arguments, by name, are strings, numbers or booleans. If ``strict``, one that the file does not use is an error.
    """
    path = packages.file
    xacro = optional("xacro", f"the xacro file {path}", "xacro")
    substitution = importlib.import_module("xacro.substitution_args")
    content(path)
    words = {name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in arguments.items()}
    given = _Arguments(words)
    notes = io.StringIO()
    with _LOCK, contextlib.redirect_stderr(notes), _finding(substitution, packages):
        try:
            text = str(xacro.process_file(str(path), mappings=given).toxml())
        except Exception as error:  # Expressions in the file may raise anything.
            if found := _UNDEFINED.search(str(error)):
                raise RobotError(
                    f"{path} needs the xacro argument {found[1]!r}, which has no default: "
                    f"give xacro_args={{{found[1]!r}: ...}}, or on the command line --xacro-args {found[1]}=..."
                ) from None
            before = len(notes.getvalue())
            xacro.print_location()
            where = "; ".join(line.strip() for line in notes.getvalue()[before:].splitlines())
            where = "" if where == f"when processing file: {path}" else f" ({where})"
            raise RobotError(f"{path} cannot be expanded: {_told(error)}{where}") from None
    for line in filter(None, map(str.strip, notes.getvalue().splitlines())):
        logger.warning("%s: %s", path, line)
    if strict and (unknown := sorted(set(arguments) - given.used)):
        known = ", ".join(sorted(given.used)) or "none"
        raise InputError(f"{path} has no xacro argument {', '.join(map(repr, unknown))}; it takes: {known}")
    return text


def _told(error: Exception) -> str:
    """What xacro says of an error, without names of Python classes."""
    if isinstance(error, expat.ExpatError):
        return f"it is not well-formed XML: {error}"
    # Of an error that wraps another one with the same message, the other one tells all.
    error = getattr(error, "exc", None) or error
    return " ".join(re.sub(r"<class '[^']*'>:?|^.*\[Errno \d+\]", "", str(error)).split()) or type(error).__name__


@contextlib.contextmanager
def _finding(substitution: Any, packages: Packages) -> Iterator[None]:
    """Make xacro look packages up in the folders around the file first, and by ROS only after them."""
    by_ros: Callable[[str], str] = substitution._eval_find

    def find(name: str) -> str:
        if folder := packages.folder(name):
            return str(folder)
        try:
            return by_ros(name)
        except Exception:  # There is no ROS or no such package; the exception depends on the version of ROS.
            looked = ", ".join(map(str, packages.places))
            raise substitution.SubstitutionException(
                f"no package {name!r} above the file nor in {looked}; give the folder that holds it as package_dirs"
            ) from None

    expressions = substitution._eval_dict
    substitution._eval_find, expressions["find"] = find, find
    try:
        yield
    finally:
        substitution._eval_find, expressions["find"] = by_ros, by_ros
