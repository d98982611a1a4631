"""The integrator and step that meet an accuracy, from runs over the whole horizon and the orders of the methods.

Every method is run at a few steps, each half of the one before. All converge to the same motion, each at the rate of
its order. Differences between runs give the errors, and the order gives those of smaller steps. No reference is
integrated. The order of a method is used only where its last halving has shown it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from varpin.arrays import Floats
from varpin.errors import VarpinError
from varpin.integrators import ExplicitEuler, Gauss, Integrator, Midpoint, RungeKutta4, SemiImplicitEuler
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene

Run = Callable[[Integrator, int], "Sample"]

# The default candidates of every choice.
INTEGRATORS: tuple[Integrator, ...] = (
    ExplicitEuler(),
    SemiImplicitEuler(),
    RungeKutta4(),
    Midpoint(),
    *(Gauss(stages=stages) for stages in (2, 3, 4, 5)),
)


# Factor between the tolerance and predicted errors.
SAFETY = 1.5
# Error from which on a motion counts as wrong [rad or m].
SENSIBLE = 1.0
# A halving shows the order p if it divides the error by 2^(p - slack) at least; a larger factor than 2^(p + slack)
# counts as this one.
_SLACK = 0.6
# Largest factor between a number of steps and that of the finest run up to which the order is extrapolated.
REACH = 4.0
# The difference of two motions is the error of one if the uncertainty of the other is below this share of it.
_CLEARLY = 0.25
# Accumulated rounding, relative to q: the smallest error that is aimed at or predicted.
ROUNDING = 200.0 * float(np.finfo(np.float64).eps)
# Most runs of the final choice, each with some more steps, until one meets the tolerance.
CHECKS = 4
# Number of halvings without gain after which a method counts as limited by rounding, if it has shown its order at an
# error below the second number [rad or m].
_STUCK, _SMALL = 2, 1e-6


def candidates(scene: Scene) -> tuple[Integrator, ...]:
    """The members of :data:`INTEGRATORS` that can integrate a scene."""
    return tuple(member for member in INTEGRATORS if member.keeps_constraints or not scene.constraints)


@dataclass(frozen=True)
class Found:
    """A method at a number of steps.

    Attributes:
        integrator: The method.
        steps: Over the horizon.
        error: Predicted, the largest over nodes and joints [rad or m]; infinite where not known.
        cost: Predicted, in the units of the runs.
        measured: Whether there are runs of as many steps or more; else the error is extrapolated by the order.
    """

    integrator: Integrator
    steps: int
    error: float
    cost: float
    measured: bool


@dataclass(frozen=True, eq=False)
class Sample:
    """One run: configurations (K, n) at K evenly spaced times up to the end, its cost, and whether it is pure.

    A pure run has no divided steps and gets to the end. A guard that divides the steps of two runs into the same parts
    makes them the same motion, whose difference is no error.
    """

    steps: int
    q: Floats
    cost: float
    pure: bool


class Method:
    """An integrator with its runs so far, each at half the step of the one before."""

    def __init__(self, run: Run, integrator: Integrator, first: int, rows: int, order: int) -> None:
        """A method without runs.

        Args:
            run: Runs an integrator with a number of steps.
            integrator: The integrator.
            first: Number of steps of the first run.
            rows: All numbers of steps are multiples of it.
            order: The expected order of convergence.
        """
        self.run, self.integrator, self.rows, self.order = run, integrator, rows, order
        self.samples: list[Sample] = []
        self.errors = np.zeros(0)
        self.bounded = np.zeros(0, dtype=bool)
        self.doubted = False
        self.open = True
        self._next = first
        self._idle, self._order_seen = 0, False

    @property
    def last(self) -> Sample:
        """The run at the smallest step."""
        return self.samples[-1]

    @property
    def whole(self) -> list[Sample]:
        """The samples after the last that is not pure."""
        bad = [k for k, sample in enumerate(self.samples) if not sample.pure]
        return self.samples[bad[-1] + 1 :] if bad else self.samples

    def refine(self) -> None:
        """Run it at half its smallest step."""
        self.samples.append(self.run(self.integrator, self._next))
        self._next *= 2

    def own_limit(self) -> tuple[Floats, float] | None:
        """The limit of the last runs, and the distance of the last from it; None before they show their order."""
        whole = self.whole
        if len(whole) < 3:
            return None
        a, b, c = (sample.q for sample in whole[-3:])
        before, after = distance(a, b), distance(b, c)
        gain = 2.0**self.order
        if not after * 2.0 ** (self.order - _SLACK) <= before:
            return None
        uncertainty = max(after, before / (gain * 2.0**_SLACK)) / (gain - 1.0)
        # Differences of coarse runs that blow up may shrink at any rate.
        if not uncertainty < SENSIBLE:
            return None
        shared = math.gcd(len(b), len(c))
        end = _thinned(c, shared)
        return end + (end - _thinned(b, shared)) / (gain - 1.0), uncertainty

    def judge(self, limit: Floats | None, uncertainty: float) -> None:
        """Set the errors of :attr:`whole`, from the best known limit if that is clearly better, else from own runs.

        ``bounded`` marks errors that are upper bounds only. ``doubted`` is set if the last error is raised for caution:
        a further run decides.
        """
        whole = self.whole
        self.errors, self.bounded = np.full(len(whole), np.nan), np.ones(len(whole), dtype=bool)
        if not whole:
            return
        found = self.own_limit()
        if found is not None:
            self.errors[:] = [distance(sample.q, found[0]) for sample in whole]
            self.errors[-1] = found[1]
            self.bounded[:] = False
        if limit is not None:
            away = np.array([distance(sample.q, limit) for sample in whole])
            clear = away * _CLEARLY >= uncertainty
            # A less certain limit still bounds the error.
            better = ~clear & ~(self.errors <= away + uncertainty)
            self.errors = np.where(clear, away, np.where(better, away + uncertainty, self.errors))
            self.bounded = better | (self.bounded & ~clear)
        # Where a joint's error changes sign a run may be right by chance: its neighbours bound its error from below.
        gain = 2.0**self.order
        from_larger = np.append(np.nan, self.errors[:-1]) / (gain * 2.0**_SLACK)
        from_smaller = np.append(self.errors[1:], np.nan) * gain
        cautious = np.fmax(self.errors, np.fmin(from_larger, from_smaller))
        self.doubted = bool(cautious[-1] > 1.5 * self.errors[-1])
        self.errors = cautious

    @property
    def regular(self) -> bool:
        """Whether the last halving has shown the order."""
        if len(self.errors) < 2 or not np.isfinite(self.errors[-2:]).all():
            return False
        return bool(self.errors[-1] * 2.0 ** (self.order - _SLACK) <= self.errors[-2])

    def note_stagnation(self) -> None:
        """Close the method if halving its step no longer reduces the error after it has shown its order."""
        self._order_seen = self._order_seen or (self.regular and self.errors[-1] < _SMALL)
        known = self._order_seen and len(self.errors) > 1 and not self.bounded[-1]
        slow = known and not self.errors[-1] < 0.7 * self.errors[-2]
        self._idle = self._idle + 1 if slow else 0
        if self._idle >= _STUCK:
            self.open = False

    def cost_at(self, steps: float) -> float:
        """Predicted cost: linear between runs, extrapolated from the last two beyond them."""
        counts = np.array([sample.steps for sample in self.samples], dtype=float)
        costs = np.array([sample.cost for sample in self.samples])
        if steps > counts[-1]:
            return float(costs[-1] + (steps - counts[-1]) * self.cost_a_step)
        return float(np.interp(steps, counts, costs))

    @property
    def cost_a_step(self) -> float:
        """The cost of one more step, at least half of the mean: measured times have noise."""
        before, last = self.samples[-2:]
        slope = (last.cost - before.cost) / (last.steps - before.steps)
        mean = last.cost / last.steps
        return min(max(slope, 0.5 * mean), mean)

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
        """The fewest steps from which on the predicted error is at most ``error``; None if not known."""
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
        # Linear between two runs in logarithms.
        here, there = np.log(self.errors[good - 1 : good + 1])
        if here - there > (self.order + 1) * math.log(2.0):
            # A stability limit lies somewhere between them.
            return counts[good]
        share = (here - math.log(error)) / (here - there)
        return min(self.rounded(counts[good - 1] * 2.0**share), counts[good])

    def rounded(self, steps: float) -> int:
        """The next multiple of ``rows``."""
        rows = self.rows
        return rows * math.ceil(min(steps, 1e15) / rows)

    def more(self, steps: int, error: float, tolerance: float) -> int:
        """The number of steps to try next after ``steps`` with this error, above the tolerance."""
        # The error of a run that blows up gives no factor.
        growth = min((error / tolerance) ** (1.0 / self.order), 2.0) if math.isfinite(error) else 2.0
        return self.rounded(1.05 * growth * steps)

    def choice(self, steps: int, floor: float) -> Found:
        """The method at a number of steps, with an error of at least ``floor``."""
        return Found(
            integrator=self.integrator,
            steps=steps,
            error=max(self.error_at(steps), floor),
            cost=self.cost_at(steps),
            measured=steps <= self.last.steps,
        )


class Search:
    """Refines the methods that may still be the cheapest.

    Attributes:
        methods: With their runs.
        floor: The smallest error that rounding allows [rad or m].
        limit: The limit of the best method's runs (K, n); None before one is known.
        uncertainty: Of the limit [rad or m].
    """

    def __init__(self, methods: Sequence[Method], late: Callable[[], bool], cheap: float) -> None:
        """Each method is run at three steps.

        Args:
            methods: Without runs.
            late: Whether no further run may begin.
            cheap: Cost below which a choice is checked by further runs.
        """
        self.methods, self.late, self.cheap = tuple(methods), late, cheap
        self.floor = 0.0
        self.limit: Floats | None = None
        self.uncertainty = math.inf
        for method in methods:
            for _ in range(3):
                method.refine()
        self.judge()

    def limits(self) -> list[tuple[Floats, float]]:
        """The limits of the methods' runs, each with its uncertainty [rad or m]."""
        return [limit for limit in (method.own_limit() for method in self.methods) if limit is not None]

    def judge(self) -> None:
        """Set the errors of all runs by the best known limit."""
        limits = self.limits()
        if limits:
            self.limit, self.uncertainty = min(limits, key=lambda limit: limit[1])
            self.floor = ROUNDING * max(1.0, float(np.abs(self.limit).max()))
        for method in self.methods:
            method.judge(self.limit, self.uncertainty)

    def refine(self, method: Method) -> None:
        """Run a method at half its step, and update the errors of all runs."""
        method.refine()
        self.judge()
        method.note_stagnation()

    def for_tolerance(self, wish: float) -> tuple[list[Found], bool]:
        """The best choice of each method for an error [rad or m], the cheapest first, and whether the error is met."""
        while not self.late():
            target = max(wish, self.floor)
            steps = {method: method.steps_for(target) for method in self.methods}
            near = [m for m in self.methods if reaches(m, steps[m])]
            best = min((m.cost_at(steps[m] or 0) for m in near), default=math.inf)
            rivals = [m for m in self.methods if m.open and m not in near and self._least(m, steps[m]) < best]
            if not rivals and near:
                winner = min(near, key=lambda m: m.cost_at(steps[m] or 0))
                # Where it costs little the prediction is checked by a run at half the step.
                beyond = 2 * (steps[winner] or 0) > winner.last.steps
                rivals = [winner] if winner.open and beyond and 2.0 * best < self.cheap else []
            if not rivals:
                break
            self.refine(min(rivals, key=lambda m: m.last.cost))
        found = {method: method.steps_for(max(wish, self.floor)) for method in self.methods}
        choices = [m.choice(k, self.floor) for m, k in found.items() if k is not None]
        if any(reaches(m, k) for m, k in found.items()):
            # Choices far beyond the runs are extrapolated too far: they come last.
            choices.sort(key=lambda c: (not reaches(self._of(c), c.steps), c.cost))
            choices[0] = self.checked(choices[0], SAFETY * max(wish, self.floor))
            return choices, wish >= self.floor
        return sorted(self.as_they_are(), key=lambda c: (c.error, -c.integrator.order)), False

    def checked(self, choice: Found, tolerance: float) -> Found:
        """The choice after a run of it, with more steps where it misses the tolerance, if that costs little."""
        method, steps = self._of(choice), choice.steps
        for _ in range(CHECKS):
            if self.limit is None or self.uncertainty > 0.5 * tolerance or choice.cost > self.cheap or self.late():
                break
            error = distance(method.run(method.integrator, steps).q, self.limit) + self.uncertainty
            if error <= tolerance:
                return replace(method.choice(steps, self.floor), error=max(error, self.floor))
            steps = method.more(steps, error, tolerance)
        return choice

    def _of(self, choice: Found) -> Method:
        return next(m for m in self.methods if m.integrator is choice.integrator)

    @staticmethod
    def _least(method: Method, steps: int | None) -> float:
        """A lower bound of the method's cost: that of its last run, or half of that predicted."""
        unsure = steps is None or method.doubted
        return method.last.cost if unsure else max(method.last.cost, 0.5 * method.cost_at(steps or 0))

    def as_they_are(self) -> list[Found]:
        """The last pure run of each method.

        Raises:
            VarpinError: There is none.
        """
        done = [m for m in self.methods if m.whole]
        if not done and self.late():
            finest = max(method.last.steps for method in self.methods)
            raise VarpinError(
                f"no integrator has taken this motion in whole steps yet, with up to {finest} of them: "
                "give more patience [s], or a shorter duration"
            )
        if not done:
            raise VarpinError("no integrator gets to the end of this motion, however small its steps were made")
        choices = [m.choice(m.last.steps, self.floor) for m in done]
        return [c if math.isfinite(c.error) else replace(c, error=math.inf) for c in choices]


def reaches(method: Method, steps: int | None) -> bool:
    """Whether the runs are fine enough to predict the error of ``steps`` steps."""
    return steps is not None and steps <= REACH * method.last.steps


def distance(a: Floats, b: Floats) -> float:
    """The largest difference of two motions (K, n) at their common times, which include the end."""
    shared = math.gcd(len(a), len(b))
    return float(np.abs(_thinned(a, shared) - _thinned(b, shared)).max())


def _thinned(q: Floats, samples: int) -> Floats:
    """A motion at fewer evenly spaced times."""
    stride = len(q) // samples
    return q[stride - 1 :: stride]


def first_steps(scene: Scene, q0: Floats, v0: Floats, duration: float, rows: int) -> int:
    """A number of steps that is coarse for the fastest mode at the start; a multiple of ``rows``."""
    jet = lagrangian_jet(scene, q0, np.zeros_like(q0))
    rates = np.abs(np.linalg.eigvals(np.linalg.solve(jet.Lvv, jet.Lqq)))
    rate = math.sqrt(float(rates.max())) + float(np.abs(v0).max())
    return rows * max(math.ceil(0.5 * rate * duration / rows), math.ceil(2 / rows))
