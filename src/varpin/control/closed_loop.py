"""The cost and the constraints of a plan around its motion, in changes of the controls beside an optimal feedback.

Beside the feedback of the quadratic model's own backward pass the model's Hessian is block diagonal, one block for each
decision. Without feedback it would be dense, and the changes of an unstable motion would have no bound.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from varpin.arrays import Floats, Integers, Mask
from varpin.control.along import Along
from varpin.control.constraints import BoundConstraint, BoundRate, Slopes
from varpin.control.descent import Model, Stake, at_stake
from varpin.control.linear_controls import at_samples, linear_steps
from varpin.control.penalties import PenalizedRate, controls_of_steps, penalized
from varpin.control.problem import OptimalControlProblem
from varpin.control.spread import state_slopes
from varpin.trajectory import Trajectory

# Least eigenvalue of the Hessian in a decision's controls, relative to the greatest.
_CONVEX = 1e-13


class ClosedLoop:
    """The quadratic model of a problem's cost and its linearized constraints around a motion.

    The controls change by K dx + P du_before + w, with K and P the gains of the model in which the penalties of the
    active rows count, too: on the linearized active constraints they are constant. Controls that are not free have no
    feedback.

    Attributes:
        gains: K (R, m, 2n); (R, m, X) of the states X of :mod:`varpin.control.linear_controls` with linear controls.
        previous: P (R, m, m); zero unless changes of controls have a cost or a limit.
        inverse: W (R, m, m), the inverse of the model's Hessian in w_k; zero in controls that are not free.
        gradient: Gradient of the cost in w (R, m).
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        motion: Trajectory,
        weights: Floats,
        multipliers: list[Floats],
    ) -> None:
        """Expand the cost along a motion.

        Args:
            problem: The problem with its constraints.
            motion: The motion.
            weights: Weights of the penalties (C,).
            multipliers: For each constraint (K, rows). Penalties count, and second derivatives where rows have them, in
                rows whose multiplier is not zero.
        """
        self.problem, self.motion = problem, motion
        zeros = [np.zeros(item.shape) for item in problem.bound_constraints]
        goal = penalized(problem, zeros, weights, zeros)
        self._along = Along(goal, motion)
        self._linear, self._velocity = self._along.linearized(0, problem.steps)
        self._multipliers, self._active = multipliers, [values != 0.0 for values in multipliers]
        self._goal = goal
        # By the identity of the constraint.
        self._known: dict[int, Slopes] = {}
        self._expand()
        # With linear controls the state contains the control, and a first step sets the first one.
        x = self._A.shape[1]
        self._before = len(self._A) - problem.steps
        terminal = self._along.terminal
        states = len(terminal.gradient)
        self._end = np.zeros(x), np.zeros((x, x))
        self._end[0][:states], self._end[1][:states, :states] = terminal.gradient, terminal.hessian

    def _expand(self) -> None:
        """Gradients (N, 2n + m) and Hessians of the steps' costs in (x, u)."""
        problem, motion, goal = self.problem, self.motion, self._goal
        of_nodes = [
            (item, rows, values)
            for item, rows, values in zip(problem.bound_constraints, self._active, self._multipliers, strict=True)
            if not item.of_controls
        ]
        of_rates = [
            rows for item, rows in zip(problem.bound_constraints, self._active, strict=True) if item.of_controls
        ]
        costs = goal.expand_cost(motion)
        self._model = Model(costs, self._along.terminal.cost)
        expansion = goal.with_held(
            costs,
            [np.zeros(item.shape) for item, _, _ in of_nodes],
            [self._slopes_of(item) if rows.any() else None for item, rows, _ in of_nodes],
            [rows for _, rows, _ in of_nodes],
            [values for _, _, values in of_nodes],
        )
        lin, rule, N = self._linear, goal.model_rule, problem.steps
        rate = self._expand_rate(of_rates)
        if problem.linear:
            steps = linear_steps(goal, self._along.of_lines, self._along.sampled, expansion, rate[1], rate[0])
            self._A, self._B = steps.A, steps.B
            self._steps = problem.dt * steps.gradient, problem.dt * steps.hessian
            R, m = problem.decisions, problem.scene.controls
            self._pull, self._rate = np.zeros((R, m)), np.zeros((0, m, m))
            return
        self._A, self._B = lin.A, lin.B
        self._pull, self._rate = rate
        x, m = lin.A.shape[1], lin.B.shape[2]
        gradient, hessian = np.zeros((N, x + m)), np.zeros((N, x + m, x + m))
        samples = len(rule)
        D = np.zeros((N, x + m, x + m))
        D[:, x:, x:] = np.eye(m)
        parts = at_samples(rule, np.concatenate([lin.A, lin.B], axis=2), self._velocity)
        for s, (of_state, weight) in enumerate(zip(parts, problem.dt * rule[:, 0], strict=True)):
            D[:, :x] = of_state
            across = weight * np.swapaxes(D, 1, 2)
            gradient += (across @ expansion.gradient[s::samples, :, None])[:, :, 0]
            hessian += across @ expansion.hessian[s::samples] @ D
        self._steps = gradient, hessian

    def _expand_rate(self, active: list[Mask]) -> tuple[Floats, Floats]:
        """Gradients (R, m) of the cost of control changes, and Hessians (R, m, m) with ``active`` rows' penalties."""
        problem, rate = self.problem, self._goal.rate
        R, m = problem.decisions, problem.scene.controls
        if rate is None:
            return np.zeros((R, m)), np.zeros((0, m, m))
        u = problem.decided(self.motion)
        pull, curved = rate.expand(u, problem.period)
        if isinstance(rate, PenalizedRate):
            pull, _ = rate.plain.expand(u, problem.period)
            _, curved = rate.expand(u, problem.period, active)
        return pull, curved

    def close(self, free: Mask) -> None:
        """Compute the feedback of the controls ``free`` (R, m), the model's Hessian beside it and the gradient."""
        hold = self.problem.hold
        A, B, (_, hessian) = self._A, self._B, self._steps
        R, m = free.shape
        x, remembers = A.shape[1], len(self._rate) > 0
        z = x + m
        self.gains, self.previous = np.zeros((R, m, x)), np.zeros((R, m, m))
        self.inverse = np.zeros((R, m, m))
        V, T = np.zeros((z, z)), np.eye(z)
        V[:x, :x] = self._end[1]
        for k in reversed(range(R)):
            for j in reversed(range(k * hold, (k + 1) * hold)):
                T[:x, :x], T[:x, x:] = A[j], B[j]
                V = T.T @ V @ T + hessian[j]
            Q = np.zeros((z + m, z + m))
            # In (x, previous control, control).
            Q[:x, :x], Q[z:, z:] = V[:x, :x], V[x:, x:]
            Q[:x, z:], Q[z:, :x] = V[:x, x:], V[x:, :x]
            if remembers:
                Q[x:z, x:z] += self._rate[k]
                Q[z:, z:] += self._rate[k]
                Q[x:z, z:] -= self._rate[k]
                Q[z:, x:z] -= self._rate[k]
            own = np.flatnonzero(free[k])
            if own.size:
                W = _inverse(Q[z + own[:, None], z + own])
                self.inverse[k][own[:, None], own] = W
                feedback = -W @ Q[z + own, :z]
                self.gains[k, own], self.previous[k, own] = feedback[:, :x], feedback[:, x:]
            through = np.vstack([np.eye(z), np.hstack([self.gains[k], self.previous[k]])])
            V = through.T @ Q @ through
            V = 0.5 * (V + V.T)
        self.gradient = self._slope()

    def open(self) -> None:
        """Leave the feedback out: w are then the changes of the controls themselves."""
        self.gains, self.previous = np.zeros(self.gains.shape), np.zeros(self.previous.shape)
        self.gradient = self._slope()

    def leave_penalties(self, free: Mask) -> None:
        """Take the feedback of the cost alone instead, for controls ``free`` (R, m)."""
        self._active = [np.zeros(rows.shape, dtype=np.bool_) for rows in self._active]
        self._expand()
        self.close(free)

    def _slope(self) -> Floats:
        """The gradient of the cost in w (R, m)."""
        hold, A, B, (gradient, _) = self.problem.hold, self._A, self._B, self._steps
        R, m, x = self.gains.shape
        found = np.zeros((R, m))
        r = np.concatenate([self._end[0], np.zeros(m)])
        for k in reversed(range(R)):
            for j in reversed(range(k * hold, (k + 1) * hold)):
                r = np.concatenate([A[j].T @ r[:x], B[j].T @ r[:x] + r[x:]]) + gradient[j]
            found[k] = r[x:] + self._pull[k]
            r = np.concatenate([r[:x] + self.gains[k].T @ found[k], self.previous[k].T @ found[k] - self._pull[k]])
        return found

    @property
    def stake(self) -> Stake:
        """The cost at stake along the motion."""
        return at_stake(self.problem, self.motion, self._model)

    @cached_property
    def _slopes(self) -> Floats:
        return state_slopes(self.problem, self.motion)

    def _slopes_of(self, item: BoundConstraint) -> Slopes:
        """The derivatives of a constraint's rows along the motion."""
        found = self._known.get(id(item))
        if found is None:
            motion = self.motion
            found = item.slopes(motion.q, motion.v, self.problem.control_rows(motion))
            self._known[id(item)] = found
        return found

    def rows(self, active: list[Mask]) -> Floats:
        """Derivatives (a, R, m) of the active rows of all constraints in w."""
        problem = self.problem
        R, m, x = self.gains.shape
        total, hold = sum(int(rows.sum()) for rows in active), problem.hold
        G = np.zeros((total, R, m))
        # For each row its derivatives in the state at its node.
        carried: list[Floats] = [np.zeros((0, x))]
        node: list[Integers] = []
        of_row: list[Integers] = []
        begin = 0
        for item, rows in zip(problem.bound_constraints, active, strict=True):
            k, r = np.nonzero(rows)
            part = slice(begin, begin + len(k))
            begin += len(k)
            if isinstance(item, BoundRate):
                G[part] = _of_rate(item, k, r, R, m)
            elif len(k):
                found = self._slopes_of(item)
                by_state = np.einsum("ax,axy->ay", found.by_state[k, r], self._slopes[found.nodes[k]])
                wide = np.pad(by_state, ((0, 0), (0, x - by_state.shape[1])))
                pulled, steps, index = found.by_controls[k, r], found.nodes[k], np.arange(begin - len(k), begin)
                if pulled.size and problem.linear:
                    # The control at the begin is a part of the state.
                    wide[:, by_state.shape[1] :][:, :m] = pulled[:, :m]
                    G[index, steps + 1] += pulled[:, m:]
                elif pulled.size:
                    G[index, steps // hold] += pulled
                carried.append(wide)
                node.append(steps + self._before)
                of_row.append(index)
        return self._carried_back(G, np.concatenate(carried), _joined(node), _joined(of_row))

    def rows_of_controls(self, chosen: Mask, sign: float) -> Floats:
        """Derivatives (a, R, m) of the ``chosen`` controls (R, m), times ``sign``, in w."""
        k, i = np.nonzero(chosen)
        G = np.zeros((len(k), *chosen.shape))
        G[np.arange(len(k)), k, i] = sign
        none: Integers = np.zeros(0, dtype=np.int64)
        return self._carried_back(G, np.zeros((0, self.gains.shape[2])), none, none)

    def _carried_back(self, G: Floats, slopes: Floats, nodes: Integers, owners: Integers) -> Floats:
        """The derivatives (a, R, m) in w of rows with the derivatives G (a, R, m) in the controls.

        Rows ``owners`` also have the derivatives ``slopes`` in the states at ``nodes``, (b, X).
        """
        hold, back = self.problem.hold, np.zeros((len(G), slopes.shape[1]))
        for j in reversed(range(len(self._A))):
            own, here = j // hold, nodes == j + 1
            np.add.at(back, owners[here], slopes[here])
            G[:, own] += back @ self._B[j]
            back = back @ self._A[j]
            if j % hold == 0:
                # Through feedback the control depends on the state before it and on the previous control.
                back += G[:, own] @ self.gains[own]
                if own > 0:
                    G[:, own - 1] += G[:, own] @ self.previous[own]
        G[:, given_controls(self.problem)] = 0.0
        return G

    def response(self, ahead: Floats) -> tuple[Floats, Floats]:
        """Changes of the states (N + 1, 2n) and controls (R, m) for w = ``ahead`` (R, m)."""
        A, B, hold = self._A, self._B, self.problem.hold
        found, change = np.zeros((len(A) + 1, A.shape[1])), ahead.copy()
        for j in range(len(A)):
            k = j // hold
            if j % hold == 0:
                change[k] += self.gains[k] @ found[j]
                if k > 0:
                    change[k] += self.previous[k] @ change[k - 1]
            found[j + 1] = A[j] @ found[j] + B[j] @ change[k]
        return found[self._before :, : self._linear.A.shape[1]], change

    def values_after(self, values: list[Floats], response: Floats, change: Floats) -> list[Floats]:
        """The constraints' values (K, rows) after changes of states and controls, to first order."""
        problem, found = self.problem, []
        for item, c in zip(problem.bound_constraints, values, strict=True):
            if isinstance(item, BoundRate):
                rate = np.diff(change, axis=0, prepend=np.zeros_like(change[:1])) / problem.period
                rate = rate[item.places][:, item.limited]
                found.append(c + np.concatenate([rate, -rate], axis=1))
            else:
                of_rows = self._slopes_of(item)
                nodes = of_rows.nodes
                by_state = np.einsum("kxy,ky->kx", self._slopes[nodes], response[nodes])
                after = c + np.einsum("krx,kx->kr", of_rows.by_state, by_state)
                if of_rows.by_controls.size:
                    moved = controls_of_steps(problem, change, nodes)
                    after += np.einsum("krc,kc->kr", of_rows.by_controls, moved)
                found.append(after)
        return found


def given_controls(problem: OptimalControlProblem) -> Mask:
    """Which decided controls (R, m) are given: those of the first instant, with linear controls."""
    found = np.zeros((problem.decisions, problem.scene.controls), dtype=np.bool_)
    if problem.begin is not None:
        found[0] = ~np.isnan(problem.begin)
    return found


def _joined(parts: list[Integers]) -> Integers:
    return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)


def _inverse(matrix: Floats) -> Floats:
    """The inverse of a symmetric matrix, made positive definite where it is not."""
    values, vectors = np.linalg.eigh(matrix)
    most = np.abs(values).max()
    found: Floats = (vectors / np.maximum(np.abs(values), _CONVEX * most or 1.0)) @ vectors.T
    return found


def _of_rate(item: BoundRate, k: Integers, r: Integers, R: int, m: int) -> Floats:
    """Derivatives (a, R, m) of rows of a rate limit in the controls."""
    rows, limited = np.zeros((len(k), R, m)), item.limited
    signs, columns = np.where(r < len(limited), 1.0, -1.0), limited[r % len(limited)]
    decisions, index = item.places[k], np.arange(len(k))
    rows[index, decisions, columns] = signs / item.period
    later = decisions > 0
    rows[index[later], decisions[later] - 1, columns[later]] = -signs[later] / item.period
    return rows
