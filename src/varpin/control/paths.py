"""Paths of a problem under a policy and noise: their costs, and how they violate constraints with a margin."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.control.constraints import BoundConstraint
from varpin.control.costs import CostSum
from varpin.control.problem import OptimalControlProblem
from varpin.ensemble.paths import Extremes, Shared, Task, chunks, simulate_paths, without_geometry
from varpin.mechanics.wiener import Children
from varpin.signals.controls import commands_of
from varpin.signals.policy import LinearPolicy
from varpin.simulation.failures import NoiseError, StepFailure
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Paths(Frozen):
    """The paths first, ..., last - 1 of a problem under a policy."""

    problem: OptimalControlProblem
    policy: LinearPolicy
    seeds: Children  # one child of the random generator for each path
    shared: Shared | None  # what the core needs; None where only Python evaluates the noise
    first: int
    last: int
    keep: int = 0  # of the largest values of each row of a constraint with a margin

    @classmethod
    def of(
        cls, problem: OptimalControlProblem, policy: LinearPolicy, seeds: Children, paths: int, keep: int = 0
    ) -> Paths:
        """All paths, of the problem without the robot's shapes and the cost's references, which no path needs."""
        bare, shared = copy.copy(problem), None
        vars(bare).update(scene=without_geometry(problem.scene), cost=CostSum(()))
        if problem.scene.noise.diffusion is not None:
            commands = commands_of(bare.scene, problem.integrator, policy, problem.steps, problem.dt)
            shared = Shared(bare.scene, problem.integrator, commands, problem.dt, problem.steps, seeds)
        return cls(bare, policy, seeds, shared, 0, paths, keep)

    def chunks(self) -> Iterator[Paths]:
        """The paths in parts: as the core integrates them, or one by one."""
        parts = ((k, k + 1) for k in range(self.last)) if self.shared is None else chunks(self.shared.steps, self.last)
        return (self.changed(first=first, last=last) for first, last in parts)


@dataclass(frozen=True, eq=False)
class Found(Frozen):
    """What C paths have shown; the last two of each constraint with a margin."""

    costs: Floats  # (C,), NaN where one failed
    extremes: Extremes  # the extreme paths, to check
    counts: tuple[Integers, ...]  # of paths that violate it, by places and rows
    largest: tuple[Floats, ...]  # its largest values, in no order, (at most keep, K, rows)


def simulated(paths: Paths) -> Found:
    """Simulate a chunk of paths."""
    problem, extremes = paths.problem, Extremes()
    if paths.shared is not None:
        q0, v0 = (np.tile(x, (paths.last - paths.first, 1)) for x in (problem.q0, problem.v0))
        part = simulate_paths(Task(paths.shared, paths.first, q0, v0, store=True, moments=False))
        extremes, stored = part.extremes, part.stored
        q, v, u = stored["q"], stored["v"], stored["u_nodes" if problem.linear else "u"]
    else:
        q = v = np.full((1, problem.steps + 1, problem.scene.robot.dof), np.nan)
        u = np.full((1, problem.steps + problem.linear, problem.scene.controls), np.nan)
        with contextlib.suppress(StepFailure, NoiseError):
            motion = path_of(paths)
            q, v, u = motion.q[None], motion.v[None], problem.control_rows(motion)[None]
    costs = problem.costs(q, v, u)
    finished = np.isfinite(costs)
    values = [
        bound.value(q[finished], v[finished], u[finished]) if finished.any() else np.zeros((0, *bound.shape))
        for bound in with_margins(problem)
    ]
    counts = tuple((c > 0.0).sum(axis=0) for c in values)
    return Found(costs, extremes, counts, tuple(_largest(c, paths.keep) for c in values))


def path_of(paths: Paths) -> Trajectory:
    """The first of the paths, whose noise Python evaluates."""
    (child,) = paths.seeds.generators(paths.first, paths.first + 1)
    return paths.problem.simulate(paths.policy, rng=child)


def joined(parts: Sequence[Found], keep: int) -> Found:
    """What all paths have shown; the parts' extremes are left out."""
    counts = tuple(np.sum(own, axis=0) for own in zip(*(part.counts for part in parts), strict=True))
    largest = zip(*(part.largest for part in parts), strict=True)
    return Found(
        costs=np.concatenate([part.costs for part in parts]),
        extremes={},
        counts=counts,
        largest=tuple(_largest(np.concatenate(own), keep) for own in largest),
    )


def with_margins(problem: OptimalControlProblem) -> list[BoundConstraint]:
    """The constraints with a margin, which are all on the state."""
    return [bound for bound in problem.bound_constraints if bound.source.margin > 0.0]


def _largest(c: Floats, keep: int) -> Floats:
    """The largest ``keep`` of the values (C, K, rows) of each row at each place."""
    first = max(len(c) - keep, 0)
    found: Floats = np.partition(c, first, axis=0)[first:] if first < len(c) else c[:0]
    return found
