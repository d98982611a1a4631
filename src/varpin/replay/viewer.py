"""A motion shown in meshcat: as one HTML file that needs no server, or live in a browser window."""

from __future__ import annotations

import base64
import contextlib
import copy
import gzip
import html as markup
import io
import logging
import math
import re
import warnings
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import meshcat
import numpy as np
import pinocchio as pin
import umsgpack
from meshcat.animation import Animation, AnimationClip, AnimationTrack
from numpy.typing import ArrayLike, NDArray
from pinocchio.visualize.meshcat_visualizer import MeshcatVisualizer, hasMeshFileInfo, loadMesh

from varpin.robot import Robot, geometry
from varpin.robot.tree import joint_axis, z_to
from varpin.trajectory import atomic_file

Floats = NDArray[np.float64]

logger = logging.getLogger(__name__)

_VERTICAL_VIEW = math.radians(40.0)
_ASPECT = 4.0 / 3.0
_MARGIN = 1.1
# meshcat's grid has 40 x 40 cells of 0.5 m, its axes are 0.5 m long.
_GRID_CELL = 0.5

# A colour that neither robots nor the background have.
_GHOST_COLOR, _GHOST_OPACITY = 0x1450D2, 0.35

_ROD, _JOINT, _CENTER = (0.45, 0.52, 0.6, 1.0), (0.85, 0.45, 0.15, 1.0), (0.15, 0.35, 0.65, 1.0)


def write_page(path: Path, robot: Robot, times: Floats, positions: Mapping[str, Floats], loop: bool) -> Path:
    """Write keyframes as one self-contained HTML file.

    Args:
        path: Of the file.
        robot: The arm.
        times: Of the keyframes (K,) [s of playback].
        positions: Of every joint of the tree (K, b) [rad or m], of "robot" and, if there is one, of its "ghost".
        loop: Start again at the end.
    """
    page = _Page()
    _draw(meshcat.Visualizer(window=page), _Picture.of(robot), times, positions, loop)
    with atomic_file(path) as stream:
        stream.write(page.html(robot.name).encode())
    return path


def show(robot: Robot, times: Floats, positions: Mapping[str, Floats], loop: bool) -> meshcat.Visualizer:
    """Draw keyframes, as :func:`write_page` takes them, in a new meshcat server; point a web browser to it."""
    with contextlib.redirect_stdout(io.StringIO()):
        viewer = meshcat.Visualizer()
    _draw(viewer, _Picture.of(robot), times, positions, loop)
    url = viewer.url()
    logger.info("meshcat serves the motion at %s", url)
    if not webbrowser.open(url, new=2):
        logger.warning("no web browser could be started; open %s in one", url)
    return viewer


class _Page:
    """In place of meshcat's window: keeps the commands that a window would send to its server."""

    def __init__(self) -> None:
        self.commands: list[bytes] = []

    def send(self, command: Any) -> None:
        # three.js computes in single precision; half the bytes say the same.
        self.commands.append(umsgpack.packb(command.lower(), force_float_precision="single"))

    def html(self, title: str) -> str:
        """The page: meshcat's viewer and the commands, compressed."""
        viewer = Path(meshcat.viewer_assets_path(), "dist", "main.min.js").read_text(encoding="utf-8")
        stream = b"".join(len(command).to_bytes(4, "little") + command for command in self.commands)
        packed = base64.b64encode(gzip.compress(stream, 6, mtime=0)).decode()
        return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{markup.escape(title)} - varpin</title>
