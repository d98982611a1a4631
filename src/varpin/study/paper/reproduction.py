"""Everything together: cells, claims, figures, report."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from varpin.study.paper.claims import Claim, assess, free_motions
from varpin.study.paper.experiments import Progress, Store, fill
from varpin.study.paper.figures import draw
from varpin.study.paper.report import write
from varpin.support.checks import path_like


@dataclass(frozen=True)
class Reproduction:
    """What was written.

    Attributes:
        page: The HTML report.
        claims: Each sentence with its verdict.
    """

    page: Path
    claims: tuple[Claim, ...]


def reproduce(folder: str | os.PathLike[str], *, quick: bool = False, progress: Progress | None = None) -> Reproduction:
    """Run the paper's experiments and write PNG, CSV and one HTML report.

    What an earlier run left in the folder is not computed again; Ctrl-C loses one cell at most.

    Args:
        folder: Where to write; made if it is not there.
        quick: Four time steps and the main setting alone.
        progress: Called with (cells done, cells in all, the next one's name).

    Raises:
        FileError: The folder cannot be made or written.
    """
    target = path_like("folder", folder)
    cells = fill(Store(target / "cells"), quick=quick, progress=progress)
    motions = free_motions()
    claims = assess(cells, motions)
    page = write(target, cells, claims, draw(cells, motions), quick=quick)
    return Reproduction(page, tuple(claims))
