"""Many noisy paths at once, on all cores, and their statistics."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.checks import as_floats, count, finite_array, positive, require_finite
from varpin.errors import InputError, VarpinError
from varpin.frozen import Frozen
from varpin.integrators import Integrator, Midpoint, Segment
from varpin.integrators.base import Failure, rows
from varpin.kernels._compile import announced_compilation
from varpin.kernels.tree import Commands
from varpin.markup import facts, table
from varpin.policy import LinearPolicy
from varpin.scene import Scene, require_scene
from varpin.simulation import commands_of
from varpin.wiener import generator

Floats = NDArray[np.float64]

logger = logging.getLogger(__name__)

# Paths that one kernel call takes, and how many numbers a block of nodes and a part of it to be reduced may hold.
_GROUP = 32
_BLOCK = 4_000_000
_SPAN = 100_000
# What a path's generator takes, in numbers.
_PATH = 200


@dataclass(frozen=True, eq=False)
class EnsembleStatistics(Frozen):
    """Moments and quantiles over the paths at each of N + 1 nodes. x is (q, p), or (q, v): see the integrator.

    Attributes:
        mean: (N + 1, 2n).
        covariance: (N + 1, 2n, 2n), with P - 1 in the denominator.
        levels: Of the quantiles (L,).
        quantiles: (L, N + 1, 2n).
        energy_mean: (N + 1,) [J].
        energy_deviation: Standard deviation (N + 1,) [J].
        count: Paths that are counted at each node (N + 1,): those that have not failed before.
    """

    mean: Floats
    covariance: Floats
    levels: Floats
    quantiles: Floats
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
    """

    t: Floats
    statistics: EnsembleStatistics
    q: Floats | None
    v: Floats | None
    p: Floats | None
    u: Floats | None
    energy: Floats | None
    failures: tuple[PathFailure, ...]

    def __repr__(self) -> str:
        return f"Ensemble({self._size()})"

    def _repr_html_(self) -> str:
        own, half = self.statistics, self.statistics.mean.shape[1] // 2
        deviation = np.sqrt(np.diagonal(own.covariance[-1]))
        rows = [(j, float(own.mean[-1, j]), float(deviation[j])) for j in range(half)]
        head = ("coordinate", "mean of q in the end [rad or m]", "standard deviation")
        energy = f"{own.energy_mean[-1]:.4g} +- {own.energy_deviation[-1]:.2g} in the end"
        return facts("Ensemble", [("of", self._size()), ("energy [J]", energy)], table(head, rows))

    def _size(self) -> str:
        counted = int(self.statistics.count[0])
        kept = "" if self.q is not None else ", not stored"
        lost = f", {len(self.failures)} stopped early" if self.failures else ""
        return f"{counted} paths{kept} over {len(self.t) - 1} steps, {self.t[-1] - self.t[0]:g} s{lost}"


class EnsembleInterrupted(KeyboardInterrupt):
    """Ctrl-C during an ensemble.

    Attributes:
        ensemble: All paths up to the last node that all of them had reached.
    """

    def __init__(self, ensemble: Ensemble) -> None:
        self.ensemble = ensemble
        super().__init__(f"interrupted after {len(ensemble.t) - 1} steps of all paths; they are in .ensemble")


