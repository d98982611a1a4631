"""What a scene and a plan have beside the robot, to be drawn: ties of the mechanism, obstacles, regions, goals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from varpin.errors import InputError
from varpin.mechanics.constraints import Constraint, Distance, FrameOnFrame, PointOnLine, PointOnPlane, PointOnPoint
from varpin.mechanics.forces import point_of
from varpin.mechanics.scene import Scene
from varpin.model import Robot
from varpin.model.tree import z_to
from varpin.show.replay.script import Region, Target, Tie

if TYPE_CHECKING:
    from varpin.control.constraints import PlanConstraint

Floats = NDArray[np.float64]


def parts_of(given: object, motion: object, robot: Robot) -> tuple[Scene | None, tuple[PlanConstraint, ...], float]:
    """The scene whose constraints are drawn, the constraints of the plan, and the time that it begins at [s].

    Args:
        given: Whether to draw those of the motion; or a scene; or a problem, with those of its plans.
        motion: What is shown, which knows its problem if it is a plan or a controller's run.
        robot: The arm that is shown.

    Raises:
        InputError: It is none of these, or of another robot.
    """
    source = given
    if isinstance(given, bool | np.bool_):
        plans = getattr(motion, "plans", None)
        source = getattr(plans[0] if plans else motion, "problem", None) if given else None
    if source is None:
        return None, (), 0.0
    scene = source if isinstance(source, Scene) else getattr(source, "scene", None)
    if not isinstance(scene, Scene):
        raise InputError(
            f"constraints must be True or False, a Scene or an OptimalControlProblem, got {type(given).__name__}"
        )
    planned = scene.robot
    if planned.joint_names != robot.joint_names or not planned.built_like(robot):
        raise InputError(f"constraints are of robot {planned.name!r}, another one than {robot.name!r}, which is shown")
    if source is scene:
        return scene, (), 0.0
    return scene, tuple(source.constraints), float(source.t0)  # type: ignore[attr-defined]


def ties(scene: Scene | None) -> tuple[Tie, ...]:
    """Where the constraints of a mechanism act; ties of joints and constraints of one's own have no place."""
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
    """Bodies to keep clear of, and where frames have to be or must not be; those that move at ``times`` (K,) [s]."""
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
                region = Region("obstacle", body.name, *ends, body.radius, box, body.rotation, way)
                # One obstacle may be that of several constraints.
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
    """Where frames have to end, but for places that are targets already."""
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
