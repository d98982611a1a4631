"""What it took to find a plan that costs on the continuous system what it promises."""

from __future__ import annotations

from dataclasses import dataclass

from varpin.control.history import Status


def part(loss: float) -> str:
    """A loss in percent, small ones too."""
    return f"{100.0 * loss:+.2g} %"


@dataclass(frozen=True)
class Refined:
    """One of the steps that a plan of a wished true cost was sought with.

    Attributes:
        dt: The step [s].
        steps: N.
        cost: Of the plan, as its search has it.
        true_cost: On the continuous system with the plan's feedback, by :meth:`Solution.verify`; NaN where the motion
            runs away.
        open_loop_cost: The same under the plan's controls alone.
        loss: By how much the true cost differs from the plan's, relative to it.
        iterations: Of the search.
        status: How the search ended.
        seconds: Of the search and of the verification [s].
        share: Of the seconds of all steps tried.
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

    HEADER = "      dt  steps         cost    true cost       loss  iterations   time"

    def __str__(self) -> str:
        return (
            f"{self.dt:8.3g} {self.steps:6d} {self.cost:12.6e} {self.true_cost:12.6e} {part(self.loss):>10} "
            f"{self.iterations:11d} {100.0 * self.share:4.0f} %"
        )


@dataclass(frozen=True)
class Refinement:
    """What it took to find a plan that costs on the continuous system what it promises.

    Attributes:
        wish: The loss that was allowed, relative to the plan's cost.
        met: Whether the plan's true cost is known to be within it.
        tried: The steps tried, from the coarsest on; the plan is that of ``tried[chosen]``.
        chosen: Which.
        reason: How the refinement ended.
    """

    wish: float
    met: bool
    tried: tuple[Refined, ...]
    chosen: int
    reason: str

    def __str__(self) -> str:
        return "\n".join([Refined.HEADER, *map(str, self.tried), self.reason])
