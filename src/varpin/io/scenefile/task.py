"""A scene file applied to its robot: lists and tables become one number for each joint or control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from varpin.arrays import Floats, Integers, Mask
from varpin.control.costs import Cost, CostSum, Terminal
from varpin.errors import InputError, RobotError, RobotNotFound, UnknownFrame, UnknownJoint, VarpinError
from varpin.io.scenefile.reading import SceneFileError, Where, suggestion
from varpin.io.scenefile.references import Timeline, constant, timeline
from varpin.io.scenefile.tables import NoiseTable, RobotTable, SceneTables
from varpin.io.scenefile.terms import CostTable
from varpin.mechanics.description import description_constraints
from varpin.mechanics.forces import CoulombFriction, Force, PositionServo
from varpin.mechanics.noise import AdditiveNoise, ControlNoise, Noise, StateNoise
from varpin.mechanics.reduction import Required, driving, idle_joints, report
from varpin.mechanics.scene import Scene, closest_controls, joints_with
from varpin.model import Robot, combine, load_robot, looks_like_degrees
from varpin.model.tree import frame_index
from varpin.simulation.start import on_constraints

# Largest number of times at which controls and references are sampled for checks.
_SAMPLES = 2000
# Controls may pass a torque limit by rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class CostTerm:
    """A term of the cost with the weights (c,) and the target of its components."""

    table: CostTable
    where: Where
    weight: Floats
    target: Timeline | None
    holding_q: Floats | None


@dataclass(frozen=True, eq=False)
class Task:
    """A scene file on a robot, complete or without some of its joints.

    Attributes:
        tables: The file.
        scene: The scene.
        q0: Initial configuration (n,) [rad or m].
        v0: Initial velocity (n,) [rad/s or m/s].
        driven: Names of the driven joints (m).
        gear: Generalized force per control (m,).
        torque_limit: Bounds (m,) [N m or N], infinite where there is none.
        costs: Terms of the cost.
        controls: Controls of a simulation over time; None for none, ``"hold"`` for those that hold the robot at q0.
    """

    tables: SceneTables
    scene: Scene
    q0: Floats
    v0: Floats
    driven: tuple[str, ...]
    gear: Floats
    torque_limit: Floats
    costs: tuple[CostTerm, ...]
    controls: Timeline | str | None

    def require_start(self) -> None:
        """Refuse a start off the constraints.

        Raises:
            SceneFileError: It misses them by too much.
        """
        if self.scene.constraints:
            try:
                on_constraints(self.scene, self.q0, self.v0)
            except VarpinError as error:
                raise self.tables.where.at("initial").at("q").error(str(error)) from None

    def without(self, joints: Sequence[str]) -> Task:
        """The same task with ``joints`` held at their initial positions, and without what acts on them alone."""
        if not joints:
            return self
        names = self.scene.robot.joint_names
        held = {name: float(self.q0[names.index(name)]) for name in joints}
        keep, columns = np.flatnonzero([name not in held for name in names]), driving(self.scene, held)
        costs = []
        for term in self.costs:
            kind = term.table.term
            if kind.space == "frame" and not joints_of_frame(self.scene.robot, term.table.frame)[keep].any():
                continue
            costs.append(_columns(term, columns if kind.space == "u" else keep, keep) if kind.of_joints else term)
        return Task(
            tables=self.tables,
            scene=self.scene.without(held),
            q0=self.q0[keep],
            v0=self.v0[keep],
            driven=tuple(self.driven[column] for column in columns),
            gear=self.gear[columns],
            torque_limit=self.torque_limit[columns],
            costs=tuple(costs),
            controls=self.controls.columns(columns.tolist()) if isinstance(self.controls, Timeline) else self.controls,
        )

    @property
    def positions(self) -> Mask:
        """Whether each control (m,) is the position of a servo or a kinematic input."""
        moved = [self.scene.robot.joint_names[c] for c in self.scene.inputs.values()]
        return np.isin(self.driven, [*self.scene.servo_joints, *moved])

    @property
    def control_limit(self) -> Floats:
        """Bounds of the scene's controls, infinite where there is none; those of servos bound the effort instead."""
        limit = np.full(self.scene.controls, np.inf)
        limit[: len(self.driven)] = np.where(self.positions, np.inf, self.torque_limit / np.abs(self.gear))
        return limit

    def cost(self) -> Cost:
        """The cost as an object."""
        made = []
        for term in self.costs:
            table, target, robot = term.table, term.target, self.scene.robot
            if term.holding_q is not None:
                target = constant(closest_controls(self.scene, term.holding_q))
            limits = table.term.limits
            if not term.weight.any() or (limits and not np.isfinite(limits(robot)).any()):
                continue
            try:
                cost = table.term.make(robot, term.weight, target, table.given)
            except VarpinError as error:
                raise term.where.of(error, table.given) from None
            made.append(Terminal(cost) if table.terminal else cost)
        return CostSum(tuple(made))


