"""The rows of penalties around a motion, and which of them are active on a linearized motion."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers, Mask
from varpin.control.along import Along
from varpin.control.constraints import BoundOnCubics
from varpin.control.passes import Plan, foreseen
from varpin.control.penalties import PenalizedProblem, PenalizedRate, T, controls_of_steps, flat, rate_columns, split

# Bisections of the line search between two passes.
_BISECTIONS = 40


class Rows:
    """The rows of all penalties around a motion; passes along it differ in their active rows."""

    def __init__(self, along: Along, problem: PenalizedProblem) -> None:
        self.whole, self.problem, motion = along, problem, along.trajectory
        # Linearized once, before the expansions are copied for each pass.
        velocity = along.of_lines.velocity if problem.linear else along.linearized(0, problem.steps)[1]
        if problem.linear:
            _ = along.sampled
        q, v, u = motion.q, motion.v, problem.control_rows(motion)
        self.of_nodes = problem.penalties
        self.of_rate = tuple(item for item in problem.all_penalties if item.bound.of_controls)
        self.penalties = (*self.of_nodes, *self.of_rate)
        self.unpenalized = problem.expand_cost(motion)
        self.signed = [item.signed(item.bound.value(q, v, u)) for item in self.penalties]
        self.begun = [item.held(s) for item, s in zip(self.penalties, self.signed, strict=True)]
        self.slopes = [item.bound.slopes(q, v, u) for item in self.of_nodes]
        count = len(self.of_nodes)
        along.expanded(problem.with_held(self.unpenalized, self.signed[:count], self.slopes, self.begun[:count]))
        # Of all rows.
        self.weights = flat(
            [np.full(s.shape, item.weight) for item, s in zip(self.penalties, self.signed, strict=True)]
        )
        self.equal = (
            flat([np.full(s.shape, item.equality) for item, s in zip(self.penalties, self.signed, strict=True)]) > 0
        )
        # The present point of the steps to the model's minimum: its rows, and the change of the cost without penalties.
        self.at, self.cost = self.signed, 0.0
        # Changes of controls and states at this point, and the model's slope from its start in that direction.
        self.moves = np.zeros((problem.decisions, u.shape[1]))
        self.states, self.slope = np.zeros((len(q), 2 * q.shape[1])), 0.0
        # What regularizes all passes: the Hessian's diagonal of a further cost of the changes of controls (R, m).
        self.proximal: Floats | None = None
        # d(q, v)/dx at the nodes.
        n = problem.scene.robot.dof
        slopes = np.tile(np.eye(2 * n), (len(q), 1, 1))
        if problem.integrator.variational:
            slopes[:, n:] = velocity
        # For each penalty the nodes (K,) whose states its rows depend on, and their derivatives (K, rows, 2n) in these.
        self.by_state: list[list[tuple[Integers, Floats]]] = []
        for item, found in zip(self.of_nodes, self.slopes, strict=True):
            parts = [(found.nodes, found.by_state)]
            if isinstance(item.bound, BoundOnCubics):
                parts = list(zip((found.nodes - 1, found.nodes), item.bound.by_nodes(found.by_state), strict=True))
            self.by_state.append([(nodes, by_state @ slopes[nodes]) for nodes, by_state in parts])

    def held(self, ahead: list[Floats]) -> list[Mask]:
        """The rows that are active where the shifted values are ``ahead``."""
        return [item.held(s) for item, s in zip(self.penalties, ahead, strict=True)]

    def split(self, values: NDArray[T]) -> list[NDArray[T]]:
        """Values of all rows, in the shapes of the penalties."""
        return split(self.signed, values)

    def in_order(self, held: Sequence[Mask]) -> Mask:
        """The active rows of all penalties (M,) in the problem's order; here those of control rates are last."""
        return flat([held[self.penalties.index(item)] for item in self.problem.all_penalties])

    def from_order(self, rows: Mask) -> list[Mask]:
        """Active rows from those in the problem's order, see :meth:`in_order`."""
        everything = self.problem.all_penalties
        parts = split([item.bound for item in everything], rows)
        return [parts[everything.index(item)] for item in self.penalties]

    def along(self, held: Sequence[Mask | Floats], shifted: list[Floats] | None = None) -> Along:
        """Expansions for a pass with the active rows ``held``, or with these shares of the rows' weights.

        ``shifted`` are the rows' shifted values at the nominal motion, by default those of the penalties.
        """
        passing = copy(self.whole)
        for name in ("model", "line"):
            vars(passing).pop(name, None)
        count, signed = len(self.of_nodes), self.signed if shifted is None else shifted
        passing.running = self.problem.with_held(self.unpenalized, signed[:count], self.slopes, held[:count])
        rate = self.problem.rate
        if isinstance(rate, PenalizedRate):
            u = self.problem.decided(self.whole.trajectory)
            passing.pull, passing.rate = rate.expand(u, self.problem.period, held[count:], signed[count:])
        return passing if self.proximal is None else passing.regularized(self.proximal)

    def ahead(self, passing: Along, plan: Plan, slack: Floats | None = None) -> list[Floats]:
        """The penalties' shifted values on the linearized motion under a plan, with its controls clipped to ``slack``.

        By default ``slack`` (R, 2, m) is that of the control limits.
        """
        problem, x = self.problem, self.states.shape[1]
        ((_, steps),) = passing.blocks
        states = np.zeros((steps + 1, passing.states))
        moves = foreseen(passing, plan, slack, after=states[1:]).moves
        # With linear controls the first step is the one that sets the first control.
        states = states[steps - problem.steps :, :x]
        self.ahead_of = states, moves
        found = []
        for s, parts, rows in zip(self.signed[: len(self.of_nodes)], self.by_state, self.slopes, strict=True):
            after = s
            for nodes, J in parts:
                after = after + np.einsum("krx,kx->kr", J, states[nodes])
            if rows.by_controls.size:
                after += np.einsum("krc,kc->kr", rows.by_controls, controls_of_steps(problem, moves, rows.nodes))
            found.append(after)
        for item, s in zip(self.of_rate, self.signed[len(self.of_nodes) :], strict=True):
            bound = item.bound
            rate = np.diff(moves, axis=0, prepend=np.zeros_like(moves[:1])) / problem.period
            rate = rate[bound.places][:, rate_columns(item)]
            found.append(s + np.concatenate([rate, -rate], axis=1))
        return found

    def move(self, plan: Plan, held: list[Mask], ahead: list[Floats], along: float, *, whole: bool = False) -> None:
        """Exact line search towards ``ahead``, the minimum of the model with active rows ``held``, or all the way.

        ``along`` is the slope of the model at its start in the direction of ``ahead``.
        """
        at, to = flat(self.at), flat(ahead)
        counts = np.concatenate([rows.ravel() for rows in held])
        weights, equal = self.weights, self.equal
        way, of_held = to - at, np.where(counts, weights, 0.0)
        least = 0.5 * float(of_held @ flat(self.signed) ** 2) - plan.expected_decrease
        gap = self.cost + 0.5 * float(of_held @ at**2) - least
        states, moves = self.ahead_of
        # Within limits the model's slope at its minimum is that of the controls pressed against them.
        last = 0.0 if plan.left is None else min(float((plan.left * (moves - self.moves)).sum()), 0.0)
        curved = max(gap + last, 0.0)

        def slope(t: float) -> float:
            s = at + t * way
            pull = np.where(equal | (s > 0.0), weights, 0.0) - of_held
            return float((pull * s) @ way) + last - 2.0 * (1.0 - t) * curved

        low, high = 0.0, 1.0
        if whole or slope(high) <= 0.0:
            low = high
        for _ in range(_BISECTIONS if low < high else 0):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if slope(middle) <= 0.0 else (low, middle)
        self.at = [a + low * (b - a) for a, b in zip(self.at, ahead, strict=True)]
        rest = 1.0 - low
        self.cost = least - rest * last + rest**2 * curved - 0.5 * float(of_held @ (at + low * way) ** 2)
        self.states, self.moves = self.states + low * (states - self.states), self.moves + low * (moves - self.moves)
        self.slope += low * (along - self.slope)

    @property
    def lowered(self) -> float:
        """Change of the model at the present point of the steps; negative where it is lower."""
        total = self.cost
        for item, s, now, t in zip(self.penalties, self.signed, self.begun, self.at, strict=True):
            total += 0.5 * item.weight * float((t[item.held(t)] ** 2).sum() - (s[now] ** 2).sum())
        return total

    def regularizing(self, moves: Floats) -> float:
        """What regularization adds to the model at changes of the controls (R, m)."""
        return 0.0 if self.proximal is None else 0.5 * float((self.proximal * moves**2).sum())

    def there(self, plan: Plan) -> Plan:
        """A plan that leads to the present point of the steps, with the feedback of ``plan``."""
        at = self.states[: -1 : self.problem.hold]
        if self.problem.linear:
            # A line is decided at its beginning, and so is the first control.
            at = np.concatenate([self.states[:1], at])
        ahead = self.moves - np.einsum("kmx,kx->km", plan.feedback, at)
        if plan.previous is not None:
            ahead[1:] -= np.einsum("kmi,ki->km", plan.previous[1:], self.moves[:-1])
        curvature = 2.0 * (self.lowered - self.regularizing(self.moves) - self.slope)
        return plan._replace(feedforward=ahead, slope=self.slope, curvature=curvature, limited=True)

    def change(self, plan: Plan, held: list[Mask], ahead: list[Floats]) -> tuple[float, float]:
        """Change of the piecewise model over a plan's full step, and its slope at the start."""
        change, slope = -plan.expected_decrease, plan.slope
        for item, s, t, now, rows in zip(self.penalties, self.signed, ahead, self.begun, held, strict=True):
            half = 0.5 * item.weight
            before, after = s * s, t * t
            then = item.held(t)
            change += half * float(before[rows].sum() - before[now].sum() + after[then].sum() - after[rows].sum())
            pull = item.weight * s * (t - s)
            slope += float(pull[now].sum() - pull[rows].sum())
        return change, slope


