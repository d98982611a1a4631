"""The base class of collocation methods with several stages."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np

from varpin.arrays import Floats
from varpin.errors import InputError
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

    def after_held(self, Z: Floats) -> Floats:
        """Derivatives (n, n) of momenta after a step in an impulse that is held over it.

        Without it they decay as exp(-Z s) over the step, for Z (n, n).
        """
        _, inner = self._held(Z)
        found: Floats = np.eye(len(Z)) - Z @ np.tensordot(self._coefficients()[1], inner, axes=1)
        return found

    def _held(self, Z: Floats) -> tuple[Floats, Floats]:
        """The matrix (s n, s n) of the stages' momenta, and these (s, n, n) for an impulse of one."""
        (a, _, c), n = self._coefficients(), len(Z)
        matrix = np.eye(len(c) * n) + np.kron(a, Z)
        return matrix, np.linalg.solve(matrix, np.kron(c[:, None], np.eye(n))).reshape(-1, n, n)
