"""The integrator and step that meet a tolerance on a motion at the lowest cost, with the estimated error.

Costs are numbers of evaluations, so that the choice is the same on every machine. Errors are those at all nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from varpin.arrays import Floats
from varpin.core.arrays import Commands
from varpin.integrators import Integrator, Segment
from varpin.integrators.base import rows, steps_of
from varpin.mechanics.constraints import CustomConstraintError
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.scene import Scene
from varpin.simulation.refinement import (
    CHECKS,
    ROUNDING,
    SAFETY,
    SENSIBLE,
    Found,
    Method,
    Sample,
    Search,
    distance,
    first_steps,
)

# Work between two checks for Ctrl-C, in steps of one joint.
_CHUNK = 100_000
# About the number of nodes of a run that are kept; of runs with no more steps, all that the core gives is.
_NODES = 4096
# Number of evaluations, times the number of joints, after which no further run begins.
_MOST_WORK = 50_000_000
# Where differences between runs shrink by at least this factor, twice, a limit is extrapolated; its distance from the
# last run in units of the last difference: 0.75 / (1 - 0.75).
_SHRINKS, _LEFT = 0.75, 3.0
# Factor on the number of steps of a second run that samples a function of time elsewhere: a jump lies at another place
# of a step.
_OTHER = 1.37
# Factor on the tolerance from which on an error ends the trial of the earlier integrator.
_FAR = 30.0
# Number of runs with a failing user's function after which the search ends, if no run has passed.
_RAISES = 24


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion to integrate.

    Attributes:
        scene: Without noise.
        q0: (n,) [rad or m].
        v0: (n,) [rad/s or m/s].
        duration: [s].
        parts: All numbers of steps are multiples of it.
        commands: The commands for an integrator and a number of steps.
        sampled: Whether the commands are samples of a function: where it jumps, steps and half steps may have the same
            samples.
    """

    scene: Scene
    q0: Floats
    v0: Floats
    duration: float
    parts: int
    commands: Callable[[Integrator, int], Commands]
    sampled: bool = False


# Consecutive steps, with their commands.
Steps = tuple[tuple[Segment, Commands], ...]


class Raised(Exception):
    """A run in which a function of a custom force or constraint failed.

    Attributes:
        integrator: Of the run.
        steps: Of the run.
        error: Of the function.
    """

    def __init__(self, integrator: Integrator, steps: int, error: CustomForceError | CustomConstraintError) -> None:
        self.integrator, self.steps, self.error = integrator, steps, error
        super().__init__(str(error))


