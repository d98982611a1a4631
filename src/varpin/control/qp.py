"""The quadratic program of an iteration: least cost of the stages within control limits and rows, by PIQP.

R. Schwan, Y. Jiang, D. Kuhn and C. N. Jones, "PIQP: a proximal interior-point quadratic programming solver" (2023).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import piqp
import scipy.sparse as sp

from varpin.arrays import Floats, Integers
from varpin.control.riccati import Plan
from varpin.control.stages import Rows, Stages

# Residuals at which the solver stops, absolute for a cost of gradient one and relative, and those of a solution that it
# cannot improve further, as weights are far apart.
_ABSOLUTE, _RELATIVE, _ROUNDED = 1e-10, 1e-11, 1e-7
# Greatest number of interior-point steps; solved programs take 10 to 40.
_STEPS = 60
# Weight of the squares of slacks, relative to their linear cost: it makes them unique.
_UNIQUE = 1e-9


class Minimum(NamedTuple):
    """The solution of a quadratic program."""

    z: Floats  # the changes of the variables
    multipliers: tuple[Floats, ...]  # (P,) of the rows of each constraint
    slack: float  # sum of what rows are violated by


class Program:
    """The program (O10) of one motion; :meth:`minimum` solves it, with other values of its rows for corrections."""

    def __init__(
        self,
        stages: Stages,
        rows: Sequence[Rows],
        limits: tuple[Floats, Floats],
        plan: Plan,
        regularization: float,
    ) -> None:
        """Assemble the matrices.

        The cost is that of the changes v = u - K x of the controls beside a backward pass's feedback: half of
        (v - k)' Quu (v - k) for each decision, with k the feed-forward part. That is the cost of the stages up to a
        constant, and the solver has neither large multipliers nor far apart weights to cope with.

        Args:
            stages: The stages.
            rows: The rows of all constraints.
            limits: Least and greatest changes of the controls, each (R, m).
            plan: A backward pass along the motion, of the costs alone.
            regularization: A further cost of half the squares of the controls' changes, relative to the diagonal of
                Quu.
        """
        self.rows, layout = tuple(rows), stages.layout
        self.layout, size = layout, layout.size
        at, beside = layout.decisions(plan.feedback, plan.previous)
        Quu = _products(plan.factors)
        pull = np.swapaxes(beside, 1, 2) @ Quu
        hessian = pull @ beside
        own = np.arange(-Quu.shape[1], 0)
        hessian[:, own, own] += regularization * np.diagonal(Quu, axis1=1, axis2=2)
        self._P = _matrix([_square(at, hessian)], (size, size))
        # Largest cost of a control's change by one.
        self.stiffness = float(np.diagonal(Quu, axis1=1, axis2=2).max())
        gradient = -(pull @ plan.feedforward[:, :, None])[:, :, 0]
        self._gradient = np.zeros(size)
        np.add.at(self._gradient, at[at >= 0], gradient[at >= 0])
        # The scale of the cost, to which the solver's residuals are relative.
        self._scale = float(np.abs(gradient).max()) or float(np.abs(hessian).max()) or 1.0
        k = np.arange(layout.stages)
        after, controls = layout.state(k + 1), layout.control(np.arange(len(plan.feedforward)))
        numbers = np.arange(after.size).reshape(after.shape)
        self._dynamics = _matrix(
            [_rectangle(numbers, layout.in_stage(k), stages.J), (numbers.ravel(), after.ravel(), -np.ones(after.size))],
            (after.size, size),
        )
        self._lower, self._upper = np.full(size, -np.inf), np.full(size, np.inf)
        self._lower[controls], self._upper[controls] = limits
        self._blocks = [self._of_rows(row, size) for row in self.rows]

    @staticmethod
    def _of_rows(rows: Rows, size: int) -> sp.csc_matrix:
        count, width = rows.at.shape
        numbers = np.repeat(np.arange(count), width)
        return _matrix([(numbers, rows.at.ravel(), rows.slopes.ravel())], (count, size))

    def _slacks(self, equal: Sequence[int], other: Sequence[int]) -> list[Floats]:
        """Where the slacks of rows belong among the variables: the two of each equality, then those of other rows."""
        last = [self.rows[i].at.max(axis=1).astype(float) for i in (*equal, *other)]
        return [*last[: len(equal)], *last[: len(equal)], *last[len(equal) :]]

    def after_rows(self, z: Floats) -> list[Floats]:
        """Changes (P,) of the values of all rows at z."""
        return [block @ z for block in self._blocks]

    def minimum(
        self, values: Sequence[Floats], gaps: Floats | None = None, weight: float | None = None
    ) -> Minimum | None:
        """The minimum within limits and rows; None where there is none or the solver fails.

        Args:
            values: Values (P,) of the rows of each constraint at z = 0.
            gaps: What the stages miss the states by at z = 0 (R, 2n); zero by default.
            weight: Cost of a violation of each row by one; by default rows are hard.
        """
        equal = [i for i, rows in enumerate(self.rows) if rows.equality]
        other = [i for i, rows in enumerate(self.rows) if not rows.equality]
        A = sp.vstack([self._dynamics, *(self._blocks[i] for i in equal)], format="csc")
        b = np.concatenate(
            [np.zeros(self._dynamics.shape[0]) if gaps is None else gaps.ravel(), *(-values[i] for i in equal)]
        )
        P, c, lower, upper = self._P / self._scale, self._gradient / self._scale, self._lower, self._upper
        G = sp.vstack([self._blocks[i] for i in other], format="csc") if other else None
        h = np.concatenate([-values[i] for i in other]) if other else None
        size = len(c)
        if weight is not None:
            of_equal, of_other = len(b) - self._dynamics.shape[0], 0 if h is None else len(h)
            slack = 2 * of_equal + of_other
            cost = weight / self._scale
            P = sp.block_diag([P, _UNIQUE * cost * sp.eye(slack)], format="csc")
            c, lower = np.append(c, np.full(slack, cost)), np.append(lower, np.zeros(slack))
            upper = np.append(upper, np.full(slack, np.inf))
            one, other_one = sp.eye(of_equal), sp.eye(of_other)
            both = sp.hstack([one, -one, sp.csc_matrix((of_equal, of_other))])
            none = sp.csc_matrix((self._dynamics.shape[0], slack))
            A = sp.hstack([A, sp.vstack([none, both])], format="csc")
            if G is not None:
                G = sp.hstack([G, sp.csc_matrix((of_other, 2 * of_equal)), -other_one], format="csc")
        # The solver factors stage by stage, if the slacks of rows are where their stages are.
        order = np.argsort(
            np.concatenate([np.arange(size), *self._slacks(equal, other)]) if weight is not None else np.arange(size),
            kind="stable",
        )
        P, A, G = P[order][:, order], A[:, order], None if G is None else G[:, order]
        found = _solved(P, c[order], A, b, G, h, lower[order], upper[order])
        if found is None:
            return None
        z = np.empty(len(order))
        z[order] = found.x
        y = self._scale * found.y
        own = iter(np.split(y[self._dynamics.shape[0] :], np.cumsum([len(values[i]) for i in equal])[:-1]))
        push = iter(np.split(self._scale * found.z_u, np.cumsum([len(values[i]) for i in other])[:-1]) if other else ())
        multipliers = tuple(next(own) if rows.equality else next(push) for rows in self.rows)
        return Minimum(z[:size], multipliers, float(z[size:].sum()))


def _solved(
    P: sp.csc_matrix,
    c: Floats,
    A: sp.csc_matrix,
    b: Floats,
    G: sp.csc_matrix | None,
    h: Floats | None,
    lower: Floats,
    upper: Floats,
) -> Any:
    """PIQP's result; None where there is no minimum or the solver fails."""
    # Stage by stage is faster, the factors of the whole matrix are more accurate.
    for kind in (piqp.KKTSolver.sparse_multistage, piqp.KKTSolver.sparse_ldlt):
        solver = piqp.SparseSolver()
        settings = solver.settings
        settings.kkt_solver = kind
        settings.eps_abs, settings.eps_rel, settings.max_iter = _ABSOLUTE, _RELATIVE, _STEPS
        solver.setup(P, c, A, b, G, None, h, lower, upper)
        status, known = solver.solve(), solver.result.info
        rounded = status == piqp.PIQP_MAX_ITER_REACHED and max(known.primal_res, known.dual_res) <= _ROUNDED
        if status == piqp.PIQP_SOLVED or rounded:
            return solver.result
        if status == piqp.PIQP_PRIMAL_INFEASIBLE:
            return None
    return None


