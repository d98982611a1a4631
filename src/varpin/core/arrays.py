"""Arrays by name, as the compiled core takes them: a robot's tree, controls, and what a rollout writes."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

_HELD: Floats = np.zeros((0, 0, 0))
_HELD.setflags(write=False)
_NOWHERE: Floats = np.zeros(0)
_NOWHERE.setflags(write=False)


class Tree(NamedTuple):
    """A tree of ``b`` bodies, each on one joint about or along the z axis of its own frame.

    Body ``j`` moves with generalized coordinate ``coordinate[j]``: its joint stands at
    ``ratio[j] * q[coordinate[j]] + offset[j]``. Where every ratio is 1, every offset 0 and b = n, bodies and
    coordinates are the same thing; mimic joints make the difference.
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
    origin: Integers  # (b,) 1 where no joint above turns: moments of what it carries are taken about its own joint
    loads: Integers  # (l,) bodies with which a part begins that is light beside what carries it
    carried: Integers  # (l, n) 1 where a coordinate belongs to the part
    periodic: Integers  # (n,) 1 where the Lagrangian without springs is the same after a whole turn
    armature: Floats  # (n,) [kg m^2 or kg]
    group: Integers  # (n,) which of r mechanically independent groups a coordinate belongs to, from 0
    groups: int  # r; coordinates of different groups share neither inertia nor a mimic joint
    ends: Integers  # (c,) one past the last coordinate of each block outside of which M, L_vq and L_qq vanish


class Element(NamedTuple):
    """What acts on one coordinate besides inertia and gravity; src/core/include/varpin/forces.hpp has the kinds."""

    kind: str
    coordinate: int
    values: tuple[float, ...]  # its numbers, in order


class Coupling(NamedTuple):
    """What acts between two points; src/core/include/varpin/couplings.hpp has the kinds."""

    kind: str
    a: int  # the body that carries the one point, -1 for the world
    b: int  # that of the other
    values: tuple[float, ...]  # both places (3,) in their body's axes [m], then its numbers in order


class Carried(NamedTuple):
    """A vector that a body carries."""

    body: int  # -1 for the world
    direction: bool  # or a point [m]
    place: tuple[float, float, float]  # in the body's axes, from its joint


class Product(NamedTuple):
    """The constraint factor X . Y - constant of two vectors, each a sum of carried ones."""

    x: int  # place in the list of vectors
    y: int
    factor: float
    constant: float


class Tied(NamedTuple):
    """The constraint q_follower - sum_k coefficients_k q_leader^k; a joint alone, without any, is moved by hand."""

    follower: int
    leader: int
    coefficients: tuple[float, ...]
    rate: int = -1  # of a joint moved by hand on a cubic: the control that is its rate at the end; else -1


class CustomRows(NamedTuple):
    """Constraints by functions."""

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

    Where gains have 2n + m columns, the control before belongs to x: (q, p, u_before). What comes out is brought
    within the limits.
    """

    u: Floats  # (R, m)
    gains: Floats  # (R, m, 2n) or (R, m, 2n + m), or (0, m, 2n) for none
    reference: Floats  # (R, 2n) or (R, 2n + m), or (0, 2n)
    hold: int  # steps between two looks at the state
    limits: Floats  # (2, m) least and greatest control, infinite where there is none
    before: Floats  # (P, m) the control before the first of each path; (0, m) for what the reference has
    # (N, s, m) at the stages of each step, of which u has the mean, without feedback and hold; empty where held
    within: Floats = _HELD
    # (s,) of the stages in a step of unit length: controls are then linear in time over each decision's steps, from the
    # control before to u, which is reached at their end; empty where they are held
    places: Floats = _NOWHERE


class Nodes(NamedTuple):
    """What a rollout of P paths over N steps writes: the node after each step, and what the step took."""

    q: Floats  # (P, N, n)
    p: Floats  # (P, N, n)
    v: Floats  # (P, N, n)
    energy: Floats  # (P, N)
    u: Floats  # (P, N, m) controls applied
    tally: Integers  # (P, N, 4) Newton iterations, jets, first-order sweeps, substeps
    quality: Floats  # (P, N, 3) worst scaled residual, smallest branch margin, energy error so far [J]
    ended: Integers  # (P,) how
    done: Integers  # (P,) steps


def new_nodes(paths: int, steps: int, dof: int, controls: int) -> Nodes:
    """Room for the nodes of a rollout."""
    return Nodes(
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
