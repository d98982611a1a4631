"""One backward pass along a motion: a quadratic model of the cost to go, and the change of the controls it gives."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin import core
from varpin.arrays import Floats
from varpin.control.along import Along
from varpin.control.descent import Model
from varpin.control.problem import OptimalControlProblem
from varpin.control.square_root import Squares, squares_of
from varpin.integrators.base import noise_fields
from varpin.linearization import (
    velocity_at_nodes,
    velocity_curvature,
)
from varpin.trajectory import Trajectory

# Greatest relative rounding error of Quu; above, the pass is repeated on square roots.
TRUSTED = 1e-9


class Plan(NamedTuple):
    """The result of a backward pass: gains, feed-forward changes of the controls, and the expected decrease."""

    feedforward: Floats  # (R, m)
    feedback: Floats  # (R, m, 2n)
    previous: Floats | None  # (R, m, m) gains on the previous control, with a rate cost or linear controls
    gradient: Floats  # (R, m)
    slope: float
    curvature: float
    noise: float  # cost of the noise along the motion
    jumps: Floats  # (N, 2n, n), empty without noise
    spread: Floats  # (N, 2n, 2n)
    loss: float  # estimated relative rounding error of Quu, or of its root
    model: Model  # of the cost along the motion
    factors: Floats  # (R, m, m) L D L' of the regularized Quu

    @property
    def expected_decrease(self) -> float:
        """Decrease of the expected cost with a full step, by the model."""
        # The step is the model's minimum, where curvature = -slope.
        return -0.5 * self.slope


def noise_shares(
    problem: OptimalControlProblem, trajectory: Trajectory, plan: Plan, processes: NDArray[np.bool_] | None = None
) -> Floats:
    """Noise cost of each step of a motion (N,), with the noise's effect and value function of the plan's own motion.

    ``processes`` (K,) selects increments, by default all. Empty where there is no noise.
    """
    if problem.processes == 0:
        return np.zeros(0)
    g = impulses(problem, trajectory, plan.jumps)
    if processes is not None:
        g = g[:, :, processes]
    added: Floats = 0.5 * np.einsum("Nai,Nai->N", g, plan.spread @ g)
    return added


def impulses(problem: OptimalControlProblem, trajectory: Trajectory, jumps: Floats) -> Floats:
    """Effect of each increment on the state after each step of a motion (N, 2n, K), for given ``jumps``."""
    scene, n, left = problem.scene, problem.scene.robot.dof, problem.integrator.left
    q, v = trajectory.q, trajectory.v
    jump = noise_fields(scene, trajectory, q[:-1], v[:-1], problem.q0).F
    if not problem.integrator.variational:
        jump = velocity_at_nodes(scene, q[:-1], v[:-1])[:, :, n:] @ jump
    g: Floats = left * (jumps @ jump)
    if left < 1.0:
        g[:, n:] += (1.0 - left) * noise_fields(scene, trajectory, q[1:], v[1:], problem.q0).F
    return g


class Foreseen(NamedTuple):
    """The linearized motion under a plan.

    Attributes:
        expected: The changes of the state and of the previous control before each decision (R, 2n + m).
        moves: The changes of the controls (R, m).
        limited: Whether a control reaches a limit.
    """

    expected: Floats
    moves: Floats
    limited: bool


def foreseen(along: Along, plan: Plan, slack: Floats | None = None, after: Floats | None = None) -> Foreseen:
    """The linearized motion under a plan whose controls are clipped to their limits, or to ``slack`` (R, 2, m).

    ``after`` (N, 2n) receives the change of the state after each step. Where controls are linear between nodes the
    state is X of :mod:`varpin.control.linear_controls`, and there are N + 1 steps.
    """
    problem, (R, m, _), x = along.problem, plan.feedback.shape, along.states
    feedback, previous = gains_on_states(along, plan)
    expected, moves, state = np.empty((R, x + m)), np.empty((R, m)), np.zeros(x + m)
    slack, limited = along.slack if slack is None else slack, False
    for begin, end in along.blocks:
        rows = slice(begin // problem.hold, end // problem.hold)
        A, B = along.state_steps(begin, end)
        then = None if after is None else after[begin:end]
        own = plan.feedforward[rows], feedback[rows], previous[rows], slack[rows]
        reached = core.foresee(problem.hold, A, B, *own, state, expected[rows], moves[rows], then)
        limited = limited or reached
    return Foreseen(expected, moves, limited)


def gains_on_states(along: Along, plan: Plan) -> tuple[Floats, Floats]:
    """A plan's feedback on the states of its pass, and on previous controls where these are no part of the state."""
    (R, m, n), x = plan.feedback.shape, along.states
    if plan.previous is None or not along.problem.linear:
        return plan.feedback, np.zeros((0, m, m)) if plan.previous is None else plan.previous
    feedback = np.zeros((R, m, x))
    feedback[:, :, :n] = plan.feedback
    feedback[:, :, n : n + m] = plan.previous
    return feedback, np.zeros((0, m, m))


