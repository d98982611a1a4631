"""The augmented Lagrangian of a problem with constraints: a problem without them, whose cost has their penalties.

Equations (P2) and (P3) of docs/plan-constraints.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.control.constraints import BoundConstraint, BoundRate
from varpin.control.costs import ControlRate, Expansion
from varpin.control.problem import OptimalControlProblem
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Passes that look for the constraints that their motion meets.
_PASSES = 60


@dataclass(frozen=True, eq=False)
class Penalty(Frozen):
    """The penalty (weight / 2) sum s^2 of one constraint, s = c + backoff + multipliers / weight.

    Of c <= 0, what of s is below zero costs nothing. It differs from the augmented Lagrangian's usual form by the
    constant multipliers^2 / (2 weight), and is never below zero.

    Attributes:
        bound: The constraint.
        multipliers: (K, rows).
        weight: > 0.
        backoff: (K, rows).
    """

    bound: BoundConstraint
    multipliers: Floats
    weight: float
    backoff: Floats

    @property
    def equality(self) -> bool:
        """Whether it is of c = 0."""
        return self.bound.source.equality

    def signed(self, c: Floats) -> Floats:
        """S of values (..., K, rows), not cut."""
        s: Floats = c + self.backoff + self.multipliers / self.weight
        return s

    def held(self, s: Floats) -> Mask:
        """Which of ``s`` cost something."""
        return np.ones(s.shape, dtype=np.bool_) if self.bound.source.equality else s > 0.0

    def shifted(self, c: Floats) -> Floats:
        """S of values (..., K, rows)."""
        s = self.signed(c)
        return s if self.bound.source.equality else np.maximum(s, 0.0)

    def shares(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """What it costs at each place (K,) of a motion."""
        s = self.shifted(self.bound.value(q, v, u))
        found: Floats = self.weight * 0.5 * (s * s).sum(axis=-1)
        return found

    def updated(self, c: Floats) -> Floats:
        """The next round's multipliers (K, rows), (P3), from the values ``c`` at this one's minimum."""
        return self.weight * self.shifted(c)


@dataclass(frozen=True, eq=False)
class PenalizedRate(Frozen):
    """What changes of the controls cost, the penalties of their limits included; as :class:`ControlRate`.

    Attributes:
        plain: Of the problem's cost; of weight zero where it has none.
        penalties: Of limits of the rate.
    """

    plain: ControlRate
    penalties: tuple[Penalty, ...]

    @property
    def weight(self) -> Floats:
        """That of the cost alone (m, m)."""
        return self.plain.weight

    @property
    def before(self) -> Floats | None:
        """The control before the horizon (m,)."""
        return self.plain.before

    def shares(self, u: Floats, period: float) -> Floats:
        """See :meth:`ControlRate.shares`."""
        found = self.plain.shares(u, period)
        for penalty in self.penalties:
            s = penalty.shifted(_rate_of(penalty).of_decisions(u))
            found[..., penalty.bound.places] += 0.5 * penalty.weight * (s * s).sum(axis=-1)
        return found

    def value(self, u: Floats, period: float) -> Floats:
        """See :meth:`ControlRate.value`."""
        total: Floats = self.shares(u, period).sum(axis=-1)
        return total

    def expand(self, u: Floats, period: float, held: Sequence[Mask] | None = None) -> tuple[Floats, Floats]:
        """See :meth:`ControlRate.expand`; of penalties, those of ``held`` rows, which cost something if left out."""
        gradient, hessian = self.plain.expand(u, period)
        for i, penalty in enumerate(self.penalties):
            bound = _rate_of(penalty)
            s, columns = penalty.signed(bound.of_decisions(u)), bound.limited
            pushed = penalty.held(s) if held is None else held[i]
            pull, count = np.where(pushed, s, 0.0), len(columns)
            gradient[np.ix_(bound.places, columns)] += penalty.weight / period * (pull[:, :count] - pull[:, count:])
            curved = penalty.weight / period**2 * (pushed[:, :count].astype(float) + pushed[:, count:])
            for c, column in enumerate(columns):
                hessian[bound.places, column, column] += curved[:, c]
        return gradient, hessian


def flat(parts: Sequence[Floats]) -> Floats:
    """Parts one after another (M,)."""
    return np.concatenate([np.ravel(part) for part in parts]) if parts else np.zeros(0)


def rate_columns(penalty: Penalty) -> NDArray[np.int64]:
    """Which controls a penalty of the rate limits."""
    return _rate_of(penalty).limited


def _rate_of(penalty: Penalty) -> BoundRate:
    bound = penalty.bound
    assert isinstance(bound, BoundRate)
    return bound


class PenalizedProblem(OptimalControlProblem):
    """A problem whose cost has the penalties of its constraints. Made by :func:`penalized`.

    Those of nodes are taken at the end of each step, beside the samples of the cost.

    Attributes:
        penalties: Of constraints on states.
        all_penalties: Of all constraints, in the problem's order.
        quiet: Whether plans leave the scene's noise out. With it, stiff penalties would count as what noise costs.
        passes: That a backward pass may take to find the rows that its motion meets.
    """

    penalties: tuple[Penalty, ...]
    all_penalties: tuple[Penalty, ...]
    quiet: bool
    passes: int

    @property
    def processes(self) -> int:
        """See :attr:`OptimalControlProblem.processes`."""
        return 0 if self.quiet else self.scene.processes

    @property
    def steered(self) -> Mask:
        """See :attr:`OptimalControlProblem.steered`."""
        return super().steered & (not self.quiet)

    @property
    def model_rule(self) -> Floats:
        """See :attr:`OptimalControlProblem.model_rule`."""
        # q and v of the node at the end of the step.
        node = [self.rule[0, 0], 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        return np.vstack([self.rule, node])

    def model_samples(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
        """See :meth:`OptimalControlProblem.model_samples`."""
        samples = self.samples(q, v, u)
        nodes = (q[1:], v[1:], u)
        steps = self.steps
        joined = [
            np.concatenate([x.reshape(steps, -1, x.shape[-1]), y[:, None]], axis=1)
            for x, y in zip(samples, nodes, strict=True)
        ]
        q, v, u = (x.reshape(-1, x.shape[-1]) for x in joined)
        return q, v, u

    def shares_along(self, q: Floats, v: Floats, u: Floats, compiled: Floats) -> Floats:
        """See :meth:`OptimalControlProblem.shares_along`."""
        shares = super().shares_along(q, v, u, compiled)
        return np.concatenate([shares, *(penalty.shares(q, v, u) for penalty in self.penalties)])

    def expand_running(self, trajectory: Trajectory) -> Expansion:
        """See :meth:`OptimalControlProblem.expand_running`; of penalties, the Hessians of Gauss and Newton."""
        q, v, u = trajectory.q, trajectory.v, trajectory.u
        s = [penalty.signed(penalty.bound.value(q, v, u)) for penalty in self.penalties]
        held = [penalty.held(signed) for penalty, signed in zip(self.penalties, s, strict=True)]
        J = [
            penalty.bound.jacobian(q, v) if mask.any() else np.zeros(())
            for penalty, mask in zip(self.penalties, held, strict=True)
        ]
        return self.with_held(super().expand_running(trajectory), s, J, held)

    def expand_cost(self, trajectory: Trajectory) -> Expansion:
        """The expansion of the running costs at their own samples, without penalties."""
        return super().expand_running(trajectory)

    def with_held(
        self, expansion: Expansion, shifted: Sequence[Floats], jacobians: Sequence[Floats], held: Sequence[Mask]
    ) -> Expansion:
        """The running costs' expansion with penalties of the rows that are ``held``, each (K, rows).

        ``shifted`` are what the penalties are squares of, and ``jacobians`` their derivatives.
        """
        N, size, x = self.steps, expansion.gradient.shape[1], 2 * self.scene.robot.dof
        gradient, hessian = np.zeros((N, size)), np.zeros((N, size, size))
        for penalty, s, J, rows in zip(self.penalties, shifted, jacobians, held, strict=True):
            if not rows.any():
                continue
            steps, counted = penalty.bound.places - 1, rows.astype(float)
            gradient[steps, :x] += penalty.weight * np.einsum("kr,krx->kx", s * counted, J)
            hessian[steps, :x, :x] += penalty.weight * (np.swapaxes(J, 1, 2) @ (counted[:, :, None] * J))
        # Samples of the model all weigh the same.
        weight = self.dt * float(self.rule[0, 0])
        gradients = np.concatenate([expansion.gradient.reshape(N, -1, size), gradient[:, None] / weight], axis=1)
        there = np.broadcast_to(expansion.hessian, (len(expansion.gradient), size, size)).reshape(N, -1, size, size)
        hessians = np.concatenate([there, hessian[:, None] / weight], axis=1)
        return Expansion(gradients.reshape(-1, size), hessians.reshape(-1, size, size))


def penalized(
    problem: OptimalControlProblem,
    multipliers: list[Floats],
    weights: Floats,
    backoff: list[Floats],
    *,
    quiet: bool = True,
    passes: int = _PASSES,
) -> PenalizedProblem:
    """The augmented Lagrangian of a problem.

    Args:
        problem: Its own.
        multipliers: Of each constraint (K, rows).
        weights: Of each penalty (C,); of weight zero there is none.
        backoff: Of each constraint (K, rows).
        quiet: Leave the scene's noise out.
        passes: That a backward pass may take at most to find the rows that its motion meets.
    """
    made = object.__new__(PenalizedProblem)
    parts = [
        Penalty(*parts)
        for parts in zip(problem.bound_constraints, multipliers, map(float, weights), backoff, strict=True)
        if parts[2] > 0.0
    ]
    on_rate = tuple(part for part in parts if part.bound.of_controls)
    changes: dict[str, object] = {
        "penalties": tuple(part for part in parts if not part.bound.of_controls),
        "all_penalties": tuple(parts),
    }
    changes |= {"constraints": (), "bound_constraints": (), "quiet": quiet, "passes": passes}
    if on_rate:
        rate = problem.rate
        if rate is None:
            m = problem.scene.controls
            rate = ControlRate(np.zeros((m, m)), _rate_of(on_rate[0]).before)
        changes["rate"] = PenalizedRate(rate, on_rate)
    # Past the dataclass, which refuses assignments.
    vars(made).update(vars(problem) | changes)
    return made
