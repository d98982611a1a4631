"""CSV, PNG and one HTML page of a reproduction."""

from __future__ import annotations

import base64
import csv
import html
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from varpin._version import __version__
from varpin.study.paper.cases import CASES, FOURTH_ORDER, MAIN, METHODS, VARIATIONS
from varpin.study.paper.claims import Cells, Claim, series
from varpin.study.paper.experiments import OPTIMUM, SEARCH, Cell
from varpin.trajectory import atomic_file

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

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 0.85rem; }
td, th { border: 1px solid #ccc; padding: 0.25rem 0.6rem; text-align: right; vertical-align: top; }
td.text, th { text-align: left; }
img { max-width: 100%; }
figure { margin: 1.5rem 0; }
.holds { background: #dff2e1; } .holds-in-part { background: #fff3d6; } .does-not-hold { background: #fbdedb; }
.not-measured { background: #ececec; }
"""


def write(
    folder: Path, cells: Cells, claims: Sequence[Claim], figures: Mapping[str, tuple[Figure, str]], *, quick: bool
) -> Path:
    """Write everything; returns the page's path.

    Raises:
        FileError: The folder cannot be written.
    """
    images = {}
    for name, (figure, _) in figures.items():
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=110)
        images[name] = stream.getvalue()
        _write(folder / f"{name}.png", images[name])
    _write(folder / "table1.csv", _csv(cells).encode())
    _write(folder / "claims.csv", _claims_csv(claims).encode())
    page = folder / "report.html"
    captions = {name: caption for name, (_, caption) in figures.items()}
    _write(page, _page(cells, claims, images, captions, quick).encode())
    return page


def _write(path: Path, data: bytes) -> None:
    with atomic_file(path) as stream:
        stream.write(data)


def _csv(cells: Cells) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for cell in cells.values():
        writer.writerow([column(cell) for column in _COLUMNS.values()])
    return text.getvalue()


def _claims_csv(claims: Sequence[Claim]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["source", "sentence", "measured", "verdict"])
    for claim in claims:
        writer.writerow([claim.source, claim.sentence, claim.measured, claim.verdict])
    return text.getvalue()


def _page(
    cells: Cells, claims: Sequence[Claim], images: Mapping[str, bytes], captions: Mapping[str, str], quick: bool
) -> str:
    settings = "".join(f"<li>{html.escape(s.title)}</li>" for s in ((MAIN,) if quick else (MAIN, *VARIATIONS)))
    noises = "".join(f"<li>Case {case.key}: {html.escape(case.title)}</li>" for case in CASES)
    figures = "".join(
        f'<figure><img alt="{html.escape(captions[name])}" src="data:image/png;base64,'
        f'{base64.b64encode(data).decode()}"><figcaption>{html.escape(captions[name])}</figcaption></figure>'
        for name, data in images.items()
    )
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>The paper's experiments, reproduced</title>
<style>{_STYLE}</style></head><body>
<h1>The paper's experiments, reproduced</h1>
<p>varpin {__version__}{", the quick version: fewer steps, one setting" if quick else ""}.
Stochastic differential dynamic programming on a 3-link finger that follows
θ<sub>r</sub>(t) = [1 + 0.25 sin 4πt, 0.1 sin 2πt, 0] for 1.5 s; cost: the integral of
10 |θ - θ<sub>r</sub>|² + 0.1 |u|², plus |θ - θ<sub>r</sub>|² at the end. Variational: the midpoint
integrator. Euler: explicit. Running costs are sampled at mid-step for both. Fourth order: Gauss collocation with two
stages, running costs sampled at two points of each step.</p>
<h2>What the paper leaves open, and what was taken</h2>
<p>The finger's parameters, its initial state, gravity, friction and the powers of ten of the noise are not in the text.
Taken: no friction; first controls that hold the finger where it starts; search parameters {html.escape(str(SEARCH))},
the tolerance relative to the cost; feedback in the line search, where the paper's forward pass is open loop; and</p>
<ul>{settings}</ul><ul>{noises}</ul>
<p>Nothing was tuned until a figure looked like the paper's. The optimizer's own cost is what the paper reports. The
true cost is that of its controls on the continuous system, integrated by a fourth-order method with the substeps
doubled until the cost stands still, open loop and with the plan's feedback; where one number stands for both it is the
better of the two, what a user gets who chooses well. The optimum over held controls is computed with that
method inside each interval: what it costs to decide only every dt, whatever the integrator.</p>
<h2>Claim by claim</h2>
<table><tr><th>source</th><th>sentence</th><th>measured</th><th>verdict</th></tr>
{"".join(_claim_row(claim) for claim in claims)}</table>
<h2>Figures</h2>{figures}
<h2>Table 1</h2>{_table(cells)}
<p>Every cell, the variations too, is in table1.csv. Times are of one machine and one run.</p>
</body></html>
"""


def _claim_row(claim: Claim) -> str:
    kind = claim.verdict.replace(" ", "-")
    cells = "".join(f'<td class="text">{html.escape(x)}</td>' for x in (claim.source, claim.sentence, claim.measured))
    return f'<tr class="{kind}">{cells}<td class="text">{claim.verdict}</td></tr>\n'


def _table(cells: Cells) -> str:
    rows = []
    names = list(_COLUMNS)[1:]
    for case in (*(case.key for case in CASES), "0"):
        for method in (*METHODS, FOURTH_ORDER, OPTIMUM):
            for own in series(cells, MAIN, case, method):
                rows.append("".join(f"<td>{_entry(own, name)}</td>" for name in names))
    head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
    return f"<table><tr>{head}</tr>" + "".join(f"<tr>{row}</tr>" for row in rows) + "</table>"


def _entry(cell: Cell, name: str) -> str:
    text = _COLUMNS[name](cell)
    return "" if text == "nan" else html.escape(text)
