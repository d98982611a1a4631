"""The line search along a plan, equation (O13) of docs/mathematics.md: the lengths and the bounds of trials."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator
from dataclasses import is_dataclass
from typing import NamedTuple

import numpy as np

from varpin.arrays import Floats
from varpin.control.along import Along
from varpin.control.backward import backward
from varpin.control.costs import CostError
from varpin.control.descent import rounding
from varpin.control.feedback import with_feedback
from varpin.control.following import AS_FORESEEN, FOLLOWS, Foresight
from varpin.control.passes import Plan, foreseen, noise_shares
from varpin.control.penalties import PenalizedProblem
from varpin.control.problem import OptimalControlProblem
from varpin.control.trials import HALVINGS, MORE_HALVINGS, Attempt, Trials, cut_less, few_halvings
from varpin.core import Watch
from varpin.core.arrays import Commands
from varpin.errors import LinearizationError
from varpin.integrators import Integrator
from varpin.integrators.variational import Variational
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.noise import NoiseFieldError
from varpin.trajectory import Trajectory

logger = logging.getLogger(__name__)

_EPS = float(np.finfo(np.float64).eps)
# Errors that reject a trial.
TRIAL_ERRORS = (CostError, NoiseFieldError, CustomForceError, LinearizationError)
# Steps no longer than that are very short.
VERY_SHORT = 0.01
# Below this share of the expected decrease a step is poor: shorter steps are tried while they improve on it.
_POOR = 0.3
# A full step whose decrease is above this share of what the slope gives ends early: at the minimum of the model it is a
# half. The step is extended by a factor while that lowers the cost. If it was not extended and the step before was a
# full one, too, a motion on the parabola through the last ones is tried, whose length counts as two. That fails so
# seldom that failures are not remembered.
_EARLY, _EXTENSION, _BENT = 0.85, 4.0, 2.0
# Approximate shortest step of a line search, its greatest number of trials, and the least factor between two of them.
_SHORTEST, _TRIALS, _SHARPEST = 1e-6, 40, 0.25
# Bounds on the substeps of a trial. A trial stops where a step needs more than HALVINGS halvings and more than the
# current motion, or where the total exceeds _PARTS times that of the current motion. If no other trial leads far, the
# stopped ones are repeated with larger bounds, then with none. A search that stalls continues without bounds.
_PARTS = 3
# Increase of the cost at which a trial stops, in units of what the slope gives: the next lengths do not depend on what
# is beyond that. A relative margin well above rounding errors.
_DEAR, _DEARER = 1.0, 1e-9
# Lengths of steps that may raise the cost.
_LEAPS = (1.0, 0.5, 0.25, 0.125)


class Start(NamedTuple):
    """What a line search starts from.

    Attributes:
        plan: The plan it goes along.
        along: The motion that the plan is around, with its expansions.
        shares: The terms of the motion's cost (:meth:`OptimalControlProblem.shares`).
        cost: Their sum.
        rating: Regularization of the passes that rate motions, :class:`Rated`.
        exact: Whether the pass had second derivatives of the dynamics.
        whole: Whether the pass had the whole gradient of the noise cost.
        extends: Whether full steps that end early are extended.
        overshot: Whether the last extension by a factor failed: then only the parabola is tried.
        follows: Whether a trial may follow foreseen states.
        bounded: Whether trials stop at a number of substeps.
        behind: The motion from which a full step led to this one, or None.
    """

    plan: Plan
    along: Along
    shares: Floats
    cost: float
    rating: float
    exact: bool
    whole: bool
    extends: bool
    overshot: bool
    follows: bool
    bounded: bool
    behind: Trajectory | None

    @property
    def trajectory(self) -> Trajectory:
        """The motion that the plan is around."""
        return self.along.trajectory


class Rated(NamedTuple):
    """A motion's expansions, and the plan along it whose noise cost counts as that of the motion.

    Noise grows under regularized gains. So the plan has no regularization where the model has a minimum without.
    """

    along: Along
    plan: Plan
    regularization: float


class Trial(NamedTuple):
    """A trial of the line search.

    Attributes:
        motion: None where the trial was stopped or has no finite cost.
        shares: The terms of its cost (:meth:`OptimalControlProblem.shares`).
        cost: Change of the cost without noise.
        expected: Change of the expected cost.
        cut: Whether it was stopped for its number of substeps.
        rated: The expansions along it and their plan, where the expected cost needed them.
    """

    motion: Attempt | None = None
    shares: Floats | None = None
    cost: float = np.inf
    expected: float = np.inf
    cut: bool = False
    rated: Rated | None = None


class Step(NamedTuple):
    """Result of a line search.

    Attributes:
        length: Length of the accepted step; 0 if none was.
        trials: Number of trials.
        decrease: Decrease of the expected cost.
        hidden: Rounding error of a difference of costs; 0 if a step was accepted or no trial has a cost.
        taken: The accepted trial.
        cut: Whether trials without an accepted one were stopped for their number of substeps.
        jumps: Whether very short trials were rejected where they divide other steps than the motion.
        strayed: Whether a trial that followed foreseen states cost no less than the full step.
        overshot: Whether an extension of a full step was tried and did not lower the cost further.
    """

    length: float = 0.0
    trials: int = 0
    decrease: float = 0.0
    hidden: float = 0.0
    taken: Trial = Trial()
    cut: bool = False
    jumps: bool = False
    strayed: bool = False
    overshot: bool = False


class _Bounds(NamedTuple):
    """Bounds on the work of a trial.

    Attributes:
        integrator: Bounds the halvings of a step.
        parts: Greatest number of substeps, relative to the current motion.
        watched: Whether a trial of length 1 is also stopped early. Most searches accept it, and the check takes time.
    """

    integrator: Integrator
    parts: float
    watched: bool


class _Here(NamedTuple):
    """What all trials have in common, beside the start."""

    controls: Floats  # of the decisions (R, m)
    feedback: Commands  # without the feed-forward part
    added: Floats  # noise cost of each step
    total: float  # the expected cost

    def commands(self, step: float, plan: Plan) -> Commands:
        """The commands of a step of this length along the plan."""
        return Commands(self.controls + step * plan.feedforward, *self.feedback[1:])


class _Lengths:
    """Step lengths of a line search: powers of the factor ``backtracking``, the longest first.

    Powers are left out that are longer than the minimum of the parabola through the last trial's cost and slope, down
    to :data:`_SHARPEST` of the last length (J. E. Dennis and R. B. Schnabel, "Numerical Methods for Unconstrained
    Optimization and Nonlinear Equations", 1983, section 6.3).
    """

    def __init__(self, backtracking: float, shortest: float) -> None:
        self._backtracking, self._shortest = backtracking, max(shortest, _SHORTEST)
        self._powers = 1

    def learn(self, step: float, change: float, slope: float) -> None:
        """Learn from the change of the cost with a trial of length ``step``, infinite if it has no cost."""
        least = 0.5 / (1.0 - change / (step * slope)) if change > step * slope else 1.0
        self._powers = 1
        if least < self._backtracking:
            powers = math.log(max(least, _SHARPEST)) / math.log(self._backtracking)
            self._powers = max(1, math.floor(powers))

    def __iter__(self) -> Iterator[float]:
        length, count = 1.0, 0
        while length > self._shortest and count < _TRIALS:
            yield length
            count += 1
            length *= self._backtracking**self._powers


class LineSearch:
    """Line searches of one problem.

    Args:
        problem: The problem.
        trials: Its trial motions.
        armijo: Least share of the expected decrease that a step must reach.
        backtracking: Factor between the lengths of trials.
        closed: Whether the plan's feedback acts in trials.
        label: Prefix of each log line.
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        trials: Trials,
        *,
        armijo: float,
        backtracking: float,
        closed: bool,
        label: str,
    ) -> None:
        self.problem, self.trials, self.label = problem, trials, label
        self.armijo, self.backtracking, self.closed = armijo, backtracking, closed
        self._rounding = _at_rounding(problem.control_limits)
        self._foresight = Foresight(problem)
        self._stiff = isinstance(problem, PenalizedProblem) and problem.later
        integrator = problem.integrator
        # Whether steps may be divided.
        self._divides = (
            isinstance(integrator, Variational) and integrator.guard is not None and is_dataclass(integrator)
        )

    def run(self, start: Start, shortest: float = 0.0) -> Step:
        """Find the first trial along the plan with sufficient decrease of the expected cost, (O13).

        A trial that follows foreseen states, (O17), may take the place of the full step.
        """
        slope = start.plan.slope
        taken, length, tried, trials, cuts, jumps, strayed = Trial(), 0.0, None, 0, False, False, False
        here = self._here(start)
        lengths = _Lengths(self.backtracking, shortest)
        left: Iterable[float] = lengths
        for bounds in self._bounds(start):
            cut = []
            for step in left:
                first = trials == 0
                trial, more = self._try(step, start, here, bounds)
                trials += more
                lengths.learn(step, trial.expected, slope)
                if first and (followed := self._following(trial, start, here, bounds)) is not None:
                    other, along, more = followed
                    trials += more
                    strayed = not (other.cut or other.expected < trial.expected)
                    if not strayed and other.expected <= self.armijo * along * slope:
                        return Step(along, trials, -other.expected, taken=other)
                if trial.expected <= self.armijo * step * slope and trial.expected < taken.expected:
                    taken, length = trial, step
                    if trial.expected <= _POOR * step * slope:
                        break
                    continue
                if length > 0.0:
                    break
                if trial.cut:
                    cut.append(step)
                    cuts = True
                elif trial.shares is not None:
                    tried = trial.shares
                if step <= VERY_SHORT:
                    jumps = jumps or trial.cut or _divides_others(trial, start)
            left = [step for step in cut if step > length]
            if not left or length > (VERY_SHORT if bounds.parts == _PARTS else 0.0):
                break
        if length > 0.0:
            found = Step(length, trials, -taken.expected, taken=taken, cut=cuts, jumps=jumps, strayed=strayed)
            return self._extended(found, start, here, bounds) if start.extends and length >= 1.0 else found
        hidden = 0.0
        if tried is not None:
            hidden = rounding(self.problem, start.trajectory, start.shares, tried, start.plan.model)
        return Step(trials=trials, hidden=hidden, cut=cuts, jumps=jumps, strayed=strayed)

    def _extended(self, step: Step, start: Start, here: _Here, bounds: _Bounds) -> Step:
        """A full step, or a longer one that lowers the cost further, where the full one ends early."""
        early = -_EARLY * start.plan.slope
        while step.decrease >= step.length * early and not start.overshot:
            before, length = step.length, _EXTENSION * step.length
            step = self._longer(step, length, here.commands(length, start.plan), start, here, bounds)
            if step.length == before:
                step = step._replace(overshot=before == 1.0)
                break
        motion = step.taken.motion
        if step.length == 1.0 and step.decrease >= early and start.behind is not None and motion is not None:
            commands = self._bent(start.behind, motion.trajectory(), start, here)
            step = self._longer(step, _BENT, commands, start, here, bounds)
        return step

    def _longer(
        self, step: Step, length: float, commands: Commands, start: Start, here: _Here, bounds: _Bounds
    ) -> Step:
        """A step of this length if it lowers the cost by more than ``step`` does, else that one."""
        trial = self._run(length, commands, start, here, bounds, rise=-step.decrease)
        step = step._replace(trials=step.trials + 1)
        if trial.expected < -step.decrease:
            return step._replace(length=length, decrease=-trial.expected, taken=trial)
        return step

    def _bent(self, behind: Trajectory, ahead: Trajectory, start: Start, here: _Here) -> Commands:
        """Commands of the next motion on the parabola through three, with the plan's feedback around its states."""
        problem = self.problem
        at_behind, at_ahead = (
            with_feedback(problem, motion, start.plan, closed=self.closed).reference for motion in (behind, ahead)
        )
        return here.feedback._replace(
            u=_on_parabola(problem.decided(behind), here.controls, problem.decided(ahead)),
            reference=_on_parabola(at_behind, here.feedback.reference, at_ahead),
        )

    def leap(self, start: Start, most: float) -> Step:
        """Take the longest trial along the plan that raises the expected cost by at most ``most``."""
        here, bounds = self._here(start), next(self._bounds(start))
        for trials, step in enumerate(_LEAPS, start=1):
            trial = self._run(step, here.commands(step, start.plan), start, here, bounds, rise=most)
            if trial.expected <= most:
                return Step(step, trials, -trial.expected, taken=trial)
        return Step(trials=len(_LEAPS))

    def _here(self, start: Start) -> _Here:
        added = noise_shares(self.problem, start.trajectory, start.plan)
        return _Here(
            self.problem.decided(start.trajectory),
            with_feedback(self.problem, start.trajectory, start.plan, closed=self.closed),
            added,
            start.cost + (float(added.sum()) if added.size else 0.0),
        )

    def _bounds(self, start: Start) -> Iterator[_Bounds]:
        """Bounds on trials, from tight to none."""
        integrator = self.problem.integrator
        if not (start.bounded and self._divides and isinstance(integrator, Variational)):
            yield _Bounds(integrator, np.inf, watched=False)
            return
        few = few_halvings(start.trajectory)
        for halvings, parts in ((few, _PARTS), (few + MORE_HALVINGS, _PARTS**2)):
            yield _Bounds(cut_less(integrator, halvings), parts, watched=halvings > HALVINGS)
        yield _Bounds(integrator, np.inf, watched=True)

    def _try(self, step: float, start: Start, here: _Here, bounds: _Bounds) -> tuple[Trial, int]:
        """The best trial of length ``step`` along the plan, and how many there were.

        Penalties make feedback so stiff that a motion may leave the neighbourhood of the foreseen one just for that.
        Where the decrease is not as foreseen, a trial under the foreseen controls alone follows, but not in the first
        round: its steps are large, and might lead to another local minimum.
        """
        plan = start.plan
        rise = -_DEAR * step * plan.slope
        trial = self._run(step, here.commands(step, plan), start, here, bounds, rise=rise)
        model = step * plan.slope + 0.5 * step**2 * plan.curvature
        if not (self._stiff and self.closed) or trial.expected <= AS_FORESEEN * model:
            return trial, 1
        alone = here.controls + step * foreseen(start.along, plan).moves
        commands = here.feedback._replace(u=alone, gains=np.zeros(here.feedback.gains.shape))
        other = self._run(step, commands, start, here, bounds, rise=min(trial.expected, 0.0))
        return (other if other.expected < trial.expected else trial), 2

    def _following(self, full: Trial, start: Start, here: _Here, bounds: _Bounds) -> tuple[Trial, float, int] | None:
        """The best trial that follows foreseen states, its length, and the number of trials it took.

        None where a ``full`` step is as good as foreseen, where these states do not cost clearly less than it, or where
        controls cannot follow them.
        """
        if not (start.follows and self.closed) or -full.expected >= AS_FORESEEN * start.plan.expected_decrease:
            return None
        try:
            found = self._foresight.followed(start.along, start.plan, start.shares, full.cost)
        except TRIAL_ERRORS as error:
            logger.info("%s: states of the full step: %s", self.label, error)
            return None
        if found is None:
            return None
        best, most, trials, cut = Trial(), min(full.expected, 0.0), 0, False
        for commands in found.commands:
            trial, trials = self._run(found.length, commands, start, here, bounds, rise=most), trials + 1
            cut = cut or trial.cut
            if trial.expected < best.expected:
                best, most = trial, min(trial.expected, most)
            if best.expected <= FOLLOWS * found.cost:
                break
        return best._replace(cut=cut), found.length, trials

    def _run(
        self, step: float, commands: Commands, start: Start, here: _Here, bounds: _Bounds, *, rise: float
    ) -> Trial:
        """A trial of length ``step`` under commands.

        It is stopped early where its substeps exceed bounds, or where the expected cost rises by more than ``rise``.
        """
        problem, plan = self.problem, start.plan
        # Where the rest of the cost and the noise cost cannot be negative, a partial sum bounds the total from below.
        bounded = problem.cost.nonnegative and not (start.exact and problem.processes)
        most = here.total + rise if bounded else np.inf
        parts = np.inf
        if bounds.parts < np.inf and (bounds.watched or step < 1.0):
            # Explicit methods have no substeps.
            parts = bounds.parts * max(1, int(start.trajectory.statistics.substeps[: self.trials.third].sum()))
        u = commands.u
        if plan.holds:
            u = _onto_limits(u, problem.control_limits, self._rounding)
            commands = commands._replace(u=u)
        if problem.linear:
            # The first control has no feedback: its state is given.
            commands = commands._replace(u=u[1:], before=np.clip(u[:1], *problem.control_limits))
        try:
            attempt = self.trials.attempt(
                commands, integrator=bounds.integrator, most=most + _DEARER * abs(most), parts=parts
            )
            if not attempt.whole:
                # A step that fails with few halvings may succeed with more.
                few = attempt.failure is not None and bounds.integrator != problem.integrator
                return Trial(cut=few or attempt.verdict is Watch.Verdict.cut)
            there = attempt.shares()
            noise, more, rated = 0.0, 0.0, None
            if problem.processes:
                noise = float((noise_shares(problem, attempt.trajectory(), plan) - here.added).sum())
            if start.whole:
                more, rated = self._noise_beyond(attempt.trajectory(), start)
        except TRIAL_ERRORS as error:
            logger.info("%s: trial of length %g: %s", self.label, step, error)
            return Trial()
        cost = float((there - start.shares).sum())
        if not math.isfinite(cost):
            return Trial()
        return Trial(attempt, there, cost, cost + noise + more, rated=rated)

    def _noise_beyond(self, trial: Trajectory, start: Start) -> tuple[float, Rated | None]:
        """Noise cost along a trial with the value function there, minus that with the current plan's."""
        along = Along(self.problem, trial)
        found = backward(self.problem, trial, start.rating, along=along)
        if found is None:
            return np.inf, None
        steered = self.problem.steered
        shares, held = (noise_shares(self.problem, trial, each, steered).sum() for each in (found, start.plan))
        return float(shares - held), Rated(along, found, start.rating)


def _on_parabola(behind: Floats, here: Floats, ahead: Floats) -> Floats:
    """The next point on the parabola through three at equal distances; exactly the same one where they are equal."""
    return behind + 3.0 * (ahead - here)


def _divides_others(trial: Trial, start: Start) -> bool:
    """Whether a trial divides other steps into parts than the motion."""
    if trial.motion is None:
        return False
    return not np.array_equal(trial.motion.written.tally[0, :, 3], start.trajectory.statistics.substeps)


def _at_rounding(limits: Floats) -> Floats:
    """Rounding errors of controls at their limits (2, m); (m,)."""
    rounding: Floats = 8.0 * _EPS * np.where(np.isfinite(limits), np.abs(limits), 0.0).max(axis=0)
    return rounding


def _onto_limits(u: Floats, limits: Floats, rounding: Floats) -> Floats:
    """Controls (R, m), moved exactly onto a limit where they differ from it by no more than ``rounding`` (m,)."""
    close = np.abs(u - limits[:, None]) <= rounding
    if not close.any():
        return u
    for limit, onto in zip(limits, close, strict=True):
        u = np.where(onto, limit, u)
    return u
