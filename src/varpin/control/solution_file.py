"""Solutions in files: npz without pickle, all that a search needs to go on but the problem."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from varpin.control.history import Iteration, SearchState, Status
from varpin.control.problem import OptimalControlProblem
from varpin.errors import FileError
from varpin.integrators.variational import Variational
from varpin.mechanics.scene import same
from varpin.model import Robot
from varpin.support.checks import path_like
from varpin.trajectory import MEMBERS, OPTIONAL, Trajectory, atomic_file, read_members, require_layout

Floats = NDArray[np.float64]

_FORMAT = "varpin.solution/2"
_PLAN = ("gains", "feedforward", "gradient")
_NUMBERS = ("cost", "noise_cost")
_PROBLEM = ("q0", "v0", "t0", "steps", "hold", "sampling", "control_limits")
_SEARCH = ("cost", "above", "first", "best_cost", "best_noise", "regularization", "growth")
_FLAGS = ("bounded", "cut")
_COLUMNS = tuple(item.name for item in fields(Iteration))


def write(path: str | os.PathLike[str], solution: Mapping[str, Any]) -> Path:
    """Write the fields of a :class:`Solution`, as :meth:`Solution.save` says."""
    problem: OptimalControlProblem = solution["problem"]
    search: SearchState | None = solution["search"]
    motions: dict[str, Trajectory] = {"": solution["trajectory"]}
    if search is not None:
        motions |= {"search.": search.trajectory} | ({} if search.best is None else {"best.": search.best})
    members: dict[str, Any] = {
        "status": solution["status"].name,
        "reason": solution["reason"],
        "plan.warnings": np.array(solution["warnings"], dtype=np.str_),
        "history": _rows(solution["history"]),
    }
    # Motions are often one and the same: each is written once.
    kept: dict[int, str] = {}
    for prefix, motion in motions.items():
        members[f"{prefix}motion"] = kept.setdefault(id(motion), prefix)
        if kept[id(motion)] == prefix:
            # The problem's scene is all of theirs, and is there once.
            own = replace(motion, scene_values={}).members()
            members |= {f"{prefix}{name}": value for name, value in own.items()}
    members |= {name: solution[name] for name in (*_PLAN, *_NUMBERS)}
    if solution["previous_gains"] is not None:
        members["previous_gains"] = solution["previous_gains"]
    members |= {name: getattr(problem, name) for name in _PROBLEM}
    members["problem.integrator"] = repr(problem.integrator)
    members |= _surroundings(problem)
    if search is not None:
        members["search.history"] = len(search.history)
        members["search.gains"] = np.array(search.gains)
        members |= {f"search.{name}": getattr(search, name) for name in _SEARCH}
        members |= {f"search.{name}": int(getattr(search, name)) for name in _FLAGS}
    with atomic_file(path) as stream:
        np.savez_compressed(stream, **members, format=_FORMAT)
    return Path(path)


def read(path: str | os.PathLike[str], problem: OptimalControlProblem) -> dict[str, Any]:
    """The fields of the :class:`Solution` in a file; errors as :meth:`Solution.load` says."""
    source = path_like("path", path)
    expected = {*MEMBERS, *_PLAN, *_NUMBERS, *_PROBLEM, "status", "reason", "history", "plan.warnings"}
    members = read_members(source, _FORMAT, expected, others=True, most=_most_bytes(problem))
    reader = _Reader(source, members, problem)
    reader.check_problem()
    return reader.fields()


def solution_trajectory(path: str | os.PathLike[str], robot: Robot | None = None) -> Trajectory:
    """The motion alone of a solution in a file, for which its problem is not needed.

    Raises:
        FileError: As :meth:`Trajectory.load`.
    """
    source = path_like("path", path)
    members = read_members(
        source, _FORMAT, MEMBERS, optional=OPTIONAL, check=lambda headers: require_layout(source, headers)
    )
    return Trajectory.of_members(source, members, robot)


def _most_bytes(problem: OptimalControlProblem) -> int:
    """More than the file of any solution unpacks to: three motions, the plan, and some megabytes for all else.

    A byte for each part of a step comes to no more than the guard's halvings allow.
    """
    n, m, k = problem.scene.robot.dof, problem.scene.controls, problem.scene.processes
    own = sum(array.nbytes for array in _surroundings(problem).values())
    numbers = 3 * (problem.steps + 1) * (3 * n + m + k + 16) + problem.decisions * m * (2 * n + m + 2)
    guard = problem.integrator.guard if isinstance(problem.integrator, Variational) else None
    parts = 0 if guard is None else 3 * problem.steps << guard.max_halvings
    return 8 * numbers + parts + own + 16_000_000


def _surroundings(problem: OptimalControlProblem) -> dict[str, Floats]:
    """What of a problem's scene tells it from others; of a noise that only Python can evaluate nothing but its size."""
    values = problem.scene.values
    arrays = {f"scene.{name}": array for name, array in values.items() if not name.startswith("noise.")}
    fields_of_noise = problem.scene.diffusion._asdict()
    return arrays | {f"noise.{name}": array for name, array in fields_of_noise.items()}


def _rows(history: tuple[Iteration, ...]) -> Floats:
    """One row for each iteration, its fields in order."""
    return np.array([[float(getattr(item, name)) for name in _COLUMNS] for item in history]).reshape(-1, len(_COLUMNS))


