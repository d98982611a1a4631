"""Motions within the steps of a plan: states at instants between nodes, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.core.arrays import Commands
from varpin.errors import LinearizationError
from varpin.integrators import Integrator
from varpin.integrators.base import Segment
from varpin.linearization import linearize_steps, velocity_at_nodes
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.scene import Scene
from varpin.signals.commands import Lines, on_lines, open_loop
from varpin.simulation.record import trajectory_of
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory, joined

# Differences of states and controls, where the derivatives of a step's parts do not follow from each other.
_SHIFT = 1e-5


@dataclass(frozen=True, eq=False)
class Parts(Frozen):
    """Steps that are each integrated in equal parts, from the node at their begin.

    Controls are (m,) of a step, or where they are linear those at its begin and its end (2m,).
    """

    scene: Scene  # without noise
    integrator: Integrator
    dt: float  # length of a step [s]
    count: int  # parts of a step
    linear: bool

    def controls(self, u: Floats, steps: Integers) -> Floats:
        """Controls (K, m), or (K, 2m), of steps, from those of all steps (N, m), or of all nodes (N + 1, m)."""
        return np.concatenate([u[steps], u[steps + 1]], axis=1) if self.linear else u[steps]

    def states(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats] | None:
        """The q and v (K, count + 1, n) at the ends of the parts of K steps from q and v (K, n); None if one fails."""
        own, dt = self._commands(u), self.dt / self.count
        try:
            found = self.integrator.motions(self.scene, q.copy(), v.copy(), own, dt)
        except CustomForceError:
            return None
        if found is None:
            return None
        return np.concatenate([q[:, None], found[0]], axis=1), np.concatenate([v[:, None], found[1]], axis=1)

    def _commands(self, u: Floats) -> Commands:
        """The controls of steps as one decision of each of K motions."""
        m = self.scene.controls
        found = open_loop(u[:, -m:])._replace(hold=self.count, own=1)
        if not self.linear:
            return found
        times = np.array(self.integrator.stage_times or (0.5,))
        return found._replace(before=np.ascontiguousarray(u[:, :m]), stage_times=times)

    def slopes(self, q: Floats, v: Floats, u: Floats) -> tuple[tuple[Floats, Floats], Floats]:
        """The states as :meth:`states`, and their derivatives (K, count + 1, 2n, 2n + c) in (q, v, controls).

        Raises:
            LinearizationError: A part fails, or has no derivative.
        """
        if self.scene.inputs:
            return self._states(q, v, u), self._by_differences(q, v, u)
        motion, states = self._one_after_another(q, v, u)
        return states, self._chained(motion, states, u)

    def _states(self, q: Floats, v: Floats, u: Floats) -> tuple[Floats, Floats]:
        found = self.states(q, v, u)
        if found is None:
            raise LinearizationError(0, 0.0, "a step fails in parts")
        return found

    def _chained(self, motion: Trajectory, states: tuple[Floats, Floats], u: Floats) -> Floats:
        """The derivatives in each step of :meth:`_one_after_another`, those of its parts one after another."""
        scene, n, K = self.scene, self.scene.robot.dof, len(u)
        lin = linearize_steps(scene, motion, self.integrator, motion.q[0], ramps=self.linear)
        A, B = (array.reshape(K, self.count, *array.shape[1:]) for array in (lin.A, lin.B))
        ramp = None if lin.ramp is None else lin.ramp.reshape(B.shape)
        slopes = np.tile(np.eye(2 * n), (K, self.count + 1, 1, 1))
        if self.integrator.variational:
            at = velocity_at_nodes(scene, *(x.reshape(-1, n) for x in states))
            slopes[:, :, n:] = at.reshape(K, self.count + 1, n, 2 * n)
        found = np.empty((K, self.count + 1, 2 * n, 2 * n + u.shape[1]))
        # In (x, controls).
        after = np.tile(np.eye(2 * n, found.shape[3]), (K, 1, 1))
        found[:, 0] = after
        after[:, :, : 2 * n] = np.linalg.inv(slopes[:, 0])
        for j in range(self.count):
            after = A[:, j] @ after
            if ramp is None:
                after[:, :, 2 * n :] += B[:, j]
            else:
                share, m = j / self.count, scene.controls
                rise = ramp[:, j] / self.count
                after[:, :, 2 * n : 2 * n + m] += (1.0 - share) * B[:, j] - rise
                after[:, :, 2 * n + m :] += share * B[:, j] + rise
            found[:, j + 1] = slopes[:, j + 1] @ after
        return found

    def _by_differences(self, q: Floats, v: Floats, u: Floats) -> Floats:
        """The derivatives by central differences: joints of kinematic inputs are on their way over a step."""
        z, n = np.concatenate([q, v, u], axis=1), self.scene.robot.dof
        K, Z = z.shape
        shifts = _SHIFT * np.concatenate([np.eye(Z), -np.eye(Z)])
        near = (z[:, None] + shifts).reshape(-1, Z)
        states = np.concatenate(self._states(near[:, :n], near[:, n : 2 * n], near[:, 2 * n :]), axis=2)
        after, before = states.reshape(K, 2, Z, self.count + 1, 2 * n).swapaxes(0, 1)
        found: Floats = np.moveaxis((after - before) / (2.0 * _SHIFT), 1, -1)
        return found

    def _one_after_another(self, q: Floats, v: Floats, u: Floats) -> tuple[Trajectory, tuple[Floats, Floats]]:
        """The parts of K steps as one motion, for its linearization, and their states (K, count + 1, n).

        In the place of each step's end is the begin of the next one: the linearization takes every step again from the
        node at its begin; that at its end is a first guess only.
        """
        scene, integrator, dt, no_noise = self.scene, self.integrator, self.dt / self.count, self.scene.silence
        state, first = integrator.start(scene, q.copy(), v.copy())
        try:
            segments = integrator.rollout_compiled(scene, state, self._commands(u), no_noise, scene.no_drift, dt)
        except CustomForceError as error:
            raise LinearizationError(0, 0.0, str(error)) from error
        for segment in segments:
            if segment.failure is not None:
                raise LinearizationError(len(segment.q), dt * len(segment.q), "a step fails in parts")
        ends: dict[str, Floats] = {}
        states: dict[str, Floats] = {}
        for name in ("q", "p", "v", "energy"):
            begins = np.array([getattr(segment, name) for segment in first])
            within = np.array([getattr(segment, name) for segment in segments])
            states[name] = np.concatenate([begins, within], axis=1)
            within[:-1, -1] = begins[1:, 0]
            ends[name] = within.reshape(-1, *within.shape[2:])
        impulses = [segment.impulses for segment in segments if segment.impulses is not None]
        steps = Segment(
            q=ends["q"],
            p=ends["p"],
            v=ends["v"],
            energy=ends["energy"],
            u=np.concatenate([segment.u for segment in segments]),
            statistics=joined([segment.statistics for segment in segments]),
            impulses=np.concatenate(impulses) if impulses else None,
        )
        motion = trajectory_of(scene, integrator, dt, first[0], [steps], None, None)
        if self.linear:
            mean, stages, nodes = self._lines(u)
            motion = replace(motion, u=mean, u_stages=stages, u_nodes=nodes)
        return motion, (states["q"], states["v"])

    def _lines(self, u: Floats) -> Lines:
        """The controls within the parts of K steps, one after another."""
        begins, ends = np.split(np.repeat(u, self.count, axis=0), 2, axis=1)
        before, mean = on_lines(begins, ends, self.count, (0.0, 0.5)).swapaxes(0, 1)
        stages = on_lines(begins, ends, self.count, self.integrator.stage_times)
        return Lines(mean.copy(), stages, np.concatenate([before, ends[-1:]]))
