"""The midpoint variational integrator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from varpin.arrays import Floats
from varpin.core import Tableau
from varpin.integrators.tableau import gauss_coefficients, lobatto_places, midpoint
from varpin.integrators.variational import Guard, Variational
from varpin.support.checks import fraction


@dataclass(frozen=True)
class Midpoint(Variational):
    """The forced midpoint variational integrator in position-momentum form.

    Solves the discrete Euler-Lagrange equations p0 + D1 Ld + F- = 0, p1 = D2 Ld + F+ with the generalized midpoint
    rule (Johnson and Murphey 2009); each half-step has half of the impulse of controls and friction. The method is
    symplectic for conservative motions, of second order for alpha = 1/2 and of first order otherwise.

    A step is accepted if Newton's method contracts from the start, if its root lies on the branch of solutions that is
    connected to dt -> 0, and if its energy balance closes. Otherwise it is halved, repeatedly if need be;
    ``Trajectory.statistics.substeps`` counts the parts.

    Main args:
        alpha: Evaluation point of the Lagrangian in a unit step, in [0, 1]. At 1/2 the order is 2; elsewhere it is 1,
            and the energy at the nodes oscillates with an amplitude of first order in dt.

    Other Args:
        guard: Conditions on accepted steps; None accepts every root that Newton's method finds, and divides no step.
        tolerance: Tolerance of the residual, in units of the rounding error of its cancelling terms.
        kick: When the noise impulse acts on the momentum. ``"left"``: before the step (the paper's scheme).
            ``"split"``: one half before the step and one half after it, evaluated at the state there; for constant mass
            and additive noise the weak order is then 2 instead of 1. ``"held"``: the noise of a step is a force that is
            constant over it, F dw / dt with F at its start; its weak order is 2 in the same cases, and with alpha = 1/2
            the stationary covariance of a linear system is exact at every dt.
    """

    alpha: float = 0.5
    guard: Guard | None = Guard()  # noqa: RUF009
    tolerance: float = 0.5
    kick: Literal["left", "split", "held"] = "left"

    named = ("alpha",)

    def __post_init__(self) -> None:
        fraction("alpha", self.alpha)
        super().__post_init__()

    @property
    def order(self) -> int:
        """See :meth:`Integrator.order`; 2 for alpha = 1/2, otherwise 1."""
        return 2 if self.alpha == 0.5 else 1

    def _tableau(self) -> Tableau:
        return midpoint(float(self.alpha))

    def _constraint_places(self) -> Floats | None:
        return lobatto_places(1) if self.alpha == 0.5 else None

    def _coefficients(self) -> tuple[Floats, Floats, Floats]:
        return gauss_coefficients(1)

    def _times(self) -> Floats:
        return np.array([float(self.alpha)])
