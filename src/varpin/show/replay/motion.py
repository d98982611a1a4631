"""Motions as keyframes in time, to be shown by meshcat."""

from __future__ import annotations

import logging
import math
import os
import reprlib
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.errors import InputError
from varpin.model import Robot
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
from varpin.support.checks import JointValues, as_floats, count, finite_array, positive, require_finite, writable
from varpin.trajectory import Trajectory

if TYPE_CHECKING:
    import meshcat

    from varpin.control import OptimalControlProblem, Solution
    from varpin.control.mpc import MpcRun
    from varpin.mechanics.scene import Scene
    from varpin.show.replay.page import Inline

logger = logging.getLogger(__name__)

Floats = NDArray[np.float64]
# What a joint may be off by between keyframes without a word [rad or m].
_SEEN = 0.02
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
    """Show a motion in meshcat, in the time it took.

    Main args:
        robot: The arm that moved; or pairs of an arm and its motion, to be shown side by side on one clock: a plan and
            its execution, two scenes. What is over before the others is held.
        motion: A trajectory or a plan; a run of :class:`varpin.Mpc`, which is shown with its plans; or configurations
            (N + 1, n) [rad or m] with ``dt``, of which a single row shows a pose.
        html: Write one self-contained HTML file here. It plays by itself, with neither server nor network.
        video: Write a film here, as ``.gif`` or ``.mp4``; with or without ``html``.
        open: Open a live window instead.
        inline: Return the page instead, to be shown by a notebook as the value of its cell.

    Other Args:
        dt: Time between the rows of an array [s].
        ghost: A second motion of the same robot, drawn translucent in the same place: a reference, another plan. A
            trajectory of any time step, started together with the motion, cut at its end and held if it is over
            before; or configurations (K, n) [rad or m] spread evenly over the motion's time, of which a single row
            stands still. Of several robots, a list with one for each, or None. The ghost of a run of
            :class:`varpin.Mpc`, if none is given, is where its plans mean to be.
        ahead: How far ahead the plans of such a run are shown [s]: where they mean to be then, as the ghost, and the
            way of each traced frame up to there, as beads. To the end of the horizon if left out, 0 for not at all.
        trace: Frames whose paths are drawn, the motion's and the ghost's; ``True`` for the end effector.
        growing: Draw these paths as far as the motion has come.
        reference: A path (K, 3) in the world [m] to draw, or several by name.
        targets: What to reach, by name, which is shown: a point (3,) [m], a pose (4, 4) or ``pin.SE3``; or rows of
            them, (K, 3) or (K, 4, 4), spread evenly over the motion's time. In the world of each robot.
        frames: Frames to draw as triads, x red, y green, z blue; ``True`` for the end effector.
        torques: Colour each link by the torque of the joint that moves it, grey for none, red at its limit: ``True``
            for the controls of the trajectory, one a joint; or the torques (N, n) themselves [N m or N], of N steps
            spread evenly over the motion's time. Of several robots, that for all of them, or a list with one for each.
        torque_limit: One number, (n,) or by joint name [N m or N]; the robot's effort limits if left out. A joint
            without one is red at its own largest torque.
        constraints: Draw what the motion is held to: where constraints of the mechanism act, and of a plan its
            obstacles, regions and goals. ``True`` takes them from a plan or a controller's run, and ``False`` draws
            none; a trajectory or an array has none of its own, so give its scene or its problem. Of several robots,
            True or False for all of them, or a list with one for each.
        offset: From each of several robots to the next (3,) [m]; far enough to see them all if left out.
        speed: Playback speed; 1 is true speed, 0.1 ten times slower.
        loop: Start again at the end; otherwise stop there.
        fps: Keyframes a second of playback, and frames of a film. Between them the page interpolates q linearly, and
            draws at the screen's own rate.
        max_frames: Most keyframes, and frames of a film; a longer motion gets fewer a second and keeps its speed, and
            the log says so where joints are off by 0.02 rad or m between them.
        size: Width and height of a film, or at most of a frame in a notebook [pixels].

    The meshes are the robot's own. Where one cannot be read, its link becomes a skeleton, as the whole robot does where
    the source has none, and the log says why. The ghost leaves out what cannot move, and gives way to the robot where
    they coincide.

    The live window's server belongs to this process and ends with it; ``.wait()`` on the returned visualizer blocks
    until a browser has connected. The server listens on every network interface of the machine, as meshcat's always
    does.

    A film is taken by a headless Chromium that draws the page at the frames' exact times, so it is the same on a slow
    machine. A GIF's frames last whole hundredths of a second; ``fps`` is rounded to that.

    Returns:
        The path of the film, if there is one, or of the page; or the ``meshcat.Visualizer`` of the window; or the page,
        as an object that notebooks show.

    Raises:
        InputError: Neither a file nor ``open``, or both; a motion or a ghost of another shape or another robot, or not
            finite; ``dt`` missing or out of place; a frame that is not there; a target, a reference, torques,
            ``constraints`` or an ``offset`` that are none, or of another robot.
        FileError: The file cannot be written.
        MissingDependency: A film needs imageio, selenium, Chromium or its driver, which are not there.
    """
    shown = _pairs(robot, motion)
    several = len(shown) > 1
    if (html is not None or video is not None) + bool(open) + bool(inline) != 1:
        raise InputError(
            "give either html=path, for a file, or open=True, for a window; or video=path, for a film; or inline=True, "
            "for a notebook"
        )
    runs = [run if _is_run(run) else None for _, run in shown]
    pairs = [(arm, _moved(moved)) for arm, moved in shown]
    steps = [moved.dt for _, moved in pairs if isinstance(moved, Trajectory)]
    if dt is not None and len(steps) == len(pairs):
        raise InputError(f"dt belongs to an array of configurations; this trajectory has its own, {steps[0]:g} s")
    motions = [
        _motion(arm, moved, dt, f"motion {k + 1}" if several else "motion") for k, (arm, moved) in enumerate(pairs)
    ]
    speed, fps = positive("speed", speed, "1"), positive("fps", fps, "1/s")
    max_frames = count("max_frames", max_frames, least=2)
    page = None if html is None else writable(html)
    film = None if video is None else Film.of(writable(video), size, fps, max_frames)
    end = max(t[-1] for t, _ in motions)
    arms = [arm for arm, _ in pairs]
    looks = [_ahead(ahead, run) for run in runs]
    if ahead is not None and not any(runs):
        raise InputError("ahead is of the plans of an MpcRun; the motion is none")
    ghosts: list[tuple[Floats, Floats] | None] = []
    beside = _each("ghost", ghost, len(pairs))
    for arm, run, look, given in zip(arms, runs, looks, beside, strict=True):
        if given is not None:
            ghosts.append(_ghost(arm, given, end))
        elif run is not None and look > 0.0:
            rows = run.planned(look)
            ghosts.append((run.period * np.arange(len(rows), dtype=np.float64), rows))
        else:
            ghosts.append(None)
    traced, triads = frame_names("trace", arms, trace), frame_names("frames", arms, frames)
    paths, tracks = references(reference), target_tracks(targets, end)
    shares = _shares(pairs, _each("torques", torques, len(pairs)), torque_limit)
    held = [
        parts_of(given, run, arm)
        for given, (arm, run) in zip(_each("constraints", constraints, len(shown)), shown, strict=True)
    ]
    step = None if offset is None else finite_array("offset", offset, (3,))

    moving = [t for t, _, _ in tracks.values() if len(t) > 1]
    followed = [second[0] for second in ghosts if second is not None]
    times = _times([t for t, _ in motions], followed + moving, end, fps / speed, max_frames)
    _say_thinned(motions, times, max_frames)
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
        # A ghost that jumps from plan to plan leaves no trace.
        if second is not None and beside[k] is not None:
            lines += traces("ghost", arm, traced[k], *second, end, clock)
        efforts = _efforts(arm, shares[k], t[-1], times)
        scene, wanted, begin = held[k]
        beyond = (ties(scene), regions(wanted, begin + np.minimum(times, t[-1])), goals(wanted, marked))
        actors.append(Actor(arm, positions, tuple(lines), tuple(plans), triads[k], efforts, *beyond))
    script = Script(times / speed, tuple(actors), paths, marked, step, loop, speed)

    from varpin.show.replay import viewer  # noqa: PLC0415 - meshcat is slow to import, and few runs show anything

    if inline:
        return viewer.inline(script, frame_size(size))
    if page is None and film is None:
        return viewer.show(script)
    with tempfile.TemporaryDirectory() as folder:
        written = viewer.write_page(page or Path(folder, "page.html"), script)
        return written if film is None else film.take(written, float(script.times[-1]))


