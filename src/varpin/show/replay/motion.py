"""Replays of motions: motions and marks at keyframes for meshcat."""

from __future__ import annotations

import math
import os
import reprlib
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.marks import Marks
from varpin.model import Robot
from varpin.show.given import frame_names, motion_of
from varpin.show.replay.drawing import Actor, Stage
from varpin.show.replay.marks import (
    Figure,
    Mark,
    beads,
    paths,
    references,
    require_marks,
    rows_at,
    surroundings,
    target_rows,
)
from varpin.show.replay.page import Inline, inline_page, open_viewer, write_page
from varpin.show.replay.video import check_film, frame_size, frame_times, write_film
from varpin.support.checks import as_floats, flag, positive, require_finite, writable
from varpin.trajectory import Trajectory, kinematic_input_rows

if TYPE_CHECKING:
    import meshcat

    from varpin.control import Solution
    from varpin.control.mpc import MpcRun

# Largest number of keyframes of a page and of frames of a film: some megabytes.
MOST_FRAMES = 10_000
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
    stage = _stage(shown, fps, speed)
    if open:
        return open_viewer(stage)
    if page is None and film is None:
        return inline_page(stage, frame_size(size))
    with tempfile.TemporaryDirectory() as folder:
        written = write_page(page or Path(folder, "page.html"), stage)
        if film is None:
            return written
        times = frame_times(film.suffix.lower(), fps, float(stage.times[-1]), MOST_FRAMES)
        return write_film(film, written, times, frame_size(size))


@dataclass(frozen=True, eq=False)
class _Shown:
    """A robot with its motion and its marks."""

    robot: Robot
    given: Motion  # its motion, plan or run
    marks: Marks  # its marks
    t: Floats  # times of the motion from 0 (N + 1,) [s]
    q: Floats  # configurations (N + 1, n) [rad or m]

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

    @cached_property
    def ghost(self) -> tuple[Floats, Floats] | None:
        """Times (K,) from 0 [s] and configurations (K, n) of the ghost, if there is one."""
        if self.marks.ghost is not None:
            return _motion(self.robot, "ghost", motion_of(self.marks.ghost), end=self.t[-1])
        if self.run is None or not self.ahead:
            return None
        rows = self.run.planned(self.ahead)
        return self.run.period * np.arange(len(rows), dtype=np.float64), rows

    def times(self) -> list[Floats]:
        """The times of everything that moves [s]: the robot, its ghost, its targets."""
        targets = target_rows(self.marks.targets, self.t[-1]).values()
        moving = [np.linspace(0.0, self.t[-1], len(places)) for places, _ in targets if len(places) > 1]
        return [self.t, *moving, *([] if self.ghost is None else [self.ghost[0]])]

    def actor(self, times: Floats, traced: Sequence[str], frames: Sequence[str]) -> Actor:
        """The robot with its marks at the keyframes (K,) [s]."""
        robot, marks, t, end, ghost = self.robot, self.marks, self.t, times[-1], self.ghost
        own_times, clock = np.minimum(times, t[-1]), times if marks.growing else None

        def annotate(figure: Figure) -> Iterator[Mark]:
            yield from references(figure, marks.reference)
            yield from paths(figure, "motion", traced, t, self.q, end, clock)
            # The planned configurations of a run jump from plan to plan and have no trace.
            if ghost is not None and marks.ghost is not None:
                yield from paths(figure, "ghost", traced, *ghost, end, clock)
            if self.run is not None and self.ahead:
                yield from beads(figure, traced, self.run, self.ahead, own_times)
            yield from surroundings(figure, marks, frames, self.given, own_times, t[-1])

        motions = {"robot": (t, self.q), **({} if ghost is None else {"ghost": ghost})}
        effort = _effort(robot, self.given, marks.torques, times / (t[-1] or 1.0))
        return Actor(robot, {name: rows_at(times, *motion) for name, motion in motions.items()}, annotate, effort)


def _shown(robot: Robot | Sequence[Shown], motion: Motion | None, dt: float | None, marks: Marks) -> list[_Shown]:
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
        t, q = _motion(arm, f"motion {k + 1}" if len(pairs) > 1 else "motion", motion_of(given), dt)
        found.append(_Shown(arm, given, require_marks(own[0]) if own else marks, t, q))
    steps = [motion_of(one.given) for one in found]
    if dt is not None and all(isinstance(path, Trajectory) for path in steps):
        raise InputError(f"dt belongs to an array of configurations; this trajectory has its own, {steps[0].dt:g} s")
    if any(one.marks.ahead is not None for one in found) and not any(one.run for one in found):
        raise InputError("ahead needs a run of an Mpc with its plans; the motion is not one")
    return found


