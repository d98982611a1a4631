"""What a solver returns, and what there is to be done with it: feedback, verification, Monte Carlo."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from varpin.archive import Header
from varpin.checks import count, is_one_of, path_like, positive
from varpin.costs import BoundSum
from varpin.ensemble import simulate_ensemble
from varpin.errors import FileError, InputError, VarpinError
from varpin.integrators import RungeKutta4
from varpin.integrators.base import open_loop
from varpin.kernels._compile import announced_compilation
from varpin.kernels.tree import Commands
from varpin.linearization import velocity_at_nodes
from varpin.policy import LinearPolicy
from varpin.problem import OptimalControlProblem, bind_cost
from varpin.simulation import NoiseError, StepFailure, rollout, simulate
from varpin.task_costs import barriers_of
from varpin.trajectory import MEMBERS, Trajectory, atomic_file, read_members
from varpin.wiener import generator

Floats = NDArray[np.float64]


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
        promised_decrease: Of the expected cost, by the quadratic model with a full step.
        decrease: Of the expected cost by the step taken, with the plan's model of the noise; 0 if none was.
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
    decrease: float
    step: float
    regularization: float
    gradient: float
    backward_passes: int
    rollouts: int
    seconds: float

    HEADER = "iter         cost   noise cost   promise  decrease      grad      reg      step  rolls"

    def __str__(self) -> str:
        return (
            f"{self.index:4d} {self.cost:12.6e} {self.noise_cost:12.4e} {self.promised_decrease:9.2e} "
            f"{self.decrease:9.2e} {self.gradient:9.2e} {self.regularization:8.1e} {self.step:9.2e} {self.rollouts:6d}"
        )


@dataclass(frozen=True, eq=False)
class SearchState:
    """Where a search stood at the start of its last iteration: all that it needs to go on.

    Attributes:
        trajectory: The motion then.
        cost: Of it, without noise.
        first: Cost of the first motion.
        best: The motion of the least expected cost so far, if one was rated yet.
        best_merit: Its expected cost.
        best_cost: Its cost without noise.
        merits: The least expected cost after each iteration.
        regularization: Relative to the diagonal of Quu.
        growth: Of the regularization.
        history: Of the iterations before.
    """

    trajectory: Trajectory
    cost: float
    first: float
    best: Trajectory | None
    best_merit: float
    best_cost: float
    merits: tuple[float, ...]
    regularization: float
    growth: float
    history: tuple[Iteration, ...]


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

    @property
    def open_loop_loss(self) -> float:
        """What the controls alone cost above the plan, relative to the plan's cost; NaN where they run away."""
        return _excess(self.open_loop_cost, self.planned_cost)

    @property
    def closed_loop_loss(self) -> float:
        """The same with feedback."""
        return _excess(self.closed_loop_cost, self.planned_cost)

    def __str__(self) -> str:
        rows = [
            ("planned", self.planned_cost, "", ""),
            ("controls alone", self.open_loop_cost, _percent(self.open_loop_loss), f"{self.open_loop_gap:.2e}"),
            ("with feedback", self.closed_loop_cost, _percent(self.closed_loop_loss), f"{self.closed_loop_gap:.2e}"),
        ]
        lines = [f"{'':16}{'cost':>14}{'loss':>12}  end off by [rad or m]"]
        for name, cost, loss, gap in rows:
            shown = (f"{cost:14.6e}{loss:>12}  {gap}" if np.isfinite(cost) else f"{'runs away':>14}").rstrip()
            lines.append(f"{name:16}{shown}")
        good = f"{self.accuracy:.0e}" if np.isfinite(self.accuracy) else "nothing: no motion stays"
        return "\n".join(
            [
                *lines,
                f"a step is off by {self.defect:.2e} rad or m at most; costs are good to {good} of themselves "
                f"({self.substeps} substeps a step)",
                "read it so: where feedback loses some percent, the plan holds; where it loses much, dt is too coarse "
                "(controls alone also lose much where a motion is unstable)",
            ]
        )


def _excess(cost: float, base: float) -> float:
    """How far a cost is above another one, relative to it; infinite above nothing."""
    if cost == base:
        return 0.0
    return (cost - base) / abs(base) if base != 0.0 else float(np.copysign(np.inf, cost - base))


