"""Advice: the cheapest integrator and step that meet an accuracy, or the most accurate within a time.

Costs are wall times. Errors and steps are found as for a tolerance, see :mod:`varpin.simulation.ladder`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from varpin.errors import InputError
from varpin.integrators import Guard, Integrator, Reference, largest_step
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.signals.commands import open_loop
from varpin.simulation.check import distance, repeated
from varpin.simulation.ladder import Ladder, Rung, Trial, first_steps
from varpin.simulation.record import rollout
from varpin.study.tradeoff.setting import Setting, integrators_of
from varpin.support.checks import JointValues, positive
from varpin.support.markup import facts, table
from varpin.trajectory import Trajectory

# Headings of a choice's entries in a table.
COLUMNS = ("integrator", "dt [s]", "steps", "predicted time [s]", "predicted error in q", "note")

# Total time of the repetitions of a short run [s], and their largest number: the first ones find caches cold.
_TIMING, _REPEATS = 0.02, 5
# Nodes at which the midpoint integrator's largest step is computed: a bound by samples, for information.
_NODES = 32
# Part of a budget that is planned for; the rest is for the scatter of wall times.
_PLANNED = 0.9


@dataclass(frozen=True)
class Choice:
    """An integrator at the step that serves a wish best.

    Attributes:
        integrator: The method.
        dt: Its step [s].
        steps: Over the horizon.
        error: The largest error in q over nodes and joints [rad or m]; infinite where not known.
        seconds: Predicted wall time [s].
        measured: Whether runs at steps as small or smaller stand behind it; else the method's order does.
    """

    integrator: Integrator
    dt: float
    steps: int
    error: float
    seconds: float
    measured: bool

    def __str__(self) -> str:
        error = f"error {self.error:.1e}" if math.isfinite(self.error) else "unknown error"
        return f"{self.integrator} at dt = {self.dt:.4g} s: {error} in {_time(self.seconds)}"

    def cells(self) -> tuple[str, ...]:
        """The entries of :data:`COLUMNS`."""
        error = f"{self.error:.2e}" if math.isfinite(self.error) else "unknown"
        note = "" if self.measured else "by the method's order"
        return str(self.integrator), f"{self.dt:.4g}", str(self.steps), f"{self.seconds:.2e}", error, note


@dataclass(frozen=True, eq=False)
class Advice:
    """Which integrator to take, at which step, and why.

    Attributes:
        best: The choice; its fields are this object's, too.
        reached: Whether it meets the wish, as far as can be predicted.
        alternatives: The best of every other method that has one, cheapest (or most accurate) first.
        largest_step: The step [s] from which on the midpoint integrator's branch guard splits steps somewhere along
            this motion; infinite if none is too large, NaN under constraints, whose guard looks at more.
        tolerance: What was asked for [rad or m], or None.
        budget: What was asked for [s], or None.
        calibration: What finding out took [s].
        reason: In words.
    """

    best: Choice
    reached: bool
    alternatives: tuple[Choice, ...]
    largest_step: float
    tolerance: float | None
    budget: float | None
    calibration: float
    reason: str = field(repr=False)

    def __repr__(self) -> str:
        return f"Advice({self.best}{'' if self.reached else ', which is not what was asked for'})"

    def _repr_html_(self) -> str:
        rows = [choice.cells() for choice in (self.best, *self.alternatives)]
        return facts("Advice", [("", line) for line in self.reason.splitlines()], table(COLUMNS, rows, [0]))

    @property
    def integrator(self) -> Integrator:
        """The method to take."""
        return self.best.integrator

    @property
    def dt(self) -> float:
        """The step to take [s]."""
        return self.best.dt

    @property
    def steps(self) -> int:
        """How many of them."""
        return self.best.steps

    @property
    def error(self) -> float:
        """The largest error in q to expect [rad or m]."""
        return self.best.error

    @property
    def seconds(self) -> float:
        """The wall time to expect [s]."""
        return self.best.seconds

    def __str__(self) -> str:
        return self.reason


def advise(
    scene: Scene,
    q0: JointValues,
    v0: JointValues,
    *,
    duration: float,
    controls: JointValues | None = None,
    tolerance: float | None = None,
    budget: float | None = None,
    integrators: Sequence[Integrator] | None = None,
    patience: float = 60.0,
) -> Advice:
    """The cheapest integrator and step that meet an accuracy on a motion, or the most accurate in a time.

    What counts is the largest error in q over all nodes and joints, on this scene from this state under these
    controls. The search takes several times as long as the motion itself. The end of a chaotic motion over many
    oscillations is beyond every method; the advice then reports that the tolerance is not reached.

    Main args:
        scene: Without noise.
        q0: Initial configuration, (n,) or by joint name [rad or m].
        v0: Initial velocity, (n,) or by joint name [rad/s or m/s].
        duration: The horizon [s].
        tolerance: Accuracy to meet [rad or m].
        budget: Wall time to keep to [s], instead.

    Other Args:
        controls: None for none, one row (m,), by joint name too, or rows (R, m) that are held over duration / R each.
        integrators: To choose from; varpin's own fixed-step ones if left out.
        patience: Time after which no further run is begun [s].

    Raises:
        InputError: Wrong arguments, or both or none of ``tolerance`` and ``budget``.
        VarpinError: No integrator got to the end.
    """
    setting = Setting.of(scene, q0, v0, controls, duration)
    members = integrators_of(scene, integrators)
    if any(isinstance(member, Reference) for member in members):
        raise InputError("Reference chooses its own steps: its accuracy is its tolerance")
    if (tolerance is None) == (budget is None):
        raise InputError("give either a tolerance [rad or m] or a budget [s]")
    patience = positive("patience", patience, "s")
    rows = len(setting.controls)
    first = first_steps(scene, setting.q0, setting.v0, setting.duration, rows)
    begin = time.perf_counter()
    late = partial(_later, begin + patience)
    ladder = Ladder(partial(_timed, setting), members, first, rows, late)
    if tolerance is not None:
        choices, reached = ladder.for_tolerance(positive("tolerance", tolerance, "rad or m"))
    else:
        choices, reached = ladder.for_budget(_PLANNED * positive("budget", budget, "s"))
    bound = _largest_step(setting, ladder.rungs)
    best, *others = (
        Choice(each.integrator, setting.duration / each.steps, each.steps, each.error, each.cost, each.measured)
        for each in choices
    )
    reason = _reason(best, others, reached, bound, tolerance, budget, duration)
    return Advice(best, reached, tuple(others), bound, tolerance, budget, time.perf_counter() - begin, reason)


def _later(end: float) -> bool:
    """Whether a time has passed."""
    return time.perf_counter() > end


def _timed(setting: Setting, integrator: Integrator, steps: int) -> Trial:
    """A trial and its wall time, the best of several short ones."""
    outcome = setting.run(integrator, steps)
    begin, seconds = time.perf_counter(), [outcome.seconds]
    while len(seconds) < _REPEATS and time.perf_counter() - begin < _TIMING:
        seconds.append(setting.run(integrator, steps).seconds)
    if outcome.failure:
        return Trial(steps, math.inf, min(seconds))
    motion = _motion(setting, integrator, steps)
    if motion.steps < steps:
        return Trial(steps, math.inf, min(seconds))
    off = float(distance(repeated(setting.scene, integrator, motion), motion)[0].max())
    whole = motion.statistics.split_steps == 0
    return Trial(steps, off if math.isfinite(off) else math.inf, min(seconds), whole=whole)


def _motion(setting: Setting, integrator: Integrator, steps: int) -> Trajectory:
    """The motion in so many steps, up to one that fails."""
    dt, commands = setting.duration / steps, open_loop(setting.rows(steps))
    return rollout(setting.scene, integrator, setting.q0, setting.v0, commands, dt)[0]


def _largest_step(setting: Setting, rungs: Sequence[Rung]) -> float:
    """The smallest of the midpoint guard's largest steps along the best motion there is [s]."""
    able = [rung for rung in rungs if any(math.isfinite(trial.error) for trial in rung.trials)]
    if not able or setting.scene.constraints:
        return math.nan
    method = max(able, key=lambda rung: (rung.integrator.order, rung.trials[-1].steps))
    motion = _motion(setting, method.integrator, method.trials[-1].steps)
    jets = (
        lagrangian_jet(setting.scene, motion.q[node], motion.v[node])
        for node in np.linspace(0, motion.steps, _NODES).astype(np.int64)
    )
    return min(largest_step(jet.Lvv, jet.Lqq, Guard().branch_margin) for jet in jets)


