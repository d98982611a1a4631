"""Steps with controls that are linear between nodes, for the backward pass: the control is part of the state.

The state of the recursion is X = (x, w), with w the control at the node, and the decision is the control u at the next
node: X' = (A x + (B - ramp) w + ramp u, u). The first control is a separate decision before the first step. Equation
(O4) of docs/mathematics.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.control.costs import Expansion
from varpin.control.problem import OptimalControlProblem
from varpin.linearization import Linearization, linearize_steps, node_jets
from varpin.mechanics.scene import quiet
from varpin.signals.inputs import with_ends
from varpin.trajectory import Trajectory

# The sampling rule of a cost in (X, u) at the beginning of the step.
RULE: Floats = np.array([[1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
RULE.setflags(write=False)

# Changes of velocities [rad/s or m/s] between the points of differences in controls.
_SHIFT = 1e-4


class Derivatives(NamedTuple):
    """Derivatives of N steps in the state and in the controls at both ends, and of velocities at the nodes."""

    A: Floats  # (N, 2n, 2n)
    begin: Floats  # (N, 2n, m)
    end: Floats  # (N, 2n, m)
    velocity: Floats  # dv/dx (N + 1, n, 2n) at nodes; (0, n, 2n) where x holds v or no cost needs it
    G: Floats  # (N, 2n, k) in the noise
    Gz: Floats  # (N, 2n, k, 2n + 2m) of G in (x, w, u)


class LinearSteps(NamedTuple):
    """N + 1 steps in X and u: the first only sets the first control, and takes no time."""

    A: Floats  # (N + 1, X, X)
    B: Floats  # (N + 1, X, m)
    gradient: Floats  # (N + 1, X + m) of the cost per dt
    hessian: Floats  # (N + 1, X + m, X + m)
    G: Floats  # (N + 1, X, k)
    Gx: Floats  # (N + 1, X, k, X)
    Gu: Floats  # (N + 1, X, k, m)
    kicked: Floats  # (N, 2n, 2n) Hessian of the cost in the state after the noise impulse; (0, 2n, 2n) without noise


def in_step(lin: Linearization) -> tuple[Floats, Floats]:
    """Derivatives (N, 2n, Z) of linearized steps in their variables, and those of the noise's effect (N, 2n, k, Z).

    The variables are (x, u), or (x, w, u) of steps with ramps.
    """
    if lin.ramp is None or lin.Gramp is None:
        return np.concatenate([lin.A, lin.B], axis=2), np.concatenate([lin.Gx, lin.Gu], axis=3)
    J = np.concatenate([lin.A, lin.B - lin.ramp, lin.ramp], axis=2)
    return J, np.concatenate([lin.Gx, lin.Gu - lin.Gramp, lin.Gramp], axis=3)


def shifted_lines(problem: OptimalControlProblem, trajectory: Trajectory, du: Floats) -> Trajectory:
    """A motion whose steps have controls changed by ``du`` (N, 2m) at their ends, nodes as they are.

    The controls recorded at a node are those of all changes there; they fit steps whose neighbours do not change.
    """
    m, nodes = problem.scene.controls, trajectory.u_nodes.copy()
    begins, ends = nodes[:-1] + du[:, :m], nodes[1:] + du[:, m:]
    nodes[:-1] += du[:, :m]
    nodes[1:] += du[:, m:]
    share = np.array(problem.integrator.stage_times).reshape(-1, 1)
    stages = (1.0 - share) * begins[:, None] + share * ends[:, None]
    mean, stages = (with_ends(problem.scene, values, ends) for values in (0.5 * (begins + ends), stages))
    return replace(trajectory, u=mean, u_nodes=nodes, u_stages=stages)


def derivatives(lin: Linearization, velocity: Floats) -> Derivatives:
    """The derivatives of steps linearized with their ramps."""
    assert lin.ramp is not None
    return Derivatives(lin.A, lin.B - lin.ramp, lin.ramp, velocity, lin.G, in_step(lin)[1])


def size(problem: OptimalControlProblem) -> int:
    """The number of states X, made even for the core by a zero state if necessary."""
    states = 2 * problem.scene.robot.dof + problem.scene.controls
    return states + states % 2


def sample_slopes(problem: OptimalControlProblem, found: Derivatives) -> list[Floats]:
    """Derivatives (N, 2n + m, 2n + 2m) of (q, v, u) in (x, w, u), for each sample of the model in a step."""
    after = np.concatenate([found.A, found.begin, found.end], axis=2)
    return on_lines(problem.rule, problem.places, after, found.velocity, problem.scene.controls)


def linear_steps(
    problem: OptimalControlProblem,
    found: Derivatives,
    sampled: list[Floats],
    running: Expansion,
    rate: Floats,
    pull: Floats,
) -> LinearSteps:
    """The steps of a plan with linear controls, (O4).

    Args:
        problem: The problem.
        found: Derivatives along the motion.
        sampled: :func:`sample_slopes`.
        running: Expansion of the running cost at its samples.
        rate: Hessian of the cost of control changes (N + 1, m, m), or (0, m, m) without one.
        pull: Its gradient (N + 1, m).
    """
    n, m, h, N = problem.scene.robot.dof, problem.scene.controls, problem.dt, problem.steps
    X, x = size(problem), 2 * n
    A, B = np.zeros((N + 1, X, X)), np.zeros((N + 1, X, m))
    A[0, :x, :x] = np.eye(x)
    A[1:, :x, :x], A[1:, :x, x : x + m], B[1:, :x] = found.A, found.begin, found.end
    B[:, x : x + m] = np.eye(m)
    # In (x, w, u); X may have a zero state between w and u.
    g, H = np.zeros((N + 1, x + 2 * m)), np.zeros((N + 1, x + 2 * m, x + 2 * m))
    samples = len(sampled)
    for s, (D, weight) in enumerate(zip(sampled, problem.rule[:, 0], strict=True)):
        across = weight * np.swapaxes(D, 1, 2)
        g[1:] += (across @ running.gradient[s::samples, :, None])[:, :, 0]
        H[1:] += across @ (of_samples(running.hessian, samples, s) @ D)
    if len(rate):
        change = np.concatenate([np.zeros((m, x)), -np.eye(m), np.eye(m)], axis=1)
        change = np.stack([np.where(np.arange(x + 2 * m) < x + m, 0.0, change), *[change] * N])
        across = np.swapaxes(change, 1, 2) / h
        g += (across @ pull[:, :, None])[:, :, 0]
        H += across @ (rate @ change)
    begin = problem.begin
    if begin is not None:
        # A given first control is no decision: it changes nothing and has its own minimum.
        given = np.flatnonzero(~np.isnan(begin))
        B[0][:, given], g[0, x + m + given], H[0][:, x + m + given], H[0][x + m + given] = 0.0, 0.0, 0.0, 0.0
        H[0, x + m + given, x + m + given] = 1.0
    kept = np.r_[0 : x + m, X : X + m]
    wide_g, wide_H = np.zeros((N + 1, X + m)), np.zeros((N + 1, X + m, X + m))
    wide_g[:, kept] = g
    wide_H[:, kept[:, None], kept] = H
    noiseless = np.zeros((N + 1, X, 0)), np.zeros((N + 1, X, 0, X)), np.zeros((N + 1, X, 0, m)), np.zeros((0, x, x))
    return LinearSteps(A, B, wide_g, wide_H, *noiseless)


def noisy(steps: LinearSteps, found: Derivatives, kicked: Floats) -> LinearSteps:
    """The steps with noise, with its effect on the costs that :func:`after_impulse` expands in ``kicked``."""
    N, X, m = steps.B.shape
    x, k = found.G.shape[1:]
    G, Gx, Gu = np.zeros((N, X, k)), np.zeros((N, X, k, X)), np.zeros((N, X, k, m))
    G[1:, :x], Gx[1:, :x, :, : x + m], Gu[1:, :x] = found.G, found.Gz[..., : x + m], found.Gz[..., x + m :]
    weighted = np.einsum("Nab,Nbkz->Nakz", kicked, found.Gz)
    kept = np.r_[0 : x + m, X : X + m]
    gradient, hessian = steps.gradient.copy(), steps.hessian.copy()
    gradient[1:, kept] += np.einsum("Nakz,Nak->Nz", weighted, found.G)
    hessian[1:, kept[:, None], kept] += np.einsum("Nakz,Naky->Nzy", found.Gz, weighted)
    return steps._replace(gradient=gradient, hessian=hessian, G=G, Gx=Gx, Gu=Gu, kicked=kicked)


def curvature_on_lines(problem: OptimalControlProblem, trajectory: Trajectory, z: Floats, in_state: Floats) -> Floats:
    """Second derivatives (N, 2n + 2m, 2n + 2m) of z . x' of each step in (x, w, u), for z (N, 2n).

    Those ``in_state`` (N, 2n, 2n) are given. Those in controls are central differences of first derivatives, whose
    points change the fastest joint's velocity by _SHIFT.
    """
    scene, n, m, h = quiet(problem.scene), problem.scene.robot.dof, problem.scene.controls, problem.dt
    N, x = len(z), 2 * n
    found = np.zeros((N, x + 2 * m, x + 2 * m))
    found[:, :x, :x] = in_state
    M, _ = node_jets(scene, trajectory.q[:-1], trajectory.v[:-1])
    speeds = np.abs(h * np.linalg.solve(M, np.broadcast_to(scene.actuation, (N, n, m)))).max(axis=1)
    shift = _SHIFT / np.where(speeds > 0.0, speeds, 1.0)
    # Positions, and velocities of cubics.
    shift[:, scene.prescribed] = _SHIFT
    for c in range(2 * m):
        du = np.zeros((N, 2 * m))
        du[:, c] = shift[:, c % m]
        pulls = []
        for sign in (1.0, -1.0):
            near = shifted_lines(problem, trajectory, sign * du)
            J, _ = in_step(linearize_steps(scene, near, problem.integrator, problem.q0, ramps=True))
            pulls.append(np.einsum("Na,Naz->Nz", z, J))
        found[:, :, x + c] = (pulls[0] - pulls[1]) / (2.0 * shift[:, c % m, None])
    found[:, x:, :x] = np.swapaxes(found[:, :x, x:], 1, 2)
    found[:, x:, x:] = 0.5 * (found[:, x:, x:] + np.swapaxes(found[:, x:, x:], 1, 2))
    return found


def widened(curvature: Floats, m: int) -> Floats:
    """Hessians (N, 2n + 2m, 2n + 2m) in (x, w, u) as those of N + 1 steps in (X, u)."""
    N, Z, _ = curvature.shape
    x = Z - 2 * m
    X = x + m + m % 2
    kept = np.r_[0 : x + m, X : X + m]
    wide = np.zeros((N + 1, X + m, X + m))
    wide[1:, kept[:, None], kept] = curvature
    return wide


def of_samples(hessian: Floats, samples: int, s: int) -> Floats:
    """The Hessians (N, 2n + m, 2n + m), or (1, 2n + m, 2n + m), of the s-th sample in each step."""
    return hessian[s::samples] if len(hessian) > 1 else hessian


def after_impulse(rule: Floats, hessian: Floats, velocity: Floats, N: int, x: int, dt: float) -> Floats:
    """Hessian (N, 2n, 2n) of each step's running cost in the state after its noise impulse.

    ``hessian`` and ``velocity`` are as for :func:`linear_steps` and :func:`at_samples`.
    """
    after, found = np.broadcast_to(np.eye(x), (N, x, x)), np.zeros((N, x, x))
    late = rule.copy()
    late[:, [1, 2, 5, 6]] = 0.0
    if not late[:, 1:].any():
        return found
    for s, P in enumerate(at_samples(late, after, velocity)):
        if late[s, 1:].any():
            H = of_samples(hessian, len(rule), s)[:, :x, :x]
            found += dt * rule[s, 0] * np.swapaxes(P, 1, 2) @ H @ P
    return found


def on_lines(rule: Floats, places: Floats, J: Floats, velocity: Floats, m: int, *, ramps: bool = True) -> list[Floats]:
    """Derivatives (N, 2n + m, Z) of (q, v, u) in (x, w, u), or without ``ramps`` in (x, u), for each sample of a step.

    ``J`` (N, 2n, Z) are those of the state after the step; see :func:`at_samples`.
    """
    x = J.shape[1]
    parts = []
    for D, share in zip(at_samples(rule, J, velocity), places, strict=True):
        of_controls = np.zeros((len(D), m, J.shape[2]))
        of_controls[:, :, x : x + m] = (1.0 - share if ramps else 1.0) * np.eye(m)
        if ramps:
            of_controls[:, :, x + m :] = share * np.eye(m)
        parts.append(np.concatenate([D, of_controls], axis=1))
    return parts


def at_samples(rule: Floats, J: Floats, velocity: Floats) -> list[Floats]:
    """Derivatives (N, 2n, y) of (q, v) at each sample of N steps, in the y variables of J (N, 2n, y), the state first.

    ``velocity`` is dv/dx (N + 1, n, 2n) at nodes, or (0, n, 2n) where x holds v or no cost needs it.
    """
    N, x, size = J.shape
    n = x // 2
    before = np.zeros((N, x, size))
    before[:, :, :x] = np.eye(x)
    # Derivatives of (q, v) at the nodes before and after a step.
    nodes = []
    for end, slopes in enumerate((before, J)):
        nodes += [slopes[:, :n], velocity[end : N + end] @ slopes if len(velocity) else slopes[:, n:]]
    parts = []
    for row in rule:
        D = np.zeros((N, x, size))
        for half in range(2):
            for weight, node in zip(row[1 + 4 * half : 5 + 4 * half], nodes, strict=True):
                if weight:
                    D[:, half * n : (half + 1) * n] += weight * node
        parts.append(D)
    return parts
