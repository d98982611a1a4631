"""The midpoint variational integrator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from varpin.checks import count, fraction, positive
from varpin.errors import InputError, LinearizationError, SingularMassMatrix
from varpin.integrators.base import Integrator, Segment, diffusion_and_drift, drifts, open_loop, segments_of, steps_of
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

REASONS = {
    equation.DIVERGED: "Newton's iteration does not contract, however small the substep",
    equation.NOT_FINITE: "the step equation gives values that are not finite",
    equation.FOLD: "the step is at a fold of the step equation's solutions (its branch margin is not positive)",
    equation.ENERGY: "the energy balance of the step does not close",
    equation.SINGULAR: "the mass matrix at the end of the step is not positive definite",
}


@dataclass(frozen=True)
class MidpointState:
    """Where a rollout stands, with its work arrays."""

    state: equation.State
    work: equation.Work
    start: Floats


def _room(scene: Scene, *, derivatives: bool = False, parts: int = 0) -> tuple[equation.State, equation.Work]:
    """State and work arrays of one path."""
    n, bodies = scene.robot.dof, scene.robot.tree.parent.size
    state = equation.new_state(1, n, scene.mechanism.diffusion.constant.shape[1])
    return state, equation.new_work(bodies, n, derivatives=derivatives, parts=parts)


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

    variational = True

    def __post_init__(self) -> None:
        fraction("alpha", self.alpha)
        positive("tolerance", self.tolerance, "rounding units")
        if fraction("branch_margin", self.branch_margin) == 1.0:
            raise InputError("branch_margin must be in [0, 1), got 1")
        positive("energy_balance", self.energy_balance, "1")
        positive("energy_budget", self.energy_budget, "1")
        if self.kick not in ("left", "split"):
            raise InputError(f"kick must be 'left' or 'split', got {self.kick!r}")
        if count("max_halvings", self.max_halvings) > 30:
            raise InputError(f"max_halvings must be at most 30, got {self.max_halvings}")

    def __str__(self) -> str:
        kick = "" if self.kick == "left" else f", kick={self.kick}"
        return f"Midpoint(alpha={self.alpha:g}{kick})"

    @property
    def left(self) -> float:
        """The part of a step's kick that comes before the step."""
        return 1.0 if self.kick == "left" else 0.5

    def _options(self) -> equation.Options:
        return equation.Options(
            float(self.alpha),
            float(self.tolerance),
            float(self.branch_margin),
            float(self.energy_balance),
            float(self.energy_budget),
            int(self.max_halvings),
            self.left,
        )

    def start(self, scene: Scene, q0: Floats, v0: Floats) -> tuple[MidpointState, list[Segment]]:
        """See :meth:`Integrator.start`; p0 = M(q0) v0."""
        robot = scene.robot
        paths, n = q0.shape
        run = MidpointState(
            equation.new_state(paths, n, scene.mechanism.diffusion.constant.shape[1]),
            equation.new_work(robot.tree.parent.size, n),
            q0.copy(),
        )
        if not kernels.begin_paths(scene.mechanism, q0, v0, run.state, run.work):
            raise SingularMassMatrix(robot.joint_names, q0)
        nodes = new_nodes(paths, 1, n, scene.controls)
        nodes.q[:, 0], nodes.p[:, 0], nodes.v[:, 0] = run.state.q, run.state.p, run.state.v
        nodes.energy[:, 0] = run.state.energy[:, :, :2].sum(axis=(1, 2))
        nodes.done[:] = 1
        return run, segments_of(nodes, REASONS)

    def step_in_python(
        self, scene: Scene, state: MidpointState, command: Commands, increment: Floats, dt: float
    ) -> Segment:
        """One step of one path with diffusion fields that are evaluated in Python."""
        now = state.state
        control = command.u[0]
        if len(command.gains):
            control = control + command.gains[0] @ (np.concatenate([now.q[0], now.p[0]]) - command.reference[0])
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

    def rollout_compiled(
        self,
        scene: Scene,
        state: MidpointState,
        commands: Commands,
        increments: Floats,
        drift: Floats,
        dt: float,
    ) -> list[Segment]:
        """See :meth:`Integrator.rollout_compiled`."""
        nodes = new_nodes(len(state.state.q), steps_of(commands), scene.robot.dof, scene.controls)
        kernels.rollout(
            scene.mechanism, self._options(), dt, commands, increments, drift, state.state, state.work, nodes
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
        q, p, v = (np.ascontiguousarray(getattr(trajectory, name)[:-1]) for name in ("q", "p", "v"))
        # Without noise the root is known; with it the step at dw = 0 starts from another momentum.
        guess = v if trajectory.dw.any() else np.diff(trajectory.q, axis=0) / trajectory.dt
        force = trajectory.u @ scene.actuation.T
        if scene.noise.velocity_dependent:
            force = force + self.drift_share * drifts(scene, trajectory)
        return q, p, guess, force, trajectory.statistics.substeps

    def _loose(self) -> equation.Options:
        """A root that is known to 1e-10 is good enough for derivatives, and one jet for them."""
        return self._options()._replace(tolerance=1e6)

    def _derivatives(
        self, scene: Scene, dt: float, q: Floats, p: Floats, guess: Floats, force: Floats, substeps: Integers
    ) -> tuple[Floats, Floats]:
        steps, n = q.shape
        Jx, Jf = np.empty((steps, 2 * n, 2 * n)), np.empty((steps, 2 * n, n))
        state, work = _room(scene, derivatives=True)
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
        outcome = parts_of_step(scene.mechanism, self._options(), dt, q, p, force, state, work)
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

    def predict(self, state: MidpointState, dt: float) -> tuple[Floats, Floats]:
        """See :meth:`Integrator.predict`; the velocity goes on from the last midpoint through the node."""
        now = state.state
        velocity = now.v[0].copy()
        if now.counters[0, 0] > 0:
            velocity += now.v[0] - now.past[0, 0]
        return now.q[0] + 0.5 * dt * now.v[0], velocity
