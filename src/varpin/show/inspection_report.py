"""The report on a robot, with tables in plain text and in notebooks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from varpin.arrays import Floats
from varpin.model import Robot
from varpin.support import markup, tables
from varpin.support.frozen import Frozen

Kind = Literal["revolute", "prismatic", "continuous", "mimic"]
FrameKind = Literal["link", "joint", "fixed joint", "frame"]

# A largest step beyond this counts as no limit [s].
_ANY_STEP = 100.0


@dataclass(frozen=True, eq=False)
class JointReport(Frozen):
    """A joint that moves.

    Attributes:
        name: Name of the joint.
        kind: Revolute, prismatic, continuous (revolute without limits) or mimic.
        axis: Unit axis (3,) in the joint's own frame.
        unit: Unit of its position, rad or m.
        lower: Lower position limit [rad or m], -inf if none.
        upper: Upper position limit [rad or m], inf if none.
        velocity: Velocity limit [rad/s or m/s], inf if none.
        effort: Effort limit [N m or N], inf if none.
        follows: Leader, ratio and offset of a mimic joint, in words; empty for others.
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
    """A link with mass or inertia; for a model in memory, all links on a joint together.

    Attributes:
        name: Name of the link.
        joint: The joint that moves it, or empty for a link of the base.
        mass: Mass [kg].
        center: Centre of mass (3,) in the link's frame [m].
        inertia: Inertia (3, 3) about the centre of mass [kg m^2].
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
    """A frame, for the names that costs, traces and payloads take.

    Attributes:
        name: Name of the frame.
        kind: Whether it belongs to a link, a joint, a fixed joint, or none of them.
        parent: The link or frame that it is attached to, or empty for the world.
        joint: The joint that moves it, or empty if it is fixed to the base.
    """

    name: str
    kind: FrameKind
    parent: str
    joint: str


@dataclass(frozen=True, eq=False)
class RobotReport(Frozen):
    """The content of a robot description, and warnings; ``print`` shows it in tables.

    Attributes:
        robot: The robot, possibly one that :func:`varpin.load_robot` refuses.
        joints: Moving joints, mimic joints included, in Pinocchio's order.
        links: Links with mass or inertia.
        frames: Frames that varpin finds by name, in Pinocchio's order.
        locked: Locked joints and their positions [rad or m].
        total_mass: Mass of all moving links [kg].
        q: Configuration of the report (n,) [rad or m].
        v: Velocity of the report (n,) [rad/s or m/s].
        condition: Condition number of M(q); it mixes units if there are prismatic joints. Infinite if singular.
        scaled_condition: Condition number of M(q) with rows and columns scaled to a unit diagonal, which does not
            depend on units. Infinite if singular.
        largest_step: Largest dt [s] whose step the midpoint integrator's branch guard accepts around (q, v); infinite
            where no direction is unstable, None where M is singular. It is not a measure of accuracy.
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
        """The largest step that the guard accepts around (q, v), in words."""
        if self.largest_step is None:
            return "undefined: the mass matrix is singular"
        # Rounded numbers in a description, such as a turn by 1.5708, make neutral directions slightly unstable.
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
            f"Robot {self.robot.name}",
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
    """Tables of joints, links, frames and the whole robot, then the warnings."""
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
    remark = f"(branch margin {report.branch_margin:g}; not a measure of accuracy)"
    tables.add_row(table, "largest step accepted", f"{report.step_in_words} {remark}")
    return table
