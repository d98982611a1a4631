"""Which integrator and which step: from short runs over the whole horizon and the known order of each method.

Every method is run at a few steps, each half of the one before. Their last configurations converge to the same one,
each at the rate of its order; differences between them give the errors, and the order what a smaller step would give.
No reference is integrated. A method is taken at its word only where its last halving has shown its order.
"""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from varpin.checks import JointValues, positive
from varpin.errors import InputError, VarpinError
from varpin.integrators import Guard, Integrator, Reference, largest_step
from varpin.lagrangian import lagrangian_jet
from varpin.markup import facts, table
from varpin.scene import Scene
from varpin.tradeoff.setting import Setting, integrators_of

Floats = NDArray[np.float64]

logger = logging.getLogger(__name__)

# Predicted errors stay below the tolerance by this factor.
_SAFETY = 1.5
# A halving shows the order p where it divides the error by 2^(p - slack) at least; and more than 2^(p + slack) is not
# believed.
_SLACK = 0.6
# How far below the smallest step tried the order is trusted.
_REACH = 4.0
# A difference between two motions is the error of one where the other is known this much better.
_CLEARLY = 0.25
# Short runs are repeated for this long [s], at most so often, since a machine's first answers are its slowest.
_TIMING, _REPEATS = 0.02, 5
# Runs shorter than this are worth making to be sure [s].
_CHEAP = 0.5
# Nodes at which the midpoint integrator's largest step is looked up.
_NODES = 32
# Errors from which on a motion is not the one that was asked for [rad or m].
_SENSIBLE = 1.0
# What rounding adds up to, relative to q: no method is asked for less, or promises it.
_ROUNDING = 200.0 * float(np.finfo(np.float64).eps)
# Runs of the final choice, each with a few steps more, until one meets the tolerance.
_CHECKS = 4
# Halvings that bring nothing, after which rounding is in charge of a method that has shown its order at small errors.
_STUCK, _SMALL = 2, 1e-6


@dataclass(frozen=True)
class Choice:
    """An integrator at the step that serves a wish best.

    Attributes:
        integrator: The method.
        dt: Its step [s].
        steps: Over the horizon.
        error: Predicted error in q at the end, the largest over the joints [rad or m]; infinite where not known.
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


@dataclass(frozen=True, eq=False)
class Advice:
    """Which integrator to take, at which step, and why.

    Attributes:
        best: The choice; its fields are this object's, too.
        reached: Whether it meets the wish, as far as can be predicted.
        alternatives: The best of every other method that has one, cheapest (or most accurate) first.
        largest_step: The step [s] from which on the midpoint integrator's branch guard splits steps somewhere along
            this motion; infinite if none is too large.
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
        rows = [
            (
                str(choice.integrator), choice.dt, choice.steps, _time(choice.seconds),
                f"{choice.error:.2e}" if math.isfinite(choice.error) else "unknown",
                "" if choice.measured else "by the method's order",
            )
            for choice in (self.best, *self.alternatives)
        ]  # fmt: skip
        columns = ("integrator", "dt [s]", "steps", "time", "error [rad or m]", "")
        return facts("Advice", [("", line) for line in self.reason.splitlines()], table(columns, rows, [0]))

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
        """The error in q at the end to expect [rad or m]."""
        return self.best.error

    @property
    def seconds(self) -> float:
        """The wall time to expect [s]."""
        return self.best.seconds

    def __str__(self) -> str:
        return self.reason


@dataclass(frozen=True, eq=False)
class _Sample:
    """One run: its last configuration (n,), its time, and whether it got there by the method's own steps alone.

    A guard that splits the steps of two runs into the same parts makes them the same motion, which shows no error.
    """

    steps: int
    q: Floats
    seconds: float
    pure: bool


