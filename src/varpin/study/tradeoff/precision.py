"""Work and precision: the error of each integrator at each step, and the time it takes."""

from __future__ import annotations

import math
import os
from collections.abc import Generator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from varpin.arrays import Floats
from varpin.ensemble.paths import without_geometry
from varpin.errors import FileError, InputError, VarpinError
from varpin.integrators import Gauss, Integrator, Reference
from varpin.mechanics.scene import Scene, refuse_constraints, require_scene
from varpin.simulation.ladder import ROUNDING, SENSIBLE, first_steps
from varpin.study.tradeoff.records import pareto_front
from varpin.study.tradeoff.runs import Progress, Run, Tradeoff, complete
from varpin.study.tradeoff.setting import PARTS, Outcome, Setting, integrators_of
from varpin.support.checks import JointValues, count, positive, writable
from varpin.support.executors import in_order, require_executor

Quantity = Literal["q", "end", "energy", "tip"]

# The largest of the steps where none are named [s], and the number of its halvings: down to 0.16 ms, from which on
# methods of fourth order are at the rounding of an arm's motion.
_COARSEST, _HALVINGS = 0.04, 8
# Times at which motions are compared, at most; more if the controls change more often. A largest error is found to a
# few per cent on motions of some ten oscillations.
_SAMPLES = 64
# Ratio of the reference's two tolerances: an error proportional to the tolerance differs by nine tenths of itself.
_LOOSER = 10.0
# What errors under constraints are measured against, in steps that are halved until two runs agree to rounding, or
# until a half leaves more than this part of a small difference; and in how many steps at most.
_CONSTRAINED, _STALLED, _SMALL, _MOST = Gauss(4), 0.5, 1e-6, 2**18

HEADINGS = {
    "integrator": "integrator",
    "order": "order",
    "dt": "dt [s]",
    "steps": "steps",
    "seconds": "wall time [s]",
    "spread": "spread of wall time [s]",
    "error": "largest error in q [rad or m]",
    "end_error": "error in q at the end [rad or m]",
    "energy_error": "energy error [J]",
    "tip_error": "end-effector error [m]",
    "newton_iterations": "Newton iterations",
    "jets": "jets",
    "sweeps": "sweeps",
    "split_steps": "split steps",
    "samples": "times compared",
    "failure": "failure",
}


@dataclass(frozen=True)
class WorkPrecisionRun(Run):
    """An integrator at one step, with the attributes of :class:`varpin.study.tradeoff.runs.Run`.

    Attributes:
        error: Largest error in q over the joints and the record's times [rad or m].
        end_error: Largest error in q over the joints at the end [rad or m].
        energy_error: Largest distance from the initial energy over all nodes [J]; NaN unless energy is to stay.
        tip_error: Largest error of the end effector's position over the record's times [m].
        newton_iterations: In all.
        jets: Evaluations of the whole jet.
        sweeps: Evaluations of its first derivatives alone, or of forward dynamics.
        split_steps: Steps that a guard took in parts.
        samples: Number of evenly spaced times at which its motion was compared with the reference's.
    """

    error: float
    end_error: float
    energy_error: float
    tip_error: float
    newton_iterations: int
    jets: int
    sweeps: int
    split_steps: int
    samples: int


@dataclass(frozen=True, eq=False, repr=False)
class WorkPrecision(Tradeoff):
    """Measured runs of one motion, :class:`WorkPrecisionRun`, with the attributes of a :class:`Tradeoff`.

    Attributes:
        reference: What errors are measured against, as text.
        reference_error: Largest distance in q from the same at a ten times looser tolerance, in twice as long
            intervals; under constraints, in steps of twice the length [rad or m]. It is above the reference's own
            error; errors below it say that, and no more. NaN where the measurement was interrupted before it was
            known; then there are no runs.
        tip_reference_error: The same of the end effector [m].
        samples: K: errors are taken at K evenly spaced times, the end being the last. A run that was added to a saved
            record with a step that does not share these times has fewer of them.
    """

    _format = "varpin.work-precision/2"
    _headings = HEADINGS
    _columns = ("integrator", "dt", "seconds", "error", "energy_error", "tip_error", "failure")

    runs: tuple[WorkPrecisionRun, ...]
    reference: str
    reference_error: float
    tip_reference_error: float
    samples: int

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, reference to {self.reference_error:.1e})"

    def error_of(self, run: WorkPrecisionRun, quantity: Quantity = "q") -> float:
        """The error of a run, not below what the reference can tell; energy errors need no reference."""
        values = {
            "q": (run.error, self.reference_error),
            "end": (run.end_error, self.reference_error),
            "tip": (run.tip_error, self.tip_reference_error),
            "energy": (run.energy_error, 0.0),
        }
        if quantity not in values:
            raise InputError(f"quantity must be one of {', '.join(values)}, got {quantity!r}")
        error, floor = values[quantity]
        return max(error, floor) if math.isfinite(error) else math.nan

    def at_floor(self, run: WorkPrecisionRun) -> bool:
        """Whether the error of a run in q is too small for the reference to tell."""
        return run.error <= self.reference_error

    def pareto(self, quantity: Quantity = "q") -> tuple[WorkPrecisionRun, ...]:
        """The runs than which no other is both faster and more accurate, from the fastest up."""
        return pareto_front(self.runs, lambda run: run.seconds, lambda run: self.error_of(run, quantity))


