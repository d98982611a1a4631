"""Replays of motions: motions and annotations sampled at keyframes for meshcat."""

from __future__ import annotations

import logging
import math
import os
import reprlib
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.model import Robot
from varpin.show.given import motion_of, problem_of
from varpin.show.replay.annotations import (
    frame_names,
    outlooks,
    references,
    target,
    target_tracks,
    torque_shares,
    traces,
)
from varpin.show.replay.script import Actor, Script
from varpin.show.replay.surroundings import goals, parts_of, regions, ties
from varpin.show.replay.video import Film, frame_size
from varpin.support.checks import JointValues, as_floats, count, finite_array, flag, positive, require_finite, writable
from varpin.trajectory import Trajectory

if TYPE_CHECKING:
    import meshcat

    from varpin.control import OptimalControlProblem, Solution
    from varpin.control.mpc import MpcRun
    from varpin.mechanics.scene import Scene
    from varpin.show.replay.page import Inline

logger = logging.getLogger(__name__)

# Threshold of the warning: error of a joint position between keyframes [rad or m].
_VISIBLE = 0.02
Motion: TypeAlias = "Trajectory | MpcRun | Solution | ArrayLike"


def replay(
    robot: Robot | Sequence[tuple[Robot, Motion]],
    motion: Motion | None = None,
    *,
    html: str | os.PathLike[str] | None = None,
    open: bool = False,
    video: str | os.PathLike[str] | None = None,
    inline: bool = False,
    dt: float | None = None,
    ghost: Trajectory | ArrayLike | Sequence[Trajectory | ArrayLike | None] | None = None,
    ahead: float | None = None,
    trace: bool | str | Sequence[str] = False,
    growing: bool = False,
    reference: ArrayLike | Mapping[str, ArrayLike] | None = None,
    targets: Mapping[str, object] | None = None,
    frames: bool | str | Sequence[str] = False,
    torques: bool | ArrayLike | Sequence[bool | ArrayLike] = False,
    torque_limit: JointValues | None = None,
    constraints: bool | Scene | OptimalControlProblem | Sequence[bool | Scene | OptimalControlProblem] = True,
    offset: ArrayLike | None = None,
    speed: float = 1.0,
    loop: bool = True,
    fps: float = 30.0,
    max_frames: int = 10_000,
    size: tuple[int, int] = (800, 600),
) -> Path | meshcat.Visualizer | Inline:
    """Show a motion in meshcat, in real time.

    Main args:
        robot: The robot; or pairs of a robot and its motion, shown side by side on one clock: a plan and its execution,
            two scenes. A motion that ends before the others stays at its end.
        motion: A trajectory or a plan; a run of :class:`varpin.Mpc`, which is shown with its plans; or configurations
            (N + 1, n) [rad or m] with ``dt``, of which a single row shows a pose.
        html: Write one self-contained HTML file here. It needs neither a server nor a network.
        video: Write a film here, as ``.gif`` or ``.mp4``; with or without ``html``.
        open: Open a live window instead.
        inline: Return the page instead, which a notebook shows as the value of a cell.

    Other Args:
        dt: Time between the rows of an array [s].
        ghost: A second motion of the same robot, drawn translucent in the same place: a reference, another plan. Either
            a trajectory of any time step, which starts with the motion and is cut or held at its end; or configurations
            (K, n) [rad or m], spread evenly over the motion's time, of which a single row shows a pose. For several
            robots, a list with one for each, or None. Without it, the ghost of a run of :class:`varpin.Mpc` shows the
            planned configurations.
        ahead: Time ahead at which the plans of such a run are shown [s]: their configurations as the ghost, and the
            planned path of each traced frame as beads. The end of the horizon if left out; 0 to show no plans.
        trace: Frames whose paths are drawn, for the motion and the ghost; ``True`` for the end effector.
        growing: Let these paths grow with the motion.
        reference: A path (K, 3) in the world [m] to draw, or several by name.
        targets: Targets by name, which is shown: a point (3,) [m], a pose (4, 4) or ``pin.SE3``; or rows of them,
            (K, 3) or (K, 4, 4), spread evenly over the motion's time. They are in the world of each robot.
        frames: Frames to draw as triads, x red, y green, z blue; ``True`` for the end effector.
        torques: Colour each link by the torque of the joint that moves it, grey for none, red at its limit: ``True``
            for the controls of the trajectory, one for each joint; or the torques (N, n) themselves [N m or N], of N
            steps spread evenly over the motion's time. For several robots, True or False for all, or a list.
        torque_limit: One number, (n,) or by joint name [N m or N]; if left out the control limits of a plan, where
            ``torques`` is True, and the robot's effort limits where it has none. A joint without a limit is red
            at its own largest torque.
        constraints: Draw the constraints of the mechanism, and the obstacles, regions and goals of a plan. ``True``
            takes them from a plan or a controller's run, ``False`` draws none. A trajectory or an array does not
            contain them: give its scene or its problem. For several robots, True or False for all, or a list.
        offset: Translation from each of several robots to the next (3,) [m]; if left out, so that none hides another.
        speed: Playback speed; 1 is true speed, 0.1 ten times slower.
        loop: Start again at the end; otherwise stop there.
        fps: Keyframes a second of playback, and frames of a film. Between keyframes the page interpolates q linearly
            and draws at the screen's own rate.
        max_frames: Largest number of keyframes, and of frames of a film. A longer motion gets fewer a second and keeps
            its speed; the log warns if joints are off by 0.02 rad or m between keyframes.
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
        InputError: Neither a file nor ``open`` is given, or both; a motion or a ghost has another shape, is of another
            robot, or is not finite; ``dt`` is missing or superfluous; a frame does not exist; or a target, a reference,
            torques, ``constraints`` or ``offset`` are invalid or of another robot.
        FileError: The file cannot be written.
        MissingDependency: A film needs imageio, selenium, Chromium or its driver, and one of them is not installed.
    """
    shown = _pairs(robot, motion)
    several = len(shown) > 1
    open, inline, growing, loop = (
        flag(name, value) for name, value in (("open", open), ("inline", inline), ("growing", growing), ("loop", loop))
    )
    if (html is not None or video is not None) + open + inline != 1:
        raise InputError(
            "give either html=path, for a file, or open=True, for a window; or video=path, for a film; or inline=True, "
            "for a notebook"
        )
    runs = [run if _is_run(run) else None for _, run in shown]
    pairs = [(arm, motion_of(run)) for arm, run in shown]
    steps = [path.dt for _, path in pairs if isinstance(path, Trajectory)]
    if dt is not None and len(steps) == len(pairs):
        raise InputError(f"dt belongs to an array of configurations; this trajectory has its own, {steps[0]:g} s")
    motions = [
        _motion(arm, path, dt, f"motion {k + 1}" if several else "motion") for k, (arm, path) in enumerate(pairs)
    ]
    speed, fps = positive("speed", speed, "1"), positive("fps", fps, "1/s")
    max_frames = count("max_frames", max_frames, least=2)
    page = None if html is None else writable(html)
    film = None if video is None else Film.of(writable(video), size, fps, max_frames)
    end = max(t[-1] for t, _ in motions)
    arms = [arm for arm, _ in pairs]
    looks = [_ahead(ahead, run) for run in runs]
    if ahead is not None and not any(runs):
        raise InputError("ahead needs a run of an Mpc with its plans; the motion is not one")
    ghosts: list[tuple[Floats, Floats] | None] = []
    beside = _each("ghost", ghost, len(pairs))
    for arm, run, look, given in zip(arms, runs, looks, beside, strict=True):
        if given is not None:
            ghosts.append(_ghost(arm, motion_of(given), end))
        elif run is not None and look > 0.0:
            rows = run.planned(look)
            ghosts.append((run.period * np.arange(len(rows), dtype=np.float64), rows))
        else:
            ghosts.append(None)
    traced, triads = frame_names("trace", arms, trace), frame_names("frames", arms, frames)
    paths, tracks = references(reference), target_tracks(targets, end)
    shares = _shares(shown, _each("torques", torques, len(pairs)), torque_limit)
    held = [
        parts_of(given, run, arm)
        for given, (arm, run) in zip(_each("constraints", constraints, len(shown)), shown, strict=True)
    ]
    step = None if offset is None else finite_array("offset", offset, (3,))

    moving = [t for t, _, _ in tracks.values() if len(t) > 1]
    followed = [second[0] for second in ghosts if second is not None]
    times = _times([t for t, _ in motions], followed + moving, end, fps / speed, max_frames)
    _warn_if_thinned(motions, times, max_frames)
    clock = times if growing else None
    marked = tuple(target(name, track, times) for name, track in tracks.items())
    actors = []
    for k, (arm, (t, q)) in enumerate(zip(arms, motions, strict=True)):
        positions, lines = {"robot": _positions(arm, t, q, times)}, traces("motion", arm, traced[k], t, q, end, clock)
        plans = []
        if (second := ghosts[k]) is not None:
            positions["ghost"] = _positions(arm, *second, times)
        run = runs[k]
        if run is not None and looks[k] > 0.0:
            plans = outlooks(arm, traced[k], run, looks[k], np.minimum(times, t[-1]))
        # The ghost of an Mpc run jumps from plan to plan and has no trace.
        if second is not None and beside[k] is not None:
            lines += traces("ghost", arm, traced[k], *second, end, clock)
        efforts = _efforts(arm, shares[k], t[-1], times)
        scene, wanted, begin = held[k]
        beyond = (ties(scene), regions(wanted, begin + np.minimum(times, t[-1])), goals(wanted, marked))
        actors.append(Actor(arm, positions, tuple(lines), tuple(plans), triads[k], efforts, *beyond))
    errors = [path.error_text for _, path in pairs if isinstance(path, Trajectory) and path.error_text]
    told = f"estimated {'; '.join(errors)} rad or m" if errors else ""
    script = Script(times / speed, tuple(actors), paths, marked, step, loop, speed, told)

    from varpin.show.replay import viewer  # noqa: PLC0415 - meshcat is slow to import, and few runs show anything

    if inline:
        return viewer.inline(script, frame_size(size))
    if page is None and film is None:
        return viewer.open_viewer(script)
    with tempfile.TemporaryDirectory() as folder:
        written = viewer.write_page(page or Path(folder, "page.html"), script)
        return written if film is None else film.take(written, float(script.times[-1]))


