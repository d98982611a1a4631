"""The quadratic program of an iteration: least cost of the stages within control limits and rows, by PIQP.

R. Schwan, Y. Jiang, D. Kuhn and C. N. Jones, "PIQP: a proximal interior-point quadratic programming solver" (2023).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import piqp
import scipy.sparse as sp

from varpin.arrays import Floats, Integers
from varpin.control.riccati import Plan
from varpin.control.sizes import FEASIBLE, HARMLESS, ROUNDING, TENTH
from varpin.control.stages import Rows, Steps

# Residuals at which the solver stops, absolute for a cost of gradient one, and relative; from 1e-12 to 1e-10.
_RESIDUAL = 1e-11
# Greatest number of interior-point steps; solved programs take 10 to 40.
_STEPS = 60


class Minimum(NamedTuple):
    """The solution of a quadratic program."""

    z: Floats  # the changes of the variables
    multipliers: tuple[Floats, ...]  # (P,) of the rows of each constraint
    slack: float  # sum of what rows are violated by


class Program:
    """The program (O10) of one motion; :meth:`minimum` solves it, with other values of its rows for corrections."""

    def __init__(
        self, steps: Steps, rows: Sequence[Rows], limits: tuple[Floats, Floats], plan: Plan, regularization: float
    ) -> None:
        """Assemble the matrices.

        The cost is that of the changes v = u - K x of the controls beside the feedback of ``plan``, a backward pass of
        the costs alone: half of (v - k)' Quu (v - k) for each decision, with k the feed-forward part. That is the cost
        of the steps up to a constant, and the solver has neither large multipliers nor far apart weights to cope with.
        ``limits`` are the least and greatest changes of the controls, each (R, m). The ``regularization`` is a further
        cost of half their squares, relative to the diagonal of Quu.
        """
        layout = steps.layout
        self._layout, self._equalities = layout, [row.equality for row in rows]
        self._forms: dict[float | None, _Form] = {}  # by the weight of the rows
        at, beside = layout.decision, plan.beside
        L = np.tril(plan.factors, -1) + np.eye(plan.factors.shape[1])
        Quu = L * np.diagonal(plan.factors, axis1=1, axis2=2)[:, None, :] @ np.swapaxes(L, 1, 2)
        diagonal = np.diagonal(Quu, axis1=1, axis2=2)
        pull = np.swapaxes(beside, 1, 2) @ Quu
        hessian = pull @ beside
        own = np.arange(-Quu.shape[1], 0)
        hessian[:, own, own] += regularization * diagonal
        # Largest cost of a control's change by one.
        self.stiffness = float(diagonal.max())
        gradient = -(pull @ plan.feedforward[:, :, None])[:, :, 0]
        # The scale of the cost, to which the solver's residuals are relative.
        slope, bend = float(np.abs(gradient).max()), float(np.abs(hessian).max())
        self._scale = (slope if slope > ROUNDING * bend else bend) or 1.0
        self._gradient = np.zeros(layout.size)
        np.add.at(self._gradient, at[at >= 0], gradient[at >= 0] / self._scale)
        self._lower, self._upper = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
        controls, after = layout.control[:-1], layout.state[1:]
        self._lower[controls], self._upper[controls] = limits
        numbers = np.arange(after.size).reshape(after.shape)
        self._hessian = _rectangle(at, at, hessian / self._scale)
        self._dynamics = [_rectangle(numbers, layout.stage, steps.J), (numbers, after, -np.ones(after.shape))]
        self._rows = [(row.at, row.slopes) for row in rows]

    def minimum(
        self, values: Sequence[Floats], gaps: Floats | None = None, weight: float | None = None
    ) -> Minimum | None:
        """The minimum within limits and rows; None where there is none or the solver fails.

        At z = 0 rows have ``values`` (P,), for each constraint, and steps miss the states by ``gaps`` (N, 2n).
        ``weight`` is the cost of a violation of each row by one; by default rows are hard.
        """
        size = self._layout.size
        still = np.zeros(self._layout.state[1:].size) if gaps is None else gaps.ravel()
        b, h = [still], [np.zeros(0)]
        for equality, c in zip(self._equalities, values, strict=True):
            (b if equality else h).append(-c)
        if weight not in self._forms:
            self._forms[weight] = self._form(weight)
        form = self._forms[weight]
        found = form.solve(np.concatenate(b), np.concatenate(h))
        if found is None:
            return None
        z, multipliers = found.x[form.rank], list[Floats]()
        pushes = {True: found.y[still.size :], False: found.z_u}
        for equality, c in zip(self._equalities, values, strict=True):
            own, pushes[equality] = np.split(pushes[equality], [len(c)])
            multipliers.append(self._scale * own)
        return Minimum(z[:size], tuple(multipliers), float(z[size:].sum()))

    def _form(self, weight: float | None) -> _Form:
        """The matrices of the program with hard rows, or of a weight."""
        size, first = self._layout.size, [self._layout.state[1:].size, 0]
        parts, slacks, places = [list(self._dynamics), list[_Entries]()], list[_Entries](), [np.arange(size)]
        for equality, (at, slopes) in zip(self._equalities, self._rows, strict=True):
            i, kind = np.arange(len(at))[:, None], 0 if equality else 1
            parts[kind].append((first[kind] + i, at, slopes))
            for sign in () if weight is None else (1.0, -1.0) if equality else (-1.0,):
                parts[kind].append((first[kind] + i, size + i, np.full(i.shape, sign)))
                slacks.append((size + i, size + i, np.full(i.shape, HARMLESS)))
                places.append(at.max(axis=1))
                size += len(i)
            first[kind] += len(i)
        # The solver factors stage by stage: slacks belong where their stages are, of an equality two.
        order = np.argsort(np.concatenate(places), kind="stable")
        rank = np.append(np.argsort(order), -1)
        cost, slack = (weight or 0.0) / self._scale, size - self._layout.size
        squares = [self._hessian, *((i, j, cost * part) for i, j, part in slacks)]
        c = np.append(self._gradient, np.full(slack, cost))[order]
        lower = np.append(self._lower, np.zeros(slack))[order]
        upper = np.append(self._upper, np.full(slack, np.inf))[order]
        P = _matrix([(rank[i], j, part) for i, j, part in squares], size, rank)
        A, G = (_matrix(own, count, rank) if own else None for own, count in zip(parts, first, strict=True))
        return _Form((P, c, A, G, lower, upper), rank[:-1])


@dataclass
class _Form:
    """A program whose right sides may change."""

    given: tuple[Any, ...]  # P, c, A, G, and least and greatest z
    rank: Integers  # of the variables in the solver's order
    solvers: dict[Any, Any] = field(default_factory=dict)

    def solve(self, b: Floats, h: Floats) -> Any:
        """PIQP's result; None where there is no minimum or the solver fails."""
        P, c, A, G, lower, upper = self.given
        most = None if G is None else h
        # Stage by stage is faster, the factors of the whole matrix are more accurate.
        for kind in (piqp.KKTSolver.sparse_multistage, piqp.KKTSolver.sparse_ldlt):
            if kind in self.solvers:
                solver = self.solvers[kind]
                solver.update(b=b, h_u=most)
            else:
                solver = self.solvers[kind] = piqp.SparseSolver()
                settings = solver.settings
                settings.kkt_solver = kind
                settings.eps_abs, settings.eps_rel, settings.max_iter = _RESIDUAL, _RESIDUAL, _STEPS
                solver.setup(P, c, A, b, G, None, most, lower, upper)
            status, known = solver.solve(), solver.result.info
            # Where weights are far apart more is left: a tenth of what a row may be violated by does no harm.
            rounded = max(known.primal_res, known.dual_res) <= TENTH * FEASIBLE
            if status == piqp.PIQP_SOLVED or (status == piqp.PIQP_MAX_ITER_REACHED and rounded):
                return solver.result
            if status == piqp.PIQP_PRIMAL_INFEASIBLE:
                return None
        return None


def changes(rows: Sequence[Rows], z: Floats) -> list[Floats]:
    """Changes (P,) of the values of all rows at z."""
    padded = np.append(z, 0.0)
    return [(row.slopes * padded[row.at]).sum(axis=1) for row in rows]


_Entries = tuple[Integers, Integers, Floats]


def _rectangle(rows: Integers, columns: Integers, blocks: Floats) -> _Entries:
    """The entries of blocks (K, A, B) at rows (K, A) and columns (K, B)."""
    return rows[:, :, None], columns[:, None, :], blocks


def _matrix(entries: Sequence[_Entries], height: int, rank: Integers) -> sp.csc_matrix:
    """A sparse matrix of entries, with columns at their rank; those of variables that are given are left out."""
    parts = [[np.ravel(part) for part in np.broadcast_arrays(*some)] for some in entries]
    i, j, values = (np.concatenate(some) for some in zip(*parts, strict=True))
    j = rank[j]
    kept = (i >= 0) & (j >= 0) & (values != 0.0)
    return sp.csc_matrix((values[kept], (i[kept], j[kept])), shape=(height, len(rank) - 1))
