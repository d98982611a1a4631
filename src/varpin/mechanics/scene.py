"""A scene: a robot and only what it needs around it. Gravity, forces on joints, actuation, noise.

Equation (1.1) of the paper.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.core import Mechanism as Core
from varpin.core.arrays import ConstraintRows, Coupling, Diffusion, Element
from varpin.errors import InputError, RobotError
from varpin.mechanics.constraints import Bound, Constraint, CustomConstraint, constraints_of, joined
from varpin.mechanics.custom import CustomForce, CustomForces
from varpin.mechanics.forces import (
    CoulombFriction,
    Force,
    JointDamper,
    JointSpring,
    dissipates,
    forces_of,
    keeps_energy,
    not_negative,
    of_kind,
)
from varpin.mechanics.noise import BoundNoise, ControlNoise, Noise, NoiseSum, bind
from varpin.model import Robot, require_sound
from varpin.model.tree import block_ends, path_coordinates
from varpin.support.checks import JointValues, as_floats, finite_array, joint_array
from varpin.support.frozen import Frozen
from varpin.support.markup import facts, listed
from varpin.support.weak import Weak

Floats = NDArray[np.float64]

logger = logging.getLogger(__name__)

# What a scene's values are called, and what is said where they are others; of joints, numbers are given.
VALUES = {
    "gravity": "gravity is another",
    "damping": "damping is another",
    "stiffness": "stiffness is another",
    "rest": "rest is another",
    "armature": "armature is another",
    "actuation": "actuation is another",
    "center": "the robot's centres of mass are others",
    "inertia": "the robot's inertias are others",
    "rotation": "the robot's joints have other axes",
    "translation": "the robot's joints are in other places",
    "ratio": "the robot's mimic joints are tied otherwise",
    "offset": "the robot's mimic joints are tied otherwise",
    "CoulombFriction": "dry friction is another",
    "JointStop": "joint stops are others",
    "PositionServo": "position servos are others",
    "FrameLoad": "forces on frames are others",
    "FrameWrench": "forces on frames are others",
    "FrameSpring": "springs between frames are others",
    "FrameLengthSpring": "springs between frames are others",
    "FrameTurnSpring": "springs between frames are others",
    "FrameDamper": "dampers between frames are others",
    "FrameTurnDamper": "dampers between frames are others",
    "functions": "forces that are functions are others",
    "constraints.between": "constraints between frames are others",
    "constraints.ties": "ties of joints are others",
    "constraints.custom": "custom constraints are others",
    "noise.constant": "the noise has another strength",
    "noise.control": "the noise has another strength",
    "noise.quadratic": "the noise has another strength",
    "noise.center": "the noise has another center",
}
# Kinds of forces that have an entry of their own, a row of the coordinate and the numbers for each element.
OF_ELEMENTS = ("CoulombFriction", "JointStop", "PositionServo")
# The same of couplings, with the bodies of both ends; entries are there only if couplings are.
OF_COUPLINGS = (
    "FrameLoad", "FrameWrench", "FrameSpring", "FrameLengthSpring", "FrameTurnSpring", "FrameDamper", "FrameTurnDamper",
)  # fmt: skip
# The same of constraints.
OF_CONSTRAINTS = ("constraints.between", "constraints.ties", "constraints.custom")
OF_FORCES = (*OF_ELEMENTS, *OF_COUPLINGS, *OF_CONSTRAINTS)
# What a configuration that is said to keep constraints may miss them by, and a start to be moved onto them unasked
# [m or rad]; and the singular values, relative to the largest, of rows that depend on others.
_OFF, CORRECTED, _DEPENDENT = 1e-6, 0.02, 1e-9
# So many joints are told of with numbers.
_NAMED = 7
_OF_JOINTS = ("damping", "stiffness", "rest", "armature")
EARTH = (0.0, 0.0, -9.81)
# Fields of the tree that the core takes.
_TREE = (
    "parent", "prismatic", "rotation", "translation", "mass", "center", "inertia", "coordinate", "ratio", "offset",
    "origin", "loads", "carried", "periodic",
)  # fmt: skip


# How far a joint may go into a stop, in units of the width over which that becomes stiff.
_GIVES = 2.0


class Bounds(NamedTuple):
    """Least and greatest position, velocity and force (n,) of the joints; infinite where there is no limit."""

    position: tuple[Floats, Floats]  # [rad or m]
    velocity: tuple[Floats, Floats]  # [rad/s or m/s]
    effort: tuple[Floats, Floats]  # [N m or N]


@dataclass(frozen=True, eq=False, init=False)
class Scene(Frozen):
    """A robot in its surroundings.

    Attributes:
        robot: The arm.
        gravity: Gravity (3,) [m/s^2] in world axes.
        forces: What acts on joints and frames, ``damping`` and ``stiffness`` among it.
        elements: What of it acts on single joints, one by one, as the core takes it, armature apart.
        couplings: What of it acts on frames and between them.
        custom: What of it is a :class:`varpin.CustomForce`, together; None for none.
        damping: Viscous damping (n,) of all dampers [N m s/rad or N s/m]: the force -damping * v.
        stiffness: Of all joint springs (n,) [N m/rad or N/m]; they are part of the potential energy.
        rest: Configuration (n,) at which the springs are slack, those of a joint taken together [rad or m].
        armature: Inertia of rotors (n,), the robot's own and that of ``forces`` [kg m^2 or kg].
        actuation: Matrix (n, m) from controls to generalized forces [N m or N per unit of control]; of a position
            servo's control, its stiffness; zero for velocities of cubic inputs, its last columns.
        noise: The diffusion fields of the noise models, if any.
        constraints: What the motion keeps, g(q) = 0; see :mod:`varpin.mechanics.constraints`.
    """

    robot: Robot
    gravity: Floats
    forces: tuple[Force, ...]
    elements: tuple[Element, ...] = field(repr=False)
    couplings: tuple[Coupling, ...] = field(repr=False)
    custom: CustomForces | None = field(repr=False)
    damping: Floats
    stiffness: Floats
    rest: Floats
    armature: Floats = field(repr=False)
    actuation: Floats = field(repr=False)
    noise: BoundNoise = field(repr=False)
    constraints: tuple[Constraint, ...]
    # The same as the core takes them, and the place there of each of their rows (c,).
    bound_constraints: Bound = field(repr=False)
    constraint_order: NDArray[np.int64] = field(repr=False)
    # Warnings that the log of this process has had: their kind, the time step [s] and the joint, if one is named.
    announced: set[tuple[str, float, int | None]] = field(repr=False)

    def __init__(
        self,
        robot: Robot,
        *,
        gravity: ArrayLike | bool = True,
        forces: Force | Sequence[Force] = (),
        damping: JointValues | Literal["robot"] | None = None,
        stiffness: JointValues = 0.0,
        rest: JointValues = 0.0,
        actuation: ArrayLike | Sequence[str] | None = None,
        noise: Noise | Sequence[Noise] | None = None,
        constraints: Constraint | Sequence[Constraint] = (),
    ) -> None:
        """Describe a scene.

        Main args:
            robot: From :func:`varpin.load_robot`.
            gravity: ``True`` for (0, 0, -9.81), ``False`` for none, or any vector (3,) [m/s^2].
            forces: What acts on the joints: friction, stops, rotors, springs, dampers, servos, as
                :class:`varpin.CoulombFriction` does; and on frames: wrenches, springs and dampers, as
                :class:`varpin.FrameSpring` does.
            damping: Short for a :class:`varpin.JointDamper` in ``forces``: one number, (n,), or numbers by joint name,
                ``{"elbow": 0.1}``, >= 0 [N m s/rad or N s/m]. Joints that are not named have none. ``"robot"`` takes
                what the robot's description gives (:attr:`varpin.Robot.damping`). Left out there is none, and where
                the description gives damping or dry friction the log says so.
            stiffness: Short for a :class:`varpin.JointSpring`: the same, >= 0 [N m/rad or N/m].

        Other Args:
            rest: Where that spring is slack, the same [rad or m]; 0 for joints that are not named.
            actuation: A matrix (n, m); or the names of the m actuated joints; every joint if left out.
            noise: A noise model, several of them, or their sum; see :mod:`varpin.mechanics.noise`.
            constraints: What the motion keeps: loops that close, gears, rods, as :class:`varpin.PointOnPoint` does.

        Raises:
            InputError: A wrong shape, a value that is not finite, negative damping or stiffness, a force that does not
                fit the robot.
            UnknownJoint: ``actuation``, ``damping``, ``stiffness``, ``rest`` or one of ``forces`` names a joint that is
                no coordinate of the robot.
            UnknownFrame: One of ``forces`` names a frame that the robot does not have.
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
        }
        values |= _forces(robot, forces, damping, stiffness, rest)
        values["actuation"] = _served(robot, _actuation(robot, actuation), values["elements"])
        _refuse_trembling_angles(noise, values["elements"], robot)
        values["constraints"] = constraints_of(constraints)
        bound, order = joined([constraint.bind(robot) for constraint in values["constraints"]])
        _require_positions(robot, values["actuation"], values["elements"], bound)
        values["actuation"], bound = _with_rates(values["actuation"], bound)
        values["noise"] = bind(noise, values["actuation"], robot.joint_names)
        values |= {"bound_constraints": bound, "constraint_order": order, "announced": set()}
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
        parts += [name for name, _ in self._other_forces()]
        parts += [type(constraint).__name__ for constraint in self.constraints]
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
            *((f"{name} on", listed(acting)) for name, acting in self._other_forces()),
            *(("constraint", repr(constraint)) for constraint in self.constraints),
            ("driven", f"{listed(driven)} by {self.controls} controls" if driven else "none"),
            ("noise", f"{self.processes} processes" if self.processes else "none"),
        ]
        return facts(f"Scene of {self.robot.name}", rows)

    def _other_forces(self) -> list[tuple[str, list[str]]]:
        """Kinds of forces besides springs and dampers, with the joints that they act on."""
        acting: dict[str, dict[str, None]] = {}
        for force in self.forces:
            if not isinstance(force, JointSpring | JointDamper):
                joints = acting.setdefault(type(force).__name__, {})
                if isinstance(force, CustomForce):
                    joints |= dict.fromkeys(self.robot.joint_names)
                    continue
                joints |= dict.fromkeys(self.robot.joint_names[c] for c in self._moved_by(force.bind(self.robot)))
        return [(kind, list(joints)) for kind, joints in acting.items()]

    def _moved_by(self, bound: Sequence[Element | Coupling]) -> list[int]:
        """The coordinates that forces act on."""
        found: set[int] = set()
        for each in bound:
            if isinstance(each, Element):
                found.add(each.coordinate)
            else:
                found.update(*(path_coordinates(self.robot.tree, body).tolist() for body in (each.a, each.b)))
        return sorted(found)

    @property
    def dissipates(self) -> bool:
        """Whether anything turns energy into heat."""
        damped = any(map(dissipates, self.elements)) or any(map(dissipates, self.couplings))
        return damped or self.custom is not None

    @property
    def conservative(self) -> bool:
        """Whether energy stays where no controls and no noise act: all forces are gradients."""
        return not self.dissipates and all(map(keeps_energy, self.couplings))

    @cached_property
    def group(self) -> NDArray[np.int64]:
        """Which coordinates (n,) move each other, labels from 0: the robot's groups, some joined by couplings."""
        group = self.robot.tree.group.copy()
        if self.custom is not None:
            # Nobody knows which joints the function joins.
            group[:] = 0
        for coupling in self.couplings:
            together = np.unique(group[self._moved_by([coupling])])
            group[np.isin(group, together)] = together[0]
        for coordinates in self._constrained():
            together = np.unique(group[coordinates])
            group[np.isin(group, together)] = together[0]
        label: NDArray[np.int64] = np.unique(group, return_inverse=True)[1].astype(np.int64)
        label.setflags(write=False)
        return label

    @property
    def open_loops(self) -> tuple[tuple[str, str], ...]:
        """Loops of the robot's description, :attr:`Robot.loops`, where no constraint can close one."""
        closes = any(hasattr(own, "a") or isinstance(own, CustomConstraint) for own in self.constraints)
        return () if closes else self.robot.loops

    def _constrained(self) -> list[list[int]]:
        """The coordinates of each constraint row."""
        tree, rows = self.robot.tree, self.bound_constraints.rows
        found = []
        for product in rows.products:
            parts = (*rows.vectors[product.x], *rows.vectors[product.y])
            found.append(sorted({int(c) for part in parts for c in path_coordinates(tree, part.body)}))
        found += [[tie.follower, tie.leader] for tie in rows.ties]
        return found + [list(range(self.robot.dof)) for _ in rows.customs]

    @property
    def constraint_labels(self) -> tuple[str, ...]:
        """What each row of the constraints is (c,), in words."""
        return tuple(self.bound_constraints.labels[row] for row in self.constraint_order)

    def constraint_values(self, q: JointValues) -> tuple[Floats, Floats]:
        """g(q) (c,) [m or rad] and dg/dq (c, n) of the constraints.

        Args:
            q: Configuration, (n,) or by joint name [rad or m].

        Raises:
            InputError: A wrong shape, or a value that is not finite.
            UnknownJoint: ``q`` names a joint that is no coordinate of the robot.
        """
        at = joint_array("q", q, self.robot.joint_names)
        g, _, C = self.core.constraints(at[None])
        g[:, list(self.inputs)] = 0.0
        return g[0, self.constraint_order], C[0, self.constraint_order]

    @cached_property
    def inputs(self) -> Mapping[int, int]:
        """Joints that are moved by hand: the coordinate of each by the core's row of its :class:`KinematicInput`."""
        rows = self.bound_constraints.rows
        return {
            len(rows.products) + k: tie.follower
            for k, tie in enumerate(rows.ties)
            if tie.follower == tie.leader and not tie.coefficients
        }

    @cached_property
    def rates(self) -> tuple[int, ...]:
        """For each of :attr:`inputs`, the control that is its velocity at the end of a step; -1 for one on a line."""
        return tuple(tie.rate for tie in self.bound_constraints.rows.ties if tie.follower == tie.leader)

    @cached_property
    def transmission(self) -> Floats:
        """From controls (m,) to what steps are differentiated in: forces (n,), and of cubic inputs velocities."""
        rates = [rate for rate in self.rates if rate >= 0]
        if not rates:
            return self.actuation
        return np.vstack([self.actuation, np.eye(self.controls)[rates]])

    @property
    def _gear(self) -> Floats:
        """Force (n,) of a control that is one joint's alone: 1, or the stiffness of its servo."""
        gear = np.ones(self.robot.dof)
        for servo in of_kind(self.elements, "PositionServo"):
            gear[servo.coordinate] = servo.values[0]
        return gear

    @property
    def controls(self) -> int:
        """m, the number of controls."""
        return int(self.actuation.shape[1])

    @cached_property
    def control_joints(self) -> tuple[str, ...] | None:
        """The joint whose force, or servo's position, each of the m controls is; None where one is anything else.

        A share of several, say.
        """
        joints = np.argmax(self.actuation, axis=0)
        alone = len(set(joints.tolist())) == self.controls
        if not alone or not np.array_equal(self.actuation, np.diag(self._gear)[:, joints]):
            return None
        return tuple(self.robot.joint_names[j] for j in joints)

    @cached_property
    def servo_joints(self) -> tuple[str, ...]:
        """The joints whose control is the position that a servo goes to."""
        return tuple(self.robot.joint_names[servo.coordinate] for servo in of_kind(self.elements, "PositionServo"))

    def command_at(self, q: Floats) -> Floats:
        """The controls (m,) that stand for none at q (n,): no forces; servos and inputs stay where they are."""
        command = np.zeros(self.controls)
        for servo in of_kind(self.elements, "PositionServo"):
            command[int(np.argmax(np.abs(self.actuation[servo.coordinate])))] = q[servo.coordinate]
        for c in self.inputs.values():
            command[int(np.argmax(self.actuation[c]))] = q[c]
        return command

    @property
    def processes(self) -> int:
        """k, the number of Wiener processes."""
        return self.noise.processes

    @cached_property
    def core(self) -> Core:
        """The scene as the compiled core takes it; without fields that only Python can evaluate."""
        tree, fields = self.robot.tree, self.diffusion
        values = {name: getattr(tree, name) for name in _TREE}
        if self.constraints:
            values |= self._of_constrained_tree()
        return Core.make(
            **values,
            group=self.group,
            groups=int(self.group.max()) + 1,
            ends=np.array([self.robot.dof]) if self.constraints else block_ends(self.group),
            armature=self.armature,
            gravity=self.gravity,
            forces=self.elements,
            couplings=self.couplings,
            constraints=_unowned(self.bound_constraints.rows),
            custom=None if self.custom is None else Weak(self.custom),
            actuation=self.actuation,
            constant=fields.constant,
            control=fields.control,
            quadratic=fields.quadratic,
            centers=fields.center,
        )

    def _of_constrained_tree(self) -> dict[str, NDArray[np.int64]]:
        """What of the tree is another under constraints."""
        tree, rows = self.robot.tree, self.bound_constraints.rows
        # Constraints do work on a light part, whose energy has no balance of its own then.
        changed = {"loads": tree.loads[:0], "carried": tree.carried[:0]}
        # A tie knows how often a joint went round; so may a function.
        periodic = tree.periodic.copy()
        periodic[[c for tie in rows.ties for c in (tie.follower, tie.leader)]] = 0
        if rows.customs:
            periodic[:] = 0
        return changed | {"periodic": periodic}

    @cached_property
    def bounds(self) -> Bounds:
        """What the robot's description lets its joints do, and how far stops let them go."""
        lower, upper = self.robot.position_limits
        # Limits that leave no room are a fault of the description, which inspect_robot tells of.
        none = ~(lower < upper)
        lower, upper = np.where(none, -np.inf, lower), np.where(none, np.inf, upper)
        for stop in of_kind(self.elements, "JointStop"):
            # What goes on against a stop is no motion that nothing stops, as far as the stop does not give way.
            c, (first, last, *_, width) = stop.coordinate, stop.values
            lower[c] = min(lower[c], first - _GIVES * width) if first > lower[c] - width else lower[c]
            upper[c] = max(upper[c], last + _GIVES * width) if last < upper[c] + width else upper[c]
        speed, effort = self.robot.velocity_limit, self.robot.effort_limit
        return Bounds((lower, upper), (-speed, speed), (-effort, effort))

    @cached_property
    def bounded(self) -> tuple[bool, ...]:
        """Whether any joint has bounds, of each kind in :class:`Bounds`."""
        return tuple(bool(np.isfinite(pair).any()) for pair in self.bounds)

    @cached_property
    def diffusion(self) -> Diffusion:
        """The noise's fields that the core can evaluate; without those that only Python can."""
        n, m = self.actuation.shape
        nothing = Diffusion(np.zeros((n, 0)), np.zeros((n, 0, m)), np.zeros((n, 0)), np.zeros((n, 0)))
        return self.noise.diffusion or nothing

    @cached_property
    def values(self) -> Mapping[str, Floats]:
        """The numbers that its motions depend on, by the names of :data:`VALUES`: a motion keeps them.

        Of the noise, strengths (n, k), for which its share of the controls is summed up; nothing of a
        :class:`varpin.CustomNoise`.
        """
        tree, values = (
            self.robot.tree,
            {name: getattr(self, name) for name in ("gravity", "damping", "stiffness", "rest")},
        )
        values |= {
            "actuation": self.actuation,
            "armature": self.armature,
            "center": tree.center,
            "inertia": tree.inertia,
        }
        for kind in OF_ELEMENTS:
            rows = [(each.coordinate, *each.values) for each in of_kind(self.elements, kind)]
            values[kind] = np.array(rows) if rows else np.zeros((0, 0))
        for kind in OF_COUPLINGS:
            if ends := [(each.a, each.b, *each.values) for each in self.couplings if each.kind == kind]:
                values[kind] = np.array(ends, dtype=np.float64)
        if self.custom is not None:
            # Of functions nothing but how many there are.
            values["functions"] = np.array([float(len(self.custom.parts))])
        values |= _numbers_of(self.bound_constraints.rows)
        values |= {"rotation": tree.rotation, "translation": tree.translation}
        values |= {"ratio": tree.ratio, "offset": tree.offset}
        if self.noise.diffusion is not None:
            fields = self.noise.diffusion
            values |= {"noise.constant": fields.constant, "noise.control": np.linalg.norm(fields.control, axis=2)}
            values |= {"noise.quadratic": fields.quadratic, "noise.center": fields.center}
        return MappingProxyType(values)

    @cached_property
    def silence(self) -> Floats:
        """The increments of Wiener processes that a rollout without noise is given."""
        none = np.zeros((0, 0, self.diffusion.constant.shape[1]))
        none.setflags(write=False)
        return none

    @cached_property
    def no_drift(self) -> Floats:
        """What a rollout is given that has no force on top of the controls'."""
        none = np.zeros((0, 0, self.robot.dof))
        none.setflags(write=False)
        return none

    def holding_torque(self, q: JointValues) -> Floats:
        """The generalized forces (n,) that hold the robot at rest at ``q`` [N m or N].

        Against gravity and springs, the gradient of the potential energy, -L_q(q, 0), and against wrenches on frames.
        Constraints take what is normal to them; of the forces that hold the robot together with them, the smallest.

        Args:
            q: Configuration, (n,) or by joint name [rad or m]; it keeps the constraints.

        Raises:
            InputError: A wrong shape, a value that is not finite, or a configuration off the constraints.
            UnknownJoint: ``q`` names a joint that is no coordinate of the robot.
        """
        at = joint_array("q", q, self.robot.joint_names)
        along = tangent_basis(self, at)
        return along @ (along.T @ self.static_pull(at))

    def static_pull(self, q: Floats) -> Floats:
        """What holds the robot at rest at ``q`` (n,) without constraints (n,)."""
        at = np.asarray(q, dtype=np.float64)
        _, Lq, *_ = self.core.jet(at, np.zeros_like(at))
        acts = self.couplings or self.custom is not None
        wrenches = self.core.coupled_forces(at[None], np.zeros((1, at.size)))[0][0] if acts else 0.0
        return np.asarray(-Lq - wrenches, dtype=np.float64)

    def holding_controls(self, q: JointValues) -> Floats:
        """The controls (m,) that hold the robot at rest at ``q``; of several that do, the smallest.

        Args:
            q: Configuration, (n,) or by joint name [rad or m].

        Raises:
            InputError: No controls hold it there; or as :meth:`holding_torque`.
            UnknownJoint: As :meth:`holding_torque`.
        """
        at = joint_array("q", q, self.robot.joint_names)
        torque = self.holding_torque(at)
        controls = closest_controls(self, at)
        force = self.actuation @ controls
        still = at[None], np.zeros((1, at.size))
        # Wrenches on frames are in both.
        drives = self.core.forces(*still, force[None])[0][0] - self.core.coupled_forces(*still)[0][0]
        along = tangent_basis(self, at)
        left = along @ (along.T @ (torque - force - drives))
        # Where nothing pulls, rounding leaves a trace of the weights' own moments, those at a metre say.
        weight = float(self.robot.tree.mass.sum() * np.linalg.norm(self.gravity))
        if (np.abs(left) > 1e-9 * (np.abs(torque).max() + weight)).any():
            c = int(np.argmax(np.abs(left)))
            raise InputError(
                f"no controls hold the robot at this q: joint {self.robot.joint_names[c]!r} is left with {left[c]:.4g} "
                "N m or N that no actuator takes"
            )
        return controls


