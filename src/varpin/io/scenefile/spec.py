"""What a scene file says, read and checked as far as that goes without the robot."""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from varpin.control.problem import default_integrator
from varpin.errors import FileError, InputError
from varpin.integrators import BY_NAME, Integrator, options_of
from varpin.io.scenefile.references import Reference, read_reference
from varpin.io.scenefile.table import ByName, SceneFileError, Table, inside, shown, suggestion
from varpin.io.scenefile.terms import TERMS, Term
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
    Point,
    PositionServo,
)
from varpin.model import Payload, models_dir
from varpin.support.checks import is_file

# A motion of seven joints over so many steps takes gigabytes.
MOST_STEPS = 10**7
# Steps times terms of a cost: references are evaluated for each.
MOST_EVALUATIONS = 10**6
# Of a file: bytes, dots outside numbers, tables within tables, characters of a word, tables or words of a list.
_MOST_BYTES = 1_000_000
_MOST_DOTS = 1000
_NESTED = 20
_LONGEST_WORD = 1000
_MOST_TABLES = 300
_FLOAT = re.compile(r"(?<![\w.+-])[+-]?[0-9][0-9_]*\.[0-9][0-9_]*(?:[eE][+-]?[0-9]+)?(?![\w.-])", re.ASCII)
# Of a [[force]], by the word for it.
FORCES: Mapping[str, type[Force]] = {
    "armature": Armature,
    "damper": JointDamper,
    "friction": CoulombFriction,
    "servo": PositionServo,
    "spring": JointSpring,
    "stop": JointStop,
}
# The same of forces on frames.
FRAME_FORCES: Mapping[str, type[Force]] = {
    "frame_damper": FrameDamper,
    "frame_spring": FrameSpring,
    "frame_wrench": FrameWrench,
}
FIGURES = (".png", ".pdf", ".svg")


@dataclass(frozen=True)
class RobotSpec:
    """Which robot, and how it is taken.

    Attributes:
        source: A name, or the path of a URDF file.
        lock: Joints held still, and where [rad or m].
        mimic: ``"tied"`` or ``"free"``.
        package_dirs: Where meshes are looked up.
        payload: What it carries.
    """

    source: str | Path
    lock: Mapping[str, float]
    mimic: str
    package_dirs: tuple[str, ...]
    payload: tuple[Payload, ...]


@dataclass(frozen=True)
class NoiseSpec:
    """A noise model.

    Attributes:
        kind: ``"additive"``, ``"control"`` or ``"state"``.
        intensity: By joint, or by control for ``"control"``.
        center: Of state noise; None for where the motion starts.
    """

    kind: str
    intensity: ByName
    center: ByName | None


@dataclass(frozen=True, eq=False)
class ForceSpec:
    """A force on joints.

    Attributes:
        kind: Which one.
        values: Its attributes by joint, those that the file gives.
        table: Where it stands, for messages.
    """

    kind: type[Force]
    values: Mapping[str, ByName]
    table: Table


@dataclass(frozen=True, eq=False)
class FrameForceSpec:
    """A force on frames.

    Attributes:
        force: What the file says.
        table: Where it stands, for messages.
    """

    force: Force
    table: Table


@dataclass(frozen=True, eq=False)
class CostSpec:
    """A term of the cost.

    Attributes:
        table: Where it stands.
        term: What kind it is.
        weight: By component.
        terminal: At the end, instead of its integral.
        reference: Its target over time, if it has one.
        hold: A configuration whose holding torques are the reference, by joint; ``()`` for the initial one.
        frame: Name of a frame, for terms that have one.
        numbers: What else it takes.
        words: What else it takes.
    """

    table: Table
    term: Term
    weight: ByName
    terminal: bool
    reference: Reference | None
    hold: ByName | None
    frame: str
    numbers: Mapping[str, float]
    words: Mapping[str, str]


@dataclass(frozen=True)
class Outputs:
    """Files to write, relative ones below the working directory.

    Attributes:
        save: Trajectory or solution, npz.
        plot: Figure.
        html: Replay.
        speed: Of the replay.
    """

    save: Path | None
    plot: Path | None
    html: Path | None
    speed: float


