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
from varpin.core.arrays import Commands, FilterArrays, FilterLog
from varpin.errors import LinearizationError
from varpin.integrators.base import (
    Integrator,
    Run,
    Segment,
    Varied,
    drifts,
    forces,
)
from varpin.mechanics.scene import Scene, refuse_constraints
from varpin.trajectory import Trajectory

REASONS: dict[int, str] = {
    Outcome.not_finite: "the state is no longer finite: the motion runs away, as where damping is faster than the step",
    Outcome.singular: "the mass matrix is not positive definite",
}


@dataclass(frozen=True)
class _Explicit(Integrator):
    """The base class of explicit methods."""

    method: ClassVar[ExplicitMethod]
    # Times of the stages, and the weights of accelerations before them and at the end, as in explicit.hpp.
    reach: ClassVar[tuple[float, ...]] = (0.0,)
    stage_q: ClassVar[tuple[tuple[float, ...], ...]] = ((),)
    stage_v: ClassVar[tuple[tuple[float, ...], ...]] = ((),)
    end_q: ClassVar[tuple[float, ...]] = (0.0,)
    end_v: ClassVar[tuple[float, ...]] = (1.0,)
    variational = False
    # In a motion no mass matrix but that of angles beyond rounding is singular.
    reasons = dict.fromkeys(REASONS, REASONS[Outcome.not_finite])

    def begun(self, scene: Scene, q0: Floats, v0: Floats) -> Run:
        refuse_constraints(scene, self)
        return Run(core.ExplicitRollout.start(scene.core, self.method, q0, v0), q0.copy())

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
        q, v = (np.ascontiguousarray(x[:-1]) for x in (trajectory.q, trajectory.v))
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
        a: list[Floats] = []
        da: list[Floats] = []
        for time, in_q, in_v in zip(self.reach, self.stage_q, self.stage_v, strict=True):
            at = self.stage_times.index(time) if own.shape[1] > 1 else 0
            Q = np.ascontiguousarray(q + h * (time * v + h * _weighed(in_q, a, q)))
            V = np.ascontiguousarray(v + h * _weighed(in_v, a, v))
            values, aq, av, _ = accelerations(scene, Q, V, own[:, at])
            pulls = [_pull(each.core, Q, V, values, f[:, at]) for each, f in zip(around, given, strict=True)]
            push = (np.stack(pulls[1::2], axis=2) - np.stack(pulls[::2], axis=2)) / distance
            moved = np.linalg.solve(scene.core.jets(Q, V)[0], push)
            none = np.zeros_like(moved)
            moved = moved + h * (aq @ (h * _weighed(in_q, da, none)) + av @ _weighed(in_v, da, none))
            a.append(values)
            da.append(moved)
        ends = h * h * _weighed(self.end_q, da, none), h * _weighed(self.end_v, da, none)
        return np.concatenate(ends, axis=1)

    def filtered(self, scene: Scene, log: FilterLog) -> FilterArrays:
        """See :meth:`Integrator.filtered`; the state is (q, v)."""
        return self._reached(core.filter_explicit(scene.core, self.method, log), log, REASONS)

    def _jump(self, in_v: Floats) -> Floats:
        """Derivatives of each step in a jump (N, 2n, n), from those in the velocity."""
        return in_v


def _weighed(weights: Sequence[float], values: Sequence[Floats], none: Floats) -> Floats:
    """The sum of some of the values by their weights; ``none`` without weights."""
    total = np.zeros_like(none)
    for weight, value in zip(weights, values, strict=True):
        total += weight * value
    return total


def _pull(mechanism: Mechanism, q: Floats, v: Floats, a: Floats, force: Floats) -> Floats:
    """What accelerations (N, n) need beyond the forces that act (N, n) [N m or N]."""
    force = np.ascontiguousarray(force)
    return core.inverse_dynamics(mechanism, q, v, a) - force - mechanism.forces(q, v, force)[0]


def accelerations(scene: Scene, q: Floats, v: Floats, force: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Accelerations (N, n) under constant forces, and their derivatives in q, v and force, each (N, n, n).

    Raises:
        LinearizationError: A mass matrix is not positive definite.
    """
    q, v, force = (np.ascontiguousarray(x) for x in (q, v, force))
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

    def kicked(
        self, scene: Scene, state: Run, command: Commands, drift: Floats, impulse: Floats | None, dt: float
    ) -> Segment:
        # As a constant force over the step, which is the same.
        drift = drift if impulse is None else drift + impulse / dt
        return super().kicked(scene, state, command, drift, None, dt)

    def _jump(self, in_v: Floats) -> Floats:
        n = in_v.shape[2]
        return np.tile(np.eye(2 * n, n, -n), (len(in_v), 1, 1))


@dataclass(frozen=True)
class SemiImplicitEuler(_Explicit):
    """v1 = v0 + h a(q0, v0), q1 = q0 + h v1, of first order; the method of most physics engines."""

    method: ClassVar[ExplicitMethod] = ExplicitMethod.semi_implicit
    end_q = (1.0,)
    order = 1


@dataclass(frozen=True)
class RungeKutta4(_Explicit):
    """The classical Runge-Kutta method, of fourth order without noise."""

    method: ClassVar[ExplicitMethod] = ExplicitMethod.runge_kutta
    order = 4
    stage_times = (0.0, 0.5, 1.0)
    reach = (0.0, 0.5, 0.5, 1.0)
    stage_q = ((), (0.0,), (0.25, 0.0), (0.0, 0.5, 0.0))
    stage_v = ((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0))
    end_q = (1 / 6, 1 / 6, 1 / 6, 0.0)
    end_v = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
