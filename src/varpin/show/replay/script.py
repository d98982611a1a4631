"""The contents of a replay over common keyframes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats
from varpin.model import Robot
from varpin.show.replay.marks import Mark


@dataclass(frozen=True, eq=False)
class Actor:
    """A robot that moves.

    Attributes:
        robot: The robot.
        positions: Positions of every joint of the tree at the keyframes (K, b) [rad or m], by "robot" and, if there is
            one, "ghost".
        marks: What is drawn beside it.
        effort: Torque of each joint of the tree as a share of its limit at the keyframes (K, b), in [0, 1]; None for
            the robot in its own colours.
        reach: Joint positions (S, b) that the view has to contain; None if the motion is known.
    """

    robot: Robot
    positions: Mapping[str, Floats]
    marks: tuple[Mark, ...] = ()
    effort: Floats | None = None
    reach: Floats | None = None


@dataclass(frozen=True, eq=False)
class Script:
    """The contents of a replay.

    Attributes:
        times: Times of the keyframes (K,) [s of playback]. All tracks share them: each track loops on its own, and
            tracks of unequal length would drift apart.
        actors: The robots.
        speed: Seconds of motion in a second of playback.
        error: The estimated error of the motions in words; empty where it is not known.
    """

    times: Floats
    actors: tuple[Actor, ...]
    speed: float = 1.0
    error: str = ""

    @property
    def marks(self) -> list[Mark]:
        """The marks of all robots."""
        return [mark for actor in self.actors for mark in actor.marks]

    @property
    def title(self) -> str:
        """The names of the robots."""
        return ", ".join(dict.fromkeys(actor.robot.name for actor in self.actors))


def tree_positions(robot: Robot, q: Floats) -> Floats:
    """Positions (K, b) [rad or m] of all joints of the tree, mimic joints included, at configurations (K, n)."""
    tree = robot.tree
    return np.asarray(q[:, tree.coordinate] * tree.ratio + tree.offset)


def rows_at(times: Floats, t: Floats, rows: Floats) -> Floats:
    """Rows (N, n) at times ``t`` (N,), interpolated linearly at ``times`` (K,)."""
    return np.column_stack([np.interp(times, t, column) for column in rows.T])
