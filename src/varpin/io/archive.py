"""Records in files: frozen dataclasses of arrays and plain values, as npz without pickle.

An entry of a file is a field of the record, under its name: ``dt``. The entry of a field of a nested record is
``statistics.jets``. The annotations of the fields define type and shape of the entries; a field with a default may be
missing, and one whose metadata have ``entry=None`` is left out. Every file has a ``format``: a name and a version.
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
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
Members = Mapping[str, Any]


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
    """Write a record of the format ``form`` as compressed npz; returns its path."""
    return write_npz(path, form, members_of(record))


def write_npz(path: str | os.PathLike[str], form: str, members: Mapping[str, Any]) -> Path:
    """Write arrays of the format ``form``; an existing file is replaced only when the new one is complete."""
    with atomic_file(path) as stream:
        np.savez_compressed(stream, **members, format=form)
    return Path(path)


class Entry:
    """An array of an npz file, of which the header alone has been read; ``np.asarray`` reads the rest."""

    def __init__(self, source: Path, archive: zipfile.ZipFile, name: str) -> None:
        self.source, self.name = source, name
        with archive.open(f"{name}.npy") as stream:
            try:
                read = _HEADERS[np.lib.format.read_magic(stream)]
                self.shape, _, self.dtype = read(stream)
            except (ValueError, KeyError) as error:
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


_HEADERS: Mapping[tuple[int, int], Callable[..., Any]] = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_npz(source: Path, form: str | None = None) -> dict[str, Entry]:
    """The headers of the arrays of an npz file, which must be of the format ``form`` if that is given.

    Each array is read where it is asked for, so that a wrong shape is found before its data.
    """
    with _opened(source) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        members = {name: Entry(source, archive, name) for name in names}
    found = str(np.asarray(members.get("format", "")))
    if form is not None and found != form:
        what = f"its format is {reprlib.repr(found)}" if found else "it has no format"
        raise FileError(f"{source} is another kind of file: {what} instead of {form!r}")
    return members


def read_format(source: Path) -> str:
    """The format of an npz file; empty if it has none."""
    return str(np.asarray(read_npz(source).get("format", "")))


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
    kind: Any = type(record)
    hints = _hints(kind)
    for item in _stored(kind):
        name, value, hint = prefix + _entry(item), getattr(record, item.name), _required(hints[item.name])
        if value is None:
            continue
        if is_dataclass(value):
            members |= members_of(value, f"{name}.")
        elif (row := _row(hint)) is not None:
            for own in row:
                members[f"{name}.{own.name}"] = np.array([_plain(getattr(each, own.name)) for each in value])
        elif isinstance(value, Mapping):
            members |= {f"{name}.{key}": array for key, array in value.items()}
        else:
            members[name] = np.array([_plain(own) for own in value], dtype=np.str_) if _texts(hint) else _plain(value)
    return members


def record_of(
    kind: type[T],
    members: Members,
    source: Path,
    *,
    prefix: str = "",
    sizes: Mapping[str, int] | None = None,
    known: Mapping[str, Any] | None = None,
) -> T:
    """A record built from the entries of an npz file whose names begin with ``prefix``.

    ``sizes`` are known axes, ``known`` the values of fields without an entry. Raises a FileError that names the file,
    the entry, and what is expected.
    """
    builder = _Builder(source, dict(sizes or {}))
    record: T = builder.record(kind, builder.tables(kind, members, prefix), prefix.removesuffix("."), known)
    return record


class _Builder:
    """Records from the entries of a file."""

    def __init__(self, source: Path, sizes: dict[str, int]) -> None:
        self.source = source
        self.sizes = sizes

    def tables(self, kind: Any, members: Members, prefix: str) -> dict[str, Any]:
        """The entries of an npz file by field: records are tables."""
        tables: dict[str, Any] = {}
        hints = _hints(kind)
        for item in _stored(kind):
            key, hint = _entry(item), _required(hints[item.name])
            name = prefix + key
            below = {
                member.removeprefix(f"{name}."): entry
                for member, entry in members.items()
                if member.startswith(f"{name}.")
            }
            if is_dataclass(hint) and below:
                tables[key] = self.tables(hint, members, f"{name}.")
            elif name in members:
                tables[key] = members[name]
            elif typing.get_origin(hint) is Mapping or below:
                tables[key] = below
        return tables

    def error(self, entry: str, found: str, expected: str) -> FileError:
        return FileError(f"{self.source}: {entry or 'the file'} is {found} instead of {expected}")

    def build(self, hint: Any, value: Any, entry: str) -> Any:
        """Convert ``value``, an array or a table, to the type ``hint`` of a field."""
        hint, optional = _required(hint), hint
        if value is None and hint is not optional:
            return None
        if typing.get_origin(hint) in (Annotated, np.ndarray):
            return self._array(hint, value, entry)
        if isinstance(value, np.ndarray | Entry):
            # A number or a text has no axes, a list has one.
            if len(value.shape) > 1 or (value.shape and typing.get_origin(hint) is not tuple):
                raise self.error(entry, f"{value.dtype} {value.shape}", "a single value or a list")
            value = np.asarray(value).tolist()
        if is_dataclass(hint):
            return self.record(hint, value, entry)
        if typing.get_origin(hint) is tuple:
            return self._tuple(hint, value, entry)
        if typing.get_origin(hint) is Mapping:
            inner = typing.get_args(hint)[1]
            return {name: self.build(inner, array, f"{entry}.{name}") for name, array in value.items()}
        return self._scalar(hint, value, entry)

    def _array(self, hint: Any, array: Any, entry: str) -> NDArray[Any]:
        kind, axes = _array_type(hint)
        found = array if isinstance(array, np.ndarray | Entry) else np.array(None)
        names = axes.axes if axes is not None else found.shape
        expected = tuple(self.sizes.get(name, name) if isinstance(name, str) else name for name in names)
        fits = found.dtype == kind and len(found.shape) == len(expected)
        if not fits or any(isinstance(a, int) and a != b for a, b in zip(expected, found.shape, strict=True)):
            raise self.error(entry, f"{found.dtype} {found.shape}", f"{kind} ({', '.join(map(str, expected))})")
        self.sizes |= {name: size for name, size in zip(names, found.shape, strict=True) if isinstance(name, str)}
        whole = np.asarray(found)
        if axes is not None and axes.finite and not np.isfinite(whole).all():
            raise FileError(f"{self.source}: {entry} holds values that are not finite numbers")
        whole.setflags(write=False)
        return whole

    def record(self, kind: Any, value: Any, entry: str, known: Mapping[str, Any] | None = None) -> Any:
        if not isinstance(value, dict):
            raise self.error(entry, reprlib.repr(value), "a table")
        hints, given = _hints(kind), dict(known or {})
        for item in _stored(kind):
            key = _entry(item)
            name = f"{entry}.{key}" if entry else key
            if key in value:
                given[item.name] = self.build(hints[item.name], value[key], name)
            elif item.default is MISSING and item.default_factory is MISSING:
                raise FileError(f"{self.source}: {name} is missing")
        try:
            return kind(**given)
        except InputError as error:
            raise FileError(f"{self.source}: {error}") from None

    def _tuple(self, hint: Any, value: Any, entry: str) -> tuple[Any, ...]:
        kinds = typing.get_args(hint)
        if isinstance(value, dict):
            # Records, by columns.
            columns = {name: np.atleast_1d(column).tolist() for name, column in value.items()}
            if len(set(map(len, columns.values()))) > 1:
                raise self.error(entry, "columns of different lengths", "a table")
            value = [dict(zip(columns, each, strict=True)) for each in zip(*columns.values(), strict=True)]
        if not isinstance(value, list) or (kinds[-1] is not ... and len(value) != len(kinds)):
            raise self.error(entry, reprlib.repr(value), "a list" if kinds[-1] is ... else f"a list of {len(kinds)}")
        wanted = [kinds[0]] * len(value) if kinds[-1] is ... else kinds
        pairs = enumerate(zip(wanted, value, strict=True))
        return tuple(self.build(kind, item, f"{entry}[{index}]") for index, (kind, item) in pairs)

    def _scalar(self, kind: Any, value: Any, entry: str) -> Any:
        if issubclass(kind, Finding):
            return kind.of_entry(self._scalar(str, value, entry))
        if issubclass(kind, Enum):
            if value not in kind.__members__:
                raise self.error(entry, reprlib.repr(value), f"a {kind.__name__}")
            return kind[value]
        if kind is float and type(value) is int and abs(value) < 2**53:
            return float(value)
        if type(value) is not kind:
            raise self.error(entry, reprlib.repr(value), f"a value of type {kind.__name__}")
        return value


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    return typing.get_type_hints(kind, include_extras=True)


def _entry(item: Any) -> str:
    """The name of a field in files: ``entry`` of its metadata, or else the name of the field."""
    return str(item.metadata.get("entry", item.name))


def _stored(kind: Any) -> list[Any]:
    """The fields of a record that have entries in files."""
    return [item for item in fields(kind) if item.metadata.get("entry", "") is not None]


def _required(hint: Any) -> Any:
    """An annotation without None."""
    if typing.get_origin(hint) not in (UnionType, typing.Union):
        return hint
    (option,) = (option for option in typing.get_args(hint) if option is not NoneType)
    return option


def _texts(hint: Any) -> bool:
    """Whether an annotation is ``tuple[str, ...]``, or of findings."""
    return typing.get_origin(hint) is tuple and typing.get_args(hint)[0] in (str, Finding)


def _row(hint: Any) -> Sequence[Any] | None:
    """The fields of the records in an annotation ``tuple[record, ...]``; None of others."""
    kinds = typing.get_args(hint) if typing.get_origin(hint) is tuple else (None,)
    return fields(kinds[0]) if is_dataclass(kinds[0]) else None


def _plain(value: Any) -> Any:
    """A value as files have it: a finding with its numbers as one text, and a member of an enumeration by its name."""
    if isinstance(value, Finding):
        return value.entry()
    return value.name if isinstance(value, Enum) else value


def _array_type(hint: Any) -> tuple[np.dtype[Any], Axes | None]:
    """The type of an array's entries, and its axes if they are annotated."""
    array, axes = typing.get_args(hint) if typing.get_origin(hint) is Annotated else (hint, None)
    (scalar,) = typing.get_args(typing.get_args(array)[1])
    return np.dtype(scalar), axes


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
