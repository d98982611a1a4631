"""What is shown: robots with their motions, ghosts, targets and torques over time."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.marks import Marks
from varpin.model import Robot
from varpin.show.given import motion_of, require_joints
from varpin.show.replay.picture import Picture, label
from varpin.support.checks import as_floats, flag, positive, require_finite
from varpin.trajectory import Trajectory, kinematic_input_rows

if TYPE_CHECKING:
    from varpin.control import Solution
    from varpin.control.mpc import MpcRun

Motion: TypeAlias = "Trajectory | MpcRun | Solution | ArrayLike"

# Largest number of keyframes of a page and of frames of a film: some megabytes.
MOST_FRAMES = 10_000


@dataclass(frozen=True, eq=False)
class Shown:
    """A robot with its motion and its marks."""

    robot: Robot
    given: Any  # its motion, plan or run; in a live view, the robot, scene or problem
    marks: Marks
    t: Floats  # times of the motion from 0 (N + 1,) [s]
    q: Floats  # configurations (N + 1, n) [rad or m]

    @property
    def run(self) -> MpcRun | None:
        """The motion if it is a controller's run; told by its attributes, to avoid an import of controllers."""
        return cast("MpcRun", self.given) if hasattr(self.given, "planned") else None

    @property
    def ahead(self) -> float:
        """Time ahead at which a run's plans are shown [s]; 0 to show none."""
        if self.run is None:
            return 0.0
        if (ahead := self.marks.ahead) is None:
            return self.run.plans[0].problem.duration
        return 0.0 if ahead == 0 else positive("ahead", ahead, "s")

    @cached_property
    def motions(self) -> dict[str, tuple[Floats, Floats]]:
        """Times from 0 [s] and configurations of the "robot" and, if there is one, the "ghost"."""
        motions = {"robot": (self.t, self.q)}
        if self.marks.ghost is not None:
            motions["ghost"] = read_motion(self.robot, "ghost", motion_of(self.marks.ghost), end=self.t[-1])
        elif self.run is not None and self.ahead:
            rows = self.run.planned(self.ahead)
            motions["ghost"] = self.run.period * np.arange(len(rows), dtype=np.float64), rows
        return motions

    @cached_property
    def targets(self) -> dict[str, tuple[Floats, Floats, Floats | None]]:
        """Times from 0 [s], positions (K, 3) [m] and, for poses, quaternions (K, 4) of targets; one row if fixed."""
        given = self.marks.targets
        if given is not None and not isinstance(given, Mapping):
            raise InputError(
                f"targets must map names to places or poses, as in {{'cup': [0.5, 0, 0.3]}}, got {given!r}"
            )
        return {str(name): _target(f"targets[{name!r}]", value, self.t[-1]) for name, value in (given or {}).items()}

    def times(self) -> list[Floats]:
        """The times of everything that moves [s]: the robot, its ghost, its targets."""
        moving: list[tuple[Any, ...]] = [*self.motions.values(), *self.targets.values()]
        return [t for t, *_ in moving if len(t) > 1]

    def effort(self, times: Floats) -> Floats | None:
        """Torque of each joint of the tree as a share of its limit (K, b), in [0, 1]; None if torques are not shown.

        A joint without a limit is held against its own largest torque.
        """
        robot, values = self.robot, self.marks.torques
        if isinstance(values, bool | np.bool_):
            if not values:
                return None
            values = _controls(robot, motion_of(self.given))
        size = np.abs(require_finite("torques", as_floats("torques", values)))
        if size.ndim != 2 or size.shape[1] != robot.dof:
            raise InputError(f"torques must have shape (N, {robot.dof}), one row a step, got {size.shape}")
        if not len(size):
            return np.zeros((len(times), len(robot.tree.parent)))
        bound = np.where(np.isfinite(robot.effort_limit), robot.effort_limit, size.max(axis=0))
        # Constant over each step; the value of the last step also holds at the end.
        step = np.minimum((times / (self.t[-1] or 1.0) * len(size) * (1.0 + 1e-12)).astype(int), len(size) - 1)
        return np.minimum(size / np.where(bound > 0.0, bound, 1.0), 1.0)[step][:, robot.tree.coordinate]


@dataclass(frozen=True, eq=False)
class Figure:
    """A robot at the keyframes, as its marks need it."""

    shown: Shown
    picture: Picture
    number: str  # the end of its nodes' names; empty for the first robot
    trace: Sequence[str]  # frames whose paths are drawn
    frames: Sequence[str]  # frames that are drawn
    times: Floats  # the keyframes (K,) [s]
    rows: Mapping[str, Floats]  # configurations at the keyframes (K, n) [rad or m], of "robot" and "ghost"
    effort: Floats | None  # shares (K, b) of :meth:`Shown.effort`
    swept: Floats  # points (P, 3) around its motion [m]
    size: float  # size of the largest robot's motion [m]
    toward: Floats  # unit vector (3,) to the camera

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.shown.robot

    @property
    def q(self) -> Floats:
        """Configurations of the robot at the keyframes (K, n) [rad or m]."""
        return self.rows["robot"]

    @cached_property
    def right(self) -> Floats:
        """The horizontal unit vector (3,) that the camera sees pointing to the right."""
        right = np.cross([0.0, 0.0, 1.0], self.toward)
        return np.asarray(right / np.linalg.norm(right))

    @property
    def up(self) -> Floats:
        """The unit vector (3,) that the camera sees pointing upwards."""
        return np.cross(self.toward, self.right)

    @cached_property
    def poses(self) -> tuple[Floats, Floats]:
        """World rotations (K, b, 3, 3) and positions (K, b, 3) [m] of the bodies."""
        return self.picture.body_poses(self.q)

    def node(self, kind: str, body: int) -> str:
        """Scene path of a body of the "robot" or the "ghost", each below that of its parent; -1 for the base."""
        if body < 0:
            return f"{kind}{self.number}"
        parent = self.node(kind, int(self.robot.tree.parent[body]))
        return f"{parent}/{body} {label(self.robot.model.names[body + 1])}/moving"


