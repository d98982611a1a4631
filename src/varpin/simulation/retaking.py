"""Repetition of some steps of a finished motion, from their own first node, by another method or in smaller steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.errors import AssemblyError, SingularMassMatrix
from varpin.integrators import ExplicitEuler, Gauss, Integrator, Radau, RungeKutta4
from varpin.integrators.base import noise_impulses, open_loop
from varpin.integrators.collocation import MOST_STAGES
from varpin.integrators.variational import Variational
from varpin.integrators.within import Times, changing, in_parts
from varpin.mechanics.assembly import along_constraints, nearest
from varpin.mechanics.inputs import in_parts_of_steps, prescribing
from varpin.mechanics.scene import Scene
from varpin.trajectory import Trajectory

# Number of steps of the first piece; each further piece doubles the number of all steps.
_FIRST = 32
# Each change of the length of a step begins the repetition anew, which takes as long as some steps. So of this many
# steps in a row all have at least as many parts as any of them, up to the second number.
_ALIKE, _FEW = 8, 4
# Halvings by which parts are shorter than their number tells, at most.
_UNEVEN = 2
# Parts of a repeated step under constraints where dampers are faster than the step. With an odd number Gauss's factor
# on modes that are far faster, 1 or -1, is that of one step.
_DAMPED_PARTS = 7


@dataclass(frozen=True)
class Finer:
    """The method with which steps of a motion are repeated.

    Attributes:
        method: The integrator.
        parts: Number of its steps in one of the motion's.
        left: The remaining share of the motion's error.
    """

    method: Integrator
    parts: int
    left: float


def stopping(scene: Scene, stages: int, integrator: Integrator) -> Integrator:
    """A method for fast damping: Radau's; under constraints, which Radau's do not keep, Gauss's.

    Noise acts as in a motion's ``integrator``.
    """
    kick = _kick(integrator)
    return Gauss(stages, kick=kick) if scene.constraints else Radau(stages, kick=kick)


def _kick(integrator: Integrator) -> Literal["left", "split", "held"]:
    return integrator.kick if isinstance(integrator, Variational) else "left"


def finer(
    integrator: Integrator, trajectory: Trajectory, *, damped: bool, pulled: bool, constrained: bool = False
) -> Finer:
    """A method whose error is far below that of a motion's integrator in steps of the same length.

    It has one stage more, so that modes far faster than the step differ: a step with an odd number of stages multiplies
    them by -1, one with an even number by 1. Where dampers are faster than the step (``damped``) it has Radau's points
    or, under constraints, divides the step. Beside explicit methods of first order it is explicit, unless springs are
    faster than the step (``pulled``).
    """
    stages = int(getattr(integrator, "stages", 1))
    kick = _kick(integrator)
    if trajectory.dw.any() and isinstance(integrator, ExplicitEuler):
        # Its kicks come after the step.
        return Finer(integrator, 2, 0.5)
    more = stages + 1 if stages < MOST_STAGES else MOST_STAGES - 1
    parts = 2 if stages == MOST_STAGES else 1
    if damped and constrained:
        return Finer(Gauss(more, kick=kick), _DAMPED_PARTS, 0.0)
    if damped or integrator.l_stable:
        return Finer(Radau(max(3, more), kick=kick), parts, 0.0)
    if integrator.order == 1 and not (integrator.variational or pulled):
        return Finer(RungeKutta4(), parts, 0.0)
    return Finer(Gauss(max(2 if integrator.order <= 2 else 3, more), kick=kick), parts, 0.0)


def shortest_parts(trajectory: Trajectory) -> Integers:
    """Number of equal parts (N,), a power of two, that are as short as the shortest part that guards made of each step.

    Guards divide a step where the motion is fast: as many equal parts would resolve it less well than the motion does.
    Where a few parts are far shorter than the others, it is a multiple of their number.
    """
    substeps, halvings = trajectory.statistics.substeps, trajectory.statistics.halvings
    parts = np.ones(trajectory.steps, dtype=np.int64)
    if halvings.size:
        split = substeps > 1
        counts = substeps[split]
        deepest = np.maximum.reduceat(halvings, np.cumsum(counts) - counts).astype(np.int64)
        parts[split] = 1 << np.minimum(deepest, _UNEVEN + np.ceil(np.log2(counts)).astype(np.int64))
    return parts


def impulses_at(scene: Scene, integrator: Integrator, trajectory: Trajectory, steps: Integers) -> tuple[Floats, Floats]:
    """Impulses of the noise of a motion (..., n) before and after some of its steps (...), of compiled fields.

    For an integrator that holds the noise, those before a step are held over it.
    """
    # Explicit Euler's kicks come after the step.
    left = 0.0 if isinstance(integrator, ExplicitEuler) else integrator.left
    n = trajectory.q.shape[1]

    def part(share: float, node: Integers) -> Floats:
        if share == 0.0:
            return np.zeros((*steps.shape, n))
        at = trajectory.q[node.ravel()], trajectory.v[node.ravel()]
        return share * noise_impulses(scene, trajectory, *at, steps.ravel()).reshape(*steps.shape, n)

    return part(left, steps), part(1.0 - left, steps + 1)


def impulses_of_parts(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, steps: Integers, parts: int
) -> Floats:
    """The impulses of :func:`impulses_at` for some steps (K,) in so many parts each (K, parts, 2, n)."""
    before, after = impulses_at(scene, integrator, trajectory, steps)
    found = np.zeros((len(steps), parts, 2, before.shape[1]))
    if integrator.holds_noise:
        found[:, :, 0] = before[:, None] / parts
    else:
        found[:, 0, 0], found[:, -1, 1] = before, after
    return found


def noise_left_out(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> bool:
    """Whether a repetition has no noise, though the motion has.

    So it is for fields in Python, and under constraints for kicks that depend on controls that change within steps.
    """
    if not trajectory.dw.any():
        return False
    kicked = _of_whole_steps(scene, trajectory) and not integrator.holds_noise
    return scene.noise.diffusion is None or (kicked and bool(scene.constraints))


def _of_whole_steps(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether kicks depend on controls that change within steps: the core sees those of parts, not of whole steps."""
    within = trajectory.u_stages.shape[1] > 0 or trajectory.u_nodes.shape[1] > 0
    return within and scene.noise.sloped.size > 0


