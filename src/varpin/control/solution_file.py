"""Solutions in files: npz without pickle, with the state of the search and without the problem."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np

from varpin.arrays import Floats
from varpin.control.between_nodes import enforced
from varpin.control.history import Iteration, Refined, Refinement, SearchState, Status
from varpin.control.multipliers import Multipliers
from varpin.control.problem import OptimalControlProblem
from varpin.errors import FileError
from varpin.finding import Finding
from varpin.io.archive import Axes, members_of, read_npz, record_of, write_npz
from varpin.model import Robot
from varpin.support.checks import path_like
from varpin.trajectory import Trajectory

Row = TypeVar("Row", Iteration, Refined)

_FORMAT = "varpin.solution/4"
# How numbers of a table are read, by the annotation of their field.
_READ: Mapping[str, Callable[[float], Any]] = {
    "int": int,
    "bool": bool,
    "float": float,
    "Status": lambda number: tuple(Status)[int(number)],
}


@dataclass(frozen=True, eq=False)
class _Refinement:
    """A :class:`Refinement` whose steps are rows of a table."""

    wish: float
    met: bool
    tried: Annotated[Floats, Axes("refined", len(fields(Refined)))]
    chosen: int
    reason: str


@dataclass(frozen=True, eq=False)
class _Plan:
    """A :class:`Solution` without its problem and its motion. The history has a row for each iteration."""

    gains: Annotated[Floats, Axes("decisions", "controls", "states", finite=True)]
    feedforward: Annotated[Floats, Axes("decisions", "controls", finite=True)]
    gradient: Annotated[Floats, Axes("decisions", "controls")]
    cost: float
    noise_cost: float
    status: str
    reason: str
    warnings: tuple[Finding, ...] = field(metadata={"entry": "plan.warnings"})
    history: Annotated[Floats, Axes("iterations", len(fields(Iteration)))]
    previous_gains: Annotated[Floats, Axes("decisions", "controls", "controls", finite=True)] | None = None
    refinement: _Refinement | None = None
    search: SearchState | None = None
    multipliers: Multipliers | None = None


def write(path: str | os.PathLike[str], solution: Mapping[str, Any]) -> Path:
    """Write the fields of a :class:`Solution`; see :meth:`Solution.save`."""
    given = {item.name: solution[item.name] for item in fields(_Plan)}
    refinement: Refinement | None = given["refinement"]
    if refinement is not None:
        steps = _table(Refined, refinement.tried)
        given["refinement"] = _Refinement(refinement.wish, refinement.met, steps, refinement.chosen, refinement.reason)
    given |= {"status": solution["status"].name, "history": _table(Iteration, solution["history"])}
    members: dict[str, Any] = members_of(replace(solution["trajectory"], scene_values={})) | members_of(_Plan(**given))
    # The numbers of the scene are those of the motion.
    for name, value in solution["problem"].setting.items():
        members[name if name.startswith("scene.") else f"problem.{name}"] = value
    return write_npz(path, _FORMAT, members)


def read(path: str | os.PathLike[str], problem: OptimalControlProblem) -> dict[str, Any]:
    """Read the fields of a :class:`Solution` from a file; see :meth:`Solution.load` for errors."""
    source = path_like("path", path)
    members, scene = read_npz(source, _FORMAT), problem.scene
    # First the motion, whose masses give a clearer message for another robot.
    motion = replace(Trajectory.of_members(source, members, scene.robot), scene_values=scene.values)
    known = [name for name in members if name.startswith(("problem.", "scene."))]
    setting = {name.removeprefix("problem."): np.asarray(members[name]) for name in known}
    if difference := problem.differs(setting):
        raise FileError(f"{source} is of another problem: {difference}")
    sizes = {"decisions": problem.decisions, "controls": scene.controls, "states": 2 * scene.robot.dof}
    plan = record_of(_Plan, members, source, sizes=sizes)
    if plan.status not in Status.__members__:
        raise FileError(f"{source}: there is no status {plan.status!r}")
    if other := problem.mismatch(setting, motion, plan.cost):
        raise FileError(f"{source} is {other}")
    if bool(problem.constraints) != (plan.multipliers is not None):
        raise FileError(f"{source}: multipliers of the problem's constraints do not belong to it, or are missing")
    if plan.multipliers is not None:
        _require_rows(source, plan.multipliers, problem)
    if (problem.rate is not None or problem.linear) and plan.previous_gains is None:
        raise FileError(f"{source}: previous_gains is missing")
    history, refinement = _rows(Iteration, source, "history", plan.history), None
    if plan.search is not None and not 0 <= plan.search.iterations <= len(history):
        raise FileError(f"{source}: search.iterations is {plan.search.iterations}, where 0 to {len(history)} belongs")
    if plan.refinement is not None:
        tried = _rows(Refined, source, "refinement.tried", plan.refinement.tried)
        given = {item.name: getattr(plan.refinement, item.name) for item in fields(Refinement)}
        refinement = Refinement(**given | {"tried": tried})
    given = {item.name: getattr(plan, item.name) for item in fields(_Plan)}
    given |= {"status": Status[plan.status], "history": history, "refinement": refinement}
    return given | {"problem": problem, "trajectory": motion}


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


def _table(kind: type[Row], rows: Sequence[Row]) -> Floats:
    """One row of numbers for each record."""
    values = [[getattr(row, item.name) for item in fields(kind)] for row in rows]
    numbers = [[float(tuple(Status).index(x) if isinstance(x, Status) else x) for x in row] for row in values]
    return np.array(numbers).reshape(-1, len(fields(kind)))


def _rows(kind: type[Row], source: Path, name: str, table: Floats) -> tuple[Row, ...]:
    """The records of a table."""
    kinds = [str(item.type) for item in fields(kind)]
    counts = table[:, [own != "float" for own in kinds]]
    states = table[:, [own == "Status" for own in kinds]]
    if not ((counts >= 0.0) & (counts == np.floor(counts))).all() or (states >= len(Status)).any():
        raise FileError(f"{source}: {name} has counts that are no whole numbers")
    return tuple(kind(*(_READ[own](x) for own, x in zip(kinds, row, strict=True))) for row in table.tolist())
