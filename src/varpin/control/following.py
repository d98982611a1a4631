"""Motions that follow given states: the controls of the inverse dynamics, and feedback that holds the motion there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from varpin import core
from varpin.arrays import Floats
from varpin.control.along import Along
from varpin.control.feedback import around
from varpin.control.passes import Plan, foreseen
from varpin.control.penalties import PenalizedProblem
from varpin.control.problem import OptimalControlProblem
from varpin.core.arrays import Commands
from varpin.linearization import node_jets, velocity_at_nodes
from varpin.mechanics.forces import limited_servos
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.signals.inputs import as_moved

# Natural frequency of the feedback that holds a motion on a path, times the decision period.
_HOLDING_FREQUENCY = 0.25
# Share of the decrease that the model says, from which on a step is as foreseen; and of that of foreseen states, from
# which on a motion follows them.
AS_FORESEEN, FOLLOWS = 0.7, 0.8
# Lengths of steps along foreseen states. Their cost must fall by _CLEARLY times as much as with the full step, and no
# joint may move away from the present motion by more than _FAR [rad or m]: arms that are moved far often reach for a
# frame in a posture that costs more.
_LENGTHS, _CLEARLY, _FAR = (1.0, 0.75, 0.5), 1.1, 2.0


@dataclass(frozen=True, eq=False)
class Path:
    """States at the problem's nodes: q (N + 1, n) [rad or m] and v (N + 1, n) [rad/s or m/s]."""

    q: Floats
    v: Floats


def inverse_dynamics(problem: OptimalControlProblem, path: Path, controls: Floats | None) -> tuple[Floats, Floats]:
    """Controls (R, m) closest to the inverse dynamics on the path, and the joint forces (R, n) that are missing.

    With ``controls`` (R, m) these are the controls.
    """
    scene, hold, needed = problem.scene, problem.hold, _demand(problem, path.q, path.v)
    if controls is None:
        controls = as_moved(scene, path.q[hold::hold], path.v[hold::hold], needed @ scene.allocation.T)
        controls = np.clip(controls, *problem.control_limits)
    return controls, needed - controls @ scene.actuation.T


def holding_feedback(problem: OptimalControlProblem, M: Floats) -> Floats:
    """Gains of the joint forces (n, 2n) that hold a motion with mass matrix M (n, n) on states, (q, p) or (q, v)."""
    omega = _HOLDING_FREQUENCY / problem.period
    return -np.hstack([omega**2 * M, 2.0 * omega * (np.eye(len(M)) if problem.integrator.variational else M)])


def states_on(problem: OptimalControlProblem, path: Path) -> Floats:
    """The states (R, 2n) of a path before each decision, (q, p) or (q, v)."""
    q, v = path.q[: -1 : problem.hold], path.v[: -1 : problem.hold]
    if problem.integrator.variational:
        v = (node_jets(problem.scene, q, v)[0] @ v[:, :, None])[:, :, 0]
    return np.hstack([q, v])


class Followed(NamedTuple):
    """Motions that follow foreseen states.

    Attributes:
        commands: Their commands, which differ in the feedback: that which holds a motion on its path, then the plan's.
        length: Length of the step.
        cost: Change of the cost that is foreseen.
    """

    commands: tuple[Commands, Commands]
    length: float
    cost: float


class Foresight:
    """Trials that follow the states which a plan foresees in place of its controls, (O17) of docs/mathematics.md."""

    def __init__(self, problem: OptimalControlProblem) -> None:
        self.problem = problem

    @cached_property
    def possible(self) -> bool:
        """Whether there are controls, just one for each motion, that give all joints the forces it needs."""
        problem, scene = self.problem, self.problem.scene
        if isinstance(problem, PenalizedProblem) or problem.linear:
            # Measured, as many of these searches took more iterations as took fewer.
            return False
        if scene.inputs or scene.constraints or scene.custom is not None or limited_servos(scene.elements):
            return False
        n = scene.robot.dof
        return scene.direct or (scene.controls == n and int(np.linalg.matrix_rank(scene.actuation)) == n)

    @cached_property
    def _holding(self) -> Floats:
        """Gains of the controls (R, m, 2n) that hold a motion on a path."""
        problem = self.problem
        M = lagrangian_jet(problem.scene, problem.q0, np.zeros(problem.scene.robot.dof)).Lvv
        to_controls = problem.scene.allocation @ holding_feedback(problem, M)
        return np.tile(to_controls, (problem.decisions, 1, 1))

    def followed(self, along: Along, plan: Plan, shares: Floats, full: float) -> Followed | None:
        """Motions that follow the plan's foreseen states; None where these are not good.

        Args:
            along: The motion that the plan is around.
            plan: The plan.
            shares: The terms of the motion's cost.
            full: Change of the cost by the full step. The foreseen states must cost clearly less.

        Raises:
            CostError: A custom cost fails at the foreseen states.
        """
        problem, n, motion = self.problem, self.problem.scene.robot.dof, along.trajectory
        if not self.possible or len(along.blocks) > 1:
            return None
        change = self._foreseen(along, plan)
        far = float(np.abs(change[:, :n]).max())
        lengths = [length for length in _LENGTHS if length * far <= _FAR]
        if not lengths:
            return None
        # The motion itself is the first one.
        parts = np.array([0.0, *lengths])[:, None, None]
        q, v = motion.q + parts * change[:, :n], motion.v + parts * change[:, n:]
        force = _demand(problem, q, v)
        # Differences of the inverse dynamics: what it is off by on the motion itself cancels.
        u = problem.decided(motion) + (force[1:] - force[:1]) @ problem.scene.allocation.T
        q, v, rows = q[1:], v[1:], np.repeat(u, problem.hold, axis=1)
        compiled = problem.running.compiled.values(*problem.samples(q, v, rows))
        (lower, upper), best, found = problem.control_limits, _CLEARLY * min(full, 0.0), None
        for k, length in enumerate(lengths):
            if problem.limited and not ((lower <= u[k]) & (u[k] <= upper)).all():
                continue
            cost = float((problem.shares_along(q[k], v[k], rows[k], compiled[k]) - shares).sum())
            model = length * plan.slope + 0.5 * length**2 * plan.curvature
            if cost < best and cost <= AS_FORESEEN * model:
                best, found = cost, k
        if found is None:
            return None
        x = states_on(problem, Path(q[found], v[found]))
        by_plan = around(problem, u[found], x, plan.feedback, plan.previous)
        held = by_plan._replace(gains=self._holding, reference=x)
        return Followed((held, by_plan), lengths[found], best)

    def _foreseen(self, along: Along, plan: Plan) -> Floats:
        """The changes of q and v at the nodes (N + 1, 2n) with a full step, by the linearized motion."""
        problem, n, motion = self.problem, self.problem.scene.robot.dof, along.trajectory
        change = np.zeros((problem.steps + 1, 2 * n))
        foreseen(along, plan, after=change[1:])
        if problem.integrator.variational:
            slopes = along.linearized(0, problem.steps)[1]
            slopes = slopes if len(slopes) else velocity_at_nodes(problem.scene, motion.q, motion.v)
            change[:, n:] = (slopes @ change[:, :, None])[:, :, 0]
        return change


def _demand(problem: OptimalControlProblem, q: Floats, v: Floats) -> Floats:
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
