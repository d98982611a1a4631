"""What collocation methods of several stages share: their options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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
    kick: Literal["left", "split"] = "left"

    named = ("stages",)

    def __post_init__(self) -> None:
        if count("stages", self.stages, least=1) > MOST_STAGES:
            raise InputError(f"stages must be at most {MOST_STAGES}, got {self.stages}")
        super().__post_init__()
