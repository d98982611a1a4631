"""How the pictures of pages are written."""

import io
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image


def save(figure: Figure, path: Path) -> None:
    """Write a figure."""
    stream = io.BytesIO()
    FigureCanvasAgg(figure).print_png(stream)
    save_image(Image.open(stream), path)


def save_image(picture: Image.Image, path: Path) -> None:
    """Write a picture, all of its colours: 256 would make thin lines of two joints one."""
    picture.convert("RGB").save(path, optimize=True)
