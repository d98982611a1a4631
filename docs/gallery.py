"""Pictures and figures of docs/gallery.md: each bundled scene solved, replayed in Chromium, and drawn; and examples.

Needs ``pip install "varpin[video]" pillow``, Chromium and chromedriver.

    python docs/gallery.py               # all of them, and the table of the page
    python docs/gallery.py ur5_reach     # these pictures alone
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import imageio.v3
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

import varpin as vp
from varpin import plots
from varpin.io.scenefile import scenes
from varpin.show.replay.video import film_frames

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "benchmarks"))
from pages import fill  # noqa: E402
from pictures import save  # noqa: E402

SIZE = (600, 450)


@dataclass(frozen=True)
class Shot:
    """How a scene is shown.

    Attributes:
        at: When [s of motion].
        draw: Its figure, right of the picture.
        view: Azimuth and elevation [degrees] of the camera, and how much nearer than usual it is; None for the usual.
    """

    at: float
    draw: Callable[[SubFigure, vp.SceneFile, vp.Solution], None]
    view: tuple[float, float, float] | None = None


def joints(figure: SubFigure, scene: vp.SceneFile, plan: vp.Solution) -> None:
    """Angles and their references."""
    axes = figure.subplots()
    plots.plot_joints(plan.trajectory, axes=axes, robot=scene.robot)
    wanted = scene.marks().ghost
    times = np.linspace(0.0, plan.trajectory.duration, len(wanted))
    for column in wanted.T:
        axes.plot(times, column, color="0.2", linewidth=0.9, linestyle="--")
    axes.set_title("joints, and what they are to follow (dashed)", fontsize=10)


def errors(figure: SubFigure, scene: vp.SceneFile, plan: vp.Solution) -> None:
    """How far the joints are from their reference."""
    axes, motion, wanted = _axes(figure), plan.trajectory, scene.marks().ghost
    reference = CubicSpline(np.linspace(0.0, motion.duration, len(wanted)), wanted)
    for name, error in zip(scene.robot.joint_names, (motion.q - reference(motion.t)).T, strict=True):
        axes.plot(motion.t, 1e3 * error, label=name)
    axes.set_title("how far the joints are from what they are to follow", fontsize=10)
    _label(axes, "error [mrad]")


def paths(figure: SubFigure, scene: vp.SceneFile, plan: vp.Solution) -> None:
    """Noisy paths under the plan's feedback."""
    problem, parts = plan.problem, figure.subplots(scene.robot.dof, 1, sharex=True)
    ensemble = vp.simulate_ensemble(
        problem.scene, problem.q0, problem.v0, dt=problem.dt, steps=problem.steps, paths=8, rng=0, controls=plan.policy
    )
    assert ensemble.q is not None
    for k, (axes, name) in enumerate(zip(parts, scene.robot.joint_names, strict=True)):
        plots.apply_style(axes)
        color = plots.COLORS[k % len(plots.COLORS)]
        axes.plot(ensemble.t, 1e3 * (ensemble.q[:, :, k] - plan.trajectory.q[:, k]).T, linewidth=0.3, color=color)
        axes.set_ylabel(f"{name} [mrad]")
    parts[0].set_title("8 noisy paths with feedback: how far they are from the plan", fontsize=10)
    parts[-1].set_xlabel("time [s]")


def torques(figure: SubFigure, scene: vp.SceneFile, plan: vp.Solution) -> None:
    """Torques in units of their limits."""
    axes, motion, limit = _axes(figure), plan.trajectory, plan.problem.control_limits[1]
    for k, name in enumerate(scene.robot.joint_names):
        axes.stairs(motion.u[:, k] / limit[k], motion.t, label=name, baseline=None, linewidth=1.2)
    axes.set_title("torques", fontsize=10)
    _label(axes, "torque / limit")


def distance(figure: SubFigure, scene: vp.SceneFile, plan: vp.Solution) -> None:
    """How far the hand is from its target."""
    axes, marks = _axes(figure), scene.marks()
    (target,) = marks.targets.values()
    tip = scene.robot.frame_positions(plan.trajectory.q, marks.trace[0])
    axes.plot(plan.trajectory.t, 1e3 * np.linalg.norm(tip - target[-1], axis=1))
    axes.set_title("distance of the hand from its target", fontsize=10)
    _label(axes, "distance [mm]", legend=False)


