"""Shapes and mesh files as meshcat can take them."""

from __future__ import annotations

import copy
import logging
import re
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import meshcat
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike
from pinocchio.visualize.meshcat_visualizer import MeshcatVisualizer, hasMeshFileInfo, loadMesh

logger = logging.getLogger(__name__)

# A colour that neither robots nor the background have.
GHOST_COLOR, _GHOST_OPACITY = 0x1450D2, 0.35


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
        if Path(geometry_object.meshPath).suffix.lower() == ".dae":
            _require_pictures(Path(geometry_object.meshPath))
        mesh = super().loadMeshFromFile(geometry_object)
        if self.collada is not None:
            mesh.dae_raw = self.collada
        elif isinstance(mesh, meshcat.geometry.MeshGeometry) and mesh.mesh_format == "obj":
            mesh.contents = _plain_obj(mesh.contents)
        return mesh

    def load(self, shape: pin.GeometryObject, placement: pin.SE3, node: str) -> None:
        """Send a shape and where it sits in its parent node."""
        parts: list[str | None] = [None]
        if Path(shape.meshPath).suffix.lower() == ".dae":
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


_LARGEST_PICTURE = 50_000_000  # [bytes]
# How files of pictures begin: PNG, JPEG, GIF, BMP, TIFF either way, WebP.
_PICTURES = (b"\x89PNG", b"\xff\xd8\xff", b"GIF8", b"BM", b"II*\0", b"MM\0*", b"RIFF")


def _require_pictures(path: Path) -> None:
    """Refuse a Collada file whose textures are something else: all of what it names would go into the page.

    Raises:
        ValueError: It names the file.
    """
    for element in ElementTree.parse(path).iter():
        # Pinocchio's viewer takes any element that has this in its name.
        if "init_from" not in str(element.tag) or not (element.text or "").strip():
            continue
        picture = path.parent / str(element.text)
        if picture.is_file():
            if picture.stat().st_size > _LARGEST_PICTURE:
                raise ValueError(f"its texture {element.text!r} is larger than {_LARGEST_PICTURE / 1e6:g} MB")
            with picture.open("rb") as stream:
                if not stream.read(4).startswith(_PICTURES):
                    raise ValueError(f"its texture {element.text!r} is no picture")


# A file whose parts would add up to more bytes, or whose elements are nested deeper, is taken whole.
_MOST_COPIED, _NESTED = 100_000_000, 100
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
    level, depth = [root], 0
    while level and depth <= _NESTED:
        depth, level = depth + 1, [child for element in level for child in element]
    if level:
        return [None]
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    instances = list(root.iter("instance_geometry"))
    meshes = [[child for child in mesh if child.tag in _PRIMITIVES] for mesh in root.iter("mesh")]
    kinds = {frozenset(x.get("semantic") for x in child.iter("input")) for mesh in meshes for child in mesh}
    copied = len(instances) * Path(path).stat().st_size
    if len(instances) < 2 or copied > _MOST_COPIED or (len(kinds) < 2 and max(map(len, meshes)) < 2):
        return [None]
    parts: list[str | None] = []
    for kept in range(len(instances)):
        part = copy.deepcopy(root)
        here = list(part.iter("instance_geometry"))
        used = here[kept].get("url", "").removeprefix("#")
        for node in part.iter("node"):
            for other in node.findall("instance_geometry"):
                if other is not here[kept]:
                    node.remove(other)
        for library in part.iter("library_geometries"):
            for mesh in library.findall("geometry"):
                if mesh.get("id") != used:
                    library.remove(mesh)
        parts.append(ElementTree.tostring(part, encoding="unicode"))
    return parts


def _plain_obj(text: str) -> str:
    """A Wavefront file's vertices, normals and faces alone, as one mesh.

    meshcat gives it one colour without texture anyway, and stops on parts of which only some have texture coordinates.
    """
    lines = (line for line in text.splitlines() if line.startswith(("v ", "vn ", "f ")))
    return "\n".join(re.sub(r"(\d+)/-?\d*(/?)", r"\1\2\2", line) if line[0] == "f" else line for line in lines)


def _hex(color: ArrayLike) -> int:
    red, green, blue = (round(255 * float(part)) for part in np.clip(np.asarray(color)[:3], 0.0, 1.0))
    return red << 16 | green << 8 | blue
