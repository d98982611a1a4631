"""The noise cost of a motion under feedback, to second order, and its gradient in the motion.

With the gains held, the covariance of (x, u) is propagated forward and the quadratic value function W backward; the
noise cost is a sum over the steps. The share of a step depends only on the state at its beginning and on its control,
through its derivatives, the Hessians of its costs and its noise. Central differences of the linearized steps give the
gradient of the shares. A control that is linear over the step is a pair (w, u), those at its ends. Equation (O12) of
docs/mathematics.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.control.linear_controls import after_impulse, at_samples, in_step, of_samples, on_lines, shifted_lines
from varpin.control.noise_adjoint import LinearizedSteps, exact_gradient, is_exact
from varpin.control.problem import OptimalControlProblem
from varpin.control.spread import Feedback, added_covariance, decided, propagated
from varpin.control.within_steps import beyond_samples
from varpin.linearization import Linearization, linearize_steps, velocity_at_nodes
from varpin.trajectory import Trajectory

# Step of the central differences, relative to the largest value of each variable along the motion.
_SHIFT = 1e-5


def noise_gradient(
    problem: OptimalControlProblem,
    trajectory: Trajectory,
    feedback: Feedback,
    rate: Floats,
    processes: NDArray[np.bool_],
    lin: Linearization | None = None,
    spread: Floats | None = None,
) -> Floats:
    """The gradient (N, Z) of the noise cost in the Z variables of each step, (O12).

    It leaves out the part through the strength of the noise, which the backward pass already has.

    Args:
        problem: The problem.
        trajectory: The motion.
        feedback: The gains of a backward pass along it.
        rate: Hessian (R, m, m) of the cost of control changes, or (0, m, m).
        processes: Mask of the increments that count (K,).
        lin: The linearized steps, if they are known.
        spread: S of (O2) from the backward pass (N, 2n, 2n).
    """
    here = _steps_of(problem, trajectory, processes, lin)
    if spread is not None and problem.hold == 1 and not len(rate) and not problem.linear:
        # The value has no rows for the control before a decision.
        x = here.J.shape[1]
        W = np.zeros((len(spread) + 1, here.J.shape[2], here.J.shape[2]))
        W[1:, :x, :x] = spread / problem.dt - here.kicked
    else:
        W = _values(problem, here, feedback, _end_hessian(problem, trajectory), rate)
    C = propagated(here.J, here.g, here.gz, problem, feedback)
    if is_exact(problem):
        return exact_gradient(problem, trajectory, here, W, C, processes)
    return _by_differences(problem, trajectory, here, W, C, processes)


def _by_differences(
    problem: OptimalControlProblem,
    trajectory: Trajectory,
    here: LinearizedSteps,
    W: Floats,
    C: Floats,
    processes: NDArray[np.bool_],
) -> Floats:
    """:func:`noise_gradient` by central differences of the shares, for any step, cost and noise."""
    (N, _, Z), n = here.J.shape, problem.scene.robot.dof
    variational = problem.integrator.variational
    x = np.concatenate([trajectory.q, trajectory.p if variational else trajectory.v], axis=1)
    nodes = trajectory.u_nodes
    y = np.concatenate([x[:-1], *((nodes[:-1], nodes[1:]) if problem.linear else (trajectory.u,))], axis=1)
    slopes = velocity_at_nodes(problem.scene, trajectory.q, trajectory.v)
    size = np.abs(y).max(axis=0)
    shift = _SHIFT * np.where(size > 0.0, size, 1.0)
    found = np.empty((N, Z))
    for c in range(Z):
        change = []
        for sign in (1.0, -1.0):
            step = np.zeros(Z)
            step[c] = sign * shift[c]
            # Every other step begins at a shifted state; the node after it moves accordingly.
            shares = np.empty(N)
            for first in range(min(2, N)):
                rows = slice(first, N, 2)
                dx, du = np.zeros((N + 1, 2 * n)), np.zeros((N, Z - 2 * n))
                dx[:-1][rows], du[rows] = step[: 2 * n], step[2 * n :]
                dx[1:][rows] = here.J[rows] @ step
                near = _steps_of(problem, _perturbed(problem, trajectory, dx, du, slopes), processes)
                shares[rows] = _shares(problem, near, W, C)[rows]
            change.append(shares)
        found[:, c] = (change[0] - change[1]) / (2.0 * shift[c])
    # The Hessian of the terminal cost depends on the state at the end, too.
    at_end = np.empty(2 * n)
    for c in range(2 * n):
        change = []
        for sign in (1.0, -1.0):
            dx = np.zeros((N + 1, 2 * n))
            dx[N, c] = sign * shift[c]
            end = _perturbed(problem, trajectory, dx, np.zeros((N, Z - 2 * n)), slopes)
            change.append(0.5 * (_end_hessian(problem, end) * C[N, : 2 * n, : 2 * n]).sum())
        at_end[c] = (change[0] - change[1]) / (2.0 * shift[c])
    found[-1] += here.J[-1].T @ at_end
    spread = problem.dt * (W[1:, : 2 * n, : 2 * n] + here.kicked)
    known: Floats = np.einsum("Nakz,Nab,Nbk->Nz", here.gz, spread, here.g)
    return found - known


def noise_cost(problem: OptimalControlProblem, trajectory: Trajectory, feedback: Feedback) -> float:
    """The noise cost of a motion under feedback, without that of control changes."""
    here = _steps_of(problem, trajectory, slice(None))
    return _with_covariances(problem, trajectory, here, propagated(here.J, here.g, here.gz, problem, feedback))


def noise_cost_in_halves(
    problem: OptimalControlProblem, halves: OptimalControlProblem, trajectory: Trajectory, feedback: Feedback
) -> float:
    """:func:`noise_cost` of linear controls on ``halves``, the problem in half steps, decided once in each whole one.

    A control in the middle of a whole step is the mean of those at its ends, which feedback decides at its beginning.
    """
    here = _steps_of(halves, trajectory, slice(None))
    x, m, dt = here.J.shape[1], problem.scene.controls, halves.dt
    C, covariance = np.zeros((halves.steps + 1, x + 2 * m, x + 2 * m)), np.zeros((x + m, x + m))
    middle = np.hstack([np.zeros((m, x)), 0.5 * np.eye(m), 0.5 * np.eye(m)])
    last = np.hstack([np.zeros((m, x + m)), np.eye(m)])
    to_middle = np.vstack([np.eye(x + m, x + 2 * m), middle])
    for k in range(problem.steps):
        T = decided(problem, feedback, k, x)
        whole = covariance if T is None else T @ covariance @ T.T
        C[2 * k] = to_middle @ whole @ to_middle.T
        through = np.vstack([here.J[2 * k] @ to_middle, middle, last])
        C[2 * k + 1] = through @ whole @ through.T
        C[2 * k + 1, :x, :x] += dt * added_covariance(here.g[2 * k], here.gz[2 * k], C[2 * k])
        through = np.vstack([here.J[2 * k + 1], last])
        covariance = through @ C[2 * k + 1] @ through.T
        covariance[:x, :x] += dt * added_covariance(here.g[2 * k + 1], here.gz[2 * k + 1], C[2 * k + 1])
    C[-1, :x, :x] = covariance[:x, :x]
    return _with_covariances(halves, trajectory, here, C)


def _with_covariances(
    problem: OptimalControlProblem, trajectory: Trajectory, here: LinearizedSteps, C: Floats
) -> float:
    """The noise cost with covariances ``C`` (N + 1, Z, Z) of the variables of each step, and of the last state."""
    x = here.J.shape[1]
    over_time = (here.cost * C[:-1]).sum()
    at_end = (_end_hessian(problem, trajectory) * C[-1, :x, :x]).sum()
    return 0.5 * float(over_time + at_end) + _of_impulses(problem, here, here.kicked, C)


def left_within_steps(problem: OptimalControlProblem, trajectory: Trajectory, feedback: Feedback) -> float:
    """The part of :func:`noise_cost` that no path shows, see :func:`varpin.control.within_steps.beyond_samples`."""
    here = _steps_of(problem, trajectory, slice(None))
    if here.beyond is None:
        return 0.0
    return _of_impulses(problem, here, here.beyond, propagated(here.J, here.g, here.gz, problem, feedback))


def _of_impulses(problem: OptimalControlProblem, steps: LinearizedSteps, hessian: Floats, C: Floats) -> float:
    """The cost of the noise's jumps by its Hessian (N, 2n, 2n) in them, for the covariances C before the steps."""
    twice = np.einsum("Nak,Nab,Nbk->", steps.g, hessian, steps.g, optimize=True)
    twice += np.einsum("Nakz,Nab,Nbky,Nzy->", steps.gz, hessian, steps.gz, C[:-1], optimize=True)
    return 0.5 * problem.dt * float(twice)


