"""The work of one worker: the simulation of a chunk of paths and its statistics."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.core.arrays import Commands
from varpin.ensemble.record import PathFailure
from varpin.errors import VarpinError
from varpin.integrators import Integrator, Segment
from varpin.integrators.base import Failure
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.scene import Scene
from varpin.mechanics.wiener import Children
from varpin.signals.commands import as_moved, lines, rows, with_ends
from varpin.simulation.record import located
from varpin.support.frozen import Frozen

# By quantity ("split", "energy", "speed"): its largest value, and the path that has it.
Extremes = dict[str, tuple[float, int]]

# Paths in one call of the core.
_GROUP = 32
# Numbers in a block of nodes.
_BLOCK = 1_000_000
# A worker simulates one chunk of paths at a time. The size of a chunk depends on the ensemble alone, so that sums do
# not depend on the number of workers: the number of chunks aimed at, then bounds of a chunk in steps and in paths.
_CHUNKS, _LEAST_STEPS, _MOST_STEPS, _FEWEST_PATHS, _MOST_PATHS = 64, 4_000, 200_000, 16, 1024


def without_geometry(scene: Scene) -> Scene:
    """The scene without its robot's shapes: no simulation needs them, and meshes are large to send to a worker."""
    if scene.robot.visuals is None and not scene.robot.parts:
        return scene
    bare = copy.copy(scene)
    vars(bare)["robot"] = dataclasses.replace(scene.robot, visuals=None, parts=())
    return bare


