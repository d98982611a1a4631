"""Runs trials with integrators, and judges what comes of each."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from functools import cached_property

from battery.exact import exact_motion, period_error
from battery.scenes import TRIALS, trials_on
from battery.trial import Outcome, Setup, Trial
from varpin.integrators import Integrator
from varpin.model import Robot
from varpin.study import checks
from varpin.study.checks import LEVELS, condition, findings
from varpin.study.exact import Exact, before_step
from varpin.study.extremes import INTEGRATORS, Cell, Kind, Record, attempt, judge
from varpin.study.record import Progress, collect
from varpin.support.checks import positive

# A motion gets this long, and the plain battery half a minute at most for one [s].
_PATIENCE, _DEEP_PATIENCE = 20.0, 900.0


def run(
    robot: Robot | None = None,
    *,
    deep: bool = False,
    trials: Sequence[Trial] | None = None,
    integrators: Sequence[Integrator] | None = None,
    patience: float | None = None,
    progress: Progress | None = None,
) -> Record:
    """Run scenes at the extremes with every integrator, and judge each.

    Main args:
        robot: Run what makes sense for any robot on this one, instead of the scenes made up for it.
        deep: The long trials too: hours.

    Other Args:
        trials: These instead.
        integrators: These instead of all.
        patience: Processor time that a motion may take before it is judged by what there is [s].
        progress: Called with (cells done, cells in all).

    Raises:
        StudyInterrupted: Ctrl-C; holds what was done.
    """
    if trials is None:
        trials = TRIALS if robot is None else trials_on(robot)
        trials = [trial for trial in trials if deep or not trial.deep]
    members = INTEGRATORS if integrators is None else tuple(integrators)
    limit = positive("patience", patience or (_DEEP_PATIENCE if deep else _PATIENCE), "s")

    def cells() -> Iterator[Cell]:
        for trial in trials:
            bench = Bench(trial)
            for member in members:
                yield bench.run(member, limit)

    name = "the battery" if robot is None else robot.name
    return collect(Record((), name), cells(), len(trials) * len(members), progress)


class Bench:
    """A trial with what all integrators share of it: its setup and its exact motion."""

    def __init__(self, trial: Trial) -> None:
        self.trial = trial
        self._exact: dict[float | None, Exact | None] = {}

    def run(self, integrator: Integrator, patience: float) -> Cell:
        """The trial with one integrator."""
        trial, begin = self.trial, time.perf_counter()
        try:
            outcome = self._judge_motion(trial, integrator, patience)
        except Exception as error:
            outcome = Outcome.of_error(error, Kind.REFUSED)
        return Cell(
            trial=trial.name,
            integrator=str(integrator),
            kind=outcome.kind,
            said=outcome.said,
            found=outcome.found,
            done=outcome.done,
            steps=trial.steps,
            seconds=round(time.perf_counter() - begin, 3),
            **dict.fromkeys(LEVELS, math.nan) | outcome.measures,
        )

    @cached_property
    def _setup(self) -> Setup:
        return self.trial.build()

    def _judge_motion(self, trial: Trial, integrator: Integrator, patience: float) -> Outcome:
        setup = self._setup
        trajectory, error = attempt(
            patience, setup.scene, setup.q0, setup.v0, dt=trial.dt, steps=trial.steps,
            controls=setup.controls, increments=setup.increments, integrator=integrator,
        )  # fmt: skip
        exact, scene = self._exact_motion(trial, integrator), setup.scene
        found, period = (
            checks.measures(scene, integrator, trajectory, exact),
            period_error(scene, integrator, trajectory),
        )
        late = (f"period {period:.2g} (wrong from 1)",) if period >= 1.0 else ()
        wrong = (*findings(found, integrator, condition(scene, setup.q0)), *late)
        kind, said, wrong = judge(trajectory, error, wrong)
        return Outcome(kind, found, said, wrong, trajectory.steps)

    def _exact_motion(self, trial: Trial, integrator: Integrator) -> Exact | None:
        """The exact motion, computed once; None where even that cannot be integrated."""
        left = 1.0 if self._setup.increments is None else before_step(integrator)
        if left not in self._exact:
            self._exact[left] = exact_motion(self._setup, trial.dt, trial.steps, trial.window, left=left)
        return self._exact[left]
