"""The hard constraints of a plan in scene files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

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
from varpin.io.scenefile.keys import FLAG, TEXT, Rule, checked, either, existing_file, number, numbers, values
from varpin.model import Robot
from varpin.model.clearance import Obstacle

Given = Mapping[str, Any]


@dataclass(frozen=True)
class Kind:
    """A kind of constraint.

    Attributes:
        make: Function that builds it for a robot.
        rules: Its keys, each with its rule and its default, ``...`` for a required key.
    """

    make: Callable[[Robot, Given], PlanConstraint]
    rules: Mapping[str, tuple[Rule, Any]]


def _limits(given: Given) -> Any:
    """(lower, upper), infinite where one is left out; None where both are."""
    lower, upper = (given[side] for side in ("lower", "upper"))
    if lower is None and upper is None:
        return None
    return -np.inf if lower is None else _plain(lower), np.inf if upper is None else _plain(upper)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _goal(robot: Robot, given: Given) -> PlanConstraint:
    rotation = None
    if given["rotation"] is not None:
        rotation = scipy.spatial.transform.Rotation.from_euler("xyz", given["rotation"]).as_matrix()
    return ReachFrame(robot, given["frame"], given["position"], rotation)


def _clear(robot: Robot, given: Given) -> PlanConstraint:
    obstacles = [Obstacle.sphere(x[:3], x[3], f"sphere[{k}]") for k, x in enumerate(given["spheres"])]
    obstacles += [Obstacle.capsule(x[:3], x[3:6], x[6], f"capsule[{k}]") for k, x in enumerate(given["capsules"])]
    obstacles += [Obstacle.box(x[:3], x[3:], name=f"box[{k}]") for k, x in enumerate(given["boxes"])]
    for k, x in enumerate(given["hulls"]):
        of = Obstacle.mesh if isinstance(x, Path) else Obstacle.convex
        obstacles.append(of(x, name=f"hull[{k}]"))
    links = None if given["links"] is None else list(given["links"])
    return KeepClear(
        robot,
        obstacles,
        given["distance"],
        links=links,
        itself=given["itself"],
        srdf=given["srdf"],
        margin=given["margin"],
    )


def _rows(length: int) -> Rule:
    one = Annotated[tuple[float, ...], numbers(length, "m")]
    return Rule(tuple[one, ...], f"a list of lists of {length} numbers [m]", parts=True)


_HULL = either(
    "a list of points, each of 3 numbers [m], or the path of a mesh file in metres",
    list=Annotated[tuple[float, ...], _rows(3)],
    text=Annotated[Path, checked(TEXT, existing_file)],
)
_HULLS = Rule(tuple[Annotated[Any, _HULL], ...], "a list of hulls", parts=True)
_MARGIN = {"margin": (number(least=0.0), 0.0)}
_FRAME = {"frame": (TEXT, ...)}
_SPHERE = _FRAME | {"center": (numbers(3, "m"), ...), "radius": (number("m", above=0.0), ...)} | _MARGIN


def _within(unit: str) -> dict[str, tuple[Rule, Any]]:
    return {"lower": (values(unit), None), "upper": (values(unit), None)} | _MARGIN


PLAN_CONSTRAINTS: dict[str, Kind] = {
    "joint_limits": Kind(
        lambda robot, g: WithinJointLimits(robot, _limits(g), margin=g["margin"]), _within("rad or m")
    ),
    "velocity_limits": Kind(
        lambda robot, g: WithinVelocityLimits(robot, _limits(g), margin=g["margin"]), _within("rad/s or m/s")
    ),
    "control_rate": Kind(
        lambda _, g: WithinControlRate(_plain(g["limit"]), _plain(g["before"])),
        {"limit": (values("control/s", least=0.0), ...), "before": (values(), None)},
    ),
    "reach_frame": Kind(_goal, _FRAME | {"position": (numbers(3, "m"), None), "rotation": (numbers(3, "rad"), None)}),
    "half_space": Kind(
        lambda robot, g: KeepInHalfSpace(robot, g["frame"], g["normal"], g["offset"], margin=g["margin"]),
        _FRAME | {"normal": (numbers(3), ...), "offset": (number("m"), ...)} | _MARGIN,
    ),
    "box": Kind(
        lambda robot, g: KeepInBox(robot, g["frame"], g["lower"], g["upper"], margin=g["margin"]),
        _FRAME | {"lower": (numbers(3, "m"), ...), "upper": (numbers(3, "m"), ...)} | _MARGIN,
    ),
    "inside_sphere": Kind(
        lambda robot, g: KeepInSphere(robot, g["frame"], g["center"], g["radius"], margin=g["margin"]), _SPHERE
    ),
    "outside_sphere": Kind(
        lambda robot, g: KeepOutOfSphere(robot, g["frame"], g["center"], g["radius"], margin=g["margin"]), _SPHERE
    ),
    "clearance": Kind(
        _clear,
        {
            "distance": (number("m"), 0.0),
            "spheres": (_rows(4), ()),
            "capsules": (_rows(7), ()),
            "boxes": (_rows(6), ()),
            "hulls": (_HULLS, ()),
            "links": (Rule(tuple[Annotated[str, TEXT], ...], "a list of texts", parts=True), None),
            "itself": (FLAG, False),
            "srdf": (checked(TEXT, existing_file), None),
        }
        | _MARGIN,
    ),
}
