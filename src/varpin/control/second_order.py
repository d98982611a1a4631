"""Second derivatives of the steps in the cost to go."""

from __future__ import annotations

import numpy as np

from varpin.arrays import Floats
from varpin.control.along import Along, linearize
from varpin.control.linear_controls import curvature_on_lines, in_step
from varpin.control.passes import Plan, impulses
from varpin.linearization import second_order_steps, velocity_at_nodes, velocity_curvature


def curvature_along(along: Along, costate: Floats, plan: Plan | None = None) -> Floats:
    """Second-derivative terms of the steps in the cost to go (N, Z, Z), in (x, u), or (x, w, u) of linear controls.

    Args:
        along: The motion.
        costate: Derivatives of the cost to go in the state after each step (N, 2n).
        plan: A pass along the motion, whose noise has such terms, too; without noise None.
    """
    problem, trajectory = along.problem, along.trajectory
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
    if problem.linear:
        total = curvature_on_lines(problem, trajectory, z, second.xx)
    else:
        total = np.block([[second.xx, np.swapaxes(second.ux, 1, 2)], [second.ux, second.uu]])
    if rule[:, [2, 6]].any():
        total[:, : 2 * n, : 2 * n] += velocity_curvature(scene, trajectory.q[:-1], trajectory.v[:-1], pulls[1])
    if after:
        J, _ = in_step(linearize(problem, trajectory, 0))
        total += np.swapaxes(J, 1, 2) @ velocity_curvature(scene, trajectory.q[1:], trajectory.v[1:], pulls[3]) @ J
    if plan is not None and problem.processes and problem.integrator.variational:
        pull = plan.spread @ impulses(problem, trajectory, plan.jumps)
        weight = problem.integrator.left * np.swapaxes(plan.jumps, 1, 2) @ pull
        total[:, :n, :n] += scene.noise.curvature(weight[:, :, : scene.processes])
    return total
