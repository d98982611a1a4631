"""Replays of motions: motions and marks at keyframes for meshcat."""

from __future__ import annotations

import logging
import math
import os
import reprlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.marks import Marks
from varpin.model import Robot
from varpin.show.given import frame_names, motion_of
from varpin.show.replay.annotations import (
    beads,
    paths,
    references,
    require_marks,
    rows_at,
    surroundings,
    target_rows,
    torque_shares,
)
from varpin.show.replay.drawing import Actor, Script
from varpin.show.replay.marks import Mark
from varpin.show.replay.page import Inline, inline_page, open_viewer, write_page
from varpin.show.replay.video import check_film, frame_size, frame_times, write_film
from varpin.support.checks import as_floats, flag, positive, require_finite, writable
from varpin.trajectory import Trajectory

if TYPE_CHECKING:
    import meshcat

    from varpin.control import Solution
    from varpin.control.mpc import MpcRun

logger = logging.getLogger(__name__)

# Largest number of keyframes of a page and of frames of a film: some megabytes.
MOST_FRAMES = 10_000
# Threshold of the warning: error of a joint position between keyframes [rad or m].
_VISIBLE = 0.02
Motion: TypeAlias = "Trajectory | MpcRun | Solution | ArrayLike"
Shown: TypeAlias = "tuple[Robot, Motion] | tuple[Robot, Motion, Marks]"


def replay(
    robot: Robot | Sequence[Shown],
    motion: Motion | None = None,
    *,
    html: str | os.PathLike[str] | None = None,
    open: bool = False,
    video: str | os.PathLike[str] | None = None,
    dt: float | None = None,
    marks: Marks | None = None,
    speed: float = 1.0,
    fps: float = 30.0,
    size: tuple[int, int] = (800, 600),
) -> Path | meshcat.Visualizer | Inline:
    """Show a motion in meshcat, in real time.

    Main args:
        robot: The robot; or pairs of a robot and its motion, shown side by side on one clock: a plan and its execution,
            two scenes. A third entry of a pair is its own marks, instead of ``marks``. A motion that ends before the
            others stays at its end.
        motion: A trajectory or a plan; a run of :class:`varpin.Mpc`, which is shown with its plans; or configurations
            (N + 1, n) [rad or m] with ``dt``, of which a single row shows a pose.
        html: Write one self-contained HTML file here. It needs neither a server nor a network.
        video: Write a film here, as ``.gif`` or ``.mp4``; with or without ``html``.
        open: Open a live window instead. With none of these three, the page is returned, which a notebook shows as the
            value of a cell.
        marks: What to show beside the robot.

    Other Args:
        dt: Time between the rows of an array [s].
        speed: Playback speed; 1 is true speed, 0.1 ten times slower.
        fps: Keyframes a second of playback, 10,000 at most, and frames of a film. Between keyframes the page
            interpolates q linearly and draws at the screen's own rate; the log warns if joints are off by 0.02 rad or
            m there.
        size: Width and height of a film, or largest size of a frame in a notebook [pixels].

    The meshes are the robot's own. A link whose mesh cannot be read is drawn as a skeleton, as is a robot without
    meshes, and the log gives the reason. The ghost has no links of the base, and the robot covers it where they
    coincide.

    The live window's server belongs to this process and ends with it; ``.wait()`` on the returned visualizer blocks
    until a browser has connected. The server listens on every network interface of the machine, as meshcat's always
    does.

    A headless Chromium draws a film at the exact times of its frames, so that it does not depend on the speed of the
    machine. A GIF's frames last whole hundredths of a second; ``fps`` is rounded to that.

    Returns:
        The path of the film, if there is one, or of the page; or the ``meshcat.Visualizer`` of the window; or the page,
        as an object that notebooks show.

    Raises:
        InputError: Both a file and ``open`` are given; a motion or a ghost has another shape, is of another robot, or
            is not finite; ``dt`` is missing or superfluous; a frame does not exist; or another mark is invalid or of
            another robot.
        FileError: The file cannot be written.
        MissingDependency: A film needs imageio, selenium, Chromium or its driver, and one of them is not installed.
    """
    if flag("open", open) and not (html is None and video is None):
        raise InputError("give either open=True, for a window, or html=path and video=path, for files")
    figures = _figures(robot, motion, dt, require_marks(marks))
    speed, fps = positive("speed", speed, "1"), positive("fps", fps, "1/s")
    page = None if html is None else writable(html)
    film = None if video is None else writable(video)
    if film is not None:
        check_film(film, size)
    script = Script(*_keyframes(figures, fps, speed), speed, _error(figures))
    if open:
        return open_viewer(script)
    if page is None and film is None:
        return inline_page(script, frame_size(size))
    with tempfile.TemporaryDirectory() as folder:
        written = write_page(page or Path(folder, "page.html"), script)
        if film is None:
            return written
        times = frame_times(film.suffix.lower(), fps, float(script.times[-1]), MOST_FRAMES)
        return write_film(film, written, times, frame_size(size))