def _unowned(rows: ConstraintRows) -> ConstraintRows:
    """Rows whose functions the scene keeps, and not the core."""
    return rows._replace(
        customs=tuple(own._replace(value=Weak(own.value), curvature=Weak(own.curvature)) for own in rows.customs)
    )


def _numbers_of(rows: ConstraintRows) -> dict[str, Floats]:
    """The numbers of constraints by the names of :data:`VALUES`, none where there are no such rows."""
    found: dict[str, Floats] = {}
    if rows.products:
        table = []
        for product in rows.products:
            numbers = [product.factor, product.constant]
            for factor in (rows.vectors[product.x], rows.vectors[product.y]):
                for part in factor:
                    numbers += [part.body, float(part.direction), *part.place]
                numbers += [-2.0, 0.0, 0.0, 0.0, 0.0] * (2 - len(factor))
            table.append(numbers)
        found["constraints.between"] = np.array(table)
    if rows.ties:
        most = max(len(tie.coefficients) for tie in rows.ties)
        found["constraints.ties"] = np.array(
            [
                [tie.follower, tie.leader, *tie.coefficients, *[0.0] * (most - len(tie.coefficients))]
                for tie in rows.ties
            ],
            dtype=np.float64,
        )
        if any(tie.rate >= 0 for tie in rows.ties):
            rates = np.array([[float(tie.rate)] for tie in rows.ties])
            found["constraints.ties"] = np.hstack([found["constraints.ties"], rates])
    if rows.customs:
        found["constraints.custom"] = np.array([[float(factor.rows)] for factor in rows.customs])
    return found