def _percent(part: float) -> str:
    if abs(part) >= 1e4:
        return f"{part:+.1e} x"
    return f"{100.0 * part:+.2f} %" if abs(part) < 1.0 else f"{100.0 * part:+.0f} %"


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

    def __str__(self) -> str:
        gap = self.cost - self.predicted
        apart = f", {gap / self.standard_error:+.1f} standard errors" if self.standard_error > 0.0 else ""
        lost = f"; {self.failures} more ran away and are not counted" if self.failures else ""
        return "\n".join(
            [
                f"{'':16}{'expected cost':>14}",
                f"{'simulated':16}{self.cost:14.6e} +- {self.standard_error:.1e} ({self.paths} paths{lost})",
                f"{'predicted':16}{self.predicted:14.6e}",
                f"{'difference':16}{gap:+14.6e} ({_percent(_excess(self.cost, self.predicted))}{apart})",
                "read it so: within three standard errors (+-) the two agree; beyond, noise is too strong for the "
                "model",
            ]
        )


class MonteCarloInterrupted(KeyboardInterrupt):
    """Ctrl-C during :meth:`Solution.monte_carlo`.

    Attributes:
        result: Of the paths done so far; None if there are fewer than two.
    """

    def __init__(self, result: MonteCarlo | None) -> None:
        self.result = result
        done = 0 if result is None else result.paths + result.failures
        super().__init__(f"interrupted after {done} paths" + ("; they are in .result" if done else ""))


@dataclass(frozen=True, eq=False)
class Violations:
    """How far a motion goes beyond limits, at its nodes: the most for each joint or control, zero where it does not.

    Attributes:
        position: Beyond the limits of the robot's joints, or of a narrower :class:`varpin.JointLimitBarrier` in the
            cost (n,) [rad or m].
        velocity: Likewise (n,) [rad/s or m/s].
        control: Beyond the problem's control limits (m,).
    """

    position: Floats
    velocity: Floats
    control: Floats

    @property
    def any(self) -> bool:
        """Whether there is one at all."""
        return bool(any(part.any() for part in (self.position, self.velocity, self.control)))


