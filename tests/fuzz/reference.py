"""Files that a scene's reference names: CSV and npz, and what is no file at all."""

from __future__ import annotations

import random
import tempfile
from pathlib import Path

import numpy as np

import varpin as vp
from fuzz import archive
from fuzz.damage import NUMBERS, WORDS, Case, Special, damaged_bytes

SCENE = """
[robot]
source = "finger"
[horizon]
dt = 1e-2
steps = 10
[[cost]]
type = "tracking"
reference = {{ file = "{name}" }}
[[cost]]
type = "control"
"""
TABLE = "t, mcp, pip, dip\n0, 1, 2, 3\n0.05, 1, 1, 1\n0.2, 3, 2, 1\n"

Corpus = dict[str, bytes]


def corpus() -> Corpus:
    """A table, a motion, and arrays by name."""
    t = np.linspace(0.0, 1.0, 20)
    with tempfile.TemporaryDirectory() as folder:
        motion = vp.simulate(vp.Scene(vp.load_robot("finger")), [0.1, 0.2, 0.3], np.zeros(3), dt=0.01, steps=10)
        motion.save(Path(folder, "a.npz"))
        np.savez(Path(folder, "b.npz"), t=t, mcp=np.sin(t), pip=np.cos(t), dip=t)
        return {
            "csv": TABLE.encode(),
            "motion": Path(folder, "a.npz").read_bytes(),
            "arrays": Path(folder, "b.npz").read_bytes(),
        }


def whole(corpus: Corpus) -> Case:
    """A table."""
    return _case("path.csv", corpus["csv"])


def _case(name: str, content: bytes | Special) -> Case:
    return Case("scene", {"scene.toml": SCENE.format(name=name).encode(), Path(name).name: content})


def make(rng: random.Random, corpus: Corpus) -> Case:
    """A damaged file, or something else in its place."""
    if rng.random() < 0.03:
        kinds = [Special("fifo"), Special("folder"), Special("link", "path.csv"), Special("link", "/dev/zero")]
        kinds += [Special("link", "/etc/passwd"), Special("link", ".."), Special("link", "/proc/self/mem")]
        return _case(rng.choice(["path.csv", "path.npz"]), rng.choice(kinds))
    form = rng.choice(["csv", "motion", "arrays"])
    if form != "csv":
        return _case("path.npz", archive.damaged(corpus[form], rng))
    if rng.random() < 0.03:
        return _case("path.csv", _extreme_table(rng))
    rows = [line.split(",") for line in TABLE.splitlines()]
    for _ in range(rng.choice([0, 1, 1, 2, 4])):
        row = rng.choice(rows)
        change = rng.randrange(5)
        if change <= 2 and row:
            row[rng.randrange(len(row))] = rng.choice([*NUMBERS, *WORDS, '"', '"1', "'1'", '"a\nb"'])
        elif change == 3:
            rows.insert(rng.randrange(len(rows) + 1), row * rng.choice([0, 1, 2]))
        elif row:
            del row[rng.randrange(len(row))]
    content = "\n".join(",".join(row) for row in rows).encode("utf-8", errors="replace")
    return _case("path.csv", damaged_bytes(content, rng) if rng.random() < 0.3 else content)


def _extreme_table(rng: random.Random) -> bytes:
    """Long, wide, or of one long word."""
    size = int(10 ** rng.uniform(3.0, 6.5))
    return rng.choice(
        [
            TABLE.encode() + b"1,1,1,1\n" * size,
            b"," * size,
            b"t,mcp,pip,dip" + b",x" * size + b"\n",
            TABLE.encode() + b"9" * size,
            b'"' * size,
            b"\n" * size,
            b"\0" * size,
            b"t\n" + b"1\n" * size,
            b"t,mcp,pip,dip\n" + b"".join(b"%d,0,0,0\n" % k for k in range(size // 20)),
        ]
    )


def read(path: Path, form: str) -> str:
    """Load the scene that names it."""
    try:
        file = vp.load_scene(path)
    except vp.VarpinError as error:
        return type(error).__name__
    # Squares of 1e200 are beyond floating point, and the search says so.
    target = file._layout.costs[0].target
    assert target is not None
    assert np.isfinite(target.at(np.linspace(0.0, 0.1, 11))).all(), "a reference that is not finite"
    return "taken"