@dataclass(frozen=True, eq=False)
class SceneSpec:
    """A scene file.

    Attributes:
        name: Of the file, or of the bundled scene.
        title: For people.
        path: Of the file.
        root: Its tables, for messages.
        robot: See :class:`RobotSpec`.
        gravity: [m/s^2], or whether there is any.
        damping: By joint [N m s/rad or N s/m], or "robot" for the description's own; None where nothing is said.
        stiffness: Of joint springs, by joint [N m/rad or N/m].
        rest: Where springs are slack, by joint [rad or m].
        forces: Others on joints.
        frame_forces: Others on frames.
        actuated: Joints that are driven; None for all.
        gear: Generalized force per control, by driven joint.
        torque_limit: By driven joint [N m or N]; ``"robot"`` for the robot description's; None for none.
        noise: Models.
        q0: Initial configuration by joint [rad or m].
        v0: Initial velocity by joint.
        dt: [s].
        steps: N.
        hold: Steps that share a control.
        sampling: Of running costs.
        integrator: The integrator.
        costs: Terms.
        controls: Of a simulation: None for none, ``"hold"`` for holding ones, or values over time.
        seed: Of the noise of a simulation; without it there is none.
        options: Of solve.
        outputs: Files to write.
    """

    name: str
    title: str
    path: Path
    root: Table
    robot: RobotSpec
    gravity: bool | tuple[float, ...]
    damping: ByName | Literal["robot"] | None
    stiffness: ByName
    rest: ByName
    forces: tuple[ForceSpec, ...]
    frame_forces: tuple[FrameForceSpec, ...]
    actuated: tuple[str, ...] | None
    gear: ByName
    torque_limit: ByName | str | None
    noise: tuple[NoiseSpec, ...]
    q0: ByName
    v0: ByName
    dt: float
    steps: int
    hold: int
    sampling: str
    integrator: Integrator
    costs: tuple[CostSpec, ...]
    controls: Reference | str | None
    seed: int | None
    options: Mapping[str, Any]
    outputs: Outputs

    @property
    def duration(self) -> float:
        """The horizon [s]."""
        return self.dt * self.steps


def scenes() -> dict[str, Path]:
    """The scenes that come with varpin, by name."""
    return {path.stem: path for path in sorted((models_dir() / "scenes").glob("*.toml"))}


