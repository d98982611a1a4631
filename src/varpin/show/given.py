"""What figures and replays are given: motions, plans, runs of controllers, and names of frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from varpin.errors import InputError, UnknownFrame
from varpin.model import Robot
from varpin.support.checks import tuple_of
from varpin.trajectory import Trajectory

if TYPE_CHECKING:
    # Imported for types alone: showing a motion needs no optimizer.
    from varpin.control import OptimalControlProblem


def motion_of(given: object) -> Any:
    """The motion of a plan or of a controller's run; anything else is returned as it is."""
    own = (getattr(given, name, None) for name in ("trajectory", "motion"))
    return next((motion for motion in own if isinstance(motion, Trajectory)), given)


def require_joints(name: str, motion: Trajectory, robot: Robot) -> None:
    """Refuse a motion of a robot with other joints."""
    if motion.joint_names != robot.joint_names:
        raise InputError(
            f"the {name} is of robot {motion.robot!r} with joints {', '.join(motion.joint_names)}; {robot.name!r} has "
            f"joints {', '.join(robot.joint_names)}"
        )


def problem_of(given: object) -> OptimalControlProblem | None:
    """The problem of a plan, or of the first plan of a controller's run; None of anything else."""
    plans = getattr(given, "plans", None)
    plan = plans[0] if isinstance(plans, tuple) and plans else given
    return cast("OptimalControlProblem | None", getattr(plan, "problem", None))


def frame_names(option: str, robots: Sequence[Robot], names: bool | str | Sequence[str]) -> list[tuple[str, ...]]:
    """The frames of each robot: of the given names those it has; for True its end effector."""
    if isinstance(names, bool | np.bool_):
        return [(robot.end_effector,) if names else () for robot in robots]
    wanted = (names,) if isinstance(names, str) else tuple_of(option, names, str)
    for name in wanted:
        if not any(robot.model.existFrame(name) for robot in robots):
            known = dict.fromkeys(frame.name for robot in robots for frame in robot.model.frames)
            owners = ", ".join(repr(robot.name) for robot in robots)
            raise UnknownFrame(name, known, f"{option}: no frame of robot {owners} is")
    return [tuple(name for name in wanted if robot.model.existFrame(name)) for robot in robots]
