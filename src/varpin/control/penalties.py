"""The augmented Lagrangian of a constrained problem: an unconstrained one with penalties in its cost.

Equations (P2) and (P3) of docs/plan-constraints.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers, Mask
from varpin.control.constraints import BoundBetween, BoundConstraint, BoundOnCubics, BoundRate, Slopes
from varpin.control.costs import ControlRate, Expansion
from varpin.control.problem import OptimalControlProblem
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

T = TypeVar("T", np.float64, np.bool_)

# Greatest number of backward passes that determine the active rows of the penalties.
_PASSES = 60


@dataclass(frozen=True, eq=False)
class Penalty(Frozen):
    """The penalty (weight / 2) sum s^2 of one constraint, (P2), with s = c + backoff + multipliers / weight.

    For c <= 0, negative s costs nothing. The penalty differs from the usual form of the augmented Lagrangian by the
    constant multipliers^2 / (2 weight), and is never negative.

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
        """Whether the constraint is c = 0."""
        return self.bound.source.equality

    def signed(self, c: Floats) -> Floats:
        """The shifted values s = c + backoff + multipliers / weight (..., K, rows)."""
        s: Floats = c + self.backoff + self.multipliers / self.weight
        return s

    def held(self, s: Floats) -> Mask:
        """Which rows of ``s`` are active, that is, have a cost."""
        return np.ones(s.shape, dtype=np.bool_) if self.bound.source.equality else s > 0.0

    def shifted(self, c: Floats) -> Floats:
        """The shifted values s (..., K, rows), zero where the row is inactive."""
        s = self.signed(c)
        return s if self.bound.source.equality else np.maximum(s, 0.0)

    def shares(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """The cost of the penalty at each of its places (K,) on a motion."""
        s = self.shifted(self.bound.value(q, v, u))
        found: Floats = self.weight * 0.5 * (s * s).sum(axis=-1)
        return found

    def updated(self, c: Floats) -> Floats:
        """Multipliers of the next round (K, rows), (P3), from the values ``c`` at the minimum of this one."""
        return self.weight * self.shifted(c)


@dataclass(frozen=True, eq=False)
class PenalizedRate(Frozen):
    """Cost of changes of the controls plus the penalties of rate limits; with the interface of :class:`ControlRate`.

    Attributes:
        plain: The rate cost of the problem; of weight zero where it has none.
        penalties: The penalties of rate limits.
    """

    plain: ControlRate
    penalties: tuple[Penalty, ...]

    @property
    def weight(self) -> Floats:
        """Weight of the rate cost without penalties (m, m)."""
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

    def expand(
        self,
        u: Floats,
        period: float,
        held: Sequence[Mask | Floats] | None = None,
        shifted: Sequence[Floats] | None = None,
    ) -> tuple[Floats, Floats]:
        """See :meth:`ControlRate.expand`.

        ``held`` selects the penalty rows, by default the active ones, or has shares of their weights; ``shifted`` are
        their shifted values, by default those at ``u``.
        """
        gradient, hessian = self.plain.expand(u, period)
        for i, penalty in enumerate(self.penalties):
            bound = _rate_of(penalty)
            s = penalty.signed(bound.of_decisions(u)) if shifted is None else shifted[i]
            pushed = (penalty.held(s) if held is None else held[i]).astype(float)
            columns, pull = bound.limited, pushed * s
            count = len(columns)
            gradient[np.ix_(bound.places, columns)] += penalty.weight / period * (pull[:, :count] - pull[:, count:])
            curved = penalty.weight / period**2 * (pushed[:, :count] + pushed[:, count:])
            for c, column in enumerate(columns):
                hessian[bound.places, column, column] += curved[:, c]
        return gradient, hessian


def flat(parts: Sequence[NDArray[T]]) -> NDArray[T]:
    """Concatenate the entries of all parts (M,)."""
    found: NDArray[Any] = np.concatenate([np.ravel(part) for part in parts]) if parts else np.zeros(0)
    return found


def split(like: Sequence[NDArray[Any] | BoundConstraint], flattened: NDArray[T]) -> list[NDArray[T]]:
    """Inverse of :func:`flat`: of entries (M,) the parts in the shapes of arrays or of constraints' values."""
    ends = np.cumsum([item.size for item in like])
    return [part.reshape(item.shape) for part, item in zip(np.split(flattened, ends[:-1]), like, strict=True)]


def controls_of_steps(problem: OptimalControlProblem, u: Floats, steps: Integers) -> Floats:
    """Of decisions (R, m) those of steps (K,): the control of each (K, m), or those at both its ends (K, 2m)."""
    if problem.linear:
        return np.concatenate([u[steps], u[steps + 1]], axis=1)
    found: Floats = u[steps // problem.hold]
    return found


def rate_columns(penalty: Penalty) -> Integers:
    """Indices of the controls that a rate penalty limits."""
    return _rate_of(penalty).limited


def _rate_of(penalty: Penalty) -> BoundRate:
    bound = penalty.bound
    assert isinstance(bound, BoundRate)
    return bound


class PenalizedProblem(OptimalControlProblem):
    """A problem with the penalties of its constraints in the cost. Made by :func:`penalized`.

    Penalties of states are evaluated at the end of each step, in addition to the samples of the cost. Those at instants
    within steps are functions of the state at the begin of their step and of its controls; those on the cubics through
    the steps have samples of their own.

    Attributes:
        penalties: Penalties of constraints on states.
        cubic: One of the constraints on the cubics, None without any.
        within: Whether there are rows within steps.
        all_penalties: Penalties of all constraints, in the problem's order.
        quiet: Whether plans leave the scene's noise out: otherwise stiff penalties would add to the noise cost.
        passes: Greatest number of passes that determine the active rows, interior-point steps left out; 0 keeps those
            of the nominal motion.
        until: Time (of ``time.perf_counter``) after which there is no further one of them.
        given: The given first controls, where controls are linear between nodes.
        later: Whether the search is that of a later round, close to the plan, with heavy penalties.
    """

    penalties: tuple[Penalty, ...]
    within: bool
    cubic: BoundOnCubics | None
    all_penalties: tuple[Penalty, ...]
    quiet: bool
    passes: int
    until: float
    given: Floats | None
    later: bool

    @property
    def begin(self) -> Floats | None:
        """See :attr:`OptimalControlProblem.begin`."""
        return self.given

    @property
    def processes(self) -> int:
        """See :attr:`OptimalControlProblem.processes`."""
        return 0 if self.quiet else self.scene.processes

    @property
    def steered(self) -> Mask:
        """See :attr:`OptimalControlProblem.steered`."""
        return super().steered & (not self.quiet)

    @cached_property
    def model_rule(self) -> Floats:
        """See :attr:`OptimalControlProblem.model_rule`."""
        # Weight, and coefficients that select q and v at the end of the step.
        node = [self.rule[0, 0], 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        # With linear controls rows within steps depend on the controls at both ends, see Expansion.begun.
        begin = [self.rule[0, 0], 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
        rows: list[Floats | list[float]] = [self.rule, node, begin] if self._begins else [self.rule, node]
        if self.cubic is not None:
            rows.append(np.append(self.rule[0, 0], self.cubic.coefficients))
        found = np.vstack(rows)
        found.setflags(write=False)
        return found

    @property
    def _begins(self) -> bool:
        """Whether the begin of each step is a sample point."""
        return self.within and not self.linear

    @property
    def at_velocities(self) -> bool:
        """See :attr:`OptimalControlProblem.at_velocities`."""
        return True

    @property
    def model_places(self) -> Floats:
        """See :attr:`OptimalControlProblem.model_places`."""
        shares = [1.0, 0.0] if self._begins else [1.0]
        return np.concatenate([self.places, shares if self.cubic is None else [*shares, self.cubic.share]])

    def model_samples(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
        """See :meth:`OptimalControlProblem.model_samples`."""
        samples = self.samples(q, v, u)
        nodes = (q[1:], v[1:], u[1:] if self.linear else u)
        steps = self.steps
        joined = [
            np.concatenate([x.reshape(steps, -1, x.shape[-1]), y[:, None]], axis=1)
            for x, y in zip(samples, nodes, strict=True)
        ]
        if self._begins:
            begins = (q[:-1], v[:-1], u)
            joined = [np.concatenate([x, y[:, None]], axis=1) for x, y in zip(joined, begins, strict=True)]
        if self.cubic is not None:
            share = self.cubic.share
            middles = (*self.cubic.states(q, v), (1.0 - share) * u[:-1] + share * u[1:])
            joined = [np.concatenate([x, y[:, None]], axis=1) for x, y in zip(joined, middles, strict=True)]
        q, v, u = (x.reshape(-1, x.shape[-1]) for x in joined)
        return q, v, u

    def shares_along(self, q: Floats, v: Floats, u: Floats, compiled: Floats) -> Floats:
        """See :meth:`OptimalControlProblem.shares_along`."""
        shares = super().shares_along(q, v, u, compiled)
        return np.concatenate([shares, *(penalty.shares(q, v, u) for penalty in self.penalties)])

    def expand_running(self, trajectory: Trajectory) -> Expansion:
        """See :meth:`OptimalControlProblem.expand_running`; penalties have Gauss-Newton Hessians.

        Those of rows that follow peaks between nodes have their second derivatives, too.
        """
        q, v, u = trajectory.q, trajectory.v, self.control_rows(trajectory)
        s = [penalty.signed(penalty.bound.value(q, v, u)) for penalty in self.penalties]
        held = [penalty.held(signed) for penalty, signed in zip(self.penalties, s, strict=True)]
        slopes = [
            penalty.bound.slopes(q, v, u) if mask.any() else None
            for penalty, mask in zip(self.penalties, held, strict=True)
        ]
        return self.with_held(super().expand_running(trajectory), s, slopes, held)

    def expand_cost(self, trajectory: Trajectory) -> Expansion:
        """The expansion of the running costs at their own samples, without penalties."""
        return super().expand_running(trajectory)

    def with_held(
        self,
        expansion: Expansion,
        shifted: Sequence[Floats],
        slopes: Sequence[Slopes | None],
        held: Sequence[Mask | Floats],
        multipliers: Sequence[Floats] | None = None,
    ) -> Expansion:
        """The running costs' expansion plus the penalties of the rows in ``held``, each (K, rows).

        ``held`` has either flags or shares of the rows' weights.
        ``shifted`` are the values whose squares are penalized (:meth:`Penalty.signed`), ``slopes`` their derivatives,
        None where no row is in ``held``. With ``multipliers`` second derivatives of rows count; by default those that
        follow from ``shifted``.
        """
        N, size, x, m = self.steps, expansion.gradient.shape[1], 2 * self.scene.robot.dof, self.scene.controls
        ends = np.zeros((N, size)), np.zeros((N, size, size))
        wide = x + 2 * m if self.linear else size
        begins = np.zeros((N, wide)), np.zeros((N, wide, wide))
        middles = np.zeros((N, size)), np.zeros((N, size, size))
        pushes = [None] * len(self.penalties) if multipliers is None else multipliers
        for penalty, s, found, rows, push in zip(self.penalties, shifted, slopes, held, pushes, strict=True):
            if found is None or not rows.any():
                continue
            within = isinstance(penalty.bound, BoundBetween)
            counted: Floats = penalty.weight * rows.astype(np.float64)
            J = found.in_step()
            z, (gradient, hessian) = slice(0, J.shape[2]), begins if within else ends
            if isinstance(penalty.bound, BoundOnCubics):
                gradient, hessian = middles
            steps = found.nodes if within else found.nodes - 1
            of_step, pull, weighed = _by_step(steps, N, J, counted, s)
            gradient[:, z] += (of_step @ (weighed * pull)[:, :, None])[:, :, 0]
            hessian[:, z, z] += of_step @ (weighed[:, :, None] * np.swapaxes(of_step, 1, 2))
            if found.curved is not None:
                pushed = counted * np.maximum(s, 0.0) if push is None else rows.astype(np.float64) * push
                of_step, _, weighed = _by_step(steps, N, found.curved, pushed, s)
                hessian[:, z, z] += of_step @ (weighed[:, :, None] * np.swapaxes(of_step, 1, 2))
        # All samples of the model have the same weight.
        weight = self.dt * float(self.rule[0, 0])
        added = [ends, begins] if self._begins else [ends]
        added += [] if self.cubic is None else [middles]
        own = len(expansion.gradient) // N
        gradients, hessians = np.empty((N, own + len(added), size)), np.empty((N, own + len(added), size, size))
        gradients[:, :own] = expansion.gradient.reshape(N, own, size)
        same = len(expansion.hessian) == 1
        hessians[:, :own] = expansion.hessian if same else expansion.hessian.reshape(N, own, size, size)
        for sample, (gradient, hessian) in enumerate(added, start=own):
            np.divide(gradient, weight, out=gradients[:, sample])
            np.divide(hessian, weight, out=hessians[:, sample])
        begun = Expansion(begins[0] / self.dt, begins[1] / self.dt) if self.within and self.linear else None
        return Expansion(gradients.reshape(-1, size), hessians.reshape(-1, size, size), begun)


def _by_step(steps: Integers, count: int, J: Floats, weights: Floats, values: Floats) -> tuple[Floats, Floats, Floats]:
    """Rows with a weight, gathered by step.

    Returns their derivatives (N, columns, P), values (N, P) and weights (N, P), filled up with zeros; P is the greatest
    number of such rows in a step.

    Args:
        steps: The step of each place (K,), in ascending order as places are; a step may have several.
        count: Number of steps N.
        J: Derivatives of the rows (K, rows, columns).
        weights: Of the rows (K, rows).
        values: Of the rows (K, rows).
    """
    places, rows = np.nonzero(weights)
    own = steps[places]
    counts = np.bincount(own, minlength=count)
    slot = np.arange(len(own)) - np.repeat(np.cumsum(counts) - counts, counts)
    most = int(counts.max(initial=0))
    slopes = np.zeros((count, J.shape[2], most))
    slopes[own, :, slot] = J[places, rows]
    both = np.zeros((2, count, most))
    both[0, own, slot], both[1, own, slot] = values[places, rows], weights[places, rows]
    return slopes, both[0], both[1]


def weights_for(cost: float, bound: Sequence[BoundConstraint]) -> Floats:
    """Weights (C,) of penalties with which a violation of a constraint's scale costs about ``cost``.

    The cost is divided by the root of the number of places, as some of them are violated at a time.
    """
    return np.array([cost / item.scale**2 / np.sqrt(len(item.places)) for item in bound])


def penalized(
    problem: OptimalControlProblem,
    multipliers: list[Floats],
    weights: Floats,
    backoff: list[Floats],
    *,
    quiet: bool = True,
    passes: int = _PASSES,
    until: float = math.inf,
    later: bool = False,
) -> PenalizedProblem:
    """The augmented Lagrangian of a problem.

    Args:
        problem: The constrained problem.
        multipliers: For each constraint (K, rows).
        weights: One for each constraint (C,); weight zero means no penalty.
        backoff: For each constraint (K, rows).
        quiet: Leave the scene's noise out.
        passes: Greatest number of backward passes that determine the active rows.
        until: Time (of ``time.perf_counter``) after which there is no further one of them.
        later: Whether the search is that of a later round.
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
        "within": any(isinstance(part.bound, BoundBetween) for part in parts),
        "cubic": next((part.bound for part in parts if isinstance(part.bound, BoundOnCubics)), None),
    }
    changes |= {"constraints": (), "bound_constraints": (), "quiet": quiet, "passes": passes, "until": until}
    if on_rate:
        rate = problem.rate
        if rate is None:
            m = problem.scene.controls
            rate = ControlRate(np.zeros((m, m)), _rate_of(on_rate[0]).before)
        changes["rate"] = PenalizedRate(rate, on_rate)
    changes |= {"given": problem.begin, "later": later}
    # The dataclass is frozen: attributes are set in its dictionary.
    vars(made).update(vars(problem) | changes)
    # Other penalties may have other samples.
    vars(made).pop("model_rule", None)
    return made
