"""``varpin inspect`` and ``varpin robots``: report on robot descriptions."""

from __future__ import annotations

import argparse
import logging
import sys

from rich.console import Console
from rich.text import Text

from varpin.cli.arguments import (
    ROBOT_OPTIONS,
    add_gravity,
    add_robot,
    add_vector,
    names_scene,
    robot_options,
    scene_file,
    values_of,
)
from varpin.cli.console import say
from varpin.model import build_robot, robot_names
from varpin.show.inspection import inspect_robot
from varpin.show.inspection_report import parts_of
from varpin.support.tables import WIDTH, add_row, facts, table_of


def add_inspect(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin inspect``."""
    parser.description = (
        "Print a robot's joints, links, masses and frames, how well its mass matrix is conditioned, the largest step "
        "that the midpoint integrator's branch guard accepts, and whatever looks wrong. Takes robots that "
        "simulate refuses."
    )
    # The report repeats the warnings of loading.
    parser.set_defaults(run=_inspect, log_level=logging.ERROR)
    add_robot(parser, scenes=True)
    add_vector(parser, "q", "configuration of the report [rad or m]; default: 0")
    add_vector(parser, "v", "velocity of the report [rad/s or m/s]; default: 0")
    add_gravity(parser)


def _inspect_scene(request: argparse.Namespace) -> int:
    file = scene_file(request, request.robot, "inspect", *ROBOT_OPTIONS, "gravity", "q", "v")
    spec, required = file.spec, file.required
    table = facts(f"{spec.title} ({spec.path.name})")
    add_row(table, "robot", file.robot.name)
    for name, words in required.rows:
        add_row(table, name, words, style="dim" if words == "none" or name == "not modelled" else "")
    add_row(table, "horizon", f"{spec.steps} steps of {spec.dt:g} s, {file.integrator}")
    console = Console() if sys.stdout.isatty() else Console(width=WIDTH)
    console.print(table)
    return 0


def _inspect(request: argparse.Namespace, _errors: Console) -> int:
    if names_scene(request.robot):
        return _inspect_scene(request)
    arguments = {**robot_options(request), "gravity": request.gravity}
    report = inspect_robot(request.robot, q=values_of("q", request.q), v=values_of("v", request.v), **arguments)
    console = Console() if sys.stdout.isatty() else Console(width=WIDTH)
    for part in parts_of(report):
        console.print(part, soft_wrap=isinstance(part, Text))
    return 0


def add_robots(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin robots``."""
    parser.description = (
        "List the robots that every command takes by name: those bundled with varpin, and the fixed-base ones of the "
        "installed example-robot-data."
    )
    parser.set_defaults(run=_robots, log_level=logging.ERROR)


def _robots(_request: argparse.Namespace, _errors: Console) -> int:
    table = table_of("Robots", ("name", "joints"))
    for name in robot_names():
        add_row(table, name, str(build_robot(name).dof))
    console = Console() if sys.stdout.isatty() else Console(width=WIDTH)
    console.print(table)
    say(console, "joints without mimic joints; --lock locks some of them", prefix="")
    return 0
