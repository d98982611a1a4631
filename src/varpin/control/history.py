"""The record of a search: its iterations, its status, and the state for resuming it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from varpin.arrays import Mask
from varpin.control.watchdog import Watchdog
from varpin.trajectory import Trajectory

# Default number of iterations, over all rounds where there are any.
ITERATIONS = 500


class Status(Enum):
    """How a solver ended; the value explains it, with advice."""

    CONVERGED = "converged"
    MAX_ITERATIONS = (
        "not converged: more iterations may help; continue from this solution with solve(problem, resume=solution)"
    )
    STALLED = (
        "not converged: no step along the plan lowers the expected cost by more than the tolerance; if the expected "
        "decrease is small, the plan is close to an optimum; else a smaller dt, other first controls, correct "
        "derivatives of a custom cost or a higher cost of the controls may help"
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
        index: Number of the iteration, from 0.
        cost: Cost of the motion after the iteration, without noise.
        noise_cost: Cost added by noise to the motion before the iteration.
        expected_decrease: Decrease of the expected cost by the quadratic model with a full step.
        decrease: Actual decrease of the expected cost, with the plan's model of the noise; 0 without a step.
        step: Length of the accepted step, 0 if there is none; 4 or more of one that was extended as the cost fell on
            beyond, 2 of one along the parabola through the last motions. Of a step along foreseen states it is the
            share of their changes.
        regularization: Relative to the diagonal of Quu.
        gradient: Largest entry of the cost's gradient in the controls.
        backward_passes: Number of backward passes with different regularizations. Those that determine the controls at
            their limits, on the same derivatives, do not count.
        rollouts: Number of trials of the line search, one along foreseen states included.
        seconds: Time of the iteration [s].
        second_order: Whether second derivatives of the dynamics were used.
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
    second_order: bool = False

    HEADER = "iter         cost   noise cost  expected  decrease      grad      reg      step  rollouts"

    def __str__(self) -> str:
        return (
            f"{self.index:4d} {self.cost:12.6e} {self.noise_cost:12.4e} {self.expected_decrease:9.2e} "
            f"{self.decrease:9.2e} {self.gradient:9.2e} {self.regularization:8.1e} {self.step:9.2e} {self.rollouts:9d}"
            f"{'  second derivatives' if self.second_order else ''}"
        )


@dataclass(frozen=True, eq=False)
class SearchState:
    """The state of a search at the start of its last iteration, from which it can be resumed.

    Attributes:
        trajectory: The motion.
        cost: Its cost without noise.
        above: Its cost minus that of the best motion, without noise.
        first: Cost at stake on the first motion.
        best: The motion of least expected cost so far; None before the first backward pass.
        best_cost: Cost of the best motion without noise.
        best_noise: Noise cost of the best motion, without the noise of constant strength, which changes no plan.
        gains: Decrease of the least expected cost in each iteration; those away from the best motion are left out.
        regularization: Relative to the diagonal of Quu.
        growth: Last factor of the regularization.
        bounded: Whether the line search stops trials with many substeps.
        cut: Whether it has stopped one.
        whole: Whether the search uses the whole gradient of the noise cost.
        saturated: Whether it takes into account that drives of servos are at their limits.
        clips: Whether plans may leave control limits to the clipping of motions where steps are short.
        follows: Whether trials may follow the states that plans foresee: none has strayed from them.
        overshot: Whether an extension of the last full step did not lower the cost.
        returned: Whether it has just gone back from a motion that cannot be linearized.
        behind: The motion from which a full step led to this one; None after another step.
        watchdog: Whether it is away from the best motion.
        rows: Active rows of penalties (M,) at the end of the last backward pass, with which the next one begins; None
            where no rows were looked for.
        history: The iterations before.
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
    saturated: bool = False
    clips: bool = True
    follows: bool = True
    overshot: bool = False
    returned: bool = False
    behind: Trajectory | None = None
    watchdog: Watchdog = field(default_factory=Watchdog)
    rows: Mask | None = None

    def __repr__(self) -> str:
        return f"SearchState(cost {self.cost:.6g}, after {len(self.history)} iterations)"
