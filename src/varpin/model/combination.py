"""Several robots combined into one: two arms that carry an object, an arm beside a moving table."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from types import MappingProxyType

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from varpin.errors import InputError
from varpin.model.additions import on_base
from varpin.model.equalities import prefixed
from varpin.model.mimic import Tie, rebuild, tied_model
from varpin.model.robot import Part, Robot
from varpin.model.sources import Description
from varpin.model.tree import flatten

logger = logging.getLogger(__name__)


def combine(
    *robots: Robot,
    placements: Sequence[ArrayLike | pin.SE3 | None] | None = None,
    prefixes: Sequence[str] | None = None,
) -> Robot:
    """Combine robots into one, whose coordinates are those of the first, then those of the second, and so on.

    The robots are independent until a scene joins them: a :class:`varpin.FrameOnFrame` between a frame of each closes
    the loop of two arms that hold one object. Limits, damping, friction, armature, mimic joints, shapes and postures
    are kept::

        left, right = vp.load_robot("ur5"), vp.load_robot("ur5")
        pair = vp.combine(left, right, placements=[None, facing], prefixes=["left_", "right_"])

    Args:
        robots: At least two; the same robot may be given twice.
        placements: Placement of each robot's world in the combined world: a transform (4, 4) [m], a ``pin.SE3``, or
            None for the identity. All are the identity if left out.
        prefixes: Prefix of the joint and frame names of each robot. If left out: none if all names are unique, else the
            robots' names, or ``a_``, ``b_`` ... if those leave duplicates.

    Raises:
        InputError: There are fewer than two robots, placements or prefixes do not match their number, a placement is
            not a rotation and a translation, or names are still duplicates.
    """
    if len(robots) < 2 or not all(isinstance(robot, Robot) for robot in robots):
        raise InputError("combine takes two or more robots, as varpin.load_robot returns them")
    if placements is None:
        placements = [None] * len(robots)
    if isinstance(placements, str | pin.SE3) or len(placements) != len(robots):
        raise InputError(f"placements must be one for each of {len(robots)} robots")
    if any(isinstance(place, str) for place in placements):
        raise InputError("placements must be transforms; for a moving base, load the robot with base='planar'")
    given = _prefixes(robots) if prefixes is None else tuple(prefixes)
    if isinstance(prefixes, str) or len(given) != len(robots) or not all(isinstance(word, str) for word in given):
        raise InputError(f"prefixes must be one string for each of {len(robots)} robots, got {prefixes!r}")
    if twice := _twice(robots, given):
        raise InputError(f"with the prefixes {given} there are two joints or frames named {twice[0]!r}")
    model, ties, parts = pin.Model(), [], []
    model.gravity = robots[0].model.gravity
    if any((robot.model.gravity.linear != model.gravity.linear).any() for robot in robots):
        logger.warning("robots of different gravity are combined: that of %r is the default of scenes", robots[0].name)
    for robot, place, prefix in zip(robots, placements, given, strict=True):
        part = robot.free_model if place is None else _placed(robot, place)
        shift = model.njoints - 1
        rebuild(part, range(1, part.njoints), part.joints.__getitem__, onto=model, prefix=prefix)
        ties += [Tie(tie.follower + shift, tie.leader + shift, tie.ratio, tie.offset) for tie in robot.ties]
        moved = pin.SE3.Identity() if place is None else pin.SE3(_homogeneous(place))
        parts.append(Part(robot, prefix, shift, moved))
    model.name = "+".join(robot.name for robot in robots)
    followers = {tie.follower for tie in ties}
    coordinates = tuple(joint for joint in range(1, model.njoints) if joint not in followers)
    pairs = list(zip(robots, given, strict=True))
    return Robot(
        name=model.name,
        model=tied_model(model, ties),
        joint_names=tuple(model.names[joint] for joint in coordinates),
        free_model=model,
        ties=tuple(ties),
        tree=flatten(model, tuple(ties), coordinates),
        locked=MappingProxyType({word + name: at for robot, word in pairs for name, at in robot.locked.items()}),
        package_dirs=tuple(dict.fromkeys(chain.from_iterable(robot.package_dirs for robot in robots))),
        group_states=tuple(
            replace(
                state, group=word + state.group, positions=tuple((word + joint, at) for joint, at in state.positions)
            )
            for robot, word in pairs
            for state in robot.group_states
        ),
        parts=tuple(parts),
        loops=tuple((word + a, word + b) for robot, word in pairs for a, b in robot.loops),
        equalities=tuple(prefixed(each, word) for robot, word in pairs for each in robot.equalities),
    )


def _placed(robot: Robot, place: ArrayLike | pin.SE3) -> pin.Model:
    try:
        return on_base(Description(robot.name, robot.free_model), place).model
    except InputError as error:
        raise InputError(f"placement of {robot.name!r}: {error}") from None


def _homogeneous(place: ArrayLike | pin.SE3) -> ArrayLike:
    return place.homogeneous if isinstance(place, pin.SE3) else np.asarray(place, dtype=np.float64)


def _names(robot: Robot) -> set[str]:
    return {*list(robot.free_model.names)[1:], *(frame.name for frame in list(robot.free_model.frames)[1:])}


def _twice(robots: Sequence[Robot], prefixes: Sequence[str]) -> list[str]:
    """Names that several robots share."""
    seen: set[str] = set()
    twice = []
    for robot, prefix in zip(robots, prefixes, strict=True):
        names = {prefix + name for name in _names(robot)}
        twice += sorted(names & seen)
        seen |= names
    return twice


def _prefixes(robots: Sequence[Robot]) -> tuple[str, ...]:
    """Empty prefixes if names are unique, else the robots' names, or letters."""
    if not _twice(robots, [""] * len(robots)):
        return ("",) * len(robots)
    names = tuple(f"{robot.name}_" for robot in robots)
    if len(set(names)) == len(names) and not _twice(robots, names):
        return names
    return tuple(f"{chr(ord('a') + k)}_" if k < 26 else f"r{k}_" for k in range(len(robots)))
