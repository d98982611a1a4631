"""Where a frame and the centre of mass are, with their derivatives, at many configurations at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from varpin.core import Links as Core
from varpin.core import rotation_logarithms
from varpin.core.arrays import Tree
from varpin.errors import InputError
from varpin.frozen import Frozen
from varpin.robot.model import Robot
from varpin.robot.tree import frame_on_body

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Links(Frozen):
    """Some bodies of a robot's tree with all their ancestors, each on one joint.

    Attributes:
        parent: Index among these bodies (c,), -1 at a root; parents come first.
        prismatic: 1 for a prismatic joint, 0 for a revolute one (c,).
        rotation: Of the joint's frame in its parent's at joint position 0 (c, 3, 3).
        translation: The same (c, 3) [m].
        coordinate: Which one moves the joint (c,), among all n.
        ratio: Of the joint's position to the coordinate (c,).
        offset: The joint's position where the coordinate is 0 (c,) [rad or m].
        gear: What each coordinate does to each of their c joints (c, n): a selection, but for mimic joints.
    """

    parent: Integers
    prismatic: Integers
    rotation: Floats
    translation: Floats
    coordinate: Integers
    ratio: Floats
    offset: Floats
    gear: Floats

    @cached_property
    def core(self) -> Core:
        """The same for the compiled core."""
        return Core.make(**{name: getattr(self, name) for name in _JOINT}, dof=self.gear.shape[1])

    def place(self, q: Floats) -> tuple[Floats, Floats]:
        """World rotations (N, c, 3, 3) and positions (N, c, 3) [m] at q (N, n)."""
        return self.core.place(np.ascontiguousarray(q))

    def motions(self, rotation: Floats, lever: Floats) -> tuple[Floats, Floats]:
        """Angular (N, c, 3) and linear velocity (N, c, 3) that each joint gives to a point at ``lever`` from it.

        In world axes and per unit of the joint's rate; ``lever`` is (N, c, 3).
        """
        z = rotation[:, :, :, 2]
        turns = (self.prismatic == 0)[:, None]
        angular = np.where(turns, z, 0.0)
        return angular, np.where(turns, cross(z, lever), z)


_JOINT = ("parent", "prismatic", "rotation", "translation", "coordinate", "ratio", "offset")


def links(tree: Tree, body: int | None = None) -> Links:
    """The bodies from the root to one of them, or all of them."""
    if body is None:
        members = np.arange(tree.parent.size)
    else:
        path = [body]
        while tree.parent[path[-1]] >= 0:
            path.append(int(tree.parent[path[-1]]))
        members = np.array(path[::-1])
    index = {int(b): k for k, b in enumerate(members)}
    gear = np.zeros((len(members), tree.armature.size))
    gear[np.arange(len(members)), tree.coordinate[members]] = tree.ratio[members]
    parent = np.array([index.get(int(tree.parent[b]), -1) for b in members], dtype=np.int64)
    return Links(parent, **{name: getattr(tree, name)[members] for name in _JOINT[1:]}, gear=gear)


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """How the c joints before a frame move it at N configurations, from the root on.

    Attributes:
        angular: Angular velocity that each joint gives it (N, c, 3), in world axes, per unit of the joint's rate.
        linear: Velocity of its origin likewise (N, c, 3).
        gear: From coordinates to joints (c, n).
    """

    angular: Floats
    linear: Floats
    gear: Floats

    def twist_in_q(self, v: Floats) -> Floats:
        """Derivative (N, 6, n) in q of linear and angular velocity at velocities v (N, n).

        A joint turns the axes of all after it: with w_i and l_i what joint i gives to the frame, d l_j / dq_i is
        w_i x l_j for i up to j and w_j x l_i beyond, and d w_j / dq_i is w_i x w_j for i before j, else zero.
        """
        rate = (v @ self.gear.T)[:, :, None]
        spin, slide = rate * self.angular, rate * self.linear
        before = np.cumsum(spin, axis=1) - spin
        beyond = spin.sum(axis=1, keepdims=True) - before - spin
        from_here = slide.sum(axis=1, keepdims=True) - np.cumsum(slide, axis=1) + slide
        linear = cross(self.angular, from_here) + cross(before, self.linear)
        both = np.concatenate([linear, cross(self.angular, beyond)], axis=2)
        total: Floats = np.swapaxes(both, 1, 2) @ self.gear
        return total

    def jacobian_in_q(self) -> Floats:
        """Derivative (N, n, 6, n) of the Jacobian: [:, i] in q_i, as in :meth:`twist_in_q`."""
        c = self.angular.shape[1]
        w, slide = self.angular, self.linear
        first = np.arange(c)[:, None] <= np.arange(c)[None, :]  # joint i is not after joint j
        ahead = cross(w[:, :, None], slide[:, None, :])  # [i, j]: w_i x l_j
        linear = np.where(first[:, :, None], ahead, np.swapaxes(ahead, 1, 2))
        turned = np.where(np.triu(first, 1)[:, :, None], cross(w[:, :, None], w[:, None, :]), 0.0)
        both = np.concatenate([linear, turned], axis=3)
        total: Floats = np.einsum("Nijr,ia,jb->Narb", both, self.gear, self.gear, optimize=True)
        return total


@dataclass(frozen=True, eq=False)
class FrameKinematics(Frozen):
    """A frame of a robot. Made by :func:`frame_kinematics`.

    Attributes:
        frame: Its name.
        links: The bodies from the root to the one that carries it.
        rotation: Its orientation in that body (3, 3).
        translation: Its place there (3,) [m].
    """

    frame: str
    links: Links
    rotation: Floats
    translation: Floats

    @cached_property
    def key(self) -> bytes:
        """The same for frames that are the same."""
        own = self.links
        arrays = *(getattr(own, name) for name in _JOINT), self.rotation, self.translation
        return b"".join(array.tobytes() for array in arrays)

    def placements(self, q: Floats) -> tuple[Floats, Floats]:
        """World rotations (N, 3, 3) and positions (N, 3) [m] at q (N, n)."""
        return self._placed(q, jacobian=False)[:2]

    def jacobians(self, q: Floats) -> tuple[Floats, Floats, Floats]:
        """:meth:`placements`, and the frame's Jacobian (N, 6, n): linear over angular velocity in world axes, in v."""
        return self._placed(q, jacobian=True)

    def _placed(self, q: Floats, *, jacobian: bool) -> tuple[Floats, Floats, Floats]:
        return self.links.core.place_frame(self.rotation, self.translation, np.ascontiguousarray(q), jacobian)

    def motion(self, q: Floats) -> FrameMotion:
        """How each joint moves the frame at q (N, n)."""
        rotation, position = self.links.place(q)
        p = position[:, -1] + rotation[:, -1] @ self.translation
        angular, linear = self.links.motions(rotation, p[:, None] - position)
        return FrameMotion(angular, linear, self.links.gear)


