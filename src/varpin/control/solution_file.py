"""Solutions in files: npz without pickle, with the state of the search and without the problem."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from varpin.control.between_nodes import enforced
from varpin.control.multipliers import Multipliers
from varpin.control.problem import OptimalControlProblem
from varpin.errors import FileError
from varpin.io.archive import members_of, read_npz, record_of, write_npz
from varpin.model import Robot
from varpin.support.checks import path_like
from varpin.trajectory import Trajectory

if TYPE_CHECKING:
    from varpin.control.solution import Solution

_FORMAT = "varpin.solution/5"


def write(path: str | os.PathLike[str], plan: Solution) -> Path:
    """Write a solution; see :meth:`Solution.save`."""
    members = members_of(replace(plan.trajectory, scene_values={})) | members_of(plan)
    # The numbers of the scene are those of the motion.
    for name, value in plan.problem.setting.items():
        members[name if name.startswith("scene.") else f"problem.{name}"] = value
    return write_npz(path, _FORMAT, members)


def read(kind: type[Solution], path: str | os.PathLike[str], problem: OptimalControlProblem) -> Solution:
    """Read a solution from a file; see :meth:`Solution.load` for errors."""
    source = path_like("path", path)
    members, scene = read_npz(source, _FORMAT), problem.scene
    # First the motion, whose masses give a clearer message for another robot.
    motion = replace(Trajectory.of_members(source, members, scene.robot), scene_values=scene.values)
    known = [name for name in members if name.startswith(("problem.", "scene."))]
    setting = {name.removeprefix("problem."): np.asarray(members[name]) for name in known}
    if difference := problem.differs(setting):
        raise FileError(f"{source} is of another problem: {difference}")
    sizes = {"decisions": problem.decisions, "controls": scene.controls, "states": 2 * scene.robot.dof}
    plan = record_of(kind, members, source, sizes=sizes, known={"problem": problem, "trajectory": motion})
    if other := problem.mismatch(setting, motion, plan.cost):
        raise FileError(f"{source} is {other}")
    if bool(problem.constraints) != (plan.multipliers is not None):
        raise FileError(f"{source}: multipliers of the problem's constraints do not belong to it, or are missing")
    if plan.multipliers is not None:
        _require_rows(source, plan.multipliers, problem)
    if (problem.rate is not None or problem.linear) and plan.previous_gains is None:
        raise FileError(f"{source}: previous_gains is missing")
    made = len(plan.history)
    if plan.search is not None and not 0 <= plan.search.iterations <= made:
        raise FileError(f"{source}: search.iterations is {plan.search.iterations}, where 0 to {made} belongs")
    return plan


def solution_trajectory(path: str | os.PathLike[str], robot: Robot | None = None) -> Trajectory:
    """Read only the motion of a solution, without its problem.

    Raises:
        FileError: As :meth:`Trajectory.load`.
    """
    source = path_like("path", path)
    return Trajectory.of_members(source, read_npz(source, _FORMAT), robot)


def _require_rows(source: Path, multipliers: Multipliers, problem: OptimalControlProblem) -> None:
    """Refuse multipliers of another number of rows, or of instants that the problem does not have."""
    between = multipliers.between
    last = len(problem.constraints), problem.steps
    if not ((between.rows >= 0) & (between.rows < last)).all():
        raise FileError(f"{source}: multipliers.between.rows are not in the problem's steps")
    every = sum(item.size for item in enforced(problem, between).bound_constraints)
    at_nodes = sum(item.size for item in problem.bound_constraints)
    for name, expected in (("values", every), ("backoff", every), ("added", at_nodes)):
        found = getattr(multipliers, name)
        if found is not None and found.size != expected:
            raise FileError(f"{source}: multipliers.{name} has shape ({found.size},), where ({expected},) belongs")
