"""A robot where it is hard: its own motions with every integrator, each judged by independent checks."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import VarpinError
from varpin.integrators import ExplicitEuler, Gauss, Integrator, Midpoint, Radau, RungeKutta4, SemiImplicitEuler
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.noise import AdditiveNoise
from varpin.mechanics.scene import Scene
from varpin.mechanics.wiener import wiener_increments
from varpin.model import Robot, load_robot
from varpin.simulation import limits
from varpin.simulation.failures import Interrupted
from varpin.simulation.simulate import simulate
from varpin.study.checks import LEVELS, condition, findings, finite, measures
from varpin.study.exact import before_step, exact_motion
from varpin.study.record import Progress, Study, collect
from varpin.support.checks import positive, tuple_of
from varpin.trajectory import Trajectory

INTEGRATORS: tuple[Integrator, ...] = (
    *(Midpoint(alpha=alpha) for alpha in (0.0, 0.5, 1.0)),
    *(Gauss(stages=stages) for stages in (1, 2, 3, 4)),
    Radau(stages=4),
    ExplicitEuler(),
    SemiImplicitEuler(),
    RungeKutta4(),
)

# Steps from rest that make a motion of which half a step is little.
_FIRST = 40
# What no coarse step excuses: a record that contradicts itself, and derivatives without their structure.
_STRUCTURE = ("record", "symplecticity")


class Kind(Enum):
    """The judgement of a motion; the value is its name in texts, and ``meaning`` what it says."""

    meaning: str

    ACCURATE = "accurate", "every check passes"
    DEGRADED = "degraded", "varpin warns that the result is inaccurate"
    REFUSED = "refused", "a named error before the first step"
    STOPPED = "stopped", "a named error during the run; the motion up to there is kept"
    WRONG = "silent wrong", "a check fails, and varpin gives no warning"

    def __new__(cls, word: str, meaning: str) -> Kind:
        """A judgement by its name and meaning."""
        kind = object.__new__(cls)
        kind._value_, kind.meaning = word, meaning
        return kind


@dataclass(frozen=True)
class Cell:
    """A motion with one integrator. Measures are NaN where they do not apply.

    Attributes:
        trial: Name of the motion.
        integrator: As text.
        kind: One of the five.
        error: Largest distance in q from the exact motion over its window, in units of how far that goes.
        joint: The same distance, each joint in units of its own travel.
        velocity: The same of v, in units of each joint's largest velocity.
        energy: Largest error of the energy balance, in units of the energy there is to turn over.
        symplecticity: Largest entry of A' J A - J, in units of the sum of magnitudes that cancel in it.
        record: Largest distance of recorded momenta and energies from Pinocchio's, in their own units.
        said: varpin's warnings, or its error.
        found: The failed checks.
        done: Number of steps taken.
        steps: Number of steps of a complete motion.
        seconds: Wall time, checks included [s].
    """

    trial: str
    integrator: str
    kind: Kind = Kind.REFUSED
    error: float = math.nan
    joint: float = math.nan
    velocity: float = math.nan
    energy: float = math.nan
    symplecticity: float = math.nan
    record: float = math.nan
    said: tuple[str, ...] = ()
    found: tuple[str, ...] = ()
    done: int = 0
    steps: int = 0
    seconds: float = 0.0


@dataclass(frozen=True, eq=False, repr=False)
class Record(Study[Cell]):
    """What came of a robot's motions.

    Attributes:
        runs: In the order of the motions, and of the integrators within.
    """

    headings: ClassVar = {
        "trial": "motion",
        "kind": "result",
        "error": "error / travel",
        "joint": "error / joint's travel",
        "velocity": "error / joint's speed",
        "energy": "energy error / turnover",
    }
    shown: ClassVar = ("trial", "integrator", "kind", "error", "energy")

    @property
    def summary(self) -> str:
        """How many there are of each kind."""
        return ", ".join(f"{count} {kind.value}" for kind, count in self.counts().items() if count) or "no runs"

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the table has to know."""
        return (
            "error: the largest distance in q from the exact motion, as a share of its travel; energy error: the "
            "largest error of the energy balance, as a share of the energy that the motion exchanges",
        )

    def note(self, run: Cell) -> str:
        """The failed checks."""
        return "; ".join(run.found)

    def counts(self) -> dict[Kind, int]:
        """How many motions there are of each kind."""
        return {kind: sum(cell.kind is kind for cell in self.runs) for kind in Kind}

    def wrong(self) -> tuple[Cell, ...]:
        """The motions that are wrong without a warning."""
        return tuple(cell for cell in self.runs if cell.kind is Kind.WRONG)


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion that is hard to integrate, with controls (N, m) or (m,) and increments (N, k) [s^0.5], or None.

    It does not depend on the whole turns in q0 that it is ``ahead`` (n,) [rad]; a window [s] of it is compared.
    """

    name: str
    dt: float
    steps: int
    scene: Scene
    q0: Floats
    v0: Floats
    controls: Floats | None
    increments: Floats | None
    ahead: Floats | float
    window: float

    def measures(self, integrator: Integrator, trajectory: Trajectory) -> dict[str, float]:
        """The measures of what an integrator made of it."""
        window, left = slice(max(1, round(self.window / self.dt))), before_step(integrator)
        u, dw = trajectory.u[window], trajectory.dw[window]
        exact = exact_motion(self.scene, self.q0, self.v0, u, dw, dt=self.dt, left=left, ahead=self.ahead)
        return measures(self.scene, integrator, trajectory, exact)


def motions_of(robot: Robot) -> list[Motion]:
    """Motions that make sense for any robot, scaled by its weight and by how fast it falls from q = 0.3."""
    n = robot.dof
    jet = lagrangian_jet(Scene(robot, damping=0.0), np.full(n, 0.3), np.zeros(n))
    # The inertia that each joint has to move, and the heaviest of the forces that gravity takes it to.
    inertia = np.diag(jet.Lvv)
    weight = np.maximum(np.abs(jet.Lq), 1e-3 * inertia)
    found: list[Motion] = []

    def add(
        name: str,
        dt: float,
        steps: int,
        window: float = 1.0,
        *,
        v: ArrayLike = 0.0,
        ahead: ArrayLike = 0.0,
        controls: Floats | None = None,
        increments: Floats | None = None,
        **scene: Any,
    ) -> None:
        v0, shift = (np.broadcast_to(np.asarray(x, dtype=np.float64), (n,)).copy() for x in (v, ahead))
        whole = Scene(robot, **{"damping": 0.0} | scene)
        found.append(Motion(name, dt, steps, whole, 0.3 + shift, v0, controls, increments, shift, window))

    # What starts to slide down is behind by half a step with any method of first order: much of its first steps, little
    # of its motion.
    for dt, steps in ((1e-6, 500), (1e-4, 1000), (1e-3, 1000), (0.01, 500), (0.1, 100), (0.5, 40)):
        add(f"falls, dt = {dt:g} s", dt, steps, max(0.3, _FIRST * dt))
    for rate in (10.0, 1e3):
        add(f"{rate:g} rad/s", 1e-3, 500, max(1.0 / rate, _FIRST * 1e-3), v=rate, gravity=False)
    # A mimic joint that follows turns by a part of it, and no motion is the same then.
    turns = np.where(robot.slides | bool(robot.ties), 0.0, 2.0 * math.pi * 1e6)
    add("after 1e6 turns", 1e-3, 500, 0.3, ahead=turns)
    add("no gravity", 1e-2, 500, 0.5, v=1.0, gravity=False)
    add("gravity 1e4 m/s^2", 1e-3, 500, _FIRST * 1e-3, gravity=(0.0, 0.0, -1e4))
    for turned in (0.1, 2.4, 50.0):
        add(f"springs, h omega = {turned:g}", 1e-3, 500, 0.01, stiffness=(turned / 1e-3) ** 2 * inertia)
    for lost in (0.1, 10.0, 1e4):
        add(f"dampers, h d / I = {lost:g}", 1e-3, 500, 0.05, v=1.0, damping=lost / 1e-3 * inertia)
    for share in (10.0, 1e6):
        add(f"+-{share:g} times its weight", 1e-3, 200, controls=flipping(share * weight))
    for strength in (1e-12, 1.0):
        noise, dw = AdditiveNoise(strength * weight), wiener_increments(n, 1e-3, 100, 0)
        add(f"noise of {strength:g} times its weight", 1e-3, 100, noise=noise, increments=dw)
    return found


def flipping(torque: Floats) -> Floats:
    """Torques (n,) that change their sign at each of 200 steps (200, n)."""
    return np.where(np.arange(200) % 2 == 0, 1.0, -1.0)[:, None] * torque


def check_robot(
    robot: Robot | str | os.PathLike[str],
    *,
    integrators: Sequence[Integrator] | None = None,
    patience: float = 20.0,
    progress: Progress | None = None,
) -> Record:
    """Run a robot's motions where it is hard with every integrator, and judge each by independent checks.

    It falls at steps from 1e-6 s to 0.5 s, turns fast and far, floats, hangs on stiff springs and dampers, is pushed to
    and fro, and trembles. Momenta and energies are held against Pinocchio's, q and v against LSODA's motion at 1e-11,
    energies against their balance, and the derivatives of variational methods against A' J A = J.

    Main args:
        robot: The robot, its name, or the path of its file.
        integrators: These alone.

    Other Args:
        patience: Processor time that a motion may take before it is judged by what there is [s].
        progress: Called with (motions done, motions in all).

    Returns:
        The record; ``record.wrong()`` are results that are wrong without a warning.

    Raises:
        RobotError: There is no such robot, or its file cannot be read.
        InputError: ``patience`` is not positive, or ``integrators`` are not varpin's.
        StudyInterrupted: Ctrl-C; holds the motions so far. It is a KeyboardInterrupt.
    """
    arm = robot if isinstance(robot, Robot) else load_robot(robot)
    limit = positive("patience", patience, "s")
    members = INTEGRATORS if integrators is None else tuple_of("integrators", integrators, Integrator)
    jobs = [(motion, member) for motion in motions_of(arm) for member in members]
    cells = (cell(motion.name, partial(replace, motion), member, limit) for motion, member in jobs)
    return collect(Record((), arm.name), cells, len(jobs), progress)


def cell(name: str, build: Callable[[], Motion], integrator: Integrator, patience: float) -> Cell:
    """A motion with an integrator; errors of varpin refuse it, others are faults."""
    begin, made = time.perf_counter(), Cell(name, str(integrator))
    try:
        motion = build()
        made = replace(made, steps=motion.steps)
        given = {"dt": motion.dt, "steps": motion.steps, "controls": motion.controls, "increments": motion.increments}
        trajectory, error = attempt(patience, motion.scene, motion.q0, motion.v0, **given, integrator=integrator)
    except VarpinError as refusal:
        made = replace(made, said=(line_of(refusal),))
    except Exception as fault:
        made = replace(made, kind=Kind.WRONG, found=(f"unnamed error: {line_of(fault)}",))
    else:
        measured = motion.measures(integrator, trajectory)
        kind, said, wrong = judge(trajectory, error, findings(measured, condition(motion.scene, motion.q0)))
        known: dict[str, Any] = {level: measured[level] for level in LEVELS if level in measured}
        made = replace(made, kind=kind, said=said, found=wrong, done=trajectory.steps, **known)
    return replace(made, seconds=round(time.perf_counter() - begin, 3))


def judge(
    trajectory: Trajectory, error: VarpinError | None, wrong: tuple[str, ...]
) -> tuple[Kind, tuple[str, ...], tuple[str, ...]]:
    """The kind of a motion, varpin's error, which ended it, and warnings, and the failed checks."""
    # These warnings are not about the steps that the checks judge.
    elsewhere = limits.KINDS
    warnings = (warning for warning in trajectory.warnings if warning.kind not in elsewhere)
    said = (*(() if error is None else (line_of(error),)), *warnings)
    if not finite(trajectory):
        return Kind.WRONG, said, ("the record is not finite", *wrong)
    if any(text.startswith(_STRUCTURE) for text in wrong):
        return Kind.WRONG, said, wrong
    if error is not None:
        return Kind.STOPPED, said, wrong
    return Kind.DEGRADED if said else Kind.WRONG if wrong else Kind.ACCURATE, said, wrong


class _OutOfTime(KeyboardInterrupt):
    """Ends a motion that takes too long, as Ctrl-C does."""


def attempt(
    patience: float, scene: Scene, q0: Floats, v0: Floats, **options: Any
) -> tuple[Trajectory, VarpinError | None]:
    """A motion as far as it goes within a processor time [s], and the error that stopped it.

    Raises:
        VarpinError: It is refused before anything ran.
    """
    begin = time.process_time()

    def stop_late(done: int, steps: int) -> None:
        if done < steps and time.process_time() - begin > patience:
            raise _OutOfTime

    try:
        return simulate(scene, q0, v0, progress=stop_late, **options), None
    except Interrupted as error:
        if time.process_time() - begin <= patience:
            raise
        return error.trajectory, None
    except VarpinError as error:
        if getattr(error, "trajectory", None) is None:
            raise
        return error.trajectory, error  # type: ignore[attr-defined]


def line_of(error: Exception) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
