"""A motion as keyframes in time, to be shown by meshcat."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.checks import as_floats, count, positive, require_finite, writable
from varpin.errors import InputError
from varpin.robot import Robot
from varpin.trajectory import Trajectory

if TYPE_CHECKING:
    import meshcat

Floats = NDArray[np.float64]


def replay(
    robot: Robot,
    motion: Trajectory | ArrayLike,
    *,
    html: str | os.PathLike[str] | None = None,
    open: bool = False,
    dt: float | None = None,
    ghost: Trajectory | ArrayLike | None = None,
    speed: float = 1.0,
    loop: bool = True,
    fps: float = 30.0,
    max_frames: int = 10_000,
) -> Path | meshcat.Visualizer:
    """Show a motion in meshcat, in the time it took.

    Main args:
        robot: The arm that moved.
        motion: A trajectory, or configurations (N + 1, n) [rad or m] with ``dt``. A single row shows a pose.
        html: Write one self-contained HTML file here. It plays by itself, with neither server nor network.
        open: Open a live window instead.

    Other Args:
        dt: Time between the rows of an array [s].
        ghost: A second motion of the same robot, drawn translucent in the same place: a reference, another plan. A
            trajectory of any time step, started together with the motion, cut at its end and held if it is over
            before; or configurations (K, n) [rad or m] spread evenly over the motion's time, of which a single row
            stands still.
        speed: Playback speed; 1 is true speed, 0.1 ten times slower.
        loop: Start again at the end; otherwise stop there.
        fps: Keyframes a second of playback. Between them the page interpolates q linearly, and draws at the
            screen's own rate.
        max_frames: Most keyframes; a longer motion gets fewer a second and keeps its speed.

    The meshes are the robot's own. Where a link's is missing, or the source has none at all, a skeleton of its joint
    and centre of mass stands in, and the log says why. The ghost leaves out what cannot move, and gives way to the
    robot where they coincide.

    The live window's server belongs to this process and ends with it; ``.wait()`` on the returned visualizer blocks
    until a browser has connected. The server listens on every network interface of the machine, as meshcat's always
    does.

    Returns:
        The path of the file, or the ``meshcat.Visualizer`` of the window.

    Raises:
        InputError: Neither or both of ``html`` and ``open``; a motion or a ghost of another shape or another robot, or
            not finite; ``dt`` missing or out of place.
        FileError: The file cannot be written.
    """
    if not isinstance(robot, Robot):
        raise InputError(f"robot must come from load_robot, got {type(robot).__name__}")
    if (html is None) != bool(open):
        raise InputError("give either html=path, for a file, or open=True, for a window")
    t, q = _motion(robot, motion, dt)
    speed, fps = positive("speed", speed, "1"), positive("fps", fps, "1/s")
    max_frames = count("max_frames", max_frames, least=2)
    path = None if html is None else writable(html)

    motions = {"robot": (t / speed, q)}
    if ghost is not None:
        ghost_t, ghost_q = _ghost(robot, ghost, t[-1])
        motions["ghost"] = ghost_t / speed, ghost_q

    times, positions = _keyframes(robot, motions, fps, max_frames)
    from varpin.replay import viewer  # noqa: PLC0415 - meshcat is slow to import, and few runs show anything

    if path is None:
        return viewer.show(robot, times, positions, loop)
    return viewer.write_page(path, robot, times, positions, loop)


def _motion(robot: Robot, motion: Trajectory | ArrayLike, dt: float | None) -> tuple[Floats, Floats]:
    """Times (N + 1,) from 0 [s] and configurations (N + 1, n)."""
    if isinstance(motion, Trajectory):
        if dt is not None:
            raise InputError(f"dt belongs to an array of configurations; this trajectory has its own, {motion.dt:g} s")
        return _nodes(robot, "trajectory", "motion", motion)
    q = _rows(robot, "motion", "(N + 1, {}), one row a node", motion)
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
    return motion.t - motion.t[0], require_finite(f"{name}.q", motion.q)


def _rows(robot: Robot, name: str, shape: str, motion: ArrayLike) -> Floats:
    q = as_floats(name, motion)
    if q.ndim != 2 or q.shape[1] != robot.dof or not len(q):
        raise InputError(f"{name} must have shape {shape.format(robot.dof)}, got {q.shape}")
    return require_finite(name, q)


def _keyframes(
    robot: Robot, motions: Mapping[str, tuple[Floats, Floats]], fps: float, max_frames: int
) -> tuple[Floats, dict[str, Floats]]:
    """Keyframe times (K,) [s], and each motion's positions (K, b) [rad or m] of all joints of the tree, mimic ones too.

    The page interpolates linearly between keyframes, so the nodes themselves are enough where they are sparse. All
    motions get the same times: each joint's track repeats by itself, and they must not drift apart.
    """
    own, _ = motions["robot"]
    end = own[-1]
    frames = min(math.ceil(end * fps), max_frames - 1)
    times = own
    for t, _ in motions.values():
        times = np.union1d(times, t[t < end])
    # Nodes of two motions can be the same but for rounding.
    times = times[np.diff(times, prepend=-np.inf) > 1e-9 * end] if end > 0.0 else own
    if frames < len(times) - 1:
        times = np.linspace(0.0, end, frames + 1)
    tree = robot.tree
    positions = {}
    for name, (t, q) in motions.items():
        at = np.column_stack([np.interp(times, t, column) for column in q.T])
        positions[name] = at[:, tree.coordinate] * tree.ratio + tree.offset
    return times, positions
