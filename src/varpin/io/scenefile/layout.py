"""A scene file applied to its robot: lists and tables become one number for each joint or control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.control.costs import Cost, CostSum, Terminal
from varpin.errors import InputError, RobotError, RobotNotFound, UnknownFrame, UnknownJoint, VarpinError
from varpin.io.scenefile.references import Timeline, constant
from varpin.io.scenefile.spec import CostSpec, ForceSpec
from varpin.io.scenefile.table import SceneFileError, Table, suggestion
from varpin.io.scenefile.terms import Given
from varpin.mechanics.constraints import Constraint, KinematicInput
from varpin.mechanics.description import description_constraints
from varpin.mechanics.forces import CoulombFriction, Force, PositionServo
from varpin.mechanics.noise import AdditiveNoise, ControlNoise, Noise, StateNoise
from varpin.mechanics.scene import Scene, closest_controls, given_constraints, resistance
from varpin.model import Robot, combine, load_robot, looks_like_degrees
from varpin.model.tree import frame_index

if TYPE_CHECKING:
    from varpin.io.scenefile.tables import RobotKeys

if TYPE_CHECKING:
    from varpin.io.scenefile.tables import SceneSpec

_OnFrames = TypeVar("_OnFrames", bound=Force | Constraint)

# Largest number of times at which controls and references are sampled for checks.
_SAMPLES = 2000


@dataclass(frozen=True, eq=False)
class Noises:
    """Intensities of a noise model, by joint (n,), or by control (m,) for control noise."""

    kind: str
    intensity: Floats
    center: Floats | None


@dataclass(frozen=True, eq=False)
class JointForces:
    """A force on joints with its attributes (n,)."""

    kind: type[Force]
    values: Mapping[str, Floats]

    def force(self) -> Force:
        """The force as an object."""
        return self.kind(**self.values)


@dataclass(frozen=True, eq=False)
class CostTerm:
    """A term of the cost with the weights (c,) and the target of its components."""

    spec: CostSpec
    weight: Floats
    target: Timeline | None
    holding_q: Floats | None


@dataclass(frozen=True, eq=False)
class Layout:
    """A scene on a robot, complete or without some of its joints.

    Attributes:
        spec: The file.
        robot: The robot.
        damping: Viscous damping (n,) [N m s/rad or N s/m].
        stiffness: Stiffness of the joint springs (n,) [N m/rad or N/m].
        rest: Rest positions of the joint springs (n,) [rad or m].
        forces: Other forces on joints.
        frame_forces: Forces on frames.
        constraints: Constraints of the motion; with any, no joint is left out.
        q0: Initial configuration (n,) [rad or m].
        v0: Initial velocity (n,) [rad/s or m/s].
        actuated: Indices of the driven joints (m,).
        gear: Generalized force per control (m,).
        torque_limit: Bounds (m,) [N m or N], infinite where there is none.
        noise: Noise models.
        costs: Terms of the cost.
        controls: Controls of a simulation over time; None for none, ``"hold"`` for those that hold the robot at q0.
        held: Joints that are left out, and their positions [rad or m].
    """

    spec: SceneSpec
    robot: Robot
    damping: Floats
    stiffness: Floats
    rest: Floats
    forces: tuple[JointForces, ...]
    frame_forces: tuple[Force, ...]
    constraints: tuple[Constraint, ...]
    q0: Floats
    v0: Floats
    actuated: NDArray[np.int64]
    gear: Floats
    torque_limit: Floats
    noise: tuple[Noises, ...]
    costs: tuple[CostTerm, ...]
    controls: Timeline | str | None
    held: Mapping[str, float]

    def without(self, joints: Sequence[str]) -> Layout:
        """The same scene with ``joints`` locked at their initial positions, and without what acts on them alone.

        Terms and forces on a frame stay if the frame still moves; those on the whole robot stay.
        """
        if not joints:
            return self
        names = self.robot.joint_names
        held = {**self.held, **{name: float(self.q0[names.index(name)]) for name in joints}}
        robot = _load(self.spec, held, self.robot)
        keep = np.array([names.index(name) for name in robot.joint_names], dtype=np.int64)
        driven = np.flatnonzero(np.isin(self.actuated, keep))
        position = {int(joint): index for index, joint in enumerate(keep)}
        costs = []
        for term in self.costs:
            space = term.spec.term.space
            if space == "frame" and not joints_of_frame(robot, term.spec.frame).any():
                continue
            index = driven if space == "u" else keep
            costs.append(_part(term, index) if term.spec.term.of_joints else term)
        noise = []
        for model in self.noise:
            index = driven if model.kind == "control" else keep
            center = None if model.center is None else model.center[keep]
            noise.append(Noises(model.kind, model.intensity[index], center))
        return Layout(
            spec=self.spec,
            robot=robot,
            damping=self.damping[keep],
            stiffness=self.stiffness[keep],
            rest=self.rest[keep],
            forces=tuple(
                JointForces(force.kind, {name: values[keep] for name, values in force.values.items()})
                for force in self.forces
            ),
            frame_forces=tuple(force for force in self.frame_forces if _has_moving_end(force, robot)),
            constraints=self.constraints,
            q0=self.q0[keep],
            v0=self.v0[keep],
            actuated=np.array([position[int(joint)] for joint in self.actuated[driven]], dtype=np.int64),
            gear=self.gear[driven],
            torque_limit=self.torque_limit[driven],
            noise=tuple(noise),
            costs=tuple(costs),
            controls=self.controls.columns(driven.tolist()) if isinstance(self.controls, Timeline) else self.controls,
            held=held,
        )

    @property
    def served(self) -> NDArray[np.bool_]:
        """Whether each joint (n,) has a servo, so that its control is a position."""
        servos = [force.values["stiffness"] > 0.0 for force in self.forces if force.kind is PositionServo]
        return np.asarray(np.any([np.zeros(self.robot.dof, dtype=np.bool_), *servos], axis=0))

    @property
    def moved(self) -> NDArray[np.bool_]:
        """Whether each joint (n,) is a kinematic input, so that its control is its position."""
        names = [each.joint for each in self.constraints if isinstance(each, KinematicInput)]
        return np.isin(self.robot.joint_names, names)

    @property
    def control_limit(self) -> Floats:
        """Bounds of the controls (m,), infinite where there is none.

        Controls that are positions have none: a torque limit then bounds the effort of the servo.
        """
        positions = (self.served | self.moved)[self.actuated]
        return np.where(positions, np.inf, self.torque_limit / np.abs(self.gear))

    def _force(self, force: JointForces) -> Force:
        """A force as an object. A torque limit bounds the effort of a servo."""
        if force.kind is not PositionServo:
            return force.force()
        limit = np.full(self.robot.dof, np.inf)
        limit[self.actuated] = self.torque_limit
        effort = force.values.get("effort", np.full(self.robot.dof, np.inf))
        return JointForces(force.kind, {**force.values, "effort": np.minimum(effort, limit)}).force()

    @property
    def actuation(self) -> Floats:
        """Matrix (n, m) from controls to generalized forces."""
        matrix = np.zeros((self.robot.dof, len(self.actuated)))
        matrix[self.actuated, np.arange(len(self.actuated))] = self.gear
        return matrix

    @property
    def driven(self) -> tuple[str, ...]:
        """Names of the driven joints."""
        return tuple(self.robot.joint_names[joint] for joint in self.actuated)

    def scene(self) -> Scene:
        """The scene as an object."""
        return Scene(
            self.robot,
            gravity=self.spec.gravity,
            damping=self.damping,
            stiffness=self.stiffness,
            rest=self.rest,
            forces=[*(self._force(force) for force in self.forces), *self.frame_forces],
            constraints=self.constraints,
            actuation=self.actuation,
            noise=[model for model in map(self._noise, self.noise) if model is not None] or None,
        )

    def _noise(self, model: Noises) -> Noise | None:
        """A noise model as an object, with its nonzero processes alone; None if there are none."""
        act = np.flatnonzero(model.intensity)
        if not len(act):
            return None
        n, m = self.robot.dof, len(self.actuated)
        if model.kind == "state":
            return StateNoise(model.intensity, model.center)
        if model.kind == "additive":
            fields = np.zeros((n, len(act)))
            fields[act, np.arange(len(act))] = model.intensity[act]
            return AdditiveNoise(fields)
        by_control = np.zeros((n, len(act), m))
        by_control[:, np.arange(len(act)), act] = (self.actuation * model.intensity)[:, act]
        return ControlNoise(by_control)

    def cost(self, scene: Scene) -> Cost:
        """The cost as an object."""
        terms = []
        for term in self.costs:
            spec, target = term.spec, term.target
            if term.holding_q is not None:
                target = constant(holding_controls(scene, term.holding_q))
            if not term.weight.any() or (spec.term.limits and not np.isfinite(spec.term.limits(self.robot)).any()):
                continue
            given = Given(self.robot, term.weight, target, spec.frame, spec.numbers, spec.words)
            try:
                made = spec.term.make(given)
            except VarpinError as error:
                raise spec.table.error("", str(error)) from None
            terms.append(Terminal(made) if spec.terminal else made)
        return CostSum(tuple(terms))


def _part(term: CostTerm, index: NDArray[np.int64]) -> CostTerm:
    target = None if term.target is None else term.target.columns(index.tolist())
    return CostTerm(term.spec, term.weight[index], target, None if term.holding_q is None else term.holding_q[index])


def holding_controls(scene: Scene, q: Floats) -> Floats:
    """The controls (m,) that come closest to holding the robot at q at rest."""
    return closest_controls(scene, q)


def joints_of_frame(robot: Robot, frame: str) -> NDArray[np.bool_]:
    """Whether each coordinate (n,) moves a frame; all False if there is no such frame."""
    model, moving = robot.free_model, np.zeros(robot.dof, dtype=np.bool_)
    if model.existFrame(frame):
        for joint in model.supports[model.frames[frame_index(model, frame, robot.name)].parentJoint]:
            if joint > 0:
                moving[robot.tree.coordinate[joint - 1]] = True
    return moving


def _load(spec: SceneSpec, held: Mapping[str, float], whole: Robot | None = None) -> Robot:
    """The robot of a file, with the joints of ``whole`` that are ``held`` locked as well."""
    if spec.prefixes is None:
        return _one(spec.robots[0], spec.root.table("robot"), held)
    own: list[dict[str, float]] = [{} for _ in spec.robots]
    for part, locks in zip(() if whole is None else whole.parts, own, strict=whole is not None):
        names = {part.prefix + name: name for name in (*part.robot.joint_names, *part.robot.locked)}
        locks.update({names[name]: at for name, at in held.items() if name in names})
    tables = [spec.root.table(f"robot[{k}]") for k in range(len(own))]
    robots = [_one(given, table, locks) for given, table, locks in zip(spec.robots, tables, own, strict=True)]
    try:
        return combine(*robots, prefixes=spec.prefixes)
    except InputError as error:
        raise tables[-1].error("prefix", str(error)) from None


def _one(given: RobotKeys, table: Table, held: Mapping[str, float]) -> Robot:
    for joint, value in given.lock.items():
        if isinstance(value, float) and looks_like_degrees(value):
            raise table.error(f"lock.{joint}", f"{value:g} looks like degrees: positions are in rad or m")
    try:
        return load_robot(
            given.source,
            package_dirs=given.package_dirs,
            lock={**given.lock, **held},
            keep=None if given.keep is None else [name for name in given.keep if name not in held],
            mimic="free" if given.mimic == "free" else "tied",
            payload=given.payload,
            xacro_args=given.xacro_args or None,
            srdf=given.srdf,
            base=given.base,
            armature=given.armature,
            inertia=given.inertia,
            density=given.density,
        )
    except RobotNotFound as error:
        raise table.error("source", str(error)) from None
    except UnknownJoint as error:
        where = {"armature": given.armature if isinstance(given.armature, Mapping) else (), "keep": given.keep or ()}
        key = next((key for key, names in where.items() if error.joint in names), "lock")
        raise table.error(
            f"{key}.{error.joint}", f"there is no such joint; {suggestion(error.joint, error.joints, 'joints')}"
        ) from None
    except UnknownFrame as error:
        index = [load.frame for load in given.payload].index(error.frame)
        raise table.error(
            f"payload[{index}].frame",
            f"there is no frame {error.frame!r}; {suggestion(error.frame, error.frames, 'frames')}",
        ) from None
    except (RobotError, InputError) as error:
        raise table.error("", str(error)) from None


def lay_out(spec: SceneSpec) -> Layout:
    """Load the robot and apply the scene to it.

    Raises:
        SceneFileError: Names, lengths or values do not fit the robot.
    """
    robot = _load(spec, {})
    try:
        return _on_robot(spec, robot)
    except SceneFileError as error:
        name = error.key.rpartition(".")[2]
        if name not in robot.locked:
            raise
        raise SceneFileError(error.source, error.key, f"the joint is locked at {robot.locked[name]}") from None


def _on_robot(spec: SceneSpec, robot: Robot) -> Layout:
    names, root = robot.joint_names, spec.root
    springs, initial, actuation = root.table("springs"), root.table("initial"), root.table("actuation")
    rest = springs.positions("rest", spec.rest, robot)
    q0 = initial.positions("q", spec.q0, robot)
    for table, name, values in ((springs, "rest", rest), (initial, "q", q0)):
        _refuse_degrees(table, name, values, robot)
    if spec.actuated is not None:
        for index, joint in enumerate(spec.actuated):
            if joint not in names:
                raise actuation.error(
                    f"joints[{index}]", f"there is no joint {joint!r}; {suggestion(joint, names, 'joints')}"
                )
    driven = names if spec.actuated is None else spec.actuated
    gear = actuation.spread("gear", spec.gear, driven, "driven joint")
    if not gear.all():
        raise actuation.error("gear", f"must not be 0, and is for {driven[int(np.argmin(np.abs(gear)))]!r}")
    actuated = np.array([names.index(joint) for joint in driven], dtype=np.int64)
    forces = tuple(_force(force, robot) for force in spec.forces)
    _require_own_controls(spec, forces, names, actuated, gear)
    given = {
        name: value if value is None or isinstance(value, str) else root.spread(name, value, names)
        for name, value in (("damping", spec.damping), ("friction", spec.friction))
    }
    damping, friction = resistance(robot, given["damping"], given["friction"], [force.force() for force in forces])
    if friction.any():
        forces = (JointForces(CoulombFriction, {"level": friction}), *forces)
    limit = _torque_limit(spec, robot, actuated, driven)
    controls = spec.controls
    timeline: Timeline | str | None
    if controls is None or isinstance(controls, str):
        timeline = controls
    else:
        timeline = controls.timeline(driven, spec.duration, "driven joint", robot)
    layout = Layout(
        spec=spec,
        robot=robot,
        damping=damping,
        stiffness=springs.spread("stiffness", spec.stiffness, names),
        rest=rest,
        forces=forces,
        frame_forces=tuple(_on_frames(read.force, read.table, robot) for read in spec.frame_forces),
        constraints=_constraints(spec, robot),
        q0=q0,
        v0=initial.spread("v", spec.v0, names),
        actuated=actuated,
        gear=gear,
        torque_limit=limit,
        noise=tuple(_noises(spec, robot, driven)),
        costs=tuple(_term(term, robot, driven, q0, spec.duration) for term in spec.costs),
        controls=timeline,
        held={},
    )
    _require_controls(layout)
    return layout


def _require_own_controls(
    spec: SceneSpec,
    forces: Sequence[JointForces],
    names: Sequence[str],
    actuated: NDArray[np.int64],
    gear: Floats,
) -> None:
    """Refuse servos on joints without a control of their own with gear 1, and two servos on one joint."""
    seen: set[int] = set()
    for force, laid in zip(spec.forces, forces, strict=True):
        if laid.kind is not PositionServo:
            continue
        for joint in np.flatnonzero(laid.values["stiffness"]).tolist():
            name = names[joint]
            if joint in seen:
                raise force.table.error("stiffness", f"joint {name!r} has a servo already")
            seen.add(joint)
            if joint not in actuated:
                raise force.table.error("stiffness", f"joint {name!r} is not driven: [actuation] joints leaves it out")
            if gear[actuated == joint] != 1.0:
                raise spec.root.table("actuation").error(
                    "gear", f"must be 1 for {name!r}, whose control is the position of its servo"
                )


def _require_controls(layout: Layout) -> None:
    """Refuse control noise on servo positions, positions in degrees, and controls of a simulation beyond limits."""
    spec, served, moved = layout.spec, layout.served[layout.actuated], layout.moved[layout.actuated]
    for index, model in enumerate(layout.noise):
        if model.kind == "control" and (served & (model.intensity != 0.0)).any():
            joint = layout.driven[int(np.argmax(served & (model.intensity != 0.0)))]
            raise spec.root.error(
                f"noise[{index}].intensity",
                f"is proportional to forces, but the control of {joint!r} is the position of its servo",
            )
    if not isinstance(layout.controls, Timeline):
        return
    table = spec.root.table("simulate")
    given = layout.controls.at(times_of(spec))
    for joint, column in zip(layout.actuated[served | moved].tolist(), given.T[served | moved], strict=True):
        worst = float(column[np.argmax(np.abs(column))])
        if not layout.robot.slides[joint] and looks_like_degrees(worst):
            name = layout.robot.joint_names[joint]
            raise table.error("controls", f"{worst:g} of {name!r} looks like degrees: positions are in rad")
    force, limit = np.abs(given * layout.gear), np.where(served | moved, np.inf, layout.torque_limit)
    if (force > limit * (1.0 + 1e-9)).any():
        worst_joint = int(np.argmax((force - limit).max(axis=0)))
        raise table.error(
            "controls",
            f"of {layout.driven[worst_joint]!r} reach {force[:, worst_joint].max():g} N m or N; torque_limit is "
            f"{limit[worst_joint]:g}",
        )


def times_of(spec: SceneSpec) -> Floats:
    """Times over the horizon [s] at which controls and references are sampled for checks."""
    return np.linspace(0.0, spec.duration, min(spec.steps, _SAMPLES) + 1)


def _refuse_degrees(table: Table, name: str, values: Floats, robot: Robot) -> None:
    for joint, value, slide in zip(robot.joint_names, values.tolist(), robot.slides.tolist(), strict=True):
        if not slide and looks_like_degrees(value):
            raise table.error(name, f"{value:g} of {joint!r} looks like degrees: angles are in rad")


def _torque_limit(spec: SceneSpec, robot: Robot, actuated: NDArray[np.int64], driven: Sequence[str]) -> Floats:
    table = spec.root.table("actuation")
    if spec.torque_limit is None:
        return np.full(len(driven), np.inf)
    if isinstance(spec.torque_limit, str):
        limit = robot.effort_limit[actuated]
        if not np.isfinite(limit).all():
            joint = driven[int(np.argmax(~np.isfinite(limit)))]
            raise table.error("torque_limit", f"the robot description gives {joint!r} none: write numbers [N m or N]")
        return limit
    limit = table.spread("torque_limit", spec.torque_limit, driven, "driven joint")
    if not (limit > 0.0).all():
        joint = driven[int(np.argmax(~(limit > 0.0)))]
        raise table.error(
            "torque_limit", f"must be > 0 [N m or N], and is {limit[driven.index(joint)]:g} for {joint!r}"
        )
    return limit


def _force(spec: ForceSpec, robot: Robot) -> JointForces:
    absent = {"lower": -np.inf, "upper": np.inf, "effort": np.inf}
    values = {
        name: robot.friction
        if isinstance(value, str)
        else spec.table.spread(name, value, robot.joint_names, absent=absent.get(name, 0.0))
        for name, value in spec.values.items()
    }
    found = JointForces(spec.kind, values)
    try:
        found.force().bind(robot)
    except InputError as error:
        raise spec.table.error("", str(error)) from None
    return found


def _constraints(spec: SceneSpec, robot: Robot) -> tuple[Constraint, ...]:
    """The constraints of a file, after a check that they fit the robot."""
    given: list[Constraint | Literal["robot"]] = []
    for read in spec.constraints:
        if read.constraint is not None:
            given.append(_on_frames(read.constraint, read.table, robot))
            continue
        try:
            description_constraints(robot)
        except InputError as error:
            raise read.table.error("", str(error)) from None
        given.append("robot")
    return given_constraints(robot, given or None)


def _on_frames(part: _OnFrames, table: Table, robot: Robot) -> _OnFrames:
    """``part`` itself, after a check that it fits the robot."""
    try:
        part.bind(robot)
    except UnknownFrame as error:
        raise table.error(
            "", f"there is no frame {error.frame!r}; {suggestion(error.frame, error.frames, 'frames')}"
        ) from None
    except (InputError, UnknownJoint) as error:
        raise table.error("", str(error)) from None
    return part


def _has_moving_end(force: Force, robot: Robot) -> bool:
    """Whether a remaining joint moves a frame on which a force acts."""
    points = [getattr(force, name) for name in ("frame", "a", "b") if hasattr(force, name)]
    frames = [point if isinstance(point, str) else point[0] for point in points if isinstance(point, str | tuple)]
    return any(joints_of_frame(robot, frame).any() for frame in frames)


def _noises(spec: SceneSpec, robot: Robot, driven: Sequence[str]) -> list[Noises]:
    found = []
    for index, model in enumerate(spec.noise):
        table = spec.root.table(f"noise[{index}]")
        whose, what = (driven, "driven joint") if model.type == "control" else (robot.joint_names, "joint")
        center = None if model.center is None else table.positions("center", model.center, robot)
        found.append(Noises(model.type, table.spread("intensity", model.intensity, whose, what), center))
    return found


def _term(spec: CostSpec, robot: Robot, driven: Sequence[str], q0: Floats, duration: float) -> CostTerm:
    table, term = spec.table, spec.term
    if term.frame and not robot.free_model.existFrame(spec.frame):
        names = [frame.name for frame in robot.free_model.frames]
        raise table.error("frame", f"there is no frame {spec.frame!r}; {suggestion(spec.frame, names, 'frames')}")
    if term.limits and not np.isfinite(term.limits(robot)).any():
        raise table.error("type", f"robot {robot.name!r} has no such limits")
    joints, what = (tuple(driven), "driven joint") if term.space == "u" else (robot.joint_names, "joint")
    axes, kind = (joints, what) if term.of_joints else (term.axes, "axis")
    weight = table.spread("weight", spec.weight, axes, kind)
    target = None
    if spec.reference is not None:
        components, kind = (joints, what) if term.of_joints else (term.components, "component")
        target = spec.reference.timeline(components, duration, kind, robot)
        if term.space == "q" and target.constant and term.reference is not None:
            _refuse_degrees(table, term.reference, target(0.0), robot)
    holding_q = None
    if spec.holding_q is not None:
        holding_q = table.positions("hold", spec.holding_q, robot) if spec.holding_q != () else q0
    return CostTerm(spec, weight, target, holding_q)