def circle(figure: SubFigure, scene: vp.SceneFile, plan: vp.Solution) -> None:
    """The drawn path from above."""
    axes, marks = _axes(figure), scene.marks()
    (path,) = marks.reference.values()
    tip = scene.robot.frame_positions(plan.trajectory.q, marks.trace[0])
    axes.plot(*path[:, :2].T, color="#157a3c", linewidth=4.0, alpha=0.4, label="wanted")
    axes.plot(*tip[:, :2].T, color="#d1480f", linewidth=1.2, label="drawn")
    axes.set_aspect("equal")
    axes.set_title("the path, from above", fontsize=10)
    axes.legend(loc="center", fontsize=9)
    axes.locator_params(nbins=5)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def swing(figure: SubFigure, scene: vp.SceneFile, plan: vp.Solution) -> None:
    """Angles, and the torque below them."""
    motion, limit = plan.trajectory, plan.problem.control_limits[1, 0]
    above, below = figure.subplots(2, 1, sharex=True)
    plots.plot_joints(motion, axes=above, robot=scene.robot)
    above.set_xlabel("")
    above.set_title("angles, and the torque", fontsize=10)
    plots.apply_style(below)
    below.stairs(motion.u[:, 0], motion.t, baseline=None, color="0.2", label="torque")
    below.hlines([-limit, limit], *motion.t[[0, -1]], color="0.3", linestyle="--", linewidth=0.9, label="limits")
    _label(below, "torque [N m]")


def closing(figure: SubFigure, scene: vp.SceneFile, plan: vp.Solution) -> None:
    """The distance of the pads, and the torque of the drive below it."""
    motion = plan.trajectory
    above, below = figure.subplots(2, 1, sharex=True)
    for axes in (above, below):
        plots.apply_style(axes)
    right, left = (scene.robot.frame_positions(motion.q, f"{side}_pad") for side in ("right", "left"))
    above.plot(motion.t, 1e3 * (right - left)[:, 0], color="0.2")
    above.set_ylabel("distance of the pads [mm]")
    below.stairs(motion.u[:, 0], motion.t, baseline=None, color="0.2")
    _label(below, "torque of the drive [N m]", legend=False)


def grip(figure: SubFigure, scene: vp.SceneFile, plan: vp.Solution) -> None:
    """Heights of both tools, and the force between them below."""
    motion = plan.trajectory
    above, below = figure.subplots(2, 1, sharex=True)
    for axes in (above, below):
        plots.apply_style(axes)
    for side in ("left", "right"):
        above.plot(motion.t, scene.robot.frame_positions(motion.q, f"{side}_tool0")[:, 2], label=f"{side} tool")
    above.set_ylabel("height [m]")
    above.legend(fontsize=8)
    below.stairs(np.linalg.norm(motion.constraint_forces[:, :3], axis=1), motion.t, baseline=None, color="0.2")
    _label(below, "force on the right tool [N]", legend=False)


def _axes(figure: SubFigure) -> Axes:
    axes = figure.subplots()
    plots.apply_style(axes)
    return axes


def _label(axes: Axes, name: str, *, legend: bool = True) -> None:
    axes.set_xlabel("time [s]")
    axes.set_ylabel(name)
    if legend:
        axes.legend(fontsize=8)


SHOTS = {
    "finger_tracking": Shot(0.13, errors),
    "finger_noise": Shot(0.5, paths),
    "ur5_reach": Shot(0.6, torques, (20.0, 25.0, 1.1)),
    "panda_payload": Shot(0.5, distance, (-50.0, 21.0, 1.15)),
    "kinova_circle": Shot(2.8, circle, (245.0, 40.0, 1.0)),
    "allegro_finger": Shot(0.55, joints, (-50.0, 21.0, 1.1)),
    "double_pendulum_swing_up": Shot(0.95, swing),
    "talos_wave": Shot(1.2, joints, (-50.0, 21.0, 0.9)),
    "gripper_closes": Shot(0.2, closing, (-80.0, 12.0, 1.0)),
    "beam_lift": Shot(0.6, grip, (-60.0, 20.0, 0.95)),
}

