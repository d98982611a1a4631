"""Velocities that alternate from step to step, which neither the robot nor its controls ask for; and restless ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.core import longest_alternation

Floats = NDArray[np.float64]

# Second differences of the velocity that count, in units of the joint's largest: four times what alternates.
_COUNTS = 2e-3
# In units of the largest velocity of all joints: what couplings and rounding leave of joints that stand still.
_IDLE = 1e-6
# Changes of sign in a row that are spoken of. An oscillation that the steps resolve has none in a row.
RUN = 8
# From a node to the next they change by less than this factor: what a jump at an end of an optimal motion leaves falls
# to a quarter or two fifths from step to step under held controls, and is gone after a few.
_EVEN = 2.0

# Differences of a velocity from node to node that count for restlessness, in units of the joint's largest velocity.
_SHOWS = 1e-3
# Changes of their sign that are spoken of: more than so many in a hundred steps, and no fewer than these, for the ends
# of a motion under held controls have five or six each, however many steps it has.
RESTLESS, _FEW = 12, 13


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
        """What is seen, for a warning to say why: which velocity alternates, how often, and from when on.

        Args:
            joints: Names of the coordinates.
            t: Times of the nodes (N + 1,) [s].
            interval: What lies between two nodes.
        """
        return (
            f"the velocity of {joints[self.joint]} alternates from {interval} to {interval}, {self.changes} times in a "
            f"row from t = {t[self.first]:.4g} s on"
        )


def alternation(v: Floats, u: Floats | None = None) -> Alternation | None:
    """The longest stretch of alternating velocities, if it is long enough to speak of.

    Args:
        v: Velocities at the nodes (N + 1, n) [rad/s or m/s].
        u: Controls of the steps (N, m). Where one of them alternates, the motion has a reason to, and does not count.
            Left out, everything does.
    """
    if len(v) < RUN + 3:
        return None
    joint, changes, first = longest_alternation(v, u, counts=_COUNTS, idle=_IDLE, even=_EVEN)
    return Alternation(joint, changes, first) if changes >= RUN else None


@dataclass(frozen=True)
class Restlessness:
    """How often the joint that does so most goes from speeding up to slowing down, or back.

    Attributes:
        joint: Its coordinate.
        changes: Changes of sign of the differences of its velocity from node to node.
    """

    joint: int
    changes: int


def restlessness(v: Floats) -> Restlessness | None:
    """The joint whose velocity goes up and down most often, if that is often enough to speak of.

    Args:
        v: Velocities at the nodes (N + 1, n) [rad/s or m/s].
    """
    fastest = np.abs(v).max(axis=0, initial=0.0)
    change = np.diff(v, axis=0)
    shows = np.abs(change) > np.maximum(_SHOWS * fastest, _IDLE * fastest.max(initial=0.0))
    changes = ((change[1:] * change[:-1] < 0.0) & shows[1:] & shows[:-1]).sum(axis=0)
    if not changes.size:
        return None
    joint = int(changes.argmax())
    most = int(changes[joint])
    return Restlessness(joint, most) if most >= _FEW and 100 * most > RESTLESS * len(change) else None
