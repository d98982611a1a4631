"""The terms of a cost that a scene file can name: a line each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from varpin.costs import ControlCost, Cost, TrackingCost, VelocityCost
from varpin.robot import Robot
from varpin.scenefile.references import Timeline
from varpin.scenefile.table import Floats

Space = Literal["q", "v", "u", "frame", "robot"]


@dataclass(frozen=True, eq=False)
class Given:
    """What a term is made of.

    Attributes:
        robot: Of the scene, without the joints that are left out.
        weight: One for each component, or one number.
        target: Its reference, if it has one.
        frame: Name of its frame, if it has one.
        numbers: What else it takes.
    """

    robot: Robot
    weight: Floats | float
    target: Timeline | None
    frame: str
    numbers: Mapping[str, float]

    @property
    def reference(self) -> Any:
        """The target as costs take it: a constant array, or a function of time."""
        if self.target is None:
            return 0.0
        return self.target.at(np.zeros(1))[0] if self.target.constant else self.target


@dataclass(frozen=True, eq=False)
class Term:
    """A kind of cost term.

    Attributes:
        make: Builds it.
        space: What it is about: a block of (q, v, u), whose components have names; a frame; or the whole robot.
        reference: Key of its target, or None if it has none.
        components: Names of the target's components, where they are not joints or controls.
        optional: Whether the target may be left out, and is 0 then.
        hold: Whether ``hold`` may stand for the reference.
        can_end: Whether it can be a terminal term.
        numbers: Other keys it takes, numbers > 0, and their defaults.
    """

    make: Callable[[Given], Cost]
    space: Space
    reference: str | None = None
    components: tuple[str, ...] = ()
    optional: bool = False
    hold: bool = False
    can_end: bool = True
    numbers: Mapping[str, float] = field(default_factory=dict)

    @property
    def frame(self) -> bool:
        """Whether it takes a frame."""
        return self.space == "frame"

    @property
    def by_name(self) -> bool:
        """Whether its weight may differ between components."""
        return self.space in ("q", "v", "u")


TERMS: dict[str, Term] = {
    "tracking": Term(lambda g: TrackingCost(g.reference, g.weight), "q", "reference"),
    "velocity": Term(lambda g: VelocityCost(g.weight, g.reference), "v", "reference", optional=True),
    "control": Term(
        lambda g: ControlCost(g.weight, g.reference), "u", "reference", optional=True, hold=True, can_end=False
    ),
}
