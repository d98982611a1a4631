"""The tables of a scene file. Forces, constraints and integrators are those of the API, by the name of their class."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation

from varpin.control.problem import default_integrator
from varpin.errors import InputError
from varpin.integrators import BY_NAME, Integrator
from varpin.io.scenefile.plan_constraints import PLAN_CONSTRAINTS, PlanTable
from varpin.io.scenefile.reading import (
    FILE,
    FLAG,
    TEXT,
    ByName,
    Rule,
    Where,
    beside,
    by_name,
    checked,
    either,
    entries,
    existing,
    keys,
    number,
    rules_of,
    table,
    toml_of,
    typed,
    values,
    whole,
    word,
    word_of,
)
from varpin.io.scenefile.references import reference
from varpin.io.scenefile.terms import COST_RULES, CostTable
from varpin.mechanics import constraints
from varpin.mechanics.constraints import Constraint, CustomConstraint
from varpin.mechanics.forces import (
    Armature,
    CoulombFriction,
    Force,
    FrameDamper,
    FrameSpring,
    FrameWrench,
    JointDamper,
    JointSpring,
    JointStop,
    PositionServo,
)
from varpin.model import Payload

# Largest number of steps: a motion of seven joints over as many takes gigabytes.
MOST_STEPS = 10**7
# Largest product of steps and terms of the cost: each term evaluates its reference at each step.
MOST_EVALUATIONS = 10**6
FIGURES = (".png", ".pdf", ".svg")
# Forces by the type of a [[force]].
FORCES: Mapping[str, type[Force]] = {
    "armature": Armature,
    "damper": JointDamper,
    "friction": CoulombFriction,
    "servo": PositionServo,
    "spring": JointSpring,
    "stop": JointStop,
    "frame_damper": FrameDamper,
    "frame_spring": FrameSpring,
    "frame_wrench": FrameWrench,
}
# Constraints by the type of a [[constraint]]: all those without a function.
CONSTRAINTS: Mapping[str, type[Constraint]] = {
    word_of(name): kind
    for name, kind in sorted(vars(constraints).items())
    if isinstance(kind, type) and issubclass(kind, Constraint) and kind not in (Constraint, CustomConstraint)
}
INTEGRATORS: Mapping[str, type[Integrator]] = {
    word_of(name): kind for name, kind in BY_NAME.items() if name != "Reference"
}

# Matrices that a file writes row by row.
_MATRICES = {"placement": (4, 4), "rest_rotation": (3, 3)}
_NUMBER = Annotated[float, number()]
# Values of the description, or a posture of the robot's SRDF file by name.
_ROBOT, _POSTURE = word("robot"), TEXT


def of_api(kind: Any, **rules: Rule) -> Rule:
    """A table that is an object of the API."""

    def made(given: Any, where: Where) -> Any:
        shaped = {}
        for name, value in given.items():
            shape = _MATRICES.get(name)
            if shape and np.size(value) != np.prod(shape):
                raise where.at(name).error(f"must have {np.prod(shape)} entries, got {np.size(value)}")
            shaped[name] = np.reshape(value, shape) if shape else value
        try:
            return kind(**shaped)
        except InputError as error:
            raise where.of(error, given) from None

    all_rules = rules_of(kind)
    return checked(keys({name: (rules.get(name, rule), must) for name, (rule, must) in all_rules.items()}), made)


@dataclass(frozen=True)
class PayloadTable:
    """[[robot.payload]]."""

    frame: Annotated[str, TEXT]
    mass: Annotated[float, number("kg", above=0.0)]
    com: Annotated[tuple[float, ...], entries(number("m"), 3)] = (0.0, 0.0, 0.0)
    inertia: Annotated[tuple[float, ...], entries(number("kg m^2"))] = (0.0, 0.0, 0.0)
    payload: Payload = field(init=False)

    def __post_init__(self) -> None:
        inertia: Any = self.inertia
        if len(inertia) == 6:
            xx, xy, xz, yy, yz, zz = inertia
            inertia = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        elif len(inertia) != 3:
            what = "3 principal moments or 6 entries ixx, ixy, ixz, iyy, iyz, izz"
            raise InputError(f"inertia must be {what}; got {len(inertia)}")
        object.__setattr__(self, "payload", Payload(self.frame, self.mass, self.com, inertia))


@dataclass(frozen=True)
class BaseTable:
    """Placement of the base of a robot."""

    xyz: Annotated[tuple[float, ...], entries(number("m"), 3)] = (0.0, 0.0, 0.0)
    rpy: Annotated[tuple[float, ...], entries(number("rad"), 3)] = (0.0, 0.0, 0.0)

    def transform(self) -> Any:
        """The placement as a matrix (4, 4)."""
        transform = np.eye(4)
        transform[:3, :3] = Rotation.from_euler("xyz", self.rpy).as_matrix()
        transform[:3, 3] = self.xyz
        return transform


def _source(text: str, where: Where) -> str | Path:
    """The name of a robot, or the path of an existing file."""
    named = not Path(text).suffix and "/" not in text and "\\" not in text
    return text if named else existing(text, where)


_LOCK = either(
    "a number [rad or m], or the configuration of a joint with several axes",
    number=number("rad or m"),
    list=entries(number()),
)
_ANY = Rule("", lambda value, _: value)
_ARGUMENT = either("a text, a number, true or false", text=_ANY, number=_ANY, flag=_ANY)
_BASE = either(
    '"planar", or { xyz, rpy }',
    text=word("planar"),
    table=checked(table(BaseTable), lambda base, _: base.transform()),
)


@dataclass(frozen=True)
class RobotTable:
    """[robot], with the options of :func:`varpin.load_robot`."""

    source: Annotated[str | Path, checked(TEXT, _source)]
    lock: Annotated[Mapping[str, Any], by_name(_LOCK)] = field(default_factory=dict)
    keep: Annotated[tuple[str, ...] | None, entries(TEXT, distinct=True)] = None
    mimic: Annotated[str, word("tied", "free")] = "tied"
    package_dirs: Annotated[
        tuple[str, ...], entries(checked(TEXT, lambda text, where: str(beside(text, where))), distinct=True)
    ] = ()
    xacro_args: Annotated[Mapping[str, Any], by_name(_ARGUMENT)] = field(default_factory=dict)
    srdf: Annotated[Path | None, FILE] = None
    payload: Annotated[tuple[Payload, ...], entries(checked(table(PayloadTable), lambda given, _: given.payload))] = ()
    base: Annotated[Any, _BASE] = None
    armature: Annotated[ByName | None, values("kg m^2 or kg", least=0.0)] = None
    inertia: Annotated[str, word("file", "meshes")] = "file"
    density: Annotated[float, number("kg/m^3", above=0.0)] = 1000.0


@dataclass(frozen=True)
class MemberTable(RobotTable):
    """[[robot]]."""

    prefix: Annotated[str, TEXT] = ""


def _several(robots: Any, where: Where) -> tuple[RobotTable, ...]:
    if isinstance(robots, RobotTable):
        return (robots,)
    if len(robots) < 2:
        raise where.error(f"[[robot]] is for two robots or more, got {len(robots)}; one is written [robot]")
    return tuple(robots)


@dataclass(frozen=True)
class SpringTable:
    """[springs]."""

    stiffness: Annotated[ByName, values("N m/rad or N/m", least=0.0)] = 0.0
    rest: Annotated[ByName | str, values("rad or m", text=_POSTURE)] = 0.0


@dataclass(frozen=True)
class ActuationTable:
    """[actuation]."""

    joints: Annotated[tuple[str, ...] | None, entries(TEXT, distinct=True)] = None
    gear: Annotated[ByName, values()] = 1.0
    torque_limit: Annotated[ByName | str | None, values("N m or N", least=0.0, text=_ROBOT)] = None

    def __post_init__(self) -> None:
        if self.joints == ():
            raise InputError("must name at least one joint; leave it out to drive all of them", "joints")


@dataclass(frozen=True)
class NoiseTable:
    """[[noise]]."""

    type: Annotated[str, word("additive", "control", "state")]
    intensity: Annotated[ByName, values(least=0.0)]
    center: Annotated[ByName | str | None, values("rad or m", text=_POSTURE)] = None

    def __post_init__(self) -> None:
        if self.type != "state" and self.center is not None:
            raise InputError(f"belongs to state noise alone, and this is {self.type} noise", "center")


@dataclass(frozen=True)
class InitialTable:
    """[initial]."""

    q: Annotated[ByName | str, values("rad or m", text=_POSTURE)] = 0.0
    v: Annotated[ByName, values("rad/s or m/s")] = 0.0


@dataclass(frozen=True)
class HorizonTable:
    """[horizon]."""

    dt: Annotated[float, number("s", above=0.0)]
    steps: Annotated[int, whole(1, MOST_STEPS)] = 0
    duration: Annotated[float | None, number("s", above=0.0)] = None
    hold: Annotated[int, whole(1)] = 1
    sampling: Annotated[str, word("gauss", "midpoint", "start")] = "gauss"
    controls: Annotated[str, word("held", "linear")] = "held"
    between_nodes: Annotated[bool, FLAG] = False

    def __post_init__(self) -> None:
        duration, dt = self.duration, self.dt
        if (duration is None) == (self.steps == 0):
            wrong = "one of them is missing" if duration is None else "they exclude each other"
            raise InputError(f"a horizon has steps or a duration: {wrong}", "")
        steps = self.steps
        if duration is not None:
            steps = round(min(duration / dt, 2.0 * MOST_STEPS))
            if steps > MOST_STEPS:
                most = f"{MOST_STEPS} steps of dt = {dt:g} s, the most there may be"
                raise InputError(f"{duration:g} s is more than {most}", "duration")
            if steps < 1 or abs(steps * dt - duration) > 1e-9 * duration:
                fits = f"dt = {duration / max(steps, 1)!r} fits"
                raise InputError(f"{duration:g} s is not a whole number of steps of dt = {dt:g} s; {fits}", "duration")
            object.__setattr__(self, "steps", steps)
        if steps % self.hold:
            raise InputError(f"{steps} steps are not a multiple of {self.hold}", "hold")


@dataclass(frozen=True)
class SimulateTable:
    """[simulate]."""

    controls: Annotated[Any, reference(text=word("hold"))] = None
    seed: Annotated[int | None, whole()] = None


@dataclass(frozen=True)
class SolveTable:
    """[solve]: options of :func:`varpin.solve`, whose defaults are those there."""

    tolerance: Annotated[float | None, number(above=0.0)] = None
    max_iterations: Annotated[int | None, whole()] = None
    second_order: Annotated[bool | None, FLAG] = None
    regularization: Annotated[float | None, number(least=0.0)] = None
    true_cost: Annotated[float | None, number(above=0.0)] = None


def _output(*endings: str) -> Rule:
    def written(text: str, where: Where) -> Path:
        path = Path.cwd() / text
        if path.suffix.lower() not in endings:
            raise where.error(f"must end in {', '.join(endings)}, got {path.name!r}")
        return path

    return checked(TEXT, written)


@dataclass(frozen=True)
class OutputTable:
    """[outputs]."""

    save: Annotated[Path | None, _output(".npz")] = None
    plot: Annotated[Path | None, _output(*FIGURES)] = None
    html: Annotated[Path | None, _output(".html")] = None
    speed: Annotated[float, number(above=0.0)] = 1.0


_LEVEL = values("N m or N", text=_ROBOT)
FORCE_RULES = {
    word: of_api(kind, **({"level": _LEVEL} if kind is CoulombFriction else {})) for word, kind in FORCES.items()
}
CONSTRAINT_RULES = {word: of_api(kind) for word, kind in CONSTRAINTS.items()}
CONSTRAINT_RULES["robot"] = checked(keys({}), lambda *_: "robot")
INTEGRATOR_RULES = {word: of_api(kind) for word, kind in INTEGRATORS.items()}


def _integrator(given: Any, where: Where) -> Integrator:
    kind = given.get("type", "gauss") if isinstance(given, dict) else ""
    stages = {"stages": default_integrator().stages} if kind == "gauss" else {}
    made: Integrator = typed(INTEGRATOR_RULES, "gauss").read(stages | given if stages else given, where)
    return made


@dataclass(frozen=True, eq=False)
class SceneTables:
    """The content of a scene file.

    Attributes:
        path: The file.
        name: Name of the file without its suffix.
        integrator: None where the file names none.
    """

    path: Path
    name: str
    robot: Annotated[
        tuple[RobotTable, ...],
        checked(
            either(
                "a table [robot], or several of [[robot]]", table=table(RobotTable), list=entries(table(MemberTable))
            ),
            _several,
        ),
    ]
    horizon: Annotated[HorizonTable, table(HorizonTable)]
    title: Annotated[str, TEXT] = ""
    gravity: Annotated[
        Any, either("true, false or three numbers [m/s^2]", flag=FLAG, list=entries(number("m/s^2"), 3))
    ] = True
    damping: Annotated[Any, values("N m s/rad or N s/m", least=0.0, text=_ROBOT)] = None
    friction: Annotated[Any, values("N m or N", least=0.0, text=_ROBOT)] = None
    springs: Annotated[SpringTable, table(SpringTable)] = SpringTable()
    force: Annotated[tuple[Force, ...], entries(typed(FORCE_RULES))] = ()
    constraint: Annotated[tuple[Any, ...], entries(typed(CONSTRAINT_RULES))] = ()
    plan_constraint: Annotated[tuple[PlanTable, ...], entries(typed(PLAN_CONSTRAINTS))] = ()
    actuation: Annotated[ActuationTable, table(ActuationTable)] = ActuationTable()
    noise: Annotated[tuple[NoiseTable, ...], entries(table(NoiseTable))] = ()
    initial: Annotated[InitialTable, table(InitialTable)] = InitialTable()
    integrator: Annotated[Integrator | None, Rule("a table", _integrator)] = None
    cost: Annotated[tuple[CostTable, ...], entries(typed(COST_RULES))] = ()
    simulate: Annotated[SimulateTable, table(SimulateTable)] = SimulateTable()
    solve: Annotated[SolveTable, table(SolveTable)] = SolveTable()
    outputs: Annotated[OutputTable, table(OutputTable)] = OutputTable()

    def __post_init__(self) -> None:
        object.__setattr__(self, "title", self.title or self.name)
        if self.steps * len(self.cost) > MOST_EVALUATIONS:
            costs = f"{self.steps} steps times {len(self.cost)} costs"
            raise InputError(f"{costs} are too many; the product may be at most {MOST_EVALUATIONS}", "horizon")

    @property
    def where(self) -> Where:
        """The top level of the file."""
        return Where(self.path)

    @property
    def dt(self) -> float:
        """Time step [s]."""
        return self.horizon.dt

    @property
    def steps(self) -> int:
        """Number of steps N."""
        return self.horizon.steps

    @property
    def duration(self) -> float:
        """The horizon [s]."""
        return self.dt * self.steps

    @property
    def prefixes(self) -> tuple[str, ...]:
        """Prefix of the names of each robot; empty for a file with one ``[robot]``."""
        return tuple(robot.prefix for robot in self.robot if isinstance(robot, MemberTable))


def read_scene(path: Path) -> SceneTables:
    """Read a scene file, checked as far as possible without the robot.

    Raises:
        FileError: The file cannot be read.
        SceneFileError: There is a mistake in it.
    """
    tables: SceneTables = table(SceneTables, path=path, name=path.stem).read(toml_of(path), Where(path))
    return tables
