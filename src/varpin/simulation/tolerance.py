"""The order ladder: methods at steps that are halved until an error is met, each by the order it shows.

Every trial of a method is a motion and its repetition by two stages more, so its error is known without a reference.
The order of a method predicts the steps that a tolerance needs; the trial at these steps confirms them or shows a lower
order, as where forces have kinks. :func:`varpin.simulate` with a tolerance counts evaluations, so that its choice is
the same on every machine; :func:`varpin.advise` measures times.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.errors import InputError, StepError, VarpinError
from varpin.finding import Finding
from varpin.integrators import (
    ExplicitEuler,
    Gauss,
    Integrator,
    Midpoint,
    Radau,
    Reference,
    RungeKutta4,
    SemiImplicitEuler,
)
from varpin.mechanics.constraints import CustomConstraintError
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.signals.commands import held_in_parts
from varpin.signals.controls import Controls, commands_of, control_rows
from varpin.signals.functions import ControlLaw, Sampled
from varpin.signals.policy import FirstOrderHold, LinearPolicy, OpenLoop
from varpin.simulation.check import Case
from varpin.simulation.failures import ToleranceError
from varpin.simulation.record import Motions
from varpin.support.checks import positive
from varpin.trajectory import Accuracy

# Number of evaluations, times the number of joints, after which no further trial begins.
_MOST_WORK = 50_000_000

# The default candidates of every choice and every comparison.
INTEGRATORS: tuple[Integrator, ...] = (
    ExplicitEuler(),
    SemiImplicitEuler(),
    RungeKutta4(),
    Midpoint(),
    *(Gauss(stages=stages) for stages in (2, 3, 4, 5)),
    *(Radau(stages=stages) for stages in (3, 4)),
)
# Factor between a wish and the error that steps are predicted for: from 1.2 to 2 the chosen steps cost within 10 %.
SAFETY = 1.5
# Error from which on a motion counts as wrong [rad or m].
SENSIBLE = 1.0
# Accumulated rounding, relative to q: the smallest error that is aimed at.
ROUNDING = 200.0 * float(np.finfo(np.float64).eps)
# Largest factor between the steps of a trial and the next, and up to which an error is extrapolated. Of 34 random
# motions 9 % cost more than twice the cheapest choice with 16, and 3 % with 4, whose search takes 1.4 times as long.
REACH = 4.0
# A trial with fewer than this share of the error of the one before makes progress; two without any end a method.
_PROGRESS, _IDLE = 0.7, 2
# Halvings of the first step in which a method may divide steps or fail, or a user's function fail: of 30 scenes none
# needed more than four.
_PROBES = 7
# Error below which a method that makes no progress is limited by rounding [rad or m].
_ROUNDED = 1e-8


def candidates(scene: Scene) -> tuple[Integrator, ...]:
    """The members of :data:`INTEGRATORS` that can integrate a scene."""
    return tuple(member for member in INTEGRATORS if member.keeps_constraints or not scene.constraints)


@dataclass(frozen=True)
class Trial:
    """A motion of a method.

    Attributes:
        integrator: The method.
        steps: Over the horizon.
        error: The largest error of q [rad or m]; infinite if it failed or is not known.
        cost: Of the motion alone.
        whole: Whether guards divided none of its steps: divided ones show neither order nor cost of others.
        measured: Whether it was made; else error and cost are predicted.
    """

    integrator: Integrator
    steps: int
    error: float
    cost: float
    whole: bool = True
    measured: bool = True


def trial_of(case: Case, cost: float) -> tuple[Trial, Floats]:
    """A motion as a trial, and its error (N + 1, n), from its repetition."""
    motion = case.trajectory
    off, _ = case.errors(case.repetition())
    largest = max(float(off.max()), ROUNDING * max(1.0, float(np.abs(motion.q).max())))
    whole = motion.statistics.split_steps == 0
    return Trial(case.integrator, motion.steps, largest if math.isfinite(largest) else math.inf, cost, whole), off


class Rung:
    """A method with its trials so far, in increasing numbers of steps."""

    def __init__(self, integrator: Integrator, first: int, rows: int) -> None:
        """A method without trials; all its numbers of steps are multiples of ``rows``, the first is ``first``."""
        self.integrator, self.first, self.rows = integrator, first, rows
        self.trials: list[Trial] = []
        self.idle = 0

    def add(self, trial: Trial) -> None:
        """Take a trial."""
        before = self.trials[-1].error if self.trials else math.inf
        self.trials.append(trial)
        slow = math.isfinite(before) and before < SENSIBLE and not trial.error < _PROGRESS * before
        self.idle = self.idle + 1 if slow else 0

    @property
    def open(self) -> bool:
        """Whether more steps may still reduce the error."""
        return self.idle < _IDLE

    @property
    def telling(self) -> bool:
        """Whether the last trial tells what more steps would do."""
        return bool(self.trials) and self.trials[-1].whole and self.trials[-1].error < SENSIBLE

    @property
    def order(self) -> float:
        """The order that the last two trials show, at most that of the method."""
        order = float(self.integrator.order)
        known = [trial for trial in self.trials if math.isfinite(trial.error) and trial.whole][-2:]
        if len(known) < 2 or not known[0].error < SENSIBLE or known[1].error <= 0.0:
            return order
        shown = math.log(known[0].error / known[1].error) / math.log(known[1].steps / known[0].steps)
        return min(max(shown, 0.5), order)

    def met(self, wish: float) -> Trial | None:
        """The trial of the fewest steps with an error within a wish."""
        return next((trial for trial in self.trials if trial.error <= wish), None)

    def steps_for(self, wish: float) -> int:
        """The number of steps of the next trial for an error within a wish."""
        if not self.trials:
            return self.first
        last = self.trials[-1]
        if not self.telling:
            return 2 * last.steps
        factor = (max(SAFETY * last.error / wish, 1.0)) ** (1.0 / self.order)
        return self.rounded(min(max(factor, 1.1), REACH) * last.steps)

    def rounded(self, steps: float) -> int:
        """The next multiple of ``rows``."""
        return self.rows * math.ceil(min(steps, 1e15) / self.rows)

    def cost_of(self, steps: int) -> float:
        """The predicted cost of so many steps."""
        return self.trials[-1].cost * steps / self.trials[-1].steps if self.trials else 0.0

    def predicted(self, steps: int) -> Trial:
        """The method at a number of steps, by its order beyond its trials."""
        for trial in self.trials:
            if trial.steps == steps:
                return trial
        near = min(self.trials, key=lambda trial: abs(math.log(trial.steps / steps)))
        known = near.error < SENSIBLE and steps <= REACH * near.steps
        error = near.error * (near.steps / steps) ** self.order if known else math.inf
        return replace(near, steps=steps, error=error, cost=self.cost_of(steps), measured=False)


class Ladder:
    """Methods, ``rungs``, that are tried until one meets a wish."""

    def __init__(
        self,
        attempt: Callable[[Integrator, int], Trial],
        integrators: Sequence[Integrator],
        first: int,
        rows: int,
        late: Callable[[], bool],
    ) -> None:
        """A ladder that ``attempt``s integrators from ``first`` steps on, multiples of ``rows``, until ``late``."""
        self.attempt, self.late = attempt, late
        self.rungs = [Rung(member, first, rows) for member in integrators]

    def _find_first(self) -> None:
        """Begin with steps that the method of the highest order takes whole: coarser ones show nothing."""
        probe = max(self.rungs, key=lambda rung: rung.integrator.order)
        for _ in range(_PROBES):
            if self.late() or probe.telling:
                break
            self.climb(probe, probe.steps_for(math.inf))
        if probe.telling:
            # Coarser ones divide steps, or fail: they are no choice.
            probe.trials = probe.trials[-1:]
            for rung in self.rungs:
                rung.first = probe.trials[-1].steps

    def climb(self, rung: Rung, steps: int) -> None:
        """Try a method with a number of steps."""
        rung.add(self.attempt(rung.integrator, steps))

    def for_tolerance(self, wish: float) -> tuple[list[Trial], bool]:
        """The methods at the steps that meet an error [rad or m], the cheapest first, and whether one does.

        If none meets it, they are at the steps of their least errors, the most accurate first.
        """
        self._find_first()
        while not self.late():
            best = min((met.cost for rung in self.rungs if (met := rung.met(wish))), default=math.inf)
            rivals = [rung for rung in self.rungs if rung.open and rung.met(wish) is None]
            rival = min(rivals, key=lambda rung: rung.cost_of(rung.steps_for(wish)), default=None)
            if rival is None or not rival.cost_of(rival.steps_for(wish)) < best:
                break
            self.climb(rival, rival.steps_for(wish))
            if not rival.open and rival.trials[-1].error < _ROUNDED:
                # More accuracy than rounding leaves is not to be had by other methods either.
                break
        known = [rung for rung in self.rungs if rung.met(wish) or (rung.open and rung.telling)]
        found = [rung.predicted(met.steps if (met := rung.met(wish)) else rung.steps_for(wish)) for rung in known]
        kept = sorted((each for each in found if each.error <= wish), key=lambda each: each.cost)
        taken = next((each for each in kept if each.measured), None)
        if taken is None:
            return self.least(), False
        return [taken, *(each for each in kept if each is not taken)], True

    def for_budget(self, budget: float) -> tuple[list[Trial], bool]:
        """The methods at the steps that a cost allows, the most accurate first, and whether there is one."""
        for rung in self.rungs:
            while not self.late() and rung.open:
                steps, last = rung.first, rung.trials[-1] if rung.trials else None
                if last is not None:
                    steps = int(last.steps * min(REACH, budget / last.cost if last.cost > 0.0 else REACH))
                steps = rung.rows * (steps // rung.rows)
                if last is not None and steps < 1.1 * last.steps:
                    break
                self.climb(rung, max(steps, rung.rows))
        trials = [trial for rung in self.rungs for trial in rung.trials]
        found = [trial for trial in trials if trial.cost <= budget and trial.error < SENSIBLE]
        best = {str(each.integrator): each for each in sorted(found, key=lambda each: -each.error)}
        if best:
            return sorted(best.values(), key=lambda each: (each.error, each.cost)), True
        return sorted(self.least(), key=lambda each: each.cost), False

    def least(self) -> list[Trial]:
        """The trial of each method with the least error, the most accurate first.

        Raises:
            VarpinError: No motion got to the end.
        """
        found = [min(rung.trials, key=lambda trial: trial.error) for rung in self.rungs if rung.trials]
        if not any(math.isfinite(each.error) for each in found):
            if self.late():
                raise VarpinError("no motion got to the end in time: give more patience, or a shorter duration")
            raise VarpinError(
                "no integrator gets to the end of this motion, however small its steps were made. Give a shorter "
                "duration, or dt and steps"
            )
        return sorted(found, key=lambda each: (each.error, -each.integrator.order))


def first_steps(scene: Scene, q0: Floats, v0: Floats, duration: float, rows: int) -> int:
    """A number of steps that is coarse for the fastest mode at the start; a multiple of ``rows``."""
    jet = lagrangian_jet(scene, q0, np.zeros_like(q0))
    rates = np.abs(np.linalg.eigvals(np.linalg.solve(jet.Lvv, jet.Lqq)))
    rate = math.sqrt(float(rates.max())) + float(np.abs(v0).max())
    return rows * max(math.ceil(0.5 * rate * duration / rows), math.ceil(2 / rows))


class Chosen(NamedTuple):
    """What :func:`steps_for_tolerance` has found; ``error`` (N + 1, n) is that of the motion [rad or m]."""

    integrator: Integrator
    steps: int
    controls: Controls
    accuracy: Accuracy
    found: tuple[Finding, ...]
    error: Floats


class _Search:
    """Trials of a motion."""

    def __init__(self, scene: Scene, q0: Floats, v0: Floats, duration: float, controls: Controls) -> None:
        self.scene, self.q0, self.v0, self.duration = scene, q0, v0, duration
        self.controls: Floats | LinearPolicy | OpenLoop | FirstOrderHold
        if isinstance(controls, OpenLoop):
            self.controls, self.rows = controls, 1
        elif isinstance(controls, LinearPolicy):
            self.controls, self.rows = controls, len(controls.gains)
        elif isinstance(controls, FirstOrderHold):
            self.controls, self.rows = controls, len(controls.u) - 1
        else:
            self.controls = control_rows(scene, controls)
            self.rows = len(self.controls)
        self.most = _MOST_WORK / len(q0)
        self.steps = self.evaluations = 0
        self.errors: dict[tuple[str, int], Floats] = {}
        self._sampled: dict[int, Sampled] = {}
        self._raised: list[VarpinError] = []
        self._passed = False

    def given(self, steps: int) -> Controls:
        """The controls of a motion in so many steps."""
        controls, parts = self.controls, steps // self.rows
        start, span = (self.q0, self.v0), self.duration / self.rows
        if isinstance(controls, OpenLoop):
            if steps not in self._sampled:
                self._sampled[steps] = Sampled(controls, self.scene, self.duration / steps)
            return self._sampled[steps]
        if isinstance(controls, FirstOrderHold):
            fine = controls.refined(parts).u.copy()
            own = self.scene.prescribed
            fine[1:, own] = held_in_parts(self.scene, controls.u[1:], *start, span, parts)[:, own]
            return FirstOrderHold(fine)
        if isinstance(controls, LinearPolicy):
            return controls
        return held_in_parts(self.scene, controls, *start, span, parts)

    def attempt(self, integrator: Integrator, steps: int) -> Trial:
        """A motion with its error and work; a VarpinError if a user's function has failed in all of many trials."""
        if steps > self.most:
            # Too long to run. Its cost is counted, which ends a search whose trials all fail in their first steps.
            self.evaluations += steps
            return Trial(integrator, steps, math.inf, math.inf)
        dt, controls = self.duration / steps, self.given(steps)
        commands = commands_of(self.scene, integrator, controls, steps, dt)
        try:
            motion, failure = Motions(self.scene, integrator, self.q0, self.v0, dt).under(commands)
            work = motion.statistics.jets.sum() + motion.statistics.sweeps.sum()
            self.steps, self.evaluations = self.steps + motion.steps, self.evaluations + int(work)
            if failure is not None:
                return Trial(integrator, steps, math.inf, float(work) * steps / max(motion.steps, 1))
            case = Case(self.scene, integrator, motion, controls)
            if case.short_forces():
                return Trial(integrator, steps, math.inf, float(work))
            trial, self.errors[str(integrator), steps] = trial_of(case, float(work))
            # Each step of a repetition takes about twice the evaluations.
            parts = case.closer[1]
            self.steps, self.evaluations = self.steps + parts * steps, self.evaluations + 2 * parts * int(work)
        except (StepError, CustomForceError, CustomConstraintError) as error:
            # Coarse steps may go where the function is not defined.
            self._raised.append(error)
            self.evaluations += steps
            if len(self._raised) >= _PROBES and not self._passed:
                raise max(self._raised, key=lambda each: getattr(each, "step", -1)) from error
            return Trial(integrator, steps, math.inf, float(steps))
        self._passed = True
        return trial


