"""What noise costs within the steps of a plan, beyond what the samples of a step see of a force held over it."""

from __future__ import annotations

import math

import numpy as np

from varpin.arrays import Floats
from varpin.control.linear_controls import after_impulse, of_samples
from varpin.control.problem import OptimalControlProblem
from varpin.errors import LinearizationError
from varpin.integrators.collocation import Collocation
from varpin.linearization import Linearization, velocity_at_nodes
from varpin.simulation.spectrum import damping_matrices
from varpin.trajectory import Trajectory

# Terms of the series for a short part of a step, and the decay over it up to which its error is a rounding error.
_TERMS, _SHORT = 11, 0.125


def beyond_samples(
    problem: OptimalControlProblem,
    motion: Trajectory,
    lin: Linearization,
    hessian: Floats,
    samples: int,
    end: Floats | None,
) -> Floats | None:
    """The Hessian (N, 2n, 2n), in the noise's jump of the state after a step, of what velocities cost within the step.

    It is added to that of the samples, :func:`after_impulse`, for the exact mean over the step of the cost of the
    velocity by white noise that begins with the step. Without the step's springs a momentum decays as exp(-Z s) over a
    unit step, see :func:`decay_of_momenta`. So an impulse f adds f' B f / 2, with B the integral of
    (1 - s) exp(-Z s)' l_pp exp(-Z s), and the jump after the step is J f. What the last step's noise leaves of the last
    velocity is more than that of a force held over the step, by :func:`left_at_end`. None where there is nothing to
    add: without noise or costs of velocities, for impulses, for sums over nodes (``sampling="start"``), and under
    constraints of the scene.

    Args:
        problem: The problem.
        motion: Nodes and controls of the steps.
        lin: The linearized steps.
        hessian: Hessians of the running cost at the samples of each step, first those of the problem's rule.
        samples: Number of samples of a step.
        end: Hessian of the terminal cost in the last velocity (n, n); None where the motion goes on.

    Raises:
        LinearizationError: Velocities grow without bound within a step.
    """
    n, h, rule, N = problem.scene.robot.dof, problem.dt, problem.rule, lin.steps
    speeds, held = slice(n, 2 * n), problem.integrator.holds_noise and problem.sampling != "start"
    costs = hessian[:, speeds, speeds].any() or (end is not None and end.any())
    if not (held and problem.scene.processes and costs) or problem.scene.constraints:
        return None
    of_speeds = np.zeros((N, len(rule), 2 * n, 2 * n))
    for s in range(len(rule)):
        of_speeds[:, s, speeds, speeds] = of_samples(hessian, samples, s)[:, speeds, speeds]
    velocity = velocity_at_nodes(problem.scene, motion.q, motion.v)
    found = -after_impulse(rule, of_speeds.reshape(-1, 2 * n, 2 * n), velocity, N, 2 * n, h)
    slope, to_impulse = velocity[:-1, :, n:], np.linalg.pinv(lin.J[:, n:])
    whole = np.einsum("s,Nsab->Nab", h * rule[:, 0], of_speeds[:, :, speeds, speeds])
    decay = decay_of_momenta(problem.dt, damping_at_nodes(problem, motion), velocity)
    # A step in which velocities grow without bound, as in a trial that runs away, has no mean.
    with np.errstate(over="ignore", invalid="ignore"):
        mean = mean_of_decay(decay, np.swapaxes(slope, 1, 2) @ whole @ slope)
        if end is not None:
            mean[-1] += left_at_end(problem, decay[-1], velocity[-1, :, n:].T @ end @ velocity[-1, :, n:])
        found[:, n:, n:] += np.swapaxes(to_impulse, 1, 2) @ mean @ to_impulse
    lost = ~np.isfinite(found).all(axis=(1, 2))
    if lost.any():
        step = int(lost.argmax())
        raise LinearizationError(step, step * h, "what noise adds to velocities grows without bound within the step")
    return found


def decay_of_momenta(dt: float, damping: tuple[Floats, Floats], velocity: Floats) -> Floats:
    """Z (N, n, n) of momenta that decay as exp(-Z s) over a unit step: h D M^-1 for the damping D, mean of both ends.

    The derivatives of a step do not tell Z: in motion they also contain the change of inertias.

    Args:
        dt: The time step h [s].
        damping: D (N, n, n) where steps begin and where they end.
        velocity: dv/dx (N + 1, n, 2n) at the nodes.
    """
    N, n, _ = damping[0].shape
    rates = [D @ velocity[end : N + end, :, n:] for end, D in enumerate(damping)]
    found: Floats = 0.5 * dt * (rates[0] + rates[1])
    return found


def damping_at_nodes(problem: OptimalControlProblem, motion: Trajectory) -> tuple[Floats, Floats]:
    """The damping (N, n, n) where steps begin and where they end, under their controls.

    Joints whose friction falls with the velocity count as undamped, custom forces with what they are.
    """
    scene = problem.scene
    forces = motion.u @ scene.actuation.T
    begin, end = (
        damping_matrices(scene, motion.q[part], motion.v[part], forces) for part in (slice(None, -1), slice(1, None))
    )
    if scene.custom is None:
        return begin, end
    own = np.array([-scene.custom(q, v, True)[2] for q, v in zip(motion.q, motion.v, strict=True)])
    return begin + own[:-1], end + own[1:]


def left_at_end(problem: OptimalControlProblem, Z: Floats, P: Floats) -> Floats:
    """The integral of E' P E over s from 0 to 1, E(s) = exp(-Z s), less H' P H for a held impulse's effect H (n, n).

    Zero for the midpoint rule, whose velocities have their exact covariance anyway once they have settled.
    """
    method = problem.integrator
    if not isinstance(method, Collocation) or method.stages == 1:
        return np.zeros(Z.shape)
    H = method.after_held(Z)
    late, early = _means_of_decay(Z[None], P[None])
    found: Floats = late[0] + early[0] - H.T @ P @ H
    return found


def mean_of_decay(Z: Floats, H: Floats) -> Floats:
    """The integral of (1 - s) exp(-Z s)' H exp(-Z s) over s from 0 to 1, for matrices (N, n, n)."""
    return _means_of_decay(Z, H)[0]


def _means_of_decay(Z: Floats, H: Floats) -> tuple[Floats, Floats]:
    """The integrals of (1 - s) and of s times exp(-Z s)' H exp(-Z s)."""
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
