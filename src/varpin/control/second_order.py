"""Second derivatives of the steps in the cost to go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from varpin.arrays import Floats
from varpin.control.problem import OptimalControlProblem
from varpin.control.stages import Steps
from varpin.linearization import second_order_steps, velocity_curvature
from varpin.mechanics.scene import quiet
from varpin.signals.commands import with_ends
from varpin.trajectory import Trajectory

# Changes of velocities [rad/s or m/s] between the points of differences in controls; from 1e-5 to 1e-3.
_SHIFT = 1e-4


def curvature_along(steps: Steps, costate: Floats) -> Floats:
    """Second derivatives of the steps (N, Z, Z) in the cost to go, whose slopes are ``costate`` (N, 2n) after each."""
    problem, motion = steps.problem, steps.trajectory
    scene, n, rule, N = problem.scene, problem.scene.robot.dof, problem.rule, problem.steps
    gradient = steps.running.gradient.reshape(N, len(rule), -1)
    # The running cost's gradient in v0, q1 and v1 of each step.
    v0, q1, v1 = (
        problem.dt * rule[0, 0] * (rule[:, 1 + c] @ gradient[:, :, :n] + rule[:, 5 + c] @ gradient[:, :, n : 2 * n])
        for c in (1, 2, 3)
    )
    z = costate.copy()
    z[:, :n] += q1
    z += np.einsum("Ni,Nix->Nx", v1, steps.slopes[1:, n:])
    second = second_order_steps(scene, motion, z, problem.integrator)
    if problem.linear:
        total = _on_lines(problem, motion, z, second.xx)
    else:
        total = np.block([[second.xx, np.swapaxes(second.ux, 1, 2)], [second.ux, second.uu]])
    total[:, : 2 * n, : 2 * n] += velocity_curvature(scene, motion.q[:-1], motion.v[:-1], v0)
    after = velocity_curvature(scene, motion.q[1:], motion.v[1:], v1)
    found: Floats = total + np.swapaxes(steps.J, 1, 2) @ after @ steps.J
    return found


def _on_lines(problem: OptimalControlProblem, trajectory: Trajectory, z: Floats, in_state: Floats) -> Floats:
    """Second derivatives (N, 2n + 2m, 2n + 2m) of z . x' of each step in (x, w, u), for z (N, 2n).

    Those ``in_state`` (N, 2n, 2n) are given. Those in controls are central differences of first derivatives, whose
    points change the fastest joint's velocity by _SHIFT.
    """
    still = problem.changed(scene=quiet(problem.scene))
    scene, n, m, h = still.scene, problem.scene.robot.dof, problem.scene.controls, problem.dt
    N, x = len(z), 2 * n
    found = np.zeros((N, x + 2 * m, x + 2 * m))
    found[:, :x, :x] = in_state
    M, _ = scene.core.jets(trajectory.q[:-1], trajectory.v[:-1])
    speeds = np.abs(h * np.linalg.solve(M, np.broadcast_to(scene.actuation, (N, n, m)))).max(axis=1)
    shift = _SHIFT / np.where(speeds > 0.0, speeds, 1.0)
    # Positions, and velocities of cubics.
    shift[:, scene.prescribed] = _SHIFT
    for c in range(2 * m):
        du = np.zeros((N, 2 * m))
        du[:, c] = shift[:, c % m]
        pulls = []
        for sign in (1.0, -1.0):
            near = _shifted(problem, trajectory, sign * du)
            pulls.append(np.einsum("Na,Naz->Nz", z, Steps(still, near).J))
        found[:, :, x + c] = (pulls[0] - pulls[1]) / (2.0 * shift[:, c % m, None])
    found[:, x:, :x] = np.swapaxes(found[:, :x, x:], 1, 2)
    found[:, x:, x:] = 0.5 * (found[:, x:, x:] + np.swapaxes(found[:, x:, x:], 1, 2))
    return found


def _shifted(problem: OptimalControlProblem, trajectory: Trajectory, du: Floats) -> Trajectory:
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
