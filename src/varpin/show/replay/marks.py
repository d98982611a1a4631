"""Marks of a page: each has a kind and a name for the legend, and tells the room that it takes and its objects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias

import numpy as np
import pinocchio as pin

from varpin.arrays import Floats
from varpin.model.hull import Hull
from varpin.model.tree import place_of_frame, z_to
from varpin.show.replay import forms

if TYPE_CHECKING:
    from meshcat.geometry import Object

    from varpin.show.replay.picture import Picture

GHOST_COLOR = 0x1450D2
# Line of the legend and colour of each kind of mark. Robots and the background have none of these colours.
KINDS: Mapping[str, tuple[str, int]] = {
    "motion": ("path of {}", 0xD1480F),
    "ghost": ("path of {}, ghost", GHOST_COLOR),
    "reference": ("reference: {}", 0x157A3C),
    "constraint": ("constraint: {}", 0x007C8A),
    "obstacle": ("obstacle: {}", 0x9A5B13),
    "out": ("{} keeps out", 0x9A5B13),
    "in": ("{} keeps in", 0x6B3FA8),
    "target": ("target: {}", 0xC0187A),
}
# Sizes relative to the size of a robot's motion.
TUBE, _BEAD, _BALL, _TRIAD, LABEL, _POINT, _ROD, _EDGE = 0.003, 0.006, 0.02, 0.1, 0.045, 0.02, 0.006, 0.1


@dataclass(frozen=True, eq=False)
class Item:
    """An object of a page, or a node for several.

    Attributes:
        node: Its path below the node of its mark.
        form: The object, if there is one.
        pose: Transform (4, 4) in the frame of its body.
        body: The body that carries it, -1 for the base; None for the world.
        tracks: What moves: three.js's kind and the values (K, ...) at the keyframes, by property.
    """

    node: str
    form: Object | None = None
    pose: Floats = field(default_factory=lambda: np.eye(4))
    body: int | None = None
    tracks: Mapping[str, tuple[str, Floats]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Figure:
    """A robot at its keyframes, as its marks need it.

    Attributes:
        picture: The robot's shapes.
        q: Configurations at the keyframes (K, n) [rad or m].
        size: Size of a robot's motion [m].
        axes: Unit vectors (3,) to the right and upwards as the camera sees them.
        swept: Points (P, 3) around the robot's motion [m].
    """

    picture: Picture
    q: Floats
    size: float
    axes: tuple[Floats, Floats]
    swept: Floats

    @cached_property
    def poses(self) -> tuple[Floats, Floats]:
        """World rotations (K, b, 3, 3) and positions (K, b, 3) [m] of the bodies."""
        return self.picture.body_poses(self.q)


@dataclass(frozen=True, eq=False)
class Path:
    """A path in the world.

    Attributes:
        kind: Whether it is the path of the robot, of its ghost, or a reference.
        name: Name of the frame, or of the reference.
        points: Points of the path (P, 3) [m], P > 1, without equal neighbours.
        reached: For a path that grows, how many of its P - 1 pieces are drawn at the keyframes (K,); else None.
    """

    kind: Literal["motion", "ghost", "reference"]
    name: str
    points: Floats
    reached: Floats | None = None

    def around(self, _: Figure) -> Floats:
        """The points of the path."""
        return self.points

    def items(self, figure: Figure) -> Iterator[Item]:
        """A tube."""
        # drawRange is the number of corners that three.js draws, so that a piece can be drawn in part.
        drawn = {} if self.reached is None else {"geometry[drawRange].count": forms.TUBE_PIECE * self.reached}
        tracks = {name: ("number", corners) for name, corners in drawn.items()}
        yield Item("", forms.tube(self.points, TUBE * figure.size, KINDS[self.kind][1]), tracks=tracks)


@dataclass(frozen=True, eq=False)
class Beads:
    """The planned path of a frame, which changes with every plan.

    Attributes:
        name: Name of the frame.
        places: Points of the path at the keyframes, evenly spaced in time (K, B, 3) [m].
    """

    name: str
    places: Floats
    kind: ClassVar[str] = "plan"

    def around(self, _: Figure) -> Floats:
        """All points."""
        return self.places.reshape(-1, 3)

    def items(self, figure: Figure) -> Iterator[Item]:
        """A bead at each point."""
        for b, places in enumerate(self.places.transpose(1, 0, 2)):
            bead = forms.bead(_BEAD * figure.size, GHOST_COLOR)
            yield Item(str(b), bead, translation(places[0]), tracks={"position": ("vector3", places)})


@dataclass(frozen=True, eq=False)
class Target:
    """A target point or pose.

    Attributes:
        name: Its label.
        places: Position in the world (1, 3), or at the keyframes (K, 3) for a moving target [m].
        turns: Unit quaternions (x, y, z, w) of a pose, as many; None for a point.
    """

    name: str
    places: Floats
    turns: Floats | None = None
    kind: ClassVar[str] = "target"

    def around(self, figure: Figure) -> Floats:
        """Points around the ball and the label."""
        right, up = figure.axes
        half = 0.5 * forms.label_width(self.name) * LABEL * figure.size * right
        bottom = (1.2 * _BALL + LABEL) * figure.size * up
        offsets = [_BALL * figure.size * up, -bottom - half, -bottom + half]
        return np.concatenate([self.places + offset for offset in offsets])

    def items(self, figure: Figure) -> Iterator[Item]:
        """A ball, axes for a pose, and a label."""
        pose = translation(self.places[0])
        tracks = {"position": ("vector3", self.places)} if len(self.places) > 1 else {}
        if self.turns is not None:
            pose[:3, :3] = pin.Quaternion(self.turns[0]).toRotationMatrix()
            tracks |= {"quaternion": ("quaternion", self.turns)} if tracks else {}
        yield Item("", None, pose, tracks=tracks)
        yield Item("ball", forms.ball(_BALL * figure.size, KINDS[self.kind][1]))
        if self.turns is not None:
            yield Item("axes", forms.triad(_TRIAD * figure.size))
        # The tool comes to a target from above or from the side.
        yield Item("label", forms.Label(self.name, LABEL * figure.size, -1.2 * _BALL * figure.size))


@dataclass(frozen=True, eq=False)
class Triad:
    """The axes of a frame of the robot.

    Attributes:
        name: Name of the frame.
    """

    name: str
    kind: ClassVar[str] = "frame"

    def around(self, figure: Figure) -> Floats:
        """The tips of the axes over the motion."""
        body, rotation, place = self._placement(figure)
        tips = place + _TRIAD * figure.size * rotation.T
        if body < 0:
            return tips
        R, p = figure.picture.body_poses(samples(figure.q))
        return np.asarray((tips @ R[:, body].transpose(0, 2, 1) + p[:, body, None]).reshape(-1, 3))

    def items(self, figure: Figure) -> Iterator[Item]:
        """The axes."""
        body, rotation, place = self._placement(figure)
        pose = translation(place)
        pose[:3, :3] = rotation
        yield Item("", forms.triad(_TRIAD * figure.size), pose, body)

    def _placement(self, figure: Figure) -> tuple[int, Floats, Floats]:
        robot = figure.picture.robot
        return place_of_frame(robot.model, self.name, robot.name)


@dataclass(frozen=True, eq=False)
class Tie:
    """A constraint of the mechanism between two points, or between a point and a line or plane.

    Attributes:
        name: The kind of constraint.
        a: Body of the first point, -1 for the world, and the point in the body's frame (3,) [m].
        b: The same for the second point.
        axis: Unit vector (3,), in the axes of b's body, of a line or plane through b; None for two points.
        plane: Whether the axis is the normal of a plane.
    """

    name: str
    a: tuple[int, Floats]
    b: tuple[int, Floats]
    axis: Floats | None = None
    plane: bool = False
    kind: ClassVar[str] = "constraint"

    def around(self, _: Figure) -> Floats:
        """The points that are fixed to the world."""
        return np.array([place for body, place in (self.a, self.b) if body < 0]).reshape(-1, 3)

    def items(self, figure: Figure) -> Iterator[Item]:
        """Points, and the rod, line or plane between them."""
        color, size = KINDS[self.kind][1], figure.size
        for name, (body, place) in zip("ab", (self.a, self.b) if self.axis is None else (self.a,), strict=False):
            yield Item(name, forms.pin(_POINT * size, color), translation(place), body)
        body, place = self.b
        if self.axis is None:
            yield from self.rod(figure)
            return
        seen = self._world(figure, self.a)
        if body >= 0:
            R, p = figure.poses
            seen = np.einsum("kji,kj->ki", R[:, body], seen - p[:, body])
        if self.plane:
            axes = z_to(self.axis)
            flat = (seen - place) @ axes[:, :2]
            middle, half = 0.5 * (flat.min(axis=0) + flat.max(axis=0)), 0.5 * float(np.ptp(flat, axis=0).max())
            pose = translation(place + axes[:, :2] @ middle)
            pose[:3, :3] = axes
            yield Item("plane", forms.sheet(half + _EDGE * size, color), pose, body)
        else:
            along = (seen - place) @ self.axis
            ends = [along.min() - _EDGE * size, along.max() + _EDGE * size]
            yield Item("line", forms.tube(place + np.outer(ends, self.axis), TUBE * size, color), body=body)

    def rod(self, figure: Figure) -> Iterator[Item]:
        """A rod between two points; none if they always coincide."""
        a, b = self._world(figure, self.a), self._world(figure, self.b)
        lengths = np.linalg.norm(b - a, axis=1)
        if self.axis is not None or lengths.max() < TUBE * figure.size:
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
        yield Item("rod", forms.rod(_ROD * figure.size, KINDS[self.kind][1]), pose, tracks=tracks)

    def _world(self, figure: Figure, end: tuple[int, Floats]) -> Floats:
        """A point in the world at the keyframes (K, 3) [m]."""
        (R, p), (body, place) = figure.poses, end
        return np.broadcast_to(place, (len(R), 3)) if body < 0 else R[:, body] @ place + p[:, body]


@dataclass(frozen=True, eq=False)
class Region:
    """An obstacle, or a region of the world that a frame has to stay in or out of.

    Attributes:
        kind: Which of these.
        name: Name of the obstacle, or of the frame.
        begin: One end of its axis in the world (3,) [m]; the centre of a sphere, the origin of a box or a hull.
        end: The other end (3,) [m].
        radius: Radius of a sphere or a capsule [m].
        box: Lower and upper sides of a box from its origin (2, 3) [m], infinite where it is open; None for others.
        rotation: Axes of the box or the hull in the world (3, 3).
        way: Displacement at the keyframes (K, 3) [m]; None if it is fixed.
        hull: Its convex hull; None for others.
    """

    kind: Literal["obstacle", "out", "in"]
    name: str
    begin: Floats
    end: Floats
    radius: float
    box: Floats | None = None
    rotation: Floats = field(default_factory=lambda: np.eye(3))
    way: Floats | None = None
    hull: Hull | None = None

    def around(self, _: Figure) -> Floats:
        """Points around its finite part, over its whole motion."""
        if self.hull is not None:
            found = np.asarray(self.begin + self.hull.points @ self.rotation.T)
        elif self.box is None:
            reach = self.radius * np.vstack([np.eye(3), -np.eye(3)])
            found = np.concatenate([self.begin + reach, self.end + reach])
        else:
            found = self.begin + corners_of(np.where(np.isfinite(self.box), self.box, 0.0)) @ self.rotation.T
        ways = np.zeros((1, 3)) if self.way is None else self.way
        return np.concatenate([found + ways.min(axis=0), found + ways.max(axis=0)])

    def items(self, figure: Figure) -> Iterator[Item]:
        """Its shape; of an open box the part around the motion."""
        color, pose = KINDS[self.kind][1], translation(self.begin)
        pose[:3, :3] = self.rotation
        if self.hull is not None:
            form = forms.hull(self.hull, color)
        elif self.box is None:
            axis = self.end - self.begin
            length = float(np.linalg.norm(axis))
            pose = translation(0.5 * (self.begin + self.end))
            pose[:3, :3] = z_to(axis / length) if length > 0.0 else np.eye(3)
            form = forms.capsule(self.radius, length, color)
        else:
            low, high = self._sides(figure.swept, _EDGE * figure.size)
            pose[:3, 3] += self.rotation @ (0.5 * (low + high))
            solid = (high > low).all()
            form = forms.box(high - low, color) if solid else forms.sheet(0.5 * float((high - low).max()), color)
        way = np.zeros((0, 3)) if self.way is None else self.way
        yield Item("", form, pose, tracks={"position": ("vector3", pose[:3, 3] + way)} if len(way) > 1 else {})

    def _sides(self, points: Floats, margin: float) -> Floats:
        """The sides (2, 3) of the box [m], infinite ones replaced by bounds of points (P, 3) plus a margin [m]."""
        assert self.box is not None
        (lower, upper), seen = self.box, (points - self.begin) @ self.rotation
        low = np.minimum(seen.min(axis=0), np.where(np.isfinite(upper), upper, np.inf)) - margin
        high = np.maximum(seen.max(axis=0), np.where(np.isfinite(lower), lower, -np.inf)) + margin
        return np.array([np.where(np.isfinite(lower), lower, low), np.where(np.isfinite(upper), upper, high)])


Mark: TypeAlias = Path | Beads | Target | Triad | Tie | Region


def legend(marks: Sequence[Mark]) -> list[tuple[str, int]]:
    """The line and the colour of each kind of mark that has a line."""
    lines = []
    for kind, (words, color) in KINDS.items():
        if names := list(dict.fromkeys(mark.name for mark in marks if mark.kind == kind)):
            alone = words.format(names[0]) == f"{kind}: {kind}"
            lines.append((kind if alone and len(names) == 1 else words.format(", ".join(names)), color))
    return lines


def translation(place: Floats) -> Floats:
    """Transform (4, 4) of a translation."""
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose


def corners_of(box: Floats) -> Floats:
    """The corners (8, 3) of a box (2, 3)."""
    return np.stack(np.meshgrid(*box.T), axis=-1).reshape(8, 3)


def samples(rows: Floats) -> Floats:
    """Up to 50 of the rows, the first and the last among them."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, 50).astype(int))]
