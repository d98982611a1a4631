"""Placements and Jacobians of frames at many configurations at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from varpin.arrays import Floats
from varpin.core import Links as Core
from varpin.core.arrays import Tree
from varpin.errors import InputError
from varpin.model.tree import path_to, place_of_frame
from varpin.support.frozen import Frozen

if TYPE_CHECKING:
    from varpin.model.robot import Robot


# What the core's links take of a tree's bodies.
_BODY = ("parent", "prismatic", "rotation", "translation", "coordinate", "ratio", "offset", "mass", "center", "inertia",
         "origin")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Links(Frozen):
    """Some bodies of a robot's tree with all their ancestors, each on one joint."""

    tree: Tree  # what it has of bodies is cut to these

    @cached_property
    def core(self) -> Core:
        """These links as the compiled core takes them."""
        return Core.make(self.tree)

    @cached_property
    def key(self) -> bytes:
        """A key that is equal for equal links."""
        return b"".join(getattr(self.tree, name).tobytes() for name in _BODY)


def links(tree: Tree, body: int | None = None) -> Links:
    """The bodies from the root to ``body``, or all bodies if left out."""
    if body is None:
        return Links(tree)
    path = path_to(tree, body)
    own = {name: getattr(tree, name)[path] for name in _BODY[1:]}
    return Links(tree._replace(parent=np.arange(-1, len(path) - 1), **own))


def place_on_body(tree: Tree, q: Floats, body: int, point: Floats) -> Floats:
    """World positions (N, 3) [m] of a point (3,) on a body, -1 for the world, at configurations q (N, n)."""
    if body < 0:
        return np.tile(point, (len(q), 1))
    return links(tree, body).core.place_frame(np.eye(3), np.ascontiguousarray(point), np.ascontiguousarray(q), False)[1]


@dataclass(frozen=True, eq=False)
class FrameKinematics(Frozen):
    """A frame of a robot. Made by :func:`frame_kinematics`."""

    frame: str  # its name
    links: Links  # the bodies from the root to the one that carries it
    rotation: Floats  # (3, 3) in that body
    translation: Floats  # (3,) in that body [m]

    @cached_property
    def key(self) -> bytes:
        """A key that is equal for equal frames."""
        return self.links.key + self.rotation.tobytes() + self.translation.tobytes()

    def placements(self, q: Floats) -> tuple[Floats, Floats]:
        """World rotations (N, 3, 3) and positions (N, 3) [m] at q (N, n)."""
        return self._placements(q, jacobian=False)[:2]

    def jacobians(self, q: Floats) -> tuple[Floats, Floats, Floats]:
        """:meth:`placements` and the frame's Jacobian (N, 6, n): linear, then angular velocity, in world axes."""
        return self._placements(q, jacobian=True)

    def _placements(self, q: Floats, *, jacobian: bool) -> tuple[Floats, Floats, Floats]:
        return self.links.core.place_frame(self.rotation, self.translation, np.ascontiguousarray(q), jacobian)


def frame_kinematics(robot: Robot, frame: str) -> FrameKinematics:
    """A frame by its name; an InputError if no joint moves it."""
    body, rotation, translation = place_of_frame(robot.model, frame, robot.name)
    if body < 0:
        raise InputError(f"frame {frame!r} of robot {robot.name!r} is fixed to the base: no joint moves it")
    return FrameKinematics(frame, links(robot.tree, body), rotation, translation)


def rotation_vectors(R: Floats) -> Floats:
    """Rotation vectors (N, 3) of rotations (N, 3, 3)."""
    return np.array([pin.log3(turn) for turn in R])


def rotation_vector_slopes(R: Floats) -> Floats:
    """Derivatives (N, 3, 3) of :func:`rotation_vectors` over turns of the rotated body."""
    return np.array([pin.Jlog3(turn) for turn in R])


def mass_carriers(robot: Robot) -> Links:
    """All links that joints move, for the robot's centre of mass."""
    if not robot.tree.mass.sum() > 0.0:
        raise InputError(f"the links of robot {robot.name!r} have no mass, so there is no centre of mass")
    return links(robot.tree)


def reach(robot: Robot, frame: FrameKinematics) -> float:
    """Upper bound on a frame's distance from its first joint [m]; infinite on free rails.

    It is the shortest chain of hops from joint to joint, or over one revolute joint to the next but one.
    """
    links = frame.links.tree
    hops = [*links.translation[1:], frame.translation]
    lower, upper = robot.position_limits
    ends = np.array([lower, upper])[:, links.coordinate]
    slides = np.where(links.prismatic, np.abs(links.ratio * ends + links.offset).max(axis=0), 0.0)
    most = [0.0]
    for k, hop in enumerate(hops):
        ways = [most[k] + slides[k] + np.linalg.norm(hop)]
        if k > 0 and not links.prismatic[k]:
            # Turned about joint k, the hop leads farthest away where it points away from its axis as the one before.
            before = links.rotation[k].T @ hops[k - 1]
            across = np.hypot(*before[:2]) + np.hypot(*hop[:2])
            ways.append(most[k - 1] + slides[k - 1] + np.hypot(across, before[2] + hop[2]))
        most.append(float(min(ways)))
    return most[-1]


def require_same(name: str, made_for: Robot, robot: Robot | None) -> None:
    """Raise an InputError for something, ``name``, that was made for another robot than a problem's."""
    if robot is not None and not made_for.built_like(robot):
        raise InputError(
            f"{name} is for robot {made_for.name!r} with {made_for.dof} coordinates, another one than the problem's "
            f"{robot.name!r} with {robot.dof}, or one of other lengths; make it with scene.robot"
        )
