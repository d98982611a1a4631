"""What a solver returns, and what there is to be done with it: feedback, verification, Monte Carlo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from varpin.checks import count, is_one_of, positive
from varpin.costs import BoundSum
from varpin.ensemble import simulate_ensemble
from varpin.errors import InputError, VarpinError
from varpin.integrators import RungeKutta4
from varpin.integrators.base import open_loop
from varpin.kernels._compile import announced_compilation
from varpin.kernels.tree import Commands
from varpin.linearization import velocity_at_nodes
from varpin.policy import LinearPolicy
from varpin.problem import OptimalControlProblem, bind_cost
from varpin.simulation import rollout
from varpin.trajectory import Trajectory
from varpin.wiener import generator

Floats = NDArray[np.float64]


class Status(Enum):
    """How a solver ended; its value says what that means and what to do."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "not converged: more iterations may help; go on from this solution with solve(problem, solution)"
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
        promised_decrease: Of the expected cost, by the quadratic model with a full step.
        step: Length of the step taken, in (0, 1]; 0 if none was.
        regularization: Relative to the diagonal of Quu.
        gradient: Largest entry of the cost's gradient in the controls.
        backward_passes: How many it took.
        rollouts: Trials of the line search.
        seconds: It took [s].
    """

    index: int
    cost: float
    noise_cost: float
    promised_decrease: float
    step: float
    regularization: float
    gradient: float
    backward_passes: int
    rollouts: int
    seconds: float

    HEADER = "iter         cost   noise cost   promise      grad      reg      step  rolls"

    def __str__(self) -> str:
        return (
            f"{self.index:4d} {self.cost:12.6e} {self.noise_cost:12.4e} {self.promised_decrease:9.2e} "
            f"{self.gradient:9.2e} {self.regularization:8.1e} {self.step:9.2e} {self.rollouts:6d}"
        )


@dataclass(frozen=True)
class Verification:
    """A plan held against an accurate integration of the continuous system.

    Costs are integrals over the continuous motion, without noise; NaN where that motion runs away.

    Attributes:
        planned_cost: The solver's own.
        open_loop_cost: Of the plan's controls alone.
        closed_loop_cost: With the plan's feedback, at the plan's own rate.
        open_loop_gap: Distance of the end from the plan's, in q, open loop [rad or m].
        closed_loop_gap: The same with feedback.
        defect: Largest distance in q of an accurately integrated step from the plan's [rad or m].
        substeps: Of the accurate integration, in one step of the plan.
        accuracy: Relative change over the last doubling of the substeps, of the cost that changed more.
    """

    planned_cost: float
    open_loop_cost: float
    closed_loop_cost: float
    open_loop_gap: float
    closed_loop_gap: float
    defect: float
    substeps: int
    accuracy: float


@dataclass(frozen=True)
class MonteCarlo:
    """The expected cost of a policy, by simulation.

    Attributes:
        cost: Mean over the paths.
        standard_error: Of the mean.
        predicted: By the solver's model.
        paths: How many were counted.
        failures: Paths that could not be finished; they are not counted.
    """

    cost: float
    standard_error: float
    predicted: float
    paths: int
    failures: int


@dataclass(frozen=True, eq=False)
class Solution:
    """The best motion a solver found, with the policy around it.

    Attributes:
        problem: What was solved.
        trajectory: The motion without noise.
        gains: Feedback (R, m, 2n) on x = (q, p) or (q, v), for each of R decisions.
        feedforward: The change of the controls (R, m) that the last backward pass asked for; zero at an optimum.
        gradient: Of the expected cost in the controls (R, m), under the solver's model of the noise.
        cost: Of the motion without noise.
        noise_cost: What noise adds to it, by the solver's model.
        status: How the solver ended.
        history: One entry for each iteration.
    """

    problem: OptimalControlProblem
    trajectory: Trajectory
    gains: Floats
    feedforward: Floats
    gradient: Floats
    cost: float
    noise_cost: float
    status: Status
    history: tuple[Iteration, ...]

    def __post_init__(self) -> None:
        for array in (self.gains, self.feedforward, self.gradient):
            array.setflags(write=False)

    @property
    def expected_cost(self) -> float:
        """Cost of the motion and what noise adds to it, by the solver's model."""
        return self.cost + self.noise_cost

    @property
    def controls(self) -> Floats:
        """One row for each decision (R, m)."""
        return self.trajectory.u[:: self.problem.hold]

    @property
    def iterations(self) -> int:
        """Steps that were taken or tried."""
        return sum(item.rollouts > 0 for item in self.history)

    @property
    def policy(self) -> LinearPolicy:
        """Controls with feedback, on the x of the problem's integrator."""
        return self.policy_on("momentum" if self.problem.integrator.variational else "velocity")

    def __repr__(self) -> str:
        noise = f" + {self.noise_cost:.4g} by noise" if self.noise_cost else ""
        return f"Solution(cost {self.cost:.6g}{noise}, {self.iterations} iterations, {self.status.value})"

    def table(self) -> str:
        """The iterations, one line each."""
        return "\n".join([Iteration.HEADER, *map(str, self.history), self.status.value])

    def shifted(self, decisions: int) -> LinearPolicy:
        """The policy from a later decision on, its last row repeated: what to start the next horizon with.

        Raises:
            InputError: Not from 0 to R - 1.
        """
        if not 0 <= count("decisions", decisions) < len(self.gains):
            raise InputError(f"decisions must be from 0 to {len(self.gains) - 1}, got {decisions}")
        own = self.policy
        rows = np.minimum(np.arange(len(self.gains)) + decisions, len(self.gains) - 1)
        return LinearPolicy(own.u[rows], own.gains[rows], own.reference[rows], hold=own.hold, on=own.on)

    def policy_on(self, x: Literal["momentum", "velocity"], substeps: int = 1) -> LinearPolicy:
        """The policy on (q, p) or on (q, v), each control held over ``substeps`` times as many steps.

        Where x is not that of the problem's integrator, dp = L_vq dq + M dv turns the gains around, to first order.

        Raises:
            InputError: ``x`` is neither "momentum" nor "velocity".
        """
        if not is_one_of(x, ("momentum", "velocity")):
            raise InputError(f"x must be 'momentum' or 'velocity', got {x!r}")
        gains, trajectory, hold = self.gains, self.trajectory, self.problem.hold
        rows, n = slice(0, -1, hold), self.problem.scene.robot.dof
        if self.problem.integrator.variational != (x == "momentum"):
            rates = velocity_at_nodes(self.problem.scene, trajectory.q[rows], trajectory.v[rows])
            by_q, by_p = rates[:, :, :n], rates[:, :, n:]
            second = gains[:, :, n:]
            if x == "velocity":
                second = second @ np.linalg.inv(by_p)
                gains = np.concatenate([gains[:, :, :n] - second @ by_q, second], axis=2)
            else:
                gains = np.concatenate([gains[:, :, :n] + second @ by_q, second @ by_p], axis=2)
        nodes = trajectory.p if x == "momentum" else trajectory.v
        reference = np.hstack([trajectory.q[rows], nodes[rows]])
        return LinearPolicy(self.controls, gains, reference, hold=hold * substeps, on=x)

    def verify(
        self, *, tolerance: float = 1e-10, max_substeps: int = 1024, progress: Callable[[int, int], None] | None = None
    ) -> Verification:
        """Replay the plan through an accurate integration of the continuous system: classical Runge-Kutta, Simpson.

        Main args:
            tolerance: On the relative change of the cost when the substeps are doubled.
            max_substeps: Of one step of the plan; where they do not reach the tolerance, ``accuracy`` says so.

        Other Args:
            progress: Called before each doubling with (substeps, max_substeps).
        """
        positive("tolerance", tolerance, "1")
        count("max_substeps", max_substeps, least=2)
        problem, substeps, before = self.problem, 2, (np.nan, np.nan)
        while True:
            if progress is not None:
                progress(substeps, max_substeps)
            costs = _fine_costs(problem, substeps)
            blind = open_loop(self.controls)._replace(hold=problem.hold * substeps)
            opened = accurate_cost(problem, blind, substeps, costs)
            policy = self.policy_on("velocity", substeps)
            feedback = Commands(policy.u, policy.gains, policy.reference, policy.hold)
            closed = accurate_cost(problem, feedback, substeps, costs)
            changes = [
                abs(now[0] - then) / max(abs(now[0]), 1e-300)
                for now, then in zip((opened, closed), before, strict=True)
                if np.isfinite(now[0]) and np.isfinite(then)
            ]
            before = opened[0], closed[0]
            accuracy = max(changes, default=np.inf)
            if accuracy <= tolerance or substeps >= max_substeps:
                break
            substeps *= 2
        end = self.trajectory.q[-1]
        return Verification(
            planned_cost=self.cost,
            open_loop_cost=opened[0],
            closed_loop_cost=closed[0],
            open_loop_gap=float(np.abs(opened[1] - end).max()),
            closed_loop_gap=float(np.abs(closed[1] - end).max()),
            defect=_defect(problem, self.trajectory, substeps),
            substeps=substeps,
            accuracy=accuracy,
        )

    def monte_carlo(
        self, paths: int, rng: np.random.Generator | int, *, feedback: bool = True, workers: int | None = None
    ) -> MonteCarlo:
        """Expected cost of the policy under the scene's noise, with the problem's own integrator and step.

        Args:
            paths: How many.
            rng: Seed or generator.
            feedback: Without, the controls alone.
            workers: Threads; as many as there are cores if left out.

        Raises:
            InputError: Wrong arguments, or noise that only Python can evaluate.
            VarpinError: Every path failed.
        """
        problem, draws = self.problem, generator(rng)
        paths = count("paths", paths, least=2)
        policy = self.policy
        if not feedback:
            policy = LinearPolicy(policy.u, np.zeros_like(policy.gains), policy.reference, policy.hold, policy.on)
        costs: list[Floats] = []
        for first in range(0, paths, _PATHS):
            batch = min(_PATHS, paths - first)
            try:
                ensemble = simulate_ensemble(
                    problem.scene,
                    problem.q0,
                    problem.v0,
                    dt=problem.dt,
                    steps=problem.steps,
                    paths=batch,
                    rng=draws,
                    controls=policy,
                    integrator=problem.integrator,
                    quantiles=(),
                    workers=workers,
                )
            except InputError:
                raise
            except VarpinError:  # every path of the batch failed
                costs.append(np.full(batch, np.nan))
                continue
            if ensemble.q is not None and ensemble.v is not None and ensemble.u is not None:
                costs.append(problem.costs(ensemble.q, ensemble.v, ensemble.u))
        values = np.concatenate(costs)
        good = values[np.isfinite(values)]
        if not len(good):
            raise VarpinError(f"every one of {paths} paths ran away; a smaller dt may help")
        return MonteCarlo(
            cost=float(good.mean()),
            standard_error=float(good.std(ddof=1) / np.sqrt(len(good))),
            predicted=self.expected_cost,
            paths=len(good),
            failures=len(values) - len(good),
        )


