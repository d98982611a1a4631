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
from varpin.control.passes import Plan
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
    """The program (O10) of motions with the same rows: its structure is set up once, its values change."""

    def __init__(self, rows: Sequence[Rows]) -> None:
        self._places = [row.at for row in rows]
        self._equal = [i for i, row in enumerate(rows) if row.equality]
        self._other = [i for i, row in enumerate(rows) if not row.equality]
        self._forms: dict[bool, _Form] = {}

    def fits(self, rows: Sequence[Rows]) -> bool:
        """Whether the structure is that of these rows."""
        return len(rows) == len(self._places) and all(
            row.at is at or np.array_equal(row.at, at) for row, at in zip(rows, self._places, strict=True)
        )

    def fill(
        self, stages: Stages, rows: Sequence[Rows], limits: tuple[Floats, Floats], plan: Plan, regularization: float
    ) -> None:
        """Fill in the values of a motion.

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
        self.stages, self.rows, layout = stages, tuple(rows), stages.layout
        self.at, beside = layout.decisions(plan.feedback, plan.previous)
        Quu = _products(plan.factors)
        diagonal = np.diagonal(Quu, axis1=1, axis2=2)
        pull = np.swapaxes(beside, 1, 2) @ Quu
        self.hessian = pull @ beside
        own = np.arange(-Quu.shape[1], 0)
        self.hessian[:, own, own] += regularization * diagonal
        # Largest cost of a control's change by one.
        self.stiffness = float(diagonal.max())
        gradient = -(pull @ plan.feedforward[:, :, None])[:, :, 0]
        self.gradient = np.zeros(layout.size)
        np.add.at(self.gradient, self.at[self.at >= 0], gradient[self.at >= 0])
        # The scale of the cost, to which the solver's residuals are relative.
        self.scale = float(np.abs(gradient).max()) or float(np.abs(self.hessian).max()) or 1.0
        self.lower, self.upper = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
        controls = layout.control(np.arange(len(plan.feedforward)))
        self.lower[controls], self.upper[controls] = limits

    def minimum(
        self, values: Sequence[Floats], gaps: Floats | None = None, weight: float | None = None
    ) -> Minimum | None:
        """The minimum within limits and rows; None where there is none or the solver fails.

        Args:
            values: Values (P,) of the rows of each constraint at z = 0.
            gaps: What the stages miss the states by at z = 0 (R, 2n); zero by default.
            weight: Cost of a violation of each row by one; by default rows are hard.
        """
        elastic = weight is not None
        if elastic not in self._forms:
            self._forms[elastic] = _Form(self, self._equal, self._other, elastic=elastic)
        layout = self.stages.layout
        still = np.zeros(layout.stages * layout.states) if gaps is None else gaps.ravel()
        b = np.concatenate([still, *(-values[i] for i in self._equal)])
        h = np.concatenate([-values[i] for i in self._other]) if self._other else None
        found = self._forms[elastic].solve(b, h, (weight or 0.0) / self.scale)
        if found is None:
            return None
        z, y, push = found
        ends = [np.cumsum([len(values[i]) for i in some])[:-1] for some in (self._equal, self._other)]
        own = iter(np.split(self.scale * y[len(still) :], ends[0]))
        others = iter(np.split(self.scale * push, ends[1]))
        multipliers = tuple(next(own) if row.equality else next(others) for row in self.rows)
        return Minimum(z[: layout.size], multipliers, float(z[layout.size :].sum()))


class _Form:
    """A program with hard or with elastic rows, and its solvers.

    Each row gets a slack, an equality two. The solver factors stage by stage, if these are where their stages are.
    """

    def __init__(self, program: Program, equal: Sequence[int], other: Sequence[int], *, elastic: bool) -> None:
        self.program, self.equal, self.other = program, equal, other
        layout, rows = program.stages.layout, program.rows
        last = {i: rows[i].at.max(axis=1) for i in (*equal, *other)} if elastic else {}
        ends = [[last[i] for i in some if i in last] for some in (equal, equal, other)]
        places = [np.arange(layout.size), *(part for some in ends for part in some)]
        self.order = np.argsort(np.concatenate(places), kind="stable")
        size = len(self.order)
        self.slacks = size - layout.size
        rank = np.empty(size + 1, dtype=np.int64)
        rank[self.order], rank[-1] = np.arange(size), -1  # of no variable: the last
        k = np.arange(layout.stages)
        after, at, decisions = rank[layout.state(k + 1)], rank[layout.in_stage(k)], rank[program.at]
        numbers = np.arange(after.size).reshape(after.shape)
        slack = rank[layout.size : size]
        pairs = sum(len(rows[i].at) for i in equal)
        own = after.size + np.arange(pairs)
        A = [_rectangle(numbers, at), (numbers, after), *_of_rows([rank[rows[i].at] for i in equal], after.size)]
        G = _of_rows([rank[rows[i].at] for i in other], 0)
        if elastic:
            A.append((np.concatenate([own, own]), slack[: 2 * pairs]))
            G.append((np.arange(self.slacks - 2 * pairs), slack[2 * pairs :]))
        self.P = _Pattern([_rectangle(decisions, decisions), (slack, slack)], (size, size))
        self.A = _Pattern(A, (after.size + pairs, size))
        self.G = _Pattern(G, (sum(len(rows[i].at) for i in other), size)) if other else None
        self.halves = np.concatenate([np.ones(pairs), -np.ones(pairs)]) if elastic else np.zeros(0)
        self.solvers: dict[Any, Any] = {}

    def solve(self, b: Floats, h: Floats | None, cost: float) -> tuple[Floats, Floats, Floats] | None:
        """The variables and the multipliers of equalities and rows; None where there is no minimum."""
        program, S, rows = self.program, self.slacks, self.program.rows
        c = np.append(program.gradient / program.scale, np.full(S, cost))[self.order]
        lower = np.append(program.lower, np.zeros(S))[self.order]
        upper = np.append(program.upper, np.full(S, np.inf))[self.order]
        J = program.stages.J
        P = self.P.filled([program.hessian / program.scale, np.full(S, _UNIQUE * cost)])
        A = self.A.filled([J, -np.ones(J[:, :, 0].size), *(rows[i].slopes for i in self.equal), self.halves])
        G = None
        if self.G is not None:
            G = self.G.filled([*(rows[i].slopes for i in self.other), -np.ones(S - len(self.halves))])
        # Stage by stage is faster, the factors of the whole matrix are more accurate.
        for kind in (piqp.KKTSolver.sparse_multistage, piqp.KKTSolver.sparse_ldlt):
            solver = self.solvers.get(kind)
            if solver is None:
                solver = self.solvers[kind] = piqp.SparseSolver()
                settings = solver.settings
                settings.kkt_solver = kind
                settings.eps_abs, settings.eps_rel, settings.max_iter = _ABSOLUTE, _RELATIVE, _STEPS
                solver.setup(P, c, A, b, G, None, h, lower, upper)
            else:
                solver.update(P, c, A, b, G, None, h, lower, upper)
            status, found = solver.solve(), solver.result
            known = found.info
            rounded = status == piqp.PIQP_MAX_ITER_REACHED and max(known.primal_res, known.dual_res) <= _ROUNDED
            if status == piqp.PIQP_SOLVED or rounded:
                z = np.empty(len(self.order))
                z[self.order] = found.x
                return z, found.y.copy(), found.z_u.copy()
            if status == piqp.PIQP_PRIMAL_INFEASIBLE:
                return None
        return None


_Entries = tuple[Integers, Integers]


class _Pattern:
    """A sparse matrix whose entries change: those of variables that are given are left out, those at one place add."""

    def __init__(self, entries: Sequence[_Entries], shape: tuple[int, int]) -> None:
        i, j = (np.concatenate([np.ravel(part) for part in parts]) for parts in zip(*entries, strict=True))
        self._kept = (i >= 0) & (j >= 0)
        i, j = i[self._kept], j[self._kept]
        places, self._at = np.unique(j * shape[0] + i, return_inverse=True)
        begins = np.searchsorted(places, np.arange(shape[1] + 1) * shape[0])
        self._matrix = sp.csc_matrix((np.zeros(len(places)), places % shape[0], begins), shape)

    def filled(self, values: Sequence[Floats]) -> sp.csc_matrix:
        """The matrix with the values of all entries."""
        given = np.concatenate([np.ravel(part) for part in values])[self._kept]
        self._matrix.data[:] = np.bincount(self._at, given, len(self._matrix.data))
        return self._matrix


def changes(rows: Sequence[Rows], z: Floats) -> list[Floats]:
    """Changes (P,) of the values of all rows at z."""
    padded = np.append(z, 0.0)
    return [(row.slopes * np.where(row.at >= 0, padded[row.at], 0.0)).sum(axis=1) for row in rows]


def _products(factors: Floats) -> Floats:
    """The matrices L D L' (R, m, m) of factors that hold L below and D on their diagonals."""
    L = np.tril(factors, -1) + np.eye(factors.shape[1])
    found: Floats = L * np.diagonal(factors, axis1=1, axis2=2)[:, None, :] @ np.swapaxes(L, 1, 2)
    return found


def _rectangle(rows: Integers, columns: Integers) -> _Entries:
    """The places of blocks (K, A, B) at rows (K, A) and columns (K, B)."""
    shape = (*rows.shape, columns.shape[1])
    i, j = np.broadcast_to(rows[:, :, None], shape), np.broadcast_to(columns[:, None, :], shape)
    return i.ravel(), j.ravel()


def _of_rows(columns: Sequence[Integers], first: int) -> list[_Entries]:
    """The places of rows with entries in columns (P, Z), numbered from ``first`` on."""
    found = []
    for at in columns:
        found.append((np.repeat(first + np.arange(len(at)), at.shape[1]), at))
        first += len(at)
    return found
