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

class Links:
    """Some bodies of a tree with all their ancestors; see src/core/include/varpin/kinematics.hpp."""

    @staticmethod
    def make(
        *,
        parent: Integers,
        prismatic: Integers,
        rotation: Floats,
        translation: Floats,
        coordinate: Integers,
        ratio: Floats,
        offset: Floats,
        dof: int,
    ) -> Links:
        """Raises ValueError for arrays that do not fit each other or describe no tree."""

    def place(self, q: Floats) -> tuple[Floats, Floats]:
        """World rotations (N, c, 3, 3) and positions (N, c, 3) [m] of the bodies at q (N, n)."""

    def place_frame(self, turned: Floats, shifted: Floats, q: Floats, jacobian: bool) -> tuple[Floats, Floats, Floats]:
        """World rotations (N, 3, 3) and positions (N, 3) of a frame on the last body, its Jacobians (N, 6, n) if asked.

        The frame stands at (turned (3, 3), shifted (3,)) in the body; Jacobians are linear over angular velocity in
        world axes, and (0, 6, n) where nobody asks for them.
        """

def rotation_logarithms(target: Floats, R: Floats, derivative: bool) -> tuple[Floats, Floats]:
    """Logarithms (N, 3) of target' R for R (N, 3, 3), and their derivatives (N, 3, 3) or (0, 3, 3).

    Targets (T, 3, 3) repeat after T. The derivative is in a turn of R about its own axes.
    """
