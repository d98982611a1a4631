"""The backward recursion along a motion: feedback, the change of the controls, the foreseen decrease, and noise costs.

Equation (O2) of docs/mathematics.md. Where the recursion loses too many digits, the value function is kept as a sum of
squares (1/2) |R x + r|^2, without its Hessian R'R: see :mod:`varpin.control.square_root`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from varpin import core
from varpin.arrays import Floats, Mask
from varpin.control.problem import OptimalControlProblem
from varpin.control.sizes import HARMLESS
from varpin.control.square_root import RootPass, squares_of
from varpin.control.stages import Recursion, Steps, states_of
from varpin.integrators.base import noise_fields
from varpin.linearization import velocity_at_nodes, velocity_curvature
from varpin.trajectory import Trajectory


class Plan(NamedTuple):
    """The result of a backward pass: gains, feed-forward changes of the controls, and the expected decrease."""

    feedforward: Floats  # (R, m)
    gains: Floats  # (R, m, X) on the states of the recursion
    states: int  # 2n
    gradient: Floats  # (R, m)
    slope: float
    noise: float  # cost of the noise along the motion
    jumps: Floats  # (N, 2n, n), empty without noise
    spread: Floats  # (N, 2n, 2n), likewise: Hessians in the noise's effect on the state after each step
    loss: float  # estimated relative rounding error of Quu, or of its root
    factors: Floats  # (R, m, m) L D L' of the regularized Quu

    @classmethod
    def none(cls, problem: OptimalControlProblem) -> Plan:
        """What is known before the first pass: no feedback and no change of the controls."""
        R, m, x = problem.decisions, problem.scene.controls, 2 * problem.scene.robot.dof
        gains, still, noise = np.zeros((R, m, states_of(problem))), np.zeros((R, m)), problem.scene.processes
        jumps, spread, factors = np.empty((0, x, x // 2)), np.empty((0, x, x)), np.zeros((R, m, m))
        cost = np.nan if noise else 0.0
        return cls(still, gains, x, np.full((R, m), np.nan), 0.0, cost, jumps, spread, 0.0, factors)

    @property
    def feedback(self) -> Floats:
        """Gains (R, m, 2n) on the state."""
        return self.gains[:, :, : self.states]

    @property
    def previous(self) -> Floats | None:
        """Gains (R, m, m) on the previous control, with a rate cost or linear controls."""
        x, (_, m, X) = self.states, self.gains.shape
        return self.gains[:, :, x : x + m] if x < X else None

    @property
    def beside(self) -> Floats:
        """Derivatives (R, m, 2n + 2m) of u - K x - G w, the changes of controls u beside feedback.

        K is on the state x where a held control, or the line to a linear one, begins, G on the previous control w.
        """
        R, m, _ = self.gains.shape
        own = np.broadcast_to(np.eye(m), (R, m, m))
        return np.concatenate([-self.feedback, 0.0 * own if self.previous is None else -self.previous, own], axis=2)

    @property
    def expected_decrease(self) -> float:
        """Decrease of the expected cost with a full step, by the model."""
        # The step is the model's minimum, where the curvature is -slope.
        return -0.5 * self.slope


def backward(
    steps: Steps, regularization: float, *, curvature: Floats | None = None, fixed: Mask | None = None
) -> Plan | None:
    """The plain recursion, or, where its rounding errors are large and the model is convex, that on square roots.

    ``curvature`` are second derivatives (N, Z, Z) of the steps in the cost to go, ``fixed`` which controls (R, m) stay
    as they are. None where the model has no minimum.
    """
    expanded = steps.recursion(curvature, fixed)
    plain = _pass(steps, expanded, regularization, second=curvature is not None, roots=False)
    if curvature is not None or (plain is not None and plain.loss <= HARMLESS):
        return plain
    return _pass(steps, expanded, regularization, second=False, roots=True) or plain


def _pass(steps: Steps, given: Recursion, regularization: float, *, second: bool, roots: bool) -> Plan | None:
    """One recursion, on square ``roots`` or not; with ``second`` derivatives, those of the last velocity count, too."""
    problem, end, motion = steps.problem, steps.terminal, steps.trajectory
    (S, X, Z), (N, x, _), k = given.J.shape, steps.J.shape, given.G.shape[2]
    m, R = Z - X, problem.decisions
    gradient, hessian = np.pad(end.gradient, (0, X - x)), np.pad(end.hessian, (0, X - x))
    if second and problem.integrator.variational:
        pull = end.cost.gradient[:, x // 2 :]
        hessian[:x, :x] += velocity_curvature(problem.scene, motion.q[-1:], motion.v[-1:], pull)[0]
    feedforward, gains, by_controls = np.empty((R, m)), np.empty((R, m, X)), np.empty((R, m))
    spread, factors = np.empty((S if k else 0, X, X)), np.empty((R, m, m))
    arrays: dict[str, Any] = {
        "A": given.J[:, :, :X],
        "B": given.J[:, :, X:],
        "G": given.G,
        "Gx": given.Gz[..., :X],
        "Gu": given.Gz[..., X:],
        "gradient": given.gradient,
        "hessian": given.hessian,
        "feedforward": feedforward,
        "feedback": gains,
        "control_gradient": by_controls,
        "spread": spread,
        "factors": factors,
    }
    found: core.BackwardPass | RootPass
    if roots:
        final = squares_of(end.cost.gradient, end.cost.hessian)
        running = squares_of(given.gradient, given.hessian)
        if final is None or running is None:
            return None
        found = RootPass(m, final.after(steps.slopes[-1]).padded(X), gradient)
        failed = found.run(problem.dt, problem.hold, float(regularization), **(arrays | {"hessian": running}))
    else:
        found = core.BackwardPass(m, gradient, hessian)
        failed = found.run(problem.dt, problem.hold, float(regularization), **arrays)
    if failed >= 0 or not (math.isfinite(found.slope) and math.isfinite(found.curvature)):
        return None
    jumps, noise = np.empty((0, x, x // 2)), found.noise
    spread = spread[:, :x, :x]
    if k:
        jumps, G, spread = steps.lin.J, steps.lin.G, spread[S - N :] + steps.kicked
        noise += 0.5 * float((G * (steps.kicked @ G)).sum())
    return Plan(feedforward, gains, x, by_controls, found.slope, noise, jumps, spread, found.loss, factors)


def foreseen(steps: Steps, plan: Plan) -> tuple[Floats, bool]:
    """The changes of the variables of :class:`Layout` under a plan, by the linear model, clipped to control limits.

    Also whether a control reaches a limit.
    """
    problem, given = steps.problem, steps.recursion(None, None)
    (S, X, _), layout = given.J.shape, steps.layout
    R, m = plan.feedforward.shape
    slack = np.zeros((0, 2, m))
    if problem.limited:
        slack = problem.control_limits - problem.decided(steps.trajectory)[:, None]
    moves, after = np.empty((R, m)), np.empty((S, X))
    limited = core.foresee(
        problem.hold, given.J[:, :, :X], given.J[:, :, X:], plan.feedforward, plan.gains, slack, moves, after
    )
    x = np.vstack([np.zeros((1, plan.states)), after[:, : plan.states]])
    return layout.joined(x[-problem.steps - 1 :], moves), limited


def noise_shares(problem: OptimalControlProblem, motion: Trajectory, plan: Plan) -> Floats:
    """Noise cost of each step of a motion (N,), with the noise's effect and value function of the plan's own motion.

    Empty where there is no noise.
    """
    if problem.scene.processes == 0:
        return np.zeros(0)
    scene, n, left = problem.scene, problem.scene.robot.dof, problem.integrator.left
    q, v = motion.q, motion.v
    jump = noise_fields(scene, motion, q[:-1], v[:-1], problem.q0).F
    if not problem.integrator.variational:
        jump = velocity_at_nodes(scene, q[:-1], v[:-1])[:, :, n:] @ jump
    g = left * (plan.jumps @ jump)
    if left < 1.0:
        g[:, n:] += (1.0 - left) * noise_fields(scene, motion, q[1:], v[1:], problem.q0).F
    added: Floats = 0.5 * np.einsum("Nai,Nai->N", g, plan.spread @ g)
    return added
