"""What all kinds of damaged input have in common: files, odd numbers and words, and bytes that change."""

from __future__ import annotations

import copy
import functools
import json
import math
import os
import random
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import varpin as vp


@dataclass(frozen=True)
class Special:
    """What may lie where a file is expected: a ``fifo``, a ``folder``, or a ``link`` to ``target``."""

    kind: str
    target: str = ""


@dataclass(frozen=True)
class Case:
    """An input: its files, the one that is read first of all, and what it is read as."""

    form: str
    files: Mapping[str, bytes | Special]

    def write(self, folder: Path) -> Path:
        """Write the files; returns the path of the first."""
        for name, content in self.files.items():
            path = folder / name
            if isinstance(content, bytes):
                path.write_bytes(content)
            elif content.kind == "fifo":
                os.mkfifo(path)
            elif content.kind == "folder":
                path.mkdir()
            else:
                path.symlink_to(content.target)
        return folder / next(iter(self.files))


NUMBERS = [
    *(
        "0",
        "-0",
        "1",
        "-1",
        "2",
        "1e-3",
        "1e3",
        "1e8",
        "1e-12",
        "1e-320",
        "1e150",
        "-1e150",
        "1e160",
        "1e308",
        "-1e308",
    ),
    *("1e309", "nan", "NaN", "-nan", "inf", "-inf", "infinity", "0x1p3", "1_000", "1,5", "1e", "1d3", "+1", ".5", "5."),
    *("٣", "½", "abc", "3.14159265358979", "1.5707963", "99999999999999999999", "2147483648", "1e-9", "1e9", "", " "),
    *("1 2", "\t1", "9" * 5000),
]
WORDS = [
    *("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical", "mimic", "universe", "world"),
    *("root_joint", "base", "base_link", "l1", "l2", "j1", "j2", "%s%n%s", "../../etc/passwd", "package://x/y.stl"),
    *("file:///dev/zero", "/dev/zero", "/dev/stdin", "é", "机器人", "\u202e", "🤖", "", " ", "a" * 20_000, "a b"),
]

# In the place of a value in a tree of dicts and lists, as JSON and TOML have them.
VALUES: list[Any] = [
    *("", "x", " ", "\0", "a/b", "../x", "a\nb", "é", "x" * 20_000, "[", "{}", "null", "1" * 5000, "nan", "finger"),
    *(None, True, False, 0, -1, 1, 2, 3, 7, 1000, 10**6, 10**9, 2**31, 2**63, 2**64, -(2**63), 10**400, 10**4000),
    *(0.0, -0.0, 0.5, -1.5, 1e-3, 1e-12, 1e-320, 1e-150, 1e8, 1e150, 1e308, -1e308, math.nan, math.inf, -math.inf),
    *([], [[]], [1, 2, 3], [1.0] * 3, [0.1], [None], ["a"], [True], [[1.0], [2.0]], ["mcp", "mcp"], [0.0] * 1000),
    *({}, {"a": 1}, {"": 1}, {"mcp": 1.0}, {"file": "x"}, [{}], [{"type": "control"}], {"a": {"b": {"c": []}}}),
]


def damaged_bytes(content: bytes, rng: random.Random) -> bytes:
    """Bytes flipped, cut, doubled or put in."""
    data = bytearray(content)
    for _ in range(rng.choice([1, 1, 2, 4, 16])):
        at = rng.randrange(len(data) + 1)
        change = rng.randrange(6)
        if change == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif change == 1 and at < len(data):
            data[at] = rng.randrange(256)
        elif change == 2:
            data[at:at] = rng.randbytes(rng.choice([1, 2, 8, 100]))
        elif change == 3:
            del data[at : at + rng.choice([1, 2, 8, 100])]
        elif change == 4:
            data[at:at] = data[at : at + rng.choice([4, 40, 400])]
        else:
            data[at : at + 4] = struct.pack("<I", rng.choice([0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x10000]))
    if rng.random() < 0.05:
        del data[rng.randrange(len(data) + 1) :]
    return bytes(data)


def places(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where there is a value in a tree of dicts and lists."""
    keys = list(data) if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
    return [path, *(place for key in keys for place in places(data[key], (*path, key)))]


def damaged_tree(data: Any, rng: random.Random, names: Sequence[str] = ()) -> Any:
    """A tree after some changes to its keys and values; ``names`` are keys and words to put in."""
    data = copy.deepcopy(data)
    for _ in range(rng.choice([1, 1, 1, 2, 3, 6])):
        *where, last = rng.choice(places(data)[1:] or [(None,)])
        if last is None:
            return rng.choice(VALUES)
        table = functools.reduce(lambda tree, key: tree[key], where, data)
        change = rng.randrange(9)
        if change <= 3:
            table[last] = copy.deepcopy(rng.choice([*VALUES, *names]))
        elif change == 4:
            del table[last]
        elif change == 5 and isinstance(table, dict):
            table[rng.choice(["more", "__class__", "", "a.b", "a\nb", *names])] = table.pop(last)
        elif change == 6:
            other = rng.choice(places(data))
            table[last] = copy.deepcopy(functools.reduce(lambda tree, key: tree[key], other, data))
        elif change == 7 and isinstance(table, list):
            table[:] = table * rng.choice([0, 2, 3, 100])
        elif isinstance(table[last], int | float) and not isinstance(table[last], bool):
            factor = rng.choice([-1, 0, 2, 1000, 10**6, 10**12])
            table[last] = table[last] * factor if rng.random() < 0.5 else table[last] // (factor or 7)
        else:
            table[last] = [copy.deepcopy(table[last])] * rng.choice([1, 2, 30])
    return data


def damaged_json(data: Any, rng: random.Random) -> str:
    """JSON with other values, another structure, or that is none."""
    if rng.random() < 0.1:
        return rng.choice(["", "{", "[" * 100_000, "null", "1", "[]", '"x"', '{"a":' * 50_000, "9" * 100_000])
    return json.dumps(damaged_tree(data, rng))


def require_finite(motion: vp.Trajectory) -> None:
    """What varpin takes, it may not answer with NaN."""
    for name in ("t", "q", "v", "p", "u", "energy"):
        assert np.isfinite(getattr(motion, name)).all(), f"a motion whose {name} is not finite"