class _Method:
    """An integrator with its runs so far, at steps that are halved from one to the next."""

    def __init__(self, setting: Setting, integrator: Integrator, first: int) -> None:
        self.setting, self.integrator, self.order = setting, integrator, integrator.order
        self.samples: list[_Sample] = []
        self.errors = np.zeros(0)
        self.bounded = np.zeros(0, dtype=bool)
        self.doubted = False
        self.open = True
        self._next = first
        self._idle, self._shown = 0, False

    @property
    def last(self) -> _Sample:
        return self.samples[-1]

    @property
    def whole(self) -> list[_Sample]:
        """The samples since the last that failed or was split."""
        bad = [k for k, sample in enumerate(self.samples) if not sample.pure]
        return self.samples[bad[-1] + 1 :] if bad else self.samples

    def refine(self) -> None:
        outcome = self.setting.run(self.integrator, self._next)
        begin, seconds = time.perf_counter(), [outcome.seconds]
        while len(seconds) < _REPEATS and time.perf_counter() - begin < _TIMING:
            seconds.append(self.setting.run(self.integrator, self._next).seconds)
        pure = not outcome.failure and outcome.split_steps == 0
        self.samples.append(_Sample(self._next, outcome.q[-1], min(seconds), pure))
        self._next *= 2

    def own_limit(self) -> tuple[Floats, float] | None:
        """Where the last runs point to, and how far the last is from there; None before they show their order."""
        whole = self.whole
        if len(whole) < 3:
            return None
        a, b, c = (sample.q for sample in whole[-3:])
        before, after = _distance(a, b), _distance(b, c)
        gain = 2.0**self.order
        if not after * 2.0 ** (self.order - _SLACK) <= before:
            return None
        uncertainty = max(after, before / (gain * 2.0**_SLACK)) / (gain - 1.0)
        # Coarse runs that blow up may shrink at any rate.
        return (c + (c - b) / (gain - 1.0), uncertainty) if uncertainty < _SENSIBLE else None

    def judge(self, limit: Floats | None, uncertainty: float) -> None:
        """Errors of :attr:`whole`, against the best known end if that is clearly better, else by its own runs.

        ``bounded`` says which of them are no more than bounds, and ``doubted`` whether the last one looks better than
        it is taken for: a further run will tell.
        """
        whole = self.whole
        self.errors, self.bounded = np.full(len(whole), np.nan), np.ones(len(whole), dtype=bool)
        if not whole:
            return
        own = self.own_limit()
        if own is not None:
            self.errors[:] = [_distance(sample.q, own[0]) for sample in whole]
            self.errors[-1] = own[1]
            self.bounded[:] = False
        if limit is not None:
            away = np.array([_distance(sample.q, limit) for sample in whole])
            clear = away * _CLEARLY >= uncertainty
            # An end that is known less well still bounds the error.
            better = ~clear & ~(self.errors <= away + uncertainty)
            self.errors = np.where(clear, away, np.where(better, away + uncertainty, self.errors))
            self.bounded = better | (self.bounded & ~clear)
        # Where errors of single joints change sign a run may be right by chance: its neighbours say how right.
        gain = 2.0**self.order
        from_larger = np.append(np.nan, self.errors[:-1]) / (gain * 2.0**_SLACK)
        from_smaller = np.append(self.errors[1:], np.nan) * gain
        cautious = np.fmax(self.errors, np.fmin(from_larger, from_smaller))
        self.doubted = bool(cautious[-1] > 1.5 * self.errors[-1])
        self.errors = cautious

    @property
    def regular(self) -> bool:
        """Whether the last halving shows the order."""
        if len(self.errors) < 2 or not np.isfinite(self.errors[-2:]).all():
            return False
        return bool(self.errors[-1] * 2.0 ** (self.order - _SLACK) <= self.errors[-2])

    def note_stagnation(self) -> None:
        """Close the method where halving its step has ceased to help after it had shown its order."""
        self._shown = self._shown or (self.regular and self.errors[-1] < _SMALL)
        known = self._shown and len(self.errors) > 1 and not self.bounded[-1]
        slow = known and not self.errors[-1] < 0.7 * self.errors[-2]
        self._idle = self._idle + 1 if slow else 0
        if self._idle >= _STUCK:
            self.open = False

    def seconds_at(self, steps: float) -> float:
        """Predicted wall time [s]: between runs on a straight line, beyond them on that of the last two."""
        counts = np.array([sample.steps for sample in self.samples], dtype=float)
        times = np.array([sample.seconds for sample in self.samples])
        if steps > counts[-1]:
            return float(times[-1] + (steps - counts[-1]) * self._seconds_a_step)
        return float(np.interp(steps, counts, times))

    @property
    def _seconds_a_step(self) -> float:
        """What one step more takes [s]; noise of the clock must not make it too small."""
        before, last = self.samples[-2:]
        slope = (last.seconds - before.seconds) / (last.steps - before.steps)
        mean = last.seconds / last.steps
        return min(max(slope, 0.5 * mean), mean)

    def steps_within(self, seconds: float) -> int:
        """The most steps that a time allows, a multiple of R."""
        rows = len(self.setting.controls)
        counts = [rows, *(sample.steps for sample in self.samples)]
        times = np.append(0.0, np.maximum.accumulate([sample.seconds for sample in self.samples]))
        inside = float(np.interp(seconds, times, counts))
        most = inside if seconds <= times[-1] else counts[-1] + (seconds - times[-1]) / self._seconds_a_step
        return max(rows, rows * int(most / rows))

    def error_at(self, steps: float) -> float:
        """Predicted error; NaN where nothing is known."""
        counts = np.array([sample.steps for sample in self.whole], dtype=float)
        if not len(counts) or steps < counts[0]:
            return math.nan
        if steps > counts[-1]:
            return float(self.errors[-1] * (counts[-1] / steps) ** self.order) if self.regular else math.nan
        return float(
            np.exp(np.interp(np.log(steps), np.log(counts), np.log(np.maximum(self.errors, np.finfo(np.float64).tiny))))
        )

    def steps_for(self, error: float) -> int | None:
        """The fewest steps whose predicted error, and that of all more, is at most ``error``; None if not known."""
        counts = [sample.steps for sample in self.whole]
        good = len(counts)
        while good > 0 and self.errors[good - 1] <= error:
            good -= 1
        if good == len(counts):
            if not self.regular:
                return None
            return self.rounded(counts[-1] * (self.errors[-1] / error) ** (1.0 / self.order))
        if good == 0 or not np.isfinite(self.errors[good - 1]):
            return counts[good]
        # On the straight line between two runs in logarithms.
        here, there = np.log(self.errors[good - 1 : good + 1])
        if here - there > (self.order + 1) * math.log(2.0):
            # A limit of stability lies between them, and nobody knows where.
            return counts[good]
        share = (here - math.log(error)) / (here - there)
        return min(self.rounded(counts[good - 1] * 2.0**share), counts[good])

    def rounded(self, steps: float) -> int:
        """A multiple of R."""
        rows = len(self.setting.controls)
        return rows * math.ceil(min(steps, 1e15) / rows)

    def choice(self, steps: int, floor: float) -> Choice:
        return Choice(
            integrator=self.integrator,
            dt=self.setting.duration / steps,
            steps=steps,
            error=max(self.error_at(steps), floor),
            seconds=self.seconds_at(steps),
            measured=steps <= self.last.steps,
        )


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

    What counts is the error in q at the end, the largest over the joints, on this scene from this state under these
    controls. It takes some times as long as the motion itself will. A horizon of many oscillations of a chaotic motion
    has no end that any method gets right; the advice then says that the wish is not reached.

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
    members = integrators_of(integrators)
    if any(isinstance(member, Reference) for member in members):
        raise InputError("Reference chooses its own steps: its accuracy is its tolerance")
    if (tolerance is None) == (budget is None):
        raise InputError("give either a tolerance [rad or m] or a budget [s]")
    patience = positive("patience", patience, "s")
    first = _first_steps(setting)
    begin = time.perf_counter()
    methods = [_Method(setting, member, first) for member in members]
    search = _Search(methods, begin + patience)
    if tolerance is not None:
        target = positive("tolerance", tolerance, "rad or m") / _SAFETY
        choices, reached = search.for_tolerance(target)
    else:
        choices, reached = search.for_budget(positive("budget", budget, "s"))
    bound = _largest_step(setting, methods)
    best, others = choices[0], tuple(choices[1:])
    reason = _reason(best, others, reached, bound, tolerance, budget, duration)
    return Advice(best, reached, others, bound, tolerance, budget, time.perf_counter() - begin, reason)


