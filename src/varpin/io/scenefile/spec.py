"""The content of a scene file, checked as far as possible without the robot."""

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
    """The name of a class in scene files: point_on_line for PointOnLine, runge_kutta_4 for RungeKutta4."""
    return re.sub(r"(?<!^)([A-Z0-9])", r"_\1", name).lower()


# Largest number of steps: a motion of seven joints over as many takes gigabytes.
MOST_STEPS = 10**7
# Largest product of steps and terms of the cost: each term evaluates its reference at each step.
MOST_EVALUATIONS = 10**6
# Forces on joints by the type of a [[force]], whose keys are the fields of the force, by joint.
FORCES: Mapping[str, type[Force]] = {
    "armature": Armature,
    "damper": JointDamper,
    "friction": CoulombFriction,
    "servo": PositionServo,
    "spring": JointSpring,
    "stop": JointStop,
}
# Forces on frames by the type of a [[force]]; the rules of their fields are in ``tables``.
FRAME_FORCES: Mapping[str, type[Force]] = {
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
FIGURES = (".png", ".pdf", ".svg")


@dataclass(frozen=True, eq=False)
class ForceSpec:
    """A force on joints.

    Attributes:
        kind: Class of the force.
        values: Its attributes by joint, those that the file gives.
        table: Its table, for messages.
    """

    kind: type[Force]
    values: Mapping[str, ByName]
    table: Table


@dataclass(frozen=True, eq=False)
class FrameForceSpec:
    """A force on frames.

    Attributes:
        force: The force.
        table: Its table, for messages.
    """

    force: Force
    table: Table


@dataclass(frozen=True, eq=False)
class ConstraintSpec:
    """A constraint.

    Attributes:
        constraint: The constraint.
        table: Its table, for messages.
    """

    constraint: Constraint
    table: Table


@dataclass(frozen=True, eq=False)
class PlanConstraintSpec:
    """A hard constraint of the plan.

    Attributes:
        kind: Kind of constraint.
        given: Values of its keys.
        table: Its table, for messages.
    """

    kind: Kind
    given: Mapping[str, Any]
    table: Table


@dataclass(frozen=True, eq=False)
class CostSpec:
    """A term of the cost.

    Attributes:
        table: Its table, for messages.
        kind: Its type in the file.
        term: The kind of term.
        weight: Weights by component.
        terminal: Whether it is a terminal cost instead of an integral over time.
        reference: Its target over time, if it has one.
        holding_q: A configuration whose holding torques are the reference, by joint; ``()`` for the initial one.
        frame: Name of its frame; empty for terms without one.
        numbers: Its other keys with numbers.
        words: Its other keys with words.
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
        name: Name of the file without its suffix.
        title: Title for reports.
        path: Path of the file.
        root: Its tables, for messages.
        robots: The tables [robot] or [[robot]]; several robots are one tree.
        prefixes: Prefix of the names of each robot; None for a file with one ``[robot]``.
        gravity: Gravity [m/s^2], or whether there is any.
        damping: Viscous damping by joint [N m s/rad or N s/m], or "robot" for that of the description; None where it is
            left out.
        stiffness: Stiffness of joint springs, by joint [N m/rad or N/m].
        rest: Rest positions of joint springs, by joint [rad or m].
        forces: Other forces on joints.
        frame_forces: Forces on frames.
        constraints: Constraints of the motion.
        plan_constraints: Hard constraints of the plan; with any, no joint is left out.
        actuated: Driven joints; None for all.
        gear: Generalized force per control, by driven joint.
        torque_limit: Bounds by driven joint [N m or N]; ``"robot"`` for those of the description; None for none.
        noise: Noise models.
        q0: Initial configuration by joint [rad or m].
        v0: Initial velocity by joint [rad/s or m/s].
        dt: Time step [s].
        steps: N.
        hold: Steps that share a control.
        sampling: Sampling of running costs.
        shape: Controls of a plan between nodes: ``"held"`` or ``"linear"``.
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


def read_scene(path: Path, name: str | None = None) -> SceneSpec:
    """Read a scene file.

    Raises:
        FileError: The file cannot be read.
        SceneFileError: There is a mistake in it.
    """
    # Imported here because pydantic loads slowly, and only scene files need it.
    from varpin.io.scenefile.tables import spec_of  # noqa: PLC0415

    try:
        data = tomllib.loads(path.read_bytes().decode("utf-8").replace("\r\n", "\n"))
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise SceneFileError(path.name, "", "it is not a text in UTF-8") from None
    except RecursionError:
        raise SceneFileError(path.name, "", "it is nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError, or an error of Python's number parsing
        raise SceneFileError(path.name, "", f"it is not TOML: {error}") from None
    return spec_of(data, path, path.stem if name is None else name)


def degrees_for_radians(value: float) -> bool:
    """Whether an angle [rad] is larger than two turns, and therefore probably in degrees."""
    return abs(value) > 4.0 * math.pi
