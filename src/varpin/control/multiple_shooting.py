"""Multiple shooting from given states: auxiliary joint forces hold the first motion on them, then are removed.

Equations (O14) and (O15) of docs/mathematics.md. The given states need not be feasible: an auxiliary force on every
joint makes up for what the controls lack; joints of kinematic inputs follow the states themselves. The effect of a
step's auxiliary forces on the state at its end is the gap of multiple shooting. Each iteration first tries the step
that closes all gaps, as FDDP does (Mastalli et al., "Crocoddyl", 2020); the backward pass includes the removal of the
forces. If the motion does not follow the model that far, the forces become controls with a quadratic cost, and its
weight grows. Without auxiliary forces the motion is feasible, and single shooting continues from it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from varpin.arrays import Floats
from varpin.control.along import Along, states
from varpin.control.backward import backward
from varpin.control.costs import CostError, Expansion
from varpin.control.following import Path, holding_feedback, inverse_dynamics, states_on
from varpin.control.history import Iteration
from varpin.control.passes import Plan
from varpin.control.penalties import PenalizedProblem, PenalizedRate
from varpin.control.problem import OptimalControlProblem
from varpin.core.arrays import Commands
from varpin.errors import InputError, LinearizationError
from varpin.linearization import linearize_steps, velocity_at_nodes
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene, assisted, quiet
from varpin.model import degrees_hint, joint_unit
from varpin.signals.inputs import with_ends
from varpin.signals.policy import LinearPolicy
from varpin.simulation.failures import StepFailure, named
from varpin.simulation.record import Motions
from varpin.support.checks import as_floats, finite_array
from varpin.trajectory import Trajectory

logger = logging.getLogger(__name__)

# Tolerance on the first state against q0, and on position limits [rad or m].
_SAME = 1e-6
# Auxiliary forces count as zero below this fraction of the total joint forces (2-norms over the motion).
_NO_FORCE = 1e-9
# Acceptance of a step: least share of an expected decrease, and greatest multiple of an expected increase.
_LEAST_DECREASE, _MOST_INCREASE = 0.1, 2.0
# Step lengths of the line search.
_LENGTHS = 0.5 ** np.arange(10)
# The weight of the auxiliary forces grows by _WEIGHT_GROWTH when the expected decrease is at most this share of the
# cost, that of the forces included.
_WEIGHT_GROWTH, _SETTLED = 4.0, 0.1
# Regularization: it decreases after steps of at least _LONG and increases after shorter ones, by the factor _GROWTH,
# from _LEAST on; iterations end above _MOST.
_LONG, _LEAST, _GROWTH, _MOST = 0.25, 1e-6, 10.0, 1e6
# Errors that reject a trial.
_TRIAL_ERRORS = (StepFailure, CostError, CustomForceError)


@dataclass(frozen=True, eq=False)
class _Motion:
    """A motion with auxiliary joint forces.

    Attributes:
        trajectory: The motion with the problem's own controls only. It solves the problem's dynamics only where the
            auxiliary forces are zero.
        full: The motion in the scene with auxiliary forces; its controls are (u, forces).
        cost: The problem's cost, without that of the auxiliary forces.
    """

    trajectory: Trajectory
    full: Trajectory
    cost: float


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


class GapClosing:
    """Iterations that remove the auxiliary forces of a motion on given states.

    Attributes:
        history: The iterations so far.
        motion: The current motion.
        left: Norm of the auxiliary forces, relative to that of the first motion.
    """

    def __init__(self, problem: OptimalControlProblem, path: Path, controls: Floats | None) -> None:
        """Make the first motion.

        Args:
            problem: The problem. Its noise is left to the search that follows.
            path: The states.
            controls: Controls along the states (R, m); None for those of the inverse dynamics, clipped to their limits.

        Raises:
            StepFailure: The motion cannot be integrated.
            CostError: The cost of the motion is not finite.
        """
        self._wanted = problem
        if problem.linear:
            problem = _held(problem)
            if controls is not None:
                controls = with_ends(problem.scene, 0.5 * (controls[:-1] + controls[1:]), controls[1:])
        scene, own = assisted(problem.scene), quiet(problem.scene)
        self.scene, self.problem = scene, problem.changed(scene=own)
        if isinstance(problem, PenalizedProblem):
            # Penalties are linearized at the current motion, without the extra passes at the expected one.
            self.problem = self.problem.changed(passes=0)
        self.history: list[Iteration] = []
        self.left = 1.0
        n, m = own.robot.dof, own.controls
        M = lagrangian_jet(own, problem.q0, np.zeros(n)).Lvv
        hold = holding_feedback(problem, M)
        free, moved = own.unprescribed, own.prescribed
        self._free = free
        self._weight = np.linalg.inv(M[np.ix_(free, free)])
        self._motions = Motions(scene, problem.integrator, problem.q0, problem.v0, problem.dt)
        own_hold = own.allocation @ hold
        own_hold[moved] = 0.0
        self._gains = np.tile(own_hold, (problem.decisions, 1, 1))
        u, force = inverse_dynamics(problem, path, controls)
        gains = np.zeros((problem.decisions, m + len(free), 2 * n))
        gains[:, m:] = hold[free]
        self.motion = self._rolled(np.hstack([u, force[:, free]]), gains, states_on(self.problem, path))
        if controls is None:
            # The controls take as much of the holding force as their limits allow.
            full = self.motion.full
            force = full.u @ scene.actuation.T
            u = np.clip(force @ own.allocation.T, *problem.control_limits)
            u = with_ends(own, u, full.u)
            self.motion = self._of(replace(full, u=np.hstack([u, (force - u @ own.actuation.T)[:, free]])))
        if not np.isfinite(self.motion.cost):
            culprits = " + ".join(map(repr, problem.not_finite(self.motion.trajectory) or problem.cost.terms))
            raise CostError(culprits, f"the cost of the motion along the states is {self.motion.cost}")
        self._cost_bound = self._holding_cost()
        self._first = float(np.linalg.norm(self.motion.full.u[:, m:]))
        if self._first <= _NO_FORCE * np.linalg.norm(self.motion.full.u @ scene.actuation.T):
            self.left = 0.0
        # The first weight makes the auxiliary forces cost as much as the motion.
        self._force_weight = 1.0
        self._force_weight = self.motion.cost / (self._force_cost(self.motion) or 1.0)

    @property
    def closed(self) -> bool:
        """Whether the motion has no auxiliary forces."""
        return self.left == 0.0

    def policy(self) -> LinearPolicy:
        """The controls of the motion, with feedback that stabilizes it."""
        problem, motion = self.problem, self.motion.trajectory
        limits, u = problem.control_limits, problem.decided(motion)
        held = LinearPolicy(
            u,
            self._gains,
            states(problem, motion)[: -1 : problem.hold],
            problem.hold,
            "momentum" if problem.integrator.variational else "velocity",
            (limits[0], limits[1]),
            period=problem.period,
        )
        if not self._wanted.linear:
            return held
        # Lines through the means of neighbours. A line answers a state half a step later than a held control, so that
        # its feedback may do harm.
        nodes = np.vstack([u[:1], 0.5 * (u[:-1] + u[1:]), u[-1:]])
        nodes[1:] = with_ends(problem.scene, nodes[1:], u)
        nodes = self._wanted.begun(nodes)
        line = LinearPolicy(
            nodes[1:],
            held.gains,
            held.reference,
            on=held.on,
            limits=(limits[0], limits[1]),
            before=nodes[0],
            period=held.period,
            linear=True,
        )
        return min((line, line.without_feedback()), key=lambda policy: _cost_under(self._wanted, policy))

    def run(self, iterations: int, deadline: float, report: Callable[[Iteration, Trajectory], None]) -> None:
        """Remove the auxiliary forces, in at most ``iterations``; some may remain."""
        regularization = 0.0
        while not self.closed and len(self.history) < iterations and time.perf_counter() <= deadline:
            started = time.perf_counter()
            try:
                item = self._iterate(regularization)
            except (CostError, CustomForceError, LinearizationError) as error:
                logger.info("states: %s", error)
                break
            item = replace(item, index=len(self.history), seconds=time.perf_counter() - started)
            self.history.append(item)
            logger.info("states, auxiliary forces at %.3g of their first norm: %s", self.left, item)
            report(item, self.motion.trajectory)
            if item.step >= _LONG:
                regularization = regularization / _GROWTH if regularization > _LEAST else 0.0
                if item.expected_decrease <= _SETTLED * (item.cost + self._force_cost(self.motion)):
                    self._force_weight *= _WEIGHT_GROWTH
            else:
                regularization = max(_LEAST, _GROWTH * item.regularization)
                if regularization > _MOST:
                    break
        if not self.closed:
            logger.info("states: auxiliary forces at %.3g of their first norm are dropped", self.left)

    def _rolled(self, u: Floats, gains: Floats, reference: Floats) -> _Motion:
        """Integrate the motion under controls and auxiliary forces (R, m + n) with feedback."""
        problem = self.problem
        free = np.outer([-np.inf, np.inf], np.ones(len(self._free)))
        commands = Commands(
            u=u,
            gains=gains,
            reference=reference,
            hold=problem.hold,
            limits=np.hstack([problem.control_limits, free]),
            before=np.zeros((0, u.shape[1])),
        )
        full, failure = self._motions.under(commands)
        if failure is not None:
            raise StepFailure(full.steps, full.t[-1], named(problem.scene, failure), self._own(full))
        return self._of(full)

    def _own(self, full: Trajectory) -> Trajectory:
        """The motion with the problem's own controls only; the auxiliary forces are left out."""
        m = self.problem.scene.controls
        return replace(
            full, u=full.u[:, :m].copy(), u_stages=full.u_stages[:, :, :m], scene_values=self.problem.scene.values
        )

    def _of(self, full: Trajectory) -> _Motion:
        own = self._own(full)
        return _Motion(own, full, float(self.problem.shares(own).sum()))

    def _holding_cost(self) -> float:
        """Cost of the default first motion, under the holding policy; infinite where it fails."""
        return _cost_under(self.problem, self.problem.holding_policy())

    def _iterate(self, regularization: float) -> Iteration:
        """Remove all auxiliary forces at once if the motion follows the model; else reduce them."""
        motion, trials, passes = self.motion, 0, 0
        length = 0.0
        closed = self._closed(regularization)
        if closed is not None:
            (rise, gradient), passes, trials, length = closed, 2, 1, float(self.closed)
        if not self.closed:
            length, rise, gradient, more = self._smaller(regularization)
            passes, trials = passes + 1, trials + more
        return Iteration(
            index=0,
            cost=self.motion.cost,
            noise_cost=0.0,
            expected_decrease=-rise,
            decrease=motion.cost - self.motion.cost,
            step=length,
            regularization=regularization,
            gradient=gradient,
            backward_passes=passes,
            rollouts=trials,
            seconds=0.0,
        )

    def _closed(self, regularization: float) -> tuple[float, float] | None:
        """Try the multiple-shooting step that removes all auxiliary forces, (O14).

        Returns:
            The expected increase of the cost and the gradient's largest entry; None where the backward pass fails.
        """
        problem, motion, m = self.problem, self.motion, self.problem.scene.controls
        around = _Around(problem, self.scene, motion)
        plan = backward(problem, motion.trajectory, regularization, along=around)
        if plan is None:
            return None
        # First the linear response to the removal of the forces under the plan's feedback, then a pass around it.
        x, u = around.responded(plan, np.zeros_like(plan.feedforward), forces=True)
        shifted = around.shifted(x, u)
        found = backward(problem, motion.trajectory, regularization, along=shifted)
        if found is None:
            return None
        more_x, more_u = shifted.responded(found, found.feedforward, forces=False)
        x, u = x + more_x, u + more_u
        rise = around.change(x, u)
        at, old = states(problem, motion.trajectory)[: -1 : problem.hold], motion.full.u[:: problem.hold]
        gains, commands = np.zeros((*old.shape, at.shape[1])), np.zeros_like(old)
        gains[:, :m], commands[:, :m] = found.feedback, old[:, :m] + u
        gradient = float(np.abs(found.free_gradient(problem, motion.trajectory)).max())
        try:
            trial = self._rolled(commands, gains, at + x[: -1 : problem.hold])
        except _TRIAL_ERRORS as error:
            logger.info("states: without forces: %s", error)
            return rise, gradient
        most = _MOST_INCREASE * rise if rise > 0.0 else _LEAST_DECREASE * rise
        if trial.cost - motion.cost <= most and trial.cost <= max(self._cost_bound, 2.0 * motion.cost):
            self.motion, self._gains, self.left = trial, found.feedback, 0.0
        return rise, gradient

    def _smaller(self, regularization: float) -> tuple[float, float, float, int]:
        """One DDP step with the auxiliary forces as controls with a quadratic cost, (O15).

        Returns:
            The step length, the expected increase of the cost, the gradient's largest entry and the number of trials.
        """
        problem, motion, m = self.problem, self.motion, self.problem.scene.controls
        assisted = problem.changed(
            scene=self.scene,
            control_limits=np.hstack([problem.control_limits, np.outer([-np.inf, np.inf], np.ones(len(self._free)))]),
        )
        plan = backward(assisted, motion.full, regularization, along=self._weighted(assisted))
        if plan is None:
            return 0.0, np.nan, np.nan, 0
        at, old = states(problem, motion.trajectory)[: -1 : problem.hold], motion.full.u[:: problem.hold]
        here = motion.cost + self._force_cost(motion)
        length, trials = 0.0, 0
        for step in _LENGTHS:
            trials += 1
            try:
                trial = self._rolled(old + step * plan.feedforward, plan.feedback, at)
            except _TRIAL_ERRORS as error:
                logger.info("states: trial of length %g: %s", step, error)
                continue
            if trial.cost + self._force_cost(trial) - here <= _LEAST_DECREASE * step * plan.slope:
                self.motion, self._gains = trial, plan.feedback[:, :m]
                length, self.left = float(step), float(np.linalg.norm(trial.full.u[:, m:])) / self._first
                break
        gradient = float(np.abs(plan.free_gradient(assisted, motion.full)).max())
        return length, -plan.expected_decrease, gradient, trials

    def _force_cost(self, motion: _Motion) -> float:
        """Cost of the auxiliary forces of a motion."""
        force = motion.full.u[:, self.problem.scene.controls :]
        return 0.5 * self._force_weight * self.problem.dt * float(np.einsum("Na,ab,Nb->", force, self._weight, force))

    def _weighted(self, assisted: OptimalControlProblem) -> Along:
        """Expansions for backward passes in which the auxiliary forces are controls with a cost."""
        problem, motion = self.problem, self.motion
        m, samples, x = problem.scene.controls, len(problem.model_rule), 2 * problem.scene.robot.dof
        own = Along(problem, motion.trajectory)
        along = Along(assisted.changed(rate=None), motion.full)
        along.problem = assisted
        size = x + self.scene.controls
        weight = self._force_weight * self._weight
        running = own.running
        gradient, hessian = np.zeros((len(running.gradient), size)), np.zeros((len(running.gradient), size, size))
        gradient[:, : x + m], hessian[:, : x + m, : x + m] = running.gradient, running.hessian
        # All samples of a step have the same weight, so each has an equal share of the forces' cost.
        share = 1.0 / (samples * float(problem.rule[0, 0]))
        gradient[:, x + m :] = share * np.repeat(motion.full.u[:, m:] @ weight, samples, axis=0)
        hessian[:, x + m :, x + m :] = share * weight
        along.running, along.terminal = Expansion(gradient, hessian), own.terminal
        if problem.rate is not None:
            R, k = problem.decisions, self.scene.controls
            along.pull, along.rate = np.zeros((R, k)), np.zeros((R, k, k))
            along.pull[:, :m], along.rate[:, :m, :m] = own.pull, own.rate
        return along


