"""Loading of shapes and mesh files into meshcat."""

from __future__ import annotations

import copy
import logging
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import meshcat
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike
from pinocchio.visualize.meshcat_visualizer import MeshcatVisualizer, hasMeshFileInfo, loadMesh

from varpin.show.replay import wavefront
from varpin.show.replay.legend import GHOST_COLOR

logger = logging.getLogger(__name__)

_GHOST_OPACITY = 0.35
_WHITE = 0xFFFFFF
# three.js's constant RepeatWrapping, for textures that repeat beyond their edges.
_REPEAT = 1000


class ShapeLoader(MeshcatVisualizer):
    """Pinocchio's loader of shapes and mesh files, with a given node for each shape."""

    def __init__(self, viewer: meshcat.Visualizer) -> None:
        super().__init__()
        self.initViewer(viewer=viewer)
        self.node = ""
        self.collada: str | None = None

    def getViewerNodeName(self, geometry_object: pin.GeometryObject, geometry_type: pin.GeometryType) -> str:  # noqa: ARG002
        """The node of the current shape."""
        return self.node

    def loadMeshFromFile(self, geometry_object: pin.GeometryObject) -> Any:
        """A mesh file in a form that meshcat draws."""
        mesh = super().loadMeshFromFile(geometry_object)
        if self.collada is not None:
            mesh.dae_raw = self.collada
        return mesh

    def load(self, shape: pin.GeometryObject, placement: pin.SE3, node: str) -> None:
        """Send a shape and its placement in the parent node."""
        suffix = Path(shape.meshPath).suffix.lower()
        if suffix == ".obj":
            self._load_obj(shape, placement, node)
            return
        if shape.meshTexturePath and not suffix and self._load_textured(shape, placement, node):
            return
        parts: list[str | None] = [None]
        if suffix == ".dae":
            parts = [*_collada_parts(shape.meshPath)]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for k, self.collada in enumerate(parts):
                self.node = node if len(parts) == 1 else f"{node}/{k}"
                self.loadViewerGeometryObject(shape, pin.GeometryType.VISUAL)
        scale = np.ones(3)
        problems = [str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)]
        if not problems:
            # Mesh files are sent unscaled; coal's shapes are already scaled.
            scale = np.asarray(shape.meshScale) if hasMeshFileInfo(shape) else scale
        elif isinstance(shape.geometry, pin.coal.BVHModelBase):
            logger.warning("%s; it is drawn in one colour", " ".join(problems))
            material = meshcat.geometry.MeshPhongMaterial(color=_hex(shape.meshColor))
            self.viewer[node].set_object(loadMesh(shape.geometry), material)
        else:
            logger.warning("%s; it is not drawn", " ".join(problems))
        self.viewer[node].set_transform(placement.homogeneous @ np.diag([*scale, 1.0]))

    def _load_obj(self, shape: pin.GeometryObject, placement: pin.SE3, node: str) -> None:
        """Send a Wavefront file as one mesh for each of its materials."""
        parts = wavefront.parts(Path(shape.meshPath))
        for k, part in enumerate(parts):
            path = node if len(parts) == 1 else f"{node}/{k}"
            color = _hex(shape.meshColor if shape.overrideMaterial or part.color is None else part.color)
            opacity = float(shape.meshColor[3]) if shape.overrideMaterial else part.opacity
            texture = shape.meshTexturePath or ("" if shape.overrideMaterial else part.texture)
            material = meshcat.geometry.MeshPhongMaterial(
                color=color, opacity=opacity, transparent=opacity < 1.0, vertexColors=part.colored
            )
            if texture and part.mapped:
                material.map, material.color = _picture(texture), _WHITE
            self.viewer[path].set_object(meshcat.geometry.MeshGeometry(part.text, "obj"), material)
        self.viewer[node].set_transform(placement.homogeneous @ np.diag([*shape.meshScale, 1.0]))

    def _load_textured(self, shape: pin.GeometryObject, placement: pin.SE3, node: str) -> bool:
        """Send a box, ball or cylinder with its texture; returns whether it can be drawn."""
        material = meshcat.geometry.MeshPhongMaterial(color=_WHITE, map=_picture(shape.meshTexturePath))
        return self._load_form(shape, placement, node, material)

    def load_plain(self, shape: pin.GeometryObject, placement: pin.SE3, node: str) -> None:
        """Send a shape in one colour, which can be animated; colours of mesh files cannot."""
        # Flat shading, as coal's meshes share vertices across edges, where smooth shading would be wrong.
        material = meshcat.geometry.MeshPhongMaterial(color=_hex(shape.meshColor), flatShading=True)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            drawn = self._load_form(shape, placement, node, material)
        if not drawn:
            logger.warning("%s; it is not drawn", " ".join(str(warning.message) for warning in caught))

    def load_ghost(self, shape: pin.GeometryObject, placement: pin.SE3, node: str) -> None:
        """Send a shape in the ghost's colour.

        A polygon offset draws the robot in front where both coincide, except for facets of a rotated sphere; without it
        they would flicker.
        """
        material = meshcat.geometry.MeshPhongMaterial(
            color=GHOST_COLOR, opacity=_GHOST_OPACITY, transparent=True, polygonOffset=True,
            polygonOffsetFactor=2.0, polygonOffsetUnits=64.0,
        )  # fmt: skip
        # Warnings were logged when the robot's own shape was loaded.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            self._load_form(shape, placement, node, material)

    def _load_form(self, shape: pin.GeometryObject, placement: pin.SE3, node: str, material: Any) -> bool:
        """Send a shape from coal, without colours and textures of its file; returns whether it can be drawn."""
        is_mesh = isinstance(shape.geometry, pin.coal.BVHModelBase)
        form = loadMesh(shape.geometry) if is_mesh else self.loadPrimitive(shape)
        if not isinstance(form, meshcat.geometry.Geometry):
            return False
        self.viewer[node].set_object(form, material)
        self.viewer[node].set_transform(placement.homogeneous)
        return True


