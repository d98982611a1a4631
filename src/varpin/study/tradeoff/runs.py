"""Runs of different integrators at different steps, and their measurement, which an interruption does not lose."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Hashable, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from varpin.study.tradeoff.records import RunTable

Job = TypeVar("Job")
Key = TypeVar("Key", bound=Hashable)
Made = TypeVar("Made", bound="Tradeoff")
Progress = Callable[[int, int], None]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Run:
    """An integrator at one step. Its measures are NaN where it failed.

    Attributes:
        integrator: As text.
        options: The same with every option: what a resumed record knows it by.
        order: Of its error in dt.
        dt: Time step [s].
        steps: N.
        seconds: Wall time, the best of the repetitions [s].
        spread: Distance of the median of the repetitions from the best [s].
        failure: Reason of a failure; empty if there is none.
    """

    integrator: str
    options: str
    order: int
    dt: float
    steps: int
    seconds: float
    spread: float
    failure: str

    @property
    def survived(self) -> bool:
        """Whether it got to the end."""
        return not self.failure

    @property
    def key(self) -> Hashable:
        """Identity of the run in its record."""
        return self.options, self.steps


@dataclass(frozen=True, eq=False)
class Tradeoff(RunTable):
    """Runs of one motion or one problem.

    Attributes:
        runs: In the order of the integrators, each from its largest step down.
        robot: The robot's name.
        duration: Of the motion [s].
        missing: Runs that an interruption left out.
        fingerprint: Of all that the runs depend on, the integrators and steps apart.
    """

    runs: tuple[Any, ...]
    robot: str
    duration: float
    missing: int = field(default=0, kw_only=True)
    fingerprint: str = field(default="", kw_only=True)

    def __repr__(self) -> str:
        lost = sum(not run.survived for run in self.runs)
        notes = (f", {lost} failed" if lost else "") + (f", {self.missing} missing" if self.missing else "")
        return f"{type(self).__name__}({self.robot}: {len(self.runs)} runs{notes})"


def complete(
    record: Made,
    plan: Mapping[Key, Job],
    begin: Callable[[Made, list[Job]], tuple[Made, Generator[Run]]],
    *,
    path: Path | None,
    progress: Progress | None,
) -> Made:
    """Add the runs of a plan to a record, except those that it holds already; Ctrl-C ends it with what is done.

    Args:
        record: The earlier runs, which stay in it.
        plan: What to measure, by the key of its run.
        begin: Takes the record and what is missing of the plan; gives the record with the facts that a measurement
            needs first, and the runs, one at a time, in the order of the plan.
        path: The record is saved there after each run.
        progress: Called with (runs done, runs in all) after each.
    """
    done = {run.key: run for run in record.runs}
    kept = tuple(run for key, run in done.items() if key not in plan)

    def current() -> Made:
        runs = [done[key] for key in plan if key in done]
        return replace(record, runs=(*kept, *runs), missing=len(plan) - len(runs))

    try:
        todo = [job for key, job in plan.items() if key not in done]
        record, measured = begin(record, todo) if todo else (record, _none())
        with closing(measured):
            for finished, key in enumerate(plan, 1):
                if key not in done:
                    done[key] = next(measured)
                if path is not None:
                    current().save(path)
                if progress is not None:
                    progress(finished, len(plan))
    except KeyboardInterrupt:
        logger.warning("interrupted after %d of %d runs, which are kept", len(plan) - current().missing, len(plan))
    return current()


def _none() -> Generator[Run]:
    yield from ()