def _columns(term: CostTerm, index: Integers, joints: Integers) -> CostTerm:
    return replace(
        term,
        weight=term.weight[index],
        target=None if term.target is None else term.target.columns(index.tolist()),
        holding_q=None if term.holding_q is None else term.holding_q[joints],
    )


def joints_of_frame(robot: Robot, frame: str) -> Mask:
    """Whether each coordinate (n,) moves a frame."""
    model, moving = robot.free_model, np.zeros(robot.dof, dtype=np.bool_)
    for joint in model.supports[model.frames[frame_index(model, frame, robot.name)].parentJoint]:
        if joint > 0:
            moving[robot.tree.coordinate[joint - 1]] = True
    return moving


def times_of(tables: SceneTables) -> Floats:
    """Times over the horizon [s] at which controls and references are sampled for checks."""
    return np.linspace(0.0, tables.duration, min(tables.steps, _SAMPLES) + 1)


def required_of(task: Task, *, idle: bool) -> tuple[Task, Required]:
    """The task without idle joints, unless they stay, and the report on it."""
    scene, tables = task.scene, task.tables
    out: Mapping[str, float] = {}
    if idle and not (tables.plan_constraint or scene.constraints):
        touched = np.any([_touched(term, task) for term in task.costs], axis=0) if task.costs else []
        busy = [name for name, acts in zip(scene.robot.joint_names, touched, strict=False) if acts]
        controls: Any = task.controls
        if isinstance(controls, Timeline):
            controls = controls.at(times_of(tables))
        elif controls == "hold":
            controls = closest_controls(scene, task.q0)
        elif scene.controls:
            controls = np.zeros(scene.controls)
        out = idle_joints(scene, task.q0, task.v0, controls, busy)
    part = task.without(list(out))
    told = report(part.scene, scene, out)
    whole = ", ".join(sorted({term.table.kind for term in part.costs if term.table.term.space == "robot"}))
    if whole and len(told.parts) > 1:
        told = replace(told, parts=(told.joints,), coupled=f"the cost has a term on the whole robot ({whole})")
    terms = {**told.terms, **_terms(part)}
    if any(constraint.kind == "clearance" for constraint in tables.plan_constraint):
        terms["not modelled"] = terms["not modelled"].replace("a replay", "replays and clearance")
    return part, replace(told, terms=terms)


