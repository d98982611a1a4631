"""Objects of meshcat besides robots: tubes along paths, triads, balls and labels."""

from __future__ import annotations

import base64
import html as markup
from typing import Any

import meshcat
import numpy as np
from meshcat.geometry import MeshBasicMaterial, MeshPhongMaterial, Object, TriangularMeshGeometry
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.model.hull import Hull
from varpin.model.tree import z_to

_SIDES = 6

# Indices of a tube's corners that draw one of its pieces.
TUBE_PIECE = 6 * _SIDES

_AXES = np.array([[0.85, 0.15, 0.12], [0.15, 0.6, 0.15], [0.12, 0.3, 0.85]])


def tube(points: Floats, radius: float, color: int) -> Object:
    """A tube along a path (P, 3), P > 1; WebGL draws lines one pixel wide, whatever width is set."""
    vertices, faces = _swept(points, radius)
    return meshcat.geometry.Mesh(TriangularMeshGeometry(vertices, faces), MeshBasicMaterial(color=color))


def bead(radius: float, color: int) -> Object:
    """A small solid sphere."""
    return meshcat.geometry.Mesh(meshcat.geometry.Sphere(radius), MeshBasicMaterial(color=color))


def ball(radius: float, color: int) -> Object:
    """A translucent sphere, which does not hide a frame that reaches it."""
    material = MeshPhongMaterial(color=color, opacity=0.6, transparent=True)
    return meshcat.geometry.Mesh(meshcat.geometry.Sphere(radius), material)


def pin(radius: float, color: int) -> Object:
    """A small sphere that is visible through the links around it."""
    material = MeshBasicMaterial(color=color, opacity=0.85, transparent=True, depthTest=False, depthWrite=False)
    return meshcat.geometry.Mesh(meshcat.geometry.Sphere(radius), material)


def rod(radius: float, color: int) -> Object:
    """A rod of length 1 around the z axis, from -1/2 to 1/2."""
    return tube(np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]]), radius, color)


def sheet(half: float, color: int) -> Object:
    """A translucent square normal to the z axis, of side 2 ``half`` [m], visible from both sides."""
    corners = half * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    form = TriangularMeshGeometry(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    return meshcat.geometry.Mesh(form, _glass(MeshBasicMaterial, color, 0.25))


def capsule(radius: float, length: float, color: int) -> Object:
    """A translucent capsule along the z axis; a sphere if its length is 0."""
    parts, rings = 48, 12
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 2 * rings)
    z = radius * np.sin(angles) + np.repeat([-0.5 * length, 0.5 * length], rings)
    turn = 2.0 * np.pi * np.arange(parts) / parts
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    flat = (radius * np.cos(angles))[:, None, None] * around
    vertices = np.concatenate([flat, np.broadcast_to(z[:, None, None], (2 * rings, parts, 1))], axis=2).reshape(-1, 3)
    form = TriangularMeshGeometry(vertices, _bands(2 * rings, parts))
    return meshcat.geometry.Mesh(form, _glass(MeshPhongMaterial, color, 0.45, flatShading=True))


def box(sides: Floats, color: int) -> Object:
    """A translucent box with ``sides`` (3,) [m], centred at the origin."""
    return meshcat.geometry.Mesh(meshcat.geometry.Box(sides.tolist()), _glass(MeshPhongMaterial, color, 0.3))


def hull(form: Hull, color: int) -> Object:
    """A translucent convex hull."""
    material = _glass(MeshPhongMaterial, color, 0.3, flatShading=True)
    return meshcat.geometry.Mesh(TriangularMeshGeometry(form.points, form.faces), material)


def _glass(kind: Any, color: int, opacity: float, **options: Any) -> Any:
    """A translucent material that hides nothing behind it."""
    return kind(color=color, opacity=opacity, transparent=True, depthWrite=False, **options)


def triad(length: float) -> Object:
    """The axes of a frame: x red, y green, z blue."""
    parts = [_swept(np.array([np.zeros(3), axis]), 0.04 * length) for axis in length * np.eye(3)]
    vertices = np.concatenate([corners for corners, _ in parts])
    faces = np.concatenate([triangles + k * len(corners) for k, (corners, triangles) in enumerate(parts)])
    colors = np.repeat(_AXES, len(parts[0][0]), axis=0)
    geometry = TriangularMeshGeometry(vertices, faces, color=colors)
    return meshcat.geometry.Mesh(geometry, MeshBasicMaterial(vertexColors=True))


