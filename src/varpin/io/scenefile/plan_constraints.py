"""The hard constraints of a plan in scene files: their keys are the arguments of the API's constraints."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from varpin.control.constraints import (
    KeepClear,
    KeepInBox,
    KeepInHalfSpace,
    KeepInSphere,
    KeepOutOfSphere,
    PlanConstraint,
    ReachFrame,
    WithinControlRate,
    WithinJointLimits,
    WithinVelocityLimits,
)
from varpin.io.scenefile.reading import FILE, FLAG, TEXT, Rule, checked, either, entries, keys, number, values
from varpin.model import Robot
from varpin.model.clearance import Obstacle

KINDS: Mapping[str, Callable[..., PlanConstraint]] = {
    "joint_limits": WithinJointLimits,
    "velocity_limits": WithinVelocityLimits,
    "control_rate": WithinControlRate,
    "reach_frame": ReachFrame,
    "half_space": KeepInHalfSpace,
    "box": KeepInBox,
    "inside_sphere": KeepInSphere,
    "outside_sphere": KeepOutOfSphere,
    "clearance": KeepClear,
}


def _rows(length: int) -> Rule:
    return entries(entries(number("m"), length))


_THREE = entries(number("m"), 3)
_HULL = either(
    "a list of points, each of 3 numbers [m], or the path of a mesh file in metres", list=_rows(3), text=FILE
)
# Rules of arguments; others are no keys.
_RULES = {
    "frame": TEXT,
    "position": _THREE,
    "rotation": entries(number("rad"), 3),
    "normal": entries(number(), 3),
    "offset": number("m"),
    "lower": _THREE,
    "upper": _THREE,
    "center": _THREE,
    "radius": number("m", above=0.0),
    "limit": values("control/s", least=0.0),
    "before": values(),
    "distance": number("m"),
    "links": entries(TEXT),
    "itself": FLAG,
    "srdf": FILE,
    "margin": number(least=0.0),
}
# What is written in place of an argument.
_INSTEAD = {
    "limits": {"lower": values("rad or m, or per s"), "upper": values("rad or m, or per s")},
    "obstacles": {"spheres": _rows(4), "capsules": _rows(7), "boxes": _rows(6), "hulls": entries(_HULL)},
}


@dataclass(frozen=True, eq=False)
class PlanTable:
    """[[plan_constraint]].

    Attributes:
        kind: Its type in the file.
        given: Its keys.
    """

    kind: str
    given: Mapping[str, Any]

    def make(self, robot: Robot) -> PlanConstraint:
        """The constraint of a robot."""
        own = {name: list(value) if type(value) is tuple else value for name, value in self.given.items()}
        arguments = inspect.signature(KINDS[self.kind]).parameters
        if "limits" in arguments and not own.keys().isdisjoint(("lower", "upper")):
            own["limits"] = own.pop("lower", -np.inf), own.pop("upper", np.inf)
        if "rotation" in own:
            own["rotation"] = scipy.spatial.transform.Rotation.from_euler("xyz", own["rotation"]).as_matrix()
        if "obstacles" in arguments:
            own["obstacles"] = _obstacles(*(own.pop(name, ()) for name in _INSTEAD["obstacles"]))
        if "robot" in arguments:
            own["robot"] = robot
        return KINDS[self.kind](**own)


def _obstacles(spheres: Any, capsules: Any, boxes: Any, hulls: Any) -> list[Obstacle]:
    found = [Obstacle.sphere(x[:3], x[3], f"sphere[{k}]") for k, x in enumerate(spheres)]
    found += [Obstacle.capsule(x[:3], x[3:6], x[6], f"capsule[{k}]") for k, x in enumerate(capsules)]
    found += [Obstacle.box(x[:3], x[3:], name=f"box[{k}]") for k, x in enumerate(boxes)]
    for k, x in enumerate(hulls):
        found.append((Obstacle.mesh if isinstance(x, Path) else Obstacle.convex)(x, name=f"hull[{k}]"))
    return found


def _rule(kind: str) -> Rule:
    rules: dict[str, tuple[Rule, bool]] = {}
    for name, item in inspect.signature(KINDS[kind]).parameters.items():
        rules |= {key: (rule, False) for key, rule in _INSTEAD.get(name, {}).items()}
        if name in _RULES:
            rules[name] = _RULES[name], item.default is item.empty
    return checked(keys(rules), lambda given, _: PlanTable(kind, given))


PLAN_CONSTRAINTS: Mapping[str, Rule] = {kind: _rule(kind) for kind in KINDS}