def _touched(term: CostTerm, task: Task) -> Mask:
    """Joints (n,) that a term of the cost would move, or that it charges in the initial configuration."""
    scene, kind = task.scene, term.table.term
    robot, rest_u = scene.robot, scene.command_at(task.q0)
    if kind.space == "frame":
        return joints_of_frame(robot, term.table.frame)
    if kind.space == "robot":
        return np.ones(robot.dof, dtype=np.bool_)
    rest = {"q": task.q0, "v": np.zeros(robot.dof), "u": rest_u}[kind.space]
    if kind.limits is not None:
        lower, upper = kind.limits(robot)
        margin = term.table.given.get("margin", 0.0)
        return np.asarray((term.weight != 0.0) & ((rest > upper - margin) | (rest < lower + margin)))
    if term.holding_q is not None:
        wanted = closest_controls(scene, term.holding_q)[None]
    else:
        wanted = rest[None] if term.target is None else term.target.at(times_of(task.tables))
    moves = ((wanted != rest) & (term.weight != 0.0)).any(axis=0)
    return np.asarray((scene.actuation != 0.0)[:, moves].any(axis=1) if kind.space == "u" else moves)


def _terms(task: Task) -> dict[str, str]:
    """What a report says of the file beside its scene."""
    tables = task.tables
    costs = [term.table.kind + (" at the end" if term.table.terminal else "") for term in task.costs]
    kept = dict.fromkeys(constraint.kind.replace("_", " ") for constraint in tables.plan_constraint)
    payloads = [
        f"{payload.mass:g} kg at {word}{payload.frame}"
        for word, robot in zip(tables.prefixes or ("",), tables.robot, strict=True)
        for payload in robot.payload
    ]
    terms = {
        "payload": ", ".join(payloads) or "none",
        "torque limits": joints_with(np.isfinite(task.torque_limit), task.driven),
        "cost": ", ".join(costs) or "none",
    }
    if kept:
        terms["the plan keeps"] = ", ".join(kept)
    return terms


def _robot(tables: SceneTables) -> Robot:
    place = tables.where.at("robot")
    if not tables.prefixes:
        return _one(tables.robot[0], place)
    robots = [_one(given, place.at(index)) for index, given in enumerate(tables.robot)]
    try:
        return combine(*robots, prefixes=tables.prefixes)
    except InputError as error:
        raise place.at(len(robots) - 1).at("prefix").error(str(error)) from None


def _one(given: RobotTable, place: Where) -> Robot:
    for joint, value in given.lock.items():
        if isinstance(value, float) and looks_like_degrees(value):
            raise place.at("lock").at(joint).error(f"{value:g} looks like degrees: positions are in rad or m")
    options = {name: value for name, value in vars(given).items() if name not in ("source", "prefix")}
    try:
        return load_robot(given.source, **options)
    except RobotNotFound as error:
        raise place.at("source").error(str(error)) from None
    except UnknownFrame as error:
        index = [load.frame for load in given.payload].index(error.frame)
        raise place.at("payload").at(index).at("frame").error(str(error)) from None
    except UnknownJoint as error:
        raise place.of(error, options) from None
    except (RobotError, InputError) as error:
        raise place.error(str(error)) from None


def task_of(tables: SceneTables) -> Task:
    """Load the robot and apply the file to it.

    Raises:
        SceneFileError: Names, lengths or values do not fit the robot.
    """
    robot = _robot(tables)
    try:
        return _on_robot(tables, robot)
    except SceneFileError as error:
        name = error.key.rpartition(".")[2]
        if name not in robot.locked:
            raise
        raise SceneFileError(error.source, error.key, f"the joint is locked at {robot.locked[name]}") from None


