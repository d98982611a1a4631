"""Objects for meshcat: a robot's shapes, and tubes, triads, balls, solids and labels beside it."""

from __future__ import annotations

import base64
import html as markup
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import meshcat
import numpy as np
import pinocchio as pin
from meshcat.geometry import Geometry, Mesh, MeshBasicMaterial, MeshPhongMaterial, Object, TriangularMeshGeometry
from numpy.typing import ArrayLike, NDArray
from pinocchio.visualize.meshcat_visualizer import MeshcatVisualizer

from varpin.arrays import Floats
from varpin.model.meshes import MeshPart, joined
from varpin.model.tree import z_to
from varpin.show.replay.picture import Shape

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
_CLEAR: dict[str, Any] = {"transparent": True, "depthWrite": False}
# Materials of marks.
LOOKS: Mapping[str, Callable[..., MeshBasicMaterial | MeshPhongMaterial]] = {
    "flat": MeshBasicMaterial,
    # Does not hide a frame that reaches it.
    "soft": partial(MeshPhongMaterial, opacity=0.6, transparent=True),
    # Is visible through the links around it.
    "through": partial(MeshBasicMaterial, opacity=0.85, depthTest=False, **_CLEAR),
    # Hide nothing behind them.
    "sheet": partial(MeshBasicMaterial, opacity=0.25, **_CLEAR),
    "solid": partial(MeshPhongMaterial, opacity=0.4, flatShading=True, **_CLEAR),
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


@dataclass(frozen=True, eq=False)
class Item:
    """A node of a page, with an object or for several."""

    node: str  # its path, or that below the node of its mark
    form: Object | None = None  # the object, if there is one
    pose: Floats = field(default_factory=lambda: np.eye(4))  # transform (4, 4) in the frame of its body
    body: int | None = None  # of a mark: the body that carries it, -1 for the base; None for the world
    tracks: Mapping[str, Floats] = field(default_factory=dict)  # values (K, ...) at the keyframes, by property

    @classmethod
    def moving(
        cls, node: str, form: Object | None, places: Floats, turns: Floats | None = None, lengths: Floats | None = None
    ) -> Item:
        """An item in the world, at positions (1 or K, 3) with quaternions (x, y, z, w) and lengths along z, as many."""
        pose, tracks = transform(places[0]), {"position": places}
        if turns is not None:
            pose[:3, :3] = pin.Quaternion(turns[0]).toRotationMatrix()
            tracks["quaternion"] = turns
        if lengths is not None:
            pose[:3, 2] *= lengths[0]
            tracks["scale"] = np.column_stack([np.ones((len(lengths), 2)), lengths])
        return cls(node, form, pose, None, tracks if len(places) > 1 else {})


def shape_items(node: str, shape: Shape, *, ghost: bool = False, colors: Floats | None = None) -> Iterator[Item]:
    """A shape of a robot: in its own looks, part by part; or in one piece, as the ghost's or in colours (K, 3)."""
    own, parts, pose = shape.form, shape.parts, shape.placement.homogeneous
    if parts and not ghost and colors is None:
        forms = [Mesh(_Triangles(part), _material(own, part)) for part in parts]
        yield Item(node, forms[0] if len(forms) == 1 else None, pose)
        if len(forms) > 1:
            yield from (Item(f"{node}/{k}", form) for k, form in enumerate(forms))
        return
    form = _Triangles(joined(parts)) if parts else _primitive(own)
    if form is None:
        return
    color, opacity = own.meshColor if colors is None else colors[0], float(own.meshColor[3])
    look: dict[str, Any] = _GHOST if ghost else {"color": _hex(color), "opacity": opacity}
    if own.meshTexturePath and not ghost and colors is None:
        look |= {"color": _hex(_WHITE), "map": _picture(own.meshTexturePath)}
    tracks = {} if colors is None else {"material.color": colors}
    yield Item(node, Mesh(form, MeshPhongMaterial(**look, flatShading=bool(parts))), pose, tracks=tracks)


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


def transform(place: Floats, rotation: Floats | None = None) -> Floats:
    """Transform (4, 4) of a translation, after a rotation."""
    pose = np.eye(4)
    pose[:3, 3] = place
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose


def _hex(color: ArrayLike) -> int:
    red, green, blue = (round(255 * float(part)) for part in np.clip(np.asarray(color)[:3], 0.0, 1.0))
    return red << 16 | green << 8 | blue


def tube(points: Floats, radius: float, color: int) -> Object:
    """A tube along a path (P, 3), P > 1; WebGL draws lines one pixel wide, whatever width is set."""
    vertices, faces = _swept(points, radius)
    return Mesh(TriangularMeshGeometry(vertices, faces), LOOKS["flat"](color=color))


def sphere(radius: float, color: int, look: str) -> Object:
    """A sphere with one of the looks of marks."""
    return Mesh(meshcat.geometry.Sphere(radius), LOOKS[look](color=color))


def sheet(half: float, color: int) -> Object:
    """A translucent square normal to the z axis, of side 2 ``half`` [m], visible from both sides."""
    corners = half * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    form = TriangularMeshGeometry(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    return Mesh(form, LOOKS["sheet"](color=color))


def solid(form: MeshPart, color: int) -> Object:
    """A translucent convex hull."""
    return Mesh(TriangularMeshGeometry(form.vertices, form.faces), LOOKS["solid"](color=color))


def triad(length: float) -> Object:
    """The axes of a frame: x red, y green, z blue."""
    parts = [_swept(np.array([np.zeros(3), axis]), 0.04 * length) for axis in length * np.eye(3)]
    vertices = np.concatenate([corners for corners, _ in parts])
    faces = np.concatenate([triangles + k * len(corners) for k, (corners, triangles) in enumerate(parts)])
    colors = np.repeat(_AXES, len(parts[0][0]), axis=0)
    geometry = TriangularMeshGeometry(vertices, faces, color=colors)
    return Mesh(geometry, MeshBasicMaterial(vertexColors=True))


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
