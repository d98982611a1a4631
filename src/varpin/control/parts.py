"""Motions within the steps of a plan: states at instants between nodes, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

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
from varpin.trajectory import Trajectory, joined

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
        motions = []
        for k in range(len(q)):
            motion, failure = self._motion(q[k], v[k], u[k])
            if failure is not None:
                raise LinearizationError(motion.steps, float(motion.t[-1]), "a step fails in parts")
            motions.append(motion)
        states = np.array([motion.q[1:-1] for motion in motions]), np.array([motion.v[1:-1] for motion in motions])
        if self.scene.inputs:
            found = np.array([self._by_differences(*step) for step in zip(motions, u, strict=True)])
        else:
            found = self._chained(_one_after_another(motions), u)
        return states, found

    def _chained(self, motion: Trajectory, u: Floats) -> Floats:
        """The derivatives in each step of :func:`_one_after_another`, those of its parts one after another."""
        scene, n, K = self.scene, self.scene.robot.dof, len(u)
        lin = linearize_steps(scene, motion, self.integrator, motion.q[0], ramps=self.linear)
        A, B = (array.reshape(K, self.count, *array.shape[1:]) for array in (lin.A, lin.B))
        ramp = None if lin.ramp is None else lin.ramp.reshape(B.shape)
        slopes = np.tile(np.eye(2 * n), (K, self.count, 1, 1))
        if self.integrator.variational:
            at = velocity_at_nodes(scene, motion.q[:-1], motion.v[:-1])
            slopes[:, :, n:] = at.reshape(K, self.count, n, 2 * n)
        found = np.empty((K, self.count - 1, 2 * n, 2 * n + u.shape[1]))
        # In (x, controls).
        after = np.tile(np.eye(2 * n, 2 * n + u.shape[1]), (K, 1, 1))
        after[:, :, : 2 * n] = np.linalg.inv(slopes[:, 0])
        for j in range(self.count - 1):
            after = A[:, j] @ after
            if ramp is None:
                after[:, :, 2 * n :] += B[:, j]
            else:
                share, m = j / self.count, scene.controls
                rise = ramp[:, j] / self.count
                after[:, :, 2 * n : 2 * n + m] += (1.0 - share) * B[:, j] - rise
                after[:, :, 2 * n + m :] += share * B[:, j] + rise
            found[:, j] = slopes[:, j + 1] @ after
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


def _one_after_another(motions: list[Trajectory]) -> Trajectory:
    """Motions as one, for its linearization: each without its last node, in whose place the next one begins.

    The linearization takes every step again from the node at its begin; that at its end is a first guess only.
    """
    first, last = motions[0], motions[-1]
    of_nodes, of_steps = ("q", "v", "p", "energy", "u_nodes"), ("u", "u_stages", "dw", "constraint_forces")
    arrays: dict[str, Any]
    arrays = {name: np.concatenate([*(getattr(x, name)[:-1] for x in motions), getattr(last, name)[-1:]])
              for name in of_nodes}  # fmt: skip
    arrays |= {name: np.concatenate([getattr(x, name) for x in motions]) for name in of_steps}
    times = first.dt * np.arange(len(arrays["q"]), dtype=np.float64)
    return replace(first, t=times, **arrays, statistics=joined([x.statistics for x in motions]))