def _on_robot(tables: SceneTables, robot: Robot) -> Task:
    names, root = robot.joint_names, tables.where
    springs, initial, actuation = root.at("springs"), root.at("initial"), root.at("actuation")
    rest = springs.at("rest").positions(tables.springs.rest, robot)
    stiffness = springs.at("stiffness").spread(tables.springs.stiffness, names)
    q0 = initial.at("q").positions(tables.initial.q, robot)
    _refuse_degrees(springs.at("rest"), rest, robot)
    _refuse_degrees(initial.at("q"), q0, robot)
    driven = names if tables.actuation.joints is None else tables.actuation.joints
    for index, joint in enumerate(driven):
        if joint not in names:
            told = f"there is no joint {joint!r}; {suggestion(joint, names, 'joints')}"
            raise actuation.at("joints").at(index).error(told)
    gear = actuation.at("gear").spread(tables.actuation.gear, driven, "driven joint")
    if not gear.all():
        raise actuation.at("gear").error(f"must not be 0, and is for {driven[int(np.argmin(np.abs(gear)))]!r}")
    limit = _torque_limit(tables, robot, driven)
    joints = [names.index(joint) for joint in driven]
    matrix = np.zeros((robot.dof, len(driven)))
    matrix[joints, np.arange(len(driven))] = gear
    effort = np.full(robot.dof, np.inf)
    effort[joints] = limit
    given = {
        name: value if value is None or isinstance(value, str) else root.at(name).spread(value, names)
        for name, value in (("damping", tables.damping), ("friction", tables.friction))
    }
    noise = [_noise(model, root.at("noise").at(k), matrix, driven, robot) for k, model in enumerate(tables.noise)]
    try:
        scene = Scene(
            robot,
            gravity=tables.gravity,
            damping=given["damping"],
            friction=given["friction"],
            stiffness=stiffness,
            rest=rest,
            forces=_forces(tables, robot, effort),
            constraints=tables.constraint or None,
            actuation=matrix,
            noise=[model for model in noise if model is not None] or None,
        )
    except VarpinError as error:
        raise _located(error, tables, robot) from None
    controls = tables.simulate.controls
    if controls is not None and controls != "hold":
        controls = timeline(
            controls, root.at("simulate").at("controls"), driven, "driven joint", robot, tables.dt, tables.duration
        )
    task = Task(
        tables=tables,
        scene=scene,
        q0=q0,
        v0=initial.at("v").spread(tables.initial.v, names),
        driven=tuple(driven),
        gear=gear,
        torque_limit=limit,
        costs=tuple(
            _term(cost, root.at("cost").at(k), robot, driven, q0, tables) for k, cost in enumerate(tables.cost)
        ),
        controls=controls,
    )
    _require_controls(task)
    return task


def _refuse_degrees(place: Where, values: Floats, robot: Robot) -> None:
    for joint, value, slide in zip(robot.joint_names, values.tolist(), robot.slides.tolist(), strict=True):
        if not slide and looks_like_degrees(value):
            raise place.error(f"{value:g} of {joint!r} looks like degrees: angles are in rad")


def _torque_limit(tables: SceneTables, robot: Robot, driven: Sequence[str]) -> Floats:
    given, place = tables.actuation.torque_limit, tables.where.at("actuation").at("torque_limit")
    if given is None:
        return np.full(len(driven), np.inf)
    if isinstance(given, str):
        limit = robot.effort_limit[[robot.coordinate(joint) for joint in driven]]
        if not np.isfinite(limit).all():
            joint = driven[int(np.argmax(~np.isfinite(limit)))]
            raise place.error(f"the robot description gives {joint!r} none: write numbers [N m or N]")
        return limit
    limit = place.spread(given, driven, "driven joint")
    if not (limit > 0.0).all():
        k = int(np.argmax(~(limit > 0.0)))
        raise place.error(f"must be > 0 [N m or N], and is {limit[k]:g} for {driven[k]!r}")
    return limit


def _forces(tables: SceneTables, robot: Robot, limit: Floats) -> list[Force]:
    """The forces of a file. Torque limits (n,) bound the effort of servos."""
    found: list[Force] = []
    for force in tables.force:
        if isinstance(force, CoulombFriction) and isinstance(force.level, str):
            found.append(replace(force, level=robot.friction))
        elif isinstance(force, PositionServo) and np.isfinite(limit).any():
            effort = np.full(robot.dof, np.inf)
            for servo in force.bind(robot):
                effort[servo.coordinate] = servo.values[2]
            found.append(replace(force, effort=np.minimum(effort, limit)))
        else:
            found.append(force)
    return found


