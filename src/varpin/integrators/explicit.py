"""Explicit integrators on (q, v), for comparison: they keep no structure, and where they are good is measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from varpin.errors import LinearizationError, SingularMassMatrix
from varpin.integrators.base import (
    Integrator,
    Segment,
    control_of,
    diffusion_and_drift,
    drifts,
    open_loop,
    read_only,
    segments_of,
    steps_of,
)
from varpin.kernels import explicit as kernels
from varpin.kernels.dynamics import Dynamics, forward_derivatives, new_dynamics
from varpin.kernels.tree import Commands, new_nodes
from varpin.lagrangian import lagrangian_jet
from varpin.scene import Scene
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

REASONS = {
    kernels.NOT_FINITE: "the state is no longer finite",
    kernels.SINGULAR: "the mass matrix is not positive definite",
}


@dataclass(frozen=True)
class ExplicitRun:
    """Where a rollout stands, with its work arrays."""

    state: kernels.ExplicitState
    dynamics: Dynamics
    room: Floats
    start: Floats


@dataclass(frozen=True)
class _Explicit(Integrator):
    """What the explicit methods share."""

    scheme: ClassVar[int]
    variational = False

    def start(self, scene: Scene, q0: Floats, v0: Floats) -> tuple[ExplicitRun, list[Segment]]:
        """See :meth:`Integrator.start`."""
        paths, n = q0.shape
        run = ExplicitRun(
            kernels.new_explicit_state(q0, v0, scene.mechanism.diffusion.center),
            new_dynamics(scene.robot.tree.parent.size, n),
            np.zeros((8, n)),
            q0.copy(),
        )
        nodes = new_nodes(paths, 1, n, scene.controls)
        if not kernels.first_nodes(scene.mechanism, run.state, run.dynamics, nodes):
            raise SingularMassMatrix(scene.robot.joint_names, q0)
        return run, segments_of(nodes, REASONS)

    def fork(self, state: ExplicitRun) -> ExplicitRun:
        """See :meth:`Integrator.fork`."""
        return replace(state, state=kernels.ExplicitState._make(array.copy() for array in state.state))

    def step_in_python(
        self, scene: Scene, state: ExplicitRun, command: Commands, increment: Floats, dt: float
    ) -> Segment:
        """One step of one path with diffusion fields that are evaluated in Python.

        The impulse is handed over as the drift of a constant force is: spread over the step for explicit Euler, which
        is the same there, and as a jump of the velocity before the step for the others.
        """
        q, v = state.state.q[0], state.state.v[0]
        control = control_of(command, 0, np.concatenate([q, v]), command.before)
        F, drift = diffusion_and_drift(scene, q, v, control, state.start[0])
        if len(increment):
            impulse = F @ increment[0, 0]
            if self.scheme == kernels.EULER:
                drift = drift + impulse / dt
            else:
                v += np.linalg.solve(mass(scene, q), impulse)
        nothing = np.zeros((0, 0, scene.mechanism.diffusion.constant.shape[1]))
        (segment,) = self.rollout_compiled(scene, state, open_loop(control[None]), nothing, drift[None, None], dt)
        return segment

    def rollout_compiled(
        self, scene: Scene, state: ExplicitRun, commands: Commands, increments: Floats, drift: Floats, dt: float
    ) -> list[Segment]:
        """See :meth:`Integrator.rollout_compiled`."""
        nodes = new_nodes(len(state.state.q), steps_of(commands), scene.robot.dof, scene.controls)
        kernels.rollout(
            scene.mechanism,
            self.scheme,
            dt,
            commands,
            increments,
            drift,
            state.state,
            state.dynamics,
            state.room,
            nodes,
        )
        return segments_of(nodes, REASONS)


def mass(scene: Scene, q: Floats) -> Floats:
    """M(q) (n, n)."""
    return lagrangian_jet(scene, q, np.zeros_like(q)).Lvv


def accelerations(scene: Scene, q: Floats, v: Floats, force: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Accelerations (N, n) under constant forces, and their derivatives in q, v and force, each (N, n, n).

    Raises:
        LinearizationError: A mass matrix is not positive definite.
    """
    N, n = q.shape
    bodies = scene.robot.tree.parent.size
    a, aq, av, af = np.empty((N, n)), np.empty((N, n, n)), np.empty((N, n, n)), np.empty((N, n, n))
    Z, P, Q = np.zeros((3, bodies, 6))
    q, v, force = read_only(q), read_only(v), read_only(force)
    if not forward_derivatives(scene.mechanism, q, v, force, Z, P, Q, new_dynamics(bodies, n), a, aq, av, af):
        raise LinearizationError(0, 0.0, REASONS[kernels.SINGULAR])
    return a, aq, av, af


