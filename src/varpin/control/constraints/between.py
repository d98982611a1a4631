"""A constraint on states at instants between the nodes of a plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.control.constraints.base import BoundConstraint


@dataclass(frozen=True, eq=False)
class BoundBetween(BoundConstraint):
    """A constraint at instants within steps, on the cubic through the nodes of the step and their velocities.

    The places are the nodes at the ends of the steps; several instants may be in one step.

    Attributes:
        inner: The constraint, bound to a grid whose nodes after the first are the instants.
        shares: Where instants are in a step of unit length (i,).
        samples: Which of them each one is (K,).
        rule: Coefficients (K, 8) of (q, v) at the begin and the end of the step for q, then those for v.
        offset: What is added to the values (K, rows): those of the motion less those of the cubic.
    """

    inner: BoundConstraint
    shares: Floats
    samples: Integers
    rule: Floats
    offset: Floats

    def states(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        """The q and v (..., K, n) of the cubics at the instants, from those at the nodes (..., N + 1, n)."""
        ends = (q[..., self.places - 1, :], v[..., self.places - 1, :], q[..., self.places, :], v[..., self.places, :])
        at_q, at_v = (
            sum(row[:, None] * end for row, end in zip(rule.T, ends, strict=True))
            for rule in (self.rule[:, :4], self.rule[:, 4:])
        )
        return np.asarray(at_q), np.asarray(at_v)

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """See :meth:`BoundConstraint.value`."""
        found: Floats = self.at(*self.states(q, v), u) + self.offset
        return found

    def at(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """The values (..., K, rows) at states (..., K, n) of the instants, without offsets."""
        q, v = (np.concatenate([x[..., :1, :], x], axis=-2) for x in (q, v))
        return self.inner.value(q, v, u)

    def jacobian(self, q: Floats, v: Floats) -> Floats:
        """The derivatives (K, rows, 2n) in (q, v) at the instants."""
        q, v = self.states(q, v)
        return self.inner.jacobian(np.concatenate([q[:1], q]), np.concatenate([v[:1], v]))

    def of_nodes(self, q: Floats, v: Floats) -> list[tuple[Integers, Floats]]:
        """See :meth:`BoundConstraint.of_nodes`."""
        J, n = self.jacobian(q, v), q.shape[-1]
        by_q, by_v, rule = J[:, :, :n], J[:, :, n:], self.rule[:, :, None, None]
        parts = [rule[:, i] * by_q + rule[:, 4 + i] * by_v for i in range(4)]
        return [
            (self.places - 1, np.concatenate(parts[:2], axis=2)),
            (self.places, np.concatenate(parts[2:], axis=2)),
        ]
