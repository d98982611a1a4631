"""Many paths of a scene under one signal, in chunks: their simulation, the checks of a few, and what comes of them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.core.arrays import Commands
from varpin.ensemble.record import PathFailure, PathsInterrupted
from varpin.errors import InputError, VarpinError, WorkersLost
from varpin.finding import Finding
from varpin.integrators import Integrator, Segment
from varpin.mechanics.constraints import CustomConstraintError
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.noise import NoiseFieldError
from varpin.mechanics.scene import Scene
from varpin.mechanics.wiener import Children
from varpin.signals.commands import as_moved, lines, rows, with_ends
from varpin.simulation.check import Case, check
from varpin.simulation.loop import Gains, unstable_loop
from varpin.simulation.record import Motions
from varpin.support.checks import told_motion
from varpin.support.executors import executing, in_order, take_all
from varpin.support.frozen import Frozen

# By quantity ("split", "energy", "speed"): its largest value, and the path that has it.
Extremes = dict[str, tuple[float, int]]
# What is made of the arrays of C paths (C, ...), NaN after a failure, whose numbers of nodes are (C,).
Reduction = Callable[[dict[str, Floats], Integers], Any]

# Paths in one call of the core.
_GROUP = 32
# A worker simulates one chunk of paths at a time. Its size depends on the ensemble alone, so that sums do not depend on
# the number of workers: the number of chunks aimed at, then bounds of a chunk in steps and in paths.
_CHUNKS, _LEAST_STEPS, _MOST_STEPS, _FEWEST_PATHS, _MOST_PATHS = 64, 4_000, 200_000, 16, 1024


def without_geometry(scene: Scene) -> Scene:
    """The scene without its robot's shapes: no simulation needs them, and meshes are large to send to a worker."""
    return scene.changed(robot=replace(scene.robot, visuals=None, parts=()))