_KEEPS = "motions and plans do, with varpin.Midpoint() or varpin.Gauss(stages)"


def refuse_constraints(scene: Scene, what: str, instead: str = _KEEPS) -> None:
    """Refuse a scene with constraints where they would not be kept; ``instead`` says what takes them.

    Raises:
        InputError: The scene has constraints.
    """
    if scene.constraints:
        names = ", ".join(dict.fromkeys(type(constraint).__name__ for constraint in scene.constraints))
        raise InputError(f"{what} does not take scenes with constraints, and this one has {names}: {instead}")


def refuse_inputs(scene: Scene, what: str) -> None:
    """Refuse a scene with joints that are moved by hand where that is not known.

    Raises:
        InputError: It has some.
    """
    if scene.inputs:
        names = ", ".join(scene.robot.joint_names[c] for c in scene.inputs.values())
        raise InputError(
            f"{what} does not take scenes with a KinematicInput, and this one has some of {names}: simulate and "
            "simulate_ensemble do with controls that are rows (N, m) or a plan's policy, and OptimalControlProblem does"
        )


def closest_controls(scene: Scene, q: Floats) -> Floats:
    """The controls (m,) whose forces come closest to what holds the robot at ``q`` (n,); of several, the smallest.

    Those of a servo as if it had no effort limit.
    """
    torque = scene.static_pull(q)
    for servo in of_kind(scene.elements, "PositionServo"):
        torque[servo.coordinate] += servo.values[0] * q[servo.coordinate]
    if not scene.constraints:
        return np.asarray(np.linalg.lstsq(scene.actuation, torque, rcond=None)[0], dtype=np.float64)
    along = tangent_basis(scene, q, CORRECTED)
    found = np.linalg.lstsq(along.T @ scene.actuation, along.T @ torque, rcond=1e-9)[0]
    for c in scene.inputs.values():
        found[np.argmax(scene.actuation[c])] = q[c]
    return np.asarray(found, dtype=np.float64)


