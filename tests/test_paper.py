"""The paper's experiments: cells, claims and the report on made-up cells; all of it, slowly, by the command line."""

import csv
import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from refusals import refused

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from paper import cases, experiments
from paper.cases import CASES, COARSE, COARSEST, MAIN, METHODS, VARIATIONS
from paper.claims import Claim, assess, free_motions
from paper.experiments import OPTIMUM, PLAIN, STOCHASTIC, Cell, Task, fill, run, tasks
from paper.figures import draw
from paper.report import write

import varpin as vp

FIGURES = ["figure1", "figure2", "figure3", "figure4", "figure5", "truth", "noise"]


def made_up(task):
    """A cell that nobody computed, in which the paper is right: errors dt^2 (variational) and dt (Euler)."""
    steps = round(cases.DURATION / task.dt)
    t = np.linspace(0.0, cases.DURATION, steps + 1)
    error = {"Euler": 100.0 * task.dt, OPTIMUM: 10.0 * task.dt**2}.get(task.method, 100.0 * task.dt**2)
    noise = 0.0 if task.case is None else 1e-8
    return Cell(
        setting=task.setting.key,
        case="0" if task.case is None else task.case.key,
        method=task.method,
        dt=task.dt,
        cost=4e-6 * (1.0 + error),
        noise_cost=noise,
        iterations=2,
        status="CONVERGED",
        seconds=1e-4 / task.dt,
        open_loop=4e-6 * (1.0 + error),
        closed_loop=np.nan if task.method == "Euler" else 4e-6 * (1.0 + error),
        accuracy=1e-11,
        sampled=np.array([8e-6 if task.method == PLAIN else 4e-6 * (1.0 + error) + noise, 1e-9]),
        t=t,
        q=np.array([cases.reference(x) for x in t]) + 1e-3 * error,
        u=1e-4 * np.column_stack([np.sin(t[:-1]), np.cos(t[:-1]), t[:-1]]),
        gains=np.full((47 if task.method in METHODS else 0, 3, 6), 1.0 + error),
    )


@pytest.fixture
def counted(monkeypatch):
    """``run`` replaced by made-up cells; returns the names of the tasks that it was asked for."""
    asked = []

    def counting(task):
        asked.append(task.name)
        return made_up(task)

    monkeypatch.setattr(experiments, "run", counting)
    return asked


@pytest.fixture(scope="module")
def motions():
    return free_motions()


@pytest.fixture(scope="module")
def cells():
    return {task.name: made_up(task) for task in tasks(quick=False)}


@pytest.fixture(scope="module")
def figures(motions):
    return draw({task.name: made_up(task) for task in tasks(quick=True)}, motions)


def test_tasks_are_complete_and_have_names_of_their_own():
    found = list(tasks(quick=False))
    names = {task.name for task in found}
    assert len(names) == len(found)
    wanted = {(MAIN.key, case.key, method, dt) for case in CASES for method in METHODS for dt in cases.STEPS}
    for setting in (MAIN, *VARIATIONS):
        wanted |= {
            (setting.key, "0", method, dt) for method in (*METHODS, cases.FOURTH_ORDER, OPTIMUM) for dt in cases.STEPS
        }
    for strength in cases.NOISY_STRENGTHS:
        wanted |= {("noisy", f"2-{strength:g}", method, cases.NOISY_STEP) for method in (STOCHASTIC, PLAIN)}
    keys = {(task.setting.key, task.case.key if task.case else "0", task.method, task.dt) for task in found}
    assert keys == wanted
    assert names > {task.name for task in tasks(quick=True)}
    # Names are file names.
    assert all(re.fullmatch(r"[\w.-]+", name) for name in names)


def test_the_problem_is_the_papers():
    for dt in cases.STEPS:
        problem = cases.problem(MAIN, CASES[1], "variational", dt)
        assert problem.duration == pytest.approx(1.5, rel=1e-12)
        assert problem.dt == pytest.approx(dt, rel=5e-3)
    # At rest and held still: the cost is the integral of 10 |theta - theta_r|^2, and |theta - theta_r|^2 at the end.
    problem = cases.problem(MAIN, None, "variational", 1e-3)
    q, u = np.tile([1.0, 0.0, 0.0], (1501, 1)), np.full((1500, 3), 0.2)
    expected = 10.0 * 1.5 * (0.25**2 + 0.1**2) / 2.0 + 0.1 * 1.5 * 3.0 * 0.2**2
    assert problem.costs(q, np.zeros_like(q), u) == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(cases.reference(1.5), [1.0, 0.0, 0.0], atol=1e-12)


def test_a_coarse_cell_is_what_it_says():
    cell = run(Task(MAIN, CASES[1], "variational", COARSE))
    assert (cell.setting, cell.case, cell.method, cell.dt) == ("main", "2", "variational", COARSE)
    assert cell.status == "CONVERGED"
    assert cell.iterations <= 4
    assert cell.t.shape == (251,)
    assert cell.q.shape == (251, 3)
    assert cell.u.shape == (250, 3)
    assert cell.gains.shape == (47, 3, 6)
    assert np.isfinite(cell.gains).all()
    assert np.abs(cell.q - [cases.reference(t) for t in cell.t]).max() < 0.01
    assert 0.0 < cell.noise_cost < cell.cost < 1e-5
    assert cell.cost < cell.true_cost < 2.0 * cell.cost
    assert cell.accuracy < 1e-8
    mean, error = cell.sampled
    assert abs(mean - cell.cost - cell.noise_cost) < 4.0 * error


