"""Reading npz archives that may be damaged, foreign or meant to harm.

``np.load`` makes room for as much as a header asks for, and zip files unpack to a thousand times their size. Here
nothing is unpickled, no memory is taken that the file's own entries do not add up to, and whoever knows what belongs in
a file can refuse it by the headers of its arrays, before any of them is read.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from varpin.errors import FileError

# An archive may unpack to this many bytes, or to this many times its own size where that is more: a motion of a million
# steps stays below both, and one at rest is nothing but repetitions.
MOST_BYTES = 400_000_000
MOST_RATIO = 100
# Bytes of one entry of an array, which may be a text.
_ENTRY = 1_000_000
# Bytes that are unpacked at a time.
_CHUNK = 1 << 20

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


@dataclass(frozen=True)
class Header:
    """What an array of an archive says of itself.

    Attributes:
        shape: Its shape.
        dtype: Of its entries.
        by_columns: Whether it lies there in Fortran's order.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    by_columns: bool

    @property
    def ndim(self) -> int:
        """How many axes it has."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """How many entries."""
        return math.prod(self.shape)

    @property
    def bytes(self) -> int:
        """What they take."""
        return self.size * self.dtype.itemsize


Check = Callable[[Mapping[str, Header]], None]


def read_npz(
    source: Path,
    names: Collection[str] = (),
    what: str = "npz file",
    *,
    wanted: Collection[str] | None = None,
    most: int | None = None,
    check: Check | None = None,
) -> dict[str, NDArray[Any]]:
    """The arrays of an npz file; without those in ``names`` it is not ``what`` it should be.

    Of others than ``wanted``, if given, nothing is read; of these, what is there. ``most`` is how many bytes it may
    unpack to, if that is known. ``check`` is given the headers of what is to be read, and raises a FileError where they
    do not fit.

    Arrays are C-contiguous and cannot be written to.

    Raises:
        FileError: The file is missing, unreadable, no npz, truncated or damaged, lacks one of ``names``, holds pickled
            objects, or unpacks to more than ``most``, or :data:`MOST_BYTES` and :data:`MOST_RATIO` times its size.
    """
    try:
        if source.is_dir():
            raise FileError(f"{source} is a folder, not an npz file")
        if not source.is_file():
            raise FileError(f"there is no file {source}")
        with source.open("rb") as stream:
            if not zipfile.is_zipfile(stream):
                raise FileError(f"{source} is not an npz file, or it is truncated")
        with zipfile.ZipFile(source) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if missing := sorted(set(names) - set(members)):
                raise FileError(f"{source} is not a {what}: it has no {', '.join(missing)}")
            if wanted is not None:
                members = {name: members[name] for name in wanted if name in members}
            _require_size(source, what, sum(info.file_size for info in members.values()), most)
            headers = {}
            for name, info in members.items():
                if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise FileError(f"{source} is damaged: {name} is packed in a way that varpin does not write")
                with archive.open(info) as stream:
                    headers[name] = _read_header(stream, info, name, source)
            # What lies by columns is turned around, for which there has to be room.
            turned = [header for header in headers.values() if header.by_columns and header.ndim > 1]
            size = sum(header.bytes for header in headers.values())
            _require_size(source, what, size + max((header.bytes for header in turned), default=0), most)
            if check is not None:
                check(headers)
            arrays = {}
            for name, info in members.items():
                with archive.open(info) as stream:
                    _read_header(stream, info, name, source)
                    arrays[name] = _read_array(stream, headers[name], name, source)
            return arrays
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"cannot read {source}: {error.strerror or error}") from None
    # A damaged archive raises whatever zipfile, zlib and numpy stumble over: there is no list of it.
    except Exception as error:
        raise FileError(f"{source} is truncated or damaged: {error}") from None


def _require_size(source: Path, what: str, size: int, most: int | None) -> None:
    if most is not None and size > most:
        raise FileError(f"{source} unpacks to {size / 1e6:.6g} MB, which no {what} does that fits here")
    if most is None and size > max(source.stat().st_size * MOST_RATIO, MOST_BYTES):
        raise FileError(
            f"{source} unpacks to {size / 1e6:.6g} MB, which is over {MOST_BYTES / 1e6:g} MB and over "
            f"{MOST_RATIO} times its size: no motion or record does"
        )


def _read_header(stream: IO[bytes], info: zipfile.ZipInfo, name: str, source: Path) -> Header:
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise FileError(f"{source} is damaged: {name} is of npy version {version}")
    shape, by_columns, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        raise FileError(f"{source} cannot be read without unpickling objects, which is not done")
    if dtype.names is not None or dtype.subdtype is not None or not 0 < dtype.itemsize <= _ENTRY:
        raise FileError(f"{source} is damaged: {name} is an array of {dtype}")
    size, left = math.prod(shape) * dtype.itemsize, info.file_size - stream.tell()
    if any(number < 0 for number in shape) or size != left:
        raise FileError(f"{source} is truncated or damaged: {name} has {left} bytes for shape {shape} of {dtype}")
    return Header(shape, dtype, by_columns)


def _read_array(stream: IO[bytes], header: Header, name: str, source: Path) -> NDArray[Any]:
    """What follows a header, unpacked into its place piece by piece."""
    size, end = header.bytes, 0
    content = np.empty(size, dtype=np.uint8)
    # Once more after the last, so that its checksum is looked at.
    while piece := stream.read(_CHUNK):
        if end + len(piece) > size:
            raise FileError(f"{source} is truncated or damaged: {name} goes on after {size} bytes")
        content[end : end + len(piece)] = np.frombuffer(piece, dtype=np.uint8)
        end += len(piece)
    if end != size:
        raise FileError(f"{source} is truncated or damaged: {name} ends after {end} of {size} bytes")
    if size == 0:
        array = np.zeros(header.shape, header.dtype)
    else:
        array = np.asarray(
            content.view(header.dtype).reshape(header.shape, order="F" if header.by_columns else "C"), order="C"
        )
    array.setflags(write=False)
    return array
