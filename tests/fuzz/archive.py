"""Npz archives damaged in their arrays, headers, members and bytes."""

from __future__ import annotations

import contextlib
import io
import random
import struct
import warnings
import zipfile
import zlib

import numpy as np

from fuzz.damage import damaged_bytes

Members = dict[str, bytes]


def members_of(content: bytes) -> Members:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def npy(array: object, *, allow_pickle: bool = False) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=allow_pickle)
    return stream.getvalue()


def _strange_array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    """Another array in the place of one."""
    change = rng.randrange(10)
    if change == 0:
        return array.astype(rng.choice(["f2", "f4", ">f8", "c16", "i1", "U8", "S3", "?", "M8[s]"]), casting="unsafe")
    if change == 1:
        return array.reshape(rng.choice([(-1,), (1, -1), (-1, 1), (1, *array.shape)]))
    if change == 2:
        return np.concatenate([array.reshape(-1)] * rng.randrange(4) or [np.zeros(0)])
    if change == 3 and array.dtype.kind in "fi" and array.size:
        wrong = np.array(array, dtype=float)
        wrong.flat[rng.randrange(array.size)] = float(rng.choice([np.nan, np.inf, 1e308, -1e308, -1.0, 0.0, 1e-320]))
        return wrong
    if change == 4:
        return np.asfortranarray(array)
    if change == 5:
        return np.zeros(rng.choice([(), (0,), (0, 0), (3, 0), (0, 3), (1,) * 32, (7,), (7, 3)]))
    if change == 6:
        return np.array(
            rng.choice(["", "x" * 3000, "varpin.trajectory/3", "\0", "é", "{", "[]", "{}", "null", "1" * 5000])
        )
    if change == 7:
        return np.zeros(3, dtype=[("a", "f8"), ("b", "U3")])
    if change == 8 and array.ndim:
        return np.swapaxes(array, 0, -1)
    return np.zeros_like(array)


def _strange_header(npy: bytes, rng: random.Random) -> bytes:
    """An array whose header says something else than its data."""
    shapes = [
        "()",
        "(1,)",
        "(-1,)",
        "(10**9,)",
        "(1000000000,)",
        "(100000000, 100)",
        "(9223372036854775807,)",
        "(2, 2)",
    ]
    shapes += ["(4611686018427387904, 4)", "(0, 1000000000000)", "(1.5,)", "('a',)", "None", "(True,)"]
    shapes += ["(" * 900 + ")" * 900, "(" + "1, " * 70 + ")", "(" + "0, " * 40 + ")", "(-4611686018427387904, 2)"]
    kinds = [
        "'<f8'",
        "'|O'",
        "'<U1000000000'",
        "'<U0'",
        "'V0'",
        "[('a', '<f8')]",
        "'<f8, <f8'",
        "'>i8'",
        "'<M8[s]'",
        "1",
    ]
    kinds += ["[('a', '|O')]", "('<f8', (1000, 1000, 1000))", "[" * 300 + "]" * 300, "'x'", "'<U2147483647'", "'<f16'"]
    shape, kind = rng.choice(shapes), rng.choice(kinds)
    head = "{'descr': %s, 'fortran_order': %s, 'shape': %s, }" % (  # noqa: UP031
        kind if rng.random() < 0.5 else "'<f8'",
        rng.choice(["False", "True", "2", "None"]),
        shape if rng.random() < 0.7 else "(3,)",
    )
    if rng.random() < 0.1:
        head = rng.choice(["{}", "[" * 5000, "", "a" * 9000, "{'descr': " * 500, "-" * 5000 + "1", "9" * 5000])
    version = rng.choice([(1, 0), (1, 0), (1, 0), (2, 0), (3, 0), (9, 9)])
    raw = head.encode() + b"\n"
    length = struct.pack("<H" if version == (1, 0) else "<I", len(raw) if rng.random() < 0.9 else 65535)
    return b"\x93NUMPY" + bytes(version) + length + raw + npy[-rng.randrange(1, 200) :]


def zipped(members: list[tuple[str, bytes]], rng: random.Random) -> bytes:
    stream = io.BytesIO()
    odd = [zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    method = zipfile.ZIP_DEFLATED if rng.random() < 0.9 else rng.choice(odd)
    with zipfile.ZipFile(stream, "w", method) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # names that are there twice
        for name, content in members:
            archive.writestr(name, content)
    return stream.getvalue()


def bomb(members: Members, rng: random.Random) -> bytes:
    """An archive that unpacks to much more than it is."""
    size = rng.choice([10**7, 10**8, 3 * 10**8])
    name = rng.choice(list(members))
    if rng.random() < 0.5:
        stream = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            stream, {"descr": rng.choice(["<f8", "|i1", "<U1"]), "fortran_order": False, "shape": (size // 8,)}
        )
        members[name] = stream.getvalue()
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = packer.compress(members[name]) + b"".join(packer.compress(bytes(10**6)) for _ in range(size // 10**6))
    packed += packer.flush()
    # Written as a stored member of that content, and then called deflated, with a checksum that does not fit.
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for other, content in members.items():
            archive.writestr(other, packed if other == name else content)
        info = archive.getinfo(name)
        info.compress_type, info.file_size = zipfile.ZIP_DEFLATED, rng.choice([len(members[name]) + size, 100, 2**40])
    return stream.getvalue()


def damaged(content: bytes, rng: random.Random) -> bytes:
    """An archive after some changes to its members."""
    if rng.random() < 0.3:
        return damaged_bytes(content, rng)
    members = members_of(content)
    if rng.random() < 0.01:
        return bomb(members, rng)
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        _damage_member(members, rng.choice(list(members)), rng)
        if not members:
            break
    return repacked(members, rng)


def repacked(members: Members, rng: random.Random) -> bytes:
    """An archive of members, sometimes with one twice, with thousands of empty ones, or with other bytes."""
    listed = list(members.items())
    if rng.random() < 0.05:
        listed += [rng.choice(listed)] if listed else []
    if rng.random() < 0.02:
        listed += [(f"m{i}.npy", b"") for i in range(3000)]
    content = zipped(listed, rng)
    return damaged_bytes(content, rng) if rng.random() < 0.1 else content


def _damage_member(members: Members, name: str, rng: random.Random) -> None:
    change = rng.randrange(10)
    if change <= 3:
        with contextlib.suppress(Exception):  # what an earlier change has made no array of
            array = np.load(io.BytesIO(members[name]))
            members[name] = npy(_strange_array(array, rng))
    elif change <= 5:
        members[name] = _strange_header(members[name], rng)
    elif change == 6:
        other = rng.choice(list(members))
        members[name], members[other] = members[other], members[name]
    elif change == 7:
        members[name] = damaged_bytes(members[name], rng)
    elif change == 8:
        members[rng.choice(["x.npy", "t", "../up.npy", "statistics.npy", name.replace(".npy", "")])] = members[name]
        if rng.random() < 0.5 and len(members) > 1:
            del members[name]
    else:
        members[name] = rng.choice([b"", npy([{}], allow_pickle=True), b"\x93NUMPY", b"\x80\x04.", b"PK\3\4"])
