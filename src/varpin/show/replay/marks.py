"""Marks of a page: the paths, targets, frames, constraints and regions beside a robot, as objects for meshcat."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

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
from varpin.model.hull import hull_around
from varpin.model.tree import place_of_frame, z_to
from varpin.show.given import problem_of
from varpin.show.replay import shapes
from varpin.show.replay.picture import Picture, corners_of
from varpin.support.checks import as_floats, flag, require_finite

if TYPE_CHECKING:
    from meshcat.geometry import Object

    from varpin.control.constraints import PlanConstraint
    from varpin.control.mpc import MpcRun

# Line of the legend and colour of each kind of mark. Robots and the background have none of these colours.
KINDS: Mapping[str, tuple[str, int]] = {
    "motion": ("path of {}", 0xD1480F),
    "ghost": ("path of {}, ghost", shapes.GHOST_COLOR),
    "reference": ("reference: {}", 0x157A3C),
    "constraint": ("constraint: {}", 0x007C8A),
    "obstacle": ("obstacle: {}", 0x9A5B13),
    "out": ("{} keeps out", 0x9A5B13),
    "in": ("{} keeps in", 0x6B3FA8),
    "target": ("target: {}", 0xC0187A),
}
# Kinds that may be much larger than the rest.
REGIONS = ("obstacle", "out", "in")
# Sizes relative to the size of a robot's motion.
TUBE, _BEAD, _BALL, _TRIAD, LABEL, _POINT, _ROD, _EDGE = 0.003, 0.006, 0.02, 0.1, 0.045, 0.02, 0.006, 0.1
# Smallest and largest number of points of a trace. Coarse motions are refined, as paths are curved between nodes.
_FEWEST, _MOST = 200, 1000
# Beads on the planned path of a frame.
_BEADS = 12


@dataclass(frozen=True, eq=False)
class Item:
    """An object of a page, or a node for several."""

    node: str  # its path below the node of its mark
    form: Object | None = None  # the object, if there is one
    pose: Floats = field(default_factory=lambda: np.eye(4))  # transform (4, 4) in the frame of its body
    body: int | None = None  # the body that carries it, -1 for the base; None for the world
    # What moves: three.js's kind and the values (K, ...) at the keyframes, by property.
    tracks: Mapping[str, tuple[str, Floats]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Mark:
    """What is drawn beside a robot."""

    kind: str  # A key of ``KINDS``, for the legend, or another word
    name: str
    around: Floats  # points around it (P, 3) [m]
    items: Sequence[Item]
    tied: Constraint | None = None  # the constraint between two points whose rod moves with the robot


@dataclass(frozen=True, eq=False)
class Figure:
    """A robot at its keyframes, as its marks need it."""

    picture: Picture  # the robot's shapes
    q: Floats  # configurations at the keyframes (K, n) [rad or m]
    size: float  # size of a robot's motion [m]
    axes: tuple[Floats, Floats]  # unit vectors (3,) to the right and upwards as the camera sees them
    swept: Floats  # points (P, 3) around the robot's motion [m]

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.picture.robot

    @cached_property
    def poses(self) -> tuple[Floats, Floats]:
        """World rotations (K, b, 3, 3) and positions (K, b, 3) [m] of the bodies."""
        return self.picture.body_poses(self.q)


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
    figure: Figure, kind: str, names: Sequence[str], t: Floats, q: Floats, end: float, growing: Floats | None
) -> Iterator[Mark]:
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
    for name in names:
        points = figure.robot.frame_positions(rows, name)
        kept = _distinct(points)
        if len(kept) > 1:
            passed = np.searchsorted(kept, np.arange(len(times)), side="right") - 1.0
            reached = None if growing is None else np.interp(growing, times, passed)
            yield _path(figure, kind, name, points[kept], reached)


def _path(figure: Figure, kind: str, name: str, points: Floats, reached: Floats | None = None) -> Mark:
    """A tube along points (P, 3), of whose pieces so many are drawn at the keyframes (K,)."""
    # drawRange is the number of corners that three.js draws, so that a piece can be drawn in part.
    drawn = {} if reached is None else {"geometry[drawRange].count": ("number", shapes.TUBE_PIECE * reached)}
    tube = shapes.tube(points, TUBE * figure.size, KINDS[kind][1])
    return Mark(kind, name, points, [Item("", tube, tracks=drawn)])


def beads(figure: Figure, names: Sequence[str], run: MpcRun, ahead: float, times: Floats) -> Iterator[Mark]:
    """The planned paths of frames up to a time ``ahead`` [s], evenly spaced in time, at each keyframe (K,) [s]."""
    ticks = run.period * np.arange(len(run.plans) + 1, dtype=np.float64)
    plans = [rows_at(times, ticks, run.planned(ahead * part)) for part in np.arange(1, _BEADS + 1) / _BEADS]
    for name in names:
        ways = [figure.robot.frame_positions(q, name) for q in plans]
        form = shapes.bead(_BEAD * figure.size, shapes.GHOST_COLOR)
        items = [Item(str(b), form, translation(way[0]), None, _moves(way)) for b, way in enumerate(ways)]
        yield Mark("plan", name, np.concatenate(ways), items)


def references(figure: Figure, given: ArrayLike | Mapping[str, ArrayLike] | None) -> Iterator[Mark]:
    """Paths in the world, by name."""
    if given is None:
        return
    named = given if isinstance(given, Mapping) else {"reference": given}
    for name, value in named.items():
        what = f"reference[{name!r}]" if isinstance(given, Mapping) else "reference"
        points = as_floats(what, value)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"{what} must have shape (K, 3), points on a path in the world [m], got {points.shape}")
        points = points[_distinct(require_finite(what, points))]
        if len(points) < 2:
            raise InputError(f"{what} stays in one place; give a single point as a target")
        yield _path(figure, "reference", str(name), points)


def _distinct(points: Floats) -> list[int]:
    """Indices of the points of a path (P, 3) that differ from the last one kept before."""
    kept = [0] if len(points) else []
    apart = 1e-5 * float(np.ptp(points, axis=0).max()) if kept else 0.0
    for k, point in enumerate(points):
        if np.linalg.norm(point - points[kept[-1]]) > apart:
            kept.append(k)
    return kept


def target_rows(given: Mapping[str, object] | None, end: float) -> dict[str, tuple[Floats, Floats | None]]:
    """Positions (K, 3) [m] of each target and, for poses, quaternions (K, 4); one row if it is fixed."""
    if given is not None and not isinstance(given, Mapping):
        raise InputError(f"targets must map names to places or poses, as in {{'cup': [0.5, 0, 0.3]}}, got {given!r}")
    found: dict[str, tuple[Floats, Floats | None]] = {}
    for name, value in (given or {}).items():
        what = f"targets[{name!r}]"
        array = require_finite(what, as_floats(what, _numbers(value)))
        array = array[None] if array.shape in ((3,), (4, 4)) else array
        if not len(array) or array.shape[1:] not in ((3,), (4, 4)):
            raise InputError(
                f"{what} must be a point (3,), a pose (4, 4) or pin.SE3, or rows of them, (K, 3) or (K, 4, 4); got "
                f"shape {array.shape}"
            )
        if len(array) > 1 and end == 0.0:
            raise InputError(f"the motion is a single pose, so {what} must be one row, too, got {len(array)}")
        if array.ndim == 2:
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


def _target(figure: Figure, name: str, places: Floats, turns: Floats | None = None) -> Mark:
    """A ball with a label, and axes for a pose, at positions (1 or K, 3) with quaternions (x, y, z, w), as many."""
    size, (right, up) = figure.size, figure.axes
    pose, tracks = translation(places[0]), _moves(places)
    items = [Item("ball", shapes.ball(_BALL * size, KINDS["target"][1]))]
    if turns is not None:
        pose[:3, :3] = pin.Quaternion(turns[0]).toRotationMatrix()
        tracks |= {"quaternion": ("quaternion", turns)} if tracks else {}
        items.append(Item("axes", shapes.triad(_TRIAD * size)))
    # The tool comes to a target from above or from the side.
    items.append(Item("label", shapes.Label(name, LABEL * size, -1.2 * _BALL * size)))
    half = 0.5 * shapes.label_width(name) * LABEL * size * right
    bottom = (1.2 * _BALL + LABEL) * size * up
    offsets = [_BALL * size * up, -bottom - half, -bottom + half]
    around = np.concatenate([places + offset for offset in offsets])
    return Mark("target", name, around, [Item("", None, pose, None, tracks), *items])


def surroundings(
    figure: Figure, marks: Marks, frames: Sequence[str], source: object, times: Floats, end: float
) -> Iterator[Mark]:
    """Triads of frames, ties of the mechanism, obstacles, regions, targets and goals of a plan.

    They are at the keyframes (K,), up to the end of the motion [s]. ``source`` is the plan or the controller's run that
    is shown, or a scene or problem.
    """
    scene, wanted, begin = _task(marks.constraints, source, figure.robot)
    yield from (_frame(figure, name) for name in frames)
    if scene is not None:
        yield from (tie for constraint in scene.constraints for tie in ties(figure, constraint))
    yield from regions(figure, wanted, begin + times)
    ends = []
    for name, (places, turns) in target_rows(marks.targets, end).items():
        ends.append(places[-1])
        if len(places) > 1:
            t = np.linspace(0.0, end, len(places))
            between = None if turns is None else Slerp(t, Rotation.from_quat(turns))(times).as_quat()
            yield _target(figure, name, rows_at(times, t, places), between)
        else:
            yield _target(figure, name, places, turns)
    for frame, goal in _goals(wanted):
        if not any(np.allclose(place, goal, atol=1e-9) for place in ends):
            yield _target(figure, f"goal of {frame}", goal[None])


def _task(given: object, source: object, robot: Robot) -> tuple[Scene | None, tuple[PlanConstraint, ...], float]:
    """The scene whose constraints are drawn, the constraints of the plan, and the initial time of the plan [s].

    ``given`` is whether to draw the constraints of ``source``; or a scene; or a problem with constraints of its plan.
    """
    own = isinstance(given, bool | np.bool_)
    task = given if not own else None if not given else problem_of(source) or source
    scene = task if isinstance(task, Scene) else getattr(task, "scene", None)
    if not isinstance(scene, Scene):
        if own:
            return None, (), 0.0
        raise InputError(
            f"constraints must be True or False, a Scene or an OptimalControlProblem, got {reprlib.repr(given)}"
        )
    owner = scene.robot
    if owner.joint_names != robot.joint_names or not owner.built_like(robot):
        raise InputError(f"constraints are of robot {owner.name!r}, but the robot that is shown is {robot.name!r}")
    return scene, tuple(getattr(task, "constraints", ())) if task is not scene else (), float(getattr(task, "t0", 0.0))


def _frame(figure: Figure, name: str) -> Mark:
    """The axes of a frame of the robot."""
    body, rotation, place = place_of_frame(figure.robot.model, name, figure.robot.name)
    pose = translation(place)
    pose[:3, :3] = rotation
    tips = place + _TRIAD * figure.size * rotation.T
    if body >= 0:
        R, p = figure.picture.body_poses(samples(figure.q))
        tips = (tips @ R[:, body].transpose(0, 2, 1) + p[:, body, None]).reshape(-1, 3)
    return Mark("frame", name, tips, [Item("", shapes.triad(_TRIAD * figure.size), pose, body)])


def ties(figure: Figure, constraint: Constraint) -> Iterator[Mark]:
    """A constraint between places: points, and the rod, line or plane between them; none for other constraints."""
    if not isinstance(constraint, Distance | FrameOnFrame | PointOnLine | PointOnPlane | PointOnPoint):
        return
    name, color, size = type(constraint).__name__, KINDS["constraint"][1], figure.size
    (here, _, a), (there, turned, b) = (point_of(end, getattr(constraint, end), figure.robot) for end in "ab")
    axis = getattr(constraint, "normal", getattr(constraint, "direction", None))
    items = [Item("a", shapes.joint_ball(_POINT * size, color), translation(a), here)]
    if axis is None:
        items.append(Item("b", shapes.joint_ball(_POINT * size, color), translation(b), there))
        items += rod(figure, constraint)
    else:
        seen = _in_world(figure, here, a)
        axes = z_to(turned @ np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis))
        if there >= 0:
            R, p = figure.poses
            seen = np.einsum("kji,kj->ki", R[:, there], seen - p[:, there])
        local = (seen - b) @ axes
        if isinstance(constraint, PointOnPlane):
            flat = local[:, :2]
            pose = translation(b + axes[:, :2] @ (0.5 * (flat.min(axis=0) + flat.max(axis=0))))
            pose[:3, :3] = axes
            half = 0.5 * float(np.ptp(flat, axis=0).max()) + _EDGE * size
            items.append(Item("plane", shapes.sheet(half, color), pose, there))
        else:
            ends = [local[:, 2].min() - _EDGE * size, local[:, 2].max() + _EDGE * size]
            line = shapes.tube(b + np.outer(ends, axes[:, 2]), TUBE * size, color)
            items.append(Item("line", line, body=there))
    fixed = np.array([place for body, place in ((here, a), (there, b)) if body < 0]).reshape(-1, 3)
    yield Mark("constraint", name, fixed, items, constraint if axis is None else None)


def rod(figure: Figure, constraint: Constraint) -> Iterator[Item]:
    """The rod between the two points of a constraint; none if they always coincide."""
    ends = (point_of(end, getattr(constraint, end), figure.robot) for end in "ab")
    a, b = (_in_world(figure, body, place) for body, _, place in ends)
    lengths = np.linalg.norm(b - a, axis=1)
    if lengths.max() < TUBE * figure.size:
        return
    # The smallest rotation from keyframe to keyframe, as the page interpolates in between.
    before, turn, turns = np.array([0.0, 0.0, 1.0]), pin.Quaternion.Identity(), []
    for span, length in zip(b - a, lengths, strict=True):
        if length > 1e-9 * figure.size:
            turn = pin.Quaternion.FromTwoVectors(before, span / length) * turn
            turn.normalize()
            before = span / length
        turns.append(turn.coeffs().copy())
    pose = translation(0.5 * (a[0] + b[0]))
    pose[:3, :3] = pin.Quaternion(turns[0]).toRotationMatrix() @ np.diag([1.0, 1.0, lengths[0]])
    tracks = {
        "position": ("vector3", 0.5 * (a + b)),
        "quaternion": ("quaternion", np.array(turns)),
        "scale": ("vector3", np.column_stack([np.ones((len(lengths), 2)), lengths])),
    }
    yield Item("rod", shapes.rod(_ROD * figure.size, KINDS["constraint"][1]), pose, tracks=tracks)


def _in_world(figure: Figure, body: int, place: Floats) -> Floats:
    """A point of a body in the world at the keyframes (K, 3) [m]."""
    R, p = figure.poses
    return np.broadcast_to(place, (len(R), 3)) if body < 0 else R[:, body] @ place + p[:, body]


def regions(figure: Figure, constraints: Sequence[PlanConstraint], times: Floats) -> Iterator[Mark]:
    """Obstacles, and regions that frames have to stay in or out of; moving ones at ``times`` (K,) [s]."""
    if not constraints:
        return
    from varpin.control import constraints as kinds  # noqa: PLC0415 - few replays need controllers imported

    # Several constraints may share an obstacle.
    bodies = {repr(body): body for c in constraints if isinstance(c, kinds.KeepClear) for body in c.obstacles}
    for body in bodies.values():
        if body.hull is not None:
            points = body.hull.points
        elif body.sides is not None:
            points = corners_of(0.5 * np.array([-body.sides, body.sides]))
        else:
            points = np.array([body.begin, body.end]) - body.begin
        shifts = body.shifts(times) if body.shift is not None else np.zeros((1, 3))
        yield _solid("obstacle", body.name, points @ body.rotation.T, body.radius, body.begin + shifts)
    for c in constraints:
        if isinstance(c, kinds.KeepInSphere | kinds.KeepOutOfSphere):
            yield _solid("out" if c.outside else "in", c.frame, np.zeros((1, 3)), c.radius, c.centers(times))
        elif isinstance(c, kinds.KeepInBox):
            yield _open_box(figure, c.frame, c.limits, np.zeros(3), np.eye(3))
        elif isinstance(c, kinds.KeepInHalfSpace):
            plane = np.array([[-np.inf, -np.inf, 0.0], [np.inf, np.inf, 0.0]])
            yield _open_box(figure, c.frame, plane, c.offset * c.normal, z_to(c.normal))


def _solid(kind: str, name: str, points: Floats, radius: float, places: Floats) -> Mark:
    """The convex body within a radius of points (P, 3) [m] around its place (1 or K, 3)."""
    corners = (points[:, None] + radius * shapes.DIRECTIONS).reshape(-1, 3) if radius else points
    form = shapes.solid(hull_around(name, corners), KINDS[kind][1])
    around = np.concatenate([corners + places.min(axis=0), corners + places.max(axis=0)])
    return Mark(kind, name, around, [Item("", form, translation(places[0]), None, _moves(places))])


def _open_box(figure: Figure, name: str, limits: Floats, place: Floats, axes: Floats) -> Mark:
    """A box of limits (2, 3) in axes of its own; open sides are drawn around the motion."""
    (lower, upper), seen, margin = limits, (figure.swept - place) @ axes, _EDGE * figure.size
    low = np.minimum(seen.min(axis=0), np.where(np.isfinite(upper), upper, np.inf)) - margin
    high = np.maximum(seen.max(axis=0), np.where(np.isfinite(lower), lower, -np.inf)) + margin
    low, high = np.where(np.isfinite(lower), lower, low), np.where(np.isfinite(upper), upper, high)
    if (high > low).all():
        return _solid("in", name, corners_of(np.array([low, high])) @ axes.T, 0.0, place[None])
    pose = translation(place + axes @ (0.5 * (low + high)))
    pose[:3, :3] = axes
    form = shapes.sheet(0.5 * float((high - low).max()), KINDS["in"][1])
    return Mark("in", name, place + corners_of(np.array([low, high])) @ axes.T, [Item("", form, pose)])


def _goals(constraints: Sequence[PlanConstraint]) -> list[tuple[str, Floats]]:
    """Frames with final positions (3,) [m]."""
    if not constraints:
        return []
    from varpin.control.constraints import ReachFrame  # noqa: PLC0415 - as above

    return [(c.frame, c.position) for c in constraints if isinstance(c, ReachFrame) and c.position is not None]


def legend(marks: Sequence[Mark]) -> list[tuple[str, int]]:
    """The line and the colour of each kind of mark that has a line."""
    lines = []
    for kind, (words, color) in KINDS.items():
        if names := list(dict.fromkeys(mark.name for mark in marks if mark.kind == kind)):
            alone = words.format(names[0]) == f"{kind}: {kind}"
            lines.append((kind if alone and len(names) == 1 else words.format(", ".join(names)), color))
    return lines


def _moves(places: Floats) -> dict[str, tuple[str, Floats]]:
    """The track of an object's positions (K, 3), if there are several."""
    return {"position": ("vector3", places)} if len(places) > 1 else {}


def translation(place: Floats) -> Floats:
    """Transform (4, 4) of a translation."""
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose


def samples(rows: Floats) -> Floats:
    """Up to 50 of the rows, the first and the last among them."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, 50).astype(int))]
