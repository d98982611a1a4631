"""Feedback policies that kernels can evaluate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.checks import as_floats, count, finite_array
from varpin.errors import InputError
from varpin.kernels.tree import Commands

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False, init=False)
class LinearPolicy:
    """u = u_k + gains_k (x - x_k), evaluated at the start of each of N intervals and held over it.

    x is (q, p) for variational integrators and (q, v) for the others.

    Attributes:
        u: Feed-forward (N, m).
        gains: (N, m, 2n).
        reference: x_k (N, 2n).
        hold: Steps that an interval has.
    """

    u: Floats
    gains: Floats
    reference: Floats
    hold: int

    def __init__(self, u: ArrayLike, gains: ArrayLike, reference: ArrayLike, hold: int = 1) -> None:
        """Make a policy.

        Args:
            u: Feed-forward controls (N, m).
            gains: (N, m, 2n).
            reference: (N, 2n), or (N + 1, 2n), of which the last row is not used.
            hold: Steps of a simulation that each control is held over: the rate of a digital controller.

        Raises:
            InputError: Shapes that do not fit each other, or values that are not finite.
        """
        rows, gains = as_floats("reference", reference), as_floats("gains", gains)
        shape = gains.shape
        if len(shape) != 3:
            raise InputError(f"gains must have shape (N, m, 2n), got {shape}")
        steps, m, size = shape
        if rows.shape == (steps + 1, size):
            rows = rows[:steps]
        values = {
            "u": finite_array("u", u, (steps, m)),
            "gains": finite_array("gains", gains, shape),
            "reference": finite_array("reference", rows, (steps, size)),
        }
        for name, value in values.items():
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "hold", count("hold", hold, least=1))

    def commands(self, steps: int, controls: int, dof: int) -> Commands:
        """The policy as kernels take it.

        Raises:
            InputError: It is for another number of steps, controls or coordinates.
        """
        if len(self.gains) * self.hold != steps:
            raise InputError(
                f"the policy has {len(self.gains)} controls, each held over {self.hold} steps: "
                f"for {len(self.gains) * self.hold} steps, not {steps}"
            )
        if self.gains.shape[1:] != (controls, 2 * dof):
            raise InputError(f"the policy's gains must have shape (N, {controls}, {2 * dof}), got {self.gains.shape}")
        return Commands(self.u, self.gains, self.reference, self.hold)