_PRIMITIVES = frozenset(["lines", "linestrips", "polygons", "polylist", "triangles", "trifans", "tristrips"])


def _collada_parts(path: str) -> list[str | None]:
    """A Collada file as texts with one mesh each, where meshcat needs that; else [None], to load it whole.

    meshcat merges the meshes of a file and keeps one material a mesh. It does not draw a file with several meshes if
    one has several colours, and fails on meshes with different vertex attributes. A single mesh keeps its colours.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        # Pinocchio's loader reports the error.
        return [None]
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    instances = list(root.iter("instance_geometry"))
    meshes = [[child for child in mesh if child.tag in _PRIMITIVES] for mesh in root.iter("mesh")]
    kinds = {frozenset(x.get("semantic") for x in child.iter("input")) for mesh in meshes for child in mesh}
    if len(instances) < 2 or (len(kinds) < 2 and max(map(len, meshes)) < 2):
        return [None]
    # Geometries are most of a file: each part contains only the one that it uses.
    geometries = {}
    for library in root.iter("library_geometries"):
        for geometry in library.findall("geometry"):
            geometries[geometry.get("id")] = geometry
            library.remove(geometry)
    parts: list[str | None] = []
    for kept in range(len(instances)):
        part = copy.deepcopy(root)
        here = list(part.iter("instance_geometry"))
        used = here[kept].get("url", "").removeprefix("#")
        for node in part.iter("node"):
            for other in node.findall("instance_geometry"):
                if other is not here[kept]:
                    node.remove(other)
        for library in [*part.iter("library_geometries")][:1]:
            library.extend([geometries[used]] if used in geometries else [])
        parts.append(ElementTree.tostring(part, encoding="unicode"))
    return parts


def _picture(path: str) -> Any:
    """An image file as a texture."""
    return meshcat.geometry.ImageTexture(meshcat.geometry.PngImage(Path(path).read_bytes()), wrap=[_REPEAT, _REPEAT])


def _hex(color: ArrayLike) -> int:
    red, green, blue = (round(255 * float(part)) for part in np.clip(np.asarray(color)[:3], 0.0, 1.0))
    return red << 16 | green << 8 | blue
