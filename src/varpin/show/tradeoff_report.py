"""A measured trade, or an advice, as files: a table (CSV), a figure (PNG) and one page (HTML) that holds both."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure, SubFigure

from varpin._version import __version__
from varpin.show.plots import plot_advice, plot_work_precision
from varpin.study.tradeoff import Advice, WorkPrecision, WorkPrecisionRun
from varpin.study.tradeoff.advice import Choice
from varpin.trajectory import atomic_file

# Heading and text of a run in the table.
COLUMNS = ("integrator", "dt [s]", "wall time [s]", "error in q", "energy error [J]", "end effector [m]", "note")
ADVICE_COLUMNS = ("integrator", "dt [s]", "steps", "predicted time [s]", "predicted error in q", "note")

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
        image = _write_image(figure, plot_work_precision(record)[0])
    with atomic_file(page) as file:
        file.write(_page(record, title, image).encode())
    return [path for path in (table, figure, page) if path != figure or image]


def write_advice(folder: Path, advice: Advice, title: str) -> list[Path]:
    """Write ``advice.png`` and ``advice.html`` into a folder that is there; their paths.

    The figure is left out where no choice has a known error.

    Raises:
        FileError: A file cannot be written.
    """
    figure, page = (folder / f"advice.{kind}" for kind in ("png", "html"))
    choices = advice.best, *advice.alternatives
    image = b""
    if any(math.isfinite(choice.error) and choice.error > 0.0 for choice in choices):
        image = _write_image(figure, plot_advice(advice)[0])
    rows = [(advice_cells(choice), choice is advice.best and advice.reached) for choice in choices]
    said = "</p><p>".join(html.escape(line) for line in advice.reason.splitlines())
    text = f"""{said}</p>
<p>varpin {__version__}. Times are predicted for this machine, on one thread, without the look at the finished
motion."""
    with atomic_file(page) as file:
        file.write(_document(title, text, "predicted error over time", image, ADVICE_COLUMNS, rows).encode())
    return [path for path in (figure, page) if path != figure or image]


def advice_cells(choice: Choice) -> tuple[str, ...]:
    """A choice as the entries of :data:`ADVICE_COLUMNS`."""
    error = f"{choice.error:.2e}" if math.isfinite(choice.error) else "unknown"
    note = "" if choice.measured else "by the method's order"
    return str(choice.integrator), f"{choice.dt:.4g}", str(choice.steps), f"{choice.seconds:.2e}", error, note


def _write_image(path: Path, figure: Figure | SubFigure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=150)  # type: ignore[union-attr]
    with atomic_file(path) as file:
        file.write(stream.getvalue())
    return stream.getvalue()


def _page(record: WorkPrecision, title: str, image: bytes) -> str:
    front = record.pareto()
    missing = f" An interruption left out {record.missing} runs." if record.missing else ""
    text = f"""varpin {__version__}. Wall times are of one machine and one run, on one thread. Errors in q are the
largest over the joints and {record.samples} times [rad or m], against {html.escape(record.reference)}, which differs
from the same at a ten times looser tolerance by {record.reference_error:.1e}. Nothing beats the runs on green in both
time and error.{missing}"""
    rows = [(cells(record, run, run in front), run in front) for run in record.runs]
    return _document(title, text, "error over time", image, COLUMNS, rows)


def _document(
    title: str,
    text: str,
    caption: str,
    image: bytes,
    columns: Sequence[str],
    rows: Sequence[tuple[tuple[str, ...], bool]],
) -> str:
    """A page of a paragraph, which is markup, a picture and a table, some of whose rows stand out."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    body = "".join(_row(entries, marked) for entries, marked in rows)
    picture = f'<img alt="{caption}" src="data:image/png;base64,{base64.b64encode(image).decode()}">' if image else ""
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>
<h1>{html.escape(title)}</h1>
<p>{text}</p>
{picture}
<table><tr>{head}</tr>{body}</table>
</body></html>
"""


def _row(entries: tuple[str, ...], front: bool) -> str:
    first, *numbers, last = (html.escape(entry) for entry in entries)
    inner = "".join(f"<td>{number}</td>" for number in numbers)
    return f'<tr{" class=front" if front else ""}><td class="text">{first}</td>{inner}<td class="text">{last}</td></tr>'
