"""SciPy's DOP853 as an integrator: a slow and accurate reference for the others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import ClassVar

import numpy as np
import scipy

from varpin.arrays import Floats
from varpin.core import ExplicitMethod, ExplicitRollout, ForwardDynamics, Outcome
from varpin.core.arrays import Commands, RolloutArrays
from varpin.errors import InputError, LinearizationError
from varpin.integrators.base import Integrator, Run, drifts, forces
from varpin.integrators.explicit import accelerations
from varpin.integrators.tableau import gauss_coefficients
from varpin.mechanics.scene import Scene, refuse_constraints
from varpin.signals.commands import control_of, interpolation
from varpin.support.checks import positive
from varpin.trajectory import Trajectory

Rate = Callable[[float, Floats], Floats]
Force = Callable[[float], Floats]

# Smallest rtol that SciPy accepts.
TIGHTEST = 100.0 * float(np.finfo(np.float64).eps)
# Points of the polynomial for a control that changes within a step; its order is 16.
_POINTS = 8
# Lower bound of the speed in tolerances [rad/s or m/s], so that rounding in an equilibrium is not resolved.
_SLOWEST = 1e-3
TOO_STEEP = "the adaptive method cannot go on: the motion runs away, or its tolerance is beyond rounding"


class _RunsAway(ArithmeticError):
    """The rate of change cannot be evaluated."""


@dataclass(frozen=True)
class Reference(Integrator):
    """The explicit Runge-Kutta method of order 8 by Dormand and Prince with its own step control, through SciPy.

    The tolerances determine the internal steps in each step of the trajectory, so the error does not depend on ``dt``.
    The control is held over a step; if it changes within the step, the polynomial through eight points replaces it. The
    method integrates q' = v, v' = M^-1 (f - bias); it shares only the robot's equations with the variational
    integrators. Scenes with noise are refused.

    Main args:
        rtol: Relative tolerance on q and v in each internal step, at least 2.3e-14.
        atol: Absolute tolerance on q [rad or m]; ``rtol`` if left out. The tolerance on v is ``atol`` times the speed
            of the robot [rad/s or m/s].
    """

    rtol: float = 1e-12
    atol: float | None = None

    variational = False
    named = ("rtol",)
    order = 8
    reasons: ClassVar[Mapping[int, str]] = MappingProxyType({Outcome.not_finite: TOO_STEEP})

    def __post_init__(self) -> None:
        if not TIGHTEST <= positive("rtol", self.rtol, "1") <= 1e-2:
            raise InputError(f"rtol must be from {TIGHTEST:.2g}, where rounding begins, to 0.01, got {self.rtol}")
        if self.atol is not None:
            positive("atol", self.atol, "rad or m")

    @property
    def stage_times(self) -> tuple[float, ...]:
        return tuple(gauss_coefficients(_POINTS)[2].tolist())

    def begun(self, scene: Scene, q0: Floats, v0: Floats) -> Run:
        refuse_constraints(scene, self)
        if scene.processes:
            raise InputError(f"{self} integrates no noise: leave it out of the scene")
        return Run(_Paths(self, scene, np.hstack([q0, v0]), ForwardDynamics(scene.core)), len(q0))

    def _force(self, values: Floats, dt: float) -> Force:
        """The force (n,) as a function of time [s] in a step, from values at its stages (s, n) or a constant (1, n)."""
        if len(values) == 1:
            return lambda _: values[0]
        times = np.array(self.stage_times)
        return lambda t: interpolation(times, np.array([t / dt]))[0] @ values

    def _atol(self, x: Floats, slope: Floats, dt: float) -> Floats:
        """Absolute tolerances on (q, v) (2n,) around a state."""
        n = len(x) // 2
        speed = max(np.abs(x[n:]).max() + dt * np.abs(slope[n:]).max(), _SLOWEST)
        unit = self.rtol if self.atol is None else self.atol
        return unit * np.concatenate([np.ones(n), np.full(n, speed)])

    def linearize(
        self, scene: Scene, trajectory: Trajectory, *, ramps: bool = False
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """See :meth:`Integrator.linearize`; the state is (q, v).

        The variational equations are integrated along with the motion, under the same tolerances.
        """
        refuse_constraints(scene, self)
        n = scene.robot.dof
        J = self._linearized(scene, trajectory)
        Jx, Jf = J[:, :, : 2 * n], J[:, :, 2 * n :]
        Jr = self._linearized(scene, trajectory, ramp=True)[:, :, 2 * n :] if ramps else 0.5 * Jf
        return Jx, Jf, J[:, :, n : 2 * n], Jr

    def _linearized(self, scene: Scene, trajectory: Trajectory, *, ramp: bool = False) -> Floats:
        """Derivatives (N, 2n, 3n) of each step in (q, v, force)."""
        n, dt = scene.robot.dof, trajectory.dt
        force = forces(scene, trajectory, drifts(scene, trajectory))
        J = np.empty((trajectory.steps, 2 * n, 3 * n))
        for k in range(trajectory.steps):
            x = np.append(trajectory.q[k], trajectory.v[k])
            try:
                J[k] = self._derivatives(scene, x, self._force(force[k], dt), dt, ramp=ramp)
            except (_RunsAway, LinearizationError):
                raise LinearizationError(k, k * dt, TOO_STEEP) from None
        return J

    def _derivatives(self, scene: Scene, x: Floats, force: Force, dt: float, *, ramp: bool) -> Floats:
        """Derivatives (2n, 3n) of one step in (q, v, force); with ``ramp`` the force grows linearly from 0."""
        n = len(x) // 2

        def rate(t: float, y: Floats) -> Floats:
            a, aq, av, af = accelerations(scene, y[None, :n], y[None, n : 2 * n], force(t)[None])
            J = y[2 * n :].reshape(2 * n, 3 * n)
            bent = aq[0] @ J[:n] + av[0] @ J[n:]
            bent[:, 2 * n :] += af[0] * (t / dt if ramp else 1.0)
            slope = np.concatenate([y[n : 2 * n], a[0], J[n:].ravel(), bent.ravel()])
            if not np.isfinite(slope).all():
                raise _RunsAway
            return slope

        y = np.concatenate([x, np.eye(2 * n, 3 * n).ravel()])
        slope = rate(dt if ramp else 0.0, y)
        atol = self._atol(x, slope[: 2 * n], dt)
        # Scales by units: dv/dq is a rate, dq/dv a time, derivatives in the force are inverse inertias.
        blocks = np.empty((2 * n, 3 * n))
        unit = atol[0]
        fast = max(float(np.abs(slope[2 * n :].reshape(2 * n, 3 * n)[n:, : 2 * n]).max()) * dt, _SLOWEST)
        light = max(float(np.abs(slope[2 * n :].reshape(2 * n, 3 * n)[n:, 2 * n :]).max()) * dt, 1e-300)
        blocks[:n, :n], blocks[:n, n : 2 * n], blocks[:n, 2 * n :] = unit, unit * dt, unit * dt * light
        blocks[n:, :n], blocks[n:, n : 2 * n], blocks[n:, 2 * n :] = unit * fast, unit, unit * light
        end, _, _ = _integrate(rate, y, dt, self.rtol, np.append(atol, blocks.ravel()), 0.0)
        return end[2 * n :].reshape(2 * n, 3 * n)


@dataclass
class _Paths:
    """P paths of a rollout."""

    method: Reference
    scene: Scene
    x: Floats  # (q, v) of each path (P, 2n)
    dynamics: ForwardDynamics
    tried: float = 0.0  # last internal step [s], 0 for none

    def copy(self) -> _Paths:
        return replace(self, x=self.x.copy())

    def first_nodes(self, nodes: RolloutArrays) -> bool:
        """See :class:`varpin.core.ExplicitRollout`."""
        start = ExplicitRollout.start(self.scene.core, ExplicitMethod.runge_kutta, *np.hsplit(self.x, 2))
        return start.first_nodes(nodes)

    def roll(
        self,
        dt: float,
        commands: Commands,
        increments: Floats,
        drift: Floats,
        nodes: RolloutArrays,
        impulses: Floats | None = None,
    ) -> None:
        """See :class:`varpin.core.ExplicitRollout`; the rate of change is compiled, the steps are those of SciPy."""
        if increments.size or impulses is not None:
            raise InputError(f"{self.method} integrates no noise: leave it out of the scene")
        for i in range(len(self.x)):
            if not self._path(i, dt, commands, drift, nodes):
                nodes.ended[i] = Outcome.not_finite

    def _path(self, i: int, dt: float, commands: Commands, drift: Floats, nodes: RolloutArrays) -> bool:
        """Write the steps of path ``i``; False where it cannot go on."""
        u = nodes.u[i]
        for s in range(len(u)):
            decision, held = divmod(s, commands.hold)
            before = u[s - 1 : s] if s else commands.before[i : i + 1]
            u[s] = before[0] if held else control_of(commands, decision, self.x[i], before)
            values = commands.within[s] if len(commands.within) else u[s : s + 1]
            if len(commands.stage_times):
                first = u[s - held - 1] if s > held else commands.before[i]
                share = (held + commands.stage_times[:, None]) / commands.hold
                values = (1.0 - share) * first + share * u[s]
            force = self.method._force(values @ self.scene.actuation.T + (drift[i, s] if len(drift) else 0.0), dt)
            try:
                x, nodes.tally[i, s, 2] = self._step(i, force, dt)
            except _RunsAway:
                return False
            self.x[i] = x
            nodes.p[i, s], nodes.energy[i, s], regular = self.dynamics.node(x)
            nodes.q[i, s], nodes.v[i, s] = np.split(x, 2)
            if not (regular and np.isfinite(nodes.energy[i, s])):
                return False
            nodes.done[i] = s + 1
        return True

    def _step(self, i: int, force: Force, dt: float) -> tuple[Floats, int]:
        """(q, v) of path ``i`` after one step, and the number of evaluations of forward dynamics."""

        def rate(t: float, x: Floats) -> Floats:
            slope, regular = self.dynamics.rate(x, force(t))
            if not (regular and np.isfinite(slope).all()):
                raise _RunsAway
            return slope

        atol = self.method._atol(self.x[i], rate(0.0, self.x[i]), dt)
        x, evaluations, self.tried = _integrate(rate, self.x[i], dt, self.method.rtol, atol, self.tried)
        return x, evaluations + 1


def _integrate(rate: Rate, x: Floats, dt: float, rtol: float, atol: Floats, tried: float) -> tuple[Floats, int, float]:
    """X after ``dt`` [s], the number of evaluations, and the length of the longest internal step [s]."""
    first = min(tried, dt) if tried > 0.0 else None
    solution = scipy.integrate.solve_ivp(rate, (0.0, dt), x, method="DOP853", rtol=rtol, atol=atol, first_step=first)
    if not solution.success:
        raise _RunsAway
    # The end of the interval shortens the last internal step, so the longest one is taken for the next trial.
    return solution.y[:, -1], int(solution.nfev), float(np.diff(solution.t).max())
