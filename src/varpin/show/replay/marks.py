"""Marks of a page: the paths, targets, frames, constraints and regions beside a robot, as objects for meshcat."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation, Slerp

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.mechanics.constraints import Constraint, Distance, FrameOnFrame, PointOnLine, PointOnPlane, PointOnPoint
from varpin.mechanics.forces import point_of
from varpin.mechanics.scene import Scene
from varpin.model.clearance import hull_around
from varpin.model.kinematics import place_on_body
from varpin.model.tree import place_of_frame, z_to
from varpin.show.given import problem_of
from varpin.show.replay import shapes
from varpin.show.replay.figure import Figure, rows_at, samples
from varpin.show.replay.picture import corners_of
from varpin.support.checks import as_floats, require_finite

if TYPE_CHECKING:
    from varpin.control.constraints import PlanConstraint

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
class Mark:
    """What is drawn beside a robot."""

    kind: str  # A key of ``KINDS``, for the legend, or another word
    name: str
    around: Floats  # points around it (P, 3) [m]
    items: Sequence[shapes.Item]
    tied: Constraint | None = None  # the constraint between two points whose rod moves with the robot


def marks_of(figure: Figure) -> Iterator[Mark]:
    """References, paths, beads of plans, frames, ties of the mechanism, obstacles, regions, targets and goals."""
    shown = figure.shown
    yield from _references(figure)
    yield from _paths(figure, "motion", *shown.motions["robot"])
    # The planned configurations of a run jump from plan to plan and have no trace.
    if shown.marks.ghost is not None:
        yield from _paths(figure, "ghost", *shown.motions["ghost"])
    yield from _beads(figure)
    scene, wanted, begin = _task(figure)
    yield from (_frame(figure, name) for name in figure.frames)
    if scene is not None:
        yield from (tie for constraint in scene.constraints for tie in _ties(figure, constraint))
    yield from _regions(figure, wanted, begin)
    yield from _targets(figure)
    yield from _goals(figure, wanted)


def _paths(figure: Figure, kind: str, t: Floats, q: Floats) -> Iterator[Mark]:
    """The paths of frames along a motion, q (N + 1, n) at t (N + 1,), without frames that do not move."""
    end = figure.times[-1]
    times = np.append(t[t < end], min(end, t[-1]))
    pieces = len(times) - 1
    if pieces:
        # Points between the nodes, or fewer points than nodes.
        parts = max(1, math.ceil(_FEWEST / pieces))
        fine = np.linspace(0.0, pieces, min(pieces * parts, _MOST) + 1)
        times = np.interp(fine, np.arange(pieces + 1), times)
    rows = rows_at(times, t, q)
    for name in figure.trace:
        points = figure.robot.frame_positions(rows, name)
        kept = _distinct(points)
        if len(kept) > 1:
            passed = np.searchsorted(kept, np.arange(len(times)), side="right") - 1.0
            reached = np.interp(figure.times, times, passed) if figure.shown.marks.growing else None
            yield _path(figure, kind, name, points[kept], reached)


def _path(figure: Figure, kind: str, name: str, points: Floats, reached: Floats | None = None) -> Mark:
    """A tube along points (P, 3), of whose pieces so many are drawn at the keyframes (K,)."""
    # drawRange is the number of corners that three.js draws, so that a piece can be drawn in part.
    drawn = {} if reached is None else {"geometry[drawRange].count": shapes.TUBE_PIECE * reached}
    tube = shapes.tube(points, TUBE * figure.size, KINDS[kind][1])
    return Mark(kind, name, points, [shapes.Item("", tube, tracks=drawn)])


def _beads(figure: Figure) -> Iterator[Mark]:
    """The paths of frames in the present plan of a run, evenly spaced in time."""
    run, ahead, t = figure.shown.run, figure.shown.ahead, figure.shown.t
    if run is None or not ahead:
        return
    ticks = run.period * np.arange(len(run.plans) + 1, dtype=np.float64)
    times = np.minimum(figure.times, t[-1])
    plans = [rows_at(times, ticks, run.planned(ahead * part)) for part in np.arange(1, _BEADS + 1) / _BEADS]
    for name in figure.trace:
        ways = [figure.robot.frame_positions(q, name) for q in plans]
        form = shapes.sphere(_BEAD * figure.size, shapes.GHOST_COLOR, "flat")
        items = [shapes.Item.moving(str(b), form, way) for b, way in enumerate(ways)]
        yield Mark("plan", name, np.concatenate(ways), items)


def _references(figure: Figure) -> Iterator[Mark]:
    """Paths in the world, by name."""
    given = figure.shown.marks.reference
    named = {} if given is None else given if isinstance(given, Mapping) else {"reference": given}
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


def _targets(figure: Figure) -> Iterator[Mark]:
    """Targets, which stand or move up to the end of the robot's motion."""
    times = np.minimum(figure.times, figure.shown.t[-1])
    for name, (t, places, turns) in figure.shown.targets.items():
        if len(places) > 1:
            between = None if turns is None else Slerp(t, Rotation.from_quat(turns))(times).as_quat()
            yield _target(figure, name, rows_at(times, t, places), between)
        else:
            yield _target(figure, name, places, turns)


