"""The backward pass on a square root of the value's Hessian, where the plain recursion loses all digits: (O3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtrtrs

from varpin.arrays import Floats
from varpin.control.sizes import ROUNDING
from varpin.core import triangular
from varpin.support.frozen import Frozen

EPSILON = float(np.finfo(float).eps)  # of rounding, relative


@dataclass(frozen=True, eq=False)
class Squares(Frozen):
    """N convex functions (1/2) |L z + r|^2 + c . z, up to constants."""

    root: Floats  # L (N, z, z), or (1, z, z) for all
    shift: Floats  # r (N, z)
    linear: Floats  # c (N, z)

    def after(self, D: Floats) -> Squares:
        """The functions of x with z = D x."""
        return Squares(self.root @ D, self.shift, self.linear @ D)

    def padded(self, size: int) -> Squares:
        """The same functions of ``size`` variables."""
        more = size - self.shift.shape[1]
        root = np.pad(self.root, ((0, 0), (0, more), (0, more)))
        return Squares(root, *(np.pad(part, ((0, 0), (0, more))) for part in (self.shift, self.linear)))


def squares_of(gradient: Floats, hessian: Floats) -> Squares | None:
    """Squares from ``gradient`` (N, z) and ``hessian`` (N, z, z) or (1, z, z); None if one is not semidefinite.

    The linear part has only the gradient's component in the Hessian's null space: in squares a gradient keeps its
    digits.
    """
    size = np.sqrt(np.abs(np.diagonal(hessian, axis1=-2, axis2=-1)))
    unit = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(hessian / (unit[..., :, None] * unit[..., None, :]))
    if not (values >= -ROUNDING).all():
        return None
    weight, known = np.sqrt(np.maximum(values, 0.0)), values > ROUNDING
    across = np.swapaxes(vectors, -1, -2)
    along = (across @ (gradient / unit)[..., None])[..., 0]
    shift = np.where(known, along / np.where(known, weight, 1.0), 0.0)
    linear = unit * (vectors @ np.where(known, 0.0, along)[..., None])[..., 0]
    return Squares(weight[..., :, None] * across * unit[..., None, :], shift, linear)


class RootPass:
    """:class:`varpin.core.BackwardPass` on rows R and r of (O3), from the terminal cost in x and its gradient (x,).

    Rows are in (u, x, shift): R has zeros for u, unless the control is held on.
    """

    def __init__(self, controls: int, terminal: Squares, gradient: Floats) -> None:
        self.m, self.x = controls, gradient.size
        self.rows = np.hstack([np.zeros((self.x, controls)), terminal.root[0], terminal.shift[0][:, None]])
        pad = (controls, 0)
        self.linear, self.costate = np.pad(terminal.linear[0], pad), np.pad(gradient, pad)
        # Rounding leaves the value off by about eps scale_i scale_j.
        self.scale = np.linalg.norm(self.rows[:, :-1], axis=0)
        self.slope = self.curvature = self.noise = self.loss = 0.0

    @np.errstate(over="ignore", invalid="ignore")  # what is not finite has no minimum
    def run(
        self,
        h: float,
        hold: int,
        regularization: float,
        *,
        A: Floats,
        B: Floats,
        G: Floats,
        Gx: Floats,
        Gu: Floats,
        gradient: Floats,
        hessian: Squares,
        feedforward: Floats,
        feedback: Floats,
        control_gradient: Floats,
        spread: Floats,
        factors: Floats,
    ) -> int:
        """As :meth:`varpin.core.BackwardPass.run`, with the running cost as squares, its ``hessian``."""
        m, x, N = self.m, self.x, len(A)
        order = np.r_[x : x + m, :x]  # from (x, u) to (u, x)
        J = np.concatenate([B, A], axis=2)
        sizes, gradient, linear = np.abs(J), h * gradient[:, order], h * hessian.linear[:, order]
        roots = np.broadcast_to(hessian.root[:, :, order], (N, m + x, m + x))
        costs = np.sqrt(h) * np.concatenate([roots, hessian.shift[:, :, None]], axis=2)
        jumps, turns = G.transpose(0, 2, 1), np.concatenate([Gu, Gx], axis=3).transpose(0, 2, 1, 3)
        for s in range(N - 1, -1, -1):
            before = self.rows
            rows = np.concatenate([np.empty_like(before), costs[s]])
            carried = rows[: len(before)]
            np.matmul(before[:, m:-1], J[s], out=carried[:, :-1])
            carried[:, -1] = before[:, -1]
            cost, costate = self.linear[m:] @ J[s] + linear[s], self.costate[m:] @ J[s] + gradient[s]
            scale = self.scale[m:] @ sizes[s]
            if (s + 1) % hold:
                carried[:, :m] += before[:, :m]
                cost[:m] += self.linear[:m]
                costate[:m] += self.costate[:m]
                scale[:m] = np.hypot(scale[:m], self.scale[:m])
            if jumps.shape[1]:
                kicked = triangular(np.sqrt(h) * before[:, m:-1], x)
                spread[s] = kicked.T @ kicked
                jump, turned = jumps[s] @ kicked.T, kicked @ turns[s]
                self.noise += 0.5 * float((jump * jump).sum())
                costate += np.einsum("wi,wic->c", jump, turned)
                rows = np.concatenate([rows, *np.concatenate([turned, jump[:, :, None]], axis=2)])
            self.linear, self.costate, self.scale = cost, costate, scale
            self.rows = triangular(rows, m + x)
            if s % hold:
                continue
            r, norms = s // hold, np.sqrt(np.einsum("ij,ij->j", rows, rows))[:-1]
            firm = self._firm(norms[:m], regularization)
            if firm is None:
                return r
            control_gradient[r], factors[r] = costate[:m], firm[:, :m]
            feedforward[r], feedback[r] = self._decide(firm)
            self.scale = np.concatenate([np.zeros(m), norms[m:]])
        # L D L' of R'R.
        pivots = np.diagonal(factors, axis1=1, axis2=2).copy()
        factors[:] = np.swapaxes(factors / pivots[:, :, None], 1, 2)
        factors[:, range(m), range(m)] = pivots**2
        return -1

    def _firm(self, norms: Floats, regularization: float) -> Floats | None:
        """The rows (m, u + x + 1) of the controls, regularized in proportion to the ``norms`` of their columns.

        None where a control has no minimum. One without any effect is not regularized, if there are others.
        """
        m, rows = self.m, self.rows
        largest = norms.max(initial=0.0)
        if not (np.isfinite(rows.sum()) and largest > 0.0):
            return None
        firm, known = rows[:m], np.ones(m)
        if regularization > 0.0 or norms.min() == 0.0:
            idle = (norms == 0.0) & (self._slope() == 0.0)
            weight, known = np.where(idle, largest, np.sqrt(regularization) * norms), np.where(idle, 0.0, 1.0)
            if weight.any():
                firm = triangular(np.vstack([firm, np.eye(m, rows.shape[1]) * weight[:, None]]), m)
        pivots = np.abs(firm.diagonal())
        if not pivots.min() > 0.0:
            return None
        lost = known * np.maximum(self.scale[:m], norms) / pivots
        self.loss = max(self.loss, EPSILON * float(lost.max()))
        return firm

    def _slope(self) -> Floats:
        """The gradient (m,) of the value in the control."""
        m = self.m
        found: Floats = self.linear[:m] + self.rows[:m, :m].T @ self.rows[:m, -1]
        return found

    def _decide(self, firm: Floats) -> tuple[Floats, Floats]:
        """Feedforward (m,) and gains (m, x) of R_uu (k, K) = -(r_u + R_uu'^-1 c_u, R_ux), and the value under them."""
        m, rows, slope = self.m, self.rows, self._slope()
        forced = dtrtrs(firm[:, :m], self.linear[:m], trans=1)[0]
        both = -dtrtrs(firm[:, :m], np.column_stack([firm[:, m:-1], firm[:, -1] + forced]))[0]
        K, k = both[:, :-1], both[:, -1]
        moved = rows[:m, :m] @ k
        self.slope += float(slope @ k)
        self.curvature += float(moved @ moved)
        left = np.hstack([np.zeros((m, m)), rows[:m, m:] + rows[:m, :m] @ both])
        # What is left of the controls' rows is zero up to rounding where they are as they were.
        self.rows = np.vstack([left[: 0 if np.array_equal(firm, rows[:m]) else m], rows[m:]])
        self.linear[m:] += K.T @ self.linear[:m]
        self.linear[:m] = self.costate[:m] = 0.0
        return k, K
