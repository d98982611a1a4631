"""Records in files: frozen dataclasses of arrays and plain values, as npz without pickle.

An entry of a file is a field of the record, under its name: ``dt``. The entry of a field of a nested record is
``statistics.jets``. The annotations of the fields define type and shape of the entries; a field with a default may be
missing. Every file has a ``format``: a name and a version.
"""

from __future__ import annotations

import contextlib
import functools
import io
import os
import reprlib
import secrets
import socket
import typing
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray

from varpin.errors import FileError, InputError
from varpin.finding import Finding
from varpin.support.checks import is_file, writable

T = TypeVar("T")


class Axes:
    """The shape of an array in a record, as the annotation of its field: ``Annotated[Floats, Axes("steps", 3)]``.

    Args:
        axes: Lengths, or names: axes of the same name have the same length throughout the record.
        finite: Whether NaN and infinite entries are refused.
    """

    def __init__(self, *axes: str | int, finite: bool = False) -> None:
        self.axes = axes
        self.finite = finite


def save_npz(path: str | os.PathLike[str], form: str, record: Any) -> Path:
    """Write a record, or its entries, of the format ``form`` as compressed npz; returns its path.

    An existing file is replaced only when the new one is complete.
    """
    members = record if isinstance(record, Mapping) else members_of(record)
    with atomic_file(path) as stream:
        np.savez_compressed(stream, **members, format=form)
    return Path(path)


class Entry:
    """An array of an npz file, of which the header alone has been read; ``np.asarray`` reads the rest."""

    def __init__(self, source: Path, archive: zipfile.ZipFile, name: str) -> None:
        self.source, self.name = source, name
        with archive.open(f"{name}.npy") as stream:
            try:
                version, _ = np.lib.format.read_magic(stream)
                read = np.lib.format.read_array_header_1_0 if version == 1 else np.lib.format.read_array_header_2_0
                self.shape, _, self.dtype = read(stream)
            except ValueError as error:
                raise FileError(f"{source}: {name} is not an array: {error}") from None

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        with _opened(self.source) as archive:
            # Read the whole entry: zipfile compares the checksum only at its end.
            content = io.BytesIO(archive.read(f"{self.name}.npy"))
        try:
            array = np.asarray(np.lib.format.read_array(content, allow_pickle=False), order="C")
        except ValueError as error:
            raise FileError(f"{self.source}: {self.name} is not an array: {error}") from None
        return array if dtype is None else array.astype(dtype)


def read_npz(source: Path, *forms: str) -> dict[str, Entry]:
    """The headers of the arrays of an npz file, which must be of one of the formats ``forms`` if there are any.

    Each array is read where it is asked for, so that a wrong shape is found before its data.
    """
    with _opened(source) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        members = {name: Entry(source, archive, name) for name in names}
    found = str(np.asarray(members.get("format", "")))
    if forms and found not in forms:
        what = f"its format is {reprlib.repr(found)}" if found else "it has no format"
        raise FileError(f"{source} is another kind of file: {what} instead of {' or '.join(map(repr, forms))}")
    return members


@contextlib.contextmanager
def _opened(source: Path) -> Iterator[zipfile.ZipFile]:
    if os.path.isdir(source):  # noqa: PTH112 - pathlib raises an OSError for a path that is too long
        raise FileError(f"{source} is a folder, not an npz file")
    if not is_file(source):
        raise FileError(f"there is no file {source}")
    try:
        with zipfile.ZipFile(source) as archive:
            yield archive
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"cannot read {source}: {error.strerror or error}") from None
    # On a damaged archive zipfile, zlib and NumPy raise many kinds of errors.
    except Exception as error:
        raise FileError(f"{source} is not an npz file, or it is truncated or damaged: {error}") from None


def members_of(record: Any, prefix: str = "") -> dict[str, Any]:
    """The entries of a record in an npz file, their names prefixed with ``prefix``."""
    members: dict[str, Any] = {}
    for item, name, hint in _entries(type(record), prefix):
        value = getattr(record, item.name)
        if is_dataclass(value):
            members |= members_of(value, f"{name}.")
        elif isinstance(value, Mapping):
            members |= {f"{name}.{key}": array for key, array in value.items()}
        elif isinstance(value, tuple) and is_dataclass(kind := typing.get_args(hint)[0]):
            members |= {
                f"{name}.{own.name}": np.array([_plain(getattr(each, own.name)) for each in value])
                for own in fields(kind)
            }
        elif isinstance(value, tuple):
            members[name] = np.array([_plain(own) for own in value], dtype=np.str_)
        elif value is not None:
            members[name] = _plain(value)
    return members


def _plain(value: Any) -> Any:
    """A value as files have it: a finding with its numbers as one text, and a member of an enumeration by its name."""
    if isinstance(value, Finding):
        return value.entry()
    return value.name if isinstance(value, Enum) else value


def record_of(
    kind: type[T],
    members: Mapping[str, Entry],
    source: Path,
    sizes: Mapping[str, int] | None = None,
    known: Mapping[str, Any] | None = None,
) -> T:
    """A record built from the entries of an npz file.

    ``sizes`` are known axes, ``known`` the values of fields without an entry. Raises a FileError that names the file,
    the entry, and what is expected.
    """
    record: T = _Reader(source, members, dict(sizes or {})).record(kind, "", known)
    return record


