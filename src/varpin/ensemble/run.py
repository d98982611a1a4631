"""Many noisy paths at once, on all cores or many machines, and their statistics."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.ensemble.paths import Part, Paths, Reduction, Shared, without_geometry
from varpin.ensemble.record import Ensemble, EnsembleStatistics
from varpin.errors import InputError, VarpinError
from varpin.finding import Finding, announce
from varpin.integrators import Integrator
from varpin.mechanics.scene import Scene, require_scene
from varpin.mechanics.wiener import children
from varpin.signals.controls import commands_of
from varpin.signals.policy import FirstOrderHold, LinearPolicy, OpenLoop
from varpin.simulation.choice import given_integrator, stronger, usual_integrator
from varpin.simulation.start import on_constraints, start_in_degrees, time_steps
from varpin.support.checks import (
    JointValues,
    as_floats,
    count,
    finite_array,
    flag,
    joint_array,
    require_finite,
    require_memory,
)
from varpin.support.frozen import Frozen

logger = logging.getLogger(__name__)

# Without stored paths, quantiles are those of as many of the first paths as have this many numbers, P (N + 1) 2n.
_KEPT = 2**25
# Quantiles are computed for runs of nodes with up to this many numbers; from 10,000 to 1,000,000.
_SPAN = 100_000
# Paths on which the integrator is chosen: one of every _OF, at most _CHOOSING.
_OF, _CHOOSING = 16, 8


def simulate_ensemble(
    scene: Scene,
    q0: JointValues,
    v0: JointValues,
    *,
    dt: float | None = None,
    steps: int | None = None,
    duration: float | None = None,
    paths: int,
    rng: np.random.Generator | int,
    controls: JointValues | LinearPolicy | OpenLoop | FirstOrderHold | None = None,
    integrator: Integrator | None = None,
    store: bool = True,
    quantiles: Sequence[float] = (0.05, 0.5, 0.95),
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Ensemble:
    """Simulate many paths of a noisy scene.

    Path i draws its noise from the i-th child of ``rng``, and moments are merged in the order of the paths. The result
    is therefore the same, byte for byte, for any number of threads, processes or machines of one kind.

    Main args:
        scene: The scene. Noise that only Python evaluates (:class:`varpin.CustomNoise`) is slow.
        q0: Initial configuration, (n,) or by joint name for all paths, or (P, n) [rad or m].
        v0: Initial velocity, the same [rad/s or m/s].
        dt: Time step [s].
        steps: N, their number.
        duration: steps * dt [s]. Two of the three are given.
        paths: P.
        rng: Seed or generator.
        controls: None, (N, m), (m,), by joint name, :class:`OpenLoop`, :class:`FirstOrderHold`, or a
            :class:`LinearPolicy`, evaluated at the state of each path.

    Other Args:
        integrator: If left out, that of the policy of a plan under noise; else ``Midpoint(kick="held")``. In a scene
            without noise, the integrator that :func:`varpin.simulate` takes for a few of the paths.
            ``Ensemble.integrator`` says which.
        store: Keep every path. Otherwise only the statistics are kept, and memory does not grow with P N.
        quantiles: Levels in [0, 1]; with an empty list, workers return moments alone. Quantiles are of all paths if
            these are stored, or if P (N + 1) 2n is at most 33 million; otherwise of as many of the first paths,
            ``statistics.quantile_paths``.
        workers: Number of threads; if left out the number of cores, and one under a ``CustomNoise``.
        executor: Any ``concurrent.futures.Executor`` instead of threads: a ``ProcessPoolExecutor``, Dask's
            ``client.get_executor()``, an ``mpi4py.futures.MPIPoolExecutor``. It stays open. At most
            256 chunks of paths are submitted and not yet merged; together they return at most 2 GiB, unless two chunks
            alone return more.
        progress: Called with (paths done, P) after each chunk.

    Raises:
        InputError: Wrong shapes, or values that are not finite.
        ForceError, ConstraintError, NoiseError: A function of a :class:`varpin.CustomForce`,
            :class:`varpin.CustomConstraint` or :class:`varpin.CustomNoise` failed. The error names the path and holds
            its motion up to the failure.
        AssemblyError: No configuration near q0 satisfies the scene's constraints.
        VarpinError: Every path failed.
        WorkersLost: The executor has lost its workers; holds the finished paths.
        PathsInterrupted: Ctrl-C; holds the finished paths. It is a KeyboardInterrupt.
    """
    require_scene(scene)
    dt, steps = time_steps(dt, steps, duration)
    paths, store = count("paths", paths, least=1), flag("store", store)
    _require_memory(scene, steps, paths, store=store)
    start = [_per_path(name, value, paths, scene.robot.joint_names) for name, value in (("q0", q0), ("v0", v0))]
    levels = require_finite("quantiles", as_floats("quantiles", quantiles))
    if levels.ndim != 1 or ((levels < 0.0) | (levels > 1.0)).any():
        raise InputError(f"quantiles must be levels in [0, 1], got {quantiles}")
    integrator = given_integrator(integrator, controls)
    if controls is None and (scene.servo_joints or scene.inputs):
        if (start[0] != start[0][0]).any():
            positions = "the scene has servos or inputs, and the paths begin at different positions"
            raise InputError(f"controls are needed: {positions}")
        controls = scene.command_at(start[0][0])
    start, moved = _onto_constraints(scene, start)
    if integrator is None:
        noisy = scene.processes > 0
        some = np.linspace(0, paths - 1, 1 if noisy else min(1 + paths // _OF, _CHOOSING)).astype(np.int64)
        integrator = stronger(usual_integrator(scene, start[0][j], start[1][j], dt, noisy=noisy) for j in some)
    commands = commands_of(scene, integrator, controls, steps, dt)
    shared = Shared(without_geometry(scene), integrator, commands, dt, steps, children(rng, paths))
    sums = Sums(shared, start[0], start[1], levels, store=store)
    found = sums.run(executor, workers, progress)
    if len(sums.failures) == paths:
        raise VarpinError(sums.failing())
    found = (*start_in_degrees(scene, start[0][0], start[1][0]), *moved, *_alike(scene, start), *found)
    announce(logger, scene.announced, dt, found)
    return sums.result(found)


def _onto_constraints(scene: Scene, start: Sequence[Floats]) -> tuple[list[Floats], tuple[Finding, ...]]:
    """Initial states (P, n) projected onto the constraints, and the findings about the first path that was changed."""
    if not scene.constraints:
        return list(start), ()
    alike = all((x == x[0]).all() for x in start)
    starts = list(zip(*start, strict=True))[: 1 if alike else None]
    q, v, found = zip(*(on_constraints(scene, *own) for own in starts), strict=True)
    findings = ([finding.about(f"path {path}: " * (not alike)) for finding in own] for path, own in enumerate(found))
    moved = [np.broadcast_to(np.array(x), start[0].shape) for x in (q, v)]
    return moved, tuple(next((own for own in findings if own), []))


def _alike(scene: Scene, start: Sequence[Floats]) -> tuple[Finding, ...]:
    """A finding if all paths are the same motion."""
    if scene.processes or len(start[0]) < 2 or any((x != x[0]).any() for x in start):
        return ()
    sentence = (
        "the scene has no noise and all paths begin alike, so that they are one and the same motion: "
        "varpin.Scene(robot, noise=...) tells them apart"
    )
    return (Finding("nothing random", sentence),)


def _require_memory(scene: Scene, steps: int, paths: int, *, store: bool) -> None:
    """Refuse an ensemble whose record does not fit into memory."""
    n, m = scene.robot.dof, scene.controls
    stored = paths if store else 0
    row = 2 * n * (4 * n + 5) + m + stored * (3 * n + m + 1)
    require_memory(steps + 1, row, f"steps = {steps} with {stored} stored paths", "step")
    require_memory(paths, 2 * n, f"paths = {paths}", "path")


def _per_path(name: str, value: JointValues, paths: int, joints: Sequence[str]) -> Floats:
    n = len(joints)
    array = joint_array(name, value, joints) if isinstance(value, Mapping) else as_floats(name, value)
    if array.shape == (n,):
        return np.broadcast_to(finite_array(name, array, (n,)), (paths, n))
    return finite_array(name, array, (paths, n))


@dataclass(frozen=True, eq=False)
class Moments(Frozen):
    """Sums over some paths at each of N + 1 nodes."""

    count: Integers  # (N + 1,)
    mean: Floats  # of x and the energy (N + 1, 2n + 1)
    squares: Floats  # sums of products of their deviations from the mean (N + 1, 2n + 1, 2n + 1)

    # Paths that blow up may have squares that are infinite.
    @classmethod
    @np.errstate(over="ignore", invalid="ignore")
    def of(cls, x: Floats, nodes: Integers) -> Moments:
        """Sums of x and the energy (N + 1, 2n + 1, C), the first ``nodes`` (C,) of each path; x is overwritten."""
        gone = np.arange(len(x))[:, None] >= nodes
        count = len(nodes) - gone.sum(axis=1)
        np.copyto(x, 0.0, where=gone[:, None])
        mean = x.sum(axis=2) / np.maximum(count, 1)[:, None]
        x -= mean[:, :, None]
        np.copyto(x, 0.0, where=gone[:, None])
        return cls(count, mean, np.einsum("jaP,jbP->jab", x, x))

    @np.errstate(over="ignore", invalid="ignore")
    def merged(self, other: Moments) -> Moments:
        """Sums over the paths of both (Chan, Golub and LeVeque 1979)."""
        total = self.count + other.count
        share = other.count / np.maximum(total, 1)
        apart = other.mean - self.mean
        products = ((self.count * share)[:, None] * apart)[:, :, None] * apart[:, None, :]
        return Moments(total, self.mean + apart * share[:, None], self.squares + other.squares + products)


def moments_of(
    arrays: dict[str, Floats], nodes: Integers, *, second: str, kept: tuple[str, ...]
) -> tuple[Moments, Integers, dict[str, Floats]]:
    """The moments of a chunk's paths, their numbers of nodes, and the arrays that are kept."""
    whole = np.concatenate([arrays["q"], arrays[second], arrays["energy"][:, :, None]], axis=2)
    # Statistics run over the paths, which are the last axis.
    x = np.ascontiguousarray(whole.transpose(1, 2, 0))
    return Moments.of(x, nodes), nodes, {name: arrays[name] for name in kept}