def single_pass(
    along: Along,
    regularization: float,
    *,
    costates: bool = False,
    curvature: Floats | None = None,
) -> tuple[Plan | None, Floats]:
    """The plain recursion, or, where its rounding errors are large and the model is convex, that on square roots."""
    plain = one_pass(along, regularization, costates, curvature, roots=False)
    if curvature is not None or (plain[0] is not None and plain[0].loss <= TRUSTED):
        return plain
    by_roots = one_pass(along, regularization, costates, None, roots=True)
    return plain if by_roots[0] is None else by_roots


class _ByRoots(NamedTuple):
    """A pass on square roots, with the costs of samples, of control changes and within steps as squares."""

    run: core.RootPass
    running: Squares
    change: Squares
    within: Squares | None


def one_pass(
    along: Along,
    regularization: float,
    costates: bool,
    curvature: Floats | None,
    *,
    roots: bool,
) -> tuple[Plan | None, Floats]:
    """The plan of one recursion, plain or on square ``roots``, and with ``costates`` those after each step (N, 2n)."""
    problem, running = along.problem, along.running
    scene = problem.scene
    n, m, k, N, R = scene.robot.dof, scene.controls, along.processes, problem.steps, problem.decisions
    by_state, by_states = along.terminal.gradient, along.terminal.hessian
    if curvature is not None and problem.integrator.variational:
        pull = along.terminal.cost.gradient[:, n:]
        by_states = by_states + velocity_curvature(scene, along.trajectory.q[-1:], along.trajectory.v[-1:], pull)[0]
    if problem.linear:
        return _one_pass_on_lines(along, regularization, costates, curvature, by_states, roots=roots)
    noisy = N if k else 0
    jumps, spread = np.empty((noisy, 2 * n, n)), np.empty((noisy, 2 * n, 2 * n))
    feedforward, feedback, gradient = np.empty((R, m)), np.empty((R, m, 2 * n)), np.empty((R, m))
    previous, factors = np.empty(along.rate.shape), np.empty((R, m, m))
    costate = np.empty((N if costates else 0, 2 * n))
    plain, by_roots = core.BackwardPass(m, by_state, by_states), None
    if roots:
        final, squares = (
            squares_of(along.terminal.cost.gradient, along.terminal.cost.hessian),
            squares_of(along.running.gradient, running.hessian),
        )
        change = squares_of(along.pull, along.rate)
        within = None if along.within is None else squares_of(np.zeros((N, 2 * n)), along.within)
        if final is None or squares is None or change is None or (within is None and along.within is not None):
            return None, costate
        by_roots = _ByRoots(
            core.RootPass(m, final.after(along.terminal.slopes).core, by_state), squares, change, within
        )
    samples = len(problem.rule)
    for begin, end in reversed(along.blocks):
        steps, points = slice(begin, end), slice(begin * samples, end * samples)
        rows = slice(begin // problem.hold, end // problem.hold)
        if k:
            jumps[steps] = along.linearized(begin, end)[0].J
        given = along.steps(begin, end, curvature)
        gains = core.Gains(
            feedforward=feedforward[rows],
            feedback=feedback[rows],
            previous=previous[rows],
            control_gradient=gradient[rows],
            costate=costate[steps] if costates else costate,
            spread=spread[steps],
            factors=factors[rows],
        )
        how = (problem.dt, problem.hold, float(regularization))
        if by_roots is None:
            failed = plain.run(*how, given, gains)
        else:
            running_squares, change_squares = by_roots.running[points].core, by_roots.change[rows].core
            within_squares = None if by_roots.within is None else by_roots.within[steps].core
            failed = by_roots.run.run(*how, given, gains, running_squares, change_squares, within_squares)
        if failed >= 0:
            return None, costate
    found = plain if by_roots is None else by_roots.run
    if not (math.isfinite(found.slope) and math.isfinite(found.curvature)):
        return None, costate
    plan = Plan(
        feedforward,
        feedback,
        None if problem.rate is None else previous,
        gradient,
        found.slope,
        found.curvature,
        found.noise,
        jumps,
        spread,
        found.loss,
        along.model,
        factors,
    )
    return plan, costate


def _one_pass_on_lines(
    along: Along,
    regularization: float,
    costates: bool,
    curvature: Floats | None,
    by_states: Floats,
    *,
    roots: bool,
) -> tuple[Plan | None, Floats]:
    """The pass of a plan whose controls are linear between nodes; ``by_states`` is the terminal Hessian (2n, 2n)."""
    problem, X, x = along.problem, along.states, 2 * along.problem.scene.robot.dof
    R, m = problem.decisions, problem.scene.controls
    cost, by_state = along.terminal.cost, along.terminal.gradient
    end_gradient, end_hessian = np.zeros(X), np.zeros((X, X))
    end_gradient[:x], end_hessian[:x, :x] = by_state, by_states
    feedforward, feedback, gradient = np.empty((R, m)), np.empty((R, m, X)), np.empty((R, m))
    line, k, factors = along.line, along.processes, np.empty((R, m, m))
    spread, costate = np.empty((R if k else 0, X, X)), np.empty((R if costates else 0, X))
    of_states = costate[1:, :x]
    gains = core.Gains(
        feedforward=feedforward,
        feedback=feedback,
        previous=np.empty((0, m, m)),
        control_gradient=gradient,
        costate=costate,
        spread=spread,
        factors=factors,
    )
    steps = along.steps(0, R, curvature)
    how = (problem.dt, 1, float(regularization))
    found: core.BackwardPass | core.RootPass
    if roots:
        final = squares_of(cost.gradient, cost.hessian)
        squares = squares_of(line.gradient, line.hessian)
        change = squares_of(np.zeros((0, m)), np.zeros((0, m, m)))
        if final is None or squares is None or change is None:
            return None, of_states
        wide = np.concatenate([along.terminal.slopes, np.zeros((x, X - x))], axis=1)
        found = core.RootPass(m, final.after(wide).padded(X).core, end_gradient)
        failed = found.run(*how, steps, gains, squares.core, change.core)
    else:
        found = core.BackwardPass(m, end_gradient, end_hessian)
        failed = found.run(*how, steps, gains)
    if failed >= 0 or not (math.isfinite(found.slope) and math.isfinite(found.curvature)):
        return None, of_states
    jumps, noise = np.empty((0, x, x // 2)), found.noise
    after = spread[1:, :x, :x] + problem.dt * line.kicked
    if k:
        jumps, G = along.linearized(0, problem.steps)[0].J, line.G[1:, :x]
        noise += 0.5 * problem.dt * float((G * (line.kicked @ G)).sum())
    plan = Plan(
        feedforward,
        feedback[:, :, :x].copy(),
        feedback[:, :, x : x + m].copy(),
        gradient,
        found.slope,
        found.curvature,
        noise,
        jumps,
        after,
        found.loss,
        along.model,
        factors,
    )
    return plan, of_states
