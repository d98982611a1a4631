"""``varpin replay``, ``varpin inspect`` and ``varpin robots``: saved motions and robot descriptions, shown."""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from varpin.cli.arguments import (
    add_robot,
    add_robot_options,
    add_vector,
    names_scene,
    robot_options,
    scene_file,
    values_of,
)
from varpin.cli.console import say, show
from varpin.cli.outputs import add_replay_options, speed_of, write_all, writers_of
from varpin.errors import InputError, RobotNotFound
from varpin.io.scenefile import SceneFile
from varpin.marks import Marks
from varpin.model import Robot, load_robot, robot_names
from varpin.show.given import frame_names
from varpin.show.inspection import inspect_robot
from varpin.support.tables import Table
from varpin.trajectory import Trajectory


def add_replay(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin replay``."""
    parser.description = "Show a saved motion in a window of the web browser, until Ctrl-C; or as a page or a video."
    parser.set_defaults(run=_replay, log_level=logging.WARNING)
    parser.add_argument("motion", type=Path, metavar="NPZ", help="a trajectory or a solution, as --save writes it")
    text = "a robot, or a scene file, whose task is shown too; default: the robot named in the motion"
    parser.add_argument("--robot", metavar="ROBOT", help=text)
    add_robot_options(parser)
    outputs = parser.add_argument_group("outputs")
    add_replay_options(outputs)
    outputs.add_argument("--ghost", type=Path, metavar="NPZ", help="a second motion of the robot, drawn translucent")
    outputs.add_argument("--frames", nargs="+", default=[], metavar="FRAME", help="draw frames as triads")
    outputs.add_argument("--torques", action="store_true", help="colour links by the torques of their joints")


def _replay(request: argparse.Namespace, errors: Console) -> int:
    first = Trajectory.load(request.motion)
    robot, scene = _robot(request, first)
    motion = Trajectory.load(request.motion, robot)
    marks = Marks() if scene is None else scene.marks(motion.duration)
    ghost = marks.ghost if request.ghost is None else Trajectory.load(request.ghost, robot)
    trace = request.trace or marks.trace
    for name, frames in (("trace", trace), ("frames", request.frames)):
        frame_names(f"--{name}", [robot], frames)
    marks = replace(marks, ghost=ghost, trace=trace, frames=request.frames, torques=request.torques)
    writers = writers_of(request, lambda _duration: marks)
    if not writers:
        return _window(request, errors, robot, motion, marks)
    with request.interrupts.keeping():
        written, status = write_all(request, errors, writers, robot, motion, motion)
    for row in written:
        show("{}: {}".format(*row))
    return status


def _window(request: argparse.Namespace, errors: Console, robot: Robot, motion: Trajectory, marks: Marks) -> int:
    """Show the motion in a live window, until Ctrl-C."""
    from varpin.show.replay.motion import replay  # noqa: PLC0415 - meshcat is slow to import

    viewer = replay(robot, motion, open=True, speed=speed_of(request), marks=marks)
    say(errors, f"{motion!r} at {viewer.url()}; Ctrl-C ends it")  # type: ignore[union-attr]
    try:
        while True:
            time.sleep(3600.0)
    except KeyboardInterrupt:
        return 0


def _robot(request: argparse.Namespace, motion: Trajectory) -> tuple[Robot, SceneFile | None]:
    """The robot of the motion, and its scene if ``--robot`` names one."""
    if request.robot is not None and names_scene(request.robot):
        scene = scene_file(request, request.robot)
        return scene.robot, scene
    name = request.robot or motion.robot
    try:
        return load_robot(name, **robot_options(request)), None
    except RobotNotFound as error:
        if request.robot is not None:
            raise
        text = f"{request.motion} is of robot {name!r}: give its URDF file or its scene file as --robot"
        raise InputError(text) from error


def add_inspect(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin inspect``."""
    parser.description = (
        "Print a robot's joints, links, masses and frames, and whatever looks wrong. Takes robots that simulate "
        "refuses."
    )
    # The report repeats the warnings of loading.
    parser.set_defaults(run=_inspect, log_level=logging.ERROR)
    add_robot(parser, scenes=True)
    add_vector(parser, "q", "configuration of the report [rad or m]; default: 0")


def _inspect(request: argparse.Namespace, _errors: Console) -> int:
    if names_scene(request.robot):
        file = scene_file(request, request.robot)
        rows = [("robot", file.robot.name), *file.required.rows]
        rows.append(("horizon", f"{file.steps} steps of {file.dt:g} s, {file.integrator}"))
        show(Table(f"{file.title} ({file.path.name})", (), rows))
        return 0
    show(inspect_robot(request.robot, q=values_of("q", request.q), **robot_options(request)))
    return 0


def add_robots(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin robots``."""
    parser.description = "List the robots with names: varpin's own, and the fixed-base ones of example-robot-data."
    parser.set_defaults(run=_robots, log_level=logging.ERROR)


def _robots(_request: argparse.Namespace, _errors: Console) -> int:
    show(Table("Robots", ("name", "joints"), [(name, load_robot(name).dof) for name in robot_names()]))
    show("joints without mimic joints; --lock locks some of them")
    return 0
