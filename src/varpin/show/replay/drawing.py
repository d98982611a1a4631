"""Robots and their marks in meshcat: their places, the view, the drawing and its animation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import meshcat
import numpy as np
from meshcat.animation import Animation, AnimationClip, AnimationTrack

from varpin.arrays import Floats
from varpin.model import Robot
from varpin.show.replay.marks import REGIONS, Figure, Mark, samples, translation
from varpin.show.replay.picture import Picture, label
from varpin.show.replay.shapes import Style, load_shape

_VERTICAL_VIEW = math.radians(40.0)
_ASPECT = 4.0 / 3.0
_MARGIN = 1.1
_GAP = 0.15
# meshcat's grid has 40 x 40 cells of 0.5 m, its axes are 0.5 m long.
_GRID_CELL = 0.5
# Part of a region that is shown around the rest, relative to the size of a robot's motion.
_AROUND = 0.3
# Colours of no torque, half of the limit and the whole limit; linear in between.
EFFORT_COLORS = np.array([[0.72, 0.76, 0.8], [0.98, 0.75, 0.1], [0.8, 0.05, 0.05]])


@dataclass(frozen=True, eq=False)
class Actor:
    """A robot that moves."""

    robot: Robot
    # Configurations at the keyframes (K, n) [rad or m], by "robot" and, if there is one, "ghost".
    motions: Mapping[str, Floats]
    annotate: Callable[[Figure], Iterable[Mark]]  # makes the marks beside it
    # Torque of each joint of the tree as a share of its limit at the keyframes (K, b), in [0, 1]; None for the robot
    # in its own colours.
    effort: Floats | None = None


@dataclass(frozen=True, eq=False)
class Stage:
    """The contents of a replay, in their places."""

    # Times of the keyframes (K,) [s of playback]. All tracks share them: each track loops on its own, and tracks of
    # unequal length would drift apart.
    times: Floats
    actors: Sequence[Actor]
    figures: list[Figure]  # what their marks know of each
    marks: list[list[Mark]]
    places: list[Floats]  # position of the world of each (3,) [m]
    points: Floats  # points around everything that is shown (P, 3) [m]
    toward: Floats  # unit vector (3,) to the camera
    size: float  # size of the largest robot's motion [m]
    speed: float  # seconds of motion in a second of playback
    error: str  # how far the picture may be off in words, for the legend; empty where nothing is known

    @classmethod
    def of(cls, times: Floats, actors: Sequence[Actor], speed: float = 1.0, error: str = "") -> Stage:
        """The robots side by side with their marks, as a camera sees them that shows all."""
        pictures = {id(actor.robot): Picture.of(actor.robot) for actor in actors}
        swept, axes, size = [], [], 0.0
        for actor in actors:
            picture = pictures[id(actor.robot)]
            q = np.concatenate([*map(samples, actor.motions.values())])
            swept.append(picture.swept(q))
            size = max(size, float(np.ptp(swept[-1], axis=0).max()))
            axes.append(picture.body_poses(q)[0][..., 2].reshape(-1, 3))
        size = size or 1.0
        toward = view_direction(np.concatenate(axes))
        plane = across(toward), np.cross(toward, across(toward))
        figures = [
            Figure(pictures[id(actor.robot)], actor.motions["robot"], size, plane, points)
            for actor, points in zip(actors, swept, strict=True)
        ]
        marks = [list(actor.annotate(figure)) for actor, figure in zip(actors, figures, strict=True)]
        extents = [_extent(figure, own) for figure, own in zip(figures, marks, strict=True)]
        places = side_by_side(extents, toward)
        points = np.concatenate([points + place for points, place in zip(extents, places, strict=True)])
        return cls(times, actors, figures, marks, places, points, toward, size, speed, error)

    @property
    def title(self) -> str:
        """The names of the robots."""
        return ", ".join(dict.fromkeys(actor.robot.name for actor in self.actors))


def _extent(figure: Figure, marks: Sequence[Mark]) -> Floats:
    """Points (P, 3) around a robot and its marks [m]; regions much larger than the rest are shown in part."""
    points = np.concatenate([figure.swept, *(mark.around for mark in marks if mark.kind not in REGIONS)])
    low, high, margin = points.min(axis=0), points.max(axis=0), _AROUND * figure.size
    regions = [mark.around for mark in marks if mark.kind in REGIONS]
    return np.concatenate([points, *(np.clip(region, low - margin, high + margin) for region in regions)])


def draw(viewer: meshcat.Visualizer, stage: Stage) -> None:
    """Send everything to a viewer."""
    _Drawing(viewer, stage).draw()


def tree_positions(robot: Robot, q: Floats) -> Floats:
    """Positions (K, b) [rad or m] of all joints of the tree, mimic joints included, at configurations (K, n)."""
    tree = robot.tree
    return np.asarray(q[:, tree.coordinate] * tree.ratio + tree.offset)


class _Drawing:
    """The drawing of a stage in one viewer."""

    def __init__(self, viewer: meshcat.Visualizer, stage: Stage) -> None:
        self.viewer = viewer
        self.stage = stage
        self.clips: dict[meshcat.path.Path, AnimationClip] = {}

    def draw(self) -> None:
        stage = self.stage
        set_view(self.viewer, stage.points, stage.toward, stage.size)
        for k, (actor, figure, place) in enumerate(zip(stage.actors, stage.figures, stage.places, strict=True)):
            number = f" {k + 1}" if k else ""
            self._robot(actor, figure.picture, number, place)
            self.viewer[f"notes{number}"].set_transform(translation(place))
            for i, mark in enumerate(stage.marks[k]):
                self._mark(mark, mark_name(i, mark), figure, number)
        if len(stage.times) > 1:
            self.viewer.set_animation(Animation(self.clips), play=True, repetitions=math.inf)

    def _robot(self, actor: Actor, picture: Picture, number: str, place: Floats) -> None:
        tree = actor.robot.tree
        for kind, q in actor.motions.items():
            root, rows = f"{kind}{number}", tree_positions(actor.robot, q)
            self.viewer[root].set_transform(translation(place))
            nodes = picture.moving_nodes(root)
            for j, node in enumerate(nodes):
                joint = translation(tree.translation[j])
                joint[:3, :3] = tree.rotation[j]
                self.viewer[node.removesuffix("/moving")].set_transform(joint)
                self.viewer[node].set_transform(joint_motion(bool(tree.prismatic[j]), rows[0, j]))
                self._animate(node, joint_track(bool(tree.prismatic[j])), "number", rows[:, j])
            shapes = zip(picture.shapes, picture.meshes, picture.bodies, picture.placements, strict=True)
            for k, (shape, parts, body, placement) in enumerate(shapes):
                node = f"{nodes[body] if body >= 0 else f'{root}/base'}/shapes/{k} {label(shape.name)}"
                if kind == "ghost" and body < 0:
                    continue
                shares = None if kind == "ghost" or body < 0 or actor.effort is None else actor.effort[:, body]
                style: Style = "ghost" if kind == "ghost" else "own" if shares is None else "plain"
                load_shape(self.viewer, shape, parts, placement, node, style)
                if shares is not None:
                    self._color(f"{node}/<object>", shares)

    def _color(self, node: str, shares: Floats) -> None:
        stops = np.linspace(0.0, 1.0, len(EFFORT_COLORS))
        colors = np.column_stack([np.interp(shares, stops, channel) for channel in EFFORT_COLORS.T])
        self.viewer[node].set_property("color", [*colors[0].tolist(), 1.0])
        self._animate(node, "material.color", "color", colors)

    def _mark(self, mark: Mark, name: str, figure: Figure, number: str) -> None:
        for item in mark.items:
            node = mark_node(figure.picture, name, item.node, item.body, number)
            if item.form is not None:
                self.viewer[node].set_object(item.form)
            self.viewer[node].set_transform(item.pose)
            for track, (kind, values) in item.tracks.items():
                # Geometry and material are the object's, position and rotation its node's.
                self._animate(f"{node}/<object>" if "." in track else node, track, kind, values)

    def _animate(self, node: str, name: str, kind: str, values: Floats) -> None:
        """Animate a property of a node with values (K, ...) at the keyframes."""
        path = self.viewer[node].path
        # With fps = 1, keyframe times are seconds.
        clip = self.clips.setdefault(path, AnimationClip({}, fps=1))
        clip.tracks[name] = AnimationTrack(name, kind, self.stage.times.tolist(), values.tolist())


def mark_name(index: int, mark: Mark) -> str:
    """Step of a scene path for one of the marks of a robot."""
    return f"{index} {mark.kind} {label(mark.name)}"


def mark_node(picture: Picture, name: str, part: str, body: int | None = None, number: str = "") -> str:
    """Scene path of a part of a mark, in the world of a robot or on one of its bodies."""
    root = f"notes{number}"
    if body is not None:
        figure = f"robot{number}"
        root = f"{picture.moving_nodes(figure)[body] if body >= 0 else f'{figure}/base'}/notes"
    return f"{root}/{name}/{part}".removesuffix("/")


def joint_track(prismatic: bool) -> str:
    """The animated property of a joint's node.

    It is one number, so that the page interpolates in q and links stay rigid at any frame rate.
    """
    return "position[z]" if prismatic else "rotation[z]"


def joint_motion(prismatic: bool, position: float) -> Floats:
    """Transform (4, 4) of a joint along or about z."""
    motion = np.eye(4)
    if prismatic:
        motion[2, 3] = position
    else:
        c, s = math.cos(position), math.sin(position)
        motion[:2, :2] = [[c, -s], [s, c]]
    return motion


def set_view(viewer: meshcat.Visualizer, points: Floats, toward: Floats, size: float, *, camera: bool = True) -> None:
    """Set the camera in a direction (3,) from points (P, 3) [m], the grid at z = 0, axes and background.

    With ``camera=False`` the present camera is moved. ``size`` is that of one robot's motion [m].
    """
    right = across(toward)
    axes = np.array([right, np.cross(toward, right), toward])
    seen = points @ axes.T
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    width, up, depth = (seen - middle).T
    tangent = math.tan(0.5 * _VERTICAL_VIEW)
    distance = _MARGIN * float(np.max(depth + np.maximum(np.abs(width) / (_ASPECT * tangent), np.abs(up) / tangent)))
    distance = distance or size

    # meshcat's camera turns about the origin only, so the middle of the motion is moved there.
    shift = -(middle @ axes)
    centered = np.eye(4)
    centered[:3, 3] = shift
    viewer.set_transform(centered)
    offset = distance * toward
    if camera:
        lens = {
            "fov": math.degrees(_VERTICAL_VIEW),
            "aspect": _ASPECT,
            "near": 0.01 * distance,
            "far": 100.0 * distance,
        }
        viewer["/Cameras/default/rotated"].set_object(meshcat.geometry.PerspectiveCamera(**lens))
    # That node turns three.js's upward y into the world's z.
    viewer["/Cameras/default/rotated/<object>"].set_property("position", [offset[0], offset[2], -offset[1]])

    cell = _round_number(size / 8.0)
    scale = [cell / _GRID_CELL] * 3
    viewer["/Grid"].set_property("color", [1.0, 1.0, 1.0, 0.3])
    viewer["/Grid"].set_property("scale", scale)
    viewer["/Grid"].set_property("position", shift.tolist())
    viewer["/Axes"].set_property("scale", scale)
    viewer["/Axes"].set_property("position", shift.tolist())
    viewer["/Background"].set_property("top_color", [0.97, 0.98, 1.0])
    viewer["/Background"].set_property("bottom_color", [0.72, 0.77, 0.83])


def across(toward: Floats) -> Floats:
    """The horizontal unit vector (3,) that a camera in the direction ``toward`` sees pointing to the right."""
    right = np.cross([0.0, 0.0, 1.0], toward)
    return np.asarray(right / np.linalg.norm(right))


def side_by_side(extents: Sequence[Floats], toward: Floats) -> list[Floats]:
    """Translations (3,) that put figures, each of points (P, 3) [m], in a row as the camera sees them."""
    right = across(toward)
    spans = [((points @ right).min(), (points @ right).max()) for points in extents]
    gap = _GAP * max(high - low for low, high in spans)
    at, places = 0.0, [np.zeros(3)]
    for (_, end), (begin, _) in pairwise(spans):
        at += end - begin + gap
        places.append(at * right)
    return places


def view_direction(joint_axes: Floats) -> Floats:
    """Unit vector (3,) to the camera: across the plane of planar joint axes (k, 3), else from front and side."""
    weights, directions = np.linalg.eigh(joint_axes.T @ joint_axes)
    if weights[-1] > 0.98 * weights.sum():
        normal = directions[:, -1]
        if normal @ [0.1, -0.2, 1.0] < 0.0:
            normal = -normal
        side = [0.0, -0.75, 0.0] if normal[2] > 0.7 else [0.0, 0.0, 0.25]
        toward = normal + side
    else:
        toward = np.array([1.0, -1.2, 0.6])
    return np.asarray(toward / np.linalg.norm(toward))


def _round_number(value: float) -> float:
    """The largest number of the form 1, 2 or 5 times a power of ten that is at most ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))
