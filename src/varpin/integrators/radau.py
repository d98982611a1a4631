"""Collocation at the Radau points: for damping that is faster than the step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from varpin.checks import count
from varpin.core import Tableau
from varpin.errors import InputError
from varpin.integrators.tableau import radau, radau_coefficients
from varpin.integrators.variational import Guard, Variational

Floats = NDArray[np.float64]

MOST_STAGES = 6


@dataclass(frozen=True)
class Radau(Variational):
    """Radau IIA collocation with s stages, in position-momentum form, for damping and springs faster than the step.

    The stage equations of :class:`Gauss` with other points, the last of them the end of the step. Of order 2 s - 1 and
    L-stable: what a control that jumps excites in a fast damper dies out within the step, where Gauss, which is
    A-stable only, rings on. It is not symplectic: where nothing is damped, energy decays slowly, and Gauss is better.

    Steps are accepted or taken in parts as :class:`Midpoint` does.

    Main args:
        stages: s, from 2 to 6. One would be the implicit Euler method, whose error is in percents of the motion.

    Other Args:
        guard: As of :class:`Midpoint`, and so are the others.
        tolerance: On the residual, in units of the rounding error of the terms that cancel in it.
        kick: When noise kicks the momentum, ``"left"`` or ``"split"``.
    """

    stages: int = 2
    guard: Guard | None = Guard()  # noqa: RUF009
    tolerance: float = 0.5
    kick: Literal["left", "split"] = "left"

    named = ("stages",)

    def __post_init__(self) -> None:
        if count("stages", self.stages, 2) > MOST_STAGES:
            raise InputError(f"stages must be at most {MOST_STAGES}, got {self.stages}")
        super().__post_init__()

    @property
    def order(self) -> int:
        """See :meth:`Integrator.order`; 2 s - 1."""
        return 2 * int(self.stages) - 1

    def _tableau(self) -> Tableau:
        return radau(int(self.stages))

    def _times(self) -> Floats:
        return radau_coefficients(int(self.stages))[2]
