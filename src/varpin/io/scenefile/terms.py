"""The terms of a cost in scene files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import scipy

from varpin.arrays import Floats
from varpin.control.costs import (
    CenterOfMassCost,
    ControlCost,
    ControlRateCost,
    Cost,
    FrameOrientationCost,
    FramePositionCost,
    FrameVelocityCost,
    JointLimitBarrier,
    ManipulabilityCost,
    TrackingCost,
    VelocityCost,
    VelocityLimitBarrier,
)
from varpin.io.scenefile.references import Timeline
from varpin.model import Robot

Space = Literal["q", "v", "u", "frame", "robot"]


@dataclass(frozen=True, eq=False)
class Given:
    """The values from which a term is built.

    Attributes:
        robot: The robot, without the joints that are left out.
        weight: One weight for each axis.
        target: Its reference, if it has one.
        frame: Name of its frame, if it has one.
        numbers: Its other keys with numbers.
        words: Its other keys with words.
    """

    robot: Robot
    weight: Floats
    target: Timeline | None
    frame: str
    numbers: Mapping[str, float]
    words: Mapping[str, str]

    @property
    def reference(self) -> Any:
        """The target as costs take it: a constant array, or a function of time."""
        if self.target is None:
            return 0.0
        return self.target(0.0) if self.target.constant else self.target

    @property
    def rotation(self) -> Any:
        """The target roll, pitch and yaw as a rotation matrix (3, 3), or as a function of time."""
        assert self.target is not None
        angles = self.target
        return _matrix(angles(0.0)) if angles.constant else _Turning(angles)


@dataclass(frozen=True, eq=False)
class _Turning:
    """Rotation matrices over time; a class, so that it can be pickled."""

    angles: Timeline

    def __call__(self, time: float) -> Floats:
        return _matrix(self.angles(time))


def _matrix(angles: Floats) -> Floats:
    """Rz(yaw) Ry(pitch) Rx(roll), as in a URDF."""
    return np.asarray(scipy.spatial.transform.Rotation.from_euler("xyz", angles).as_matrix())


@dataclass(frozen=True, eq=False)
class Term:
    """A kind of cost term.

    Attributes:
        make: Function that builds it.
        space: Its argument: q, v or u, whose components are joints; a frame; or the whole robot.
        reference: Key of its target, or None if it has none.
        components: Names of the target's components, if they are not joints.
        axes: Names of the components with weights of their own, if they are not joints; with one, the weight is a
            number.
        optional: Whether the target may be left out; it is then 0.
        holding: Whether ``hold`` may replace the reference by the torques that hold the robot at a configuration.
        initial: Whether the target is constant and concerns the first step alone; None if it is left out.
        can_end: Whether it can be a terminal term.
        numbers: Other keys with numbers >= 0, and their defaults, None for a required key.
        words: Other keys with words, and the allowed words, the default first.
        limits: Function that returns the robot's limits (n,), (n,) for a barrier; None for other terms.
    """

    make: Callable[[Given], Cost]
    space: Space
    reference: str | None = None
    components: tuple[str, ...] = ()
    axes: tuple[str, ...] = ()
    optional: bool = False
    holding: bool = False
    initial: bool = False
    can_end: bool = True
    numbers: Mapping[str, float | None] = field(default_factory=dict)
    words: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    limits: Callable[[Robot], tuple[Floats, Floats]] | None = None

    @property
    def frame(self) -> bool:
        """Whether it takes a frame."""
        return self.space == "frame"

    @property
    def of_joints(self) -> bool:
        """Whether its components are joints, or the controls of joints."""
        return self.space in ("q", "v", "u")


_XYZ = ("x", "y", "z")
_RPY = ("roll", "pitch", "yaw")
_TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")

TERMS: dict[str, Term] = {
    "tracking": Term(lambda g: TrackingCost(g.reference, g.weight), "q", "reference"),
    "velocity": Term(lambda g: VelocityCost(g.weight, g.reference), "v", "reference", optional=True),
    "control": Term(
        lambda g: ControlCost(g.weight, g.reference), "u", "reference", optional=True, holding=True, can_end=False
    ),
    "control_rate": Term(
        lambda g: ControlRateCost(g.weight, None if g.target is None else g.target(0.0)),
        "u",
        "before",
        holding=True,
        initial=True,
        can_end=False,
    ),
    "frame_position": Term(
        lambda g: FramePositionCost(g.robot, g.frame, g.reference, g.weight), "frame", "target", _XYZ, _XYZ
    ),
    "frame_orientation": Term(
        lambda g: FrameOrientationCost(g.robot, g.frame, g.rotation, g.weight), "frame", "target", _RPY, _XYZ
    ),
    "frame_velocity": Term(
        lambda g: FrameVelocityCost(g.robot, g.frame, g.reference, g.weight),
        "frame",
        "target",
        _TWIST,
        _TWIST,
        optional=True,
    ),
    "center_of_mass": Term(lambda g: CenterOfMassCost(g.robot, g.reference, g.weight), "robot", "target", _XYZ, _XYZ),
    "manipulability": Term(
        lambda g: ManipulabilityCost(g.robot, g.frame, g.numbers["least"], float(g.weight[0]), g.words["directions"]),
        "frame",
        axes=("weight",),
        numbers={"least": None},
        words={"directions": ("all", "linear", "angular")},
    ),
    "joint_limits": Term(
        lambda g: JointLimitBarrier(g.robot, g.weight, g.numbers["margin"]),
        "q",
        numbers={"margin": 0.0},
        limits=lambda robot: robot.position_limits,
    ),
    "velocity_limits": Term(
        lambda g: VelocityLimitBarrier(g.robot, g.weight, g.numbers["margin"]),
        "v",
        numbers={"margin": 0.0},
        limits=lambda robot: (-robot.velocity_limit, robot.velocity_limit),
    ),
}
