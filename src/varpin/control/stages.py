"""The stages along a motion: dynamics, cost and rows as one quadratic program in all decisions.

Equation (O10) of docs/mathematics.md.

The variables are the changes z = (u_0, x_1, u_1, ..., x_R) of the states before each decision and of the controls; with
linear controls u_R follows. A control that is held over several steps makes one stage of them. No other file knows
whether controls are held or linear, or that the state holds momenta.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.control.along import Along
from varpin.control.constraints import BoundBetween, BoundConstraint, BoundOnCubics, BoundRate
from varpin.control.linear_controls import in_step, on_lines
from varpin.control.problem import OptimalControlProblem
from varpin.control.spread import state_slopes
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory


class Layout(NamedTuple):
    """Where the variables of a problem are.

    Attributes:
        states: 2n.
        controls: m.
        stages: R, the number of stages with dynamics.
        linear: Whether there is a control at the end.
    """

    states: int
    controls: int
    stages: int
    linear: bool

    @classmethod
    def of(cls, problem: OptimalControlProblem) -> Layout:
        """The layout of a problem."""
        scene = problem.scene
        return cls(2 * scene.robot.dof, scene.controls, problem.steps // problem.hold, problem.linear)

    @property
    def size(self) -> int:
        """The number of variables."""
        return self.stages * (self.states + self.controls) + self.linear * self.controls

    def state(self, k: Integers) -> Integers:
        """Indices (K, 2n) of states before decisions; -1 for the first one, which is given."""
        own = (k * (self.states + self.controls) - self.states)[:, None] + np.arange(self.states)
        return np.where(k[:, None] > 0, own, -1)

    def control(self, k: Integers) -> Integers:
        """Indices (K, m) of controls; -1 for that before the horizon."""
        own = (k * (self.states + self.controls))[:, None] + np.arange(self.controls)
        return np.where(k[:, None] >= 0, own, -1)

    def in_stage(self, k: Integers) -> Integers:
        """Indices (K, Z) of the variables of stages: (x, u), or (x, w, u) of linear controls."""
        ends = (k, k + 1) if self.linear else (k,)
        return np.concatenate([self.state(k), *map(self.control, ends)], axis=1)

    def decisions(self, feedback: Floats, previous: Floats | None) -> tuple[Integers, Floats]:
        """The changes of controls beside feedback (R, m): u - K x - G w, with w the previous control.

        Returns the indices (R, Z) of the variables and the derivatives (R, m, Z). A control that is linear reacts to
        the state where its line begins.

        Args:
            feedback: K (R, m, 2n).
            previous: G (R, m, m), or None.
        """
        R, m, _ = feedback.shape
        k = np.arange(R)
        w = np.zeros((R, m, m)) if previous is None else previous
        at = np.concatenate([self.state(k - self.linear), self.control(k - 1), self.control(k)], axis=1)
        return at, np.concatenate([-feedback, -w, np.broadcast_to(np.eye(m), w.shape)], axis=2)

    def controls_of(self, z: Floats) -> Floats:
        """The changes (R, m), or (R + 1, m), of the controls in z."""
        return z[self.control(np.arange(self.stages + self.linear))]

    def states_of(self, z: Floats) -> Floats:
        """The changes (R + 1, 2n) of the states in z."""
        at = self.state(np.arange(self.stages + 1))
        return np.where(at >= 0, z[at], 0.0)

    def joined(self, states: Floats, controls: Floats) -> Floats:
        """The variables of changes of the states (R + 1, 2n) and of the controls."""
        z = np.empty(self.size)
        z[self.state(np.arange(1, self.stages + 1))] = states[1:]
        z[self.control(np.arange(len(controls)))] = controls
        return z


class Cost(NamedTuple):
    """Quadratic costs, each of some variables."""

    at: Integers  # (K, Z) indices, -1 where there is none
    gradient: Floats  # (K, Z)
    hessian: Floats  # (K, Z, Z)


class Rows(NamedTuple):
    """The rows of one constraint, in tenths of its range."""

    values: Floats  # (P,) c with its margin
    at: Integers  # (P, Z) indices of variables, -1 where there is none
    slopes: Floats  # (P, Z)
    equality: bool


@dataclass(frozen=True, eq=False)
class Stages(Frozen):
    """The expansions along a motion, the matrices of (O10).

    Attributes:
        layout: Where the variables are.
        J: Derivatives of the state after each stage in its variables (R, 2n, Z).
        costs: The costs of the stages, of control changes and of the end.
    """

    layout: Layout
    J: Floats
    costs: tuple[Cost, ...]
    _within: Floats  # (N, 2n + .., Z): state and controls of each step in the variables of its stage; empty if hold = 1
    _velocity: Floats  # d(q, v)/dx at the nodes

    @classmethod
    def along(cls, along: Along, spread: Floats | None = None, curvature: Floats | None = None) -> Stages:
        """The stages of a motion with its expansions.

        Args:
            along: The expansions.
            spread: Hessians (N, 2n, 2n) of the cost to go in the state after each step, of which noise costs the half
                of g' S g; none without noise.
            curvature: Second derivatives (N, Z, Z) of the steps in the cost to go, where they count.
        """
        problem, motion = along.problem, along.trajectory
        layout, dt, rule = Layout.of(problem), problem.dt, problem.rule
        lin, velocity = along.linearized(0, problem.steps)
        J, gz = in_step(lin)
        N, _, Z = J.shape
        running, samples = along.running, len(rule)
        gradient, hessian = np.zeros((N, Z)), np.zeros((N, Z, Z))
        for s, D in enumerate(on_lines(rule, problem.places, J, velocity, layout.controls, ramps=problem.linear)):
            across, weight = np.swapaxes(D, 1, 2), dt * rule[s, 0]
            own = running.hessian[s::samples] if len(running.hessian) > 1 else running.hessian
            gradient += weight * (across @ running.gradient[s::samples, :, None])[:, :, 0]
            hessian += weight * (across @ (own @ D))
        if spread is not None:
            weighted = np.einsum("Nab,Nbkz->Nakz", spread, gz)
            gradient += np.einsum("Nakz,Nak->Nz", weighted, lin.G)
            hessian += np.einsum("Nakz,Naky->Nzy", gz, weighted)
        if curvature is not None:
            hessian += curvature
        within = np.zeros((0, Z, Z))
        if problem.hold > 1:
            within, J, gradient, hessian = _condensed(J, gradient, hessian, problem.hold)
        k = np.arange(layout.stages)
        costs = [Cost(layout.in_stage(k), gradient, hessian)]
        end = along.terminal
        costs.append(Cost(layout.state(np.array([layout.stages])), end.gradient[None], end.hessian[None]))
        if len(along.rate):
            k = np.arange(len(along.rate))
            at = np.concatenate([layout.control(k - 1), layout.control(k)], axis=1)
            pull, rate = along.pull, along.rate
            costs.append(Cost(at, np.concatenate([-pull, pull], axis=1), np.block([[rate, -rate], [-rate, rate]])))
        return cls(layout, J, tuple(costs), within, state_slopes(problem, motion))

    def rows(self, problem: OptimalControlProblem, motion: Trajectory, bound: BoundConstraint, margin: Floats) -> Rows:
        """The rows of a constraint along the motion, with a margin (K, rows)."""
        u = problem.control_rows(motion)
        values = (bound.value(motion.q, motion.v, u) + margin).ravel() / bound.scale
        at, slopes = self._rows_in_decisions(problem, motion, bound)
        return Rows(values, at, slopes / bound.scale, bound.source.equality)

    def _rows_in_decisions(
        self, problem: OptimalControlProblem, motion: Trajectory, bound: BoundConstraint
    ) -> tuple[Integers, Floats]:
        """Indices (P, Z) of the variables of a constraint's rows, and derivatives."""
        layout = self.layout
        if isinstance(bound, BoundRate):
            columns = bound.limited
            at = np.stack([layout.control(bound.places - 1)[:, columns], layout.control(bound.places)[:, columns]], 2)
            pair = np.broadcast_to(np.array([-1.0, 1.0]) / bound.period, at.shape)
            return np.concatenate([at, at], axis=1).reshape(-1, 2), np.concatenate([pair, -pair], 1).reshape(-1, 2)
        u = problem.control_rows(motion)
        if isinstance(bound, BoundOnCubics):
            parts = bound.by_nodes(bound.jacobian(motion.q, motion.v))
            nodes = bound.places - 1, bound.places
            found = [self._at_nodes(problem, k, part, None) for k, part in zip(nodes, parts, strict=True)]
            return np.concatenate([at for at, _ in found], axis=1), np.concatenate([J for _, J in found], axis=1)
        slopes = bound.slopes(motion.q, motion.v, u)
        controls = slopes.by_controls if isinstance(bound, BoundBetween) else None
        return self._at_nodes(problem, slopes.nodes, slopes.by_state, controls)

    def _at_nodes(
        self, problem: OptimalControlProblem, nodes: Integers, by_state: Floats, by_controls: Floats | None
    ) -> tuple[Integers, Floats]:
        """Indices and derivatives of rows, each (P, Z), from those (K, rows, 2n) in (q, v) of nodes and of controls."""
        layout, hold = self.layout, problem.hold
        of_x = by_state @ self._velocity[nodes]
        whole = by_controls is not None or hold > 1
        # The node at the end of a stage is a variable of its own; at the end of the horizon no stage begins.
        k = np.minimum(nodes // hold, layout.stages - 1) if whole else nodes
        at = layout.in_stage(k) if whole else layout.state(k)
        J = np.zeros((*of_x.shape[:2], at.shape[1]))
        J[:, :, : layout.states] = of_x
        if by_controls is not None:
            J[:, :, layout.states :] = by_controls
        if hold > 1:
            last = nodes == problem.steps
            J = J @ np.where(
                last[:, None, None], np.eye(at.shape[1]), self._within[np.minimum(nodes, problem.steps - 1)]
            )
            at = np.where(last[:, None], -1, at)
            at[last, : layout.states] = layout.state(np.array([layout.stages]))
        return np.repeat(at, by_state.shape[1], axis=0), J.reshape(-1, at.shape[1])

    def change(self, z: Floats) -> tuple[float, float]:
        """The slope of the cost along z, and its change at z by the quadratic model."""
        padded, slope, curvature = np.append(z, 0.0), 0.0, 0.0
        for at, gradient, hessian in self.costs:
            moved = np.where(at >= 0, padded[at], 0.0)
            slope += float((gradient * moved).sum())
            curvature += float((moved * (hessian @ moved[:, :, None])[:, :, 0]).sum())
        return slope, slope + 0.5 * curvature

    def slopes(self, rows: Sequence[Rows], multipliers: Sequence[Floats]) -> Floats:
        """The gradient of the Lagrangian in the controls (R, m), by costates."""
        return self.layout.controls_of(self._lagrangian(rows, multipliers))

    def costates(self, rows: Sequence[Rows], multipliers: Sequence[Floats]) -> Floats:
        """Derivatives (R, 2n) of the Lagrangian in the state after each stage."""
        return self._lagrangian(rows, multipliers)[self.layout.state(np.arange(1, self.layout.stages + 1))]

    def _lagrangian(self, rows: Sequence[Rows], multipliers: Sequence[Floats]) -> Floats:
        """Derivatives of the Lagrangian in all variables, states after them left free."""
        layout = self.layout
        total = np.zeros(layout.size + 1)
        for at, gradient, _ in self.costs:
            np.add.at(total, at, gradient)
        for row, push in zip(rows, multipliers, strict=True):
            np.add.at(total, row.at, push[:, None] * row.slopes)
        at = layout.in_stage(np.arange(layout.stages))
        for k in range(layout.stages - 1, -1, -1):
            np.add.at(total, at[k], self.J[k].T @ total[layout.state(np.array([k + 1]))[0]])
        return total

    def gaps_of(self, z: Floats) -> Floats:
        """What the linearized stages miss the states in z by (R, 2n)."""
        k, padded = np.arange(self.layout.stages), np.append(z, 0.0)
        at = self.layout.in_stage(k)
        moved = np.where(at >= 0, padded[at], 0.0)
        found: Floats = (self.J @ moved[:, :, None])[:, :, 0] - z[self.layout.state(k + 1)]
        return found


def _condensed(J: Floats, gradient: Floats, hessian: Floats, hold: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Steps (N, ...) whose control is held over some of them, as stages (R, ...).

    Returns the variables of each step in those of its stage (N, Z, Z), and J, gradient and Hessian of the stages.
    """
    N, x, Z = J.shape
    R = N // hold
    J, gradient, hessian = (part.reshape(R, hold, *part.shape[1:]) for part in (J, gradient, hessian))
    within = np.empty((R, hold, Z, Z))
    T = np.tile(np.eye(Z), (R, 1, 1))
    total, curved = np.zeros((R, Z)), np.zeros((R, Z, Z))
    for j in range(hold):
        within[:, j] = T
        across = np.swapaxes(T, 1, 2)
        total += (across @ gradient[:, j, :, None])[:, :, 0]
        curved += across @ hessian[:, j] @ T
        T = np.concatenate([J[:, j] @ T, T[:, x:]], axis=1)
    return within.reshape(N, Z, Z), T[:, :x], total, curved
