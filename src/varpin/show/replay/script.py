"""What a replay shows, as arrays on one clock: to be drawn by meshcat, which this module does not know."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from varpin.model import Robot

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Trace:
    """A path in the world.

    Attributes:
        kind: Of what moves along it.
        name: Of the frame, or of the reference.
        points: On the path (P, 3) [m], P > 1, no two in a row the same.
        reached: How many of its P - 1 pieces are behind what moves at the keyframes (K,), to be drawn as far as that;
            None where it is to be drawn whole.
    """

    kind: Literal["motion", "ghost", "reference"]
    name: str
    points: Floats
    reached: Floats | None = None


@dataclass(frozen=True, eq=False)
class Outlook:
    """Where a plan means to take a frame, which changes with every plan.

    Attributes:
        name: Of the frame.
        places: At the keyframes, evenly spaced in time from soon to as far as the plan is shown (K, B, 3) [m].
    """

    name: str
    places: Floats


@dataclass(frozen=True, eq=False)
class Target:
    """A place to go to, or a pose to take.

    Attributes:
        name: Shown beside it.
        places: In the world (1, 3) or, of a target that moves, at the keyframes (K, 3) [m].
        turns: Unit quaternions (x, y, z, w), as many, of a pose; None of a point.
    """

    name: str
    places: Floats
    turns: Floats | None = None


@dataclass(frozen=True, eq=False)
class Tie:
    """Where a constraint of the mechanism acts.

    Attributes:
        name: The kind of constraint.
        a: The body that carries the one point, -1 for the world, and the place on it (3,) [m].
        b: The same of the other.
        axis: Of a line or a plane through b, a unit vector (3,) in the axes of b's body; None of two points.
        plane: Whether the axis is the normal of a plane.
    """

    name: str
    a: tuple[int, Floats]
    b: tuple[int, Floats]
    axis: Floats | None = None
    plane: bool = False


@dataclass(frozen=True, eq=False)
class Region:
    """A body to keep clear of, or a part of the world that a frame has to be in or out of.

    Attributes:
        kind: Which of these.
        name: Of the body, or of the frame.
        begin: One end of its axis in the world (3,) [m]; of a sphere its centre, of a box its origin.
        end: The other end (3,) [m].
        radius: Of a sphere or a capsule [m].
        box: Lower and upper sides of a box from its origin (2, 3) [m], infinite where it has none; None of round ones.
        rotation: Axes of the box in the world (3, 3).
    """

    kind: Literal["obstacle", "out", "in"]
    name: str
    begin: Floats
    end: Floats
    radius: float
    box: Floats | None = None
    rotation: Floats = field(default_factory=lambda: np.eye(3))

    @property
    def corners(self) -> Floats:
        """Points (k, 3) around what is finite of it [m]."""
        if self.box is None:
            reach = self.radius * np.vstack([np.eye(3), -np.eye(3)])
            return np.concatenate([self.begin + reach, self.end + reach])
        sides = np.where(np.isfinite(self.box), self.box, 0.0)
        return np.asarray(self.begin + _corners(sides) @ self.rotation.T)

    def box_within(self, points: Floats, margin: float) -> Floats:
        """Its sides (2, 3) [m], those that are infinite put around points (P, 3), with a margin [m]."""
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
        robot: The arm.
        positions: Of every joint of the tree at the keyframes (K, b) [rad or m], of "robot" and, if there is one, of
            its "ghost".
        traces: Of its frames.
        outlooks: Of its frames.
        frames: Names of those drawn as triads.
        effort: Share of the limit that the torque of each joint of the tree takes at the keyframes (K, b), in [0, 1];
            None for the robot in its own colours.
        ties: Of the mechanism.
        regions: That it keeps to.
        goals: Of its plan.
        reach: Joint positions (S, b) that it may come to, for which the view has room; none if what it does is known.
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
    """Everything that is shown.

    Attributes:
        times: Of the keyframes (K,) [s of playback]. All tracks have the same: each repeats by itself, and they must
            not drift apart.
        actors: The robots.
        traces: References, in the world of each robot.
        targets: In the world of each robot.
        offset: From one robot to the next (3,) [m]; None for as far as they need beside each other.
        loop: Start again at the end.
        speed: Seconds of motion in a second of playback.
    """

    times: Floats
    actors: tuple[Actor, ...]
    traces: tuple[Trace, ...] = field(default=())
    targets: tuple[Target, ...] = field(default=())
    offset: Floats | None = None
    loop: bool = True
    speed: float = 1.0

    @property
    def title(self) -> str:
        """The names of the robots."""
        return ", ".join(dict.fromkeys(actor.robot.name for actor in self.actors))
