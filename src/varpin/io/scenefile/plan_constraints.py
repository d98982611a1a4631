"""The hard constraints of a plan in scene files."""

from __future__ import annotations

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

Given = Mapping[str, Any]
Rules = Mapping[str, Rule]


@dataclass(frozen=True, eq=False)
class PlanTable:
    """[[plan_constraint]].

    Attributes:
        kind: Its type in the file.
        given: Its keys.
        make: Function of the robot and the keys that builds it.
    """

    kind: str
    given: Given
    make: Callable[[Robot, Given], PlanConstraint]


def _limits(given: Given) -> Any:
    """(lower, upper), infinite where one is left out; None where both are."""
    lower, upper = (given.get(side) for side in ("lower", "upper"))
    if lower is None and upper is None:
        return None
    return -np.inf if lower is None else _plain(lower), np.inf if upper is None else _plain(upper)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _goal(robot: Robot, given: Given) -> PlanConstraint:
    rotation = None
    if "rotation" in given:
        rotation = scipy.spatial.transform.Rotation.from_euler("xyz", given["rotation"]).as_matrix()
    return ReachFrame(robot, given["frame"], given.get("position"), rotation)


def _clear(robot: Robot, given: Given) -> PlanConstraint:
    own = dict(given)
    shapes = {key: enumerate(own.pop(key, ())) for key in ("spheres", "capsules", "boxes", "hulls")}
    obstacles = [Obstacle.sphere(x[:3], x[3], f"sphere[{k}]") for k, x in shapes["spheres"]]
    obstacles += [Obstacle.capsule(x[:3], x[3:6], x[6], f"capsule[{k}]") for k, x in shapes["capsules"]]
    obstacles += [Obstacle.box(x[:3], x[3:], name=f"box[{k}]") for k, x in shapes["boxes"]]
    for k, x in shapes["hulls"]:
        obstacles.append((Obstacle.mesh if isinstance(x, Path) else Obstacle.convex)(x, name=f"hull[{k}]"))
    if "links" in own:
        own["links"] = list(own["links"])
    return KeepClear(robot, obstacles, own.pop("distance", 0.0), **own)


def _on_frame(kind: Callable[..., PlanConstraint]) -> Callable[[Robot, Given], PlanConstraint]:
    return lambda robot, given: kind(robot, **given)


def _within(kind: Callable[..., PlanConstraint]) -> Callable[[Robot, Given], PlanConstraint]:
    return lambda robot, given: kind(robot, _limits(given), margin=given.get("margin", 0.0))


def _rule(kind: str, make: Callable[[Robot, Given], PlanConstraint], needed: Rules, others: Rules) -> Rule:
    rules = {key: (rule, True) for key, rule in needed.items()} | {key: (rule, False) for key, rule in others.items()}
    return checked(keys(rules), lambda given, _: PlanTable(kind, given, make))


def _rows(length: int) -> Rule:
    return entries(entries(number("m"), length))


_HULL = either(
    "a list of points, each of 3 numbers [m], or the path of a mesh file in metres", list=_rows(3), text=FILE
)
_THREE = entries(number("m"), 3)
_MARGIN = {"margin": number(least=0.0)}
_SIDES = {"lower": values("rad or m"), "upper": values("rad or m")}
_SPEEDS = {"lower": values("rad/s or m/s"), "upper": values("rad/s or m/s")}
_FRAME = {"frame": TEXT}
_SPHERE = _FRAME | {"center": _THREE, "radius": number("m", above=0.0)}
_CLEARANCE = {
    "distance": number("m"),
    "spheres": _rows(4),
    "capsules": _rows(7),
    "boxes": _rows(6),
    "hulls": entries(_HULL),
    "links": entries(TEXT),
    "itself": FLAG,
    "srdf": FILE,
}
_KINDS: tuple[tuple[str, Callable[[Robot, Given], PlanConstraint], Rules, Rules], ...] = (
    ("joint_limits", _within(WithinJointLimits), {}, _SIDES | _MARGIN),
    ("velocity_limits", _within(WithinVelocityLimits), {}, _SPEEDS | _MARGIN),
    (
        "control_rate",
        lambda _, given: WithinControlRate(**{key: _plain(value) for key, value in given.items()}),
        {"limit": values("control/s", least=0.0)},
        {"before": values()},
    ),
    ("reach_frame", _goal, _FRAME, {"position": _THREE, "rotation": entries(number("rad"), 3)}),
    (
        "half_space",
        _on_frame(KeepInHalfSpace),
        _FRAME | {"normal": entries(number(), 3), "offset": number("m")},
        _MARGIN,
    ),
    ("box", _on_frame(KeepInBox), _FRAME | {"lower": _THREE, "upper": _THREE}, _MARGIN),
    ("inside_sphere", _on_frame(KeepInSphere), _SPHERE, _MARGIN),
    ("outside_sphere", _on_frame(KeepOutOfSphere), _SPHERE, _MARGIN),
    ("clearance", _clear, {}, _CLEARANCE | _MARGIN),
)
PLAN_CONSTRAINTS: Mapping[str, Rule] = {kind[0]: _rule(*kind) for kind in _KINDS}
