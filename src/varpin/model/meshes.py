"""Mesh files: what is weighed, kept clear of obstacles and drawn is the same triangles.

coal's loader, which Pinocchio uses, points the triangles of a file's second material at the vertices of the first,
ignores the units of Collada files and leaves mirrored meshes inside out.
"""

from __future__ import annotations

import io
import logging
import re
import textwrap
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from varpin.arrays import Floats
from varpin.errors import FileError
from varpin.model.packages import content
from varpin.support.checks import is_file

logger = logging.getLogger(__name__)

coal = pin.coal

# Longest text of a reader's own in an error.
_REASON = 100
# Suffixes of images that browsers can show.
_PICTURES = frozenset([".png", ".jpg", ".jpeg", ".gif", ".bmp", ".webp"])
# What a Collada file may have besides triangles; a fault in it costs the colours, not the shape.
_BESIDE = frozenset(
    f"{kind}_{what}"
    for kind in ("library", "instance")
    for what in ("animations", "camera", "cameras", "effects", "images", "light", "lights")
) | {"bind_material", "library_materials", "lines", "linestrips"}


@dataclass(frozen=True, eq=False)
class MeshPart:
    """The triangles of a mesh that share a material; colours are from 0 to 1."""

    vertices: Floats  # corners (V, 3) [m]
    faces: NDArray[np.int64]  # indices of the corners of each triangle (F, 3), anticlockwise from outside
    normals: Floats | None = None  # unit normals at the corners (V, 3)
    uv: Floats | None = None  # texture coordinates (V, 2)
    colors: Floats | None = None  # red, green and blue at the corners (V, 3)
    color: Floats | None = None  # red, green, blue and opacity (4,) of the material
    shine: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)  # more of it, by three.js's names
    texture: Path | None = None  # an image file

    def moved(self, matrix: Floats) -> MeshPart:
        """The part under a linear map and a translation (4, 4); a mirror image keeps its outside."""
        if (matrix == np.eye(4)).all():
            return self
        turn = matrix[:3, :3]
        faces = self.faces if np.linalg.det(turn) >= 0.0 else self.faces[:, ::-1]
        normals = self.normals
        if normals is not None:
            normals = np.einsum("ij,jk->ik", normals, np.linalg.pinv(turn))
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
        # einsum, as threads of linear algebra take longer.
        vertices = np.einsum("ij,kj->ik", self.vertices, turn) + matrix[:3, 3]
        return replace(self, vertices=vertices, faces=faces, normals=normals)


Reader = Callable[[str], tuple[MeshPart, ...]]


def read_mesh(path: str) -> tuple[MeshPart, ...]:
    """Read a mesh file, Collada, Wavefront (.obj), STL, PLY, OFF or glTF: at least one part for each material [m].

    Lengths of a Collada file are in its unit; its ``<up_axis>`` is ignored, as RViz, MoveIt and Gazebo do.
    """
    file = Path(path)
    if not is_file(file):
        raise FileError(f"no mesh file {path!r}")
    read = _READERS.get(file.suffix.lower())
    if read is None:
        raise FileError(f"the mesh {path} is of a kind that is not read: convert it to one of {', '.join(_READERS)}")
    try:
        parts = tuple(part for part in read(file, content(file, FileError)) if len(part.faces))
    except FileError:
        raise
    except Exception as error:  # Readers of damaged files fail in many ways.
        raise FileError(f"the mesh {path} cannot be read: {textwrap.shorten(str(error), _REASON)}") from None
    if not parts:
        raise FileError(f"the mesh {path} has no triangles")
    if not all(np.isfinite(part.vertices).all() for part in parts):
        raise FileError(f"the mesh {path} has corners that are no finite numbers")
    return parts


def _read_plain(file: Path, data: bytes) -> list[MeshPart]:  # noqa: ARG001
    """The triangles of a file without materials."""
    import trimesh  # noqa: PLC0415 - takes a while

    mesh = trimesh.load_scene(str(file), process=False).to_mesh()
    return [joined([MeshPart(_floats(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))])]


