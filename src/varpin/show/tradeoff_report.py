"""Work-precision records and advice as files: a table (CSV), a figure (PNG) and a page (HTML) with both."""

from __future__ import annotations

import html
import io
import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure, SubFigure

from varpin._version import __version__
from varpin.io.archive import atomic_file
from varpin.show.plots import plot_advice, plot_work_precision
from varpin.study.tradeoff import Advice, WorkPrecision, WorkPrecisionRun
from varpin.study.tradeoff.advice import COLUMNS as _ADVICE_COLUMNS
from varpin.support.markup import page, picture

# Columns of the table of runs.
COLUMNS = ("integrator", "dt [s]", "wall time [s]", "error in q", "energy error [J]", "end effector [m]", "note")

_STYLE = "tr.front { background: #dff2e1; }"


def cells(record: WorkPrecision, run: WorkPrecisionRun, front: bool) -> tuple[str, ...]:
    """A run as entries of :data:`COLUMNS`; ``front`` tells whether it is on the Pareto front."""
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
    """Write ``tradeoff.csv``, ``tradeoff.png`` and ``tradeoff.html`` into an existing folder; returns their paths.

    The figure is left out where no run has an error.

    Raises:
        FileError: A file cannot be written.
    """
    table, figure, document = (folder / f"tradeoff.{kind}" for kind in ("csv", "png", "html"))
    record.to_csv(table)
    image = b""
    if record.pareto():
        image = _write_image(figure, plot_work_precision(record)[0])
    with atomic_file(document) as file:
        file.write(_page(record, title, image).encode())
    return [path for path in (table, figure, document) if path != figure or image]


def write_advice(folder: Path, advice: Advice, title: str) -> list[Path]:
    """Write ``advice.png`` and ``advice.html`` into an existing folder; returns their paths.

    The figure is left out where no choice has a known error.

    Raises:
        FileError: A file cannot be written.
    """
    figure, document = (folder / f"advice.{kind}" for kind in ("png", "html"))
    choices = advice.best, *advice.alternatives
    image = b""
    if any(math.isfinite(choice.error) and choice.error > 0.0 for choice in choices):
        image = _write_image(figure, plot_advice(advice)[0])
    rows = [(choice.cells(), choice is advice.best and advice.reached) for choice in choices]
    reason = "</p><p>".join(html.escape(line) for line in advice.reason.splitlines())
    text = f"""{reason}</p>
<p>varpin {__version__}. Times are predicted for this machine, on one thread, without the checks of the finished
motion."""
    with atomic_file(document) as file:
        file.write(_document(title, text, "predicted error over time", image, _ADVICE_COLUMNS, rows).encode())
    return [path for path in (figure, document) if path != figure or image]


def _write_image(path: Path, figure: Figure | SubFigure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=150)  # type: ignore[union-attr]
    with atomic_file(path) as file:
        file.write(stream.getvalue())
    return stream.getvalue()


def _page(record: WorkPrecision, title: str, image: bytes) -> str:
    front = record.pareto()
    missing = f" An interruption left out {record.missing} runs." if record.missing else ""
    text = f"""varpin {__version__}. Wall times were measured once, on one machine and one thread. Errors in q are the
largest over the joints and {record.samples} times [rad or m], against {html.escape(record.reference)}, which differs
from the same at a ten times looser tolerance by {record.reference_error:.1e}. Runs on green are on the Pareto front: no
other run has both a smaller time and a smaller error.{missing}"""
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
    """A page with a paragraph ``text`` (HTML), a picture, and a table of (entries, whether the row is marked)."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    body = "".join(_row(entries, marked) for entries, marked in rows)
    figure = picture(image, caption) if image else ""
    return page(title, f"<p>{text}</p>\n{figure}\n<table><tr>{head}</tr>{body}</table>", _STYLE)


def _row(entries: tuple[str, ...], front: bool) -> str:
    first, *numbers, last = (html.escape(entry) for entry in entries)
    inner = "".join(f"<td>{number}</td>" for number in numbers)
    return f'<tr{" class=front" if front else ""}><td class="text">{first}</td>{inner}<td class="text">{last}</td></tr>'