class _Runs:
    """Runs of a motion, with their total cost."""

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        self.most = _MOST_WORK / len(motion.q0)
        self.steps = self.evaluations = 0
        self.raised: Raised | None = None
        self._raises, self._passed = 0, False
        self._done: dict[tuple[str, int], Sample] = {}
        self._whole: dict[tuple[str, int], Steps] = {}

    def whole(self, integrator: Integrator, steps: int) -> Steps:
        """All steps of an earlier run; empty for a long one, which is not kept."""
        return self._whole.get((str(integrator), steps), ())

    def __call__(self, integrator: Integrator, steps: int) -> Sample:
        key = str(integrator), steps
        if key not in self._done:
            self._done[key] = self._run(integrator, steps)
        return self._done[key]

    def _run(self, integrator: Integrator, steps: int) -> Sample:
        given, stride = self.motion, 1
        while steps % (2 * stride) == 0 and steps // stride > _NODES:
            stride *= 2
        n, dt, nothing = len(given.q0), given.duration / steps, np.zeros((0, 0, 0))
        if steps > self.most:
            # Too long to run. Its cost is counted, which ends a search whose runs all fail in their first steps.
            self.evaluations += steps
            return Sample(steps, np.full((steps // stride, n), np.nan), math.inf, pure=False)
        commands = given.commands(integrator, steps)
        state, (last,) = integrator.start(given.scene, given.q0[None], given.v0[None])
        q, done, evaluations, pure = np.full((steps // stride, n), np.nan), 0, 0, True
        parts: list[tuple[Segment, Commands]] = []
        chunk = max(1, _CHUNK // n // commands.hold)
        while done < steps and pure:
            first = done // commands.hold
            block = rows(commands, first, first + chunk, last.u[None, -1] if done else None)
            try:
                (last,) = integrator.rollout(given.scene, state, block, nothing, dt)
            except (CustomForceError, CustomConstraintError) as error:
                # Coarse steps may go where the function is not defined.
                self.raised, pure = Raised(integrator, steps, error), False
                self._raises += 1
                if self._raises >= _RAISES and not self._passed:
                    raise self.raised from error
                evaluations += steps
                break
            nodes = done + 1 + np.arange(len(last.q))
            kept = nodes % stride == 0
            q[nodes[kept] // stride - 1] = last.q[kept]
            statistics = last.statistics
            evaluations += int(statistics.sweeps.sum() + statistics.jets.sum())
            pure = last.failure is None and statistics.split_steps == 0
            done += steps_of(block)
            if steps <= _NODES:
                parts.append((last, block))
        if pure:
            self._whole[str(integrator), steps] = tuple(parts)
        self.steps += done
        self.evaluations += evaluations
        self._passed = self._passed or pure
        # A run with divided steps does not show the method's order; it ends there.
        return Sample(steps, q, float(evaluations) * steps / max(done, 1), pure)


class _CheckedSearch(Search):
    """A search whose costs are evaluations, and whose choice is checked by a run at half its step."""

    def __init__(self, methods: Sequence[Method], runs: _Runs) -> None:
        super().__init__(methods, lambda: runs.evaluations > runs.most, math.inf)
        self.sampled = runs.motion.sampled

    def limits(self) -> list[tuple[Floats, float]]:
        """See :meth:`Search.limits`; where no method shows its order, limits of shrinking differences."""
        return super().limits() or [limit for limit in map(_rough_limit, self.methods) if limit is not None]

    def checked(self, choice: Found, tolerance: float) -> Found:
        """See :meth:`Search.checked`; errors at all nodes."""
        method, best = self._of(choice), choice
        for trial in range(CHECKS):
            if self.late() and best.steps > method.last.steps:
                break
            error = _error(method, best.steps)
            if self.sampled:
                error = max(error, _error_of_samples(method, best.steps))
            if self.limit is not None:
                error = max(error, distance(method.run(method.integrator, best.steps).q, self.limit) - self.uncertainty)
            best = replace(best, error=max(error, self.floor) if math.isfinite(error) else math.inf, measured=True)
            if best.error <= tolerance or trial == CHECKS - 1:
                break
            best = replace(best, steps=method.more(best.steps, error, tolerance))
        return best

    def as_they_are(self) -> list[Found]:
        """See :meth:`Search.as_they_are`; an unknown error where no method has a pure run."""
        if any(method.whole for method in self.methods):
            return super().as_they_are()
        method = self.methods[-1]
        return [Found(method.integrator, method.last.steps, math.inf, method.last.cost, measured=True)]


def _rough_limit(method: Method) -> tuple[Floats, float] | None:
    """The last run, and its distance from the limit, from differences that shrink twice, at whatever rate."""
    if len(method.whole) < 4:
        return None
    a, b, c, d = (sample.q for sample in method.whole[-4:])
    before, middle, after = distance(a, b), distance(b, c), distance(c, d)
    if not (middle <= _SHRINKS * before and after <= _SHRINKS * middle and _LEFT * after < SENSIBLE):
        return None
    return d, _LEFT * after


def _error(method: Method, steps: int) -> float:
    """The error of a run at its nodes, from a run at half the step; NaN where one of them fails."""
    once, twice = (method.run(method.integrator, k) for k in (steps, 2 * steps))
    gain = 2.0**method.order if len(method.errors) == 0 or method.regular else 2.0
    return distance(once.q, twice.q) * gain / (gain - 1.0)


def _error_of_samples(method: Method, steps: int) -> float:
    """The difference at the end from a run with other sampling times; NaN where one of them fails."""
    other = method.rounded(_OTHER * steps)
    one, two = (method.run(method.integrator, k).q[-1] for k in (steps, other))
    return float(np.abs(one - two).max())


@dataclass(frozen=True)
class Choice:
    """The chosen integrator and number of steps, with the cost of the search.

    Attributes:
        integrator: The method.
        steps: Its number of steps.
        error: The estimate, at all nodes [rad or m]; infinite where nothing is known.
        search_steps: Steps of all runs.
        search_evaluations: Evaluations in them.
        floor: The smallest error that rounding allows [rad or m].
        raised: The last run in which a function of a custom force or constraint failed, if one did.
        motion: All steps of the chosen run; empty if it is long, or was not run.
    """

    integrator: Integrator
    steps: int
    error: float
    search_steps: int
    search_evaluations: int
    floor: float
    raised: Raised | None = None
    motion: Steps = ()


def choose(
    motion: Motion,
    candidates: Callable[[], Sequence[Integrator]],
    tolerance: float,
    first: tuple[Integrator, float] | None = None,
) -> Choice:
    """The cheapest of some integrators, and its number of steps, for an error in q of at most ``tolerance``.

    Args:
        motion: To integrate.
        candidates: The integrators to choose from, called if the first one does not do.
        tolerance: At all nodes [rad or m].
        first: An integrator and a step [s] to try first: taken if they, or somewhat smaller steps, meet the tolerance.

    Raises:
        SingularMassMatrix: M(q0) is not positive definite.
        VarpinError: No integrator gets to the end.
        Raised: A function of a custom force or constraint fails in all runs.
    """
    runs = _Runs(motion)

    def of(integrator: Integrator, least: int) -> Method:
        return Method(runs, integrator, least, motion.parts, integrator.order)

    if first is not None and motion.duration / first[1] < runs.most:
        _require_start(motion, first[0])
        method = of(first[0], motion.parts)
        steps = method.rounded(motion.duration / first[1] * (1.0 - 1e-9))
        for _ in range(CHECKS):
            error = _error(method, steps)
            floor = ROUNDING * max(1.0, float(np.abs(runs(first[0], steps).q).max()))
            if not (runs(first[0], steps).pure and math.isfinite(error) and error < SENSIBLE):
                break
            if max(error, floor) <= tolerance:
                found = runs.whole(first[0], steps)
                return Choice(first[0], steps, max(error, floor), runs.steps, runs.evaluations, floor, motion=found)
            if error > _FAR * tolerance:
                break
            steps = method.more(steps, error, tolerance)
    integrators = candidates()
    _require_start(motion, integrators[0])
    coarse = first_steps(motion.scene, motion.q0, motion.v0, motion.duration, motion.parts)
    if coarse > runs.most:
        return Choice(integrators[0], coarse, math.inf, 0, 0, 0.0)
    # Powers of two, so that runs share as many nodes as possible.
    least = motion.parts * 2 ** math.ceil(math.log2(coarse // motion.parts))
    search = _CheckedSearch([of(member, least) for member in integrators], runs)
    (best, *_), _ = search.for_tolerance(tolerance / SAFETY)
    found, spent = runs.whole(best.integrator, best.steps), (runs.steps, runs.evaluations)
    return Choice(best.integrator, best.steps, best.error, *spent, search.floor, runs.raised, found)


def _require_start(motion: Motion, integrator: Integrator) -> None:
    """Raise for a state from which no motion can start."""
    integrator.start(motion.scene, motion.q0[None], motion.v0[None])
