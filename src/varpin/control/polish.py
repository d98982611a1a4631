"""A last step of a plan onto its active constraints, by Newton on the exact linearization of its motion.

Equation (P4) of docs/plan-constraints.md.
After the projected Newton step of Howell, Jackson and Manchester (2019), with the least change of the controls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.control.backward import states
from varpin.control.constraints import BoundConstraint, BoundRate
from varpin.control.problem import OptimalControlProblem
from varpin.control.solution import Solution
from varpin.control.trials import Trials
from varpin.core.arrays import Commands
from varpin.integrators.base import open_loop
from varpin.linearization import linearize_steps, velocity_at_nodes
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_STEPS = 8
# Of a step, how often controls that it takes beyond their limits are put there.
_CLIPS = 6
# What is left is rounding.
_DONE = 1e-12
# Of the diagonal, what rows that depend on each other need.
_LITTLE = 1e-13


def onto_constraints(
    problem: OptimalControlProblem, plan: Solution, multipliers: list[Floats], backoff: list[Floats]
) -> Trajectory:
    """The motion next to a plan's that violates its constraints least, with controls within their limits.

    Args:
        problem: The problem with its constraints.
        plan: A plan that all but keeps to them; its feedback holds the motion on the way.
        multipliers: Of each constraint (K, rows): where they are not zero the constraint is to hold with equality.
        backoff: Of each constraint (K, rows).
    """
    best, worst = plan.trajectory, _worst(problem, plan.trajectory, backoff)
    trials, motion = Trials(problem), plan.trajectory
    active = [
        np.full(multiplier.shape, item.source.equality) | (multiplier > 0.0)
        for item, multiplier in zip(problem.bound_constraints, multipliers, strict=True)
    ]
    for _ in range(_STEPS):
        if worst <= _DONE:
            break
        values = [c + b for c, b in zip(_values(problem, motion), backoff, strict=True)]
        # A row that a step has run into stays: it may be next to one that the plan is held back by.
        active = [rows | (c > 0.0) for rows, c in zip(active, values, strict=True)]
        attempt = trials.attempt(_corrected(problem, plan, motion, values, active))
        if not attempt.whole:
            break
        motion = attempt.trajectory()
        now = _worst(problem, motion, backoff)
        if now < worst:
            best, worst = motion, now
    return best


def _worst(problem: OptimalControlProblem, motion: Trajectory, backoff: list[Floats]) -> float:
    """The largest violation, each in its own unit."""
    values = [c + b for c, b in zip(_values(problem, motion), backoff, strict=True)]
    parts = [
        np.abs(c).max() if item.source.equality else c.max()
        for item, c in zip(problem.bound_constraints, values, strict=True)
    ]
    return max(0.0, *map(float, parts))


def _values(problem: OptimalControlProblem, motion: Trajectory) -> list[Floats]:
    return [item.value(motion.q, motion.v, motion.u) for item in problem.bound_constraints]


def _corrected(
    problem: OptimalControlProblem,
    plan: Solution,
    motion: Trajectory,
    values: list[Floats],
    active: list[Mask],
) -> Commands:
    """The motion's controls with the least change that brings its active rows to their bounds, to first order."""
    R, m = problem.decisions, problem.scene.controls
    u = motion.u[:: problem.hold]
    lower, upper = problem.control_limits
    around = _Around(problem, motion)
    G = around.rows(active).reshape(-1, R, m)
    free = (u > lower) & (u < upper)
    # Controls of large machines may change more than those of small ones.
    size = np.abs(u).max(axis=0)
    size = np.where(size > 0.0, size, max(float(size.max()), 1.0))
    c = np.concatenate([value[rows] for value, rows in zip(values, active, strict=True)])
    change = np.zeros((R, m))
    for _ in range(_CLIPS):
        # What has met a limit stays there, and the others do its part.
        left = c + np.einsum("aRm,Rm->a", G, np.where(free, 0.0, change))
        change = np.where(
            free, _least_change((G * (free * size)).reshape(len(G), -1), left).reshape(R, m) * size, change
        )
        beyond = free & ((u + change < lower) | (u + change > upper))
        if not beyond.any():
            break
        free = free & ~beyond
        change = np.clip(u + change, lower, upper) - u
    gains, reference = plan.gains, states(problem, motion) + around.moved(change)
    reference = reference[: -1 : problem.hold]
    if plan.previous_gains is not None:
        before = np.vstack([u[:1], (u + change)[:-1]])
        gains, reference = np.concatenate([gains, plan.previous_gains], axis=2), np.hstack([reference, before])
    return open_loop(u + change)._replace(
        hold=problem.hold,
        limits=problem.control_limits.copy(),
        gains=np.ascontiguousarray(gains),
        reference=np.ascontiguousarray(reference),
    )


def _least_change(G: Floats, c: Floats) -> Floats:
    """The shortest x with G x = -c, where rows of G may depend on each other."""
    length = np.linalg.norm(G, axis=1)
    length = np.where(length > 0.0, length, 1.0)
    unit = G / length[:, None]
    square = unit @ unit.T
    square[np.diag_indices(len(square))] += _LITTLE * len(square)
    found: Floats = -(unit.T @ np.linalg.solve(square, c / length))
    return found


