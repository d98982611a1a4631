"""The backward pass on a square root of the value's Hessian, where the plain recursion loses all digits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from varpin.arrays import Floats
from varpin.control.sizes import ROUNDING
from varpin.support.frozen import Frozen


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
        hessian: Floats,  # noqa: ARG002 - in `running`, as squares
        feedforward: Floats,
        feedback: Floats,
        control_gradient: Floats,
        spread: Floats,
        factors: Floats,
        running: Squares,
    ) -> int:
        """As :meth:`varpin.core.BackwardPass.run`, with the ``running`` cost as squares."""
        m, x = self.m, self.x
        order = np.r_[x : x + m, :x]  # from (x, u) to (u, x)
        for s in range(len(A) - 1, -1, -1):
            step = np.zeros((m + x, m + x))
            step[m:] = np.hstack([B[s], A[s]])
            held = (s + 1) % hold != 0
            step[:m, :m] = np.eye(m) * held
            root, rest = running.root[s % len(running.root)][:, order], running.shift[s][:, None]
            stack = [np.hstack([self.rows[:, :-1] @ step, self.rows[:, -1:]]), np.sqrt(h) * np.hstack([root, rest])]
            linear = self.linear @ step + h * running.linear[s][order]
            costate = self.costate @ step + h * gradient[s][order]
            if G.shape[2]:
                kicked = _triangular(np.sqrt(h) * self.rows[:, m:-1], x)[:x]
                spread[s] = kicked.T @ kicked
                for w in range(G.shape[2]):
                    jump, turned = kicked @ G[s, :, w], kicked @ np.hstack([Gu[s, :, w], Gx[s, :, w]])
                    self.noise += 0.5 * float(jump @ jump)
                    if turned.any():
                        stack.append(np.hstack([turned, jump[:, None]]))
                        costate = costate + jump @ turned
            scale = self.scale[m:] @ np.abs(step[m:])
            scale[:m] = np.hypot(scale[:m], held * self.scale[:m])
            self.linear, self.costate, self.scale = linear, costate, scale
            rows = np.vstack(stack)
            self.rows = _triangular(rows, m + x)[: m + x]
            if s % hold:
                continue
            r = s // hold
            norms = np.linalg.norm(rows[:, :-1], axis=0)
            firm = self._firm(norms[:m], regularization)
            if firm is None:
                return r
            control_gradient[r] = costate[:m]
            pivots = np.diagonal(firm)
            factors[r] = np.tril((firm[:, :m] / pivots[:, None]).T, -1) + np.diag(pivots**2)
            feedforward[r], feedback[r] = self._decide(firm)
            self.scale = np.concatenate([np.zeros(m), norms[m:]])
        return -1

    def _firm(self, norms: Floats, regularization: float) -> Floats | None:
        """The rows (m, u + x + 1) of the controls, regularized in proportion to the ``norms`` of their columns.

        None where a control has no minimum. One without any effect is not regularized, if there are others.
        """
        m, rows = self.m, self.rows
        largest = norms.max(initial=0.0)
        if not (np.isfinite(rows).all() and largest > 0.0):
            return None
        idle = (norms == 0.0) & (self._slope() == 0.0)
        weight = np.where(idle, largest, np.sqrt(regularization) * norms)
        firm = rows[:m]
        if weight.any():
            firm = _triangular(np.vstack([firm, np.eye(m, rows.shape[1]) * weight[:, None]]), m)[:m]
        pivots = np.abs(np.diagonal(firm))
        if not (pivots > 0.0).all():
            return None
        lost = np.finfo(float).eps * np.maximum(self.scale[:m], norms) / pivots
        self.loss = max(self.loss, float(lost[~idle].max(initial=0.0)))
        return firm

    def _slope(self) -> Floats:
        """The gradient (m,) of the value in the control."""
        m = self.m
        found: Floats = self.linear[:m] + self.rows[:m, :m].T @ self.rows[:m, -1]
        return found

    def _decide(self, firm: Floats) -> tuple[Floats, Floats]:
        """Feedforward (m,) and gains (m, x) of R_uu (k, K) = -(r_u + R_uu'^-1 c_u, R_ux), and the value under them."""
        m, rows, slope = self.m, self.rows, self._slope()
        forced = solve_triangular(firm[:, :m], self.linear[:m], trans=1)
        both = -solve_triangular(firm[:, :m], np.column_stack([firm[:, m:-1], firm[:, -1] + forced]))
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


def _triangular(rows: Floats, leading: int) -> Floats:
    """``rows`` (r, c) with their first ``leading`` columns made triangular by reflections.

    The row with the largest entry in a column is the pivot row. Otherwise a large row with a zero there would destroy
    digits of small rows (Powell and Reid, "On applying Householder transformations to linear least squares problems",
    1969).
    """
    rows = rows.copy()
    for k in range(leading):
        best = k + int(np.argmax(np.abs(rows[k:, k])))
        largest = abs(rows[best, k])
        if not largest > 0.0:
            continue
        rows[[k, best]] = rows[[best, k]]
        along = rows[k:, k].copy()
        norm = largest * np.linalg.norm(along / largest)
        end = -norm if along[0] > 0.0 else norm
        # The vector of the reflection, scaled by its first entry, is (1, w) with length^2 = 2 norm / (norm + |a_kk|).
        factor = (norm + largest) / norm
        along = np.append(1.0, along[1:] / (along[0] - end))
        rows[k:, k + 1 :] -= np.outer(along, factor * (along @ rows[k:, k + 1 :]))
        rows[k:, k] = 0.0
        rows[k, k] = end
    return rows
