"""Velocities that alternate from step to step: what a method leaves that neither the robot nor its controls ask for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


def alternation(v: Floats, u: Floats | None = None) -> Alternation | None:
    """The longest stretch of alternating velocities, if it is long enough to speak of.

    Args:
        v: Velocities at the nodes (N + 1, n) [rad/s or m/s].
        u: Controls of the steps (N, m). Where one of them alternates, the motion has a reason to, and does not count.
            Left out, everything does.
    """
    fastest = np.abs(v).max(axis=0)
    if len(v) < RUN + 3:
        return None
    bend = np.diff(v, n=2, axis=0)
    if not (np.count_nonzero(bend[1:] * bend[:-1] < 0.0, axis=0) >= RUN).any():
        return None
    counts = (np.abs(bend) > _COUNTS * fastest) & (np.abs(bend) > _IDLE * fastest.max())
    size = np.abs(bend)
    even = (size[1:] < _EVEN * size[:-1]) & (size[:-1] < _EVEN * size[1:])
    turns = (bend[1:] * bend[:-1] < 0.0) & counts[1:] & counts[:-1] & even
    if u is not None:
        # The bend at a node is driven by the jump of the controls there.
        jump = np.diff(u, axis=0)
        driven = (jump[1:] * jump[:-1] < 0.0) & (np.abs(jump[1:]) > _COUNTS * np.abs(u).max(axis=0))
        turns &= ~driven.any(axis=1, keepdims=True)
    # How many turns in a row end at each node: those since the last node without one.
    nodes = np.arange(1, len(turns) + 1)[:, None]
    rows = nodes - np.maximum.accumulate(np.where(turns, 0, nodes), axis=0)
    last, joint = np.unravel_index(int(rows.argmax()), rows.shape)
    longest = int(rows[last, joint])
    return Alternation(int(joint), longest, int(last) + 1 - longest) if longest >= RUN else None
