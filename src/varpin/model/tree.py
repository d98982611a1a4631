"""A Pinocchio model as flat arrays, with joint frames turned so that every joint axis is z."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers
from varpin.core import Mechanism
from varpin.core.arrays import ConstraintRows, Diffusion, Tree
from varpin.errors import RobotError, UnknownFrame, UnsupportedJoint
from varpin.model.mimic import Tie


def joint_axis(model: pin.Model, joint: int) -> tuple[bool, Floats]:
    """Whether a one-axis joint is prismatic, and its unit axis (3,) in the joint's frame."""
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
    # Pinocchio normalizes axes, except those whose squares overflow or underflow.
    length = float(np.linalg.norm(axis))
    if abs(length - 1.0) > 1e-6:
        raise RobotError(f"joint {name!r} has an axis of length {length:g}, which Pinocchio cannot normalize")
    return bool(linear.any()), axis / length


def is_unbounded(model: pin.Model, joint: int) -> bool:
    """Whether Pinocchio keeps the joint's angle as a (cos, sin) pair."""
    return bool(model.joints[joint].nv == 1 and model.joints[joint].nq == 2)


def z_to(axis: Floats) -> Floats:
    """A rotation matrix (3, 3) whose third column is ``axis``, exact for the coordinate axes."""
    a, b, c = (float(part) for part in axis)
    # Perpendicular to the coordinate axis that is least aligned with this axis.
    x = [(0.0, -c, b), (c, 0.0, -a), (-b, a, 0.0)][int(np.argmin(np.abs(axis)))]
    u, v, w = (part / math.hypot(*x) for part in x)
    return np.array([[u, b * w - c * v, a], [v, c * u - a * w, b], [w, a * v - b * u, c]])


def _is_rigid(placement: pin.SE3) -> bool:
    R = placement.rotation
    if not np.isfinite(placement.homogeneous).all():
        return False
    return bool(np.abs(R.T @ R - np.eye(3)).max() < 1e-6 and np.linalg.det(R) > 0.0)


def flatten(model: pin.Model, ties: tuple[Tie, ...], coordinates: tuple[int, ...]) -> Tree:
    """The tree of a model whose joints all have one axis."""
    tied = {tie.follower: tie for tie in ties}
    index = {joint: c for c, joint in enumerate(coordinates)}
    turn, rows = [np.eye(3)], []
    for joint in range(1, model.njoints):
        slides, axis = joint_axis(model, joint)
        turn.append(z_to(axis))
        before = turn[model.parents[joint]]
        placement = model.jointPlacements[joint]
        if not _is_rigid(placement):
            raise RobotError(f"the placement of joint {model.names[joint]!r} must be a finite rotation and translation")
        link = model.inertias[joint]
        if not (np.isfinite(link.mass) and np.isfinite(link.lever).all() and np.isfinite(link.inertia).all()):
            raise RobotError(f"the link moved by joint {model.names[joint]!r} has a mass or inertia that is not finite")
        about_center = turn[joint].T @ link.inertia @ turn[joint]
        tie = tied.get(joint, Tie(joint, joint, 1.0, 0.0))
        row = {
            "parent": model.parents[joint] - 1,
            "prismatic": int(slides),
            "rotation": before.T @ placement.rotation @ turn[joint],
            "translation": before.T @ placement.translation,
            "mass": link.mass,
            "center": turn[joint].T @ link.lever,
            "inertia": about_center[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]],
            "coordinate": index[tie.leader],
            "ratio": tie.ratio,
            "offset": tie.offset,
        }
        rows.append(row)
    bodies: dict[str, Any] = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    parent, coordinate, prismatic = bodies["parent"], bodies["coordinate"], bodies["prismatic"]
    group = independent_groups(parent, coordinate, len(coordinates))
    # That of followers counts at their leaders, times the squares of their ratios.
    armature: Floats = np.zeros(len(coordinates))
    np.add.at(armature, coordinate, np.asarray(model.armature) * bodies["ratio"] ** 2)
    if not (np.isfinite(armature).all() and (armature >= 0.0).all()):
        raise RobotError(f"armature must be finite and >= 0, got {armature}")
    loads, carried = _light_parts(bodies, len(coordinates))
    return Tree(
        **bodies,
        origin=origins(parent, prismatic),
        loads=loads,
        carried=carried,
        periodic=periodic_coordinates(coordinate, prismatic, bodies["ratio"], len(coordinates)),
        armature=armature,
        group=group,
        groups=int(group.max()) + 1,
        ends=block_ends(group),
    )


def frame_of(model: pin.Model, name: str, robot: str) -> pin.Frame:
    """The frame of a name: the link's where a joint that may be elsewhere has the same."""
    found = [frame for frame in model.frames if frame.name == name] if isinstance(name, str) else []
    if not found:
        # Frames of tools come last.
        raise UnknownFrame(str(name), [frame.name for frame in reversed(model.frames)], f"robot {robot!r} has no frame")
    return next((frame for frame in found if frame.type == pin.FrameType.BODY), found[0])


def place_of_frame(model: pin.Model, frame: str, robot: str) -> tuple[int, Floats, Floats]:
    """The body of the flat tree that carries a frame, -1 for the world, and its rotation and position in that body."""
    found = frame_of(model, frame, robot)
    joint, R, at = found.parentJoint, found.placement.rotation.copy(), found.placement.translation.copy()
    if joint == 0:
        return -1, R, at
    turn = z_to(joint_axis(model, joint)[1])
    return joint - 1, turn.T @ R, turn.T @ at