def chunk_size(steps: int, paths: int) -> int:
    """The number of paths of a whole chunk."""
    steps = max(1, steps)
    size = max(math.ceil(paths / _CHUNKS), _LEAST_STEPS // steps)
    size = max(_FEWEST_PATHS, min(size, _MOST_STEPS // steps, _MOST_PATHS))
    if size > _GROUP:
        size = math.ceil(size / _GROUP) * _GROUP
    return size


def chunks(steps: int, paths: int) -> Iterator[tuple[int, int]]:
    """The first path of each chunk, and one past its last.

    The first is small and each twice as large as the one before, up to the whole size: some paths are finished soon.
    """
    size, first = chunk_size(steps, paths), 0
    now = min(size, max(1, _LEAST_STEPS // max(1, steps)))
    while first < paths:
        last = min(first + now, paths)
        yield first, last
        first, now = last, min(2 * now, size)


@dataclass(frozen=True, eq=False)
class Shared(Frozen):
    """The data that all paths of an ensemble share.

    Attributes:
        scene: The scene.
        integrator: The integrator.
        commands: Commands of all steps.
        dt: Time step [s].
        steps: N.
        seeds: One child of the random generator for each path.
    """

    scene: Scene
    integrator: Integrator
    commands: Commands
    dt: float
    steps: int
    seeds: Children

    @property
    def increments(self) -> int:
        """K, the number of increments of a step."""
        return self.scene.increments(linear=len(self.commands.stage_times) > 0)

    def drawn(self, generator: np.random.Generator) -> Floats:
        """The increments (N, K) of the path of a generator."""
        found: Floats = generator.standard_normal((self.steps, self.increments)) * np.sqrt(self.dt)
        return found


@dataclass(frozen=True, eq=False)
class Task(Frozen):
    """A chunk of C paths to simulate, and which results to return.

    Attributes:
        shared: The data that all paths share.
        first: Index of the first path.
        q0: Initial configurations (C, n) [rad or m].
        v0: Initial velocities (C, n) [rad/s or m/s].
        store: Whether to return the paths themselves.
        moments: Whether to return their moments.
        values: Whether to return their states, node by node.
    """

    shared: Shared
    first: int
    q0: Floats
    v0: Floats
    store: bool = False
    moments: bool = True
    values: bool = False


@dataclass(frozen=True, eq=False)
class Moments(Frozen):
    """Sums over some paths at each of N + 1 nodes.

    Attributes:
        count: Number of paths (N + 1,).
        mean: Mean of x and of the energy (N + 1, 2n + 1).
        squares: Sums of products of the deviations of x from its mean (N + 1, 2n, 2n).
        energy: Sums of squared deviations of the energy from its mean (N + 1,).
    """

    count: Integers
    mean: Floats
    squares: Floats
    energy: Floats

    # Paths that blow up may have squares that are infinite.
    @np.errstate(over="ignore", invalid="ignore")
    def merged(self, other: Moments) -> Moments:
        """Sums over the paths of both (Chan, Golub and LeVeque 1979)."""
        total = self.count + other.count
        share = other.count / np.maximum(total, 1)
        apart = other.mean - self.mean
        weight, x = self.count * share, apart[:, :-1]
        return Moments(
            total,
            self.mean + apart * share[:, None],
            self.squares + other.squares + (weight[:, None] * x)[:, :, None] * x[:, None, :],
            self.energy + other.energy + weight * apart[:, -1] ** 2,
        )


@dataclass(frozen=True, eq=False)
class Part(Frozen):
    """Results of a chunk; those that the task does not ask for are None or empty.

    Attributes:
        first: Index of its first path.
        paths: C.
        failures: Paths that stopped early.
        extremes: The most split steps, the largest energy and the largest speed, each with its path.
        nodes: Number of nodes of each path (C,).
        moments: Moments of the paths.
        stored: Arrays of the paths by name, (C, ...).
        values: x by node (N + 1, 2n, C), NaN after a failure.
    """

    first: int
    paths: int
    failures: tuple[PathFailure, ...]
    extremes: Extremes
    nodes: Integers
    moments: Moments | None
    stored: dict[str, Floats]
    values: Floats | None


def simulate_paths(task: Task) -> Part:
    """Simulate a chunk in one thread. The bytes of a path do not depend on the chunk that it is in."""
    return _Chunk(task).part()


class _Chunk:
    """Paths in groups. A group has one integrator state; all groups advance by one block of nodes at a time."""

    def __init__(self, task: Task) -> None:
        self.task, shared = task, task.shared
        self.shared, self.paths = shared, len(task.q0)
        n, m, N = shared.scene.robot.dof, shared.scene.controls, shared.steps
        self.groups = [slice(a, min(a + _GROUP, self.paths)) for a in range(0, self.paths, _GROUP)]
        self.generators = shared.seeds.generators(task.first, task.first + self.paths)
        # The previous control of each path; NaN before the first unless the policy gives one.
        self.before = [np.repeat(shared.commands.before, group.stop - group.start, axis=0) for group in self.groups]
        # Whether controls are linear between nodes; the stored ones of steps are then their means.
        self.linear = len(shared.commands.stage_times) > 0
        self.alive = np.ones(self.paths, dtype=bool)
        self.nodes = np.zeros(self.paths, dtype=np.int64)
        self.split = np.zeros(self.paths, dtype=np.int64)
        self.most_energy, self.fastest = np.full((2, self.paths), -np.inf)
        self.failures: list[PathFailure] = []
        block = max(1, _BLOCK // (self.paths * (2 * n + 1)) // shared.commands.hold) * shared.commands.hold
        self.length = min(N, block)
        # Nodes of a block; the paths are the last axis, over which statistics run.
        self.block = np.empty((max(1, self.length), 2 * n + 1, self.paths))
        self.moments = None
        if task.moments:
            self.moments = Moments(
                np.zeros(N + 1, np.int64),
                np.zeros((N + 1, 2 * n + 1)),
                np.zeros((N + 1, 2 * n, 2 * n)),
                np.zeros(N + 1),
            )
        self.values = np.empty((N + 1, 2 * n, self.paths)) if task.values else None
        self.stored: dict[str, Floats] = {}
        if task.store:
            self.stored = {name: np.full((self.paths, N + 1, n), np.nan) for name in ("q", "v", "p")}
            self.stored |= {"energy": np.full((self.paths, N + 1), np.nan), "u": np.full((self.paths, N, m), np.nan)}
            if self.linear:
                self.stored["u_nodes"] = np.full((self.paths, N + 1, m), np.nan)
                self.stored["u_nodes"][:, 0] = shared.commands.before

    def part(self) -> Part:
        """Simulate all steps."""
        task, shared = self.task, self.shared
        states = []
        for group, before in zip(self.groups, self.before, strict=True):
            state, first = shared.integrator.start(shared.scene, task.q0[group], task.v0[group])
            states.append(state)
            self._store(0, group, first, [1] * len(first), before)
        self._reduce(0, np.ones(self.paths, dtype=np.int64))
        for begin in range(0, shared.steps, max(1, self.length)):
            end = min(shared.steps, begin + self.length)
            done = np.concatenate(
                [self._run_group(number, states[number], begin, end) for number in range(len(self.groups))]
            )
            self._reduce(begin + 1, done)
        extremes = {
            name: (float(values.max()), task.first + int(np.argmax(values)))
            for name, values in (("split", self.split), ("energy", self.most_energy), ("speed", self.fastest))
        }
        return Part(
            first=task.first,
            paths=self.paths,
            failures=tuple(self.failures),
            extremes=extremes,
            nodes=self.nodes,
            moments=self.moments,
            stored=self.stored,
            values=self.values,
        )

    def _run_group(self, number: int, state: object, begin: int, end: int) -> Integers:
        """Simulate steps begin .. end of a group; the number of steps of each path, 0 for one that has failed."""
        shared, group = self.shared, self.groups[number]
        hold = shared.commands.hold
        decisions = rows(shared.commands, begin // hold, end // hold, self.before[number])
        increments = np.empty((group.stop - group.start, end - begin, shared.increments))
        for drawn, child in zip(increments, self.generators[group], strict=True):
            child.standard_normal(out=drawn)
        increments *= np.sqrt(shared.dt)
        try:
            segments = shared.integrator.rollout(shared.scene, state, decisions, increments, shared.dt)
        except CustomForceError as error:
            raise self._located(group, error) from error
        alive = self.alive[group]
        done = [len(segment.q) * int(still) for segment, still in zip(segments, alive, strict=True)]
        self._store(begin + 1, group, segments, done, self.before[number])
        lost = np.full(shared.scene.controls, np.nan)
        self.before[number] = np.array([segment.u[-1] if len(segment.u) else lost for segment in segments])
        for i, (k, segment) in enumerate(zip(done, segments, strict=True)):
            if not alive[i]:
                continue
            self.split[group.start + i] += int(segment.statistics.substeps.sum()) - k
            if segment.failure is not None:
                self._fail(group.start + i, begin + k, segment.failure)
        return np.array(done, dtype=np.int64)

    def _located(self, group: slice, error: CustomForceError) -> VarpinError:
        """The error of a custom force, with the path and the step where it failed and the motion up to there."""
        shared, task = self.shared, self.task
        for i in range(group.start, group.stop):
            (generator,) = shared.seeds.generators(task.first + i, task.first + i + 1)
            drawn = shared.drawn(generator)
            given = shared.scene, shared.integrator, (task.q0[i], task.v0[i]), shared.commands, shared.dt
            found = located(*given, drawn, error, f"path {task.first + i}: ")
            if found is not error:
                return found
        return error

    def _fail(self, path: int, step: int, failure: Failure) -> None:
        self.alive[path] = False
        self.failures.append(PathFailure(self.task.first + path, step, failure.reason))

    def _store(self, first: int, group: slice, segments: list[Segment], done: list[int], before: Floats) -> None:
        """Store nodes of a group from node ``first`` on, ``done[i]`` of its i-th path after its control ``before``."""
        n, momentum = self.shared.scene.robot.dof, self.shared.integrator.variational
        self.nodes[group] += done
        for i, (segment, k) in enumerate(zip(segments, done, strict=True), group.start):
            x = self.block[:, :, i]
            x[:k, :n], x[:k, n:-1] = segment.q[:k], (segment.p if momentum else segment.v)[:k]
            x[:k, -1] = segment.energy[:k]
            if k < len(x):
                x[k:] = np.nan
            for name, array in self.stored.items():
                if name in ("q", "v", "p", "energy"):
                    array[i, first : first + k] = getattr(segment, name)[:k]
            if self.stored and first > 0:
                # The control of the step to node k is in row k - 1.
                mean, after = self._controls(segment, k, before[i - group.start : i - group.start + 1])
                self.stored["u"][i, first - 1 : first - 1 + k] = mean
                if self.linear:
                    self.stored["u_nodes"][i, first : first + k] = after

    def _controls(self, segment: Segment, steps: int, before: Floats) -> tuple[Floats, Floats]:
        """Mean controls of the steps of a segment and those at their ends (steps, m), after ``before`` (1, m).

        Those of kinematic inputs are their positions at the ends of steps.
        """
        shared, u = self.shared, segment.u[:steps]
        if self.linear:
            mean, _, nodes = lines(shared.commands._replace(before=before), u, ())
            return with_ends(shared.scene, mean, u), nodes[1:]
        moving = shared.scene.inputs and shared.commands.hold > 1
        moved = as_moved(shared.scene, segment.q[:steps], segment.v[:steps], u) if moving else u
        return moved, moved

    @np.errstate(over="ignore", invalid="ignore")
    def _reduce(self, first: int, done: Integers) -> None:
        """Add the block to the statistics. It begins at node ``first`` and has ``done[i]`` nodes of path i."""
        last, n2 = int(done.max()), self.block.shape[1] - 1
        length = min(self.shared.steps + 1 - first, len(self.block))
        block = self.block[:last]
        np.fmax(self.most_energy, np.fmax.reduce(block[:, -1], axis=0, initial=-np.inf), out=self.most_energy)
        speed = np.fmax.reduce(np.abs(block[:, n2 // 2 : -1]), axis=(0, 1), initial=-np.inf)
        np.fmax(self.fastest, speed, out=self.fastest)
        if self.values is not None:
            self.values[first : first + length] = self.block[:length, :-1]
        if self.moments is None:
            return
        begin = 0
        # Between two nodes at which paths fail, the set of paths is the same.
        for end in np.unique(done[done > 0]).tolist():
            inside = done >= end
            span = block[begin:end] if inside.all() else np.compress(inside, block[begin:end], axis=2)
            nodes = slice(first + begin, first + end)
            moments, mean = self.moments, span.mean(axis=2)
            deviation = span - mean[:, :, None]
            moments.mean[nodes], moments.count[nodes] = mean, span.shape[2]
            moments.squares[nodes] = np.einsum("jaP,jbP->jab", deviation[:, :-1], deviation[:, :-1])
            moments.energy[nodes] = np.einsum("jP,jP->j", deviation[:, -1], deviation[:, -1])
            begin = end
