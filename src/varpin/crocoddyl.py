"""Problems of varpin for crocoddyl's solvers (FDDP, BoxFDDP) and their callbacks, on the variational map.

Needs crocoddyl, which is built against one version of Pinocchio: ``pip install "varpin[crocoddyl]"``.

    from varpin.crocoddyl import shooting_problem, first_guess, policy_of

    solver = crocoddyl.SolverFDDP(shooting_problem(problem))
    solver.solve(*first_guess(problem))
    plan = varpin.solve(problem, policy_of(problem, solver), max_iterations=0)
"""

from __future__ import annotations

import logging
from typing import Any, Literal

import numpy as np

from varpin.arrays import Floats
from varpin.control.problem import OptimalControlProblem
from varpin.control.solving import solve
from varpin.control.stages import Steps, states
from varpin.errors import InputError, VarpinError
from varpin.linearization import velocity_at_nodes
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.signals.commands import open_loop
from varpin.signals.policy import LinearPolicy
from varpin.simulation.record import rollout
from varpin.trajectory import Trajectory

try:
    import crocoddyl
except ImportError as missing:
    raise ImportError(
        f"varpin.crocoddyl needs crocoddyl ({missing}): pip install 'varpin[crocoddyl]', "
        "in a separate environment, as it installs the Pinocchio that it was built against"
    ) from missing


logger = logging.getLogger(__name__)

# Stands for infinity in limits: crocoddyl leaves out limits of which no lower one, or no upper one, is finite.
_NO_LIMIT = 1e30


class StepModel(crocoddyl.ActionModelAbstract):
    """The step of a problem of one step, with its running cost, as an action of crocoddyl.

    The state is (q, p) for variational integrators and (q, v) for the others, (2n,). ``Fx`` and ``Fu`` are the exact
    derivatives of the step; second derivatives of the cost are Gauss-Newton approximations. Noise is left out. ``u_lb``
    and ``u_ub`` are the problem's control limits. A step that cannot be solved is logged and returns NaN, for which
    crocoddyl's line search shortens its step.
    """

    def __init__(self, problem: OptimalControlProblem) -> None:
        super().__init__(crocoddyl.StateVector(2 * problem.scene.robot.dof), problem.scene.controls, 0)
        self._problem = problem
        if problem.limited:
            self.u_lb, self.u_ub = np.clip(problem.control_limits, -_NO_LIMIT, _NO_LIMIT)

    def calc(self, data: Any, x: Floats, u: Floats | None = None) -> None:
        """The next state and the cost of the step."""
        problem, motion = self._problem, self._step(x, u)
        if motion is None:
            data.xnext, data.cost = np.full(x.size, np.nan), np.inf
            return
        data.xnext = states(problem, motion)[1]
        values = problem.running.value(*problem.samples(motion.q, motion.v, motion.u))
        # All samples of a rule have the same weight.
        data.cost = float(problem.dt * problem.rule[0, 0] * values.sum())

    def calcDiff(self, data: Any, x: Floats, u: Floats | None = None) -> None:  # crocoddyl's name
        """Derivatives of the next state and of the cost."""
        motion = self._step(x, u)
        if motion is None:
            raise VarpinError("a step that cannot be solved has no derivatives")
        steps, at, by = Steps(self._problem, motion), slice(0, x.size), slice(x.size, None)
        (J,), (gradient,), (hessian,) = steps.J, *steps.costs
        data.Fx, data.Fu = J[:, at], J[:, by]
        data.Lx, data.Lu = gradient[at], gradient[by]
        data.Lxx, data.Lxu, data.Luu = hessian[at, at], hessian[at, by], hessian[by, by]

    def _step(self, x: Floats, u: Floats | None) -> Trajectory | None:
        """The step from x under u."""
        problem = self._problem
        u = np.zeros(problem.scene.controls) if u is None else u
        q, v = _configuration_and_velocity(problem, x)
        if not (np.isfinite(q).all() and np.isfinite(v).all() and np.isfinite(u).all()):
            return None
        motion, failure = rollout(problem.scene, problem.integrator, q, v, open_loop(u[None]), problem.dt)
        if failure is not None:
            logger.warning("a step cannot be solved: %s", failure.reason)
            return None
        return motion


