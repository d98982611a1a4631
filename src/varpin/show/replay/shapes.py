"""Loading of shapes into meshcat."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import meshcat
import numpy as np
import pinocchio as pin
from meshcat.geometry import Geometry, MeshPhongMaterial
from numpy.typing import ArrayLike
from pinocchio.visualize.meshcat_visualizer import MeshcatVisualizer

from varpin.arrays import Floats
from varpin.model.meshes import MeshPart, joined
from varpin.show.replay.marks import GHOST_COLOR

Style: TypeAlias = Literal["own", "plain", "ghost"]

logger = logging.getLogger(__name__)

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