# Paths that are kept at a time to add up their costs.
_PATHS = 256


def _fine_costs(problem: OptimalControlProblem, substeps: int) -> tuple[BoundSum, BoundSum]:
    """Running and terminal costs at the nodes of a finer grid."""
    times = np.arange(problem.steps * substeps + 1, dtype=np.float64) * (problem.dt / substeps)
    dof, controls = problem.scene.robot.dof, problem.scene.controls
    return bind_cost(problem.cost, times, problem.duration, problem.steps, dof, controls)


def accurate_cost(
    problem: OptimalControlProblem, commands: Commands, substeps: int, costs: tuple[BoundSum, BoundSum] | None = None
) -> tuple[float, Floats]:
    """True cost under given commands, and the end configuration; NaN where the motion runs away."""
    scene, h = problem.scene, problem.dt / substeps
    n, m = scene.robot.dof, scene.controls
    with announced_compilation():
        motion, failure = rollout(scene, RungeKutta4(), problem.q0, problem.v0, commands, h)
    if failure is not None:
        return np.nan, np.full(n, np.nan)
    running, terminal = _fine_costs(problem, substeps) if costs is None else costs
    # Simpson's rule within each step of the plan: the control jumps between steps.
    after = running.value(motion.q, motion.v, np.vstack([motion.u, motion.u[-1:]]))
    before = running.value(motion.q, motion.v, np.vstack([motion.u[:1], motion.u]))
    integral = h / 3.0 * (after[:-1:2] + 4.0 * after[1::2] + before[2::2]).sum()
    end = terminal.value(motion.q[-1:], motion.v[-1:], np.zeros((1, m)))[0]
    return float(integral + end), motion.q[-1]


def _defect(problem: OptimalControlProblem, trajectory: Trajectory, substeps: int) -> float:
    """Largest distance in q between the plan's steps and accurate ones from the same nodes."""
    scene, h, n = problem.scene, problem.dt / substeps, problem.scene.robot.dof
    integrator = RungeKutta4()
    state, _ = integrator.start(scene, trajectory.q[:-1].copy(), trajectory.v[:-1].copy())
    # Every step is a path of its own, with its own control handed over as a force.
    commands = open_loop(np.zeros((1, scene.controls)))._replace(hold=substeps)
    force = trajectory.u @ scene.actuation.T
    forces = np.ascontiguousarray(np.broadcast_to(force[:, None], (trajectory.steps, substeps, n)))
    segments = integrator.rollout_compiled(scene, state, commands, np.zeros((0, 0, scene.processes)), forces, h)
    lost = np.full(n, np.nan)
    ends = np.array([segment.q[-1] if segment.failure is None else lost for segment in segments])
    return float(np.abs(ends - trajectory.q[1:]).max())
