"""Solutions in files: npz without pickle, with the state of the search and without the problem."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.control.between_nodes import MOST_INSTANTS, UNUSED, enforced, in_force, watched
from varpin.control.history import Iteration, Refined, Refinement, SearchState, Status
from varpin.control.multipliers import Multipliers
from varpin.control.problem import OptimalControlProblem
from varpin.errors import FileError
from varpin.finding import Finding
from varpin.io.archive import Axes, members_of, read_npz, record_of, write_npz
from varpin.mechanics.scene import same
from varpin.model import Robot
from varpin.support.checks import path_like
from varpin.trajectory import Trajectory

Members = Mapping[str, NDArray[Any]]

_FORMAT = "varpin.solution/3"
_PROBLEM = ("q0", "v0", "t0", "steps", "hold", "controls", "between_nodes", "sampling", "control_limits")
_STATUSES = tuple(Status)
_REFINED = tuple(item.name for item in fields(Refined) if item.name != "status")
# The columns of a history; the truth values of `second_order` are an entry of their own, which older files do not have.
_COLUMNS = tuple(item.name for item in fields(Iteration) if item.type != "bool")


@dataclass(frozen=True, eq=False)
class _Refinement:
    """A :class:`Refinement` without the rows of the steps tried."""

    wish: float
    met: int
    chosen: int
    reason: str


@dataclass(frozen=True, eq=False)
class _Plan:
    """A :class:`Solution` without its problem and its motions. The history has a row for each iteration."""

    gains: Annotated[Floats, Axes("decisions", "controls", "states", finite=True)]
    feedforward: Annotated[Floats, Axes("decisions", "controls", finite=True)]
    gradient: Annotated[Floats, Axes("decisions", "controls")]
    cost: float
    noise_cost: float
    status: str
    reason: str
    warnings: tuple[Finding, ...] = field(metadata={"entry": "plan.warnings"})
    history: Annotated[Floats, Axes("iterations", len(_COLUMNS))]
    previous_gains: Annotated[Floats, Axes("decisions", "controls", "controls", finite=True)] | None = None
    second_order: Annotated[Floats, Axes("iterations")] | None = None
    refined: Annotated[Floats, Axes("refined", len(_REFINED) + 1)] | None = None
    refinement: _Refinement | None = None
    search: SearchState | None = None
    multipliers: Multipliers | None = None


def write(path: str | os.PathLike[str], solution: Mapping[str, Any]) -> Path:
    """Write the fields of a :class:`Solution`; see :meth:`Solution.save`."""
    problem: OptimalControlProblem = solution["problem"]
    members: dict[str, Any] = members_of(replace(solution["trajectory"], scene_values={}))
    apart = ("refined", "refinement", "second_order")
    given = {item.name: solution[item.name] for item in fields(_Plan) if item.name not in apart}
    refinement: Refinement | None = solution["refinement"]
    if refinement is not None:
        given["refined"] = np.array(
            [
                [*(float(getattr(row, name)) for name in _REFINED), _STATUSES.index(row.status)]
                for row in refinement.tried
            ]
        ).reshape(-1, len(_REFINED) + 1)
        given["refinement"] = _Refinement(refinement.wish, int(refinement.met), refinement.chosen, refinement.reason)
    given |= {"status": solution["status"].name, "history": _rows(solution["history"])}
    exact = np.array([float(item.second_order) for item in solution["history"]])
    members |= members_of(_Plan(**given, second_order=exact if exact.any() else None))
    members |= {name: getattr(problem, name) for name in _PROBLEM}
    members |= {"problem.integrator": repr(problem.integrator)} | _surroundings(problem)
    if problem.constraints:
        members["problem.constraints"] = problem.described_constraints
    return write_npz(path, _FORMAT, members)


def read(path: str | os.PathLike[str], problem: OptimalControlProblem) -> dict[str, Any]:
    """Read the fields of a :class:`Solution` from a file; see :meth:`Solution.load` for errors."""
    source = path_like("path", path)
    members = read_npz(source, _FORMAT)
    scene = problem.scene
    sizes = {"decisions": problem.decisions, "controls": scene.controls, "states": 2 * scene.robot.dof}

    _require_problem(source, members, problem)
    motion = _motion(source, members, problem)
    # Only after the motion, whose masses give a clearer message for another robot.
    _require_surroundings(source, members, problem, "scene.")
    plan = record_of(_Plan, members, source, sizes=sizes)
    if plan.status not in Status.__members__:
        raise FileError(f"{source}: there is no status {plan.status!r}")
    found = problem.cost_of(motion)
    if not abs(found - plan.cost) <= 1e-9 * max(abs(found), abs(plan.cost)):
        raise FileError(f"{source} is of a problem with another cost: {plan.cost:.9g}, and here {found:.9g}")
    history = _iterations(source, plan.history, plan.second_order)
    if bool(problem.constraints) != (plan.multipliers is not None):
        raise FileError(f"{source}: multipliers of the problem's constraints do not belong to it, or are missing")
    if plan.multipliers is not None:
        _require_rows(source, plan.multipliers, problem)
    if (problem.rate is not None or problem.linear) and plan.previous_gains is None:
        raise FileError(f"{source}: previous_gains is missing")
    apart = ("refined", "second_order")
    given = {item.name: getattr(plan, item.name) for item in fields(_Plan) if item.name not in apart}
    given["refinement"] = _refinement(source, plan)
    given |= {"status": Status[plan.status], "history": history}
    if plan.search is not None and not 0 <= plan.search.iterations <= len(history):
        raise FileError(f"{source}: search.iterations is {plan.search.iterations}, where 0 to {len(history)} belongs")
    return given | {"problem": problem, "trajectory": motion}


def _require_rows(source: Path, multipliers: Multipliers, problem: OptimalControlProblem) -> None:
    """Refuse multipliers of another number of rows, or of instants that the problem does not have."""
    between = multipliers.between
    most = len(problem.constraints), problem.steps, MOST_INSTANTS
    inside = ((between.rows >= 0) & (between.rows < most)).all()
    known = inside and np.array_equal(between.rows, np.unique(between.rows, axis=0))
    if not known or any(not watched(problem)[i] for i in between.constraints):
        raise FileError(f"{source}: multipliers.instants are not in the problem's steps")
    own = [problem.bound_constraints[i] for i in between.rows[:, 0]]
    if sum(len(item.rows) for item in own) != between.moments.size:
        raise FileError(f"{source}: multipliers.moments do not belong to multipliers.instants")
    inside = (between.moments == UNUSED) | ((between.moments >= 0.0) & (between.moments <= 1.0))
    if not inside.all():
        raise FileError(f"{source}: multipliers.moments are not within steps")
    if not all(rows.any(axis=1).all() for rows in in_force(problem, between)):
        raise FileError(f"{source}: multipliers.moments enforce no row at an instant")
    sizes = [item.size for item in enforced(problem, between).bound_constraints]
    at_nodes = sum(item.size for item in problem.bound_constraints)
    for name, found, expected in (
        ("values", multipliers.values, sum(sizes)),
        ("added", multipliers.added, at_nodes),
    ):
        if found is not None and found.size != expected:
            raise FileError(f"{source}: multipliers.{name} has shape ({found.size},), where ({expected},) belongs")


def _refinement(source: Path, plan: _Plan) -> Refinement | None:
    refinement, rows = plan.refinement, plan.refined
    if refinement is None or rows is None:
        return None
    whole, kinds = {"steps", "iterations"}, rows[:, -1]
    if not (np.isin(kinds, np.arange(len(_STATUSES))).all() and 0 <= refinement.chosen < max(len(rows), 1)):
        raise FileError(f"{source}: the steps of the refinement are inconsistent")
    tried = tuple(
        Refined(
            **{name: int(value) if name in whole else value for name, value in zip(_REFINED, row[:-1], strict=True)},
            status=_STATUSES[int(row[-1])],
        )
        for row in rows.tolist()
    )
    return Refinement(refinement.wish, bool(refinement.met), tried, refinement.chosen, refinement.reason)


def solution_trajectory(path: str | os.PathLike[str], robot: Robot | None = None) -> Trajectory:
    """Read only the motion of a solution, without its problem.

    Raises:
        FileError: As :meth:`Trajectory.load`.
    """
    source = path_like("path", path)
    return Trajectory.of_members(source, read_npz(source, _FORMAT), robot)


def _motion(source: Path, members: Members, problem: OptimalControlProblem) -> Trajectory:
    """The motion, checked against the problem."""
    motion, scene = Trajectory.of_members(source, members, problem.scene.robot), problem.scene
    found = motion.steps, motion.u.shape[1], motion.dw.shape[1]
    if found != (problem.steps, scene.controls, scene.processes):
        raise FileError(
            f"{source}: its motion has {found[0]} steps, {found[1]} controls and {found[2]} noise processes; "
            f"the problem has {problem.steps}, {scene.controls} and {scene.processes}"
        )
    return replace(motion, scene_values=scene.values)


def _surroundings(problem: OptimalControlProblem) -> dict[str, Floats]:
    """Arrays that identify a problem's scene; noise that only Python evaluates is identified by its size only."""
    values = problem.scene.values
    arrays = {f"scene.{name}": array for name, array in values.items() if not name.startswith("noise.")}
    fields_of_noise = problem.scene.diffusion._asdict()
    return arrays | {f"noise.{name}": array for name, array in fields_of_noise.items()}


