"""Records of the battery at the extremes, as JSON: read, gone on with, and shown."""

from __future__ import annotations

import json
import math
import random
import tempfile
from pathlib import Path

import varpin as vp
from fuzz.damage import Case, damaged_bytes, damaged_json
from varpin.show import extremes_report
from varpin.study import extremes
from varpin.study.extremes.trial import Cell, Kind

Corpus = bytes


def corpus() -> Corpus:
    """A record of one cell of each kind."""
    nothing = dict.fromkeys(("momentum", "reversal", "symplecticity", "record"), math.nan)
    cells = [
        Cell(
            family="time step",
            trial=f"3 links, dt = 0.0{k} s",
            integrator="Midpoint()",
            kind=kind,
            error=1e-3 * k,
            joint=2e-3 * k,
            velocity=3e-3 * k,
            period=4e-3 * k,
            energy=math.inf,
            said=("dt is coarse",) * (k % 2),
            found=("energy",) * (k % 3),
            done=10,
            steps=20,
            seconds=0.25,
            fingerprint=f"{k:024x}",
            **nothing,
        )
        for k, kind in enumerate(Kind)
    ]
    with tempfile.TemporaryDirectory() as folder:
        return extremes.Record(tuple(cells), "the battery", deep=False).save(Path(folder, "a.json")).read_bytes()


def whole(corpus: Corpus) -> Case:
    """The record."""
    return Case("record", {"input.json": corpus})


def make(rng: random.Random, corpus: Corpus) -> Case:
    """A damaged record."""
    content = corpus
    if rng.random() < 0.8:
        content = damaged_json(json.loads(corpus), rng).encode()
    if rng.random() < 0.3 or content == corpus:
        content = damaged_bytes(content, rng)
    return Case("record", {"input.json": content})


def read(path: Path, form: str) -> str:
    """Load it, show it, and go on with a battery that has nothing left to run."""
    try:
        record = extremes.Record.load(path)
    except vp.VarpinError as error:
        return type(error).__name__
    repr(record), record.counts(), record.wrong()
    extremes_report.write_page(path.with_suffix(".html"), record)
    record.save(path)
    again = extremes.Record.load(path)
    assert len(again.cells) == len(record.cells)
    extremes.run(trials=[], save=path)
    return "taken"
