"""Equality constraints of a robot's description, the ``<equality>`` elements of an MJCF file.

A tree does not keep them. :mod:`varpin.mechanics.description` makes constraints of a scene from them.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin

# Greatest tilt [rad] of axes in a planar loop, and greatest offset of its point across the plane relative to the loop's
# size; below _EXACT they count as exact.
_PARALLEL, _EXACT = 1e-3, 1e-10


class End(NamedTuple):
    """One of two frames that coincide."""

    body: str
    place: pin.SE3  # placement in the body's axes


class Closure(NamedTuple):
    """Two frames that coincide (``<weld>``), or their origins alone (``<connect>``)."""

    name: str  # tag and name of the element
    a: End
    b: End
    turns: bool  # whether the axes of the frames coincide, too
    # In the axes of b, of the plane of a planar loop whose numbers are rounded: the origins coincide in it alone.
    normal: tuple[float, float, float] | None = None


class Gear(NamedTuple):
    """A joint that follows another: q_joint = c_0 + c_1 q_leader + c_2 q_leader^2 + ... (``<joint>``)."""

    name: str  # tag and name of the element
    joint: str
    leader: str | None  # None if the joint is held at c_0
    coefficients: tuple[float, ...]


Equality: TypeAlias = Closure | Gear


def rounded_normal(
    model: pin.Model, a: tuple[int, pin.SE3], b: tuple[int, pin.SE3]
) -> tuple[float, float, float] | None:
    """The normal of a loop's plane in the axes of b, if the loop is planar up to the rounding of a file's numbers.

    None for loops in space, and for those that are planar to the last digit. The loop is closed at two placements, each
    in the axes of a joint, and is looked at in the model's ``"qpos0"``.
    """
    sides = [set(model.supports[joint]) for joint, _ in (a, b)]
    loop = sorted(sides[0] ^ sides[1])
    if not loop or any(model.joints[j].nv != 1 for j in loop):
        return None
    data, q = model.createData(), model.referenceConfigurations["qpos0"]
    # For a model with one joint Pinocchio returns (6,).
    J = pin.computeJointJacobians(model, data, q).reshape(6, -1)[:, [model.joints[j].idx_v for j in loop]]
    hinges, slides = J[3:, np.abs(J[3:]).max(axis=0) > 0.5], J[:3, np.abs(J[3:]).max(axis=0) <= 0.5]
    if not hinges.size:
        return None
    normal = (hinges * np.where(hinges[:, 0] @ hinges < 0.0, -1.0, 1.0)).sum(axis=1)
    normal /= np.linalg.norm(normal)
    tilts = [*np.linalg.norm(np.cross(hinges.T, normal), axis=1), *np.abs(slides.T @ normal)]
    tilt = float(np.max(tilts))
    here, there = (data.oMi[joint] * place for joint, place in (a, b))
    size = max(float(np.linalg.norm(data.oMi[j].translation - there.translation)) for j in loop)
    off = abs(float(normal @ (here.translation - there.translation)))
    if tilt > _PARALLEL or off > _PARALLEL * size or (tilt <= _EXACT and off <= _EXACT * size):
        return None
    x, y, z = there.rotation.T @ normal
    return float(x), float(y), float(z)


def prefixed(equality: Equality, prefix: str) -> Equality:
    """The equality of a robot whose joints and frames have a prefix."""
    if isinstance(equality, Closure):
        a, b = (end._replace(body=prefix + end.body) for end in (equality.a, equality.b))
        return equality._replace(a=a, b=b)
    leader = None if equality.leader is None else prefix + equality.leader
    return equality._replace(joint=prefix + equality.joint, leader=leader)
