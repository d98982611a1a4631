"""The contents of a replay as arrays over common keyframes, independent of meshcat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from varpin.arrays import Floats
from varpin.model import Robot
from varpin.model.hull import Hull


@dataclass(frozen=True, eq=False)
class Trace:
    """A path in the world.

    Attributes:
        kind: Whether it is the path of the robot, of its ghost, or a reference.
        name: Name of the frame, or of the reference.
        points: Points of the path (P, 3) [m], P > 1, without equal neighbours.
        reached: For a path that grows, how many of its P - 1 pieces are drawn at the keyframes (K,); else None.
    """

    kind: Literal["motion", "ghost", "reference"]
    name: str
    points: Floats
    reached: Floats | None = None


@dataclass(frozen=True, eq=False)
class Outlook:
    """Planned path of a frame, which changes with every plan.

    Attributes:
        name: Name of the frame.
        places: Points of the path at the keyframes, evenly spaced in time (K, B, 3) [m].
    """

    name: str
    places: Floats


@dataclass(frozen=True, eq=False)
class Target:
    """A target point or pose.

    Attributes:
        name: Its label.
        places: Position in the world (1, 3), or at the keyframes (K, 3) for a moving target [m].
        turns: Unit quaternions (x, y, z, w) of a pose, as many; None for a point.
    """

    name: str
    places: Floats
    turns: Floats | None = None


@dataclass(frozen=True, eq=False)
class Tie:
    """A constraint of the mechanism between two points, or between a point and a line or plane.

    Attributes:
        name: The kind of constraint.
        a: Body of the first point, -1 for the world, and the point in the body's frame (3,) [m].
        b: The same for the second point.
        axis: Unit vector (3,), in the axes of b's body, of a line or plane through b; None for two points.
        plane: Whether the axis is the normal of a plane.
    """

    name: str
    a: tuple[int, Floats]
    b: tuple[int, Floats]
    axis: Floats | None = None
    plane: bool = False


@dataclass(frozen=True, eq=False)
class Region:
    """An obstacle, or a region of the world that a frame has to stay in or out of.

    Attributes:
        kind: Which of these.
        name: Name of the obstacle, or of the frame.
        begin: One end of its axis in the world (3,) [m]; the centre of a sphere, the origin of a box or a hull.
        end: The other end (3,) [m].
        radius: Radius of a sphere or a capsule [m].
        box: Lower and upper sides of a box from its origin (2, 3) [m], infinite where it is open; None for others.
        rotation: Axes of the box or the hull in the world (3, 3).
        way: Displacement at the keyframes (K, 3) [m]; None if it is fixed.
        hull: Its convex hull; None for others.
    """

    kind: Literal["obstacle", "out", "in"]
    name: str
    begin: Floats
    end: Floats
    radius: float
    box: Floats | None = None
    rotation: Floats = field(default_factory=lambda: np.eye(3))
    way: Floats | None = None
    hull: Hull | None = None

    @property
    def moves(self) -> bool:
        """Whether it moves."""
        return self.way is not None

    @property
    def corners(self) -> Floats:
        """Points (k, 3) [m] around its finite part, over its whole motion."""
        if self.hull is not None:
            found = np.asarray(self.begin + self.hull.points @ self.rotation.T)
        elif self.box is None:
            reach = self.radius * np.vstack([np.eye(3), -np.eye(3)])
            found = np.concatenate([self.begin + reach, self.end + reach])
        else:
            sides = np.where(np.isfinite(self.box), self.box, 0.0)
            found = np.asarray(self.begin + _corners(sides) @ self.rotation.T)
        if self.way is None:
            return found
        return np.concatenate([found + self.way.min(axis=0), found + self.way.max(axis=0)])

    def box_within(self, points: Floats, margin: float) -> Floats:
        """Its sides (2, 3) [m], with infinite ones replaced by bounds of points (P, 3) plus a margin [m]."""
        assert self.box is not None
        (lower, upper), seen = self.box, (points - self.begin) @ self.rotation
        low = np.minimum(seen.min(axis=0), np.where(np.isfinite(upper), upper, np.inf)) - margin
        high = np.maximum(seen.max(axis=0), np.where(np.isfinite(lower), lower, -np.inf)) + margin
        return np.array([np.where(np.isfinite(lower), lower, low), np.where(np.isfinite(upper), upper, high)])


def _corners(box: Floats) -> Floats:
    """The corners (8, 3) of a box (2, 3)."""
    return np.stack(np.meshgrid(*box.T), axis=-1).reshape(8, 3)


@dataclass(frozen=True, eq=False)
class Actor:
    """A robot that moves.

    Attributes:
        robot: The robot.
        positions: Positions of every joint of the tree at the keyframes (K, b) [rad or m], by "robot" and, if there is
            one, "ghost".
        traces: Paths of its frames.
        outlooks: Planned paths of its frames.
        frames: Names of the frames drawn as triads.
        effort: Torque of each joint of the tree as a share of its limit at the keyframes (K, b), in [0, 1]; None for
            the robot in its own colours.
        ties: Constraints of the mechanism.
        regions: Obstacles and regions of its plan.
        goals: Goals of its plan.
        reach: Joint positions (S, b) that the view has to contain; None if the motion is known.
    """

    robot: Robot
    positions: Mapping[str, Floats]
    traces: tuple[Trace, ...] = ()
    outlooks: tuple[Outlook, ...] = ()
    frames: tuple[str, ...] = ()
    effort: Floats | None = None
    ties: tuple[Tie, ...] = ()
    regions: tuple[Region, ...] = ()
    goals: tuple[Target, ...] = ()
    reach: Floats | None = None


@dataclass(frozen=True, eq=False)
class Script:
    """The contents of a replay.

    Attributes:
        times: Times of the keyframes (K,) [s of playback]. All tracks share them: each track loops on its own, and
            tracks of unequal length would drift apart.
        actors: The robots.
        traces: References, in the world of each robot.
        targets: Targets, in the world of each robot.
        offset: Translation from one robot to the next (3,) [m]; None to place them side by side.
        loop: Start again at the end.
        speed: Seconds of motion in a second of playback.
        error: The estimated error of the motions in words; empty where it is not known.
    """

    times: Floats
    actors: tuple[Actor, ...]
    traces: tuple[Trace, ...] = field(default=())
    targets: tuple[Target, ...] = field(default=())
    offset: Floats | None = None
    loop: bool = True
    speed: float = 1.0
    error: str = ""

    @property
    def target_names(self) -> tuple[str, ...]:
        """The names of all targets and goals."""
        every = (*self.targets, *(goal for actor in self.actors for goal in actor.goals))
        return tuple(dict.fromkeys(target.name for target in every))

    @property
    def title(self) -> str:
        """The names of the robots."""
        return ", ".join(dict.fromkeys(actor.robot.name for actor in self.actors))