# Examples: when they are shown [s], the second time where they draw no figure; and from where.
EXAMPLES: dict[str, tuple[float, float, tuple[float, float, float] | None]] = {
    "ur5_servos": (0.5, 0.5, (20.0, 25.0, 0.85)),
    "panda_stop": (1.5, 1.5, (-50.0, 21.0, 1.0)),
    "kinova_door": (4.5, 4.5, (130.0, 25.0, 0.95)),
    "tiago_reach": (0.0, 3.0, (-50.0, 21.0, 0.95)),
    "ur5_around_obstacle": (0.2, 0.8, (-25.0, 35.0, 1.0)),
    "five_bar_circle": (0.7, 0.7, None),
    "driven_crank": (0.0, 0.0, None),
    "two_arms_beam": (0.0, 1.0, (-60.0, 20.0, 0.95)),
    "panda_wipes": (0.6, 2.6, (-50.0, 21.0, 1.05)),
}

_VIEW = """
const [azimuth, elevation, nearer] = arguments;
const path = ["Cameras", "default", "rotated", "<object>"];
const far = viewer.scene_tree.find(path).object.position.length() / nearer;
const a = azimuth * Math.PI / 180, e = elevation * Math.PI / 180;
const near = far * Math.cos(e);
viewer.set_property(path, "position", [near * Math.cos(a), far * Math.sin(e), -near * Math.sin(a)]);
"""


def photograph(name: str, scene: vp.SceneFile, plan: vp.Solution) -> NDArray[np.uint8]:
    """The replay's picture (height, width, 3)."""
    shot = SHOTS[name]
    with tempfile.TemporaryDirectory() as folder:
        page = vp.replay(scene.robot, plan.trajectory, html=Path(folder, "page.html"), marks=scene.marks())
        script = [] if shot.view is None else [(_VIEW, shot.view)]
        (picture,) = film_frames(page, np.array([shot.at]), SIZE, script)
    return picture


def draw(name: str, scene: vp.SceneFile, plan: vp.Solution) -> None:
    """Write a scene's picture beside its figure."""
    figure = Figure(figsize=(12.0, 4.5), layout="constrained")
    left, right = figure.subfigures(1, 2)
    axes = left.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(photograph(name, scene, plan))
    axes.axis("off")
    SHOTS[name].draw(right, scene, plan)
    save(figure, HERE / "images" / f"gallery_{name}.png")


def row(scene: vp.SceneFile, plan: vp.Solution) -> str:
    """A line of the table."""
    name, truth = scene.path.stem, plan.verify()
    numbers = f"{plan.cost:.5g} | {plan.iterations} | {truth.closed_loop_cost:.5g}"
    size = f"{scene.robot.dof} of {scene.required.described} | {scene.steps} of {scene.dt:g} s"
    return f"| [{name}](#{name.replace('_', '-')}) | {size} | {numbers} |"


def draw_example(name: str) -> None:
    """Run an example, and write its replay's picture beside its figure, or beside a later picture."""
    first, later, view = EXAMPLES[name]
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, HERE.parent / "examples" / f"{name}.py"], cwd=folder, check=True)
        out = Path(folder, "out")
        script = [] if view is None else [(_VIEW, view)]
        pictures = list(film_frames(out / f"{name}.html", np.array([first, later]), SIZE, script))
        drawn = out / f"{name}.png"
        if drawn.exists():
            pictures[1] = imageio.v3.imread(drawn)
    figure = Figure(figsize=(12.0, 4.5), layout="constrained")
    for part, picture in zip(figure.subfigures(1, 2), pictures, strict=True):
        axes = part.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.imshow(picture)
        axes.axis("off")
    save(figure, HERE / "images" / f"gallery_{name}.png")


def main() -> None:
    """Draw what was asked for; of all scenes, the table, too."""
    for name in [name for name in sys.argv[1:] or list(EXAMPLES) if name in EXAMPLES]:
        draw_example(name)
    names = [name for name in sys.argv[1:] or list(SHOTS) if name not in EXAMPLES]
    assert set(SHOTS) == set(scenes())
    lines = ["| scene | joints computed | steps | cost | iterations | true cost |", "|---|---|---|---|---|---|"]
    for name in names:
        scene = vp.load_scene(name)
        plan = scene.solve()
        draw(name, scene, plan)
        lines.append(row(scene, plan))
    if not sys.argv[1:]:
        fill(HERE / "gallery.md", {"table": "\n".join(lines)})


if __name__ == "__main__":
    main()
