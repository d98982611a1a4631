"""The compiled core: src/core, bound by nanobind."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

class Mechanism:
    """A tree of bodies in its surroundings; see src/core/include/varpin/tree.hpp for the fields."""

    @staticmethod
    def make(
        *,
        parent: Integers,
        prismatic: Integers,
        rotation: Floats,
        translation: Floats,
        mass: Floats,
        center: Floats,
        inertia: Floats,
        coordinate: Integers,
        ratio: Floats,
        offset: Floats,
        origin: Integers,
        loads: Integers,
        carried: Integers,
        periodic: Integers,
        armature: Floats,
        group: Integers,
        groups: int,
        ends: Integers,
        gravity: Floats,
        damping: Floats,
        stiffness: Floats,
        rest: Floats,
        actuation: Floats,
        constant: Floats,
        control: Floats,
        quadratic: Floats,
        centers: Floats,
    ) -> Mechanism:
        """Raises ValueError for arrays that do not fit each other or describe no tree."""

    def jet(self, q: Floats, v: Floats) -> tuple[float, Floats, Floats, Floats, Floats, Floats]:
        """L, L_q, L_v, L_qq, L_vq and L_vv at q, v (n,)."""

    def jets(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        """M and L_vq (N, n, n) at each row of q and v (N, n)."""

    def jets_along(self, q: Floats, v: Floats, alpha: Floats, beta: Floats) -> tuple[Floats, Floats, Floats]:
        """Derivatives of M, L_vq and L_qq (N, n, n) at each row of q and v along that of alpha and beta (N, n)."""