def _target(figure: Figure, name: str, places: Floats, turns: Floats | None = None) -> Mark:
    """A ball with a label, and axes for a pose, at positions (1 or K, 3) with quaternions (x, y, z, w), as many."""
    size, right, up = figure.size, figure.right, figure.up
    items = [
        shapes.Item.moving("", None, places, turns),
        shapes.Item("ball", shapes.sphere(_BALL * size, KINDS["target"][1], "soft")),
        *([] if turns is None else [shapes.Item("axes", shapes.triad(_TRIAD * size))]),
        # The tool comes to a target from above or from the side.
        shapes.Item("label", shapes.Label(name, LABEL * size, -1.2 * _BALL * size)),
    ]
    half = 0.5 * shapes.label_width(name) * LABEL * size * right
    bottom = (1.2 * _BALL + LABEL) * size * up
    offsets = [_BALL * size * up, -bottom - half, -bottom + half]
    return Mark("target", name, np.concatenate([places + offset for offset in offsets]), items)


def _task(figure: Figure) -> tuple[Scene | None, tuple[PlanConstraint, ...], float]:
    """The scene whose constraints are drawn, the constraints of the plan, and the initial time of the plan [s].

    Given is whether to draw the constraints of what is shown; or a scene; or a problem with constraints of its plan.
    """
    given, source, robot = figure.shown.marks.constraints, figure.shown.given, figure.robot
    own = isinstance(given, bool | np.bool_)
    task: Any = given if not own else None if not given else problem_of(source) or source
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
    q, tips = samples(figure.q), place + _TRIAD * figure.size * rotation.T
    around = np.concatenate([place_on_body(figure.robot.tree, q if body >= 0 else q[:1], body, tip) for tip in tips])
    item = shapes.Item("", shapes.triad(_TRIAD * figure.size), shapes.transform(place, rotation), body)
    return Mark("frame", name, around, [item])


def _ties(figure: Figure, constraint: Constraint) -> Iterator[Mark]:
    """A constraint between places: points, and the rod, line or plane between them; none for other constraints."""
    if not isinstance(constraint, Distance | FrameOnFrame | PointOnLine | PointOnPlane | PointOnPoint):
        return
    name, color, size = type(constraint).__name__, KINDS["constraint"][1], figure.size
    (here, _, a), (there, turned, b) = (point_of(end, getattr(constraint, end), figure.robot) for end in "ab")
    axis = getattr(constraint, "normal", getattr(constraint, "direction", None))
    ball = shapes.sphere(_POINT * size, color, "through")
    items = [shapes.Item("a", ball, shapes.transform(a), here)]
    if axis is None:
        items += [shapes.Item("b", ball, shapes.transform(b), there), *rod(figure, constraint)]
    else:
        seen = place_on_body(figure.robot.tree, figure.q, here, a)
        axes = z_to(turned @ np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis))
        if there >= 0:
            R, p = figure.poses
            seen = np.einsum("kji,kj->ki", R[:, there], seen - p[:, there])
        local = (seen - b) @ axes
        if isinstance(constraint, PointOnPlane):
            flat = local[:, :2]
            middle = b + axes[:, :2] @ (0.5 * (flat.min(axis=0) + flat.max(axis=0)))
            half = 0.5 * float(np.ptp(flat, axis=0).max()) + _EDGE * size
            items.append(shapes.Item("plane", shapes.sheet(half, color), shapes.transform(middle, axes), there))
        else:
            ends = [local[:, 2].min() - _EDGE * size, local[:, 2].max() + _EDGE * size]
            line = shapes.tube(b + np.outer(ends, axes[:, 2]), TUBE * size, color)
            items.append(shapes.Item("line", line, body=there))
    fixed = np.array([place for body, place in ((here, a), (there, b)) if body < 0]).reshape(-1, 3)
    yield Mark("constraint", name, fixed, items, constraint if axis is None else None)


