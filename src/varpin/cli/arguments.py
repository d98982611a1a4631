"""Arguments that several commands share: a robot, its motion, a scene file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.integrators import BY_NAME, Integrator, integrator_of
from varpin.io.scenefile import SceneFile, load_scene, scenes
from varpin.mechanics.scene import Scene
from varpin.model import Robot, load_robot
from varpin.support.checks import JointValues, joint_array


def add_robot(parser: argparse.ArgumentParser, *, scenes: bool = False) -> None:
    """Add the robot and the options with which it is loaded."""
    parser.add_argument(
        "robot",
        metavar="ROBOT",
        help="path of a URDF file, or name of a robot of varpin or of example-robot-data"
        + ("; or a scene file (TOML), or name of a scene of varpin" if scenes else ""),
    )
    add_robot_options(parser)


# Options that :func:`add_robot_options` adds.
ROBOT_OPTIONS = ("lock", "package_dir")


def add_robot_options(parser: argparse.ArgumentParser) -> None:
    """Add the options with which the robot is loaded; a scene file has more."""
    parser.add_argument(
        "--lock",
        type=_lock,
        nargs="+",
        action="extend",
        default=[],
        metavar="JOINT=VALUE",
        help="lock joints at positions [rad or m]",
    )
    parser.add_argument(
        "--package-dir",
        action="append",
        metavar="DIR",
        help="folder in which package:// paths of meshes are looked up; repeatable",
    )


def robot_options(request: argparse.Namespace) -> dict[str, Any]:
    """The options of :func:`add_robot_options` as arguments of :func:`varpin.load_robot`."""
    return {"package_dirs": request.package_dir, "lock": dict(request.lock)}


def add_motion(parser: argparse.ArgumentParser) -> None:
    """Add the initial state of a motion, and the commonest forces on it; a scene file has all."""
    start = parser.add_argument_group("start")
    text = "initial configuration [rad or m], or the name of a posture of the robot's SRDF file (home); default: 0"
    add_vector(start, "q0", text)
    add_vector(start, "v0", "initial velocity [rad/s or m/s]; default: 0")
    surroundings = parser.add_argument_group("surroundings")
    add_gravity(surroundings)
    text = "viscous damping [N m s/rad or N s/m], or 'robot' for that of the robot's description; default: 0"
    add_vector(surroundings, "damping", text)
    add_vector(surroundings, "stiffness", "joint springs [N m/rad or N/m]; default: 0")
    add_vector(surroundings, "rest", "rest positions of the springs [rad or m]; default: 0")
    add_vector(surroundings, "torque", "constant generalized forces [N m or N]; default: 0")


def add_vector(group: argparse._ActionsContainer, name: str, text: str) -> None:
    """Add an option: one number for all joints, one for each, some by name, or a word."""
    group.add_argument(f"--{name}", type=_value, nargs="+", metavar="X", help=text)


def add_integrator(parser: argparse.ArgumentParser) -> None:
    """Add the choice of the integrator."""
    parser.add_argument(
        "--integrator",
        metavar="NAME",
        help=f"{', '.join(BY_NAME)}; with options as Python writes them, 'Gauss(stages=3)'; default: Gauss(stages=2), "
        "with 4 where springs are fast for the step, Radau(stages=4) where dampers are faster, "
        "Midpoint(kick=held) under noise",
    )


def integrator_of_words(text: str) -> Integrator:
    """The integrator of a word of :func:`add_integrator`."""
    name, bracket, rest = text.strip().partition("(")
    # runge_kutta_4 and RUNGEKUTTA4 are RungeKutta4.
    plain = {member.lower(): member for member in BY_NAME}
    return integrator_of(plain.get(name.replace("_", "").lower(), name) + bracket + rest)


def add_gravity(group: argparse._ActionsContainer) -> None:
    """Add gravity as a vector, or none."""
    gravity = group.add_mutually_exclusive_group()
    gravity.add_argument(
        "--gravity",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        default=True,
        help="in world axes [m/s^2]; default: the robot's, 0 0 -9.81",
    )
    gravity.add_argument("--no-gravity", dest="gravity", action="store_false", help="none")


def _lock(word: str) -> tuple[str, ArrayLike]:
    name, equals, value = word.strip().rpartition("=")
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError:
        numbers = []
    if not (equals and name and numbers):
        raise argparse.ArgumentTypeError(f"{word!r} is not of the form JOINT=VALUE, for example elbow=0.5")
    return name, numbers[0] if len(numbers) == 1 else numbers


def _value(word: str) -> float | tuple[str, float] | str:
    """A number, a joint and its number, or a word, which begins with a letter."""
    text = word.strip()
    name, equals, value = text.rpartition("=")
    if text[:1].isalpha() and not equals:
        return text
    try:
        return (name, float(value)) if equals else float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither a number nor of the form JOINT=VALUE, for example elbow=0.5"
        ) from None


def values_of(option: str, given: Sequence[float | tuple[str, float] | str] | None) -> JointValues | str | None:
    """Value of an option of :func:`add_vector`: None, one number, several, some by name, or a word."""
    if given is None:
        return None
    if len({type(item) for item in given}) > 1:
        raise InputError(f"--{option} takes numbers, or JOINT=VALUE, or one word alone; not several of these")
    numbers: list[Any] = list(given)
    if not isinstance(given[0], tuple):
        return numbers[0] if len(numbers) == 1 else numbers
    named = dict(numbers)
    if len(named) < len(numbers):
        raise InputError(f"--{option} names a joint more than once, among {', '.join(map(repr, named))}")
    return named


def _joints(option: str, request: argparse.Namespace, robot: Robot) -> Floats | str | None:
    """The numbers (n,) of an option, or its word; None if it was not given."""
    values = values_of(option, getattr(request, option))
    if values is None or isinstance(values, str):
        return values
    return joint_array(f"--{option}", values, robot.joint_names, uniform=True)


def motion_of(request: argparse.Namespace) -> tuple[Scene, ArrayLike, ArrayLike, NDArray[np.float64] | None]:
    """The scene, q0, v0, and the torque unless it is zero."""
    robot = load_robot(request.robot, **robot_options(request))
    names = ("damping", "stiffness", "rest", "q0", "v0", "torque")
    given: dict[str, Any] = {name: _joints(name, request, robot) for name in names}
    q0, v0, torque = (given.pop(name) for name in ("q0", "v0", "torque"))
    forces = {name: value for name, value in given.items() if value is not None}
    scene = Scene(robot, gravity=request.gravity, **forces)
    still = np.zeros(robot.dof)
    start = robot.posture(q0) if isinstance(q0, str) else still if q0 is None else q0
    return scene, start, still if v0 is None else v0, torque if np.any(torque) else None


def names_scene(word: str) -> bool:
    """Whether a word names a scene file and not a robot."""
    return Path(word).suffix == ".toml" or word in scenes()


def scene_file(request: argparse.Namespace, word: str, *excluded: str) -> SceneFile:
    """Load a scene file, with which the options ``excluded`` cannot be given."""
    default = request.parser.parse_args(["robot"])
    for name in excluded:
        if getattr(request, name) != getattr(default, name):
            option = name.replace("_", "-") if getattr(request, name) is not False else f"no-{name}"
            raise InputError(f"--{option} cannot be given with a scene file: {word} has it")
    return load_scene(word)


def take_outputs(request: argparse.Namespace, file: SceneFile) -> None:
    """Outputs of a scene file replace those that the command line does not set."""
    for name, value in file.outputs.items():
        if getattr(request, name, value) is None:
            setattr(request, name, value)
