"""The replay of motions."""

from __future__ import annotations

import os
import reprlib
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from varpin.errors import InputError
from varpin.io.archive import atomic_file
from varpin.marks import Marks
from varpin.model import Robot
from varpin.show.given import motion_of
from varpin.show.replay.figure import MOST_FRAMES, Motion, Shown, read_motion, require_marks
from varpin.show.replay.page import Inline, open_viewer, page_of
from varpin.show.replay.stage import Stage
from varpin.show.replay.video import check_film, frame_size, frame_times, write_film
from varpin.support.checks import flag, positive, writable
from varpin.trajectory import Trajectory

if TYPE_CHECKING:
    import meshcat

Pair: TypeAlias = "tuple[Robot, Motion] | tuple[Robot, Motion, Marks]"


def replay(
    robot: Robot | Sequence[Pair],
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
            interpolates q linearly and draws at the screen's own rate.
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
    shown = _shown(robot, motion, dt, require_marks(marks))
    speed, fps = positive("speed", speed, "1"), positive("fps", fps, "1/s")
    page = None if html is None else writable(html)
    film = None if video is None else writable(video)
    if film is not None:
        check_film(film, size)
    stage = Stage.of(shown, speed, fps)
    if open:
        return open_viewer(stage)
    html_text = page_of(stage)
    if page is None and film is None:
        return Inline(html_text, stage.title, frame_size(size))
    with tempfile.TemporaryDirectory() as folder:
        page = page or Path(folder, "page.html")
        with atomic_file(page) as stream:
            stream.write(html_text.encode())
        if film is None:
            return page
        times = frame_times(film.suffix.lower(), fps, float(stage.times[-1]), MOST_FRAMES)
        return write_film(film, page, times, frame_size(size))


def _shown(robot: Robot | Sequence[Pair], motion: Motion | None, dt: float | None, marks: Marks) -> list[Shown]:
    """Each robot with its motion and its marks."""
    if isinstance(robot, Robot):
        if motion is None:
            raise InputError("give the robot's motion: a trajectory, or configurations with dt")
        pairs: Sequence[Any] = [(robot, motion)]
    elif not isinstance(robot, list | tuple) or not robot:
        raise InputError(
            f"robot must come from load_robot, or be pairs of a robot and its motion, got {reprlib.repr(robot)}"
        )
    elif motion is not None:
        raise InputError("for several robots, give pairs of a robot and its motion, and no other motion")
    else:
        pairs = robot
    found = []
    for k, pair in enumerate(pairs):
        if not (isinstance(pair, list | tuple) and len(pair) in (2, 3) and isinstance(pair[0], Robot)):
            raise InputError(f"several robots must be pairs of a robot and its motion, got {reprlib.repr(pair)}")
        arm, given, *own = pair
        t, q = read_motion(arm, f"motion {k + 1}" if len(pairs) > 1 else "motion", motion_of(given), dt)
        found.append(Shown(arm, given, require_marks(own[0]) if own else marks, t, q))
    steps = [motion_of(one.given) for one in found]
    if dt is not None and all(isinstance(path, Trajectory) for path in steps):
        raise InputError(f"dt belongs to an array of configurations; this trajectory has its own, {steps[0].dt:g} s")
    if any(one.marks.ahead is not None for one in found) and not any(one.run for one in found):
        raise InputError("ahead needs a run of an Mpc with its plans; the motion is not one")
    return found
