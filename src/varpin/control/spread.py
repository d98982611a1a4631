"""Covariance of the state and the control under feedback and the scene's noise, to first order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats
from varpin.control.problem import OptimalControlProblem
from varpin.linearization import linearize_steps, velocity_at_nodes
from varpin.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Feedback:
    """Gains (R, m, 2n) on the state, and (R, m, m) on the previous control where its change has a cost."""

    state: Floats
    before: Floats | None


def state_slopes(problem: OptimalControlProblem, motion: Trajectory) -> Floats:
    """d(q, v)/dx at the nodes (N + 1, 2n, 2n)."""
    n = problem.scene.robot.dof
    slopes = np.tile(np.eye(2 * n), (len(motion.q), 1, 1))
    if problem.integrator.variational:
        slopes[:, n:] = velocity_at_nodes(problem.scene, motion.q, motion.v)
    return slopes


def decision(feedback: Feedback, r: int, x: int, m: int) -> Floats:
    """The matrix from (x, previous control) to (x, u)."""
    T = np.zeros((x + m, x + m))
    T[:x, :x], T[x:, :x] = np.eye(x), feedback.state[r]
    if feedback.before is not None:
        T[x:, x:] = feedback.before[r]
    return T


def propagated(J: Floats, g: Floats, gz: Floats, problem: OptimalControlProblem, feedback: Feedback) -> Floats:
    """Covariances of (x, u) at the beginning of each step and at the end (N + 1, 2n + m, 2n + m).

    P' = T P T' + dt sum_i E[g_i g_i'] with each control held over its decision; :func:`varpin.propagate_moments` is the
    same without feedback. Control limits are neglected.

    Args:
        J: Derivatives of the steps in (x, u) (N, 2n, 2n + m).
        g: Derivatives in the noise (N, 2n, k).
        gz: Derivatives of g in (x, u) (N, 2n, k, 2n + m).
        problem: The problem.
        feedback: The gains.
    """
    N, x, m = len(J), J.shape[1], J.shape[2] - J.shape[1]
    C, covariance = np.zeros((N + 1, x + m, x + m)), np.zeros((x + m, x + m))
    for k in range(N):
        if k % problem.hold == 0:
            T = decision(feedback, k // problem.hold, x, m)
            covariance = T @ covariance @ T.T
        C[k] = covariance
        through = np.zeros((x + m, x + m))
        through[:x], through[x:, x:] = J[k], np.eye(m)
        covariance = through @ covariance @ through.T
        covariance[:x, :x] += problem.dt * (g[k] @ g[k].T + (gz[k] @ C[k]).reshape(x, -1) @ gz[k].reshape(x, -1).T)
    C[N] = covariance
    return C


def covariances(problem: OptimalControlProblem, motion: Trajectory, feedback: Feedback) -> Floats:
    """Covariances of the state at the nodes of a motion under feedback (N + 1, 2n, 2n), see :func:`propagated`."""
    lin = linearize_steps(problem.scene, motion, problem.integrator, problem.q0)
    J, gz = np.concatenate([lin.A, lin.B], axis=2), np.concatenate([lin.Gx, lin.Gu], axis=3)
    x = J.shape[1]
    return propagated(J, lin.G, gz, problem, feedback)[:, :x, :x]