def _forces(scene: Scene, trajectory: Trajectory) -> Floats:
    """The constant force of each step (N, n): of the controls and of the noise's drift."""
    force: Floats = trajectory.u @ scene.actuation.T + drifts(scene, trajectory)
    return force


@dataclass(frozen=True)
class ExplicitEuler(_Explicit):
    """q1 = q0 + h v0, v1 = v0 + h a(q0, v0): of first order, and the paper's comparison."""

    scheme: ClassVar[int] = kernels.EULER
    order = 1

    def linearize(self, scene: Scene, trajectory: Trajectory) -> tuple[Floats, Floats, Floats]:
        """See :meth:`Integrator.linearize`; the state is (q, v)."""
        h, n = trajectory.dt, scene.robot.dof
        _, aq, av, af = accelerations(scene, trajectory.q[:-1], trajectory.v[:-1], _forces(scene, trajectory))
        one, zero = np.broadcast_to(np.eye(n), aq.shape), np.zeros_like(aq)
        Jx = np.block([[one, h * one], [h * aq, one + h * av]])
        return Jx, np.concatenate([zero, h * af], axis=1), np.concatenate([zero, one], axis=1)


@dataclass(frozen=True)
class SemiImplicitEuler(_Explicit):
    """v1 = v0 + h a(q0, v0), q1 = q0 + h v1: of first order; most physics engines step so."""

    scheme: ClassVar[int] = kernels.SEMI_IMPLICIT
    order = 1

    def linearize(self, scene: Scene, trajectory: Trajectory) -> tuple[Floats, Floats, Floats]:
        """See :meth:`Integrator.linearize`; the state is (q, v)."""
        h, n = trajectory.dt, scene.robot.dof
        _, aq, av, af = accelerations(scene, trajectory.q[:-1], trajectory.v[:-1], _forces(scene, trajectory))
        one = np.broadcast_to(np.eye(n), aq.shape)
        Jx = np.block([[one + h * h * aq, h * (one + h * av)], [h * aq, one + h * av]])
        return Jx, np.concatenate([h * h * af, h * af], axis=1), Jx[:, :, n:]


@dataclass(frozen=True)
class RungeKutta4(_Explicit):
    """The classical method of Runge and Kutta: of fourth order without noise."""

    scheme: ClassVar[int] = kernels.RUNGE_KUTTA
    order = 4

    def linearize(self, scene: Scene, trajectory: Trajectory) -> tuple[Floats, Floats, Floats]:
        """See :meth:`Integrator.linearize`; the state is (q, v). The four stages are differentiated in turn."""
        h, n = trajectory.dt, scene.robot.dof
        q, v, force = trajectory.q[:-1], trajectory.v[:-1], _forces(scene, trajectory)
        steps = len(q)
        identity = np.broadcast_to(np.eye(2 * n), (steps, 2 * n, 2 * n))
        at_q, at_v = q, v
        in_x, in_f = identity, np.zeros((steps, 2 * n, n))
        Jx, Jf = identity.copy(), np.zeros((steps, 2 * n, n))
        for weight, ahead in ((h / 6.0, 0.5 * h), (h / 3.0, 0.5 * h), (h / 3.0, h), (h / 6.0, 0.0)):
            a, aq, av, af = accelerations(scene, at_q, at_v, force)
            slope_x = np.concatenate([in_x[:, n:], aq @ in_x[:, :n] + av @ in_x[:, n:]], axis=1)
            slope_f = np.concatenate([in_f[:, n:], aq @ in_f[:, :n] + av @ in_f[:, n:] + af], axis=1)
            Jx += weight * slope_x
            Jf += weight * slope_f
            at_q, at_v = q + ahead * at_v, v + ahead * a
            in_x, in_f = identity + ahead * slope_x, ahead * slope_f
        return Jx, Jf, Jx[:, :, n:]
