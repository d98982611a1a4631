"""How a control law responds to its state, by calls of its copies: u_k = sum_i H_i x_(k-i) to first order, x = (q, v).

H_i is what a displacement of x changes i periods later. Copies of the same moment draw the same noise, which cancels.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator

import numpy as np

from varpin.arrays import Floats
from varpin.mechanics.scene import Scene
from varpin.signals.functions import ControlLaw, Copies, copier, decision

# Displacement of a coordinate [rad or m, and by s]: above the rounding of laws in single precision.
_SMALL = 1e-4
# Least share of second differences in first ones of a law that jumps or has a kink within the displacement.
_KINK = 0.1
# Periods in which the response to a displacement is seen; beyond, it decays at one rate, as of filters and integrals.
MEMORY = 6
# Largest relative error of a call that gives the recorded control: other sums in the same arithmetic.
_SAME = 1e-9


def responses(
    scene: Scene, law: Copies, t: Floats, x: Floats, u: Floats, centres: dict[int, Floats]
) -> Iterator[tuple[int, Floats, Floats]]:
    """The controls (m,) of a law at centres of nodes, and its responses (J, m, 2n).

    A law that gives recorded controls again at once has no memory; any other is called in order up to each node.
    """

    def call(own: ControlLaw, k: int, state: Floats, later: int = 0) -> Floats:
        control: Floats = decision(own, scene, k, float(t[k] + later * t[1]), *np.split(state, 2))[0]
        return control

    def gives(own: ControlLaw, k: int) -> bool:
        return bool(np.allclose(call(own, k, x[k]), u[k], rtol=_SAME, atol=_SAME * np.abs(u[k]).max()))

    def alone(own: ControlLaw, k: int, state: Floats) -> list[Floats]:
        return [call(own, k, state)]

    def rolled(copies: Copies, k: int, state: Floats) -> list[Floats]:
        own = copies()
        return [call(own, k, centres[k] if later else state, later) for later in range(MEMORY)]

    own, done, remembers = law(), 0, False
    for k, centre in centres.items():
        if not remembers:
            remembers = not gives(own, k)
            slopes = _slopes(functools.partial(alone, own, k), centre)
            remembers = remembers or not gives(own, k)
            own = law() if remembers else own
        if remembers:
            copies = copier(own) if all(gives(own, j) for j in range(done, k)) else None
            if copies is None:
                return
            done, slopes = k, _slopes(functools.partial(rolled, copies, k), centre)
        yield k, *slopes


def _slopes(roll: Callable[[Floats], list[Floats]], centre: Floats) -> tuple[Floats, Floats]:
    """The control (m,) at a state (2n,) and the response (J, m, 2n) over J periods that ``roll`` gives; 0 at a kink."""
    moved = _SMALL * np.eye(len(centre))
    up, down = (np.array([roll(centre + side * each) for each in moved]) for side in (1.0, -1.0))
    first, here = up - down, np.array(roll(centre))
    H: Floats = np.moveaxis(first, 0, -1) / (2.0 * _SMALL)
    if np.abs(up + down - 2.0 * here).max() > _KINK * np.abs(first).max():
        H = np.zeros_like(H)
    return here[0], H[: 1 + max(np.flatnonzero(H.any(axis=(1, 2))), default=0)]
