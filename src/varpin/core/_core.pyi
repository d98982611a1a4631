"""The compiled core: src/core, bound by nanobind."""

from collections.abc import Callable, Sequence
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

from varpin.core.arrays import Commands, ConstraintRows, Nodes

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

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
        forces: Sequence[tuple[str, int, tuple[float, ...]]],
        couplings: Sequence[tuple[str, int, int, tuple[float, ...]]],
        constraints: ConstraintRows,
        custom: Callable[[Floats, Floats, bool], tuple[Floats, Floats, Floats]] | None,
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

    def constraints(self, q: Floats) -> tuple[Floats, Floats, Floats]:
        """G (N, c), the magnitudes of the terms that cancel in it (N, c), and dg/dq (N, c, n), at rows of q (N, n)."""

    def constraint_curvature(self, q: Floats, weights: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Weights . g_qq (n, n) and g_qq v (c, n) at q (n,)."""

    def velocity_slopes(self, q: Floats, v: Floats) -> Floats:
        """The derivative of v in (q, p) (N, n, 2n) at each row of q and v; NaN where M is not positive definite."""

    def forces(self, q: Floats, v: Floats, f: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Forces F beside L_q, what elements have of dF/dq and dF/dv, and the power turned into heat (N, n).

        They are at rows of q, v and f (N, n), f being the constant force of the controls, to which F adds.
        """

    def coupled_forces(self, q: Floats, v: Floats) -> tuple[Floats, Floats, Floats]:
        """The couplings' forces beside L_q (N, n), and dF/dq and dF/dv (N, n, n), at rows of q and v (N, n)."""

    def jets_along(self, q: Floats, v: Floats, alpha: Floats, beta: Floats) -> tuple[Floats, Floats, Floats]:
        """Derivatives of M, L_vq and L_qq (N, n, n) at each row of q and v along that of alpha and beta (N, n)."""

class Solver(Enum):
    """How a variational step solves; see src/core/include/varpin/elimination.hpp."""

    automatic = ...
    dense = ...
    elimination = ...

class Elimination:
    """Solves at one (q, v) by elimination from the leaves to the roots; see src/core/include/varpin/elimination.hpp.

    Raises ValueError where couplings act.
    """

    def __init__(self, mechanism: Mechanism, q: Floats, v: Floats) -> None: ...
    def step(self, ahead: float, behind: float, diagonal: Floats, b: Floats) -> tuple[Floats, Floats, float, bool]:
        """X with N x = b, (A' + ahead L_qq) x, x' M x, and whether all pivots of N are positive.

        N = M + ahead A - behind A' - ahead behind L_qq + diag(diagonal - armature + ahead behind stiffness), springs
        being part of L_qq.
        """

    def least_pivot_ratio(self, coupling: float, curvature: float, diagonal: Floats) -> float:
        """The smallest ratio of a pivot of M + coupling (A + A') - curvature L_qq to the same one of M; 0 if none is.

        Of the diagonal as in :meth:`step`.
        """

    def mass(self, b: Floats) -> tuple[Floats, Floats, bool]:
        """M^-1 b, the coordinates' shares of b . x / 2, and whether M is positive definite."""

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
    """When a step is accepted; see src/core/include/varpin/guards.hpp."""

    @staticmethod
    def make(
        *, active: bool, branch_margin: float, energy_balance: float, energy_budget: float, most_halvings: int
    ) -> Guards: ...

class Watch:
    """The running cost of one path while it is rolled out, and whether the motion is worth going on with."""

    class Verdict(Enum):
        going = 0
        cut = 1
        dear = 2

    def __init__(self, costs: CostTerms, rule: Floats, q: Floats, v: Floats, u: Floats, values: Floats) -> None:
        """Over nodes q and v (N + 1, n) and controls u (N, m) that are being written, the first node there already.

        The values of the terms at the samples of the rule (s, 9) go into ``values`` (N s, terms).
        """

    def ask(self, weight: float, most: float, after: int, parts: float) -> None:
        """End the motion where ``weight`` times its values exceed ``most``, or its first steps take too many parts.

        It is looked at from ``after`` steps on, which may take ``parts`` together.
        """

    def after(self, step: int, parts: int) -> bool:
        """Look at a step, which was taken in so many parts; False where the motion is to end there."""

    @property
    def verdict(self) -> Verdict: ...

class _Rollout:
    """What the rollouts of variational integrators have in common; of this file alone.

    Paths and the work arrays of a step, which forks share: one of them moves at a time.
    """

    def begin(self, q: Floats, v: Floats) -> bool:
        """Put each path at its row of q and v (P, n); False where an M(q) is not positive definite."""

    def kick(self, impulse: Floats) -> None:
        """Add an impulse (P, n) to the momenta; constraints absorb what is normal to them."""

    def nodes(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Configurations, momenta and velocities (P, n), and energies (P,)."""

    def halvings(self, path: int) -> Bytes:
        """Of each part of every step of a path in its last roll that was not taken whole, step after step."""

class VariationalRollout(_Rollout):
    """Paths without constraints."""

    def __init__(
        self,
        mechanism: Mechanism,
        tableau: Tableau,
        tolerance: float,
        guards: Guards,
        left: float,
        paths: int,
        solver: Solver = Solver.automatic,
    ) -> None: ...
    def fork(self, guards: Guards) -> VariationalRollout:
        """The paths as they stand, to move on by themselves."""

    def roll(
        self,
        dt: float,
        commands: Commands,
        increments: Floats,
        drift: Floats,
        nodes: Nodes,
        watch: Watch | None = None,
        impulses: Floats | None = None,
    ) -> None:
        """Take the steps that the commands are for, and write them into the nodes; named tuples of arrays.

        One path alone may be under a watch, which may end it. ``impulses`` on top of the noise's jump the momenta
        before and after each step (P, N, 2, n).
        """

class ConstrainedRollout(_Rollout):
    """Paths under constraints."""

    def __init__(
        self, mechanism: Mechanism, tableau: Tableau, places: Floats, tolerance: float, guards: Guards, paths: int
    ) -> None: ...
    def fork(self, guards: Guards) -> ConstrainedRollout:
        """The paths as they stand, to move on by themselves."""

    def roll(self, dt: float, commands: Commands, increments: Floats, drift: Floats, nodes: Nodes) -> None:
        """Take the steps that the commands are for, and write them into the nodes; named tuples of arrays."""

    def impulses(self, path: int) -> Floats:
        """What the constraints gave in each step of a path in its last roll (steps, c): dg/dq' times it."""

    def weakest(self, path: int) -> int:
        """The row of the constraints that depended most on the others where a path was last."""

def constrained_derivatives(
    mechanism: Mechanism,
    tableau: Tableau,
    places: Floats,
    tolerance: float,
    guards: Guards,
    dt: float,
    q: Floats,
    p: Floats,
    force: Floats,
    rates: Floats,
    substeps: Integers,
    halvings: Bytes,
    *,
    guess: Floats,
    ramp: bool = False,
) -> tuple[Floats, Floats, Floats, int, int]:
    """As variational_derivatives; and in the rates (N, i) of joints moved by hand, (N, 2n, i)."""

def variational_derivatives(
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
    *,
    guess: Floats,
    ramp: bool = False,
    solver: Solver = Solver.automatic,
) -> tuple[Floats, Floats, int, int]:
    """d(q1, p1)/d(q0, p0) (N, 2n, 2n) and d(q1, p1)/df (N, 2n, n); how it ended, and how many steps were done.

    ``force`` (N, 1, n) is constant over each step, or (N, s, n) that at each stage. f is constant over the step, or
    with ``ramp`` grows from 0 at its start to f at its end.

    ``halvings`` are those of the parts of all steps with more ``substeps`` than one. The same parts are taken again;
    one that ``guards`` refuse, where they are active, in halves.
    """

def variational_curvatures(
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
    *,
    guess: Floats,
    z: Floats,
    solver: Solver = Solver.automatic,
) -> tuple[Floats, int, int]:
    """Z . d2(q1, p1)/d(q0, p0, f)2 (N, 3n, 3n) for z (N, 2n); how it ended, and how many steps were done."""

def variational_ends(
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
    *,
    solver: Solver = Solver.automatic,
) -> tuple[Floats, Floats, int, int]:
    """Configurations and velocities (N, n) at the end of each step; how it ended, and how many steps were done."""

class ExpandedSteps:
    """The linearized dynamics and the expanded costs of N steps; what may be left out is empty then.

    See src/core/include/varpin/steps.hpp for the fields.
    """

    def __init__(
        self,
        *,
        A: Floats,
        B: Floats,
        G: Floats,
        Gx: Floats,
        Gu: Floats,
        rule: Floats,
        gradient: Floats,
        hessian: Floats,
        velocity: Floats,
        curvature: Floats,
        slack: Floats,
        expected: Floats,
        rate: Floats,
        pull: Floats,
    ) -> None:
        """Raises ValueError for arrays that do not fit each other."""

class Gains:
    """Arrays of R decisions and N steps that a backward pass fills in: u + k + K (x - x_nominal).

    ``feedforward`` (R, m), ``feedback`` (R, m, 2n), ``previous`` (R, m, m) on the control before where its change costs
    something, ``control_gradient`` (R, m) of the cost, ``costate`` (N, 2n) its gradient in the state after each step,
    empty if not asked for, and ``spread`` (N, 2n, 2n) S where there is noise.
    """

    def __init__(
        self,
        *,
        feedforward: Floats,
        feedback: Floats,
        previous: Floats,
        control_gradient: Floats,
        costate: Floats,
        spread: Floats,
    ) -> None: ...

class Squares:
    """N functions (1/2) |L z + r|^2 + c . z: root L (N, z, z) or (1, z, z), shift r and linear c (N, z)."""

    def __init__(self, root: Floats, shift: Floats, linear: Floats) -> None: ...

class _Found:
    @property
    def slope(self) -> float:
        """Sum of Qu . k."""
    @property
    def curvature(self) -> float:
        """Sum of k . Quu k."""
    @property
    def noise(self) -> float:
        """What noise adds to the cost."""
    @property
    def loss(self) -> float:
        """The largest part of a pivot of Quu, or of its root, that rounding may have changed."""

class BackwardPass(_Found):
    """The recursion from the terminal cost's gradient (2n,) and Hessian (2n, 2n) in x."""

    def __init__(self, controls: int, gradient: Floats, hessian: Floats) -> None: ...
    def run(self, h: float, hold: int, regularization: float, steps: ExpandedSteps, gains: Gains) -> int:
        """Over a block of steps, the last block first; -1, or the decision that has no minimum.

        Each control is held over ``hold`` steps.
        """

class RootPass(_Found):
    """The same on square roots, from the terminal cost in x as one function of squares, and its gradient (2n,)."""

    def __init__(self, controls: int, terminal: Squares, gradient: Floats) -> None: ...
    def run(
        self,
        h: float,
        hold: int,
        regularization: float,
        steps: ExpandedSteps,
        gains: Gains,
        running: Squares,
        change: Squares | None = None,
    ) -> int:
        """As that of :class:`BackwardPass`; ``running`` are the samples' costs, ``change`` those of R changes."""

def foresee(hold: int, steps: ExpandedSteps, gains: Gains, state: Floats, expected: Floats, moves: Floats) -> None:
    """Where the linearized motion goes under gains, each control clipped to its limits.

    ``state`` (2n + m,), the deviations before the first step of the state and of the control before it, becomes those
    after the last; ``expected`` (R, 2n + m) are those before each decision, ``moves`` (R, m) the controls' changes.
    """

def box_minimum(H: Floats, g: Floats, limits: Floats, guess: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]] | None:
    """The x (m,) within ``limits`` (2, m) that minimizes g . x + (1/2) x'Hx; None where H is not positive definite.

    With it, L D L' of H with held rows and columns replaced by those of the identity (unit L below the diagonal, D on
    it), and which entries the box holds.
    """

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
        mass: Floats,
        center: Floats,
        dof: int,
    ) -> Links:
        """Raises ValueError for arrays that do not fit each other or describe no tree."""

    def place_frame(self, turned: Floats, shifted: Floats, q: Floats, jacobian: bool) -> tuple[Floats, Floats, Floats]:
        """World rotations (N, 3, 3) and positions (N, 3) of a frame on the last body, its Jacobians (N, 6, n) if asked.

        The frame stands at (turned (3, 3), shifted (3,)) in the body; Jacobians are linear over angular velocity in
        world axes, and (0, 6, n) where nobody asks for them.
        """