@dataclass(frozen=True)
class _Reader:
    """Records from the entries of a file."""

    source: Path
    members: Mapping[str, Entry]
    sizes: dict[Any, int]  # of the axes that are known so far

    def error(self, name: str, found: object, expected: str) -> FileError:
        return FileError(f"{self.source}: {name} is {found} instead of {expected}")

    def record(self, kind: Any, prefix: str, known: Mapping[str, Any] | None = None) -> Any:
        given = dict(known or {})
        for item, name, hint in _entries(kind, prefix):
            below = any(member.startswith(f"{name}.") for member in self.members)
            if below or name in self.members or typing.get_origin(hint) is Mapping:
                given[item.name] = self.value(hint, name)
            elif item.default is MISSING and item.default_factory is MISSING:
                raise FileError(f"{self.source}: {name} is missing")
        try:
            return kind(**given)
        except InputError as error:
            raise FileError(f"{self.source}: {error}") from None

    def value(self, hint: Any, name: str) -> Any:
        """The value of type ``hint`` at a name, or of the entries below it."""
        origin: Any = typing.get_origin(hint)
        kinds: tuple[Any, ...] = typing.get_args(hint)
        if is_dataclass(hint):
            return self.record(hint, f"{name}.")
        if origin is Mapping:
            below = [own for own in self.members if own.startswith(f"{name}.")]
            return {own.removeprefix(f"{name}."): self.array(kinds[1], own) for own in below}
        if origin in (Annotated, np.ndarray):
            return self.array(hint, name)
        if origin is not tuple:
            return self.scalar(hint, self.listed(name, 0), name)
        if not is_dataclass(kinds[0]):
            return tuple(self.scalar(kinds[0], each, name) for each in self.listed(name, 1))
        return self.rows(kinds[0], name)

    def rows(self, kind: Any, name: str) -> tuple[Any, ...]:
        """Records by columns."""
        columns = []
        for _, own, hint in _entries(kind, f"{name}."):
            columns.append([self.scalar(hint, each, own) for each in self.listed(own, 1)])
            if len(columns[-1]) != len(columns[0]):
                raise self.error(own, f"a column of {len(columns[-1])} rows", f"{len(columns[0])} as the first one")
        return tuple(kind(*row) for row in zip(*columns, strict=True))

    def entry(self, name: str) -> Entry:
        if name not in self.members:
            raise FileError(f"{self.source}: {name} is missing")
        return self.members[name]

    def array(self, hint: Any, name: str) -> NDArray[Any]:
        array, axes = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint, None)
        kind, found = np.dtype(typing.get_args(typing.get_args(array)[1])[0]), self.entry(name)
        names = found.shape if axes is None else axes.axes
        expected = tuple(self.sizes.get(axis, axis) for axis in names)
        fits = found.dtype == kind and len(found.shape) == len(expected)
        if not fits or any(isinstance(a, int) and a != b for a, b in zip(expected, found.shape, strict=True)):
            raise self.error(name, f"{found.dtype} {found.shape}", f"{kind} ({', '.join(map(str, expected))})")
        self.sizes.update((axis, size) for axis, size in zip(names, found.shape, strict=True) if isinstance(axis, str))
        whole = np.asarray(found)
        if axes is not None and axes.finite and not np.isfinite(whole).all():
            raise FileError(f"{self.source}: {name} holds values that are not finite numbers")
        whole.setflags(write=False)
        return whole

    def listed(self, name: str, axes: int) -> Any:
        """A single value, or a list of them."""
        found = self.entry(name)
        if len(found.shape) != axes:
            raise self.error(name, f"{found.dtype} {found.shape}", "a list" if axes else "a single value")
        return np.asarray(found).tolist()

    def scalar(self, kind: Any, value: Any, name: str) -> Any:
        if issubclass(kind, Finding) and isinstance(value, str):
            try:
                return kind.of_entry(value)
            except (TypeError, ValueError):
                raise self.error(name, reprlib.repr(value), "a warning") from None
        if issubclass(kind, Enum) and value in kind.__members__:
            return kind[value]
        if kind is float and type(value) is int and abs(value) < 2**53:
            return float(value)
        if type(value) is not kind:
            raise self.error(name, reprlib.repr(value), f"a value of type {kind.__name__}")
        return value


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    return typing.get_type_hints(kind, include_extras=True)


def _entries(kind: Any, prefix: str) -> Iterator[tuple[Any, str, Any]]:
    """Each field of a record, its name in files, and its type, never None.

    The metadata of a field may have its name as ``entry``, or None where files do not have it.
    """
    for item in fields(kind):
        if item.metadata.get("entry", item.name) is None:
            continue
        hint = _hints(kind)[item.name]
        if typing.get_origin(hint) in (UnionType, typing.Union):
            (hint,) = (option for option in typing.get_args(hint) if option is not NoneType)
        yield item, prefix + item.metadata.get("entry", item.name), hint


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A binary stream whose contents replace ``path`` when the block ends without an error, and are deleted otherwise.

    What processes that were killed in such a block have left in the folder is deleted, too.
    """
    target = writable(path)
    host = socket.gethostname()
    # Not tempfile, whose files only their owner can read.
    draft = target.with_name(f".varpin-{host}-{os.getpid()}-{secrets.token_hex(8)}")
    try:
        for left in target.parent.glob(f".varpin-{host}-*-*"):
            if not _runs(left.name.split("-")[-2]):
                left.unlink(missing_ok=True)
        with draft.open("xb") as stream:
            yield stream
        draft.replace(target)
    except BaseException as error:
        draft.unlink(missing_ok=True)
        if isinstance(error, OSError) and not isinstance(error, FileError):
            raise FileError(f"cannot write {target}: {error.strerror or error}") from None
        raise


def _runs(process: str) -> bool:
    """Whether a process of this machine runs."""
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (ValueError, OverflowError, OSError):
        return True
    return True
