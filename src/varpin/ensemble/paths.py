"""The work of one worker: the simulation of a chunk of paths, its moments, and a check of one path."""

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
from varpin.finding import Finding
from varpin.integrators import Integrator, Segment
from varpin.mechanics.custom import CustomForceError
from varpin.mechanics.scene import Scene
from varpin.mechanics.wiener import Children
from varpin.signals.commands import as_moved, lines, rows, with_ends
from varpin.simulation.check import check
from varpin.simulation.loop import Gains, unstable_loop
from varpin.simulation.record import Motions, located
from varpin.support.frozen import Frozen

# By quantity ("split", "energy", "speed"): its largest value, and the path that has it.
Extremes = dict[str, tuple[float, int]]

# Paths in one call of the core.
_GROUP = 32
# A worker simulates one chunk of paths at a time. Its size depends on the ensemble alone, so that sums do not depend on
# the number of workers: the number of chunks aimed at, then bounds of a chunk in steps and in paths.
_CHUNKS, _LEAST_STEPS, _MOST_STEPS, _FEWEST_PATHS, _MOST_PATHS = 64, 4_000, 200_000, 16, 1024


def without_geometry(scene: Scene) -> Scene:
    """The scene without its robot's shapes: no simulation needs them, and meshes are large to send to a worker."""
    bare = copy.copy(scene)
    vars(bare)["robot"] = dataclasses.replace(scene.robot, visuals=None, parts=())
    return bare


def chunks(steps: int, paths: int) -> Iterator[tuple[int, int]]:
    """The first path of each chunk, and one past its last."""
    steps = max(1, steps)
    size = min(max(math.ceil(paths / _CHUNKS), _LEAST_STEPS // steps), _MOST_STEPS // steps, _MOST_PATHS)
    size = max(size, _FEWEST_PATHS) if size <= _GROUP else math.ceil(size / _GROUP) * _GROUP
    return ((first, min(first + size, paths)) for first in range(0, paths, size))


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
    """A chunk of C paths to simulate, and which results to return."""

    shared: Shared
    first: int  # index of the first path
    q0: Floats  # (C, n) [rad or m]
    v0: Floats  # (C, n) [rad/s or m/s]
    kept: tuple[str, ...] = ()  # names of the arrays to return
    moments: bool = True  # whether to return moments


@dataclass(frozen=True, eq=False)
class Moments(Frozen):
    """Sums over some paths at each of N + 1 nodes."""

    count: Integers  # (N + 1,)
    mean: Floats  # of x and of the energy (N + 1, 2n + 1)
    squares: Floats  # sums of products of the deviations of x from its mean (N + 1, 2n, 2n)
    energy: Floats  # sums of squared deviations of the energy from its mean (N + 1,)

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
        squares = np.einsum("jaP,jbP->jab", x[:, :-1], x[:, :-1])
        return cls(count, mean, squares, np.einsum("jP,jP->j", x[:, -1], x[:, -1]))

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
    """Results of a chunk of C paths."""

    first: int  # index of its first path
    nodes: Integers  # number of nodes of each path (C,)
    failures: tuple[PathFailure, ...]
    extremes: Extremes
    moments: Moments | None
    stored: dict[str, Floats]  # the arrays that the task asks for (C, ...), NaN after a failure


def simulate_paths(task: Task) -> Part:
    """Simulate a chunk in one thread. The bytes of a path do not depend on the chunk that it is in."""
    shared, P = task.shared, len(task.q0)
    names = dict.fromkeys(["q", shared.second, "energy", *task.kept])
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
    q, second, energy = arrays["q"], arrays[shared.second], arrays["energy"]
    extremes = {}
    for name, values in (("split", split), ("energy", energy), ("speed", np.abs(second))):
        most = np.fmax.reduce(values.reshape(P, -1), axis=1, initial=-np.inf)
        extremes[name] = float(most.max()), task.first + int(np.argmax(most))
    moments = None
    if task.moments:
        # Statistics run over the paths, which are the last axis.
        x = np.empty((q.shape[1], 2 * q.shape[2] + 1, P))
        np.concatenate([part.transpose(1, 2, 0) for part in (q, second, energy[:, :, None])], axis=1, out=x)
        moments = Moments.of(x, nodes)
    return Part(task.first, nodes, tuple(failures), extremes, moments, {name: arrays[name] for name in task.kept})


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
    except CustomForceError as error:
        raise _located(task, range(first, last), error) from error


def _located(task: Task, paths: range, error: CustomForceError) -> VarpinError:
    """The error of a custom force, with the path and the step where it failed and the motion up to there."""
    shared = task.shared
    for path in paths:
        start = task.q0[path - task.first], task.v0[path - task.first]
        (drawn,) = shared.drawn(path, path + 1)
        given = shared.scene, shared.integrator, start, shared.commands, shared.dt, drawn
        found = located(*given, error, f"path {path}: ")
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


def examine(task: Task) -> tuple[Finding, ...]:
    """Findings about one path."""
    shared = task.shared
    (drawn,) = shared.drawn(task.first, task.first + 1)
    motions = Motions(shared.scene, shared.integrator, task.q0[0], task.v0[0], shared.dt)
    motion, _ = motions.under(shared.commands, increments=drawn)
    # The loop's check is for held controls.
    held = len(shared.commands.gains) and not shared.linear
    gains = Gains(shared.commands.gains, shared.integrator.variational)
    loop = unstable_loop(shared.scene, motion, shared.commands.hold, gains) if held else ()
    return (*loop, *check(shared.scene, shared.integrator, motion, shared.commands if held else None).warnings)
