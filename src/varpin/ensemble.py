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
from varpin.integrators import Integrator, Midpoint, Segment
from varpin.integrators.base import rows
from varpin.kernels._compile import announced_compilation
from varpin.kernels.tree import Commands
from varpin.policy import LinearPolicy
from varpin.scene import Scene, require_scene
from varpin.simulation import commands_of
from varpin.wiener import generator

Floats = NDArray[np.float64]

logger = logging.getLogger(__name__)

# Paths that one kernel call takes, and how many numbers a block of nodes may hold.
_GROUP = 32
_BLOCK = 8_000_000


@dataclass(frozen=True, eq=False)
class EnsembleStatistics:
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
class Ensemble:
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
    _require_memory(scene, steps, paths if store else 0)
    commands = commands_of(scene, controls, steps)
    run = _Run(scene, integrator, dt, start, rng, commands)
    collector = _Collector(steps, levels, run, store)
    block = min(steps, _BLOCK // (paths * (4 * n + scene.controls + scene.processes + 8)))
    block = max(1, block // commands.hold) * commands.hold
    with announced_compilation(), ThreadPoolExecutor(workers) as pool:
        try:
            collector.add_first(run.first)
            for begin in range(0, steps, block):
                end = min(steps, begin + block)
                collector.add(begin, end, *run.advance(begin, end, pool))
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


def _require_memory(scene: Scene, steps: int, stored: int) -> None:
    """Refuse a record that cannot be held, before anything runs."""
    n, m = scene.robot.dof, scene.controls
    row = 2 * n * (2 * n + 5) + m + stored * (3 * n + m + 1)
    try:
        np.empty((steps + 1, row))
    except (MemoryError, ValueError, OverflowError):
        raise InputError(
            f"steps = {steps} with {stored} stored paths needs more memory than there is: {row * 8} bytes a step"
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
        self.states = []
        self.first: list[Segment] = []
        for group in self.groups:
            state, first = integrator.start(scene, start[0][group], start[1][group])
            self.states.append(state)
            self.first += first

    def advance(self, begin: int, end: int, pool: ThreadPoolExecutor) -> tuple[list[Segment], NDArray[np.int64]]:
        """Steps begin .. end of every path, and how many of them each path did: none once it has failed."""
        decisions = rows(self.commands, begin // self.commands.hold, end // self.commands.hold)

        def work(number: int) -> list[Segment]:
            group = self.groups[number]
            shape = (end - begin, self.scene.processes)
            drawn = np.array([generator.normal(size=shape) for generator in self.generators[group]])
            increments = np.sqrt(self.dt) * drawn
            return self.integrator.rollout(self.scene, self.states[number], decisions, increments, self.dt)

        segments = [segment for part in pool.map(work, range(len(self.groups))) for segment in part]
        done = np.zeros(self.paths, dtype=np.int64)
        for path in np.flatnonzero(self.alive):
            segment = segments[path]
            done[path] = len(segment.q)
            if segment.failure is not None:
                self.alive[path] = False
                self.failures.append(PathFailure(int(path), begin + len(segment.q), segment.failure.reason))
        return segments, done


class _Collector:
    """Puts blocks of nodes into statistics and, if asked, into arrays of all paths."""

    def __init__(self, steps: int, levels: Floats, run: _Run, store: bool) -> None:
        self.run, self.levels = run, levels
        n, m, P = run.scene.robot.dof, run.scene.controls, run.paths
        self.done = 0
        self.mean = np.full((steps + 1, 2 * n), np.nan)
        self.covariance = np.full((steps + 1, 2 * n, 2 * n), np.nan)
        self.quantiles = np.full((len(levels), steps + 1, 2 * n), np.nan)
        self.energy = np.full((2, steps + 1), np.nan)
        self.count = np.zeros(steps + 1, dtype=np.int64)
        shapes = {"q": n, "v": n, "p": n}
        self.stored = {name: np.full((P, steps + 1, size), np.nan) for name, size in shapes.items()} if store else {}
        if store:
            self.stored |= {"energy": np.full((P, steps + 1), np.nan), "u": np.full((P, steps, m), np.nan)}

    def add_first(self, segments: list[Segment]) -> None:
        self._enter(slice(0, 1), segments, np.ones(len(segments), dtype=np.int64))

    def add(self, begin: int, end: int, segments: list[Segment], done: NDArray[np.int64]) -> None:
        """Steps begin .. end, of which path i did the first ``done[i]``."""
        if self.stored:
            for path, segment in enumerate(segments):
                self.stored["u"][path, begin : begin + done[path]] = segment.u[: done[path]]
        self._enter(slice(begin + 1, end + 1), segments, done)

    def _enter(self, nodes: slice, segments: list[Segment], done: NDArray[np.int64]) -> None:
        velocity = "p" if self.run.integrator.variational else "v"
        for path, segment in enumerate(segments):
            for name in ("q", "v", "p", "energy") if self.stored else ():
                self.stored[name][path, nodes.start : nodes.start + done[path]] = getattr(segment, name)[: done[path]]
        # Between two nodes at which paths fail, the same paths are counted.
        first = 0
        for last in np.unique(done[done > 0]):
            counted = [segment for segment, k in zip(segments, done, strict=True) if k >= last]
            self._reduce(
                slice(nodes.start + first, nodes.start + last),
                np.array([np.hstack([s.q[first:last], getattr(s, velocity)[first:last]]) for s in counted]),
                np.array([s.energy[first:last] for s in counted]),
            )
            first = last
        self.done = nodes.stop - 1

    def _reduce(self, nodes: slice, x: Floats, energy: Floats) -> None:
        """Statistics of x (P, N, 2n) and of the energy (P, N)."""
        self.mean[nodes] = x.mean(axis=0)
        deviation = x - self.mean[nodes]
        self.covariance[nodes] = np.einsum("Pja,Pjb->jab", deviation, deviation) / max(1, len(x) - 1)
        self.quantiles[:, nodes] = np.quantile(x, self.levels, axis=0)
        self.energy[0, nodes] = energy.mean(axis=0)
        self.energy[1, nodes] = energy.std(axis=0, ddof=len(x) > 1)
        self.count[nodes] = len(x)

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
