"""The picture of the README: the finger in meshcat beside its joint angles.

Needs Chromium and chromedriver (and ``pip install "varpin[test]"`` for selenium).

    python docs/figures.py
"""

import io
import tempfile
import time
from pathlib import Path

import matplotlib.image
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from selenium import webdriver

import varpin as vp
from varpin import plots

IMAGES = Path(__file__).resolve().parent / "images"


def screenshot(page: Path, seconds: float, size: tuple[int, int] = (800, 640)) -> bytes:
    """A PNG of a replay some seconds after it has been opened."""
    options = webdriver.ChromeOptions()
    for flag in ("--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"):
        options.add_argument(flag)
    options.add_argument("--enable-unsafe-swiftshader")
    options.add_argument(f"--window-size={size[0]},{size[1]}")
    with tempfile.TemporaryDirectory() as profile:
        options.add_argument(f"--user-data-dir={profile}")
        browser = webdriver.Chrome(options=options)
        try:
            browser.get(page.as_uri())
            time.sleep(seconds)
            browser.execute_script("document.querySelectorAll('.dg').forEach(e => e.remove())")
            return browser.get_screenshot_as_png()
        finally:
            browser.quit()


def main() -> None:
    """Draw it."""
    finger = vp.load_robot("finger")
    impedance = {"stiffness": [0.54, 0.28, 0.12], "damping": [3.1e-3, 2.2e-3, 0.9e-3], "rest": [0.5, 0.7, 0.3]}
    scene = vp.Scene(finger, gravity=False, **impedance)
    motion = vp.simulate(scene, [1.2, 1.1, 0.6], [0.0, 0.0, 0.0], dt=1e-4, steps=3000)
    with tempfile.TemporaryDirectory() as folder:
        page = vp.replay(finger, motion.q[:1], dt=1.0, html=Path(folder) / "finger.html")
        picture = matplotlib.image.imread(io.BytesIO(screenshot(page, 3.0)))
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.imshow(picture)
    left.axis("off")
    plots.plot_joints(motion, axes=right, robot=finger)
    FigureCanvasAgg(figure).print_png(IMAGES / "finger.png")


if __name__ == "__main__":
    main()