def _require_problem(source: Path, members: Members, problem: OptimalControlProblem) -> None:
    """Refuse a solution of another problem, by its numbers and its noise."""
    given = {name: getattr(problem, name) for name in (*_PROBLEM, "dt")}
    # Files without these entries are older than linear controls, and than rows between nodes of held ones.
    usual = {"controls": np.array("held"), "between_nodes": np.array(False)}
    for name, value in given.items():
        theirs = members.get(name, usual.get(name, np.array("unknown")))
        if not np.array_equal(theirs, value):
            raise FileError(f"{source} is of a problem with {name} = {theirs}, not {value}")
    described, found = problem.described_constraints, str(members.get("problem.constraints", ""))
    if described != found:
        there, here = _apart(found, described)
        raise FileError(f"{source} is of a problem with constraints = {there}, not {here}")
    _require_surroundings(source, members, problem, "noise.")
    # After the noise, which decides about the default integrator.
    stored, here = str(members.get("problem.integrator", "unknown")), repr(problem.integrator)
    if stored != here:
        raise FileError(f"{source} is of a problem with integrator = {stored}, not {here}: give it as integrator=")


def _apart(there: str, here: str) -> tuple[str, str]:
    """Two different descriptions of constraints, each in short: their kinds, or where the first difference is."""
    kinds = [", ".join(re.findall(r"(?:^|; )(\w+)\(", text)) or "none" for text in (there, here)]
    if kinds[0] != kinds[1]:
        return kinds[0], kinds[1]
    pairs = zip(there, here, strict=False)
    at = next((k for k, (a, b) in enumerate(pairs) if a != b), min(len(there), len(here)))
    first = max(0, at - 60)
    dots = "..." if first else ""
    short = [dots + text[first : at + 60] + ("..." if len(text) > at + 60 else "") for text in (there, here)]
    return short[0], short[1]


