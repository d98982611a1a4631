"""Marks from what a user gives, checked and sampled at the keyframes."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.marks import Marks
from varpin.mechanics.constraints import Constraint, Distance, FrameOnFrame, PointOnLine, PointOnPlane, PointOnPoint
from varpin.mechanics.forces import point_of
from varpin.mechanics.scene import Scene
from varpin.model import Robot
from varpin.model.tree import z_to
from varpin.show.given import motion_of, problem_of
from varpin.show.replay.marks import Beads, Mark, Path, Region, Target, Tie, Triad
from varpin.support.checks import as_floats, flag, require_finite
from varpin.trajectory import Trajectory, kinematic_input_rows

if TYPE_CHECKING:
    from varpin.control.constraints import PlanConstraint
    from varpin.control.mpc import MpcRun

# Smallest and largest number of points of a trace. Coarse motions are refined, as paths are curved between nodes.
_FEWEST, _MOST = 200, 1000
# Beads on the planned path of a frame.
_BEADS = 12


def require_marks(marks: Marks | None) -> Marks:
    """The marks, or none; raises an InputError for anything else."""
    if marks is not None and not isinstance(marks, Marks):
        raise InputError(f"marks must be varpin.Marks(...), such as Marks(trace=True), got {reprlib.repr(marks)}")
    marks = Marks() if marks is None else marks
    flag("growing", marks.growing)
    return marks


def rows_at(times: Floats, t: Floats, rows: Floats) -> Floats:
    """Rows (N, n) at times ``t`` (N,), interpolated linearly at ``times`` (K,)."""
    return np.column_stack([np.interp(times, t, column) for column in rows.T])


def paths(
    kind: Literal["motion", "ghost"],
    robot: Robot,
    names: Sequence[str],
    t: Floats,
    q: Floats,
    end: float,
    growing: Floats | None,
) -> list[Path]:
    """The paths of frames along a motion, q (N + 1, n) at t (N + 1,), up to a time, without frames that do not move.

    With times of keyframes (K,) as ``growing`` [s], paths grow with the motion.
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
        kept = _distinct(points)
        if len(kept) > 1:
            passed = np.searchsorted(kept, np.arange(len(times)), side="right") - 1.0
            reached = None if growing is None else np.interp(growing, times, passed)
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
        points = points[_distinct(require_finite(what, points))]
        if len(points) < 2:
            raise InputError(f"{what} stays in one place; give a single point as a target")
        found.append(Path("reference", str(name), points))
    return found


def _distinct(points: Floats) -> list[int]:
    """Indices of the points of a path (P, 3) that differ from the last one kept before."""
    kept = [0] if len(points) else []
    apart = 1e-5 * float(np.ptp(points, axis=0).max()) if kept else 0.0
    for k, point in enumerate(points):
        if np.linalg.norm(point - points[kept[-1]]) > apart:
            kept.append(k)
    return kept


