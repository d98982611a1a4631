"""What the backward passes along a motion share: the linearized steps and the expansions of the costs."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from varpin import core
from varpin.arrays import Floats, Mask
from varpin.control.costs import CostError, Expansion
from varpin.control.descent import Model, Stake, at_stake
from varpin.control.linear_controls import (
    RULE,
    Derivatives,
    LinearSteps,
    after_impulse,
    derivatives,
    linear_steps,
    noisy,
    sample_slopes,
    size,
)
from varpin.control.problem import OptimalControlProblem
from varpin.control.within_steps import beyond_samples
from varpin.errors import LinearizationError
from varpin.linearization import (
    Linearization,
    linearize_steps,
    velocity_at_nodes,
)
from varpin.trajectory import Trajectory

# Number of nodes that are linearized at a time; longer motions do not keep their derivatives.
_BLOCK = 2048


def states(problem: OptimalControlProblem, trajectory: Trajectory) -> Floats:
    """X (N + 1, 2n): (q, p) or (q, v)."""
    second = trajectory.p if problem.integrator.variational else trajectory.v
    return np.concatenate((trajectory.q, second), axis=1)


class Along:
    """Expansions along a motion that all its passes share; the linearization is kept where it is one block."""

    def __init__(self, problem: OptimalControlProblem, trajectory: Trajectory) -> None:
        self.problem, self.trajectory = problem, trajectory
        m = problem.scene.controls
        self.rate, self.pull = np.zeros((0, m, m)), np.zeros((0, m))
        if problem.rate is not None:
            self.pull, self.rate = problem.rate.expand(problem.decided(trajectory), problem.period)
        self.slack = np.zeros((0, 2, m))
        if problem.limited:
            self.slack = problem.control_limits - problem.decided(trajectory)[:, None]
        # The number of states of the pass; with linear controls the state contains the control.
        self.blocks, self.states = [(0, problem.steps)], 2 * problem.scene.robot.dof
        if problem.linear:
            self.blocks, self.states = [(0, problem.decisions)], size(problem)
        elif problem.steps > _BLOCK:
            block = max(1, _BLOCK // problem.hold) * problem.hold
            self.blocks = [(max(0, end - block), end) for end in range(problem.steps, 0, -block)][::-1]
        self.kept: tuple[Linearization, Floats] | None = None
        self.held: Mask | None = None  # which controls (R, m) passes keep as they are
        self.processes = problem.processes  # number of Wiener processes that passes take into account

    @cached_property
    def running(self) -> Expansion:
        """The running cost at its samples."""
        return self._finite(self.problem.expand_running(self.trajectory))

    def _finite(self, running: Expansion) -> Expansion:
        """The expansion of a running cost, if it is finite.

        Raises:
            CostError: It is not.
        """
        for name, array in (("gradient", running.gradient), ("Hessian", running.hessian)):
            if not np.isfinite(array).all():
                raise CostError(repr(self.problem.cost), f"its {name} along the motion is not finite")
        return running

    @property
    def within(self) -> Floats | None:
        """The Hessian (N, 2n, 2n), in the noise's jumps, of what their velocities cost beyond the samples."""
        # Most plans have no noise, and a cached property takes a lock for each motion in Python 3.11.
        return self._within if self.problem.processes and self.problem.integrator.holds_noise else None

    @cached_property
    def _within(self) -> Floats | None:
        problem, hessian, samples = self.problem, self.running.hessian, len(self.problem.rule)
        found: list[Floats] = []
        n = problem.scene.robot.dof
        for begin, end in [(0, problem.steps)] if problem.linear else self.blocks:
            part, points = self.trajectory.part(begin, end), slice(begin * samples, end * samples)
            own = hessian[points] if len(hessian) > 1 else hessian
            lin = self.linearized(begin, end)[0]
            last = self.terminal.cost.hessian[0, n:, n:] if end == problem.steps else None
            try:
                more = beyond_samples(problem, part, lin, own, samples, last)
            except LinearizationError as error:
                raise _in_whole(error, begin, problem.dt) from None
            if more is None:
                return None
            found.append(more)
        return np.concatenate(found)

    @cached_property
    def stake(self) -> Stake:
        """The cost at stake along the motion."""
        return at_stake(self.problem, self.trajectory, self.model)

    @cached_property
    def model(self) -> Model:
        """The quadratic model of the cost along the motion."""
        return Model(self.running, self.terminal.cost)

    @cached_property
    def terminal(self) -> _Terminal:
        """The terminal cost at the end of the motion."""
        problem, q, v = self.problem, self.trajectory.q[-1:], self.trajectory.v[-1:]
        n = problem.scene.robot.dof
        end, x = problem.expand_terminal(self.trajectory), slice(0, 2 * n)
        # Contiguous, as the core takes them.
        cost = Expansion(end.gradient[:1, x], np.ascontiguousarray(end.hessian[:1, x, x]))
        g, H, D = cost.gradient[0], cost.hessian[0], None
        if problem.integrator.variational:
            D = np.eye(2 * n)
            # The linearization of a motion of one block is kept, and includes the last node.
            slopes = self.linearized(0, problem.steps)[1] if len(self.blocks) == 1 else D[:0, n:]
            D[n:] = slopes[-1] if len(slopes) else velocity_at_nodes(problem.scene, q, v)[0]
            g, H = D.T @ g, D.T @ H @ D
        return _Terminal(cost, g, H, D)

    @cached_property
    def line(self) -> LinearSteps:
        """The steps with the control in the state, where controls are linear between nodes."""
        problem, found, lines = self.problem, self.running, self.of_lines
        steps = linear_steps(problem, lines, self.sampled, found, self.rate, self.pull)
        if self.processes:
            x = lines.A.shape[1]
            kicked = after_impulse(problem.rule, found.hessian, lines.velocity, problem.steps, x, problem.dt)
            if self.within is not None:
                kicked = kicked + self.within
            steps = noisy(steps, lines, kicked)
        return steps

    @cached_property
    def of_lines(self) -> Derivatives:
        """Derivatives of the steps whose controls are linear between nodes."""
        return derivatives(*self.linearized(0, self.problem.steps))

    @cached_property
    def sampled(self) -> list[Floats]:
        """Derivatives of the model's samples in steps whose controls are linear between nodes."""
        return sample_slopes(self.problem, self.of_lines)

    def linearized(self, begin: int, end: int) -> tuple[Linearization, Floats]:
        """A block of steps, and dv/dx at its nodes where they are needed."""
        if self.kept is not None:
            return self.kept
        problem, part = self.problem, self.trajectory.part(begin, end)
        # dv/dx is needed where the cost samples velocities of nodes and x holds momenta.
        nodes = problem.integrator.variational and problem.at_velocities
        lin = linearize(problem, part, begin)
        n = problem.scene.robot.dof
        velocity = velocity_at_nodes(problem.scene, part.q, part.v) if nodes else np.zeros((0, n, 2 * n))
        if len(self.blocks) == 1:
            self.kept = lin, velocity
        return lin, velocity

    def state_steps(self, begin: int, end: int) -> tuple[Floats, Floats]:
        """A and B of a block of steps, with linear controls those of the states X."""
        if self.problem.linear:
            return self.line.A, self.line.B
        lin = self.linearized(begin, end)[0]
        return lin.A, lin.B

    def steps(self, begin: int, end: int, curvature: Floats | None) -> core.ExpandedSteps:
        """The expansions of a block of steps for the core."""
        if self.problem.linear:
            return self._on_lines(curvature)
        problem, hessian, samples = self.problem, self.running.hessian, len(self.problem.rule)
        size = hessian.shape[-1]
        rows, points = slice(begin // problem.hold, end // problem.hold), slice(begin * samples, end * samples)
        lin, velocity = self.linearized(begin, end)
        G, Gx, Gu, count = lin.G, lin.Gx, lin.Gu, self.processes
        if count < G.shape[2]:
            G, Gx, Gu = (np.ascontiguousarray(array[:, :, :count]) for array in (G, Gx, Gu))
        return core.ExpandedSteps(
            A=lin.A,
            B=lin.B,
            G=G,
            Gx=Gx,
            Gu=Gu,
            rule=problem.rule,
            gradient=self.running.gradient[points],
            hessian=hessian[points] if len(hessian) > 1 else hessian,
            velocity=velocity,
            curvature=np.zeros((0, size, size)) if curvature is None else curvature[begin:end],
            rate=self.rate[rows],
            pull=self.pull[rows],
            within=None if self.within is None else self.within[begin:end],
            held=None if self.held is None else self.held[rows],
        )

    def _on_lines(self, curvature: Floats | None) -> core.ExpandedSteps:
        X, m = self.line.B.shape[1:]
        return core.ExpandedSteps(
            A=self.line.A,
            B=self.line.B,
            G=self.line.G,
            Gx=self.line.Gx,
            Gu=self.line.Gu,
            rule=RULE,
            gradient=self.line.gradient,
            hessian=self.line.hessian,
            velocity=np.zeros((0, X // 2, X)),
            curvature=np.zeros((0, X + m, X + m)) if curvature is None else curvature,
            rate=np.zeros((0, m, m)),
            pull=np.zeros((0, m)),
            held=self.held,
        )


class _Terminal(NamedTuple):
    """The terminal cost in (q, v), its gradient (2n,) and Hessian (2n, 2n) in x, and d(q, v)/dx unless x = (q, v)."""

    cost: Expansion
    gradient: Floats
    hessian: Floats
    by_momentum: Floats | None

    @property
    def slopes(self) -> Floats:
        """d(q, v)/dx (2n, 2n)."""
        return np.eye(len(self.gradient)) if self.by_momentum is None else self.by_momentum


def linearize(problem: OptimalControlProblem, part: Trajectory, begin: int) -> Linearization:
    """The linearized steps of a part of a motion, of which ``begin`` is the first.

    Raises:
        LinearizationError: A step has no derivative; its number is that in the whole motion.
    """
    try:
        return linearize_steps(problem.scene, part, problem.integrator, problem.q0, ramps=problem.linear)
    except LinearizationError as error:
        raise _in_whole(error, begin, problem.dt) from None


def _in_whole(error: LinearizationError, begin: int, dt: float) -> LinearizationError:
    """An error of a part of a motion, with the step's number in the whole motion."""
    step = begin + error.step
    return LinearizationError(step, step * dt, error.reason)
