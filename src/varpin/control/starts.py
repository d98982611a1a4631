"""Starts from given states: the controls of the inverse dynamics, and feedback that holds the motion there."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from varpin import core
from varpin.arrays import Floats
from varpin.control.problem import OptimalControlProblem
from varpin.control.rollout import around
from varpin.control.trials import Trials
from varpin.core.arrays import Commands
from varpin.errors import InputError, VarpinError
from varpin.linearization import node_jets
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.model import degrees_hint, joint_unit
from varpin.signals.inputs import as_moved, with_ends
from varpin.support.checks import as_floats, finite_array
from varpin.trajectory import Trajectory

logger = logging.getLogger(__name__)

# Greatest distance of the first state from the problem's [rad or m], and beyond a limit without a warning.
_SAME = 1e-6
# Natural frequency of the feedback that holds a motion on its states, times the decision period.
_HOLDING_FREQUENCY = 0.25


@dataclass(frozen=True, eq=False)
class Path:
    """States at the problem's nodes: q (N + 1, n) [rad or m] and v (N + 1, n) [rad/s or m/s]."""

    q: Floats
    v: Floats


def path_of(problem: OptimalControlProblem, given: object) -> Path:
    """Check the states that a search starts from.

    Raises:
        InputError: The states do not fit the problem, or do not begin at its q0.
    """
    n, nodes, names = problem.scene.robot.dof, problem.steps + 1, problem.scene.robot.joint_names
    q: object = given
    v: object = None
    if isinstance(given, Trajectory):
        if given.joint_names != names:
            raise InputError(
                f"states: the motion is of joints {', '.join(given.joint_names)}, the problem of {', '.join(names)}"
            )
        if given.steps == problem.steps and not np.isclose(given.dt, problem.dt, rtol=1e-6):
            raise InputError(
                f"states: the motion has dt = {given.dt:g} s, the problem {problem.dt:g} s; give states=motion.q to "
                "follow its path at the problem's pace"
            )
        q, v = given.q, given.v
    elif isinstance(given, tuple):
        if len(given) != 2:
            raise InputError(f"states must be q, or a pair (q, v), got {len(given)} arrays")
        q, v = given
    positions = _rows("states", q, (nodes, n))
    farthest = positions[int(np.argmax(np.abs(positions).max(axis=1)))]
    units = degrees_hint(problem.scene.robot, "states: the position", farthest)
    off = np.abs(positions[0] - problem.q0)
    joint = int(np.argmax(off))
    if off[joint] > _SAME:
        raise InputError(
            f"states must begin at the problem's q0: joint {names[joint]!r} is at {positions[0, joint]:.6g} in their "
            f"first row, and at {problem.q0[joint]:.6g} in q0" + (f"; {units}" if units else "")
        )
    if units:
        logger.warning("%s", units)
    lower, upper = problem.scene.robot.position_limits
    beyond = np.maximum(positions - upper, lower - positions)
    if beyond.max() > _SAME:
        node, joint = divmod(int(np.argmax(beyond)), beyond.shape[1])
        logger.warning(
            "states: joint %r is %.4g %s beyond its limit at node %d",
            names[joint],
            beyond[node, joint],
            joint_unit(problem.scene.robot, joint),
            node,
        )
    speeds = np.gradient(positions, problem.dt, axis=0) if v is None else _rows("states: v", v, (nodes, n))
    speeds[0] = problem.v0
    return Path(positions, speeds)


def _rows(name: str, given: object, shape: tuple[int, int]) -> Floats:
    array = as_floats(name, given)
    if array.ndim == 2 and array.shape[1] == shape[1] and array.shape[0] != shape[0]:
        raise InputError(
            f"{name} must have a row for each of {shape[0]} nodes, the first and the last included, got "
            f"{array.shape[0]}: resample them, for example with numpy.interp"
        )
    return finite_array(name, array, shape).copy()