<link rel="icon" href="data:,">
<style>body {{ margin: 0; }} #meshcat-pane {{ width: 100vw; height: 100vh; overflow: hidden; }}</style>
</head>
<body>
<div id="meshcat-pane"></div>
<script>{viewer}</script>
<script id="commands" type="text/plain">{packed}</script>
<script>{_PLAYER}</script>
</body>
</html>
"""


# The commands go to the viewer one after the other, for a property or an animation needs the object it speaks of.
# A mesh that three.js cannot take is left out; the rest plays.
_PLAYER = """
var viewer;
async function play() {
    viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
    const packed = atob(document.getElementById("commands").textContent);
    const bytes = new Uint8Array(packed.length);
    for (let i = 0; i < packed.length; i++) bytes[i] = packed.charCodeAt(i);
    const unzip = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const data = await new Response(unzip).arrayBuffer();
    const view = new DataView(data);
    for (let at = 0; at < data.byteLength;) {
        const size = view.getUint32(at, true);
        try {
            viewer.handle_command_bytearray(new Uint8Array(data.slice(at + 4, at + 4 + size)));
        } catch (error) {
            console.error(error);
        }
        at += 4 + size;
    }
    document.documentElement.dataset.loaded = "true";
}
play().catch(error => {
    console.error(error);
    document.getElementById("meshcat-pane").textContent = "This motion cannot be shown here: " + error.message;
});
"""


@dataclass(frozen=True)
class _Picture:
    """What to draw, body by body; body -1 is the base.

    A body's node moves by one number: its angle about, or its way along, the z axis of the joint frame.

    Attributes:
        robot: The arm.
        shapes: Its visual geometry, or a skeleton; on joints of ``robot.free_model``.
        bodies: The body each shape is on, -1 for the base.
        placements: Of each shape in its body's frame.
    """

    robot: Robot
    shapes: Sequence[pin.GeometryObject]
    bodies: Sequence[int]
    placements: Sequence[pin.SE3]

    @classmethod
    def of(cls, robot: Robot) -> _Picture:
        """The picture of a robot, made of its meshes if they can be read."""
        model = robot.free_model
        unread: dict[str, str] = {}
        shapes = list(geometry(robot, unread=unread).geometryObjects)
        if not (shapes or unread):
            logger.warning(
                "robot %r comes without visual geometry; drawing a skeleton of its joints and centres of mass instead",
                robot.name,
            )
            shapes = _skeleton(robot)
        elif unread:
            for link, reason in unread.items():
                logger.warning("%s; drawing a skeleton of link %r instead", reason, link)
            bare = {model.frames[model.getFrameId(link, pin.FrameType.BODY)].parentJoint for link in unread}
            shapes += [shape for shape in _skeleton(robot) if shape.parentJoint in bare]
        turns = [np.eye(3), *(z_to(joint_axis(model, joint)[1]) for joint in range(1, model.njoints))]
        return cls(
            robot,
            shapes,
            [shape.parentJoint - 1 for shape in shapes],
            [pin.SE3(turns[shape.parentJoint].T, np.zeros(3)) * shape.placement for shape in shapes],
        )

    def moving_nodes(self, root: str) -> list[str]:
        """Scene path of each body (b,) below a root."""
        names = [_label(name) for name in self.robot.free_model.names[1:]]
        nodes: list[str] = []
        for name, parent in zip(names, self.robot.tree.parent, strict=True):
            nodes.append(f"{nodes[parent] if parent >= 0 else root}/{name}/moving")
        return nodes

    def body_poses(self, positions: Floats) -> tuple[Floats, Floats]:
        """World orientation (S, b, 3, 3) and place (S, b, 3) [m] of each body at joint positions (S, b)."""
        tree = self.robot.tree
        samples, bodies = positions.shape
        R, p = np.empty((samples, bodies, 3, 3)), np.empty((samples, bodies, 3))
        for j, parent in enumerate(tree.parent):
            before = R[:, parent] if parent >= 0 else np.broadcast_to(np.eye(3), (samples, 3, 3))
            origin = p[:, parent] if parent >= 0 else np.zeros(3)
            frame = before @ tree.rotation[j]
            p[:, j] = origin + before @ tree.translation[j]
            if tree.prismatic[j]:
                R[:, j] = frame
                p[:, j] += positions[:, j, None] * frame[:, :, 2]
            else:
                c, s = np.cos(positions[:, j, None]), np.sin(positions[:, j, None])
                R[:, j] = frame
                R[:, j, :, 0] = c * frame[:, :, 0] + s * frame[:, :, 1]
                R[:, j, :, 1] = c * frame[:, :, 1] - s * frame[:, :, 0]
        return R, p

    def corners(self, body: int) -> Floats:
        """Corners (k, 3) of the boxes around the shapes on a body, in its frame [m]."""
        boxes = [np.empty((0, 3))]
        for shape, on, placement in zip(self.shapes, self.bodies, self.placements, strict=True):
            if on == body:
                shape.geometry.computeLocalAABB()
                box = np.array([shape.geometry.aabb_local.min_, shape.geometry.aabb_local.max_])
                corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(8, 3)
                boxes.append(corners @ placement.rotation.T + placement.translation)
        return np.concatenate(boxes)


def _label(name: str) -> str:
    """A name as one step of a scene path."""
    return name.replace("/", "_") or "_"


def _skeleton(robot: Robot) -> list[pin.GeometryObject]:
    """Spheres at the joints and at the centres of mass, and rods from each joint to what hangs on it."""
    model = robot.free_model
    joints = range(1, model.njoints)
    ends: dict[int, list[Floats]] = {joint: [] for joint in range(model.njoints)}
    for joint in joints:
        ends[model.parents[joint]].append(model.jointPlacements[joint].translation)
    for frame in model.frames:
        if frame.type in (pin.FrameType.BODY, pin.FrameType.OP_FRAME):
            ends[frame.parentJoint].append(frame.placement.translation)
    centers = {joint: model.inertias[joint].lever for joint in joints if model.inertias[joint].mass > 0.0}
    reach = {0: 0.0}
    for joint in joints:
        reach[joint] = reach[model.parents[joint]] + float(np.linalg.norm(model.jointPlacements[joint].translation))
    points = [(joint, point) for joint in ends for point in [*ends[joint], centers.get(joint, np.zeros(3))]]
    size = max(reach[joint] + float(np.linalg.norm(point)) for joint, point in points) or 1.0
    radius = 0.015 * size

    shapes: list[pin.GeometryObject] = []

    def add(joint: int, placement: pin.SE3, form: Any, color: tuple[float, ...]) -> None:
        shape = pin.GeometryObject(f"skeleton{len(shapes)}", joint, placement, form)
        shape.meshColor = np.array(color)
        shapes.append(shape)

    for joint in range(model.njoints):
        if joint:
            add(joint, pin.SE3.Identity(), pin.coal.Sphere(2.0 * radius), _JOINT)
        center = centers.get(joint)
        for point in [*ends[joint], *([] if center is None else [center])]:
            length = float(np.linalg.norm(point))
            if length > radius:
                placement = pin.SE3(z_to(point / length), 0.5 * point)
                add(joint, placement, pin.coal.Cylinder(radius, length), _ROD)
        if center is not None:
            add(joint, pin.SE3(np.eye(3), center), pin.coal.Sphere(1.5 * radius), _CENTER)
    return shapes


class _ShapeLoader(MeshcatVisualizer):
    """Pinocchio's reader of shapes and mesh files, told which node each goes to."""

    def __init__(self, viewer: meshcat.Visualizer) -> None:
        super().__init__()
        self.initViewer(viewer=viewer)
        self.node = ""
        self.collada: str | None = None

    def getViewerNodeName(self, geometry_object: pin.GeometryObject, geometry_type: pin.GeometryType) -> str:  # noqa: ARG002
        return self.node

    def loadMeshFromFile(self, geometry_object: pin.GeometryObject) -> Any:
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

    def load_ghost(self, shape: pin.GeometryObject, placement: pin.SE3, node: str) -> None:
        """Send a shape in the ghost's colour: as coal has it, for neither colours nor textures of its file are shown.

        A polygon offset lets the robot win where both are in one place, up to the facets of a sphere that has turned;
        without it they would flicker.
        """
        is_mesh = isinstance(shape.geometry, pin.coal.BVHModelBase)
        with warnings.catch_warnings():
            # The robot's own shape has been reported.
            warnings.simplefilter("ignore", UserWarning)
            form = loadMesh(shape.geometry) if is_mesh else self.loadPrimitive(shape)
        if isinstance(form, meshcat.geometry.Geometry):
            material = meshcat.geometry.MeshPhongMaterial(
                color=_GHOST_COLOR, opacity=_GHOST_OPACITY, transparent=True, polygonOffset=True,
                polygonOffsetFactor=2.0, polygonOffsetUnits=64.0,
            )  # fmt: skip
            self.viewer[node].set_object(form, material)
            self.viewer[node].set_transform(placement.homogeneous)


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