class Outcome(IntEnum):
    """Why a rollout of a path ended; see src/core/include/varpin/nodes.hpp."""

    solved = ...
    diverged = ...
    not_finite = ...
    fold = ...
    energy = ...
    singular = ...
    toggle = ...
    assembly = ...

class ForwardDynamics:
    """Forward dynamics at one state after another."""

    def __init__(self, mechanism: Mechanism, solver: Solver = Solver.automatic) -> None: ...
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

    def roll(
        self,
        dt: float,
        commands: Commands,
        increments: Floats,
        drift: Floats,
        nodes: Nodes,
        watch: Watch | None = None,
        impulses: Floats | None = None,
    ) -> None:
        """All N steps of length dt [s] of all paths.

        With increments of the Wiener processes (P, N, k), or (0, 0, k) for none, and a force (P, N, n) on top of that
        of the controls, or (0, 0, n) for none.
        """

def linearize_explicit(
    mechanism: Mechanism, method: ExplicitMethod, dt: float, q: Floats, v: Floats, force: Floats, ramp: bool = False
) -> tuple[Floats, Floats, int]:
    """Derivatives of (q, v) after one step from each row of q and v, under a force (N, 1, n), or (N, s, n) by times.

    In (q, v) (N, 2n, 2n), and in a constant force (N, 2n, n), or with ``ramp`` in one that grows to it from 0.

    With them, how many rows there are before the first with a mass matrix that is not positive definite.
    """