def steps_for_tolerance(
    scene: Scene,
    q0: Floats,
    v0: Floats,
    duration: float,
    tolerance: float,
    wanted: Controls | ControlLaw,
    integrator: Integrator | None,
) -> Chosen:
    """What meets a tolerance [rad or m] under the controls ``wanted``, by one ``integrator`` or any.

    Raises:
        InputError: The scene, the controls or the integrator are none that a tolerance can choose steps for.
        ToleranceError: No number of steps gives an error below 1 rad or m.
        VarpinError: A user's function fails, or no integrator gets to the end.
    """
    wish = positive("tolerance", tolerance, "rad or m")
    if scene.processes:
        raise InputError(
            "tolerance is of single motions without noise: leave the noise out of the scene, or give dt and steps"
        )
    if isinstance(integrator, Reference):
        raise InputError("Reference chooses its own steps: its tolerance is rtol; give it dt and steps")
    if callable(wanted):
        raise InputError(
            "a tolerance chooses the steps, in which a control law's period is: give dt and steps with a law, or a "
            "varpin.LinearPolicy with a period, or a varpin.OpenLoop(f)"
        )
    search = _Search(scene, q0, v0, duration, wanted)
    floor = ROUNDING * max(1.0, float(np.abs(q0).max()))
    members = candidates(scene) if integrator is None else (integrator,)
    if integrator is None and isinstance(search.controls, LinearPolicy):
        members = tuple(member for member in members if member.variational != (search.controls.on == "velocity"))
    # Raise for a state from which no motion can start.
    members[0].start(scene, q0[None], v0[None])
    coarse = first_steps(scene, q0, v0, duration, search.rows)
    ladder = Ladder(search.attempt, members, coarse, search.rows, lambda: search.evaluations > search.most)
    try:
        found = ladder.for_tolerance(max(wish, floor))[0][0]
    except (StepError, InputError):
        raise
    except VarpinError:
        raise ToleranceError(wish, duration, coarse, math.inf) from None
    if not found.error < SENSIBLE:
        raise ToleranceError(wish, duration, found.steps, found.error)
    record = Accuracy(
        wish, found.error, str(found.integrator), duration / found.steps, search.steps, search.evaluations
    )
    cause = f"rounding leaves {floor:.1e}" if wish < floor else "errors grow, or forces jump within steps"
    text = (
        f"tolerance = {wish:g} is not met: q is off by up to {record.error:.1e} with {record.integrator} "
        f"at dt = {record.dt:.3g} s ({cause})"
    )
    told = () if record.met else (Finding("tolerance not met", text, value=record.error, unit="rad or m"),)
    error = search.errors[str(found.integrator), found.steps]
    return Chosen(found.integrator, found.steps, search.given(found.steps), record, told, error)
