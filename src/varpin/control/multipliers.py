"""What a plan's constraints say of its motion: by how much they are violated, which are active, their multipliers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from varpin.control.constraints import BoundConstraint
from varpin.control.problem import OptimalControlProblem
from varpin.io.archive import Axes
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# What a constraint may be violated by at its places in a plan that is feasible, in its own unit.
FEASIBLE = 1e-6
# Of a tenth of a constraint's range, what is violated beside its places, or by a controller, without a word.
TOLD = 1e-2


@dataclass(frozen=True, eq=False)
class Multipliers(Frozen):
    """Multipliers of a plan's constraints, and where the rounds of the augmented Lagrangian stood.

    Arrays of one number for each place and row have those of all constraints one after another, (M,).

    Attributes:
        values: Of the plan's motion (M,) [cost / unit of the constraint].
        backoff: What ``margin`` standard deviations come to (M,), in the constraint's unit; zero without a margin.
        begun: Those that the last round began with (M,).
        weights: Of the penalties in the last round (C,), for each constraint [cost / unit^2].
        first_weights: The same in the first round (C,).
        worst: The violation after the round before (C,), for each constraint; infinite in the first round.
        tolerance: Of the search in the last round.
        round: Number of the last round, from 0.
        iterations: Of the search in all rounds before.
        stuck: Rounds in a row that have lowered the worst violation by little.
    """

    values: Annotated[Floats, Axes("rows", finite=True)]
    backoff: Annotated[Floats, Axes("rows", finite=True)]
    begun: Annotated[Floats, Axes("rows", finite=True)]
    weights: Annotated[Floats, Axes("constraints", finite=True)]
    first_weights: Annotated[Floats, Axes("constraints", finite=True)]
    worst: Annotated[Floats, Axes("constraints")]
    tolerance: float
    round: int
    iterations: int
    stuck: int

    def __post_init__(self) -> None:
        for array in (self.values, self.backoff, self.begun, self.weights, self.first_weights, self.worst):
            array.setflags(write=False)


@dataclass(frozen=True, eq=False)
class ConstraintReport(Frozen):
    """How a plan keeps to one of its constraints.

    Attributes:
        label: The constraint.
        rows: What each row is, in words.
        unit: Of the values.
        t: Times of its places (K,) [s].
        values: c at each place (K, rows), with what the margin adds: at most zero where it holds, zero of equalities.
        multipliers: (K, rows) [cost / unit]: by how much the least cost falls, per unit, where the bound is moved away.
        equality: Whether it is c = 0 rather than c <= 0.
    """

    label: str
    rows: tuple[str, ...]
    unit: str
    t: Floats
    values: Floats
    multipliers: Floats
    equality: bool

    @property
    def excess(self) -> Floats:
        """What is violated at each place (K, rows), at least zero."""
        found: Floats = np.abs(self.values) if self.equality else np.maximum(self.values, 0.0)
        return found

    @property
    def violation(self) -> float:
        """The most that is violated."""
        return float(self.excess.max(initial=0.0))

    @property
    def active(self) -> NDArray[np.bool_]:
        """Where it holds the motion back (K, rows): its multiplier is not zero."""
        return np.asarray(self.multipliers != 0.0)

    @property
    def where(self) -> str:
        """Its worst place in words."""
        k, r = np.unravel_index(int(np.argmax(self.excess)), self.excess.shape)
        return f"{self.rows[r]} at t = {self.t[k]:.4g} s"

    def __str__(self) -> str:
        held = int(self.active.sum())
        most = float(np.abs(self.multipliers).max(initial=0.0))
        worst = f"violated by {self.violation:.1e} {self.unit} at most"
        worst += f" ({self.where})" if self.violation > FEASIBLE else ""
        return f"{self.label}: {worst}, {held} of {self.values.size} bounds active, multipliers up to {most:.3g}"

    __repr__ = __str__


def split(bound: tuple[BoundConstraint, ...], flat: Floats) -> list[Floats]:
    """The part (K, rows) of each constraint in an array (M,)."""
    ends = np.cumsum([item.size for item in bound])
    return [part.reshape(item.shape) for item, part in zip(bound, np.split(flat, ends[:-1]), strict=True)]


def reports(
    problem: OptimalControlProblem, motion: Trajectory, multipliers: Multipliers
) -> tuple[ConstraintReport, ...]:
    """What each constraint of a problem says of a motion on its grid."""
    bound = problem.bound_constraints
    found = []
    for item, backoff, values in zip(
        bound, split(bound, multipliers.backoff), split(bound, multipliers.values), strict=True
    ):
        c = item.value(motion.q, motion.v, motion.u) + backoff
        found.append(
            ConstraintReport(item.source.label, item.rows, item.unit, item.times, c, values, item.source.equality)
        )
    return tuple(found)
