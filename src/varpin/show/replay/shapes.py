"""Shapes and mesh files as meshcat can take them."""

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
# three.js's word for textures that go on beyond their edges.
_REPEAT = 1000


class ShapeLoader(MeshcatVisualizer):
    """Pinocchio's reader of shapes and mesh files, told which node each goes to."""

    def __init__(self, viewer: meshcat.Visualizer) -> None:
        super().__init__()
        self.initViewer(viewer=viewer)
        self.node = ""
        self.collada: str | None = None

    def getViewerNodeName(self, geometry_object: pin.GeometryObject, geometry_type: pin.GeometryType) -> str:  # noqa: ARG002
        """The node that was told."""
        return self.node

    def loadMeshFromFile(self, geometry_object: pin.GeometryObject) -> Any:
        """A mesh file, in a form that meshcat draws."""
        mesh = super().loadMeshFromFile(geometry_object)
        if self.collada is not None:
            mesh.dae_raw = self.collada
        return mesh

    def load(self, shape: pin.GeometryObject, placement: pin.SE3, node: str) -> None:
        """Send a shape and where it sits in its parent node."""
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
            # Mesh files go out as they are on disk; coal's shapes have their scale applied.
            scale = np.asarray(shape.meshScale) if hasMeshFileInfo(shape) else scale
        elif isinstance(shape.geometry, pin.coal.BVHModelBase):
            logger.warning("%s; it is drawn in one colour", " ".join(problems))
            material = meshcat.geometry.MeshPhongMaterial(color=_hex(shape.meshColor))
            self.viewer[node].set_object(loadMesh(shape.geometry), material)
        else:
            logger.warning("%s; it is not drawn", " ".join(problems))
        self.viewer[node].set_transform(placement.homogeneous @ np.diag([*scale, 1.0]))

    def _load_obj(self, shape: pin.GeometryObject, placement: pin.SE3, node: str) -> None:
        """Send a Wavefront file, each of its materials as a mesh of its own."""
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
        """Send a box, ball or cylinder with its texture, if there is a way to draw it."""
        material = meshcat.geometry.MeshPhongMaterial(color=_WHITE, map=_picture(shape.meshTexturePath))
        return self._load_form(shape, placement, node, material)

    def load_plain(self, shape: pin.GeometryObject, placement: pin.SE3, node: str) -> None:
        """Send a shape in one colour that can be animated; those of mesh files cannot."""
        # Facets, for coal's meshes share corners across edges, which smooth shading would wrinkle.
        material = meshcat.geometry.MeshPhongMaterial(color=_hex(shape.meshColor), flatShading=True)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            drawn = self._load_form(shape, placement, node, material)
        if not drawn:
            logger.warning("%s; it is not drawn", " ".join(str(warning.message) for warning in caught))

    def load_ghost(self, shape: pin.GeometryObject, placement: pin.SE3, node: str) -> None:
        """Send a shape in the ghost's colour.

        A polygon offset lets the robot win where both are in one place, up to the facets of a sphere that has turned;
        without it they would flicker.
        """
        material = meshcat.geometry.MeshPhongMaterial(
            color=GHOST_COLOR, opacity=_GHOST_OPACITY, transparent=True, polygonOffset=True,
            polygonOffsetFactor=2.0, polygonOffsetUnits=64.0,
        )  # fmt: skip
        # The robot's own shape has been reported.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            self._load_form(shape, placement, node, material)

    def _load_form(self, shape: pin.GeometryObject, placement: pin.SE3, node: str, material: Any) -> bool:
        """Send a shape as coal has it, without the colours and textures of its file, if there is a way to draw it."""
        is_mesh = isinstance(shape.geometry, pin.coal.BVHModelBase)
        form = loadMesh(shape.geometry) if is_mesh else self.loadPrimitive(shape)
        if not isinstance(form, meshcat.geometry.Geometry):
            return False
        self.viewer[node].set_object(form, material)
        self.viewer[node].set_transform(placement.homogeneous)
        return True


_PRIMITIVES = frozenset(["lines", "linestrips", "polygons", "polylist", "triangles", "trifans", "tristrips"])


def _collada_parts(path: str) -> list[str | None]:
    """A Collada file as texts with one mesh each, where meshcat needs that; else [None], to be taken whole.

    meshcat merges the meshes of a file and keeps one material a mesh: of a mesh in several colours beside another
    it draws nothing, and on meshes with different kinds of vertices it stops. A mesh alone keeps its colours.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        # Pinocchio's loader will say so in its own words.
        return [None]
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    instances = list(root.iter("instance_geometry"))
    meshes = [[child for child in mesh if child.tag in _PRIMITIVES] for mesh in root.iter("mesh")]
    kinds = {frozenset(x.get("semantic") for x in child.iter("input")) for mesh in meshes for child in mesh}
    if len(instances) < 2 or (len(kinds) < 2 and max(map(len, meshes)) < 2):
        return [None]
    # Geometries are most of a file: each goes only where it is used.
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
    """The picture in a file, as a texture."""
    return meshcat.geometry.ImageTexture(meshcat.geometry.PngImage(Path(path).read_bytes()), wrap=[_REPEAT, _REPEAT])


def _hex(color: ArrayLike) -> int:
    red, green, blue = (round(255 * float(part)) for part in np.clip(np.asarray(color)[:3], 0.0, 1.0))
    return red << 16 | green << 8 | blue
