"""Integrators by name, and from the text that a trajectory stores; whether a motion is of a scene."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import fields
from types import MappingProxyType
from typing import Any

from varpin.errors import InputError
from varpin.integrators.base import Integrator
from varpin.integrators.collocation import Gauss, Midpoint, Radau
from varpin.integrators.explicit import ExplicitEuler, RungeKutta4, SemiImplicitEuler
from varpin.integrators.reference import Reference
from varpin.integrators.variational import Guard
from varpin.mechanics.scene import Scene
from varpin.mechanics.values import differences, same
from varpin.trajectory import Trajectory, require_trajectory

_OWN: tuple[type[Integrator], ...] = (Midpoint, Gauss, Radau, ExplicitEuler, SemiImplicitEuler, RungeKutta4, Reference)
# Integrators by class name. A new integrator is added to the tuple above.
BY_NAME: Mapping[str, type[Integrator]] = MappingProxyType({kind.__name__: kind for kind in _OWN})


def integrator_of(text: str) -> Integrator:
    """The integrator of a text with its name and options, as ``str`` and ``repr`` of an integrator write it.

        integrator_of("RungeKutta4")
        integrator_of("Gauss(3)")
        integrator_of('Midpoint(alpha=0.5, kick="split")')
        integrator_of("Midpoint(kick=split)")

    Raises:
        InputError: The text has another form, the integrator or an option is unknown, or a value is out of its range.
    """
    form = "a name, or a name with options such as Gauss(stages=3)"
    try:
        node = ast.parse(text.strip(), mode="eval").body
        match node:
            case ast.Name(id=name):
                values, named = [], {}
            case ast.Call(func=ast.Name(id=name), args=args, keywords=keywords):
                values = [_value(argument) for argument in args]
                named = {str(keyword.arg): _value(keyword.value) for keyword in keywords}
            case _:
                raise InputError(f"an integrator is written as {form}, got {text!r}")
    except (SyntaxError, RecursionError, MemoryError):
        raise InputError(f"an integrator is written as {form}, got {text!r}") from None
    if name not in BY_NAME:
        raise InputError(f"varpin has no integrator {name!r}; it has {', '.join(BY_NAME)}")
    made: Integrator = _made(BY_NAME[name], values, named, text)
    return made


def _made(kind: type[Any], values: list[Any], named: dict[str, Any], text: str) -> Any:
    """The object of a class with options."""
    try:
        return kind(*values, **named)
    except TypeError:
        known = ", ".join(item.name for item in fields(kind)) or "none"
        given = ", ".join([*map(repr, values), *map(repr, named)])
        raise InputError(f"options of {kind.__name__} are {known}, not {given}: {text!r}") from None


def _value(node: ast.expr) -> Any:
    """The value of an option: a number, None, a word with or without quotes, or a guard."""
    match node:
        case ast.Name(id=name):
            return name
        case ast.Call(func=ast.Name(id="Guard"), args=[], keywords=keywords):
            given = {str(keyword.arg): _value(keyword.value) for keyword in keywords}
            return _made(Guard, [], given, ast.unparse(node))
    try:
        return ast.literal_eval(node)
    except ValueError:
        raise InputError(f"options of an integrator are numbers and words, got {ast.unparse(node)!r}") from None


def require_motion(scene: Scene, trajectory: Trajectory) -> None:
    """Refuse anything but a trajectory of a scene's robot with the scene's number of controls."""
    require_trajectory(trajectory)
    if trajectory.joint_names != scene.robot.joint_names:
        raise InputError(
            f"the trajectory is of joints {', '.join(trajectory.joint_names)}; "
            f"the scene's robot has {', '.join(scene.robot.joint_names)}"
        )
    if trajectory.u.shape[1] != scene.controls:
        raise InputError(f"the trajectory has {trajectory.u.shape[1]} controls, the scene {scene.controls}")


def require_scene_of(scene: Scene, trajectory: Trajectory) -> None:
    """Refuse a motion of a scene with other numbers, as far as the motion has them; of noise if it has increments."""
    found = differences(scene, trajectory.scene_values, noise=bool(trajectory.dw.any()))
    if not same(trajectory.masses, scene.robot.tree.mass):
        found.insert(0, "the robot's masses")
    if found:
        more = f" and {len(found) - 2} more" if len(found) > 2 else ""
        raise InputError(
            f"the trajectory was made in another scene than the one given, which differs in {', '.join(found[:2])}"
            f"{more}. Give the scene that made it, or simulate again in this one"
        )
