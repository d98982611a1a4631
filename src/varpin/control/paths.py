"""Paths of a problem under a policy and noise, in chunks that the core integrates."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from varpin.control.costs import CostSum
from varpin.control.problem import OptimalControlProblem
from varpin.ensemble.paths import Shared, Task, chunks, without_geometry
from varpin.mechanics.wiener import Children
from varpin.signals.controls import commands_of
from varpin.signals.policy import LinearPolicy
from varpin.support.frozen import Frozen


@dataclass(frozen=True, eq=False)
class Chunk(Frozen):
    """A chunk of paths that the core integrates."""

    problem: OptimalControlProblem
    task: Task


def sent(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The problem without the robot's shapes and the cost's references, which no path needs."""
    bare = copy.copy(problem)
    vars(bare).update(scene=without_geometry(problem.scene), cost=CostSum(()))
    return bare


def shared_by(problem: OptimalControlProblem, policy: LinearPolicy, seeds: Children) -> Shared | None:
    """What all paths share; None where only Python evaluates the noise, so that the core cannot integrate paths."""
    if problem.scene.noise.diffusion is None:
        return None
    commands = commands_of(problem.scene, problem.integrator, policy, problem.steps, problem.dt)
    return Shared(problem.scene, problem.integrator, commands, problem.dt, problem.steps, seeds)


def chunks_of(problem: OptimalControlProblem, shared: Shared, begin: int, end: int) -> Iterator[Chunk]:
    """The chunks of the paths begin, ..., end - 1 from the problem's initial state."""
    for first, last in chunks(shared.steps, end - begin):
        q0, v0 = (np.tile(x, (last - first, 1)) for x in (problem.q0, problem.v0))
        yield Chunk(problem, Task(shared, begin + first, q0, v0, store=True, moments=False))
