"""What the variational integrators share: state, kicks, guards."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from varpin.checks import count, fraction, is_one_of, positive
from varpin.core import (
    Guards,
    Outcome,
    Tableau,
    VariationalRollout,
    variational_curvatures,
    variational_derivatives,
)
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
    written,
)
from varpin.scene import Scene
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

REASONS: dict[int, str] = {
    Outcome.diverged: "Newton's iteration does not contract, however small the substep",
    Outcome.not_finite: "the step equation gives values that are not finite",
    Outcome.fold: "the step is at a fold of the step equation's solutions (its branch margin is not positive)",
    Outcome.energy: "the energy balance of the step does not close",
    Outcome.singular: "the mass matrix at the end of the step is not positive definite",
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


@dataclass(frozen=True)
class Guard:
    """When a variational step is accepted; one that is not is taken in halves, and halves of halves.

    Its step equation has other roots than the one that is connected to dt -> 0, and Newton's method finds them
    (docs/mathematics.md, "The principal branch").

    Args:
        branch_margin: How far from the fold of solutions a root must stay: the destabilising term of the step
            equation's Jacobian is exaggerated by 1 / (1 - branch_margin), in [0, 1).
        energy_balance: Largest error in the energy balance of a substep, in units of the energy it turns over.
        energy_budget: The errors of all substeps together, in units of the largest kinetic energy so far (plus the work
            done by forces); a fuller ledger leaves less room for errors of its own sign.
        max_halvings: A step is never cut into more than 2**max_halvings parts, at most 30.

    Raises:
        InputError: A value is out of its range.
    """

    branch_margin: float = 0.5
    energy_balance: float = 0.005
    energy_budget: float = 0.02
    max_halvings: int = 12

    def __post_init__(self) -> None:
        if fraction("branch_margin", self.branch_margin) == 1.0:
            raise InputError("branch_margin must be in [0, 1), got 1")
        positive("energy_balance", self.energy_balance, "1")
        positive("energy_budget", self.energy_budget, "1")
        if count("max_halvings", self.max_halvings) > 30:
            raise InputError(f"max_halvings must be at most 30, got {self.max_halvings}")

    def __repr__(self) -> str:
        text = written(self)
        return text if text.endswith(")") else f"{text}()"


class Variational(Integrator):
    """A variational integrator on (q, p) whose steps are guarded, cut and kicked."""

    guard: Guard | None
    tolerance: float
    kick: Literal["left", "split"]

    variational = True

    def same_map(self, other: Integrator) -> bool:
        """See :meth:`Integrator.same_map`: guards decide which steps are cut, not what a step is."""
        own, others = ({k: v for k, v in vars(x).items() if k not in ("guard", "tolerance")} for x in (self, other))
        return type(self) is type(other) and own == others

    def __post_init__(self) -> None:
        if not (self.guard is None or isinstance(self.guard, Guard)):
            raise InputError(f"guard must be a varpin.Guard, or None for no guards, got {self.guard!r}")
        positive("tolerance", self.tolerance, "rounding units")
        if not is_one_of(self.kick, ("left", "split")):
            raise InputError(f"kick must be 'left' or 'split', got {self.kick!r}")

    @property
    def left(self) -> float:
        """The part of a step's kick that comes before the step."""
        return 1.0 if self.kick == "left" else 0.5

    @abstractmethod
    def _tableau(self) -> Tableau:
        """Its coefficients."""

    def _asked(self) -> Guard | None:
        """What of its guard is asked of its steps."""
        return self.guard

    def _guards(self) -> Guards:
        asked = self._asked()
        own = asked or Guard(max_halvings=0)
        return Guards.make(
            active=asked is not None,
            branch_margin=float(own.branch_margin),
            energy_balance=float(own.energy_balance),
            energy_budget=float(own.energy_budget),
            most_halvings=int(own.max_halvings),
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
        return replace(state, paths=state.paths.fork(self._guards()))

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
        substeps = trajectory.statistics.substeps
        if substeps.size and not 1 <= substeps.min() <= substeps.max() <= 1 << 30:
            raise InputError("the trajectory is damaged: statistics.substeps holds numbers of parts that no step has")
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

    def _guess(self, trajectory: Trajectory) -> Floats:
        """Stage velocities (N, s, n) next to the roots of every step at dw = 0: of the cubic through both nodes.

        With noise that step starts from another momentum, and its velocity is all there is to go by.
        """
        q, v, c = trajectory.q, trajectory.v, self._times()[None, :, None]
        if trajectory.dw.any():
            return v[:-1, None] + np.zeros_like(c)
        mean = (np.diff(q, axis=0) / trajectory.dt)[:, None]
        if c.size == 1:
            return mean  # of one stage the root itself
        guess: Floats = (
            (1.0 - c) * (1.0 - 3.0 * c) * v[:-1, None] + c * (3.0 * c - 2.0) * v[1:, None] + 6.0 * c * (1.0 - c) * mean
        )
        return guess

    @abstractmethod
    def _times(self) -> Floats:
        """Where its stages stand in a step of unit length (s,)."""