def same_rows(some: Sequence[Mask], others: Sequence[Mask]) -> bool:
    """Whether the same rows of all penalties are active."""
    return all(np.array_equal(a, b) for a, b in zip(some, others, strict=True))


class Pushes:
    """Multipliers of penalties' rows in an interior-point method, and how far the rows are inside.

    The penalty (w / 2) max(s, 0)^2 of a row is the least of (w / 2) (s + p)^2 over p >= 0. Its multiplier is
    y = w (s + p), and the method has y p = mu. Rows of equality constraints have their quadratic penalty.
    """

    def __init__(self, rows: Rows, at: Floats, mu: float) -> None:
        self.rows, self.free, w = rows, ~rows.equal, rows.weights
        self.s = at
        root = np.sqrt(at**2 + 4.0 * mu / w)
        self.y = np.where(at > 0.0, 0.5 * w * (at + root), 2.0 * mu / np.maximum(root - at, 1e-300))
        self.p = mu / self.y
        self.to, self.to_y, self.to_p = self.s, self.y, self.p
        self.last_y, self.last_p = self.y, self.p

    @property
    def products(self) -> Floats:
        """The products y p."""
        return (self.y * self.p)[self.free]

    @property
    def bent(self) -> Floats:
        """Second-order terms of the products over the whole step."""
        return (self.to_y - self.y) * (self.to_p - self.p)

    def left(self, length: float) -> float:
        """Sum of the products after a share of the step."""
        y, p = (a + length * (b - a) for a, b in ((self.y, self.to_y), (self.p, self.to_p)))
        return float((y * p)[self.free].sum())

    @property
    def active(self) -> list[Mask]:
        """The rows that will be active: those whose distances fell by more than their multipliers in the last step."""
        now = self.rows.equal | (self.p * self.last_y < self.y * self.last_p)
        return self.rows.split(now)

    def _linear(self, aim: Floats) -> tuple[Floats, Floats]:
        """Shares of the weights, and the shifts, of the quadratic penalties of a step."""
        # Rows of equality constraints may have a multiplier of zero.
        y = np.where(self.free, self.y, 1.0)
        share = np.where(self.free, 1.0 / (1.0 + self.rows.weights * self.p / y), 1.0)
        return share, np.where(self.free, aim / y + self.p, 0.0)

    def along(self, aim: Floats) -> Along:
        """Expansions for the pass of a step towards the products ``aim``."""
        share, shift = self._linear(aim)
        return self.rows.along(self.rows.split(share), self.rows.split(flat(self.rows.signed) + shift))

    def towards(self, ahead: list[Floats], aim: Floats) -> float:
        """Take a step's end from the rows ``ahead``; returns the model's change there less that of the step's model."""
        share, shift = self._linear(aim)
        w, begin = self.rows.weights, flat(self.rows.signed)
        self.to = flat(ahead)
        self.to_y = w * share * (self.to + shift)
        self.to_p = self.to_y / w - self.to

        def piecewise(s: Floats) -> Floats:
            return np.where(self.free, np.maximum(s, 0.0), s) ** 2

        of_step = share * ((self.to + shift) ** 2 - (begin + shift) ** 2)
        return 0.5 * float((w * (piecewise(self.to) - piecewise(begin) - of_step)).sum())

    @property
    def signs(self) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
        """Multipliers and distances, which stay positive, and their changes over the whole step."""
        free = self.free
        return (self.y[free], self.p[free]), ((self.to_y - self.y)[free], (self.to_p - self.p)[free])

    def move(self, length: float) -> None:
        """Go a share of the step."""
        self.last_y, self.last_p = self.y, self.p
        self.s = self.s + length * (self.to - self.s)
        self.y = self.y + length * (self.to_y - self.y)
        self.p = self.p + length * (self.to_p - self.p)