def _draw(
    viewer: meshcat.Visualizer, picture: _Picture, times: Floats, positions: Mapping[str, Floats], loop: bool
) -> None:
    """Send the robot, its ghost, the view and the animation.

    Args:
        viewer: Where to.
        picture: What to draw.
        times: Of the keyframes (K,) [s].
        positions: Of the joints (K, b) [rad or m], of "robot" and "ghost".
        loop: Whether to play for ever.
    """
    tree = picture.robot.tree
    loader = _ShapeLoader(viewer)
    _set_view(viewer, picture, np.concatenate([_samples(rows) for rows in positions.values()]))
    clips = {}
    for root, rows in positions.items():
        nodes = picture.moving_nodes(root)
        for j, node in enumerate(nodes):
            placement = pin.SE3(tree.rotation[j], tree.translation[j])
            viewer[node.removesuffix("/moving")].set_transform(placement.homogeneous)
            viewer[node].set_transform(_joint_motion(bool(tree.prismatic[j]), rows[0, j]))
            # One number a joint: the page then interpolates in q itself, and links stay whole at any frame rate.
            name = "position[z]" if tree.prismatic[j] else "rotation[z]"
            track = AnimationTrack(name, "number", times.tolist(), rows[:, j].tolist())
            # One frame a second, so that keyframe times are seconds.
            clips[viewer[node].path] = AnimationClip({name: track}, fps=1)
        shapes = zip(picture.shapes, picture.bodies, picture.placements, strict=True)
        for k, (shape, body, placement) in enumerate(shapes):
            parent = nodes[body] if body >= 0 else f"{root}/base"
            node = f"{parent}/shapes/{k} {_label(shape.name)}"
            if root == "robot":
                loader.load(shape, placement, node)
            elif body >= 0:
                loader.load_ghost(shape, placement, node)
    if len(times) > 1:
        viewer.set_animation(Animation(clips), play=True, repetitions=math.inf if loop else 1)


