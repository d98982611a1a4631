"""Warnings about single paths of an ensemble: its extreme paths are simulated again and examined."""

from __future__ import annotations

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


def findings_of_paths(
    shared: Shared, q0: Floats, v0: Floats, extremes: Extremes, pool: Executor | None
) -> tuple[Finding, ...]:
    """Findings about a few paths, each kind once, for the path with the largest value; without a pool in this thread.

    Of many paths they are the first, and those with the most split steps, the most energy and the largest speed.
    """
    if not shared.steps:
        return ()
    split = [path for amount, path in (extremes["split"],) if amount > 0]
    some = [0, *split, extremes["energy"][1], extremes["speed"][1]] if len(q0) > _ALL_EXAMINED else range(len(q0))
    tasks = [Task(shared, path, q0[path : path + 1].copy(), v0[path : path + 1].copy()) for path in dict.fromkeys(some)]
    found: dict[str, Finding] = {}
    results = (_examine(task) for task in tasks) if pool is None else in_order(pool, _examine, tasks)
    with closing(results) as results:
        for task, findings in zip(tasks, results, strict=True):
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
