"""The record of a search: its iterations, its status, the state for resuming it, and the steps of a refinement."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np


class Status(Enum):
    """How a solver ended; the value explains it, with advice."""

    CONVERGED = "converged"
    MAX_ITERATIONS = (
        "not converged: more iterations may help; continue from this solution with solve(problem, resume=solution)"
    )
    STALLED = (
        "not converged: no step lowers the expected cost; a smaller dt, another start (controls=, states=), a wider "
        "dry friction (CoulombFriction(width=)) or a higher cost of the controls may help"
    )
    INDEFINITE = (
        "not converged: the model of the cost has no minimum in a control, whatever the regularization; give every "
        "control a cost (ControlCost)"
    )
    NOT_DIFFERENTIABLE = (
        "not converged: the derivatives of the dynamics or of the cost do not exist along the last motion; the log "
        "says where. A smaller dt, or a cost that is finite around the motion, may help"
    )
    INFEASIBLE = (
        "infeasible: plan.reason names the constraint; a start that leads around an obstacle (states=), a smaller dt, "
        "a longer horizon, wider limits or, of dry friction, a larger CoulombFriction(width=) may help"
    )
    OUT_OF_TIME = "stopped at the time limit: this is the best motion so far"
    INTERRUPTED = "interrupted: this is the best motion so far"

    @property
    def converged(self) -> bool:
        """Whether the solver's tolerance was met."""
        return self is Status.CONVERGED


@dataclass(frozen=True)
class Iteration:
    """One iteration of a solver.

    Attributes:
        index: Number of the iteration, from 0.
        cost: Cost of the motion after the iteration, without noise.
        noise_cost: Cost added by noise to the motion before the iteration.
        violation: Sum of all violations of constraints by that motion, margins included, in tenths of their ranges.
        expected_decrease: Decrease of the expected cost by the quadratic model with a full step.
        decrease: Actual decrease of the expected cost, with the plan's model of the noise; 0 without a step.
        step: Length of the accepted step, 0 if there is none; 4 or more of one that was extended as the cost fell on
            beyond.
        regularization: Relative to the diagonal of Quu.
        gradient: Largest entry of the gradient in the controls, with the multipliers of constraints.
        backward_passes: Number of backward passes: with different regularizations, and for goals and noise.
        rollouts: Number of trials of the line search.
        seconds: Time of the iteration [s].
        second_order: Whether second derivatives of the dynamics were used.
    """

    index: int
    cost: float
    noise_cost: float
    violation: float
    expected_decrease: float
    decrease: float
    step: float
    regularization: float
    gradient: float
    backward_passes: int
    rollouts: int
    seconds: float
    second_order: bool = False

    HEADER = "iter         cost noise cost expected decrease     grad     reg     step trials"

    def __str__(self) -> str:
        return (
            f"{self.index:4d} {self.cost:12.6e} {self.noise_cost:10.3e} {self.expected_decrease:8.1e} "
            f"{self.decrease:8.1e} {self.gradient:8.1e} {self.regularization:7.0e} {self.step:8.1e} "
            f"{self.rollouts:6d}{' *' if self.second_order else ''}"
        )


@dataclass(frozen=True)
class SearchState:
    """What a search needs, beside its motion and its multipliers, to be resumed.

    Attributes:
        weight: Weight of the constraints in the merit, in tenths of their ranges.
        regularization: Relative to the diagonal of Quu.
        growth: Last factor of the regularization.
        first: Cost at stake on the first motion; -1 before it is known.
        counts: How often margins have been widened by counting motions.
        since: The first iteration from which on rows and margins stay.
        second_order: Whether it uses second derivatives of the steps.
        iterations: Number of entries of the history that were made before.
        rounds: How often margins have followed the motion of a search that ended, since then.
    """

    weight: float
    regularization: float
    growth: float
    first: float
    counts: int
    since: int
    second_order: bool
    iterations: int
    rounds: int = 0


def percent(part: float) -> str:
    """A fraction as text, to a ten-thousandth of a percent."""
    value = round(100.0 * part, 4) + 0.0
    return f"{value:+.{'3g' if abs(value) < 100.0 else '0f'}} %"


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
        excess: Excess of the true cost over the optimum of finer controls, relative to the latter: an estimate
            from the plan with half the step. Infinite where it is not known.
        violation: Largest violation of a constraint on the continuous system with feedback, relative to the
            constraint's range (for frames and clearance 1 m or rad); NaN where that motion diverges.
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
    excess: float = np.inf
    violation: float = 0.0

    HEADER = "      dt  steps         cost    true cost       loss     excess  violation  iterations  time [s]"

    def __str__(self) -> str:
        above = percent(self.excess) if np.isfinite(self.excess) else ""
        return (
            f"{self.dt:8.3g} {self.steps:6d} {self.cost:12.6e} {self.true_cost:12.6e} {percent(self.loss):>10} "
            f"{above:>10} {self.violation:10.1e} {self.iterations:11d} {self.seconds:9.2g}"
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
