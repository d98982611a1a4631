"""Run the paper's experiments: python benchmarks/paper FOLDER [--quick].

Tables (CSV) and figures (PNG) go to the folder. What an earlier run left there is not computed again; Ctrl-C loses one
cell at most. ``--quick`` takes four time steps and the main setting alone, in about a minute.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from paper.claims import Claim, assess, free_motions
from paper.experiments import fill
from paper.figures import draw
from paper.report import write


def reproduce(folder: Path, *, quick: bool = False) -> list[Claim]:
    """Run the experiments, write everything, and return each sentence with its verdict."""
    cells = fill(folder / "cells", quick=quick, progress=lambda done, of, name: print(f"{done}/{of} {name}"))
    motions = free_motions()
    claims = assess(cells, motions)
    write(folder, cells, claims, draw(cells, motions))
    return list(claims)


def main() -> None:
    """Print the verdicts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--quick", action="store_true")
    request = parser.parse_args()
    for claim in reproduce(request.folder, quick=request.quick):
        print(f"{claim.verdict:14} {claim.sentence} ({claim.measured})")


if __name__ == "__main__":
    main()
