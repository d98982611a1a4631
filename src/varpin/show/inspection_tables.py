"""A robot report in plain text."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from varpin.support.tables import add_row, facts, table_of

if TYPE_CHECKING:
    from varpin.show.inspection import JointReport, RobotReport


def parts_of(report: RobotReport) -> Iterator[RenderableType]:
    """Tables of joints, links, frames and the whole, and the warnings below them."""
    yield _joint_table(report)
    yield _link_table(report)
    yield _frame_table(report)
    yield _report_table(report)
    for warning in report.warnings:
        yield Text(f"warning: {warning}", style="yellow")
    if not report.warnings:
        yield Text("nothing looks wrong")


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


def _frame_table(report: RobotReport) -> Table:
    table = table_of(f"{report.robot.name}: frames", ("frame", "what it is", "on", "moved by"))
    for frame in report.frames:
        on, joint = frame.parent or "the world", frame.joint or "the base"
        add_row(table, frame.name, frame.kind, on, joint, style="" if frame.joint else "dim")
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
