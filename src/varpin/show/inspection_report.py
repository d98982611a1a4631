"""What inspection finds of a robot, and its tables in plain text and in notebooks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from varpin.model import Robot
from varpin.support import markup, tables
from varpin.support.frozen import Frozen

Floats = NDArray[np.float64]
Kind = Literal["revolute", "prismatic", "continuous", "mimic"]
FrameKind = Literal["link", "joint", "fixed joint", "frame"]

# The largest step is no limit beyond this [s].
_ANY_STEP = 100.0


@dataclass(frozen=True, eq=False)
class JointReport(Frozen):
    """A joint that moves.

    Attributes:
        name: Its name.
        kind: Revolute, prismatic, continuous (revolute without end stops) or mimic.
        axis: Unit axis (3,) in the joint's own frame.
        unit: Of its position, rad or m.
        lower: Lower position limit [rad or m], -inf if none.
        upper: Upper position limit [rad or m], inf if none.
        velocity: Velocity limit [rad/s or m/s], inf if none.
        effort: Effort limit [N m or N], inf if none.
        follows: For a mimic joint, what it does: its leader, ratio and offset in words; else empty.
    """

    name: str
    kind: Kind
    axis: Floats
    unit: Literal["rad", "m"]
    lower: float
    upper: float
    velocity: float
    effort: float
    follows: str = ""


@dataclass(frozen=True, eq=False)
class LinkReport(Frozen):
    """A link with mass or inertia; for a model in memory, a joint's links taken together.

    Attributes:
        name: Its name.
        joint: The joint that moves it, or empty for a link of the base.
        mass: [kg].
        center: Centre of mass (3,) in the link's frame [m].
        inertia: (3, 3) about the centre of mass [kg m^2].
        moments: Principal moments of inertia (3,), ascending [kg m^2].
    """

    name: str
    joint: str
    mass: float
    center: Floats
    inertia: Floats
    moments: Floats


@dataclass(frozen=True)
class FrameReport:
    """A frame, whose name costs, traces and payloads take.

    Attributes:
        name: Its name.
        kind: A link's, a joint's, a fixed joint's, or one by itself.
        parent: The link or frame that it is attached to, or empty for the world.
        joint: The joint that moves it, or empty if it is fixed to the base.
    """

    name: str
    kind: FrameKind
    parent: str
    joint: str


@dataclass(frozen=True, eq=False)
class RobotReport(Frozen):
    """A robot as its description has it, and what looks wrong; ``print`` shows all of it in tables.

    Attributes:
        robot: The robot, possibly one that :func:`varpin.load_robot` refuses.
        joints: Every joint that moves, mimic joints included, in Pinocchio's order.
        links: Every link with mass or inertia.
        frames: Every frame by whose name varpin finds it, in Pinocchio's order.
        locked: Joints held still, and where [rad or m].
        total_mass: Of everything that moves [kg].
        q: The configuration looked at (n,) [rad or m].
        v: The velocity there (n,) [rad/s or m/s].
        condition: Condition number of M(q); it mixes units if there are prismatic joints. Infinite if singular.
        scaled_condition: Condition number of M(q) with rows and columns scaled to a unit diagonal, which depends
            on no unit. Infinite if singular.
        largest_step: Largest dt [s] whose step the midpoint integrator's branch guard accepts around (q, v); infinite
            where no direction is unstable, None where M is singular. It says nothing about accuracy.
        branch_margin: The guard's margin, for which ``largest_step`` holds.
        warnings: What looks wrong, in words that name the joint or link.
    """

    robot: Robot = field(repr=False)
    joints: tuple[JointReport, ...]
    links: tuple[LinkReport, ...]
    frames: tuple[FrameReport, ...]
    locked: Mapping[str, float | tuple[float, ...]]
    total_mass: float
    q: Floats
    v: Floats
    condition: float
    scaled_condition: float
    largest_step: float | None
    branch_margin: float
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        warned = markup.warning_count(self.warnings)
        return f"RobotReport({self.robot.name}: {len(self.joints)} joints, {len(self.links)} links{warned})"

    def __str__(self) -> str:
        return tables.plain(parts_of(self))

    @property
    def step_in_words(self) -> str:
        """The largest step the guard accepts around (q, v)."""
        if self.largest_step is None:
            return "undefined: the mass matrix is singular"
        # A description's own rounding, a frame turned by 1.5708, makes directions unstable that are not.
        step = "any: nothing is unstable" if self.largest_step > _ANY_STEP else f"{self.largest_step:.3g} s"
        return f"{step} at this q, {'at rest' if not self.v.any() else 'and this v'}"

    def _repr_html_(self) -> str:
        rows: list[tuple[str, object]] = [
            ("mass that moves [kg]", self.total_mass),
            ("condition of M(q)", f"{self.condition:.3g}; {self.scaled_condition:.3g} with a unit diagonal"),
            ("largest step the guard accepts", self.step_in_words),
            *(("warning", warning) for warning in self.warnings),
        ]
        joints = [
            (j.name, f"mimic: {j.follows}" if j.follows else j.kind, j.lower, j.upper, j.velocity, j.effort)
            for j in self.joints
        ]
        links = [(x.name, x.joint or "the base", x.mass, "  ".join(f"{m:.3g}" for m in x.moments)) for x in self.links]
        return markup.facts(
            f"Robot {self.robot.name}, looked into",
            rows,
            markup.table(("joint", "kind", "lower [rad or m]", "upper", "velocity [1/s]", "effort [N m or N]"), joints),
            markup.folded(
                "links", markup.table(("link", "moved by", "mass [kg]", "principal moments [kg m^2]"), links)
            ),
            markup.folded(
                "frames",
                markup.table(
                    ("frame", "what it is", "on", "moved by"),
                    [(x.name, x.kind, x.parent or "the world", x.joint or "the base") for x in self.frames],
                ),
            ),
        )


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
    table = tables.table_of(f"{report.robot.name}: joints", columns)
    number = iter(range(len(report.joints)))
    for joint in report.joints:
        slides = joint.unit == "m"
        kind = joint.kind if joint.kind != "mimic" else f"mimic: {joint.follows}"
        tables.add_row(
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
        tables.add_row(table, "", name, f"locked at {at}", "", "", "", "", style="dim")
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
    table = tables.table_of(f"{report.robot.name}: links", columns)
    for link in report.links:
        tables.add_row(
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
    table = tables.table_of(f"{report.robot.name}: frames", ("frame", "what it is", "on", "moved by"))
    for frame in report.frames:
        on, joint = frame.parent or "the world", frame.joint or "the base"
        tables.add_row(table, frame.name, frame.kind, on, joint, style="" if frame.joint else "dim")
    return table


def _report_table(report: RobotReport) -> Table:
    table = tables.facts(f"{report.robot.name}: as a whole")
    tables.add_row(table, "degrees of freedom", str(report.robot.dof))
    tables.add_row(table, "mass of what moves", f"{report.total_mass:.5g} kg")
    tables.add_row(table, "at q [rad or m]", "  ".join(f"{x:g}" for x in report.q))
    tables.add_row(
        table, "condition of M(q)", f"{report.condition:.3g}; {report.scaled_condition:.3g} with a unit diagonal"
    )
    remark = f"(branch margin {report.branch_margin:g}; says nothing of accuracy)"
    tables.add_row(table, "largest step accepted", f"{report.step_in_words} {remark}")
    return table
