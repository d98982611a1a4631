"""Words of the command line that several commands share: a robot, its motion, a scene file."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.errors import InputError
from varpin.robot import Robot, load_robot
from varpin.scene import Scene
from varpin.scenefile import SceneFile, load_scene, scenes


def add_robot(parser: argparse.ArgumentParser, *, optional: bool = False, scenes: bool = False) -> None:
    """The robot by name or file, and the joints to lock."""
    parser.add_argument(
        "robot",
        metavar="ROBOT",
        nargs="?" if optional else None,
        help="path of a URDF file, or name of a robot of varpin or of example-robot-data"
        + ("; scenes made up for it if left out" if optional else "")
        + ("; or a scene file (TOML), or name of a scene of varpin" if scenes else ""),
    )
    parser.add_argument(
        "--lock",
        type=_lock,
        nargs="+",
        action="extend",
        default=[],
        metavar="JOINT=VALUE",
        help="hold joints still [rad or m]",
    )
    parser.add_argument(
        "--package-dir",
        action="append",
        metavar="DIR",
        help="where package:// paths of meshes are looked up; repeatable",
    )


def add_motion(parser: argparse.ArgumentParser) -> None:
    """Where a motion starts, and what acts on it."""
    start = parser.add_argument_group("start")
    add_vector(start, "q0", "initial configuration [rad or m]; default: 0")
    add_vector(start, "v0", "initial velocity [rad/s or m/s]; default: 0")
    surroundings = parser.add_argument_group("surroundings")
    add_gravity(surroundings)
    add_vector(surroundings, "damping", "viscous damping [N m s/rad or N s/m]; default: 0")
    add_vector(surroundings, "stiffness", "joint springs [N m/rad or N/m]; default: 0")
    add_vector(surroundings, "rest", "where the springs are slack [rad or m]; default: 0")
    add_vector(surroundings, "torque", "constant generalized forces [N m or N]; default: 0")


def add_vector(group: argparse._ActionsContainer, name: str, text: str) -> None:
    """An option of one number for all joints or one for each."""
    group.add_argument(f"--{name}", type=float, nargs="+", metavar="X", help=text)


def add_gravity(group: argparse._ActionsContainer) -> None:
    """Gravity as a vector, or none."""
    gravity = group.add_mutually_exclusive_group()
    gravity.add_argument(
        "--gravity",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        default=True,
        help="in world axes [m/s^2]; default: 0 0 -9.81",
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


def _vector(option: str, numbers: Sequence[float] | None, robot: Robot) -> ArrayLike:
    """The numbers of an option: none for 0, one for all joints, or (n,)."""
    if numbers is None:
        return 0.0
    if len(numbers) not in (1, robot.dof):
        raise InputError(
            f"--{option} takes one number for all joints or {robot.dof}, for {', '.join(robot.joint_names)}; "
            f"got {len(numbers)}"
        )
    return numbers[0] if len(numbers) == 1 else list(numbers)


def motion_of(request: argparse.Namespace) -> tuple[Scene, ArrayLike, ArrayLike, NDArray[np.float64] | None]:
    """The scene, q0, v0, and the torque unless it is zero."""
    robot = load_robot(request.robot, package_dirs=request.package_dir, lock=dict(request.lock))
    scene = Scene(
        robot,
        gravity=request.gravity,
        damping=_vector("damping", request.damping, robot),
        stiffness=_vector("stiffness", request.stiffness, robot),
        rest=_vector("rest", request.rest, robot),
    )
    q0, v0, torque = (
        np.broadcast_to(_vector(name, getattr(request, name), robot), (robot.dof,)) for name in ("q0", "v0", "torque")
    )
    return scene, q0, v0, torque if torque.any() else None


def names_scene(word: str) -> bool:
    """Whether a word names a scene file and not a robot."""
    return Path(word).suffix == ".toml" or word in scenes()


def scene_file(request: argparse.Namespace, word: str, *given: str) -> SceneFile:
    """The scene file, whose outputs stand in for those not asked for; ``given`` are options it leaves no room for."""
    command, default = given[0], request.parser.parse_args(["robot"]) if len(given) > 1 else None
    for name in given[1:]:
        if getattr(request, name) != getattr(default, name):
            option = name.replace("_", "-") if getattr(request, name) is not False else f"no-{name}"
            raise InputError(f"--{option} has no place beside a scene file: {command} {word} takes it from the file")
    scene = load_scene(word)
    outputs = scene.spec.outputs
    for name in ("save", "plot", "html", "speed"):
        if hasattr(request, name) and getattr(request, name) is None:
            setattr(request, name, getattr(outputs, name))
    return scene


def one_or_all(numbers: Sequence[float] | None) -> ArrayLike | None:
    """One number by itself, several as they are."""
    return numbers[0] if numbers is not None and len(numbers) == 1 else numbers