@dataclass(frozen=True, eq=False)
class _Figure:
    """A robot with its motion and its marks.

    Attributes:
        robot: The robot.
        given: Its motion, plan or run.
        marks: Its marks.
        t: Times of the motion from 0 (N + 1,) [s].
        q: Configurations (N + 1, n) [rad or m].
    """

    robot: Robot
    given: Motion
    marks: Marks
    t: Floats
    q: Floats

    @property
    def run(self) -> MpcRun | None:
        """The motion if it is a controller's run; told by its attributes, to avoid an import of controllers."""
        return cast("MpcRun", self.given) if hasattr(self.given, "planned") else None

    @property
    def ahead(self) -> float:
        """Time ahead at which a run's plans are shown [s]; 0 to show none."""
        if self.run is None:
            return 0.0
        if (ahead := self.marks.ahead) is None:
            return self.run.plans[0].problem.duration
        return 0.0 if ahead == 0 else positive("ahead", ahead, "s")

    def ghost(self, end: float) -> tuple[Floats, Floats] | None:
        """Times (K,) from 0 [s] and configurations (K, n) of the ghost, if there is one."""
        if self.marks.ghost is None:
            if self.run is None or not self.ahead:
                return None
            rows = self.run.planned(self.ahead)
            return self.run.period * np.arange(len(rows), dtype=np.float64), rows
        ghost = motion_of(self.marks.ghost)
        if isinstance(ghost, Trajectory):
            return _nodes(self.robot, "ghost", ghost)
        q = _rows(self.robot, "ghost", "(K, {}), its rows spread evenly over the motion's time", ghost)
        if end == 0.0 and len(q) > 1:
            raise InputError(f"the motion is a single pose, so its ghost must be one row, too, got {len(q)}")
        return np.linspace(0.0, end, len(q)), q

    def times(self, end: float) -> list[Floats]:
        """The times of everything that moves [s]: the robot, its ghost, its targets."""
        targets = target_rows(self.marks.targets, self.t[-1]).values()
        moving = [np.linspace(0.0, self.t[-1], len(places)) for places, _ in targets if len(places) > 1]
        ghost = self.ghost(end)
        return [self.t, *moving, *([] if ghost is None else [ghost[0]])]


def _figures(robot: Robot | Sequence[Shown], motion: Motion | None, dt: float | None, marks: Marks) -> list[_Figure]:
    """Each robot with its motion and its marks."""
    if isinstance(robot, Robot):
        if motion is None:
            raise InputError("give the robot's motion: a trajectory, or configurations with dt")
        shown: Sequence[Any] = [(robot, motion)]
    elif not isinstance(robot, list | tuple) or not robot:
        raise InputError(
            f"robot must come from load_robot, or be pairs of a robot and its motion, got {reprlib.repr(robot)}"
        )
    elif motion is not None:
        raise InputError("for several robots, give pairs of a robot and its motion, and no other motion")
    else:
        shown = robot
    found = []
    for k, pair in enumerate(shown):
        if not (isinstance(pair, list | tuple) and len(pair) in (2, 3) and isinstance(pair[0], Robot)):
            raise InputError(f"several robots must be pairs of a robot and its motion, got {reprlib.repr(pair)}")
        arm, given, *own = pair
        t, q = _motion(arm, motion_of(given), dt, f"motion {k + 1}" if len(shown) > 1 else "motion")
        found.append(_Figure(arm, given, require_marks(own[0]) if own else marks, t, q))
    steps = [motion_of(figure.given) for figure in found]
    if dt is not None and all(isinstance(path, Trajectory) for path in steps):
        raise InputError(f"dt belongs to an array of configurations; this trajectory has its own, {steps[0].dt:g} s")
    if any(figure.marks.ahead is not None for figure in found) and not any(figure.run for figure in found):
        raise InputError("ahead needs a run of an Mpc with its plans; the motion is not one")
    return found


def _keyframes(figures: Sequence[_Figure], fps: float, speed: float) -> tuple[Floats, tuple[Actor, ...]]:
    """Times of the keyframes (K,) [s of playback], and the robots at them."""
    end = max(figure.t[-1] for figure in figures)
    times = _times([t for figure in figures for t in figure.times(end)], end, fps / speed)
    _warn_if_thinned(figures, times)
    robots = [figure.robot for figure in figures]
    return times / speed, tuple(_actor(figure, robots, k, times) for k, figure in enumerate(figures))