def rod(figure: Figure, constraint: Constraint) -> Iterator[shapes.Item]:
    """The rod between the two points of a constraint; none if they always coincide."""
    ends = (point_of(end, getattr(constraint, end), figure.robot) for end in "ab")
    a, b = (place_on_body(figure.robot.tree, figure.q, body, place) for body, _, place in ends)
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
    form = shapes.tube(np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]]), _ROD * figure.size, KINDS["constraint"][1])
    yield shapes.Item.moving("rod", form, 0.5 * (a + b), np.array(turns), lengths)


def _regions(figure: Figure, constraints: Sequence[PlanConstraint], begin: float) -> Iterator[Mark]:
    """Obstacles, and regions that frames have to stay in or out of; what moves does so from the time ``begin`` [s]."""
    if not constraints:
        return
    from varpin.control import constraints as kinds  # noqa: PLC0415 - few replays need controllers imported

    times = begin + np.minimum(figure.times, figure.shown.t[-1])
    # Several constraints may share an obstacle.
    bodies = {repr(body): body for c in constraints if isinstance(c, kinds.KeepClear) for body in c.obstacles}
    for body in bodies.values():
        shifts = body.shifts(times) if body.shift is not None else np.zeros((1, 3))
        yield _solid("obstacle", body.name, body.points @ body.rotation.T, body.radius, body.position + shifts)
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
    return Mark(kind, name, around, [shapes.Item.moving("", form, places)])


def _open_box(figure: Figure, name: str, limits: Floats, place: Floats, axes: Floats) -> Mark:
    """A box of limits (2, 3) in axes of its own; open sides are drawn around the motion."""
    (lower, upper), seen, margin = limits, (figure.swept - place) @ axes, _EDGE * figure.size
    low = np.minimum(seen.min(axis=0), np.where(np.isfinite(upper), upper, np.inf)) - margin
    high = np.maximum(seen.max(axis=0), np.where(np.isfinite(lower), lower, -np.inf)) + margin
    low, high = np.where(np.isfinite(lower), lower, low), np.where(np.isfinite(upper), upper, high)
    corners = corners_of(np.array([low, high])) @ axes.T
    if (high > low).all():
        return _solid("in", name, corners, 0.0, place[None])
    form = shapes.sheet(0.5 * float((high - low).max()), KINDS["in"][1])
    pose = shapes.transform(place + axes @ (0.5 * (low + high)), axes)
    return Mark("in", name, place + corners, [shapes.Item("", form, pose)])


def _goals(figure: Figure, constraints: Sequence[PlanConstraint]) -> Iterator[Mark]:
    """Final positions of frames, but for those where a target ends."""
    if not constraints:
        return
    from varpin.control.constraints import ReachFrame  # noqa: PLC0415 - as above

    ends = [places[-1] for _, places, _ in figure.shown.targets.values()]
    goals = [(c.frame, c.position) for c in constraints if isinstance(c, ReachFrame) and c.position is not None]
    for frame, goal in goals:
        if not any(np.allclose(place, goal, atol=1e-9) for place in ends):
            yield _target(figure, f"goal of {frame}", goal[None])