@dataclass(frozen=True, eq=False)
class Solution:
    """The best motion a solver found, with the policy around it.

    ``print(plan.table())`` shows a row for each iteration, then how the search ended and why:

    ========== =====================================================================================
    iter       Its number, from 0.
    cost       Of the motion it ended with, without noise.
    noise cost What noise adds to the cost of the motion it began with, by the solver's model.
    promise    The decrease of the expected cost that the quadratic model promises for a full step.
    decrease   What the step taken brought; near the promise where the model is good.
    grad       Largest entry of the expected cost's gradient in the controls.
    reg        Regularization, relative to the diagonal of Quu; 0 where the model needs none.
    step       Length of the step taken, in (0, 1]; 0 where none was, as at the end.
    rolls      Motions that the line search tried.
    ========== =====================================================================================

    ``print(plan.verify())`` tells what the plan costs on the continuous robot, ``print(plan.monte_carlo(200, rng=0))``
    what it costs under the scene's noise.

    Attributes:
        problem: What was solved.
        trajectory: The motion without noise.
        gains: Feedback (R, m, 2n) on x = (q, p) or (q, v), for each of R decisions.
        feedforward: The change of the controls (R, m) that the last backward pass asked for; zero at an optimum.
        gradient: Of the expected cost in the controls (R, m), under the solver's model of the noise. At an optimum it
            is zero but where it pushes a control against its limit.
        cost: Of the motion without noise.
        noise_cost: What noise adds to it, by the solver's model.
        status: How the solver ended.
        reason: With which numbers.
        history: One entry for each iteration.
        search: From where :func:`varpin.solve` can go on, with ``resume``.
    """

    problem: OptimalControlProblem
    trajectory: Trajectory
    gains: Floats
    feedforward: Floats
    gradient: Floats
    cost: float
    noise_cost: float
    status: Status
    reason: str
    history: tuple[Iteration, ...]
    search: SearchState | None = None

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
    def violations(self) -> Violations:
        """What the motion does beyond the limits of joints, whether the cost knows them or not, and of controls."""
        robot, motion, speed = self.problem.scene.robot, self.trajectory, self.problem.scene.robot.velocity_limit
        joints, speeds = barriers_of(self.problem.cost)
        return Violations(
            position=_beyond(motion.q, [robot.position_limits, *(term.limits for term in joints)]),
            velocity=_beyond(motion.v, [(-speed, speed), *(term.limits for term in speeds)]),
            control=_beyond(motion.u, [self.problem.control_limits]),
        )

    @property
    def policy(self) -> LinearPolicy:
        """Controls with feedback, on the x of the problem's integrator."""
        return self.policy_on("momentum" if self.problem.integrator.variational else "velocity")

    def __repr__(self) -> str:
        noise = f" + {self.noise_cost:.4g} by noise" if self.noise_cost else ""
        return f"Solution(cost {self.cost:.6g}{noise}, {self.iterations} iterations, {self.status.value})"

    def table(self) -> str:
        """The iterations, one row each, and how and why they ended; :class:`Solution` explains the columns."""
        return "\n".join([Iteration.HEADER, *map(str, self.history), self.status.value, f"({self.reason})"])

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the solution as a compressed npz file without pickle; returns its path.

        The problem is not in it: :meth:`load` takes it. All that a search needs to go on is.

        Raises:
            FileError: The path cannot be written.
        """
        search = self.search
        motions = {"": self.trajectory}
        if search is not None:
            motions |= {"search.": search.trajectory} | ({} if search.best is None else {"best.": search.best})
        members: dict[str, Any] = {"status": self.status.name, "reason": self.reason, "history": _rows(self.history)}
        # Motions are often one and the same: each is written once.
        kept: dict[int, str] = {}
        for prefix, motion in motions.items():
            members[f"{prefix}motion"] = kept.setdefault(id(motion), prefix)
            if kept[id(motion)] == prefix:
                members |= {f"{prefix}{name}": value for name, value in motion.members().items()}
        members |= {name: getattr(self, name) for name in (*_PLAN, *_NUMBERS)}
        members |= {name: getattr(self.problem, name) for name in _PROBLEM}
        members["problem.integrator"] = repr(self.problem.integrator)
        members |= _surroundings(self.problem)
        if search is not None:
            members["search.history"] = len(search.history)
            members["search.merits"] = np.array(search.merits)
            members |= {f"search.{name}": getattr(search, name) for name in _SEARCH}
        with atomic_file(path) as stream:
            np.savez_compressed(stream, **members, format=FORMAT)
        return Path(path)

    @classmethod
    def load(cls, path: str | os.PathLike[str], problem: OptimalControlProblem) -> Solution:
        """Read a solution of ``problem`` that :meth:`save` wrote.

        Raises:
            FileError: The file is missing, truncated, no npz, written by something else, holds pickled objects, arrays
                that do not fit together or are not finite, or is of another problem.
        """
        if not isinstance(problem, OptimalControlProblem):
            raise InputError(f"problem must be an OptimalControlProblem, got {type(problem).__name__}")
        source = path_like("path", path)
        expected = {*MEMBERS, *_PLAN, *_NUMBERS, *_PROBLEM, "status", "reason", "history"}
        most = _most_bytes(problem)

        def check(headers: Mapping[str, Header]) -> None:
            size = sum(header.bytes for header in headers.values())
            if size > most:
                raise FileError(
                    f"{source} unpacks to {size / 1e6:.6g} MB, and no solution of this problem to more than "
                    f"{most / 1e6:.6g} MB"
                )

        members = read_members(source, FORMAT, expected, others=True, check=check)
        reader = _Reader(source, members, problem)
        reader.check_problem()
        return reader.solution()

    def shifted(self, decisions: int) -> LinearPolicy:
        """The policy from a later decision on, its last row repeated: what to start the next horizon with.

        Raises:
            InputError: Not from 0 to R - 1.
        """
        if not 0 <= count("decisions", decisions) < len(self.gains):
            raise InputError(f"decisions must be from 0 to {len(self.gains) - 1}, got {decisions}")
        own = self.policy
        rows = np.minimum(np.arange(len(self.gains)) + decisions, len(self.gains) - 1)
        return LinearPolicy(
            own.u[rows], own.gains[rows], own.reference[rows], own.hold, own.on, (own.limits[0], own.limits[1])
        )

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
        limits = self.problem.control_limits
        return LinearPolicy(self.controls, gains, reference, hold * substeps, x, (limits[0], limits[1]))

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
        with announced_compilation("Solution.verify"):
            return self._verify(tolerance, max_substeps, progress)

    def _verify(self, tolerance: float, max_substeps: int, progress: Callable[[int, int], None] | None) -> Verification:
        problem, substeps, before = self.problem, 2, (np.nan, np.nan)
        while True:
            if progress is not None:
                progress(substeps, max_substeps)
            costs = _fine_costs(problem, substeps)
            blind = open_loop(self.controls)._replace(hold=problem.hold * substeps)
            opened = accurate_cost(problem, blind, substeps, costs)
            policy = self.policy_on("velocity", substeps)
            feedback = Commands(policy.u, policy.gains, policy.reference, policy.hold, policy.limits)
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
        self,
        paths: int,
        rng: np.random.Generator | int,
        *,
        feedback: bool = True,
        workers: int | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> MonteCarlo:
        """Expected cost of the policy under the scene's noise, with the problem's own integrator and step.

        Path i draws its noise from the i-th child of ``rng``, for any number of workers. Noise that only Python can
        evaluate (:class:`varpin.CustomNoise`) is simulated path by path, which is slow.

        Main args:
            paths: How many.
            rng: Seed or generator.
            feedback: Without, the controls alone.

        Other Args:
            workers: Threads; as many as there are cores if left out.
            progress: Called now and then with (paths done, paths in all).

        Raises:
            InputError: Wrong arguments.
            VarpinError: Every path failed.
            MonteCarloInterrupted: Ctrl-C; holds the result of the paths done. It is a KeyboardInterrupt.
        """
        draws, paths = generator(rng), count("paths", paths, least=2)
        workers = count("workers", (os.cpu_count() or 1) if workers is None else workers, least=1)
        policy = self.policy
        if not feedback:
            policy = LinearPolicy(policy.u, np.zeros_like(policy.gains), policy.reference, policy.hold, policy.on)
        compiled = self.problem.scene.noise.diffusion is not None
        most = min(_PATHS, _PATHS_PER_WORKER * workers) if compiled else 1
        costs: list[Floats] = []
        try:
            for first in range(0, paths, most):
                batch = min(most, paths - first)
                costs.append(self._sampled(batch, draws, policy, workers) if compiled else self._one(draws, policy))
                if progress is not None:
                    progress(first + batch, paths)
        except KeyboardInterrupt:
            raise MonteCarloInterrupted(self._mean(costs)) from None
        result = self._mean(costs)
        if result is None:
            raise VarpinError(f"fewer than two of {paths} paths got to the end; a smaller dt may help")
        return result

    def _sampled(self, paths: int, draws: np.random.Generator, policy: LinearPolicy, workers: int) -> Floats:
        """Costs of some paths (P,), NaN where one failed."""
        problem = self.problem
        try:
            ensemble = simulate_ensemble(
                problem.scene,
                problem.q0,
                problem.v0,
                dt=problem.dt,
                steps=problem.steps,
                paths=paths,
                rng=draws,
                controls=policy,
                integrator=problem.integrator,
                quantiles=(),
                workers=workers,
            )
        except InputError:
            raise
        except VarpinError:  # every path failed
            return np.full(paths, np.nan)
        if ensemble.q is None or ensemble.v is None or ensemble.u is None:
            return np.full(paths, np.nan)
        return problem.costs(ensemble.q, ensemble.v, ensemble.u)

    def _one(self, draws: np.random.Generator, policy: LinearPolicy) -> Floats:
        """The cost of a path (1,), NaN where it failed."""
        problem, (child,) = self.problem, draws.spawn(1)
        try:
            motion = simulate(
                problem.scene,
                problem.q0,
                problem.v0,
                dt=problem.dt,
                steps=problem.steps,
                controls=policy,
                integrator=problem.integrator,
                rng=child,
                check=False,
            )
        except (StepFailure, NoiseError):
            return np.full(1, np.nan)
        return np.array([problem.cost_of(motion)])

    def _mean(self, costs: Sequence[Floats]) -> MonteCarlo | None:
        values = np.concatenate([np.zeros(0), *costs])
        good = values[np.isfinite(values)]
        if len(good) < 2:
            return None
        return MonteCarlo(
            cost=float(good.mean()),
            standard_error=float(good.std(ddof=1) / np.sqrt(len(good))),
            predicted=self.expected_cost,
            paths=len(good),
            failures=len(values) - len(good),
        )


FORMAT = "varpin.solution/1"
_PLAN = ("gains", "feedforward", "gradient")
_NUMBERS = ("cost", "noise_cost")
_PROBLEM = ("q0", "v0", "t0", "steps", "hold", "sampling", "control_limits")
_SURROUNDINGS = ("gravity", "damping", "stiffness", "rest", "actuation")
_SEARCH = ("cost", "first", "best_merit", "best_cost", "regularization", "growth")
_COLUMNS = tuple(item.name for item in fields(Iteration))


def _surroundings(problem: OptimalControlProblem) -> dict[str, Floats]:
    """What of a problem's scene tells it from others; of a noise that only Python can evaluate nothing but its size."""
    arrays = {f"scene.{name}": getattr(problem.scene, name) for name in _SURROUNDINGS}
    fields_of_noise = problem.scene.mechanism.diffusion._asdict()
    return arrays | {f"noise.{name}": array for name, array in fields_of_noise.items()}