def work_precision(
    scene: Scene,
    q0: JointValues,
    v0: JointValues,
    *,
    duration: float,
    controls: JointValues | None = None,
    integrators: Sequence[Integrator] | None = None,
    dts: Sequence[float] | None = None,
    reference: Reference | None = None,
    repeats: int = 3,
    progress: Progress | None = None,
    save: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
) -> WorkPrecision:
    """Measure errors and wall times of integrators over steps, on one motion.

    A run has one thread to itself. A run that fails is in the record with its
    reason, and the others go on; Ctrl-C ends the measurement, and what is done is returned.

    Main args:
        scene: Without noise.
        q0: Initial configuration, (n,) or by joint name [rad or m].
        v0: Initial velocity, (n,) or by joint name [rad/s or m/s].
        duration: Of the motion [s].
        controls: None for none, one row (m,), by joint name too, or rows (R, m) that are held over duration / R each.
        integrators: varpin's own fixed-step ones if left out.
        dts: Time steps [s], each rounded so that the controls' intervals hold whole numbers of steps.

    Other Args:
        reference: The reference of the errors; its own error is estimated with another tolerance. Scenes with
            constraints have ``Gauss(4)``, in steps that are halved until nothing changes.
        repeats: Number of repetitions of each run; the fastest counts. Short runs have one more, which is not timed.
        progress: Called with (runs done, runs in all).
        save: Save the record in this npz file after each run. Runs that the file already has are not repeated, also
            if steps and integrators differ from those of before.
        executor: Any ``concurrent.futures.Executor`` that takes the runs, one at a time each; they follow each other
            here if left out. Errors are the same; wall times are those of its workers, and to be trusted where each
            has a core, and all have the same kind.

    Raises:
        InputError: Wrong arguments.
        FileError: ``save`` cannot be written, or holds runs of another motion or reference.
        VarpinError: The reference cannot integrate the motion.
    """
    setting = Setting.of(without_geometry(require_scene(scene)), q0, v0, controls, duration)
    members, repeats = integrators_of(scene, integrators), count("repeats", repeats, least=1)
    executor = None if executor is None else require_executor(executor)
    if reference is not None:
        if not isinstance(reference, Reference):
            raise InputError(f"reference must be a varpin.Reference, got {reference!r}")
        refuse_constraints(scene, str(reference), "leave reference= out, for varpin.Gauss(4) in ever smaller steps")
    elif not scene.constraints:
        reference = Reference(rtol=1e-13)
    grids = _grids(setting, dts)
    plan = {(repr(member), steps): (member, steps) for member in members for steps in grids}
    path = None if save is None else writable(save)
    known = _known(path, setting, reference)
    base = _record(setting, reference, _samples(grids, len(setting.controls))) if known is None else known

    def begin(record: WorkPrecision, missing: list[tuple[Integrator, int]]) -> tuple[WorkPrecision, Generator[Run]]:
        exact = _Exact(setting, reference, record.samples)
        if known is None:
            record = replace(record, reference_error=exact.error, tip_reference_error=exact.tip_error)
        measure = partial(_measure, setting, exact, repeats)
        return record, (measure(job) for job in missing) if executor is None else in_order(executor, measure, missing)

    return complete(base, plan, begin, path=path, progress=progress)


class _Exact:
    """The reference's motion, and how far it is from the same at a looser tolerance, or in steps of twice the length.

    No reference is that of scenes with constraints.
    """

    def __init__(self, setting: Setting, reference: Reference | None, samples: int) -> None:
        tight, loose = _halved(setting, samples) if reference is None else self._by(setting, reference, samples)
        self.q = tight.q
        self.tip = setting.scene.robot.frame_positions(tight.q)
        self.error = float(np.abs(tight.q - loose.q).max())
        self.tip_error = _largest(setting.scene.robot.frame_positions(loose.q) - self.tip)

    @staticmethod
    def _by(setting: Setting, reference: Reference, samples: int) -> tuple[Outcome, Outcome]:
        atol = None if reference.atol is None else _LOOSER * reference.atol
        looser = Reference(rtol=_LOOSER * reference.rtol, atol=atol)
        # Over short intervals both tolerances may take the same steps and agree, exact or not: halved they do not.
        tight = setting.run(reference, 2 * samples, samples=samples)
        loose = setting.run(looser, samples, samples=samples)
        for outcome in (tight, loose):
            if outcome.failure:
                raise VarpinError(f"the reference cannot integrate this motion: {outcome.failure}")
        return tight, loose


