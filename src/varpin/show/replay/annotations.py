"""Marks from what a user gives, checked and sampled at the keyframes: paths, targets, torques."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
import pinocchio as pin
import scipy
from numpy.typing import ArrayLike, NDArray

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.marks import Marks
from varpin.model import Robot
from varpin.show.given import motion_of, problem_of
from varpin.show.replay.marks import Beads, Path, Target
from varpin.show.replay.script import rows_at
from varpin.support.checks import as_floats, require_finite
from varpin.trajectory import Trajectory, kinematic_input_rows

if TYPE_CHECKING:
    from varpin.control.mpc import MpcRun


# Smallest and largest number of points of a trace. Coarse motions are refined, as paths are curved between nodes.
_FEWEST, _MOST = 200, 1000

# Beads on the planned path of a frame.
_BEADS = 12


def paths(
    kind: Literal["motion", "ghost"],
    robot: Robot,
    names: Sequence[str],
    t: Floats,
    q: Floats,
    end: float,
    growing: Floats | None,
) -> list[Path]:
    """The paths of frames along a motion up to a time, without those of frames that do not move.

    Args:
        kind: Whether it is the motion of the robot or of its ghost.
        robot: The robot.
        names: Names of its frames.
        t: Times (N + 1,) [s].
        q: Configurations (N + 1, n) [rad or m], linear in between as on the page.
        end: End of the replay [s].
        growing: Times of the keyframes (K,) [s], to let paths grow with the motion; None for whole paths.
    """
    times = np.append(t[t < end], min(end, t[-1]))
    pieces = len(times) - 1
    if pieces:
        # Points between the nodes, or fewer points than nodes.
        parts = max(1, math.ceil(_FEWEST / pieces))
        fine = np.linspace(0.0, pieces, min(pieces * parts, _MOST) + 1)
        times = np.interp(fine, np.arange(pieces + 1), times)
    rows = rows_at(times, t, q)
    found = []
    for name in names:
        points = robot.frame_positions(rows, name)
        kept = _moves(points)
        if kept.sum() > 1:
            reached = None if growing is None else np.interp(growing, times, np.cumsum(kept) - 1.0)
            found.append(Path(kind, name, points[kept], reached))
    return found


def beads(robot: Robot, names: Sequence[str], run: MpcRun, ahead: float, times: Floats) -> list[Beads]:
    """The planned paths of frames up to a time ``ahead`` [s], at each keyframe (K,) [s]."""
    ticks = run.period * np.arange(len(run.plans) + 1, dtype=np.float64)
    plans = [rows_at(times, ticks, run.planned(ahead * part)) for part in np.arange(1, _BEADS + 1) / _BEADS]
    return [Beads(name, np.stack([robot.frame_positions(q, name) for q in plans], axis=1)) for name in names]


def references(given: ArrayLike | Mapping[str, ArrayLike] | None) -> list[Path]:
    """Paths in the world, by name.

    Raises:
        InputError: A path is not (K, 3), is not finite, or stays in one place.
    """
    if given is None:
        return []
    named = given if isinstance(given, Mapping) else {"reference": given}
    found = []
    for name, value in named.items():
        what = f"reference[{name!r}]" if isinstance(given, Mapping) else "reference"
        points = as_floats(what, value)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"{what} must have shape (K, 3), points on a path in the world [m], got {points.shape}")
        points = points[_moves(require_finite(what, points))]
        if len(points) < 2:
            raise InputError(f"{what} stays in one place; give a single point as a target")
        found.append(Path("reference", str(name), points))
    return found


def _moves(points: Floats) -> NDArray[np.bool_]:
    """Mask (P,) of the points of a path (P, 3) that differ from the last point kept before."""
    kept = np.zeros(len(points), dtype=np.bool_)
    if not len(points):
        return kept
    apart = 1e-5 * float(np.ptp(points, axis=0).max())
    last, kept[0] = points[0], True
    for k, point in enumerate(points):
        if np.linalg.norm(point - last) > apart:
            last, kept[k] = point, True
    return kept


def target_tracks(given: Mapping[str, object] | None, end: float) -> dict[str, tuple[Floats, Floats, Floats | None]]:
    """Times (K,) [s], positions (K, 3) [m] and, for poses, quaternions (K, 4) of each target; one row if it is fixed.

    Args:
        given: Points (3,), poses (4, 4), pin.SE3, or rows of either, spread evenly over the motion's time.
        end: End of the motion [s].

    Raises:
        InputError: A target is none of these, is not finite, or has no rotation; or it moves and the motion does not.
    """
    if given is not None and not isinstance(given, Mapping):
        raise InputError(f"targets must map names to places or poses, as in {{'cup': [0.5, 0, 0.3]}}, got {given!r}")
    found: dict[str, tuple[Floats, Floats, Floats | None]] = {}
    for name, value in (given or {}).items():
        what = f"targets[{name!r}]"
        array = require_finite(what, as_floats(what, _numbers(value)))
        if array.shape in ((3,), (4, 4)):
            array = array[None]
        poses = array.ndim == 3 and array.shape[1:] == (4, 4)
        if not (poses or (array.ndim == 2 and array.shape[1] == 3)) or not len(array):
            raise InputError(
                f"{what} must be a point (3,), a pose (4, 4) or pin.SE3, or rows of them, (K, 3) or (K, 4, 4); got "
                f"shape {array.shape}"
            )
        if len(array) > 1 and end == 0.0:
            raise InputError(f"the motion is a single pose, so {what} must be one row, too, got {len(array)}")
        times = np.linspace(0.0, end, len(array))
        if not poses:
            found[str(name)] = times, array, None
            continue
        R = array[:, :3, :3]
        rigid = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max() < 1e-6 and (np.linalg.det(R) > 0.0).all()
        if not rigid or np.abs(array[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
            raise InputError(f"{what} must be a pose: a rotation and a position above the row 0 0 0 1")
        found[str(name)] = times, array[:, :3, 3], scipy.spatial.transform.Rotation.from_matrix(R).as_quat()
    return found


def _numbers(value: object) -> ArrayLike:
    if isinstance(value, pin.SE3):
        return value.homogeneous
    if isinstance(value, Sequence) and value and all(isinstance(row, pin.SE3) for row in value):
        return [row.homogeneous for row in value]
    return value  # type: ignore[return-value]


def target(name: str, track: tuple[Floats, Floats, Floats | None], times: Floats) -> Target:
    """A target at the keyframes (K,) [s]."""
    t, places, turns = track
    if len(t) == 1:
        return Target(name, places, turns)
    at = rows_at(times, t, places)
    if turns is None:
        return Target(name, at)
    between = scipy.spatial.transform.Slerp(t, scipy.spatial.transform.Rotation.from_quat(turns))
    return Target(name, at, between(np.minimum(times, t[-1])).as_quat())


def torque_shares(robot: Robot, given: object, marks: Marks) -> Floats | None:
    """Torque of each joint in each step as a share of its limit (N, n), in [0, 1]; None if torques are not shown.

    Args:
        robot: The robot.
        given: The motion, whose controls are the torques if ``marks.torques`` is True.
        marks: What to show.

    Raises:
        InputError: The motion does not have torques of all joints, or they are not (N, n).
    """
    torques, own = marks.torques, isinstance(marks.torques, bool | np.bool_)
    if own and not torques:
        return None
    if own:
        motion = motion_of(given)
        if not isinstance(motion, Trajectory):
            raise InputError("torques=True takes the controls of a trajectory; for an array, give the torques (N, n)")
        values, wrong = motion.u, ""
        if values.shape[1] != robot.dof:
            wrong = f"{values.shape[1]} controls for {robot.dof} joints"
        elif motion.scene_values.get("PositionServo", np.zeros(0)).size or len(kinematic_input_rows(motion)):
            wrong = "positions of servos or kinematic inputs"
        if wrong:
            raise InputError(
                f"torques=True takes controls for torques, but this trajectory has {wrong}: give the torques "
                f"(N, {robot.dof}) themselves"
            )
    else:
        values = as_floats("torques", torques)
        if values.ndim != 2 or values.shape[1] != robot.dof:
            raise InputError(f"torques must have shape (N, {robot.dof}), one row a step, got {values.shape}")
    size = np.abs(require_finite("torques", values))
    bounds, problem = [size.max(axis=0, initial=0.0), robot.effort_limit], problem_of(given)
    if own and problem is not None:
        bounds.append(np.abs(problem.control_limits).max(axis=0))
    bound = functools.reduce(lambda before, more: np.where(np.isfinite(more), more, before), bounds)
    return np.minimum(size / np.where(bound > 0.0, bound, 1.0), 1.0)