def target_rows(given: Mapping[str, object] | None, end: float) -> dict[str, tuple[Floats, Floats | None]]:
    """Positions (K, 3) [m] of each target and, for poses, quaternions (K, 4); one row if it is fixed.

    Raises:
        InputError: A target is none of these, is not finite, or has no rotation; or it moves and the motion does not.
    """
    if given is not None and not isinstance(given, Mapping):
        raise InputError(f"targets must map names to places or poses, as in {{'cup': [0.5, 0, 0.3]}}, got {given!r}")
    found: dict[str, tuple[Floats, Floats | None]] = {}
    for name, value in (given or {}).items():
        what = f"targets[{name!r}]"
        array = require_finite(what, as_floats(what, _numbers(value)))
        array = array[None] if array.shape in ((3,), (4, 4)) else array
        poses = array.ndim == 3 and array.shape[1:] == (4, 4)
        if not (poses or (array.ndim == 2 and array.shape[1] == 3)) or not len(array):
            raise InputError(
                f"{what} must be a point (3,), a pose (4, 4) or pin.SE3, or rows of them, (K, 3) or (K, 4, 4); got "
                f"shape {array.shape}"
            )
        if len(array) > 1 and end == 0.0:
            raise InputError(f"the motion is a single pose, so {what} must be one row, too, got {len(array)}")
        if not poses:
            found[str(name)] = array, None
            continue
        R = array[:, :3, :3]
        rigid = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max() < 1e-6 and (np.linalg.det(R) > 0.0).all()
        if not rigid or np.abs(array[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
            raise InputError(f"{what} must be a pose: a rotation and a position above the row 0 0 0 1")
        found[str(name)] = array[:, :3, 3], Rotation.from_matrix(R).as_quat()
    return found


def _numbers(value: Any) -> Any:
    """Poses of Pinocchio as matrices; anything else as it is."""
    if isinstance(value, list | tuple):
        return [_numbers(row) for row in value]
    return value.homogeneous if isinstance(value, pin.SE3) else value


def surroundings(
    robot: Robot, marks: Marks, frames: Sequence[str], source: object, times: Floats, end: float
) -> list[Mark]:
    """Triads of frames, ties of the mechanism, obstacles, regions, targets and goals of a plan.

    They are at the keyframes (K,), up to the end of the motion [s]. ``source`` is the plan or the controller's run that
    is shown, or a scene or problem.
    """
    scene, wanted, begin = _task(marks.constraints, source, robot)
    targets = []
    for name, (places, turns) in target_rows(marks.targets, end).items():
        if len(places) == 1:
            targets.append(Target(name, places, turns))
            continue
        t = np.linspace(0.0, end, len(places))
        between = None if turns is None else Slerp(t, Rotation.from_quat(turns))(times).as_quat()
        targets.append(Target(name, rows_at(times, t, places), between))
    ties = [] if scene is None else [_tie(constraint, robot) for constraint in scene.constraints]
    drawn = [tie for tie in ties if tie is not None]
    return [*map(Triad, frames), *drawn, *regions(wanted, begin + times), *targets, *_goals(wanted, targets)]


def _task(given: object, source: object, robot: Robot) -> tuple[Scene | None, tuple[PlanConstraint, ...], float]:
    """The scene whose constraints are drawn, the constraints of the plan, and the initial time of the plan [s].

    ``given`` is whether to draw the constraints of ``source``; or a scene; or a problem with constraints of its plan.
    """
    if own := isinstance(given, bool | np.bool_):
        problem = problem_of(source)
        given = None if not given else source if problem is None else problem
    scene = _scene_of(given)
    if scene is None and own:
        return None, (), 0.0
    if scene is None:
        raise InputError(
            f"constraints must be True or False, a Scene or an OptimalControlProblem, got {reprlib.repr(given)}"
        )
    owner = scene.robot
    if owner.joint_names != robot.joint_names or not owner.built_like(robot):
        raise InputError(f"constraints are of robot {owner.name!r}, but the robot that is shown is {robot.name!r}")
    return (scene, (), 0.0) if given is scene else (scene, tuple(given.constraints), float(given.t0))  # type: ignore[attr-defined]


def _scene_of(given: object) -> Scene | None:
    """A scene, or that of a problem; None of anything else."""
    scene = given if isinstance(given, Scene) else getattr(given, "scene", None)
    return scene if isinstance(scene, Scene) else None


def _tie(constraint: Constraint, robot: Robot) -> Tie | None:
    """The tie of a constraint between places; those between joints and custom ones have none."""
    if not isinstance(constraint, Distance | FrameOnFrame | PointOnLine | PointOnPlane | PointOnPoint):
        return None
    (body, _, here), (other, turned, there) = (point_of(end, getattr(constraint, end), robot) for end in "ab")
    axis = getattr(constraint, "normal", getattr(constraint, "direction", None))
    if axis is not None:
        axis = turned @ np.asarray(axis, dtype=np.float64)
        axis /= np.linalg.norm(axis)
    plane = isinstance(constraint, PointOnPlane)
    return Tie(type(constraint).__name__, (body, here), (other, there), axis, plane=plane)


def regions(constraints: Sequence[PlanConstraint], times: Floats) -> tuple[Region, ...]:
    """Obstacles, and regions that frames have to stay in or out of; moving ones at ``times`` (K,) [s]."""
    if not constraints:
        return ()
    from varpin.control import constraints as kinds  # noqa: PLC0415 - few replays need controllers imported

    found: dict[Any, Region] = {}
    for constraint in constraints:
        if isinstance(constraint, kinds.KeepClear):
            for body in constraint.obstacles:
                half = None if body.sides is None else 0.5 * body.sides
                box = None if half is None else np.array([-half, half])
                ends, way = (body.begin, body.end), None
                if body.shift is not None:
                    shifts = body.shifts(times)
                    ends, way = (body.begin + shifts[0], body.end + shifts[0]), shifts - shifts[0]
                region = Region("obstacle", body.name, *ends, body.radius, box, body.rotation, way, body.hull)
                # Several constraints may share an obstacle.
                found[repr(body)] = region
        elif isinstance(constraint, kinds.KeepInSphere | kinds.KeepOutOfSphere):
            kind = "out" if constraint.outside else "in"
            centers = constraint.shifts(times)
            way = centers - centers[0] if callable(constraint.center) else None
            found[constraint] = Region(kind, constraint.frame, centers[0], centers[0], constraint.radius, way=way)  # type: ignore[arg-type]
        elif isinstance(constraint, kinds.KeepInBox):
            found[constraint] = Region("in", constraint.frame, np.zeros(3), np.zeros(3), 0.0, constraint.limits)
        elif isinstance(constraint, kinds.KeepInHalfSpace):
            plane = np.array([[-np.inf, -np.inf, 0.0], [np.inf, np.inf, 0.0]])
            place = constraint.offset * constraint.normal
            found[constraint] = Region("in", constraint.frame, place, place, 0.0, plane, z_to(constraint.normal))
    return tuple(found.values())


def _goals(constraints: Sequence[PlanConstraint], taken: Sequence[Target]) -> list[Target]:
    """Final positions of frames as targets, except for those that are already among ``taken``."""
    if not constraints:
        return []
    from varpin.control.constraints import ReachFrame  # noqa: PLC0415 - as above

    ends = [(c.frame, c.position) for c in constraints if isinstance(c, ReachFrame) and c.position is not None]
    return [
        Target(f"goal of {frame}", place[None])
        for frame, place in ends
        if not any(np.allclose(target.places[-1], place, atol=1e-9) for target in taken)
    ]


def torque_shares(robot: Robot, given: object, torques: object) -> Floats | None:
    """Torque of each joint in each step as a share of its limit (N, n), in [0, 1]; None if torques are not shown.

    ``torques`` are given (N, n), or True for the motion's controls. A joint without a limit is held against its own
    largest torque.

    Raises:
        InputError: The motion does not have torques of all joints, or they are not (N, n).
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
    bound = np.where(np.isfinite(robot.effort_limit), robot.effort_limit, size.max(axis=0, initial=0.0))
    return np.minimum(size / np.where(bound > 0.0, bound, 1.0), 1.0)
