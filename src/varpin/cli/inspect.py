"""``varpin inspect`` and ``varpin robots``: look into descriptions."""

from __future__ import annotations

import argparse
import logging
import math
import sys

from rich.console import Console
from rich.table import Table

from varpin.cli.arguments import add_gravity, add_robot, add_vector, names_scene, one_or_all, scene_file
from varpin.cli.console import WIDTH, add_row, facts, say, table_of
from varpin.inspection import JointReport, RobotReport, inspect_robot
from varpin.robot import build_robot, robot_names


def add_inspect(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin inspect``."""
    parser.description = (
        "Print a robot's joints, links and masses, how well its mass matrix is conditioned, the largest step the "
        "midpoint integrator's branch guard accepts, and whatever looks wrong. Takes robots that simulate refuses."
    )
    # What loading warns of is among the report's own warnings.
    parser.set_defaults(run=_inspect, log_level=logging.ERROR)
    add_robot(parser, scenes=True)
    add_vector(parser, "q", "configuration to look at [rad or m]; default: 0")
    add_vector(parser, "v", "velocity there [rad/s or m/s]; default: 0")
    add_gravity(parser)


def _inspect_scene(request: argparse.Namespace) -> int:
    file = scene_file(request, request.robot, "inspect", "lock", "package_dir", "gravity", "q", "v")
    spec, required = file.spec, file.required
    table = facts(f"{spec.title} ({spec.path.name})")
    add_row(table, "robot", f"{file.robot.name}, {len(required.joints)} of {required.described} joints computed")
    add_row(table, "computed", ", ".join(required.joints))
    for title, joints in (("locked", required.locked), ("left out: nothing touches", required.idle)):
        if joints:
            add_row(table, title, ", ".join(f"{joint} at {at}" for joint, at in joints.items()), style="dim")
    if len(required.parts) > 1:
        add_row(table, "planned apart", "; ".join(", ".join(part) for part in required.parts))
    if required.coupled:
        add_row(table, "planned together", required.coupled)
    for name, words in required.terms.items():
        add_row(table, name, words, style="dim" if words == "none" or name == "not modelled" else "")
    add_row(table, "horizon", f"{spec.steps} steps of {spec.dt:g} s, {spec.integrator}")
    if required.saved:
        add_row(table, "saved", f"{100 * required.saved:.0f}% of the linear algebra of a plan, by counting")
    console = Console() if sys.stdout.isatty() else Console(width=WIDTH)
    console.print(table)
    return 0


def _inspect(request: argparse.Namespace, _errors: Console) -> int:
    if names_scene(request.robot):
        return _inspect_scene(request)
    arguments = {"package_dirs": request.package_dir, "lock": dict(request.lock), "gravity": request.gravity}
    report = inspect_robot(request.robot, q=one_or_all(request.q), v=one_or_all(request.v), **arguments)
    console = Console() if sys.stdout.isatty() else Console(width=WIDTH)
    console.print(_joint_table(report))
    console.print(_link_table(report))
    console.print(_report_table(report))
    for warning in report.warnings:
        say(console, warning, prefix="warning", style="yellow")
    if not report.warnings:
        say(console, "nothing looks wrong", prefix="")
    return 0


def _joint_table(report: RobotReport) -> Table:
    columns = "#", "joint", "kind", "axis", "position", "velocity", "effort"
    table = table_of(f"{report.robot.name}: joints", columns)
    number = iter(range(len(report.joints)))
    for joint in report.joints:
        slides = joint.unit == "m"
        kind = joint.kind if joint.kind != "mimic" else f"mimic: {joint.follows}"
        add_row(
            table,
            "" if joint.kind == "mimic" else str(next(number)),
            joint.name,
            kind,
            _axis(joint),
            "free" if joint.kind == "continuous" else f"{joint.lower:g} .. {joint.upper:g} {joint.unit}",
            _bound(joint.velocity, "m/s" if slides else "rad/s"),
            _bound(joint.effort, "N" if slides else "N m"),
        )
    for name, at in report.locked.items():
        add_row(table, "", name, f"locked at {at}", "", "", "", "", style="dim")
    return table


def _axis(joint: JointReport) -> str:
    for letter, component in zip("xyz", joint.axis, strict=True):
        if abs(abs(component) - 1.0) < 1e-9:
            return f"{'+' if component > 0.0 else '-'}{letter}"
    return "(" + ", ".join(f"{component:.3g}" for component in joint.axis) + ")"


def _bound(value: float, unit: str) -> str:
    return "none" if math.isinf(value) else f"{value:g} {unit}"


def _link_table(report: RobotReport) -> Table:
    columns = "link", "moved by", "mass [kg]", "centre of mass [m]", "principal moments [kg m^2]"
    table = table_of(f"{report.robot.name}: links", columns)
    for link in report.links:
        add_row(
            table,
            link.name,
            link.joint or "the base",
            f"{link.mass:.4g}",
            "  ".join(f"{x:.3g}" for x in link.center),
            "  ".join(f"{x:.3g}" for x in link.moments),
            style="" if link.joint else "dim",
        )
    return table


def _report_table(report: RobotReport) -> Table:
    table = facts(f"{report.robot.name}: as a whole")
    add_row(table, "degrees of freedom", str(report.robot.dof))
    add_row(table, "mass of what moves", f"{report.total_mass:.5g} kg")
    add_row(table, "at q [rad or m]", "  ".join(f"{x:g}" for x in report.q))
    add_row(table, "condition of M(q)", f"{report.condition:.3g}; {report.scaled_condition:.3g} with a unit diagonal")
    remark = f"(branch margin {report.branch_margin:g}; says nothing of accuracy)"
    add_row(table, "largest step accepted", f"{report.step_in_words} {remark}")
    return table


def add_robots(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``varpin robots``."""
    parser.description = (
        "List the robots that every command takes by name: those that come with varpin, and the fixed-base ones of the "
        "installed example-robot-data."
    )
    parser.set_defaults(run=_robots, log_level=logging.ERROR)


def _robots(_request: argparse.Namespace, _errors: Console) -> int:
    table = table_of("Robots", ("name", "joints"))
    for name in robot_names():
        add_row(table, name, str(build_robot(name).dof))
    console = Console() if sys.stdout.isatty() else Console(width=WIDTH)
    console.print(table)
    say(console, "joints without those that mimic others; --lock holds some still", prefix="")
    return 0
