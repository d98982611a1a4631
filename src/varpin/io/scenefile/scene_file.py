"""A loaded scene file: its robot, scene and optimal control problem, and the joints that it leaves out."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from varpin.arrays import Floats
from varpin.control import OptimalControlProblem, Solution, solve
from varpin.control.costs import CostError, CostSum
from varpin.errors import InputError
from varpin.integrators import Integrator
from varpin.io.scenefile import kinds
from varpin.io.scenefile.marks import marks_of
from varpin.io.scenefile.reading import Where, find_scene, toml_of
from varpin.io.scenefile.references import Timeline
from varpin.io.scenefile.task import Task, required_of, task_of
from varpin.marks import Marks
from varpin.mechanics.reduction import Required
from varpin.mechanics.scene import Scene, closest_controls
from varpin.model import Robot, models_dir
from varpin.signals.policy import LinearPolicy
from varpin.simulation.choice import integrator_for, usual_integrator
from varpin.simulation.simulate import simulate
from varpin.support.checks import count, positive
from varpin.support.markup import facts
from varpin.trajectory import Trajectory

_OPTIONS = ("tolerance", "max_iterations", "second_order", "regularization", "true_cost")


@dataclass(frozen=True, eq=False, repr=False)
class SceneFile:
    """A scene file on its robot, without idle joints.

    Attributes:
        path: The file.
        title: Its title; the name of the file if it has none.
        dt: Time step [s].
        steps: N.
        required: Report on what is computed, what is not, and why.
        scene: Robot and surroundings.
        q0: Initial configuration (n,) [rad or m].
        v0: Initial velocity (n,) [rad/s or m/s].
        outputs: Paths by option (save, plot, html) and the speed of a replay, as far as the file has them.
    """

    path: Path
    title: str
    dt: float
    steps: int
    required: Required
    scene: Scene
    q0: Floats
    v0: Floats
    outputs: dict[str, Any]
    _task: Task
    _integrator: Integrator | None
    _options: dict[str, Any]
    _seed: int | None

    def __repr__(self) -> str:
        return f"SceneFile({self.path.stem}: {self.title})"

    def _repr_html_(self) -> str:
        horizon = f"{self.steps} steps of {self.dt:g} s, {self.integrator}"
        rows = [("file", self.path.name), ("robot", self.robot), ("horizon", horizon)]
        return facts(self.title, rows, self.required._repr_html_())

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
        if self._integrator is not None:
            return self._integrator
        if self._task.tables.get("cost"):
            return integrator_for(self.scene, self.q0, self.dt)
        return usual_integrator(self.scene, self.q0, self.v0, self.dt, noisy=self._seed is not None)

    @cached_property
    def problem(self) -> OptimalControlProblem:
        """The optimal control problem of the file.

        Raises:
            SceneFileError: The file has no cost, or a cost does not fit the robot.
        """
        task = self._task
        if not task.tables.get("cost"):
            raise task.where.at("cost").error("is missing; a scene to solve needs at least one [[cost]]")
        horizon = {key: value for key, value in task.tables["horizon"].items() if key != "duration"}
        options = horizon | {"dt": self.dt, "steps": self.steps, "integrator": self.integrator}
        options |= {"control_limits": (-task.control_limit, task.control_limit)}
        options |= {"constraints": task.plan_constraints()}
        try:
            return OptimalControlProblem(task.scene, CostSum(task.costs), task.q0, task.v0, **options)
        except (CostError, InputError) as error:
            if index := re.search(r"constraints(\[\d+\])", " ".join(getattr(error, "__notes__", ()))):
                raise task.where.at(f"plan_constraint{index[1]}").error(str(error)) from None
            wrong = task.where.at("horizon").of(error, horizon)
            raise (task.where.at("cost").error(str(error)) if wrong.key == "horizon" else wrong) from None

    def controls(self) -> Floats | None:
        """Controls of a simulation, (N, m) or (m,), or None for none."""
        given = self._task.controls
        if not isinstance(given, Timeline):
            return None if given is None else closest_controls(self.scene, self.q0)
        k = np.arange(self.steps, dtype=np.float64)
        found = given.at((k + 0.5) * self.dt)
        # The control of a kinematic input is its position at the end of the step.
        moved = [int(np.argmax(self.scene.actuation[c])) for c in self.scene.inputs.values()]
        found[:, moved] = given.at((k + 1.0) * self.dt)[:, moved]
        cubic = [place for place, rate in zip(moved, self.scene.rates, strict=True) if rate >= 0]
        return np.hstack([found, self._rates(given)[:, cubic]]) if cubic else found

    def _rates(self, given: Timeline) -> Floats:
        """Time derivatives of controls at the ends of steps, by backward differences of fourth order."""
        t, h = np.arange(1.0, self.steps + 1.0) * self.dt, 0.01 * self.dt
        before = [weight * given.at(t - k * h) for k, weight in enumerate((25.0, -48.0, 36.0, -16.0, 3.0))]
        rates: Floats = sum(before[1:], before[0]) / (12.0 * h)
        return rates

    def simulate(self, *, progress: Callable[[int, int], None] | None = None) -> Trajectory:
        """The motion under the controls of ``[simulate]``, with noise if it gives a seed.

        Raises:
            SceneFileError: The start is off the constraints.
            StepFailure, Interrupted: As :func:`varpin.simulate`.
        """
        self._task.require_start()
        return simulate(
            self.scene,
            self.q0,
            self.v0,
            dt=self.dt,
            steps=self.steps,
            controls=self.controls(),
            integrator=self.integrator if self._task.tables.get("cost") else self._integrator,
            rng=self._seed,
            progress=progress,
        )

    def solve(
        self,
        controls: LinearPolicy | Solution | Floats | None = None,
        *,
        resume: Solution | None = None,
        **options: Any,
    ) -> Solution:
        """The optimal motion, by :func:`varpin.solve` with the options of ``[solve]``.

        Args:
            controls: Initial controls, as for :func:`varpin.solve`.
            resume: A solution to continue from.
            **options: Options of :func:`varpin.solve` that replace those of the file.

        Raises:
            InputError: A wrong option.
            SceneFileError: A wrong option of the file.
        """
        given = self._options | options
        try:
            return solve(self.problem, controls, resume=resume, **given)
        except InputError as error:
            where = self._task.where.at("solve")
            wrong = where.of(error, {name: value for name, value in self._options.items() if name not in options})
            if wrong.key == where.key:
                raise
            raise wrong from None

    def marks(self, duration: float | None = None) -> Marks:
        """The task in a replay: ``replay(robot, motion, marks=scene.marks())``.

        They are targets, reference paths and traces of the frames in the cost, a ghost of the robot that follows a
        reference of joints, and constraints.

        Args:
            duration: Duration of the motion [s]; the horizon if left out.
        """
        constraints = self.problem if self._task.tables.get("plan_constraint") else self.scene
        return marks_of(self._task.costs, self.q0, self.steps * self.dt if duration is None else duration, constraints)

    def load_solution(self, path: str | Path) -> Solution:
        """Read a solution of this scene that :meth:`Solution.save` wrote; see :meth:`Solution.load`."""
        return Solution.load(path, self.problem)


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
    path = find_scene(source, scenes())
    root, tables = Where(path), toml_of(path)
    task, required = required_of(task_of(root, tables), idle=required_only)
    integrator = None
    if "integrator" in tables:
        at = root.at("integrator")
        _, kind, own = at.kind(tables["integrator"], kinds.INTEGRATORS, "gauss")
        integrator = at.call(kind, own, without=("guard",))
    at = root.at("outputs")
    outputs = dict(at.table(tables.get("outputs", {}), ("save", "plot", "html", "speed")))
    for key, value in outputs.items():
        outputs[key] = at.at(key).check(positive, value, "1") if key == "speed" else Path.cwd() / at.at(key).text(value)
    seed = tables.get("simulate", {}).get("seed")
    file = SceneFile(
        path,
        root.at("title").text(tables.get("title", path.stem)),
        task.dt,
        task.steps,
        required,
        task.scene,
        task.q0,
        task.v0,
        outputs,
        task,
        integrator,
        root.at("solve").table(tables.get("solve", {}), _OPTIONS),
        None if seed is None else root.at("simulate", "seed").check(count, seed),
    )
    if tables.get("cost"):
        # Raise a mistake in the cost now, not at the first use of the problem.
        file.problem  # noqa: B018
    return file


def scenes() -> dict[str, Path]:
    """Files of the scenes bundled with varpin, by name."""
    return {path.stem: path for path in sorted((models_dir() / "scenes").glob("*.toml"))}
