"""Studies as files: a table (CSV), a figure (PNG) and a page (HTML)."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from varpin._version import __version__
from varpin.errors import InputError
from varpin.io.archive import atomic_file
from varpin.show.plots import plot_study
from varpin.study.record import Study
from varpin.support.markup import page, picture


def write_report(folder: Path, name: str, study: Study[Any], title: str) -> list[Path]:
    """Write ``name.csv``, ``name.png`` and ``name.html`` into an existing folder; returns their paths.

    The figure is left out if the study has none, or no run has the numbers for it.
    """
    image = _image(study)
    body = study.html(most=len(study.runs)) + (picture(image, title) if image else "")
    files = {"png": image, "html": page(title, f"{body}<p>measured with varpin {__version__}</p>").encode()}
    written = [study.to_csv(folder / f"{name}.csv")]
    for kind, content in files.items():
        if content:
            written.append(folder / f"{name}.{kind}")
            with atomic_file(written[-1]) as stream:
                stream.write(content)
    return written


def _image(study: Study[Any]) -> bytes:
    """The figure as PNG; empty if there is none."""
    stream = io.BytesIO()
    try:
        figure = Figure(figsize=(8.0, 4.5), layout="constrained")
        plot_study(study, figure.subplots())
        figure.savefig(stream, format="png", dpi=150)
    except InputError:  # the study has none, or no run has the numbers
        return b""
    return stream.getvalue()