def find_scene(source: str | Path) -> Path:
    """The scene file at a path, or of a bundled name.

    Raises:
        FileError: There is none; names that come close are listed.
        InputError: Not a path.
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


def read_scene(path: Path, name: str | None = None) -> SceneSpec:
    """Read a scene file.

    Raises:
        FileError: It cannot be read.
        SceneFileError: A mistake in it.
    """
    source = path.name
    try:
        with path.open("rb") as stream:
            content = stream.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise SceneFileError(source, "", f"it is larger than {_MOST_BYTES / 1e6:g} MB, the largest that is read")
        text = content.decode("utf-8")
        # A key of n parts takes tomllib a time of n^2: minutes for 50 kB.
        if text.count(".") - len(_FLOAT.findall(text)) > _MOST_DOTS:
            raise SceneFileError(source, "", f"it has more than {_MOST_DOTS} dots that are not those of numbers")
        data = tomllib.loads(text.replace("\r\n", "\n"))
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise SceneFileError(source, "", "it is not a text in UTF-8") from None
    except RecursionError:
        raise SceneFileError(source, "", "it is nested too deeply") from None
    except SceneFileError:
        raise
    except ValueError as error:  # of numbers that Python does not read, tomllib lets Python's own through
        raise SceneFileError(source, "", f"it is not TOML: {error}") from None
    _require_sane(source, data)
    return _scene(Table(source, "", data), path, path.stem if name is None else name)


def _require_sane(source: str, data: Mapping[str, Any]) -> None:
    """Refuse what no scene has and what makes messages and searches of any length.

    Raises:
        SceneFileError: Tables within tables without end, thousands of tables in a list, integers of more than 64 bits,
            or words that are very long or cannot be printed.
    """
    waiting: list[tuple[str, int, Any]] = [("", 0, data)]
    while waiting:
        key, depth, value = waiting.pop()
        if depth > _NESTED:
            raise SceneFileError(source, key[:_LONGEST_WORD], f"is nested more than {_NESTED} deep")
        if isinstance(value, str) and not _is_plain(value):
            raise SceneFileError(
                source, key, f"must be a text of one line and {_LONGEST_WORD} characters at most, got {shown(value)}"
            )
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise SceneFileError(source, key, "is an integer of more than 64 bits")
        if isinstance(value, dict):
            for name, entry in value.items():
                if not _is_plain(name):
                    raise SceneFileError(source, key, f"has a key of no use, {shown(name)}")
                waiting.append((f"{key}.{name}" if key else name, depth + 1, entry))
        if isinstance(value, list):
            if len(value) > _MOST_TABLES and any(isinstance(entry, dict | str) for entry in value):
                raise SceneFileError(source, key, f"has {len(value)} entries; {_MOST_TABLES} are the most")
            waiting += [(f"{key}[{index}]", depth + 1, entry) for index, entry in enumerate(value)]


def _is_plain(word: str) -> bool:
    return word.isprintable() and len(word) <= _LONGEST_WORD


def _damping(root: Table) -> ByName | Literal["robot"] | None:
    if isinstance(root.data.get("damping"), str):
        root.choice("damping", ("robot",))
        return "robot"
    return root.by_name("damping", least=0.0, unit="N m s/rad or N s/m") if "damping" in root else None


def _scene(root: Table, path: Path, name: str) -> SceneSpec:
    root.allow(
        *("title", "gravity", "damping", "robot", "springs", "force", "actuation", "noise", "initial", "horizon"),
        *("integrator", "cost", "simulate", "solve", "outputs"),
    )
    for required in ("robot", "horizon"):
        root.require(required, f"the table [{required}]")
    folder = path.resolve().parent
    horizon = _horizon(root.table("horizon"))
    springs = root.table("springs").allow("stiffness", "rest")
    initial = root.table("initial").allow("q", "v")
    actuation = root.table("actuation").allow("joints", "gear", "torque_limit")
    simulation = root.table("simulate").allow("controls", "seed")
    limit: ByName | str | None = None
    if isinstance(actuation.data.get("torque_limit"), str):
        limit = actuation.choice("torque_limit", ("robot",))
    elif "torque_limit" in actuation:
        limit = actuation.by_name("torque_limit", least=0.0, unit="N m or N")
    controls: Reference | str | None = None
    if isinstance(simulation.data.get("controls"), str):
        controls = simulation.choice("controls", ("hold",))
    elif "controls" in simulation:
        controls = read_reference(simulation, "controls", folder, horizon["dt"])
    costs = tuple(_cost(table, folder, horizon["dt"]) for table in root.tables("cost"))
    if horizon["steps"] * len(costs) > MOST_EVALUATIONS:
        raise root.table("horizon").error(
            "",
            f"{horizon['steps']} steps times {len(costs)} costs are too many; {MOST_EVALUATIONS} are the most",
        )
    forces = [_force(table) for table in root.tables("force")]
    joints = actuation.texts("joints")
    if "joints" in actuation and not joints:
        raise actuation.error("joints", "must name a joint at least; leave it out to drive all of them")
    return SceneSpec(
        name=name,
        title=root.text("title", name),
        path=path,
        root=root,
        robot=_robot(root.table("robot"), folder),
        gravity=_gravity(root),
        damping=_damping(root),
        stiffness=springs.by_name("stiffness", 0.0, least=0.0, unit="N m/rad or N/m"),
        rest=springs.by_name("rest", 0.0, unit="rad or m"),
        forces=tuple(force for force in forces if isinstance(force, ForceSpec)),
        frame_forces=tuple(force for force in forces if isinstance(force, FrameForceSpec)),
        actuated=joints or None,
        gear=actuation.by_name("gear", 1.0),
        torque_limit=limit,
        noise=tuple(_noise(table) for table in root.tables("noise")),
        q0=initial.by_name("q", 0.0, unit="rad or m"),
        v0=initial.by_name("v", 0.0, unit="rad/s or m/s"),
        **horizon,
        integrator=_integrator(root.table("integrator")),
        costs=costs,
        controls=controls,
        seed=simulation.whole("seed") if "seed" in simulation else None,
        options=_options(root.table("solve")),
        outputs=_outputs(root.table("outputs")),
    )


def _robot(table: Table, folder: Path) -> RobotSpec:
    table.allow("source", "lock", "mimic", "package_dirs", "payload")
    text = table.text("source")
    source: str | Path = text
    if Path(text).suffix or "/" in text or "\\" in text:
        source = inside(table, "source", text, folder, "the scene's folder")
        if not is_file(source):
            raise table.error("source", f"there is no file {source}")
    lock = table.table("lock")
    folders = tuple(
        str(inside(table, f"package_dirs[{index}]", entry, folder, "the scene's folder"))
        for index, entry in enumerate(table.texts("package_dirs"))
    )
    return RobotSpec(
        source=source,
        lock={joint: lock.number(joint, unit="rad or m") for joint in lock.data},
        mimic=table.choice("mimic", ("tied", "free"), "tied"),
        package_dirs=folders,
        payload=tuple(_payload(entry) for entry in table.tables("payload")),
    )


def _payload(table: Table) -> Payload:
    table.allow("frame", "mass", "com", "inertia")
    inertia: Any = 0.0
    if "inertia" in table:
        inertia = table.numbers("inertia")
        if len(inertia) == 6:
            xx, xy, xz, yy, yz, zz = inertia
            inertia = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        elif len(inertia) != 3:
            raise table.error(
                "inertia", f"must be 3 principal moments or 6 entries ixx, ixy, ixz, iyy, iyz, izz; got {len(inertia)}"
            )
    try:
        return Payload(
            frame=table.text("frame"),
            mass=table.number("mass", unit="kg", above=0.0),
            center=table.numbers("com", 3) if "com" in table else (0.0, 0.0, 0.0),
            inertia=inertia,
        )
    except InputError as error:
        raise table.error("inertia", str(error).removeprefix("payload inertia ")) from None


def _gravity(root: Table) -> bool | tuple[float, ...]:
    if isinstance(root.data.get("gravity", True), bool):
        return root.flag("gravity", True)
    if not isinstance(root.data["gravity"], list):
        raise root.error("gravity", "must be true, false or three numbers [m/s^2]")
    return root.numbers("gravity", 3)


def _force(table: Table) -> ForceSpec | FrameForceSpec:
    word = table.choice("type", (*FORCES, *FRAME_FORCES))
    if word in FRAME_FORCES:
        return _frame_force(table, word)
    kind = FORCES[word]
    own = fields(kind)
    table.allow("type", *(item.name for item in own))
    values = {item.name: table.by_name(item.name) for item in own if item.name in table or item.default is MISSING}
    return ForceSpec(kind, values, table)


def _frame_force(table: Table, word: str) -> FrameForceSpec:
    if word == "frame_wrench":
        table.allow("type", "frame", "wrench", "axes")
        point = _point(table, "frame")
        if not isinstance(point, str | tuple):
            raise table.error("frame", "must be a frame: its name, or a table of frame and place")
        axes = table.choice("axes", ("world", "frame"), "world")
        return FrameForceSpec(FrameWrench(point, table.numbers("wrench", 6), axes), table)  # type: ignore[arg-type]
    ends = _point(table, "a"), _point(table, "b")
    if word == "frame_damper":
        table.allow("type", "a", "b", "damping")
        return FrameForceSpec(FrameDamper(*ends, _along(table, "damping", "N s/m")), table)
    table.allow("type", "a", "b", "stiffness", "rest")
    rest = _along(table, "rest", "m") if "rest" in table else 0.0
    return FrameForceSpec(FrameSpring(*ends, _along(table, "stiffness", "N/m"), rest), table)


def _along(table: Table, name: str, unit: str) -> float | list[float]:
    """One number, or three along the axes of the world."""
    if isinstance(table.data.get(name), list):
        return list(table.numbers(name, 3))
    return table.number(name, unit=unit)


def _point(table: Table, name: str) -> Point:
    """A frame's name, a table of a frame and a place in it, or a place in the world."""
    value = table.require(name, "a frame's name, { frame, place } or a place in the world [m]")
    if isinstance(value, list):
        return list(table.numbers(name, 3))
    if isinstance(value, dict):
        own = table.table(name).allow("frame", "place")
        return own.text("frame"), list(own.numbers("place", 3))
    return table.text(name)


