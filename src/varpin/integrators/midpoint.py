"""The midpoint variational integrator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from varpin.checks import fraction
from varpin.errors import LinearizationError
from varpin.integrators.base import Segment, drifts, read_only, segments_of, steps_of
from varpin.integrators.variational import REASONS, Variational, VariationalRun
from varpin.kernels import midpoint as kernels
from varpin.kernels import midpoint_equation as equation
from varpin.kernels.jet_tangent import new_tangent
from varpin.kernels.midpoint_curvature import contract, parts_of_step
from varpin.kernels.midpoint_linearize import linearize
from varpin.kernels.tree import Commands, new_nodes
from varpin.scene import Scene
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def largest_step(M: Floats, Lqq: Floats, margin: float) -> float:
    """The dt [s] up to which the branch guard of alpha = 1/2 accepts a step around a state with these M and L_qq.

    Where M - dt^2 / (4 (1 - margin)) L_qq ceases to be positive definite; infinite where no direction is unstable. It
    says nothing of accuracy.
    """
    rates = eigh(Lqq, M, eigvals_only=True)
    # Of a direction without curvature rounding leaves a tiny one, of either sign.
    rounding = 1e-12 * float(np.abs(rates).max())
    return 2.0 * float(np.sqrt((1.0 - margin) / rates[-1])) if rates[-1] > rounding else np.inf


def _room(scene: Scene, *, derivatives: bool = False, parts: int = 0) -> tuple[equation.State, equation.Work]:
    """State and work arrays of one path."""
    n, bodies, loads = scene.robot.dof, scene.robot.tree.parent.size, scene.robot.tree.loads.size
    state = equation.new_state(1, n, scene.mechanism.diffusion.constant.shape[1], loads)
    return state, equation.new_work(bodies, n, loads, derivatives=derivatives, parts=parts)


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
    energy_budget: float = 0.02
    max_halvings: int = 12
    kick: Literal["left", "split"] = "left"

    named = ("alpha",)

    def __post_init__(self) -> None:
        fraction("alpha", self.alpha)
        super().__post_init__()

    @property
    def order(self) -> int:
        """See :meth:`Integrator.order`; 2 for alpha = 1/2, and 1 elsewhere."""
        return 2 if self.alpha == 0.5 else 1

    def _arrays(self, scene: Scene, paths: int) -> tuple[equation.State, None]:
        processes, loads = scene.mechanism.diffusion.constant.shape[1], scene.robot.tree.loads.size
        return equation.new_state(paths, scene.robot.dof, processes, loads), None

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
        Jx, Jf = self._derivatives(scene, trajectory.dt, *self._roots(scene, trajectory))
        return Jx, Jf, Jx[:, :, scene.robot.dof :]

    def _roots(self, scene: Scene, trajectory: Trajectory) -> tuple[Floats, Floats, Floats, Floats, Integers]:
        """Of every step at dw = 0: q, p, a guess next to its velocity, the constant force, each (N, n); its parts."""
        q, p, v = (read_only(getattr(trajectory, name)[:-1]) for name in ("q", "p", "v"))
        # Without noise the root is known; with it the step at dw = 0 starts from another momentum.
        guess = v if trajectory.dw.any() else np.diff(trajectory.q, axis=0) / trajectory.dt
        force = trajectory.u @ scene.actuation.T
        if scene.noise.velocity_dependent:
            force = force + self.drift_share * drifts(scene, trajectory)
        return q, p, guess, force, trajectory.statistics.substeps

    def _loose(self) -> equation.Options:
        """A root that is known to 1e-10 is good enough for derivatives, and one jet for them."""
        return self._options(self.alpha)._replace(tolerance=1e6)

    def _derivatives(
        self, scene: Scene, dt: float, q: Floats, p: Floats, guess: Floats, force: Floats, substeps: Integers
    ) -> tuple[Floats, Floats]:
        steps, n = q.shape
        Jx, Jf = np.empty((steps, 2 * n, 2 * n)), np.empty((steps, 2 * n, n))
        state, work = _room(scene, derivatives=True)
        q, p, guess, force, substeps = (read_only(array) for array in (q, p, guess, force, substeps))
        outcome, done = linearize(scene.mechanism, self._loose(), dt, q, p, guess, force, substeps, state, work, Jx, Jf)
        if outcome != equation.SOLVED:
            raise LinearizationError(done, done * dt, REASONS[outcome])
        return Jx, Jf

    def contract(self, scene: Scene, trajectory: Trajectory, z: Floats) -> Floats:
        """See :meth:`Integrator.contract`; steps that were taken in parts are chained as in :meth:`linearize`."""
        q, p, guess, force, substeps = self._roots(scene, trajectory)
        H = np.empty((len(q), 3 * scene.robot.dof, 3 * scene.robot.dof))
        whole = substeps == 1
        H[whole] = self._curvatures(scene, trajectory.dt, q[whole], p[whole], guess[whole], force[whole], z[whole])
        for j in np.flatnonzero(~whole):
            H[j] = self._chained_curvature(scene, trajectory.dt, q[j], p[j], force[j], int(substeps[j]), z[j])
        return H

    def _curvatures(
        self, scene: Scene, dt: float, q: Floats, p: Floats, guess: Floats, force: Floats, z: Floats
    ) -> Floats:
        steps, n = q.shape
        H, room = np.empty((steps, 3 * n, 3 * n)), np.empty((n, 3 * n))
        state, work = _room(scene)
        tangent = new_tangent(scene.robot.tree.parent.size, n)
        outcome, done = contract(
            scene.mechanism, self._loose(), dt, q, p, guess, force, z, state, work, tangent, room, H
        )
        if outcome != equation.SOLVED:
            raise LinearizationError(done, done * dt, REASONS[outcome])
        return H

    def _chained_curvature(
        self, scene: Scene, dt: float, q: Floats, p: Floats, force: Floats, substeps: int, z: Floats
    ) -> Floats:
        """Z goes back by each part's derivative, and the curvature of each part to the start of the step."""
        n = len(q)
        state, work = _room(scene, parts=substeps)
        outcome = parts_of_step(scene.mechanism, self._options(self.alpha), dt, q, p, force, state, work)
        if outcome != equation.SOLVED:
            raise LinearizationError(0, 0.0, REASONS[outcome])
        one = np.ones(1, dtype=np.int64)
        parts = [(row[None, :n], row[None, n : 2 * n], row[None, 2 * n : 3 * n], row[3 * n]) for row in work.trail]
        links = []
        for at_q, at_p, at_v, length in parts:
            Jx, Jf = self._derivatives(scene, length, at_q, at_p, at_v, force[None], one)
            links.append(np.block([[Jx[0], Jf[0]], [np.zeros((n, 2 * n)), np.eye(n)]]))
        starts = [np.eye(3 * n)]
        for link in links[:-1]:
            starts.append(link @ starts[-1])
        H = np.zeros((3 * n, 3 * n))
        for (at_q, at_p, at_v, length), link, start in zip(parts[::-1], links[::-1], starts[::-1], strict=True):
            H += start.T @ self._curvatures(scene, length, at_q, at_p, at_v, force[None], z[None])[0] @ start
            z = z @ link[: 2 * n, : 2 * n]
        return H
