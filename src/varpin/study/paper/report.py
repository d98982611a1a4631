"""CSV, PNG and one HTML page of a reproduction."""

from __future__ import annotations

import html
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from varpin._version import __version__
from varpin.io.archive import atomic_file
from varpin.study.paper.cases import CASES, FOURTH_ORDER, MAIN, METHODS, VARIATIONS
from varpin.study.paper.claims import Cells, Claim, series
from varpin.study.paper.experiments import OPTIMUM, SEARCH, Cell
from varpin.support.markup import page, picture
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

_STYLE = """
body { max-width: 76rem; }
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
    rows = ([column(cell) for column in _COLUMNS.values()] for cell in cells.values())
    _write(folder / "table1.csv", csv_text(_COLUMNS, rows).encode())
    rows = ([claim.source, claim.sentence, claim.measured, claim.verdict] for claim in claims)
    _write(folder / "claims.csv", csv_text(("source", "sentence", "measured", "verdict"), rows).encode())
    target = folder / "report.html"
    captions = {name: caption for name, (_, caption) in figures.items()}
    _write(target, _page(cells, claims, images, captions, quick).encode())
    return target


def _write(path: Path, data: bytes) -> None:
    with atomic_file(path) as stream:
        stream.write(data)


def _page(
    cells: Cells, claims: Sequence[Claim], images: Mapping[str, bytes], captions: Mapping[str, str], quick: bool
) -> str:
    settings = "".join(f"<li>{html.escape(s.title)}</li>" for s in ((MAIN,) if quick else (MAIN, *VARIATIONS)))
    noises = "".join(f"<li>Case {case.key}: {html.escape(case.title)}</li>" for case in CASES)
    figures = "".join(
        f"<figure>{picture(data, captions[name])}<figcaption>{html.escape(captions[name])}</figcaption></figure>"
        for name, data in images.items()
    )
    body = f"""<p>varpin {__version__}{", the quick version: fewer steps, one setting" if quick else ""}.
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
<p>No setting was tuned to make a figure resemble the paper's. The paper reports the optimizer's own cost. The true cost
is that of the plan's controls on the continuous system, with and without the plan's feedback; a fourth-order method
integrates it, with substeps doubled until the cost no longer changes. Where there is one number for both, it is the
smaller. The optimum over held controls is computed with the same method inside each interval: it is the least cost of
controls that change only every dt, for any integrator.</p>
<h2>Claim by claim</h2>
<table><tr><th>source</th><th>sentence</th><th>measured</th><th>verdict</th></tr>
{"".join(_claim_row(claim) for claim in claims)}</table>
<h2>Figures</h2>{figures}
<h2>Table 1</h2>{_table(cells)}
<p>Every cell, the variations too, is in table1.csv. Times are of one machine and one run.</p>"""
    return page("The paper's experiments, reproduced", body, _STYLE)


def _claim_row(claim: Claim) -> str:
    kind = claim.verdict.replace(" ", "-")
    cells = "".join(f'<td class="text">{html.escape(x)}</td>' for x in (claim.source, claim.sentence, claim.measured))
    return f'<tr class="{kind}">{cells}<td class="text">{claim.verdict}</td></tr>\n'


def _table(cells: Cells) -> str:
    rows = []
    names = list(_COLUMNS)[1:]
    for case in (*(case.key for case in CASES), "0"):
        for method in (*METHODS, FOURTH_ORDER, OPTIMUM):
            for cell in series(cells, MAIN, case, method):
                rows.append("".join(f"<td>{_entry(cell, name)}</td>" for name in names))
    head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
    return f"<table><tr>{head}</tr>" + "".join(f"<tr>{row}</tr>" for row in rows) + "</table>"


def _entry(cell: Cell, name: str) -> str:
    text = _COLUMNS[name](cell)
    return "" if text == "nan" else html.escape(text)