def require_marks(marks: Marks | None) -> Marks:
    """The marks, or none; raises an InputError for anything else."""
    if marks is not None and not isinstance(marks, Marks):
        raise InputError(f"marks must be varpin.Marks(...), such as Marks(trace=True), got {reprlib.repr(marks)}")
    marks = Marks() if marks is None else marks
    flag("growing", marks.growing)
    return marks


def read_motion(
    robot: Robot, name: str, motion: Trajectory | ArrayLike, dt: float | None = None, end: float | None = None
) -> tuple[Floats, Floats]:
    """Times (N + 1,) from 0 [s], with ``dt`` or up to an ``end``, and configurations (N + 1, n)."""
    if isinstance(motion, Trajectory):
        require_joints(name, motion, robot)
        for what in ("rotation", "translation"):
            saved, present = motion.scene_values.get(what), getattr(robot.tree, what)
            if saved is not None and (saved.shape != present.shape or not np.allclose(saved, present, atol=1e-9)):
                raise InputError(
                    f"the {name} is of robot {motion.robot!r}, whose joints have the names of those of {robot.name!r} "
                    "but other placements"
                )
        return motion.t - motion.t[0], require_finite(f"{name}.q", motion.q)
    q = as_floats(name, motion)
    if q.ndim != 2 or q.shape[1] != robot.dof or not len(q):
        rows = "(N + 1, {}), one row a node" if end is None else "(K, {}), rows spread evenly over the motion's time"
        raise InputError(f"{name} must have shape {rows.format(robot.dof)}, got {q.shape}")
    require_finite(name, q)
    if end is not None:
        return _spread(f"its {name}", q, end), q
    if dt is None:
        raise InputError("an array of configurations needs dt, the time between its rows [s]")
    return np.arange(len(q), dtype=np.float64) * positive("dt", dt, "s"), q


def _spread(name: str, rows: Floats, end: float) -> Floats:
    """Times of rows that are spread evenly over a motion [s]."""
    if end == 0.0 and len(rows) > 1:
        raise InputError(f"the motion is a single pose, so {name} must be one row, too, got {len(rows)}")
    return np.linspace(0.0, end, len(rows))


def _target(name: str, value: Any, end: float) -> tuple[Floats, Floats, Floats | None]:
    """Times up to an ``end`` [s], positions (K, 3) [m] and, for poses, quaternions (K, 4)."""
    array = require_finite(name, as_floats(name, value))
    array = array[None] if array.shape in ((3,), (4, 4)) else array
    if array.shape[1:] not in ((3,), (4, 4)) or not len(array):
        raise InputError(
            f"{name} must be a point (3,), a pose (4, 4) or pin.SE3, or rows of them, (K, 3) or (K, 4, 4); got shape "
            f"{array.shape}"
        )
    times = _spread(name, array, end)
    if array.ndim == 2:
        return times, array, None
    R = array[:, :3, :3]
    rigid = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max() < 1e-6 and (np.linalg.det(R) > 0.0).all()
    if not rigid or np.abs(array[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
        raise InputError(f"{name} must be a pose: a rotation and a position above the row 0 0 0 1")
    return times, array[:, :3, 3], Rotation.from_matrix(R).as_quat()


def _controls(robot: Robot, motion: object) -> Floats:
    """The controls of a motion (N, n), each the torque of a joint."""
    if (
        not isinstance(motion, Trajectory)
        or motion.u.shape[1] != robot.dof
        or motion.scene_values.get("PositionServo", np.zeros(0)).size
        or len(kinematic_input_rows(motion))
    ):
        raise InputError(
            f"torques=True needs a motion with a torque of each of {robot.dof} joints as its controls, without servos "
            f"and kinematic inputs: give the torques (N, {robot.dof}) themselves"
        )
    return motion.u


def keyframe_times(shown: Sequence[Shown], fps: float) -> Floats:
    """Times of the keyframes (K,), from 0 to the end of the longest motion [s].

    The page interpolates linearly between keyframes, so the given times themselves are enough where they are sparse.
    """
    end = max(one.t[-1] for one in shown)
    given = [t for one in shown for t in one.times()]
    if end == 0.0:
        return np.zeros(1)
    frames = min(math.ceil(end * fps), MOST_FRAMES - 1)
    times = np.unique(np.concatenate([[0.0, end], *(t[t < end] for t in given)]))
    # Nodes of two motions can be equal up to rounding.
    times = times[np.diff(times, prepend=-np.inf) > 1e-9 * end]
    times[-1] = end
    return np.linspace(0.0, end, frames + 1) if frames < len(times) - 1 else times


def rows_at(times: Floats, t: Floats, rows: Floats) -> Floats:
    """Rows (N, n) at times ``t`` (N,), interpolated linearly at ``times`` (K,)."""
    return np.column_stack([np.interp(times, t, column) for column in rows.T])


def samples(rows: Floats) -> Floats:
    """Up to 50 of the rows, the first and the last among them."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, 50).astype(int))]
