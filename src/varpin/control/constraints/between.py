"""A constraint on states at instants between the nodes of a plan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats, Integers, Mask
from varpin.control.constraints.base import BoundConstraint, Slopes
from varpin.control.parts import Parts


@dataclass(frozen=True, eq=False)
class BoundBetween(BoundConstraint):
    """A constraint at instants within steps, each integrated in parts from the node at its begin.

    The value at an instant is that of the parabola through the ends of parts next to it. The places are the nodes at
    the ends of the steps; several instants may be in one step. The times are means of those of the rows.

    Attributes:
        of_nodes: The constraint at the nodes, all after the first.
        parts: The steps in parts.
        steps: The steps with instants (S,), ascending.
        samples: Index in ``steps`` and end of a part (U, 2) of each state at which the constraint is evaluated.
        inner: The constraint, bound to a grid whose nodes after the first are these states.
        near: Which of them are the ends of parts of an instant's step (K, parts + 1); any where the weights are zero.
        weights: Their weights in each row (K, rows, parts + 1); all zero in rows that are not enforced.
    """

    of_nodes: BoundConstraint
    parts: Parts
    steps: Integers
    samples: Integers
    inner: BoundConstraint
    near: Integers
    weights: Floats

    @property
    def in_force(self) -> Mask:
        """Which rows are enforced (K, rows); others have minus the scale for a value."""
        return np.asarray(self.weights.any(axis=2))

    @property
    def begins(self) -> Integers:
        """Indices of the nodes at the begin of the steps (K,)."""
        return self.places - 1

    def _within(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
        """q, v and controls of the steps with instants."""
        return q[self.steps], v[self.steps], self.parts.controls(u, self.steps)

    def value(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """See :meth:`BoundConstraint.value`; for one motion. Infinite where a step fails in parts."""
        within = self.parts.states(*self._within(q, v, u))
        if within is None:
            return np.full(self.shape, np.inf)
        q, v = (_after_first(x[tuple(self.samples.T)]) for x in within)
        c = self.inner.value(q, v, u)[self.near]
        found = np.einsum("krs,ksr->kr", self.weights, c)
        return np.where(self.in_force, found, -self.scale)

    def jacobian(self, q: Floats, v: Floats) -> Floats:
        """dc/d(q, v) (K, rows, 2n) as at the ends of the steps."""
        return self.of_nodes.jacobian(q, v)[self.begins]

    def slopes(self, q: Floats, v: Floats, u: Floats) -> Slopes:
        """See :meth:`BoundConstraint.slopes`.

        Raises:
            LinearizationError: A part of a step has no derivative.
        """
        within, D = self.parts.slopes(*self._within(q, v, u))
        q, v = (_after_first(x[tuple(self.samples.T)]) for x in within)
        J = (self.inner.jacobian(q, v) @ D[tuple(self.samples.T)])[self.near]
        found = np.einsum("krs,ksrz->krz", self.weights, J)
        x = D.shape[2]
        return Slopes(self.begins, found[:, :, :x], found[:, :, x:])


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
