"""Variational integrators of high order: collocation at the Gauss points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from varpin.checks import count
from varpin.core import Guards, Tableau
from varpin.errors import InputError
from varpin.integrators.tableau import gauss, gauss_coefficients
from varpin.integrators.variational import Variational
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

MOST_STAGES = 6
# Of the energy errors that one stage is allowed, what is enough for more: steps of high order seldom need it.
BALANCE_SHARE, BUDGET_SHARE = 1 / 25, 1 / 100


@dataclass(frozen=True)
class Gauss(Variational):
    """Variational Gauss-Legendre collocation with s stages, in position-momentum form.

    Solves L_v(Q_i, V_i) = p0 + dt sum_j a_ij (L_q + F)(Q_j, V_j) with Q_i = q0 + dt sum_j a_ij V_j for the stage
    velocities V_i. Of order 2 s, symmetric, and symplectic where nothing is forced; one stage is ``Midpoint()``.

    Dampers and springs of the scene act at every stage and keep the order. Controls are constant over a step, and so
    the motion under a digital controller (a control law, a :class:`varpin.LinearPolicy`) is of order 2 s. Of a control
    that changes within the step the motion is right to second order only, whatever s, when it is sampled in the step's
    middle (:class:`varpin.OpenLoop`), and to first order when at its start. So put viscous friction into the scene,
    not into a control law.

    Steps are accepted or taken in parts as :class:`Midpoint` does.

    Main args:
        stages: s, from 1 to 6.

    Other Args:
        tolerance: As of :class:`Midpoint`, and so are the others.
        branch_margin: Of the stages' mean mass matrix and curvature.
        energy_balance: Largest error in the energy balance of a substep, in units of the energy it turns over; of more
            than one stage 1/25 of it is asked.
        energy_budget: The errors of all substeps together, in units of the largest kinetic energy so far; of more than
            one stage 1/100 of it is asked. That costs few substeps and keeps fifty times the energy: a chaotic
            motion gathers its energy error in a few violent moments.
        max_halvings: A step is never cut into more than 2**max_halvings parts.
        kick: When noise kicks the momentum, ``"left"`` or ``"split"``.
    """

    stages: int = 2
    tolerance: float = 0.5
    branch_margin: float = 0.5
    energy_balance: float = 0.005
    energy_budget: float = 0.02
    max_halvings: int = 12
    kick: Literal["left", "split"] = "left"

    named = ("stages",)

    def __post_init__(self) -> None:
        if count("stages", self.stages, 1) > MOST_STAGES:
            raise InputError(f"stages must be at most {MOST_STAGES}, got {self.stages}")
        super().__post_init__()

    @property
    def order(self) -> int:
        """See :meth:`Integrator.order`; 2 s."""
        return 2 * int(self.stages)

    def _tableau(self) -> Tableau:
        return gauss(int(self.stages))

    def _guards(self) -> Guards:
        if self.stages == 1:
            return super()._guards()
        strict = replace(
            self,
            stages=1,
            energy_balance=BALANCE_SHARE * self.energy_balance,
            energy_budget=BUDGET_SHARE * self.energy_budget,
        )
        return strict._guards()

    def _guess(self, trajectory: Trajectory) -> Floats:
        """Stage velocities (N, s, n) of the cubic through the nodes and their velocities.

        With noise the step at dw = 0 starts from another momentum, and its velocity is all there is to go by.
        """
        q, v = trajectory.q, trajectory.v
        c = gauss_coefficients(int(self.stages))[2][None, :, None]
        if trajectory.dw.any():
            return v[:-1, None] + np.zeros_like(c)
        mean = (np.diff(q, axis=0) / trajectory.dt)[:, None]
        if self.stages == 1:
            return mean
        guess: Floats = (
            (1.0 - c) * (1.0 - 3.0 * c) * v[:-1, None] + c * (3.0 * c - 2.0) * v[1:, None] + 6.0 * c * (1.0 - c) * mean
        )
        return guess
