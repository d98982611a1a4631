"""Saved solutions, as npz archives: read with their problem, and gone on from."""

from __future__ import annotations

import random
import tempfile
from pathlib import Path

import numpy as np

import varpin as vp
from fuzz import archive
from fuzz.damage import Case, require_finite

Corpus = list[bytes]


def problem(form: str) -> vp.OptimalControlProblem:
    """Small, with noise or without."""
    robot = vp.load_robot("finger")
    scene = vp.Scene(robot, damping=1e-4, noise=vp.AdditiveNoise(1e-7) if form == "noisy" else None)
    cost = vp.TrackingCost([1.0, 0.5, 0.2], 10.0) + vp.ControlCost(0.1)
    steps = 12 if form == "noisy" else 20
    return vp.OptimalControlProblem(scene, cost, np.zeros(3), np.zeros(3), dt=2e-3, steps=steps, hold=2)


def corpus() -> Corpus:
    """Of the noisy problem and of the other, each with the state of its search, and one without."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for form in ("noisy", "quiet"):
            plan = vp.solve(problem(form), max_iterations=2)
            found.append(plan.save(Path(folder, "a.npz")).read_bytes())
    return found


def whole(corpus: Corpus) -> Case:
    """A solution that can be gone on from."""
    return Case("noisy", {"input.npz": corpus[0]})


def make(rng: random.Random, corpus: Corpus) -> Case:
    """A damaged solution, of its own problem and now and then of another."""
    number = rng.randrange(len(corpus))
    form = ("noisy", "quiet")[number if rng.random() < 0.95 else 1 - number]
    return Case(form, {"input.npz": archive.damaged(corpus[number], rng)})


def read(path: Path, form: str) -> str:
    """Load it, look at it and go on from it."""
    try:
        plan = vp.Solution.load(path, problem(form))
    except vp.VarpinError as error:
        return type(error).__name__
    require_finite(plan.trajectory)
    repr(plan), plan.table(), plan.violations, plan.policy, plan.expected_cost
    plan.save(path)
    try:
        on = vp.solve(plan.problem, resume=plan, max_iterations=1)
    except vp.VarpinError as error:
        return f"taken, not gone on from: {type(error).__name__}"
    require_finite(on.trajectory)
    assert np.isfinite([on.cost, on.noise_cost]).all(), "a plan whose cost is not finite"
    assert np.isfinite(on.gains).all(), "a plan whose gains are not finite"
    return "taken"
