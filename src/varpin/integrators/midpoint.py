"""The midpoint variational integrator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.checks import count, fraction, positive
from varpin.errors import InputError, SingularMassMatrix
from varpin.integrators.base import Failure, Integrator, Segment
from varpin.kernels import midpoint as kernels
from varpin.scene import Scene
from varpin.trajectory import StepStatistics

Floats = NDArray[np.float64]

REASONS = {
    kernels.DIVERGED: "Newton's iteration does not contract, however small the substep",
    kernels.NOT_FINITE: "the step equation gives values that are not finite",
    kernels.FOLD: "the step is at a fold of the step equation's solutions (its branch margin is not positive)",
    kernels.ENERGY: "the energy balance of the step does not close",
    kernels.SINGULAR: "the mass matrix at the end of the step is not positive definite",
}


@dataclass(frozen=True)
class MidpointState:
    """Where a rollout stands, with its work arrays."""

    state: kernels.State
    work: kernels.Work


@dataclass(frozen=True)
class Midpoint(Integrator):
    """The forced midpoint variational integrator in position-momentum form.

    Solves the discrete Euler-Lagrange equations p0 + D1 Ld + F- = 0, p1 = D2 Ld + F+ with the generalized midpoint
    rule (Johnson and Murphey 2009); each half-step carries half of the impulse of controls and friction. Symplectic
    where nothing is forced, of second order for alpha = 1/2 and of first order otherwise.

    A whole step is accepted if Newton contracts from the start, if its root lies on the branch of solutions that is
    connected to dt -> 0, and if its energy balance closes; else it is taken in halves, and halves of halves, which
    ``Trajectory.statistics.substeps`` counts.

    Main args:
        alpha: Where in the step the Lagrangian is taken, in [0, 1]. Of second order at 1/2; elsewhere of first, and the
            energy at nodes swings by as much.

    Other Args:
        tolerance: On the residual, in units of the rounding error of the terms that cancel in it.
        branch_margin: How far from the fold of solutions a root must stay: the destabilising term of the step
            equation's Jacobian is exaggerated by 1 / (1 - branch_margin), in [0, 1).
        energy_balance: Largest error in the energy balance of a substep, in units of the energy it turns over.
        energy_budget: The errors of all substeps together, in units of the largest kinetic energy so far (plus
            the work done by forces); a fuller ledger leaves less room for errors of its own sign.
        max_halvings: A step is never cut into more than 2**max_halvings parts.
    """

    alpha: float = 0.5
    tolerance: float = 0.5
    branch_margin: float = 0.5
    energy_balance: float = 0.005
    energy_budget: float = 0.05
    max_halvings: int = 12

    variational = True

    def __post_init__(self) -> None:
        fraction("alpha", self.alpha)
        positive("tolerance", self.tolerance, "rounding units")
        if fraction("branch_margin", self.branch_margin) == 1.0:
            raise InputError("branch_margin must be in [0, 1), got 1")
        positive("energy_balance", self.energy_balance, "1")
        positive("energy_budget", self.energy_budget, "1")
        if count("max_halvings", self.max_halvings) > 30:
            raise InputError(f"max_halvings must be at most 30, got {self.max_halvings}")

    def __str__(self) -> str:
        return f"Midpoint(alpha={self.alpha:g})"

    def _options(self) -> kernels.Options:
        return kernels.Options(
            float(self.alpha),
            float(self.tolerance),
            float(self.branch_margin),
            float(self.energy_balance),
            float(self.energy_budget),
            int(self.max_halvings),
        )

    def start(self, scene: Scene, q0: Floats, v0: Floats) -> tuple[MidpointState, Segment]:
        """See :meth:`Integrator.start`; p0 = M(q0) v0."""
        robot = scene.robot
        run = MidpointState(kernels.new_state(robot.dof), kernels.new_work(robot.tree.parent.size, robot.dof))
        if not kernels.begin(scene.mechanism, q0, v0, run.state, run.work):
            raise SingularMassMatrix(robot.joint_names, q0)
        state = run.state
        energy = state.energy[:1] + state.energy[1:2]
        nothing = _statistics(np.zeros((0, 4), dtype=np.int64), np.zeros((0, 2)))
        return run, Segment(state.q[None].copy(), state.p[None].copy(), state.v[None].copy(), energy, nothing)

    def rollout(self, scene: Scene, state: MidpointState, controls: Floats, dt: float) -> Segment:
        """See :meth:`Integrator.rollout`."""
        steps, n = controls.shape[0], scene.robot.dof
        q, p, v = np.empty((steps, n)), np.empty((steps, n)), np.empty((steps, n))
        energy = np.empty(steps)
        tally, quality = np.empty((steps, 4), dtype=np.int64), np.empty((steps, 2))
        options = self._options()
        outcome, done = kernels.rollout(
            scene.mechanism, options, dt, controls, state.state, state.work, q, p, v, energy, tally, quality
        )
        failure = None
        if outcome != kernels.SOLVED:
            failure = Failure(REASONS[outcome], float(state.work.quality[0]))
        return Segment(q[:done], p[:done], v[:done], energy[:done], _statistics(tally[:done], quality[:done]), failure)

    def predict(self, state: MidpointState, dt: float) -> tuple[Floats, Floats]:
        """See :meth:`Integrator.predict`; the velocity goes on from the last midpoint through the node."""
        now = state.state
        velocity = now.v.copy()
        if now.counters[0] > 0:
            velocity += now.v - now.past[0]
        return now.q + 0.5 * dt * now.v, velocity


def _statistics(tally: NDArray[np.int64], quality: Floats) -> StepStatistics:
    return StepStatistics(
        newton_iterations=tally[:, 0].copy(),
        jets=tally[:, 1].copy(),
        sweeps=tally[:, 2].copy(),
        substeps=tally[:, 3].copy(),
        residual=quality[:, 0].copy(),
        branch_margin=quality[:, 1].copy(),
    )
