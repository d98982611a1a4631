"""The base class of collocation methods with several stages."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.integrators.tableau import stability
from varpin.integrators.variational import Guard, Variational
from varpin.support.checks import count

MOST_STAGES = 6


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

    @abstractmethod
    def _coefficients(self) -> tuple[Floats, Floats, Floats]:
        """A (s, s), b (s,) and c (s,) of the method over a unit step."""

    @property
    def stage_times(self) -> tuple[float, ...]:
        """See :attr:`Integrator.stage_times`."""
        return tuple(self._times().tolist()) if self.stages > 1 else ()

    def _times(self) -> Floats:
        return self._coefficients()[2]

    def amplification(self, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """See :meth:`Integrator.amplification`."""
        a, b, _ = self._coefficients()
        return stability(a, b, z)
