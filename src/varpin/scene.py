"""A scene: a robot and only what it needs around it. Gravity, dampers, springs, actuation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.checks import JointValues, as_floats, finite_array, joint_array
from varpin.core import Mechanism as Core
from varpin.core.arrays import Diffusion
from varpin.errors import InputError, RobotError
from varpin.frozen import Frozen
from varpin.markup import facts, listed
from varpin.noise import BoundNoise, Noise, bind
from varpin.robot import Robot, require_sound

Floats = NDArray[np.float64]

EARTH = (0.0, 0.0, -9.81)
# Fields of the tree that the core takes.
_TREE = (
    "parent", "prismatic", "rotation", "translation", "mass", "center", "inertia", "coordinate", "ratio", "offset",
    "origin", "loads", "carried", "periodic", "armature", "group",
)  # fmt: skip


@dataclass(frozen=True, eq=False, init=False)
class Scene(Frozen):
    """A robot in its surroundings.

    Attributes:
        robot: The arm.
        gravity: Gravity (3,) [m/s^2] in world axes.
        damping: Viscous damping (n,) [N m s/rad or N s/m]: the force -damping * v.
        stiffness: Joint springs (n,) [N m/rad or N/m]; they are part of the potential energy.
        rest: Configuration (n,) at which the springs are slack [rad or m].
        actuation: Matrix (n, m) from controls to generalized forces [N m or N per unit of control].
        noise: The diffusion fields of the noise models, if any.
    """

    robot: Robot
    gravity: Floats
    damping: Floats
    stiffness: Floats
    rest: Floats
    actuation: Floats = field(repr=False)
    noise: BoundNoise = field(repr=False)
    # Warnings that the log of this process has had: their kind, the time step [s] and the joint, if one is named.
    announced: set[tuple[str, float, int | None]] = field(repr=False)

    def __init__(
        self,
        robot: Robot,
        *,
        gravity: ArrayLike | bool = True,
        damping: JointValues = 0.0,
        stiffness: JointValues = 0.0,
        rest: JointValues = 0.0,
        actuation: ArrayLike | Sequence[str] | None = None,
        noise: Noise | Sequence[Noise] | None = None,
    ) -> None:
        """Describe a scene.

        Main args:
            robot: From :func:`varpin.load_robot`.
            gravity: ``True`` for (0, 0, -9.81), ``False`` for none, or any vector (3,) [m/s^2].
            damping: One number, (n,), or numbers by joint name, ``{"elbow": 0.1}``, >= 0 [N m s/rad or N s/m]. Joints
                that are not named have none.
            stiffness: The same, >= 0 [N m/rad or N/m].

        Other Args:
            rest: The same [rad or m]; 0 for joints that are not named.
            actuation: A matrix (n, m); or the names of the m actuated joints; every joint if left out.
            noise: A noise model, several of them, or their sum; see :mod:`varpin.noise`.

        Raises:
            InputError: A wrong shape, a value that is not finite, negative damping or stiffness.
            UnknownJoint: ``actuation``, ``damping``, ``stiffness`` or ``rest`` names a joint that is no coordinate of
                the robot.
        """
        if not isinstance(robot, Robot):
            raise InputError(f"robot must come from load_robot, got {type(robot).__name__}")
        require_sound(robot.tree)
        n = robot.dof
        if robot.tree.armature.size != n:
            raise RobotError(f"the robot's tree is damaged: it has {robot.tree.armature.size} coordinates, not {n}")
        values: dict[str, Any] = {
            "robot": robot,
            "gravity": _gravity(gravity),
            "damping": _not_negative("damping", joint_array("damping", damping, robot.joint_names, uniform=True)),
            "stiffness": _not_negative(
                "stiffness", joint_array("stiffness", stiffness, robot.joint_names, uniform=True)
            ),
            "rest": joint_array("rest", rest, robot.joint_names, uniform=True),
        }
        values["actuation"] = _actuation(robot, actuation)
        values["noise"] = bind(noise, values["actuation"], robot.joint_names)
        values["announced"] = set()
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, name, value)

    def __getstate__(self) -> dict[str, Any]:
        state = super().__getstate__()
        # Another process, or a copy, has a log of its own.
        return state | {"values": state["values"] | {"announced": set()}}

    def __repr__(self) -> str:
        parts = [f"gravity {self.gravity.tolist()}" if self.gravity.any() else "no gravity"]
        parts += [name for name in ("damping", "stiffness") if getattr(self, name).any()]
        return f"Scene({self.robot.name}: {', '.join(parts)}, {self.controls} controls)"

    def _repr_html_(self) -> str:
        names, n = self.robot.joint_names, self.robot.dof

        def of(values: Floats) -> str:
            acting = [f"{name} {value:.4g}" for name, value in zip(names, values, strict=True) if value]
            return f"{values[0]:.4g} on every joint" if len(acting) == n and np.ptp(values) == 0.0 else listed(acting)

        pulls = "none" if not self.gravity.any() else ", ".join(f"{g:g}" for g in self.gravity)
        driven = [name for name, row in zip(names, self.actuation, strict=True) if row.any()]
        rows = [
            ("joints", listed(names)),
            ("gravity [m/s^2]", pulls),
            ("damping [N m s/rad or N s/m]", of(self.damping)),
            ("springs [N m/rad or N/m]", of(self.stiffness)),
            ("driven", f"{listed(driven)} by {self.controls} controls" if driven else "none"),
            ("noise", f"{self.processes} processes" if self.processes else "none"),
        ]
        return facts(f"Scene of {self.robot.name}", rows)

    @property
    def controls(self) -> int:
        """m, the number of controls."""
        return int(self.actuation.shape[1])

    @property
    def control_joints(self) -> tuple[str, ...] | None:
        """The joint whose force each of the m controls is; None where one is anything else, a share of several say."""
        joints = np.argmax(self.actuation, axis=0)
        alone = len(set(joints.tolist())) == self.controls
        if not alone or not np.array_equal(self.actuation, np.eye(self.robot.dof)[:, joints]):
            return None
        return tuple(self.robot.joint_names[j] for j in joints)

    @property
    def processes(self) -> int:
        """k, the number of Wiener processes."""
        return self.noise.processes

    @cached_property
    def core(self) -> Core:
        """The scene as the compiled core takes it; without fields that only Python can evaluate."""
        tree, fields = self.robot.tree, self.diffusion
        return Core.make(
            **{name: getattr(tree, name) for name in _TREE},
            groups=tree.groups,
            ends=tree.ends,
            gravity=self.gravity,
            damping=self.damping,
            stiffness=self.stiffness,
            rest=self.rest,
            actuation=self.actuation,
            constant=fields.constant,
            control=fields.control,
            quadratic=fields.quadratic,
            centers=fields.center,
        )

    @property
    def diffusion(self) -> Diffusion:
        """The noise's fields that the core can evaluate; without those that only Python can."""
        n, m = self.actuation.shape
        nothing = Diffusion(np.zeros((n, 0)), np.zeros((n, 0, m)), np.zeros((n, 0)), np.zeros((n, 0)))
        return self.noise.diffusion or nothing

    @property
    def silence(self) -> Floats:
        """The increments of Wiener processes that a rollout without noise is given."""
        return np.zeros((0, 0, self.diffusion.constant.shape[1]))

    def holding_torque(self, q: JointValues) -> Floats:
        """The generalized forces (n,) that hold the robot at rest at ``q``, against gravity and springs [N m or N].

        The gradient of the potential energy, -L_q(q, 0).

        Args:
            q: Configuration, (n,) or by joint name [rad or m].

        Raises:
            InputError: A wrong shape, or a value that is not finite.
            UnknownJoint: ``q`` names a joint that is no coordinate of the robot.
        """
        at = joint_array("q", q, self.robot.joint_names)
        _, Lq, *_ = self.core.jet(at, np.zeros_like(at))
        return np.asarray(-Lq, dtype=np.float64)

    def holding_controls(self, q: JointValues) -> Floats:
        """The controls (m,) that hold the robot at rest at ``q``; of several that do, the smallest.

        Args:
            q: Configuration, (n,) or by joint name [rad or m].

        Raises:
            InputError: No controls hold it there; or as :meth:`holding_torque`.
            UnknownJoint: As :meth:`holding_torque`.
        """
        torque = self.holding_torque(q)
        controls = closest_controls(self, torque)
        left = torque - self.actuation @ controls
        # Where nothing pulls, rounding leaves a trace of the weights' own moments, those at a metre say.
        weight = float(self.robot.tree.mass.sum() * np.linalg.norm(self.gravity))
        if (np.abs(left) > 1e-9 * (np.abs(torque).max() + weight)).any():
            c = int(np.argmax(np.abs(left)))
            raise InputError(
                f"no controls hold the robot at this q: joint {self.robot.joint_names[c]!r} is left with {left[c]:.4g} "
                "N m or N that no actuator takes"
            )
        return controls


