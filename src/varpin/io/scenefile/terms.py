"""The terms of a cost in scene files: their keys are the arguments of the API's costs."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
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
from varpin.io.scenefile.reading import FLAG, TEXT, TRUE, Rule, Where, checked, keys, number, values, word
from varpin.io.scenefile.references import Timeline, reference
from varpin.model import Robot

_XYZ = ("x", "y", "z")
_TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")


@dataclass(frozen=True, eq=False)
class Term:
    """A kind of cost term.

    Attributes:
        kind: The cost.
        space: Its argument: q, v or u, whose components are joints; a frame; or the whole robot.
        components: Names of the target's components, if they are not joints.
        axes: Names of the components with weights of their own, if they are not joints; empty for one weight.
        limits: Function that returns the robot's limits (n,), (n,) for a barrier; None for other terms.
    """

    kind: Callable[..., Cost]
    space: Literal["q", "v", "u", "frame", "robot"]
    components: tuple[str, ...] = ()
    axes: tuple[str, ...] = _XYZ
    limits: Callable[[Robot], tuple[Floats, Floats]] | None = None

    @property
    def of_joints(self) -> bool:
        """Whether its components are joints, or the controls of joints."""
        return self.space in ("q", "v", "u")

    @property
    def target(self) -> str:
        """The key of its target; empty if it has none."""
        return next((key for key in ("reference", "target", "before") if key in self.arguments), "")

    @property
    def arguments(self) -> Mapping[str, inspect.Parameter]:
        """The arguments of the cost that are keys, and the robot."""
        return {name: item for name, item in inspect.signature(self.kind).parameters.items() if name != "limits"}

    def make(self, robot: Robot, weight: Floats, target: Timeline | None, given: Mapping[str, Any]) -> Cost:
        """The cost of these weights and this target, and of other keys."""
        own = {name: value for name, value in given.items() if name in self.arguments}
        own["weight"] = weight if self.of_joints or self.axes else float(weight[0])
        if "robot" in self.arguments:
            own["robot"] = robot
        if target is not None and self.kind is FrameOrientationCost:
            own["target"] = _matrix(target(0.0)) if target.constant else _Turning(target)
        elif self.target:
            own[self.target] = None if target is None else target(0.0) if target.constant else target
        return self.kind(**own)


@dataclass(frozen=True, eq=False)
class _Turning:
    """Rotation matrices over time; a class, so that it can be pickled."""

    angles: Timeline

    def __call__(self, time: float) -> Floats:
        return _matrix(self.angles(time))


def _matrix(angles: Floats) -> Floats:
    """Rz(yaw) Ry(pitch) Rx(roll), as in a URDF."""
    return np.asarray(scipy.spatial.transform.Rotation.from_euler("xyz", angles).as_matrix())


TERMS: Mapping[str, Term] = {
    "tracking": Term(TrackingCost, "q"),
    "velocity": Term(VelocityCost, "v"),
    "control": Term(ControlCost, "u"),
    "control_rate": Term(ControlRateCost, "u"),
    "frame_position": Term(FramePositionCost, "frame", _XYZ),
    "frame_orientation": Term(FrameOrientationCost, "frame", ("roll", "pitch", "yaw")),
    "frame_velocity": Term(FrameVelocityCost, "frame", _TWIST, _TWIST),
    "center_of_mass": Term(CenterOfMassCost, "robot", _XYZ),
    "manipulability": Term(ManipulabilityCost, "frame", axes=()),
    "joint_limits": Term(JointLimitBarrier, "q", limits=lambda robot: robot.position_limits),
    "velocity_limits": Term(
        VelocityLimitBarrier, "v", limits=lambda robot: (-robot.velocity_limit, robot.velocity_limit)
    ),
}


@dataclass(frozen=True, eq=False)
class CostTable:
    """[[cost]].

    Attributes:
        kind: Its type in the file.
        given: Its keys.
    """

    kind: str
    given: Mapping[str, Any]

    @property
    def term(self) -> Term:
        """The kind of term."""
        return TERMS[self.kind]

    @property
    def terminal(self) -> bool:
        """Whether it is a terminal cost instead of an integral over time."""
        return bool(self.given.get("terminal", False))

    @property
    def frame(self) -> str:
        """Name of its frame; empty for terms without one."""
        return str(self.given.get("frame", ""))


def cost_keys(kind: str) -> dict[str, tuple[Rule, bool]]:
    """The keys of a term: the arguments of its cost, and what they may be in a file."""
    term = TERMS[kind]
    postures = {"text": TEXT} if term.space == "q" else {}
    rules = {
        "frame": TEXT,
        "weight": values(least=0.0) if term.of_joints or term.axes else number(least=0.0),
        "reference": reference(**postures),
        "target": reference(),
        "before": values(),
        "directions": word("all", "linear", "angular"),
    }
    needed = {name: item.default is item.empty for name, item in term.arguments.items() if name != "robot"}
    found = {name: (rules.get(name, number(least=0.0)), must) for name, must in needed.items()}
    if term.space == "u":
        found["hold"] = values("rad or m", flag=TRUE, text=TEXT), False
    else:
        found["terminal"] = FLAG, False
    return found


def _cost_rule(kind: str) -> Rule:
    def made(given: Mapping[str, Any], where: Where) -> CostTable:
        target = TERMS[kind].target
        if "hold" in given and target in given:
            raise where.error(f"hold and {target} exclude each other: give one of them")
        return CostTable(kind, given)

    return checked(keys(cost_keys(kind)), made)


COST_RULES = {kind: _cost_rule(kind) for kind in TERMS}
