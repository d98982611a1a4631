"""What a replay adds to robots: tubes along paths, triads of axes, balls and labels."""

from __future__ import annotations

from typing import Any

import meshcat
import numpy as np
from meshcat.geometry import MeshBasicMaterial, MeshPhongMaterial, Object, TriangularMeshGeometry
from numpy.typing import NDArray

from varpin.model.tree import z_to

Floats = NDArray[np.float64]

_SIDES = 6

# Indices of a tube's corners that draw one of its pieces.
TUBE_PIECE = 6 * _SIDES

_AXES = np.array([[0.85, 0.15, 0.12], [0.15, 0.6, 0.15], [0.12, 0.3, 0.85]])


def tube(points: Floats, radius: float, color: int) -> Object:
    """A tube along a path (P, 3), P > 1; lines would be a pixel wide, whatever they are told."""
    vertices, faces = _swept(points, radius)
    return meshcat.geometry.Mesh(TriangularMeshGeometry(vertices, faces), MeshBasicMaterial(color=color))


def bead(radius: float, color: int) -> Object:
    """A small solid sphere."""
    return meshcat.geometry.Mesh(meshcat.geometry.Sphere(radius), MeshBasicMaterial(color=color))


def ball(radius: float, color: int) -> Object:
    """A translucent sphere, which hides nothing that arrives at it."""
    material = MeshPhongMaterial(color=color, opacity=0.6, transparent=True)
    return meshcat.geometry.Mesh(meshcat.geometry.Sphere(radius), material)


def triad(length: float) -> Object:
    """The axes of a frame: x red, y green, z blue."""
    parts = [_swept(np.array([np.zeros(3), axis]), 0.04 * length) for axis in length * np.eye(3)]
    vertices = np.concatenate([corners for corners, _ in parts])
    faces = np.concatenate([triangles + k * len(corners) for k, (corners, triangles) in enumerate(parts)])
    colors = np.repeat(_AXES, len(parts[0][0]), axis=0)
    geometry = TriangularMeshGeometry(vertices, faces, color=colors)
    return meshcat.geometry.Mesh(geometry, MeshBasicMaterial(vertexColors=True))


class Label(Object):
    """A word above a place, turned to the camera and before everything else."""

    def __init__(self, text: str, size: float) -> None:
        super().__init__(geometry=None, material=None)
        self.text, self.size = text, size

    def lower(self) -> dict[str, Any]:
        """What three.js's loader reads; its texture is meshcat's own kind, which writes a text on a canvas."""
        texture, material = f"{self.uuid}-texture", f"{self.uuid}-material"
        return {
            "metadata": {"version": 4.5, "type": "Object"},
            "geometries": [],
            "textures": [
                {"uuid": texture, "type": "_text", "text": self.text, "font_size": 48, "font_face": "sans-serif"}
            ],
            "materials": [
                {"uuid": material, "type": "SpriteMaterial", "map": texture, "transparent": True, "depthTest": False}
            ],
            "object": {
                "uuid": self.uuid,
                "type": "Sprite",
                "material": material,
                "matrix": np.diag([self.size, self.size, 1.0, 1.0]).ravel().tolist(),
            },
        }


def _swept(points: Floats, radius: float) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (P * sides, 3), a ring around each point, and triangles (2 * (P - 1) * sides, 3) between the rings."""
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1)[:, None]
    before, after = np.vstack([steps[:1], steps]), np.vstack([steps, steps[-1:]])
    tangents = before + after
    turns_back = np.linalg.norm(tangents, axis=1) < 1e-6
    tangents[turns_back] = before[turns_back]
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    normal = z_to(tangents[0])[:, 0]
    normals = np.empty_like(points)
    for k, tangent in enumerate(tangents):
        # Carried along without a twist; where the path turns into the normal, any other will do.
        normal = normal - (normal @ tangent) * tangent
        length = float(np.linalg.norm(normal))
        normal = normal / length if length > 1e-6 else z_to(tangent)[:, 0]
        normals[k] = normal
    angles = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    ring = np.cos(angles)[:, None] * normals[:, None] + np.sin(angles)[:, None] * np.cross(tangents, normals)[:, None]
    vertices = (points[:, None] + radius * ring).reshape(-1, 3)
    side = np.arange(_SIDES)
    low, high = side, (side + 1) % _SIDES
    quads = np.stack([low, high, low + _SIDES, high, high + _SIDES, low + _SIDES], axis=1).reshape(-1, 3)
    faces = (quads[None] + _SIDES * np.arange(len(points) - 1)[:, None, None]).reshape(-1, 3)
    return vertices, faces
