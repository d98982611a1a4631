"""Variational integrators of high order: collocation at the Gauss points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.core import Tableau
from varpin.integrators.collocation import Collocation
from varpin.integrators.tableau import gauss, gauss_coefficients, lobatto_places

Floats = NDArray[np.float64]

# Of the energy errors that one stage is allowed, what is enough for more: steps of high order seldom need it.
BALANCE_SHARE, BUDGET_SHARE = 1 / 25, 1 / 100


@dataclass(frozen=True)
class Gauss(Collocation):
    """Variational Gauss-Legendre collocation with s stages, in position-momentum form.

    Solves L_v(Q_i, V_i) = p0 + dt sum_j a_ij (L_q + F)(Q_j, V_j) with Q_i = q0 + dt sum_j a_ij V_j for the stage
    velocities V_i. Of order 2 s, symmetric, and symplectic where nothing is forced; one stage is ``Midpoint()``.

    Dampers and springs of the scene act at every stage and keep the order, and so do controls that are a function of
    time (:class:`varpin.OpenLoop`). Other controls are constant over a step, and so the motion under a digital
    controller (a control law, a :class:`varpin.LinearPolicy`) is of order 2 s, too. As an approximation of a law in
    continuous time it is of first order in the law's period. So put viscous friction into the scene, not into a
    control law.

    Steps are accepted or taken in parts as :class:`Midpoint` does.

    Main args:
        stages: s, from 1 to 6.

    Other Args:
        guard: As of :class:`Midpoint`, and so are the others; of more than one stage 1/25 of its ``energy_balance`` is
            asked, and 1/100 of its ``energy_budget``. That costs few substeps and keeps fifty times the energy: a
            chaotic motion gathers its energy error in a few violent moments.
        tolerance: On the residual, in units of the rounding error of the terms that cancel in it.
        kick: When noise kicks the momentum, ``"left"`` or ``"split"``.
    """

    @property
    def order(self) -> int:
        """See :meth:`Integrator.order`; 2 s."""
        return 2 * int(self.stages)

    def _tableau(self) -> Tableau:
        return gauss(int(self.stages))

    def _constraint_places(self) -> Floats | None:
        return lobatto_places(int(self.stages))

    def _coefficients(self) -> tuple[Floats, Floats, Floats]:
        return gauss_coefficients(int(self.stages))

    def _shares(self) -> tuple[float, float]:
        return (BALANCE_SHARE, BUDGET_SHARE) if self.stages > 1 else (1.0, 1.0)