def closest_controls(scene: Scene, torque: Floats) -> Floats:
    """The controls (m,) whose forces come closest to ``torque`` (n,) [N m or N]; of several that do, the smallest."""
    return np.asarray(np.linalg.lstsq(scene.actuation, torque, rcond=None)[0], dtype=np.float64)


def require_scene(scene: object) -> Scene:
    """``scene`` itself, or an InputError that says what it is instead."""
    if not isinstance(scene, Scene):
        raise InputError(f"scene must be a varpin.Scene, got {type(scene).__name__}")
    return scene


def _gravity(gravity: ArrayLike | bool) -> Floats:
    """Gravity (3,) from what a user gives."""
    if isinstance(gravity, bool | np.bool_):
        return np.array(EARTH if gravity else (0.0, 0.0, 0.0))
    given = as_floats("gravity", gravity)
    if given.ndim == 0 and np.isfinite(given):
        meant = f"({', '.join(f'{g:g}' for g in (0.0, 0.0, -abs(float(given))))})" if given else "False"
        raise InputError(
            f"gravity is a vector in world axes, z up [m/s^2], got the number {float(given):g}; did you mean "
            f"gravity={meant}?"
        )
    return finite_array("gravity", given, (3,))


def _not_negative(name: str, values: Floats) -> Floats:
    if (values < 0.0).any():
        c = int(np.argmax(values < 0.0))
        raise InputError(f"{name}[{c}] is {values[c]}; it must be >= 0")
    return values


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