def _most_bytes(problem: OptimalControlProblem) -> int:
    """More than the file of any solution unpacks to: three motions, the plan, and some megabytes for all else."""
    n, m, k = problem.scene.robot.dof, problem.scene.controls, problem.scene.processes
    own = sum(array.nbytes for array in _surroundings(problem).values())
    numbers = 3 * (problem.steps + 1) * (3 * n + m + k + 16) + problem.decisions * m * (2 * n + 2)
    return 8 * numbers + own + 16_000_000


def _rows(history: tuple[Iteration, ...]) -> Floats:
    """One row for each iteration, its fields in order."""
    return np.array([[float(getattr(item, name)) for name in _COLUMNS] for item in history]).reshape(-1, len(_COLUMNS))


@dataclass(frozen=True, eq=False)
class _Reader:
    """The members of a file of a solution, checked as they are taken out."""

    source: Path
    members: dict[str, NDArray[Any]]
    problem: OptimalControlProblem

    def check_problem(self) -> None:
        problem, members = self.problem, self.members
        given = {name: getattr(problem, name) for name in _PROBLEM} | {"dt": problem.dt}
        for name, value in given.items():
            if not np.array_equal(members[name], value):
                raise FileError(f"{self.source} is of a problem with {name} = {members[name]}, not {value}")
        own = repr(problem.integrator)
        if str(members.get("problem.integrator")) != own:
            raise FileError(
                f"{self.source} is of a problem with integrator {members.get('problem.integrator')}, not {own}"
            )

        for name, array in _surroundings(problem).items():
            if name not in members or not np.array_equal(members[name], array, equal_nan=True):
                raise FileError(f"{self.source} is of a problem with another {name.replace('.', ' ')}")

    def array(self, name: str, shape: tuple[int, ...], *, finite: bool = True) -> Floats:
        """A member of floats of the shape given, -1 for any length."""
        if name not in self.members:
            raise FileError(f"{self.source} is not a varpin solution: it has no {name}")
        array = self.members[name]
        if array.ndim != len(shape) or any(b not in (-1, a) for a, b in zip(array.shape, shape, strict=True)):
            raise FileError(f"{self.source}: {name} has shape {array.shape}, where {shape} belongs")
        if array.dtype.kind not in "fi" or (finite and not np.isfinite(array).all()):
            raise FileError(f"{self.source}: {name} holds values that are not finite numbers")
        return np.array(array, dtype=np.float64, order="C")

    def motion(self, prefix: str) -> Trajectory:
        own = {name: self.members[prefix + name] for name in MEMBERS if prefix + name in self.members}
        missing = sorted(MEMBERS - set(own))
        if missing:
            raise FileError(f"{self.source} is not a varpin solution: it has no {prefix}{missing[0]}")
        motion = Trajectory.of_members(self.source, own, self.problem.scene.robot)
        scene = self.problem.scene
        found = motion.steps, motion.u.shape[1], motion.dw.shape[1]
        if found != (self.problem.steps, scene.controls, scene.processes):
            raise FileError(
                f"{self.source}: its motion has {found[0]} steps, {found[1]} controls and {found[2]} noise processes; "
                f"the problem has {self.problem.steps}, {scene.controls} and {scene.processes}"
            )
        return motion

    def history(self) -> tuple[Iteration, ...]:
        rows = self.array("history", (-1, len(_COLUMNS)), finite=False)
        whole = {item.name for item in fields(Iteration) if item.type == "int"}
        found = []
        for row in rows.tolist():
            values: dict[str, Any] = dict(zip(_COLUMNS, row, strict=True))
            found.append(Iteration(**values | {name: int(values[name]) for name in whole}))
        return tuple(found)

    def solution(self) -> Solution:
        problem, members = self.problem, self.members
        R, m, n = problem.decisions, problem.scene.controls, problem.scene.robot.dof
        status = str(members["status"])
        if status not in Status.__members__:
            raise FileError(f"{self.source}: there is no status {status!r}")
        motions = {"": self.motion("")}
        history = self.history()
        cost = float(self.array("cost", ()))
        found = problem.cost_of(motions[""])
        if not abs(found - cost) <= 1e-9 * max(abs(found), abs(cost)):
            raise FileError(f"{self.source} is of a problem with another cost: {cost:.9g}, and here {found:.9g}")
        search = None
        if "search.motion" in members:
            names = {}
            for name in ("search.", "best."):
                names[name] = str(members.get(f"{name}motion", "none"))
                if names[name] != "none" and names[name] not in motions:
                    motions[names[name]] = self.motion(names[name])
            numbers = {name: float(self.array(f"search.{name}", (), finite=False)) for name in _SEARCH}
            search = SearchState(
                trajectory=motions[names["search."]],
                best=motions.get(names["best."]),
                merits=tuple(self.array("search.merits", (-1,)).tolist()),
                history=history[: int(self.array("search.history", ()))],
                **numbers,
            )
        return Solution(
            problem=problem,
            trajectory=motions[""],
            gains=self.array("gains", (R, m, 2 * n)),
            feedforward=self.array("feedforward", (R, m)),
            gradient=self.array("gradient", (R, m), finite=False),
            cost=cost,
            noise_cost=float(self.array("noise_cost", (), finite=False)),
            status=Status[status],
            reason=str(members["reason"]),
            history=history,
            search=search,
        )


