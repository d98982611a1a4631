"""The tables of a scene file: their keys, the rules of their values, and their content as a :class:`SceneSpec`."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, create_model, model_validator
from scipy.spatial.transform import Rotation

from varpin.control.problem import default_integrator
from varpin.errors import InputError
from varpin.integrators import BY_NAME, Integrator, options_of
from varpin.io.scenefile.keys import (
    FLAG,
    TEXT,
    Keys,
    Rule,
    beside,
    checked,
    either,
    existing,
    existing_file,
    mistake,
    number,
    numbers,
    read_keys,
    toml_type,
    typed,
    values,
    whole,
    word,
)
from varpin.io.scenefile.plan_constraints import PLAN_CONSTRAINTS, Kind
from varpin.io.scenefile.references import ReferenceSignal, Sine
from varpin.io.scenefile.spec import (
    CONSTRAINTS,
    FIGURES,
    FORCES,
    FRAME_FORCES,
    MOST_EVALUATIONS,
    MOST_STEPS,
    ConstraintSpec,
    CostSpec,
    ForceSpec,
    FrameForceSpec,
    PlanConstraintSpec,
    word_of,
)
from varpin.io.scenefile.table import ByName, Table, inside
from varpin.io.scenefile.terms import TERMS, Term
from varpin.mechanics.constraints import FrameOnFrame
from varpin.mechanics.forces import CoulombFriction
from varpin.model import Payload

_THREE = tuple[float, float, float]
# The value of the robot's description.
_ROBOT = Annotated[str, word("robot")]


def _distinct(rule: Rule) -> Rule:
    """A list without repetitions."""

    def once(entries: tuple[str, ...]) -> tuple[str, ...]:
        for index, entry in enumerate(entries):
            if entry in entries[:index]:
                raise mistake(index, f"{entry!r} is a duplicate")
        return entries

    return checked(tuple[Annotated[str, rule], ...], once)


def _folder(text: str, info: ValidationInfo) -> str:
    return str(beside(text, info))


def _robot_source(text: str, info: ValidationInfo) -> str | Path:
    """The name of a robot, or the path of an existing file."""
    named = not Path(text).suffix and "/" not in text and "\\" not in text
    return text if named else existing(beside(text, info))


# The position of a locked joint. A joint with several axes, or a continuous one, has several numbers.
_LOCK = either(
    "a number [rad or m], or the configuration of a joint with several axes",
    number=Annotated[float, number("rad or m")],
    list=Annotated[tuple[float, ...], numbers()],
)
# The value of an argument of a xacro file.
_ARGUMENT = either("a text, a number, true or false", text=str, number=int | float, flag=bool)
# A posture of the robot's SRDF file by name.
_POSTURE = Annotated[str, TEXT]


class PayloadKeys(Keys):
    """[[robot.payload]]."""

    frame: Annotated[str, TEXT]
    mass: Annotated[float, number("kg", above=0.0)]
    com: Annotated[_THREE, numbers(3, "m")] = (0.0, 0.0, 0.0)
    inertia: Annotated[tuple[float, ...], numbers(unit="kg m^2")] = (0.0, 0.0, 0.0)

    def payload(self) -> Payload:
        """The payload as an object."""
        inertia: Any = self.inertia
        if len(inertia) == 6:
            xx, xy, xz, yy, yz, zz = inertia
            inertia = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        elif len(inertia) != 3:
            entries = "3 principal moments or 6 entries ixx, ixy, ixz, iyy, iyz, izz"
            raise mistake("inertia", f"must be {entries}; got {len(inertia)}")
        try:
            return Payload(self.frame, self.mass, self.com, inertia)
        except InputError as error:
            raise mistake("inertia", str(error).removeprefix("payload inertia ")) from None


class BaseKeys(Keys):
    """Placement of the base of a robot."""

    xyz: Annotated[_THREE, numbers(3, "m")] = (0.0, 0.0, 0.0)
    rpy: Annotated[_THREE, numbers(3, "rad")] = (0.0, 0.0, 0.0)

    def transform(self) -> Any:
        """The placement as a matrix (4, 4)."""
        transform = np.eye(4)
        transform[:3, :3] = Rotation.from_euler("xyz", self.rpy).as_matrix()
        transform[:3, 3] = self.xyz
        return transform


def _base_of(base: Any) -> Any:
    return base.transform() if isinstance(base, BaseKeys) else base


class RobotKeys(Keys):
    """[robot]."""

    source: Annotated[str | Path, checked(TEXT, _robot_source)]
    lock: dict[str, Annotated[Any, _LOCK]] = Field(default_factory=dict)
    keep: Annotated[tuple[str, ...] | None, _distinct(TEXT)] = None
    mimic: Annotated[str, word("tied", "free")] = "tied"
    package_dirs: Annotated[tuple[str, ...], _distinct(checked(TEXT, _folder))] = ()
    xacro_args: dict[str, Annotated[Any, _ARGUMENT]] = Field(default_factory=dict)
    srdf: Annotated[Path | None, checked(TEXT, existing_file)] = None
    payload: tuple[Annotated[Payload, checked(PayloadKeys, PayloadKeys.payload)], ...] = ()
    base: Annotated[
        Any,
        checked(either('"planar", or { xyz, rpy }', text=Annotated[str, word("planar")], table=BaseKeys), _base_of),
    ] = None
    armature: Annotated[ByName | None, values("kg m^2 or kg", least=0.0)] = None
    inertia: Annotated[Literal["file", "meshes"], word("file", "meshes")] = "file"
    density: Annotated[float, number("kg/m^3", above=0.0)] = 1000.0


class MemberKeys(RobotKeys):
    """[[robot]]."""

    prefix: Annotated[str, TEXT] = ""


def _several(robots: RobotKeys | tuple[MemberKeys, ...]) -> tuple[RobotKeys, ...]:
    if isinstance(robots, RobotKeys):
        return (robots,)
    if len(robots) < 2:
        raise ValueError(f"[[robot]] is for two robots or more, got {len(robots)}; one is written [robot]")
    return robots


class SpringKeys(Keys):
    """[springs]."""

    stiffness: Annotated[ByName, values("N m/rad or N/m", least=0.0)] = 0.0
    rest: Annotated[ByName | str, values("rad or m", text=_POSTURE)] = 0.0


class ActuationKeys(Keys):
    """[actuation]."""

    joints: Annotated[tuple[str, ...] | None, _distinct(TEXT)] = None
    gear: Annotated[ByName, values()] = 1.0
    torque_limit: Annotated[ByName | str | None, values("N m or N", least=0.0, text=_ROBOT)] = None

    @model_validator(mode="after")
    def _require_joints(self) -> ActuationKeys:
        if self.joints == ():
            raise mistake("joints", "must name at least one joint; leave it out to drive all of them")
        return self


class NoiseKeys(Keys):
    """[[noise]]."""

    type: Annotated[str, word("additive", "control", "state")]
    intensity: Annotated[ByName, values(least=0.0)]
    center: Annotated[ByName | str | None, values("rad or m", text=_POSTURE)] = None

    @model_validator(mode="after")
    def _require_no_center(self) -> NoiseKeys:
        if self.type != "state" and self.center is not None:
            raise mistake("center", f"belongs to state noise alone, and this is {self.type} noise")
        return self


class InitialKeys(Keys):
    """[initial]."""

    q: Annotated[ByName | str, values("rad or m", text=_POSTURE)] = 0.0
    v: Annotated[ByName, values("rad/s or m/s")] = 0.0


class HorizonKeys(Keys):
    """[horizon]."""

    dt: Annotated[float, number("s", above=0.0)]
    steps: Annotated[int | None, whole(1, MOST_STEPS)] = None
    duration: Annotated[float | None, number("s", above=0.0)] = None
    hold: Annotated[int, whole(1)] = 1
    sampling: Annotated[str, word("gauss", "midpoint", "start")] = "gauss"
    controls: Annotated[str, word("held", "linear")] = "held"
    between_nodes: Annotated[bool, FLAG] = False

    @property
    def count(self) -> int:
        """Number of steps."""
        return self.steps or round(min((self.duration or 0.0) / self.dt, 2.0 * MOST_STEPS))

    @model_validator(mode="after")
    def _require_whole_steps(self) -> HorizonKeys:
        duration, steps = self.duration, self.count
        if (duration is None) == (self.steps is None):
            wrong = "one of steps, duration is missing" if duration is None else "steps and duration exclude each other"
            raise ValueError(wrong)
        if duration is not None and (steps < 1 or abs(min(steps, MOST_STEPS) * self.dt - duration) > 1e-9 * duration):
            if steps > MOST_STEPS:
                wrong = f"{duration:g} s is more than {MOST_STEPS} steps of dt = {self.dt:g} s, the most there may be"
            else:
                fits = duration / max(steps, 1)
                wrong = f"{duration:g} s is not a whole number of steps of dt = {self.dt:g} s; dt = {fits!r} fits"
            raise mistake("duration", wrong)
        if steps % self.hold:
            raise mistake("hold", f"{steps} steps are not a multiple of {self.hold}")
        return self


class SineKeys(Keys):
    """A sine of a reference."""

    of: Annotated[str, TEXT]
    amplitude: Annotated[float, number()]
    frequency: Annotated[float, number("Hz", above=0.0)]
    phase: Annotated[float, number("rad")] = 0.0


class SinesKeys(Keys):
    """A reference of sines."""

    offset: Annotated[ByName, values()] = 0.0
    sines: tuple[SineKeys, ...]


class WaypointKeys(Keys):
    """A reference of waypoints."""

    times: Annotated[tuple[float, ...], numbers(unit="s")]
    values: tuple[Annotated[tuple[float, ...], numbers()], ...]
    between: Annotated[str, word("lines", "smooth")] = "lines"

    @model_validator(mode="after")
    def _require_rows(self) -> WaypointKeys:
        if len(self.times) < 2 or not all(b > a for a, b in itertools.pairwise(self.times)):
            raise mistake("times", f"must be two or more, and increase [s], got {list(self.times)}")
        if len(self.values) != len(self.times):
            raise mistake("values", f"must have {len(self.times)} rows, one for each of times; got {len(self.values)}")
        return self


def _values_file(text: str, info: ValidationInfo) -> Path:
    path = beside(text, info)
    if path.suffix not in (".csv", ".npz"):
        raise ValueError(f"must be a .csv or .npz file, got {path.name!r}")
    return existing(path)


class FileKeys(Keys):
    """A reference in a file."""

    file: Annotated[Path, checked(TEXT, _values_file)]


REFERENCE_KEYS: Mapping[str, type[Keys]] = {"file": FileKeys, "waypoints": WaypointKeys, "sines": SinesKeys}


def _reference_shape(value: Any) -> str:
    keys = set(value) if isinstance(value, dict) else set()
    if any(isinstance(value[key], list | dict) for key in keys & {"constant", "value"}):
        raise ValueError("constant values are given without a table, as in target = [0.4, 0.2, 0.3]")
    return next((name for name, kind in REFERENCE_KEYS.items() if keys & set(kind.model_fields)), toml_type(value))


def _reference(**others: Any) -> Rule:
    scalar = Annotated[float, number()]
    what = "a number for all, a list, a table by name, sines, waypoints or a file"
    numbers_of = {"number": scalar, "list": tuple[scalar, ...], "table": dict[str, scalar]}
    return either(what, _reference_shape, **numbers_of, **REFERENCE_KEYS, **others)


class SimulateKeys(Keys):
    """[simulate]."""

    controls: Annotated[Any, _reference(text=Annotated[str, word("hold")])] = None
    seed: Annotated[int | None, whole()] = None


class SolveKeys(Keys):
    """[solve]."""

    tolerance: Annotated[float, number(above=0.0)] = 0.0
    max_iterations: Annotated[int, whole()] = 0
    second_order: Annotated[bool, FLAG] = False
    forward: Annotated[str, word("closed", "open")] = "closed"
    regularization: Annotated[float, number(least=0.0)] = 0.0
    true_cost: Annotated[float, number(above=0.0)] = 0.0
    noise: Annotated[str, word("held", "whole")] = "held"


def _output(*endings: str) -> Rule:
    def written(text: str) -> Path:
        path = inside(text, Path.cwd(), "the working directory")
        if path.suffix.lower() not in endings:
            raise ValueError(f"must end in {', '.join(endings)}, got {path.name!r}")
        return path

    return checked(TEXT, written)


class OutputKeys(Keys):
    """[outputs]."""

    save: Annotated[Path | None, _output(".npz")] = None
    plot: Annotated[Path | None, _output(*FIGURES)] = None
    html: Annotated[Path | None, _output(".html")] = None
    speed: Annotated[float, number(above=0.0)] = 1.0


class TypedKeys(Keys):
    """A table whose kind is its ``type``."""

    type: str = ""


# [integrator]: options of the integrators in scene files.
_OPTIONS = {
    "alpha": Annotated[float, number(least=0.0, most=1.0)],
    "stages": Annotated[int, whole(1)],
    "kick": Annotated[str, word("left", "split", "held")],
}
INTEGRATORS: Mapping[str, Callable[..., Integrator]] = {
    word_of(name): kind for name, kind in BY_NAME.items() if name != "Reference"
}


def _integrator_keys(kind: Any) -> type[Keys]:
    options: dict[str, Any] = {name: (_OPTIONS[name], None) for name in options_of(kind) if name in _OPTIONS}
    return create_model(kind.__name__, __base__=TypedKeys, **options)


# [[force]] on joints: the fields of the force, by joint.
def _force_keys(kind: Any) -> type[Keys]:
    keys: dict[str, Any] = {item.name: (Annotated[Any, values()], _default(item)) for item in fields(kind)}
    if kind is CoulombFriction:
        keys["level"] = (Annotated[Any, values("N m or N", text=_ROBOT)], ...)
    return create_model(kind.__name__, __base__=TypedKeys, **keys)


def _default(item: Any) -> Any:
    return ... if item.default is MISSING else None


class PointKeys(Keys):
    """A point in a frame."""

    frame: Annotated[str, TEXT]
    place: Annotated[_THREE, numbers(3, "m")]


_THREE_NUMBERS = Annotated[Any, numbers(3)]


def _along(unit: str) -> Rule:
    what = f"a number, or three along the axes of the world [{unit}]"
    return either(what, number=Annotated[float, number(unit)], list=_THREE_NUMBERS)


_ON_FRAME: dict[str, Any] = {"text": Annotated[str, TEXT], "table": PointKeys}
_POINT = either("a frame's name, { frame, place } or a place in the world [m]", **_ON_FRAME, list=_THREE_NUMBERS)
# Rules of the fields of forces on frames.
_OF_FRAMES = {
    "a": _POINT,
    "b": _POINT,
    "frame": either("a frame's name, or { frame, place }", **_ON_FRAME),
    "wrench": numbers(6, "N and N m"),
    "axes": word("world", "frame"),
    "stiffness": _along("N/m"),
    "damping": _along("N s/m"),
    "rest": _along("m"),
    "rotational_stiffness": _along("N m/rad"),
    "rotational_damping": _along("N m s/rad"),
    "rest_rotation": numbers(9),
}


# Rules of the fields of constraints that do not follow from their annotations.
_OF_CONSTRAINTS = {
    "a": _POINT,
    "b": _POINT,
    "direction": numbers(3),
    "interpolation": word("linear", "cubic"),
    "length": number("m", above=0.0),
    "normal": numbers(3),
    "placement": numbers(16),
}


# Rules by annotation, for fields without a rule of their own.
_BY_ANNOTATION = {"Point": _POINT, "str": TEXT, "float": number(), "int": whole(0), "ArrayLike": numbers()}


def _keys_of_fields(kind: Any, rules: Mapping[str, Rule]) -> type[Keys]:
    keys: dict[str, Any] = {
        item.name: (Annotated[Any, rules.get(item.name) or _BY_ANNOTATION[item.type.split(" | ")[0]]], _default(item))
        for item in fields(kind)
    }
    return create_model(kind.__name__, __base__=TypedKeys, **keys)


# [[cost]]
def _cost_keys(name: str, term: Term) -> type[Keys]:
    weight = number(least=0.0) if len(term.axes) == 1 else values(least=0.0)
    keys: dict[str, Any] = {"weight": (Annotated[Any, weight], 1.0)}
    if term.reference is not None:
        of_postures = {"text": _POSTURE} if term.space == "q" else {}
        rule = values() if term.initial else _reference(**of_postures)
        keys[term.reference] = (Annotated[Any, rule], None if term.optional or term.holding else ...)
    if term.frame:
        keys["frame"] = (Annotated[str, TEXT], ...)
    if term.holding:
        keys["hold"] = (Annotated[Any, values("rad or m", flag=Literal[True], text=_POSTURE)], None)
    if term.can_end:
        keys["terminal"] = (Annotated[bool, FLAG], False)
    for key, default in term.numbers.items():
        keys[key] = (Annotated[float, number(least=0.0)], ... if default is None else default)
    keys |= {key: (Annotated[str, word(*options)], options[0]) for key, options in term.words.items()}
    return create_model(name, __base__=TypedKeys, **keys)


# [[plan_constraint]]
def _plan_constraint_keys(name: str, kind: Kind) -> type[Keys]:
    rules: dict[str, Any] = {key: (Annotated[Any, rule], default) for key, (rule, default) in kind.rules.items()}
    return create_model(name, __base__=TypedKeys, **rules)


FORCE_KEYS = {name: _force_keys(kind) for name, kind in FORCES.items()} | {
    name: _keys_of_fields(kind, _OF_FRAMES) for name, kind in FRAME_FORCES.items()
}
CONSTRAINT_KEYS = {
    name: _keys_of_fields(kind, _OF_CONSTRAINTS | (dict.fromkeys("ab", TEXT) if kind is FrameOnFrame else {}))
    for name, kind in CONSTRAINTS.items()
} | {"robot": create_model("RobotConstraints", __base__=TypedKeys)}
PLAN_CONSTRAINT_KEYS = {name: _plan_constraint_keys(name, kind) for name, kind in PLAN_CONSTRAINTS.items()}
INTEGRATOR_KEYS = {name: _integrator_keys(kind) for name, kind in INTEGRATORS.items()}
COST_KEYS = {name: _cost_keys(name, term) for name, term in TERMS.items()}


class SceneKeys(Keys):
    """A scene file."""

    title: Annotated[str | None, TEXT] = None
    gravity: Annotated[
        bool | tuple[float, ...],
        either("true, false or three numbers [m/s^2]", flag=bool, list=Annotated[Any, numbers(3, "m/s^2")]),
    ] = True
    damping: Annotated[Any, values("N m s/rad or N s/m", least=0.0, text=_ROBOT)] = None
    friction: Annotated[Any, values("N m or N", least=0.0, text=_ROBOT)] = None
    robot: Annotated[
        tuple[RobotKeys, ...],
        checked(
            either("a table [robot], or several of [[robot]]", table=RobotKeys, list=tuple[MemberKeys, ...]), _several
        ),
    ]
    springs: SpringKeys = SpringKeys()
    force: tuple[Annotated[Any, typed(FORCE_KEYS)], ...] = ()
    constraint: tuple[Annotated[Any, typed(CONSTRAINT_KEYS)], ...] = ()
    plan_constraint: tuple[Annotated[Any, typed(PLAN_CONSTRAINT_KEYS)], ...] = ()
    actuation: ActuationKeys = ActuationKeys()
    noise: tuple[NoiseKeys, ...] = ()
    initial: InitialKeys = InitialKeys()
    horizon: HorizonKeys
    integrator: Annotated[Any, typed(INTEGRATOR_KEYS, "gauss")] = TypedKeys(type="gauss")
    cost: tuple[Annotated[Any, typed(COST_KEYS)], ...] = ()
    simulate: SimulateKeys = SimulateKeys()
    solve: SolveKeys = SolveKeys()
    outputs: OutputKeys = OutputKeys()


@dataclass(frozen=True, eq=False)
class SceneSpec:
    """A scene file.

    Attributes:
        name: Name of the file without its suffix.
        title: Title for reports.
        path: Path of the file.
        root: Its tables, for messages.
        robots: The tables [robot] or [[robot]]; several robots are one tree.
        prefixes: Prefix of the names of each robot; None for a file with one ``[robot]``.
        gravity: Gravity [m/s^2], or whether there is any.
        damping: Viscous damping by joint [N m s/rad or N s/m], or "robot" for that of the description; None where it is
            left out.
        friction: Dry friction by joint [N m or N], in the forms of ``damping``.
        stiffness: Stiffness of joint springs, by joint [N m/rad or N/m].
        rest: Rest positions of joint springs, by joint [rad or m], or the name of a posture.
        forces: Other forces on joints.
        frame_forces: Forces on frames.
        constraints: Constraints of the motion.
        plan_constraints: Hard constraints of the plan; with any, no joint is left out.
        actuated: Driven joints; None for all.
        gear: Generalized force per control, by driven joint.
        torque_limit: Bounds by driven joint [N m or N]; ``"robot"`` for those of the description; None for none.
        noise: Noise models.
        q0: Initial configuration by joint [rad or m], or the name of a posture.
        v0: Initial velocity by joint [rad/s or m/s].
        dt: Time step [s].
        steps: N.
        hold: Steps that share a control.
        sampling: Sampling of running costs.
        shape: Controls of a plan between nodes: ``"held"`` or ``"linear"``.
        between_nodes: Whether the plan's constraints are to hold between nodes, too.
        integrator: The integrator; None where the file names none.
        costs: Terms of the cost.
        controls: Controls of a simulation: None for none, ``"hold"`` to hold the robot, or values over time.
        seed: Seed of the noise in a simulation; None for no noise.
        options: Options of ``solve``.
        outputs: Files to write.
    """

    name: str
    title: str
    path: Path
    root: Table
    robots: tuple[RobotKeys, ...]
    prefixes: tuple[str, ...] | None
    gravity: bool | tuple[float, ...]
    damping: ByName | Literal["robot"] | None
    friction: ByName | Literal["robot"] | None
    stiffness: ByName
    rest: ByName | str
    forces: tuple[ForceSpec, ...]
    frame_forces: tuple[FrameForceSpec, ...]
    constraints: tuple[ConstraintSpec, ...]
    plan_constraints: tuple[PlanConstraintSpec, ...]
    actuated: tuple[str, ...] | None
    gear: ByName
    torque_limit: ByName | str | None
    noise: tuple[NoiseKeys, ...]
    q0: ByName | str
    v0: ByName
    dt: float
    steps: int
    hold: int
    sampling: str
    shape: str
    between_nodes: bool
    integrator: Integrator | None
    costs: tuple[CostSpec, ...]
    controls: ReferenceSignal | str | None
    seed: int | None
    options: Mapping[str, Any]
    outputs: OutputKeys

    @property
    def duration(self) -> float:
        """The horizon [s]."""
        return self.dt * self.steps


def spec_of(data: Mapping[str, Any], path: Path, name: str) -> SceneSpec:
    """The content of the file ``path``, checked as far as possible without the robot.

    Raises:
        SceneFileError: There is a mistake in the tables.
    """
    root = Table(path.name, "")
    keys = read_keys(SceneKeys, data, path)
    horizon = keys.horizon
    if horizon.count * len(keys.cost) > MOST_EVALUATIONS:
        costs = f"{horizon.count} steps times {len(keys.cost)} costs"
        raise root.error("horizon", f"{costs} are too many; the product may be at most {MOST_EVALUATIONS}")
    forces = [_force(root.table(f"force[{index}]"), entry) for index, entry in enumerate(keys.force)]
    controls = keys.simulate.controls
    if controls is not None and controls != "hold":
        controls = _reference_of(root.table("simulate"), "controls", controls, horizon.dt)
    members = [robot for robot in keys.robot if isinstance(robot, MemberKeys)]
    return SceneSpec(
        name=name,
        title=name if keys.title is None else keys.title,
        path=path,
        root=root,
        robots=keys.robot,
        prefixes=tuple(robot.prefix for robot in members) if members else None,
        gravity=keys.gravity,
        damping=keys.damping,
        friction=keys.friction,
        stiffness=keys.springs.stiffness,
        rest=keys.springs.rest,
        forces=tuple(force for force in forces if isinstance(force, ForceSpec)),
        frame_forces=tuple(force for force in forces if isinstance(force, FrameForceSpec)),
        constraints=tuple(
            _constraint(root.table(f"constraint[{k}]"), entry) for k, entry in enumerate(keys.constraint)
        ),
        plan_constraints=tuple(
            PlanConstraintSpec(PLAN_CONSTRAINTS[entry.type], _all(entry), root.table(f"plan_constraint[{k}]"))
            for k, entry in enumerate(keys.plan_constraint)
        ),
        actuated=keys.actuation.joints,
        gear=keys.actuation.gear,
        torque_limit=keys.actuation.torque_limit,
        noise=keys.noise,
        q0=keys.initial.q,
        v0=keys.initial.v,
        dt=horizon.dt,
        steps=horizon.count,
        hold=horizon.hold,
        sampling=horizon.sampling,
        shape=horizon.controls,
        between_nodes=horizon.between_nodes,
        integrator=_integrator(root.table("integrator"), keys.integrator),
        costs=tuple(_cost(root.table(f"cost[{k}]"), entry, horizon.dt) for k, entry in enumerate(keys.cost)),
        controls=controls,
        seed=keys.simulate.seed,
        options=_given(keys.solve),
        outputs=keys.outputs,
    )


def _given(keys: Keys) -> dict[str, Any]:
    """The given keys of a table, without its type."""
    return {name: getattr(keys, name) for name in keys.model_fields_set if name != "type"}


def _all(keys: Keys) -> dict[str, Any]:
    """All keys of a table, without its type, with defaults for those left out."""
    return {name: getattr(keys, name) for name in type(keys).model_fields if name != "type"}


def _force(table: Table, keys: TypedKeys) -> ForceSpec | FrameForceSpec:
    if keys.type in FORCES:
        return ForceSpec(FORCES[keys.type], _given(keys), table)
    given = {name: _point(value) for name, value in _given(keys).items()}
    if "rest_rotation" in given:
        given["rest_rotation"] = [given["rest_rotation"][row : row + 3] for row in range(0, 9, 3)]
    return FrameForceSpec(FRAME_FORCES[keys.type](**given), table)


def _constraint(table: Table, keys: TypedKeys) -> ConstraintSpec:
    if keys.type not in CONSTRAINTS:
        return ConstraintSpec(None, table)
    given = {name: _point(value) for name, value in _given(keys).items()}
    if "placement" in given:
        given["placement"] = [given["placement"][row : row + 4] for row in range(0, 16, 4)]
    try:
        return ConstraintSpec(CONSTRAINTS[keys.type](**given), table)
    except InputError as error:
        raise table.error("", str(error)) from None


def _point(value: Any) -> Any:
    """A point in the form that forces and constraints take."""
    if isinstance(value, PointKeys):
        return value.frame, list(value.place)
    return list(value) if isinstance(value, tuple) else value


def _integrator(table: Table, keys: TypedKeys) -> Integrator | None:
    if type(keys) is TypedKeys:
        # The file has no table [integrator].
        return None
    kind = keys.type or "gauss"
    given = {"stages": default_integrator().stages} if kind == "gauss" else {}
    try:
        return INTEGRATORS[kind](**given | _given(keys))
    except InputError as error:
        raise table.error("", str(error)) from None


def _cost(table: Table, keys: TypedKeys, dt: float) -> CostSpec:
    term = TERMS[keys.type]
    given = _given(keys)
    holding_q, value = given.get("hold"), given.get(term.reference or "")
    if holding_q is not None and value is not None:
        raise table.error("", f"hold and {term.reference} exclude each other: give one of them")
    reference = None
    if term.reference is not None and holding_q is None and not (term.initial and value is None):
        reference = _reference_of(table, term.reference, 0.0 if value is None else value, dt)
    return CostSpec(
        table=table,
        kind=keys.type,
        term=term,
        weight=given.get("weight", 1.0),
        terminal=given.get("terminal", False),
        reference=reference,
        holding_q=() if holding_q is True else holding_q,
        frame=given.get("frame", ""),
        numbers={name: getattr(keys, name) for name in term.numbers},
        words={name: getattr(keys, name) for name in term.words},
    )


def _reference_of(table: Table, name: str, value: Any, dt: float) -> ReferenceSignal:
    nested = table.table(name)
    if isinstance(value, WaypointKeys):
        return ReferenceSignal(table, name, times=value.times, values=value.values, smooth=value.between == "smooth")
    if isinstance(value, FileKeys):
        return ReferenceSignal(table, name, file=value.file)
    if not isinstance(value, SinesKeys):
        return ReferenceSignal(table, name, offset=value)
    for index, sine in enumerate(value.sines):
        if sine.frequency > 0.5 / dt:
            most = f"<= {0.5 / dt:g} [Hz], the most that dt = {dt:g} s resolves"
            raise nested.error(f"sines[{index}].frequency", f"must be {most}, got {sine.frequency:g}")
    sines = tuple(Sine(sine.of, sine.amplitude, sine.frequency, sine.phase) for sine in value.sines)
    return ReferenceSignal(table, name, offset=value.offset, sines=sines)
