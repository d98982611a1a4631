"""The midpoint variational integrator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from varpin.checks import fraction
from varpin.errors import LinearizationError
from varpin.integrators.base import Segment, drifts, segments_of, steps_of
from varpin.integrators.variational import REASONS, Variational, VariationalRun
from varpin.kernels import midpoint as kernels
from varpin.kernels import midpoint_equation as equation
from varpin.kernels.midpoint_linearize import linearize
from varpin.kernels.tree import Commands, new_nodes
from varpin.scene import Scene
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Midpoint(Variational):
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
        kick: When noise kicks the momentum: ``"left"``, before the step (the paper's scheme); or ``"split"``, half
            of it before and half after, at the state then reached, which for constant mass and additive noise is of
            weak order 2 instead of 1.
    """

    alpha: float = 0.5
    tolerance: float = 0.5
    branch_margin: float = 0.5
    energy_balance: float = 0.005
    energy_budget: float = 0.05
    max_halvings: int = 12
    kick: Literal["left", "split"] = "left"

    def __post_init__(self) -> None:
        fraction("alpha", self.alpha)
        super().__post_init__()

    def __str__(self) -> str:
        kick = "" if self.kick == "left" else f", kick={self.kick}"
        return f"Midpoint(alpha={self.alpha:g}{kick})"

    def _arrays(self, paths: int, dof: int, processes: int) -> tuple[equation.State, None]:
        return equation.new_state(paths, dof, processes), None

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
        nodes = new_nodes(len(state.state.q), steps_of(commands), scene.robot.dof, scene.controls)
        kernels.rollout(
            scene.mechanism, self._options(self.alpha), dt, commands, increments, drift, state.state, state.work, nodes
        )
        return segments_of(nodes, REASONS)

    def linearize(self, scene: Scene, trajectory: Trajectory) -> tuple[Floats, Floats, Floats]:
        """See :meth:`Integrator.linearize`; the state is (q, p).

        A step that was taken in parts is taken in parts again, and their derivatives are chained.
        """
        steps, n = trajectory.steps, scene.robot.dof
        q, p, v = (np.ascontiguousarray(getattr(trajectory, name)[:-1]) for name in ("q", "p", "v"))
        # Without noise the root is known; with it the step at dw = 0 starts from another momentum.
        guess = v if trajectory.dw.any() else np.diff(trajectory.q, axis=0) / trajectory.dt
        force = trajectory.u @ scene.actuation.T + self.drift_share * drifts(scene, trajectory)
        Jx, Jf = np.empty((steps, 2 * n, 2 * n)), np.empty((steps, 2 * n, n))
        outcome, done = linearize(
            scene.mechanism,
            # A root that is known to 1e-10 is good enough for derivatives, and one jet for them.
            self._options(self.alpha)._replace(tolerance=1e6),
            trajectory.dt,
            q,
            p,
            guess,
            force,
            trajectory.statistics.substeps,
            equation.new_state(1, n, scene.mechanism.diffusion.constant.shape[1]),
            equation.new_work(scene.robot.tree.parent.size, n, derivatives=True),
            Jx,
            Jf,
        )
        if outcome != equation.SOLVED:
            raise LinearizationError(done, done * trajectory.dt, REASONS[outcome])
        return Jx, Jf, Jx[:, :, n:]

    def predict(self, state: VariationalRun, dt: float) -> tuple[Floats, Floats]:
        """See :meth:`Integrator.predict`; the velocity goes on from the last midpoint through the node."""
        now = state.state
        velocity = now.v[0].copy()
        if now.counters[0, 0] > 0:
            velocity += now.v[0] - now.past[0, 0]
        return now.q[0] + 0.5 * dt * now.v[0], velocity
