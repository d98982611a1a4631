"""Collocation at the Radau points, for damping that is faster than the step."""

from __future__ import annotations

from dataclasses import dataclass

from varpin.arrays import Floats
from varpin.core import Tableau
from varpin.integrators.collocation import Collocation
from varpin.integrators.gauss import BUDGET_SHARE
from varpin.integrators.tableau import radau, radau_coefficients


@dataclass(frozen=True)
class Radau(Collocation):
    """Radau IIA collocation with s stages, in position-momentum form, for damping and springs faster than the step.

    The stage equations of :class:`Gauss` at other points, the last of which is the end of the step. The method has
    order 2 s - 1 and is L-stable: transients of fast dampers after a jump of the control decay within the step, where
    Gauss, which is only A-stable, oscillates. It is not symplectic: without damping, energy decays slowly, and Gauss is
    better.

    Steps are accepted or divided as in :class:`Midpoint`.

    Main args:
        stages: s, from 1 to 6. One stage is the implicit Euler method, with errors of several percent.

    Other Args:
        guard: As in :class:`Midpoint`. With more than one stage, its ``energy_budget`` is multiplied by 1/100, so that
            undamped oscillations beside dampers keep their energy.
        tolerance: Tolerance of the residual, in units of the rounding error of its cancelling terms.
        kick: When the noise impulse acts: ``"left"``, ``"split"`` or ``"held"``, as in :class:`Midpoint`.
    """

    l_stable = True

    @property
    def order(self) -> int:
        """See :meth:`Integrator.order`; 2 s - 1."""
        return 2 * int(self.stages) - 1

    def _shares(self) -> tuple[float, float]:
        # Only the budget: the balance of a step has a large error, as intended, where it damps unresolved modes.
        return (1.0, BUDGET_SHARE) if self.stages > 1 else (1.0, 1.0)

    def _tableau(self) -> Tableau:
        return radau(int(self.stages))

    def _coefficients(self) -> tuple[Floats, Floats, Floats]:
        return radau_coefficients(int(self.stages))
