"""The last step of a plan onto its active constraints: Newton's method on the exact linearization of its motion.

Equation (P4) of docs/plan-constraints.md. After the projected Newton step of Howell, Jackson and Manchester (2019),
with the least change of the controls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.control.backward import states
from varpin.control.constraints import BoundConstraint, BoundRate
from varpin.control.problem import OptimalControlProblem
from varpin.control.solution import Solution
from varpin.control.spread import Feedback, covariances, state_slopes
from varpin.control.trials import Trials
from varpin.core.arrays import Commands
from varpin.integrators.base import open_loop
from varpin.linearization import Linearization, linearize_steps
from varpin.trajectory import Trajectory

Mask = NDArray[np.bool_]

# Greatest number of Newton steps.
_STEPS = 8
# Greatest number of passes in a step that fix controls at their limits.
_CLIPS = 6
# Violation that counts as rounding error.
_DONE = 1e-12
# Regularization of the normal equations, relative to their diagonal, for linearly dependent rows.
_LITTLE = 1e-13


def onto_constraints(
    problem: OptimalControlProblem, plan: Solution, multipliers: list[Floats], backoff: list[Floats]
) -> Trajectory:
    """The motion near a plan's with the least violation of its constraints and controls within their limits.

    Args:
        problem: The problem with its constraints.
        plan: A nearly feasible plan; its feedback stabilizes the motions of the Newton steps.
        multipliers: For each constraint (K, rows); rows with positive multipliers are active.
        backoff: For each constraint (K, rows).
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
        # A row that a step violates becomes active and stays so: it may be next to an active one.
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
    """The largest violation over all constraints, each in its own unit."""
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
    """Commands with the least change of the controls that moves active rows onto their bounds, to first order, (P4)."""
    R, m = problem.decisions, problem.scene.controls
    u = motion.u[:: problem.hold]
    lower, upper = problem.control_limits
    free = (u > lower) & (u < upper)
    # Changes are weighed relative to the size of each control.
    size = np.abs(u).max(axis=0)
    size = np.where(size > 0.0, size, max(float(size.max()), 1.0))
    c = np.concatenate([value[rows] for value, rows in zip(values, active, strict=True)])
    linear = linearize_steps(problem.scene, motion, problem.integrator, problem.q0)
    ahead = np.zeros((R, m))
    for _ in range(_CLIPS):
        # Controls at a limit are fixed there, and the free ones make up for them.
        around = _Around(problem, motion, linear, plan, free)
        G = around.rows(active).reshape(-1, R, m)
        left = c + np.einsum("aRm,Rm->a", G, np.where(free, 0.0, ahead))
        ahead = np.where(free, _least_change((G * (free * size)).reshape(len(G), -1), left).reshape(R, m) * size, ahead)
        response, change = around.response(ahead)
        beyond = free & ((u + change < lower) | (u + change > upper))
        if not beyond.any():
            break
        free = free & ~beyond
        change = np.clip(u + change, lower, upper) - u
        ahead = np.where(beyond, change, ahead)
    gains, reference = plan.gains, states(problem, motion) + response
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
    """The linearization of a motion, and of its constraints, under a plan's feedback.

    The feedback returns the motion to the plan after a correction. Without it an unstable motion would diverge.

    Attributes:
        problem: The problem with its constraints.
        motion: The motion.
        linear: Linearization of its steps.
        plan: The plan with the feedback.
        free: Controls (R, m) on which the feedback acts.
    """

    problem: OptimalControlProblem
    motion: Trajectory
    linear: Linearization
    plan: Solution
    free: Mask

    def __post_init__(self) -> None:
        previous, acts = self.plan.previous_gains, self.free[:, :, None]
        self.gains = self.plan.gains * acts
        self.previous = np.zeros((*self.free.shape, self.free.shape[1])) if previous is None else previous * acts

    def rows(self, active: list[Mask]) -> Floats:
        """Derivatives (a, R m) of the active rows with respect to the feed-forward controls."""
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
            own, here = j // hold, node == j + 1
            back[here] += carried[here]
            G[:, own] += back @ self.linear.B[j]
            back = back @ self.linear.A[j]
            if j % hold == 0:
                # Through feedback the control depends on the state before it and on the previous control.
                back += G[:, own] @ self.gains[own]
                if own > 0:
                    G[:, own - 1] += G[:, own] @ self.previous[own]
        return G.reshape(total, R * m)

    def response(self, ahead: Floats) -> tuple[Floats, Floats]:
        """Changes of the states (N + 1, 2n) and controls (R, m) for feed-forward changes ``ahead`` (R, m)."""
        A, B, hold = self.linear.A, self.linear.B, self.problem.hold
        found, change = np.zeros((len(A) + 1, A.shape[1])), ahead.copy()
        for j in range(len(A)):
            k = j // hold
            if j % hold == 0:
                change[k] += self.gains[k] @ found[j]
                if k > 0:
                    change[k] += self.previous[k] @ change[k - 1]
            found[j + 1] = A[j] @ found[j] + B[j] @ change[k]
        return found, change


def _of_rate(item: BoundRate, k: NDArray[np.int64], r: NDArray[np.int64], R: int, m: int) -> Floats:
    """Derivatives (a, R, m) of rows of a rate limit with respect to the controls."""
    rows, limited = np.zeros((len(k), R, m)), item.limited
    signs, columns = np.where(r < len(limited), 1.0, -1.0), limited[r % len(limited)]
    decisions, index = item.places[k], np.arange(len(k))
    rows[index, decisions, columns] = signs / item.period
    later = decisions > 0
    rows[index[later], decisions[later] - 1, columns[later]] = -signs[later] / item.period
    return rows


def deviations(problem: OptimalControlProblem, plan: Solution, bound: BoundConstraint) -> Floats:
    """Standard deviations (K, rows) of a state constraint under the plan's feedback and the scene's noise."""
    motion = plan.trajectory
    found = covariances(problem, motion, Feedback(plan.gains, plan.previous_gains))
    J = bound.jacobian(motion.q, motion.v) @ state_slopes(problem, motion)[bound.places]
    variance = np.einsum("krx,kxy,kry->kr", J, found[bound.places], J)
    spread: Floats = np.sqrt(np.maximum(variance, 0.0))
    return spread
