"""CSV and PNG of a reproduction."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from paper.claims import Cells, Claim
from paper.experiments import Cell
from varpin.io.archive import atomic_file
from varpin.support.tables import csv_text

_COLUMNS: dict[str, Callable[[Cell], str]] = {
    "setting": lambda c: c.setting,
    "case": lambda c: c.case,
    "method": lambda c: c.method,
    "dt [s]": lambda c: f"{c.dt:g}",
    "cost": lambda c: f"{c.cost:.6e}",
    "noise cost": lambda c: f"{c.noise_cost:.4e}",
    "iterations": lambda c: str(c.iterations),
    "status": lambda c: c.status,
    "time [s]": lambda c: f"{c.seconds:.4g}",
    "true cost, open loop": lambda c: f"{c.open_loop:.6e}",
    "true cost, with feedback": lambda c: f"{c.closed_loop:.6e}",
    "accuracy of true cost": lambda c: f"{c.accuracy:.1e}",
    "Monte Carlo cost": lambda c: f"{c.sampled[0]:.5e}",
    "its standard error": lambda c: f"{c.sampled[1]:.1e}",
}


def write(folder: Path, cells: Cells, claims: Sequence[Claim], figures: Mapping[str, tuple[Figure, str]]) -> None:
    """Write the figures, every cell and every claim.

    Raises:
        FileError: The folder cannot be written.
    """
    for name, (figure, _) in figures.items():
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=110)
        _write(folder / f"{name}.png", stream.getvalue())
    rows = ([column(cell) for column in _COLUMNS.values()] for cell in cells.values())
    _write(folder / "table1.csv", csv_text(_COLUMNS, rows).encode())
    rows = ([claim.source, claim.sentence, claim.measured, claim.verdict] for claim in claims)
    _write(folder / "claims.csv", csv_text(("source", "sentence", "measured", "verdict"), rows).encode())


def _write(path: Path, data: bytes) -> None:
    with atomic_file(path) as stream:
        stream.write(data)