def frame_kinematics(robot: Robot, frame: str) -> FrameKinematics:
    """A frame by its name.

    Raises:
        UnknownFrame: The robot has no such frame.
        InputError: No joint moves it.
    """
    body, rotation, translation = frame_on_body(robot.free_model, frame, robot.name)
    return FrameKinematics(frame, links(robot.tree, body), rotation, translation)


@dataclass(frozen=True, eq=False)
class CenterOfMass(Frozen):
    """The centre of mass of the links that joints move. Made by :func:`center_of_mass`.

    Attributes:
        links: All bodies.
        center: Of each in its own frame (b, 3) [m].
        share: Of the mass in each (b,).
        after: Which bodies each joint moves (b, b): ones in row j for j and all after it.
    """

    links: Links
    center: Floats
    share: Floats
    after: Floats

    def position(self, q: Floats) -> Floats:
        """In the world (N, 3) [m] at q (N, n)."""
        total: Floats = self.share @ self._centers(*self.links.place(q))
        return total

    def _centers(self, rotation: Floats, position: Floats) -> Floats:
        centers: Floats = position + (rotation @ self.center[:, :, None])[..., 0]
        return centers

    def motion(self, q: Floats) -> tuple[Floats, Floats]:
        """Position (N, 3) and its derivative in q (N, 3, n)."""
        rotation, position = self.links.place(q)
        moments = self.share[:, None] * self._centers(rotation, position)
        moved = self.after @ self.share  # the share of the mass that a joint moves
        # The joint moves that part as one body: its share times the lever to its centre.
        lever = self.after @ moments - moved[:, None] * position
        _, linear = self.links.motions(rotation, lever)
        linear = np.where(self.links.prismatic[:, None] == 0, linear, moved[:, None] * linear)
        return moments.sum(axis=1), np.swapaxes(linear, 1, 2) @ self.links.gear


def center_of_mass(robot: Robot) -> CenterOfMass:
    """The centre of mass of the links that joints move.

    Raises:
        InputError: They have no mass.
    """
    tree = robot.tree
    if not tree.mass.sum() > 0.0:
        raise InputError(f"the links of robot {robot.name!r} have no mass, so no centre of it")
    count = tree.parent.size
    after = np.eye(count)
    for body in range(count - 1, -1, -1):
        if tree.parent[body] >= 0:
            after[tree.parent[body]] += after[body]
    return CenterOfMass(links(tree), tree.center, tree.mass / tree.mass.sum(), after)


def rotation_errors(target: Floats, R: Floats, *, derivative: bool = False) -> tuple[Floats, Floats]:
    """Rotation vectors (..., 3) [rad] from targets (T, 3, 3) to rotations (..., T, 3, 3), in the latter's own axes.

    With them, if asked for, their derivatives (N, 3, 3) in a turn of R (N, 3, 3) about its own axes; else (0, 3, 3).
    """
    if len(target) not in (1, R.shape[-3]):
        raise InputError(f"{len(target)} targets do not go with {R.shape[-3]} rotations")
    rows = np.ascontiguousarray(R).reshape(-1, 3, 3)
    r, D = rotation_logarithms(np.ascontiguousarray(target), rows, derivative)
    return r.reshape(*R.shape[:-2], 3), D


def cross(a: Floats, b: Floats) -> Floats:
    """The vector product a x b along the last axis, for many short vectors several times as fast as ``numpy.cross``."""
    x, y = np.broadcast_arrays(a, b)
    out = np.empty(x.shape)
    out[..., 0] = x[..., 1] * y[..., 2] - x[..., 2] * y[..., 1]
    out[..., 1] = x[..., 2] * y[..., 0] - x[..., 0] * y[..., 2]
    out[..., 2] = x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]
    return out
