"""Collocation at the Radau points: for damping that is faster than the step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.core import Tableau
from varpin.integrators.collocation import Collocation
from varpin.integrators.gauss import BUDGET_SHARE
from varpin.integrators.tableau import radau, radau_coefficients

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Radau(Collocation):
    """Radau IIA collocation with s stages, in position-momentum form, for damping and springs faster than the step.

    The stage equations of :class:`Gauss` with other points, the last of them the end of the step. Of order 2 s - 1 and
    L-stable: what a control that jumps excites in a fast damper dies out within the step, where Gauss, which is
    A-stable only, rings on. It is not symplectic: where nothing is damped, energy decays slowly, and Gauss is better.

    Steps are accepted or taken in parts as :class:`Midpoint` does.

    Main args:
        stages: s, from 1 to 6. One is the implicit Euler method, whose error is in percents of the motion.

    Other Args:
        guard: As of :class:`Midpoint`, and so are the others; with two stages or more 1/100 of its ``energy_budget``
            is allowed, so that oscillations that nothing damps keep their energy beside dampers.
        tolerance: On the residual, in units of the rounding error of the terms that cancel in it.
        kick: When noise kicks the momentum, ``"left"`` or ``"split"``.
    """

    l_stable = True

    @property
    def order(self) -> int:
        """See :meth:`Integrator.order`; 2 s - 1."""
        return 2 * int(self.stages) - 1

    def _shares(self) -> tuple[float, float]:
        # The budget alone: a step's own balance is off where it damps what it does not resolve, and is to.
        return (1.0, BUDGET_SHARE) if self.stages > 1 else (1.0, 1.0)

    def _tableau(self) -> Tableau:
        return radau(int(self.stages))

    def _coefficients(self) -> tuple[Floats, Floats, Floats]:
        return radau_coefficients(int(self.stages))