@dataclass(frozen=True, eq=False)
class _Reader:
    """The members of a file of a solution, checked as they are taken out."""

    source: Path
    members: dict[str, NDArray[Any]]
    problem: OptimalControlProblem

    def check_problem(self) -> None:
        problem, members = self.problem, self.members
        given = {name: getattr(problem, name) for name in _PROBLEM} | {"dt": problem.dt}
        for name, value in given.items():
            if not np.array_equal(members[name], value):
                raise FileError(f"{self.source} is of a problem with {name} = {members[name]}, not {value}")
        own = repr(problem.integrator)
        if str(members.get("problem.integrator")) != own:
            raise FileError(
                f"{self.source} is of a problem with integrator {members.get('problem.integrator')}, not {own}"
            )

        self._check_arrays("noise.")

    def _check_arrays(self, kind: str) -> None:
        for name, array in _surroundings(self.problem).items():
            if not name.startswith(kind):
                continue
            found = self.members.get(name)
            if found is None or found.dtype != array.dtype or not same(found, array):
                raise FileError(f"{self.source} is of a problem with another {name.replace('.', ' ')}")

    def array(self, name: str, shape: tuple[int, ...], *, finite: bool = True) -> Floats:
        """A member of floats of the shape given, -1 for any length."""
        if name not in self.members:
            raise FileError(f"{self.source} is not a varpin solution: it has no {name}")
        array = self.members[name]
        if array.ndim != len(shape) or any(b not in (-1, a) for a, b in zip(array.shape, shape, strict=True)):
            raise FileError(f"{self.source}: {name} has shape {array.shape}, where {shape} belongs")
        if array.dtype.kind not in "fi" or (finite and not np.isfinite(array).all()):
            raise FileError(f"{self.source}: {name} holds values that are not finite numbers")
        return np.array(array, dtype=np.float64, order="C")

    def motion(self, prefix: str) -> Trajectory:
        own = {name: self.members[prefix + name] for name in MEMBERS if prefix + name in self.members}
        missing = sorted(MEMBERS - set(own))
        if missing:
            raise FileError(f"{self.source} is not a varpin solution: it has no {prefix}{missing[0]}")
        motion = Trajectory.of_members(self.source, own, self.problem.scene.robot)
        scene = self.problem.scene
        found = motion.steps, motion.u.shape[1], motion.dw.shape[1]
        if found != (self.problem.steps, scene.controls, scene.processes):
            raise FileError(
                f"{self.source}: its motion has {found[0]} steps, {found[1]} controls and {found[2]} noise processes; "
                f"the problem has {self.problem.steps}, {scene.controls} and {scene.processes}"
            )
        return replace(motion, scene_values=scene.values)

    def count(self, name: str, most: int) -> int:
        """A member that is a whole number from 0 to ``most``."""
        value = float(self.array(name, ()))
        if not (0.0 <= value <= most and value.is_integer()):
            raise FileError(f"{self.source}: {name} is {value:g}, where a whole number from 0 to {most} belongs")
        return int(value)

    def history(self) -> tuple[Iteration, ...]:
        rows = self.array("history", (-1, len(_COLUMNS)), finite=False)
        whole = {item.name for item in fields(Iteration) if item.type == "int"}
        counts = rows[:, [_COLUMNS.index(name) for name in sorted(whole)]]
        if not ((counts >= 0.0) & (counts < 2.0**53) & (counts == np.floor(counts))).all():
            raise FileError(f"{self.source}: history holds counts that are no whole numbers")
        found = []
        for row in rows.tolist():
            values: dict[str, Any] = dict(zip(_COLUMNS, row, strict=True))
            found.append(Iteration(**values | {name: int(values[name]) for name in whole}))
        return tuple(found)

    def fields(self) -> dict[str, Any]:
        problem, members = self.problem, self.members
        R, m, n = problem.decisions, problem.scene.controls, problem.scene.robot.dof
        status = str(members["status"])
        if status not in Status.__members__:
            raise FileError(f"{self.source}: there is no status {status!r}")
        motions = {"": self.motion("")}
        # Motions of another robot say so by its weight.
        self._check_arrays("scene.")
        history = self.history()
        cost = float(self.array("cost", ()))
        found = problem.cost_of(motions[""])
        if not abs(found - cost) <= 1e-9 * max(abs(found), abs(cost)):
            raise FileError(f"{self.source} is of a problem with another cost: {cost:.9g}, and here {found:.9g}")
        search = None
        if "search.motion" in members:
            names = {}
            for name in ("search.", "best."):
                names[name] = str(members.get(f"{name}motion", "none"))
                if names[name] != "none" and names[name] not in motions:
                    motions[names[name]] = self.motion(names[name])
            numbers = {name: float(self.array(f"search.{name}", (), finite=False)) for name in _SEARCH}
            search = SearchState(
                trajectory=motions[names["search."]],
                best=motions.get(names["best."]),
                gains=tuple(self.array("search.gains", (-1,)).tolist()),
                history=history[: self.count("search.history", len(history))],
                **numbers,
                bounded=bool(self.count("search.bounded", 1)),
                cut=bool(self.count("search.cut", 1)),
            )
        return {
            "problem": problem,
            "trajectory": motions[""],
            "gains": self.array("gains", (R, m, 2 * n)),
            "feedforward": self.array("feedforward", (R, m)),
            "gradient": self.array("gradient", (R, m), finite=False),
            "cost": cost,
            "noise_cost": float(self.array("noise_cost", (), finite=False)),
            "status": Status[status],
            "reason": str(members["reason"]),
            "history": history,
            "search": search,
            "warnings": tuple(str(sentence) for sentence in members["plan.warnings"].reshape(-1)),
            "previous_gains": None if problem.rate is None else self.array("previous_gains", (R, m, m)),
        }