def _end_hessian(problem: OptimalControlProblem, trajectory: Trajectory) -> Floats:
    """Hessian of the terminal cost in x (2n, 2n)."""
    n = problem.scene.robot.dof
    H: Floats = problem.expand_terminal(trajectory).hessian[0, : 2 * n, : 2 * n]
    if not problem.integrator.variational:
        return H
    D = np.eye(2 * n)
    D[n:] = velocity_at_nodes(problem.scene, trajectory.q[-1:], trajectory.v[-1:])[0]
    return np.asarray(D.T @ H @ D)


def _perturbed(
    problem: OptimalControlProblem, trajectory: Trajectory, dx: Floats, du: Floats, slopes: Floats
) -> Trajectory:
    """A trajectory with shifted nodes and controls; its steps do not connect, but each can be linearized.

    ``du`` (N, m) are changes of the controls, or (N, 2m) those of the ends of linear ones.
    """
    n = trajectory.q.shape[1]
    q = trajectory.q + dx[:, :n]
    moved = shifted_lines(problem, trajectory, du) if problem.linear else replace(trajectory, u=trajectory.u + du)
    if not problem.integrator.variational:
        return replace(moved, q=q, v=trajectory.v + dx[:, n:])
    v = trajectory.v + np.einsum("Nix,Nx->Ni", slopes, dx)
    return replace(moved, q=q, p=trajectory.p + dx[:, n:], v=v)