def _read_wavefront(file: Path, data: bytes) -> list[MeshPart]:
    from trimesh.exchange.obj import load_obj  # noqa: PLC0415 - takes a while
    from trimesh.geometry import triangulate_quads  # noqa: PLC0415 - as above
    from trimesh.resolvers import FilePathResolver  # noqa: PLC0415 - as above

    class Beside(FilePathResolver):
        """Material libraries and images in the folder of the file; the log tells which are missing."""

        def get(self, name: str) -> Any:
            try:
                return super().get(named(name))
            except OSError:
                level = logging.INFO if name.endswith(".mtl") else logging.WARNING
                logger.log(level, "%s: its texture or material library %r is not there", file, name)
                raise

    def named(words: str) -> str:
        """The name of a file, which options may precede."""
        return words if is_file(file.parent / words) else words.rsplit(" ", maxsplit=1)[-1]

    text = data.decode("utf-8", errors="replace").replace("\\\n", " ")
    if re.search(r"^[ \t]|^f.*-|^[fv].*#", text, re.MULTILINE):
        text = _simplified(text)
    loaded = load_obj(io.StringIO(text), resolver=Beside(str(file), allow_anywhere=True))
    parts = []
    for mesh in loaded.get("geometry", {}).values():
        visual, normals, colors = mesh.get("visual"), mesh.get("vertex_normals"), mesh.get("vertex_colors")
        material = getattr(visual, "material", None)
        looks = getattr(material, "kwargs", {})
        color = None
        if "kd" in looks:
            opacity = float(looks["d"][-1]) if "d" in looks else 1.0 - float(looks.get("tr", ["0"])[-1])
            color = np.clip([*looks["kd"], opacity], 0.0, 1.0)
        image = getattr(getattr(material, "image", None), "info", {}).get("file_path")
        parts.append(
            MeshPart(
                _floats(mesh["vertices"]),
                triangulate_quads(mesh["faces"], dtype=np.int64),
                None if normals is None else _floats(normals),
                None if getattr(visual, "uv", None) is None else _floats(visual.uv),
                None if colors is None else _floats(colors)[:, :3],
                color,
                texture=None if image is None else _texture(named(image), file),
            )
        )
    return parts[::-1]


def _simplified(text: str) -> str:
    """A Wavefront text without what trimesh misreads: blanks before words, comments behind and negative numbers."""
    seen = {"v": 0, "vt": 0, "vn": 0}

    def counted(line: str) -> str:
        word, *corners = line.partition("#")[0].split() or [""]
        if word != "f" and word not in seen:
            return line.lstrip()
        if word != "f":
            seen[word] += 1
            return " ".join([word, *corners])
        pairs = (zip(corner.split("/"), seen.values(), strict=False) for corner in corners)
        return "f " + " ".join(
            "/".join(str(count + 1 + int(number)) if number[:1] == "-" else number for number, count in corner)
            for corner in pairs
        )

    return "\n".join(map(counted, text.splitlines()))


def _read_collada(file: Path, data: bytes) -> list[MeshPart]:
    import collada  # noqa: PLC0415 - few robots need it

    try:
        document = collada.Collada(io.BytesIO(data))
    except collada.DaeError as error:
        root = ET.fromstring(data)
        for parent in list(root.iter()):
            for child in [child for child in parent if child.tag.rpartition("}")[2] in _BESIDE]:
                parent.remove(child)
        document = collada.Collada(io.BytesIO(ET.tostring(root)))
        logger.warning("%s: its colours cannot be read and are left out: %s", file, error)
    unit = document.assetInfo.unitmeter
    unit = 1.0 if unit is None else unit
    if not 0.0 < unit < np.inf:
        raise FileError(f"the mesh {file} has a <unit> of {unit:g} m")
    scale = np.diag([unit, unit, unit, 1.0])
    scenes = [document.scene] if document.scene is not None else document.scenes
    found = [instance for scene in scenes for node in scene.nodes for instance in _instances(node, scale)]
    parts = []
    for geometry, bound, matrix in found:
        effects = {material.symbol: material.target.effect for material in bound}
        for primitive in geometry.primitives:
            triangles = primitive.triangleset() if hasattr(primitive, "triangleset") else primitive
            if isinstance(triangles, collada.triangleset.TriangleSet) and triangles.vertex is not None:
                parts.append(_collada_part(triangles, effects.get(triangles.material), file).moved(matrix))
    return parts


