"""A stage in meshcat: robots, marks, their animation, and the camera."""

from __future__ import annotations

import math

import meshcat
import numpy as np
from meshcat.animation import Animation, AnimationClip, AnimationTrack

from varpin.arrays import Floats
from varpin.show.replay.figure import Figure
from varpin.show.replay.shapes import transform
from varpin.show.replay.stage import Stage

_VERTICAL_VIEW = math.radians(40.0)
_ASPECT = 4.0 / 3.0
_MARGIN = 1.1
# meshcat's grid has 40 x 40 cells of 0.5 m, its axes are 0.5 m long.
_GRID_CELL = 0.5
# three.js's kinds of animated properties that are no numbers.
_KINDS = {"position": "vector3", "scale": "vector3", "quaternion": "quaternion", "material.color": "color"}


def draw(viewer: meshcat.Visualizer, stage: Stage) -> None:
    """Send everything to a viewer."""
    _set_surroundings(viewer, stage.points, stage.figures[0])
    set_view(viewer, stage.points, stage.figures[0])
    clips: dict[meshcat.path.Path, AnimationClip] = {}
    for item in stage.items():
        node = viewer[item.node]
        if item.form is not None:
            node.set_object(item.form)
        node.set_transform(item.pose)
        for name, values in item.tracks.items():
            # Geometry and material are the object's, position and rotation its node's.
            path = (node["<object>"] if "." in name else node).path
            # With fps = 1, keyframe times are seconds.
            clip = clips.setdefault(path, AnimationClip({}, fps=1))
            kind = _KINDS.get(name, "number")
            clip.tracks[name] = AnimationTrack(name, kind, stage.times.tolist(), values.tolist())
    if len(stage.times) > 1:
        viewer.set_animation(Animation(clips), play=True, repetitions=math.inf)


def _framing(points: Floats, figure: Figure) -> tuple[Floats, float]:
    """The middle (3,) of points (P, 3) [m], and the distance from which the camera sees them all [m]."""
    axes = np.array([figure.right, figure.up, figure.toward])
    seen = points @ axes.T
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    width, up, depth = (seen - middle).T
    tangent = math.tan(0.5 * _VERTICAL_VIEW)
    distance = _MARGIN * float(np.max(depth + np.maximum(np.abs(width) / (_ASPECT * tangent), np.abs(up) / tangent)))
    return middle @ axes, distance or figure.size


def set_view(viewer: meshcat.Visualizer, points: Floats, figure: Figure) -> None:
    """Move the camera so that it sees points (P, 3) [m]."""
    middle, distance = _framing(points, figure)
    # That node turns three.js's upward y into the world's z.
    x, y, z = distance * figure.toward
    viewer["/Cameras/default/rotated/<object>"].set_property("position", [x, z, -y])
    # meshcat's camera turns about the origin only, so the middle of the motion is moved there.
    viewer.set_transform(transform(-middle))
    for name in ("/Grid", "/Axes"):
        viewer[name].set_property("position", (-middle).tolist())


def _set_surroundings(viewer: meshcat.Visualizer, points: Floats, figure: Figure) -> None:
    """Set the camera's lens, the grid at z = 0, axes and background."""
    _, distance = _framing(points, figure)
    lens = {"fov": math.degrees(_VERTICAL_VIEW), "near": 0.01 * distance, "far": 100.0 * distance}
    viewer["/Cameras/default/rotated"].set_object(meshcat.geometry.PerspectiveCamera(aspect=_ASPECT, **lens))
    scale = [_round_number(figure.size / 8.0) / _GRID_CELL] * 3
    for name in ("/Grid", "/Axes"):
        viewer[name].set_property("scale", scale)
    viewer["/Grid"].set_property("color", [1.0, 1.0, 1.0, 0.3])
    viewer["/Background"].set_property("top_color", [0.97, 0.98, 1.0])
    viewer["/Background"].set_property("bottom_color", [0.72, 0.77, 0.83])


def _round_number(value: float) -> float:
    """The largest number of the form 1, 2 or 5 times a power of ten that is at most ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))
