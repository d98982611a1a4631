"""From a Pinocchio model to flat arrays: every joint turned so that it moves about or along its own z axis."""

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from varpin.errors import InputError, RobotError, UnknownFrame, UnsupportedJoint
from varpin.kernels.tree import Tree
from varpin.robot.mimic import Tie

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def joint_axis(model: pin.Model, joint: int) -> tuple[bool, Floats]:
    """Whether a one-axis joint is prismatic, and its unit axis (3,) in the joint's frame.

    Raises:
        UnsupportedJoint: The joint has another number of degrees of freedom, screws, or is a composite with a
            placement of its own.
        RobotError: Its axis is zero.
    """
    kind = model.joints[joint]
    name = model.names[joint]
    if kind.nv != 1 or kind.nq > 2:
        raise UnsupportedJoint(name, kind.shortname(), kind.nq)
    data = kind.createData()
    kind.calc(data, pin.neutral(model))
    subspace = np.asarray(data.S, dtype=float).reshape(6)
    linear, angular = subspace[:3], subspace[3:]
    at_zero = pin.SE3(data.M)
    if (linear.any() and angular.any()) or not at_zero.isIdentity(1e-12):
        raise UnsupportedJoint(name, kind.shortname(), kind.nq)
    axis = angular if angular.any() else linear
    if not (np.isfinite(axis).all() and axis.any()):
        raise RobotError(f"joint {name!r} has no axis: its direction is zero or not finite")
    return bool(linear.any()), axis / np.linalg.norm(axis)


def is_unbounded(model: pin.Model, joint: int) -> bool:
    """Whether Pinocchio keeps the joint's angle as a (cos, sin) pair."""
    return bool(model.joints[joint].nv == 1 and model.joints[joint].nq == 2)


