"""One motion to integrate in many ways: a scene, a state, controls and a duration; and a measured run of it."""

from __future__ import annotations

import hashlib
import logging
import reprlib
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.finding import announce
from varpin.integrators import Integrator
from varpin.integrators.base import Segment
from varpin.mechanics.scene import OF_CONSTRAINTS, Scene, require_scene
from varpin.signals.commands import open_loop
from varpin.signals.controls import held_rows
from varpin.signals.inputs import held_in_parts
from varpin.simulation.ladder import candidates
from varpin.simulation.start import on_constraints
from varpin.support.checks import JointValues, joint_array, positive
from varpin.support.frozen import Frozen

Result = TypeVar("Result")

logger = logging.getLogger(__name__)

# What a motion depends on, in the order of its fingerprint.
PARTS = ("scene", "initial state", "controls", "duration")

# Work between two chances for Ctrl-C, in steps of one joint.
_CHUNK = 100_000
# A first run this long [s] is as good as the next.
_LONG = 0.2


@dataclass(frozen=True, eq=False)
class Outcome:
    """A run.

    Attributes:
        q: Configurations (K + 1, n) at evenly spaced times; NaN from where it failed [rad or m].
        v: Velocities there (K + 1, n) [rad/s or m/s].
        energy_error: Largest distance of the energy from its start over all nodes [J].
        seconds: Wall time, the best of the repetitions [s].
        newton_iterations: In all.
        jets: In all.
        sweeps: In all; evaluations of forward dynamics with integrators on (q, v).
        split_steps: How many steps a guard took in parts.
        failure: Why it did not get to the end; empty if it did.
        spread: How far the middle one of the repetitions is above the best [s].
    """

    q: Floats
    v: Floats
    energy_error: float
    seconds: float
    newton_iterations: int
    jets: int
    sweeps: int
    split_steps: int
    failure: str
    spread: float = 0.0


