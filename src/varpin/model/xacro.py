"""Xacro files: expanded to the URDF or SRDF that they stand for, by the package xacro, with or without ROS."""

import contextlib
import importlib
import io
import logging
import os
import re
import threading
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.parsers import expat

from varpin.errors import InputError, MissingDependency, RobotError

logger = logging.getLogger(__name__)

# The package keeps its state in its modules, so expansions take turns.
_TURN = threading.Lock()


class _Arguments(dict[str, str]):
    """Arguments of an expansion, which note those that the file asks for."""

    def __init__(self, given: Mapping[str, str]) -> None:
        super().__init__(given)
        self.asked: set[str] = set()

    def __contains__(self, name: object) -> bool:
        self.asked.add(str(name))
        return super().__contains__(name)

    def __getitem__(self, name: str) -> str:
        self.asked.add(name)
        return super().__getitem__(name)


def is_xacro(path: Path) -> bool:
    """Whether a file is one by its name."""
    return path.suffix == ".xacro"


def plain_name(path: Path) -> str:
    """The name of a file without its suffixes: ``arm`` of ``arm.urdf.xacro``."""
    return Path(path.name.removesuffix(".xacro")).stem if is_xacro(path) else path.stem


def expand(
    path: Path,
    arguments: Mapping[str, object],
    package_dirs: Sequence[str] = (),
    packages: Mapping[str, str] | None = None,
    *,
    strict: bool = True,
) -> str:
    """The XML that a xacro file stands for.

    Args:
        path: Of the file.
        arguments: Its arguments by name: texts, numbers or truth values.
        package_dirs: Where ``$(find package)`` is looked up, after the folders above the file.
        packages: Folders of packages by name, known beforehand.
        strict: Whether an argument that the file does not ask for is an error.

    Raises:
        MissingDependency: The package xacro is not installed.
        InputError: The file has no such argument.
        RobotError: The file cannot be expanded.
    """
    xacro, substitution = _package(path)
    given = _Arguments({name: _word(value) for name, value in arguments.items()})
    notes = io.StringIO()
    with _TURN, contextlib.redirect_stderr(notes), _finding(substitution, path, package_dirs, packages or {}):
        try:
            text = str(xacro.process_file(str(path), mappings=given).toxml())
        except Exception as error:  # The file's expressions are evaluated, and may fail in any way.
            said = len(notes.getvalue())
            xacro.print_location()
            where = "; ".join(line.strip() for line in notes.getvalue()[said:].splitlines())
            where = "" if where == f"when processing file: {path}" else f" ({where})"
            raise RobotError(f"{path} cannot be expanded: {', '.join(_told(error))}{where}") from None
    for line in filter(None, map(str.strip, notes.getvalue().splitlines())):
        logger.warning("%s: %s", path, line)
    if strict and (unknown := sorted(set(arguments) - given.asked)):
        known = ", ".join(sorted(given.asked)) or "none"
        raise InputError(f"{path} has no xacro argument {', '.join(map(repr, unknown))}; it takes: {known}")
    return text


def enclosing_packages(path: Path) -> dict[str, Path]:
    """The ROS packages that a file lies in, innermost first: folders with a ``package.xml``, by the name it gives."""
    found: dict[str, Path] = {}
    for folder in path.absolute().parents:
        manifest = folder / "package.xml"
        if manifest.is_file():
            with contextlib.suppress(ET.ParseError, OSError):
                name = ET.parse(manifest).getroot().findtext("name") or folder.name
                found.setdefault(name.strip(), folder)
    return found


def _package(path: Path) -> tuple[ModuleType, Any]:
    try:
        return importlib.import_module("xacro"), importlib.import_module("xacro.substitution_args")
    except ModuleNotFoundError as error:
        raise MissingDependency(f"the xacro file {path}", [str(error.name)], 'pip install "varpin[xacro]"') from None


def _told(error: BaseException) -> list[str]:
    """What an error says, and those that it wraps, each thing once and without names of Python's classes."""
    if isinstance(error, OSError) and error.strerror:
        return [f"{error.strerror}: {error.filename}"]
    if isinstance(error, expat.ExpatError):
        return [f"it is not well-formed XML: {error}"]
    inner = getattr(error, "exc", None)
    said = [str(error.args[0] or "") if error.args else ""] if hasattr(error, "exc") else [str(error)]
    said += [] if inner is None else _told(inner) if isinstance(inner, BaseException) else [str(inner)]
    said.append(str(getattr(error, "suffix", None) or ""))
    plain = [" ".join(re.sub(r"<class '[^']*'>:?", "", words).split()) for words in said]
    return list(dict.fromkeys(filter(None, plain))) or [type(error).__name__]


def _word(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


@contextlib.contextmanager
def _finding(substitution: Any, path: Path, package_dirs: Sequence[str], packages: Mapping[str, str]) -> Iterator[None]:
    """Look packages up around the file first, and where ROS has them only then."""
    enclosing = enclosing_packages(path)
    by_ros: Callable[[str], str] = substitution._eval_find

    def find(name: str) -> str:
        if name in packages:
            return packages[name]
        if name in enclosing:
            return str(enclosing[name])
        around = [folder for folder in path.absolute().parents if folder.name == name]
        around += [Path(folder, name).absolute() for folder in package_dirs]
        for folder in around:
            if folder.is_dir():
                return str(folder)
        try:
            return by_ros(name)
        except Exception:  # No ROS, or another package that is not there: each version has an error of its own.
            looked = ", ".join(map(os.fspath, package_dirs)) or "no package_dirs"
            raise substitution.SubstitutionException(
                f"no package {name!r} above the file nor in {looked}; give the folder that holds it as package_dirs"
            ) from None

    expressions = substitution._eval_dict
    substitution._eval_find, expressions["find"] = find, find
    try:
        yield
    finally:
        substitution._eval_find, expressions["find"] = by_ros, by_ros
