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


def set_view(viewer: meshcat.Visualizer, points: Floats, figure: Figure, *, camera: bool = True) -> None:
    """Set the camera so that it sees points (P, 3) [m], the grid at z = 0, axes and background.

    With ``camera=False`` the present camera is moved.
    """
    toward = figure.toward
    axes = np.array([figure.right, figure.up, toward])
    seen = points @ axes.T
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    width, up, depth = (seen - middle).T
    tangent = math.tan(0.5 * _VERTICAL_VIEW)
    distance = _MARGIN * float(np.max(depth + np.maximum(np.abs(width) / (_ASPECT * tangent), np.abs(up) / tangent)))
    distance = distance or figure.size

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

    cell = _round_number(figure.size / 8.0)
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
