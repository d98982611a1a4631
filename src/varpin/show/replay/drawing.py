"""A stage in meshcat: robots, marks, their animation, and the camera."""

from __future__ import annotations

import math

import meshcat
import numpy as np
from meshcat.animation import Animation, AnimationClip, AnimationTrack

from varpin.arrays import Floats
from varpin.model import Robot
from varpin.show.replay.figure import Figure, across
from varpin.show.replay.marks import Item, Mark
from varpin.show.replay.picture import label
from varpin.show.replay.shapes import Style, load_shape, transform
from varpin.show.replay.stage import Stage

_VERTICAL_VIEW = math.radians(40.0)
_ASPECT = 4.0 / 3.0
_MARGIN = 1.1
# meshcat's grid has 40 x 40 cells of 0.5 m, its axes are 0.5 m long.
_GRID_CELL = 0.5
# Colours of no torque, half of the limit and the whole limit; linear in between.
EFFORT_COLORS = np.array([[0.72, 0.76, 0.8], [0.98, 0.75, 0.1], [0.8, 0.05, 0.05]])
# three.js's kinds of animated properties that are no numbers.
_KINDS = {"position": "vector3", "scale": "vector3", "quaternion": "quaternion", "material.color": "color"}


class Drawing:
    """The drawing of a stage in one viewer."""

    def __init__(self, viewer: meshcat.Visualizer, stage: Stage) -> None:
        self._viewer = viewer
        self._stage = stage
        self._clips: dict[meshcat.path.Path, AnimationClip] = {}

    def draw(self) -> None:
        """Send everything to the viewer."""
        viewer, stage = self._viewer, self._stage
        set_view(viewer, stage.points, stage.toward, stage.size)
        for figure, place, marks in zip(stage.figures, stage.places, stage.marks, strict=True):
            for kind, q in figure.rows.items():
                viewer[f"{kind}{figure.number}"].set_transform(transform(place))
                self._robot(figure, kind, q)
            viewer[f"notes{figure.number}"].set_transform(transform(place))
            for i, mark in enumerate(marks):
                for item in mark.items:
                    self._item(item_node(figure, i, mark, item), item)
        if len(stage.times) > 1:
            viewer.set_animation(Animation(self._clips), play=True, repetitions=math.inf)

    def _robot(self, figure: Figure, kind: str, q: Floats) -> None:
        tree, picture, rows = figure.robot.tree, figure.picture, tree_positions(figure.robot, q)
        for j in range(len(tree.parent)):
            node, slides = figure.node(kind, j), bool(tree.prismatic[j])
            self._viewer[node.removesuffix("/moving")].set_transform(transform(tree.translation[j], tree.rotation[j]))
            self._viewer[node].set_transform(joint_motion(slides, rows[0, j]))
            # One number, so that the page interpolates in q and links stay rigid at any frame rate.
            self._animate(node, "position[z]" if slides else "rotation[z]", rows[:, j])
        shapes = zip(picture.shapes, picture.meshes, picture.bodies, picture.placements, strict=True)
        for k, (shape, parts, body, placement) in enumerate(shapes):
            if kind == "ghost" and body < 0:
                continue
            shares = figure.effort[:, body] if kind == "robot" and body >= 0 and figure.effort is not None else None
            node = f"{figure.node(kind, body)}/shapes/{k} {label(shape.name)}"
            style: Style = "ghost" if kind == "ghost" else "own" if shares is None else "plain"
            load_shape(self._viewer, shape, parts, placement, node, style)
            if shares is not None:
                self._color(f"{node}/<object>", shares)

    def _color(self, node: str, shares: Floats) -> None:
        stops = np.linspace(0.0, 1.0, len(EFFORT_COLORS))
        colors = np.column_stack([np.interp(shares, stops, channel) for channel in EFFORT_COLORS.T])
        self._viewer[node].set_property("color", [*colors[0].tolist(), 1.0])
        self._animate(node, "material.color", colors)

    def _item(self, node: str, item: Item) -> None:
        if item.form is not None:
            self._viewer[node].set_object(item.form)
        self._viewer[node].set_transform(item.pose)
        for track, values in item.tracks.items():
            # Geometry and material are the object's, position and rotation its node's.
            self._animate(f"{node}/<object>" if "." in track else node, track, values)

    def _animate(self, node: str, name: str, values: Floats) -> None:
        """Animate a property of a node with values (K, ...) at the keyframes."""
        path = self._viewer[node].path
        # With fps = 1, keyframe times are seconds.
        clip = self._clips.setdefault(path, AnimationClip({}, fps=1))
        clip.tracks[name] = AnimationTrack(
            name, _KINDS.get(name, "number"), self._stage.times.tolist(), values.tolist()
        )


def item_node(figure: Figure, index: int, mark: Mark, item: Item) -> str:
    """Scene path of an item of one of the marks of a robot, in its world or on one of its bodies."""
    root = f"notes{figure.number}" if item.body is None else f"{figure.node('robot', item.body)}/notes"
    return f"{root}/{index} {mark.kind} {label(mark.name)}/{item.node}".removesuffix("/")


def tree_positions(robot: Robot, q: Floats) -> Floats:
    """Positions (K, b) [rad or m] of all joints of the tree, mimic joints included, at configurations (K, n)."""
    tree = robot.tree
    return np.asarray(q[:, tree.coordinate] * tree.ratio + tree.offset)


def joint_motion(prismatic: bool, position: float) -> Floats:
    """Transform (4, 4) of a joint along or about z."""
    if prismatic:
        return transform(np.array([0.0, 0.0, position]))
    c, s = math.cos(position), math.sin(position)
    return transform(np.zeros(3), np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


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
    viewer.set_transform(transform(shift))
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


def _round_number(value: float) -> float:
    """The largest number of the form 1, 2 or 5 times a power of ten that is at most ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))