def z_to(axis: Floats) -> Floats:
    """A rotation matrix (3, 3) whose third column is ``axis``, exact for the coordinate axes."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])


def _is_rigid(placement: pin.SE3) -> bool:
    R = placement.rotation
    if not np.isfinite(placement.homogeneous).all():
        return False
    return bool(np.abs(R.T @ R - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0.0)


def flatten(model: pin.Model, ties: tuple[Tie, ...], coordinates: tuple[int, ...]) -> Tree:
    """The tree of a model whose joints all have one axis.

    Args:
        model: Every joint on its own, mimic or not.
        ties: Which joints follow which.
        coordinates: Indices of the joints that are generalized coordinates, in their order.

    Raises:
        UnsupportedJoint: A joint has no single axis.
        RobotError: A link's mass, centre or inertia is NaN or infinite, its mass is negative, or a joint's placement
            is no rotation and translation.
    """
    bodies = model.njoints - 1
    tied = {tie.follower: tie for tie in ties}
    index = {joint: c for c, joint in enumerate(coordinates)}
    turn = [np.eye(3)]
    prismatic = np.zeros(bodies, dtype=np.int64)
    rotation = np.zeros((bodies, 3, 3))
    translation = np.zeros((bodies, 3))
    mass = np.zeros(bodies)
    center = np.zeros((bodies, 3))
    inertia = np.zeros((bodies, 6))
    coordinate = np.zeros(bodies, dtype=np.int64)
    ratio = np.ones(bodies)
    offset = np.zeros(bodies)
    for body in range(bodies):
        joint = body + 1
        slides, axis = joint_axis(model, joint)
        turn.append(z_to(axis))
        before = turn[model.parents[joint]]
        placement = model.jointPlacements[joint]
        if not _is_rigid(placement):
            raise RobotError(f"the placement of joint {model.names[joint]!r} is no finite rotation and translation")
        prismatic[body] = slides
        rotation[body] = before.T @ placement.rotation @ turn[joint]
        translation[body] = before.T @ placement.translation
        link = model.inertias[joint]
        if not (np.isfinite(link.mass) and np.isfinite(link.lever).all() and np.isfinite(link.inertia).all()):
            raise RobotError(f"the link moved by joint {model.names[joint]!r} has a mass or inertia that is not finite")
        mass[body] = link.mass
        center[body] = turn[joint].T @ link.lever
        about_center = turn[joint].T @ link.inertia @ turn[joint]
        inertia[body] = about_center[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
        if mass[body] < 0.0:
            raise RobotError(f"the link moved by joint {model.names[joint]!r} has mass {mass[body]} < 0 [kg]")
        if joint in tied:
            tie = tied[joint]
            coordinate[body], ratio[body], offset[body] = index[tie.leader], tie.ratio, tie.offset
        else:
            coordinate[body] = index[joint]
    parent = np.array([model.parents[j] - 1 for j in range(1, model.njoints)], dtype=np.int64)
    group = independent_groups(parent, coordinate, len(coordinates))
    return Tree(
        parent=parent,
        prismatic=prismatic,
        rotation=rotation,
        translation=translation,
        mass=mass,
        center=center,
        inertia=inertia,
        coordinate=coordinate,
        ratio=ratio,
        offset=offset,
        armature=coordinate_armature(model, ties, coordinates),
        group=group,
        groups=int(group.max()) + 1,
    )


def frame_index(model: pin.Model, frame: str, robot: str) -> int:
    """Index of a frame by its name.

    Raises:
        UnknownFrame: There is none.
    """
    names = [item.name for item in model.frames]
    if not isinstance(frame, str) or frame not in names:
        raise UnknownFrame(str(frame), names, robot)
    return names.index(frame)


def frame_on_body(model: pin.Model, frame: str, robot: str) -> tuple[int, Floats, Floats]:
    """The body of the flat tree that carries a frame, and the frame's rotation (3, 3) and place (3,) in it.

    Raises:
        UnknownFrame: There is no such frame.
        InputError: It is fixed to the base, and no joint moves it.
    """
    found = model.frames[frame_index(model, frame, robot)]
    joint = found.parentJoint
    if joint == 0:
        raise InputError(f"frame {frame!r} of robot {robot!r} is fixed to the base: no joint moves it")
    turn = z_to(joint_axis(model, joint)[1])
    return joint - 1, turn.T @ found.placement.rotation, turn.T @ found.placement.translation


def coordinate_armature(model: pin.Model, ties: tuple[Tie, ...], coordinates: tuple[int, ...]) -> Floats:
    """Armature (n,) seen by each coordinate: its own and its followers', by the square of their ratios."""
    own = np.asarray(model.armature, dtype=float)
    armature = np.array([own[model.joints[joint].idx_v] for joint in coordinates])
    for tie in ties:
        armature[coordinates.index(tie.leader)] += tie.ratio**2 * own[model.joints[tie.follower].idx_v]
    if not (np.isfinite(armature).all() and (armature >= 0.0).all()):
        raise RobotError(f"armature must be finite and >= 0, got {armature}")
    return armature


def to_pinocchio(model: pin.Model, positions: Floats) -> Floats:
    """Joint positions (..., k), one a joint, as configurations (..., model.nq) of a model without mimic joints.

    A continuous joint's angle becomes Pinocchio's (cos, sin).
    """
    configuration = np.empty((*positions.shape[:-1], model.nq))
    for k, joint in enumerate(model.joints[1:]):
        if joint.nq == 2:
            configuration[..., joint.idx_q] = np.cos(positions[..., k])
            configuration[..., joint.idx_q + 1] = np.sin(positions[..., k])
        else:
            configuration[..., joint.idx_q] = positions[..., k]
    return configuration


def independent_groups(parent: Integers, coordinate: Integers, dof: int) -> Integers:
    """Which coordinates (n,) move each other: labels from 0 of the groups that inertia or mimic joints tie together.

    Args:
        parent: Of each body (b,), -1 at a root.
        coordinate: Of each body (b,).
        dof: n.
    """
    tied = parent >= 0
    links = coo_array((np.ones(tied.sum()), (coordinate[tied], coordinate[parent[tied]])), shape=(dof, dof))
    _, label = connected_components(links, directed=False)
    return np.asarray(label, dtype=np.int64)
