"""The backward pass on a square root of the value's Hessian, for where the plain recursion runs out of digits.

The value is kept as a sum of squares (1/2) |R x + r|^2, and its Hessian R'R never formed. With the running cost as
squares (1/2) |L z + l|^2 too, the cost to go from a step is a sum of squares in (u, x). An orthogonal transformation
brings their rows to

    ( R_uu  R_ux  r_u )        K = -R_uu^-1 R_ux,  k = -R_uu^-1 r_u,
    (   0   R_xx  r_x )        and the last rows are the value before the step

(Kailath, Sayed and Hassibi, *Linear Estimation*, 2000, chapter 12). What is eps of the Hessian's largest terms to the
plain recursion is eps of their root here, so that weights may be twice as many digits apart. Every Hessian must be
positive semidefinite; the part of a gradient that it knows nothing of is carried along as it is. Node by node in NumPy,
many times as slow as the compiled recursion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from varpin.kernels.backward import EPS, Gains, Steps, Value
from varpin.kernels.box import solve_box
from varpin.kernels.orthogonal import triangularize

Floats = NDArray[np.float64]

# Eigenvalues of this size are rounding's in a Hessian with ones on its diagonal.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Squares:
    """Convex quadratic functions (1/2) |L z + r|^2 + c . z, but for constants."""

    root: Floats  # L (..., z, z)
    shift: Floats  # r (..., z)
    linear: Floats  # c (..., z)

    def __getitem__(self, rows: slice | int) -> Squares:
        return Squares(self.root[rows], self.shift[rows], self.linear[rows])


def squares_of(gradient: Floats, hessian: Floats) -> Squares | None:
    """Of ``gradient`` (N, z) and ``hessian`` (N, z, z) or (1, z, z); None where one is not positive semidefinite.

    Only what the Hessian knows nothing of is left in the linear part: as a sum of squares a gradient keeps its digits.
    """
    size = np.sqrt(np.abs(np.diagonal(hessian, axis1=-2, axis2=-1)))
    unit = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(hessian / (unit[..., :, None] * unit[..., None, :]))
    if not (values >= -_ROUNDING).all():
        return None
    weight, known = np.sqrt(np.maximum(values, 0.0)), values > _ROUNDING
    across = np.swapaxes(vectors, -1, -2)
    along = (across @ (gradient / unit)[..., None])[..., 0]
    shift = np.where(known, along / np.where(known, weight, 1.0), 0.0)
    linear = unit * (vectors @ np.where(known, 0.0, along)[..., None])[..., 0]
    root = np.broadcast_to(weight[..., :, None] * across * unit[..., None, :], (*gradient.shape, gradient.shape[-1]))
    return Squares(root, shift, linear)


def triangular(rows: Floats) -> Floats:
    """The upper triangular R (z, z) with R'R = rows'rows."""
    size = rows.shape[1]
    room = np.zeros((max(len(rows), size), size))
    room[: len(rows)] = rows
    triangularize(room)
    return room[:size]


def _at_sample(part: Floats, velocity: Floats, node: int, dof: int) -> Floats:
    """Derivative (2n, 2n) of (q, v) at a sample in x at ``node``; ``part`` holds q of q, v and v of q, v there."""
    one = np.eye(dof)
    rate = velocity[node] if len(velocity) else np.eye(dof, 2 * dof, dof)
    places = np.hstack([one, np.zeros((dof, dof))])
    return np.vstack([part[0] * places + part[1] * rate, part[2] * places + part[3] * rate])


class RootPass:
    """The pass so far; blocks of steps are taken from the last to the first."""

    def __init__(self, terminal: Squares, value: Value) -> None:
        """From the terminal cost in x, and its gradient as the costate in ``value``."""
        x, size = terminal.root.shape[-1], value.gradient.size
        self.root, self.linear = np.zeros((len(terminal.root), size + 1)), np.zeros(size)
        self.root[:, :x], self.root[:, -1], self.linear[:x] = terminal.root, terminal.shift, terminal.linear
        self.value = value
        value.scale[:] = np.sqrt((self.root[:, :-1] ** 2).sum(axis=0))

    def run(self, h: float, hold: int, regularization: float, steps: Steps, running: Squares, gains: Gains) -> int:
        """Over a block, as :func:`varpin.kernels.backward.backward_pass`; ``running`` costs are of the samples."""
        for s in range(len(steps.A) - 1, -1, -1):
            if len(gains.costate):
                gains.costate[s] = self.value.costate[: steps.A.shape[1]]
            rows, linear, costate = self._step(h, s, (s + 1) % hold != 0, steps, running, gains)
            if s % hold == 0:
                if not self._decide(regularization, s // hold, steps.slack, rows, linear, costate, gains):
                    return s // hold
                continue
            self.root, self.linear = triangular(rows)[:-1], linear
            self.value.costate[:] = costate
        return -1

    def _step(
        self, h: float, s: int, held: bool, steps: Steps, running: Squares, gains: Gains
    ) -> tuple[Floats, Floats, Floats]:
        """Rows (L r) of the squares that add up to the cost in (x, u); the linear part; the gradient of the motion."""
        value, x, size = self.value, steps.A.shape[1], steps.A.shape[1] + steps.B.shape[2]
        n, samples = x // 2, len(steps.rule)
        J = np.hstack([steps.A[s], steps.B[s]])
        carried = np.hstack([self.root[:, :x] @ J, self.root[:, -1:]])
        linear, costate = J.T @ self.linear[:x], J.T @ value.costate[:x]
        scale = np.abs(J).T @ value.scale[:x]
        if held:
            carried[:, x:-1] += self.root[:, x:-1]
            linear[x:] += self.linear[x:]
            costate[x:] += value.costate[x:]
            scale[x:] = np.hypot(scale[x:], value.scale[x:])
        value.scale[:] = scale
        rows, kicked = [carried], [np.sqrt(h) * self.root[:, :x]]
        for k in range(samples):
            rule, point = steps.rule[k], s * samples + k
            own = running[point]
            after = _at_sample(rule[[3, 4, 7, 8]], steps.velocity, s + 1, n)
            D = np.eye(size)
            D[:x] = after @ J
            D[:x, :x] += _at_sample(rule[[1, 2, 5, 6]], steps.velocity, s, n)
            rows.append(np.sqrt(h * rule[0]) * np.column_stack([own.root @ D, own.shift]))
            linear += h * rule[0] * (D.T @ own.linear)
            costate += h * rule[0] * (D.T @ steps.gradient[point])
            kicked.append(h * np.sqrt(rule[0]) * (own.root[:, :x] @ after))
        if steps.G.shape[2]:
            N = np.vstack(kicked)
            gains.spread[s] = N.T @ N
            for w in range(steps.G.shape[2]):
                jump = N @ steps.G[s, :, w]
                spread = N @ np.hstack([steps.Gx[s, :, w], steps.Gu[s, :, w]])
                rows.append(np.column_stack([spread, jump]))
                value.noise[0] += 0.5 * jump @ jump
                costate += spread.T @ jump
        return np.vstack(rows), linear, costate

    def _decide(
        self, regularization: float, r: int, slack: Floats, rows: Floats, linear: Floats, costate: Floats, gains: Gains
    ) -> bool:
        value, m = self.value, gains.feedforward.shape[1]
        x = rows.shape[1] - 1 - m
        R = triangular(np.hstack([rows[:, x:-1], rows[:, :x], rows[:, -1:]]))
        top, own = R[:m], np.sqrt((rows[:, x:-1] ** 2).sum(axis=0))
        if not own.any() or not np.isfinite(R).all():
            return False
        Qu = top[:, :m].T @ top[:, -1] + linear[x:]
        idle = (own == 0.0) & (Qu == 0.0)
        weight = np.where(idle, own.max(), np.sqrt(regularization) * own)
        firm = top
        if weight.any():
            firm = triangular(np.vstack([top, np.hstack([np.diag(weight), np.zeros((m, x + 1))])]))[:m]
        k, K, free = np.zeros(m), np.zeros((m, x)), np.ones(m, dtype=bool)
        if len(slack):
            U, work = firm[:, :m], np.zeros((3, m))
            if not (np.diag(U) != 0.0).all() or not solve_box(U.T @ U, Qu, slack[r], k, np.zeros((m, m)), work):
                return False
            free = work[0] == 0.0
        if free.any():
            held = firm[:, -1] + firm[:, :m][:, ~free] @ k[~free]
            F = triangular(np.column_stack([firm[:, :m][:, free], firm[:, m:-1], held]))
            count = int(free.sum())
            F, pivots = F[:count], np.abs(np.diag(F)[:count])
            if not (pivots > 0.0).all():
                return False
            U = F[:, :count]
            K[free] = -solve_triangular(U, F[:, count:-1])
            k[free] = -solve_triangular(U, F[:, -1] + solve_triangular(U, linear[x:][free], trans="T"))
            lost = (EPS * np.maximum(value.scale[x:], own)[free] / pivots)[~idle[free]]
            value.loss[0] = max(value.loss[0], float(lost.max(initial=0.0)))
        if len(slack):
            k = np.clip(k, *slack[r])
        gains.feedforward[r], gains.feedback[r], gains.control_gradient[r] = k, K, costate[x:]
        moved = top[:, :m] @ k
        value.decrease[:] += np.array([Qu @ k, moved @ moved])
        self.linear = np.concatenate([linear[:x] + K.T @ linear[x:], np.zeros(m)])
        value.costate[:x], value.costate[x:] = costate[:x], 0.0
        value.scale[:x], value.scale[x:] = np.sqrt((rows[:, :x] ** 2).sum(axis=0)), 0.0
        # What no control takes away. Without regularization and limits it is zero, but for rounding.
        rest = R[m:-1]
        if weight.any() or not free.all():
            rest = np.vstack([top + np.hstack([np.zeros((m, m)), top[:, :m] @ K, moved[:, None]]), rest])
        self.root = np.hstack([rest[:, m:-1], np.zeros((len(rest), m)), rest[:, -1:]])
        return True