def _each(name: str, given: Any, robots: int) -> list[Any]:
    """One value for each robot: the entries of a list, or the same None, True or False for all."""
    if robots == 1:
        return [given]
    if given is None or isinstance(given, bool | np.bool_):
        return [given] * robots
    if not isinstance(given, list | tuple) or len(given) != robots:
        raise InputError(f"{name} of several robots must be a list with one for each of the {robots}")
    return list(given)


def _is_run(motion: object) -> TypeGuard[MpcRun]:
    """Whether a motion is the run of a controller; by its attributes, to avoid an import of controllers."""
    return hasattr(motion, "planned")


def _ahead(ahead: float | None, run: MpcRun | None) -> float:
    """Time ahead at which a run's plans are shown [s]; 0 to show none."""
    if run is None:
        return 0.0
    if ahead is None:
        return run.plans[0].problem.duration
    return ahead if isinstance(ahead, int | float) and ahead == 0 else positive("ahead", ahead, "s")


def _shares(
    shown: Sequence[tuple[Robot, Motion]], torques: Sequence[Any], limit: JointValues | None
) -> list[Floats | None]:
    """:func:`torque_shares` of each robot; the limit is for those whose torques are shown."""
    hidden = [isinstance(torque, bool | np.bool_) and not torque for torque in torques]
    limits = [None if out and not all(hidden) else limit for out in hidden]
    given = zip(shown, torques, limits, strict=True)
    return [torque_shares(arm, motion_of(run), torque, bound, problem_of(run)) for (arm, run), torque, bound in given]


