"""The backward pass along a motion: a quadratic model of the cost to go, and how to change the controls by it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin import core
from varpin.costs import CostError, Expansion
from varpin.errors import LinearizationError
from varpin.linearization import (
    Linearization,
    linearize_steps,
    second_order_steps,
    velocity_at_nodes,
    velocity_curvature,
)
from varpin.sddp.descent import Model
from varpin.sddp.problem import OptimalControlProblem
from varpin.sddp.square_root import Squares, squares_of
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# Nodes that are linearized at a time: their derivatives are not kept.
_BLOCK = 2048

# A pass whose Quu rounding may have changed by more than this part is made anew on square roots.
TRUSTED = 1e-9


@dataclass(frozen=True, eq=False)
class Plan:
    """What a backward pass found: how to change the controls, and what to expect of it."""

    feedforward: Floats  # (R, m)
    feedback: Floats  # (R, m, 2n)
    previous: Floats | None  # (R, m, m) gains on the control before, where its change costs something
    gradient: Floats  # (R, m)
    slope: float
    curvature: float
    noise: float  # cost of the noise along the motion
    jumps: Floats  # (N, 2n, n), empty without noise
    spread: Floats  # (N, 2n, 2n)
    limited: bool
    loss: float  # about the part of Quu, or of its root, that rounding may have changed
    model: Model  # of the cost along the motion

    @property
    def promise(self) -> float:
        """Decrease of the expected cost with a full step, by the model."""
        # Without limits the step is the model's minimum, where the curvature takes back half of what the slope gives.
        return -self.slope - 0.5 * self.curvature if self.limited else -0.5 * self.slope

    def followed(self, length: float) -> Plan:
        """What is left of it after a step of some length, by the model: its gains, and the rest of the way."""
        left = 1.0 - length
        return replace(self, feedforward=left * self.feedforward, gradient=left * self.gradient)

    def free_gradient(self, problem: OptimalControlProblem, trajectory: Trajectory) -> Floats:
        """The gradient (R, m) without what pushes controls against limits they are at: zero at an optimum."""
        if not problem.limited:
            return self.gradient
        u, (lower, upper) = trajectory.u[:: problem.hold], problem.control_limits
        held = ((u <= lower) & (self.gradient > 0.0)) | ((u >= upper) & (self.gradient < 0.0))
        return np.where(held, 0.0, self.gradient)


def noise_shares(
    problem: OptimalControlProblem, trajectory: Trajectory, plan: Plan, processes: NDArray[np.bool_] | None = None
) -> Floats:
    """What noise adds in each step (N,) to the cost of a motion, if it acts and costs as it did along the plan's own.

    ``processes`` (k,) says which ones count, all if left out. Empty where there is no noise.
    """
    if problem.scene.processes == 0:
        return np.zeros(0)
    g = impulses(problem, trajectory, plan.jumps)
    if processes is not None:
        g = g[:, :, processes]
    added: Floats = 0.5 * np.einsum("Nai,Nai->N", g, plan.spread @ g)
    return added


def impulses(problem: OptimalControlProblem, trajectory: Trajectory, jumps: Floats) -> Floats:
    """What each Wiener process does to the state after each step of a motion, (N, 2n, k), for given ``jumps``."""
    scene, n, left = problem.scene, problem.scene.robot.dof, problem.integrator.left
    q, v, u = trajectory.q, trajectory.v, trajectory.u
    jump = scene.noise.fields(q[:-1], v[:-1], u, problem.q0).F
    if not problem.integrator.variational:
        jump = velocity_at_nodes(scene, q[:-1], v[:-1])[:, :, n:] @ jump
    g: Floats = left * (jumps @ jump)
    if left < 1.0:
        g[:, n:] += (1.0 - left) * scene.noise.fields(q[1:], v[1:], u, problem.q0).F
    return g


def _curvature(problem: OptimalControlProblem, trajectory: Trajectory, plan: Plan, costate: Floats) -> Floats:
    """Second derivatives (N, 2n + m, 2n + m) in (x, u) that dynamics and noise fields add to the cost to go."""
    scene, n, h = problem.scene, problem.scene.robot.dof, problem.dt
    N, samples, rule = problem.steps, len(problem.rule), problem.rule
    gradient = problem.expand_running(trajectory).gradient.reshape(N, samples, -1)
    by_q, by_v = gradient[:, :, :n], gradient[:, :, n : 2 * n]
    # The running cost's gradient in q0, v0, q1 and v1 of each step.
    pulls = [
        h * np.einsum("s,Nsi->Ni", rule[:, 0] * rule[:, 1 + c], by_q)
        + h * np.einsum("s,Nsi->Ni", rule[:, 0] * rule[:, 5 + c], by_v)
        for c in range(4)
    ]
    z = costate.copy()
    z[:, :n] += pulls[2]
    after = bool(rule[:, [4, 8]].any())
    if after:
        z += np.einsum("Ni,Nix->Nx", pulls[3], velocity_at_nodes(scene, trajectory.q[1:], trajectory.v[1:]))
    second = second_order_steps(scene, trajectory, z, problem.integrator)
    total = np.block([[second.xx, np.swapaxes(second.ux, 1, 2)], [second.ux, second.uu]])
    if rule[:, [2, 6]].any():
        total[:, : 2 * n, : 2 * n] += velocity_curvature(scene, trajectory.q[:-1], trajectory.v[:-1], pulls[1])
    if after:
        lin = _linearize(problem, trajectory, 0)
        J = np.concatenate([lin.A, lin.B], axis=2)
        total += np.swapaxes(J, 1, 2) @ velocity_curvature(scene, trajectory.q[1:], trajectory.v[1:], pulls[3]) @ J
    if scene.processes and problem.integrator.variational:
        pull = plan.spread @ impulses(problem, trajectory, plan.jumps)
        weight = problem.integrator.left * np.swapaxes(plan.jumps, 1, 2) @ pull
        total[:, :n, :n] += scene.noise.curvature(weight)
    return total


def backward(
    problem: OptimalControlProblem, trajectory: Trajectory, regularization: float, second_order: bool = False
) -> Plan | None:
    """One backward pass along a motion; None where a control has no minimum.

    Raises:
        LinearizationError: A step has no derivative.
    """
    if not second_order:
        return _pass(problem, trajectory, regularization)[0]
    # First derivatives of the cost to go, then with them second derivatives of the dynamics (stagewise Newton).
    plan, costate = _pass(problem, trajectory, max(regularization, 1e-3), costates=True)
    if plan is None:
        return None
    return _pass(problem, trajectory, regularization, curvature=_curvature(problem, trajectory, plan, costate))[0]


def _pass(
    problem: OptimalControlProblem,
    trajectory: Trajectory,
    regularization: float,
    *,
    costates: bool = False,
    curvature: Floats | None = None,
) -> tuple[Plan | None, Floats]:
    """The pass by the plain recursion, or, where that has lost its digits and the model is convex, on square roots."""
    plain = _one_pass(problem, trajectory, regularization, costates, curvature, roots=False)
    if curvature is not None or (plain[0] is not None and plain[0].loss <= TRUSTED):
        return plain
    by_roots = _one_pass(problem, trajectory, regularization, costates, None, roots=True)
    return plain if by_roots[0] is None else by_roots


class _ByRoots(NamedTuple):
    """A pass on square roots, and the costs of samples and of changes of the control as squares."""

    run: core.RootPass
    running: Squares
    change: Squares


def _one_pass(
    problem: OptimalControlProblem,
    trajectory: Trajectory,
    regularization: float,
    costates: bool,
    curvature: Floats | None,
    *,
    roots: bool,
) -> tuple[Plan | None, Floats]:
    scene = problem.scene
    n, m, k, N, R = scene.robot.dof, scene.controls, scene.processes, problem.steps, problem.decisions
    size = 2 * n + m
    terminal, D, by_state, by_states = _terminal(problem, trajectory, curvature is not None)
    running = problem.expand_running(trajectory)
    for name, array in (("gradient", running.gradient), ("Hessian", running.hessian)):
        if not np.isfinite(array).all():
            raise CostError(repr(problem.cost), f"its {name} along the motion is not finite")
    noisy = N if k else 0
    jumps, spread = np.empty((noisy, 2 * n, n)), np.empty((noisy, 2 * n, 2 * n))
    feedforward, feedback, gradient = np.empty((R, m)), np.empty((R, m, 2 * n)), np.empty((R, m))
    rate, pull = np.zeros((0, m, m)), np.zeros((0, m))
    if problem.rate is not None:
        pull, rate = problem.rate.expand(trajectory.u[:: problem.hold], problem.period)
    previous = np.empty(rate.shape)
    costate = np.empty((N if costates else 0, 2 * n))
    hessian = running.hessian
    plain, by_roots = core.BackwardPass(m, by_state, by_states), None
    if roots:
        final, squares = squares_of(terminal.gradient, terminal.hessian), squares_of(running.gradient, hessian)
        change = squares_of(pull, rate)
        if final is None or squares is None or change is None:
            return None, costate
        by_roots = _ByRoots(core.RootPass(m, final.after(D).core, by_state), squares, change)
    rule = problem.rule
    samples = len(rule)
    # Velocities at nodes are needed where they are sampled and x does not hold them.
    nodes = problem.integrator.variational and bool(rule[:, [2, 4, 6, 8]].any())
    slack = np.zeros((0, 2, m))
    if problem.limited:
        slack = problem.control_limits - trajectory.u[:: problem.hold, None]
    block = max(1, _BLOCK // problem.hold) * problem.hold
    for end in range(N, 0, -block):
        begin = max(0, end - block)
        part, steps = trajectory.part(begin, end), slice(begin, end)
        rows = slice(begin // problem.hold, end // problem.hold)
        lin = _linearize(problem, part, begin)
        if k:
            jumps[steps] = lin.J
        velocity = velocity_at_nodes(scene, part.q, part.v) if nodes else np.zeros((0, n, 2 * n))
        points = slice(begin * samples, end * samples)
        given = core.ExpandedSteps(
            A=lin.A,
            B=lin.B,
            G=lin.G,
            Gx=lin.Gx,
            Gu=lin.Gu,
            rule=rule,
            gradient=running.gradient[points],
            hessian=hessian[points] if len(hessian) > 1 else hessian,
            velocity=velocity,
            curvature=np.zeros((0, size, size)) if curvature is None else curvature[steps],
            slack=slack[rows],
            rate=rate[rows],
            pull=pull[rows],
        )
        gains = core.Gains(
            feedforward=feedforward[rows],
            feedback=feedback[rows],
            previous=previous[rows],
            control_gradient=gradient[rows],
            costate=costate[steps] if costates else costate,
            spread=spread[steps],
        )
        how = (problem.dt, problem.hold, float(regularization))
        if by_roots is None:
            failed = plain.run(*how, given, gains)
        else:
            running_squares, change_squares = by_roots.running[points].core, by_roots.change[rows].core
            failed = by_roots.run.run(*how, given, gains, running_squares, change_squares)
        if failed >= 0:
            return None, costate
    found = plain if by_roots is None else by_roots.run
    if not (np.isfinite(found.slope) and np.isfinite(found.curvature)):
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
        problem.limited,
        found.loss,
        Model(running, terminal),
    )
    return plan, costate


def _linearize(problem: OptimalControlProblem, part: Trajectory, begin: int) -> Linearization:
    try:
        return linearize_steps(problem.scene, part, problem.integrator, problem.q0)
    except LinearizationError as error:
        step = begin + error.step
        raise LinearizationError(step, step * problem.dt, error.reason) from None


def _terminal(
    problem: OptimalControlProblem, trajectory: Trajectory, exact: bool
) -> tuple[Expansion, Floats, Floats, Floats]:
    """The terminal cost in (q, v), d(q, v)/dx, and the cost's gradient (2n,) and Hessian (2n, 2n) in x."""
    n = problem.scene.robot.dof
    end = problem.expand_terminal(trajectory)
    x = slice(0, 2 * n)
    gradient, hessian, D = end.gradient[:1, x], end.hessian[:1, x, x], np.eye(2 * n)
    g, H = gradient[0], hessian[0]
    if problem.integrator.variational:
        D[n:] = velocity_at_nodes(problem.scene, trajectory.q[-1:], trajectory.v[-1:])[0]
        H = D.T @ H @ D
        if exact:
            H = H + velocity_curvature(problem.scene, trajectory.q[-1:], trajectory.v[-1:], g[None, n:])[0]
        g = D.T @ g
    return Expansion(gradient, hessian), D, g, H
