"""Warnings about single paths of an ensemble: its extreme paths are simulated again and examined."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from contextlib import closing

from varpin.arrays import Floats
from varpin.ensemble.paths import Extremes, Shared, Task
from varpin.finding import Finding
from varpin.simulation.check import check
from varpin.simulation.loop import unstable_loop
from varpin.simulation.record import Motions
from varpin.support.executors import in_order

# Up to this number of paths, every path is examined.
_ALL_EXAMINED = 10


def greater(one: Extremes, other: Extremes) -> Extremes:
    """The greater of each extreme; ``one`` where both are equal."""
    return {name: max(one.get(name, found), found, key=lambda x: x[0]) for name, found in other.items()}


def looked_at(pool: Executor, shared: Shared, q0: Floats, v0: Floats, extremes: Extremes) -> tuple[Finding, ...]:
    """Findings about a few paths: each kind once, for the path with the largest value."""
    tasks = _examined(shared, q0, v0, extremes)
    with closing(in_order(pool, _examine, tasks)) as findings:
        return _worst_of_each_kind(tasks, findings)


def looked_at_here(shared: Shared, q0: Floats, v0: Floats, extremes: Extremes) -> tuple[Finding, ...]:
    """:func:`looked_at` after Ctrl-C, without the workers, which may have stopped; empty after a second Ctrl-C."""
    tasks = _examined(shared, q0, v0, extremes)
    try:
        return _worst_of_each_kind(tasks, map(_examine, tasks))
    except KeyboardInterrupt:
        return ()


def _examined(shared: Shared, q0: Floats, v0: Floats, extremes: Extremes) -> list[Task]:
    """The paths to examine, one a task."""
    if not shared.steps:
        return []
    if len(q0) <= _ALL_EXAMINED:
        paths = list(range(len(q0)))
    else:
        split = [path for amount, path in (extremes["split"],) if amount > 0]
        paths = list(dict.fromkeys([0, *split, extremes["energy"][1], extremes["speed"][1]]))
    return [Task(shared, path, q0[path : path + 1].copy(), v0[path : path + 1].copy()) for path in paths]


def _worst_of_each_kind(tasks: Sequence[Task], findings_of_tasks: Iterable[tuple[Finding, ...]]) -> tuple[Finding, ...]:
    found: dict[str, Finding] = {}
    for task, findings in zip(tasks, findings_of_tasks, strict=True):
        for finding in findings:
            kept = found.get(finding.kind)
            if kept is None or (finding.value or 0.0) > (kept.value or 0.0):
                found[finding.kind] = finding.about(f"path {task.first}: ")
    return tuple(found.values())


def _examine(task: Task) -> tuple[Finding, ...]:
    """Findings about one path."""
    shared = task.shared
    (generator,) = shared.seeds.generators(task.first, task.first + 1)
    drawn = shared.drawn(generator)
    motions = Motions(shared.scene, shared.integrator, task.q0[0], task.v0[0], shared.dt)
    motion, _ = motions.under(shared.commands, increments=drawn)
    # The loop's check is for held controls.
    held = len(shared.commands.gains) and not len(shared.commands.stage_times)
    loop = unstable_loop(shared.scene, motion, shared.commands.hold) if held else ()
    return (*loop, *check(shared.scene, shared.integrator, motion, shared.commands if held else None).warnings)
