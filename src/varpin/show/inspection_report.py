"""The report on a robot, with the same tables in plain text and in notebooks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from varpin.arrays import Floats
from varpin.model import Robot
from varpin.support import markup
from varpin.support.frozen import Frozen
from varpin.support.tables import Table

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
        told = [f"warning: {warning}" for warning in self.warnings] or ["nothing looks wrong"]
        return "\n".join([*(f"{table}\n" for table in self.tables), *told])

    @property
    def tables(self) -> tuple[Table, ...]:
        """Tables of joints, links, frames and the whole robot."""
        moving = iter(range(len(self.joints)))
        joints: list[tuple[object, ...]] = [
            (
                j.name,
                "-" if j.kind == "mimic" else next(moving),
                j.kind,
                _axis(j),
                j.follows or _range(j),
                "none" if math.isinf(j.velocity) else f"{j.velocity:g}",
                "none" if math.isinf(j.effort) else f"{j.effort:g}",
            )
            for j in self.joints
        ]
        joints += [(name, "-", f"locked at {at}", "", "", "", "") for name, at in self.locked.items()]
        links = [
            (x.name, f"{x.mass:.4g}", *("  ".join(f"{y:.3g}" for y in part) for part in (x.center, x.moments)))
            for x in self.links
        ]
        frames = [(x.name, x.kind, x.parent or "the world", x.joint or "the base") for x in self.frames]
        whole = [
            ("degrees of freedom", self.robot.dof),
            ("mass that moves [kg]", f"{self.total_mass:.5g}"),
            ("at q [rad or m]", "  ".join(f"{x:g}" for x in self.q)),
            ("largest step of Midpoint", self.step_in_words),
        ]
        units = {"rad": "[rad]", "m": "[m]"}
        unit = units.get("".join({j.unit for j in self.joints}), "[rad or m]")
        per = unit.replace("]", "/s]").replace(" or", "/s or")
        effort = {"[rad]": "[N m]", "[m]": "[N]"}.get(unit, "[N m or N]")
        heads = "joint", "q", "kind", "axis", f"limits {unit}", f"speed {per}", f"effort {effort}"
        name = self.robot.name
        return (
            Table(f"{name}: joints", heads, joints),
            Table(f"{name}: links", ("link", "mass [kg]", "centre of mass [m]", "principal moments [kg m^2]"), links),
            Table(f"{name}: frames", ("frame", "what it is", "on", "moved by"), frames),
            Table(f"{name}: as a whole", (), whole),
        )

    @property
    def step_in_words(self) -> str:
        """The largest step that the midpoint integrator accepts around (q, v), in words."""
        if self.largest_step is None:
            return "undefined: the mass matrix is singular"
        # Rounded numbers in a description, such as a turn by 1.5708, make neutral directions slightly unstable.
        step = "any: nothing is unstable" if self.largest_step > _ANY_STEP else f"{self.largest_step:.3g} s"
        return f"{step} at this q, {'at rest' if not self.v.any() else 'and this v'}"

    def _repr_html_(self) -> str:
        joints, links, frames, whole = self.tables
        rows = [(str(name), value) for name, value in whole.rows]
        rows += [("warning", warning) for warning in self.warnings]
        folded = (markup.folded(part.title, markup.table(part.columns, part.rows)) for part in (links, frames))
        return markup.facts(f"Robot {self.robot.name}", rows, markup.table(joints.columns, joints.rows), *folded)


def _range(joint: JointReport) -> str:
    free = math.isinf(joint.lower) and math.isinf(joint.upper)
    return "free" if free else f"{joint.lower:g} .. {joint.upper:g}"


def _axis(joint: JointReport) -> str:
    for letter, component in zip("xyz", joint.axis, strict=True):
        if abs(abs(component) - 1.0) < 1e-9:
            return f"{'+' if component > 0.0 else '-'}{letter}"
    return "(" + ", ".join(f"{component:.3g}" for component in joint.axis) + ")"