class _Search:
    """Refines the methods that may still win."""

    def __init__(self, methods: list[_Method], deadline: float) -> None:
        self.methods, self.deadline = methods, deadline
        self.floor = 0.0
        self.limit: Floats | None = None
        self.uncertainty = math.inf
        for method in methods:
            for _ in range(3):
                method.refine()
        self.judge()

    @property
    def late(self) -> bool:
        return time.perf_counter() > self.deadline

    def judge(self) -> None:
        """Errors of all runs, by the best end that is known."""
        limits = [own for own in (method.own_limit() for method in self.methods) if own is not None]
        if limits:
            self.limit, self.uncertainty = min(limits, key=lambda own: own[1])
            self.floor = _ROUNDING * max(1.0, float(np.abs(self.limit).max()))
        for method in self.methods:
            method.judge(self.limit, self.uncertainty)

    def refine(self, method: _Method) -> None:
        method.refine()
        self.judge()
        method.note_stagnation()

    def for_tolerance(self, wish: float) -> tuple[list[Choice], bool]:
        while not self.late:
            # What rounding puts out of reach is approached as far as it lets.
            target = max(wish, self.floor)
            steps = {method: method.steps_for(target) for method in self.methods}
            near = [m for m in self.methods if _near(m, steps[m])]
            best = min((m.seconds_at(steps[m] or 0) for m in near), default=math.inf)
            rivals = [m for m in self.methods if m.open and m not in near and self._least(m, steps[m]) < best]
            if not rivals and near:
                winner = min(near, key=lambda m: m.seconds_at(steps[m] or 0))
                # Where it costs little the prediction is held against a run at half the step.
                beyond = 2 * (steps[winner] or 0) > winner.last.steps
                rivals = [winner] if winner.open and beyond and 2.0 * best < _CHEAP else []
            if not rivals:
                break
            self.refine(min(rivals, key=lambda m: m.last.seconds))
        found = {method: method.steps_for(max(wish, self.floor)) for method in self.methods}
        choices = [m.choice(k, self.floor) for m, k in found.items() if k is not None]
        if any(_near(m, k) for m, k in found.items()):
            # What no run stands near is an estimate, and gives way to what is known.
            choices.sort(key=lambda c: (not _near(self._of(c), c.steps), c.seconds))
            choices[0] = self._checked(choices[0], _SAFETY * max(wish, self.floor))
            return choices, wish >= self.floor
        return sorted(self._as_they_are(), key=lambda c: (c.error, -c.integrator.order)), False

    def _checked(self, choice: Choice, tolerance: float) -> Choice:
        """The choice, run as it is and with more steps where it misses the tolerance, if that costs little."""
        method, steps = self._of(choice), choice.steps
        for _ in range(_CHECKS):
            if self.limit is None or self.uncertainty > 0.5 * tolerance or choice.seconds > _CHEAP or self.late:
                break
            outcome = method.setting.run(method.integrator, steps, repeats=2)
            error = _distance(outcome.q[-1], self.limit) + self.uncertainty
            if error <= tolerance:
                return replace(method.choice(steps, self.floor), error=max(error, self.floor))
            # A blow-up says nothing of how many more it takes.
            growth = min((error / tolerance) ** (1.0 / method.order), 2.0) if math.isfinite(error) else 2.0
            steps = method.rounded(1.05 * growth * steps)
        return choice

    def for_budget(self, budget: float) -> tuple[list[Choice], bool]:
        while not self.late:
            reach = 1.0 if budget < _CHEAP else _REACH
            rivals = [m for m in self.methods if m.open and reach * m.last.seconds < budget]
            if not rivals:
                break
            self.refine(min(rivals, key=lambda m: m.last.seconds))
        choices = []
        for method in self.methods:
            # More accuracy than rounding leaves is not to be had for more steps.
            enough = method.steps_for(self.floor)
            steps = min(method.steps_within(0.9 * budget), enough if enough is not None else sys.maxsize)
            if not math.isfinite(method.error_at(steps)):
                known = [s.steps for s, e in zip(method.whole, method.errors, strict=True) if np.isfinite(e)]
                steps = max((k for k in known if method.seconds_at(k) <= budget), default=0)
            if steps:
                choices.append(method.choice(steps, self.floor))
        if choices:
            return sorted(choices, key=lambda c: (c.error, c.seconds)), True
        return sorted(self._as_they_are(), key=lambda c: c.seconds), False

    def _of(self, choice: Choice) -> _Method:
        return next(m for m in self.methods if m.integrator is choice.integrator)

    @staticmethod
    def _least(method: _Method, steps: int | None) -> float:
        """A time that the method cannot do without: that of its last run, or half of what its order asks for."""
        unsure = steps is None or method.doubted
        return method.last.seconds if unsure else max(method.last.seconds, 0.5 * method.seconds_at(steps or 0))

    def _as_they_are(self) -> list[Choice]:
        """The last whole run of each method, where its error is known to any extent.

        Raises:
            VarpinError: There is none.
        """
        done = [m for m in self.methods if m.whole]
        if not done and self.late:
            finest = max(method.last.steps for method in self.methods)
            raise VarpinError(
                f"no integrator has taken this motion in whole steps yet, with up to {finest} of them: "
                "give more patience [s], or a shorter duration"
            )
        if not done:
            raise VarpinError("no integrator gets to the end of this motion, however small its steps were made")
        choices = [m.choice(m.last.steps, self.floor) for m in done]
        return [c if math.isfinite(c.error) else _unknown(c) for c in choices]