def _steps_of(
    problem: OptimalControlProblem,
    trajectory: Trajectory,
    processes: NDArray[np.bool_] | slice,
    lin: Linearization | None = None,
) -> LinearizedSteps:
    scene, n, m, N = problem.scene, problem.scene.robot.dof, problem.scene.controls, problem.steps
    x, h, rule, samples = 2 * n, problem.dt, problem.rule, len(problem.rule)
    if lin is None:
        lin = linearize_steps(scene, trajectory, problem.integrator, problem.q0, ramps=problem.linear)
    velocity = np.zeros((0, n, x))
    if problem.integrator.variational and rule[:, [2, 4, 6, 8]].any():
        velocity = velocity_at_nodes(scene, trajectory.q, trajectory.v)
    J, gz = in_step(lin)
    hessian = problem.expand_running(trajectory).hessian
    cost = np.zeros((N, J.shape[2], J.shape[2]))
    if problem.linear:
        wholes = on_lines(rule, problem.places, J, velocity, m)
    else:
        of_controls = np.zeros((N, m, x + m))
        of_controls[:, :, x:] = np.eye(m)
        wholes = [np.concatenate([D, of_controls], axis=1) for D in at_samples(rule, J, velocity)]
    for s, whole in enumerate(wholes):
        cost += h * rule[s, 0] * np.swapaxes(whole, 1, 2) @ of_samples(hessian, samples, s) @ whole
    kicked = after_impulse(rule, hessian, velocity, N, x, h)
    end = problem.expand_terminal(trajectory).hessian[0, n:x, n:x]
    beyond = beyond_samples(problem, trajectory, lin, hessian, samples, end)
    if beyond is not None:
        kicked = kicked + beyond
    return LinearizedSteps(J, lin.G[:, :, processes], gz[:, :, processes], cost, kicked, beyond, lin, velocity, hessian)


def _hessian(problem: OptimalControlProblem, steps: LinearizedSteps, W: Floats, k: int | slice) -> Floats:
    """Hessian in the step's variables of the cost from step k on, with the value function W after the step."""
    J, gz, x = steps.J[k], steps.gz[k], steps.J.shape[1]
    after = slice(-problem.scene.controls, None)
    across = W[..., :x, x:]
    spread = problem.dt * (W[..., :x, :x] + steps.kicked[k])
    Y = steps.cost[k] + np.swapaxes(J, -1, -2) @ W[..., :x, :x] @ J
    mixed = np.swapaxes(J, -1, -2) @ across
    Y[..., :, after] += mixed
    Y[..., after, :] += np.swapaxes(mixed, -1, -2)
    Y[..., after, after] += W[..., x:, x:]
    by_process = np.moveaxis(gz, -2, -3)
    added: Floats = (np.swapaxes(by_process, -1, -2) @ (spread[..., None, :, :] @ by_process)).sum(axis=-3)
    return Y + added


def _shares(problem: OptimalControlProblem, steps: LinearizedSteps, W: Floats, C: Floats) -> Floats:
    """Noise cost of each step (N,), from the values W after the steps and the covariances C before them."""
    x = steps.J.shape[1]
    spread = problem.dt * (W[1:, :x, :x] + steps.kicked)
    before = np.einsum("Nzy,Nzy->N", C[:-1], _hessian(problem, steps, W[1:], slice(None)))
    total: Floats = 0.5 * (before + np.einsum("Nak,Nab,Nbk->N", steps.g, spread, steps.g))
    return total


def _values(
    problem: OptimalControlProblem, steps: LinearizedSteps, feedback: Feedback, terminal: Floats, rate: Floats
) -> Floats:
    """Hessians of the value function at the nodes (N + 1, 2n + m, 2n + m) in (x, previous control)."""
    N, x, m = problem.steps, steps.J.shape[1], problem.scene.controls
    W = np.zeros((N + 1, x + m, x + m))
    W[N, :x, :x] = terminal
    for k in range(N - 1, -1, -1):
        Y = _hessian(problem, steps, W[k + 1], k)
        T = decided(problem, feedback, k, x)
        if T is not None:
            Y = T.T @ Y @ T
            if len(rate):
                change = T[-m:].copy()
                change[:, x:] -= np.eye(m)
                Y += change.T @ rate[k + 1 if problem.linear else k // problem.hold] @ change
        # Rounding errors that are not symmetric may grow from step to step.
        W[k] = 0.5 * (Y + Y.T)
    return W
