"""``varpin inspect`` and ``varpin robots``: report on robot descriptions."""

from __future__ import annotations

import argparse
import logging
from typing import Any

from rich.console import Console

from varpin.cli.arguments import (
    add_gravity,
    add_robot,
    add_vector,
    names_scene,
    robot_options,
    scene_file,
    values_of,
)
from varpin.cli.console import show
from varpin.model import load_robot, robot_names
from varpin.show.inspection import inspect_robot
from varpin.support.tables import Table


def add_inspect(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin inspect``."""
    parser.description = (
        "Print a robot's joints, links, masses and frames, the largest step that Midpoint accepts, and whatever looks "
        "wrong. Takes robots that simulate refuses."
    )
    # The report repeats the warnings of loading.
    parser.set_defaults(run=_inspect, log_level=logging.ERROR)
    add_robot(parser, scenes=True)
    add_vector(parser, "q", "configuration of the report [rad or m]; default: 0")
    add_vector(parser, "v", "velocity of the report [rad/s or m/s]; default: 0")
    add_gravity(parser)


def _inspect(request: argparse.Namespace, _errors: Console) -> int:
    if names_scene(request.robot):
        file = scene_file(request, request.robot)
        rows = [("robot", file.robot.name), *file.required.rows]
        rows.append(("horizon", f"{file.steps} steps of {file.dt:g} s, {file.integrator}"))
        show(Table(f"{file.title} ({file.path.name})", (), rows))
        return 0
    values: dict[str, Any] = {name: values_of(name, getattr(request, name)) for name in ("q", "v")}
    show(inspect_robot(request.robot, **values, gravity=request.gravity, **robot_options(request)))
    return 0


def add_robots(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin robots``."""
    parser.description = (
        "List the robots that every command takes by name: those bundled with varpin, and the fixed-base ones of the "
        "installed example-robot-data."
    )
    parser.set_defaults(run=_robots, log_level=logging.ERROR)


def _robots(_request: argparse.Namespace, _errors: Console) -> int:
    show(Table("Robots", ("name", "joints"), [(name, load_robot(name).dof) for name in robot_names()]))
    show("joints without mimic joints; --lock locks some of them")
    return 0