class EndModel(crocoddyl.ActionModelAbstract):
    """The terminal cost of a problem."""

    def __init__(self, problem: OptimalControlProblem) -> None:
        super().__init__(crocoddyl.StateVector(2 * problem.scene.robot.dof), 0, 0)
        self._problem = problem

    def calc(self, data: Any, x: Floats, u: Floats | None = None) -> None:  # noqa: ARG002
        """The terminal cost."""
        data.xnext = x
        data.cost = float(self._problem.terminal.value(*self._end(x))[0])

    def calcDiff(self, data: Any, x: Floats, u: Floats | None = None) -> None:  # noqa: ARG002
        """Its derivatives."""
        n, (q, v, none) = self._problem.scene.robot.dof, self._end(x)
        expansion = self._problem.terminal.expand(q, v, none)
        J = np.eye(2 * n)
        if self._problem.integrator.variational:
            J[n:] = velocity_at_nodes(self._problem.scene, q, v)[0]
        data.Fx = np.eye(2 * n)
        data.Lx = J.T @ expansion.gradient[0, : 2 * n]
        data.Lxx = J.T @ expansion.hessian[0, : 2 * n, : 2 * n] @ J

    def _end(self, x: Floats) -> tuple[Floats, Floats, Floats]:
        q, v = _configuration_and_velocity(self._problem, x)
        return q[None], v[None], np.zeros((1, self._problem.scene.controls))


def shooting_problem(problem: OptimalControlProblem) -> crocoddyl.ShootingProblem:
    """The problem for crocoddyl: an action for each step, and the terminal cost.

    ``SolverBoxFDDP`` and ``SolverBoxDDP`` keep control limits, crocoddyl's other solvers ignore them. The actions are
    Python objects, so leave ``nthreads`` at 1.

    Raises:
        InputError: Controls are held over several steps, are linear between nodes, or have a cost of their rate; or the
            plan has constraints.
    """
    if problem.rate is not None:
        raise InputError("crocoddyl's actions do not have the previous control: leave the ControlRateCost out")
    if problem.linear:
        raise InputError("crocoddyl's actions hold their control over a step; the problem's are linear between nodes")
    if problem.hold != 1:
        raise InputError(f"crocoddyl decides at every step; the problem holds its controls over {problem.hold}")
    if problem.constraints:
        raise InputError("hard constraints of a plan have no counterpart in crocoddyl: make them costs")
    q, v = problem.q0, problem.v0
    x0 = np.concatenate([q, lagrangian_jet(problem.scene, q, v).Lv if problem.integrator.variational else v])
    models = [StepModel(problem.step(k)) for k in range(problem.steps)]
    return crocoddyl.ShootingProblem(x0, models, EndModel(problem))


def first_guess(problem: OptimalControlProblem) -> tuple[list[Floats], list[Floats]]:
    """States ``xs`` and controls ``us`` of the initial motion of :func:`varpin.solve`.

    Raises:
        StepFailure: That motion cannot be integrated.
    """
    motion = solve(problem, max_iterations=0, check=False).trajectory
    return list(states(problem, motion)), list(motion.u)


def policy_of(problem: OptimalControlProblem, solver: Any) -> LinearPolicy:
    """The policy us - K (x - xs), within the control limits, of a solver of ``shooting_problem(problem)``."""
    gains = -np.array(list(solver.K))
    on: Literal["momentum", "velocity"] = "momentum" if problem.integrator.variational else "velocity"
    return problem.policy_of(np.array(solver.us.tolist()), gains, np.array(solver.xs.tolist())[:-1], on)


def _configuration_and_velocity(problem: OptimalControlProblem, x: Floats) -> tuple[Floats, Floats]:
    n = problem.scene.robot.dof
    q, second = x[:n].copy(), x[n:].copy()
    if not problem.integrator.variational or not np.isfinite(x).all():
        return q, second
    v = np.asarray(np.linalg.solve(lagrangian_jet(problem.scene, q, np.zeros(n)).Lvv, second), dtype=np.float64)
    return q, v
