"""Objects for meshcat: a robot's shapes, and tubes, triads, balls, solids and labels beside it."""

from __future__ import annotations

import base64
import html as markup
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import meshcat
import numpy as np
import pinocchio as pin
from meshcat.geometry import Geometry, MeshBasicMaterial, MeshPhongMaterial, Object, TriangularMeshGeometry
from numpy.typing import ArrayLike, NDArray
from pinocchio.visualize.meshcat_visualizer import MeshcatVisualizer

from varpin.arrays import Floats
from varpin.model.clearance import Hull
from varpin.model.meshes import MeshPart, joined
from varpin.model.tree import z_to

Style: TypeAlias = Literal["own", "plain", "ghost"]

logger = logging.getLogger(__name__)

GHOST_COLOR = 0x1450D2
_WHITE = (1.0, 1.0, 1.0)
# three.js's constant RepeatWrapping, for textures that repeat beyond their edges.
_REPEAT = 1000
# A polygon offset draws the robot in front where both coincide, except for facets of a rotated sphere; without it they
# would flicker.
_GHOST: dict[str, Any] = {
    "color": GHOST_COLOR,
    "opacity": 0.35,
    "transparent": True,
    "polygonOffset": True,
    "polygonOffsetFactor": 2.0,
    "polygonOffsetUnits": 64.0,
}
_SIDES = 6
# Indices of a tube's corners that draw one of its pieces.
TUBE_PIECE = 6 * _SIDES
_AXES = np.array([[0.85, 0.15, 0.12], [0.15, 0.6, 0.15], [0.12, 0.3, 0.85]])
# Unit vectors in all directions (D, 3), along the axes among them.
_RISE, _TURN = np.meshgrid(np.linspace(-0.5, 0.5, 25) * np.pi, np.arange(48) * np.pi / 24.0)
DIRECTIONS = np.stack([np.cos(_RISE) * np.cos(_TURN), np.cos(_RISE) * np.sin(_TURN), np.sin(_RISE)], axis=-1).reshape(
    -1, 3
)


def load_shape(
    viewer: meshcat.Visualizer,
    shape: pin.GeometryObject,
    parts: Sequence[MeshPart],
    placement: pin.SE3,
    node: str,
    style: Style,
) -> None:
    """Send a shape, with the parts of its mesh if it is one, and its placement in the parent node.

    In its own colours, part by part; plain, as one object in one colour that can be animated; or as the ghost's.
    """
    if style == "own" and parts:
        for k, part in enumerate(parts):
            viewer[node if len(parts) == 1 else f"{node}/{k}"].set_object(_Triangles(part), _material(shape, part))
    else:
        if style == "ghost":
            look = _GHOST | {"flatShading": bool(parts)}
        else:
            look = {"color": _hex(shape.meshColor), "opacity": float(shape.meshColor[3]), "flatShading": bool(parts)}
        if style == "own" and shape.meshTexturePath:
            look |= {"color": _hex(_WHITE), "map": _picture(shape.meshTexturePath)}
        form = _Triangles(joined(parts)) if parts else _primitive(shape)
        if form is None:
            return
        viewer[node].set_object(form, MeshPhongMaterial(**look))
    viewer[node].set_transform(placement.homogeneous)


def _material(shape: pin.GeometryObject, part: MeshPart) -> MeshPhongMaterial:
    """The look of a part of a mesh: as in RViz, a Collada file's materials prevail over the description's."""
    given = shape.overrideMaterial and (part.color is None or not shape.meshPath.lower().endswith(".dae"))
    color = shape.meshColor if given or part.color is None else part.color
    look: dict[str, Any] = {"flatShading": part.normals is None, "opacity": float(color[3])}
    if not given:
        look |= {name: value if np.isscalar(value) else _hex(value) for name, value in part.shine.items()}
    if part.colors is not None and part.color is None and not given:
        color, look["vertexColors"] = _WHITE, True
    texture = shape.meshTexturePath or ("" if given else part.texture)
    if texture and part.uv is not None:
        color, look["map"] = _WHITE, _picture(texture)
    return MeshPhongMaterial(color=_hex(color), **look)


def _primitive(shape: pin.GeometryObject) -> Geometry | None:
    """The form of Pinocchio's own viewer; None, with a warning, if there is none."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        form = MeshcatVisualizer().loadPrimitive(shape)
    if isinstance(form, Geometry):
        return form
    problem = " ".join(str(warning.message) for warning in caught) or f"shape {shape.name!r} has no form"
    logger.warning("%s; it is not drawn", problem)
    return None


class _Triangles(Geometry):
    """The triangles of a part of a mesh."""

    def __init__(self, part: MeshPart) -> None:
        super().__init__()
        self.part = part

    def lower(self, object_data: Any) -> dict[str, Any]:  # noqa: ARG002
        """The triangles for three.js's loader."""
        part = self.part
        rows = {"position": part.vertices, "normal": part.normals, "uv": part.uv, "color": part.colors}
        attributes = {name: _packed(array.astype(np.float32)) for name, array in rows.items() if array is not None}
        index = _packed(part.faces.astype(np.uint32))
        return {"uuid": self.uuid, "type": "BufferGeometry", "data": {"attributes": attributes, "index": index}}


def _packed(rows: Floats) -> dict[str, Any]:
    """An array (N, k) for three.js; meshcat packs columns."""
    return meshcat.geometry.pack_numpy_array(rows.T)


def _picture(path: str | Path) -> Any:
    """An image file as a texture."""
    return meshcat.geometry.ImageTexture(meshcat.geometry.PngImage(Path(path).read_bytes()), wrap=[_REPEAT, _REPEAT])


def _hex(color: ArrayLike) -> int:
    red, green, blue = (round(255 * float(part)) for part in np.clip(np.asarray(color)[:3], 0.0, 1.0))
    return red << 16 | green << 8 | blue


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


def joint_ball(radius: float, color: int) -> Object:
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


def solid(form: Hull, color: int) -> Object:
    """A translucent convex hull."""
    material = _glass(MeshPhongMaterial, color, 0.4, flatShading=True)
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
    side = np.arange(_SIDES)
    low, high = side, (side + 1) % _SIDES
    quads = np.stack([low, high, low + _SIDES, high, high + _SIDES, low + _SIDES], axis=1).reshape(-1, 3)
    return vertices, (quads[None] + _SIDES * np.arange(len(points) - 1)[:, None, None]).reshape(-1, 3)