def simulate_ensemble(
    scene: Scene,
    q0: ArrayLike,
    v0: ArrayLike,
    *,
    dt: float,
    steps: int,
    paths: int,
    rng: np.random.Generator | int,
    controls: ArrayLike | LinearPolicy | None = None,
    integrator: Integrator | None = None,
    store: bool = True,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Ensemble:
    """Simulate many paths of a noisy scene.

    Path i draws its noise from the i-th child of ``rng``: the same bytes for any number of workers or of paths.

    Main args:
        scene: The scene, with noise that kernels can evaluate (not a ``CustomNoise``).
        q0: Initial configuration, (n,) for all paths or (P, n) [rad or m].
        v0: Initial velocity, (n,) or (P, n) [rad/s or m/s].
        dt: Time step [s].
        steps: N.
        paths: P.
        rng: Seed or generator.
        controls: None, (N, m), (m,), or a :class:`LinearPolicy` that each path evaluates at its own state.

    Other Args:
        integrator: ``Midpoint()`` if left out.
        store: Keep every path. Without, only the statistics are kept, and memory does not grow with P N.
        quantiles: Levels in [0, 1].
        workers: Threads; as many as there are cores if left out.
        progress: Called now and then with (steps done by all paths, N).

    Raises:
        InputError: Wrong shapes, values that are not finite, or a scene whose noise kernels cannot evaluate.
        VarpinError: Every path failed.
        EnsembleInterrupted: Ctrl-C; holds what was done. It is a KeyboardInterrupt.
    """
    n = require_scene(scene).robot.dof
    dt, steps, paths = positive("dt", dt, "s"), count("steps", steps), count("paths", paths, least=1)
    _require_memory(scene, steps, paths, store=store)
    start = [_per_path(name, value, paths, n) for name, value in (("q0", q0), ("v0", v0))]
    if scene.noise.diffusion is None:
        raise InputError("an ensemble needs noise that kernels evaluate; a CustomNoise is simulated path by path")
    levels = require_finite("quantiles", as_floats("quantiles", quantiles))
    if levels.ndim != 1 or ((levels < 0.0) | (levels > 1.0)).any():
        raise InputError(f"quantiles must be levels in [0, 1], got {quantiles}")
    workers = count("workers", (os.cpu_count() or 1) if workers is None else workers, least=1)
    integrator = Midpoint() if integrator is None else integrator
    if not isinstance(integrator, Integrator):
        raise InputError(f"integrator must be one of varpin's, for example varpin.Midpoint(), got {integrator!r}")
    commands = commands_of(scene, integrator, controls, steps)
    run = _Run(scene, integrator, dt, start, rng, commands)
    block = min(steps, _BLOCK // (paths * (2 * n + 1)))
    block = max(1, block // commands.hold) * commands.hold
    collector = _Collector(steps, block, levels, run, store)
    feature = f"simulate_ensemble with {type(integrator).__name__}"
    with announced_compilation(feature), ThreadPoolExecutor(workers) as pool:
        try:
            run.begin(collector, pool)
            for begin in range(0, steps, block):
                end = min(steps, begin + block)
                run.advance(begin, end, collector, pool)
                if progress is not None:
                    progress(end, steps)
                if not run.alive.any():
                    break
        except KeyboardInterrupt:
            raise EnsembleInterrupted(collector.ensemble()) from None
    ensemble = collector.ensemble()
    if ensemble.failures:
        first = min(ensemble.failures, key=lambda failure: failure.step)
        text = f"{len(ensemble.failures)} of {paths} paths failed, the first at step {first.step}: {first.reason}"
        if len(ensemble.failures) == paths:
            raise VarpinError(text)
        logger.warning("%s; they are left out of the statistics from there on", text)
    return ensemble


def _require_memory(scene: Scene, steps: int, paths: int, *, store: bool) -> None:
    """Refuse a record that cannot be held, before anything runs."""
    n, m = scene.robot.dof, scene.controls
    stored = paths if store else 0
    row = 2 * n * (2 * n + 5) + m + stored * (3 * n + m + 1)
    for shape, what in (
        ((steps + 1, row), f"steps = {steps} with {stored} stored paths"),
        ((paths, _PATH + 16 * n), f"paths = {paths}"),
    ):
        try:
            np.empty(shape)
        except (MemoryError, ValueError, OverflowError):
            raise InputError(
                f"{what} needs more memory than there is: {8 * shape[1]} bytes a {what.partition(' ')[0][:-1]}"
            ) from None


def _per_path(name: str, value: ArrayLike, paths: int, n: int) -> Floats:
    array = as_floats(name, value)
    if array.shape == (n,):
        array = np.repeat(array[None], paths, axis=0)
    return finite_array(name, array, (paths, n))


class _Run:
    """The groups of paths, each with its integrator state, generators and failures."""

    def __init__(
        self,
        scene: Scene,
        integrator: Integrator,
        dt: float,
        start: list[Floats],
        rng: np.random.Generator | int,
        commands: Commands,
    ) -> None:
        self.scene, self.integrator, self.dt, self.commands = scene, integrator, dt, commands
        self.paths = len(start[0])
        self.generators = generator(rng).spawn(self.paths)
        self.alive = np.ones(self.paths, dtype=bool)
        self.failures: list[PathFailure] = []
        self.groups = [slice(a, min(a + _GROUP, self.paths)) for a in range(0, self.paths, _GROUP)]
        # The control before, of each path; before the first there is none, if the policy does not say.
        self.before = [np.repeat(commands.before, group.stop - group.start, axis=0) for group in self.groups]
        self.states = []
        self.first: list[list[Segment]] = []
        for group in self.groups:
            state, first = integrator.start(scene, start[0][group], start[1][group])
            self.states.append(state)
            self.first.append(first)

    def begin(self, collector: _Collector, pool: ThreadPoolExecutor) -> None:
        """The first node of every path."""
        for number, segments in enumerate(self.first):
            collector.put(0, number, segments, [1] * len(segments))
        collector.reduce(0, 1, np.ones(self.paths, dtype=np.int64), pool)

    def advance(self, begin: int, end: int, collector: _Collector, pool: ThreadPoolExecutor) -> None:
        """Steps begin .. end of every path; a path that has failed does none."""

        def work(number: int) -> list[tuple[int, Failure | None]]:
            group, hold = self.groups[number], self.commands.hold
            decisions = rows(self.commands, begin // hold, end // hold, self.before[number])
            increments = np.empty((group.stop - group.start, end - begin, self.scene.processes))
            for drawn, child in zip(increments, self.generators[group], strict=True):
                child.standard_normal(out=drawn)
            increments *= np.sqrt(self.dt)
            segments = self.integrator.rollout(self.scene, self.states[number], decisions, increments, self.dt)
            done = [len(segment.q) * int(alive) for segment, alive in zip(segments, self.alive[group], strict=True)]
            collector.put(begin + 1, number, segments, done)
            lost = np.full(self.scene.controls, np.nan)
            self.before[number] = np.array([segment.u[-1] if len(segment.u) else lost for segment in segments])
            return [(k, segment.failure) for k, segment in zip(done, segments, strict=True)]

        outcomes = [outcome for part in pool.map(work, range(len(self.groups))) for outcome in part]
        collector.reduce(begin + 1, end + 1, np.array([done for done, _ in outcomes]), pool)
        for path in np.flatnonzero(self.alive):
            done, failure = outcomes[path]
            if failure is not None:
                self.alive[path] = False
                self.failures.append(PathFailure(int(path), begin + done, failure.reason))


class _Collector:
    """Puts blocks of nodes into statistics and, if asked, into arrays of all paths."""

    def __init__(self, steps: int, block: int, levels: Floats, run: _Run, store: bool) -> None:
        self.run, self.levels = run, levels
        n, m, P = run.scene.robot.dof, run.scene.controls, run.paths
        self.done = 0
        self.mean = np.full((steps + 1, 2 * n), np.nan)
        self.covariance = np.full((steps + 1, 2 * n, 2 * n), np.nan)
        self.quantiles = np.full((len(levels), steps + 1, 2 * n), np.nan)
        self.energy = np.full((2, steps + 1), np.nan)
        self.count = np.zeros(steps + 1, dtype=np.int64)
        # A block of nodes of each group of paths, paths last: statistics run over them.
        self.blocks = [np.empty((block, 2 * n + 1, group.stop - group.start)) for group in run.groups]
        shapes = {"q": n, "v": n, "p": n}
        self.stored = {name: np.full((P, steps + 1, size), np.nan) for name, size in shapes.items()} if store else {}
        if store:
            self.stored |= {"energy": np.full((P, steps + 1), np.nan), "u": np.full((P, steps, m), np.nan)}

    def put(self, first: int, number: int, segments: list[Segment], done: list[int]) -> None:
        """Nodes of a group from node ``first`` on, ``done[i]`` of its i-th path; threads may put other groups."""
        n = self.run.scene.robot.dof
        momentum = self.run.integrator.variational
        for i, (segment, k) in enumerate(zip(segments, done, strict=True)):
            x = self.blocks[number][:k, :, i]
            x[:, :n], x[:, n:-1] = segment.q[:k], (segment.p if momentum else segment.v)[:k]
            x[:, -1] = segment.energy[:k]
            for name, array in self.stored.items():
                # The control that leads to a node stands one row before it, and none leads to the first.
                row = first - 1 if name == "u" else first
                if row >= 0:
                    array[self.run.groups[number].start + i, row : row + k] = getattr(segment, name)[:k]

    def reduce(self, first: int, last: int, done: NDArray[np.int64], pool: ThreadPoolExecutor) -> None:
        """Statistics of nodes first .. last, which have been put; path i has the first ``done[i]`` of them."""
        size = max(1, _SPAN // (self.run.paths * self.mean.shape[1]))
        spans = []
        begin = 0
        # Between two nodes at which paths fail, the same paths are counted.
        for end in np.unique(done[done > 0]):
            spans += [(a, min(a + size, end), done >= end) for a in range(begin, end, size)]
            begin = end
        list(pool.map(lambda span: self._reduce(first, *span), spans))
        self.done = last - 1

    def _reduce(self, first: int, begin: int, end: int, counted: NDArray[np.bool_]) -> None:
        """Statistics of nodes begin .. end of the blocks, which start at node ``first``, over the paths counted."""
        nodes = slice(first + begin, first + end)
        block = np.concatenate([part[begin:end] for part in self.blocks], axis=2)
        if not counted.all():
            block = np.compress(counted, block, axis=2)
        x, energy, paths = block[:, :-1], block[:, -1], block.shape[2]
        self.mean[nodes] = x.mean(axis=2)
        deviation = x - self.mean[nodes, :, None]
        self.covariance[nodes] = np.einsum("jaP,jbP->jab", deviation, deviation) / max(1, paths - 1)
        self.quantiles[:, nodes] = np.quantile(x, self.levels, axis=2)
        self.energy[0, nodes] = energy.mean(axis=1)
        self.energy[1, nodes] = energy.std(axis=1, ddof=paths > 1)
        self.count[nodes] = paths

    def ensemble(self) -> Ensemble:
        nodes = slice(0, self.done + 1)
        stored = {name: self.stored[name][:, nodes] if self.stored else None for name in ("q", "v", "p", "energy")}
        return Ensemble(
            t=np.arange(self.done + 1, dtype=np.float64) * self.run.dt,
            statistics=EnsembleStatistics(
                mean=self.mean[nodes],
                covariance=self.covariance[nodes],
                levels=self.levels,
                quantiles=self.quantiles[:, nodes],
                energy_mean=self.energy[0, nodes],
                energy_deviation=self.energy[1, nodes],
                count=self.count[nodes],
            ),
            u=self.stored["u"][:, : self.done] if self.stored else None,
            failures=tuple(self.run.failures),
            **stored,
        )