def _reason(
    best: Choice,
    others: Sequence[Choice],
    reached: bool,
    bound: float,
    tolerance: float | None,
    budget: float | None,
    duration: float,
) -> str:
    wish = f"an error of {tolerance:g} in q" if tolerance is not None else f"{_time(budget or 0.0)}"
    if not reached:
        lines = [f"{wish} is not within reach of what was tried; the best is {best}"]
    elif tolerance is not None:
        # Times are measured, and near ties go to the choice whose error is the safer one.
        tied = any(other.seconds < best.seconds for other in others[:1])
        lines = [f"{best}, {'one of the cheapest' if tied else 'the cheapest'} within {wish} after {duration:g} s"]
    else:
        lines = [f"{best}, the most accurate after {duration:g} s within {wish}"]
    if others and tolerance is not None and reached:
        longer = f"{others[0].seconds / best.seconds:.2g}"
        lines.append(f"next: {others[0]}, {'as long' if longer == '1' else f'{longer} times as long'}")
    elif others:
        lines.append(f"next: {others[0]}")
    if not best.measured:
        lines.append(f"the error is extrapolated from larger steps by the method's order, {best.integrator.order}")
    if not best.integrator.variational:
        lines.append(
            "it is no variational integrator: over much longer horizons its energy drifts, and this advice is for "
            f"{duration:g} s"
        )
    if math.isfinite(bound):
        lines.append(f"the midpoint integrator's guard splits steps longer than {bound:.3g} s on this motion")
    return "\n".join(lines)


def _time(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds:.2g} s"