def tangent_basis(scene: Scene, q: Floats, off: float = _OFF) -> Floats:
    """An orthonormal basis (n, f) of the velocities that constraints allow at ``q`` (n,); all of them without any.

    Raises:
        InputError: The configuration misses the constraints by more than ``off`` [m or rad].
    """
    if not scene.constraints:
        return np.eye(q.size)
    g, C = scene.constraint_values(q)
    worst = int(np.argmax(np.abs(g)))
    if not abs(g[worst]) <= off:
        raise InputError(
            f"q misses {scene.constraint_labels[worst]} by {abs(g[worst]):.4g} m or rad: varpin.assemble(scene, q) "
            "looks for the nearest configuration that keeps the constraints"
        )
    _, sizes, basis = np.linalg.svd(C)
    rank = int((sizes > _DEPENDENT * sizes[0]).sum())
    return np.ascontiguousarray(basis[rank:].T)


def same(one: Floats, other: Floats) -> bool:
    """Whether a scene's values are alike but for rounding: a robot may have been read by another Pinocchio."""
    if one.shape != other.shape:
        return False
    least = 1e-12 * max(float(np.abs(x[np.isfinite(x)]).max(initial=0.0)) for x in (one, other))
    return bool(np.isclose(one, other, rtol=1e-9, atol=least, equal_nan=True).all())


