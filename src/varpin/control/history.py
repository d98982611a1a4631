"""How a search went: its iterations, how it ended, and where it can go on."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from varpin.trajectory import Trajectory

# Of a search that is not told how many.
ITERATIONS = 100


class Status(Enum):
    """How a solver ended; its value says what that means and what to do."""

    CONVERGED = "converged"
    MAX_ITERATIONS = (
        "not converged: more iterations may help; go on from this solution with solve(problem, resume=solution)"
    )
    STALLED = (
        "not converged: no step along the plan lowers the expected cost by more than the tolerance; if what it "
        "promises is little, that is as far as it goes; else a smaller dt, other first controls, right derivatives of "
        "a cost of one's own or a cost that weighs the controls more may help"
    )
    INDEFINITE = (
        "not converged: the model of the cost has no minimum in a control, whatever the regularization; give every "
        "control a ControlCost"
    )
    NOT_DIFFERENTIABLE = (
        "not converged: the derivatives of the dynamics or of the cost do not exist along the last motion; the log "
        "says where. A smaller dt, or a cost that is finite around the motion, may help"
    )
    INFEASIBLE = (
        "infeasible: a constraint cannot be met from the first controls, and plan.reason names it. Other first "
        "controls may lead around an obstacle; a longer horizon, wider limits or another goal may help"
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
        index: From 0.
        cost: Of the motion it ended with, without noise.
        noise_cost: What noise adds to the cost of the motion it began with.
        expected_decrease: Of the expected cost, by the quadratic model with a full step.
        decrease: Of the expected cost by the step taken, with the plan's model of the noise; 0 if none was.
        step: Length of the step taken, in (0, 1]; 0 if none was.
        regularization: Relative to the diagonal of Quu.
        gradient: Largest entry of the cost's gradient in the controls.
        backward_passes: How many it took, with other regularizations; looking for the controls that meet their limits,
            on the same derivatives, does not count.
        rollouts: Trials of the line search.
        seconds: It took [s].
    """

    index: int
    cost: float
    noise_cost: float
    expected_decrease: float
    decrease: float
    step: float
    regularization: float
    gradient: float
    backward_passes: int
    rollouts: int
    seconds: float

    HEADER = "iter         cost   noise cost  expected  decrease      grad      reg      step  rollouts"

    def __str__(self) -> str:
        return (
            f"{self.index:4d} {self.cost:12.6e} {self.noise_cost:12.4e} {self.expected_decrease:9.2e} "
            f"{self.decrease:9.2e} {self.gradient:9.2e} {self.regularization:8.1e} {self.step:9.2e} {self.rollouts:9d}"
        )


@dataclass(frozen=True, eq=False)
class SearchState:
    """Where a search stood at the start of its last iteration: all that it needs to go on.

    Attributes:
        trajectory: The motion then.
        cost: Of it, without noise.
        above: By how much it costs more than the best one, without noise.
        first: How much of the cost of the first motion was at stake.
        best: The motion of the least expected cost so far, if one was rated yet.
        best_cost: Its cost without noise.
        best_noise: What noise adds to it; that of constant strength changes no plan, and is left out.
        gains: By how much each iteration lowered the least expected cost.
        regularization: Relative to the diagonal of Quu.
        growth: Of the regularization.
        bounded: Whether the line search gives up trials whose steps are cut into many parts.
        cut: Whether it has given up one.
        whole: Whether the search has come to the whole gradient of what noise adds.
        history: Of the iterations before.
    """

    trajectory: Trajectory
    cost: float
    above: float
    first: float
    best: Trajectory | None
    best_cost: float
    best_noise: float
    gains: tuple[float, ...]
    regularization: float
    growth: float
    bounded: bool
    cut: bool
    history: tuple[Iteration, ...]
    whole: bool = False

    def __repr__(self) -> str:
        return f"SearchState(cost {self.cost:.6g}, after {len(self.history)} iterations)"
