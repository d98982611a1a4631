"""Motions within the steps of a plan: states at instants between nodes, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.errors import LinearizationError
from varpin.integrators import Integrator
from varpin.integrators.base import Failure, open_line, open_loop
from varpin.linearization import linearize_steps, velocity_at_nodes
from varpin.mechanics.forces import limited_servos
from varpin.mechanics.scene import Scene
from varpin.simulation.record import rollout
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

# Differences of states and controls, where the derivatives of a step's parts do not follow from each other.
_SHIFT = 1e-5


@dataclass(frozen=True, eq=False)
class Parts(Frozen):
    """Steps that are each integrated in equal parts, from the node at their begin.

    Controls are (m,) of a step, or where they are linear those at its begin and its end (2m,).

    Attributes:
        scene: The scene, without noise.
        integrator: The integrator of the parts.
        dt: Length of a step [s].
        count: Number of parts of a step.
        linear: Whether controls are linear over a step.
    """

    scene: Scene
    integrator: Integrator
    dt: float
    count: int
    linear: bool

    def controls(self, u: Floats, steps: Integers) -> Floats:
        """Controls (K, m), or (K, 2m), of steps, from those of all steps (N, m), or of all nodes (N + 1, m)."""
        return np.concatenate([u[steps], u[steps + 1]], axis=1) if self.linear else u[steps]

    def states(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats] | None:
        """The q and v (K, count - 1, n) between the parts of K steps; None where one fails.

        Args:
            q: Configurations at their begin (K, n).
            v: Velocities at their begin (K, n).
            u: Their controls.
        """
        scene, dt = self.scene, self.dt / self.count
        if not (self.linear or scene.inputs or scene.custom or limited_servos(scene.elements)):
            commands = open_loop(np.zeros((1, scene.controls)))._replace(hold=self.count)
            forces = np.repeat((u @ scene.actuation.T)[:, None], self.count, axis=1)
            found = self.integrator.motions(scene, q.copy(), v.copy(), commands, forces, dt)
            return None if found is None else (found[0][:, :-1], found[1][:, :-1])
        within = np.empty((2, len(q), self.count - 1, scene.robot.dof))
        for k in range(len(q)):
            part, failure = self._motion(q[k], v[k], u[k])
            if failure is not None:
                return None
            within[:, k] = part.q[1:-1], part.v[1:-1]
        return within[0], within[1]

    def _motion(self, q: Floats, v: Floats, u: Floats) -> tuple[Trajectory, Failure | None]:
        """The parts of one step, and why one failed."""
        own = open_line(u.reshape(2, -1), self.integrator.stage_times) if self.linear else open_loop(u[None])
        return rollout(self.scene, self.integrator, q, v, own._replace(hold=self.count), self.dt / self.count)

    def slopes(self, q: Floats, v: Floats, u: Floats) -> tuple[tuple[Floats, Floats], Floats]:
        """The states as :meth:`states`, and their derivatives (K, count - 1, 2n, 2n + c) in (q, v, controls).

        Raises:
            LinearizationError: A part has no derivative.
        """
        own, n = self._by_differences if self.scene.inputs else self._chained, self.scene.robot.dof
        states = np.empty((2, len(q), self.count - 1, n))
        found = np.empty((len(q), self.count - 1, 2 * n, 2 * n + u.shape[1]))
        for k in range(len(q)):
            motion, failure = self._motion(q[k], v[k], u[k])
            if failure is not None:
                raise LinearizationError(motion.steps, float(motion.t[-1]), "a step fails in parts")
            states[:, k] = motion.q[1:-1], motion.v[1:-1]
            found[k] = own(motion.part(0, self.count - 1), u[k])
        return (states[0], states[1]), found

    def _chained(self, motion: Trajectory, u: Floats) -> Floats:
        """The derivatives in one step, those of its parts one after another."""
        scene, n = self.scene, self.scene.robot.dof
        lin = linearize_steps(scene, motion, self.integrator, motion.q[0], ramps=self.linear)
        slopes = np.tile(np.eye(2 * n), (self.count, 1, 1))
        if self.integrator.variational:
            slopes[:, n:] = velocity_at_nodes(scene, motion.q, motion.v)
        found = np.empty((self.count - 1, 2 * n, 2 * n + len(u)))
        # In (x, controls).
        after = np.eye(2 * n, 2 * n + len(u))
        after[:, : 2 * n] = np.linalg.inv(slopes[0])
        for j, (A, B) in enumerate(zip(lin.A, lin.B, strict=True)):
            after = A @ after
            if lin.ramp is None:
                after[:, 2 * n :] += B
            else:
                share, m = j / self.count, scene.controls
                rise = lin.ramp[j] / self.count
                after[:, 2 * n : 2 * n + m] += (1.0 - share) * B - rise
                after[:, 2 * n + m :] += share * B + rise
            found[j] = slopes[j + 1] @ after
        return found

    def _by_differences(self, motion: Trajectory, u: Floats) -> Floats:
        """The derivatives in one step by central differences: joints of kinematic inputs are on their way over it."""
        z, n = np.concatenate([motion.q[0], motion.v[0], u]), self.scene.robot.dof
        near = np.concatenate([z + _SHIFT * np.eye(len(z)), z - _SHIFT * np.eye(len(z))])
        parted = self.states(near[:, :n].copy(), near[:, n : 2 * n].copy(), near[:, 2 * n :].copy())
        if parted is None:
            raise LinearizationError(0, 0.0, "a step fails in parts")
        after, before = np.split(np.concatenate(parted, axis=2), 2)
        found: Floats = np.moveaxis((after - before) / (2.0 * _SHIFT), 0, -1)
        return found
