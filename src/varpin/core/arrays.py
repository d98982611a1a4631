"""Named arrays for the compiled core: a robot's tree, forces, constraints, commands, and the nodes of a rollout."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers

Bytes = NDArray[np.uint8]

# Not read-only, which has nothing to protect in an empty array and makes each call of the core longer.
_HELD: Floats = np.zeros((0, 0, 0))
_NO_TIMES: Floats = np.zeros(0)


class Tree(NamedTuple):
    """A tree of ``b`` bodies, each on one joint about or along the z axis of its own frame.

    Body ``j`` moves with generalized coordinate ``coordinate[j]``: its joint is at
    ``ratio[j] * q[coordinate[j]] + offset[j]``. Without mimic joints every ratio is 1, every offset 0 and b = n.
    """

    parent: Integers  # (b,) index of the parent body, -1 at a root; parents come first
    prismatic: Integers  # (b,) 1 for a prismatic joint, 0 for a revolute one
    rotation: Floats  # (b, 3, 3) of the joint's frame in its parent's at joint position 0
    translation: Floats  # (b, 3) [m]
    mass: Floats  # (b,) [kg]
    center: Floats  # (b, 3) centre of mass in the body's frame [m]
    inertia: Floats  # (b, 6) xx, xy, yy, xz, yz, zz about the centre of mass, in the body's axes [kg m^2]
    coordinate: Integers  # (b,)
    ratio: Floats  # (b,)
    offset: Floats  # (b,) [rad or m]
    origin: Integers  # (b,) 1 below prismatic joints only: moments of its subtree are taken about its own joint
    loads: Integers  # (l,) first bodies of subtrees that are light compared to their carriers
    carried: Integers  # (l, n) 1 where a coordinate belongs to the subtree
    periodic: Integers  # (n,) 1 where the Lagrangian without springs is the same after a whole turn
    armature: Floats  # (n,) [kg m^2 or kg]
    group: Integers  # (n,) which of r mechanically independent groups a coordinate belongs to, from 0
    groups: int  # r; coordinates of different groups share neither inertia nor a mimic joint
    ends: Integers  # (c,) one past the last coordinate of each block outside of which M, L_vq and L_qq vanish


class Element(NamedTuple):
    """A force on one coordinate besides gravity; src/core/include/varpin/forces.hpp has the kinds."""

    kind: str
    coordinate: int
    values: tuple[float, ...]  # parameters of its kind, in order


class Coupling(NamedTuple):
    """A force between two points; src/core/include/varpin/couplings.hpp has the kinds."""

    kind: str
    a: int  # body of the first point, -1 for the world
    b: int  # body of the second point
    values: tuple[float, ...]  # both points (3,) in the axes of their bodies [m], then parameters of its kind


class Carried(NamedTuple):
    """A direction or a point that is fixed to a body."""

    body: int  # -1 for the world
    direction: bool  # a direction; else a point [m]
    place: tuple[float, float, float]  # in the body's axes, from its joint


class Product(NamedTuple):
    """The constraint factor X . Y - constant of two vectors, each a sum of carried ones."""

    x: int  # index in the list of vectors
    y: int
    factor: float
    constant: float


class Tied(NamedTuple):
    """The constraint q_follower - sum_k coefficients_k q_leader^k; without coefficients, a kinematic input."""

    follower: int
    leader: int
    coefficients: tuple[float, ...]
    rate: int = -1  # of a cubic kinematic input: index of the control that is its rate at the end; else -1


class CustomRows(NamedTuple):
    """Constraints defined by Python functions."""

    rows: int  # r
    value: Callable[[Floats], tuple[Floats, Floats]]  # g (r,) and C (r, n) of q (n,)
    curvature: Callable[[Floats, Floats], Floats]  # (n, n) of q and weights (r,)


class ConstraintRows(NamedTuple):
    """Rows of g(q) = 0, in this order; src/core/include/varpin/constraints.hpp."""

    vectors: tuple[tuple[Carried, ...], ...] = ()  # each one vector, or the first minus the second
    products: tuple[Product, ...] = ()
    ties: tuple[Tied, ...] = ()
    customs: tuple[CustomRows, ...] = ()


class Diffusion(NamedTuple):
    """Fields F_i of k Wiener processes that the core can evaluate.

    F[:, i] = constant[:, i] + control[:, i] u + quadratic[:, i] (q - center[:, i])^2, entry by entry.
    """

    constant: Floats  # (n, k) generalized force per square root of time
    control: Floats  # (n, k, m)
    quadratic: Floats  # (n, k)
    center: Floats  # (n, k) [rad or m]; NaN stands for the configuration at which a rollout starts


class Commands(NamedTuple):
    """R controls, each held over ``hold`` steps: u, or u + gains (x - reference) with x = (q, p) or (q, v).

    Where gains have 2n + m columns, x contains the previous control: (q, p, u_before). The result is clipped to the
    limits.
    """

    u: Floats  # (R, m)
    gains: Floats  # (R, m, 2n) or (R, m, 2n + m), or (0, m, 2n) for none
    reference: Floats  # (R, 2n) or (R, 2n + m), or (0, 2n)
    hold: int  # steps per decision
    limits: Floats  # (2, m) least and greatest control, infinite where there is none
    before: Floats  # (P, m) the control before the first of each path; (0, m) for that of the reference
    # (N, s, m) controls at the stages of each step, with mean u, without feedback and hold; empty for held controls
    within: Floats = _HELD
    # (s,) stages in a step of unit length: controls are then linear in time over each decision's steps, from the
    # previous control to u at their end; empty for held controls
    stage_times: Floats = _NO_TIMES
    # R where each path has controls of its own, u (P R, m), one path after another; 0 where all share u
    own: int = 0


class FilterLog(NamedTuple):
    """K samples of z numbers, positions and then velocities if there are any, and what acts in the K - 1 intervals.

    The state is (q, p) or (q, v), with d = 2n, or with the external forces on the joints, too, d = 3n.
    """

    mean: Floats  # (d,) before the first sample
    covariance: Floats  # (d, d)
    measured: Floats  # (K, z), NaN where missing
    variance: Floats  # (z,) of their errors
    parts: Integers  # (K - 1,) steps in each interval
    h: Floats  # (K - 1,) their length [s]
    force: Floats  # (K - 1, n) of the controls
    spread: Floats  # (K - 1, n, n) F F' of the noise
    kept: Floats  # (K - 1,) share of external forces that a step keeps
    added: Floats  # (K - 1, n) variance that it adds to them


class FilterArrays(NamedTuple):
    """Moments of the state before and after each sample, and what gave them."""

    predicted: Floats  # (K, d)
    predicted_covariance: Floats  # (K, d, d)
    state: Floats  # (K, d)
    covariance: Floats  # (K, d, d)
    transition: Floats  # (K - 1, d, d) derivatives of a prediction in the state before
    innovations: Floats  # (K, z) measured minus predicted, NaN where missing
    rows: Floats  # (K, z, 2n) derivatives of the predicted samples in the state


class RolloutArrays(NamedTuple):
    """Output of a rollout of P paths over N steps: the node after each step, and the work of the step."""

    q: Floats  # (P, N, n)
    p: Floats  # (P, N, n)
    v: Floats  # (P, N, n)
    energy: Floats  # (P, N)
    u: Floats  # (P, N, m) controls applied
    tally: Integers  # (P, N, 4) Newton iterations, jets, first-order sweeps, substeps
    quality: Floats  # (P, N, 3) worst scaled residual, smallest branch margin, energy error so far [J]
    ended: Integers  # (P,) outcome, as in src/core/include/varpin/nodes.hpp
    done: Integers  # (P,) number of steps done


def new_nodes(paths: int, steps: int, dof: int, controls: int) -> RolloutArrays:
    """Allocate the nodes of a rollout."""
    return RolloutArrays(
        q=np.empty((paths, steps, dof)),
        p=np.empty((paths, steps, dof)),
        v=np.empty((paths, steps, dof)),
        energy=np.empty((paths, steps)),
        u=np.empty((paths, steps, controls)),
        tally=np.zeros((paths, steps, 4), dtype=np.int64),
        quality=np.zeros((paths, steps, 3)),
        ended=np.zeros(paths, dtype=np.int64),
        done=np.zeros(paths, dtype=np.int64),
    )