def _beyond(y: Floats, limits: Sequence[tuple[Floats, Floats] | Floats]) -> Floats:
    """The most that each column of y (N, k) is outside any of some limits."""
    excess = [np.maximum(y - upper, lower - y).max(axis=0) for lower, upper in limits]
    most: Floats = np.maximum(0.0, np.max(excess, axis=0))
    return most


# Paths that are kept at a time to add up their costs; few, so that Ctrl-C loses little.
_PATHS, _PATHS_PER_WORKER = 256, 32


def _fine_costs(problem: OptimalControlProblem, substeps: int) -> tuple[BoundSum, BoundSum]:
    """Running and terminal costs at the nodes of a finer grid."""
    times = np.arange(problem.steps * substeps + 1, dtype=np.float64) * (problem.dt / substeps)
    return bind_cost(problem.cost, problem.t0 + times, problem.running.points)


def accurate_cost(
    problem: OptimalControlProblem, commands: Commands, substeps: int, costs: tuple[BoundSum, BoundSum] | None = None
) -> tuple[float, Floats]:
    """True cost under given commands, and the end configuration; NaN where the motion runs away."""
    scene, h = problem.scene, problem.dt / substeps
    n, m = scene.robot.dof, scene.controls
    with announced_compilation("accurate integration"):
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