class _Around(Along):
    """Expansions for backward passes along a motion with auxiliary forces."""

    def __init__(self, problem: OptimalControlProblem, scene: Scene, motion: _Motion) -> None:
        super().__init__(problem, motion.trajectory)
        m, n, q, v = problem.scene.controls, problem.scene.robot.dof, motion.trajectory.q, motion.trajectory.v
        lin = linearize_steps(scene, motion.full, problem.integrator, problem.q0)
        # Change of the state at the end of each step when its auxiliary force is removed.
        self.gap = -np.einsum("Nxf,Nf->Nx", lin.B[:, :, m:], motion.full.u[:, m:])
        self.rates = velocity_at_nodes(problem.scene, q, v) if problem.integrator.variational else None
        own = replace(lin, B=np.ascontiguousarray(lin.B[:, :, :m]), Gu=lin.Gu[:, :, :, :m])
        self.blocks = [(0, problem.steps)]
        self.kept = own, np.zeros((0, n, 2 * n)) if self.rates is None else self.rates

    def responded(self, plan: Plan, ahead: Floats, *, forces: bool) -> tuple[Floats, Floats]:
        """Response of the linearized motion: changes of the states (N + 1, 2n) and of the controls (R, m).

        Args:
            plan: The plan whose feedback acts.
            ahead: Feed-forward change of the controls (R, m).
            forces: Whether the auxiliary forces are removed.
        """
        problem, (lin, _) = self.problem, self.linearized(0, self.problem.steps)
        x, u = np.zeros((problem.steps + 1, lin.A.shape[1])), np.zeros_like(ahead)
        for j in range(problem.steps):
            k = j // problem.hold
            if j % problem.hold == 0:
                u[k] = ahead[k] + plan.feedback[k] @ x[j]
                if plan.previous is not None and k > 0:
                    u[k] += plan.previous[k] @ u[k - 1]
                if self.slack.size:
                    u[k] = np.clip(u[k], *self.slack[k])
            x[j + 1] = lin.A[j] @ x[j] + lin.B[j] @ u[k]
            if forces:
                x[j + 1] += self.gap[j]
        return x, u

    def _at_samples(self, x: Floats, u: Floats) -> tuple[Floats, Floats]:
        """Changes of (q, v, u) at the cost's samples and of (q, v) at the end.

        x (N + 1, 2n) and u (R, m) are the changes of the states and the controls.
        """
        problem, n = self.problem, self.problem.scene.robot.dof
        q, v = x[:, :n], x[:, n:] if self.rates is None else np.einsum("Nvx,Nx->Nv", self.rates, x)
        samples = np.concatenate(problem.model_samples(q, v, np.repeat(u, problem.hold, axis=0)), axis=1)
        return samples, np.concatenate([q[-1], v[-1]])

    def shifted(self, x: Floats, u: Floats) -> _Around:
        """The expansions shifted by changes of the states (N + 1, 2n) and controls (R, m), to second order."""
        there, (samples, end) = copy(self), self._at_samples(x, u)
        there.added = _products(self.running.hessian, samples)
        final, D = self.terminal, self.terminal.slopes
        pull = final.cost.gradient + end @ final.cost.hessian[0]
        there.terminal = final._replace(cost=replace(final.cost, gradient=pull), gradient=(pull @ D)[0])
        there.slack = self.slack - u[:, None] if self.slack.size else self.slack
        change = np.diff(u, axis=0, prepend=np.zeros_like(u[:1]))
        there.pull = self.pull + np.einsum("kab,kb->ka", self.rate, change) if self.pull.size else self.pull
        return there

    def change(self, x: Floats, u: Floats) -> float:
        """Change of the cost under the quadratic model, for changes of states (N + 1, 2n) and controls (R, m)."""
        weight, (samples, end) = self.problem.dt * float(self.problem.rule[0, 0]), self._at_samples(x, u)
        final = self.terminal.cost
        slope = weight * float((self.running.gradient * samples).sum()) + float(final.gradient[0] @ end)
        curvature = weight * float((_products(self.running.hessian, samples) * samples).sum())
        curvature += float(end @ final.hessian[0] @ end)
        if self.pull.size:
            change = np.diff(u, axis=0, prepend=np.zeros_like(u[:1]))
            slope += float((self.pull * change).sum())
            curvature += float(np.einsum("ka,kab,kb->", change, self.rate, change))
        return slope + 0.5 * curvature


def _held(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The problem with held controls in the place of linear ones, without penalties of their changes."""
    if not isinstance(problem, PenalizedProblem):
        return problem.changed(controls="held")
    rate = problem.rate.plain if isinstance(problem.rate, PenalizedRate) else problem.rate
    return problem.changed(controls="held", rate=rate, all_penalties=problem.penalties, given=None)


def _cost_under(problem: OptimalControlProblem, policy: LinearPolicy) -> float:
    """Cost of the motion under a policy, without noise; infinite where it fails."""
    own, n, m = problem.integrator, problem.scene.robot.dof, problem.scene.controls
    commands = policy.commands(problem.steps, m, n, own.variational, problem.dt, own.stage_times)
    if problem.linear:
        commands = commands._replace(before=problem.begun(commands.before))
    try:
        motion, failure = Motions(problem.scene, own, problem.q0, problem.v0, problem.dt).under(commands)
        return np.inf if failure is not None else float(problem.shares(motion).sum())
    except _TRIAL_ERRORS:
        return np.inf


def _products(hessian: Floats, z: Floats) -> Floats:
    """H z at each point (K, size)."""
    found: Floats = z @ hessian[0] if len(hessian) == 1 else (hessian @ z[:, :, None])[:, :, 0]
    return found
