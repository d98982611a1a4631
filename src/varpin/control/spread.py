"""Covariance of the state and the control under feedback and the scene's noise, to first order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats
from varpin.control.constraints import BoundConstraint
from varpin.control.linear_controls import in_step
from varpin.control.problem import OptimalControlProblem
from varpin.linearization import Linearization, linearize_steps, velocity_at_nodes
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


def decided(problem: OptimalControlProblem, feedback: Feedback, k: int, x: int) -> Floats | None:
    """The matrix from (x, previous control) at node k to the variables of the step from it; None within a decision.

    These are (x, u), or (x, w, u) of linear controls, with w the previous control.
    """
    m, lines = problem.scene.controls, problem.linear
    if k % problem.hold:
        return None
    r = k + 1 if lines else k // problem.hold
    T = np.zeros((x + 2 * m if lines else x + m, x + m))
    T[:x, :x] = np.eye(x)
    if lines:
        T[x : x + m, x:] = np.eye(m)
    T[-m:, :x] = feedback.state[r]
    if feedback.before is not None:
        T[-m:, x:] = feedback.before[r]
    return T


def added_covariance(g: Floats, gz: Floats, C: Floats) -> Floats:
    """What the noise of a step adds to the covariance (2n, 2n) of the state, over dt.

    ``g`` (2n, k) and ``gz`` (2n, k, Z) are those of the step, ``C`` (Z, Z) the covariance of its variables.
    """
    x = len(g)
    found: Floats = g @ g.T + (gz @ C).reshape(x, -1) @ gz.reshape(x, -1).T
    return found


def propagated(J: Floats, g: Floats, gz: Floats, problem: OptimalControlProblem, feedback: Feedback) -> Floats:
    """Covariances (N + 1, Z, Z) of the variables of each step, and that of the state at the end.

    P' = T P T' + dt sum_i E[g_i g_i'] with each control held over its decision; :func:`varpin.propagate_moments` is the
    same without feedback. Control limits are neglected.

    Args:
        J: Derivatives of the steps in their Z variables (N, 2n, Z): (x, u), or (x, w, u) of linear controls.
        g: Derivatives in the noise (N, 2n, k).
        gz: Derivatives of g in the variables (N, 2n, k, Z).
        problem: The problem.
        feedback: The gains.
    """
    N, x, Z = J.shape
    m = problem.scene.controls
    C, covariance = np.zeros((N + 1, Z, Z)), np.zeros((x + m, x + m))
    through = np.zeros((x + m, Z))
    through[x:, Z - m :] = np.eye(m)
    for k in range(N):
        T = decided(problem, feedback, k, x)
        C[k] = covariance if T is None else T @ covariance @ T.T
        through[:x] = J[k]
        covariance = through @ C[k] @ through.T
        covariance[:x, :x] += problem.dt * added_covariance(g[k], gz[k], C[k])
    C[N, :x, :x] = covariance[:x, :x]
    return C


def covariances(
    problem: OptimalControlProblem, motion: Trajectory, feedback: Feedback, lin: Linearization | None = None
) -> Floats:
    """Covariances of the state at the nodes of a motion under feedback (N + 1, 2n, 2n), see :func:`propagated`.

    ``lin`` are its linearized steps, if they are known.
    """
    if lin is None:
        lin = linearize_steps(problem.scene, motion, problem.integrator, problem.q0, ramps=problem.linear)
    (J, gz), x = in_step(lin), lin.A.shape[1]
    return propagated(J, lin.G, gz, problem, feedback)[:, :x, :x]


def deviations(
    problem: OptimalControlProblem,
    motion: Trajectory,
    feedback: Feedback,
    bounds: Sequence[BoundConstraint],
    lin: Linearization | None = None,
) -> list[Floats]:
    """Standard deviations (K, rows) of state constraints about a motion under feedback and the scene's noise."""
    found, slopes = covariances(problem, motion, feedback, lin), state_slopes(problem, motion)
    return [
        of_values(bound.jacobian(motion.q, motion.v) @ slopes[bound.places], found[bound.places]) for bound in bounds
    ]


def of_values(J: Floats, covariance: Floats) -> Floats:
    """Standard deviations (K, rows) of values with derivatives J (K, rows, 2n), by covariances of x (K, 2n, 2n)."""
    variance = np.einsum("krx,kxy,kry->kr", J, covariance, J)
    spread: Floats = np.sqrt(np.maximum(variance, 0.0))
    return spread