def _noise(table: Table) -> NoiseSpec:
    table.allow("type", "intensity", "center")
    kind = table.choice("type", ("additive", "control", "state"))
    if kind != "state" and "center" in table:
        raise table.error("center", f"is of state noise alone, and this is {kind} noise")
    return NoiseSpec(
        kind=kind,
        intensity=table.by_name("intensity", least=0.0),
        center=table.by_name("center", unit="rad or m") if "center" in table else None,
    )


def _horizon(table: Table) -> dict[str, Any]:
    table.allow("dt", "steps", "duration", "hold", "sampling")
    dt = table.number("dt", unit="s", above=0.0)
    if table.one_of("steps", "duration") == "steps":
        steps = table.whole("steps", least=1, most=MOST_STEPS)
    else:
        duration = table.number("duration", unit="s", above=0.0)
        steps = round(min(duration / dt, 2.0 * MOST_STEPS))
        if steps < 1 or abs(steps * dt - duration) > 1e-9 * duration:
            raise table.error("duration", f"{duration:g} s is no whole number of steps of dt = {dt:g} s")
        if steps > MOST_STEPS:
            raise table.error("duration", f"{duration:g} s has more than {MOST_STEPS} steps of {dt:g} s")
    hold = table.whole("hold", 1, least=1)
    if steps % hold:
        raise table.error("hold", f"{steps} steps are no multiple of {hold}")
    return {
        "dt": dt,
        "steps": steps,
        "hold": hold,
        "sampling": table.choice("sampling", ("gauss", "midpoint", "start"), "gauss"),
    }