def differences(scene: Scene, values: Mapping[str, Floats], *, noise: bool) -> list[str]:
    """In what a scene is another than one whose :attr:`Scene.values` are given, in words; ``noise`` counts if asked."""
    found = []
    for name, before in values.items():
        now = scene.values.get(name)
        if name.startswith("noise.") and (not noise or now is None):
            continue
        if now is not None and now.shape == before.shape:
            if same(now, before):
                continue
            if name in _OF_JOINTS:
                c = int(np.argmax(np.abs(now - before)))
                joint = scene.robot.joint_names[c]
                found.append(f"{name} was {before[c]:.6g} at joint {joint!r}, and is {now[c]:.6g} in the scene")
                continue
            if name == "gravity":
                then, here = (f"({', '.join(f'{g:g}' for g in x)})" for x in (before, now))
                found.append(f"gravity was {then} m/s^2, and is {here} in the scene")
                continue
        found.append(f"{VALUES[name]} in the scene")
    if values:
        found += [
            f"{VALUES[name]} in the scene"
            for name in (*OF_COUPLINGS, *OF_CONSTRAINTS, "functions")
            if name in scene.values and name not in values
        ]
    return list(dict.fromkeys(found))


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


def damping_of(robot: Robot, given: JointValues | Literal["robot"] | None, forces: Sequence[Force] = ()) -> Floats:
    """Damping (n,) as :class:`Scene` takes it; the log has what of the robot's description is left out unasked."""
    if isinstance(given, str) and given != "robot":
        raise InputError(f"damping must be numbers, or 'robot' for those of the robot's description, got {given!r}")
    if given is None or isinstance(given, str):
        damped = given is not None or any(isinstance(force, JointDamper) for force in forces)
        _tell_of_friction(robot, damped=damped, rubs=any(isinstance(force, CoulombFriction) for force in forces))
        given = 0.0 if given is None else robot.damping
    return not_negative("damping", given, robot)


