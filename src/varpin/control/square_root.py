"""Convex quadratic functions as sums of squares, for the backward pass on square roots.

Where the plain recursion loses too many digits, the value function is kept as a sum of squares (1/2) |R x + r|^2,
without its Hessian R'R: see ``square_root.hpp`` in ``src/core``. Every Hessian must be positive semidefinite.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from varpin import core
from varpin.arrays import Floats

# Size of eigenvalues that are rounding errors in a Hessian with unit diagonal.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Squares:
    """N functions (1/2) |L z + r|^2 + c . z, up to constants."""

    root: Floats  # L (N, z, z), or (1, z, z) for all
    shift: Floats  # r (N, z)
    linear: Floats  # c (N, z)

    def __getitem__(self, rows: slice) -> Squares:
        return Squares(self.root if len(self.root) == 1 else self.root[rows], self.shift[rows], self.linear[rows])

    def after(self, D: Floats) -> Squares:
        """The functions of x with z = D x."""
        return Squares(self.root @ D, self.shift, self.linear @ D)

    def padded(self, rows: int) -> Squares:
        """The same functions, with zero rows added to the roots up to ``rows``."""
        more = rows - self.shift.shape[1]
        return Squares(
            np.pad(self.root, ((0, 0), (0, more), (0, 0))), np.pad(self.shift, ((0, 0), (0, more))), self.linear
        )

    @property
    def core(self) -> core.Squares:
        """The squares as an object of the compiled core."""
        return core.Squares(self.root, self.shift, self.linear)


def squares_of(gradient: Floats, hessian: Floats) -> Squares | None:
    """Squares from ``gradient`` (N, z) and ``hessian`` (N, z, z) or (1, z, z); None if one is not semidefinite.

    The linear part has only the gradient's component in the Hessian's null space: in squares a gradient keeps its
    digits.
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
    return Squares(weight[..., :, None] * across * unit[..., None, :], shift, linear)
