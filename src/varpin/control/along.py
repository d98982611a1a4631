"""What the backward passes along a motion share: the linearized steps and the expansions of the costs."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin import core
from varpin.arrays import Floats
from varpin.control.costs import CostError, Expansion
from varpin.control.descent import Model, Stake, at_stake
from varpin.control.linear_controls import (
    RULE,
    Derivatives,
    LinearSteps,
    after_impulse,
    at_samples,
    derivatives,
    in_step,
    linear_steps,
    noisy,
    sample_slopes,
    size,
    widened,
    with_pull,
)
from varpin.control.moments import noise_gradient
from varpin.control.problem import OptimalControlProblem
from varpin.control.spread import Feedback, state_slopes
from varpin.control.within_steps import beyond_samples
from varpin.errors import LinearizationError
from varpin.linearization import (
    Linearization,
    linearize_steps,
    velocity_at_nodes,
)
from varpin.mechanics.forces import limited_servos
from varpin.trajectory import Trajectory

# Number of nodes that are linearized at a time; longer motions do not keep their derivatives.
_BLOCK = 2048


def states(problem: OptimalControlProblem, trajectory: Trajectory) -> Floats:
    """X (N + 1, 2n): (q, p) or (q, v)."""
    second = trajectory.p if problem.integrator.variational else trajectory.v
    return np.concatenate((trajectory.q, second), axis=1)


class Limits(NamedTuple):
    """Control limits for a pass: their ``slack`` (R, 2, m), and the ``expected`` states (R, 2n + m).

    The slack is empty without limits, the expected states around the nominal ones. The pass fills in the diagonal of
    Quu without regularization in ``stiffness`` (R, m), the gradient at the expected states in ``pressure`` (R, m), and
    L D L' of the regularized Quu of free controls in ``factors`` (R, m, m).
    """

    slack: Floats
    expected: Floats
    stiffness: Floats | None = None
    pressure: Floats | None = None
    factors: Floats | None = None

    def part(self, rows: slice) -> dict[str, Floats | None]:
        """What the pass fills in for some decisions."""
        return {
            "stiffness": None if self.stiffness is None else self.stiffness[rows],
            "pressure": None if self.pressure is None else self.pressure[rows],
            "factors": None if self.factors is None else self.factors[rows],
        }


def without_limits(controls: int, states: int) -> Limits:
    """Those of controls without limits."""
    return around_nominal(np.zeros((0, 2, controls)), states)


def around_nominal(slack: Floats, states: int) -> Limits:
    """Limits around the nominal states, with ``slack`` (R, 2, m)."""
    return Limits(slack, np.zeros((0, states + slack.shape[2])))


class Along:
    """Expansions along a motion that all its passes share; the linearization is kept where it is one block."""

    def __init__(self, problem: OptimalControlProblem, trajectory: Trajectory) -> None:
        self.problem, self.trajectory = problem, trajectory
        m = problem.scene.controls
        self.rate, self.pull = np.zeros((0, m, m)), np.zeros((0, m))
        if problem.rate is not None:
            self.pull, self.rate = problem.rate.expand(problem.decided(trajectory), problem.period)
        self.slack = np.zeros((0, 2, m))
        self.clipped = False  # whether passes leave the limits to the motion, which clips controls
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
        # Gradient of the noise cost, added to the cost's gradient at its samples (N s, 2n + m) once it is known.
        self.added: Floats | None = None
        # With linear controls in (x, w, u) of each step (N, 2n + 2m).
        self.pulled: Floats | None = None
        self.noise_differentiated = False
        # Hessians of a further cost, added to those of steps (N, 2n + m, 2n + m).
        self.firm: Floats | None = None
        self.processes = problem.processes  # number of Wiener processes that passes take into account

    @cached_property
    def running(self) -> Expansion:
        """The running cost at its samples."""
        return self._finite(self.problem.expand_running(self.trajectory))

    def expanded(self, running: Expansion) -> None:
        """Take over the expansion of the running cost from who has it.

        Raises:
            CostError: It is not finite.
        """
        self.running = self._finite(running)

    def _finite(self, running: Expansion) -> Expansion:
        """The expansion of a running cost, if it is finite.

        Raises:
            CostError: It is not.
        """
        for name, array in (("gradient", running.gradient), ("Hessian", running.hessian)):
            if not np.isfinite(array).all():
                raise CostError(repr(self.problem.cost), f"its {name} along the motion is not finite")
        return running

    def differentiate_noise(self, feedback: Feedback, spread: Floats, processes: NDArray[np.bool_]) -> None:
        """Add the whole gradient of the noise cost to later passes.

        It is that of ``processes`` (K,) under the ``feedback`` of a pass, with its Hessians ``spread`` (N, 2n, 2n).
        """
        problem, N = self.problem, self.problem.steps
        lin = self.linearized(0, N)[0] if len(self.blocks) == 1 else None
        pull = noise_gradient(problem, self.trajectory, feedback, self.rate, processes, lin, spread)
        self._pull(pull)
        self.noise_differentiated = True

    def _pull(self, gradient: Floats) -> None:
        """Add a gradient of the steps' costs (N, Z), in (x, u) or with linear controls in (x, w, u)."""
        problem, N = self.problem, self.problem.steps
        if problem.linear:
            self.pulled = gradient if self.pulled is None else self.pulled + gradient
            vars(self).pop("line", None)
            return
        # A gradient in (x, u) is one in (q, v, u) at the step's first sample.
        lin, velocity = self.linearized(0, N)
        rule, x, m = problem.model_rule, 2 * problem.scene.robot.dof, problem.scene.controls
        D = np.zeros((N, x + m, x + m))
        D[:, :x] = at_samples(rule[:1], np.concatenate([lin.A, lin.B], axis=2), velocity)[0]
        D[:, x:, x:] = np.eye(m)
        added = np.zeros((N, len(rule), x + m))
        added[:, 0] = np.linalg.solve(np.swapaxes(D, 1, 2), gradient[:, :, None])[:, :, 0] / (problem.dt * rule[0, 0])
        self.added = added.reshape(-1, x + m) if self.added is None else self.added + added.reshape(-1, x + m)

    def with_noise_held(self, spread: Floats) -> Along:
        """These expansions without noise, whose cost is instead a fixed one of the steps, for S ``spread`` (N, 2n, 2n).

        The gains of regularized passes let noise grow, and so do not tell what it costs.
        """
        made, m, linear = copy(self), self.problem.scene.controls, self.problem.linear
        lin = self.linearized(0, self.problem.steps)[0]
        counted = slice(None) if linear else slice(self.processes)
        gz = in_step(lin)[1][:, :, counted]
        weighted = np.einsum("Nab,Nbkz->Nakz", spread, gz)
        hessian = np.einsum("Nakz,Naky->Nzy", gz, weighted)
        made.processes, made.firm = 0, widened(hessian, m) if linear else hessian
        made._pull(np.einsum("Nakz,Nak->Nz", weighted, lin.G[:, :, counted]))
        return made

    def with_cost_of_controls(self, diagonal: Floats, gradient: Floats | None = None) -> Along:
        """These expansions with a further cost of the changes of decided controls: both (R, m)."""
        made, problem, (R, m), x = copy(self), self.problem, diagonal.shape, self.states
        made.firm = np.zeros((R * problem.hold, x + m, x + m))
        entries = np.arange(x, x + m)
        made.firm[:, entries, entries] = np.repeat(diagonal / problem.hold, problem.hold, axis=0)
        if gradient is None:
            return made
        if problem.linear:
            total = self.line.gradient.copy()
            total[:, -m:] += gradient / problem.dt
            vars(made)["line"] = self.line._replace(gradient=total)
            return made
        rule = problem.model_rule
        added = np.zeros((problem.steps, len(rule), x + m))
        added[:, 0, x:] = np.repeat(gradient / problem.hold, problem.hold, axis=0) / (problem.dt * rule[0, 0])
        made.added = added.reshape(-1, x + m) if self.added is None else self.added + added.reshape(-1, x + m)
        return made

    def regularized(self, diagonal: Floats) -> Along:
        """These expansions with a further cost of the changes of decided controls, its Hessian's diagonal (R, m).

        Other than :meth:`with_cost_of_controls`, passes on square roots include it.
        """
        made, problem, m = copy(self), self.problem, diagonal.shape[1]
        controls = np.arange(-m, 0)
        if problem.linear:
            hessian = self.line.hessian.copy()
            hessian[:, controls, controls] += diagonal / problem.dt
            vars(made)["line"] = self.line._replace(hessian=hessian)
            return made
        rule, hessian = problem.model_rule, self.running.hessian.copy()
        weight = problem.hold * problem.dt * rule[0, 0]
        hessian[:: len(rule), controls, controls] += np.repeat(diagonal / weight, problem.hold, axis=0)
        made.running = Expansion(self.running.gradient, hessian)
        return made

    def with_gradient_alone(self, gradient: Floats) -> Along:
        """These steps with a gradient of the changes of decided controls (R, m) as the only one."""
        made = copy(self)
        if self.problem.linear:
            vars(made)["line"] = self.line._replace(gradient=np.zeros(self.line.gradient.shape))
        else:
            made.running = Expansion(np.zeros(self.running.gradient.shape), self.running.hessian)
        made.added, made.pull = None, np.zeros(self.pull.shape)
        return made.with_cost_of_controls(np.zeros(gradient.shape), gradient)

    @property
    def slopes(self) -> Floats:
        """The gradient of the running cost at its samples, with that of the noise cost if it was added."""
        return self.running.gradient if self.added is None else self.running.gradient + self.added

    @property
    def within(self) -> Floats | None:
        """The Hessian (N, 2n, 2n), in the noise's jumps, of what their velocities cost beyond the samples."""
        # Most plans have no noise, and a cached property takes a lock for each motion in Python 3.11.
        return self._within if self.problem.processes and self.problem.integrator.holds_noise else None

    @cached_property
    def _within(self) -> Floats | None:
        problem, hessian, samples = self.problem, self.running.hessian, len(self.problem.model_rule)
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
            kicked = after_impulse(problem.model_rule, found.hessian, lines.velocity, problem.steps, x, problem.dt)
            if self.within is not None:
                kicked = kicked + self.within
            steps = noisy(steps, lines, kicked)
        return steps if self.pulled is None else with_pull(steps, self.pulled, problem.dt)

    @cached_property
    def of_lines(self) -> Derivatives:
        """Derivatives of the steps whose controls are linear between nodes."""
        return derivatives(*self.linearized(0, self.problem.steps))

    @cached_property
    def sampled(self) -> list[Floats]:
        """Derivatives of the model's samples in steps whose controls are linear between nodes."""
        return sample_slopes(self.problem, self.of_lines)

    @cached_property
    def demands(self) -> Floats:
        """Hessians (N, 2n + m, 2n + m) in (x, u) of the squared changes of what servos demand of their drives.

        The demand is that at the begin of a step, with linear controls of the step's mean control, in units of the
        effort limit. With linear controls they are those of N + 1 steps in (X, u).
        """
        problem, motion, scene = self.problem, self.trajectory, self.problem.scene
        n, m, N = problem.scene.robot.dof, problem.scene.controls, problem.steps
        speed = state_slopes(problem, motion)[:-1, n:]
        ends = 2 if problem.linear else 1
        found = np.zeros((N, 2 * n + ends * m, 2 * n + ends * m))
        for servo in limited_servos(scene.elements):
            c, (stiffness, damping, effort) = servo.coordinate, servo.values
            row = np.zeros((N, 2 * n + ends * m))
            row[:, : 2 * n] = -damping * speed[:, c]
            row[:, c] -= stiffness
            row[:, 2 * n :] = np.tile(scene.actuation[c] / ends, ends)
            found += np.einsum("Na,Nb->Nab", row, row) / effort**2
        return widened(found, m) if problem.linear else found

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

    def steps(self, begin: int, end: int, curvature: Floats | None, limits: Limits) -> core.ExpandedSteps:
        """The expansions of a block of steps for the core."""
        if self.firm is not None:
            curvature = self.firm if curvature is None else curvature + self.firm
        if self.problem.linear:
            return self._on_lines(curvature, limits)
        problem, hessian, samples = self.problem, self.running.hessian, len(self.problem.model_rule)
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
            rule=problem.model_rule,
            gradient=self.slopes[points],
            hessian=hessian[points] if len(hessian) > 1 else hessian,
            velocity=velocity,
            curvature=np.zeros((0, size, size)) if curvature is None else curvature[begin:end],
            slack=limits.slack[rows],
            expected=limits.expected[rows],
            rate=self.rate[rows],
            pull=self.pull[rows],
            within=None if self.within is None else self.within[begin:end],
        )

    def _on_lines(self, curvature: Floats | None, limits: Limits) -> core.ExpandedSteps:
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
            slack=limits.slack,
            expected=limits.expected,
            rate=np.zeros((0, m, m)),
            pull=np.zeros((0, m)),
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
