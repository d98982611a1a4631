"""Work and precision: the error of each integrator at each step, and the time it takes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from varpin.arrays import Floats
from varpin.errors import InputError, VarpinError
from varpin.integrators import Gauss, Integrator, Reference
from varpin.mechanics.scene import Scene, require_scene
from varpin.signals.commands import held_in_parts
from varpin.simulation.tolerance import ROUNDING, steps_for_tolerance
from varpin.study.motion import Setting, integrators_of
from varpin.study.record import Progress, Study, collect
from varpin.support.checks import JointValues, count, positive

# The largest of the steps where none are named [s], and the number of its halvings: down to 0.16 ms, from which on
# methods of fourth order are at the rounding of an arm's motion.
_COARSEST, _HALVINGS = 0.04, 8
# Times at which motions are compared, at most; more if the controls change more often. A largest error is found to a
# few per cent on motions of some ten oscillations.
_SAMPLES = 64
# The reference, and the one that tells its error.
_EXACT, _LOOSER = Reference(rtol=1e-13), Reference(rtol=1e-12)
# The reference under constraints, which ``Reference`` does not keep.
_CONSTRAINED = Gauss(4)


@dataclass(frozen=True)
class WorkPrecisionRun:
    """An integrator at one step. Its measures are NaN where it failed.

    Attributes:
        integrator: As text.
        order: Of its error in dt.
        dt: Time step [s].
        steps: N.
        seconds: Wall time, the best of the repetitions [s].
        error: Largest error in q over the joints and the record's times [rad or m].
        energy_error: Largest distance from the initial energy over all nodes [J]; NaN unless energy is to stay.
        newton_iterations: In all.
        jets: Evaluations of the whole jet.
        sweeps: Evaluations of its first derivatives alone, or of forward dynamics.
        split_steps: Steps that a guard took in parts.
        failure: Reason of a failure; empty if there is none.
    """

    integrator: str
    order: int
    dt: float
    steps: int
    seconds: float = math.nan
    error: float = math.nan
    energy_error: float = math.nan
    newton_iterations: int = 0
    jets: int = 0
    sweeps: int = 0
    split_steps: int = 0
    failure: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class WorkPrecision(Study[WorkPrecisionRun]):
    """Measured runs of one motion, in the order of the integrators, each from its largest step down.

    Attributes:
        runs: The runs.
        duration: Of the motion [s].
        reference: What errors are measured against, as text.
        reference_error: Largest distance in q of the reference from the same at a ten times looser tolerance, or under
            constraints from its repetition by a better method [rad or m]. It is above the reference's own error; errors
            below it say that, and no more.
        samples: K: errors are taken at K evenly spaced times, the end being the last.
    """

    shown: ClassVar = ("integrator", "dt", "seconds", "error", "energy_error")
    quantities: ClassVar = {"q": "error", "energy": "energy_error"}

    duration: float
    reference: str
    reference_error: float
    samples: int

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the table has to know."""
        return (
            f"{self.duration:g} s of motion; wall times on one thread",
            f"errors in q: the largest over joints and {self.samples} instant{'s' * (self.samples > 1)}, against "
            f"{self.reference}, which is accurate to {self.reference_error:.1e}; smaller ones show as <",
            "Pareto: no other run has both a smaller time and a smaller error",
        )

    def note(self, run: WorkPrecisionRun) -> str:
        """Whether a run is on the front, failed, or has divided steps."""
        split = f"{run.split_steps} split" if run.split_steps else ""
        return "; ".join(filter(None, (super().note(run), split)))

    def row(self, run: WorkPrecisionRun) -> tuple[str, ...]:
        """A run as entries of the columns that screens show."""
        texts = dict(zip((*self.shown, "note"), super().row(run), strict=True))
        if self.at_floor(run) and self.reference_error > 0.0:
            texts["error"] = f"<{self.reference_error:.3g}"
        return tuple(texts.values())

    def value_of(self, run: WorkPrecisionRun, quantity: str = "q") -> float:
        """An error of a run, that of q not below what the reference can tell; energy errors need no reference."""
        found = super().value_of(run, quantity)
        return max(found, self.reference_error) if quantity == "q" and math.isfinite(found) else found

    def at_floor(self, run: WorkPrecisionRun) -> bool:
        """Whether the error of a run in q is too small for the reference to tell."""
        return run.error <= self.reference_error