def fastest_damping(mechanism: Mechanism, q: Floats, v: Floats, f: Floats, least: float) -> float:
    """The fastest rate of what damps [1/s] over rows of q, v and the controls' forces f (K, n); 0 below ``least``."""

def pulls_fast(mechanism: Mechanism, q: Floats, v: Floats, f: Floats, dt: float) -> bool:
    """Whether springs, servos or gravity turn a mode by more than a radian over dt [s], at a row of q, v, f (K, n)."""

def glance(
    mechanism: Mechanism, q: Floats, v: Floats, u: Floats, substeps: Integers, dt: float
) -> tuple[float, bool, bool, bool]:
    """The largest velocity; whether steps were taken in parts, all have the same controls, and a pull is fast.

    Of nodes (N + 1, n), ``dt`` [s] apart, and controls (N, m). The last is :func:`pulls_fast` over a step, at the ends.
    """

def energy_turnover(
    mechanism: Mechanism, q: Floats, v: Floats, p: Floats, u: Floats, dt: float, *, even: float, looks: int
) -> tuple[float, float, Floats, Floats]:
    """The energy that a motion turns over [J]; of its nodes (N + 1, n), ``dt`` [s] apart, and controls (N, m).

    The largest kinetic energy; the largest work so far of all controls, of servos that of their drives. For each
    coordinate (n,): the kinetic energy of the largest change of its velocity, at least by the part ``even`` of its
    largest; the largest work so far.
    """