def _tell_of_friction(robot: Robot, *, damped: bool, rubs: bool) -> None:
    """Log what the description gives of damping and dry friction that a scene has nothing of."""
    words = []
    if robot.damping.any() and not damped:
        words.append(
            f"damping [N m s/rad or N s/m] of {_by_joint(robot, robot.damping)} "
            "(damping='robot' takes it, damping=0 says that none is meant)"
        )
    if robot.friction.any() and not rubs:
        words.append(
            f"dry friction [N m or N] of {_by_joint(robot, robot.friction)} "
            "(forces=[varpin.CoulombFriction(robot.friction)] takes it)"
        )
    if words:
        told = "robot %r: the scene leaves out what the description gives: %s"
        logger.warning(told, robot.name, ", and ".join(words))


def _by_joint(robot: Robot, values: Floats) -> str:
    """Numbers that are not zero, by joint, a few of them."""
    named = [f"{name!r} {value:g}" for name, value in zip(robot.joint_names, values, strict=True) if value]
    if len(named) == robot.dof and np.ptp(values) == 0.0:
        return f"{values[0]:g} at every joint"
    return ", ".join(named[:_NAMED]) + (f" and {len(named) - _NAMED} more" if len(named) > _NAMED else "")


def _forces(
    robot: Robot,
    forces: Force | Sequence[Force],
    damping: JointValues | Literal["robot"] | None,
    stiffness: JointValues,
    rest: JointValues,
) -> dict[str, Any]:
    """What a scene keeps of its forces, by the names of its attributes."""
    # Both are checked even where they make no element.
    given = forces_of(forces)
    short = damping_of(robot, damping, given), not_negative("stiffness", stiffness, robot)
    slack = joint_array("rest", rest, robot.joint_names, uniform=True)
    if short[0].any():
        given = (JointDamper(short[0]), *given)
    if short[1].any():
        given = (JointSpring(short[1], slack), *given)
    bound = [each for force in given for each in force.bind(robot)]
    elements = [each for each in bound if isinstance(each, Element)]
    own_code = tuple(force for force in given if isinstance(force, CustomForce))
    total = {kind: np.zeros(robot.dof) for kind in ("JointDamper", "JointSpring", "Armature")}
    for element in elements:
        if element.kind in total:
            total[element.kind][element.coordinate] += element.values[0]
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


