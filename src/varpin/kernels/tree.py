"""The robot and the scene as flat arrays, the only form in which kernels see them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


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
    armature: Floats  # (n,) [kg m^2 or kg]


class Mechanism(NamedTuple):
    """A tree with what a scene adds: gravity, dampers, springs, actuation."""

    tree: Tree
    gravity: Floats  # (3,) [m/s^2]
    damping: Floats  # (n,) [N m s/rad or N s/m]
    stiffness: Floats  # (n,) [N m/rad or N/m]
    rest: Floats  # (n,) the springs' rest configuration [rad or m]
    actuation: Floats  # (n, m) generalized force per control


class Sweep(NamedTuple):
    """Work arrays of the sweeps, and where they leave their results."""

    rotation: Floats  # (b, 9) world orientation of each body, row-major
    position: Floats  # (b, 3) of each joint, from the root of its branch [m]
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
    V_scale: Floats  # (1,) the same for the potential energy [J]


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
        V_scale=np.zeros(1),
    )
