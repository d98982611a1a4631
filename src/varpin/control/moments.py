"""The noise cost of a motion under feedback, to second order: covariances forward, with the gains held."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.control.linear_controls import after_impulse, in_step, of_samples, on_lines
from varpin.control.problem import OptimalControlProblem
from varpin.control.spread import Feedback, added_covariance, decided, propagated
from varpin.control.within_steps import beyond_samples
from varpin.linearization import linearize_steps, velocity_at_nodes
from varpin.trajectory import Trajectory


class LinearizedSteps(NamedTuple):
    """N linearized steps in their Z variables, (x, u) or (x, w, u), with their costs to second order."""

    J: Floats  # (N, 2n, Z)
    g: Floats  # (N, 2n, k) derivative in the noise
    gz: Floats  # (N, 2n, k, Z) its derivative in the variables
    cost: Floats  # (N, Z, Z) Hessian of the running cost
    kicked: Floats  # (N, 2n, 2n) Hessian of the part after the noise impulse, in the state there
    beyond: Floats | None  # (N, 2n, 2n) what no sample of it sees


def noise_cost(problem: OptimalControlProblem, trajectory: Trajectory, feedback: Feedback) -> float:
    """The noise cost of a motion under feedback, without that of control changes."""
    here = _steps_of(problem, trajectory)
    return _with_covariances(problem, trajectory, here, propagated(here.J, here.g, here.gz, problem, feedback))


def noise_cost_in_halves(
    problem: OptimalControlProblem, halves: OptimalControlProblem, trajectory: Trajectory, feedback: Feedback
) -> float:
    """:func:`noise_cost` of linear controls on ``halves``, the problem in half steps, decided once in each whole one.

    A control in the middle of a whole step is the mean of those at its ends, which feedback decides at its beginning.
    """
    here = _steps_of(halves, trajectory)
    x, m, dt = here.J.shape[1], problem.scene.controls, halves.dt
    C, covariance = np.zeros((halves.steps + 1, x + 2 * m, x + 2 * m)), np.zeros((x + m, x + m))
    middle = np.hstack([np.zeros((m, x)), 0.5 * np.eye(m), 0.5 * np.eye(m)])
    last = np.hstack([np.zeros((m, x + m)), np.eye(m)])
    to_middle = np.vstack([np.eye(x + m, x + 2 * m), middle])
    for k in range(problem.steps):
        T = decided(problem, feedback, k, x)
        whole = covariance if T is None else T @ covariance @ T.T
        C[2 * k] = to_middle @ whole @ to_middle.T
        through = np.vstack([here.J[2 * k] @ to_middle, middle, last])
        C[2 * k + 1] = through @ whole @ through.T
        C[2 * k + 1, :x, :x] += dt * added_covariance(here.g[2 * k], here.gz[2 * k], C[2 * k])
        through = np.vstack([here.J[2 * k + 1], last])
        covariance = through @ C[2 * k + 1] @ through.T
        covariance[:x, :x] += dt * added_covariance(here.g[2 * k + 1], here.gz[2 * k + 1], C[2 * k + 1])
    C[-1, :x, :x] = covariance[:x, :x]
    return _with_covariances(halves, trajectory, here, C)


def _with_covariances(
    problem: OptimalControlProblem, trajectory: Trajectory, here: LinearizedSteps, C: Floats
) -> float:
    """The noise cost with covariances ``C`` (N + 1, Z, Z) of the variables of each step, and of the last state."""
    x = here.J.shape[1]
    over_time = (here.cost * C[:-1]).sum()
    at_end = (_end_hessian(problem, trajectory) * C[-1, :x, :x]).sum()
    return 0.5 * float(over_time + at_end) + _of_impulses(problem, here, here.kicked, C)


def left_within_steps(problem: OptimalControlProblem, trajectory: Trajectory, feedback: Feedback) -> float:
    """The part of :func:`noise_cost` that no path shows, see :func:`varpin.control.within_steps.beyond_samples`."""
    here = _steps_of(problem, trajectory)
    if here.beyond is None:
        return 0.0
    return _of_impulses(problem, here, here.beyond, propagated(here.J, here.g, here.gz, problem, feedback))


def _of_impulses(problem: OptimalControlProblem, steps: LinearizedSteps, hessian: Floats, C: Floats) -> float:
    """The cost of the noise's jumps by its Hessian (N, 2n, 2n) in them, for the covariances C before the steps."""
    twice = np.einsum("Nak,Nab,Nbk->", steps.g, hessian, steps.g, optimize=True)
    twice += np.einsum("Nakz,Nab,Nbky,Nzy->", steps.gz, hessian, steps.gz, C[:-1], optimize=True)
    return 0.5 * problem.dt * float(twice)


def _end_hessian(problem: OptimalControlProblem, trajectory: Trajectory) -> Floats:
    """Hessian of the terminal cost in x (2n, 2n)."""
    n = problem.scene.robot.dof
    H: Floats = problem.expand_terminal(trajectory).hessian[0, : 2 * n, : 2 * n]
    if not problem.integrator.variational:
        return H
    D = np.eye(2 * n)
    D[n:] = velocity_at_nodes(problem.scene, trajectory.q[-1:], trajectory.v[-1:])[0]
    return np.asarray(D.T @ H @ D)


def _steps_of(problem: OptimalControlProblem, trajectory: Trajectory) -> LinearizedSteps:
    scene, n, m, N = problem.scene, problem.scene.robot.dof, problem.scene.controls, problem.steps
    x, h, rule, samples = 2 * n, problem.dt, problem.rule, len(problem.rule)
    lin = linearize_steps(scene, trajectory, problem.integrator, problem.q0, ramps=problem.linear)
    velocity = np.zeros((0, n, x))
    if problem.integrator.variational and rule[:, [2, 4, 6, 8]].any():
        velocity = velocity_at_nodes(scene, trajectory.q, trajectory.v)
    J, gz = in_step(lin)
    hessian = problem.expand_running(trajectory).hessian
    cost = np.zeros((N, J.shape[2], J.shape[2]))
    wholes = on_lines(rule, problem.places, J, velocity, m, ramps=problem.linear)
    for s, whole in enumerate(wholes):
        cost += h * rule[s, 0] * np.swapaxes(whole, 1, 2) @ of_samples(hessian, samples, s) @ whole
    kicked = after_impulse(rule, hessian, velocity, N, x, h)
    end = problem.expand_terminal(trajectory).hessian[0, n:x, n:x]
    beyond = beyond_samples(problem, trajectory, lin, hessian, samples, end)
    if beyond is not None:
        kicked = kicked + beyond
    return LinearizedSteps(J, lin.G, gz, cost, kicked, beyond)
