"""Saved motions, work-precision records and cells, as npz archives."""

from __future__ import annotations

import io
import json
import random
import tempfile
from dataclasses import fields
from pathlib import Path

import numpy as np

import varpin as vp
from fuzz import archive
from fuzz.damage import Case, damaged_json, require_finite
from varpin.study.paper.cases import MAIN
from varpin.study.paper.experiments import Cell, Store, Task
from varpin.study.tradeoff import OptimalControlTradeoff, WorkPrecision
from varpin.study.tradeoff.optimal_control import OptimalControlRun
from varpin.study.tradeoff.precision import WorkPrecisionRun

Corpus = dict[str, list[bytes]]


def corpus() -> Corpus:
    """Whole files of every format that is read, by format."""
    finger = vp.Scene(vp.load_robot("finger"), noise=vp.AdditiveNoise(1e-7))
    chain = vp.Scene(vp.planar_chain(2))
    motions = [
        vp.simulate(finger, [0.1, 0.2, 0.3], [0, 1, 0], dt=1e-3, steps=6, rng=0),
        vp.simulate(chain, [0.1, 0.2], [0.0, 0.0], dt=1e-2, steps=40),
        vp.simulate(chain, [0.1, 0.2], [0.0, 0.0], dt=1e-2, steps=0),
    ]
    values = {"int": 3, "float": 0.25, "str": "Midpoint"}

    def row(kind: type) -> object:
        return kind(**{item.name: values[str(item.type)] for item in fields(kind)})

    precision = WorkPrecision((row(WorkPrecisionRun),) * 3, "ur5", 1.0, "Reference", 1e-12, 1e-12, 64, 1, "abc")
    tradeoff = OptimalControlTradeoff((row(OptimalControlRun),) * 2, "ur5", 1.0, 0, "abc")
    cell = Cell("main", "0", "midpoint", 0.01, 1.0, 0.0, 5, "CONVERGED", 0.1, 1.0, 1.0, 1e-6, t=np.zeros(4))
    with tempfile.TemporaryDirectory() as folder:
        task = Task(MAIN, None, "midpoint", 0.01)
        store = Store(Path(folder))
        store.save(task, cell)
        return {
            "trajectory": [motion.save(Path(folder, "a.npz")).read_bytes() for motion in motions],
            "precision": [precision.save(Path(folder, "b.npz")).read_bytes()],
            "tradeoff": [tradeoff.save(Path(folder, "c.npz")).read_bytes()],
            "cell": [Path(folder, f"{task.name}.npz").read_bytes()],
        }


def whole(corpus: Corpus) -> Case:
    """A motion."""
    return Case("trajectory", {"input.npz": corpus["trajectory"][0]})


def make(rng: random.Random, corpus: Corpus) -> Case:
    """A damaged archive, and the format it is damaged from."""
    form = rng.choice(["trajectory", "trajectory", "precision", "tradeoff", "cell"])
    content = rng.choice(corpus[form])
    if form == "cell" and rng.random() < 0.5:
        members = archive.members_of(content)
        members["facts.npy"] = archive.npy(np.array(_damaged_facts(members["facts.npy"], rng)))
        return Case(form, {"input.npz": archive.repacked(members, rng)})
    return Case(form, {"input.npz": archive.damaged(content, rng)})


def _damaged_facts(npy: bytes, rng: random.Random) -> str:
    """The JSON of a paper cell, with another value or another structure."""
    return damaged_json(json.loads(str(np.load(io.BytesIO(npy)))), rng)


def read(path: Path, form: str) -> str:
    """Read a file as what it was, and use it."""
    try:
        if form == "cell":
            task = Task(MAIN, None, "midpoint", 0.01)
            cell = Store(path.parent).load(task) if path.rename(path.with_name(f"{task.name}.npz")) else None
            if cell is None:
                return "refused"
            assert cell.q.shape[1:] == (3,)
            assert np.isscalar(cell.true_cost)
            return "taken"
        if form == "trajectory":
            robot = vp.load_robot("finger") if path.stat().st_size % 2 else None
            motion = vp.Trajectory.load(path, robot)
            require_finite(motion)
            repr(motion), motion.duration, motion.statistics.split_steps
            if robot is not None:
                vp.linearize(vp.Scene(robot, noise=vp.AdditiveNoise(1e-7)), motion)
            motion.save(path)
            return "taken"
        record = (WorkPrecision if form == "precision" else OptimalControlTradeoff).load(path)
        repr(record), record.pareto(), [run.survived for run in record.runs]
        record.save(path)
        record.to_csv(path.with_suffix(".csv"))
    except vp.VarpinError as error:
        return type(error).__name__
    return "taken"
