"""What the variational integrators share: state, kicks, guards."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from varpin.checks import count, fraction, is_one_of, positive
from varpin.core import Guards, Tableau, VariationalRollout, variational_curvatures, variational_derivatives
from varpin.core.arrays import Commands, new_nodes
from varpin.errors import InputError, LinearizationError, SingularMassMatrix
from varpin.integrators.base import (
    Integrator,
    Segment,
    control_of,
    diffusion_and_drift,
    drifts,
    open_loop,
    segments_of,
    steps_of,
)
from varpin.scene import Scene
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# By the numbers of nodes.hpp.
REASONS = {
    1: "Newton's iteration does not contract, however small the substep",
    2: "the step equation gives values that are not finite",
    3: "the step is at a fold of the step equation's solutions (its branch margin is not positive)",
    4: "the energy balance of the step does not close",
    5: "the mass matrix at the end of the step is not positive definite",
}


@dataclass(frozen=True)
class VariationalRun:
    """Where a rollout stands.

    Attributes:
        paths: In the core.
        start: Configurations at which the rollout started (P, n) [rad or m].
    """

    paths: VariationalRollout
    start: Floats


_GUARDS = ("tolerance", "branch_margin", "energy_balance", "energy_budget", "max_halvings")


class Variational(Integrator):
    """A variational integrator on (q, p) whose steps are guarded, cut and kicked."""

    tolerance: float
    branch_margin: float
    energy_balance: float
    energy_budget: float
    max_halvings: int
    kick: Literal["left", "split"]

    variational = True

    def same_map(self, other: Integrator) -> bool:
        """See :meth:`Integrator.same_map`: guards decide which steps are cut, not what a step is."""
        own, others = ({k: v for k, v in vars(x).items() if k not in _GUARDS} for x in (self, other))
        return type(self) is type(other) and own == others

    def __post_init__(self) -> None:
        positive("tolerance", self.tolerance, "rounding units")
        if fraction("branch_margin", self.branch_margin) == 1.0:
            raise InputError("branch_margin must be in [0, 1), got 1")
        positive("energy_balance", self.energy_balance, "1")
        positive("energy_budget", self.energy_budget, "1")
        if not is_one_of(self.kick, ("left", "split")):
            raise InputError(f"kick must be 'left' or 'split', got {self.kick!r}")
        if count("max_halvings", self.max_halvings) > 30:
            raise InputError(f"max_halvings must be at most 30, got {self.max_halvings}")

    @property
    def left(self) -> float:
        """The part of a step's kick that comes before the step."""
        return 1.0 if self.kick == "left" else 0.5

    @abstractmethod
    def _tableau(self) -> Tableau:
        """Its coefficients."""

    def _guards(self) -> Guards:
        return Guards.make(
            active=True,
            branch_margin=float(self.branch_margin),
            energy_balance=float(self.energy_balance),
            energy_budget=float(self.energy_budget),
            most_halvings=int(self.max_halvings),
        )

    def start(self, scene: Scene, q0: Floats, v0: Floats) -> tuple[VariationalRun, list[Segment]]:
        """See :meth:`Integrator.start`; p0 = M(q0) v0."""
        paths, n = q0.shape
        rollout = VariationalRollout(
            scene.core, self._tableau(), float(self.tolerance), self._guards(), self.left, paths
        )
        if not rollout.begin(np.ascontiguousarray(q0), np.ascontiguousarray(v0)):
            raise SingularMassMatrix(scene.robot.joint_names, q0)
        nodes = new_nodes(paths, 1, n, scene.controls)
        nodes.q[:, 0], nodes.p[:, 0], nodes.v[:, 0], nodes.energy[:, 0] = rollout.nodes()
        nodes.done[:] = 1
        return VariationalRun(rollout, q0.copy()), segments_of(nodes, REASONS)

    def fork(self, state: VariationalRun) -> VariationalRun:
        """See :meth:`Integrator.fork`."""
        return replace(state, paths=state.paths.fork())

    def rollout_compiled(
        self,
        scene: Scene,
        state: VariationalRun,
        commands: Commands,
        increments: Floats,
        drift: Floats,
        dt: float,
    ) -> list[Segment]:
        """See :meth:`Integrator.rollout_compiled`."""
        nodes = new_nodes(len(state.start), steps_of(commands), scene.robot.dof, scene.controls)
        state.paths.roll(dt, commands, increments, drift, nodes)
        return segments_of(nodes, REASONS)

    def step_in_python(
        self, scene: Scene, state: VariationalRun, command: Commands, increment: Floats, dt: float
    ) -> Segment:
        """One step of one path with diffusion fields that are evaluated in Python."""
        q, p, v, _ = state.paths.nodes()
        control = control_of(command, 0, np.concatenate([q[0], p[0]]), command.before)
        F, drift = diffusion_and_drift(scene, q[0], v[0], control, state.start[0])
        if len(increment):
            state.paths.kick(self.left * (F @ increment[0, 0])[None])
        (segment,) = self.rollout_compiled(
            scene, state, open_loop(control[None]), scene.silence, self.drift_share * drift[None, None], dt
        )
        if len(increment) and self.left < 1.0 and segment.failure is None:
            q, p, v, _ = state.paths.nodes()
            F, _ = diffusion_and_drift(scene, q[0], v[0], control, state.start[0])
            state.paths.kick((1.0 - self.left) * (F @ increment[0, 0])[None])
            _, segment.p[-1:], segment.v[-1:], segment.energy[-1:] = state.paths.nodes()
        return segment

    def linearize(self, scene: Scene, trajectory: Trajectory) -> tuple[Floats, Floats, Floats]:
        """See :meth:`Integrator.linearize`; the state is (q, p).

        A step that was taken in parts is taken in parts again, and their derivatives are chained.
        """
        Jx, Jf, outcome, done = variational_derivatives(**self._steps(scene, trajectory))
        if outcome in REASONS:
            raise LinearizationError(done, done * trajectory.dt, REASONS[outcome])
        return Jx, Jf, Jx[:, :, scene.robot.dof :]

    def contract(self, scene: Scene, trajectory: Trajectory, z: Floats) -> Floats:
        """See :meth:`Integrator.contract`; steps that were taken in parts are chained as in :meth:`linearize`."""
        H, outcome, done = variational_curvatures(**self._steps(scene, trajectory), z=np.ascontiguousarray(z))
        if outcome in REASONS:
            raise LinearizationError(done, done * trajectory.dt, REASONS[outcome])
        return H

    def _steps(self, scene: Scene, trajectory: Trajectory) -> dict[str, Any]:
        """What the core takes the derivatives of every step at dw = 0 from, by the names of its arguments."""
        force = trajectory.u @ scene.actuation.T
        if scene.noise.velocity_dependent:
            force = force + self.drift_share * drifts(scene, trajectory)
        arrays = {
            "q": trajectory.q[:-1],
            "p": trajectory.p[:-1],
            "guess": self._guess(trajectory),
            "force": force,
            "substeps": trajectory.statistics.substeps,
        }
        return {
            "mechanism": scene.core,
            "tableau": self._tableau(),
            "tolerance": float(self.tolerance),
            "guards": self._guards(),
            "dt": float(trajectory.dt),
            **{name: np.ascontiguousarray(array) for name, array in arrays.items()},
        }

    @abstractmethod
    def _guess(self, trajectory: Trajectory) -> Floats:
        """Stage velocities (N, s, n) next to the roots of every step at dw = 0."""
