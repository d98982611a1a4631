"""The midpoint variational integrator.

Equation (G2) of docs/mathematics.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from varpin.core import Tableau
from varpin.integrators.tableau import lobatto_places, midpoint
from varpin.integrators.variational import Guard, Variational
from varpin.support.checks import fraction

Floats = NDArray[np.float64]


def largest_step(M: Floats, Lqq: Floats, margin: float) -> float:
    """The dt [s] up to which the branch guard of alpha = 1/2 accepts a step around a state with these M and L_qq.

    Where M - dt^2 / (4 (1 - margin)) L_qq ceases to be positive definite; infinite where no direction is unstable. It
    says nothing of accuracy.
    """
    rates = scipy.linalg.eigh(Lqq, M, eigvals_only=True)
    # Of a direction without curvature rounding leaves a tiny one, of either sign.
    rounding = 1e-12 * float(np.abs(rates).max())
    return 2.0 * float(np.sqrt((1.0 - margin) / rates[-1])) if rates[-1] > rounding else np.inf


@dataclass(frozen=True)
class Midpoint(Variational):
    """The forced midpoint variational integrator in position-momentum form.

    Solves the discrete Euler-Lagrange equations p0 + D1 Ld + F- = 0, p1 = D2 Ld + F+ with the generalized midpoint
    rule (Johnson and Murphey 2009); each half-step carries half of the impulse of controls and friction. Symplectic
    where nothing is forced, of second order for alpha = 1/2 and of first order otherwise.

    A whole step is accepted if Newton contracts from the start, if its root lies on the branch of solutions that is
    connected to dt -> 0, and if its energy balance closes; else it is taken in halves, and halves of halves, which
    ``Trajectory.statistics.substeps`` counts.

    Main args:
        alpha: Where in the step the Lagrangian is taken, in [0, 1]. Of second order at 1/2; elsewhere of first, and the
            energy at nodes swings by as much.

    Other Args:
        guard: When a step is accepted; None takes every root that Newton's method finds, and cuts no step.
        tolerance: On the residual, in units of the rounding error of the terms that cancel in it.
        kick: When noise kicks the momentum: ``"left"``, before the step (the paper's scheme); or ``"split"``, half
            of it before and half after, at the state then reached, which for constant mass and additive noise is of
            weak order 2 instead of 1.
    """

    alpha: float = 0.5
    guard: Guard | None = Guard()  # noqa: RUF009
    tolerance: float = 0.5
    kick: Literal["left", "split"] = "left"

    named = ("alpha",)

    def __post_init__(self) -> None:
        fraction("alpha", self.alpha)
        super().__post_init__()

    @property
    def order(self) -> int:
        """See :meth:`Integrator.order`; 2 for alpha = 1/2, and 1 elsewhere."""
        return 2 if self.alpha == 0.5 else 1

    def _tableau(self) -> Tableau:
        return midpoint(float(self.alpha))

    def _constraint_places(self) -> Floats | None:
        return lobatto_places(1) if self.alpha == 0.5 else None

    def _times(self) -> Floats:
        return np.array([float(self.alpha)])

    def amplification(self, z: NDArray[np.complex128]) -> NDArray[np.complex128] | None:
        """See :meth:`Integrator.amplification`; for alpha = 1/2 alone."""
        return (1.0 + 0.5 * z) / (1.0 - 0.5 * z) if self.alpha == 0.5 else None