def work_precision(
    scene: Scene,
    q0: JointValues,
    v0: JointValues,
    *,
    duration: float,
    controls: JointValues | None = None,
    integrators: Sequence[Integrator] | None = None,
    dts: Sequence[float] | None = None,
    repeats: int = 3,
    progress: Progress | None = None,
) -> WorkPrecision:
    """Measure errors and wall times of integrators over steps, on one motion.

    Errors are against ``Reference(rtol=1e-13)``, or under constraints ``Gauss(4)`` in ever smaller steps. A run has one
    thread to itself. A run that fails is in the record with its reason, and the others go on.

    Main args:
        scene: Without noise.
        q0: Initial configuration, (n,) or by joint name [rad or m].
        v0: Initial velocity, (n,) or by joint name [rad/s or m/s].
        duration: Of the motion [s].
        controls: None for none, one row (m,), by joint name too, or rows (R, m) that are held over duration / R each.
        integrators: varpin's own fixed-step ones if left out.
        dts: Time steps [s], each rounded so that the controls' intervals hold whole numbers of steps.

    Other Args:
        repeats: Number of repetitions of each run; the fastest counts. Short runs have one more, which is not timed.
        progress: Called with (runs done, runs in all).

    Raises:
        InputError: Wrong arguments.
        VarpinError: The reference cannot integrate the motion.
        StudyInterrupted: Ctrl-C; holds the runs so far. It is a KeyboardInterrupt.
    """
    setting = Setting.of(require_scene(scene), q0, v0, controls, duration)
    members, repeats = integrators_of(scene, integrators), count("repeats", repeats, least=1)
    grids = _grids(setting, dts)
    jobs = [(member, steps) for member in members for steps in grids]
    samples = _samples(grids, len(setting.controls))
    if scene.constraints:
        text, exact, error = f"{_CONSTRAINED} in ever smaller steps", *_constrained(setting, samples)
    else:
        # Over short intervals both may take the same steps and agree, exact or not: halved they do not.
        text, exact = str(_EXACT), _by(setting, _EXACT, 2 * samples)[::2]
        error = float(np.abs(exact - _by(setting, _LOOSER, samples)).max())
    base = WorkPrecision((), scene.robot.name, setting.duration, text, error, samples)
    return collect(base, (_measure(setting, exact, repeats, *job) for job in jobs), len(jobs), progress)


def _by(setting: Setting, reference: Reference, samples: int) -> Floats:
    """The motion (K + 1, n) of a reference."""
    outcome = setting.run(reference, samples)
    if outcome.failure:
        raise VarpinError(f"the reference cannot integrate this motion: {outcome.failure}")
    return outcome.motion.q


def _constrained(setting: Setting, samples: int) -> tuple[Floats, float]:
    """A motion under constraints (K + 1, n) in steps that leave nothing but rounding, and its error."""
    scene, start, parts = setting.scene, (setting.q0, setting.v0), samples // len(setting.controls)
    rows = held_in_parts(scene, setting.controls, *start, setting.duration * parts / samples, parts)
    found = steps_for_tolerance(scene, *start, setting.duration, ROUNDING, rows, _CONSTRAINED)
    motion = setting.run(_CONSTRAINED, found.steps).motion
    return motion.q[:: found.steps // samples], float(found.error.max())


def _grids(setting: Setting, dts: Sequence[float] | None) -> list[int]:
    """Numbers of steps, multiples of R, from the fewest up."""
    rows = len(setting.controls)
    if dts is None:
        coarsest = rows * math.ceil(setting.duration / (_COARSEST * rows))
        return [coarsest * 2**k for k in range(_HALVINGS + 1)]
    grids = set()
    for dt in dts:
        ratio = setting.duration / positive("dts", dt, "s") / rows
        if ratio < 0.5:
            raise InputError(f"dts: {dt:g} s is longer than what the controls are held for")
        grids.add(rows * round(ratio))
    if not grids:
        raise InputError("dts must be one step or more")
    return sorted(grids)


def _samples(grids: Sequence[int], rows: int) -> int:
    """K, the most times up to a limit that all grids and the controls' intervals share."""
    shared = math.gcd(*grids) // rows
    most = max(1, _SAMPLES // rows)
    return rows * max(k for k in range(1, min(shared, most) + 1) if shared % k == 0)


def _measure(setting: Setting, exact: Floats, repeats: int, member: Integrator, steps: int) -> WorkPrecisionRun:
    """A run against the exact motion (K + 1, n)."""
    run = WorkPrecisionRun(str(member), member.order, setting.duration / steps, steps)
    # An error of one run, whatever it is, does not stop the others.
    try:
        outcome = setting.run(member, steps, repeats=repeats)
    except Exception as reason:
        return replace(run, failure=f"{type(reason).__name__}: {reason}")
    motion, own = outcome.motion, outcome.motion.statistics
    counts: dict[str, Any] = {name: int(getattr(own, name).sum()) for name in ("newton_iterations", "jets", "sweeps")}
    run = replace(run, **counts, split_steps=own.split_steps, failure=outcome.failure)
    if run.failure:
        return run
    error = float(np.abs(motion.q[:: steps // (len(exact) - 1)] - exact).max())
    change = float(np.abs(motion.energy - motion.energy[0]).max()) if setting.conservative else math.nan
    return replace(run, seconds=outcome.seconds, error=error, energy_error=change)
