"""A second look at the paths of an ensemble that stand out: what is to be said of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from contextlib import closing

import numpy as np
from numpy.typing import NDArray

from varpin.ensemble.paths import Extremes, Shared, Task
from varpin.simulation.loop_stability import examined_in_loop
from varpin.simulation.run import Motions
from varpin.simulation.soundness import Finding
from varpin.support.executors import in_order

Floats = NDArray[np.float64]

# So few paths are all looked at once more.
_ALL_LOOKED_AT = 10


def greater(one: Extremes, other: Extremes) -> Extremes:
    """Of each extreme the greater, of equal ones that of ``one``."""
    return {name: max(one.get(name, found), found, key=lambda x: x[0]) for name, found in other.items()}


def looked_at(pool: Executor, shared: Shared, q0: Floats, v0: Floats, extremes: Extremes) -> tuple[Finding, ...]:
    """What is to be said of a few paths, each kind of finding once, of the first path that shows it."""
    tasks = _looks(shared, q0, v0, extremes)
    with closing(in_order(pool, _look, tasks)) as looks:
        return _found(tasks, looks)


def looked_at_here(shared: Shared, q0: Floats, v0: Floats, extremes: Extremes) -> tuple[Finding, ...]:
    """The same after an interruption, without workers, which it may have reached too; nothing after another one."""
    tasks = _looks(shared, q0, v0, extremes)
    try:
        return _found(tasks, map(_look, tasks))
    except KeyboardInterrupt:
        return ()


def _looks(shared: Shared, q0: Floats, v0: Floats, extremes: Extremes) -> list[Task]:
    """The paths that are worth a look, each by itself."""
    if not shared.steps:
        return []
    if len(q0) <= _ALL_LOOKED_AT:
        paths = list(range(len(q0)))
    else:
        split = [path for amount, path in (extremes["split"],) if amount > 0]
        paths = list(dict.fromkeys([0, *split, extremes["energy"][1], extremes["speed"][1]]))
    return [Task(shared, path, q0[path : path + 1].copy(), v0[path : path + 1].copy()) for path in paths]


def _found(tasks: Sequence[Task], looks: Iterable[tuple[Finding, ...]]) -> tuple[Finding, ...]:
    found: dict[str, Finding] = {}
    for task, findings in zip(tasks, looks, strict=True):
        for finding in findings:
            found.setdefault(finding.kind, Finding(finding.kind, f"path {task.first}: {finding.sentence}"))
    return tuple(found.values())


def _look(task: Task) -> tuple[Finding, ...]:
    """What is to be said of one path."""
    shared = task.shared
    (generator,) = shared.seeds.generators(task.first, task.first + 1)
    drawn = generator.standard_normal((shared.steps, shared.scene.processes)) * np.sqrt(shared.dt)
    motions = Motions(shared.scene, shared.integrator, task.q0[0], task.v0[0], shared.dt)
    motion, _ = motions.under(shared.commands, increments=drawn)
    hold = shared.commands.hold if len(shared.commands.gains) else None
    return examined_in_loop(shared.scene, shared.integrator, motion, hold)[1]
