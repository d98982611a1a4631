"""Marks of constraints: ties of the mechanism, obstacles, regions and goals of a plan."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.mechanics.constraints import Constraint, Distance, FrameOnFrame, PointOnLine, PointOnPlane, PointOnPoint
from varpin.mechanics.forces import point_of
from varpin.mechanics.scene import Scene
from varpin.model import Robot
from varpin.model.tree import z_to
from varpin.show.given import problem_of
from varpin.show.replay.marks import Region, Target, Tie

if TYPE_CHECKING:
    from varpin.control.constraints import PlanConstraint


def parts_of(given: object, motion: object, robot: Robot) -> tuple[Scene | None, tuple[PlanConstraint, ...], float]:
    """The scene whose constraints are drawn, the constraints of the plan, and the initial time of the plan [s].

    Args:
        given: Whether to draw the constraints of the motion; or a scene; or a problem with constraints of its plan.
        motion: The motion, which has a problem if it is a plan or a controller's run.
        robot: The robot that is shown.

    Raises:
        InputError: ``given`` is none of these, or of another robot.
    """
    source = given
    if isinstance(given, bool | np.bool_):
        source = problem_of(motion) if given else None
    if source is None:
        return None, (), 0.0
    scene = source if isinstance(source, Scene) else getattr(source, "scene", None)
    if not isinstance(scene, Scene):
        raise InputError(
            f"constraints must be True or False, a Scene or an OptimalControlProblem, got {reprlib.repr(given)}"
        )
    owner = scene.robot
    if owner.joint_names != robot.joint_names or not owner.built_like(robot):
        raise InputError(f"constraints are of robot {owner.name!r}, but the robot that is shown is {robot.name!r}")
    if source is scene:
        return scene, (), 0.0
    return scene, tuple(source.constraints), float(source.t0)  # type: ignore[attr-defined]


def ties(scene: Scene | None) -> tuple[Tie, ...]:
    """The ties of a scene's constraints, except for those between joints and custom ones, which are not drawn."""
    found = [] if scene is None else [_tie(constraint, scene.robot) for constraint in scene.constraints]
    return tuple(tie for tie in found if tie is not None)


def _tie(constraint: Constraint, robot: Robot) -> Tie | None:
    name = type(constraint).__name__
    if not isinstance(constraint, Distance | FrameOnFrame | PointOnLine | PointOnPlane | PointOnPoint):
        return None
    (body, _, here), (other, turned, there) = (point_of(end, getattr(constraint, end), robot) for end in "ab")
    axis = getattr(constraint, "normal", getattr(constraint, "direction", None))
    if axis is not None:
        axis = turned @ np.asarray(axis, dtype=np.float64)
        axis /= np.linalg.norm(axis)
    return Tie(name, (body, here), (other, there), axis, plane=isinstance(constraint, PointOnPlane))


def regions(constraints: Sequence[PlanConstraint], times: Floats) -> tuple[Region, ...]:
    """Obstacles, and regions that frames have to stay in or out of; moving ones at ``times`` (K,) [s]."""
    if not constraints:
        return ()
    from varpin.control import constraints as kinds  # noqa: PLC0415 - few replays need controllers imported

    found: dict[Any, Region] = {}
    for constraint in constraints:
        if isinstance(constraint, kinds.KeepClear):
            for body in constraint.obstacles:
                half = None if body.sides is None else 0.5 * body.sides
                box = None if half is None else np.array([-half, half])
                ends, way = (body.begin, body.end), None
                if body.shift is not None:
                    shifts = body.shifts(times)
                    ends, way = (body.begin + shifts[0], body.end + shifts[0]), shifts - shifts[0]
                region = Region("obstacle", body.name, *ends, body.radius, box, body.rotation, way, body.hull)
                # Several constraints may share an obstacle.
                found[repr(body)] = region
        elif isinstance(constraint, kinds.KeepInSphere | kinds.KeepOutOfSphere):
            kind = "out" if constraint.outside else "in"
            centers = constraint.shifts(times)
            way = centers - centers[0] if callable(constraint.center) else None
            found[constraint] = Region(kind, constraint.frame, centers[0], centers[0], constraint.radius, way=way)  # type: ignore[arg-type]
        elif isinstance(constraint, kinds.KeepInBox):
            found[constraint] = Region("in", constraint.frame, np.zeros(3), np.zeros(3), 0.0, constraint.limits)
        elif isinstance(constraint, kinds.KeepInHalfSpace):
            plane = np.array([[-np.inf, -np.inf, 0.0], [np.inf, np.inf, 0.0]])
            place = constraint.offset * constraint.normal
            found[constraint] = Region("in", constraint.frame, place, place, 0.0, plane, z_to(constraint.normal))
    return tuple(found.values())


def goals(constraints: Sequence[PlanConstraint], taken: Sequence[Target]) -> tuple[Target, ...]:
    """Final positions of frames as targets, except for those that are already among ``taken``."""
    if not constraints:
        return ()
    from varpin.control.constraints import ReachFrame  # noqa: PLC0415 - as above

    found = []
    for constraint in constraints:
        if isinstance(constraint, ReachFrame) and constraint.position is not None:
            place = constraint.position
            if not any(np.allclose(target.places[-1], place, atol=1e-9) for target in taken):
                found.append(Target(f"goal of {constraint.frame}", place[None]))
    return tuple(found)