def _located(error: VarpinError, tables: SceneTables, robot: Robot) -> SceneFileError:
    """An error of the scene with its place in the file."""
    for key, parts in (("force", tables.force), ("constraint", tables.constraint)):
        for index, part in enumerate(parts):
            try:
                description_constraints(robot) if isinstance(part, str) else part.bind(robot)
            except VarpinError as wrong:
                place = tables.where.at(key).at(index)
                return place.of(wrong, {} if isinstance(part, str) else vars(part))
    words = {"Noise": "noise", "control": "actuation", "servo": "force"}
    key = next((key for word, key in words.items() if word in str(error)), "")
    return tables.where.at(key).error(str(error))


def _noise(given: NoiseTable, place: Where, actuation: Floats, driven: Sequence[str], robot: Robot) -> Noise | None:
    """A noise model with its nonzero processes alone; None if there are none."""
    of_control = given.type == "control"
    whose, what = (driven, "driven joint") if of_control else (robot.joint_names, "joint")
    intensity = place.at("intensity").spread(given.intensity, whose, what)
    center = None if given.center is None else place.at("center").positions(given.center, robot)
    act = np.flatnonzero(intensity)
    if not len(act):
        return None
    if given.type == "state":
        return StateNoise(intensity, center)
    if not of_control:
        return AdditiveNoise(np.diag(intensity)[:, act])
    field = np.zeros((robot.dof, len(act), len(driven)))
    field[:, np.arange(len(act)), act] = (actuation * intensity)[:, act]
    return ControlNoise(field)


def _term(
    table: CostTable, place: Where, robot: Robot, driven: Sequence[str], q0: Floats, tables: SceneTables
) -> CostTerm:
    term, given = table.term, table.given
    if term.space == "frame":
        try:
            frame_index(robot.free_model, table.frame, robot.name)
        except UnknownFrame as error:
            raise place.at("frame").error(str(error)) from None
    if term.limits and not np.isfinite(term.limits(robot)).any():
        raise place.at("type").error(f"robot {robot.name!r} has no such limits")
    joints, what = (tuple(driven), "driven joint") if term.space == "u" else (robot.joint_names, "joint")
    axes, kind = (joints, what) if term.of_joints else (term.axes or ("weight",), "axis")
    weight = place.at("weight").spread(given.get("weight", 1.0), axes, kind)
    target = None
    if term.target and "hold" not in given and (term.target in given or term.target != "before"):
        components, kind = (joints, what) if term.of_joints else (term.components, "component")
        at = place.at(term.target)
        target = timeline(given.get(term.target, 0.0), at, components, kind, robot, tables.dt, tables.duration)
        if term.space == "q" and target.constant:
            _refuse_degrees(at, target(0.0), robot)
    holding_q = None
    if "hold" in given:
        holding_q = q0 if given["hold"] is True else place.at("hold").positions(given["hold"], robot)
    return CostTerm(table, place, weight, target, holding_q)


def _require_controls(task: Task) -> None:
    """Refuse controls of a simulation that are positions in degrees, or beyond limits."""
    if not isinstance(task.controls, Timeline):
        return
    place, robot = task.tables.where.at("simulate").at("controls"), task.scene.robot
    given = task.controls.at(times_of(task.tables))
    for k in np.flatnonzero(task.positions).tolist():
        worst = float(given[np.argmax(np.abs(given[:, k])), k])
        if not robot.slides[robot.coordinate(task.driven[k])] and looks_like_degrees(worst):
            raise place.error(f"{worst:g} of {task.driven[k]!r} looks like degrees: positions are in rad")
    force, limit = np.abs(given * task.gear), np.where(task.positions, np.inf, task.torque_limit)
    if (force > limit * (1.0 + _ROUNDING)).any():
        k = int(np.argmax((force - limit).max(axis=0)))
        told = f"reach {force[:, k].max():g} N m or N; torque_limit is {limit[k]:g}"
        raise place.error(f"of {task.driven[k]!r} {told}")