def _stage(shown: Sequence[_Shown], fps: float, speed: float) -> Stage:
    """The robots at the keyframes."""
    end = max(one.t[-1] for one in shown)
    times = _times([t for one in shown for t in one.times()], end, fps / speed)
    robots = [one.robot for one in shown]
    frames = [
        [frame_names(name, robots, getattr(one.marks, name))[k] for name in ("trace", "frames")]
        for k, one in enumerate(shown)
    ]
    motions = [motion_of(one.given) for one in shown]
    errors = [path.error_text for path in motions if isinstance(path, Trajectory) and path.error_text]
    notes = [f"estimated {'; '.join(errors)} rad or m"] if errors else []
    notes += [f"drawn every {times[1]:.2g} s, straight in between"] if len(times) == MOST_FRAMES else []
    return Stage.of(
        times / speed,
        [one.actor(times, *names) for one, names in zip(shown, frames, strict=True)],
        speed,
        "; ".join(notes),
    )


def _motion(
    robot: Robot, name: str, motion: Trajectory | ArrayLike, dt: float | None = None, end: float | None = None
) -> tuple[Floats, Floats]:
    """Times (N + 1,) from 0 [s], with ``dt`` or up to an ``end``, and configurations (N + 1, n)."""
    if isinstance(motion, Trajectory):
        if motion.joint_names != robot.joint_names:
            raise InputError(
                f"the {name} is of robot {motion.robot!r} with joints {', '.join(motion.joint_names)}; "
                f"{robot.name!r} has joints {', '.join(robot.joint_names)}"
            )
        for what in ("rotation", "translation"):
            saved, present = motion.scene_values.get(what), getattr(robot.tree, what)
            if saved is not None and (saved.shape != present.shape or not np.allclose(saved, present, atol=1e-9)):
                raise InputError(
                    f"the {name} is of robot {motion.robot!r}, whose joints have the names of those of {robot.name!r} "
                    "but other placements"
                )
        return motion.t - motion.t[0], require_finite(f"{name}.q", motion.q)
    q = as_floats(name, motion)
    if q.ndim != 2 or q.shape[1] != robot.dof or not len(q):
        rows = "(N + 1, {}), one row a node" if end is None else "(K, {}), rows spread evenly over the motion's time"
        raise InputError(f"{name} must have shape {rows.format(robot.dof)}, got {q.shape}")
    require_finite(name, q)
    if end is not None:
        if end == 0.0 and len(q) > 1:
            raise InputError(f"the motion is a single pose, so its ghost must be one row, too, got {len(q)}")
        return np.linspace(0.0, end, len(q)), q
    if dt is None:
        raise InputError("an array of configurations needs dt, the time between its rows [s]")
    return np.arange(len(q), dtype=np.float64) * positive("dt", dt, "s"), q


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


def _effort(robot: Robot, given: object, torques: object, shares: Floats) -> Floats | None:
    """Torque of each joint of the tree as a share of its limit (K, b), in [0, 1]; None if torques are not shown.

    ``torques`` are given (N, n), or True for the motion's controls; ``shares`` (K,) are those of the motion's time. A
    joint without a limit is held against its own largest torque.
    """
    values = torques
    if isinstance(torques, bool | np.bool_):
        if not torques:
            return None
        motion = motion_of(given)
        if (
            not isinstance(motion, Trajectory)
            or motion.u.shape[1] != robot.dof
            or motion.scene_values.get("PositionServo", np.zeros(0)).size
            or len(kinematic_input_rows(motion))
        ):
            raise InputError(
                f"torques=True needs a motion with a torque of each of {robot.dof} joints as its controls, without "
                f"servos and kinematic inputs: give the torques (N, {robot.dof}) themselves"
            )
        values = motion.u
    size = np.abs(require_finite("torques", as_floats("torques", values)))
    if size.ndim != 2 or size.shape[1] != robot.dof:
        raise InputError(f"torques must have shape (N, {robot.dof}), one row a step, got {size.shape}")
    if not len(size):
        return np.zeros((len(shares), len(robot.tree.parent)))
    bound = np.where(np.isfinite(robot.effort_limit), robot.effort_limit, size.max(axis=0))
    # Constant over each step; the value of the last step also holds at the end.
    step = np.minimum((shares * len(size) * (1.0 + 1e-12)).astype(int), len(size) - 1)
    return np.minimum(size / np.where(bound > 0.0, bound, 1.0), 1.0)[step][:, robot.tree.coordinate]
