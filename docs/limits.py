"""The table of other simulators of docs/limits.md, from a record of the battery of scenes.

    python benchmarks/extremes.py FOLDER --scenes
    python docs/limits.py FOLDER/scenes.pickle

Other simulators take part where they are installed (``pip install "varpin[peers]"``; trep has no release for Python 3).
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.study.checks import LEVELS
from varpin.study.extremes import Cell, Kind, Record

DOCUMENT = Path(__file__).resolve().parent / "limits.md"
sys.path[:0] = [str(DOCUMENT.parents[1] / name) for name in ("benchmarks", "tests")]
import peers  # noqa: E402
from battery import TRIALS, Bench  # noqa: E402
from pages import fill  # noqa: E402

OWN = {"Midpoint": "Midpoint(alpha=0.5)", "Gauss(4)": "Gauss(stages=4)", "RungeKutta4": "RungeKutta4"}
MOTIONS: dict[str, Callable[[peers.Case, float], peers.Motion | None]] = {
    "MuJoCo Euler": partial(peers.mujoco_motion, integrator="Euler"),
    "MuJoCo RK4": partial(peers.mujoco_motion, integrator="RK4"),
    "Drake, discrete": peers.drake_motion,
    "Drake RK3, 1e-4": partial(peers.drake_motion, scheme="runge_kutta3"),
    "trep midpoint": peers.trep_motion,
}
# What others are asked to do as well: chains that all describe alike.
SHARED = (
    "3 links, dt = 0.01 s",
    "3 links, dt = 0.05 s",
    "1000 rad/s, dt = 0.001 s",
    "20 links, tip 1e+06 of base",
    "spring, h omega = 10",
)


def main() -> None:
    """Rewrite the table."""
    if len(sys.argv) != 2:
        raise SystemExit("usage: limits.py RECORD")
    record: Record = pickle.loads(Path(sys.argv[1]).read_bytes())
    missing = [name for name in ("mujoco", "pydrake", "trep") if peers.available(name) is None]
    if missing:
        sys.stderr.write(f"not installed: {', '.join(missing)}; the table of the others stays as it is\n")
    else:
        fill(DOCUMENT, {"peers": "\n".join(peers_table(record))})


def peers_table(record: Record) -> Iterator[str]:
    """A row for each shared scene: varpin's integrators, and what others make of it and say."""
    cells = {(cell.trial, cell.integrator): cell for cell in record.runs}
    rows: dict[str, dict[str, str]] = {}
    for trial in TRIALS:
        if trial.name in SHARED:
            sys.stderr.write(f"{trial.name}\n")
            bench = trial.build()
            own = {name: in_varpin(cells[trial.name, text], bench) for name, text in OWN.items()}
            rows[trial.name] = own | {name: in_words(bench, motion) for name, motion in MOTIONS.items()}
    names = [name for name in next(iter(rows.values())) if any(row[name] for row in rows.values())]
    yield f"| scene | {' | '.join(names)} |"
    yield "|---" * (1 + len(names)) + "|"
    for scene, row in rows.items():
        yield f"| {scene} | {' | '.join(row[name] for name in names)} |"


def in_varpin(cell: Cell, bench: Bench) -> str:
    """A cell in words."""
    if cell.kind is Kind.REFUSED:
        return "refused"
    if cell.kind is Kind.STOPPED:
        return f"stops at {cell.done * bench.dt:.2g} s"
    return outcome(cell.error, cell.energy, "told" if cell.kind is Kind.DEGRADED else "")


def outcome(error: float, energy: float, said: str) -> str:
    """Errors and what was said of them; in bold where a wrong motion comes without a word."""
    wrong = not (error < LEVELS["error"] and energy < LEVELS["energy"])
    text = f"{error:.0e}" + ("" if energy < LEVELS["energy"] else f", energy {energy:.0e}")
    return f"{text}, {said}" if said else f"**{text}**" if wrong else text


def in_words(bench: Bench, motion: Callable[[peers.Case, float], peers.Motion | None]) -> str:
    """Error of another simulator's motion from the exact one, its energy error, and what it says."""
    scene = bench.scene
    case = peers.Case(bench.name, scene, bench.q0, bench.v0, np.zeros(scene.controls), bench.dt * bench.steps)
    try:
        found = motion(case, bench.dt)
    except (ValueError, RuntimeError) as error:
        # The mechanism itself is refused, each library in its own words.
        sys.stderr.write(f"  refused: {str(error).splitlines()[0]}\n")
        return "refused"
    if found is None:
        return ""
    if found.said.startswith(("set back", "gives up")):
        return found.said
    q, v = found.q, found.v
    if not (np.isfinite(q).all() and np.isfinite(v).all()):
        first = int(np.argmin(np.isfinite(q).all(axis=1) & np.isfinite(v).all(axis=1)))
        return f"**not finite from {first * bench.dt:.2g} s**"
    exact = bench.exact()
    known = exact.nodes < len(q)
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(q[exact.nodes[known]] - exact.q[known]).max(initial=0.0) / exact.travel
        at = np.unique(np.linspace(0, len(q) - 1, 200).astype(int))
        jets = [lagrangian_jet(scene, q[k], v[k]) for k in at]
        kinetic = np.array([0.5 * v[k] @ jet.Lv for k, jet in zip(at, jets, strict=True)])
        total = 2.0 * kinetic - np.array([jet.L for jet in jets])
        energy = np.nan_to_num(np.abs(total - total[0]).max() / max(kinetic.max(), np.finfo(float).tiny), nan=np.inf)
    return outcome(float(error), float(energy), found.said)


if __name__ == "__main__":
    main()
