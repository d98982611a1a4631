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
    """

    robot: Robot
    positions: Mapping[str, Floats]
    traces: tuple[Trace, ...] = ()
    outlooks: tuple[Outlook, ...] = ()
    frames: tuple[str, ...] = ()
    effort: Floats | None = None


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