def windows_agree(
    mechanism: Mechanism,
    q: Floats,
    v: Floats,
    begins: Integers,
    length: int,
    dt: float,
    again_q: Floats,
    again_v: Floats,
    *,
    way: float,
    velocity: float,
    little: float,
    light: float,
    even: float,
) -> bool:
    """Whether windows of a motion (N + 1, n) are what steps of twice the length make of them (K, length / 2, n).

    Up to ``way`` of each coordinate's way over the window, and ``velocity`` of its largest velocity.
    """

def longest_alternation(
    v: Floats, u: Floats | None, *, counts: float, idle: float, even: float
) -> tuple[int, int, int]:
    """The coordinate, the number and the first node of the longest stretch of turns of v (N + 1, n), one after another.

    Turns are those of its second differences. Nodes at which one of the controls u (N, m) turns do not count.
    """

class Subject(Enum):
    """What the residual of a cost is of.

    Entries of z = (q, v, u), or what they are beyond limits; a frame's position, orientation or twist, or what its
    manipulability lacks.
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
        """A frame that stands at (turned, shifted) in the last of some bodies; its index."""

    def add_center(self, links: Links) -> int:
        """The bodies' centre of mass, in the place of a frame; its index."""

    def add_term(self, subject: Subject, place: int, weight: Floats, target: Floats, directions: Integers) -> None:
        """A term with weight (r, r) and targets (T, r) that repeat after T samples.

        Targets of an orientation are (T, 9); of an excess (T, 2 r), the least values and then the greatest. ``place``
        is the first of the entries of z, or the index of the frame; ``directions`` (d,) are the rows of the Jacobian
        that a manipulability is of, none for other subjects.
        """

    def values(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """The value of each term (N, terms) at rows of q (N, n), v (N, n) and u (N, m)."""

    def expand(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats]:
        """Gradient (N, 2n + m) and Hessian (N or 1, 2n + m, 2n + m) of all terms, of Gauss and Newton."""

    def expand_steps(self, rule: Floats, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats]:
        """The same at the samples of the rule (s, 9) in the steps of q and v (N + 1, n) under u (N, m)."""

def change_values(weight: Floats, before: Floats, u: Floats) -> Floats:
    """What the changes of controls (P, N, m) cost, weight (m, m) . (u_k - u_(k-1))^2, one by one (P, N).

    ``before`` is the control before the first one (1, m), or (0, m) where the first one is free.
    """

def expand_changes(weight: Floats, before: Floats, u: Floats) -> tuple[Floats, Floats]:
    """Gradients (N, m) and Hessians (N, m, m) in u_k of the same at controls (N, m), with u_(k-1) as it is."""

def sample_steps(rule: Floats, q: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Samples (P, N s, n) of q and v from their nodes (P, N + 1, n), by a rule (s, 9)."""
