"""Shapes of a robot by body: its meshes, or a skeleton where there are none."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from varpin.arrays import Floats
from varpin.model import Robot, readable_geometry
from varpin.model.kinematics import links
from varpin.model.meshes import MeshPart, parts_of, read_mesh
from varpin.model.tree import joint_axis, z_to

logger = logging.getLogger(__name__)

_ROD, _JOINT, _CENTER = (0.45, 0.52, 0.6, 1.0), (0.85, 0.45, 0.15, 1.0), (0.15, 0.35, 0.65, 1.0)


@dataclass(frozen=True)
class Picture:
    """The shapes to draw, by body; body -1 is the base.

    The motion of a body's node is one number: the rotation about, or the translation along, the z axis of the joint.
    """

    robot: Robot
    shapes: Sequence[pin.GeometryObject]  # its visual geometry, or a skeleton; on joints of ``robot.model``
    meshes: Sequence[tuple[MeshPart, ...]]  # parts of the mesh of each shape; none for a shape of another kind
    bodies: Sequence[int]  # body of each shape, -1 for the base
    placements: Sequence[pin.SE3]  # placement of each shape in its body's frame

    @classmethod
    def of(cls, robot: Robot) -> Picture:
        """The picture of a robot from the meshes that can be read."""
        read = functools.cache(read_mesh)
        visuals, missing = readable_geometry(robot, read)
        shapes = list(visuals.geometryObjects)
        problem = "; ".join(dict.fromkeys(error for _, error in missing.values()))
        problem = problem or f"robot {robot.name!r} comes without visual geometry"
        if not shapes:
            logger.warning("%s; drawing a skeleton of its joints and centres of mass instead", problem)
            shapes = _skeleton(robot)
        elif missing:
            links = ", ".join(map(repr, missing))
            logger.warning("%s; drawing the skeleton of %s instead", problem, links)
            bare = {joint for joint, _ in missing.values()}
            shapes += [shape for shape in _skeleton(robot) if shape.parentJoint in bare]
        turns = _turns(robot)
        return cls(
            robot,
            shapes,
            [parts_of(shape, read) for shape in shapes],
            [shape.parentJoint - 1 for shape in shapes],
            [turns[shape.parentJoint] * shape.placement for shape in shapes],
        )

    def moving_nodes(self, root: str) -> list[str]:
        """Scene path below ``root`` of each body (b,)."""
        names = labels(self.robot.model.names[1:])
        nodes: list[str] = []
        for name, parent in zip(names, self.robot.tree.parent, strict=True):
            nodes.append(f"{nodes[parent] if parent >= 0 else root}/{name}/moving")
        return nodes

    def body_poses(self, q: Floats) -> tuple[Floats, Floats]:
        """World rotation (S, b, 3, 3) and position (S, b, 3) [m] of each body at configurations (S, n)."""
        tree, q = self.robot.tree, np.ascontiguousarray(q)
        poses = [links(tree, j).core.place_frame(np.eye(3), np.zeros(3), q, False)[:2] for j in range(len(tree.parent))]
        return np.stack([R for R, _ in poses], axis=1), np.stack([p for _, p in poses], axis=1)

    def corners(self, body: int) -> Floats:
        """Corners (k, 3) of the boxes around the shapes on a body, in its frame [m]."""
        boxes = [np.empty((0, 3))]
        for shape, on, placement in zip(self.shapes, self.bodies, self.placements, strict=True):
            if on == body:
                shape.geometry.computeLocalAABB()
                box = np.array([shape.geometry.aabb_local.min_, shape.geometry.aabb_local.max_])
                boxes.append(corners_of(box) @ placement.rotation.T + placement.translation)
        return np.concatenate(boxes)

    def swept(self, q: Floats) -> Floats:
        """Points (k, 3) [m] of the world around all shapes at configurations (S, n)."""
        R, p = self.body_poses(q)
        points = [self.corners(-1), p.reshape(-1, 3)]
        for j in range(R.shape[1]):
            points.append((self.corners(j) @ R[:, j].transpose(0, 2, 1) + p[:, j, None]).reshape(-1, 3))
        return np.concatenate(points)


def corners_of(box: Floats) -> Floats:
    """The corners (8, 3) of a box (2, 3)."""
    return np.stack(np.meshgrid(*box.T), axis=-1).reshape(8, 3)


def _turns(robot: Robot) -> list[pin.SE3]:
    """Rotations from the model's joint frames, the universe first, to those of the bodies, whose joint axis is z."""
    model = robot.model
    axes = [joint_axis(model, joint)[1] for joint in range(1, model.njoints)]
    return [pin.SE3.Identity(), *(pin.SE3(z_to(axis).T, np.zeros(3)) for axis in axes)]


def label(name: str) -> str:
    """A name as one step of a scene path."""
    return name.replace("/", "_") or "_"


# Steps of scene paths that no joint may have.
_TAKEN = ("base", "shapes", "notes", "<object>")


def labels(names: Iterable[str]) -> list[str]:
    """Names as distinct steps of scene paths."""
    found: dict[str, None] = dict.fromkeys(_TAKEN)
    for name in names:
        step, count = label(name), 2
        while step in found:
            step, count = f"{label(name)} {count}", count + 1
        found[step] = None
    return list(found)[len(_TAKEN) :]


def _skeleton(robot: Robot) -> list[pin.GeometryObject]:
    """Spheres at joints and centres of mass, and rods from each joint to its children, frames and centre of mass."""
    model = robot.model
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