@dataclass
class _Around:
    """The linearization of a motion, with what constraints make of it."""

    problem: OptimalControlProblem
    motion: Trajectory

    def __post_init__(self) -> None:
        problem, motion = self.problem, self.motion
        self.linear = linearize_steps(problem.scene, motion, problem.integrator, problem.q0)

    def rows(self, active: list[Mask]) -> Floats:
        """Derivatives (a, R m) of the active rows in the controls of all decisions."""
        problem, motion = self.problem, self.motion
        n, R, m, hold = problem.scene.robot.dof, problem.decisions, problem.scene.controls, problem.hold
        total = sum(int(rows.sum()) for rows in active)
        G = np.zeros((total, R, m))
        carried, node = np.zeros((total, 2 * n)), np.full(total, -1)
        slopes = state_slopes(problem, motion)
        begin = 0
        for item, rows in zip(problem.bound_constraints, active, strict=True):
            k, r = np.nonzero(rows)
            part = slice(begin, begin + len(k))
            begin += len(k)
            if isinstance(item, BoundRate):
                G[part] = _of_rate(item, k, r, R, m)
            else:
                places = item.places[k]
                J = item.jacobian(motion.q, motion.v)[k, r]
                carried[part] = np.einsum("ax,axy->ay", J, slopes[places])
                node[part] = places
        back = np.zeros_like(carried)
        for j in reversed(range(problem.steps)):
            here = node == j + 1
            back[here] = carried[here]
            G[:, j // hold] += back @ self.linear.B[j]
            back = back @ self.linear.A[j]
        return G.reshape(total, R * m)

    def moved(self, change: Floats) -> Floats:
        """What changes (R, m) of the controls do to the states (N + 1, 2n), to first order."""
        A, B, hold = self.linear.A, self.linear.B, self.problem.hold
        found = np.zeros((len(A) + 1, A.shape[1]))
        for j in range(len(A)):
            found[j + 1] = A[j] @ found[j] + B[j] @ change[j // hold]
        return found


def _of_rate(item: BoundRate, k: NDArray[np.int64], r: NDArray[np.int64], R: int, m: int) -> Floats:
    """Derivatives (a, R, m) of rows of the controls' rate."""
    rows, limited = np.zeros((len(k), R, m)), item.limited
    signs, columns = np.where(r < len(limited), 1.0, -1.0), limited[r % len(limited)]
    decisions, index = item.places[k], np.arange(len(k))
    rows[index, decisions, columns] = signs / item.period
    later = decisions > 0
    rows[index[later], decisions[later] - 1, columns[later]] = -signs[later] / item.period
    return rows


def state_slopes(problem: OptimalControlProblem, motion: Trajectory) -> Floats:
    """d(q, v)/dx at the nodes (N + 1, 2n, 2n)."""
    n = problem.scene.robot.dof
    slopes = np.tile(np.eye(2 * n), (len(motion.q), 1, 1))
    if problem.integrator.variational:
        slopes[:, n:] = velocity_at_nodes(problem.scene, motion.q, motion.v)
    return slopes


def deviations(problem: OptimalControlProblem, plan: Solution, bound: BoundConstraint) -> Floats:
    """Standard deviations (K, rows) of a constraint of states under the plan's feedback and the scene's noise.

    The covariance is that of the linearization, P' = Ac P Ac' + dt sum_i E[g_i g_i'] with each control held over its
    decision, as :func:`varpin.propagate_moments` has it without feedback. Limits of controls are not in it.
    """
    motion, n, m = plan.trajectory, problem.scene.robot.dof, problem.scene.controls
    lin = linearize_steps(problem.scene, motion, problem.integrator, problem.q0)
    x = 2 * n
    # Of the state and the control that holds, together.
    P, found = np.zeros((x + m, x + m)), np.zeros((problem.steps + 1, x, x))
    for j in range(problem.steps):
        if j % problem.hold == 0:
            k = j // problem.hold
            take = np.eye(x + m)
            take[x:, :x] = plan.gains[k]
            take[x:, x:] = 0.0 if plan.previous_gains is None else plan.previous_gains[k]
            P = take @ P @ take.T
        step = np.eye(x + m)
        step[:x, :x], step[:x, x:] = lin.A[j], lin.B[j]
        slope = np.concatenate([lin.Gx[j], lin.Gu[j]], axis=2)
        kick = np.einsum("aib,bc,dic->ad", slope, P, slope) + lin.G[j] @ lin.G[j].T
        P = step @ P @ step.T
        P[:x, :x] += lin.dt * kick
        found[j + 1] = P[:x, :x]
    J = bound.jacobian(motion.q, motion.v) @ state_slopes(problem, motion)[bound.places]
    variance = np.einsum("krx,kxy,kry->kr", J, found[bound.places], J)
    spread: Floats = np.sqrt(np.maximum(variance, 0.0))
    return spread
