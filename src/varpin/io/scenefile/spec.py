"""Parts of a scene file: forces, constraints and costs, and the words for their kinds."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from varpin.io.scenefile.plan_constraints import Kind
from varpin.io.scenefile.references import ReferenceSignal
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
    """The name of a class in scene files: point_on_line for PointOnLine, runge_kutta_4 for RungeKutta4."""
    return re.sub(r"(?<!^)([A-Z0-9])", r"_\1", name).lower()


# Largest number of steps: a motion of seven joints over as many takes gigabytes.
MOST_STEPS = 10**7
# Largest product of steps and terms of the cost: each term evaluates its reference at each step.
MOST_EVALUATIONS = 10**6
# Forces on joints by the type of a [[force]], whose keys are the fields of the force, by joint.
FORCES: Mapping[str, type[Force]] = {
    "armature": Armature,
    "damper": JointDamper,
    "friction": CoulombFriction,
    "servo": PositionServo,
    "spring": JointSpring,
    "stop": JointStop,
}
# Forces on frames by the type of a [[force]]; the rules of their fields are in ``tables``.
FRAME_FORCES: Mapping[str, type[Force]] = {
    "frame_damper": FrameDamper,
    "frame_spring": FrameSpring,
    "frame_wrench": FrameWrench,
}
# Constraints by the type of a [[constraint]]: all those without a function.
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
        kind: Class of the force.
        values: Its attributes by joint, those that the file gives; ``"robot"`` for a level of the description.
        table: Its table, for messages.
    """

    kind: type[Force]
    values: Mapping[str, ByName | Literal["robot"]]
    table: Table


@dataclass(frozen=True, eq=False)
class FrameForceSpec:
    """A force on frames.

    Attributes:
        force: The force.
        table: Its table, for messages.
    """

    force: Force
    table: Table


@dataclass(frozen=True, eq=False)
class ConstraintSpec:
    """A constraint.

    Attributes:
        constraint: The constraint; None for those of the robot's description.
        table: Its table, for messages.
    """

    constraint: Constraint | None
    table: Table


@dataclass(frozen=True, eq=False)
class PlanConstraintSpec:
    """A hard constraint of the plan.

    Attributes:
        kind: Kind of constraint.
        given: Values of its keys.
        table: Its table, for messages.
    """

    kind: Kind
    given: Mapping[str, Any]
    table: Table


@dataclass(frozen=True, eq=False)
class CostSpec:
    """A term of the cost.

    Attributes:
        table: Its table, for messages.
        kind: Its type in the file.
        term: The kind of term.
        weight: Weights by component.
        terminal: Whether it is a terminal cost instead of an integral over time.
        reference: Its target over time, if it has one.
        holding_q: A configuration whose holding torques are the reference, by joint or the name of a posture; ``()``
            for the initial one.
        frame: Name of its frame; empty for terms without one.
        numbers: Its other keys with numbers.
        words: Its other keys with words.
    """

    table: Table
    kind: str
    term: Term
    weight: ByName
    terminal: bool
    reference: ReferenceSignal | None
    holding_q: ByName | str | None
    frame: str
    numbers: Mapping[str, float]
    words: Mapping[str, str]
