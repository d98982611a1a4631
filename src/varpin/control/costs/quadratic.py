"""Quadratic costs of positions, velocities and controls."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats
from varpin.control.costs.base import (
    BoundCost,
    CompiledCost,
    Cost,
    Points,
    ReferenceValues,
    checked_weight,
    sample,
    weight_matrix,
)
from varpin.control.costs.terms import Terms
from varpin.support.checks import JointValues, as_floats, control_array, joint_array


class _Quadratic(Cost):
    """weight . (y - y_r)^2 for one block y of z."""

    weight: Floats | Mapping[str, float]
    reference: ReferenceValues | Mapping[str, float]
    block: str

    def __init__(self, reference: ReferenceValues | Mapping[str, float], weight: JointValues) -> None:
        self.weight = weight if isinstance(weight, Mapping) else checked_weight(type(self).__name__, weight)
        given = callable(reference) or isinstance(reference, Mapping)
        self.reference = reference if given else as_floats(f"{type(self).__name__} reference", reference)

    def _named(self, what: str, values: Mapping[str, float], points: Points) -> Floats:
        """What is given by the names of joints, in the order of the block."""
        name = f"{type(self).__name__} {what}"
        if self.block == "u":
            return control_array(name, values, points.control_joints)
        return joint_array(name, values, points.joints)

    def __repr__(self) -> str:
        weight = dict(self.weight) if isinstance(self.weight, Mapping) else self.weight.tolist()
        return f"{type(self).__name__}(weight={weight})"

    @property
    def nonnegative(self) -> bool:
        """See :attr:`Cost.nonnegative`."""
        return True

    @property
    def timed(self) -> bool:
        """See :attr:`Cost.timed`."""
        return callable(self.reference) or (not isinstance(self.reference, Mapping) and np.ndim(self.reference) > 1)

    def bind(self, points: Points) -> BoundCost:
        """See :meth:`Cost.bind`."""
        size = points.controls if self.block == "u" else points.dof
        begin = {"q": 0, "v": points.dof, "u": 2 * points.dof}[self.block]
        name, weight, values = type(self).__name__, self.weight, self.reference
        if isinstance(weight, Mapping):
            weight = checked_weight(name, self._named("weight", weight, points))
        if isinstance(values, Mapping):
            values = self._named("reference", values, points)
        reference = sample(name, values, points, size, held=self.block == "u")
        return _BoundQuadratic(begin, weight_matrix(name, weight, size), reference, points)


@dataclass(frozen=True, eq=False)
class _BoundQuadratic(CompiledCost):
    begin: int
    weight: Floats  # (size, size)
    reference: Floats  # (N, size) or (1, size)
    points: Points

    def add_to(self, terms: Terms, factor: float) -> bool:
        terms.add_entries(self.begin, factor * self.weight, self.reference)
        return True


class TrackingCost(_Quadratic):
    """weight . (q - q_r(t))^2: follow a reference in joint space."""

    block = "q"

    def __init__(self, reference: ReferenceValues | Mapping[str, float], weight: JointValues = 1.0) -> None:
        """Describe the cost.

        Args:
            reference: q_r: a function of the time [s] that returns (n,), a constant (n,), by joint name too, with 0 for
                joints that are not named, or an array (N + 1, n) of its values at the problem's nodes, between which it
                is linear [rad or m].
            weight: One number, (n,), by joint name, with 0 for joints that are not named, or a matrix (n, n), positive
                semidefinite.

        Raises:
            InputError: A weight that is not finite, indefinite, or neither number, vector nor square matrix.
        """
        super().__init__(reference, weight)


class VelocityCost(_Quadratic):
    """weight . (v - v_r(t))^2."""

    block = "v"

    def __init__(self, weight: JointValues = 1.0, reference: ReferenceValues | Mapping[str, float] = 0.0) -> None:
        """Describe the cost; see :class:`TrackingCost`."""
        super().__init__(reference, weight)


class ControlCost(_Quadratic):
    """weight . (u - u_r(t))^2."""

    block = "u"

    def __init__(self, weight: JointValues = 1.0, reference: ReferenceValues | Mapping[str, float] = 0.0) -> None:
        """Describe the cost; see :class:`TrackingCost`, with m controls for n coordinates.

        Args:
            weight: One number, (m,), by joint name where each control is the force of a joint, or a matrix (m, m),
                positive semidefinite.
            reference: u_r: a function of the time [s], a constant, by joint name too, or an array of rows of m: N + 1
                of them as there, or N, one for each step and constant over it, as controls are; for example those of
                another solution.
        """
        super().__init__(reference, weight)

    @property
    def of_controls(self) -> bool:
        """See :attr:`Cost.of_controls`."""
        return True
