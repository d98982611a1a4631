"""The compiled core: src/core, bound by nanobind."""

from collections.abc import Callable, Sequence
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

from varpin.core.arrays import Commands, ConstraintRows, Diffusion, FilterLog, RolloutArrays, Tree

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

class Mechanism:
    """A tree of bodies with the forces, constraints, actuation and noise of a scene.

    The fields are described in src/core/include/varpin/mechanism.hpp.
    """

    @staticmethod
    def make(
        tree: Tree,
        *,
        gravity: Floats,
        forces: Sequence[tuple[str, int, tuple[float, ...]]],
        couplings: Sequence[tuple[str, int, int, tuple[float, ...]]],
        constraints: ConstraintRows,
        custom: Callable[[Floats, Floats, bool], tuple[Floats, Floats, Floats]] | None,
        actuation: Floats,
        diffusion: Diffusion,
        noise: tuple[Callable[..., tuple[Floats, Floats]], Integers, bool] | None = None,
    ) -> Mechanism:
        """Raises ValueError for arrays that do not fit each other or describe no tree.

        ``noise`` is a :class:`varpin.mechanics.noise.StepNoise`, the processes that see the slope of a control within
        a step, and whether a field depends on the velocity.
        """

    def jet(self, q: Floats, v: Floats) -> tuple[float, Floats, Floats, Floats, Floats, Floats]:
        """L, L_q, L_v, L_qq, L_vq and L_vv at q, v (n,)."""

    def jets(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        """M and L_vq (N, n, n) at each row of q and v (N, n)."""

    def constraints(self, q: Floats) -> tuple[Floats, Floats, Floats]:
        """G (N, c), the magnitudes of the terms that cancel in it (N, c), and dg/dq (N, c, n), at rows of q (N, n)."""

    def constraint_curvature(self, q: Floats, weights: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Weights . g_qq (n, n) and g_qq v (c, n) at q (n,)."""

    def velocity_slopes(self, q: Floats, v: Floats) -> Floats:
        """The derivative of v in (q, p) (N, n, 2n) at each row of q and v; NaN where M is not positive definite."""

    def forces(self, q: Floats, v: Floats, f: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Forces F besides L_q, dF/dq and dF/dv of elements, and the dissipated power, each (N, n).

        They are taken at rows of q, v and the constant force f of the controls (N, n), to which F adds.
        """

    def coupled_forces(self, q: Floats, v: Floats) -> tuple[Floats, Floats, Floats]:
        """Forces F of couplings besides L_q (N, n), and dF/dq and dF/dv (N, n, n), at rows of q and v (N, n)."""

    def jets_along(self, q: Floats, v: Floats, alpha: Floats, beta: Floats) -> tuple[Floats, Floats, Floats]:
        """Derivatives of M, L_vq and L_qq (N, n, n) at rows of q and v along rows of alpha and beta (N, n)."""

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
        stiffly_accurate: bool,
    ) -> Tableau:
        """Raises ValueError for arrays that do not fit each other."""

class Guards:
    """Conditions on accepted steps; see src/core/include/varpin/guards.hpp."""

    @staticmethod
    def make(
        *, active: bool, branch_margin: float, energy_balance: float, energy_budget: float, most_halvings: int
    ) -> Guards: ...

class Rollout:
    """Paths of a variational integrator, under constraints where ``places`` are given.

    A rollout has paths and the work arrays of a step. Forks share the work arrays: one thread at a time advances one of
    them, and another raises RuntimeError.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        tableau: Tableau,
        tolerance: float,
        guards: Guards,
        left: float,
        paths: int,
        held: bool = False,
        places: Floats | None = None,
    ) -> None: ...
    def fork(self, guards: Guards) -> Rollout:
        """An independent copy of the paths."""

    def begin(self, q: Floats, v: Floats) -> bool:
        """Start each path at its row of q and v (P, n); False if an M(q) is not positive definite."""

    def roll(
        self,
        dt: float,
        commands: Commands,
        increments: Floats,
        drift: Floats,
        nodes: RolloutArrays,
        impulses: Floats | None = None,
    ) -> None:
        """Take the steps of the commands, and write them into the nodes; both are named tuples of arrays.

        ``impulses`` (P, N, 2, n), in addition to noise, are added to the momenta before
        and after each step, or held over it as the noise; under constraints they have to be held.
        """

    def first_nodes(self, nodes: RolloutArrays) -> bool:
        """Write the node that each path is at, as :class:`ExplicitRollout`; True."""

    def halvings(self, path: int) -> Bytes:
        """The halvings of each part of every divided step in the last roll of a path, in order."""

    def impulses(self, path: int) -> Floats:
        """Constraint impulses (steps, c) in each step of the last roll of a path; joints feel dg/dq' times them."""

    def weakest(self, path: int) -> int:
        """The constraint row that was closest to dependence on the others at the end of a path."""

class Parameters:
    """Parameters of a mechanism; see src/core/include/varpin/repeated_steps.hpp.

    Each is a pair of mechanisms, above and below it, and their ``distance`` (k,). ``gears`` (k, 2, n) are the factors
    by which forces of controls are greater there.
    """

    def __init__(self, pairs: Sequence[tuple[Mechanism, Mechanism]], distance: Floats, gears: Floats) -> None:
        """Raises ValueError for arrays that do not fit each other."""

class Steps:
    """The steps of a trajectory, to be repeated at dw = 0.

    ``force`` is (N, 1, n), constant over each step, or (N, s, n) at its stages. ``halvings`` are those of the parts of
    all steps with more than one of ``substeps``. The same parts are repeated; parts that active ``guards`` refuse are
    halved. ``guess`` (N, s, n) are stage velocities close to those of each step.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        tableau: Tableau,
        tolerance: float,
        guards: Guards,
        dt: float,
        q: Floats,
        p: Floats,
        force: Floats,
        substeps: Integers,
        halvings: Bytes,
        guess: Floats,
    ) -> None:
        """Raises ValueError for arrays that do not fit each other."""

    def derivatives(
        self,
        ramp: bool = False,
        external: bool = False,
        parameters: Parameters | None = None,
        places: Floats | None = None,
        rates: Floats | None = None,
    ) -> tuple[Floats, Floats, Floats, Floats, Floats, int, int]:
        """Derivatives of steps, the outcome, and the number of steps done.

        They are those of (q1, p1) in (q0, p0) (N, 2n, 2n), in a constant force f (N, 2n, n), with ``ramp`` in one that
        grows linearly from 0 at the start of a step to f at its end (N, 2n, n), in the rates (N, i) of driven joints
        (N, 2n, i), and in k parameters (N, 2n, k); what is not asked for has no columns. Under constraints there are
        ``places`` and ``rates``. ``external``: f is not the force of the controls, which drives limit, but acts beside.
        """

    def curvatures(self, z: Floats) -> tuple[Floats, int, int]:
        """Z . d2(q1, p1)/d(q0, p0, f)2 (N, 3n, 3n) for z (N, 2n), the outcome, and the number of steps done."""

    def ends(self) -> tuple[Floats, Floats, int, int]:
        """Configurations and velocities (N, n) at the end of each step, the outcome, and the number of steps done."""

class BackwardPass:
    """The recursion from the terminal cost's gradient (2n,) and Hessian (2n, 2n) in x."""

    def __init__(self, controls: int, gradient: Floats, hessian: Floats) -> None: ...
    @property
    def slope(self) -> float:
        """Sum of Qu . k."""
    @property
    def curvature(self) -> float:
        """Sum of k . Quu k."""
    @property
    def noise(self) -> float:
        """The cost of noise."""
    @property
    def loss(self) -> float:
        """The largest relative rounding error of a pivot of Quu."""
    def run(
        self,
        h: float,
        hold: int,
        regularization: float,
        *,
        A: Floats,
        B: Floats,
        G: Floats,
        Gx: Floats,
        Gu: Floats,
        gradient: Floats,
        hessian: Floats,
        feedforward: Floats,
        feedback: Floats,
        control_gradient: Floats,
        spread: Floats,
        factors: Floats,
    ) -> int:
        """Pass over a block of N steps, the last block first; returns -1, or the decision without a minimum.

        Each control is held over ``hold`` steps, for R decisions. The linearized dynamics and the expanded costs are
        described in src/core/include/varpin/backward.hpp. Written are the gains of u + k + K (x - x_nominal),
        ``feedforward`` (R, m) and ``feedback`` (R, m, 2n); ``control_gradient`` (R, m) of the cost; with noise
        ``spread`` (N, 2n, 2n), S; and ``factors`` (R, m, m), L D L' of the regularized Quu.
        """

def triangular(rows: Floats, leading: int) -> Floats:
    """The first rows (leading, c) of R in rows (r, c) = Q R, triangular in as many columns."""

def foresee(
    hold: int,
    A: Floats,
    B: Floats,
    feedforward: Floats,
    feedback: Floats,
    slack: Floats,
    moves: Floats,
    after: Floats,
) -> bool:
    """The deviations on N linearized steps under a plan of R decisions, from the nominal state.

    Its steps are ``A`` (N, 2n, 2n) and ``B`` (N, 2n, m), its controls change by ``feedforward`` (R, m) and
    ``feedback`` (R, m, 2n) of the state, clipped to ``slack`` (R, 2, m) unless it is empty. ``moves`` (R, m) receives
    the changes of the controls, ``after`` (N, 2n) the deviations of the state after each step. The result tells whether
    a control reaches a limit.
    """

class Links:
    """Some bodies of a tree with all their ancestors; see src/core/include/varpin/kinematics.hpp."""

    @staticmethod
    def make(tree: Tree) -> Links:
        """Raises ValueError for arrays that do not fit each other or describe no tree."""

    def place_frame(self, turned: Floats, shifted: Floats, q: Floats, jacobian: bool) -> tuple[Floats, Floats, Floats]:
        """World rotations (N, 3, 3), positions (N, 3) and Jacobians (N, 6, n) of a frame on the last body.

        The frame has rotation ``turned`` (3, 3) and position ``shifted`` (3,) in the body. Jacobians are linear, then
        angular velocity in world axes; without ``jacobian`` they are (0, 6, n).
        """

class Outcome(IntEnum):
    """The reason for the end of a path's rollout; see src/core/include/varpin/nodes.hpp."""

    solved = ...
    diverged = ...
    not_finite = ...
    fold = ...
    energy = ...
    singular = ...
    toggle = ...
    assembly = ...

class ForwardDynamics:
    """Forward dynamics at single states."""

    def __init__(self, mechanism: Mechanism) -> None: ...
    def rate(self, x: Floats, force: Floats) -> tuple[Floats, bool]:
        """The rate (v, a) of x = (q, v) (2n,) under a force (n,), and whether the mass matrix is positive definite."""

    def node(self, x: Floats) -> tuple[Floats, float, bool]:
        """Momentum (n,) and energy [J] at x = (q, v) (2n,), and whether the mass matrix is positive definite."""

def element_kinds() -> dict[str, tuple[int, bool, bool]]:
    """Of each kind of element: how many parameters it has, whether it has a potential, and a force without one."""

def coupling_kinds() -> dict[str, tuple[int, bool, bool]]:
    """The same of couplings, without the positions of their two points."""

def nystroem(method: ExplicitMethod) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """C (s,), k and l (s, s), x and y (s,) of a method with s stages, as in src/core/include/varpin/explicit.hpp."""

def accelerations(
    mechanism: Mechanism, q: Floats, v: Floats, force: Floats
) -> tuple[Floats, Floats, Floats, Floats, int]:
    """Accelerations (N, n) at each row of q, v and force (N, n), and their derivatives (N, n, n) in each.

    Also returns the number of rows before the first whose mass matrix is not positive definite.
    """

def inverse_dynamics(mechanism: Mechanism, q: Floats, v: Floats, a: Floats) -> Floats:
    """The joint forces M a + L_vq v - L_q (N, n) that a motion needs at rows of q, v and a (N, n)."""

class ExplicitMethod(Enum):
    """See src/core/include/varpin/explicit.hpp."""

    euler = ...
    semi_implicit = ...
    runge_kutta = ...

class ExplicitRollout:
    """P paths of an explicit method."""

    @staticmethod
    def start(mechanism: Mechanism, method: ExplicitMethod, q: Floats, v: Floats) -> ExplicitRollout:
        """Paths at q and v (P, n)."""

    @property
    def q(self) -> Floats:
        """Current configurations of the paths (P, n) [rad or m], writable."""

    @property
    def v(self) -> Floats:
        """Current velocities of the paths (P, n) [rad/s or m/s], writable."""

    def copy(self) -> ExplicitRollout: ...
    def first_nodes(self, nodes: RolloutArrays) -> bool:
        """Write the state of each path as its node 0; False if a mass matrix is not positive definite."""

    def roll(
        self,
        dt: float,
        commands: Commands,
        increments: Floats,
        drift: Floats,
        nodes: RolloutArrays,
        impulses: Floats | None = None,
    ) -> None:
        """All N steps of length dt [s] of all paths.

        ``increments`` of the Wiener processes are (P, N, k), or (0, 0, k) for none; ``drift`` is a force in addition to
        the controls (P, N, n), or (0, 0, n) for none.
        """

def filter_variational(
    mechanism: Mechanism, tableau: Tableau, tolerance: float, guards: Guards, log: FilterLog
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats, Floats, int, int]:
    """The Kalman filter over a log, in (q, p): FilterArrays, why it ended and the samples that it reached."""

def filter_explicit(
    mechanism: Mechanism, method: ExplicitMethod, log: FilterLog
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats, Floats, int, int]:
    """The same in (q, v)."""

def linearize_explicit(
    mechanism: Mechanism, method: ExplicitMethod, dt: float, q: Floats, v: Floats, force: Floats, ramp: bool = False
) -> tuple[Floats, Floats, int]:
    """Derivatives of (q, v) after one step from each row of q and v, under a force (N, 1, n), or (N, s, n) by times.

    They are taken in (q, v) (N, 2n, 2n), and in a constant force (N, 2n, n), or with ``ramp`` in one that grows
    linearly to it from 0.

    Also returns the number of rows before the first whose mass matrix is not positive definite.
    """

class Stretch:
    """Polynomials over consecutive steps, and a quadrature on them; see src/core/include/varpin/clearance.hpp."""

    @staticmethod
    def make(*, curves: Floats, sums: Floats, places: Floats) -> Stretch:
        """Raises ValueError for arrays that do not fit each other."""

def propagated_errors(
    mechanism: Mechanism,
    q: Floats,
    v: Floats,
    u: Floats,
    within: Floats,
    dt: float,
    *,
    narrow: Stretch,
    wide: Stretch | None,
    damped: bool,
    most_q: Floats,
    most_v: Floats,
) -> Floats:
    """The largest errors of q (n,) at the nodes (N + 1, n) of a motion, from the defects of its steps.

    They are infinite where they are not known, or where those of q exceed ``most_q`` or those of v ``most_v`` (n,). The
    controls are u (N, m), and those at the stages of each step ``within`` (N, s, m), s = 0 for controls that are
    constant over each; ``narrow`` is a stretch of one step, ``wide`` of two. Along single steps errors are not known
    where there are fast dampers, ``damped``.
    """

class Subject(Enum):
    """The quantity of a cost's residual.

    Entries of z = (q, v, u), or their excess beyond limits; the position, orientation or twist of a frame, or the
    deficit of its manipulability.
    """

    entries = 0
    excess = 1
    position = 2
    orientation = 3
    twist = 4
    manipulability = 5

class CostTerms:
    """Costs weight . r^2 at samples (q, v, u); see src/core/include/varpin/costs.hpp."""

    @staticmethod
    def make(dof: int, controls: int) -> CostTerms: ...
    def add_frame(self, links: Links, turned: Floats, shifted: Floats) -> int:
        """Add a frame with rotation ``turned`` and position ``shifted`` in the last of some bodies; its index."""

    def add_center(self, links: Links) -> int:
        """Add the centre of mass of the bodies in place of a frame; its index."""

    def add_term(self, subject: Subject, place: int, weight: Floats, target: Floats, directions: Integers) -> None:
        """Add a term with weight (r, r) and targets (T, r) that repeat after T samples.

        Targets of an orientation are (T, 9); of an excess (T, 2 r), lower limits and then upper limits. ``place`` is
        the index of the first entry of z, or of the frame; ``directions`` (d,) are the rows of the Jacobian in a
        manipulability, none for other subjects.
        """

    def values(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """The value of each term (N, terms) at rows of q (N, n), v (N, n) and u (N, m)."""

    def expand(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats]:
        """Gradient (N, 2n + m) and Gauss-Newton Hessian (N or 1, 2n + m, 2n + m) of all terms."""
