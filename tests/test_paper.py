"""The paper's experiments: its problem, cells of it; all of it, slowly, by the command line."""

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from paper import cases
from paper.cases import CASES, COARSE, COARSEST, MAIN
from paper.experiments import OPTIMUM, Task, run


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
    assert (cell.q.shape, cell.u.shape, cell.gains.shape) == ((251, 3), (250, 3), (47, 3, 6))
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

    right = ("figure 1", "equivalent to the classic DDP", "table 1 and figure 5, case 1", "figure 5b, case 2")
    assert {verdict_of(words) for words in (*right, "true cost is never above Euler's")} == {"holds"}
    assert verdict_of("table 1, case 3") == "does not hold"
    assert verdict_of("algorithm iterations") == "holds in part"
    assert verdict_of("gains, referred to the middle") == "not measured"
    assert len([*folder.glob("*.png")]) == 7

    kept = {path: path.stat().st_mtime_ns for path in (folder / "cells").iterdir()}
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert {path: path.stat().st_mtime_ns for path in (folder / "cells").iterdir()} == kept
    with (folder / "claims.csv").open(newline="") as stream:
        assert list(csv.DictReader(stream)) == claims