def _each(name: str, given: Any, robots: int) -> list[Any]:
    """One for each robot: all of a list, or the same for all of what is no motion."""
    if robots == 1:
        return [given]
    if given is None or isinstance(given, bool | np.bool_):
        return [given] * robots
    if not isinstance(given, list | tuple) or len(given) != robots:
        raise InputError(f"{name} of several robots must be a list with one for each of the {robots}")
    return list(given)


def _is_run(motion: object) -> TypeGuard[MpcRun]:
    """Whether a motion is a controller's; asked of what it can do, as few replays need controllers imported."""
    return hasattr(motion, "planned")


def _moved(motion: Motion) -> Trajectory | ArrayLike:
    """What moves: of a controller's run the plant's motion, of a plan its own."""
    if _is_run(motion):
        return motion.motion
    return cast("Trajectory | ArrayLike", getattr(motion, "trajectory", motion))


def _ahead(ahead: float | None, run: MpcRun | None) -> float:
    """How far ahead a run's plans are shown [s]; 0 for not at all."""
    if run is None:
        return 0.0
    if ahead is None:
        return run.plans[0].problem.duration
    return ahead if isinstance(ahead, int | float) and ahead == 0 else positive("ahead", ahead, "s")


def _shares(
    pairs: Sequence[tuple[Robot, Trajectory | ArrayLike]], torques: Sequence[Any], limit: JointValues | None
) -> list[Floats | None]:
    """:func:`torque_shares` of each robot; the limit is of those that are coloured."""
    hidden = [isinstance(torque, bool | np.bool_) and not torque for torque in torques]
    limits = [None if out and not all(hidden) else limit for out in hidden]
    return [torque_shares(*pair, torque, bound) for pair, torque, bound in zip(pairs, torques, limits, strict=True)]


