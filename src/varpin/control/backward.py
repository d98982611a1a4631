"""The backward pass of a search: with penalties that become active, and second derivatives where they are asked for."""

from __future__ import annotations

from copy import copy

import numpy as np

from varpin.arrays import Floats, Mask
from varpin.control.along import Along, linearize
from varpin.control.linear_controls import curvature_on_lines, in_step, widened
from varpin.control.passes import Plan, impulses, single_pass
from varpin.control.piecewise import minimum
from varpin.control.problem import OptimalControlProblem
from varpin.linearization import second_order_steps, velocity_at_nodes, velocity_curvature
from varpin.trajectory import Trajectory


def _curvature(along: Along, plan: Plan, costate: Floats) -> Floats:
    """Second-derivative terms of dynamics and noise fields in the cost to go (N, 2n + m, 2n + m), in (x, u).

    With linear controls they are those of N + 1 steps in (X, u).
    """
    problem, trajectory = along.problem, along.trajectory
    scene, n, h = problem.scene, problem.scene.robot.dof, problem.dt
    N, samples, rule = problem.steps, len(problem.model_rule), problem.model_rule
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
    if problem.processes and problem.integrator.variational:
        pull = plan.spread @ impulses(problem, trajectory, plan.jumps)
        weight = problem.integrator.left * np.swapaxes(plan.jumps, 1, 2) @ pull
        total[:, :n, :n] += scene.noise.curvature(weight[:, :, : scene.processes])
    return widened(total, scene.controls) if problem.linear else total


def backward(
    problem: OptimalControlProblem,
    trajectory: Trajectory,
    regularization: float,
    second_order: bool = False,
    *,
    along: Along | None = None,
    demands: bool = False,
    clipped: bool = False,
    rows: Mask | None = None,
) -> Plan | None:
    """One backward pass along a motion; None where the model has no minimum in a control.

    ``along`` has the expansions of other passes along the motion. With ``demands``, ``regularization`` also applies to
    what servos demand of their drives, relative to the cost at stake. ``clipped`` leaves out the limits of controls.
    ``rows`` are the active rows of penalties to begin with, :attr:`Plan.rows` of another motion.

    Raises:
        CostError: An expansion of the cost is not finite.
        LinearizationError: A step has no derivative.
    """
    along = Along(problem, trajectory) if along is None else along
    if clipped:
        along = copy(along)
        along.clipped = True
    damping = regularization * along.stake.moved * along.demands if demands and regularization > 0.0 else None
    if not second_order:
        return minimum(along, regularization, damping, rows)
    # First derivatives of the cost to go, then with them second derivatives of the dynamics (stagewise Newton).
    plan, costate = single_pass(along, max(regularization, 1e-3), costates=True)
    if plan is None:
        return None
    curvature = _curvature(along, plan, costate)
    return minimum(along, regularization, curvature if damping is None else curvature + damping, rows)
