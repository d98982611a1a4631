"""Covariance of the state under a plan's feedback and the scene's noise, to first order."""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats
from varpin.control.problem import OptimalControlProblem
from varpin.control.solution import Solution
from varpin.linearization import linearize_steps, velocity_at_nodes
from varpin.trajectory import Trajectory


def state_slopes(problem: OptimalControlProblem, motion: Trajectory) -> Floats:
    """d(q, v)/dx at the nodes (N + 1, 2n, 2n)."""
    n = problem.scene.robot.dof
    slopes = np.tile(np.eye(2 * n), (len(motion.q), 1, 1))
    if problem.integrator.variational:
        slopes[:, n:] = velocity_at_nodes(problem.scene, motion.q, motion.v)
    return slopes


def covariances(problem: OptimalControlProblem, plan: Solution) -> Floats:
    """Covariances of the state at the nodes (N + 1, 2n, 2n).

    They are those of the linearization, P' = Ac P Ac' + dt sum_i E[g_i g_i'], with each control held over its decision;
    :func:`varpin.propagate_moments` is the same without feedback. Control limits are neglected.
    """
    motion, n, m = plan.trajectory, problem.scene.robot.dof, problem.scene.controls
    lin = linearize_steps(problem.scene, motion, problem.integrator, problem.q0)
    x = 2 * n
    # Covariance of the state and the held control.
    P, found = np.zeros((x + m, x + m)), np.zeros((problem.steps + 1, x, x))
    for j in range(problem.steps):
        if j % problem.hold == 0:
            k = j // problem.hold
            take = np.eye(x + m)
            take[x:, :x] = plan.gains[k]
            take[x:, x:] = 0.0 if plan.previous_gains is None else plan.previous_gains[k]
            P = take @ P @ take.T
        step = np.eye(x + m)
        step[:x, :x], step[:x, x:] = lin.A[j], lin.B[j]
        slope = np.concatenate([lin.Gx[j], lin.Gu[j]], axis=2)
        kick = np.einsum("aib,bc,dic->ad", slope, P, slope) + lin.G[j] @ lin.G[j].T
        P = step @ P @ step.T
        P[:x, :x] += lin.dt * kick
        found[j + 1] = P[:x, :x]
    return found