def _pairs(robot: Robot | Sequence[tuple[Robot, Motion]], motion: Motion | None) -> list[tuple[Robot, Motion]]:
    """Each robot with its motion."""
    if isinstance(robot, Robot):
        if motion is None:
            raise InputError("give the robot's motion: a trajectory, or configurations with dt")
        return [(robot, motion)]
    if not isinstance(robot, list | tuple) or not robot:
        raise InputError(f"robot must come from load_robot, got {type(robot).__name__}")
    if motion is not None:
        raise InputError("of several robots, give pairs of a robot and its motion, and no motion beside them")
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
    """The same of the ghost, beside a motion of some duration [s]."""
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
        made, given = motion.scene_values.get(what), getattr(robot.tree, what)
        if made is not None and not (made.shape == given.shape and np.allclose(made, given, rtol=1e-6, atol=1e-9)):
            raise InputError(
                f"the {title} is of robot {motion.robot!r}, whose joints lie otherwise than those of {robot.name!r}, "
                "which have the same names"
            )
    return motion.t - motion.t[0], require_finite(f"{name}.q", motion.q)


def _rows(robot: Robot, name: str, shape: str, motion: ArrayLike) -> Floats:
    q = as_floats(name, motion)
    if q.ndim != 2 or q.shape[1] != robot.dof or not len(q):
        raise InputError(f"{name} must have shape {shape.format(robot.dof)}, got {q.shape}")
    return require_finite(name, q)


def _times(motions: Sequence[Floats], others: Sequence[Floats], end: float, fps: float, max_frames: int) -> Floats:
    """Keyframe times (K,) from 0 to ``end`` [s], of motions with given times and of whatever moves beside them.

    The page interpolates linearly between keyframes, so the nodes themselves are enough where they are sparse.
    """
    if end == 0.0:
        return np.zeros(1)
    frames = min(math.ceil(end * fps), max_frames - 1)
    times = np.array([0.0, end])
    for t in (*motions, *others):
        times = np.union1d(times, t[t < end])
    # Nodes of two motions can be the same but for rounding.
    times = times[np.diff(times, prepend=-np.inf) > 1e-9 * end]
    times[-1] = end
    return np.linspace(0.0, end, frames + 1) if frames < len(times) - 1 else times


def _say_thinned(motions: Sequence[tuple[Floats, Floats]], times: Floats, max_frames: int) -> None:
    """Say if so few keyframes are left of a long motion that it is seen to be another."""
    if len(times) < max_frames:
        return
    off = max(
        float(np.abs(np.interp(t, times, np.interp(times, t, column)) - column).max())
        for t, q in motions
        for column in q.T
    )
    if off > _SEEN:
        logger.warning(
            "%g s of motion are shown with %d keyframes, between which joints are off by up to %.2g rad or m: a larger "
            "max_frames, or a part of the motion, shows more",
            times[-1], len(times), off,
        )  # fmt: skip


def _positions(robot: Robot, t: Floats, q: Floats, times: Floats) -> Floats:
    """Positions (K, b) [rad or m] of all joints of the tree, mimic ones too, at the keyframes."""
    tree = robot.tree
    at = np.column_stack([np.interp(times, t, column) for column in q.T])
    return at[:, tree.coordinate] * tree.ratio + tree.offset


def _efforts(robot: Robot, shares: Floats | None, end: float, times: Floats) -> Floats | None:
    """Shares of the limit (K, b) of all joints of the tree at the keyframes, from those of N steps to ``end`` [s]."""
    if shares is None or not len(shares) or end == 0.0:
        return None if shares is None else np.zeros((len(times), len(robot.tree.parent)))
    # Constant over each step; the last one's holds at the end.
    step = np.minimum((times / end * len(shares) * (1.0 + 1e-12)).astype(int), len(shares) - 1)
    return shares[step][:, robot.tree.coordinate]
