"""The record of a refinement: the steps tried for a plan of a given true cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from varpin.control.history import Status


def part(loss: float) -> str:
    """A loss in percent, with two significant digits."""
    return f"{100.0 * loss:+.2g} %"


@dataclass(frozen=True)
class Refined:
    """One step size of a refinement.

    Attributes:
        dt: The step [s].
        steps: N.
        cost: The plan's cost.
        true_cost: Cost on the continuous system with the plan's feedback, by :meth:`Solution.verify`; NaN where the
            motion diverges.
        open_loop_cost: The same under the plan's controls alone.
        loss: Difference of the true cost from the plan's, relative to the latter.
        iterations: Iterations of the search.
        status: How the search ended.
        seconds: Time of the search and the verification [s].
        share: Share in the time of all steps tried.
        excess: Excess of the true cost over the optimum of finer controls, relative to the latter: an estimate
            from the plan with half the step. Infinite where it is not known.
        violation: Largest violation of a constraint on the continuous system with feedback, relative to the
            constraint's range (for frames and clearance 1 m or 3 rad); NaN where that motion diverges.
    """

    dt: float
    steps: int
    cost: float
    true_cost: float
    open_loop_cost: float
    loss: float
    iterations: int
    status: Status
    seconds: float
    share: float = 1.0
    excess: float = np.inf
    violation: float = 0.0

    HEADER = "      dt  steps         cost    true cost       loss     excess  violation  iterations   time"

    def __str__(self) -> str:
        above = part(self.excess) if np.isfinite(self.excess) else ""
        return (
            f"{self.dt:8.3g} {self.steps:6d} {self.cost:12.6e} {self.true_cost:12.6e} {part(self.loss):>10} "
            f"{above:>10} {self.violation:10.1e} {self.iterations:11d} {100.0 * self.share:4.0f} %"
        )


@dataclass(frozen=True)
class Refinement:
    """The step sizes tried for a plan of a given true cost, and the result.

    Attributes:
        wish: The greatest allowed loss, relative to the plan's cost, and excess over the optimum of finer controls.
        met: Whether the loss of the plan is within it, and the excess, where finer controls were compared, and no
            constraint is violated on the continuous system by more than a thousandth of its range.
        tried: The steps tried, from the coarsest on.
        chosen: Index of the plan's step in ``tried``.
        reason: How the refinement ended.
    """

    wish: float
    met: bool
    tried: tuple[Refined, ...]
    chosen: int
    reason: str

    def __str__(self) -> str:
        return "\n".join([Refined.HEADER, *map(str, self.tried), self.reason])