def _instances(node: Any, matrix: Floats) -> Iterator[tuple[Any, Any, Floats]]:
    """The geometries at and below a node, each with its materials and its placement (4, 4)."""
    geometry = getattr(node, "geometry", None) or getattr(getattr(node, "controller", None), "geometry", None)
    if geometry is not None:
        yield geometry, node.materials, matrix
    for child in getattr(node, "children", ()):
        yield from _instances(child, matrix @ _floats(node.matrix))


def _collada_part(triangles: Any, effect: Any, file: Path) -> MeshPart:
    sources = [(triangles.vertex, triangles.vertex_index), (triangles.normal, triangles.normal_index), (None, None)]
    if len(triangles.texcoordset):
        sources[2] = triangles.texcoordset[0], triangles.texcoord_indexset[0]
    for offset, _, _, _, source, *_ in triangles.sources.get("COLOR", ())[:1]:
        sources.append((source.data, triangles.index[:, :, offset]))
    # Corners with the same indices become one.
    corners = np.zeros(triangles.vertex_index.size, dtype=np.int64)
    for _, index in sources:
        if index is not None:
            corners = np.unique(corners * (index.max(initial=0) + 1) + index.ravel(), return_inverse=True)[1]
    _, first, faces = np.unique(corners, return_index=True, return_inverse=True)
    vertices, normals, uv, colors = (
        None if data is None or index is None else _floats(data[index.ravel()[first]])
        for data, index in [*sources, (None, None)][:4]
    )
    color, shine, texture = None, {}, None
    if effect is not None:
        diffuse = effect.diffuse
        if hasattr(diffuse, "sampler"):
            texture, diffuse = _texture(diffuse.sampler.surface.image.path, file) if uv is not None else None, None
        color = np.clip([*(diffuse or (1.0, 1.0, 1.0))[:3], _opacity(effect)], 0.0, 1.0)
        given = {"emissive": effect.emission, "specular": effect.specular, "shininess": effect.shininess}
        # Lambert's surfaces do not shine.
        given = given if effect.shadingtype in ("phong", "blinn") else given | {"specular": (0.0, 0.0, 0.0)}
        shine = {name: value for name, value in given.items() if isinstance(value, tuple | float)}
    assert vertices is not None
    colors = None if colors is None else colors[:, :3]
    uv = None if uv is None else uv[:, :2]
    return MeshPart(vertices, faces.reshape(-1, 3), normals, uv, colors, color, shine, texture)


def _opacity(effect: Any) -> float:
    """The opacity of a Collada material (specification 1.4.1, chapter 7, "Determining Transparency")."""
    if not isinstance(effect.transparent, tuple) or not isinstance(effect.transparency, float):
        return 1.0
    if effect.opaque_mode == "RGB_ZERO":
        return 1.0 - effect.transparent[0] * effect.transparency
    return float(effect.transparent[3]) * effect.transparency


def _floats(numbers: ArrayLike) -> Floats:
    return np.asarray(numbers, dtype=np.float64)


def _texture(name: str, file: Path) -> Path | None:
    """An image that a mesh file names, if browsers can show it; otherwise the log says so."""
    path = file.parent / unquote(name.removeprefix("file://")).replace("\\", "/")
    if not is_file(path):
        logger.warning("%s: its texture %r is not there", file, name)
    elif path.suffix.lower() not in _PICTURES:
        logger.warning("%s: its texture %r is of a kind that browsers do not show", file, name)
    else:
        return path
    return None


