"""A loaded scene file: its robot, scene and optimal control problem, and the joints that it leaves out."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from varpin.arrays import Floats
from varpin.control import OptimalControlProblem, Solution, solve
from varpin.control.costs import CostError
from varpin.control.problem import integrator_for
from varpin.errors import FileError, InputError, VarpinError
from varpin.integrators import Integrator
from varpin.io.scenefile.reading import suggestion
from varpin.io.scenefile.references import Timeline
from varpin.io.scenefile.shown import marks_of
from varpin.io.scenefile.tables import SceneTables, read_scene
from varpin.io.scenefile.task import Task, required_of, task_of
from varpin.marks import Marks
from varpin.mechanics.reduction import Required
from varpin.mechanics.scene import Scene, closest_controls
from varpin.model import Robot, models_dir
from varpin.signals.policy import LinearPolicy
from varpin.simulation.choice import usual_integrator
from varpin.simulation.simulate import simulate
from varpin.support.checks import is_file
from varpin.support.markup import facts
from varpin.trajectory import Trajectory

# Measured time to set up a part, in units of linear algebra: the cube of the number of joints, times steps.
_SETUP = 200_000


@dataclass(frozen=True, eq=False)
class SceneFile:
    """A scene file on its robot, without idle joints.

    Attributes:
        spec: The content of the file.
        required: Report on what is computed, what is not, and why.
        scene: Robot and surroundings.
        q0: Initial configuration (n,) [rad or m].
        v0: Initial velocity (n,) [rad/s or m/s].
    """

    spec: SceneTables
    required: Required
    scene: Scene
    q0: Floats
    v0: Floats
    _task: Task = field(repr=False)

    def __repr__(self) -> str:
        return f"SceneFile({self.spec.name}: {self.spec.title})"

    def _repr_html_(self) -> str:
        spec = self.spec
        rows = [
            ("file", spec.path.name),
            ("robot", self.robot),
            ("horizon", f"{spec.steps} steps of {spec.dt:g} s, {self.integrator}"),
        ]
        return facts(spec.title, rows, self.required._repr_html_())

    @property
    def robot(self) -> Robot:
        """The robot, without the joints that are left out."""
        return self.scene.robot

    @cached_property
    def integrator(self) -> Integrator:
        """The integrator of the file.

        If it names none: the default of :class:`varpin.OptimalControlProblem`, or that of :func:`varpin.simulate` if
        the file has no cost. The trajectory names what ``simulate`` took.
        """
        if self.spec.integrator is not None:
            return self.spec.integrator
        if self.spec.cost:
            return integrator_for(self.scene, self.q0, self.spec.dt)
        return usual_integrator(self.scene, self.q0, self.v0, self.spec.dt, noisy=self.spec.simulate.seed is not None)

    @cached_property
    def problem(self) -> OptimalControlProblem:
        """The optimal control problem of the file.

        Raises:
            SceneFileError: The file has no cost, or a cost does not fit the robot.
        """
        return self._problem(self._task)

    def _problem(self, task: Task) -> OptimalControlProblem:
        spec, horizon = self.spec, self.spec.horizon
        if not spec.cost:
            raise spec.where.at("cost").error("is missing; a scene to solve needs at least one [[cost]]")
        task.require_start()
        most, constraints = task.control_limit, []
        for index, given in enumerate(spec.plan_constraint):
            try:
                constraints.append(given.make(task.scene.robot))
            except VarpinError as error:
                raise spec.where.at("plan_constraint").at(index).of(error, given.given) from None
        try:
            return OptimalControlProblem(
                task.scene,
                task.cost(),
                task.q0,
                task.v0,
                dt=spec.dt,
                steps=spec.steps,
                integrator=self.integrator,
                sampling=horizon.sampling,  # type: ignore[arg-type]
                hold=horizon.hold,
                control_limits=(-most, most),
                controls=horizon.controls,  # type: ignore[arg-type]
                constraints=constraints,
                between_nodes=horizon.between_nodes,
            )
        except (CostError, InputError) as error:
            about = (error.argument or "") if isinstance(error, InputError) else ""
            key = about.replace("constraints[", "plan_constraint[") if about else "cost"
            key = f"horizon.{about}" if about in ("controls", "sampling") else key
            raise spec.where.at(key).error(str(error)) from None

    def controls(self) -> Floats | None:
        """Controls of a simulation, (N, m) or (m,), or None for none."""
        given = self._task.controls
        if given is None:
            return None
        if isinstance(given, Timeline):
            k = np.arange(self.spec.steps, dtype=np.float64)
            found = given.at((k + 0.5) * self.spec.dt)
            # The control of a kinematic input is its position at the end of the step.
            moved = [int(np.argmax(self.scene.actuation[c])) for c in self.scene.inputs.values()]
            found[:, moved] = given.at((k + 1.0) * self.spec.dt)[:, moved]
            cubic = [place for place, rate in zip(moved, self.scene.rates, strict=True) if rate >= 0]
            return np.hstack([found, self._rates(given)[:, cubic]]) if cubic else found
        return closest_controls(self.scene, self.q0)

    def _rates(self, given: Timeline) -> Floats:
        """Time derivatives of controls at the ends of steps, by backward differences of fourth order."""
        t, h = np.arange(1.0, self.spec.steps + 1.0) * self.spec.dt, 0.01 * self.spec.dt
        before = [weight * given.at(t - k * h) for k, weight in enumerate((25.0, -48.0, 36.0, -16.0, 3.0))]
        rates: Floats = sum(before[1:], before[0]) / (12.0 * h)
        return rates

    def simulate(self, *, progress: Callable[[int, int], None] | None = None) -> Trajectory:
        """The motion under the controls of ``[simulate]``, with noise if it gives a seed.

        Raises:
            SceneFileError: The start is off the constraints.
            StepFailure, Interrupted: As :func:`varpin.simulate`.
        """
        spec = self.spec
        self._task.require_start()
        return simulate(
            self.scene,
            self.q0,
            self.v0,
            dt=spec.dt,
            steps=spec.steps,
            controls=self.controls(),
            integrator=self.integrator if spec.cost else spec.integrator,
            rng=spec.simulate.seed,
            progress=progress,
        )

    def solve(
        self,
        controls: LinearPolicy | Solution | Floats | None = None,
        *,
        resume: Solution | None = None,
        apart: bool | None = None,
        **options: Any,
    ) -> Solution:
        """The optimal motion, by :func:`varpin.solve` with the options of ``[solve]``.

        Independent groups of joints are planned separately; their plans then start one solve of the whole problem.

        Args:
            controls: Initial controls, as for :func:`varpin.solve`.
            resume: A solution to continue from.
            apart: Whether to plan groups separately; if left out, where that saves time. Not used with ``controls`` or
                ``resume``.
            **options: Options of :func:`varpin.solve` that replace those of the file.
        """
        given = {name: value for name, value in vars(self.spec.solve).items() if value is not None} | options
        if controls is None and resume is None and (self._pays_apart() if apart is None else apart):
            controls = self._planned_apart(given)
        return solve(self.problem, controls, resume=resume, **given)

    def _pays_apart(self) -> bool:
        """Whether planning groups separately saves more linear algebra than setting up the parts costs."""
        if self.spec.plan_constraint:
            return False
        parts = self.required.parts
        saved = self.robot.dof**3 - sum(len(part) ** 3 for part in parts)
        return len(parts) > 1 and self.spec.steps * saved > _SETUP * len(parts)

    def marks(self, duration: float | None = None) -> Marks:
        """The task in a replay: ``replay(robot, motion, marks=scene.marks())``.

        They are targets, reference paths and traces of the frames in the cost, a ghost of the robot that follows a
        reference of joints, and constraints.

        Args:
            duration: Duration of the motion [s]; the horizon if left out.
        """
        constraints = self.problem if self.spec.plan_constraint else self.scene
        return marks_of(self._task, self.spec.duration if duration is None else duration, constraints)

    def load_solution(self, path: str | Path) -> Solution:
        """Read a solution of this scene that :meth:`Solution.save` wrote; see :meth:`Solution.load`."""
        return Solution.load(path, self.problem)

    @cached_property
    def _parts(self) -> tuple[tuple[Task, OptimalControlProblem], ...]:
        """The groups of joints as problems of their own; empty if a group has no control or no cost.

        Empty, too, for several robots, for a part does not have all of them.
        """
        if self.spec.prefixes:
            return ()
        names, parts = self.robot.joint_names, []
        for part in self.required.parts:
            task = self._task.without([name for name in names if name not in part])
            if not task.driven or not task.costs:
                return ()
            parts.append((task, self._problem(task)))
        return tuple(parts)

    def _planned_apart(self, options: dict[str, Any]) -> LinearPolicy | None:
        """The policies of all groups of joints in one; None where they cannot be planned separately."""
        if not self._parts or self.spec.horizon.controls == "linear":
            return None
        problem, driven = self.problem, self._task.driven
        names, n, m, R = self.robot.joint_names, self.robot.dof, self.scene.controls, problem.decisions
        u, gains, reference = np.zeros((R, m)), np.zeros((R, m, 2 * n)), np.zeros((R, 2 * n))
        for task, part in self._parts:
            plan = solve(part, **{**options, "true_cost": None}, check=False).policy
            rows = np.array([driven.index(name) for name in task.driven])
            order = np.array([names.index(name) for name in task.scene.robot.joint_names])
            x = np.concatenate([order, n + order])
            u[:, rows], reference[:, x] = plan.u, plan.reference
            gains[:, rows[:, None], x] = plan.gains
        return LinearPolicy(u, gains, reference, hold=plan.hold, on=plan.on, period=plan.period)


def load_scene(source: str | Path, *, required_only: bool = True) -> SceneFile:
    """Load a scene file.

    Main args:
        source: Path of a TOML file, or the name of a scene that comes with varpin (``"finger_tracking"``).

    Other Args:
        required_only: Leave out idle joints, on which no force and no cost acts. Results for the others are the same.

    Raises:
        FileError: There is no such file, or it cannot be read.
        SceneFileError: There is a mistake in the file: the message names the key, the given value and allowed ones.
    """
    tables = read_scene(find_scene(source))
    task, required = required_of(task_of(tables), idle=required_only)
    file = SceneFile(tables, required, task.scene, task.q0, task.v0, task)
    if tables.cost:
        # Raise a mistake in the cost now, not at the first use of the problem.
        file.problem  # noqa: B018
    return file


def scenes() -> dict[str, Path]:
    """Files of the scenes bundled with varpin, by name."""
    return {path.stem: path for path in sorted((models_dir() / "scenes").glob("*.toml"))}


def find_scene(source: str | Path) -> Path:
    """The scene file at a path, or the bundled one of that name.

    Raises:
        FileError: There is no such file; similar names are listed.
        InputError: ``source`` is not a path.
    """
    if not isinstance(source, str | Path) or "\0" in str(source):
        raise InputError(f"a scene must be the path of a TOML file or a name, got {type(source).__name__}")
    bundled = scenes()
    if str(source) in bundled:
        return bundled[str(source)]
    path = Path(source).expanduser()
    if is_file(path):
        return path
    if os.path.isdir(path):  # noqa: PTH112 - of a path that is too long for any, pathlib raises an OSError
        raise FileError(f"{path} is a folder, not a scene file")
    raise FileError(f"no scene file {str(source)!r}; {suggestion(path.stem, bundled, 'bundled scenes')}")
