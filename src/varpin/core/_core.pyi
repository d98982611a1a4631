"""The compiled core: src/core, bound by nanobind."""

from typing import Any

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

class Tableau:
    """Collocation over a step of unit length; see src/core/include/varpin/tableau.hpp."""

    @staticmethod
    def make(
        *,
        a: Floats,
        gradient: Floats,
        force: Floats,
        b: Floats,
        c: Floats,
        ahead: Floats,
        reach: float,
        skew: float,
    ) -> Tableau:
        """Raises ValueError for arrays that do not fit each other."""

class Guards:
    """When a step is accepted; see src/core/include/varpin/guards.hpp."""

    @staticmethod
    def make(
        *, active: bool, branch_margin: float, energy_balance: float, energy_budget: float, most_halvings: int
    ) -> Guards: ...

class VariationalRollout:
    """Paths of a variational integrator, and the work arrays of a step."""

    def __init__(
        self, mechanism: Mechanism, tableau: Tableau, tolerance: float, guards: Guards, left: float, paths: int
    ) -> None: ...
    def fork(self) -> VariationalRollout:
        """The paths as they stand, to move on by themselves; work arrays are shared, so one moves at a time."""

    def begin(self, q: Floats, v: Floats) -> bool:
        """Put each path at its row of q and v (P, n); False where an M(q) is not positive definite."""

    def roll(self, dt: float, commands: Any, increments: Floats, drift: Floats, nodes: Any) -> None:
        """Take the steps that the commands are for, and write them into the nodes; named tuples of arrays."""

    def kick(self, impulse: Floats) -> None:
        """Add an impulse (P, n) to the momenta."""

    def nodes(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Configurations, momenta and velocities (P, n), and energies (P,)."""

def variational_derivatives(
    mechanism: Mechanism,
    tableau: Tableau,
    tolerance: float,
    guards: Guards,
    dt: float,
    q: Floats,
    p: Floats,
    guess: Floats,
    force: Floats,
    substeps: Integers,
) -> tuple[Floats, Floats, int, int]:
    """d(q1, p1)/d(q0, p0) (N, 2n, 2n) and d(q1, p1)/df (N, 2n, n); how it ended, and how many steps were done."""

def variational_curvatures(
    mechanism: Mechanism,
    tableau: Tableau,
    tolerance: float,
    guards: Guards,
    dt: float,
    q: Floats,
    p: Floats,
    guess: Floats,
    force: Floats,
    substeps: Integers,
    z: Floats,
) -> tuple[Floats, int, int]:
    """z . d2(q1, p1)/d(q0, p0, f)2 (N, 3n, 3n) for z (N, 2n); how it ended, and how many steps were done."""
