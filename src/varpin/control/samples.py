"""What running costs see of a step: their samples, and what noise costs after its impulse and within the step."""

from __future__ import annotations

import math

import numpy as np

from varpin.arrays import Floats
from varpin.control.problem import OptimalControlProblem
from varpin.errors import LinearizationError
from varpin.integrators.collocation import Collocation
from varpin.linearization import Linearization
from varpin.simulation.spectrum import damping_matrices
from varpin.trajectory import Trajectory

# Terms of the series for a short part of a step, and the decay over it up to which its error is a rounding error.
_TERMS, _SHORT = 11, 0.125


def at_samples(rule: Floats, J: Floats, velocity: Floats) -> Floats:
    """Derivatives (N, s, 2n, Z) of (q, v) at each sample of N steps, from those J (N, 2n, Z) of the state after them.

    The variables begin with the state before the step. ``velocity`` is dv/dx (N + 1, n, 2n) at nodes.
    """
    N, x, Z = J.shape
    n = x // 2
    nodes = np.zeros((N, 4, n, Z))
    nodes[:, 0, :, :n] = np.eye(n)
    nodes[:, 1, :, :x] = velocity[:-1]
    nodes[:, 2] = J[:, :n]
    nodes[:, 3] = velocity[1:] @ J
    found: Floats = rule[:, 1:].reshape(-1, 4) @ nodes.reshape(N, 4, n * Z)
    return found.reshape(N, len(rule), x, Z)


def after_impulse(rule: Floats, hessian: Floats, velocity: Floats, dt: float) -> Floats:
    """Hessian (N, 2n, 2n) of each step's running cost in the state after its noise impulse.

    ``hessian`` (N, s, 2n, 2n) are those of the cost in (q, v) at the samples, ``velocity`` is as for
    :func:`at_samples`.
    """
    N, x = len(hessian), hessian.shape[-1]
    late = rule.copy()
    late[:, [1, 2, 5, 6]] = 0.0
    P = at_samples(late, np.broadcast_to(np.eye(x), (N, x, x)), velocity)
    found: Floats = dt * np.einsum("s,Nsab->Nab", rule[:, 0], np.swapaxes(P, 2, 3) @ hessian @ P)
    return found


def beyond_samples(
    problem: OptimalControlProblem,
    motion: Trajectory,
    lin: Linearization,
    hessian: Floats,
    velocity: Floats,
    terminal: Floats,
) -> Floats | None:
    """The Hessian (N, 2n, 2n), in the noise's jump of the state after a step, of what velocities cost within the step.

    It is added to that of the samples, :func:`after_impulse`, for the exact mean over the step of the cost of the
    velocity by white noise that begins with the step. Without the step's springs a momentum decays as exp(-Z s) over a
    unit step, with Z = h D M^-1 for the damping D, the mean of both ends: the derivatives of a step also contain the
    change of inertias. So an impulse f adds f' B f / 2, with B the integral of (1 - s) exp(-Z s)' l_pp exp(-Z s), and
    the jump after the step is J f. The last step's noise leaves more of the last velocity than a force held over the
    step, by :func:`_left_at_end`. None where there is nothing to add: without noise or costs of velocities, for
    impulses, for sums over nodes (``sampling="start"``), and under constraints of the scene.

    ``hessian`` (N, s, 2n, 2n) are those of the running cost in (q, v) at the samples, ``terminal`` (2n, 2n) that of the
    terminal cost. ``velocity`` is dv/dx (N + 1, n, 2n) at the nodes, in momenta.

    Raises:
        LinearizationError: Velocities grow without bound within a step.
    """
    n, h = problem.scene.robot.dof, problem.dt
    end = terminal[n:, n:]
    of_speeds = np.zeros(hessian.shape)
    of_speeds[..., n:, n:] = hessian[..., n:, n:]
    held = problem.integrator.holds_noise and problem.sampling != "start" and not problem.scene.constraints
    if not (held and problem.scene.processes and (of_speeds.any() or end.any())):
        return None
    found = -after_impulse(problem.rule, of_speeds, velocity, h)
    by_momenta, to_impulse = velocity[:, :, n:], np.linalg.pinv(lin.J[:, n:])
    whole = np.einsum("s,Nsab->Nab", h * problem.rule[:, 0], hessian[..., n:, n:])
    # The damping where steps begin and where they end; friction that falls with velocity is left out.
    forces = motion.u @ problem.scene.actuation.T
    begin, after = (
        damping_matrices(problem.scene, motion.q[part], motion.v[part], forces, custom=True) @ by_momenta[part]
        for part in (slice(None, -1), slice(1, None))
    )
    decay = 0.5 * h * (begin + after)
    # A step in which velocities grow without bound, as in a trial that runs away, has no mean.
    with np.errstate(over="ignore", invalid="ignore"):
        mean = means_of_decay(decay, np.swapaxes(by_momenta[:-1], 1, 2) @ whole @ by_momenta[:-1])[0]
        mean[-1] += _left_at_end(problem, decay[-1], by_momenta[-1].T @ end @ by_momenta[-1])
        found[:, n:, n:] += np.swapaxes(to_impulse, 1, 2) @ mean @ to_impulse
    lost = ~np.isfinite(found).all(axis=(1, 2))
    if lost.any():
        step = int(lost.argmax())
        raise LinearizationError(step, step * h, "what noise adds to velocities grows without bound within the step")
    return found


def _left_at_end(problem: OptimalControlProblem, Z: Floats, P: Floats) -> Floats:
    """The integral of E' P E over s from 0 to 1, E(s) = exp(-Z s), less H' P H for a held impulse's effect H (n, n).

    Zero for the midpoint rule, whose velocities have their exact covariance anyway once they have settled.
    """
    method = problem.integrator
    if not isinstance(method, Collocation) or method.stages == 1:
        return np.zeros(Z.shape)
    H = method.after_held(Z)
    late, early = means_of_decay(Z[None], P[None])
    found: Floats = late[0] + early[0] - H.T @ P @ H
    return found


def means_of_decay(Z: Floats, H: Floats) -> tuple[Floats, Floats]:
    """The integrals of (1 - s) and of s times exp(-Z s)' H exp(-Z s) over s from 0 to 1, for matrices (N, n, n)."""
    size = float(np.linalg.norm(Z, axis=(1, 2)).max())
    doublings = max(0, math.ceil(math.log2(size / _SHORT))) if size > 0.0 else 0
    part = 0.5**doublings
    flow = np.broadcast_to(np.eye(Z.shape[1]), Z.shape)
    term, power, scale = H, flow, part
    total, first = np.zeros(H.shape), np.zeros(H.shape)
    for k in range(_TERMS):
        # H, and its derivatives in time under the decay.
        total, first = total + scale * term, first + scale * part * (k + 1) / (k + 2) * term
        power = power @ Z * (-part / (k + 1))
        flow, turned = flow + power, term @ Z
        term, scale = -(turned + np.swapaxes(turned, 1, 2)), scale * part / (k + 2)
    for _ in range(doublings):
        later = np.swapaxes(flow, 1, 2)
        total, first = total + later @ total @ flow, first + later @ (first + part * total) @ flow
        flow, part = flow @ flow, 2.0 * part
    return total - first, first
