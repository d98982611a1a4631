"""The arguments of a scene: what they mean for its robot, and what is refused."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import count
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.core.arrays import Coupling, Element, Tied
from varpin.errors import InputError
from varpin.mechanics.constraints import Bound, Constraint, KinematicInput
from varpin.mechanics.custom import CustomForce, CustomForces
from varpin.mechanics.description import description_constraints
from varpin.mechanics.forces import (
    SUMMED,
    CoulombFriction,
    Force,
    JointDamper,
    JointSpring,
    bound_force,
    of_kind,
    refuse_where,
)
from varpin.model import Robot
from varpin.support.checks import JointValues, as_floats, finite_array, is_one_of, joint_array, tuple_of

logger = logging.getLogger(__name__)


def gravity_of(gravity: ArrayLike | bool, robot: Robot) -> Floats:
    """Gravity (3,) [m/s^2] from the argument of a scene."""
    if isinstance(gravity, bool | np.bool_):
        return finite_array("gravity of the robot", robot.model.gravity.linear, (3,)) if gravity else np.zeros(3)
    given = as_floats("gravity", gravity)
    if given.ndim == 0 and np.isfinite(given):
        meant = f"({', '.join(f'{g:g}' for g in (0.0, 0.0, -abs(float(given))))})" if given else "False"
        raise InputError(
            f"gravity is a vector in world axes, z up [m/s^2], got the number {float(given):g}; did you mean "
            f"gravity={meant}?"
        )
    return finite_array("gravity", given, (3,))


def _warn_of_description(robot: Robot, name: str, what: str, *, gives: bool, asked: bool, decided: bool) -> None:
    """Log that the description gives nothing where it is asked for, or something that nobody decided about."""
    if asked and not gives:
        logger.warning("robot %r: %s='robot' is none, because the description gives none", robot.name, name)
    if gives and not (asked or decided):
        message = "robot %r: the scene leaves out the %s of its description: %s='robot' takes it, %s=%s silences this"
        logger.warning(message, robot.name, what, name, name, 0 if name == what else "()")


def given_constraints(
    robot: Robot, given: Constraint | Sequence[Constraint | Literal["robot"]] | Literal["robot"] | None
) -> tuple[Constraint, ...]:
    """The constraints from the argument of a scene, with those of the robot's description in place of ``"robot"``."""
    parts: Any = ("robot",) if is_one_of(given, ("robot",)) else () if given is None else given
    if asked := isinstance(parts, list | tuple) and any(is_one_of(part, ("robot",)) for part in parts):
        if [is_one_of(part, ("robot",)) for part in parts].count(True) > 1:
            raise InputError("constraints has 'robot' twice")
        own = description_constraints(robot)
        parts = [each for part in parts for each in (own if is_one_of(part, ("robot",)) else (part,))]
    note = "; those of a plan, such as limits and obstacles, belong to varpin.OptimalControlProblem(constraints=)"
    found = tuple_of("constraints", parts, Constraint, note)
    # Kinematic inputs alone are no decision on those of the description.
    decided = given is not None and not (found and all(isinstance(part, KinematicInput) for part in found))
    gives = bool(robot.equalities)
    _warn_of_description(robot, "constraints", "equality constraints", gives=gives, asked=asked, decided=decided)
    return found


