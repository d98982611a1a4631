"""Arguments that several commands share: a robot, its motion, a scene file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.integrators import BY_NAME, Integrator, integrator_of
from varpin.io.scenefile import SceneFile, load_scene, scenes
from varpin.mechanics.scene import Scene
from varpin.model import load_robot
from varpin.support.checks import JointValues, joint_array


def add_robot(parser: argparse.ArgumentParser, *, scenes: bool = False) -> None:
    """Add the robot and the options with which it is loaded."""
    text = "path of a robot's file, or name of a robot" + ("; or a scene file, or name of a scene" if scenes else "")
    parser.add_argument("robot", metavar="ROBOT", help=text)
    add_robot_options(parser)


# Options that a scene file takes the place of.
_OF_SCENES = (
    *("lock", "package_dir", "xacro_args", "dt", "tolerance", "duration", "steps", "integrator", "q", "v"),
    *("q0", "v0", "gravity", "damping", "friction", "stiffness", "rest", "torque"),
)


def add_robot_options(parser: argparse.ArgumentParser) -> None:
    """Add the options with which the robot is loaded; a scene file has more."""
    text = "lock joints at positions [rad or m]"
    parser.add_argument("--lock", nargs="+", action="extend", metavar="JOINT=VALUE", help=text)
    text = "folder in which package:// paths of meshes are looked up; repeatable"
    parser.add_argument("--package-dir", action="append", metavar="DIR", help=text)
    text = "arguments of a xacro file"
    parser.add_argument("--xacro-args", nargs="+", action="extend", metavar="NAME=VALUE", help=text)


def robot_options(request: argparse.Namespace) -> dict[str, Any]:
    """The options of :func:`add_robot_options` as arguments of :func:`varpin.load_robot`."""
    lock = values_of("lock", request.lock)
    if not isinstance(lock, dict | None):
        raise InputError(f"--lock takes JOINT=VALUE, for example elbow=0.5, got {' '.join(request.lock)}")
    pairs = [word.partition("=") for word in request.xacro_args or ()]
    if not all(equals for _, equals, _ in pairs):
        raise InputError(f"--xacro-args takes NAME=VALUE, for example dof=7, got {' '.join(request.xacro_args)}")
    arguments = {name: value for name, _, value in pairs}
    return {"package_dirs": request.package_dir, "lock": lock or {}, "xacro_args": arguments or None}


def add_motion(parser: argparse.ArgumentParser) -> None:
    """Add the initial state of a motion, and the commonest forces on it; a scene file has all."""
    start = parser.add_argument_group("start")
    text = "initial configuration [rad or m], or the name of a posture of the robot's SRDF file (home); default: 0"
    add_vector(start, "q0", text)
    add_vector(start, "v0", "initial velocity [rad/s or m/s]; default: 0")
    surroundings = parser.add_argument_group("surroundings")
    add_gravity(surroundings)
    add_losses(surroundings)
    add_vector(surroundings, "stiffness", "joint springs [N m/rad or N/m]; default: 0")
    add_vector(surroundings, "rest", "rest positions of the springs [rad or m]; default: 0")
    add_vector(surroundings, "torque", "constant generalized forces [N m or N]; default: 0")


def add_losses(group: argparse._ActionsContainer) -> None:
    """Add what damps joints."""
    for name, text in (("damping", "viscous damping [N m s/rad or N s/m]"), ("friction", "dry friction [N m or N]")):
        add_vector(group, name, f"{text}, or 'robot' for that of the robot's description; default: 0")


def add_vector(group: argparse._ActionsContainer, name: str, text: str) -> None:
    """Add an option: one number for all joints, one for each, some by name, or a word."""
    group.add_argument(f"--{name}", nargs="+", metavar="X", help=text)


# The integrator of a motion for which none is named.
_CHOSEN = (
    "Gauss(stages=2), with 4 where springs are fast for the step, Radau(stages=4) where dampers are faster, "
    "Midpoint(kick=held) under noise"
)


def add_integrator(parser: argparse.ArgumentParser, default: str = _CHOSEN) -> None:
    """Add the choice of the integrator."""
    text = f"{', '.join(BY_NAME)}; with options as Python writes them, 'Gauss(stages=3)'; default: {default}"
    parser.add_argument("--integrator", metavar="NAME", help=text)


def integrator_of_words(text: str | None) -> Integrator | None:
    """The integrator of a word of :func:`add_integrator`."""
    if text is None:
        return None
    name, bracket, rest = text.strip().partition("(")
    # runge_kutta_4 and RUNGEKUTTA4 are RungeKutta4.
    plain = {member.lower(): member for member in BY_NAME}
    return integrator_of(plain.get(name.replace("_", "").lower(), name) + bracket + rest)


def add_gravity(group: argparse._ActionsContainer) -> None:
    """Add gravity as a vector, or none."""
    gravity = group.add_mutually_exclusive_group()
    text = "in world axes [m/s^2]; default: the robot's, 0 0 -9.81"
    gravity.add_argument("--gravity", type=float, nargs=3, metavar=("X", "Y", "Z"), default=True, help=text)
    gravity.add_argument("--no-gravity", dest="gravity", action="store_false", help="none")


def values_of(option: str, words: Sequence[str] | None) -> JointValues | str | None:
    """The words of an option: None, one number, several, some by name, or one word, which begins with a letter."""
    if words is None:
        return None
    if len(words) == 1 and "=" not in words[0] and words[0].strip()[:1].isalpha():
        return words[0].strip()
    pairs = [word.strip().rpartition("=") for word in words]
    names = {name if equals else None for name, equals, _ in pairs}
    try:
        numbers = [float(number) for *_, number in pairs]
        if names != {None} and (names & {None, ""} or len(names) < len(numbers)):
            raise ValueError
    except ValueError:
        allowed = "numbers, JOINT=VALUE once for each of some joints, or one word"
        raise InputError(f"--{option} takes {allowed}; got {' '.join(words)}") from None
    if names != {None}:
        return {name: number for (name, *_), number in zip(pairs, numbers, strict=True)}
    return numbers[0] if len(numbers) == 1 else numbers


def motion_of(request: argparse.Namespace) -> tuple[Scene, ArrayLike, ArrayLike, Floats | None]:
    """The scene, q0, v0, and the torque unless it is zero."""
    robot = load_robot(request.robot, **robot_options(request))
    given: dict[str, Any] = {}
    for name in ("damping", "friction", "stiffness", "rest", "q0", "v0", "torque"):
        values = values_of(name, getattr(request, name))
        if isinstance(values, str):
            given[name] = robot.posture(values) if name == "q0" else values
        elif values is not None:
            given[name] = joint_array(f"--{name}", values, robot.joint_names, uniform=True)
    q0, v0, torque = (given.pop(name, np.zeros(robot.dof)) for name in ("q0", "v0", "torque"))
    return Scene(robot, gravity=request.gravity, **given), q0, v0, torque if np.any(torque) else None


def names_scene(word: str) -> bool:
    """Whether a word names a scene file and not a robot."""
    return Path(word).suffix == ".toml" or word in scenes()


def scene_file(request: argparse.Namespace, word: str) -> SceneFile:
    """Load a scene file, which has what other options would say."""
    for name in _OF_SCENES:
        given = getattr(request, name, None)
        if given is not None and given is not True:
            option = "no-gravity" if given is False else name.replace("_", "-")
            raise InputError(f"--{option} cannot be given with a scene file: {word} has it")
    return load_scene(word)


def take_outputs(request: argparse.Namespace, file: SceneFile) -> None:
    """Outputs of a scene file replace those that the command line does not set."""
    for name, value in file.outputs.items():
        if getattr(request, name, value) is None:
            setattr(request, name, value)
