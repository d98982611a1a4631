"""Violations, active rows and multipliers of a plan's constraints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.control.between_nodes import Instants, enforced
from varpin.control.constraints import BoundConstraint
from varpin.control.problem import OptimalControlProblem
from varpin.control.sizes import FEASIBLE
from varpin.io.archive import Axes
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Multipliers(Frozen):
    """Multipliers of a plan's constraints, with the rows between nodes and the margins they belong to.

    Arrays (M,) have one number for each place and row of all constraints, one constraint after another: the problem's,
    and then, once more, those that also have rows between nodes.

    Attributes:
        values: Multipliers of the plan's motion (M,) [cost / unit of the constraint].
        backoff: ``margin`` standard deviations (M,), and what is ``added`` to them, in the constraint's unit.
        between: The rows between nodes.
        added: What is added to margins of the rows at nodes, as motions under noise were counted; None where margins of
            the linear model suffice.
    """

    values: Annotated[Floats, Axes("rows", finite=True)]
    backoff: Annotated[Floats, Axes("rows", finite=True)]
    between: Instants
    added: Annotated[Floats, Axes("node_rows", finite=True)] | None = None

    def __post_init__(self) -> None:
        for array in (self.values, self.backoff, self.added):
            if array is not None:
                array.setflags(write=False)


@dataclass(frozen=True, eq=False)
class ConstraintReport(Frozen):
    """How well a plan satisfies one of its constraints.

    Attributes:
        label: The constraint.
        rows: Description of each row.
        unit: Unit of the values.
        t: Times of its places (K,) [s]: nodes, and instants between them at which it would not hold otherwise.
        values: c at each place (K, rows), margin included. The constraint holds where c <= 0, an equality where c = 0.
        multipliers: (K, rows) [cost / unit]: decrease of the least cost per unit by which the bound is relaxed.
        equality: Whether the constraint is c = 0 rather than c <= 0.
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
        """Violation at each place (K, rows), at least zero."""
        found: Floats = np.abs(self.values) if self.equality else np.maximum(self.values, 0.0)
        return found

    @property
    def violation(self) -> float:
        """The largest violation."""
        return float(self.excess.max(initial=0.0))

    @property
    def active(self) -> NDArray[np.bool_]:
        """Where the constraint is active (K, rows): its multiplier is not zero."""
        return np.asarray(self.multipliers != 0.0)

    @property
    def where(self) -> str:
        """The row and time of the largest violation in words."""
        k, r = np.unravel_index(int(np.argmax(self.excess)), self.excess.shape)
        return f"{self.rows[r]} at t = {self.t[k]:.4g} s"

    def __str__(self) -> str:
        held = int(self.active.sum())
        most = float(np.abs(self.multipliers).max(initial=0.0))
        worst = f"violated by {self.violation:.1e} {self.unit} at most"
        worst += f" ({self.where})" if self.violation > FEASIBLE else ""
        active = f", {held} of {self.values.size} bounds active, multipliers up to {most:.3g}" if held else ""
        return f"{self.label}: {worst}{active}"

    __repr__ = __str__


def flat(parts: Sequence[Floats]) -> Floats:
    """Concatenate the entries of all parts (M,)."""
    found: Floats = np.concatenate([np.ravel(part) for part in parts]) if parts else np.zeros(0)
    return found


def split(bound: Sequence[BoundConstraint], flattened: Floats) -> list[Floats]:
    """Inverse of :func:`flat`: of entries (M,) the parts in the shapes of constraints' values."""
    ends = np.cumsum([item.size for item in bound])
    return [part.reshape(item.shape) for part, item in zip(np.split(flattened, ends[:-1]), bound, strict=True)]


def at_nodes(problem: OptimalControlProblem, known: Multipliers, values: Floats) -> list[Floats]:
    """Of numbers (M,) like those of ``known``, those of each constraint at the nodes (K, rows)."""
    return split(enforced(problem, known.between).bound_constraints, values)[: len(problem.bound_constraints)]


def reports(
    problem: OptimalControlProblem, motion: Trajectory, multipliers: Multipliers
) -> tuple[ConstraintReport, ...]:
    """Reports about each constraint of a problem for a motion on its grid, with their rows between nodes."""
    between, u = multipliers.between, problem.control_rows(motion)
    whole, found = enforced(problem, between).bound_constraints, list[ConstraintReport]()
    pulls, margins = (split(whole, array) for array in (multipliers.values, multipliers.backoff))
    for item, pull, margin in zip(whole, pulls, margins, strict=True):
        given = problem.label_of(item.source), item.rows, item.unit, item.times
        c = item.value(motion.q, motion.v, u) + margin
        found.append(ConstraintReport(*given, c, pull, item.source.equality))
    count = len(problem.bound_constraints)
    for i, more in zip(between.constraints, found[count:], strict=True):
        order = np.argsort(np.concatenate([found[i].t, more.t]), kind="stable")
        t, c, pull = (
            np.concatenate([getattr(found[i], name), getattr(more, name)])[order]
            for name in ("t", "values", "multipliers")
        )
        found[i] = replace(found[i], t=t, values=c, multipliers=pull)
    return tuple(found[:count])