def _refuse_trembling_angles(noise: Noise | Sequence[Noise] | None, elements: Sequence[Element], robot: Robot) -> None:
    """Refuse noise in proportion to controls that are positions: where an angle is 0 says nothing of a drive."""
    given = noise if isinstance(noise, Sequence) else [noise]
    models = [term for model in given for term in (model.terms if isinstance(model, NoiseSum) else [model])]
    servos = [servo.coordinate for servo in of_kind(elements, "PositionServo")]
    if servos and any(isinstance(model, ControlNoise) for model in models):
        raise InputError(
            f"ControlNoise is in proportion to forces, and the control of joint {robot.joint_names[servos[0]]!r} is "
            "the position of its servo: take AdditiveNoise"
        )


def _sole_control(actuation: Floats, c: int) -> int | None:
    """The control that drives coordinate ``c`` with share 1, and nothing else; None where there is no such control."""
    drives = np.flatnonzero(actuation[c])
    alone = len(drives) == 1 and actuation[c, drives[0]] == 1.0 and np.count_nonzero(actuation[:, drives[0]]) == 1
    return int(drives[0]) if alone else None


def _require_positions(robot: Robot, actuation: Floats, elements: Sequence[Element], bound: Bound) -> None:
    """Refuse a KinematicInput whose joint has no control of its own, or a servo besides."""
    served = {own.coordinate for own in of_kind(elements, "PositionServo")}
    for tie in bound.rows.ties:
        if tie.follower != tie.leader or tie.coefficients:
            continue
        c, name = tie.follower, robot.joint_names[tie.follower]
        if c in served:
            raise InputError(f"joint {name!r} has both a PositionServo and a KinematicInput")
        if _sole_control(actuation, c) is None:
            raise InputError(
                f"the KinematicInput of joint {name!r} needs a control of its own, its position: under this actuation "
                "none is; name the joint in the actuation, or give it a column with a 1"
            )


