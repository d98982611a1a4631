"""Parts of what a scene file says: forces, constraints, costs; and the words for their kinds."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from varpin.io.scenefile.plan_constraints import Kind
from varpin.io.scenefile.references import Reference
from varpin.io.scenefile.table import ByName, Table
from varpin.io.scenefile.terms import Term
from varpin.mechanics import constraints
from varpin.mechanics.constraints import Constraint, CustomConstraint
from varpin.mechanics.forces import (
    Armature,
    CoulombFriction,
    Force,
    FrameDamper,
    FrameSpring,
    FrameWrench,
    JointDamper,
    JointSpring,
    JointStop,
    PositionServo,
)


def word_of(name: str) -> str:
    """The name of a class as scene files have it: PointOnLine is point_on_line, RungeKutta4 runge_kutta_4."""
    return re.sub(r"(?<!^)([A-Z0-9])", r"_\1", name).lower()


# A motion of seven joints over so many steps takes gigabytes.
MOST_STEPS = 10**7
# Steps times terms of a cost: references are evaluated for each.
MOST_EVALUATIONS = 10**6
# Of a [[force]], by the word for it; its keys are the fields of the force, by joint.
FORCES: Mapping[str, type[Force]] = {
    "armature": Armature,
    "damper": JointDamper,
    "friction": CoulombFriction,
    "servo": PositionServo,
    "spring": JointSpring,
    "stop": JointStop,
}
# The same of forces on frames; what their fields take is in ``tables``.
FRAME_FORCES: Mapping[str, type[Force]] = {
    "frame_damper": FrameDamper,
    "frame_spring": FrameSpring,
    "frame_wrench": FrameWrench,
}
# Of a [[constraint]]: all that need no function, PointOnLine as point_on_line.
CONSTRAINTS: Mapping[str, type[Constraint]] = {
    word_of(name): kind
    for name, kind in sorted(vars(constraints).items())
    if isinstance(kind, type) and issubclass(kind, Constraint) and kind not in (Constraint, CustomConstraint)
}
FIGURES = (".png", ".pdf", ".svg")


@dataclass(frozen=True, eq=False)
class ForceSpec:
    """A force on joints.

    Attributes:
        kind: Which one.
        values: Its attributes by joint, those that the file gives.
        table: Where it stands, for messages.
    """

    kind: type[Force]
    values: Mapping[str, ByName]
    table: Table


@dataclass(frozen=True, eq=False)
class FrameForceSpec:
    """A force on frames.

    Attributes:
        force: What the file says.
        table: Where it stands, for messages.
    """

    force: Force
    table: Table


@dataclass(frozen=True, eq=False)
class ConstraintSpec:
    """A constraint.

    Attributes:
        constraint: What the file says.
        table: Where it stands, for messages.
    """

    constraint: Constraint
    table: Table


@dataclass(frozen=True, eq=False)
class PlanConstraintSpec:
    """A hard constraint of the plan.

    Attributes:
        kind: What its type in the file means.
        given: Its keys.
        table: Where it stands, for messages.
    """

    kind: Kind
    given: Mapping[str, Any]
    table: Table


@dataclass(frozen=True, eq=False)
class CostSpec:
    """A term of the cost.

    Attributes:
        table: Where it stands.
        kind: Its type in the file.
        term: What the type means.
        weight: By component.
        terminal: At the end, instead of its integral.
        reference: Its target over time, if it has one.
        holding_q: A configuration whose holding torques are the reference, by joint; ``()`` for the initial one.
        frame: Name of a frame, for terms that have one.
        numbers: What else it takes.
        words: What else it takes.
    """

    table: Table
    kind: str
    term: Term
    weight: ByName
    terminal: bool
    reference: Reference | None
    holding_q: ByName | None
    frame: str
    numbers: Mapping[str, float]
    words: Mapping[str, str]


def degrees_for_radians(value: float) -> bool:
    """Whether an angle is beyond two turns either way, as degrees written for radians are."""
    return abs(value) > 4.0 * math.pi
