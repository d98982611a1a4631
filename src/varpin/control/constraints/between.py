"""A constraint on states at instants between the nodes of a plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.control.constraints.base import BoundConstraint, Slopes
from varpin.control.parts import Parts


@dataclass(frozen=True, eq=False)
class BoundBetween(BoundConstraint):
    """A constraint at instants within steps, each integrated in parts from the node at its begin.

    The places are the nodes at the ends of the steps; several instants may be in one step.

    Attributes:
        inner: The constraint, bound to a grid whose nodes after the first are the instants.
        parts: The steps in parts, whose ends are the instants.
        samples: Which end of a part each instant is (K,), from 0.
        offset: What is added to the values (K, rows), for peaks between instants.
    """

    inner: BoundConstraint
    parts: Parts
    samples: Integers
    offset: Floats

    @property
    def begins(self) -> Integers:
        """Indices of the nodes at the begin of the steps (K,)."""
        return self.places - 1

    def _steps(self, q: Floats, v: Floats, u: Floats) -> tuple[Integers, tuple[Floats, Floats, Floats]]:
        """The index (K,) of each instant's step in the steps that have any, and q, v and controls of these."""
        steps, index = np.unique(self.begins, return_inverse=True)
        return index, (q[steps], v[steps], self.parts.controls(u, steps))

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """See :meth:`BoundConstraint.value`; for one motion. Infinite where a step fails in parts."""
        index, steps = self._steps(q, v, u)
        within = self.parts.states(*steps)
        if within is None:
            return np.full(self.shape, np.inf)
        q, v = (x[index, self.samples] for x in within)
        found: Floats = self.inner.value(_after_first(q), _after_first(v), u) + self.offset
        return found

    def jacobian(self, q: Floats, v: Floats) -> Floats:
        """dc/d(q, v) (K, rows, 2n) as at the ends of the steps."""
        return self.inner.jacobian(_after_first(q[self.places]), _after_first(v[self.places]))

    def slopes(self, q: Floats, v: Floats, u: Floats) -> Slopes:
        """See :meth:`BoundConstraint.slopes`.

        Raises:
            LinearizationError: A part of a step has no derivative.
        """
        index, steps = self._steps(q, v, u)
        inner, D = self.parts.slopes(*steps)
        q, v = (x[index, self.samples] for x in inner)
        J = self.inner.jacobian(_after_first(q), _after_first(v)) @ D[index, self.samples]
        x = 2 * q.shape[1]
        return Slopes(self.begins, J[:, :, :x], J[:, :, x:])


def _after_first(x: Floats) -> Floats:
    """Nodes (K + 1, n) whose last are the instants (K, n)."""
    return np.concatenate([x[:1], x])
