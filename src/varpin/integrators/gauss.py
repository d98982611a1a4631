"""Variational integrators of high order: collocation at the Gauss points."""

from __future__ import annotations

from dataclasses import dataclass

from varpin.arrays import Floats
from varpin.core import Tableau
from varpin.integrators.collocation import Collocation
from varpin.integrators.tableau import gauss, gauss_coefficients, lobatto_places

# Shares of the guard's energy balance and energy budget for methods with more than one stage.
BALANCE_SHARE, BUDGET_SHARE = 1 / 25, 1 / 100


@dataclass(frozen=True)
class Gauss(Collocation):
    """Variational Gauss-Legendre collocation with s stages, in position-momentum form.

    Solves L_v(Q_i, V_i) = p0 + dt sum_j a_ij (L_q + F)(Q_j, V_j) with Q_i = q0 + dt sum_j a_ij V_j for the stage
    velocities V_i. The method is symmetric, has order 2 s, and is symplectic for conservative motions. One stage is
    ``Midpoint()``.

    Dampers and springs of the scene act at every stage and keep the order, as do controls as a function of time
    (:class:`varpin.OpenLoop`). Other controls are constant over a step, so motions under a digital controller (a
    control law, a :class:`varpin.LinearPolicy`) have order 2 s, too. As an approximation of a law in continuous time,
    they have order 1 in the law's period. So put viscous friction into the scene, not into a control law.

    Steps are accepted or divided as in :class:`Midpoint`.

    Main args:
        stages: s, from 1 to 6.

    Other Args:
        guard: As in :class:`Midpoint`. With more than one stage, its ``energy_balance`` is multiplied by 1/25 and its
            ``energy_budget`` by 1/100. That costs few substeps and reduces the energy error by a factor of fifty: in
            chaotic motions, most of it comes from a few violent moments.
        tolerance: Tolerance of the residual, in units of the rounding error of its cancelling terms.
        kick: When the noise impulse acts: ``"left"``, ``"split"`` or ``"held"``, as in :class:`Midpoint`.
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
