"""The robot and the scene as flat arrays, the only form in which kernels see them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.kernels._compile import inlined

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
# Of one block a tuple, of more an array: kernels are compiled for either, and know that one block is all there is.
Ends = Integers | tuple[int]


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
    ends: Ends  # (c,) one past the last coordinate of each block outside of which M, L_vq and L_qq vanish


@inlined
def block(ends: Ends, b: int) -> tuple[int, int]:
    """The first coordinate of block ``b``, and one past its last.

    That they fit 31 bits tells the compiler that none is negative; every access would else be tested for it.
    """
    return (ends[b - 1] & 0x7FFFFFFF if b > 0 else 0), ends[b] & 0x7FFFFFFF


class Diffusion(NamedTuple):
    """Fields F_i of k Wiener processes that a kernel can evaluate.

    F[:, i] = constant[:, i] + control[:, i] u + quadratic[:, i] (q - center[:, i])^2, entry by entry.
    """

    constant: Floats  # (n, k) generalized force per square root of time
    control: Floats  # (n, k, m)
    quadratic: Floats  # (n, k)
    center: Floats  # (n, k) [rad or m]; NaN stands for the configuration at which a rollout starts


class Mechanism(NamedTuple):
    """A tree with what a scene adds: gravity, dampers, springs, actuation, noise."""

    tree: Tree
    gravity: Floats  # (3,) [m/s^2]
    damping: Floats  # (n,) [N m s/rad or N s/m]
    stiffness: Floats  # (n,) [N m/rad or N/m]
    rest: Floats  # (n,) the springs' rest configuration [rad or m]
    actuation: Floats  # (n, m) generalized force per control
    diffusion: Diffusion


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


class Sweep(NamedTuple):
    """Work arrays of the sweeps, and where they leave their results."""

    rotation: Floats  # (b, 9) world orientation of each body, row-major
    position: Floats  # (b, 3) of each joint, from the last origin above it [m]
    axis: Floats  # (b, 6) S, motion axis
    velocity: Floats  # (b, 6) V
    axis_rate: Floats  # (b, 6) W = V x S
    inertia: Floats  # (b, 10) Y: mass, first moment (3), xx, xy, yy, xz, yz, zz
    momentum: Floats  # (b, 6) H
    dual_axis: Floats  # (b, 6) F = Y S
    dual_rate: Floats  # (b, 6) B = Y W + S x* H
    magnitude: Floats  # (b, 5) magnitudes that add up to V, V, H, H (linear, angular each) and the first moment
    M: Floats  # (n, n) L_vv
    A: Floats  # (n, n) L_vq
    Lqq: Floats  # (n, n)
    Lq: Floats  # (n,)
    Lv: Floats  # (n,)
    Lv_scale: Floats  # (n,) sum of the magnitudes that make up Lv
    Lq_scale: Floats  # (n,) the same for Lq
    V: Floats  # (n,) potential energy of each group; the first r count [J]
    V_scale: Floats  # (n,) the same for V


def new_sweep(bodies: int, dof: int) -> Sweep:
    """Allocate the work arrays for ``bodies`` bodies and ``dof`` coordinates."""
    spatial = [np.zeros((bodies, 6)) for _ in range(6)]
    return Sweep(
        rotation=np.zeros((bodies, 9)),
        position=np.zeros((bodies, 3)),
        axis=spatial[0],
        velocity=spatial[1],
        axis_rate=spatial[2],
        inertia=np.zeros((bodies, 10)),
        momentum=spatial[3],
        dual_axis=spatial[4],
        dual_rate=spatial[5],
        magnitude=np.zeros((bodies, 5)),
        M=np.zeros((dof, dof)),
        A=np.zeros((dof, dof)),
        Lqq=np.zeros((dof, dof)),
        Lq=np.zeros(dof),
        Lv=np.zeros(dof),
        Lv_scale=np.zeros(dof),
        Lq_scale=np.zeros(dof),
        V=np.zeros(dof),
        V_scale=np.zeros(dof),
    )
