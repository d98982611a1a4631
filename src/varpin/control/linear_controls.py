"""Steps with controls that are linear between nodes, for the backward pass: the control is part of the state.

The state of the recursion is X = (x, w), with w the control at the node, and the decision is the control u at the next
node: X' = (A x + (B - ramp) w + ramp u, u). The first control is a separate decision before the first step. Equation
(O11) of docs/mathematics.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.control.problem import OptimalControlProblem

# The sampling rule of a cost in (X, u) at the beginning of the step.
RULE: Floats = np.array([[1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
RULE.setflags(write=False)


class Derivatives(NamedTuple):
    """Derivatives of N steps in the state and in the controls at both ends, and of velocities at the nodes."""

    A: Floats  # (N, 2n, 2n)
    begin: Floats  # (N, 2n, m)
    end: Floats  # (N, 2n, m)
    velocity: Floats  # dv/dx (N + 1, n, 2n) at nodes; (0, n, 2n) where x holds v or no cost needs it


class LinearSteps(NamedTuple):
    """N + 1 steps in X and u: the first only sets the first control, and takes no time."""

    A: Floats  # (N + 1, X, X)
    B: Floats  # (N + 1, X, m)
    gradient: Floats  # (N + 1, X + m) of the cost per dt
    hessian: Floats  # (N + 1, X + m, X + m)


def size(problem: OptimalControlProblem) -> int:
    """The number of states X, made even for the core by a zero state if necessary."""
    states = 2 * problem.scene.robot.dof + problem.scene.controls
    return states + states % 2


def linear_steps(
    problem: OptimalControlProblem, found: Derivatives, gradient: Floats, hessian: Floats, rate: Floats, pull: Floats
) -> LinearSteps:
    """The steps of a plan with linear controls, (O11).

    Args:
        problem: The problem.
        found: Derivatives along the motion.
        gradient: Gradient of the running cost at its samples (N s, 2n + m).
        hessian: Its Hessian (N s, 2n + m, 2n + m), or (1, 2n + m, 2n + m) for all samples.
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
    samples = len(problem.model_rule)
    of_sample = hessian.reshape(-1, samples, x + m, x + m) if len(hessian) > 1 else hessian[:, None]
    for s, (D, weight) in enumerate(zip(_sampled(problem, found), problem.model_rule[:, 0], strict=True)):
        curvature = of_sample[:, s if of_sample.shape[1] > 1 else 0]
        across = weight * np.swapaxes(D, 1, 2)
        g[1:] += (across @ gradient[s::samples, :, None])[:, :, 0]
        H[1:] += across @ (curvature @ D)
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
    return LinearSteps(A, B, wide_g, wide_H)


def _sampled(problem: OptimalControlProblem, found: Derivatives) -> list[Floats]:
    """Derivatives (N, 2n + m, 2n + 2m) of (q, v, u) in (x, w, u), for each sample of a step."""
    m, x = problem.scene.controls, 2 * problem.scene.robot.dof
    after = np.concatenate([found.A, found.begin, found.end], axis=2)
    parts = []
    for D, share in zip(at_samples(problem.model_rule, after, found.velocity), problem.model_places, strict=True):
        of_controls = np.zeros((len(D), m, x + 2 * m))
        of_controls[:, :, x : x + m], of_controls[:, :, x + m :] = (1.0 - share) * np.eye(m), share * np.eye(m)
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
