"""One motion to integrate in many ways: a scene, a state, controls and a duration; and a timed run of it."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.finding import announce
from varpin.integrators import Integrator
from varpin.mechanics.scene import Scene, require_scene
from varpin.signals.commands import held_in_parts
from varpin.signals.controls import control_rows
from varpin.simulation.failures import StepFailure
from varpin.simulation.simulate import simulate
from varpin.simulation.start import on_constraints
from varpin.simulation.tolerance import candidates
from varpin.support.checks import JointValues, joint_array, positive, tuple_of
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

Result = TypeVar("Result")

logger = logging.getLogger(__name__)

# A first run this long [s] is as good as the next.
_LONG = 0.2


@dataclass(frozen=True, eq=False)
class Outcome:
    """A timed run."""

    motion: Trajectory  # up to the step that failed, if one did
    failure: str  # why it did not get to the end; empty if it did
    seconds: float  # wall time, the best of the repetitions [s]


@dataclass(frozen=True, eq=False)
class Setting(Frozen):
    """A motion to integrate."""

    scene: Scene  # without noise
    q0: Floats  # (n,) [rad or m]
    v0: Floats  # (n,) [rad/s or m/s]
    controls: Floats  # (R, m), each row held over duration / R; kinematic inputs reach their positions in that time
    duration: float  # [s]

    @classmethod
    def of(
        cls, scene: Scene, q0: JointValues, v0: JointValues, controls: JointValues | None, duration: float
    ) -> Setting:
        """The setting of checked arguments. A start near constraints is moved onto them; the log has the distance."""
        joints = require_scene(scene).robot.joint_names
        if scene.processes:
            raise InputError("errors of single motions are compared here: leave the noise out of the scene")
        if callable(controls):
            raise InputError("controls must be rows (R, m), each held over duration / R, or one row (m,)")
        begin, speed = joint_array("q0", q0, joints), joint_array("v0", v0, joints)
        rows = control_rows(scene, scene.command_at(begin) if controls is None else controls)
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

    def run(self, integrator: Integrator, steps: int, *, repeats: int = 0, within: float = math.inf) -> Outcome:
        """The motion in ``steps`` steps, a multiple of R; arguments for the time as for :func:`fastest`."""
        (motion, failure), seconds = fastest(lambda: self._once(integrator, steps), repeats, within)
        return Outcome(motion, failure, seconds)

    def _once(self, integrator: Integrator, steps: int) -> tuple[tuple[Trajectory, str], float]:
        scene, R, failure = self.scene, len(self.controls), ""
        rows = held_in_parts(scene, self.controls, self.q0, self.v0, self.duration / R, steps // R)
        options: dict[str, Any] = {"dt": self.duration / steps, "steps": steps, "controls": rows, "check": False}
        begin = time.perf_counter()
        try:
            motion = simulate(scene, self.q0, self.v0, integrator=integrator, **options)
        except StepFailure as error:
            motion, failure = error.trajectory, error.problem
        return (motion, failure), time.perf_counter() - begin


def fastest(run: Callable[[], tuple[Result, float]], repeats: int, within: float = math.inf) -> tuple[Result, float]:
    """The result and the time [s] of the fastest of several runs; 0 ``repeats`` are the first alone.

    The first run finds caches cold and a processor at rest: it does not count unless it is so long that this is
    nothing. None is begun after the time ``within`` [s] if one counts.
    """
    begin, first = time.perf_counter(), run()
    counted = [first] if not repeats or first[1] >= min(_LONG, within) else []
    while not counted or (len(counted) < repeats and time.perf_counter() - begin < within):
        counted.append(run())
    return min(counted, key=lambda done: done[1])


def integrators_of(scene: Scene, integrators: Sequence[Integrator] | None) -> tuple[Integrator, ...]:
    """The integrators to compare."""
    if integrators is None:
        return candidates(scene)
    members = tuple_of("integrators", integrators, Integrator)
    for member in members:
        if scene.constraints and not member.keeps_constraints:
            raise InputError(f"{member} keeps no constraints: varpin.Midpoint() and varpin.Gauss(stages) do")
    if not members or len(set(map(repr, members))) < len(members):
        raise InputError("integrators must be one or more, each once")
    return members