@dataclass(frozen=True, eq=False)
class Shared(Frozen):
    """The data that all paths of an ensemble share."""

    scene: Scene
    integrator: Integrator
    commands: Commands  # of all steps
    dt: float
    steps: int
    seeds: Children  # one child of the random generator for each path

    @property
    def linear(self) -> bool:
        """Whether controls are linear between nodes."""
        return len(self.commands.stage_times) > 0

    @property
    def second(self) -> str:
        """The name of the second half of x."""
        return "p" if self.integrator.variational else "v"

    def chunks(self, paths: int) -> Iterator[tuple[int, int]]:
        """The first path of each chunk, and one past its last."""
        steps = max(1, self.steps)
        size = min(max(math.ceil(paths / _CHUNKS), _LEAST_STEPS // steps), _MOST_STEPS // steps, _MOST_PATHS)
        size = max(size, _FEWEST_PATHS) if size <= _GROUP else math.ceil(size / _GROUP) * _GROUP
        # Paths whose noise Python evaluates are slow: single ones for Ctrl-C and progress.
        size = 1 if self.scene.noise.own else size
        return ((first, min(first + size, paths)) for first in range(0, paths, size))

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of an array of one path."""
        m, nodes = self.scene.controls, self.steps + 1
        own = {"energy": (nodes,), "u": (self.steps, m), "u_nodes": (nodes, m)}
        return own.get(name, (nodes, self.scene.robot.dof))

    def drawn(self, first: int, last: int) -> Floats:
        """The increments (P, N, K) of some paths."""
        found = np.empty((last - first, self.steps, self.scene.increments(linear=self.linear)))
        for own, child in zip(found, self.seeds.generators(first, last), strict=True):
            child.standard_normal(out=own)
        found *= np.sqrt(self.dt)
        return found


@dataclass(frozen=True, eq=False)
class Task(Frozen):
    """A chunk of C paths to simulate, and what to make of them."""

    shared: Shared
    first: int  # index of the first path
    q0: Floats  # (C, n) [rad or m]
    v0: Floats  # (C, n) [rad/s or m/s]
    names: tuple[str, ...]  # of the arrays that are needed
    reduce: Reduction


@dataclass(frozen=True, eq=False)
class Part(Frozen):
    """Results of a chunk of C paths."""

    first: int  # index of its first path
    paths: int  # C
    failures: tuple[PathFailure, ...]
    extremes: Extremes
    found: Any  # what the task makes of the paths


def simulate_paths(task: Task) -> Part:
    """Simulate a chunk in one thread. The bytes of a path do not depend on the chunk that it is in."""
    shared, P = task.shared, len(task.q0)
    names = dict.fromkeys(["q", shared.second, "energy", *task.names])
    arrays = {name: np.full((P, *shared.shape(name)), np.nan) for name in names}
    nodes, split = np.ones(P, dtype=np.int64), np.zeros(P)
    failures = []
    for first in range(0, P, _GROUP):
        group = slice(first, min(first + _GROUP, P))
        starts, segments = _segments(task, group)
        for path, (start, segment) in enumerate(zip(starts, segments, strict=True), first):
            _store({name: array[path] for name, array in arrays.items()}, shared, start, segment)
            nodes[path] += len(segment.q)
            split[path] = segment.statistics.substeps.sum() - len(segment.q)
            if segment.failure is not None:
                failures.append(PathFailure(task.first + path, len(segment.q), segment.failure.reason))
    extremes = {}
    for name, values in (("split", split), ("energy", arrays["energy"]), ("speed", np.abs(arrays[shared.second]))):
        most = np.fmax.reduce(values.reshape(P, -1), axis=1, initial=-np.inf)
        extremes[name] = float(most.max()), task.first + int(np.argmax(most))
    return Part(task.first, P, tuple(failures), extremes, task.reduce(arrays, nodes))


def _segments(task: Task, group: slice) -> tuple[list[Segment], list[Segment]]:
    """The first node of each path of a group, and its steps, by one call of the core."""
    shared, first, last = task.shared, task.first + group.start, task.first + group.stop
    state, starts = shared.integrator.start(shared.scene, task.q0[group], task.v0[group])
    if not shared.steps:
        return starts, [start.part(0) for start in starts]
    before = np.repeat(shared.commands.before, last - first, axis=0)
    decisions = rows(shared.commands, 0, shared.steps // shared.commands.hold, before)
    try:
        return starts, shared.integrator.rollout(shared.scene, state, decisions, shared.drawn(first, last), shared.dt)
    except (CustomForceError, CustomConstraintError, NoiseFieldError) as error:
        raise _located(task, range(first, last), error) from error


def _located(task: Task, paths: range, error: InputError) -> VarpinError:
    """The error of a user's function, with the path and the step where it failed and the motion up to there."""
    shared = task.shared
    for path in paths:
        start = task.q0[path - task.first], task.v0[path - task.first]
        (drawn,) = shared.drawn(path, path + 1)
        motions = Motions(shared.scene, shared.integrator, *start, shared.dt)
        found = motions.located(shared.commands, drawn, error, f"path {path}: ")
        if found is not error:
            return found
    return error


def _store(path: dict[str, Floats], shared: Shared, start: Segment, segment: Segment) -> None:
    """Copy the nodes and the controls of a path into its arrays."""
    steps = len(segment.q)
    for name in path.keys() & {"q", "v", "p", "energy"}:
        path[name][:1], path[name][1 : steps + 1] = getattr(start, name), getattr(segment, name)
    if "u" in path or "u_nodes" in path:
        u = after = segment.u[:steps]
        if shared.linear:
            mean, _, after = lines(shared.commands, u, ())
            u = with_ends(shared.scene, mean, u)
        elif shared.scene.inputs and shared.commands.hold > 1:
            # The controls of kinematic inputs are their positions at the ends of steps.
            u = as_moved(shared.scene, segment.q[:steps], segment.v[:steps], u)
        for name, values in (("u", u), ("u_nodes", after)):
            if name in path:
                path[name][: len(values)] = values


def examine(task: tuple[Shared, int, Floats, Floats]) -> tuple[Finding, ...]:
    """Findings about one path, from its index and its state at the start."""
    shared, path, q0, v0 = task
    (drawn,) = shared.drawn(path, path + 1)
    motion, _ = Motions(shared.scene, shared.integrator, q0, v0, shared.dt).under(shared.commands, increments=drawn)
    # The loop's check is for held controls.
    held = len(shared.commands.gains) and not shared.linear
    gains = Gains(shared.commands.gains, shared.scene if shared.integrator.variational else None)
    loop = unstable_loop(shared.scene, motion, shared.commands.hold, gains) if held else ()
    case = Case(shared.scene, shared.integrator, motion, shared.commands if held else None)
    return (*loop, *check(case).warnings)


class Paths(ABC):
    """What P paths from (q0, v0) (P, n) have shown so far, in their order."""

    def __init__(self, shared: Shared, q0: Floats, v0: Floats) -> None:
        self.shared, self.q0, self.v0 = shared, q0, v0
        self.done = 0
        self.failures: list[PathFailure] = []
        self.extremes: Extremes = {}

    @abstractmethod
    def reduction(self, first: int) -> tuple[tuple[str, ...], Reduction]:
        """The names of the arrays that the chunk from path ``first`` on needs, and what to make of them."""

    @abstractmethod
    def take(self, part: Part) -> None:
        """Take what was made of the next chunk."""

    @abstractmethod
    def result(self, found: tuple[Finding, ...]) -> Any:
        """The record of the paths so far, with findings as its warnings; None if they are too few."""

    def part_bytes(self) -> int:
        """Size of what is made of a chunk [bytes], where it is large."""
        return 0

    def tasks(self) -> Iterator[Task]:
        """The chunks."""
        for first, last in self.shared.chunks(len(self.q0)):
            start = self.q0[first:last].copy(), self.v0[first:last].copy()
            yield Task(self.shared, first, *start, *self.reduction(first))

    def add(self, part: Part) -> None:
        """Add the next chunk. One after a gap, which Ctrl-C may leave, is not added."""
        if part.first != self.done:
            return
        self.take(part)
        self.failures += part.failures
        for name, found in part.extremes.items():
            self.extremes[name] = max(self.extremes.get(name, found), found, key=lambda x: x[0])
        self.done += part.paths

    def executing(self, executor: Executor | None, workers: int | None) -> AbstractContextManager[Executor]:
        """The workers; one thread by default for functions in Python, which need not be thread-safe."""
        python = bool(self.shared.scene.noise.own)
        return executing(executor, 1 if python and executor is None and workers is None else workers)

    def simulate(self, pool: Executor, progress: Callable[[int, int], None] | None = None) -> None:
        """Simulate all paths."""
        with closing(in_order(pool, simulate_paths, self.tasks(), result_bytes=self.part_bytes())) as parts:
            take_all(parts, self.add, lambda: None if progress is None else progress(self.done, len(self.q0)))

    def run(
        self, executor: Executor | None, workers: int | None, progress: Callable[[int, int], None] | None
    ) -> tuple[Finding, ...]:
        """Simulate all paths; findings about them.

        Raises:
            PathsInterrupted, WorkersLost: They hold the :meth:`result` of the paths so far.
        """
        told_motion("progress", progress, "paths done, paths in all")
        with self.executing(executor, workers) as pool:
            try:
                self.simulate(pool, progress)
                return (*self.lost(), *self.findings(pool))
            except (KeyboardInterrupt, WorkersLost) as stop:
                found: tuple[Finding, ...] = ()
                # The workers may have stopped; a second Ctrl-C leaves the examination out.
                with suppress(KeyboardInterrupt):
                    found = self.findings(None)
                kept = self.result((*self.lost(), *found)) if self.done else None
                if isinstance(stop, WorkersLost):
                    raise WorkersLost(stop.__cause__, kept) from stop.__cause__
                raise PathsInterrupted(kept, self.done) from None

    def findings(self, pool: Executor | None) -> tuple[Finding, ...]:
        """Findings about a few paths, each kind once, of the path with the largest value; without a pool here.

        They are the first path, and those with the most split steps, the most energy and the largest speed.
        """
        if not (self.shared.steps and self.done):
            return ()
        split = [path for amount, path in (self.extremes["split"],) if amount > 0]
        some = dict.fromkeys([0, *split, self.extremes["energy"][1], self.extremes["speed"][1]])
        tasks = [(self.shared, path, self.q0[path].copy(), self.v0[path].copy()) for path in some]
        kept: dict[str, Finding] = {}
        with closing((examine(task) for task in tasks) if pool is None else in_order(pool, examine, tasks)) as results:
            for path, findings in zip(some, results, strict=True):
                for finding in findings:
                    known = kept.get(finding.kind)
                    if known is None or (finding.value or 0.0) > (known.value or 0.0):
                        kept[finding.kind] = finding.about(f"path {path}: ")
        return tuple(kept.values())

    def lost(self) -> tuple[Finding, ...]:
        """A finding about failed paths, if there are any."""
        if not self.failures:
            return ()
        return (Finding("failed paths", f"{self.failing()}; they are left out of the statistics from there on"),)

    def failing(self) -> str:
        """The number of failed paths and the earliest failure, in words."""
        first = min(self.failures, key=lambda failure: failure.step)
        return f"{len(self.failures)} of {self.done} paths failed, the first at step {first.step}: {first.reason}"