def _halved(setting: Setting, samples: int) -> tuple[Outcome, Outcome]:
    """A motion under constraints in so small steps that halves of them change no more than rounding, and in those."""
    steps = samples * math.ceil(first_steps(setting.scene, setting.q0, setting.v0, setting.duration, 1) / samples)
    before = math.inf
    loose = setting.run(_CONSTRAINED, steps, samples=samples)
    while True:
        steps *= 2
        tight = setting.run(_CONSTRAINED, steps, samples=samples)
        # Steps that a guard takes in parts show no error.
        whole = [not outcome.failure and not outcome.split_steps for outcome in (tight, loose)]
        failure = tight.failure or ("" if whole[0] else f"with {steps} steps, {tight.split_steps} are taken in parts")
        if all(whole):
            off = float(np.abs(tight.q - loose.q).max())
            stalled = off > _STALLED * before and before < _SMALL
            if off <= ROUNDING * max(1.0, float(np.abs(tight.q).max())) or stalled:
                return tight, loose
            before = off
        if 2 * steps > _MOST:
            if before < SENSIBLE and all(whole):
                return tight, loose
            raise VarpinError(f"no steps are small enough for a reference of this motion: {failure or 'runs differ'}")
        loose = tight


def _reference_text(reference: Reference | None) -> str:
    return f"{_CONSTRAINED} in ever smaller steps" if reference is None else str(reference)


def _record(setting: Setting, reference: Reference | None, samples: int) -> WorkPrecision:
    """A record without runs, whose reference has not been integrated."""
    return WorkPrecision(
        runs=(),
        robot=setting.scene.robot.name,
        duration=setting.duration,
        reference=_reference_text(reference),
        reference_error=math.nan,
        tip_reference_error=math.nan,
        samples=samples,
        fingerprint=setting.fingerprint,
    )


def _known(path: Path | None, setting: Setting, reference: Reference | None) -> WorkPrecision | None:
    """The record of an earlier run at ``path``, if there is one and it fits."""
    if path is None or not path.exists():
        return None
    record = WorkPrecision.load(path)
    here, there = setting.fingerprint.split(), record.fingerprint.split()
    if len(there) != len(PARTS):
        raise FileError(f"{path} is damaged: it does not say what motion it is of")
    other = [part for part, wanted, found in zip(PARTS, here, there, strict=True) if wanted != found]
    other += ["reference"] if record.reference != _reference_text(reference) else []
    if other:
        raise FileError(f"{path} holds runs of another motion (not the same: {', '.join(other)}): choose another file")
    return record


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


def _measure(setting: Setting, exact: _Exact, repeats: int, job: tuple[Integrator, int]) -> WorkPrecisionRun:
    member, steps = job
    samples = _samples([steps, len(exact.q) - 1], len(setting.controls))
    shared = slice(None, None, (len(exact.q) - 1) // samples)
    # An error of one run, whatever it is, does not stop the others.
    try:
        outcome = setting.run(member, steps, samples=samples, repeats=repeats)
    except Exception as reason:
        lost = np.full_like(exact.q[shared], np.nan)
        outcome = Outcome(lost, lost, np.nan, np.nan, 0, 0, 0, 0, f"{type(reason).__name__}: {reason}")
    error = end = tip = energy = math.nan
    if not outcome.failure:
        off = np.abs(outcome.q - exact.q[shared])
        error, end = float(off.max()), float(off[-1].max())
        tip = _largest(setting.scene.robot.frame_positions(outcome.q) - exact.tip[shared])
        energy = outcome.energy_error if setting.conservative else math.nan
    counted = "spread", "failure", "newton_iterations", "jets", "sweeps", "split_steps"
    return WorkPrecisionRun(
        integrator=str(member),
        options=repr(member),
        order=member.order,
        dt=setting.duration / steps,
        steps=steps,
        seconds=outcome.seconds if not outcome.failure else math.nan,
        error=error,
        end_error=end,
        energy_error=energy,
        tip_error=tip,
        samples=samples,
        **{name: getattr(outcome, name) for name in counted},
    )


def _largest(vectors: Floats) -> float:
    """The length of the longest row."""
    return float(np.linalg.norm(vectors, axis=1).max())
