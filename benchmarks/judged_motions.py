"""What the check of ``vp.simulate`` says of hundreds of random motions, held against their true ones.

    python benchmarks/judged_motions.py --count 400 --seed 0 --cache FOLDER

The motions are those of tests/random_motions.py, and true ones are kept in the folder.
"""

import argparse
import hashlib
import logging
import sys
import timeit
from pathlib import Path

import numpy as np

import varpin as vp

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from oracles import Mechanism
from random_motions import KINDS, Case, Truth, Verdict, draw, judge, truth

COLUMNS = ("failed", "unknown", "off", "untold", "off 1%", "untold 1%", "right", "told", "loop")
LEVELS = (0.025, 0.05, 0.5, 0.95, 0.975)


def known(case: Case, cache: Path | None = None) -> Truth | None:
    """The true motion, from a folder of those that were integrated before."""
    if cache is None:
        return truth(case)
    given, q0, v0 = case.controls, case.q0, case.v0
    now = given.f(case.dt) if isinstance(given, vp.OpenLoop) else given(0.0, q0, v0) if callable(given) else given
    acting = Mechanism(case.scene).forces(q0, v0, v0)
    probe = [q0, v0, case.dt, case.steps, *acting, 0.0 if now is None else now]
    key = hashlib.sha1(np.round(np.concatenate(probe, axis=None), 9).tobytes()).hexdigest()[:12]
    file = cache / f"{case.seed}_{key}.npz"
    if not file.exists():
        found = truth(case)
        cache.mkdir(parents=True, exist_ok=True)
        np.savez(file, **({} if found is None else {"states": found[0], "doubt": found[1]}))
    stored = np.load(file)
    return (stored["states"], stored["doubt"]) if stored.files else None


def verdict_of(seed: int, cache: Path | None = None) -> tuple[Case, Verdict]:
    case = draw(seed)
    try:
        motion = case.simulate()
        runs = [timeit.repeat(lambda on=on: case.simulate(on), number=1, repeat=2) for on in (False, True)]
    except vp.StepFailure as error:
        return case, Verdict(frozenset({"failed"}), (str(error),))
    return case, judge(case, motion, known(case, cache))._replace(seconds=tuple(map(min, runs)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, kind, start in (("count", int, 400), ("seed", int, 0), ("only", int, None), ("cache", Path, None)):
        parser.add_argument(f"--{name}", type=kind, default=start)
    asked = parser.parse_args()
    logging.disable(logging.CRITICAL)
    seeds = range(asked.seed, asked.seed + asked.count) if asked.only is None else [asked.only]
    found = [verdict_of(seed, asked.cache) for seed in seeds]
    heads = ("n", *COLUMNS, *map("{:.3g}".format, LEVELS), "in 2", "time")
    out = ["kind     " + "".join(f"{name:>10s}" for name in heads)]
    for kind in (*KINDS, "all"):
        own = [verdict for case, verdict in found if kind in (case.kind, "all")]
        factors = np.array([one.factor for one in own if np.isfinite(one.factor)] or [np.nan])
        bare, checked = np.sum([one.seconds for one in own], axis=0) if own else (1.0, np.nan)
        numbers = [len(own), *(sum(name in one.labels for one in own) for name in COLUMNS)]
        numbers += [*np.quantile(factors, LEVELS), np.mean(np.abs(np.log2(factors)) <= 1.0), checked / bare]
        out.append(f"{kind:9s}" + "".join(f"{number:10.3g}" for number in numbers))
    for name in ("untold", "told", "unknown", "failed") if asked.only is None else found[0][1].labels:
        lines = [f"{case}: {own}" for case, own in found if name in own.labels]
        out += [f"\n{name}: {len(lines)}", *lines]
    sys.stdout.write("\n".join([*out, ""]))


if __name__ == "__main__":
    main()
