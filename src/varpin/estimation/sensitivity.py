"""Derivatives of a motion in parameters of its scene.

Equation (L5) of docs/mathematics.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.estimation.parameters import parameters_of
from varpin.integrators.base import Integrator, Varied
from varpin.linearization import Linearization, linearize, matching_integrator, velocity_at_nodes
from varpin.mechanics.scene import Scene, require_scene
from varpin.support.checks import finite_array
from varpin.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Gradient:
    """The gradient of a loss of a motion.

    Attributes:
        parameters: In the parameters (P,), with q0, v0 and the controls fixed.
        q0: In the first configuration (n,), with v0 fixed.
        v0: In the first velocity (n,).
        u: In the controls (N, m), each constant over its step.
    """

    parameters: Floats
    q0: Floats
    v0: Floats
    u: Floats


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Derivatives of a motion of N steps in P parameters, with q0, v0 and the controls fixed.

    Attributes:
        names: Names of the parameters (P,).
        values: Their values (P,).
        q: Derivatives of the configurations (N + 1, n, P).
        v: Of the velocities (N + 1, n, P).
        p: Of the momenta (N + 1, n, P).
    """

    names: tuple[str, ...]
    values: Floats
    q: Floats
    v: Floats
    p: Floats
    _map: MotionMap

    def __repr__(self) -> str:
        nodes, n, P = self.q.shape
        return f"Sensitivities({nodes} nodes, {n} joints, {P} parameters)"

    @property
    def start(self) -> Floats:
        """Derivatives of (q, v) at the nodes in (q0, v0) (N + 1, 2n, 2n)."""
        return self._map.forward(np.eye(2 * self.q.shape[1]), np.zeros((len(self.q), 1, 1)))

    def gradient(
        self, loss_q: ArrayLike | None = None, *, loss_v: ArrayLike | None = None, loss_p: ArrayLike | None = None
    ) -> Gradient:
        """The gradient of a loss of the motion by one adjoint pass: what it costs does not grow with P.

        Args:
            loss_q: Derivatives of the loss in the configurations at the nodes (N + 1, n); zero if left out.
            loss_v: In the velocities (N + 1, n).
            loss_p: In the momenta (N + 1, n).

        Raises:
            InputError: A shape is wrong, or a value is not finite.
        """
        shape = self.q.shape[:2]
        given = {"loss_q": loss_q, "loss_v": loss_v, "loss_p": loss_p}
        in_q, in_v, in_p = (
            np.zeros(shape) if loss is None else finite_array(name, loss, shape) for name, loss in given.items()
        )
        return self._map.backward(in_q, in_v, in_p)


@dataclass(frozen=True, eq=False)
class MotionMap:
    """The linear map from parameters, start and controls to nodes: x' = A x + B u + D theta of x = (q, v)."""

    A: Floats  # (N, 2n, 2n)
    B: Floats  # (N, 2n, m)
    D: Floats  # (N, 2n, P)
    to_p: Floats  # (N + 1, n, 2n) of p in (q, v)
    pull: Floats  # (N + 1, n, P) of p at fixed (q, v)

    def forward(self, x: Floats, D: Floats) -> Floats:
        """States (N + 1, 2n, k) from the first (2n, k), where each step adds D (N, 2n, k)."""
        states = np.empty((len(self.A) + 1, *x.shape))
        states[0] = x
        for j, A in enumerate(self.A):
            states[j + 1] = A @ states[j] + D[j]
        return states

    def backward(self, in_q: Floats, in_v: Floats, in_p: Floats) -> Gradient:
        n = in_q.shape[1]
        loss = np.concatenate([in_q, in_v], axis=1) + np.einsum("ka,kab->kb", in_p, self.to_p)
        theta = np.einsum("ka,kap->p", in_p, self.pull)
        row, u = loss[-1], np.empty((len(self.B), self.B.shape[2]))
        for j in range(len(self.A) - 1, -1, -1):
            u[j], theta = row @ self.B[j], theta + row @ self.D[j]
            row = loss[j] + row @ self.A[j]
        return Gradient(theta, row[:n], row[n:], u)


def sensitivities(
    scene: Scene, motion: Trajectory, parameters: str | Sequence[str], *, integrator: Integrator | None = None
) -> Sensitivities:
    """Exact derivatives of a motion in parameters of its scene.

    They are those of the discrete map, (L5), step by step beside the linearization: x_theta' = A x_theta + dx'/dtheta,
    where dx'/dtheta solves the factored step equation of A and B.

    Main args:
        scene: The scene of the motion; constraints and kinematic inputs are no obstacle.
        motion: From :func:`varpin.simulate`, without noise. Its controls are held as they were.
        parameters: Names, see :func:`varpin.estimation.parameters.parameters_of`: ``"damping"``,
            ``"friction:elbow_joint"``, ``"payload"``, ``"inertia:wrist_3_link"``.

    Other Args:
        integrator: As for :func:`varpin.linearize`.

    Raises:
        InputError: As :func:`varpin.linearize`; the motion has noise; a name stands for no parameter; or the integrator
            has no derivatives in parameters.
        LinearizationError: A step has no solution.
    """
    if motion.noisy:
        raise InputError("sensitivities are of a motion without noise, and this one has it: simulate it without rng=")
    if require_scene(scene).noise.velocity_dependent:
        raise InputError("sensitivities do not take noise whose fields depend on the velocity, as its drift has M^-1")
    of = parameters_of(scene, parameters)
    linear = linearize(scene, motion, integrator=integrator)
    chosen = matching_integrator(scene, motion, integrator)
    by = motion_map(scene, motion, of.varied(), linear, chosen)
    x, n = by.forward(np.zeros(by.D.shape[1:]), by.D), scene.robot.dof
    return Sensitivities(of.names, of.values, x[:, :n], x[:, n:], by.to_p @ x + by.pull, by)


def motion_map(
    scene: Scene, motion: Trajectory, varied: Sequence[Varied], linear: Linearization, integrator: Integrator
) -> MotionMap:
    """The map of a motion with its linearization."""
    q, v, n = motion.q, motion.v, scene.robot.dof
    M, Lvq = scene.core.jets(q, v)
    to_p, pull = np.concatenate([Lvq, M], axis=2), np.zeros((*q.shape, len(varied)))
    for k, each in enumerate(varied):
        above, below = (near.core.jets(q, v)[0] for near in (each.above, each.below))
        pull[:, :, k] = np.einsum("kij,kj->ki", above - below, v) / each.distance
    A, B, D = linear.A, linear.B, np.zeros((len(linear.A), 2 * n, 0))
    if varied:
        D = integrator.in_parameters(scene, motion, varied)
    if integrator.variational:
        to_v = velocity_at_nodes(scene, q, v)[1:]
        D = D + A[:, :, n:] @ pull[:-1]
        A = np.concatenate([A[:, :, :n], np.zeros_like(A[:, :, n:])], axis=2) + A[:, :, n:] @ to_p[:-1]
        A, B, D = (np.concatenate([x[:, :n], to_v @ x], axis=1) for x in (A, B, D))
        D[:, n:] -= to_v[:, :, n:] @ pull[1:]
    return MotionMap(A, B, D, to_p, pull)
