"""A measured trade as files: a table (CSV), a figure (PNG) and one page (HTML) that holds both."""

from __future__ import annotations

import base64
import html
import io
import math
from pathlib import Path

from varpin._version import __version__
from varpin.plots import plot_work_precision
from varpin.tradeoff import WorkPrecision, WorkPrecisionRun
from varpin.trajectory import atomic_file

# Heading and text of a run in the table.
COLUMNS = ("integrator", "dt [s]", "wall time [s]", "error in q", "energy error [J]", "end effector [m]", "note")

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 0.85rem; }
td, th { border: 1px solid #ccc; padding: 0.25rem 0.6rem; text-align: right; vertical-align: top; }
td.text, th { text-align: left; }
tr.front { background: #dff2e1; }
img { max-width: 100%; }
"""


def cells(record: WorkPrecision, run: WorkPrecisionRun, front: bool) -> tuple[str, ...]:
    """A run as the entries of :data:`COLUMNS`; ``front`` says whether nothing beats it."""
    notes = []
    if front:
        notes.append("Pareto")
    if record.at_floor(run):
        notes.append("at the reference's floor")
    if run.split_steps:
        notes.append(f"{run.split_steps} steps split")
    if run.failure:
        notes.append(f"failed: {run.failure}")
    numbers = run.seconds, record.error_of(run), run.energy_error, run.tip_error
    texts = ("" if math.isnan(number) else f"{number:.2e}" for number in numbers)
    return run.integrator, f"{run.dt:.4g}", *texts, "; ".join(notes)


def write_report(folder: Path, record: WorkPrecision, title: str) -> list[Path]:
    """Write ``tradeoff.csv``, ``tradeoff.png`` and ``tradeoff.html`` into a folder that is there; their paths.

    The figure is left out where no run has an error.

    Raises:
        FileError: A file cannot be written.
    """
    table, figure, page = (folder / f"tradeoff.{kind}" for kind in ("csv", "png", "html"))
    record.to_csv(table)
    image = b""
    if record.pareto():
        stream = io.BytesIO()
        drawing, _ = plot_work_precision(record)
        drawing.savefig(stream, format="png", dpi=150)  # type: ignore[union-attr]
        image = stream.getvalue()
        with atomic_file(figure) as file:
            file.write(image)
    with atomic_file(page) as file:
        file.write(_page(record, title, image).encode())
    return [path for path in (table, figure, page) if path != figure or image]


def _page(record: WorkPrecision, title: str, image: bytes) -> str:
    front = record.pareto()
    rows = "".join(_row(cells(record, run, run in front), run in front) for run in record.runs)
    head = "".join(f"<th>{html.escape(name)}</th>" for name in COLUMNS)
    picture = f'<img alt="error over time" src="data:image/png;base64,{base64.b64encode(image).decode()}">'
    missing = f" An interruption left out {record.missing} runs." if record.missing else ""
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>
<h1>{html.escape(title)}</h1>
<p>varpin {__version__}. Wall times are of one machine and one run, on one thread. Errors in q are the largest over the
joints and {record.samples} times [rad or m], against {html.escape(record.reference)}, which differs from the same at a
ten times looser tolerance by {record.reference_error:.1e}. Nothing beats the runs on green in both time and
error.{missing}</p>
{picture if image else ""}
<table><tr>{head}</tr>{rows}</table>
</body></html>
"""


def _row(entries: tuple[str, ...], front: bool) -> str:
    first, *numbers, last = (html.escape(entry) for entry in entries)
    inner = "".join(f"<td>{number}</td>" for number in numbers)
    return f'<tr{" class=front" if front else ""}><td class="text">{first}</td>{inner}<td class="text">{last}</td></tr>'
