"""Equality constraints of a robot's description, the ``<equality>`` elements of an MJCF file.

A tree does not keep them. :mod:`varpin.mechanics.description` makes constraints of a scene from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin

from varpin.arrays import Floats
from varpin.errors import RobotError

# Greatest tilt [rad] of axes in a planar loop, and greatest offset of its point across the plane relative to the loop's
# size; below _EXACT they count as exact.
_PARALLEL, _EXACT = 1e-3, 1e-10

_KINDS = {"body": pin.FrameType.BODY, "site": pin.FrameType.OP_FRAME}


class End(NamedTuple):
    """One of two frames that coincide."""

    frame: str  # name of a body or site
    kind: str  # "body" or "site"
    place: pin.SE3 | None  # placement in the body or site; None: where the other end is in the reference configuration


class Plane(NamedTuple):
    """The plane of a loop's motion."""

    normal: tuple[float, float, float]  # in the axes of the second frame, b
    tilt: float  # greatest angle of a joint's axis with the normal, or of a slide's with the plane [rad]


@dataclass(frozen=True, eq=False)
class Closure:
    """Two frames that coincide (``<weld>``), or their origins alone (``<connect>``).

    Attributes:
        name: Tag and name of the element.
        a: Frame of the first body.
        b: Frame of the second body.
        turns: Whether the axes of the frames coincide, too.
        plane: Of a planar loop whose numbers are rounded; its point coincides in this plane only.
    """

    name: str
    a: End
    b: End
    turns: bool
    plane: Plane | None = None


@dataclass(frozen=True)
class Gear:
    """A joint that follows another: q_joint = c_0 + c_1 q_leader + c_2 q_leader^2 + ... (``<joint>``).

    Attributes:
        name: Tag and name of the element.
        joint: Name of the following joint.
        leader: Name of the leading joint; None if the joint is held at c_0.
        coefficients: c, in a file from the reference positions of both joints.
    """

    name: str
    joint: str
    leader: str | None
    coefficients: tuple[float, ...]


Equality: TypeAlias = Closure | Gear


def at_reference(equalities: Sequence[Equality], model: pin.Model, path: Path) -> tuple[Equality, ...]:
    """Equalities of a file, with the places and positions that follow from the file's reference configuration.

    Args:
        equalities: Equalities as in the file.
        model: The model of the file.
        path: The file, for messages.

    Raises:
        RobotError: There is no such body, site or joint, or a joint has several coordinates.
    """
    if not equalities:
        return ()
    data, q = model.createData(), model.referenceConfigurations["qpos0"]
    pin.framesForwardKinematics(model, data, q)

    def pose(equality: Closure, end: End) -> pin.SE3:
        if not model.existFrame(end.frame, _KINDS[end.kind]):
            raise RobotError(f"{path}: {equality.name}: there is no {end.kind} {end.frame!r}")
        return data.oMf[model.getFrameId(end.frame, _KINDS[end.kind])]

    def position(equality: Gear, joint: str) -> float:
        if not model.existJointName(joint):
            raise RobotError(f"{path}: {equality.name}: there is no joint {joint!r}")
        kind = model.joints[model.getJointId(joint)]
        if kind.nq != 1:
            raise RobotError(f"{path}: {equality.name}: joint {joint!r} has several coordinates")
        return float(q[kind.idx_q])

    found: list[Equality] = []
    for equality in equalities:
        if isinstance(equality, Closure):
            a, b = equality.a, equality.b
            at, there = pose(equality, a), pose(equality, b)
            if a.place is None:
                a = a._replace(place=at.inverse() * there * b.place)
            elif b.place is None:
                b = b._replace(place=there.inverse() * at * a.place)
            frames = (model.getFrameId(end.frame, _KINDS[end.kind]) for end in (a, b))
            plane = None if equality.turns else _rounded_plane(model, data, q, [*frames], at * a.place, there * b.place)
            found.append(replace(equality, a=a, b=b, plane=plane))
            continue
        rest = position(equality, equality.joint)
        turned = np.polynomial.Polynomial(equality.coefficients)
        if equality.leader is not None:
            turned = turned(np.polynomial.Polynomial([-position(equality, equality.leader), 1.0]))
        found.append(replace(equality, coefficients=tuple((turned + rest).coef.tolist())))
    return tuple(found)


def _rounded_plane(
    model: pin.Model, data: pin.Data, q: Floats, frames: Sequence[int], a: pin.SE3, b: pin.SE3
) -> Plane | None:
    """The plane of a loop closed at the frames ``a`` and ``b``, if it is planar up to the rounding of a file's numbers.

    None for loops in space, and for those that are planar to the last digit.
    """
    sides = [set(model.supports[model.frames[frame].parentJoint]) for frame in frames]
    loop = sorted(sides[0] ^ sides[1])
    if not loop or any(model.joints[j].nv != 1 for j in loop):
        return None
    J = pin.computeJointJacobians(model, data, q)[:, [model.joints[j].idx_v for j in loop]]
    hinges, slides = J[3:, np.abs(J[3:]).max(axis=0) > 0.5], J[:3, np.abs(J[3:]).max(axis=0) <= 0.5]
    if not hinges.size:
        return None
    normal = (hinges * np.where(hinges[:, 0] @ hinges < 0.0, -1.0, 1.0)).sum(axis=1)
    normal /= np.linalg.norm(normal)
    tilts = [*np.linalg.norm(np.cross(hinges.T, normal), axis=1), *np.abs(slides.T @ normal)]
    tilt = float(np.max(tilts))
    size = max(float(np.linalg.norm(data.oMi[j].translation - b.translation)) for j in loop)
    off = abs(float(normal @ (a.translation - b.translation)))
    if tilt > _PARALLEL or off > _PARALLEL * size or (tilt <= _EXACT and off <= _EXACT * size):
        return None
    x, y, z = b.rotation.T @ normal
    return Plane((float(x), float(y), float(z)), tilt)


def prefixed(equality: Equality, prefix: str) -> Equality:
    """The equality of a robot whose joints and frames have a prefix."""
    if isinstance(equality, Closure):
        a, b = (end._replace(frame=prefix + end.frame) for end in (equality.a, equality.b))
        return replace(equality, a=a, b=b)
    leader = None if equality.leader is None else prefix + equality.leader
    return replace(equality, joint=prefix + equality.joint, leader=leader)


def on_named_frame(model: pin.Model, end: End) -> tuple[str, pin.SE3]:
    """A frame on the same body that the name alone tells apart, and the placement of ``end`` in it.

    A joint, a body and a site of an MJCF file may have one name.
    """
    own = model.frames[model.getFrameId(end.frame, _KINDS[end.kind])]
    names = [frame.name for frame in model.frames]
    beside = [frame for frame in model.frames if frame.parentJoint == own.parentJoint]
    frame = next(
        frame for frame in (own, *beside) if model.frames[names.index(frame.name)].parentJoint == own.parentJoint
    )
    named = model.frames[names.index(frame.name)]
    return str(named.name), named.placement.inverse() * own.placement * end.place