def _actor(figure: _Figure, robots: Sequence[Robot], k: int, times: Floats) -> Actor:
    """The k-th of the robots with its marks at the keyframes (K,) [s]."""
    robot, marks, t, end = figure.robot, figure.marks, figure.t, times[-1]
    ghost, own_times = figure.ghost(end), np.minimum(times, t[-1])
    traced, frames = (frame_names(name, robots, getattr(marks, name))[k] for name in ("trace", "frames"))
    clock = times if marks.growing else None
    own: list[Mark] = [*references(marks.reference), *paths("motion", robot, traced, t, figure.q, end, clock)]
    motions = {"robot": rows_at(times, t, figure.q)}
    if ghost is not None:
        motions["ghost"] = rows_at(times, *ghost)
        # The planned configurations of a run jump from plan to plan and have no trace.
        own += paths("ghost", robot, traced, *ghost, end, clock) if marks.ghost is not None else []
    if figure.run is not None and figure.ahead:
        own += beads(robot, traced, figure.run, figure.ahead, own_times)
    own += surroundings(robot, marks, frames, figure.given, own_times, t[-1])
    shares = torque_shares(robot, figure.given, marks.torques)
    effort = None if shares is None else np.zeros((len(times), len(robot.tree.parent)))
    if shares is not None and len(shares) and t[-1] > 0.0:
        # Constant over each step; the value of the last step also holds at the end.
        step = np.minimum((times / t[-1] * len(shares) * (1.0 + 1e-12)).astype(int), len(shares) - 1)
        effort = shares[step][:, robot.tree.coordinate]
    return Actor(robot, motions, tuple(own), effort)


def _error(figures: Sequence[_Figure]) -> str:
    """The estimated error of the motions in words."""
    motions = [motion_of(figure.given) for figure in figures]
    errors = [path.error_text for path in motions if isinstance(path, Trajectory) and path.error_text]
    return f"estimated {'; '.join(errors)} rad or m" if errors else ""


def _motion(robot: Robot, motion: Trajectory | ArrayLike, dt: float | None, name: str) -> tuple[Floats, Floats]:
    """Times (N + 1,) from 0 [s] and configurations (N + 1, n)."""
    if isinstance(motion, Trajectory):
        return _nodes(robot, name, motion)
    q = _rows(robot, name, "(N + 1, {}), one row a node", motion)
    if dt is None:
        raise InputError("an array of configurations needs dt, the time between its rows [s]")
    return np.arange(len(q), dtype=np.float64) * positive("dt", dt, "s"), q


def _nodes(robot: Robot, name: str, motion: Trajectory) -> tuple[Floats, Floats]:
    if motion.joint_names != robot.joint_names:
        raise InputError(
            f"the {name} is of robot {motion.robot!r} with joints {', '.join(motion.joint_names)}; "
            f"{robot.name!r} has joints {', '.join(robot.joint_names)}"
        )
    for what in ("rotation", "translation"):
        saved, present = motion.scene_values.get(what), getattr(robot.tree, what)
        if saved is not None and (saved.shape != present.shape or not np.allclose(saved, present, atol=1e-9)):
            raise InputError(
                f"the {name} is of robot {motion.robot!r}, whose joints have the names of those of {robot.name!r} but "
                "other placements"
            )
    return motion.t - motion.t[0], require_finite(f"{name}.q", motion.q)


def _rows(robot: Robot, name: str, shape: str, motion: ArrayLike) -> Floats:
    q = as_floats(name, motion)
    if q.ndim != 2 or q.shape[1] != robot.dof or not len(q):
        raise InputError(f"{name} must have shape {shape.format(robot.dof)}, got {q.shape}")
    return require_finite(name, q)


def _times(given: Sequence[Floats], end: float, fps: float) -> Floats:
    """Keyframe times (K,) from 0 to ``end`` [s], from the times of everything that moves.

    The page interpolates linearly between keyframes, so the given times themselves are enough where they are sparse.
    """
    if end == 0.0:
        return np.zeros(1)
    frames = min(math.ceil(end * fps), MOST_FRAMES - 1)
    times = np.unique(np.concatenate([[0.0, end], *(t[t < end] for t in given)]))
    # Nodes of two motions can be equal up to rounding.
    times = times[np.diff(times, prepend=-np.inf) > 1e-9 * end]
    times[-1] = end
    return np.linspace(0.0, end, frames + 1) if frames < len(times) - 1 else times


def _warn_if_thinned(figures: Sequence[_Figure], times: Floats) -> None:
    """Warn if a long motion has too few keyframes to be shown accurately."""
    if len(times) < MOST_FRAMES:
        return
    off = max(
        float(np.abs(rows_at(figure.t, times, rows_at(times, figure.t, figure.q)) - figure.q).max())
        for figure in figures
    )
    if off > _VISIBLE:
        logger.warning(
            "%g s of motion are shown with %d keyframes, between which joints are off by up to %.2g rad or m: replay "
            "a part of the motion",
            times[-1], len(times), off,
        )  # fmt: skip
