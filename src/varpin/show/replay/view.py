"""Camera, grid and background, set from the extent of what is shown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import meshcat
import numpy as np

from varpin.arrays import Floats

_VERTICAL_VIEW = math.radians(40.0)
_ASPECT = 4.0 / 3.0
_MARGIN = 1.1
_GAP = 0.15
# meshcat's grid has 40 x 40 cells of 0.5 m, its axes are 0.5 m long.
_GRID_CELL = 0.5


def set_view(viewer: meshcat.Visualizer, points: Floats, toward: Floats, size: float, *, camera: bool = True) -> None:
    """Set camera, grid, axes and background; the grid is at z = 0.

    Args:
        viewer: The viewer.
        points: Points that have to be visible (P, 3) [m].
        toward: Unit vector (3,) from the points to the camera.
        size: Size of one robot's motion [m].
        camera: Whether a new camera is made; else the present one is moved.
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
    """Translations that put several figures in a row, as seen from the camera.

    Args:
        extents: Points (P, 3) of each figure [m].
        toward: Unit vector (3,) to the camera.

    Returns:
        Translations (3,) of the figures; the first one is zero.
    """
    right = across(toward)
    spans = [((points @ right).min(), (points @ right).max()) for points in extents]
    gap = _GAP * max(high - low for low, high in spans)
    at, places = 0.0, [np.zeros(3)]
    for (_, end), (begin, _) in pairwise(spans):
        at += end - begin + gap
        places.append(at * right)
    return places


def view_direction(joint_axes: Floats) -> Floats:
    """Unit vector (3,) from the robot to the camera: across the plane of a planar motion, else from front and side.

    Args:
        joint_axes: Axes of the joints in the world (k, 3).
    """
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
