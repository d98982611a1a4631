"""A script in meshcat: as one HTML file that needs no server, or in a live browser window."""

from __future__ import annotations

import contextlib
import io
import logging
import webbrowser
from pathlib import Path

import meshcat

from varpin.io.archive import atomic_file
from varpin.show.replay.drawing import draw
from varpin.show.replay.page import Inline, Page
from varpin.show.replay.script import Script

logger = logging.getLogger(__name__)


def write_page(path: Path, script: Script) -> Path:
    """Write a script as one self-contained HTML file."""
    with atomic_file(path) as stream:
        stream.write(_page(script).encode())
    return path


def inline(script: Script, size: tuple[int, int]) -> Inline:
    """A script's page for a notebook, with a width and a height [pixels]."""
    return Inline(_page(script), script.title, size)


def _page(script: Script) -> str:
    page = Page()
    draw(meshcat.Visualizer(window=page), script, legend=True)
    return page.html(script)


def open_viewer(script: Script) -> meshcat.Visualizer:
    """Draw a script in a new meshcat server, and open it in a web browser."""
    with contextlib.redirect_stdout(io.StringIO()):
        viewer = meshcat.Visualizer()
    draw(viewer, script)
    open_browser(viewer.url())
    return viewer


def open_browser(url: str) -> bool:
    """Open an address in a web browser; returns whether one could be started."""
    logger.info("meshcat serves the motion at %s", url)
    if webbrowser.open(url, new=2):
        return True
    logger.warning("no web browser could be started; open %s in one", url)
    return False