def _products(factors: Floats) -> Floats:
    """The matrices L D L' (R, m, m) of factors that hold L below and D on their diagonals."""
    L = np.tril(factors, -1) + np.eye(factors.shape[1])
    found: Floats = L * np.diagonal(factors, axis1=1, axis2=2)[:, None, :] @ np.swapaxes(L, 1, 2)
    return found


_Entries = tuple[Integers, Integers, Floats]


def _square(at: Integers, blocks: Floats) -> _Entries:
    """The entries of blocks (K, Z, Z) at variables (K, Z)."""
    return _rectangle(at, at, blocks)


def _rectangle(rows: Integers, columns: Integers, blocks: Floats) -> _Entries:
    """The entries of blocks (K, A, B) at rows (K, A) and columns (K, B)."""
    shape = blocks.shape
    i, j = np.broadcast_to(rows[:, :, None], shape), np.broadcast_to(columns[:, None, :], shape)
    return i.ravel(), j.ravel(), blocks.ravel()


def _matrix(entries: Sequence[_Entries], shape: tuple[int, int]) -> sp.csc_matrix:
    """A sparse matrix of entries, those of variables that are given left out."""
    i, j, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    kept = (i >= 0) & (j >= 0) & (values != 0.0)
    return sp.csc_matrix((values[kept], (i[kept], j[kept])), shape=shape)
