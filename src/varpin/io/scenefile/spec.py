"""What a scene file says, read and checked as far as that goes without the robot."""

from __future__ import annotations

import math
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from varpin.errors import FileError, InputError
from varpin.integrators import Integrator
from varpin.io.scenefile.plan_constraints import Kind
from varpin.io.scenefile.references import Reference
from varpin.io.scenefile.table import ByName, SceneFileError, Table, suggestion
from varpin.io.scenefile.terms import Term
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
from varpin.model import models_dir
from varpin.support.checks import is_file

if TYPE_CHECKING:
    from varpin.io.scenefile.tables import NoiseKeys, OutputKeys, RobotKeys


def word_of(name: str) -> str:
    """The name of a class as scene files have it: PointOnLine is point_on_line, RungeKutta4 runge_kutta_4."""
    return re.sub(r"(?<!^)([A-Z0-9])", r"_\1", name).lower()


# A motion of seven joints over so many steps takes gigabytes.
MOST_STEPS = 10**7
# Steps times terms of a cost: references are evaluated for each.
MOST_EVALUATIONS = 10**6
# Of a [[force]], by the word for it; its keys are the fields of the force, by joint.
FORCES: Mapping[str, type[Force]] = {
    "armature": Armature,
    "damper": JointDamper,
    "friction": CoulombFriction,
    "servo": PositionServo,
    "spring": JointSpring,
    "stop": JointStop,
}
# The same of forces on frames; what their fields take is in ``tables``.
FRAME_FORCES: Mapping[str, type[Force]] = {
    "frame_damper": FrameDamper,
    "frame_spring": FrameSpring,
    "frame_wrench": FrameWrench,
}
# Of a [[constraint]]: all that need no function, PointOnLine as point_on_line.
CONSTRAINTS: Mapping[str, type[Constraint]] = {
    word_of(name): kind
    for name, kind in sorted(vars(constraints).items())
    if isinstance(kind, type) and issubclass(kind, Constraint) and kind not in (Constraint, CustomConstraint)
}
FIGURES = (".png", ".pdf", ".svg")


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
class ConstraintSpec:
    """A constraint.

    Attributes:
        constraint: What the file says.
        table: Where it stands, for messages.
    """

    constraint: Constraint
    table: Table


@dataclass(frozen=True, eq=False)
class PlanConstraintSpec:
    """A hard constraint of the plan.

    Attributes:
        kind: What its type in the file means.
        given: Its keys.
        table: Where it stands, for messages.
    """

    kind: Kind
    given: Mapping[str, Any]
    table: Table


@dataclass(frozen=True, eq=False)
class CostSpec:
    """A term of the cost.

    Attributes:
        table: Where it stands.
        kind: Its type in the file.
        term: What the type means.
        weight: By component.
        terminal: At the end, instead of its integral.
        reference: Its target over time, if it has one.
        holding_q: A configuration whose holding torques are the reference, by joint; ``()`` for the initial one.
        frame: Name of a frame, for terms that have one.
        numbers: What else it takes.
        words: What else it takes.
    """

    table: Table
    kind: str
    term: Term
    weight: ByName
    terminal: bool
    reference: Reference | None
    holding_q: ByName | None
    frame: str
    numbers: Mapping[str, float]
    words: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class SceneSpec:
    """A scene file.

    Attributes:
        name: Of the file, or of the bundled scene.
        title: For people.
        path: Of the file.
        root: Its tables, for messages.
        robots: Which robot, and how it is taken; or several that are one tree.
        prefixes: Before the names of each; None for a file with one ``[robot]``.
        gravity: [m/s^2], or whether there is any.
        damping: By joint [N m s/rad or N s/m], or "robot" for the description's own; None where nothing is said.
        stiffness: Of joint springs, by joint [N m/rad or N/m].
        rest: Where springs are slack, by joint [rad or m].
        forces: Others on joints.
        frame_forces: Others on frames.
        constraints: What the motion keeps.
        plan_constraints: What the plan keeps; where there are some, no joint is left out.
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
        shape: Of a plan's controls in time: ``"held"``, or ``"linear"`` between nodes.
        integrator: The integrator; None where the file names none.
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
    robots: tuple[RobotKeys, ...]
    prefixes: tuple[str, ...] | None
    gravity: bool | tuple[float, ...]
    damping: ByName | Literal["robot"] | None
    stiffness: ByName
    rest: ByName
    forces: tuple[ForceSpec, ...]
    frame_forces: tuple[FrameForceSpec, ...]
    constraints: tuple[ConstraintSpec, ...]
    plan_constraints: tuple[PlanConstraintSpec, ...]
    actuated: tuple[str, ...] | None
    gear: ByName
    torque_limit: ByName | str | None
    noise: tuple[NoiseKeys, ...]
    q0: ByName
    v0: ByName
    dt: float
    steps: int
    hold: int
    sampling: str
    shape: str
    integrator: Integrator | None
    costs: tuple[CostSpec, ...]
    controls: Reference | str | None
    seed: int | None
    options: Mapping[str, Any]
    outputs: OutputKeys

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
    # It takes pydantic, which only whoever reads a scene has to wait for.
    from varpin.io.scenefile.tables import spec_of  # noqa: PLC0415

    try:
        data = tomllib.loads(path.read_bytes().decode("utf-8").replace("\r\n", "\n"))
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise SceneFileError(path.name, "", "it is not a text in UTF-8") from None
    except RecursionError:
        raise SceneFileError(path.name, "", "it is nested too deeply") from None
    except ValueError as error:  # tomllib lets those of Python's own numbers through
        raise SceneFileError(path.name, "", f"it is not TOML: {error}") from None
    return spec_of(data, path, path.stem if name is None else name)


def degrees_for_radians(value: float) -> bool:
    """Whether an angle is beyond two turns either way, as degrees written for radians are."""
    return abs(value) > 4.0 * math.pi