def _pairs(robot: Robot | Sequence[tuple[Robot, Motion]], motion: Motion | None) -> list[tuple[Robot, Motion]]:
    """Each robot with its motion."""
    if isinstance(robot, Robot):
        if motion is None:
            raise InputError("give the robot's motion: a trajectory, or configurations with dt")
        return [(robot, motion)]
    if not isinstance(robot, list | tuple) or not robot:
        raise InputError(
            f"robot must come from load_robot, or be pairs of a robot and its motion, got {reprlib.repr(robot)}"
        )
    if motion is not None:
        raise InputError("for several robots, give pairs of a robot and its motion, and no other motion")
    for pair in robot:
        if not (isinstance(pair, list | tuple) and len(pair) == 2 and isinstance(pair[0], Robot)):
            raise InputError(f"several robots must be pairs of a robot and its motion, got {reprlib.repr(pair)}")
    return [(arm, shown) for arm, shown in robot]


def _motion(robot: Robot, motion: Trajectory | ArrayLike, dt: float | None, name: str) -> tuple[Floats, Floats]:
    """Times (N + 1,) from 0 [s] and configurations (N + 1, n)."""
    if isinstance(motion, Trajectory):
        return _nodes(robot, "trajectory", name, motion)
    q = _rows(robot, name, "(N + 1, {}), one row a node", motion)
    if dt is None:
        raise InputError("an array of configurations needs dt, the time between its rows [s]")
    return np.arange(len(q), dtype=np.float64) * positive("dt", dt, "s"), q


