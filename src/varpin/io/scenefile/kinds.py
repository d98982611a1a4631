"""The types of tables in scene files: classes of the API by a word each."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Mapping
from typing import Any

from varpin.control import constraints as plan
from varpin.control import costs
from varpin.control.costs import Cost
from varpin.integrators import BY_NAME, Gauss, Integrator
from varpin.mechanics import constraints, forces
from varpin.mechanics.constraints import Constraint, CustomConstraint
from varpin.mechanics.forces import Force
from varpin.mechanics.noise import AdditiveNoise, ControlNoise, Noise, StateNoise
from varpin.model.clearance import Obstacle
from varpin.simulation.choice import STAGES


def _word_of(name: str) -> str:
    """The name of a class in scene files: point_on_line for PointOnLine, runge_kutta_4 for RungeKutta4."""
    return re.sub(r"(?<!^)([A-Z0-9])", r"_\1", name).lower()


FORCES: Mapping[str, type[Force]] = {
    "armature": forces.Armature,
    "damper": forces.JointDamper,
    "friction": forces.CoulombFriction,
    "servo": forces.PositionServo,
    "spring": forces.JointSpring,
    "stop": forces.JointStop,
    "frame_damper": forces.FrameDamper,
    "frame_spring": forces.FrameSpring,
    "frame_wrench": forces.FrameWrench,
}
# All constraints without a function; "robot" stands for those of the robot's description.
CONSTRAINTS: Mapping[str, Any] = {
    _word_of(name): kind
    for name, kind in sorted(vars(constraints).items())
    if isinstance(kind, type) and issubclass(kind, Constraint) and kind not in (Constraint, CustomConstraint)
} | {"robot": lambda: "robot"}
INTEGRATORS: Mapping[str, Callable[..., Integrator]] = {
    _word_of(name): kind for name, kind in BY_NAME.items() if name != "Reference"
} | {"gauss": functools.partial(Gauss, stages=STAGES)}
NOISE: Mapping[str, Callable[..., Noise]] = {"additive": AdditiveNoise, "control": ControlNoise, "state": StateNoise}
PLAN_CONSTRAINTS: Mapping[str, Callable[..., plan.PlanConstraint]] = {
    "joint_limits": plan.WithinJointLimits,
    "velocity_limits": plan.WithinVelocityLimits,
    "control_rate": plan.WithinControlRate,
    "reach_frame": plan.ReachFrame,
    "half_space": plan.KeepInHalfSpace,
    "box": plan.KeepInBox,
    "inside_sphere": plan.KeepInSphere,
    "outside_sphere": plan.KeepOutOfSphere,
    "clearance": plan.KeepClear,
}
OBSTACLES: Mapping[str, Callable[..., Obstacle]] = {
    name: getattr(Obstacle, name) for name in ("sphere", "capsule", "box", "convex", "mesh")
}
COSTS: Mapping[str, type[Cost]] = {
    "tracking": costs.TrackingCost,
    "velocity": costs.VelocityCost,
    "control": costs.ControlCost,
    "control_rate": costs.ControlRateCost,
    "frame_position": costs.FramePositionCost,
    "frame_orientation": costs.FrameOrientationCost,
    "frame_velocity": costs.FrameVelocityCost,
    "center_of_mass": costs.CenterOfMassCost,
    "manipulability": costs.ManipulabilityCost,
    "joint_limits": costs.JointLimitBarrier,
    "velocity_limits": costs.VelocityLimitBarrier,
}
COST_WORDS = {kind: word for word, kind in COSTS.items()}
# Costs whose components are joints, or controls; and names of the components of others: weights, and targets.
OF_JOINTS = ("tracking", "velocity", "joint_limits", "velocity_limits")
OF_CONTROLS = ("control", "control_rate")
AXES: Mapping[str, tuple[str, ...]] = {
    "frame_position": ("x", "y", "z"),
    "frame_orientation": ("x", "y", "z"),
    "frame_velocity": ("vx", "vy", "vz", "wx", "wy", "wz"),
    "center_of_mass": ("x", "y", "z"),
}
ANGLES = ("roll", "pitch", "yaw")


def target_key(kind: str) -> str:
    """The key of the target of a cost; empty if it has none."""
    arguments = inspect.signature(COSTS[kind]).parameters
    return next((key for key in ("reference", "target", "before") if key in arguments), "")


def cost_keys(kind: str) -> dict[str, bool]:
    """The keys of a cost beside its type, and whether it needs them: the arguments of its class, and when it holds."""
    arguments = inspect.signature(COSTS[kind]).parameters
    needed = {name: item.default is item.empty for name, item in arguments.items() if name not in ("robot", "limits")}
    return needed | {"hold" if kind in OF_CONTROLS else "terminal": False}