def _joint_motion(prismatic: bool, position: float) -> Floats:
    """Transform (4, 4) of a joint along or about z."""
    motion = np.eye(4)
    if prismatic:
        motion[2, 3] = position
    else:
        c, s = math.cos(position), math.sin(position)
        motion[:2, :2] = [[c, -s], [s, c]]
    return motion


def _samples(rows: Floats) -> Floats:
    """Some of many rows, the first and the last among them."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, 50).astype(int))]


def _set_view(viewer: meshcat.Visualizer, picture: _Picture, samples: Floats) -> None:
    """Camera, grid, axes and background to the measure of the robot in some poses (S, b)."""
    R, p = picture.body_poses(samples)
    base = picture.corners(-1)
    swept = [base, p.reshape(-1, 3)]
    for j in range(R.shape[1]):
        swept.append((picture.corners(j) @ R[:, j].transpose(0, 2, 1) + p[:, j, None]).reshape(-1, 3))
    points = np.concatenate(swept)
    extent = float(np.ptp(points, axis=0).max())

    toward = _view_direction(R)
    right = np.cross([0.0, 0.0, 1.0], toward)
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(toward, right), toward])
    seen = points @ axes.T
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    across, up, depth = (seen - middle).T
    tangent = math.tan(0.5 * _VERTICAL_VIEW)
    distance = _MARGIN * float(np.max(depth + np.maximum(np.abs(across) / (_ASPECT * tangent), np.abs(up) / tangent)))

    camera = meshcat.geometry.PerspectiveCamera(
        fov=math.degrees(_VERTICAL_VIEW), aspect=_ASPECT, near=0.01 * distance, far=100.0 * distance
    )
    # meshcat's camera turns about the origin and nothing else, so the middle of the motion is put there.
    shift = -(middle @ axes)
    centered = np.eye(4)
    centered[:3, 3] = shift
    viewer.set_transform(centered)
    offset = distance * toward
    viewer["/Cameras/default/rotated"].set_object(camera)
    # That node turns three.js's upward y into the world's z.
    viewer["/Cameras/default/rotated/<object>"].set_property("position", [offset[0], offset[2], -offset[1]])

    cell = _round_number(extent / 8.0)
    floor = base[:, 2].min() if len(base) else points[:, 2].min()
    scale = [cell / _GRID_CELL] * 3
    viewer["/Grid"].set_property("color", [1.0, 1.0, 1.0, 0.3])
    viewer["/Grid"].set_property("scale", scale)
    viewer["/Grid"].set_property("position", [shift[0], shift[1], shift[2] + float(floor)])
    viewer["/Axes"].set_property("scale", scale)
    viewer["/Axes"].set_property("position", shift.tolist())
    viewer["/Background"].set_property("top_color", [0.97, 0.98, 1.0])
    viewer["/Background"].set_property("bottom_color", [0.72, 0.77, 0.83])


def _view_direction(R: Floats) -> Floats:
    """Unit vector (3,) from the robot to the camera: across the plane of a planar motion, else from front and side.

    Args:
        R: Orientation (S, b, 3, 3) of the bodies, whose third axis is the joint's.
    """
    joint_axes = R[..., 2].reshape(-1, 3)
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
    """The 1, 2 or 5 times a power of ten next below ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))
