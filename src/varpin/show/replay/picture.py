"""Shapes of a robot by body: its meshes, or a skeleton where there are none."""

from __future__ import annotations

import functools
import itertools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.model import Robot, readable_geometry
from varpin.model.kinematics import links
from varpin.model.meshes import MeshPart, parts_of, read_mesh
from varpin.model.tree import joint_axis, z_to

logger = logging.getLogger(__name__)

_ROD, _JOINT, _CENTER = (0.45, 0.52, 0.6, 1.0), (0.85, 0.45, 0.15, 1.0), (0.15, 0.35, 0.65, 1.0)


class Shape(NamedTuple):
    """A shape of a robot."""

    form: pin.GeometryObject  # of its visual geometry, or of a skeleton; on a joint of ``robot.model``
    parts: tuple[MeshPart, ...]  # of its mesh; none for a shape of another kind
    body: int  # the body that carries it, -1 for the base
    placement: pin.SE3  # its placement in the body's frame


@dataclass(frozen=True)
class Picture:
    """The shapes of a robot, on bodies whose joint axis is z."""

    robot: Robot
    shapes: Sequence[Shape]

    @classmethod
    def of(cls, robot: Robot) -> Picture:
        """The picture of a robot from the meshes that can be read."""
        read = functools.cache(read_mesh)
        visuals, missing = readable_geometry(robot, read)
        forms = list(visuals.geometryObjects)
        problem = "; ".join(dict.fromkeys(error for _, error in missing.values()))
        if not forms:
            problem = problem or f"robot {robot.name!r} comes without visual geometry"
            logger.warning("%s; drawing a skeleton of its joints and centres of mass instead", problem)
            forms = list(_skeleton(robot))
        elif missing:
            logger.warning("%s; drawing the skeleton of %s instead", problem, ", ".join(map(repr, missing)))
            bare = {joint for joint, _ in missing.values()}
            forms += [form for form in _skeleton(robot) if form.parentJoint in bare]
        # From the frames of the model's joints, the universe first, to those of the bodies.
        axes = [joint_axis(robot.model, joint)[1] for joint in range(1, robot.model.njoints)]
        turns = [pin.SE3.Identity(), *(pin.SE3(z_to(axis).T, np.zeros(3)) for axis in axes)]
        shapes = [
            Shape(form, parts_of(form, read), form.parentJoint - 1, turns[form.parentJoint] * form.placement)
            for form in forms
        ]
        return cls(robot, shapes)

    def body_poses(self, q: Floats) -> tuple[Floats, Floats]:
        """World rotation (S, b, 3, 3) and position (S, b, 3) [m] of each body at configurations (S, n)."""
        tree, q = self.robot.tree, np.ascontiguousarray(q)
        poses = [links(tree, j).core.place_frame(np.eye(3), np.zeros(3), q, False)[:2] for j in range(len(tree.parent))]
        return np.stack([R for R, _ in poses], axis=1), np.stack([p for _, p in poses], axis=1)

    def swept(self, q: Floats) -> Floats:
        """Points (k, 3) [m] of the world around all shapes at configurations (S, n)."""
        R, p = self.body_poses(q)
        points = [p.reshape(-1, 3)]
        for form, _, body, placement in self.shapes:
            form.geometry.computeLocalAABB()
            box = np.array([form.geometry.aabb_local.min_, form.geometry.aabb_local.max_])
            corners = corners_of(box) @ placement.rotation.T + placement.translation
            if body >= 0:
                corners = (corners @ R[:, body].transpose(0, 2, 1) + p[:, body, None]).reshape(-1, 3)
            points.append(corners)
        return np.concatenate(points)


def corners_of(box: Floats) -> Floats:
    """The corners (8, 3) of a box (2, 3)."""
    return np.stack(np.meshgrid(*box.T), axis=-1).reshape(8, 3)


def label(name: str) -> str:
    """A name as one step of a scene path."""
    return name.replace("/", "_") or "_"


def _skeleton(robot: Robot) -> Iterator[pin.GeometryObject]:
    """Spheres at joints and centres of mass, and rods from each joint to its children, frames and centre of mass."""
    model = robot.model
    ends: list[list[Floats]] = [[] for _ in range(model.njoints)]
    reach = np.zeros(model.njoints)
    for joint, parent in enumerate(model.parents[1:], start=1):
        place = model.jointPlacements[joint].translation
        ends[parent].append(place)
        reach[joint] = reach[parent] + np.linalg.norm(place)
    for frame in model.frames:
        if frame.type in (pin.FrameType.BODY, pin.FrameType.OP_FRAME):
            ends[frame.parentJoint].append(frame.placement.translation)
    centers = {j: body.lever for j, body in enumerate(model.inertias) if j and body.mass > 0.0}
    for joint, center in centers.items():
        ends[joint].append(center)
    far = [max([0.0, *(float(np.linalg.norm(point)) for point in own)]) for own in ends]
    size = float(max(reach + far)) or 1.0
    radius, names = 0.015 * size, itertools.count()

    def bone(joint: int, form: Any, color: ArrayLike, place: Floats, rotation: Floats) -> pin.GeometryObject:
        shape = pin.GeometryObject(f"skeleton{next(names)}", joint, pin.SE3(rotation, place), form)
        shape.meshColor = np.array(color)
        return shape

    for joint, own in enumerate(ends):
        if joint:
            yield bone(joint, pin.coal.Sphere(2.0 * radius), _JOINT, np.zeros(3), np.eye(3))
        for point in own:
            length = float(np.linalg.norm(point))
            if length > radius:
                yield bone(joint, pin.coal.Cylinder(radius, length), _ROD, 0.5 * point, z_to(point / length))
        if joint in centers:
            yield bone(joint, pin.coal.Sphere(1.5 * radius), _CENTER, centers[joint], np.eye(3))
