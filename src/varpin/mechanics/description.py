"""Constraints from the equality constraints of a robot's description: ``Scene(robot, constraints="robot")``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from varpin.errors import InputError
from varpin.mechanics.constraints import Constraint, FrameOnFrame, JointTie, PointOnLine, PointOnPoint
from varpin.model import Robot
from varpin.model.equalities import Closure, End, Gear
from varpin.model.tree import place_of_frame

# Largest miss of constraints that locked joints keep [m or rad].
_MISSED = 0.02


def description_constraints(robot: Robot) -> tuple[Constraint, ...]:
    """The equality constraints of a robot's description; without those between bodies that locked joints hold.

    Raises:
        InputError: Locked joints violate a constraint, or leave a nonlinear one with a single joint.
    """
    found: list[Constraint | None] = []
    for equality in robot.equalities:
        found.append(_closure(equality, robot) if isinstance(equality, Closure) else _tie(equality, robot))
    return tuple(constraint for constraint in found if constraint is not None)


def _closure(closure: Closure, robot: Robot) -> Constraint | None:
    (a, here), (b, there) = closure.a, closure.b
    (body, *at), (other, *on) = (place_of_frame(robot.model, name, robot.name) for name in (a, b))
    if body == other:
        miss = (pin.SE3(*at) * here).actInv(pin.SE3(*on) * there)
        turned = np.abs(pin.log3(miss.rotation)).max() if closure.turns else 0.0
        _require_kept(closure.name, max(float(np.abs(miss.translation).max()), float(turned)), robot)
        return None
    if closure.turns:
        return FrameOnFrame(a, b, (there * here.inverse()).homogeneous)
    if closure.normal is not None:
        return PointOnLine(_point(closure.a), _point(closure.b), there.rotation @ np.array(closure.normal))
    return PointOnPoint(_point(closure.a), _point(closure.b))


def _point(end: End) -> str | tuple[str, Sequence[float]]:
    return (end.body, end.place.translation.tolist()) if end.place.translation.any() else end.body


def _tie(gear: Gear, robot: Robot) -> Constraint | None:
    follows = np.polynomial.Polynomial(gear.coefficients)
    if gear.joint in robot.locked and gear.leader is not None and gear.leader not in robot.locked:
        raise InputError(
            f"robot {robot.name!r}: {gear.name} of the description ties the locked joint {gear.joint!r} to "
            f"{gear.leader!r}: lock {gear.leader!r}, too"
        )
    if gear.leader is not None and gear.leader not in robot.locked:
        return JointTie(gear.joint, gear.leader, follows.coef)
    target = gear.coefficients[0] if gear.leader is None else float(follows(_locked(robot, gear.leader)))
    if gear.joint in robot.locked:
        _require_kept(gear.name, abs(_locked(robot, gear.joint) - target), robot)
        return None
    # A joint at a constant position is a tie that does not depend on its leader.
    others = [other for other in robot.joint_names if other != gear.joint]
    if not others:
        raise InputError(
            f"robot {robot.name!r}: {gear.name} of the description holds its only joint {gear.joint!r}, at "
            f"{target:.6g}: nothing moves"
        )
    return JointTie(gear.joint, others[0], (target,))


def _locked(robot: Robot, joint: str) -> float:
    return float(np.ravel(robot.locked[joint])[0])


def _require_kept(name: str, miss: float, robot: Robot) -> None:
    if not miss <= _MISSED:
        raise InputError(
            f"robot {robot.name!r}: its locked joints miss {name} of the description by {miss:.4g} m or rad: lock them "
            "where they satisfy it"
        )
