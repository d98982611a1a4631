"""Results of ``check_robot`` as an HTML page: a heat map of motions and integrators, without scripts."""

from __future__ import annotations

import html
import math
import os
from pathlib import Path

from varpin.io.archive import atomic_file
from varpin.study.extremes import Cell, Kind, Record
from varpin.study.extremes.record import LEVELS
from varpin.support.checks import writable
from varpin.support.markup import page

# Letter and terminal style of each kind of result.
LETTERS = {Kind.ACCURATE: "A", Kind.DEGRADED: "D", Kind.REFUSED: "R", Kind.STOPPED: "S", Kind.WRONG: "W"}
STYLES = {
    Kind.ACCURATE: "green",
    Kind.DEGRADED: "yellow",
    Kind.REFUSED: "cyan",
    Kind.STOPPED: "magenta",
    Kind.WRONG: "bold white on red",
}
_MEANING = {
    Kind.ACCURATE: "every check passes; the number is the error, in units of the motion",
    Kind.DEGRADED: "varpin warns that the result is inaccurate; the number is the error",
    Kind.REFUSED: "a named error before the first step",
    Kind.STOPPED: "a named error during the run; the motion up to there is kept",
    Kind.WRONG: "a check fails, and varpin gives no warning",
}
_STYLE = """
body { font-size: 15px; max-width: 88rem; }
table { font-size: 0.78rem; }
th { border: 0; font-weight: 600; padding: 0.15rem 0.5rem; }
thead th { position: sticky; top: 0; background: #fff; font-size: 0.72rem; vertical-align: bottom; }
td { border: 1px solid #fff; padding: 0.15rem 0.4rem; min-width: 4.2rem; text-align: right; white-space: nowrap; }
td.name { text-align: left; }
.accurate0 { background: #6fc3a4; } .accurate1 { background: #9ad5bf; } .accurate2 { background: #c4e7da; }
.degraded { background: #f6dc8b; } .refused { background: #b9d9ee; } .stopped { background: #e3c4d8; }
.wrong { background: #c8102e; color: #fff; font-weight: 700; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.2rem 0.8rem; }
dt { padding: 0 0.5rem; } dd { margin: 0; }
"""


def entry(cell: Cell) -> str:
    """Short text of a cell: its letter with the error, or with the number of steps done."""
    if cell.kind is Kind.STOPPED:
        return f"S {cell.done}/{cell.steps}"
    if cell.kind is Kind.REFUSED:
        return "R"
    # The error of the energy, where no exact motion is known.
    known = (
        f" {cell.error:.0e}"
        if not math.isnan(cell.error)
        else ""
        if math.isnan(cell.energy)
        else f" E {cell.energy:.0e}"
    )
    return LETTERS[cell.kind] + known + ("" if cell.done == cell.steps else f" {cell.done}/{cell.steps}")


def grid(record: Record) -> tuple[list[str], dict[str, dict[str, Cell]]]:
    """The integrators, and the cells of each motion by integrator."""
    rows: dict[str, dict[str, Cell]] = {}
    for cell in record.cells:
        rows.setdefault(cell.trial, {})[cell.integrator] = cell
    return list(dict.fromkeys(cell.integrator for cell in record.cells)), rows


def write_page(path: str | os.PathLike[str], record: Record) -> Path:
    """Write the heat map; returns its path.

    Raises:
        FileError: The path cannot be written.
    """
    target = writable(path)
    with atomic_file(target) as stream:
        stream.write(_page(record).encode())
    return Path(path)


def _page(record: Record) -> str:
    (columns, rows), counts = grid(record), record.counts()
    legend = "".join(
        f'<dt class="{_class(kind, math.nan)}">{LETTERS[kind]} {kind.value}: {counts[kind]}</dt><dd>{text}</dd>'
        for kind, text in _MEANING.items()
    )
    head = "".join(f"<th>{html.escape(name).replace('(', '<br>(')}</th>" for name in columns)
    lines = (
        f'<tr><td class="name">{html.escape(name)}</td>{"".join(_box(cells.get(column)) for column in columns)}</tr>\n'
        for name, cells in rows.items()
    )
    missing = f" An interruption left out {record.missing} cells." if record.missing else ""
    body = f"""<p>varpin {html.escape(record.version)}.
Errors are the largest distance in q from the exact motion, relative to the travel of that motion. Where no exact motion
is known, E marks the error of the energy balance over the whole run, relative to the energy that the motion can
exchange. Point at a cell for all of its measures.{missing}</p>
<dl>{legend}</dl>
<table><thead><tr><th>motion</th>{head}</tr></thead><tbody>{"".join(lines)}</tbody></table>"""
    return page(f"Varpin at the extremes: {record.robot}", body, _STYLE)


def _box(cell: Cell | None) -> str:
    if cell is None:
        return "<td></td>"
    values = [f"{name} {getattr(cell, name):.2g}" for name in LEVELS if not math.isnan(getattr(cell, name))]
    lines = [f"{cell.kind.value}; {cell.done} of {cell.steps} steps, {cell.seconds:.2g} s", ", ".join(values)]
    tip = html.escape("\n".join(line for line in (*lines, *cell.found, *cell.said) if line), quote=True)
    return f'<td class="{_class(cell.kind, cell.error)}" title="{tip}">{html.escape(entry(cell))}</td>'


def _class(kind: Kind, error: float) -> str:
    if kind is not Kind.ACCURATE:
        return "wrong" if kind is Kind.WRONG else str(kind.value)
    return "accurate2" if error > 1e-2 else "accurate1" if error > 1e-6 else "accurate0"
