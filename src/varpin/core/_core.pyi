"""The compiled core: src/core, bound by nanobind."""

from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

from varpin.kernels.tree import Commands, Nodes

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

class Outcome(IntEnum):
    """Why a rollout of a path ended; see src/core/include/varpin/nodes.hpp."""

    solved = ...
    diverged = ...
    not_finite = ...
    fold = ...
    energy = ...
    singular = ...

class ForwardDynamics:
    """Forward dynamics at one state after another."""

    def __init__(self, mechanism: Mechanism) -> None: ...
    def rate(self, x: Floats, force: Floats) -> tuple[Floats, bool]:
        """The rate (v, a) of x = (q, v) (2n,) under a force (n,), and whether the mass matrix is positive definite."""

    def node(self, x: Floats) -> tuple[Floats, float, bool]:
        """Momentum (n,) and energy [J] at x = (q, v) (2n,), and whether the mass matrix is positive definite."""

def accelerations(
    mechanism: Mechanism, q: Floats, v: Floats, force: Floats
) -> tuple[Floats, Floats, Floats, Floats, int]:
    """Accelerations (N, n) at each row of q, v and force (N, n), and their derivatives (N, n, n) in each.

    With them, how many rows there are before the first whose mass matrix is not positive definite.
    """

class ExplicitMethod(Enum):
    """See src/core/include/varpin/explicit.hpp."""

    euler = ...
    semi_implicit = ...
    runge_kutta = ...

class ExplicitRollout:
    """P paths of an explicit method on their way."""

    @staticmethod
    def start(mechanism: Mechanism, method: ExplicitMethod, q: Floats, v: Floats) -> ExplicitRollout:
        """Paths at q and v (P, n)."""

    @property
    def q(self) -> Floats:
        """Where the paths stand (P, n) [rad or m]; what is written to it moves them."""

    @property
    def v(self) -> Floats:
        """Their velocities (P, n), in the same way."""

    def copy(self) -> ExplicitRollout: ...
    def first_nodes(self, nodes: Nodes) -> bool:
        """Enter where each path stands as its node 0; False where a mass matrix is not positive definite."""

    def roll(self, dt: float, commands: Commands, increments: Floats, drift: Floats, nodes: Nodes) -> None:
        """All N steps of length dt [s] of all paths.

        With increments of the Wiener processes (P, N, k), or (0, 0, k) for none, and a force (P, N, n) on top of that
        of the controls, or (0, 0, n) for none.
        """

def linearize_explicit(
    mechanism: Mechanism, method: ExplicitMethod, dt: float, q: Floats, v: Floats, force: Floats
) -> tuple[Floats, Floats, int]:
    """Derivatives of (q, v) after one step from each row of q, v and force (N, n).

    In (q, v) (N, 2n, 2n), and in the force (N, 2n, n).

    With them, how many rows there are before the first with a mass matrix that is not positive definite.
    """
