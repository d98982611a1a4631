"""Velocities that alternate from step to step without a cause in robot or controls; and restless velocities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats
from varpin.core import longest_alternation

# Least second difference of a velocity that counts, as a share of the joint's largest velocity: it is four times the
# alternating part.
_COUNTS = 2e-3
# The same as a share of the largest velocity of all joints: swings of slow joints that hardly move the robot or change
# its cost, and couplings and rounding in joints at rest.
_IDLE = 5e-4
# Changes of sign in a row from which on a warning is given. An oscillation that the steps resolve has none in a row.
RUN = 8
# Largest factor between second differences in a row. Those after a jump at an end of an optimal motion do not count:
# under held controls they fall to a quarter or two fifths from step to step.
_EVEN = 2.0

# Least difference of a velocity from node to node that counts as restlessness, as a share of the joint's largest
# velocity, and of the largest velocity of all joints.
_RESTLESS_CHANGE, _RESTLESS_IDLE = 1e-3, 1e-6
# Changes of sign from which on a warning is given: more than the first number in a hundred steps, and at least the
# second, for each end of a motion under held controls has five or six, whatever the number of steps.
RESTLESS, _FEWEST = 12, 13


@dataclass(frozen=True)
class Alternation:
    """The longest stretch over which a joint's velocity is above its trend at one node and below it at the next.

    Attributes:
        joint: Its coordinate.
        changes: Changes of sign of the velocity's second differences, one after another.
        first: The node where they begin.
    """

    joint: int
    changes: int
    first: int

    def sentence(self, joints: Sequence[str], t: Floats, interval: str = "step") -> str:
        """The first part of a warning: which velocity alternates, how often, and from when on.

        Args:
            joints: Names of the coordinates.
            t: Times of the nodes (N + 1,) [s].
            interval: Name of the interval between two nodes.
        """
        return (
            f"the velocity of {joints[self.joint]} alternates from {interval} to {interval}, {self.changes} times in a "
            f"row from t = {t[self.first]:.4g} s on"
        )


def alternation(v: Floats, u: Floats | None = None) -> Alternation | None:
    """The longest stretch of alternating velocities, if it is long enough for a warning.

    Args:
        v: Velocities at the nodes (N + 1, n) [rad/s or m/s].
        u: Controls of the steps (N, m). Stretches in which one of them alternates do not count. Left out, all
            stretches count.
    """
    if len(v) < RUN + 3:
        return None
    joint, changes, first = longest_alternation(v, u, counts=_COUNTS, idle=_IDLE, even=_EVEN)
    return Alternation(joint, changes, first) if changes >= RUN else None


@dataclass(frozen=True)
class Restlessness:
    """The joint whose acceleration changes its sign most often.

    Attributes:
        joint: Its coordinate.
        changes: Changes of sign of the differences of its velocity from node to node.
    """

    joint: int
    changes: int


def restlessness(v: Floats) -> Restlessness | None:
    """The joint whose acceleration changes its sign most often, if that is often enough for a warning.

    Args:
        v: Velocities at the nodes (N + 1, n) [rad/s or m/s].
    """
    fastest = np.abs(v).max(axis=0, initial=0.0)
    change = np.diff(v, axis=0)
    counts = np.abs(change) > np.maximum(_RESTLESS_CHANGE * fastest, _RESTLESS_IDLE * fastest.max(initial=0.0))
    changes = ((change[1:] * change[:-1] < 0.0) & counts[1:] & counts[:-1]).sum(axis=0)
    if not changes.size:
        return None
    joint = int(changes.argmax())
    most = int(changes[joint])
    return Restlessness(joint, most) if most >= _FEWEST and 100 * most > RESTLESS * len(change) else None
