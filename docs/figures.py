"""Pictures of replays: the finger beside its joint angles, and a reach with all that can be marked.

Needs Chromium and chromedriver (and ``pip install "varpin[test]"`` for selenium).

    python docs/figures.py
"""

import io
import tempfile
import time
from pathlib import Path

import matplotlib.image
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from selenium import webdriver

import varpin as vp
from varpin import plots

IMAGES = Path(__file__).resolve().parent / "images"


def screenshot(page: Path, seconds: float, size: tuple[int, int] = (800, 640), at: float = 0.0) -> bytes:
    """A PNG of a replay some seconds after it has been opened, stopped at a time [s]."""
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
            browser.execute_script("viewer.animator.pause(); viewer.animator.seek(arguments[0])", at)
            time.sleep(1.0)
            return browser.get_screenshot_as_png()
        finally:
            browser.quit()


def reach(folder: Path) -> bytes:
    """A UR5 on its way to a posture, with its trace, its target, its reference and its torques."""
    robot = vp.load_robot("ur5")
    scene = vp.Scene(robot, damping=0.1)
    begin = np.array([0.9, -1.6, 1.6, -0.6, 0.0, 0.0])  # [rad]
    goal = np.array([-0.8, -1.0, 1.2, -0.6, 0.8, 0.0])
    stiffness = np.array([400.0, 400.0, 200.0, 40.0, 20.0, 4.0])  # [N m/rad]

    def control(_: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        gravity = vp.lagrangian_jet(scene, q, np.zeros(6)).Lq
        return -gravity - stiffness * (q - goal) - 0.2 * stiffness * v

    motion = vp.simulate(scene, begin, np.zeros(6), dt=2e-3, steps=1000, controls=control)
    hand = robot.frame_positions([begin, goal])
    page = vp.replay(
        robot,
        motion,
        html=folder / "reach.html",
        ghost=[goal],
        trace=True,
        reference={"straight": hand},
        targets={"goal": hand[1]},
        frames=True,
        torques=True,
    )
    return screenshot(page, 5.0, at=0.25)


def main() -> None:
    """Draw them."""
    finger = vp.load_robot("finger")
    impedance = {"stiffness": [0.54, 0.28, 0.12], "damping": [3.1e-3, 2.2e-3, 0.9e-3], "rest": [0.5, 0.7, 0.3]}
    scene = vp.Scene(finger, gravity=False, **impedance)
    motion = vp.simulate(scene, [1.2, 1.1, 0.6], [0.0, 0.0, 0.0], dt=1e-4, steps=3000)
    with tempfile.TemporaryDirectory() as folder:
        page = vp.replay(finger, motion.q[:1], dt=1.0, html=Path(folder) / "finger.html")
        picture = matplotlib.image.imread(io.BytesIO(screenshot(page, 3.0)))
        (IMAGES / "replay.png").write_bytes(reach(Path(folder)))
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.imshow(picture)
    left.axis("off")
    plots.plot_joints(motion, axes=right, robot=finger)
    FigureCanvasAgg(figure).print_png(IMAGES / "finger.png")


if __name__ == "__main__":
    main()
