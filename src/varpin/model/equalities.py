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

from varpin.errors import RobotError

_KINDS = {"body": pin.FrameType.BODY, "site": pin.FrameType.OP_FRAME}


class End(NamedTuple):
    """One of two frames that coincide."""

    frame: str  # name of a body or site
    kind: str  # "body" or "site"
    place: pin.SE3 | None  # placement in the body or site; None: where the other end is in the reference configuration


@dataclass(frozen=True, eq=False)
class Closure:
    """Two frames that coincide (``<weld>``), or their origins alone (``<connect>``).

    Attributes:
        name: Tag and name of the element.
        a: Frame of the first body.
        b: Frame of the second body.
        turns: Whether the axes of the frames coincide, too.
    """

    name: str
    a: End
    b: End
    turns: bool


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
            found.append(replace(equality, a=a, b=b))
            continue
        rest = position(equality, equality.joint)
        turned = np.polynomial.Polynomial(equality.coefficients)
        if equality.leader is not None:
            turned = turned(np.polynomial.Polynomial([-position(equality, equality.leader), 1.0]))
        found.append(replace(equality, coefficients=tuple((turned + rest).coef.tolist())))
    return tuple(found)


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
