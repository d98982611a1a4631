"""What the variational integrators share: state, kicks, guards."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from varpin.checks import count, fraction, is_one_of, positive
from varpin.errors import InputError, SingularMassMatrix
from varpin.integrators.base import Integrator, Segment, control_of, diffusion_and_drift, open_loop, segments_of
from varpin.kernels import midpoint as kernels
from varpin.kernels import midpoint_equation as equation
from varpin.kernels.tree import Commands, new_nodes
from varpin.scene import Scene

Floats = NDArray[np.float64]

REASONS = {
    equation.DIVERGED: "Newton's iteration does not contract, however small the substep",
    equation.NOT_FINITE: "the step equation gives values that are not finite",
    equation.FOLD: "the step is at a fold of the step equation's solutions (its branch margin is not positive)",
    equation.ENERGY: "the energy balance of the step does not close",
    equation.SINGULAR: "the mass matrix at the end of the step is not positive definite",
}


@dataclass(frozen=True)
class VariationalRun:
    """Where a rollout stands, with its work arrays.

    Attributes:
        state: Of each path.
        work: Of a step.
        stages: More work arrays, of integrators that have stages.
        start: Configurations at which the rollout started (P, n) [rad or m].
    """

    state: equation.State
    work: equation.Work
    stages: Any
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

    def _options(self, alpha: float) -> equation.Options:
        return equation.Options(
            float(alpha),
            float(self.tolerance),
            float(self.branch_margin),
            float(self.energy_balance),
            float(self.energy_budget),
            int(self.max_halvings),
            self.left,
        )

    @abstractmethod
    def _arrays(self, scene: Scene, paths: int) -> tuple[equation.State, Any]:
        """The states of several paths, and the work arrays of the stages, if there are any."""

    def start(self, scene: Scene, q0: Floats, v0: Floats) -> tuple[VariationalRun, list[Segment]]:
        """See :meth:`Integrator.start`; p0 = M(q0) v0."""
        robot = scene.robot
        paths, n = q0.shape
        state, stages = self._arrays(scene, paths)
        work = equation.new_work(robot.tree.parent.size, n, robot.tree.loads.size)
        run = VariationalRun(state, work, stages, q0.copy())
        if not kernels.begin_paths(scene.mechanism, q0, v0, run.state, run.work):
            raise SingularMassMatrix(robot.joint_names, q0)
        nodes = new_nodes(paths, 1, n, scene.controls)
        nodes.q[:, 0], nodes.p[:, 0], nodes.v[:, 0] = run.state.q, run.state.p, run.state.v
        nodes.energy[:, 0] = run.state.energy[:, :, :2].sum(axis=(1, 2))
        nodes.done[:] = 1
        return run, segments_of(nodes, REASONS)

    def fork(self, state: VariationalRun) -> VariationalRun:
        """See :meth:`Integrator.fork`."""
        return replace(state, state=equation.State._make(array.copy() for array in state.state))

    def step_in_python(
        self, scene: Scene, state: VariationalRun, command: Commands, increment: Floats, dt: float
    ) -> Segment:
        """One step of one path with diffusion fields that are evaluated in Python."""
        now = state.state
        control = control_of(command, 0, np.concatenate([now.q[0], now.p[0]]), command.before)
        F, drift = diffusion_and_drift(scene, now.q[0], now.v[0], control, state.start[0])
        if len(increment):
            kernels.apply_impulse(scene.mechanism, self.left * (F @ increment[0, 0]), now, state.work)
        nothing = np.zeros((0, 0, scene.mechanism.diffusion.constant.shape[1]))
        (segment,) = self.rollout_compiled(
            scene, state, open_loop(control[None]), nothing, self.drift_share * drift[None, None], dt
        )
        if len(increment) and self.left < 1.0 and segment.failure is None:
            F, _ = diffusion_and_drift(scene, now.q[0], now.v[0], control, state.start[0])
            kernels.apply_impulse(scene.mechanism, (1.0 - self.left) * (F @ increment[0, 0]), now, state.work)
            segment.p[-1], segment.v[-1], segment.energy[-1] = now.p[0], now.v[0], now.energy[0, :, :2].sum()
        return segment
