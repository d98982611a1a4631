"""How a control law responds to its state, by calls of its copies: u_k = sum_i H_i x_(k-i) to first order, x = (q, v).

H_i is what a displacement of x changes i periods later. Copies of the same moment draw the same noise, which cancels.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from varpin.arrays import Floats
from varpin.errors import ControlError
from varpin.mechanics.scene import Scene
from varpin.signals.functions import ControlLaw, Copies, copier, decision

# The control u + sum(H) x of a state x at rest: u (m,), H (J, m, 2n), and what later periods multiply it by (m, m).
Response = tuple[Floats, Floats, Floats]

# Displacement of a coordinate [rad or m, and by s]: above the rounding of laws in single precision.
_SMALL = 1e-4
# Least share of second differences in first ones of a law that jumps or has a kink within the displacement.
_KINK = 0.1
# Periods in which the response to a displacement is seen; beyond, it decays at one rate, as of filters and integrals.
MEMORY = 6
# Largest relative error of a call that gives the recorded control: other sums in the same arithmetic.
_SAME = 1e-9


def responses(scene: Scene, law: Copies, t: Floats, x: Floats, u: Floats) -> Callable[[int, Floats], Response]:
    """The response of a law in a period, none before that of the last call, at a state (2n,).

    A law that gives recorded controls again at once has no memory; any other is called in order up to the period. A
    ControlError tells of one that does not give them then, or has no copy.
    """
    own, done, copies = law(), 0, None

    def call(own: ControlLaw, k: int, state: Floats, later: int = 0) -> Floats:
        control: Floats = decision(own, scene, k, float(t[k] + later * t[1]), *np.split(state, 2))[0]
        return control

    def gives(k: int) -> bool:
        return bool(np.allclose(call(own, k, x[k]), u[k], rtol=_SAME, atol=_SAME * np.abs(u[k]).max()))

    def rolled(copies: Copies, k: int, states: list[Floats]) -> list[Floats]:
        own = copies()
        return [call(own, k, state, later) for later, state in enumerate(states)]

    def respond(k: int, centre: Floats) -> Response:
        nonlocal own, done, copies
        if copies is None:
            known = gives(k)
            found = _slopes(lambda state: [call(own, k, state)], centre)
            if known and gives(k):
                return found
            own = law()
        if copies is None or k > done:
            copies, done = copier(own) if all(gives(j) for j in range(done, k)) else None, k
        if copies is None:
            raise ControlError(k, float(t[k]), "the control law cannot be called again")
        roll = copies
        return _slopes(lambda state: rolled(roll, k, [state, *[centre] * (MEMORY - 1)]), centre)

    return respond


def _slopes(roll: Callable[[Floats], list[Floats]], centre: Floats) -> Response:
    """The response at a state (2n,), from the controls of J periods that ``roll`` gives; 0 at a jump or kink.

    Later periods multiply the last by one number, that of what it remembers.
    """
    # Two displacements forward and one back: values beside a jump are no line, even if it is in the middle.
    moved = _SMALL * np.eye(len(centre))
    here, up, down = np.array(roll(centre)), *(np.array([roll(centre + far * d) for d in moved]) for far in (2.0, -1.0))
    H: Floats = np.moveaxis(up + 3.0 * here - 4.0 * down, 0, -1) / (6.0 * _SMALL)
    if np.abs(up + 2.0 * down - 3.0 * here).max() > _KINK * np.abs(up - down).max():
        H = np.zeros_like(H)
    H = H[: 1 + max(np.flatnonzero(H.any(axis=(1, 2))), default=0)]
    ratio = np.vdot(H[-1], H[-2]) / np.vdot(H[-2], H[-2]) if len(H) == MEMORY else 0.0
    return here[-1] - H.sum(axis=0) @ centre, H, np.clip(ratio, 0.0, 1.0) * np.eye(here.shape[1])
