"""Many noisy paths at once, on all cores or many machines, and their statistics."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import logging
import math
import os
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from varpin.core.arrays import Commands
from varpin.errors import InputError, VarpinError
from varpin.integrators import Integrator, Midpoint, Segment
from varpin.integrators.base import Failure, rows
from varpin.mechanics.policy import LinearPolicy, OpenLoop
from varpin.mechanics.scene import Scene, refuse_constraints, require_scene
from varpin.mechanics.wiener import Children, children
from varpin.simulation.loop_stability import examined_in_loop
from varpin.simulation.run import Motions, commands_of
from varpin.simulation.soundness import Finding, announce
from varpin.support.checks import JointValues, as_floats, count, finite_array, joint_array, positive, require_finite
from varpin.support.executors import executing, in_order
from varpin.support.frozen import Frozen
from varpin.support.markup import facts, table, warning_count

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
# By what they are extreme in, how much of it, and which path.
Extremes = dict[str, tuple[float, int]]

logger = logging.getLogger(__name__)

# Paths that one call of the core takes, and numbers that a block of nodes holds.
_GROUP = 32
_BLOCK = 1_000_000
# A chunk of paths is what a worker does at a time. Its size depends on the ensemble alone, and so does every sum: so
# many chunks, but each with this much to do at least and at most [steps of paths], and never fewer or more paths.
_CHUNKS, _LEAST, _MOST, _FEWEST_PATHS, _MOST_PATHS = 64, 4_000, 200_000, 16, 1024
# Numbers up to which quantiles are exact without stored paths, numbers in the bins that they are read from beyond, and
# how far those reach on either side of the first chunk's values, in units of their range.
_EXACT, _BINS, _REACH = 2**25, 2**25, 0.75
_FEWEST_BINS, _MOST_BINS = 64, 1000
# Numbers that a part of the nodes may have whose quantiles are taken at a time.
_SPAN = 100_000
# So few paths are all looked at once more.
_ALL_LOOKED_AT = 10


@dataclass(frozen=True, eq=False)
class EnsembleStatistics(Frozen):
    """Moments and quantiles over the paths at each of N + 1 nodes. x is (q, p), or (q, v): see the integrator.

    Attributes:
        mean: (N + 1, 2n).
        covariance: (N + 1, 2n, 2n), with P - 1 in the denominator.
        levels: Of the quantiles (L,).
        quantiles: (L, N + 1, 2n).
        quantile_errors: What each is off by at most, (L, N + 1, 2n); zero where they are exact.
        energy_mean: (N + 1,) [J].
        energy_deviation: Standard deviation (N + 1,) [J].
        count: Paths that are counted at each node (N + 1,): those that have not failed before.
    """

    mean: Floats
    covariance: Floats
    levels: Floats
    quantiles: Floats
    quantile_errors: Floats
    energy_mean: Floats
    energy_deviation: Floats
    count: NDArray[np.int64]

    def __repr__(self) -> str:
        nodes, states = self.mean.shape
        return f"EnsembleStatistics({nodes} nodes, {states // 2} joints, {len(self.levels)} quantiles)"


@dataclass(frozen=True)
class PathFailure:
    """A path that could not be finished.

    Attributes:
        path: Its index.
        step: The step that failed.
        reason: In words.
    """

    path: int
    step: int
    reason: str


@dataclass(frozen=True, eq=False)
class Ensemble(Frozen):
    """P paths over N steps.

    Attributes:
        t: Times (N + 1,) [s].
        statistics: Over the paths.
        q: Configurations (P, N + 1, n) [rad or m], or None where paths were not to be stored; NaN after a failure.
        v: Velocities (P, N + 1, n).
        p: Momenta (P, N + 1, n).
        u: Controls applied (P, N, m).
        energy: (P, N + 1) [J].
        failures: Paths that stopped early; they are left out of the statistics from there on.
        warnings: What varpin says of the paths, a sentence each: dt too coarse, energy off, paths that stopped early.
            A few paths are looked at, as :func:`varpin.simulate` looks at its motion: the first, the one with the most
            split steps, the one with the most energy and the fastest; up to ten are all looked at.
    """

    t: Floats
    statistics: EnsembleStatistics
    q: Floats | None
    v: Floats | None
    p: Floats | None
    u: Floats | None
    energy: Floats | None
    failures: tuple[PathFailure, ...]
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"Ensemble({self._size()}{warning_count(self.warnings)})"

    def __str__(self) -> str:
        return "\n".join([f"Ensemble({self._size()})", *(f"warning: {warning}" for warning in self.warnings)])

    def _repr_html_(self) -> str:
        moments, half = self.statistics, self.statistics.mean.shape[1] // 2
        deviation = np.sqrt(np.diagonal(moments.covariance[-1]))
        rows = [(j, float(moments.mean[-1, j]), float(deviation[j])) for j in range(half)]
        head = ("coordinate", "mean of q in the end [rad or m]", "standard deviation")
        energy = f"{moments.energy_mean[-1]:.4g} +- {moments.energy_deviation[-1]:.2g} in the end"
        warned = [("warning", warning) for warning in self.warnings]
        return facts("Ensemble", [("of", self._size()), ("energy [J]", energy), *warned], table(head, rows))

    def _size(self) -> str:
        counted = int(self.statistics.count[0])
        kept = "" if self.q is not None else ", not stored"
        lost = f", {len(self.failures)} stopped early" if self.failures else ""
        return f"{counted} paths{kept} over {len(self.t) - 1} steps, {self.t[-1] - self.t[0]:g} s{lost}"


class EnsembleInterrupted(KeyboardInterrupt):
    """Ctrl-C during an ensemble.

    Attributes:
        ensemble: The first paths, up to where they were done; None if none were.
    """

    def __init__(self, ensemble: Ensemble | None) -> None:
        self.ensemble = ensemble
        done = 0 if ensemble is None else int(ensemble.statistics.count[0])
        super().__init__(f"interrupted after {done} paths" + ("; they are in .ensemble" if done else ""))


def simulate_ensemble(
    scene: Scene,
    q0: JointValues,
    v0: JointValues,
    *,
    dt: float,
    steps: int,
    paths: int,
    rng: np.random.Generator | int,
    controls: JointValues | LinearPolicy | OpenLoop | None = None,
    integrator: Integrator | None = None,
    store: bool = True,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Ensemble:
    """Simulate many paths of a noisy scene.

    Path i draws its noise from the i-th child of ``rng``, and moments are merged in the order of the paths: the same
    bytes for any number of workers, threads, processes or machines of one kind.

    Main args:
        scene: The scene, with noise that the core can evaluate (not a ``CustomNoise``).
        q0: Initial configuration, (n,) or by joint name for all paths, or (P, n) [rad or m].
        v0: Initial velocity, the same [rad/s or m/s].
        dt: Time step [s].
        steps: N.
        paths: P.
        rng: Seed or generator.
        controls: None, (N, m), (m,), by joint name, :class:`OpenLoop`, or a :class:`LinearPolicy` that each path
            evaluates at its own state.

    Other Args:
        integrator: ``Midpoint()`` if left out.
        store: Keep every path. Without, only the statistics are kept, and memory does not grow with P N.
        quantiles: Levels in [0, 1]; none, and no more than moments come back from the workers. They are exact if paths
            are stored, or if P (N + 1) 2n is no more than 33 million. Beyond, they are read from histograms of up to
            1000 bins over 2.5 times the range of the first paths (up to 1024), linear within a bin; then
            ``statistics.quantile_errors`` says what they are off by at most, a bin. Levels 0 and 1 stay exact.
        workers: Threads; as many as there are cores if left out.
        executor: Any ``concurrent.futures.Executor`` instead of threads: a ``ProcessPoolExecutor``, Dask's
            ``client.get_executor()``, an ``mpi4py.futures.MPIPoolExecutor``. It stays open. The work of a worker that
            is lost is done again. Chunks of paths that wait, run or have come back before their turn are four for each
            worker at most, and no more than 2 GiB of results, but two at least.
        progress: Called now and then with (paths done, P).

    Raises:
        InputError: Wrong shapes, values that are not finite, or a scene whose noise the core cannot evaluate.
        VarpinError: Every path failed, or workers get lost again and again.
        EnsembleInterrupted: Ctrl-C; holds the paths that were done. It is a KeyboardInterrupt.
    """
    refuse_constraints(require_scene(scene), "simulate_ensemble")
    dt, steps, paths = positive("dt", dt, "s"), count("steps", steps), count("paths", paths, least=1)
    _require_memory(scene, steps, paths, store=store)
    start = [_per_path(name, value, paths, scene.robot.joint_names) for name, value in (("q0", q0), ("v0", v0))]
    if scene.noise.diffusion is None:
        raise InputError("an ensemble needs noise that the core evaluates; a CustomNoise is simulated path by path")
    levels = require_finite("quantiles", as_floats("quantiles", quantiles))
    if levels.ndim != 1 or ((levels < 0.0) | (levels > 1.0)).any():
        raise InputError(f"quantiles must be levels in [0, 1], got {quantiles}")
    integrator = Midpoint() if integrator is None else integrator
    if not isinstance(integrator, Integrator):
        raise InputError(f"integrator must be one of varpin's, for example varpin.Midpoint(), got {integrator!r}")
    if controls is None and scene.servo_joints:
        if (start[0] != start[0][0]).any():
            raise InputError("controls are needed: the scene has servos, and the paths begin at different positions")
        controls = scene.command_at(start[0][0])
    commands = commands_of(scene, integrator, controls, steps, dt)
    with executing(executor, workers) as pool:
        shared = Shared(without_geometry(scene), integrator, commands, dt, steps, children(rng, paths))
        sums = _Sums(shared, paths, levels, store=store)
        try:
            with closing(_parts(pool, sums, start[0], start[1])) as parts:
                for part in parts:
                    sums.add(part)
                    if progress is not None:
                        progress(sums.done, paths)
            found = looked_at(pool, shared, start[0], start[1], sums.extremes)
        except KeyboardInterrupt:
            if not sums.done:
                raise EnsembleInterrupted(None) from None
            seen = looked_at_here(shared, start[0][: sums.done], start[1][: sums.done], sums.extremes)
            raise EnsembleInterrupted(sums.ensemble((*sums.lost(), *seen))) from None
    if len(sums.failures) == paths:
        raise VarpinError(sums.failing())
    found = (*_alike(scene, start), *sums.lost(), *found)
    announce(logger, scene, dt, found)
    return sums.ensemble(found)


def _alike(scene: Scene, start: Sequence[Floats]) -> tuple[Finding, ...]:
    """Says if nothing tells the paths apart."""
    if scene.processes or len(start[0]) < 2 or any((x != x[0]).any() for x in start):
        return ()
    sentence = (
        "the scene has no noise and all paths begin alike, so that they are one and the same motion: "
        "varpin.Scene(robot, noise=...) tells them apart"
    )
    return (Finding("paths alike", sentence),)


def _parts(pool: Executor, sums: _Sums, q0: Floats, v0: Floats) -> Generator[Part, None, None]:
    """What comes of the chunks; the first by itself where the bins of the others depend on it."""
    tasks = sums.tasks(q0, v0)
    if sums.estimated:
        yield from in_order(pool, simulate_paths, itertools.islice(tasks, 1))
    yield from in_order(pool, simulate_paths, tasks, result_bytes=sums.part_bytes())


def _require_memory(scene: Scene, steps: int, paths: int, *, store: bool) -> None:
    """Refuse a record that cannot be held, before anything runs."""
    n, m = scene.robot.dof, scene.controls
    stored = paths if store else 0
    row = 2 * n * (4 * n + 5) + m + stored * (3 * n + m + 1)
    for shape, what in (
        ((steps + 1, row), f"steps = {steps} with {stored} stored paths"),
        ((paths, 2 * n), f"paths = {paths}"),
    ):
        try:
            np.empty(shape)
        except (MemoryError, ValueError, OverflowError):
            raise InputError(
                f"{what} needs more memory than there is: {8 * shape[1]} bytes a {what.partition(' ')[0][:-1]}"
            ) from None


def _per_path(name: str, value: JointValues, paths: int, joints: Sequence[str]) -> Floats:
    n = len(joints)
    array = joint_array(name, value, joints) if isinstance(value, Mapping) else as_floats(name, value)
    if array.shape == (n,):
        return np.broadcast_to(finite_array(name, array, (n,)), (paths, n))
    return finite_array(name, array, (paths, n))


def without_geometry(scene: Scene) -> Scene:
    """The scene without shapes that came with its robot: no simulation needs them, and meshes are large to send."""
    if scene.robot.visuals is None:
        return scene
    bare = copy.copy(scene)
    vars(bare)["robot"] = dataclasses.replace(scene.robot, visuals=None)
    return bare


def chunks(steps: int, paths: int) -> Iterator[tuple[int, int]]:
    """The first path of each chunk, and one past its last; the same for any workers."""
    steps = max(1, steps)
    size = max(math.ceil(paths / _CHUNKS), _LEAST // steps)
    size = max(_FEWEST_PATHS, min(size, _MOST // steps, _MOST_PATHS))
    if size > _GROUP:
        size = math.ceil(size / _GROUP) * _GROUP
    for first in range(0, paths, size):
        yield first, min(first + size, paths)


@dataclass(frozen=True, eq=False)
class Shared(Frozen):
    """What all paths of an ensemble share.

    Attributes:
        scene: The scene.
        integrator: The integrator.
        commands: Of all steps.
        dt: Time step [s].
        steps: N.
        seeds: A child for each path.
    """

    scene: Scene
    integrator: Integrator
    commands: Commands
    dt: float
    steps: int
    seeds: Children


@dataclass(frozen=True, eq=False)
class Task(Frozen):
    """A chunk of paths to simulate, and what of them is wanted.

    Attributes:
        shared: What they share with others.
        first: The first of them.
        q0: (C, n) [rad or m].
        v0: (C, n).
        store: The paths themselves.
        moments: Their moments.
        values: Their states, node by node.
        grid: The bins in which to count their states, as least value and width (2, N + 1, 2n) and how many; or None.
    """

    shared: Shared
    first: int
    q0: Floats
    v0: Floats
    store: bool = False
    moments: bool = True
    values: bool = False
    grid: tuple[Floats, int] | None = None


@dataclass(frozen=True, eq=False)
class Moments(Frozen):
    """Sums over some paths at each of N + 1 nodes.

    Attributes:
        count: Paths (N + 1,).
        mean: Of x and of the energy (N + 1, 2n + 1).
        squares: Products of deviations from it, added up, of x (N + 1, 2n, 2n).
        energy: The same of the energy (N + 1,).
    """

    count: Integers
    mean: Floats
    squares: Floats
    energy: Floats

    def merged(self, other: Moments) -> Moments:
        """Those of both (Chan, Golub and LeVeque 1979)."""
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
    """What came of a chunk.

    Attributes:
        first: Its first path.
        paths: C.
        failures: Paths that stopped early.
        extremes: Those of its paths that are worth a look: what for, how much of it, and which path.
        nodes: By path, how many nodes each has (C,).
        moments: If wanted.
        stored: The paths by name, (C, ...), if wanted.
        values: x by node (N + 1, 2n, C), NaN after a failure, if wanted.
        counts: Paths in each bin (N + 1, 2n, B + 2), below and above the bins too, if wanted.
        bounds: Least and greatest x (2, N + 1, 2n), if counts are.
    """

    first: int
    paths: int
    failures: tuple[PathFailure, ...]
    extremes: Extremes
    nodes: Integers
    moments: Moments | None
    stored: dict[str, Floats]
    values: Floats | None
    counts: NDArray[np.uint16] | None
    bounds: Floats | None


def simulate_paths(task: Task) -> Part:
    """A chunk of paths, in one thread; path by path the bytes are those of any other chunk."""
    return _Chunk(task).part()


class _Chunk:
    """Paths in groups, each with its integrator state and generators, which go through blocks of nodes together."""

    def __init__(self, task: Task) -> None:
        self.task, shared = task, task.shared
        self.shared, self.paths = shared, len(task.q0)
        n, m, N = shared.scene.robot.dof, shared.scene.controls, shared.steps
        self.groups = [slice(a, min(a + _GROUP, self.paths)) for a in range(0, self.paths, _GROUP)]
        self.generators = shared.seeds.generators(task.first, task.first + self.paths)
        # The control before, of each path; before the first there is none, if the policy does not say.
        self.before = [np.repeat(shared.commands.before, group.stop - group.start, axis=0) for group in self.groups]
        self.alive = np.ones(self.paths, dtype=bool)
        self.nodes = np.zeros(self.paths, dtype=np.int64)
        self.split = np.zeros(self.paths, dtype=np.int64)
        self.most_energy, self.fastest = np.full((2, self.paths), -np.inf)
        self.failures: list[PathFailure] = []
        block = max(1, _BLOCK // (self.paths * (2 * n + 1)) // shared.commands.hold) * shared.commands.hold
        self.length = min(N, block)
        # Nodes of a block, paths last: statistics run over them.
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
        self.counts: NDArray[np.uint16] | None = None
        self.bounds: Floats | None = None
        if task.grid is not None:
            self.counts = np.zeros((N + 1, 2 * n, task.grid[1] + 2), dtype=np.uint16)
            self.bounds = np.empty((2, N + 1, 2 * n))
        self.stored: dict[str, Floats] = {}
        if task.store:
            self.stored = {name: np.full((self.paths, N + 1, n), np.nan) for name in ("q", "v", "p")}
            self.stored |= {"energy": np.full((self.paths, N + 1), np.nan), "u": np.full((self.paths, N, m), np.nan)}

    def part(self) -> Part:
        """All steps."""
        task, shared = self.task, self.shared
        states = []
        for group in self.groups:
            state, first = shared.integrator.start(shared.scene, task.q0[group], task.v0[group])
            states.append(state)
            self._store(0, group, first, [1] * len(first))
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
            counts=self.counts,
            bounds=self.bounds,
        )

    def _run_group(self, number: int, state: object, begin: int, end: int) -> Integers:
        """Steps begin .. end of a group: how many each path did; one that has failed does none."""
        shared, group = self.shared, self.groups[number]
        hold = shared.commands.hold
        decisions = rows(shared.commands, begin // hold, end // hold, self.before[number])
        increments = np.empty((group.stop - group.start, end - begin, shared.scene.processes))
        for drawn, child in zip(increments, self.generators[group], strict=True):
            child.standard_normal(out=drawn)
        increments *= np.sqrt(shared.dt)
        segments = shared.integrator.rollout(shared.scene, state, decisions, increments, shared.dt)
        alive = self.alive[group]
        done = [len(segment.q) * int(still) for segment, still in zip(segments, alive, strict=True)]
        self._store(begin + 1, group, segments, done)
        lost = np.full(shared.scene.controls, np.nan)
        self.before[number] = np.array([segment.u[-1] if len(segment.u) else lost for segment in segments])
        for i, (k, segment) in enumerate(zip(done, segments, strict=True)):
            if not alive[i]:
                continue
            self.split[group.start + i] += int(segment.statistics.substeps.sum()) - k
            if segment.failure is not None:
                self._fail(group.start + i, begin + k, segment.failure)
        return np.array(done, dtype=np.int64)

    def _fail(self, path: int, step: int, failure: Failure) -> None:
        self.alive[path] = False
        self.failures.append(PathFailure(self.task.first + path, step, failure.reason))

    def _store(self, first: int, group: slice, segments: list[Segment], done: list[int]) -> None:
        """Nodes of a group from node ``first`` on, ``done[i]`` of its i-th path."""
        n, momentum = self.shared.scene.robot.dof, self.shared.integrator.variational
        self.nodes[group] += done
        for i, (segment, k) in enumerate(zip(segments, done, strict=True), group.start):
            x = self.block[:, :, i]
            x[:k, :n], x[:k, n:-1] = segment.q[:k], (segment.p if momentum else segment.v)[:k]
            x[:k, -1] = segment.energy[:k]
            if k < len(x):
                x[k:] = np.nan
            for name, array in self.stored.items():
                # The control that leads to a node stands one row before it, and none leads to the first.
                row = first - 1 if name == "u" else first
                if row >= 0:
                    array[i, row : row + k] = getattr(segment, name)[:k]

    def _reduce(self, first: int, done: Integers) -> None:
        """Take in the block, which begins at node ``first`` and has ``done[i]`` nodes of path i."""
        last, n2 = int(done.max()), self.block.shape[1] - 1
        length = min(self.shared.steps + 1 - first, len(self.block))
        block = self.block[:last]
        np.fmax(self.most_energy, np.fmax.reduce(block[:, -1], axis=0, initial=-np.inf), out=self.most_energy)
        speed = np.fmax.reduce(np.abs(block[:, n2 // 2 : -1]), axis=(0, 1), initial=-np.inf)
        np.fmax(self.fastest, speed, out=self.fastest)
        if self.values is not None:
            self.values[first : first + length] = self.block[:length, :-1]
        if self.counts is not None and self.bounds is not None and self.task.grid is not None:
            (least, width), bins = self.task.grid
            nodes = slice(first, first + length)
            counted(
                self.block[:length, :-1], least[nodes], width[nodes], bins, self.counts[nodes], self.bounds[:, nodes]
            )
        if self.moments is None:
            return
        begin = 0
        # Between two nodes at which paths fail, the same paths are counted.
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


def counted(x: Floats, least: Floats, width: Floats, bins: int, counts: NDArray[np.uint16], bounds: Floats) -> None:
    """Count x (k, 2n, C) in bins from ``least`` on, ``width`` wide each (k, 2n), and find its bounds (2, k, 2n)."""
    position = np.floor((x - least[:, :, None]) / width[:, :, None])
    there = ~np.isnan(position)
    index = np.clip(np.where(there, position, 0.0), -1, bins).astype(np.int64) + 1
    index += (bins + 2) * np.arange(width.size).reshape(*width.shape, 1)
    counts.reshape(-1)[:] = np.bincount(index[there], minlength=counts.size)
    bounds[0], bounds[1] = np.fmin.reduce(x, axis=2, initial=np.inf), np.fmax.reduce(x, axis=2, initial=-np.inf)


class _Sums:
    """What comes of chunks, taken in in the order of the paths."""

    def __init__(self, shared: Shared, paths: int, levels: Floats, *, store: bool) -> None:
        self.shared, self.paths, self.levels, self.store = shared, paths, levels, store
        n, m, N = shared.scene.robot.dof, shared.scene.controls, shared.steps
        self.done = 0
        self.moments: Moments | None = None
        self.failures: list[PathFailure] = []
        self.extremes: Extremes = {}
        self.nodes = np.zeros(paths, dtype=np.int64)
        self.stored: dict[str, Floats] = {}
        if store:
            self.stored = {name: np.empty((paths, N + 1, n)) for name in ("q", "v", "p")}
            self.stored |= {"energy": np.empty((paths, N + 1)), "u": np.empty((paths, N, m))}
        exact = paths * (N + 1) * 2 * n <= _EXACT
        self.values = np.empty((N + 1, 2 * n, paths)) if len(levels) and exact and not store else None
        self.histogram: _Histogram | None = None
        self.estimated = bool(len(levels)) and not exact and not store

    def tasks(self, q0: Floats, v0: Floats) -> Iterator[Task]:
        """The chunks; where quantiles are estimated, the second is asked for once the first has been taken in."""
        for first, last in chunks(self.shared.steps, self.paths):
            yield Task(
                self.shared,
                first,
                q0[first:last].copy(),
                v0[first:last].copy(),
                store=self.store,
                values=self.values is not None or (self.estimated and self.histogram is None),
                grid=None if self.histogram is None else self.histogram.grid,
            )

    def part_bytes(self) -> int:
        """What comes of a chunk [bytes], its arrays alone."""
        nodes, size = self.shared.steps + 1, 2 * self.shared.scene.robot.dof
        _, paths = next(chunks(self.shared.steps, self.paths))
        numbers = nodes * (size**2 + size + 3) + paths
        if self.store:
            numbers += paths * (nodes * (3 * size // 2 + 1) + self.shared.steps * self.shared.scene.controls)
        if self.values is not None:
            numbers += paths * nodes * size
        if self.histogram is not None:
            bins = self.histogram.grid[1] + 2
            numbers += nodes * size * (2 + math.ceil(bins / 4))
        return 8 * numbers

    def add(self, part: Part) -> None:
        """The next chunk."""
        here = slice(part.first, part.first + part.paths)
        assert part.first == self.done
        assert part.moments is not None
        self.moments = part.moments if self.moments is None else self.moments.merged(part.moments)
        self.failures += part.failures
        self.extremes = greater(self.extremes, part.extremes)
        self.nodes[here] = part.nodes
        for name, array in part.stored.items():
            self.stored[name][here] = array
        if self.estimated:
            if self.histogram is None and part.values is not None:
                self.histogram = _Histogram(part.values)
            elif self.histogram is not None and part.counts is not None and part.bounds is not None:
                self.histogram.add(part.counts, part.bounds)
        elif self.values is not None and part.values is not None:
            self.values[:, :, here] = part.values
        self.done = here.stop

    def lost(self) -> tuple[Finding, ...]:
        """What is to be said of failures, if there are any."""
        if not self.failures:
            return ()
        return (Finding("failed paths", f"{self.failing()}; they are left out of the statistics from there on"),)

    def failing(self) -> str:
        """How many paths failed, and the first of them."""
        first = min(self.failures, key=lambda failure: failure.step)
        return f"{len(self.failures)} of {self.done} paths failed, the first at step {first.step}: {first.reason}"

    def ensemble(self, found: Sequence[Finding]) -> Ensemble:
        """Of the paths that were taken in, with what is to be said of them."""
        moments, n2 = self.moments, 2 * self.shared.scene.robot.dof
        assert moments is not None
        there = moments.count > 0
        degrees = np.maximum(moments.count - 1, 1)
        quantiles, errors = self._quantiles()
        stored = {name: array[: self.done] for name, array in self.stored.items()}
        return Ensemble(
            t=np.arange(self.shared.steps + 1, dtype=np.float64) * self.shared.dt,
            statistics=EnsembleStatistics(
                mean=np.where(there[:, None], moments.mean[:, :n2], np.nan),
                covariance=np.where(there[:, None, None], moments.squares / degrees[:, None, None], np.nan),
                levels=self.levels,
                quantiles=quantiles,
                quantile_errors=errors,
                energy_mean=np.where(there, moments.mean[:, n2], np.nan),
                energy_deviation=np.where(there, np.sqrt(moments.energy / degrees), np.nan),
                count=moments.count,
            ),
            q=stored.get("q"),
            v=stored.get("v"),
            p=stored.get("p"),
            u=stored.get("u"),
            energy=stored.get("energy"),
            failures=tuple(self.failures),
            warnings=tuple(finding.sentence for finding in found),
        )

    def _quantiles(self) -> tuple[Floats, Floats]:
        shape = (len(self.levels), self.shared.steps + 1, 2 * self.shared.scene.robot.dof)
        if self.histogram is not None:
            return self.histogram.quantiles(self.levels)
        found = np.full(shape, np.nan)
        if not len(self.levels):
            return found, np.zeros(shape)
        size, nodes = max(1, _SPAN // (self.done * shape[2])), self.nodes[: self.done]
        spans, begin = [], 0
        # Between two nodes at which paths fail, the same paths are counted.
        for end in np.unique(nodes).tolist():
            spans += [(a, min(a + size, end), nodes >= end) for a in range(begin, end, size)]
            begin = end

        def take(span: tuple[int, int, NDArray[np.bool_]]) -> None:
            first, last, inside = span
            x = self._states(first, last)
            found[:, first:last] = np.quantile(x if inside.all() else x[:, :, inside], self.levels, axis=2)

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            list(pool.map(take, spans))
        return found, np.zeros(shape)

    def _states(self, first: int, last: int) -> Floats:
        """X at some nodes (k, 2n, P)."""
        if self.values is not None:
            return self.values[first:last, :, : self.done]
        second = self.stored["p" if self.shared.integrator.variational else "v"]
        parts = [array[: self.done, first:last].transpose(1, 2, 0) for array in (self.stored["q"], second)]
        return np.concatenate(parts, axis=1)


class _Histogram:
    """Counts of x in bins around the values of the first paths (N + 1, 2n, C)."""

    def __init__(self, values: Floats) -> None:
        least = np.fmin.reduce(values, axis=2, initial=np.inf)
        most = np.fmax.reduce(values, axis=2, initial=-np.inf)
        # Where all of them have failed, bins are those of the node before.
        there = np.isfinite(least).all(axis=1)
        node = np.maximum.accumulate(np.where(there, np.arange(len(there)), 0))
        least, most = least[node], most[node]
        spread = np.maximum(most - least, 1e-9 * np.maximum(np.abs(least), np.abs(most)) + 1e-300)
        bins = int(np.clip(_BINS // spread.size, _FEWEST_BINS, _MOST_BINS))
        self.grid = np.stack([least - _REACH * spread, (1.0 + 2.0 * _REACH) * spread / bins]), bins
        self.counts = np.zeros((*spread.shape, bins + 2), dtype=np.int64)
        self.bounds = np.stack([np.full(spread.shape, np.inf), np.full(spread.shape, -np.inf)])
        counts, bounds = np.zeros(self.counts.shape, dtype=np.uint16), np.empty(self.bounds.shape)
        counted(values, self.grid[0][0], self.grid[0][1], bins, counts, bounds)
        self.add(counts, bounds)

    def add(self, counts: NDArray[np.uint16], bounds: Floats) -> None:
        """Those of other paths."""
        self.counts += counts
        np.minimum(self.bounds[0], bounds[0], out=self.bounds[0])
        np.maximum(self.bounds[1], bounds[1], out=self.bounds[1])

    def quantiles(self, levels: Floats) -> tuple[Floats, Floats]:
        """Quantiles, and what they are off by at most, each (L, N + 1, 2n)."""
        found, errors = np.full((2, len(levels), *self.counts.shape[:2]), np.nan)
        for j in range(len(self.counts)):
            below = np.cumsum(self.counts[j], axis=1)
            for i, level in enumerate(levels):
                rank = level * (below[:, -1] - 1)
                lower, upper = (
                    self._ranked(j, below, np.asarray(r(rank), dtype=np.int64)) for r in (np.floor, np.ceil)
                )
                found[i, j] = lower[0] + (rank - np.floor(rank)) * (upper[0] - lower[0])
                errors[i, j] = np.maximum(lower[1], upper[1])
        return np.where(self.counts.any(axis=2), found, np.nan), np.where(self.counts.any(axis=2), errors, np.nan)

    def _ranked(self, node: int, below: Integers, rank: Integers) -> tuple[Floats, Floats]:
        """The value (2n,) of so many less than it, and what it is off by at most; ``below`` are cumulated counts."""
        (least, width), bins = self.grid[0][:, node], self.grid[1]
        first, last = self.bounds[:, node]
        bin_of = np.argmax(below > rank[:, None], axis=1)
        rows = np.arange(len(rank))
        inside = np.maximum(self.counts[node][rows, bin_of], 1)
        share = (rank + 0.5 - (below[rows, bin_of] - inside)) / inside
        begin = np.where(bin_of == 0, first, least + (bin_of - 1) * width)
        end = np.where(bin_of == bins + 1, last, least + bin_of * width)
        # The extremes are known themselves.
        begin, end = np.maximum(begin, first), np.minimum(end, last)
        begin = np.where(rank >= below[:, -1] - 1, last, begin)
        end = np.where(rank <= 0, first, np.maximum(begin, end))
        begin = np.minimum(begin, end)
        return begin + share * (end - begin), end - begin


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
