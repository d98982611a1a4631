"""Variational integrators of several stages: collocation at Gauss points, or at Radau points for fast damping."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from varpin.arrays import Floats
from varpin.core import Tableau
from varpin.errors import InputError
from varpin.integrators.tableau import gauss, gauss_coefficients, lobatto_places, radau, radau_coefficients
from varpin.integrators.variational import Guard, Variational
from varpin.support.checks import count

MOST_STAGES = 6
# Shares of the guard's energy balance and energy budget for methods with more than one stage.
_BALANCE_SHARE, _BUDGET_SHARE = 1 / 25, 1 / 100


@dataclass(frozen=True)
class Collocation(Variational):
    """A variational integrator with ``stages`` stages."""

    stages: int = 2
    guard: Guard | None = Guard()  # noqa: RUF009
    tolerance: float = 0.5
    kick: Literal["left", "split", "held"] = "left"

    named = ("stages",)

    def __post_init__(self) -> None:
        if count("stages", self.stages, least=1) > MOST_STAGES:
            raise InputError(f"stages must be at most {MOST_STAGES}, got {self.stages}")
        super().__post_init__()

    @property
    def stage_times(self) -> tuple[float, ...]:
        return tuple(self._times().tolist()) if self.stages > 1 else ()

    def _times(self) -> Floats:
        return self._coefficients()[2]

    def after_held(self, Z: Floats) -> Floats:
        """Derivatives (n, n) of momenta after a step in an impulse that is held over it.

        Without it they decay as exp(-Z s) over the step, for Z (n, n).
        """
        (a, b, c), n = self._coefficients(), len(Z)
        stages = np.linalg.solve(np.eye(len(c) * n) + np.kron(a, Z), np.kron(c[:, None], np.eye(n)))
        found: Floats = np.eye(n) - Z @ np.tensordot(b, stages.reshape(-1, n, n), axes=1)
        return found


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
        return (_BALANCE_SHARE, _BUDGET_SHARE) if self.stages > 1 else (1.0, 1.0)


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
        return (1.0, _BUDGET_SHARE) if self.stages > 1 else (1.0, 1.0)

    def _tableau(self) -> Tableau:
        return radau(int(self.stages))

    def _coefficients(self) -> tuple[Floats, Floats, Floats]:
        return radau_coefficients(int(self.stages))
