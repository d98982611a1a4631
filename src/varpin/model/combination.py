"""Several robots combined into one: two arms that carry an object, an arm beside a moving table."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from varpin.errors import InputError
from varpin.model.equalities import prefixed
from varpin.model.loading import transform
from varpin.model.mimic import rebuild
from varpin.model.robot import Part, Robot
from varpin.support.checks import tuple_of

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
    if not np.iterable(placements) or len(placements := tuple(placements)) != len(robots):
        raise InputError(f"placements must be one for each of {len(robots)} robots")
    if any(isinstance(place, str) for place in placements):
        raise InputError("placements must be transforms; for a moving base, load the robot with base='planar'")
    given = _prefixes(robots) if prefixes is None else tuple_of("prefixes", prefixes, str)
    if len(given) != len(robots):
        raise InputError(f"prefixes must be one string for each of {len(robots)} robots, got {prefixes!r}")
    if twice := _twice(robots, given):
        raise InputError(f"with the prefixes {given} there are two joints or frames named {twice[0]!r}")
    model = pin.Model()
    model.name, model.gravity = "+".join(robot.name for robot in robots), robots[0].model.gravity
    if any((robot.model.gravity.linear != model.gravity.linear).any() for robot in robots):
        logger.warning("robots of different gravity are combined: that of %r is the default of scenes", robots[0].name)
    places = [
        None if place is None else transform(place, f"placements: that of {robot.name!r}")
        for robot, place in zip(robots, placements, strict=True)
    ]
    parts = tuple(map(Part, robots, given, places))
    ties = tuple(
        tie
        for robot, prefix, place in parts
        for tie in rebuild(robot.model, onto=model, prefix=prefix, place=place).ties(robot.ties)
    )
    pairs = list(zip(robots, given, strict=True))
    return Robot(
        model.name,
        model,
        ties,
        locked=MappingProxyType({word + name: at for robot, word in pairs for name, at in robot.locked.items()}),
        group_states=tuple(
            replace(
                state, group=word + state.group, positions=tuple((word + joint, at) for joint, at in state.positions)
            )
            for robot, word in pairs
            for state in robot.group_states
        ),
        parts=parts,
        loops=tuple((word + a, word + b) for robot, word in pairs for a, b in robot.loops),
        equalities=tuple(prefixed(each, word) for robot, word in pairs for each in robot.equalities),
    )


def _twice(robots: Sequence[Robot], prefixes: Sequence[str]) -> list[str]:
    """Names of joints and frames that several robots share."""
    own = ({*list(x.model.names)[1:], *(frame.name for frame in list(x.model.frames)[1:])} for x in robots)
    counts = Counter(prefix + name for names, prefix in zip(own, prefixes, strict=True) for name in sorted(names))
    return [name for name, robots_with in counts.items() if robots_with > 1]


def _prefixes(robots: Sequence[Robot]) -> tuple[str, ...]:
    """Empty prefixes if names are unique, else the robots' names, or letters."""
    letters = tuple(f"{chr(ord('a') + k)}_" if k < 26 else f"r{k}_" for k in range(len(robots)))
    choices = ("",) * len(robots), tuple(f"{robot.name}_" for robot in robots)
    return next((prefixes for prefixes in choices if not _twice(robots, prefixes)), letters)