def commands_along(problem: OptimalControlProblem, path: Path, controls: Floats | None) -> Commands:
    """Commands whose motion keeps to states, as far as controls can.

    Args:
        problem: The problem.
        path: The states.
        controls: Controls (R, m) along them; by default those of the inverse dynamics, clipped to their limits.
    """
    scene, hold = problem.scene, problem.hold
    m = scene.controls
    u = controls
    if u is None:
        needed = joint_forces(problem, path.q, path.v)
        u = as_moved(scene, path.q[hold::hold], path.v[hold::hold], needed @ scene.allocation.T)
        u = np.clip(u, *problem.control_limits)
    gains = holding_gains(problem)
    gains[scene.prescribed] = 0.0
    q, v = path.q[:-1:hold], path.v[:-1:hold]
    if problem.integrator.variational:
        v = (node_jets(scene, q, v)[0] @ v[:, :, None])[:, :, 0]
    x = np.hstack([q, v])
    if not problem.linear:
        return around(problem, u, x, np.tile(gains, (len(u), 1, 1)), None)
    if controls is None:
        # Lines through the means of neighbours.
        held, u = u, np.vstack([u[:1], 0.5 * (u[:-1] + u[1:]), u[-1:]])
        u[1:] = with_ends(scene, u[1:], held)
    u = problem.begun(u)
    # A line answers a state half a step later than a held control, so that feedback may do harm.
    tries = [
        around(problem, u, x, np.tile(share * gains, (len(u), 1, 1)), np.zeros((len(u), m, m))) for share in (1.0, 0.0)
    ]
    return min(tries, key=lambda commands: _cost_under(problem, commands))


def holding_gains(problem: OptimalControlProblem) -> Floats:
    """Gains (m, 2n) of the controls that hold a motion on states, (q, p) or (q, v)."""
    scene, n = problem.scene, problem.scene.robot.dof
    M = lagrangian_jet(scene, problem.q0, np.zeros(n)).Lvv
    omega = _HOLDING_FREQUENCY / problem.period
    on_speed = np.eye(n) if problem.integrator.variational else M
    found: Floats = scene.allocation @ -np.hstack([omega**2 * M, 2.0 * omega * on_speed])
    return found


def states_on(problem: OptimalControlProblem, q: Floats, v: Floats) -> Floats:
    """The states (R, 2n) before each decision, (q, p) or (q, v), of q and v (N + 1, n) at the nodes."""
    q, v = q[: -1 : problem.hold], v[: -1 : problem.hold]
    if problem.integrator.variational:
        v = (node_jets(problem.scene, q, v)[0] @ v[:, :, None])[:, :, 0]
    return np.hstack([q, v])


def _cost_under(problem: OptimalControlProblem, commands: Commands) -> float:
    """The cost of the motion under commands; infinite where it fails."""
    try:
        attempt = Trials(problem).attempt(commands)
        return float(attempt.shares().sum()) if attempt.whole else np.inf
    except VarpinError:
        return np.inf


def joint_forces(problem: OptimalControlProblem, q: Floats, v: Floats) -> Floats:
    """The joint forces (..., R, n) that controls have to give over each decision, on q and v (..., N + 1, n)."""
    scene, period = problem.scene, problem.period
    q, v = q[..., :: problem.hold, :], v[..., :: problem.hold, :]
    before, after = (..., slice(None, -1), slice(None)), (..., slice(1, None), slice(None))
    shape, n = q[before].shape, q.shape[-1]
    at = (0.5 * (q[before] + q[after])).reshape(-1, n)
    rate, acceleration = (((x[after] - x[before]) / period).reshape(-1, n) for x in (q, v))
    # A servo commanded to its present position exerts no spring force.
    still = at @ scene.holding.T @ scene.actuation.T
    needed: Floats = core.inverse_dynamics(scene.core, at, rate, acceleration) + still
    return (needed - scene.core.forces(at, rate, still)[0]).reshape(shape)
