"""Starts from given states: the controls of the inverse dynamics, and feedback that holds the motion there."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from varpin import core
from varpin.arrays import Floats
from varpin.control.multipliers import FEASIBLE
from varpin.control.problem import FASTEST, OptimalControlProblem
from varpin.control.rollout import around
from varpin.core.arrays import Commands
from varpin.errors import InputError, VarpinError
from varpin.linearization import node_jets
from varpin.model import degrees_hint
from varpin.signals.commands import as_moved, with_ends
from varpin.simulation.record import rollout
from varpin.support.checks import finite_array
from varpin.trajectory import Trajectory

logger = logging.getLogger(__name__)

# States at a problem's nodes: q (N + 1, n) [rad or m] and v (N + 1, n) [rad/s or m/s].
Path = tuple[Floats, Floats]


def path_of(problem: OptimalControlProblem, given: Any) -> Path:
    """Check the states that a search starts from.

    Raises:
        InputError: The states do not fit the problem, or do not begin at its q0.
    """
    robot, shape = problem.scene.robot, (problem.steps + 1, problem.scene.robot.dof)
    names, q, v = robot.joint_names, given, None
    if isinstance(given, Trajectory):
        if given.joint_names != names:
            raise InputError(f"states: the motion is of joints {given.joint_names}, the problem of {names}")
        if given.steps == problem.steps and not np.isclose(given.dt, problem.dt, rtol=1e-6):
            raise InputError(
                f"states: the motion has dt = {given.dt:g} s, the problem {problem.dt:g} s: give its q alone"
            )
        q, v = given.q, given.v
    elif isinstance(given, tuple):
        if len(given) != 2:
            raise InputError(f"states must be q, or a pair (q, v), got {len(given)} arrays")
        q, v = given
    positions = finite_array("states", q, shape).copy()
    units = degrees_hint(robot, "states: the position", positions[int(np.abs(positions).max(axis=1).argmax())])
    off = np.abs(positions[0] - problem.q0)
    joint = int(off.argmax())
    if off[joint] > FEASIBLE:
        raise InputError(
            f"states must begin at the problem's q0: joint {names[joint]!r} is at {positions[0, joint]:.6g} in their "
            f"first row, and at {problem.q0[joint]:.6g} in q0{'; ' if units else ''}{units}"
        )
    if units:
        logger.warning("%s", units)
    speeds = np.gradient(positions, problem.dt, axis=0) if v is None else finite_array("states: v", v, shape).copy()
    speeds[0] = problem.v0
    return positions, speeds


def commands_along(problem: OptimalControlProblem, path: Path, controls: Floats | None) -> Commands:
    """Commands whose motion keeps to states, as far as controls can.

    Args:
        problem: The problem.
        path: The states.
        controls: Controls (R, m) along them; by default those of the inverse dynamics, clipped to their limits.
    """
    scene, hold, (q, v), u = problem.scene, problem.hold, path, controls
    m = scene.controls
    if u is None:
        u = as_moved(scene, q[hold::hold], v[hold::hold], _joint_forces(problem, q, v) @ scene.allocation.T)
        u = np.clip(u, *problem.control_limits)
    q, v = q[:-1:hold], v[:-1:hold]
    if problem.integrator.variational:
        v = (node_jets(scene, q, v)[0] @ v[:, :, None])[:, :, 0]
    x, gains = np.hstack([q, v]), problem.feedback(FASTEST / problem.period)
    if not problem.linear:
        return around(problem, u, x, np.tile(gains, (len(u), 1, 1)), None)
    if controls is None:
        # Lines through the means of neighbours.
        held, u = u, np.vstack([u[:1], 0.5 * (u[:-1] + u[1:]), u[-1:]])
        u[1:] = with_ends(scene, u[1:], held)
    u = problem.begun(u)
    # A line answers a state half a step later than a held control, so that feedback may do harm.
    tries = [
        around(problem, u, x, np.tile(own, (len(u), 1, 1)), np.zeros((len(u), m, m))) for own in (gains, 0 * gains)
    ]
    return min(tries, key=lambda commands: _cost_under(problem, commands))


def _cost_under(problem: OptimalControlProblem, commands: Commands) -> float:
    """The cost of the motion under commands; infinite where it fails."""
    try:
        motion, failure = rollout(problem.scene, problem.integrator, problem.q0, problem.v0, commands, problem.dt)
        return problem.cost_of(motion) if failure is None else np.inf
    except VarpinError:
        return np.inf


def _joint_forces(problem: OptimalControlProblem, q: Floats, v: Floats) -> Floats:
    """The joint forces (R, n) that controls have to give over each decision, on q and v (N + 1, n)."""
    scene, period = problem.scene, problem.period
    q, v = q[:: problem.hold], v[:: problem.hold]
    at = 0.5 * (q[:-1] + q[1:])
    rate, acceleration = np.diff(q, axis=0) / period, np.diff(v, axis=0) / period
    # A servo commanded to its present position exerts no spring force.
    still = at @ scene.holding.T @ scene.actuation.T
    needed: Floats = core.inverse_dynamics(scene.core, at, rate, acceleration) + still
    return needed - scene.core.forces(at, rate, still)[0]
