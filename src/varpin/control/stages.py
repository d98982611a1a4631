"""The stages along a motion: dynamics, costs, noise and rows, expanded for the recursion and for quadratic programs.

Equations (O4), (O9) and (O10) of docs/mathematics.md. No other file knows whether controls are held or linear, or that
the state holds momenta.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats, Integers, Mask
from varpin.control.between_nodes import BoundBetween
from varpin.control.constraints import BoundConstraint, BoundRate
from varpin.control.costs import CostError, Expansion
from varpin.control.problem import OptimalControlProblem
from varpin.control.samples import after_impulse, at_samples, beyond_samples
from varpin.linearization import Linearization, linearize_steps, velocity_at_nodes
from varpin.trajectory import Trajectory

# Rounding errors of costs and states, in units of the last digit.
_ROUNDED = 16.0 * float(np.finfo(np.float64).eps)


def states(problem: OptimalControlProblem, motion: Trajectory) -> Floats:
    """X (N + 1, 2n): (q, p) or (q, v)."""
    return np.concatenate((motion.q, motion.p if problem.integrator.variational else motion.v), axis=1)


@dataclass(frozen=True, eq=False)
class Feedback:
    """Gains (R, m, 2n) on the state, and (R, m, m) on the previous control where that matters."""

    state: Floats
    before: Floats | None


class Stake(NamedTuple):
    """The cost at stake along a motion, without constants and noise, (O9)."""

    free: float  # decrease of the quadratic models if all were free; infinite without a minimum, zero at the least cost
    moved: float  # each bounded by its change over the motion's displacement: tolerances are relative to it


def _stakes(model: Expansion, displacement: Floats) -> tuple[float, float]:
    """The sums of :class:`Stake` over quadratic models, along displacements (N, k) of their variables."""
    gradient, hessian = model.gradient, model.hessian
    bend = np.diagonal(hessian, axis1=1, axis2=2) + np.zeros_like(gradient)
    # Steepest descent, scaled by the diagonal: exact where no variables are coupled.
    step = np.divide(gradient, bend, out=np.zeros_like(gradient), where=bend > 0.0)
    slope, curvature = (gradient * step).sum(axis=1), _form(hessian, step)
    endless = ((gradient != 0.0) & ~(bend > 0.0)).any(axis=1) | ((slope > 0.0) & ~(curvature > 0.0))
    fall = np.where(endless, np.inf, 0.5 * slope**2 / np.where(curvature > 0.0, curvature, 1.0))
    bound = np.maximum(0.5 * _form(hessian, displacement), 0.0)
    return float(fall.sum()), float(np.minimum(bound, fall).sum())


def _form(hessian: Floats, z: Floats) -> Floats:
    """Z' H z (N,)."""
    form: Floats = (np.matmul(z[:, None, :], hessian)[:, 0] * z).sum(axis=1)
    return form


class Terminal(NamedTuple):
    """The terminal cost in (q, v), and its gradient (2n,) and Hessian (2n, 2n) in x."""

    cost: Expansion
    gradient: Floats
    hessian: Floats


def states_of(problem: OptimalControlProblem) -> int:
    """The number of states X of :class:`Recursion`."""
    m, x = problem.scene.controls, 2 * problem.scene.robot.dof
    return x + m + m % 2 if problem.linear or problem.rate is not None else x


class Recursion(NamedTuple):
    """Steps as the backward recursion takes them, in z = (X, u).

    X is x, or (x, w) where the control w before the decision matters, with a zero state where its size would be odd.
    Where controls are linear a first step, which takes no time, decides on the first one.
    """

    J: Floats  # (S, X, Z)
    gradient: Floats  # (S, Z) of the cost per dt
    hessian: Floats  # (S, Z, Z)
    G: Floats  # (S, X, k)
    Gz: Floats  # (S, X, k, Z)

    def without(self, fixed: Mask) -> Recursion:
        """The steps with controls (S, m) that change nothing, and have a minimum of their own at zero."""
        free = np.ones_like(self.gradient)
        free[:, -fixed.shape[1] :] = ~fixed
        hessian = self.hessian * free[:, :, None] * free[:, None]
        own = np.arange(free.shape[1])
        hessian[:, own, own] += 1.0 - free
        return Recursion(self.J * free[:, None], self.gradient * free, hessian, self.G, self.Gz * free[:, None, None])