def _with_rates(actuation: Floats, bound: Bound) -> tuple[Floats, Bound]:
    """The actuation with a column of zeros for the velocity of each cubic input, and the rows that know these."""
    m, ties = actuation.shape[1], list(bound.rows.ties)
    cubic = [k for k, tie in enumerate(ties) if tie.rate >= 0]
    if not cubic:
        return actuation, bound
    for k, place in enumerate(cubic):
        ties[place] = ties[place]._replace(rate=m + k)
    return (
        np.hstack([actuation, np.zeros((len(actuation), len(cubic)))]),
        bound._replace(rows=bound.rows._replace(ties=tuple(ties))),
    )


def _served(robot: Robot, actuation: Floats, elements: Sequence[Element]) -> Floats:
    """The actuation with controls of servos, which are positions, multiplied by their stiffness.

    Raises:
        InputError: A servo's joint has two, or not exactly one control, of its own and of unit share.
    """
    servos = of_kind(elements, "PositionServo")
    scaled = actuation.copy()
    for servo in servos:
        c, name = servo.coordinate, robot.joint_names[servo.coordinate]
        if sum(other.coordinate == c for other in servos) > 1:
            raise InputError(f"joint {name!r} has two position servos")
        alone = _sole_control(actuation, c)
        if alone is None:
            raise InputError(
                f"the position servo of joint {name!r} needs a control of its own: under this actuation none is the "
                "joint's alone, with share 1"
            )
        scaled[c, alone] = servo.values[0]
    return scaled


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
