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


@dataclass(frozen=True, eq=False)
class BoundOnCubics(BoundConstraint):
    """A constraint within steps, at the same share of each, on the cubics through their nodes (q, v).

    The places are the nodes at the ends of the steps. Derivatives are those in (q, v) on the cubics.

    Attributes:
        inner: The constraint, bound to a grid whose nodes after the first are the instants.
        share: Where the instants are in a step of unit length.
        coefficients: Those of (q0, v0, q1, v1) of a step, for q, then for v (8,).
    """

    inner: BoundConstraint
    share: float
    coefficients: Floats

    def states(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        """The q and v (..., K, n) on the cubics of motions (..., N + 1, n)."""
        nodes = [x[..., self.places - back, :] for back in (1, 0) for x in (q, v)]
        found = [sum(c * x for c, x in zip(self.coefficients[half : half + 4], nodes, strict=True)) for half in (0, 4)]
        return np.asarray(found[0]), np.asarray(found[1])

    def by_nodes(self, of_state: Floats) -> tuple[Floats, Floats]:
        """Derivatives (K, rows, 2n) in (q, v) at the nodes before and after, of those ``of_state`` on the cubics."""
        n, c = of_state.shape[2] // 2, self.coefficients
        by_q, by_v = of_state[:, :, :n], of_state[:, :, n:]
        before, after = (
            np.concatenate([c[i] * by_q + c[i + 4] * by_v, c[i + 1] * by_q + c[i + 5] * by_v], axis=2) for i in (0, 2)
        )
        return before, after

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """See :meth:`BoundConstraint.value`."""
        q, v = self.states(q, v)
        return self.inner.value(_after_first(q), _after_first(v), u)

    def jacobian(self, q: Floats, v: Floats) -> Floats:
        """dc/d(q, v) (K, rows, 2n), in the states on the cubics."""
        q, v = self.states(q, v)
        return self.inner.jacobian(_after_first(q), _after_first(v))


def _after_first(x: Floats) -> Floats:
    """Nodes (..., K + 1, n) whose last are the instants (..., K, n)."""
    return np.concatenate([x[..., :1, :], x], axis=-2)