def acting_forces(
    robot: Robot,
    forces: Force | Sequence[Force],
    damping: JointValues | Literal["robot"] | None,
    friction: JointValues | Literal["robot"] | None,
    stiffness: JointValues,
    rest: JointValues,
) -> dict[str, Any]:
    """The attributes of a scene that follow from its forces, by name."""
    given: tuple[Force, ...] = tuple_of("forces", forces, Force)
    kinds = {type(force) for force in given}

    def resistance(name: str, value: Any, own: Floats, *, decided: bool) -> JointValues:
        asked = isinstance(value, str)
        if asked and value != "robot":
            raise InputError(f"{name} must be numbers, or 'robot' for those of the robot's description, got {value!r}")
        _warn_of_description(robot, name, name, gives=bool(own.any()), asked=asked, decided=decided)
        numbers: JointValues = own if asked else 0.0 if value is None else value
        return numbers

    viscous = resistance("damping", damping, robot.damping, decided=damping is not None or JointDamper in kinds)
    # Numbers for the damping are a decision on the dry friction, too.
    decided = friction is not None or not (damping is None or is_one_of(damping, ("robot",)))
    level = resistance("friction", friction, robot.friction, decided=decided or CoulombFriction in kinds)
    dry = joint_array("friction", level, robot.joint_names, uniform=True)
    # Its force would call it the level.
    refuse_where("friction", dry, dry < 0.0, "must be >= 0")
    short: tuple[Force, ...] = (JointSpring(stiffness, rest), JointDamper(viscous), CoulombFriction(dry))
    acting = [(force, parts) for force in short if (parts := force.bind(robot))]
    acting += [(force, bound_force(force, robot)) for force in given]
    given = tuple(force for force, _ in acting)
    bound = [each for _, parts in acting for each in parts]
    elements = [each for each in bound if isinstance(each, Element)]
    own_code = tuple(force for force in given if isinstance(force, CustomForce))
    total = {kind: np.zeros(robot.dof) for kind in SUMMED}
    for element in elements:
        if element.kind in total:
            total[element.kind][element.coordinate] += element.values[0]
    slack = np.zeros(robot.dof)
    for c in np.flatnonzero(total["JointSpring"]):
        springs = [element.values for element in of_kind(elements, "JointSpring") if element.coordinate == c]
        first = springs[0][1]
        slack[c] = first + sum(stiffness * (rest - first) for stiffness, rest in springs) / total["JointSpring"][c]
    return {
        "forces": given,
        "elements": tuple(element for element in elements if element.kind != "Armature"),
        "couplings": tuple(each for each in bound if isinstance(each, Coupling)),
        "custom": CustomForces(own_code) if own_code else None,
        "damping": total["JointDamper"],
        "stiffness": total["JointSpring"],
        "rest": slack,
        "armature": robot.tree.armature + total["Armature"],
    }


def is_input(tie: Tied) -> bool:
    """Whether a tie is a :class:`KinematicInput`."""
    return tie.follower == tie.leader and not tie.coefficients


def driven(
    robot: Robot, actuation: ArrayLike | Sequence[str] | None, elements: Sequence[Element], bound: Bound
) -> tuple[Floats, Bound]:
    """The matrix from controls to forces, and the constraints with the columns of the controls of cubic inputs.

    Columns of servos are multiplied by their stiffness. Columns of zeros follow, for the velocities of cubic inputs.

    Raises:
        InputError: A joint has two servos or kinematic inputs, or one without a control of its own with factor 1.
    """
    matrix = _actuation(robot, actuation)
    scaled, taken = matrix.copy(), set()
    drives = [(servo.coordinate, servo.values[0], "PositionServo") for servo in of_kind(elements, "PositionServo")]
    drives += [(tie.follower, 1.0, "KinematicInput") for tie in bound.rows.ties if is_input(tie)]
    for c, stiffness, what in drives:
        joint, columns = robot.joint_names[c], np.flatnonzero(matrix[c])
        if c in taken:
            raise InputError(f"joint {joint!r} has more than one PositionServo or KinematicInput")
        if not (len(columns) == 1 and np.array_equal(matrix[:, columns[0]], np.eye(robot.dof)[c])):
            raise InputError(
                f"the {what} of joint {joint!r} needs a control of its own, and no column of the actuation has a 1 at "
                "this joint and zeros elsewhere"
            )
        taken.add(c)
        scaled[c, columns] = stiffness
    columns_of_rates = count(matrix.shape[1])
    ties = tuple(tie._replace(rate=next(columns_of_rates)) if tie.rate >= 0 else tie for tie in bound.rows.ties)
    added = np.zeros((robot.dof, next(columns_of_rates) - matrix.shape[1]))
    return np.hstack([scaled, added]), bound._replace(rows=bound.rows._replace(ties=ties))


def _actuation(robot: Robot, actuation: ArrayLike | Sequence[str] | None) -> Floats:
    n = robot.dof
    if actuation is None:
        return np.eye(n)
    if isinstance(actuation, str):
        actuation = [actuation]
    if isinstance(actuation, Sequence) and all(isinstance(name, str) for name in actuation):
        names = [str(name) for name in actuation]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(f"actuation names {', '.join(map(repr, twice))} more than once")
        return np.eye(n)[:, [robot.coordinate(name) for name in names]].copy()
    matrix = as_floats("actuation", actuation)
    if matrix.ndim != 2:
        raise InputError(f"actuation must be a matrix with {n} rows, or joint names, got shape {matrix.shape}")
    return finite_array("actuation", matrix, (n, matrix.shape[1]))