class Layout(NamedTuple):
    """Where the variables of a problem are: z = (u_0, x_1, ..., x_hold, u_1, ...), and at the end a linear control."""

    state: Integers  # (N + 1, 2n); -1 for the first one, which is given
    control: Integers  # (R + 1, m); the last row is -1, for the control before the horizon
    stage: Integers  # (N, Z) of the variables of steps: (x, u), or (x, w, u) of linear controls
    decision: Integers  # (R, 2n + 2m) of x where a control, or the line to it, begins, the control before, and its own
    size: int  # the number of variables

    @classmethod
    def of(cls, problem: OptimalControlProblem) -> Layout:
        """The layout of a problem."""
        N, hold, R, linear = problem.steps, problem.hold, problem.decisions, problem.linear
        m, x = problem.scene.controls, 2 * problem.scene.robot.dof
        span, step, own = m + hold * x, np.arange(N), np.arange(R)
        state, control = np.full((N + 1, x), -1), np.full((R + 1, m), -1)
        state[1:] = (step // hold * span + m + step % hold * x)[:, None] + np.arange(x)
        control[:-1] = (own * span)[:, None] + np.arange(m)
        ends = (control[step], control[step + 1]) if linear else (control[step // hold],)
        begin = state[np.maximum(own - linear, 0) * hold]
        return cls(
            state,
            control,
            np.concatenate([state[:-1], *ends], axis=1),
            np.concatenate([begin, control[own - 1], control[own]], axis=1),
            N // hold * span + linear * m,
        )

    def joined(self, states: Floats, controls: Floats) -> Floats:
        """The variables of changes of the states (N + 1, 2n) and of the controls (R, m)."""
        z = np.empty(self.size)
        z[self.state[1:]] = states[1:]
        z[self.control[:-1]] = controls
        return z


class Cost(NamedTuple):
    """Quadratic costs, each of some variables."""

    at: Integers  # (K, Z) indices, -1 where there is none
    gradient: Floats  # (K, Z)
    hessian: Floats  # (K, Z, Z)


class Rows(NamedTuple):
    """The rows of one constraint, in tenths of its range."""

    at: Integers  # (P, Z) indices of variables, -1 where there is none
    slopes: Floats  # (P, Z)
    equality: bool


def change(costs: Sequence[Cost], z: Floats) -> tuple[float, float]:
    """The slope of costs along z, and their change at z by the quadratic model."""
    padded, slope, curvature = np.append(z, 0.0), 0.0, 0.0
    for at, gradient, hessian in costs:
        moved = padded[at]
        slope += float((gradient * moved).sum())
        curvature += float((moved * (hessian @ moved[:, :, None])[:, :, 0]).sum())
    return slope, slope + 0.5 * curvature


class Steps:
    """The steps of a motion; each expansion is made when it is first needed.

    The variables of a step are (x, u), or (x, w, u) with the controls w and u at its ends where they are linear, (O4).

    Raises:
        CostError: An expansion of the running cost is not finite; as the attributes are made.
        LinearizationError: A step has no derivative; likewise.
    """

    def __init__(self, problem: OptimalControlProblem, trajectory: Trajectory) -> None:
        self.problem, self.trajectory = problem, trajectory

    @cached_property
    def lin(self) -> Linearization:
        """The linearized steps."""
        problem = self.problem
        return linearize_steps(problem.scene, self.trajectory, problem.integrator, problem.q0, ramps=problem.linear)

    @cached_property
    def J(self) -> Floats:
        """Derivatives of the state after each step in its variables (N, 2n, Z)."""
        lin = self.lin
        own = (lin.B,) if lin.ramp is None else (lin.B - lin.ramp, lin.ramp)
        return np.concatenate([lin.A, *own], axis=2)

    @cached_property
    def Gz(self) -> Floats:
        """Derivatives of the noise's effect in the variables (N, 2n, k, Z)."""
        lin = self.lin
        own = (lin.Gu,) if lin.Gramp is None else (lin.Gu - lin.Gramp, lin.Gramp)
        return np.concatenate([lin.Gx, *own], axis=3)

    @cached_property
    def _velocity(self) -> Floats:
        """dv/dx at the nodes (N + 1, n, 2n), with x = (q, p)."""
        return velocity_at_nodes(self.problem.scene, self.trajectory.q, self.trajectory.v)

    @cached_property
    def slopes(self) -> Floats:
        """d(q, v)/dx at the nodes (N + 1, 2n, 2n)."""
        n = self.problem.scene.robot.dof
        found = np.tile(np.eye(2 * n), (len(self.trajectory.q), 1, 1))
        if self.problem.integrator.variational:
            found[:, n:] = self._velocity
        return found

    @cached_property
    def _at_samples(self) -> tuple[Floats, Floats, Floats]:
        """q, v and u at the samples."""
        motion = self.trajectory
        return self.problem.samples(motion.q, motion.v, self.problem.control_rows(motion))

    @cached_property
    def running(self) -> Expansion:
        """The running cost at its samples."""
        found = self.problem.running.expand(*self._at_samples)
        for name, array in (("gradient", found.gradient), ("Hessian", found.hessian)):
            if not np.isfinite(array).all():
                raise CostError(repr(self.problem.cost), f"its {name} along the motion is not finite")
        return found

    @property
    def _hessians(self) -> Floats:
        """Hessians (N, s, 2n + m, 2n + m) of the running cost at the samples."""
        N, samples, size = len(self.trajectory.u), len(self.problem.rule), self.running.hessian.shape[-1]
        return np.broadcast_to(self.running.hessian, (N * samples, size, size)).reshape(N, samples, size, size)

    @cached_property
    def terminal(self) -> Terminal:
        """The terminal cost at the end of the motion."""
        problem, motion, x = self.problem, self.trajectory, slice(0, 2 * self.problem.scene.robot.dof)
        end = problem.terminal.expand(motion.q[-1:], motion.v[-1:], np.zeros((1, problem.scene.controls)))
        # Contiguous, as the core takes them.
        cost = Expansion(end.gradient[:1, x], np.ascontiguousarray(end.hessian[:1, x, x]))
        D = self.slopes[-1]
        return Terminal(cost, D.T @ cost.gradient[0], D.T @ cost.hessian[0] @ D)

    @cached_property
    def rate(self) -> tuple[Floats, Floats]:
        """Gradients (R, m) and Hessians (R, m, m) of the cost of each change of the controls; empty without one."""
        problem, m = self.problem, self.problem.scene.controls
        if problem.rate is None:
            return np.zeros((0, m)), np.zeros((0, m, m))
        return problem.rate.expand(problem.decided(self.trajectory), problem.period)

    @cached_property
    def costs(self) -> tuple[Floats, Floats]:
        """Gradients (N, Z) and Hessians (N, Z, Z) of the running cost of each step in its variables."""
        problem, rule, m = self.problem, self.problem.rule, self.problem.scene.controls
        N, x, Z = self.J.shape
        D = np.zeros((N, len(rule), x + m, Z))
        D[:, :, :x] = at_samples(rule, self.J, self.slopes[:, x // 2 :])
        late = problem.places if problem.linear else np.ones(len(rule))
        D[:, :, x:, x : x + m] = (1.0 - late)[:, None, None] * np.eye(m)
        D[:, :, x:, Z - m :] = late[:, None, None] * np.eye(m)
        weight = problem.dt * rule[0, 0]  # the same for all samples
        across = np.swapaxes(D.reshape(N, -1, Z), 1, 2)
        gradient = weight * (across @ self.running.gradient.reshape(N, -1, 1))[:, :, 0]
        return gradient, weight * (across @ (self._hessians @ D).reshape(N, -1, Z))

    @cached_property
    def beyond(self) -> Floats | None:
        """Of :attr:`kicked` (N, 2n, 2n) per dt what no sample sees, and so no path; None if nothing."""
        x = 2 * self.problem.scene.robot.dof
        hessian = self._hessians[:, :, :x, :x]
        end = self.terminal.cost.hessian[0]
        return beyond_samples(self.problem, self.trajectory, self.lin, hessian, self._velocity, end)

    @cached_property
    def kicked(self) -> Floats:
        """Hessians (N, 2n, 2n) of what the noise of a step costs within it, in its effect on the state after it."""
        x, problem = 2 * self.problem.scene.robot.dof, self.problem
        hessian, velocity = self._hessians[:, :, :x, :x], self.slopes[:, x // 2 :]
        found = after_impulse(problem.rule, hessian, velocity, problem.dt)
        return problem.dt * (found if self.beyond is None else found + self.beyond)

    def of_noise(self, spread: Floats) -> tuple[Floats, Floats]:
        """Gradients (N, Z) and Hessians (N, Z, Z) of g' S g / 2 with Hessians S (N, 2n, 2n) in the noise's effect g."""
        N, x, k, Z = self.Gz.shape
        weighted = (spread @ self.Gz.reshape(N, x, k * Z)).reshape(N, x * k, Z)
        gradient = (np.swapaxes(weighted, 1, 2) @ self.lin.G.reshape(N, x * k, 1))[:, :, 0]
        return gradient, np.swapaxes(self.Gz.reshape(N, x * k, Z), 1, 2) @ weighted

    def closed(self, feedback: Feedback, *, halves: bool = False) -> Floats:
        """Matrices (N, Z, Z) to the variables of each step, from the state before it and the controls of the last one.

        With ``halves`` these are halves of the steps whose linear controls the feedback decides.
        """
        (N, x, Z), m = self.J.shape, self.problem.scene.controls
        begin, own = slice(x, x + m), slice(Z - m, Z)
        found = np.tile(np.eye(Z), (N, 1, 1))
        if self.problem.linear:
            found[:, begin] = np.eye(m, Z, Z - m)
        decided = slice(None, None, 2 if halves else self.problem.hold)
        found[decided, own] = 0.0
        found[decided, own, :x] = feedback.state[int(self.problem.linear) :]
        if feedback.before is not None:
            found[decided, own, own] = feedback.before[int(self.problem.linear) :]
        if halves:
            # The control in the middle is the mean of those at the ends, and so that at the end follows from it.
            found[decided, own] = 0.5 * (found[decided, begin] + found[decided, own])
            found[1::2, own] = 2.0 * np.eye(m, Z, Z - m) - np.eye(m, Z, x)
        return found

    @cached_property
    def _wide(self) -> Recursion:
        problem, (N, x, _), X = self.problem, self.J.shape, states_of(self.problem)
        gradient, hessian = (part / problem.dt for part in self.costs)
        if self.lin.G.shape[2]:
            slope, bend = self.of_noise(self.kicked / problem.dt)
            gradient, hessian = gradient + slope, hessian + bend
        narrow = Recursion(self.J, gradient, hessian, self.lin.G, self.Gz)
        if x == X:
            return narrow
        m, first, k = problem.scene.controls, int(problem.linear), self.lin.G.shape[2]
        w, u, kept = slice(x, x + m), slice(X, X + m), self._places
        J, G, Gz = (np.zeros((N + first, X, *sizes)) for sizes in ((X + m,), (k,), (k, X + m)))
        gradient, hessian = np.zeros((N + first, X + m)), np.zeros((N + first, X + m, X + m))
        J[:first, :x, :x] = np.eye(x)
        J[:, w, u] = np.eye(m)
        J[first:, :x, kept], G[first:, :x], Gz[first:, :x, :, kept] = narrow.J, narrow.G, narrow.Gz
        gradient[first:, kept], hessian[first:, kept[:, None], kept] = narrow.gradient, narrow.hessian
        if problem.rate is not None:
            pull, rate = (part / problem.dt for part in self.rate)
            decided = slice(None, None, problem.hold)
            change = np.eye(m, X + m, X) - np.eye(m, X + m, x)
            gradient[decided] += pull @ change
            hessian[decided] += change.T @ rate @ change
        found, begin = Recursion(J, gradient, hessian, G, Gz), problem.begin
        if np.isnan(begin).all():
            return found
        fixed = np.zeros((N + first, m), dtype=bool)
        fixed[0] = ~np.isnan(begin)
        return found.without(fixed)

    @property
    def _places(self) -> Integers:
        """Where the variables of steps are in z of :class:`Recursion`."""
        m, Z = self.problem.scene.controls, self.J.shape[2]
        return np.concatenate([np.arange(Z - m), states_of(self.problem) + np.arange(m)])

    def recursion(self, curvature: Floats | None, fixed: Mask | None) -> Recursion:
        """The steps for the recursion, with second derivatives (N, Z, Z), and controls (R, m) that stay ``fixed``."""
        found, kept = self._wide, self._places
        if curvature is not None:
            hessian = found.hessian.copy()
            hessian[int(self.problem.linear) :, kept[:, None], kept] += curvature / self.problem.dt
            found = found._replace(hessian=hessian)
        return found if fixed is None else found.without(np.repeat(fixed, self.problem.hold, axis=0))

    @cached_property
    def stake(self) -> Stake:
        """The cost at stake along the motion, (O9)."""
        start = np.concatenate([self.problem.q0, self.problem.v0])
        free = moved = 0.0
        for factor, expansion, z in self._models:
            change = z.copy()
            change[:, : len(start)] -= start
            could, does = _stakes(expansion, change)
            free, moved = free + factor * could, moved + factor * does
        if self.problem.rate is not None:
            rate = float(self.problem.rate.shares(self.problem.decided(self.trajectory), self.problem.period).sum())
            free, moved = free + rate, moved + rate
        return Stake(free, moved)

    def rounding(self, here: Floats, there: Floats) -> float:
        """Rounding error of the difference between the costs of this motion and a neighbour, from their shares."""
        changed = here != there
        total = np.abs(here[changed]).sum() + np.abs(there[changed]).sum()
        for factor, expansion, z in self._models:
            total += factor * (np.abs(expansion.gradient) * np.abs(z)).sum()
        return _ROUNDED * float(total)

    @property
    def _models(self) -> tuple[tuple[float, Expansion, Floats], ...]:
        """Weights, expansions and variables of the cost at the samples, (q, v, u), and at the end, (q, v)."""
        problem, motion = self.problem, self.trajectory
        along = np.concatenate(self._at_samples, axis=1)
        end = np.concatenate([motion.q[-1:], motion.v[-1:]], axis=1)
        return (problem.dt * float(problem.rule[0, 0]), self.running, along), (1.0, self.terminal.cost, end)

    @cached_property
    def layout(self) -> Layout:
        """Where the variables are."""
        return Layout.of(self.problem)

    def quadratic(self, spread: Floats | None = None, curvature: Floats | None = None) -> list[Cost]:
        """The costs of the steps, of the end and of control changes, (O10).

        With what noise costs by Hessians S (N, 2n, 2n), and second derivatives (N, Z, Z) of the steps.
        """
        layout, (gradient, hessian) = self.layout, self.costs
        if spread is not None:
            gradient, hessian = (a + b for a, b in zip((gradient, hessian), self.of_noise(spread), strict=True))
        if curvature is not None:
            hessian = hessian + curvature
        costs, end, (pull, rate) = [Cost(layout.stage, gradient, hessian)], self.terminal, self.rate
        costs.append(Cost(layout.state[-1:], end.gradient[None], end.hessian[None]))
        if len(rate):
            at = layout.decision[:, layout.state.shape[1] :]
            costs.append(Cost(at, np.concatenate([-pull, pull], axis=1), np.block([[rate, -rate], [-rate, rate]])))
        return costs

    def rows(self, bound: BoundConstraint) -> Rows:
        """The rows of a constraint along the motion."""
        at, slopes = self._in_decisions(bound)
        return Rows(at, slopes / bound.scale, bound.source.equality)

    def _in_decisions(self, bound: BoundConstraint) -> tuple[Integers, Floats]:
        """Indices (P, Z) of the variables of a constraint's rows, and derivatives."""
        layout, motion = self.layout, self.trajectory
        if isinstance(bound, BoundRate):
            columns = bound.limited
            at = np.stack([layout.control[bound.places - back][:, columns] for back in (1, 0)], axis=2)
            pair = np.broadcast_to(np.array([-1.0, 1.0]) / bound.period, at.shape)
            return np.concatenate([at, at], axis=1).reshape(-1, 2), np.concatenate([pair, -pair], 1).reshape(-1, 2)
        if isinstance(bound, BoundBetween) and bound.ends is not None:
            J = bound.slopes(motion.q, motion.v, self.problem.control_rows(motion))
            begins, x = bound.places - 1, layout.state.shape[1]
            at = layout.stage[begins]
            J = np.concatenate([J[:, :, :x] @ self.slopes[begins], J[:, :, x:]], axis=2)
        else:
            nodes, slopes = [bound.places], [bound.jacobian(motion.q, motion.v)]
            if isinstance(bound, BoundBetween):
                nodes, slopes = [bound.places - 1, bound.places], bound.by_nodes(slopes[0])
            at = np.concatenate([layout.state[k] for k in nodes], axis=1)
            J = np.concatenate([part @ self.slopes[k] for k, part in zip(nodes, slopes, strict=True)], axis=2)
        return np.repeat(at, len(bound.rows), axis=0), J.reshape(-1, J.shape[2])

    def lagrangian(self, costs: Sequence[Cost], rows: Sequence[Rows], multipliers: Sequence[Floats]) -> Floats:
        """Derivatives of the Lagrangian in all variables, states after them left free."""
        layout = self.layout
        total = np.zeros(layout.size + 1)
        for at, gradient, _ in costs:
            np.add.at(total, at, gradient)
        for row, push in zip(rows, multipliers, strict=True):
            np.add.at(total, row.at, push[:, None] * row.slopes)
        for k in range(len(self.J) - 1, -1, -1):
            np.add.at(total, layout.stage[k], self.J[k].T @ total[layout.state[k + 1]])
        return total

    def gaps_of(self, z: Floats) -> Floats:
        """What the linearized stages miss the states in z by (R, 2n)."""
        moved = np.append(z, 0.0)[self.layout.stage]
        found: Floats = (self.J @ moved[:, :, None])[:, :, 0] - z[self.layout.state[1:]]
        return found
