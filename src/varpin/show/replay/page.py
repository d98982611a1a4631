"""A stage in meshcat: as one HTML file that needs no server, or in a live browser window."""

from __future__ import annotations

import base64
import contextlib
import gzip
import html as markup
import io
import logging
import webbrowser
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshcat
import numpy as np
import umsgpack

from varpin.errors import InputError
from varpin.show.replay.drawing import draw
from varpin.show.replay.marks import KINDS
from varpin.show.replay.shapes import GHOST_COLOR
from varpin.show.replay.stage import EFFORT_COLORS, Stage

logger = logging.getLogger(__name__)

# Playback speeds in the menu of the page; 1 is true speed.
_SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)


class _Recorder:
    """Replaces meshcat's window and keeps the commands that a window would send to its server."""

    def __init__(self) -> None:
        self.commands: list[bytes] = []

    def send(self, command: Any) -> None:
        """Keep a command."""
        # three.js computes in single precision.
        try:
            self.commands.append(umsgpack.packb(command.lower(), force_float_precision="single"))
        except OverflowError:
            raise InputError("the replay has sizes or positions beyond 3e38, which no viewer draws") from None


def page_of(stage: Stage) -> str:
    """A stage as one HTML file: meshcat's viewer, the compressed commands, the legend and the control bar."""
    window = _Recorder()
    draw(meshcat.Visualizer(window=window), stage)
    viewer = Path(meshcat.viewer_assets_path(), "dist", "main.min.js").read_text(encoding="utf-8")
    stream = b"".join(len(command).to_bytes(4, "little") + command for command in window.commands)
    packed = base64.b64encode(gzip.compress(stream, 6, mtime=0)).decode()
    title, key = markup.escape(stage.title), "\n".join(_legend(stage))
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{title} - varpin</title>
<link rel="icon" href="data:,">
<style>{_part("player.css")}</style>
</head>
<body>
<div id="stage"><div id="meshcat-pane"></div><p id="loading">loading</p>
<div id="about"><h1>{title}</h1><ul>{key}</ul></div></div>
{_bar(stage)}
<script>{viewer}</script>
<script id="commands" type="text/plain">{packed}</script>
<script>{_part("player.js")}</script>
</body>
</html>
"""


def _part(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _legend(stage: Stage) -> Iterator[str]:
    """The lines of the legend, one for each kind of mark, and the note."""
    marks = [mark for own in stage.marks for mark in own]
    lines: list[tuple[str, list[int]]] = []
    if any(figure.effort is not None for figure in stage.figures):
        scale = [int.from_bytes(np.rint(255.0 * color).astype(np.uint8).tobytes()) for color in EFFORT_COLORS]
        lines.append(("torque: none, half, all of the limit", scale))
    if any("ghost" in figure.rows for figure in stage.figures):
        planned = any(mark.kind == "plan" for mark in marks)
        lines.append(("plan" if planned else "ghost", [GHOST_COLOR] * 2))
    for kind, (words, color) in KINDS.items():
        if names := ", ".join(dict.fromkeys(mark.name for mark in marks if mark.kind == kind)):
            text = words.format(names)
            lines.append((kind if text == f"{kind}: {kind}" else text, [color] * 2))
    for text, colors in lines:
        ramp = ", ".join(f"#{color:06x}" for color in colors)
        swatch = f'<span class="swatch" style="background: linear-gradient(to right, {ramp})"></span>'
        yield f"<li>{swatch}{markup.escape(text)}</li>"
    if stage.note:
        yield f"<li>{markup.escape(stage.note)}</li>"


def _bar(stage: Stage) -> str:
    """The control bar with play, time and speed; empty for a pose."""
    if len(stage.times) < 2:
        return ""
    options = "".join(
        f'<option value="{speed:g}"{" selected" if speed == stage.speed else ""}>{speed:g} x</option>'
        for speed in sorted({*_SPEEDS, stage.speed})
    )
    return (
        f'<div id="bar" data-speed="{stage.speed!r}"><button id="play" type="button"></button>'
        '<input id="time" type="range" min="0" step="any" value="0" aria-label="Time">'
        f'<output id="clock"></output><select id="speed" title="Speed" aria-label="Speed">{options}</select></div>'
    )


@dataclass(frozen=True, eq=False)
class Inline:
    """A page that a notebook shows as the value of a cell."""

    html: str  # the page
    title: str  # its title
    size: tuple[int, int]  # its largest width, and its height [pixels]

    def __repr__(self) -> str:
        return f"Inline(replay of {self.title}, {len(self.html) / 1e6:.1f} MB)"

    def _repr_html_(self) -> str:
        """The page in a sandboxed frame, isolated from the notebook's page."""
        width, height = self.size
        return (
            f'<iframe srcdoc="{markup.escape(self.html)}" title="{markup.escape(self.title)}" sandbox="allow-scripts" '
            f'style="width: 100%; max-width: {width}px; height: {height}px; border: 0"></iframe>'
        )


def open_viewer(stage: Stage) -> meshcat.Visualizer:
    """Draw a stage in a new meshcat server, and open it in a web browser."""
    with contextlib.redirect_stdout(io.StringIO()):
        viewer = meshcat.Visualizer()
    draw(viewer, stage)
    open_browser(viewer.url())
    return viewer


def open_browser(url: str) -> bool:
    """Open an address in a web browser; returns whether one could be started."""
    logger.info("meshcat serves the motion at %s", url)
    if webbrowser.open(url, new=2):
        return True
    logger.warning("no web browser could be started; open %s in one", url)
    return False
