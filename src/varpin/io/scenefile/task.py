"""A scene file applied to its robot: lists and tables become one number for each joint or control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from varpin.arrays import Floats, Mask
from varpin.control.constraints import PlanConstraint
from varpin.control.costs import Cost, CostSum, Terminal
from varpin.errors import RobotNotFound, VarpinError
from varpin.io.scenefile import kinds
from varpin.io.scenefile.reading import SceneFileError, Where
from varpin.io.scenefile.references import Timeline, constant, timeline
from varpin.mechanics.description import description_constraints
from varpin.mechanics.forces import Force, PositionServo
from varpin.mechanics.noise import Noise
from varpin.mechanics.reduction import Required, driving, idle_joints, report
from varpin.mechanics.scene import Scene, closest_controls, joints_with
from varpin.model import Robot, combine, load_robot
from varpin.model.clearance import Obstacle
from varpin.model.inertia import Payload
from varpin.model.tree import frame_of
from varpin.simulation.start import on_constraints, time_steps
from varpin.support.checks import count

# Largest number of steps; with costs a tenth of it by their number, as each evaluates its reference at each step.
_MOST_STEPS, _PER_COST = 10**7, 10
# Largest number of times at which controls and references are sampled for checks.
_SAMPLES = 2000
# Controls may pass a torque limit by rounding.
_ROUNDING = 1e-9
TABLES = (
    *("title", "gravity", "damping", "friction", "springs", "robot", "force", "constraint", "plan_constraint"),
    *("actuation", "noise", "initial", "horizon", "integrator", "cost", "simulate", "solve", "outputs"),
)


@dataclass(frozen=True, eq=False)
class Term:
    """A term of the cost."""

    where: Where
    kind: str  # its type in the file
    options: Mapping[str, Any]  # other keys than these
    terminal: bool  # whether it is a cost at the end instead of an integral over time
    weight: Floats  # of its components (c,)
    target: Timeline | None  # of its components
    hold: Floats | None  # configuration (n,) that its reference is to hold [rad or m]
    names: tuple[str, ...] | None  # the joints of its components; None for components that are not joints

    @property
    def frame(self) -> str:
        """The name of its frame; empty if it has none."""
        return str(self.options.get("frame", ""))

    def limits(self, robot: Robot) -> tuple[Floats, Floats] | None:
        """The limits (n,), (n,) of a barrier."""
        velocity = robot.velocity_limit
        return {"joint_limits": robot.position_limits, "velocity_limits": (-velocity, velocity)}.get(self.kind)

    def make(self, scene: Scene, joints: Sequence[str], driven: Sequence[str]) -> Cost | None:
        """The cost of a scene with these joints and these driven joints; None if it weighs nothing of it."""
        weight, target, robot = self.weight, self.target, scene.robot
        if self.names is not None:
            keep = [self.names.index(name) for name in (driven if self.kind in kinds.OF_CONTROLS else joints)]
            weight, target = weight[keep], None if target is None else target.columns(keep)
        if self.hold is not None:
            target = constant(closest_controls(scene, self.hold))
        limits = self.limits(robot)
        if not weight.any() or (limits is not None and not np.isfinite(limits).any()):
            return None
        own = dict(self.options)
        own["weight"] = float(weight[0]) if self.kind == "manipulability" else weight
        if target is not None:
            turned = self.kind == "frame_orientation"
            value: Any = _Turning(target) if turned else target
            own[kinds.target_key(self.kind)] = value(0.0) if target.constant else value
        if self.names is None or limits is not None:
            own["robot"] = robot
        with self.where.named({**self.options, "weight": 0.0, "target": 0.0}):
            cost = kinds.COSTS[self.kind](**own)
        return Terminal(cost) if self.terminal else cost


@dataclass(frozen=True, eq=False)
class _Turning:
    """Rotation matrices over time, Rz(yaw) Ry(pitch) Rx(roll) as in a URDF; a class, so that it can be pickled."""

    angles: Timeline

    def __call__(self, time: float) -> Floats:
        return np.asarray(Rotation.from_euler("xyz", self.angles(time)).as_matrix())


@dataclass(frozen=True, eq=False)
class Task:
    """A scene file on a robot, complete or without some of its joints."""

    where: Where
    tables: Mapping[str, Any]  # the content of the file
    scene: Scene
    q0: Floats  # (n,) [rad or m]
    v0: Floats  # (n,) [rad/s or m/s]
    dt: float  # [s]
    steps: int
    driven: tuple[str, ...]  # names of the driven joints (m)
    gear: Floats  # generalized force per control (m,)
    torque_limit: Floats  # (m,) [N m or N], infinite where there is none
    terms: tuple[Term, ...] = ()  # of the cost
    controls: Timeline | str | None = None  # of a simulation; "hold" for those that hold the robot at q0

    def require_start(self) -> None:
        """Refuse a start off the constraints."""
        if self.scene.constraints:
            with self.where.at("initial", "q").named():
                on_constraints(self.scene, self.q0, self.v0)

    def without(self, joints: Sequence[str]) -> Task:
        """The same task with ``joints`` held at their initial positions, and without what acts on them alone."""
        if not joints:
            return self
        names = self.scene.robot.joint_names
        held = {name: float(self.q0[names.index(name)]) for name in joints}
        keep, columns = np.flatnonzero([name not in held for name in names]), driving(self.scene, held)
        moving = [not term.frame or joints_of_frame(self.scene.robot, term.frame)[keep].any() for term in self.terms]
        controls = self.controls
        return replace(
            self,
            scene=self.scene.without(held),
            q0=self.q0[keep],
            v0=self.v0[keep],
            driven=tuple(self.driven[column] for column in columns),
            gear=self.gear[columns],
            torque_limit=self.torque_limit[columns],
            terms=tuple(
                replace(term, hold=None if term.hold is None else term.hold[keep])
                for term, moves in zip(self.terms, moving, strict=True)
                if moves
            ),
            controls=controls.columns(columns.tolist()) if isinstance(controls, Timeline) else controls,
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

    @property
    def times(self) -> Floats:
        """Times over the horizon [s] at which controls and references are sampled for checks."""
        return np.linspace(0.0, self.steps * self.dt, min(self.steps, _SAMPLES) + 1)

    def cost(self) -> Cost:
        """The cost as an object."""
        made = [term.make(self.scene, self.scene.robot.joint_names, self.driven) for term in self.terms]
        return CostSum(tuple(cost for cost in made if cost is not None))

    def plan_constraints(self) -> list[PlanConstraint]:
        """The constraints of a plan."""
        found, robot = [], self.scene.robot
        for where, given in self.where.at("plan_constraint").tables(self.tables.get("plan_constraint", [])):
            word, kind, own = where.kind(given, kinds.PLAN_CONSTRAINTS)
            others: dict[str, Any] = {} if word == "control_rate" else {"robot": robot}
            if word == "clearance":
                bodies = where.at("obstacles").tables(own.pop("obstacles", []))
                others |= {"obstacles": [_obstacle(*body) for body in bodies], "capsules": None}
                own |= {"srdf": where.at("srdf").file(own["srdf"])} if "srdf" in own else {}
            elif word.endswith("_limits") and own.keys() & {"lower", "upper"}:
                others["limits"] = own.pop("lower", -np.inf), own.pop("upper", np.inf)
            elif "rotation" in own:
                angles = where.at("rotation").numbers(own["rotation"], kinds.ANGLES, "angle")
                own["rotation"] = Rotation.from_euler("xyz", angles).as_matrix()
            found.append(where.call(kind, own, **others))
        return found


def _obstacle(where: Where, given: Any) -> Obstacle:
    word, make, own = where.kind(given, kinds.OBSTACLES)
    if word == "mesh" and "path" in own:
        own["path"] = where.at("path").file(own["path"])
    return where.call(make, own)


def joints_of_frame(robot: Robot, frame: str) -> Mask:
    """Whether each coordinate (n,) moves a frame."""
    model, moving = robot.model, np.zeros(robot.dof, dtype=np.bool_)
    for joint in model.supports[frame_of(model, frame, robot.name).parentJoint]:
        if joint > 0:
            moving[robot.tree.coordinate[joint - 1]] = True
    return moving


def required_of(task: Task, *, idle: bool) -> tuple[Task, Required]:
    """The task without idle joints, unless they stay, and the report on it."""
    scene, kept = task.scene, task.where.at("plan_constraint").tables(task.tables.get("plan_constraint", []))
    out: Mapping[str, float] = {}
    if idle and not (kept or scene.constraints):
        touched = np.any([np.zeros(scene.robot.dof), *(_touched(term, task) for term in task.terms)], axis=0)
        busy = [name for name, acts in zip(scene.robot.joint_names, touched, strict=True) if acts]
        controls: Any = np.zeros(scene.controls) if task.controls is None else task.controls
        if isinstance(controls, Timeline):
            controls = controls.at(task.times)
        elif task.controls == "hold":
            controls = closest_controls(scene, task.q0)
        out = idle_joints(scene, task.q0, task.v0, controls if scene.controls else None, busy)
    part = task.without(list(out))
    told = report(part.scene, scene, out)
    costs = [term.kind + (" at the end" if term.terminal else "") for term in part.terms]
    words = dict.fromkeys(place.kind(given, kinds.PLAN_CONSTRAINTS)[0] for place, given in kept)
    terms = {
        **told.terms,
        "torque limits": joints_with(np.isfinite(part.torque_limit), part.driven),
        "cost": ", ".join(costs) or "none",
    }
    if words:
        terms["the plan keeps"] = ", ".join(words).replace("_", " ")
    if "clearance" in words:
        terms["not modelled"] = terms["not modelled"].replace("a replay", "replays and clearance")
    return part, replace(told, terms=terms)


def _touched(term: Term, task: Task) -> Mask:
    """Joints (n,) that a term of the cost would move, or that it charges in the initial configuration."""
    scene, robot = task.scene, task.scene.robot
    if term.names is None:
        return joints_of_frame(robot, term.frame) if term.frame else np.ones(robot.dof, dtype=np.bool_)
    if (limits := term.limits(robot)) is not None:
        rest = task.q0 if term.kind == "joint_limits" else np.zeros(robot.dof)
        margin = term.where.at("margin").numbers(term.options.get("margin", 0.0), robot.joint_names)
        return np.asarray((term.weight != 0.0) & ((rest > limits[1] - margin) | (rest < limits[0] + margin)))
    rest = task.q0 if term.kind == "tracking" else np.zeros(robot.dof)
    if term.kind in kinds.OF_CONTROLS:
        rest = scene.command_at(task.q0)
    wanted = rest[None] if term.target is None else term.target.at(task.times)
    if term.hold is not None:
        wanted = closest_controls(scene, term.hold)[None]
    moves = ((wanted != rest) & (term.weight != 0.0)).any(axis=0)
    of_controls = term.kind in kinds.OF_CONTROLS
    return np.asarray((scene.actuation != 0.0)[:, moves].any(axis=1) if of_controls else moves)


def task_of(root: Where, tables: dict[str, Any]) -> Task:
    """Load the robot of a file and apply the file to it."""
    root.table(tables, TABLES, ("robot", "horizon"))
    at = root.at("horizon")
    keys = ("dt", "steps", "duration", "hold", "sampling", "controls", "between_nodes")
    horizon = at.table(tables["horizon"], keys, ("dt",))
    costs = len(root.at("cost").tables(tables.get("cost", [])))
    if ("steps" in horizon) == ("duration" in horizon):
        raise at.error("a horizon has steps, or a duration [s]: give one of them")
    with at.named(horizon):
        dt, steps = time_steps(horizon["dt"], horizon.get("steps"), horizon.get("duration"))
        count("steps", steps, 1)
    if steps * max(1, _PER_COST * costs) > _MOST_STEPS:
        raise at.error(f"{steps} steps are more than {_MOST_STEPS}, or a tenth of that divided by the number of costs")
    return _on_robot(root, tables, _robot(root.at("robot"), tables["robot"]), dt, steps)


def _robot(where: Where, given: Any) -> Robot:
    """The robot of a file, or several in one."""
    if not isinstance(given, list):
        return _one(where, given)
    members = [(place, dict(place.table(own))) for place, own in where.tables(given)]
    prefixes = [place.at("prefix").text(own.pop("prefix")) if "prefix" in own else "" for place, own in members]
    robots = [_one(place, own) for place, own in members]
    with where.named():
        return combine(*robots, prefixes=prefixes)


def _one(where: Where, given: Any) -> Robot:
    """The robot of one table."""
    own = dict(where.table(given, None, ("source",)))
    source = where.at("source").text(own["source"])
    if "." in source or "/" in source or "\\" in source:
        own["source"] = where.at("source").file(source)
    if "srdf" in own:
        own["srdf"] = where.at("srdf").file(own["srdf"])
    if isinstance(base := own.get("base"), dict):
        own["base"] = _placement(where.at("base"), base)
    folders = own.get("package_dirs", [])
    if isinstance(folders, list) and folders:
        own["package_dirs"] = [where.at("package_dirs", k).beside(folder) for k, folder in enumerate(folders)]
    payloads = where.at("payload").tables(own.get("payload", []))
    own["payload"] = [place.call(Payload, load) for place, load in payloads]
    lock = own.get("lock", {})
    for joint, value in lock.items() if isinstance(lock, dict) else ():
        if isinstance(value, int | float):
            where.at("lock", joint).refuse_degrees(np.array([value]), [joint], [False])
    try:
        return where.call(load_robot, own)
    except SceneFileError as error:
        if isinstance(error.__context__, RobotNotFound):
            raise where.at("source").error(error.problem) from None
        raise


def _placement(where: Where, given: dict[str, Any]) -> Floats:
    """The placement (4, 4) of a base: its place and its angles."""
    where.table(given, ("xyz", "rpy"))
    transform = np.eye(4)
    angles = where.at("rpy").numbers(given.get("rpy", 0.0), kinds.ANGLES, "angle")
    transform[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    transform[:3, 3] = where.at("xyz").numbers(given.get("xyz", 0.0), ("x", "y", "z"), "axis")
    return transform


def _on_robot(root: Where, tables: Mapping[str, Any], robot: Robot, dt: float, steps: int) -> Task:
    names = robot.joint_names
    initial, springs = (tables.get(name, {}) for name in ("initial", "springs"))
    root.at("initial").table(initial, ("q", "v"))
    root.at("springs").table(springs, ("stiffness", "rest"))
    q0 = root.at("initial", "q").positions(initial.get("q", 0.0), robot)
    driven, gear, limit = _actuation(root.at("actuation"), tables.get("actuation", {}), robot)
    matrix = np.zeros((robot.dof, len(driven)))
    matrix[[robot.coordinate(joint) for joint in driven], np.arange(len(driven))] = gear
    constraints: list[Any] = []
    for where, given in root.at("constraint").tables(tables.get("constraint", [])):
        _, kind, own = where.kind(given, kinds.CONSTRAINTS)
        constraints.append(_bound(where, kind, own, robot))
    given = {
        "gravity": tables.get("gravity", True),
        "damping": tables.get("damping"),
        "friction": tables.get("friction"),
        "stiffness": springs.get("stiffness", 0.0),
        "rest": root.at("springs", "rest").positions(springs.get("rest", 0.0), robot),
        "forces": _forces(root.at("force"), tables.get("force", []), robot, driven, limit),
        "actuation": matrix,
        "noise": _noise(root.at("noise"), tables.get("noise", []), robot, driven) or None,
        "constraints": constraints or None,
    }
    try:
        scene = Scene(robot, **given)
    except VarpinError as error:
        words = {"stiffness": "springs.stiffness", "Noise": "noise", "control": "actuation", "Servo": "force"}
        key = next((key for word, key in words.items() if word in str(error)), root.of(error, given).key)
        raise SceneFileError(root.path.name, key, str(error)) from None
    v0 = root.at("initial", "v").numbers(initial.get("v", 0.0), names)
    task = Task(root, tables, scene, q0, v0, dt, steps, driven, gear, limit)
    horizon = dt, dt * steps
    terms = [_term(where, cost, task, horizon) for where, cost in root.at("cost").tables(tables.get("cost", []))]
    where = root.at("simulate")
    controls = where.table(tables.get("simulate", {}), ("controls", "seed")).get("controls")
    if controls is not None and controls != "hold":
        controls = timeline(controls, where.at("controls"), driven, "driven joint", robot, horizon)
        force = np.abs(controls.at(task.times) * gear).max(axis=0)
        over = (force > limit * (1.0 + _ROUNDING)) & ~task.positions
        if over.any():
            k = int(np.argmax(over))
            told = f"of {driven[k]!r} reach {force[k]:g} N m or N; torque_limit is {limit[k]:g}"
            raise where.at("controls").error(told)
    return replace(task, terms=tuple(terms), controls=controls)


def _actuation(where: Where, given: Any, robot: Robot) -> tuple[tuple[str, ...], Floats, Floats]:
    """The driven joints (m), their gears (m,), and the limits (m,) of the torques at the joints [N m or N]."""
    where.table(given, ("joints", "gear", "torque_limit"))
    driven = given.get("joints", list(robot.joint_names))
    if not isinstance(driven, list) or not driven:
        raise where.at("joints").error("must be a list of at least one joint; leave it out to drive all of them")
    for index, joint in enumerate(driven):
        where.at("joints", index).one_of(joint, [name for name in robot.joint_names if name not in driven[:index]])
    gear = where.at("gear").numbers(given.get("gear", 1.0), driven, "driven joint")
    if not gear.all():
        raise where.at("gear").error(f"must not be 0, and is for {driven[int(np.argmin(np.abs(gear)))]!r}")
    at, value = where.at("torque_limit"), given.get("torque_limit")
    if value is None:
        return tuple(driven), gear, np.full(len(driven), np.inf)
    own = robot.effort_limit[[robot.coordinate(joint) for joint in driven]]
    limit = own if value == "robot" else at.numbers(value, driven, "driven joint")
    if not ((limit > 0.0) & np.isfinite(limit)).all():
        joint = driven[int(np.argmin((limit > 0.0) & np.isfinite(limit)))]
        raise at.error(f"must be > 0 and finite [N m or N] for {joint!r}")
    return tuple(driven), gear, limit


def _bound(where: Where, kind: Any, own: dict[str, Any], robot: Robot) -> Any:
    """A force or a constraint of the keys of a table, which fits the robot."""
    points = {
        name: (value["frame"], value["place"])
        for name, value in own.items()
        if isinstance(value, dict) and value.keys() == {"frame", "place"}
    }
    made = where.call(kind, own | points)
    with where.named(own | points):
        description_constraints(robot) if made == "robot" else made.bind(robot)
    return made


def _forces(where: Where, given: Any, robot: Robot, driven: Sequence[str], limit: Floats) -> list[Force]:
    """The forces of a file. Torque limits of driven joints bound the effort of servos."""
    most = np.full(robot.dof, np.inf)
    most[[robot.coordinate(joint) for joint in driven]] = limit
    found: list[Force] = []
    for place, table in where.tables(given):
        word, kind, own = place.kind(table, kinds.FORCES)
        if word == "friction" and own.get("level") == "robot":
            own["level"] = robot.friction
        force = _bound(place, kind, own, robot)
        if isinstance(force, PositionServo) and np.isfinite(most).any():
            bounds = np.full(robot.dof, np.inf)
            for servo in force.bind(robot):
                bounds[servo.coordinate] = servo.values[2]
            force = replace(force, effort=np.minimum(bounds, most))
        found.append(force)
    return found


def _noise(where: Where, given: Any, robot: Robot, driven: Sequence[str]) -> list[Noise]:
    """The noise models of a file."""
    found: list[Noise] = []
    for place, table in where.tables(given):
        word, kind, own = place.kind(table, kinds.NOISE)
        whose, what = (driven, "driven joint") if word == "control" else (robot.joint_names, "joint")
        if "intensity" in own:
            own["intensity"] = place.at("intensity").numbers(own["intensity"], whose, what)
        if "center" in own:
            own["center"] = place.at("center").positions(own["center"], robot)
        found.append(place.call(kind, own))
    return found


def _term(where: Where, table: Any, task: Task, horizon: tuple[float, float]) -> Term:
    """A term of the cost; ``horizon`` is the step and the duration [s]."""
    kind, _, own = where.kind(table, kinds.COSTS)
    robot, target_key = task.scene.robot, kinds.target_key(kind)
    keys = kinds.cost_keys(kind)
    where.table(own, keys, [key for key, needed in keys.items() if needed])
    names: tuple[str, ...] | None = None
    if kind in kinds.OF_JOINTS + kinds.OF_CONTROLS:
        names = task.driven if kind in kinds.OF_CONTROLS else robot.joint_names
    what = "joint" if names is not None else "component"
    if "frame" in own:
        where.at("frame").one_of(own["frame"], [frame.name for frame in robot.model.frames])
    axes = names if names is not None else kinds.AXES.get(kind, ("weight",))
    weight = where.at("weight").numbers(own.pop("weight", 1.0), axes, what)
    hold, terminal, given = own.pop("hold", None), own.pop("terminal", False), own.pop(target_key, None)
    if not isinstance(terminal, bool):
        raise where.at("terminal").error("must be true or false")
    if hold is not None and given is not None:
        raise where.error(f"hold and {target_key} exclude each other: give one of them")
    at, target = where.at(target_key), None
    if kind == "control_rate" and given is not None:
        target = constant(at.numbers(given, axes, what))
    elif target_key and hold is None and kind != "control_rate":
        axes = kinds.ANGLES if kind == "frame_orientation" else axes
        target = timeline(0.0 if given is None else given, at, axes, what, robot, horizon)
        if kind == "tracking" and target.constant:
            at.refuse_degrees(target(0.0), robot.joint_names, robot.slides.tolist())
    if hold is not None:
        hold = task.q0 if hold is True else where.at("hold").positions(hold, robot)
    term = Term(where, kind, own, terminal, weight, target, hold, names)
    if (limits := term.limits(robot)) is not None and not np.isfinite(limits).any():
        raise where.at("type").error(f"robot {robot.name!r} has no such limits")
    return term