class Sums(Paths):
    """Sums over the chunks, which are added in the order of the paths."""

    def __init__(self, shared: Shared, q0: Floats, v0: Floats, levels: Floats, *, store: bool) -> None:
        super().__init__(shared, q0, v0)
        self.levels, self.store, paths = levels, store, len(q0)
        self.moments: Moments | None = None
        # Paths whose arrays are kept, for the record or for quantiles.
        width = 2 * (shared.steps + 1) * shared.scene.robot.dof
        self.known = paths if store else min(paths, max(1, _KEPT // width)) if len(levels) else 0
        self.nodes = np.zeros(self.known, dtype=np.int64)
        names = ("q", "v", "p", "energy", "u") if store else ("q", shared.second)
        self.stored = {name: np.empty((self.known, *shared.shape(name))) for name in names}

    def reduction(self, first: int) -> tuple[tuple[str, ...], Reduction]:
        kept = tuple(self.stored) if first < self.known else ()
        return kept, functools.partial(moments_of, second=self.shared.second, kept=kept)

    def part_bytes(self) -> int:
        """Size of a chunk's result [bytes], the arrays alone."""
        _, paths = next(self.shared.chunks(len(self.q0)))
        size = 2 * self.shared.scene.robot.dof + 1
        row = sum(array[:1].nbytes for array in self.stored.values()) if self.known else 0
        return 8 * (self.shared.steps + 1) * (size**2 + size + 1) + paths * (8 + row)

    def take(self, part: Part) -> None:
        moments, nodes, stored = part.found
        self.moments = moments if self.moments is None else self.moments.merged(moments)
        room = slice(part.first, min(part.first + part.paths, self.known))
        self.nodes[room] = nodes[: self.nodes[room].size]
        for name, array in stored.items():
            self.stored[name][room] = array[: self.nodes[room].size]

    def result(self, found: Sequence[Finding]) -> Ensemble:
        moments = self.moments
        assert moments is not None
        there = moments.count > 0
        mean = np.where(there[:, None], moments.mean, np.nan)
        degrees = np.maximum(moments.count - 1, 1)
        covariance = np.where(there[:, None, None], moments.squares / degrees[:, None, None], np.nan)
        stored = {name: array[: self.done] for name, array in self.stored.items()} if self.store else {}
        return Ensemble(
            t=np.arange(self.shared.steps + 1, dtype=np.float64) * self.shared.dt,
            statistics=EnsembleStatistics(
                mean=mean[:, :-1].copy(),
                covariance=covariance[:, :-1, :-1].copy(),
                levels=self.levels,
                quantiles=self._quantiles(),
                quantile_paths=min(self.known, self.done),
                energy_mean=mean[:, -1].copy(),
                energy_deviation=np.sqrt(covariance[:, -1, -1]),
                count=moments.count,
            ),
            **stored,
            failures=tuple(self.failures),
            warnings=tuple(found),
            integrator=str(self.shared.integrator),
            joint_names=self.shared.scene.robot.joint_names,
        )

    def _quantiles(self) -> Floats:
        known, states, names = min(self.known, self.done), 2 * self.shared.scene.robot.dof, ("q", self.shared.second)
        found = np.full((len(self.levels), self.shared.steps + 1, states), np.nan)
        if not len(self.levels):
            return found
        nodes, span = self.nodes[:known], max(1, _SPAN // (known * states))
        # Between two nodes at which paths fail, the set of paths is the same.
        cuts = np.union1d(nodes, np.arange(0, nodes.max(), span)).tolist()

        def take(first: int, last: int) -> None:
            x = np.concatenate([self.stored[name][:known, first:last] for name in names], axis=2)
            found[:, first:last] = np.quantile(x[nodes >= last], self.levels, axis=0)

        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            list(pool.map(take, cuts[:-1], cuts[1:]))
        return found