@dataclass(frozen=True, eq=False)
class Setting(Frozen):
    """A motion to integrate.

    Attributes:
        scene: Without noise.
        q0: (n,) [rad or m].
        v0: (n,) [rad/s or m/s].
        controls: (R, m), each row held over duration / R; kinematic inputs reach their positions in that time.
        duration: [s].
    """

    scene: Scene
    q0: Floats
    v0: Floats
    controls: Floats
    duration: float

    @classmethod
    def of(
        cls, scene: Scene, q0: JointValues, v0: JointValues, controls: JointValues | None, duration: float
    ) -> Setting:
        """The setting of checked arguments. A start near constraints is moved onto them; the log has the distance.

        Raises:
            InputError: Wrong shapes or values, a scene with noise, controls that are a function.
            AssemblyError: The scene's constraints cannot be kept next to q0.
        """
        joints = require_scene(scene).robot.joint_names
        if scene.processes:
            raise InputError("errors of single motions are compared here: leave the noise out of the scene")
        if callable(controls):
            raise InputError("controls must be rows (R, m), each held over duration / R, or one row (m,)")
        begin, speed = joint_array("q0", q0, joints), joint_array("v0", v0, joints)
        rows = held_rows(scene, scene.command_at(begin) if controls is None else controls)
        duration = positive("duration", duration, "s")
        if scene.constraints:
            begin, speed, moved = on_constraints(scene, begin, speed)
            announce(logger, scene.announced, duration / len(rows), moved)
        return cls(scene, begin, speed, rows, duration)

    @property
    def conservative(self) -> bool:
        """Whether the energy is to stay."""
        still = not (self.controls @ self.scene.actuation.T).any() and not self.scene.inputs
        return self.scene.conservative and still

    @property
    def fingerprint(self) -> str:
        """SHA-256 over each part that the motion depends on, by :data:`PARTS`."""
        scene = self.scene
        surroundings = (
            *(scene.robot.tree, scene.gravity, scene.damping, scene.stiffness, scene.rest, scene.actuation),
            scene.diffusion,
            *([scene.elements, scene.armature] if scene.forces else []),
            *([scene.couplings] if scene.couplings else []),
            *([tuple(map(repr, scene.custom.parts))] if scene.custom else []),
            *(scene.values[name] for name in OF_CONSTRAINTS if name in scene.values),
            *([tuple(map(repr, scene.constraints))] if scene.constraints else []),
        )
        parts = surroundings, (self.q0, self.v0), self.controls, self.duration
        return " ".join(digest(part) for part in parts)

    def run(self, integrator: Integrator, steps: int, *, samples: int = 1, repeats: int = 0) -> Outcome:
        """The motion in ``steps`` steps, a multiple of R and of ``samples``: once, or the fastest of ``repeats``."""

        def once() -> tuple[Outcome, float]:
            outcome = self._once(integrator, steps, samples)
            return outcome, outcome.seconds

        first, seconds = once()
        if first.failure or repeats == 0:
            return first
        best, _, spread = fastest(once, repeats, (first, seconds))
        return replace(best, spread=spread)

    def _once(self, integrator: Integrator, steps: int, samples: int) -> Outcome:
        n, stride, hold = self.scene.robot.dof, steps // samples, steps // len(self.controls)
        dt, chunk = self.duration / steps, max(1, _CHUNK // n)
        q, v = np.full((2, samples + 1, n), np.nan)
        q[0], v[0] = self.q0, self.v0
        nothing = np.zeros((0, 0, 0))
        moved = self.rows(steps) if self.scene.inputs else None
        tally, drift, failure = np.zeros(4, dtype=np.int64), 0.0, ""
        begin = time.perf_counter()
        state, (start,) = integrator.start(self.scene, self.q0[None], self.v0[None])
        for first in range(0, steps, chunk):
            nodes = np.arange(first, min(first + chunk, steps))
            commands = open_loop(self.controls[nodes // hold] if moved is None else moved[nodes])
            (segment,) = integrator.rollout(self.scene, state, commands, nothing, dt)
            kept = np.flatnonzero((nodes[: len(segment.q)] + 1) % stride == 0)
            at = (nodes[kept] + 1) // stride
            q[at], v[at] = segment.q[kept], segment.v[kept]
            if len(segment.energy):
                drift = max(drift, float(np.abs(segment.energy - start.energy[0]).max()))
            tally += _tally(segment)
            if segment.failure is not None:
                done = first + len(segment.q)
                failure = f"step {done} of {steps} (t = {done * dt:.4g} s): {segment.failure.reason}"
                break
        seconds = time.perf_counter() - begin
        newton, jets, sweeps, split = (int(x) for x in tally)
        return Outcome(q, v, drift, seconds, newton, jets, sweeps, split, failure)

    def rows(self, steps: int) -> Floats:
        """The controls of each of so many steps (steps, m); kinematic inputs are on their way."""
        parts = len(self.controls)
        start = self.q0, self.v0
        return held_in_parts(self.scene, self.controls, *start, self.duration / parts, steps // parts)


def fastest(
    run: Callable[[], tuple[Result, float]], repeats: int, first: tuple[Result, float] | None = None
) -> tuple[Result, float, float]:
    """The result, the time and the spread [s] of the fastest of several runs; each returns its result and time.

    The first run finds caches cold and a processor at rest: it does not count unless it is so long that this is
    nothing.
    """
    runs = [run() if first is None else first]
    if runs[0][1] < _LONG:
        runs = []
    runs += [run() for _ in range(repeats - len(runs))]
    result, seconds = min(runs, key=lambda done: done[1])
    return result, seconds, float(np.median([done[1] for done in runs])) - seconds


def digest(part: Any) -> str:
    """SHA-256 over numbers, words, arrays, and tuples, mappings and dataclasses of them; the same in every process.

    Raises:
        InputError: It contains an object without a value of its own, known by its address alone.
    """
    total = hashlib.sha256()
    for array in _arrays(part):
        total.update(str(array.shape).encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def _tally(segment: Segment) -> NDArray[np.int64]:
    counts = segment.statistics
    return np.array([counts.newton_iterations.sum(), counts.jets.sum(), counts.sweeps.sum(), counts.split_steps])


def _arrays(value: Any) -> Iterator[NDArray[Any]]:
    """All arrays, numbers and words in ``value``, names of fields among them."""
    if is_dataclass(value) and not isinstance(value, type):
        value = {item.name: getattr(value, item.name) for item in fields(value)}
    if isinstance(value, Mapping):
        value = tuple(value.items())
    if isinstance(value, tuple):
        for part in value:
            yield from _arrays(part)
        return
    array = np.asarray("none" if value is None else value)
    if array.dtype.hasobject:
        raise InputError(f"{type(value).__name__} cannot be told from others in a saved record: {reprlib.repr(value)}")
    yield array


def integrators_of(scene: Scene, integrators: Sequence[Integrator] | None) -> tuple[Integrator, ...]:
    """The integrators to compare.

    Raises:
        InputError: None is given, one twice, or one that is no integrator, or does not keep the scene's constraints.
    """
    if integrators is None:
        return candidates(scene)
    if not isinstance(integrators, Iterable):
        raise InputError(f"integrators must be a list of varpin's, got {integrators!r}")
    members = tuple(integrators)
    for member in members:
        if not isinstance(member, Integrator):
            raise InputError(f"integrators must be varpin's, for example varpin.Midpoint(), got {member!r}")
        if scene.constraints and not member.keeps_constraints:
            raise InputError(f"{member} keeps no constraints: varpin.Midpoint() and varpin.Gauss(stages) do")
    if not members or len(set(map(repr, members))) < len(members):
        raise InputError("integrators must be one or more, each once")
    return members
