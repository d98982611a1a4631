"""Where a coordinate stands: sums that keep what rounding takes from them, and angles with whole turns taken off.

A joint that has turned a million times stands at an angle of which floating point keeps nine decimals, and a step of
the sweep would see no more of it. The Lagrangian does not know how often an angle went round, so the sweeps see it
within one turn; the turns are counted beside it, and the angle that is shown is continuous.
"""

import math

from varpin.kernels._compile import inlined
from varpin.kernels.midpoint_equation import State
from varpin.kernels.tree import Floats, Mechanism

TURN = 2.0 * math.pi
# A turn in two parts, the first so short that its multiples are exact (Cody and Waite 1980).
TURN_HIGH = 6.28125
TURN_LOW = 0.0019353071795864769253


@inlined
def add(high: float, low: float, increment: float) -> tuple[float, float]:
    """The sum high + low + increment as a new high and low part (Knuth's two-sum)."""
    increment += low
    total = high + increment
    part = total - high
    return total, (high - (total - part)) + (increment - part)


@inlined
def unwind(mechanism: Mechanism, i: int, state: State) -> None:
    """Take whole turns off the place of coordinate ``i``, where the Lagrangian is the same after each of them."""
    place = state.place[i]
    if abs(place) <= TURN or mechanism.tree.periodic[i] == 0 or mechanism.stiffness[i] != 0.0:
        return
    turns = math.floor(place / TURN + 0.5)
    place, low = add(place, state.place_low[i], -turns * TURN_HIGH)
    state.place[i], state.place_low[i] = add(place, low, -turns * TURN_LOW)
    state.turns[i] += turns


@inlined
def show(i: int, state: State) -> None:
    """Bring the coordinate ``q`` that is shown to where the place and the turns are."""
    turns = state.turns[i]
    if turns == 0.0:
        state.q[i] = state.place[i]
    else:
        state.q[i] = turns * TURN_HIGH + (state.place[i] + (turns * TURN_LOW + state.place_low[i]))


@inlined
def put(mechanism: Mechanism, q: Floats, p: Floats, state: State) -> None:
    """Put the state at (q, p)."""
    for i in range(q.size):
        state.q[i], state.place[i], state.place_low[i], state.turns[i] = q[i], q[i], 0.0, 0.0
        unwind(mechanism, i, state)
        state.p[i], state.p_low[i] = p[i], 0.0
