"""Pictures of replays (a finger, a reach with all that can be marked, a controller), and a notebook.

Needs Chromium and chromedriver (and ``pip install "varpin[test]"`` for selenium).

    python docs/figures.py
"""

import io
import shutil
import tempfile
import time
from pathlib import Path

import matplotlib.image
import numpy as np
from matplotlib.figure import Figure
from pictures import save, save_image
from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

import varpin as vp
from varpin import plots
from varpin.show.replay.video import film_frames

IMAGES = Path(__file__).resolve().parent / "images"


def screenshot(page: Path, seconds: float, size: tuple[int, int] = (800, 640), at: float | None = 0.0) -> bytes:
    """A PNG of a page some seconds after it has been opened; of a replay, stopped at a time [s]."""
    options = webdriver.ChromeOptions()
    for flag in ("--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"):
        options.add_argument(flag)
    options.add_argument("--enable-unsafe-swiftshader")
    options.add_argument(f"--window-size={size[0]},{size[1]}")
    with tempfile.TemporaryDirectory() as profile:
        options.add_argument(f"--user-data-dir={profile}")
        browser = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
        try:
            browser.get(page.as_uri())
            time.sleep(seconds)
            if at is not None:
                browser.execute_script("viewer.animator.pause(); viewer.animator.seek(arguments[0])", at)
                time.sleep(1.0)
            return browser.get_screenshot_as_png()
        finally:
            browser.quit()


def reach(folder: Path) -> Image.Image:
    """A UR5 on its way to a posture, with its trace, its target, its reference and its torques."""
    robot = vp.load_robot("ur5")
    scene = vp.Scene(robot, damping=0.1)
    begin = np.array([0.9, -1.6, 1.6, -0.6, 0.0, 0.0])  # [rad]
    goal = np.array([-0.8, -1.0, 1.2, -0.6, 0.8, 0.0])
    stiffness = np.array([400.0, 400.0, 200.0, 40.0, 20.0, 4.0])  # [N m/rad]

    def control(_: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return scene.holding_torque(q) - stiffness * (q - goal) - 0.2 * stiffness * v

    motion = vp.simulate(scene, begin, np.zeros(6), dt=2e-3, steps=1000, controls=control)
    hand = robot.frame_positions([begin, goal])
    page = vp.replay(
        robot,
        motion,
        html=folder / "reach.html",
        marks=vp.Marks(
            ghost=[goal], trace=True, reference={"straight": hand}, targets={"goal": hand[1]}, frames=True, torques=True
        ),
    )
    return Image.open(io.BytesIO(screenshot(page, 5.0, at=0.25)))


_NOTEBOOK = """<!DOCTYPE html><meta charset="utf-8"><style>
body { font: 13px Helvetica, Arial, sans-serif; margin: 12px 20px; }
table { border-collapse: collapse; font-size: 12px; }
td, th { padding: 3px 8px; } tr:nth-child(even) { background: #f5f5f5; } .varpin { margin-bottom: 14px; }
</style>"""


def notebook(folder: Path) -> Image.Image:
    """A plan and its motion as a notebook shows them."""
    plan = vp.load_scene("ur5_reach").solve()
    page = folder / "notebook.html"
    page.write_text(_NOTEBOOK + plan._repr_html_() + plan.trajectory._repr_html_(), encoding="utf-8")
    return Image.open(io.BytesIO(screenshot(page, 1.0, (760, 640), at=None)))


def controller(folder: Path) -> Image.Image:
    """A UR5 that follows a moving target, replanning: its trace so far, and where its plan means to go."""
    robot = vp.load_robot("ur5")
    scene = vp.Scene(robot, damping=0.05)
    begin = np.array([0.0, -1.5, 1.2, -1.2, -1.5, 0.0])  # [rad]

    def target(t: float) -> list[float]:
        return [0.45 + 0.1 * np.sin(2.0 * t), 0.15 + 0.15 * np.cos(1.3 * t), 0.4 + 0.1 * np.sin(1.7 * t)]

    hold = scene.holding_torque(begin)
    cost = vp.FramePositionCost(robot, "tool0", target, 1e3) + vp.VelocityCost(0.05) + vp.ControlCost(1e-4, hold)
    problem = vp.OptimalControlProblem(scene, cost, begin, np.zeros(6), dt=1e-2, steps=50)
    run = vp.Mpc(problem, iterations=1).run(duration=3.0)
    marks = vp.Marks(targets={"target": [target(t) for t in np.linspace(0.0, 3.0, 150)]}, trace="tool0", growing=True)
    page = vp.replay(robot, run, html=folder / "controller.html", marks=marks)
    (picture,) = film_frames(page, np.array([1.5]), (640, 480))
    return Image.fromarray(picture)


def main() -> None:
    """Draw them."""
    finger = vp.load_robot("finger")
    impedance = {"stiffness": [0.54, 0.28, 0.12], "damping": [3.1e-3, 2.2e-3, 0.9e-3], "rest": [0.5, 0.7, 0.3]}
    scene = vp.Scene(finger, gravity=False, **impedance)
    motion = vp.simulate(scene, [1.2, 1.1, 0.6], [0.0, 0.0, 0.0], dt=1e-4, steps=3000)
    with tempfile.TemporaryDirectory() as folder:
        page = vp.replay(finger, motion.q[:1], dt=1.0, html=Path(folder) / "finger.html")
        picture = matplotlib.image.imread(io.BytesIO(screenshot(page, 3.0)))
        save_image(reach(Path(folder)), IMAGES / "replay.png")
        save_image(notebook(Path(folder)), IMAGES / "notebook.png")
        save_image(controller(Path(folder)), IMAGES / "controller.png")
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.imshow(picture)
    left.axis("off")
    plots.plot_joints(motion, axes=right, robot=finger)
    save(figure, IMAGES / "finger.png")


if __name__ == "__main__":
    main()
