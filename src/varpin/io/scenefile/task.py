"""A scene file applied to its robot: lists and tables become one number for each joint or control."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from varpin.arrays import Floats, Integers, Mask
from varpin.control import costs
from varpin.control.constraints import PlanConstraint
from varpin.control.costs import Cost
from varpin.errors import RobotNotFound, VarpinError
from varpin.io.scenefile import kinds
from varpin.io.scenefile.reading import SceneFileError, Where
from varpin.io.scenefile.references import Reader, Timeline, timeline
from varpin.mechanics.description import description_constraints
from varpin.mechanics.forces import PositionServo
from varpin.mechanics.noise import Noise
from varpin.mechanics.reduction import Required, driving, idle_joints, report
from varpin.mechanics.scene import Scene, closest_controls, joints_with
from varpin.model import Robot, combine, load_robot
from varpin.model.clearance import Obstacle
from varpin.model.inertia import Payload
from varpin.model.tree import path_coordinates, place_of_frame
from varpin.simulation.start import on_constraints, time_steps
from varpin.support.checks import count, flag, joint_array

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


def _turned(angles: Floats) -> Floats:
    """The rotation matrix Rz(yaw) Ry(pitch) Rx(roll) of (roll, pitch, yaw), as in a URDF."""
    return np.asarray(Rotation.from_euler("xyz", angles).as_matrix())


# A part of this function can be pickled, and a closure cannot.
def _turned_at(angles: Timeline, time: float) -> Floats:
    return _turned(angles(time))


@dataclass(frozen=True, eq=False)
class Task:
    """A scene file on a robot, complete or without some of its joints."""

    where: Where
    tables: Mapping[str, Any]  # the content of the file
    robot: Robot  # whose joints the numbers in the file are of
    motors: tuple[str, ...]  # names of its driven joints
    scene: Scene
    joints: Integers  # the robot's coordinates that are in the scene (n,)
    columns: Integers  # the motors that are (m,)
    q0: Floats  # (n,) [rad or m]
    v0: Floats  # (n,) [rad/s or m/s]
    dt: float  # [s]
    steps: int
    gear: Floats  # generalized force per control (m,)
    torque_limit: Floats  # (m,) [N m or N], infinite where there is none
    costs: tuple[Cost, ...] = ()
    controls: Timeline | str | None = None  # of a simulation; "hold" for those that hold the robot at q0

    @property
    def driven(self) -> list[str]:
        """Names of the driven joints (m)."""
        return [self.motors[column] for column in self.columns]

    def complete(self) -> Task:
        """The task with its costs and controls."""
        given = self.where.entries(self.tables, "cost", kinds.COSTS)
        if given:
            self.require_start()
        found = [_cost(self, *each) for each in given]
        return replace(self, costs=tuple(cost for cost in found if cost is not None), controls=_controls(self))

    def reader(self, where: Where, names: Sequence[str], what: str) -> Reader:
        """What references with these components are of."""
        return Reader(where, self.robot, names, what, self.dt, self.dt * self.steps)

    def require_start(self) -> None:
        """Refuse a start off the constraints."""
        if self.scene.constraints:
            with self.where.at("initial", "q").named():
                on_constraints(self.scene, self.q0, self.v0)

    def without(self, joints: Sequence[str]) -> Task:
        """The same task with ``joints`` held at their initial positions, and without what acts on them alone."""
        if not joints:
            return self
        names = self.robot.joint_names
        held = {name: float(self.q0[names.index(name)]) for name in joints}
        keep, columns = np.flatnonzero([name not in held for name in names]), driving(self.scene, held)
        part = replace(
            self,
            scene=self.scene.without(held),
            joints=keep,
            columns=columns,
            q0=self.q0[keep],
            v0=self.v0[keep],
            gear=self.gear[columns],
            torque_limit=self.torque_limit[columns],
        )
        return part.complete()

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

    def plan_constraints(self) -> list[PlanConstraint]:
        """The constraints of a plan."""
        found, robot = [], self.scene.robot
        for where, word, kind, own in self.where.entries(self.tables, "plan_constraint", kinds.PLAN_CONSTRAINTS):
            others: dict[str, Any] = {} if word == "control_rate" else {"robot": robot}
            if word == "clearance":
                bodies = where.entries({"obstacles": own.pop("obstacles", [])}, "obstacles", kinds.OBSTACLES)
                others |= {"obstacles": [_obstacle(*body) for body in bodies], "capsules": None}
                if "srdf" in own:
                    own["srdf"] = where.at("srdf").file(own["srdf"])
            elif word.endswith("_limits") and own.keys() & {"lower", "upper"}:
                others["limits"] = own.pop("lower", -np.inf), own.pop("upper", np.inf)
            elif "rotation" in own:
                angles = where.at("rotation").numbers(own["rotation"], kinds.ANGLES, "angle")
                own["rotation"] = _turned(angles)
            found.append(where.call(kind, own, **others))
        return found


def _obstacle(where: Where, word: str, make: Callable[..., Obstacle], own: dict[str, Any]) -> Obstacle:
    if word == "mesh" and "path" in own:
        own["path"] = where.at("path").file(own["path"])
    return where.call(make, own)


def required_of(task: Task, *, idle: bool) -> tuple[Task, Required]:
    """The task without idle joints, unless they stay, and the report on it."""
    scene, kept = task.scene, task.where.entries(task.tables, "plan_constraint", kinds.PLAN_CONSTRAINTS)
    out: Mapping[str, float] = {}
    if idle and not (kept or scene.constraints):
        touched = np.any([np.zeros(scene.robot.dof), *(_touched(cost, task) for cost in task.costs)], axis=0)
        busy = [name for name, acts in zip(scene.robot.joint_names, touched, strict=True) if acts]
        controls: Any = np.zeros(scene.controls) if task.controls is None else task.controls
        if isinstance(controls, Timeline):
            controls = controls.at(task.times)
        elif task.controls == "hold":
            controls = closest_controls(scene, task.q0)
        out = idle_joints(scene, task.q0, task.v0, controls if scene.controls else None, busy)
    part = task.without(list(out))
    told = report(part.scene, scene, out)
    costs = [kinds.COST_WORDS[type(cost)] + (" at the end" if cost.at_end else "") for cost in part.costs]
    words = dict.fromkeys(word for _, word, *_ in kept)
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


def _touched(cost: Any, task: Task) -> Mask:
    """Joints (n,) that a term of the cost would move, or that it charges in the initial configuration."""
    scene, still = task.scene, np.zeros(task.scene.robot.dof)
    if isinstance(cost, costs.CenterOfMassCost):
        return np.ones(len(still), dtype=np.bool_)
    if hasattr(cost, "frame"):
        body, *_ = place_of_frame(scene.robot.model, cost.frame, scene.robot.name)
        return np.isin(np.arange(len(still)), path_coordinates(scene.robot.tree, body))
    if isinstance(cost, costs.JointLimitBarrier | costs.VelocityLimitBarrier):
        rest = task.q0 if isinstance(cost, costs.JointLimitBarrier) else still
        beyond = (rest > cost.limits[1] - cost.margin) | (rest < cost.limits[0] + cost.margin)
        return np.asarray((cost.weight != 0.0) & beyond)
    rest = task.q0 if isinstance(cost, costs.TrackingCost) else still
    if cost.of_controls:
        rest = scene.command_at(task.q0)
    wanted: Any = cost.before if isinstance(cost, costs.ControlRateCost) else cost.reference
    wanted = rest if wanted is None else wanted.at(task.times) if isinstance(wanted, Timeline) else wanted
    moves = ((np.atleast_2d(wanted) != rest) & (cost.weight != 0.0)).any(axis=0)
    return np.asarray((scene.actuation != 0.0)[:, moves].any(axis=1) if cost.of_controls else moves)


def task_of(root: Where, tables: dict[str, Any]) -> Task:
    """Load the robot of a file and apply the file to it."""
    root.table(tables, TABLES, ("robot", "horizon"))
    at = root.at("horizon")
    keys = ("dt", "steps", "duration", "hold", "sampling", "controls", "between_nodes")
    horizon = at.table(tables["horizon"], keys)
    costs = len(root.tables(tables, "cost"))
    with at.named(horizon):
        dt, steps = time_steps(horizon.get("dt"), horizon.get("steps"), horizon.get("duration"))
        count("steps", steps, 1)
    if steps * max(1, _PER_COST * costs) > _MOST_STEPS:
        raise at.error(f"{steps} steps are more than {_MOST_STEPS}, or a tenth of that divided by the number of costs")
    return _on_robot(root, tables, _robot(root, tables), dt, steps)


def _robot(root: Where, tables: Mapping[str, Any]) -> Robot:
    """The robot of a file, or several in one."""
    where = root.at("robot")
    if not isinstance(tables["robot"], list):
        return _one(where, tables["robot"])
    members = [(place, dict(place.table(own))) for place, own in root.tables(tables, "robot")]
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
    own["payload"] = [place.call(Payload, load) for place, load in where.tables(own, "payload")]
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
    transform[:3, :3] = _turned(angles)
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
    forces = _forces(root, tables, robot, driven, limit)
    own = root.entries(tables, "constraint", kinds.CONSTRAINTS)
    constraints = [_made(where, kind, keys) for where, _, kind, keys in own]
    given = {
        "gravity": tables.get("gravity", True),
        "damping": tables.get("damping"),
        "friction": tables.get("friction"),
        "stiffness": springs.get("stiffness", 0.0),
        "rest": root.at("springs", "rest").positions(springs.get("rest", 0.0), robot),
        "forces": [force for force, *_ in forces],
        "actuation": matrix,
        "noise": _noise(root, tables, robot, driven) or None,
        "constraints": [constraint for constraint, *_ in constraints] or None,
    }
    try:
        scene = Scene(robot, **given)
    except VarpinError as error:
        for made, where, keys in (*forces, *constraints):
            with where.named(keys):
                description_constraints(robot) if made == "robot" else made.bind(robot)
        words = {"stiffness": "springs.stiffness", "Noise": "noise", "control": "actuation", "Servo": "force"}
        key = next((key for word, key in words.items() if word in str(error)), root.of(error, given).key)
        raise SceneFileError(root.path.name, key, str(error)) from None
    v0 = root.at("initial", "v").numbers(initial.get("v", 0.0), names)
    every = np.arange(robot.dof), np.arange(len(driven))
    return Task(root, tables, robot, driven, scene, *every, q0, v0, dt, steps, gear, limit).complete()


def _controls(task: Task) -> Timeline | str | None:
    """The controls of a simulation, within the torque limits."""
    where = task.where.at("simulate")
    given = where.table(task.tables.get("simulate", {}), ("controls", "seed")).get("controls")
    if given is None or given == "hold":
        return given
    where = where.at("controls")
    found = timeline(given, task.reader(where, task.motors, "driven joint"), task.columns)
    force = np.abs(found.at(task.times) * task.gear).max(axis=0)
    over = (force > task.torque_limit * (1.0 + _ROUNDING)) & ~task.positions
    if over.any():
        k = int(np.argmax(over))
        limit = task.torque_limit[k]
        raise where.error(f"of {task.driven[k]!r} reach {force[k]:g} N m or N; torque_limit is {limit:g}")
    return found


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


def _made(where: Where, kind: Any, own: dict[str, Any]) -> tuple[Any, Where, dict[str, Any]]:
    """A force or a constraint of the keys of a table, its place, and these keys."""
    points = {
        name: (value["frame"], value["place"])
        for name, value in own.items()
        if isinstance(value, dict) and value.keys() == {"frame", "place"}
    }
    return where.call(kind, own | points), where, own | points


def _forces(
    root: Where, tables: Mapping[str, Any], robot: Robot, driven: Sequence[str], limit: Floats
) -> list[tuple[Any, Where, dict[str, Any]]]:
    """The forces of a file, as :func:`_made`. Torque limits of driven joints bound the effort of servos."""
    most = np.full(robot.dof, np.inf)
    most[[robot.coordinate(joint) for joint in driven]] = limit
    found = []
    for place, word, kind, own in root.entries(tables, "force", kinds.FORCES):
        if word == "friction" and own.get("level") == "robot":
            own["level"] = robot.friction
        force, *where = _made(place, kind, own)
        if isinstance(force, PositionServo):
            with place.named(own):
                effort = joint_array("effort", force.effort, robot.joint_names, uniform=True, absent=np.inf)
            force = replace(force, effort=np.minimum(effort, most))
        found.append((force, *where))
    return found


def _noise(root: Where, tables: Mapping[str, Any], robot: Robot, driven: Sequence[str]) -> list[Noise]:
    """The noise models of a file."""
    found: list[Noise] = []
    for place, word, kind, own in root.entries(tables, "noise", kinds.NOISE):
        whose, what = (driven, "driven joint") if word == "control" else (robot.joint_names, "joint")
        if "intensity" in own:
            own["intensity"] = place.at("intensity").numbers(own["intensity"], whose, what)
        if "center" in own:
            own["center"] = place.at("center").positions(own["center"], robot)
        found.append(place.call(kind, own))
    return found


def _cost(task: Task, where: Where, kind: str, make: type[Cost], own: dict[str, Any]) -> Cost | None:
    """A term of the cost; None if it weighs nothing of the task's joints."""
    scene, robot, keys = task.scene, task.robot, kinds.cost_keys(kind)
    where.table(own, keys, [key for key, needed in keys.items() if needed])
    names, what = kinds.AXES.get(kind, ("weight",)), "component"
    keep: Any = slice(None)
    if kind in kinds.OF_CONTROLS:
        names, keep, what = task.motors, task.columns, "joint"
    elif kind in kinds.OF_JOINTS:
        names, keep, what = robot.joint_names, task.joints, "joint"
    weight = where.at("weight").numbers(own.pop("weight", 1.0), names, what)[keep]
    terminal = where.at("terminal").check(flag, own.pop("terminal", False))
    if kind.endswith("_limits"):
        limits = scene.robot.position_limits if kind == "joint_limits" else scene.robot.velocity_limit
        if not np.isfinite(limits).any():
            if len(task.joints) < robot.dof:
                return None
            raise where.at("type").error(f"robot {robot.name!r} has no such limits")
        if "margin" in own:
            own["margin"] = where.at("margin").numbers(own["margin"], names)[keep]
    own |= _target(task, where, kind, own, names, what, keep)
    if not weight.any():
        return None
    own["weight"] = float(weight[0]) if kind == "manipulability" else weight
    others = {"robot": scene.robot} if "robot" in inspect.signature(make).parameters else {}
    with where.named(own):
        cost = make(**own, **others)
    return costs.Terminal(cost) if terminal else cost


def _target(
    task: Task, where: Where, kind: str, own: dict[str, Any], names: Sequence[str], what: str, keep: Any
) -> dict[str, Any]:
    """The target of a term by its key, from the keys of its table, which lose it; of the components to ``keep``."""
    key = kinds.target_key(kind)
    hold, given, at = own.pop("hold", None), own.pop(key, None), where.at(key)
    if hold is not None and given is not None:
        raise where.error(f"hold and {key} exclude each other: give one of them")
    if hold is not None:
        q = task.q0 if hold is True else where.at("hold").positions(hold, task.robot)[task.joints]
        return {key: closest_controls(task.scene, q)}
    if kind == "control_rate":
        return {key: None if given is None else at.numbers(given, names, what)[keep]}
    if not key:
        return {}
    turned = kind == "frame_orientation"
    reader = task.reader(at, kinds.ANGLES if turned else names, what)
    target = timeline(0.0 if given is None else given, reader, keep)
    value: Any = partial(_turned_at, target) if turned else target
    return {key: value(0.0) if target.constant else value}