class Again:
    """Repetition of ``count`` steps of a motion from node ``step`` on under the same forces.

    Each is divided into ``parts``: an integer, or (count,). ``times`` are the stage times of the motion's own
    integrator, at which the motion has its controls if they change within steps. ``shift`` is added to q and v of the
    first node.

    Attributes:
        q: Configurations at the nodes (count + 1, n), NaN where not known.
        v: Velocities.
        done: Number of repeated steps.
        ended: Whether the repetition is complete or has failed.
    """

    def __init__(
        self,
        scene: Scene,
        method: Integrator,
        trajectory: Trajectory,
        times: Times,
        step: int,
        count: int,
        parts: int | Integers,
        shift: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.q, self.v = np.full((2, count + 1, scene.robot.dof), np.nan)
        self.q[0], self.v[0] = trajectory.q[step] + shift[0], trajectory.v[step] + shift[1]
        self.done, self.ended = 0, count == 0
        self._scene, self._method, self._trajectory, self._step = scene, method, trajectory, step
        self._count, self._times = count, times
        self._parts = np.full(count, parts, dtype=np.int64)
        for first in range(0, count, _ALIKE):
            some = self._parts[first : first + _ALIKE]
            some[:] = np.maximum(some, min(_FEW, some.max()))
        try:
            if scene.constraints and any(shift):
                self.q[0] = nearest(scene, self.q[0])
                self.v[0] = along_constraints(scene, self.q[0], self.v[0])
        except AssemblyError:
            self.ended = True
        self._start(0)

    def go_on(self, steps: int | None = None) -> None:
        """Repeat some more steps; if ``steps`` is left out, as many as there are already."""
        end = min(self._count, self.done + (max(self.done, _FIRST) if steps is None else steps))
        while not self.ended:
            alike = self._parts[self.done : end] == self._parts[self.done]
            last = end if alike.all() else self.done + int(alike.argmin())
            self._repeat(last, int(self._parts[self.done]))
            if self.done == end:
                break

    @property
    def work(self) -> int:
        """Number of steps taken for it, in parts."""
        return int(self._parts[: self.done].sum())

    def _start(self, node: int) -> None:
        """Begin anew at a node."""
        try:
            self._state, _ = self._method.start(self._scene, self.q[[node]], self.v[[node]])
        except (SingularMassMatrix, AssemblyError):
            self.ended = True

    def _repeat(self, end: int, parts: int) -> None:
        """Repeat the steps up to one, each in so many parts."""
        scene, trajectory, method, begin = self._scene, self._trajectory, self._method, self.done
        if begin and parts != self._parts[begin - 1]:
            # Guesses come from steps of the same length.
            self._start(begin)
            if self.ended:
                return
        taken = slice(self._step + begin, self._step + end)
        drawn, kicks = scene.silence, None
        held = bool(trajectory.dw.any()) and method.holds_noise
        if not held and (not trajectory.dw.any() or noise_left_out(scene, method, trajectory)):
            pass
        elif held or _of_whole_steps(scene, trajectory):
            steps = np.arange(taken.start, taken.stop)
            kicks = impulses_of_parts(scene, method, trajectory, steps, parts)
            kicks = kicks.reshape(1, -1, 2, scene.robot.dof)
        else:
            drawn = np.zeros((1, (end - begin) * parts, trajectory.dw.shape[1]))
            if isinstance(method, ExplicitEuler):
                # Its kicks come after the step.
                drawn[0, parts - 1 :: parts] = trajectory.dw[taken]
            else:
                drawn[0, ::parts] += method.left * trajectory.dw[taken]
                drawn[0, parts - 1 :: parts] += (1.0 - method.left) * trajectory.dw[taken]
        # Impulses of the noise depend on the controls, too.
        given = trajectory.u[taken], trajectory.q[taken], trajectory.v[taken]
        commands = open_loop(in_parts_of_steps(scene, *given, trajectory.dt, parts))
        if trajectory.u_stages.shape[1]:
            at = method.stage_times
            parted = changing(in_parts(trajectory.u_stages[taken], self._times, parts, at), at)
            commands = prescribing(scene, parted, commands.u)
        (segment,) = method.rollout_compiled(
            scene, self._state, commands, drawn, scene.no_drift, trajectory.dt / parts, kicks
        )
        done = len(segment.q) // parts
        for nodes, values in ((self.q, segment.q), (self.v, segment.v)):
            nodes[begin + 1 : begin + done + 1] = values[parts - 1 :: parts][:done]
        self.done += done
        self.ended = self.done < end or end == self._count


def taken_again(
    scene: Scene,
    method: Integrator,
    trajectory: Trajectory,
    times: Times,
    step: int,
    count: int,
    parts: int | Integers,
) -> tuple[Floats, Floats] | None:
    """Repeated steps: q and v at their nodes (count + 1, n). The arguments are those of :class:`Again`.

    NaN from where a step fails; None if the first does.
    """
    again = Again(scene, method, trajectory, times, step, count, parts)
    if not again.ended:
        again.go_on(count)
    return (again.q, again.v) if again.done else None
