"""Advice: the cheapest integrator and step that meet an accuracy, or the most accurate within a time.

Costs are wall times. Errors and steps are found as for a tolerance, see :mod:`varpin.simulation.tolerance`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from varpin.errors import InputError
from varpin.integrators import Integrator, Reference
from varpin.mechanics.scene import Scene
from varpin.simulation.check import Case
from varpin.simulation.tolerance import Ladder, Trial, first_steps, trial_of
from varpin.study.motion import Setting, integrators_of
from varpin.study.record import Study
from varpin.support.checks import JointValues, positive

# Total time of the repetitions of a short run [s], and their largest number.
_TIMING, _REPEATS = 0.02, 5
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
        return f"{self.integrator} at dt = {self.dt:.4g} s: {error} in {self.seconds:.3g} s"


@dataclass(frozen=True, eq=False, repr=False)
class Advice(Study[Choice]):
    """Which integrator to take, at which step, and why.

    Attributes:
        runs: The best choice of each method, the advised one first, then cheapest (or most accurate) first.
        reached: Whether the first meets the wish, as far as can be predicted.
        tolerance: What was asked for [rad or m], or None.
        budget: What was asked for [s], or None.
        calibration: What finding out took [s].
        reason: In words.
    """

    headings: ClassVar = {"seconds": "predicted time [s]"}
    shown: ClassVar = ("integrator", "dt", "steps", "seconds", "error")

    reached: bool
    tolerance: float | None
    budget: float | None
    calibration: float
    reason: str = field(repr=False)

    @property
    def summary(self) -> str:
        """The choice."""
        return f"{self.best}{'' if self.reached else ', which is not what was asked for'}"

    @property
    def notes(self) -> tuple[str, ...]:
        """The reason, line by line."""
        return tuple(self.reason.splitlines())

    def note(self, run: Choice) -> str:
        """Whether a choice was measured."""
        return "" if run.measured else "extrapolated"

    def pareto(self, quantity: str = "") -> tuple[Choice, ...]:  # noqa: ARG002
        """The choice, if it meets the wish."""
        return (self.best,) if self.reached else ()

    @property
    def best(self) -> Choice:
        """The choice."""
        return self.runs[0]

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
    ladder = Ladder(
        lambda member, steps: _timed(setting, member, steps),
        members,
        first,
        rows,
        lambda: time.perf_counter() > begin + patience,
    )
    if tolerance is not None:
        choices, reached = ladder.for_tolerance(positive("tolerance", tolerance, "rad or m"))
    else:
        choices, reached = ladder.for_budget(_PLANNED * positive("budget", budget, "s"))
    runs = tuple(
        Choice(each.integrator, setting.duration / each.steps, each.steps, each.error, each.cost, each.measured)
        for each in choices
    )
    reason = _reason(runs, reached, tolerance, budget, duration)
    calibration = time.perf_counter() - begin
    return Advice(runs, scene.robot.name, reached, tolerance, budget, calibration, reason)


def _timed(setting: Setting, integrator: Integrator, steps: int) -> Trial:
    """A trial: its wall time, the best of several short ones, and its error, from its repetition."""
    outcome = setting.run(integrator, steps, repeats=_REPEATS, within=_TIMING)
    if outcome.failure:
        return Trial(integrator, steps, math.inf, outcome.seconds)
    return trial_of(Case(setting.scene, integrator, outcome.motion), outcome.seconds)[0]


def _reason(
    choices: Sequence[Choice],
    reached: bool,
    tolerance: float | None,
    budget: float | None,
    duration: float,
) -> str:
    best = choices[0]
    wish = f"an error of {tolerance:g} in q" if tolerance is not None else f"{budget:g} s"
    if not reached:
        lines = [f"{wish} is not within reach of what was tried; the best is {best}"]
    else:
        what = "of the least time" if tolerance is not None else "the most accurate"
        lines = [f"{best}, {what} within {wish} after {duration:g} s"]
    if not best.measured:
        lines.append(f"the error is extrapolated from larger steps by the method's order, {best.integrator.order}")
    if not best.integrator.variational:
        lines.append(
            "it is no variational integrator: over much longer horizons its energy drifts, and this advice is for "
            f"{duration:g} s"
        )
    return "\n".join(lines)
