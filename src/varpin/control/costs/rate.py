"""The cost of control changes, which couples each decision to the previous one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats
from varpin.control.costs.base import (
    BoundCost,
    Cost,
    CostSum,
    LeastSquares,
    Points,
    checked_weight,
    plain,
    weight_matrix,
)
from varpin.errors import InputError
from varpin.support.checks import JointValues, as_floats, control_array, control_values
from varpin.support.frozen import Frozen


class ControlRateCost(LeastSquares):
    """weight . (du/dt)^2: keep controls smooth.

    Controls are constant over a period T = hold dt and jump between periods. The cost is the integral of the squared
    rate of the line through them, the sum over decisions of weight . (u_k - u_(k-1))^2 / T. For controls that are
    smooth in time it is the same at every ``dt``, up to an error of order T.
    """

    before: Floats | Mapping[str, float] | None
    of_controls = True

    def __init__(self, weight: JointValues = 1.0, before: JointValues | None = None) -> None:
        """Describe the cost.

        Args:
            weight: One number, (m,), by joint name where each control is the force of a joint, or a matrix (m, m),
                positive semidefinite [cost s / control^2].
            before: The control before the horizon, for the first change: one number, (m,) or by joint name. By default
                the first control is free.
        """
        self.weight = weight if isinstance(weight, Mapping) else checked_weight("ControlRateCost", weight)
        self.before = (
            before if before is None or isinstance(before, Mapping) else as_floats("ControlRateCost before", before)
        )

    def _text(self) -> str:
        own = super()._text()
        return own if self.before is None else f"{own[:-1]}, before={plain(self.before)})"

    def bind(self, points: Points) -> BoundCost:  # noqa: ARG002
        """Raise an error: the cost has no value at single points, and a problem takes it by :func:`control_rate`.

        Raises:
            InputError: Always: the cost is part of another cost than a sum.
        """
        raise InputError(f"{self!r} must be a term of a problem's cost, scaled or not, and no part of another")


@dataclass(frozen=True, eq=False)
class ControlRate(Frozen):
    """The total cost of control changes, (O5).

    Attributes:
        weight: (m, m).
        before: The control before the horizon (m,), or None where the first one is free.
    """

    weight: Floats
    before: Floats | None

    def shares(self, u: Floats, period: float) -> Floats:
        """Costs (..., N) of the changes to each of N controls (..., N, m) that change every ``period`` [s]."""
        changes = self._changes(u)
        shares: Floats = ((changes @ (self.weight / period)) * changes).sum(axis=-1)
        return shares

    def expand(self, u: Floats, period: float) -> tuple[Floats, Floats]:
        """Gradients (N, m) and Hessians (N, m, m) in u_k of the cost of each change, at controls (N, m)."""
        hessian = np.tile(2.0 * self.weight / period, (len(u), 1, 1))
        if self.before is None:
            hessian[:1] = 0.0
        return 2.0 * self._changes(u) @ (self.weight / period), hessian

    def _changes(self, u: Floats) -> Floats:
        """The change to each control (..., N, m); none to a first one that is free."""
        first = u[..., :1, :]
        changes: Floats = np.diff(u, axis=-2, prepend=first if self.before is None else first * 0.0 + self.before)
        return changes


def control_rate(cost: Cost, controls: int, joints: Sequence[str] | None = None) -> ControlRate | None:
    """The sum of a cost's terms on the rate of m controls; None if there is none.

    ``joints`` are those whose force each control is; None where controls are something else.

    Raises:
        UnknownJoint: A name that is no driven joint's.
        InputError: Weights or controls of a wrong size, or terms with different controls before.
    """
    name = "ControlRateCost"
    weight = np.zeros((controls, controls))
    starts: dict[object, Floats | None] = {}
    for term in cost.terms:
        if not isinstance(term, ControlRateCost):
            continue
        entries = term.weight
        if isinstance(entries, Mapping):
            entries = checked_weight(name, control_array(f"{name} weight", entries, joints))
        weight += term.factor * weight_matrix(name, entries, controls)
        start = term.before
        if start is not None:
            start = control_values(f"{name} before", start, joints, controls, uniform=True)
        starts[None if start is None else tuple(start.tolist())] = start
    if len(starts) > 1:
        raise InputError(f"{name} terms of one cost must have the same control before")
    return ControlRate(weight, *starts.values()) if starts else None


def with_control_before(cost: Cost, before: JointValues) -> Cost:
    """The same cost with another control before the horizon."""
    terms = [
        ControlRateCost(term.weight, before).changed(factor=term.factor) if isinstance(term, ControlRateCost) else term
        for term in cost.terms
    ]
    return CostSum(tuple(terms))
