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
    try:
        node = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, RecursionError, MemoryError):
        node = None
    head = node.func if isinstance(node, ast.Call) else node
    found = _value(node) if node and isinstance(head, ast.Name) else None
    made = _made(found, [], {}) if isinstance(found, str) else found
    if not isinstance(made, Integrator):
        form = "a name, or a name with options such as Gauss(stages=3)"
        raise InputError(f"an integrator is written as {form}, got {text!r}")
    return made


def _value(node: ast.expr) -> Any:
    """The value of an expression: a number, None, a word with or without quotes, an integrator or a guard."""
    match node:
        case ast.Name(id=name):
            return name
        case ast.Call(func=ast.Name(id=name), args=args, keywords=keywords):
            return _made(name, list(map(_value, args)), {str(own.arg): _value(own.value) for own in keywords})
    try:
        return ast.literal_eval(node)
    except ValueError:
        raise InputError(f"options of an integrator are numbers and words, got {ast.unparse(node)!r}") from None


def _made(name: str, values: list[Any], named: dict[str, Any]) -> Any:
    """The object of a class by its name, with options."""
    kind: Any = Guard if name == Guard.__name__ else BY_NAME.get(name)
    if kind is None:
        raise InputError(f"varpin has no integrator {name!r}; it has {', '.join(BY_NAME)}")
    try:
        return kind(*values, **named)
    except TypeError:
        known = ", ".join(item.name for item in fields(kind)) or "none"
        given = ", ".join([*map(repr, values), *map(repr, named)])
        raise InputError(f"options of {name} are {known}, not {given}") from None


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
