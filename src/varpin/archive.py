"""Reading npz archives that may be damaged, foreign or meant to harm.

``np.load`` makes room for as much as a header asks for, and zip files unpack to a thousand times their size. Here
nothing is unpickled, and no memory is taken that the file's own entries do not add up to.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from varpin.errors import FileError

# An archive may unpack to this many bytes, or to this many times its own size where that is more: a motion of a million
# steps stays below both, and one at rest is nothing but repetitions.
MOST_BYTES = 512_000_000
MOST_RATIO = 100
# Bytes of one entry of an array, which may be a text.
_ENTRY = 1_000_000

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_npz(
    source: Path, names: Collection[str] = (), what: str = "npz file", *, others: bool = True
) -> dict[str, NDArray[Any]]:
    """The arrays of an npz file; without those in ``names`` it is not ``what`` it should be.

    With ``others`` off the rest is left unread.

    Arrays are C-contiguous and cannot be written to.

    Raises:
        FileError: The file is missing, unreadable, no npz, truncated or damaged, lacks one of ``names``, holds pickled
            objects, or unpacks to more than :data:`MOST_BYTES` and :data:`MOST_RATIO` times its size.
    """
    if source.is_dir():
        raise FileError(f"{source} is a folder, not an npz file")
    if not source.is_file():
        raise FileError(f"there is no file {source}")
    try:
        with source.open("rb") as stream:
            if not zipfile.is_zipfile(stream):
                raise FileError(f"{source} is not an npz file, or it is truncated")
        with zipfile.ZipFile(source) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if missing := sorted(set(names) - set(members)):
                raise FileError(f"{source} is not a {what}: it has no {', '.join(missing)}")
            if not others:
                members = {name: members[name] for name in names}
            size, limit = sum(info.file_size for info in members.values()), source.stat().st_size * MOST_RATIO
            if size > max(limit, MOST_BYTES):
                raise FileError(
                    f"{source} unpacks to {size / 1e6:.6g} MB, which is over {MOST_BYTES / 1e6:g} MB and over "
                    f"{MOST_RATIO} times its size: no motion or record does"
                )
            return {name: _read_array(archive, info, name, source) for name, info in members.items()}
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"cannot read {source}: {error.strerror or error}") from None
    # A damaged archive raises whatever zipfile, zlib and numpy stumble over: there is no list of it.
    except Exception as error:
        raise FileError(f"{source} is truncated or damaged: {error}") from None


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str, source: Path) -> NDArray[Any]:
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise FileError(f"{source} is damaged: {name} is packed in a way that varpin does not write")
    with archive.open(info) as stream:
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
        # Read to the end whatever is left, so that its checksum is looked at.
        content = stream.read()
    if len(content) != size:
        raise FileError(f"{source} is truncated or damaged: {name} ends after {len(content)} of {size} bytes")
    if size == 0:
        empty = np.zeros(shape, dtype)
        empty.setflags(write=False)
        return empty
    return np.asarray(np.frombuffer(content, dtype).reshape(shape, order="F" if by_columns else "C"), order="C")
