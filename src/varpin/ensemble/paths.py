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
    """Paths in groups, each of which is one call of the core."""

    def __init__(self, task: Task) -> None:
        self.task, self.shared = task, task.shared
        shared, P = task.shared, len(task.q0)
        n, m, N = shared.scene.robot.dof, shared.scene.controls, shared.steps
        # Whether controls are linear between nodes; the stored ones of steps are then their means.
        self.linear = len(shared.commands.stage_times) > 0
        self.nodes, self.split = np.zeros((2, P), dtype=np.int64)
        self.failures: list[PathFailure] = []
        # States and energy; the paths are the last axis, over which statistics run.
        self.x = np.full((N + 1, 2 * n + 1, P), np.nan)
        self.stored: dict[str, Floats] = {}
        if task.store:
            self.stored = {name: np.full((P, N + 1, n), np.nan) for name in ("q", "v", "p")}
            self.stored |= {"energy": np.full((P, N + 1), np.nan), "u": np.full((P, N, m), np.nan)}
            if self.linear:
                self.stored["u_nodes"] = np.full((P, N + 1, m), np.nan)
                self.stored["u_nodes"][:, 0] = shared.commands.before

    def part(self) -> Part:
        """Simulate all paths."""
        task, paths, n = self.task, len(self.task.q0), self.shared.scene.robot.dof
        for first in range(0, paths, _GROUP):
            self._simulate(slice(first, min(first + _GROUP, paths)))
        energy = np.fmax.reduce(self.x[:, -1], axis=0, initial=-np.inf)
        speed = np.fmax.reduce(np.abs(self.x[:, n:-1]), axis=(0, 1), initial=-np.inf)
        return Part(
            first=task.first,
            paths=paths,
            failures=tuple(self.failures),
            extremes={
                name: (float(values.max()), task.first + int(np.argmax(values)))
                for name, values in (("split", self.split), ("energy", energy), ("speed", speed))
            },
            nodes=self.nodes,
            moments=self._moments() if task.moments else None,
            stored=self.stored,
            values=self.x[:, :-1] if task.values else None,
        )

    def _simulate(self, group: slice) -> None:
        """Simulate the paths of a group and store them."""
        shared, task, size = self.shared, self.task, group.stop - group.start
        state, start = shared.integrator.start(shared.scene, task.q0[group], task.v0[group])
        # The control before the first of each path; NaN unless the policy gives one.
        before = np.repeat(shared.commands.before, size, axis=0)
        self._store(0, group, start, before)
        if not shared.steps:
            return
        increments = np.empty((size, shared.steps, shared.increments))
        generators = shared.seeds.generators(task.first + group.start, task.first + group.stop)
        for drawn, child in zip(increments, generators, strict=True):
            child.standard_normal(out=drawn)
        increments *= np.sqrt(shared.dt)
        decisions = rows(shared.commands, 0, shared.steps // shared.commands.hold, before)
        try:
            segments = shared.integrator.rollout(shared.scene, state, decisions, increments, shared.dt)
        except CustomForceError as error:
            raise self._located(group, error) from error
        self._store(1, group, segments, before)
        for path, segment in enumerate(segments, group.start):
            self.split[path] = int(segment.statistics.substeps.sum()) - len(segment.q)
            if segment.failure is not None:
                self.failures.append(PathFailure(task.first + path, len(segment.q), segment.failure.reason))

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

    def _store(self, first: int, group: slice, segments: list[Segment], before: Floats) -> None:
        """Store nodes of a group from node ``first`` on; ``before`` are the controls before each path."""
        n, momentum = self.shared.scene.robot.dof, self.shared.integrator.variational
        for i, segment in enumerate(segments, group.start):
            k = len(segment.q)
            self.nodes[i] += k
            x = self.x[first : first + k, :, i]
            x[:, :n], x[:, n:-1] = segment.q, segment.p if momentum else segment.v
            x[:, -1] = segment.energy
            for name, array in self.stored.items():
                if name in ("q", "v", "p", "energy"):
                    array[i, first : first + k] = getattr(segment, name)
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
    def _moments(self) -> Moments:
        """Sums over the paths at each node."""
        nodes, size = len(self.x), self.x.shape[1] - 1
        count, squares = np.zeros(nodes, np.int64), np.zeros((nodes, size, size))
        mean, energy = np.zeros((nodes, size + 1)), np.zeros(nodes)
        begin = 0
        # Between two nodes at which paths fail, the set of paths is the same.
        for end in np.unique(self.nodes).tolist():
            here, inside = slice(begin, end), self.nodes >= end
            span = self.x[here] if inside.all() else np.compress(inside, self.x[here], axis=2)
            count[here], mean[here] = span.shape[2], span.mean(axis=2)
            deviation = span - mean[here, :, None]
            squares[here] = np.einsum("jaP,jbP->jab", deviation[:, :-1], deviation[:, :-1])
            energy[here] = np.einsum("jP,jP->j", deviation[:, -1], deviation[:, -1])
            begin = end
        return Moments(count, mean, squares, energy)