def _unknown(choice: Choice) -> Choice:
    return Choice(choice.integrator, choice.dt, choice.steps, math.inf, choice.seconds, choice.measured)


def _near(method: _Method, steps: int | None) -> bool:
    """Whether the runs reach far enough to speak of so many steps."""
    return steps is not None and steps <= _REACH * method.last.steps


def _distance(a: Floats, b: Floats) -> float:
    return float(np.abs(a - b).max())


def _first_steps(setting: Setting) -> int:
    """So few steps that they are coarse for the fastest direction at the start; a multiple of R."""
    n, rows = setting.scene.robot.dof, len(setting.controls)
    jet = lagrangian_jet(setting.scene, setting.q0, np.zeros(n))
    rates = np.abs(np.linalg.eigvals(np.linalg.solve(jet.Lvv, jet.Lqq)))
    rate = math.sqrt(float(rates.max())) + float(np.abs(setting.v0).max())
    return rows * max(math.ceil(0.5 * rate * setting.duration / rows), math.ceil(2 / rows))


def _largest_step(setting: Setting, methods: Sequence[_Method]) -> float:
    """The smallest of the midpoint guard's largest steps along the best motion there is [s]."""
    able = [m for m in methods if m.whole]
    if not able:
        return math.nan
    method = max(able, key=lambda m: (m.order, m.last.steps))
    rows = len(setting.controls)
    parts = method.last.steps // rows
    samples = rows * max(k for k in range(1, max(1, _NODES // rows) + 1) if parts % k == 0)
    motion = setting.run(method.integrator, method.last.steps, samples=samples)
    margin = Guard().branch_margin
    bounds = []
    for q, v in zip(motion.q, motion.v, strict=True):
        jet = lagrangian_jet(setting.scene, q, v)
        bounds.append(largest_step(jet.Lvv, jet.Lqq, margin))
    return min(bounds)


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
        lines = [f"{best}, the cheapest within {wish} after {duration:g} s"]
    else:
        lines = [f"{best}, the most accurate after {duration:g} s within {wish}"]
    if others and tolerance is not None and reached:
        lines.append(f"next: {others[0]}, {others[0].seconds / best.seconds:.2g} times as long")
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
