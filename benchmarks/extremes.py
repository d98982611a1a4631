"""The battery of extreme scenes on every robot that goes by a name, and on random trees.

Keeps a record for each robot (pickle) in a folder; robots that are there already are not run again. Prints a table, and
exits with status 1 if anything is silent wrong.

    python benchmarks/extremes.py FOLDER             # some five hours of one core
    python benchmarks/extremes.py FOLDER --turns 6   # an hour: trees and larger robots take turns at the trials
    python benchmarks/extremes.py FOLDER ur5 tree17  # these alone
    python benchmarks/extremes.py FOLDER --scenes    # the scenes made up for it, to FOLDER/scenes.pickle: 20 minutes
    python benchmarks/extremes.py FOLDER --deep      # and the long ones: hours

``docs/limits.py`` makes a table of the record of scenes.
"""

import argparse
import logging
import pickle
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

import varpin as vp
from varpin.model import robot_names
from varpin.study.extremes import Kind, Record

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import battery  # noqa: E402
from mechanisms import random_tree  # noqa: E402

TREES = 200
RATIOS = (1e-4, 1e-2, 1.0, 1e2, 1e4)
# Robots of more joints than LARGE, whose motions take minutes, always take turns at the trials.
LARGE, TURNS = 20, 6
# A motion may take this long before it is judged by what there is [s].
PATIENCE = 1.0


def names() -> list[str]:
    """Every robot that goes by a name, and the random trees."""
    return [*robot_names(), *(f"tree{seed}" for seed in range(TREES))]


def robot_of(name: str) -> vp.Robot:
    """A robot by its name; ``tree7`` is the random tree of seed 7."""
    if not name.startswith("tree"):
        return vp.load_robot(name)
    seed = int(name.removeprefix("tree"))
    rng = np.random.default_rng([seed, TREES])
    joints, ratio = int(rng.integers(2, 9)), float(rng.choice(RATIOS))
    model = random_tree(seed, joints, branching=rng.random() < 0.8, armature=rng.random() < 0.5, ratio=ratio)
    return vp.load_robot(model)


def trials_of(name: str, robot: vp.Robot, turns: int = 1) -> list[battery.Trial]:
    """The battery, of which trees and robots of more than four joints may get each so many-th trial, by turns."""
    trials = battery.trials_on(robot)
    if robot.dof > LARGE:
        turns = max(turns, TURNS)
    elif robot.dof <= 4 and not name.startswith("tree"):
        turns = 1
    return trials[names().index(name) % turns :: turns]


def judged(chosen: Sequence[str], folder: Path, turns: int) -> Iterator[tuple[str, vp.Robot, Record | str]]:
    """Each robot, small ones first, with its record, or with the name of an earlier one that is the same mechanism."""
    robots = {name: robot_of(name) for name in chosen}
    seen: dict[tuple[bytes, ...], str] = {}
    begin = time.monotonic()
    for k, (name, robot) in enumerate(sorted(robots.items(), key=lambda item: item[1].dof)):
        same = seen.setdefault(tuple(np.asarray(part).tobytes() for part in robot.tree), name)
        if same != name:
            yield name, robot, same
            continue

        def tell(done: int, cells: int, place: str = f"{k + 1}/{len(robots)} {name}") -> None:
            text = f"{time.monotonic() - begin:6.0f} s  {place}  {done}/{cells}"
            sys.stderr.write(f"\r{text[:118]:118}")

        path = folder / f"{name}.pickle"
        if not path.exists():
            record = battery.run(trials_of(name, robot, turns), name=robot.name, patience=PATIENCE, progress=tell)
            path.write_bytes(pickle.dumps(record))
            sys.stderr.write("\r" + " " * 118 + "\r")
        yield name, robot, pickle.loads(path.read_bytes())


def table(results: Iterable[tuple[str, vp.Robot, Record | str]]) -> Iterator[str]:
    """A row for each robot; trees by their number of joints."""
    yield f"| robot | joints | cells | {' | '.join(kind.value for kind in Kind)} |"
    yield "|---" * (3 + len(Kind)) + "|"
    named, trees = [], {}
    for name, robot, record in results:
        if name.startswith("tree") and isinstance(record, Record):
            trees.setdefault(robot.dof, []).append(record)
        else:
            named.append((name, robot.dof, record))
    every = [record for _, _, record in named if isinstance(record, Record)]
    for name, joints, record in named:
        if isinstance(record, Record):
            yield _row(name, joints, [record])
        else:
            yield f"| {name} | {joints} | the same mechanism as {record} |" + " |" * len(Kind)
    for joints, records in sorted(trees.items()):
        yield _row(f"{len(records)} random trees", joints, records)
        every += records
    yield _row("all", "", every)


def _row(name: str, joints: int | str, records: Sequence[Record]) -> str:
    counts = [sum(record.counts()[kind] for record in records) for kind in Kind]
    return f"| {name} | {joints} | {sum(counts)} | {' | '.join(map(str, counts))} |"


def scenes(path: Path, *, deep: bool) -> int:
    """The record of the scenes, in a file; returns the exit status."""

    record = battery.run(battery.TRIALS, deep=deep, progress=lambda done, cells: sys.stderr.write(f"\r{done}/{cells}"))
    path.write_bytes(pickle.dumps(record))
    needless = sum(cell.kind is Kind.DEGRADED and not cell.found for cell in record.runs)
    print(f"\n{record}, {needless} warnings without need")
    for cell in record.wrong():
        print(f"  silent wrong: {cell.trial}, {cell.integrator}: {'; '.join(cell.found)}")
    return 1 if record.wrong() else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path, help="where the records are kept")
    parser.add_argument("robots", nargs="*", help="these alone in the page")
    parser.add_argument("--turns", type=int, default=1, metavar="K", help="trees and larger robots get each K-th trial")
    parser.add_argument("--scenes", action="store_true", help="the scenes made up for the battery, and no robots")
    parser.add_argument("--deep", action="store_true", help="the long scenes, too")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    logging.getLogger("varpin").setLevel(logging.CRITICAL)
    if options.scenes or options.deep:
        return scenes(options.folder / "scenes.pickle", deep=options.deep)
    results = []
    for name, robot, record in judged(options.robots or names(), options.folder, options.turns):
        results.append((name, robot, record))
        if isinstance(record, Record):
            print(f"{record}, {sum(cell.seconds for cell in record.runs):.0f} s", flush=True)
            for cell in record.wrong():
                print(f"  silent wrong: {cell.trial}, {cell.integrator}: {'; '.join(cell.found)}", flush=True)
    lines = list(table(results))
    print("\n".join(lines))
    records = [record for _, _, record in results if isinstance(record, Record)]
    return 1 if any(record.wrong() for record in records) else 0


if __name__ == "__main__":
    sys.exit(main())
