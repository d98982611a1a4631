"""A record of extreme scenes as a page (HTML): a heat map of every scene with every integrator, without scripts."""

from __future__ import annotations

import html
import math
import os
from collections.abc import Iterable
from pathlib import Path

from varpin.study.extremes import Cell, Kind, Record
from varpin.study.extremes.battery import families
from varpin.support.checks import writable
from varpin.trajectory import atomic_file

# What a kind looks like: a letter for those who see no colours, and a colour for those who do (after Okabe and Ito).
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
    Kind.DEGRADED: "varpin itself says that something is not as it should be; the error is given",
    Kind.REFUSED: "a named error before anything ran",
    Kind.STOPPED: "a named error on the way; the motion so far is kept",
    Kind.WRONG: "a check fails, and varpin says nothing",
}
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 88rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; font-size: 0.78rem; margin: 1rem 0; }
th { text-align: left; font-weight: 600; padding: 0.15rem 0.5rem; }
thead th { position: sticky; top: 0; background: #fff; font-size: 0.72rem; vertical-align: bottom; }
td { border: 1px solid #fff; padding: 0.15rem 0.4rem; min-width: 4.2rem; text-align: right; white-space: nowrap; }
td.name { text-align: left; } tr.family th { padding-top: 0.8rem; font-size: 0.9rem; border-bottom: 1px solid #bbb; }
.accurate0 { background: #6fc3a4; } .accurate1 { background: #9ad5bf; } .accurate2 { background: #c4e7da; }
.degraded { background: #f6dc8b; } .refused { background: #b9d9ee; } .stopped { background: #e3c4d8; }
.wrong { background: #c8102e; color: #fff; font-weight: 700; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.2rem 0.8rem; }
dt { padding: 0 0.5rem; } dd { margin: 0; }
"""


def false_alarms(record: Record) -> str:
    """How many warnings were needless, in words."""
    warned, needless = record.counts()[Kind.DEGRADED], len(record.needless())
    return f"Of {warned} cells that varpin warns of, {needless} fail no check: false alarms."


def entry(cell: Cell) -> str:
    """A cell in a few signs: its letter and its error, or how far it came."""
    if cell.kind is Kind.STOPPED:
        return f"S {cell.done}/{cell.steps}"
    if cell.kind is Kind.REFUSED:
        return "R"
    short = "" if cell.done == cell.steps else f" {cell.done}/{cell.steps}"
    return f"{LETTERS[cell.kind]} {headline(cell)}{short}"


def headline(cell: Cell) -> str:
    """Its error, or what stands for it: the energy's error where no exact motion is known."""
    if not math.isnan(cell.error):
        return f"{cell.error:.0e}"
    return "" if math.isnan(cell.energy) else f"E {cell.energy:.0e}"


def grid(record: Record) -> tuple[list[str], list[tuple[str, str, dict[str, Cell]]]]:
    """The integrators, and rows of a family, a trial and its cells by integrator."""
    columns = list(dict.fromkeys(cell.integrator for cell in record.cells))
    cells = {(cell.family, cell.trial, cell.integrator): cell for cell in record.cells}
    rows = [
        (family, trial, {name: cells[family, trial, name] for name in columns if (family, trial, name) in cells})
        for family, trials in families(record.cells).items()
        for trial in trials
    ]
    return columns, rows


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
    columns, rows = grid(record)
    counts = record.counts()
    legend = "".join(
        f'<dt class="{_class(kind, math.nan)}">{LETTERS[kind]} {kind.value}: {counts[kind]}</dt><dd>{text}</dd>'
        for kind, text in _MEANING.items()
    )
    head = "".join(f"<th>{_broken(name)}</th>" for name in columns)
    title = f"Varpin at the extremes: {html.escape(record.robot)}"
    missing = f" An interruption left out {record.missing} cells." if record.missing else ""
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style></head><body>
<h1>{title}</h1>
<p>varpin {html.escape(record.version)}. Errors are the largest distance in q from the exact motion over some periods,
in units of how far that motion goes; E stands before the error of the energy balance over the whole run, in units of
the energy there is to turn over, where no exact motion is known. Point at a cell for all of its measures.{missing}</p>
<dl>{legend}</dl>
<p>{false_alarms(record)}</p>
<table><thead><tr><th>scene</th>{head}</tr></thead><tbody>{"".join(_rows(columns, rows))}</tbody></table>
</body></html>
"""


def _rows(columns: list[str], rows: list[tuple[str, str, dict[str, Cell]]]) -> Iterable[str]:
    last = ""
    for family, trial, cells in rows:
        if family != last:
            yield f'<tr class="family"><th colspan="{len(columns) + 1}">{html.escape(family)}</th></tr>\n'
            last = family
        inner = "".join(_box(cells[name]) if name in cells else "<td></td>" for name in columns)
        yield f'<tr><td class="name">{html.escape(trial)}</td>{inner}</tr>\n'


def _box(cell: Cell) -> str:
    tip = html.escape(details(cell), quote=True)
    return f'<td class="{_class(cell.kind, cell.error)}" title="{tip}">{html.escape(entry(cell))}</td>'


def details(cell: Cell) -> str:
    """All there is to say of a cell."""
    names = ("error", "joint", "velocity", "period", "energy", "momentum", "reversal", "symplecticity", "record")
    values = [f"{name} {getattr(cell, name):.2g}" for name in names if not math.isnan(getattr(cell, name))]
    kind = f"{cell.kind.value}, needlessly" if cell.needless else cell.kind.value
    lines = [f"{kind}; {cell.done} of {cell.steps} steps, {cell.seconds:.2g} s", ", ".join(values)]
    return "\n".join(line for line in (*lines, *cell.found, *cell.said) if line)


def _class(kind: Kind, error: float) -> str:
    if kind is not Kind.ACCURATE:
        return "wrong" if kind is Kind.WRONG else str(kind.value)
    return "accurate2" if error > 1e-2 else "accurate1" if error > 1e-6 else "accurate0"


def _broken(name: str) -> str:
    return html.escape(name).replace("(", "<br>(")