def _require_surroundings(source: Path, members: Members, problem: OptimalControlProblem, kind: str) -> None:
    """Refuse numbers, of those whose names begin with ``kind``, that differ or are on one side alone."""
    known = _surroundings(problem)
    for name in members:
        if name.startswith(kind) and name not in known and members[name].size:
            raise FileError(
                f"{source} is of a problem with {name.replace('.', ' ')}, which the given one, or this installation "
                "of varpin, does not have"
            )
    for name, array in known.items():
        found = members.get(name)
        if name.startswith(kind) and (found is None or found.dtype != array.dtype or not same(found, array)):
            raise FileError(f"{source} is of a problem with another {name.replace('.', ' ')}")


def _rows(history: tuple[Iteration, ...]) -> Floats:
    """One row per iteration, with its fields in order."""
    return np.array([[float(getattr(item, name)) for name in _COLUMNS] for item in history]).reshape(-1, len(_COLUMNS))


def _iterations(source: Path, rows: Floats, exact: Floats | None) -> tuple[Iteration, ...]:
    """The iterations in the rows of a history, and whether each was of second order."""
    whole = [index for index, item in enumerate(fields(Iteration)) if item.type == "int"]
    counts = rows[:, whole]
    if not ((counts >= 0.0) & (counts < 2.0**53) & (counts == np.floor(counts))).all():
        raise FileError(f"{source}: history holds counts that are no whole numbers")
    typed: list[list[Any]] = [
        [int(value) if index in whole else value for index, value in enumerate(row)] for row in rows.tolist()
    ]
    orders = [[]] * len(rows) if exact is None else exact[:, None].astype(bool).tolist()
    return tuple(Iteration(*row, *order) for row, order in zip(typed, orders, strict=True))