def label_width(text: str) -> float:
    """Width of a label relative to the height of its plate."""
    # The mean width of a letter is at most 0.58 of a sans-serif font's size; East Asian letters are square.
    letters = sum(0.58 if ord(letter) < 0x2E80 else 1.05 for letter in text)
    return 0.7 * letters + 0.6


class Label(Object):
    """A text on a translucent plate above or below a point. It faces the camera and is in front of everything else.

    Args:
        text: The text.
        size: Height of the plate [m].
        above: Distance from the point up to the plate [m]; negative for a plate below the point.
    """

    def __init__(self, text: str, size: float, above: float) -> None:
        super().__init__(geometry=None, material=None)
        self.text, self.size, self.above = text, size, above

    def lower(self) -> dict[str, Any]:
        """The object for three.js's loader: a sprite with an image of the plate as its texture."""
        image, texture, material = (f"{self.uuid}-{part}" for part in ("image", "texture", "material"))
        picture, width, height = _plate(self.text, self.above / self.size)
        return {
            "metadata": {"version": 4.5, "type": "Object"},
            "geometries": [],
            "images": [{"uuid": image, "url": picture}],
            "textures": [{"uuid": texture, "image": image}],
            "materials": [
                {
                    "uuid": material,
                    "type": "SpriteMaterial",
                    "map": texture,
                    "transparent": True,
                    "depthTest": False,
                    "depthWrite": False,
                }
            ],
            "object": {
                "uuid": self.uuid,
                "type": "Sprite",
                "material": material,
                "renderOrder": 3,
                "matrix": np.diag([self.size * width, self.size * height, 1.0, 1.0]).ravel().tolist(),
            },
        }


def _plate(text: str, above: float) -> tuple[str, float, float]:
    """An image of the plate, whose centre is the labelled point: its URL, and its width and height in plate heights.

    The other half, and the part between point and plate, are empty.
    """
    width, height = label_width(text), 2.0 * (1.0 + abs(above))
    top = 0.0 if above >= 0.0 else height - 1.0
    pixels = 64
    drawing = f"""\
<svg xmlns="http://www.w3.org/2000/svg" width="{pixels * width:.0f}" height="{pixels * height:.0f}"
 viewBox="0 0 {width:.3f} {height:.3f}">
<rect x="0.03" y="{top + 0.03:.3f}" width="{width - 0.06:.3f}" height="0.94" rx="0.2"
 fill="#fff" fill-opacity="0.7" stroke="#1d2733" stroke-opacity="0.5" stroke-width="0.04"/>
<text x="{width / 2.0:.3f}" y="{top + 0.73:.3f}" font-family="sans-serif" font-size="0.7" fill="#1d2733"
 text-anchor="middle">{markup.escape(text)}</text>
</svg>"""
    return f"data:image/svg+xml;base64,{base64.b64encode(drawing.encode()).decode()}", width, height


def _swept(points: Floats, radius: float) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (P * sides, 3) in a ring around each point, and triangles (2 * (P - 1) * sides, 3) between the rings."""
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
        # Transported without twist; where the path turns into the normal, any other normal is used.
        normal = normal - (normal @ tangent) * tangent
        length = float(np.linalg.norm(normal))
        normal = normal / length if length > 1e-6 else z_to(tangent)[:, 0]
        normals[k] = normal
    angles = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    ring = np.cos(angles)[:, None] * normals[:, None] + np.sin(angles)[:, None] * np.cross(tangents, normals)[:, None]
    vertices = (points[:, None] + radius * ring).reshape(-1, 3)
    return vertices, _bands(len(points), _SIDES)


def _bands(rings: int, parts: int) -> NDArray[np.int64]:
    """Triangles (2 * (rings - 1) * parts, 3) between rings of ``parts`` corners each."""
    side = np.arange(parts)
    low, high = side, (side + 1) % parts
    quads = np.stack([low, high, low + parts, high, high + parts, low + parts], axis=1).reshape(-1, 3)
    return np.asarray((quads[None] + parts * np.arange(rings - 1)[:, None, None]).reshape(-1, 3))