def test_nothing_beats_the_optimum_over_held_controls():
    best, own, other = (run(Task(MAIN, None, method, COARSEST)) for method in (OPTIMUM, "variational", "Euler"))
    assert best.cost == pytest.approx(best.true_cost, rel=1e-3)
    assert best.true_cost < own.true_cost < other.true_cost
    assert best.u.shape == own.u.shape == (75, 3)
    assert np.isnan(own.sampled).all()


def test_a_second_fill_computes_nothing(tmp_path, counted):
    seen = []
    first = fill(tmp_path, quick=True, progress=lambda done, cells, name: seen.append((done, cells, name)))
    names = [task.name for task in tasks(quick=True)]
    assert counted == list(first) == names
    assert seen == [(k, len(names), name) for k, name in enumerate(names)]
    second = fill(tmp_path, quick=True)
    assert counted == names
    for name in names:
        for item in dataclasses.fields(Cell):
            np.testing.assert_array_equal(getattr(first[name], item.name), getattr(second[name], item.name))
    (damaged, *_) = tmp_path.iterdir()
    damaged.write_bytes(damaged.read_bytes()[:-100])
    with refused(vp.FileError, damaged.name):
        fill(tmp_path, quick=True)


def test_claims_hold_where_the_paper_is_right_and_not_where_euler_is_better(cells, motions):
    right = assess(cells, motions)
    swapped = {}
    other = {"variational": "Euler", "Euler": "variational", STOCHASTIC: PLAIN, PLAIN: STOCHASTIC}
    for task in tasks(quick=False):
        twin = dataclasses.replace(task, method=other.get(task.method, task.method))
        swapped[task.name] = dataclasses.replace(cells[twin.name], method=task.method)
    wrong = assess(swapped, motions)
    assert len(right) == len(wrong) > 10
    sources = " ".join(claim.source for claim in right)
    for place in ("table 1 and figure 5, case 1", "figure 5b, case 2", "table 1, case 3", "figures 3a and 3b, case 2"):
        assert sources.count(place) == 1
    of_the_methods = {"table 1 and figure 5", "true cost is never above", "gains", "hinge", "Where noise matters"}
    of_the_methods |= {"figures 2a", "figures 3a", "figure 5b", "table 1, case 3"}
    for before, after in zip(right, wrong, strict=True):
        assert before.sentence == after.sentence
        if any(words in before.source + before.sentence for words in of_the_methods):
            assert before.verdict == "holds", before
            assert after.verdict != "holds", after


def test_report_has_every_figure_and_every_cell(tmp_path, cells, motions, figures):
    own = {task.name: cells[task.name] for task in tasks(quick=True)}
    assert list(figures) == FIGURES
    claim = Claim("nobody", "1 < 2 & <b>x</b>", "1, 2", "holds in part")
    write(tmp_path, own, [claim, *assess(own, motions)], figures)
    files = [*(f"{name}.png" for name in FIGURES), "claims.csv", "table1.csv"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(files)
    for name in FIGURES:
        picture = np.asarray(Image.open(tmp_path / f"{name}.png").convert("L"))
        assert picture.shape[1] > 900
        assert picture.std() > 5.0
    with (tmp_path / "table1.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(own)
    for row, cell in zip(rows, own.values(), strict=True):
        assert (row["setting"], row["case"], row["method"]) == (cell.setting, cell.case, cell.method)
        assert float(row["dt [s]"]) == cell.dt
        assert float(row["cost"]) == pytest.approx(cell.cost, rel=1e-6)
        assert np.isnan(float(row["true cost, with feedback"])) == (cell.method == "Euler")
    with (tmp_path / "claims.csv").open(newline="") as stream:
        claims = list(csv.DictReader(stream))
    assert list(claims[0].values()) == [claim.source, claim.sentence, claim.measured, claim.verdict]


@pytest.mark.slow
def test_quick_reproduction(tmp_path):
    folder = tmp_path / "paper"
    command = [sys.executable, str(Path(cases.__file__).parent), str(folder), "--quick"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=900)
    assert done.returncode == 0, done.stderr
    assert "holds" in done.stdout

    with (folder / "claims.csv").open(newline="") as stream:
        claims = list(csv.DictReader(stream))
    found = {(row["source"], row["sentence"]): row["verdict"] for row in claims}

    def verdict_of(words):
        (one,) = [value for key, value in found.items() if words in " ".join(key)]
        return one

    assert verdict_of("figure 1") == "holds"
    assert verdict_of("equivalent to the classic DDP") == "holds"
    assert verdict_of("table 1 and figure 5, case 1") == "holds"
    assert verdict_of("figure 5b, case 2") == "holds"
    assert verdict_of("table 1, case 3") == "does not hold"
    assert verdict_of("algorithm iterations") == "holds in part"
    assert verdict_of("gains, referred to the middle") == "not measured"
    assert verdict_of("true cost is never above Euler's") == "holds"

    kept = {path: path.stat().st_mtime_ns for path in (folder / "cells").iterdir()}
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert {path: path.stat().st_mtime_ns for path in (folder / "cells").iterdir()} == kept
    with (folder / "claims.csv").open(newline="") as stream:
        assert list(csv.DictReader(stream)) == claims
