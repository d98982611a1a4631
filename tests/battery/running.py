"""Runs trials with integrators, and judges what comes of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, partial

from battery.exact import exact_motion, period_error
from battery.scenes import TRIALS, trials_on
from battery.trial import Setup, Trial
from varpin.integrators import Integrator
from varpin.model import Robot
from varpin.study import checks
from varpin.study.exact import Exact, before_step
from varpin.study.extremes import INTEGRATORS, Cell, Motion, Record, cell
from varpin.study.record import Progress, collect
from varpin.support.checks import positive
from varpin.trajectory import Trajectory

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
            build = cache(partial(Bench.of, trial))
            for member in members:
                yield cell(trial.name, build, member, limit)

    name = "the battery" if robot is None else robot.name
    return collect(Record((), name), cells(), len(trials) * len(members), progress)


@dataclass(frozen=True, eq=False)
class Bench(Motion):
    """The motion of a trial; its exact motion is in closed form where there is one, and it is compared all over."""

    setup: Setup
    known: dict[float | None, Exact | None] = field(default_factory=dict)

    @classmethod
    def of(cls, trial: Trial) -> Bench:
        """A trial; may raise varpin's refusal of it."""
        setup = trial.build()
        state = setup.scene, setup.q0, setup.v0, setup.controls, setup.increments, setup.shift
        return cls(trial.name, trial.dt, trial.steps, *state, trial.window, setup)

    def measures(self, integrator: Integrator, trajectory: Trajectory) -> dict[str, float]:
        """And the error from nodes all over, in units of what is wrong."""
        left = 1.0 if self.increments is None else before_step(integrator)
        if left not in self.known:
            self.known[left] = exact_motion(self.setup, self.dt, self.steps, self.window, left=left)
        found = checks.measures(self.scene, integrator, trajectory, self.known[left])
        return found | {"period": period_error(self.scene, integrator, trajectory)}
