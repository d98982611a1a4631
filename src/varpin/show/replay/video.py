"""Films of a page, which a headless Chromium draws frame by frame at exact times."""

from __future__ import annotations

import base64
import contextlib
import importlib.util
import math
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.errors import InputError, MissingDependency, VarpinError
from varpin.io.archive import atomic_file
from varpin.support.checks import count

if TYPE_CHECKING:
    from selenium.webdriver import Chrome


FORMATS = (".gif", ".mp4")

# Distributions by the name of their module.
_PACKAGES = {"imageio": "imageio", "imageio_ffmpeg": "imageio-ffmpeg", "selenium": "selenium"}
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_DRIVER = "chromedriver"

# Beside the driver's own. Software rendering gives the same pictures everywhere. Containers allow no sandbox, and the
# page is varpin's own.
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--disable-component-update",
)

_LOAD_LIMIT = 120.0  # time limit for a page to load [s]

_STOP = "viewer.animator.pause(); viewer.set_3d_pane_size(arguments[0], arguments[1]);"
# Textures are read in the background.
_COMPLETE = """
let complete = document.documentElement.dataset.loaded === "true";
if (complete) viewer.scene.traverse(node => {
    for (const material of [node.material || []].flat())
        if (material.map && !(material.map.image && material.map.image.complete !== false)) complete = false;
});
return complete;
"""
_DRAW = "viewer.animator.seek(arguments[0]); return viewer.capture_image();"

# A palette for each frame, as colours change; frames are then encoded one by one.
_FILTER = "split[a][b];[a]palettegen=stats_mode=single[p];[b][p]paletteuse=new=1"
_GIF = {"codec": "gif", "pix_fmt_out": "pal8", "quality": None, "output_params": ["-filter_complex", _FILTER]}


def frame_size(size: tuple[int, int]) -> tuple[int, int]:
    """Width and height [pixels], checked."""
    if not isinstance(size, tuple | list) or len(size) != 2:
        raise InputError(f"size must be a width and a height [pixels], got {size!r}")
    width, height = (count("size", number, least=16) for number in size)
    return width, height


def frame_times(suffix: str, fps: float, duration: float, most: int) -> Floats:
    """Times of the frames (F,) of a film [s], from 0 to a duration; a longer film than ``most`` has fewer a second."""
    period = max(1.0 / fps, duration / (most - 1))
    if suffix == ".gif":
        # GIF times are in hundredths of a second, and viewers do not follow periods below two.
        period = 0.01 * max(2, round(100.0 * period), math.ceil(100.0 * duration / (most - 1) - 1e-9))
    return np.arange(math.floor(duration / period * (1.0 + 1e-9)) + 1, dtype=np.float64) * period


def write_film(path: Path, page: Path, times: Floats, size: tuple[int, int]) -> Path:
    """Write the film of a page, whose frames are at ``times`` (F,) [s]."""
    import imageio_ffmpeg  # noqa: PLC0415 - of an extra

    suffix = path.suffix.lower()
    rate = 1.0 / (times[1] - times[0]) if len(times) > 1 else 1.0
    options = _GIF if suffix == ".gif" else {}
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder, f"film{suffix}")
        writer = imageio_ffmpeg.write_frames(
            str(draft), size, fps=rate, macro_block_size=2, ffmpeg_log_level="error", **options
        )
        writer.send(None)
        with contextlib.closing(writer):
            for frame in film_frames(page, times, size):
                writer.send(np.ascontiguousarray(frame))
        with atomic_file(path) as stream:
            stream.write(draft.read_bytes())
    return path


def check_film(path: Path, size: tuple[int, int] = (16, 16)) -> None:
    """Check the format and the size of a film, and that the necessary packages and programs are installed."""
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"video must end in {' or '.join(FORMATS)}, got {path.name!r}")
    width, height = frame_size(size)
    if width % 2 or height % 2:
        raise InputError(f"size must be even numbers of pixels, as video formats need, got {width} x {height}")
    packages = [name for module, name in _PACKAGES.items() if importlib.util.find_spec(module) is None]
    programs = [name for name, found in (("chromium", _chromium()), (_DRIVER, shutil.which(_DRIVER))) if not found]
    for missing, command in (
        (packages, 'pip install "varpin[video]"'),
        (programs, "apt install chromium chromium-driver"),
    ):
        if missing:
            raise MissingDependency("video", missing, command)


def _chromium() -> str | None:
    return next((path for name in _BROWSERS if (path := shutil.which(name))), None)


@contextlib.contextmanager
def _browser(size: tuple[int, int]) -> Iterator[Chrome]:
    """A headless Chromium with a page of ``size`` [pixels]."""
    from selenium import webdriver  # noqa: PLC0415 - of an extra
    from selenium.common.exceptions import WebDriverException  # noqa: PLC0415
    from selenium.webdriver.chrome.service import Service  # noqa: PLC0415

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile, contextlib.ExitStack() as stack:
        options = webdriver.ChromeOptions()
        options.binary_location = _chromium() or ""
        for flag in (*_FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        try:
            browser = webdriver.Chrome(options=options, service=Service(shutil.which(_DRIVER)))
            stack.callback(browser.quit)
            metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
            yield browser
        except WebDriverException as error:
            raise VarpinError(f"Chromium cannot show the motion: {(error.msg or '').splitlines()[0]}") from None


def film_frames(
    page: Path, times: Floats, size: tuple[int, int], scripts: Sequence[tuple[str, Sequence[float]]] = ()
) -> Iterator[NDArray[np.uint8]]:
    """A page's picture (height, width, 3) at each time [s of playback], after ``scripts`` with their arguments."""
    import imageio.v3 as imageio  # noqa: PLC0415 - of an extra

    with _browser(size) as browser:
        browser.get(page.resolve().as_uri())
        give_up = time.monotonic() + _LOAD_LIMIT
        while not browser.execute_script(_COMPLETE):
            if time.monotonic() > give_up:
                raise VarpinError(f"Chromium did not finish loading the motion within {_LOAD_LIMIT:g} s")
            time.sleep(0.05)
        for script, arguments in ((_STOP, size), *scripts):
            browser.execute_script(script, *arguments)
        # In single precision, as the page has the times of its keyframes.
        for seconds in times.astype(np.float32):
            address = browser.execute_script(_DRAW, float(seconds))
            picture = base64.b64decode(address.partition(",")[2])
            yield np.asarray(imageio.imread(picture, extension=".png"))[..., :3]