def origins(parent: Integers, prismatic: Integers) -> Integers:
    """Whether each body (b,) has only prismatic joints above its own: 1 or 0."""
    turns_above = (ancestors(parent) & (prismatic == 0)).sum(axis=1) - (prismatic == 0)
    return np.asarray(turns_above == 0, dtype=np.int64)


# A part is light if its share of the inertia about a joint above it is below this.
LIGHT = 0.005


def ancestors(parent: Integers) -> NDArray[np.bool_]:
    """Ancestors of each body (b, b), itself included: [j, a] is True where a is an ancestor of j or j itself."""
    is_ancestor = np.eye(len(parent), dtype=bool)
    for body, above in enumerate(parent):
        if above >= 0:
            is_ancestor[body] |= is_ancestor[above]
    return is_ancestor


def _light_parts(tree: Mapping[str, Any], dof: int) -> tuple[Integers, Integers]:
    """Light subtrees, whose energy is negligible beside that of the bodies that carry them.

    Their inertia is compared with that of their carrier with all joints stretched out, which bounds both.

    Returns:
        The root body of each light subtree (l,), and whether each coordinate moves within it (l, n): 1 or 0.
    """
    parent, prismatic, mass = tree["parent"], tree["prismatic"], tree["mass"]
    bodies = len(parent)
    is_ancestor = ancestors(parent)
    path = is_ancestor @ np.linalg.norm(tree["translation"], axis=1)  # along the offsets between joints, from the root
    # [a, b]: inertia of body b about the joint of its ancestor a.
    with np.errstate(over="ignore", invalid="ignore"):
        reach = np.linalg.norm(tree["center"], axis=1) + path - path[:, None]
        slides = prismatic[:, None] == 1
        about = mass * np.where(slides, 1.0, reach**2)
        about += np.where(slides, 0.0, tree["inertia"][:, [0, 2, 5]].sum(axis=1) / 2.0)
        about[~is_ancestor.T] = 0.0
        # [a, j]: inertia, about joint a, of all bodies that joint j carries.
        carries = about @ is_ancestor
        light = carries < LIGHT * np.diag(carries)[:, None]
    carrier = np.full(bodies, -1)  # root of the light subtree that a body is in
    joints, rows = [], []
    movers = np.zeros((bodies, dof))
    movers[np.arange(bodies), tree["coordinate"]] = 1.0
    movable = is_ancestor.T.astype(float) @ movers  # [j, c]: how many bodies that joint j carries coordinate c moves
    elsewhere = movers.sum(axis=0) - movable
    for j in range(bodies):
        if parent[j] < 0:
            continue
        carrier[j] = carrier[parent[j]]
        if ((movable[j] > 0) & (elsewhere[j] > 0)).any():  # a mimic joint outside the subtree moves, too
            continue
        above = np.flatnonzero(is_ancestor[j])[:-1]
        if light[above[carrier[above] == carrier[j]], j].any():
            carrier[j] = j
            joints.append(j)
            rows.append(movable[j] > 0)
    shape = (len(joints), dof)
    return np.array(joints, dtype=np.int64), np.array(rows, dtype=np.int64).reshape(shape)


def periodic_coordinates(coordinate: Integers, prismatic: Integers, ratio: Floats, dof: int) -> Integers:
    """Whether a whole turn of each coordinate (n,) is a whole turn of every joint that it moves: 1 or 0."""
    periodic = np.ones(dof, dtype=np.int64)
    periodic[coordinate[(prismatic == 1) | (ratio != np.rint(ratio))]] = 0
    return periodic


def mechanism(tree: Tree, **values: Any) -> Mechanism:
    """A tree in the compiled core, with other ``values``: forces, for one, of which it has none."""
    n = tree.armature.size
    none = np.zeros((n, 0))
    given: dict[str, Any] = {"gravity": np.zeros(3), "forces": (), "couplings": (), "constraints": ConstraintRows()}
    given |= {"custom": None, "actuation": none, "diffusion": Diffusion(none, np.zeros((n, 0, 0)), none, none)}
    return Mechanism.make(tree, **(given | values))


def independent_groups(parent: Integers, coordinate: Integers, dof: int) -> Integers:
    """Groups of coordinates coupled by inertia or mimic joints: a label (n,) from 0 on for each coordinate."""
    label = np.arange(dof)
    for body in np.flatnonzero(parent >= 0):
        one, other = sorted(label[coordinate[[body, parent[body]]]])
        label[label == other] = one
    return np.asarray(np.unique(label, return_inverse=True)[1], dtype=np.int64)


def path_to(tree: Tree, body: int) -> Integers:
    """The bodies from the root to a body; none to the world, -1."""
    return np.flatnonzero(ancestors(tree.parent)[body] if body >= 0 else [])


def path_coordinates(tree: Tree, body: int) -> Integers:
    """The coordinates that move a body; empty for the world, -1."""
    return tree.coordinate[path_to(tree, body)]


def block_ends(group: Integers) -> Integers:
    """Ends (c,) of the shortest runs of coordinates that consist of whole groups.

    Usually each group is one run; groups whose coordinates alternate share one.
    """
    n = group.size
    last = np.zeros(n, dtype=np.int64)
    np.maximum.at(last, group, np.arange(n))
    return np.flatnonzero(np.maximum.accumulate(last[group]) == np.arange(n)) + 1