def _ghost(robot: Robot, ghost: Trajectory | ArrayLike, duration: float) -> tuple[Floats, Floats]:
    """Times (K,) from 0 [s] and configurations (K, n) of the ghost of a motion with a ``duration`` [s]."""
    if isinstance(ghost, Trajectory):
        return _nodes(robot, "ghost", "ghost", ghost)
    q = _rows(robot, "ghost", "(K, {}), its rows spread evenly over the motion's time", ghost)
    if duration == 0.0 and len(q) > 1:
        raise InputError(f"the motion is a single pose, so its ghost must be one row, too, got {len(q)}")
    return np.linspace(0.0, duration, len(q)), q


def _nodes(robot: Robot, title: str, name: str, motion: Trajectory) -> tuple[Floats, Floats]:
    if motion.joint_names != robot.joint_names:
        raise InputError(
            f"the {title} is of robot {motion.robot!r} with joints {', '.join(motion.joint_names)}; "
            f"{robot.name!r} has joints {', '.join(robot.joint_names)}"
        )
    for what in ("rotation", "translation"):
        saved, present = motion.scene_values.get(what), getattr(robot.tree, what)
        same = saved is None or (saved.shape == present.shape and np.allclose(saved, present, rtol=1e-6, atol=1e-9))
        if not same:
            raise InputError(
                f"the {title} is of robot {motion.robot!r}, whose joints have the same names as those of "
                f"{robot.name!r} but other placements"
            )
    return motion.t - motion.t[0], require_finite(f"{name}.q", motion.q)


def _rows(robot: Robot, name: str, shape: str, motion: ArrayLike) -> Floats:
    q = as_floats(name, motion)
    if q.ndim != 2 or q.shape[1] != robot.dof or not len(q):
        raise InputError(f"{name} must have shape {shape.format(robot.dof)}, got {q.shape}")
    return require_finite(name, q)


def _times(motions: Sequence[Floats], others: Sequence[Floats], end: float, fps: float, max_frames: int) -> Floats:
    """Keyframe times (K,) from 0 to ``end`` [s], from the times of motions and of other moving objects.

    The page interpolates linearly between keyframes, so the given times themselves are enough where they are sparse.
    """
    if end == 0.0:
        return np.zeros(1)
    frames = min(math.ceil(end * fps), max_frames - 1)
    times = np.array([0.0, end])
    for t in (*motions, *others):
        times = np.union1d(times, t[t < end])
    # Nodes of two motions can be equal up to rounding.
    times = times[np.diff(times, prepend=-np.inf) > 1e-9 * end]
    times[-1] = end
    return np.linspace(0.0, end, frames + 1) if frames < len(times) - 1 else times


def _warn_if_thinned(motions: Sequence[tuple[Floats, Floats]], times: Floats, max_frames: int) -> None:
    """Warn if a long motion has too few keyframes to be shown accurately."""
    if len(times) < max_frames:
        return
    off = max(
        float(np.abs(np.interp(t, times, np.interp(times, t, column)) - column).max())
        for t, q in motions
        for column in q.T
    )
    if off > _VISIBLE:
        logger.warning(
            "%g s of motion are shown with %d keyframes, between which joints are off by up to %.2g rad or m: use a "
            "larger max_frames, or replay a part of the motion",
            times[-1], len(times), off,
        )  # fmt: skip


def _positions(robot: Robot, t: Floats, q: Floats, times: Floats) -> Floats:
    """Positions (K, b) [rad or m] of all joints of the tree, mimic joints included, at the keyframes."""
    tree = robot.tree
    at = np.column_stack([np.interp(times, t, column) for column in q.T])
    return at[:, tree.coordinate] * tree.ratio + tree.offset


def _efforts(robot: Robot, shares: Floats | None, end: float, times: Floats) -> Floats | None:
    """Shares of the limit (K, b) of all joints of the tree at the keyframes, from those of N steps to ``end`` [s]."""
    if shares is None or not len(shares) or end == 0.0:
        return None if shares is None else np.zeros((len(times), len(robot.tree.parent)))
    # Constant over each step; the value of the last step also holds at the end.
    step = np.minimum((times / end * len(shares) * (1.0 + 1e-12)).astype(int), len(shares) - 1)
    return shares[step][:, robot.tree.coordinate]
