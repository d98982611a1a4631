"""The record of a motion, what a progress function is told of it, and motions under given commands."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.errors import ControlError, InputError, StepError, VarpinError
from varpin.integrators import Integrator, Segment
from varpin.integrators.base import Failure, Run, join
from varpin.mechanics.constraints import CustomConstraintError
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.scene import Scene
from varpin.signals.commands import as_moved, in_parts_of_steps, lines, open_loop, rows, steps_of, with_ends
from varpin.signals.controls import Controls
from varpin.signals.functions import ControlLaw, Sampled, decision
from varpin.simulation.failures import ConstraintError, ForceError, NoiseError
from varpin.support.checks import told_motion
from varpin.trajectory import Nodes, Trajectory

# Number of segments from which on they are joined into one.
_PARTS = 256
# The error of a step for that of a user's function; of noise for any other.
_OF_STEPS: dict[type[InputError], type[StepError]] = {
    CustomForceError: ForceError,
    CustomConstraintError: ConstraintError,
}

Progress = Callable[[int, int], None] | Callable[[int, int, Nodes], None]
# Longest time between two calls of a function that gets the motion [s], except within a chunk of steps.
_LONGEST = 1.0 / 60.0


class Reporter:
    """Calls a progress function with the number of steps done and, if it takes them, the new nodes."""

    def __init__(self, progress: Progress | None, steps: int, dt: float) -> None:
        self._progress: Any = progress
        self._steps, self._dt = steps, dt
        self._takes_nodes = told_motion("progress", progress, "steps done, steps in all", "nodes")
        self._parts: list[Segment] = []
        self._last = time.perf_counter()

    def begin(self, node: Segment) -> None:
        """Take the first node, and report it to a function that takes nodes."""
        if self._takes_nodes:
            self._parts = [node]
            self._report(0)

    def add(self, segment: Segment, done: int, *, due: bool) -> None:
        """Take steps, ``done`` the number of all so far; report if ``due``, late or at the end."""
        if self._progress is None:
            return
        if self._takes_nodes:
            self._parts.append(segment)
            due = due or time.perf_counter() - self._last > _LONGEST
        if due or done == self._steps:
            self._report(done)

    def _report(self, done: int) -> None:
        if not self._takes_nodes:
            self._progress(done, self._steps)
            return
        q, v = (np.concatenate([getattr(part, name) for part in self._parts]) for name in ("q", "v"))
        nodes = Nodes(np.arange(done - len(q) + 1, done + 1, dtype=np.float64) * self._dt, q, v)
        self._parts = [replace(self._parts[-1], q=q[-1:], v=v[-1:])]
        self._progress(done, self._steps, nodes)
        self._last = time.perf_counter()


class MotionRecord:
    """The steps done so far.

    Attributes:
        steps: Their number.
        last: The segment added last, or the first node.
    """

    def __init__(
        self,
        scene: Scene,
        integrator: Integrator,
        dt: float,
        dw: Floats,
        first: Segment,
        line: Commands | None,
        *,
        held: bool = False,
    ) -> None:
        self.scene, self.integrator, self.dt, self.dw = scene, integrator, dt, dw
        self._line = line  # the commands of controls that are linear between nodes
        # Whether controls of kinematic inputs are the goals of several steps; they are recorded step by step.
        self._on_way = bool(scene.inputs) and (held or line is not None)
        self.steps, self.last = 0, first
        self._first = first
        self._joined: list[Segment] = []
        self._parts: list[Segment] = []
        self._within: list[Floats] = []

    def advance(
        self, state: Run, controls: Controls | ControlLaw, commands: Commands, most: int, steps: int
    ) -> Segment:
        """Append about ``most`` steps of ``steps`` in all; a StepError with the motion so far if a function failed."""
        try:
            block = next_block(controls, commands, self, most, steps - self.steps)
        except ControlError as error:
            raise error.after(self.trajectory()) from error.__cause__
        drawn = self.dw[None, self.steps : self.steps + steps_of(block)] if len(self.dw) else self.dw[None, :0][:0]
        try:
            (segment,) = self.integrator.rollout(self.scene, state, block, drawn, self.dt)
        except (CustomForceError, CustomConstraintError, InputError) as error:
            now = self.trajectory()
            kind = _OF_STEPS.get(type(error), NoiseError)
            cause = error.__cause__ if kind is NoiseError else error
            raise kind(now.steps, float(now.t[-1]), str(error), now) from cause
        if not len(segment.q):
            return segment
        self.steps += len(segment.q)
        self.last = segment
        self._parts.append(segment)
        if len(block.within):
            self._within.append(block.within[: len(segment.q)])
        # A segment of one step takes many times the memory of its numbers.
        if len(self._parts) == _PARTS:
            self._joined.append(join(self._parts))
            self._parts = []
        return segment

    def trajectory(self) -> Trajectory:
        """The motion so far."""
        dw = self.dw[: self.steps] if len(self.dw) else None
        within = np.concatenate(self._within) if self._within else None
        parts = [*self._joined, *self._parts]
        made = trajectory_of(self.scene, self.integrator, self.dt, self._first, parts, dw, within, self._line)
        if not self._on_way:
            return made
        q, v, nodes = made.q, made.v, made.u_nodes
        return replace(
            made,
            u=as_moved(self.scene, q[1:], v[1:], made.u),
            u_stages=as_moved(self.scene, q[1:, None], v[1:, None], made.u_stages),
            u_nodes=as_moved(self.scene, q, v, nodes) if nodes.shape[1] else nodes,
        )


def trajectory_of(
    scene: Scene,
    integrator: Integrator,
    dt: float,
    first: Segment,
    parts: list[Segment],
    dw: Floats | None,
    within: Floats | None,
    on: Commands | None = None,
) -> Trajectory:
    """The motion from a first node through consecutive segments, with increments ``dw`` (N, k), None for zeros.

    ``within`` are the controls at the stages (N, s, m), None for constant ones; ``on`` the commands of the whole
    motion, where its controls are linear between nodes.
    """
    steps = join(parts) if len(parts) > 1 else parts[0] if parts else first.part(0)
    N = len(steps.u)
    u, nodes = steps.u, np.zeros((N + 1, 0))
    if on is not None:
        mean, stages, nodes = lines(on, steps.u, integrator.stage_times)
        # A kinematic input's control is where its joint is at the end of the step.
        u, within = with_ends(scene, mean, nodes[1:]), with_ends(scene, stages, nodes[1:])
    return Trajectory(
        t=np.arange(N + 1, dtype=np.float64) * dt,
        q=np.concatenate([first.q, steps.q]),
        v=np.concatenate([first.v, steps.v]),
        p=np.concatenate([first.p, steps.p]),
        energy=np.concatenate([first.energy, steps.energy]),
        u=u,
        dw=np.zeros((N, scene.processes)) if dw is None else dw,
        masses=scene.robot.tree.mass.copy(),
        dt=dt,
        integrator=str(integrator),
        robot=scene.robot.name,
        joint_names=scene.robot.joint_names,
        statistics=steps.statistics,
        scene_values=scene.values,
        constraint_forces=np.zeros((N, len(scene.constraint_order))) if steps.impulses is None else steps.impulses / dt,
        constraint_labels=scene.constraint_labels,
        u_stages=np.zeros((N, 0, scene.controls)) if within is None else within,
        u_nodes=nodes,
    )


def next_block(
    controls: Controls | ControlLaw, commands: Commands, record: MotionRecord, most: int, left: int
) -> Commands:
    """Commands of about ``most`` next steps, whole intervals of held controls unless it is 1, of ``left`` in all.

    ``commands`` are those of the whole motion, unless the ``controls`` are a function: it may fail with a ControlError.
    """
    if callable(controls):
        decides = record.steps % commands.hold == 0
        k, last = record.steps, record.last
        u = decision(controls, record.scene, k, k * record.dt, last.q[-1], last.v[-1]) if decides else last.u[-1:]
        if record.scene.inputs:
            # All steps of the period: a kinematic input is on its way over them.
            state = record.last.q[-1:], record.last.v[-1:]
            u = in_parts_of_steps(record.scene, u, *state, commands.hold * record.dt, commands.hold)
            return open_loop(u[:left])
        return open_loop(u)._replace(hold=min(1 if most == 1 else commands.hold, left))
    if isinstance(controls, Sampled):
        times, first = record.integrator.stage_times, record.steps
        try:
            return controls.commands(first, min(most, left), times)
        except ControlError as error:
            # The steps before the one for which it fails.
            if error.step == first:
                raise
            return controls.commands(first, error.step - first, times)
    first, held = divmod(record.steps, commands.hold)
    before = record.last.u[None, -1] if record.steps else None
    block = rows(commands, first, first + max(1, most // commands.hold), before)
    # A kinematic input, or a line, is on its way over all steps of a decision.
    if most > 1 or commands.hold == 1 or record.scene.inputs or len(commands.stage_times):
        return block
    return open_loop(record.last.u[-1:]) if held else block._replace(hold=1)


class Motions:
    """Motions from one state under given commands; they share their work arrays."""

    def __init__(self, scene: Scene, integrator: Integrator, q0: Floats, v0: Floats, dt: float) -> None:
        self.scene, self.integrator, self.dt = scene, integrator, dt
        self._state, (self._first,) = integrator.start(scene, q0[None], v0[None])

    def under(
        self,
        commands: Commands,
        *,
        increments: Floats | None = None,
        integrator: Integrator | None = None,
    ) -> tuple[Trajectory, Failure | None]:
        """The motion under commands of all its steps, unchecked, and the failure that stopped it, if any.

        ``increments`` are (N, k) [s^0.5], left out for no noise; ``integrator`` is the integrator with another guard.
        Raises a ForceError or ConstraintError if a function failed.
        """
        drawn = np.zeros((0, 0, self.scene.processes)) if increments is None else increments[None]
        own = integrator or self.integrator
        state = own.fork(self._state)
        try:
            (segment,) = own.rollout(self.scene, state, commands, drawn, self.dt)
        except (CustomForceError, CustomConstraintError) as error:
            raise self.located(commands, increments, error) from error
        done = len(segment.u)
        dw = None if increments is None else increments[:done]
        within = commands.within[:done] if len(commands.within) else None
        line = commands if len(commands.stage_times) else None
        made = trajectory_of(self.scene, self.integrator, self.dt, self._first, [segment], dw, within, line)
        return made, segment.failure

    def located(self, commands: Commands, increments: Floats | None, error: InputError, where: str = "") -> VarpinError:
        """The error of a user's function that failed under commands, with its step and the motion before.

        The motion is repeated step by step to find the step.
        """
        line = commands if len(commands.stage_times) else None
        dw = np.zeros((0, self.scene.processes)) if increments is None else increments
        record = MotionRecord(self.scene, self.integrator, self.dt, dw, self._first, line)
        state, steps = self.integrator.fork(self._state), steps_of(commands)
        try:
            while record.steps < steps and record.advance(state, None, commands, 1, steps).failure is None:
                pass
        except StepError as found:
            return type(found)(found.step, found.time, f"{where}{found.problem}", found.trajectory)
        # The function did not fail this time: its result depends on more than its arguments.
        return error


def rollout(
    scene: Scene, integrator: Integrator, q0: Floats, v0: Floats, commands: Commands, dt: float
) -> tuple[Trajectory, Failure | None]:
    """One of the :class:`Motions` from (q0, v0)."""
    return Motions(scene, integrator, q0, v0, dt).under(commands)
