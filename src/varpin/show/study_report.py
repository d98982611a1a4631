"""Studies as files: a table (CSV), a figure (PNG) and a page (HTML)."""

from __future__ import annotations

import html
import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from varpin._version import __version__
from varpin.errors import InputError
from varpin.io.archive import atomic_file
from varpin.show.plots import plot_advice, plot_optimal_control_tradeoff, plot_work_precision
from varpin.study.extremes import Cell, Kind, Record
from varpin.study.record import Study
from varpin.support.markup import page, picture

# The figure of a study, by its class.
_FIGURES: dict[str, Callable[..., Any]] = {
    "WorkPrecision": plot_work_precision,
    "Advice": plot_advice,
    "OptimalControlTradeoff": plot_optimal_control_tradeoff,
}
MEANING = {
    Kind.ACCURATE: "every check passes",
    Kind.DEGRADED: "varpin warns that the result is inaccurate",
    Kind.REFUSED: "a named error before the first step",
    Kind.STOPPED: "a named error during the run; the motion up to there is kept",
    Kind.WRONG: "a check fails, and varpin gives no warning",
}
# Errors from which on the green of an accurate motion is paler.
_PALER = (1e-6, 1e-2)
_STYLE = """
tr.front { background: #dff2e1; }
body:has(.map) { max-width: 88rem; }
.map { font-size: 0.78rem; }
.map td { border: 1px solid #fff; padding: 0.15rem 0.4rem; white-space: nowrap; }
.accurate0 { background: #6fc3a4; } .accurate1 { background: #9ad5bf; } .accurate2 { background: #c4e7da; }
.degraded { background: #f6dc8b; } .refused { background: #b9d9ee; } .stopped { background: #e3c4d8; }
.wrong { background: #c8102e; color: #fff; font-weight: 700; }
"""


def write_report(folder: Path, name: str, study: Study[Any], title: str) -> list[Path]:
    """Write ``name.csv``, ``name.png`` and ``name.html`` into an existing folder; returns their paths.

    The figure is left out if the study has none, or no run has the numbers for it.

    Raises:
        FileError: A file cannot be written.
    """
    table, figure, document = (folder / f"{name}.{kind}" for kind in ("csv", "png", "html"))
    files = {table: b"", figure: _image(study), document: b""}
    study.to_csv(table)
    missing = (f"an interruption left out {study.missing} runs",) if study.missing else ()
    notes = [*study.notes, *study.failures, *missing, f"measured with varpin {__version__}"]
    body = f"<ul>{''.join(f'<li>{html.escape(note)}</li>' for note in notes)}</ul>"
    if files[figure]:
        body += picture(files[figure], title)
    body += _map(study) if isinstance(study, Record) else _table(study)
    files[document] = page(title, body, _STYLE).encode()
    for path, content in files.items():
        if content:
            with atomic_file(path) as stream:
                stream.write(content)
    return [path for path in files if path == table or files[path]]


def _image(study: Study[Any]) -> bytes:
    """The figure as PNG; empty if there is none."""
    draw, stream = _FIGURES.get(type(study).__name__), io.BytesIO()
    if draw is not None:
        try:
            draw(study)[0].savefig(stream, format="png", dpi=150)
        except InputError:  # no run has the numbers
            return b""
    return stream.getvalue()


def _table(study: Study[Any]) -> str:
    front = study.pareto()
    head = "".join(f"<th>{html.escape(name)}</th>" for name in study.columns())
    rows = "".join(_row(study.row(run), marked=run in front) for run in study.runs)
    return f"<table><tr>{head}</tr>{rows}</table>"


def _row(entries: tuple[str, ...], *, marked: bool) -> str:
    first, *numbers, last = map(html.escape, entries)
    inner = "".join(f"<td>{number}</td>" for number in numbers)
    return (
        f'<tr{" class=front" if marked else ""}><td class="text">{first}</td>{inner}<td class="text">{last}</td></tr>'
    )


def _map(record: Record) -> str:
    """Motions by integrators, in colours."""
    counts = record.counts()
    legend = "".join(
        f'<tr><td class="{_class(kind, math.nan)}">{kind.letter}</td><td>{counts[kind]}</td>'
        f'<td class="text">{kind.value}: {text}</td></tr>'
        for kind, text in MEANING.items()
    )
    columns, rows = grid(record)
    head = "".join(
        f"<th>{html.escape(name).replace('(', '<br>(').replace('Euler', '<br>Euler')}</th>" for name in columns
    )
    lines = "".join(
        f'<tr><td class="text">{html.escape(name)}</td>{"".join(map(_box, cells))}</tr>' for name, cells in rows.items()
    )
    return (
        f"<table>{legend}</table><p>Point at a cell for its checks.</p>"
        f'<table class="map"><tr><th>motion</th>{head}</tr>{lines}</table>'
    )


def grid(record: Record) -> tuple[list[str], dict[str, list[Cell | None]]]:
    """The integrators, and the cells of each motion by integrator."""
    columns = list(dict.fromkeys(cell.integrator for cell in record.runs))
    rows: dict[str, list[Cell | None]] = {cell.trial: [None] * len(columns) for cell in record.runs}
    for cell in record.runs:
        rows[cell.trial][columns.index(cell.integrator)] = cell
    return columns, rows


def _box(cell: Cell | None) -> str:
    if cell is None:
        return "<td></td>"
    known = {name: value for name, value in cell.measures().items() if not math.isnan(value)}
    lines = [f"{cell.kind.value}; {cell.done} of {cell.steps} steps, {cell.seconds:.2g} s"]
    lines += [", ".join(f"{name} {value:.2g}" for name, value in known.items()), *cell.found, *cell.said]
    tip = html.escape("\n".join(filter(None, lines)), quote=True)
    return f'<td class="{_class(cell.kind, cell.error)}" title="{tip}">{html.escape(str(cell))}</td>'


def _class(kind: Kind, error: float) -> str:
    if kind is Kind.ACCURATE:
        return f"accurate{sum(error > pale for pale in _PALER)}"
    return "wrong" if kind is Kind.WRONG else str(kind.value)