# Readers by suffix; lengths of the files of trimesh are metres.
_READERS: Mapping[str, Callable[[Path, bytes], list[MeshPart]]] = {
    ".dae": _read_collada,
    ".zae": _read_collada,
    ".obj": _read_wavefront,
    **dict.fromkeys((".stl", ".ply", ".off", ".glb", ".gltf"), _read_plain),
}


def joined(parts: Sequence[MeshPart]) -> MeshPart:
    """The triangles of several parts as one without looks, with one corner at each place."""
    vertices, faces = _together(parts)
    order = np.lexsort(vertices.T)
    new = np.ones(len(order), dtype=bool)
    new[1:] = (vertices[order[1:]] != vertices[order[:-1]]).any(axis=1)
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.cumsum(new) - 1
    return MeshPart(vertices[order[new]], place[faces])


def _together(parts: Sequence[MeshPart]) -> tuple[Floats, NDArray[np.int64]]:
    shifts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + shift for part, shift in zip(parts, shifts, strict=False)]
    return np.concatenate([part.vertices for part in parts]), np.concatenate(faces)


def coal_shape(parts: Sequence[MeshPart]) -> Any:
    """The triangles of some parts for coal, without the tree of boxes that collisions need: ``endModel`` builds it."""
    (vertices, faces), shape = _together(parts), coal.BVHModelOBBRSS()
    shape.beginModel(len(faces), len(vertices))
    shape.addVertices(vertices)
    shape.addTriangles(faces)
    return shape


def parts_of(shape: pin.GeometryObject, read: Reader = read_mesh) -> tuple[MeshPart, ...]:
    """The parts of a shape's mesh: of its file, or of its triangles if it has none; empty if it is no mesh."""
    if not isinstance(shape.geometry, coal.BVHModelBase):
        return ()
    if shape.meshPath:
        return _scaled(read(shape.meshPath), shape.meshScale)
    mesh = shape.geometry
    faces = [[triangle[k] for k in range(3)] for triangle in map(mesh.tri_indices, range(mesh.num_tris))]
    return (MeshPart(_floats(mesh.vertices()).reshape(-1, 3), np.array(faces).reshape(-1, 3)),)


def shape_points(shape: pin.GeometryObject) -> Floats:
    """Points (N, 3) [m], in the axes of a shape's joint, whose hull contains the shape."""
    if isinstance(shape.geometry, coal.BVHModelBase):
        points = _floats(shape.geometry.vertices()).reshape(-1, 3)
    elif isinstance(shape.geometry, coal.ConvexBase):
        points = np.array([shape.geometry.point(i) for i in range(shape.geometry.num_points)])
    else:
        shape.geometry.computeLocalAABB()
        box = shape.geometry.aabb_local
        points = np.array(list(product(*zip(box.min_, box.max_, strict=True))))
    return np.asarray(points @ shape.placement.rotation.T + shape.placement.translation)


def put_mesh(shape: pin.GeometryObject, path: str, scale: ArrayLike, read: Reader) -> None:
    """Give a shape the mesh of a file."""
    shape.geometry = coal_shape(_scaled(read(path), scale))
    shape.meshPath, shape.meshScale = path, _floats(scale)


def with_own_meshes(shapes: pin.GeometryModel, read: Reader) -> pin.GeometryModel:
    """Shapes with the meshes of their files in place of what coal's loader made of them."""
    own = shapes.copy()
    for shape in own.geometryObjects:
        if shape.meshPath and isinstance(shape.geometry, coal.BVHModelBase):
            try:
                put_mesh(shape, shape.meshPath, shape.meshScale, read)
            except FileError as error:
                shape.meshPath = ""
                logger.warning("%s; shape %r is as Pinocchio read it", error, shape.name)
    return own


def _scaled(parts: Sequence[MeshPart], scale: ArrayLike) -> tuple[MeshPart, ...]:
    return tuple(part.moved(np.diag([*_floats(scale), 1.0])) for part in parts)