# By their names in scene files, RungeKutta4 as runge_kutta_4, with the options that can be given there.
_INTEGRATORS: dict[str, tuple[Callable[..., Integrator], tuple[str, ...]]] = {
    re.sub(r"(?<!^)([A-Z0-9])", r"_\1", name).lower(): (
        kind,
        tuple(option for option in options_of(kind) if option in ("alpha", "stages", "kick")),
    )
    for name, kind in BY_NAME.items()
    if name != "Reference"
}


def _integrator(table: Table) -> Integrator:
    kind = table.choice("type", _INTEGRATORS, "gauss")
    make, names = _INTEGRATORS[kind]
    table.allow("type", *names)
    given: dict[str, Any] = {}
    if "alpha" in table:
        given["alpha"] = table.number("alpha", least=0.0, most=1.0)
    if kind == "gauss":
        given["stages"] = default_integrator().stages
    if "stages" in table:
        given["stages"] = table.whole("stages", least=1)
    if "kick" in table:
        given["kick"] = table.choice("kick", ("left", "split"))
    try:
        return make(**given)
    except InputError as error:
        raise table.error("", str(error)) from None


def _cost(table: Table, folder: Path, dt: float) -> CostSpec:
    kind = table.choice("type", TERMS)
    term = TERMS[kind]
    reference = () if term.reference is None else (term.reference,)
    frame = ("frame",) if term.frame else ()
    held = ("hold",) if term.hold else ()
    terminal = ("terminal",) if term.can_end else ()
    if "terminal" in table and not terminal:
        raise table.error("terminal", f"a term {kind!r} has no meaning at the end: there is no control there")
    table.allow("type", "weight", *reference, *frame, *held, *terminal, *term.numbers, *term.words)
    hold: ByName | None = None
    if "hold" in table:
        table.one_of(*held, *reference)
        hold = () if table.data["hold"] is True else table.by_name("hold", unit="rad or m")
    found = None
    if term.reference is not None and term.initial:
        if term.reference in table:
            found = Reference(table, term.reference, offset=table.by_name(term.reference))
    elif term.reference is not None and hold is None:
        default = 0.0 if term.optional else None
        found = read_reference(table, term.reference, folder, dt, default)
    weight = table.by_name("weight", 1.0, least=0.0)
    if len(term.axes) == 1 and not isinstance(weight, float):
        raise table.error("weight", "must be one number")
    return CostSpec(
        table=table,
        term=term,
        weight=weight,
        terminal=table.flag("terminal", False) if term.can_end else False,
        reference=found,
        hold=hold,
        frame=table.text("frame") if term.frame else "",
        numbers={name: table.number(name, default, least=0.0) for name, default in term.numbers.items()},
        words={name: table.choice(name, options, options[0]) for name, options in term.words.items()},
    )


def _options(table: Table) -> dict[str, Any]:
    table.allow("tolerance", "max_iterations", "second_order", "forward", "regularization")
    options: dict[str, Any] = {}
    if "tolerance" in table:
        options["tolerance"] = table.number("tolerance", above=0.0)
    if "max_iterations" in table:
        options["max_iterations"] = table.whole("max_iterations")
    if "second_order" in table:
        options["second_order"] = table.flag("second_order", False)
    if "forward" in table:
        options["forward"] = table.choice("forward", ("closed", "open"))
    if "regularization" in table:
        options["regularization"] = table.number("regularization", least=0.0)
    return options


def _outputs(table: Table) -> Outputs:
    table.allow("save", "plot", "html", "speed")
    endings = {"save": (".npz",), "plot": FIGURES, "html": (".html",)}
    paths: dict[str, Path | None] = {}
    for name, allowed in endings.items():
        if name not in table:
            paths[name] = None
            continue
        path = inside(table, name, table.text(name), Path.cwd(), "the working directory")
        if path.suffix.lower() not in allowed:
            raise table.error(name, f"must end in {', '.join(allowed)}, got {path.name!r}")
        paths[name] = path
    return Outputs(**paths, speed=table.number("speed", 1.0, above=0.0))


def degrees_for_radians(value: float) -> bool:
    """Whether an angle is beyond two turns either way, as degrees written for radians are."""
    return abs(value) > 4.0 * math.pi
