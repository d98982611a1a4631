"""Inertias that a rigid body can have, in coordinates without bounds.

Equation (I2) of docs/mathematics.md; Rucker and Wensing, IEEE RA-L 2022.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats
from varpin.model.inertia import of_pseudo_inertia, pseudo_inertia

# Least eigenvalue of a body's pseudo-inertia that it begins with, as a share of the largest: links of URDFs are thin or
# points, and a body without extent could never get any.
_FLOOR = 1e-6
_LOWER = np.tril_indices(4)


@dataclass(frozen=True, eq=False)
class Body:
    """A body's inertial numbers as a function of ten coordinates, (I2): P = L E E' L', L L' that of its nominal ones.

    E is lower triangular, with exponentials on its diagonal and 1 where the coordinates are 0. A coordinate of 1 is a
    change by a factor of about e, whatever the size of the body.
    """

    root: Floats  # L (4, 4)

    @classmethod
    def around(cls, numbers: Floats) -> Body:
        """That of a body's numbers (10,), made definite where they are not."""
        sizes, axes = np.linalg.eigh(pseudo_inertia(numbers))
        least = _FLOOR * max(float(sizes[-1]), _FLOOR)
        return cls(np.linalg.cholesky((axes * np.maximum(sizes, least)) @ axes.T))

    def numbers(self, y: Floats) -> tuple[Floats, Floats]:
        """The numbers (10,) at coordinates (10,), and their derivatives (10, 10)."""
        E, diagonal = np.zeros((4, 4)), _LOWER[0] == _LOWER[1]
        E[_LOWER] = np.where(diagonal, np.exp(y), y)
        slopes = np.zeros((10, 4, 4))
        slopes[np.arange(10), _LOWER[0], _LOWER[1]] = np.where(diagonal, np.exp(y), 1.0)
        root = self.root @ E
        change = self.root @ slopes @ root.T
        found, *columns = map(of_pseudo_inertia, (root @ root.T, *(change + np.swapaxes(change, 1, 2))))
        return found, np.stack(columns, axis=1)
