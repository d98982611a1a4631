"""From a Pinocchio model to flat arrays: every joint turned so that it moves about or along its own z axis."""

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from varpin.errors import InputError, RobotError, UnknownFrame, UnsupportedJoint
from varpin.kernels.tree import Ends, Tree
from varpin.robot.mimic import Tie

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def joint_axis(model: pin.Model, joint: int) -> tuple[bool, Floats]:
    """Whether a one-axis joint is prismatic, and its unit axis (3,) in the joint's frame.

    Raises:
        UnsupportedJoint: The joint has another number of degrees of freedom, screws, or is a composite with a
            placement of its own.
        RobotError: Its axis is zero or no unit vector.
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
    # Pinocchio makes unit vectors of axes, but not of those whose squares are beyond floating point.
    length = float(np.linalg.norm(axis))
    if abs(length - 1.0) > 1e-6:
        raise RobotError(f"joint {name!r} has an axis of length {length:g}, which Pinocchio makes no unit vector of")
    return bool(linear.any()), axis / length


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
    loads, carried = light_parts(parent, coordinate, prismatic, translation, mass, center, inertia, len(coordinates))
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
        origin=origins(parent, prismatic),
        loads=loads,
        carried=carried,
        periodic=periodic_coordinates(coordinate, prismatic, ratio, len(coordinates)),
        armature=coordinate_armature(model, ties, coordinates),
        group=group,
        groups=int(group.max()) + 1,
        ends=block_ends(group),
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
        armature[coordinates.index(tie.leader)] += tie.ratio * tie.ratio * float(own[model.joints[tie.follower].idx_v])
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


def origins(parent: Integers, prismatic: Integers) -> Integers:
    """Which bodies (b,) have no joint above them that turns: 1 or 0."""
    origin = np.ones(len(parent), dtype=np.int64)
    for body, above in enumerate(parent):
        if above >= 0:
            origin[body] = origin[above] and prismatic[above]
    return origin


# A part is light if it has less than this part of the inertia about a joint above it.
LIGHT = 0.005


def light_parts(
    parent: Integers,
    coordinate: Integers,
    prismatic: Integers,
    translation: Floats,
    mass: Floats,
    center: Floats,
    inertia: Floats,
    dof: int,
) -> tuple[Integers, Integers]:
    """Parts whose energy would be lost in that of what carries them.

    Inertias are compared with all joints stretched out, which is a bound for both.

    Args:
        parent: Of each body (b,), -1 at a root.
        coordinate: Of each body (b,).
        prismatic: 1 where the joint of a body slides (b,).
        translation: Of each joint in its parent's frame (b, 3) [m].
        mass: Of each body (b,) [kg].
        center: Of mass in each body's frame (b, 3) [m].
        inertia: Of each body about its centre (b, 6) [kg m^2].
        dof: n.

    Returns:
        The bodies with which they begin (l,), and which coordinates move with each (l, n): 1 or 0.
    """
    bodies = len(parent)
    about = np.zeros((bodies, bodies))  # [a, b]: inertia of body b about the joint of its ancestor a
    below = np.zeros((bodies, bodies), dtype=bool)
    for b in range(bodies):
        reach, a = float(np.linalg.norm(center[b])), b
        while a >= 0:
            below[a, b] = True
            about[a, b] = mass[b] * (1.0 if prismatic[a] else reach**2)
            if not prismatic[a]:
                about[a, b] += inertia[b, [0, 2, 5]].sum() / 2.0
            reach += float(np.linalg.norm(translation[a]))
            a = parent[a]
    carrier = np.full(bodies, -1)  # the light part a body is in
    loads, rows = [], []
    for j in range(bodies):
        a = parent[j]
        if a < 0:
            continue
        carrier[j] = carrier[a]
        moved = np.zeros(dof, dtype=bool)
        moved[coordinate[below[j]]] = True
        if moved[coordinate[~below[j]]].any():  # a mimic joint elsewhere moves along
            continue
        while a >= 0 and carrier[a] == carrier[j]:
            if about[a, below[j]].sum() < LIGHT * about[a, below[a]].sum():
                carrier[j] = j
                loads.append(j)
                rows.append(moved)
                break
            a = parent[a]
    shape = (len(loads), dof)
    return np.array(loads, dtype=np.int64), np.array(rows, dtype=np.int64).reshape(shape)


def periodic_coordinates(coordinate: Integers, prismatic: Integers, ratio: Floats, dof: int) -> Integers:
    """Which coordinates (n,) bring every joint they move back by a whole turn: 1 or 0."""
    periodic = np.ones(dof, dtype=np.int64)
    periodic[coordinate[(prismatic == 1) | (ratio != np.rint(ratio))]] = 0
    return periodic


def require_sound(tree: Tree) -> None:
    """Refuse arrays that kernels, which check no bounds, would read or write beyond their ends.

    :func:`flatten` makes none; a tree that was changed afterwards may be one.

    Raises:
        RobotError: Naming the array.
    """
    b, n = np.size(tree.parent), np.size(tree.armature)
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
        ("parent", "prismatic", "mass", "coordinate", "ratio", "origin"), (b,)
    )
    shapes |= {"offset": (b,), "rotation": (b, 3, 3), "translation": (b, 3), "center": (b, 3), "inertia": (b, 6)}
    shapes |= {"armature": (n,), "group": (n,), "periodic": (n,)}
    shapes |= {"loads": (np.size(tree.loads),), "carried": (np.size(tree.loads), n)}
    whole = ("parent", "prismatic", "coordinate", "group", "origin", "periodic", "loads", "carried")
    for name, shape in shapes.items():
        array = getattr(tree, name)
        kind = np.int64 if name in whole else np.float64
        if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != kind:
            raise RobotError(f"the robot's tree is damaged: its {name} is no array {shape} of {np.dtype(kind)}")
        if kind is np.float64 and not np.isfinite(array).all():
            raise RobotError(f"the robot's tree is damaged: its {name} is not finite")
    # (name, lowest, beyond the highest)
    for name, low, high in (
        ("parent", -1, np.arange(b)),
        ("coordinate", 0, n),
        ("group", 0, min(n, tree.groups)),
        ("loads", 0, b),
    ):
        values = getattr(tree, name)
        if ((values < low) | (values >= high)).any():
            raise RobotError(f"the robot's tree is damaged: its {name} points to what is not there")
    ends, known = tree.ends, block_ends(tree.group)
    indices = not isinstance(ends, np.ndarray) or ends.dtype == np.int64
    if type(ends) is not type(known) or not indices or not np.array_equal(ends, known):
        raise RobotError("the robot's tree is damaged: its blocks do not end where groups do")


def tree_mass_matrix(tree: Tree, q: Floats) -> Floats:
    """M(q) (n, n), armature included: M_ij = S_i . Y_j S_j for an ancestor i of j, or j itself; see kernels.jet.

    In plain NumPy and n^2 memory, for robots whose data in Pinocchio would not fit.
    """
    bodies = tree.parent.size
    rotation, position = np.empty((bodies, 3, 3)), np.empty((bodies, 3))
    axis, inertia = np.zeros((bodies, 6)), np.zeros((bodies, 6, 6))
    M = np.zeros((bodies, bodies))
    for j, s in enumerate(tree.ratio * q[tree.coordinate] + tree.offset):
        up = tree.parent[j]
        R, p = (rotation[up], position[up]) if up >= 0 else (np.eye(3), np.zeros(3))
        p, R = p + R @ tree.translation[j], R @ tree.rotation[j]
        z = R[:, 2]
        if tree.prismatic[j]:
            p = p + s * z
            axis[j, :3] = z
        else:
            R = R @ np.array([[np.cos(s), -np.sin(s), 0.0], [np.sin(s), np.cos(s), 0.0], [0.0, 0.0, 1.0]])
            axis[j, :3], axis[j, 3:] = np.cross(p, z), z
        rotation[j], position[j] = R, p
        x, y, w = p + R @ tree.center[j]
        cross = np.array([[0.0, -w, y], [w, 0.0, -x], [-y, x, 0.0]])
        xx, xy, yy, xz, yz, zz = tree.inertia[j]
        own = R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T
        m = tree.mass[j]
        inertia[j] = np.block([[m * np.eye(3), -m * cross], [m * cross, own - m * cross @ cross]])
    for j in range(bodies - 1, -1, -1):
        dual, i = inertia[j] @ axis[j], j
        while i >= 0:
            M[i, j] = M[j, i] = axis[i] @ dual
            i = tree.parent[i]
        if tree.parent[j] >= 0:
            inertia[tree.parent[j]] += inertia[j]
    G = np.zeros((bodies, tree.armature.size))
    G[np.arange(bodies), tree.coordinate] = tree.ratio
    return np.asarray(G.T @ M @ G + np.diag(tree.armature))


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


def block_ends(group: Integers) -> Ends:
    """Where runs of coordinates end that hold whole groups (c,); a tuple if there is one.

    Mostly each group is one run; groups whose coordinates take turns share one.

    Args:
        group: Of each coordinate (n,), from :func:`independent_groups`.
    """
    n = group.size
    last = np.zeros(n, dtype=np.int64)
    np.maximum.at(last, group, np.arange(n))
    ends = np.flatnonzero(np.maximum.accumulate(last[group]) == np.arange(n)) + 1
    return ends if len(ends) > 1 else (n,)
