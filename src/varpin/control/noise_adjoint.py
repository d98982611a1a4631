"""The exact gradient of the noise cost in the motion, where steps have second derivatives.

The shares of (O12) are functions of the linearized step, of the velocities' derivatives at its nodes and of the costs'
Hessians. The derivatives of the shares in these matrices come first, by hand. One contraction of the second derivatives
of each step with such a matrix then gives the gradient in the step's variables, without a third-order tensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.control.linear_controls import at_samples, of_samples
from varpin.control.problem import OptimalControlProblem
from varpin.control.within_steps import (
    damping_at_nodes,
    decay_of_momenta,
    left_at_end,
    left_at_end_slopes,
    mean_of_decay,
    mean_of_decay_slopes,
)
from varpin.integrators.variational import Variational
from varpin.linearization import Linearization, velocity_at_nodes, velocity_curvature
from varpin.mechanics.forces import limited_servos
from varpin.trajectory import Trajectory

# Step of the central differences of costs' Hessians, relative to the largest value of each variable.
_SHIFT = 1e-5


@dataclass(frozen=True, eq=False)
class LinearizedSteps:
    """N linearized steps in their Z variables, (x, u) or (x, w, u), with their costs to second order."""

    J: Floats  # (N, 2n, Z)
    g: Floats  # (N, 2n, k) derivative in the noise
    gz: Floats  # (N, 2n, k, Z) its derivative in the variables
    cost: Floats  # (N, Z, Z) Hessian of the running cost
    kicked: Floats  # (N, 2n, 2n) Hessian of the part after the noise impulse, in the state there
    beyond: Floats | None  # (N, 2n, 2n) what no sample of it sees
    lin: Linearization
    velocity: Floats  # dv/dx (N + 1, n, 2n) at the nodes, or (0, n, 2n) where no running cost needs it
    hessian: Floats  # of the running cost at its samples in (q, v, u), or one for all


def is_exact(problem: OptimalControlProblem) -> bool:
    """Whether :func:`slopes` is there: for variational steps with second derivatives and constant controls.

    It takes the effect of held noise for that of a control's force, which a drive's limit tells apart.
    """
    scene, integrator = problem.scene, problem.integrator
    smooth = scene.custom is None and not scene.constraints and not scene.inputs and scene.noise.diffusion is not None
    told_apart = integrator.holds_noise and bool(limited_servos(scene.elements))
    smooth = smooth and not told_apart
    return isinstance(integrator, Variational) and integrator.left == 1.0 and smooth and not problem.linear


def exact_gradient(
    problem: OptimalControlProblem,
    trajectory: Trajectory,
    around: LinearizedSteps,
    values: Floats,
    covariances: Floats,
    processes: NDArray[np.bool_],
) -> Floats:
    """The gradient (N, 2n + m) of the noise cost in (x, u) of each step, but through the strength of the noise.

    Args:
        problem: The problem.
        trajectory: The motion.
        around: Its linearized steps, with the processes that count.
        values: Hessians of the value function (N + 1, 2n + m, 2n + m) in (x, previous control).
        covariances: Those of (x, u) before each step, and of the state at the end (N + 1, 2n + m, 2n + m).
        processes: Mask of the processes that count (k,).
    """
    scene, integrator, h, x = problem.scene, problem.integrator, problem.dt, around.J.shape[1]
    assert isinstance(integrator, Variational)
    n, N = x // 2, problem.steps
    J, C, W, velocity = around.J, covariances[:-1], values[1:], around.velocity
    if not len(velocity):
        velocity = velocity_at_nodes(scene, trajectory.q, trajectory.v)
    S = h * (W[:, :x, :x] + around.kicked)
    moved = np.einsum("Nakz,Nzy->Naky", around.gz, C)
    of_noise = np.einsum("Nak,Nbk->Nab", around.g, around.g) + np.einsum("Naky,Nbky->Nab", moved, around.gz)
    # Derivatives in J, in the effect of an impulse, and in dv/dx at the nodes.
    to_step = W[:, :x, :x] @ J @ C + W[:, :x, x:] @ C[:, x:]
    impulse = around.lin.J
    fields = scene.noise.fields(trajectory.q[:-1], trajectory.v[:-1], trajectory.u, problem.q0)
    F = fields.F[:, :, processes]
    Fz = np.zeros((*F.shape, J.shape[2]))
    Fz[..., :n], Fz[..., x:] = fields.Fq[:, :, processes], fields.Fu[:, :, processes]
    of_force = np.einsum("Nak,Nbk->Nab", F, F) + np.einsum("Nakz,Nzy,Nbky->Nab", Fz, C, Fz, optimize=True)
    to_impulse = S @ impulse @ of_force
    to_nodes = np.zeros((N + 1, n, x))
    samples, rule = len(problem.rule), problem.rule
    weights = np.zeros((N, samples, J.shape[2], J.shape[2]))
    of_u = np.zeros((N, J.shape[2] - x, J.shape[2]))
    of_u[:, :, x:] = np.eye(J.shape[2] - x)
    for s, D in enumerate(at_samples(rule, J, velocity)):
        whole, part = np.concatenate([D, of_u], axis=1), h * rule[s, 0]
        spread = whole @ C
        weights[:, s] = 0.5 * part * spread @ np.swapaxes(whole, 1, 2)
        pull = part * (of_samples(around.hessian, samples, s) @ spread)[:, :x]
        for half in range(2):
            _, at_begin, after_q, after_v = rule[s, 1 + 4 * half : 5 + 4 * half]
            row = pull[:, half * n : (half + 1) * n]
            to_nodes[:-1] += at_begin * row[:, :, :x]
            to_step[:, :n] += after_q * row
            to_nodes[1:] += after_v * row @ np.swapaxes(J, 1, 2)
            to_step += after_v * np.swapaxes(velocity[1:], 1, 2) @ row
    to_kicked = 0.5 * h * of_noise
    late = rule.copy()
    late[:, [1, 2, 5, 6]] = 0.0
    for s, P in enumerate(at_samples(late, np.broadcast_to(np.eye(x), (N, x, x)), velocity)):
        part = h * rule[s, 0]
        seen = np.ones((x, x))
        if around.beyond is not None:
            seen[n:, n:] = 0.0
        spread = P @ to_kicked
        weights[:, s, :x, :x] += part * seen * (spread @ np.swapaxes(P, 1, 2))
        pull = 2.0 * part * (seen * of_samples(around.hessian, samples, s)[:, :x, :x]) @ spread
        for half in range(2):
            to_nodes[1:] += late[s, 4 + 4 * half] * pull[:, half * n : (half + 1) * n]
    to_last: Floats = np.zeros((n, n))
    if around.beyond is not None:
        pull = to_kicked[:, n:, n:]
        to_damping, to_last = _add_within(problem, trajectory, around, velocity, pull, to_impulse, to_nodes, weights)
    # In the state and the joint forces.
    bends = np.concatenate([to_step[:, :, :x], to_step[:, :, x:] @ scene.transmission.T], axis=2)
    if integrator.holds_noise:
        bends[:, :, x:] += to_impulse / h
    else:
        bends[:, :, n:x] += to_impulse
    moves = integrator.bend(scene, trajectory, bends)
    found = np.concatenate([moves[:, :x], moves[:, x:] @ scene.transmission], axis=1)
    # Second derivatives of the noise fields, in the configuration alone.
    to_field = np.zeros((N, n, scene.processes, n))
    to_field[:, :, processes] = np.einsum("Nac,Nakz->Nckz", S @ impulse, moved[..., :n], optimize=True)
    for c in range(n):
        found[:, :n] += scene.noise.curvature(np.ascontiguousarray(to_field[..., c]))[:, c]
    end = np.eye(x)
    end[n:] = velocity[-1]
    spread = end @ covariances[-1, :x, :x]
    to_nodes[-1] += problem.expand_terminal(trajectory).hessian[0, n:x, :x] @ spread
    at_nodes = _of_velocities(problem, trajectory, to_nodes)
    to_terminal = 0.5 * spread @ end.T
    to_terminal[n:, n:] += to_last
    at_end = _of_terminal_hessian(problem, trajectory, to_terminal)
    at_nodes[-1] += end.T @ at_end
    if around.beyond is not None:
        of_damping = _of_damping(problem, trajectory, to_damping)
        at_nodes += of_damping[:, :n] @ np.eye(n, x) + np.einsum("Nix,Ni->Nx", velocity, of_damping[:, n:])
    if len(around.hessian) > 1:
        in_nodes, in_controls = _of_hessians(problem, trajectory, weights)
        at_nodes += in_nodes[:, :n] @ np.eye(n, x) + np.einsum("Nix,Ni->Nx", velocity, in_nodes[:, n:])
        found[:, x:] += in_controls
    found[:, :x] += at_nodes[:-1]
    found[-1] += J[-1].T @ at_nodes[-1]
    return found


def _add_within(
    problem: OptimalControlProblem,
    trajectory: Trajectory,
    around: LinearizedSteps,
    velocity: Floats,
    pull: Floats,
    to_impulse: Floats,
    to_nodes: Floats,
    weights: Floats,
) -> tuple[list[Floats], Floats]:
    """Add derivatives through what velocities cost within the steps, ``pull`` (N, n, n) those in its Hessian.

    Returns those in the damping (N, n, n) where steps begin and where they end, and in the terminal cost's Hessian in
    the last velocity (n, n).
    """
    N, n, _ = pull.shape
    speeds, hw = slice(n, 2 * n), problem.dt * problem.rule[:, 0]
    whole = np.zeros((N, n, n))
    for s, part in enumerate(hw):
        whole += part * of_samples(around.hessian, len(hw), s)[:, speeds, speeds]
    slope, inverse = velocity[:-1, :, n:], np.linalg.pinv(around.lin.J[:, n:])
    dampings = damping_at_nodes(problem, trajectory)
    decay, sampled = decay_of_momenta(problem.dt, dampings, velocity), np.swapaxes(slope, 1, 2) @ whole @ slope
    end_slope, end_cost = velocity[-1, :, n:], problem.expand_terminal(trajectory).hessian[0, speeds, speeds]
    of_end = end_slope.T @ end_cost @ end_slope
    mean = mean_of_decay(decay, sampled)
    mean[-1] += left_at_end(problem, decay[-1], of_end)
    to_mean = inverse @ pull @ np.swapaxes(inverse, 1, 2)
    to_decay, to_sampled = mean_of_decay_slopes(decay, sampled, to_mean)
    of_last, to_end = left_at_end_slopes(problem, decay[-1], of_end, to_mean[-1])
    to_decay[-1] += of_last
    to_nodes[-1, :, n:] += 2.0 * end_cost @ end_slope @ to_end
    turned = np.swapaxes(inverse, 1, 2)
    to_impulse[:, n:] -= turned @ (2.0 * mean @ inverse @ pull) @ turned
    to_nodes[:-1, :, n:] += 2.0 * whole @ slope @ to_sampled
    seen = slope @ to_sampled @ np.swapaxes(slope, 1, 2)
    weights[:, :, speeds, speeds] += hw[:, None, None] * seen[:, None]
    part, to_damping = 0.5 * problem.dt, []
    for end, damping in enumerate(dampings):
        to_nodes[end : N + end, :, n:] += part * np.swapaxes(damping, 1, 2) @ to_decay
        to_damping.append(part * to_decay @ np.swapaxes(velocity[end : N + end, :, n:], 1, 2))
    return to_damping, end_slope @ to_end @ end_slope.T


def _of_damping(problem: OptimalControlProblem, trajectory: Trajectory, pulls: list[Floats]) -> Floats:
    """Derivatives (N + 1, 2n) in (q, v) at the nodes of sums of pull_ab D_ab, by central differences of the damping."""
    n, N = problem.scene.robot.dof, problem.steps
    found = np.zeros((N + 1, 2 * n))
    for half, name in enumerate(("q", "v")):
        values = getattr(trajectory, name)
        for c in range(n):
            step = _SHIFT * (float(np.abs(values[:, c]).max()) or 1.0)
            ends = []
            for sign in (1.0, -1.0):
                moved = values.copy()
                moved[:, c] += sign * step
                ends.append(damping_at_nodes(problem, replace(trajectory, **{name: moved})))
            for end, pull in enumerate(pulls):
                change = (ends[0][end] - ends[1][end]) / (2.0 * step)
                found[end : N + end, half * n + c] += (change * pull).sum(axis=(1, 2))
    return found


def _of_velocities(problem: OptimalControlProblem, trajectory: Trajectory, pull: Floats) -> Floats:
    """Derivatives (N + 1, 2n) in x at the nodes of sum pull_ab (dv/dx)_ab, for ``pull`` (N + 1, n, 2n)."""
    nodes, n, x = pull.shape
    q, v = np.repeat(trajectory.q, n, axis=0), np.repeat(trajectory.v, n, axis=0)
    second = velocity_curvature(problem.scene, q, v, np.tile(np.eye(n), (nodes, 1)))
    found: Floats = np.einsum("Ncax,Nca->Nx", second.reshape(nodes, n, x, x), pull, optimize=True)
    return found


def _of_hessians(problem: OptimalControlProblem, trajectory: Trajectory, weights: Floats) -> tuple[Floats, Floats]:
    """Derivatives of sum weight_ab H_ab over all samples, by central differences of the running cost's Hessian.

    In (q, v) at the nodes (N + 1, 2n), and in the controls (N, m).
    """
    N, n, m = problem.steps, problem.scene.robot.dof, problem.scene.controls
    in_nodes, in_controls = np.zeros((N + 1, 2 * n)), np.zeros((N, m))

    def change(name: str, rows: slice, c: int) -> Floats:
        values = getattr(trajectory, name)
        step = _SHIFT * (float(np.abs(values[:, c]).max()) or 1.0)
        ends = []
        for sign in (1.0, -1.0):
            moved = values.copy()
            moved[rows, c] += sign * step
            ends.append(problem.expand_running(replace(trajectory, **{name: moved})).hessian)
        by_step: Floats = ((ends[0] - ends[1]).reshape(weights.shape) * weights).sum(axis=(1, 2, 3))
        return by_step / (2.0 * step)

    for half, name in enumerate(("q", "v")):
        for c in range(n):
            # Every other node, as a step depends on both of its own.
            for first in range(2):
                steps = change(name, slice(first, None, 2), c)
                both = np.concatenate([[0.0], steps]) + np.concatenate([steps, [0.0]])
                in_nodes[first::2, half * n + c] = both[first::2]
    for c in range(m):
        in_controls[:, c] = change("u", slice(None), c)
    return in_nodes, in_controls


def _of_terminal_hessian(problem: OptimalControlProblem, trajectory: Trajectory, weight: Floats) -> Floats:
    """Derivatives (2n,) of sum weight_ab H_ab in (q, v) at the end, with H the terminal cost's Hessian there."""
    n, m = problem.scene.robot.dof, problem.scene.controls
    end = np.concatenate([trajectory.q[-1], trajectory.v[-1]])
    size = np.repeat([float(np.abs(a).max()) or 1.0 for a in (trajectory.q, trajectory.v)], n)
    moved = np.concatenate([end + _SHIFT * np.diag(size), end - _SHIFT * np.diag(size)])
    H = problem.terminal.expand(moved[:, :n], moved[:, n:], np.zeros((4 * n, m))).hessian[:, : 2 * n, : 2 * n]
    if len(H) == 1:
        return np.zeros(2 * n)
    values = (H * weight).sum(axis=(1, 2))
    found: Floats = (values[: 2 * n] - values[2 * n :]) / (2.0 * _SHIFT * size)
    return found
