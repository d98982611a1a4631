"""Explicit integrators on (q, v), for comparison: they do not preserve the symplectic structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy

from varpin import core
from varpin.arrays import Floats
from varpin.core import ExplicitMethod, Mechanism, Outcome
from varpin.core.arrays import FilterArrays, FilterLog
from varpin.errors import LinearizationError
from varpin.integrators.base import Integrator, Run, Varied, drifts, forces
from varpin.mechanics.scene import Scene, refuse_constraints
from varpin.trajectory import Trajectory

REASONS: dict[int, str] = {
    Outcome.not_finite: "the state is no longer finite: the motion runs away",
    Outcome.singular: "the mass matrix is not positive definite",
}


@dataclass(frozen=True)
class _Explicit(Integrator):
    """The base class of explicit methods."""

    method: ClassVar[ExplicitMethod]
    variational = False
    # In a motion no mass matrix but that of angles beyond rounding is singular.
    reasons = dict.fromkeys(REASONS, REASONS[Outcome.not_finite])

    def begun(self, scene: Scene, q0: Floats, v0: Floats) -> Run:
        refuse_constraints(scene, self)
        return Run(core.ExplicitRollout.start(scene.core, self.method, q0, v0), len(q0))

    def damped(self, z: Floats) -> tuple[Floats, Floats]:
        kept = np.polynomial.polynomial.polyval(-z, 1.0 / scipy.special.factorial(np.arange(self.order + 1)))
        return kept, kept

    def linearize(
        self, scene: Scene, trajectory: Trajectory, *, ramps: bool = False
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """See :meth:`Integrator.linearize`; the state is (q, v)."""
        refuse_constraints(scene, self)
        Jx, Jf = self._derivatives(scene, trajectory)
        ramp = ramps and bool(self.stage_times)
        Jr = self._derivatives(scene, trajectory, ramp=True)[1] if ramp else 0.5 * Jf
        return Jx, Jf, self._jump(Jx[:, :, scene.robot.dof :]), Jr

    def _derivatives(self, scene: Scene, trajectory: Trajectory, *, ramp: bool = False) -> tuple[Floats, Floats]:
        h = trajectory.dt
        q, v = trajectory.q[:-1], trajectory.v[:-1]
        force = forces(scene, trajectory, drifts(scene, trajectory))
        Jx, Jf, done = core.linearize_explicit(scene.core, self.method, h, q, v, force, ramp)
        if done < len(q):
            raise LinearizationError(done, done * h, REASONS[Outcome.singular])
        return Jx, Jf

    def in_parameters(self, scene: Scene, trajectory: Trajectory, varied: Sequence[Varied]) -> Floats:
        """See :meth:`Integrator.in_parameters`; equation (X2).

        At a stage M da = dF - d(M a + bias) + what moves it: a difference of inverse dynamics at fixed (q, v, a).
        """
        h, q, v = trajectory.dt, trajectory.q[:-1], trajectory.v[:-1]
        own, around = forces(scene, trajectory), [each for pair in varied for each in (pair.above, pair.below)]
        given, distance = [forces(each, trajectory) for each in around], np.array([each.distance for each in varied])
        times, stage_q, stage_v, end_q, end_v = core.nystroem(self.method)
        # Of all stages, zero before they are known.
        a, da = np.zeros((len(times), *q.shape)), np.zeros((len(times), *q.shape, len(varied)))
        for i, time in enumerate(times):
            at = self.stage_times.index(time) if own.shape[1] > 1 else 0
            Q = q + h * (time * v + h * np.tensordot(stage_q[i], a, 1))
            V = v + h * np.tensordot(stage_v[i], a, 1)
            a[i], aq, av, _ = accelerations(scene, Q, V, own[:, at])
            pulls = [_pull(each.core, Q, V, a[i], f[:, at]) for each, f in zip(around, given, strict=True)]
            push = (np.stack(pulls[1::2], axis=2) - np.stack(pulls[::2], axis=2)) / distance
            before_q, before_v = (np.tensordot(weights[i], da, 1) for weights in (stage_q, stage_v))
            da[i] = np.linalg.solve(scene.core.jets(Q, V)[0], push) + h * (aq @ (h * before_q) + av @ before_v)
        return np.concatenate([h * h * np.tensordot(end_q, da, 1), h * np.tensordot(end_v, da, 1)], axis=1)

    def filtered(self, scene: Scene, log: FilterLog) -> FilterArrays:
        """See :meth:`Integrator.filtered`; the state is (q, v)."""
        return self._reached(core.filter_explicit(scene.core, self.method, log), log, REASONS)

    def _jump(self, in_v: Floats) -> Floats:
        """Derivatives of each step in a jump (N, 2n, n), from those in the velocity."""
        return in_v


def _pull(mechanism: Mechanism, q: Floats, v: Floats, a: Floats, force: Floats) -> Floats:
    """What accelerations (N, n) need beyond the forces that act (N, n) [N m or N]."""
    return core.inverse_dynamics(mechanism, q, v, a) - force - mechanism.forces(q, v, force)[0]


def accelerations(scene: Scene, q: Floats, v: Floats, force: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Accelerations (N, n) under constant forces, and their derivatives in q, v and force, each (N, n, n).

    Raises:
        LinearizationError: A mass matrix is not positive definite.
    """
    a, aq, av, af, done = core.accelerations(scene.core, q, v, force)
    if done < len(q):
        raise LinearizationError(0, 0.0, REASONS[Outcome.singular])
    return a, aq, av, af


@dataclass(frozen=True)
class ExplicitEuler(_Explicit):
    """q1 = q0 + h v0, v1 = v0 + h a(q0, v0), of first order; the comparison of the paper."""

    method: ClassVar[ExplicitMethod] = ExplicitMethod.euler
    order = 1
    kicks_after = True

    def damped(self, z: Floats) -> tuple[Floats, Floats]:
        return 1.0 - z, np.ones_like(z)

    def _jump(self, in_v: Floats) -> Floats:
        n = in_v.shape[2]
        return np.tile(np.eye(2 * n, n, -n), (len(in_v), 1, 1))


@dataclass(frozen=True)
class SemiImplicitEuler(_Explicit):
    """v1 = v0 + h a(q0, v0), q1 = q0 + h v1, of first order; the method of most physics engines."""

    method: ClassVar[ExplicitMethod] = ExplicitMethod.semi_implicit
    order = 1


@dataclass(frozen=True)
class RungeKutta4(_Explicit):
    """The classical Runge-Kutta method, of fourth order without noise."""

    method: ClassVar[ExplicitMethod] = ExplicitMethod.runge_kutta
    order = 4
    stage_times = (0.0, 0.5, 1.0)
