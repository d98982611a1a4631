"""A scene: a robot with gravity, forces, actuation, noise and constraints.

Equation (1.1) of the paper.
"""

from __future__ import annotations

import weakref
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.arrays import Floats, Integers
from varpin.core import Mechanism
from varpin.core.arrays import Coupling, Element
from varpin.errors import InputError
from varpin.finding import Told
from varpin.mechanics.arguments import acting_forces, driven, given_constraints, gravity_of, is_input
from varpin.mechanics.constraints import Bound, Constraint, CustomConstraint, bound_constraint, joined
from varpin.mechanics.custom import CustomForces
from varpin.mechanics.forces import (
    CoulombFriction,
    Force,
    JointDamper,
    JointSpring,
    JointStop,
    dissipates,
    keeps_energy,
    of_kind,
)
from varpin.mechanics.noise import BoundNoise, ControlNoise, Noise, StepNoise, bind, models_of
from varpin.mechanics.values import values_of
from varpin.model import Robot, require_robot
from varpin.model.tree import block_ends, mechanism, path_coordinates
from varpin.support.checks import JointValues, joint_array
from varpin.support.frozen import Frozen
from varpin.support.markup import facts, listed

if TYPE_CHECKING:
    from varpin.mechanics.reduction import Required

# Largest constraint residual of a given configuration, and of a start that is projected without request [m or rad].
_OFF, CORRECTED = 1e-6, 0.02
# Rank tolerance of the constraint Jacobian, relative to its largest singular value.
_RANK = 1e-9
# Forces that act only if the scene has them, by their names in a report.
_ABSENT: Mapping[str, type[Force]] = {"stops at joint limits": JointStop, "dry friction": CoulombFriction}
# Depth to which a joint may press into a stop, in widths of the stop.
_STOP_DEPTH = 2.0


@dataclass(frozen=True, eq=False, init=False)
class Scene(Frozen):
    """A robot with gravity, forces, actuation, noise and constraints; its equation of motion is (1.1) of the paper.

    Attributes:
        robot: The robot.
        gravity: Gravity (3,) [m/s^2] in world axes.
        forces: Forces on joints and frames, including those of ``damping`` and ``stiffness``.
        elements: ``forces`` on joints in the form of the core, without armature.
        couplings: ``forces`` on frames in the form of the core.
        custom: All :class:`varpin.CustomForce` in ``forces``; None for none.
        damping: Viscous damping (n,) of all dampers [N m s/rad or N s/m]: the force -damping * v.
        stiffness: Stiffness (n,) of all joint springs [N m/rad or N/m]; they are part of the potential energy.
        rest: Configuration (n,) at which the springs of each joint exert no force together [rad or m].
        armature: Rotor inertia (n,) of the robot and of ``forces`` [kg m^2 or kg].
        actuation: Matrix (n, m) from controls to generalized forces [N m or N per unit of control]; the stiffness for
            the control of a position servo; zero in the last columns, the velocities of cubic inputs.
        noise: Diffusion fields of the noise models.
        constraints: Constraints g(q) = 0; see :mod:`varpin.mechanics.constraints`.
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
    # The constraints in the form of the core, and the core's row of each constraint row (c,).
    bound_constraints: Bound = field(repr=False)
    constraint_order: NDArray[np.int64] = field(repr=False)
    # Warnings that this process has logged: kind, time step [s] and joint, or None.
    announced: Told = field(repr=False)

    def __init__(
        self,
        robot: Robot,
        *,
        gravity: ArrayLike | bool = True,
        forces: Force | Sequence[Force] = (),
        damping: JointValues | Literal["robot"] | None = None,
        friction: JointValues | Literal["robot"] | None = None,
        stiffness: JointValues = 0.0,
        rest: JointValues = 0.0,
        actuation: ArrayLike | Sequence[str] | None = None,
        noise: Noise | Sequence[Noise] | None = None,
        constraints: Constraint | Sequence[Constraint | Literal["robot"]] | Literal["robot"] | None = None,
    ) -> None:
        """Describe a scene.

        Main args:
            robot: From :func:`varpin.load_robot`.
            gravity: ``True`` for that of the robot's description, (0, 0, -9.81) unless a ``pin.Model`` or an MJCF file
                has another; ``False`` for none; or any vector (3,) [m/s^2].
            forces: Forces on joints (friction, stops, rotors, springs, dampers, servos, such as
                :class:`varpin.CoulombFriction`) and on frames (wrenches, springs, dampers, such as
                :class:`varpin.FrameSpring`).
            damping: Short for a :class:`varpin.JointDamper` in ``forces``: one number, (n,), or numbers by joint name,
                ``{"elbow": 0.1}``, >= 0 [N m s/rad or N s/m]; 0 for joints that are not named. ``"robot"`` takes the
                damping of the robot's description (:attr:`varpin.Robot.damping`). If left out there is no damping, and
                the log warns if the description gives damping or dry friction.
            friction: Short for a :class:`varpin.CoulombFriction` of this level in ``forces``, in the forms of
                ``damping``, >= 0 [N m or N]. ``"robot"`` takes the dry friction of the robot's description
                (:attr:`varpin.Robot.friction`).
            stiffness: Short for a :class:`varpin.JointSpring` in ``forces``, in the forms of ``damping``,
                >= 0 [N m/rad or N/m].

        Other Args:
            rest: Rest position of that spring, in the same forms [rad or m]; 0 for joints that are not named.
            actuation: A matrix (n, m); or the names of the m actuated joints; every joint if left out.
            noise: A noise model, several of them, or their sum; see :mod:`varpin.mechanics.noise`.
            constraints: Constraints of the motion: closed loops, gears, rods, such as :class:`varpin.PointOnPoint`.
                ``"robot"``, alone or among others, stands for the equality constraints of the robot's description
                (:attr:`varpin.Robot.equalities`). If left out there are none, and the log warns if the description
                gives some.

        Raises:
            InputError: A wrong shape; a value that is not finite; negative damping, friction or stiffness; a force,
                noise model or constraint that does not fit the robot.
            UnknownJoint: An argument names a joint that is no coordinate of the robot.
            UnknownFrame: A force or constraint names a frame that the robot does not have.
        """
        require_robot(robot)
        values: dict[str, Any] = {"robot": robot, "gravity": gravity_of(gravity, robot)}
        values |= acting_forces(robot, forces, damping, friction, stiffness, rest)
        values["constraints"] = given_constraints(robot, constraints)
        bound, order = joined([bound_constraint(constraint, robot) for constraint in values["constraints"]])
        values["actuation"], bound = driven(robot, actuation, values["elements"], bound)
        models = models_of(noise)
        servos = of_kind(values["elements"], "PositionServo")
        if servos and any(isinstance(model, ControlNoise) for model in models):
            raise InputError(
                "ControlNoise is proportional to forces, but the control of joint "
                f"{robot.joint_names[servos[0].coordinate]!r} is the position of its servo: take AdditiveNoise"
            )
        # Kinematic inputs absorb all forces on their joints.
        forced = values["actuation"].copy()
        forced[[tie.follower for tie in bound.rows.ties if is_input(tie)]] = 0.0
        values["noise"] = bind(models, forced, robot.joint_names)
        values |= {"bound_constraints": bound, "constraint_order": order, "announced": set()}
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, name, value)

    def __getstate__(self) -> dict[str, Any]:
        # A copy, possibly in another process, logs its warnings again.
        return super().__getstate__() | {"announced": set()}

    def __repr__(self) -> str:
        parts = [f"gravity {self.gravity.tolist()}" if self.gravity.any() else "no gravity"]
        parts += [name for name in ("damping", "stiffness") if getattr(self, name).any()]
        parts += self._other_forces
        parts += [type(constraint).__name__ for constraint in self.constraints]
        parts += [f"noise of {self.processes} processes"] if self.processes else []
        return f"Scene({self.robot.name}: {', '.join(parts)}, {self.controls} controls)"

    def _repr_html_(self) -> str:
        return facts(f"Scene of {self.robot.name}", [("joints", listed(self.robot.joint_names)), *self.terms.items()])

    @property
    def terms(self) -> dict[str, str]:
        """What acts in the scene, in words by its subject."""
        names, kinds = self.robot.joint_names, set(map(type, self.forces))
        absent = [*(words for words, kind in _ABSENT.items() if kind not in kinds), "contact"]
        terms = {
            "gravity": f"{', '.join(f'{g:g}' for g in self.gravity)} m/s^2" if self.gravity.any() else "none",
            "damping": joints_with(self.damping, names),
            "springs": joints_with(self.stiffness, names),
            "noise": f"{self.processes} processes" if self.processes else "none",
            "driven": ", ".join(np.array(names)[self.actuation.any(axis=1)].tolist()) or "none",
            "other forces": ", ".join(sorted(self._other_forces)) or "none",
            "not modelled": f"{', '.join(absent)}; shapes are read only for a replay",
        }
        if self.constraints:
            terms["constraints"] = ", ".join(dict.fromkeys(type(part).__name__ for part in self.constraints))
        return terms

    @property
    def _other_forces(self) -> list[str]:
        """Kinds of forces other than joint springs and dampers."""
        kinds = dict.fromkeys(type(force) for force in self.forces)
        return [kind.__name__ for kind in kinds if kind not in (JointSpring, JointDamper)]

    def _moved_by(self, bound: Sequence[Element | Coupling]) -> list[int]:
        """The coordinates that forces act on."""
        found: set[int] = set()
        for each in bound:
            if isinstance(each, Element):
                found.add(each.coordinate)
            else:
                found.update(*(path_coordinates(self.robot.tree, body).tolist() for body in (each.a, each.b)))
        return sorted(found)

    def without(self, joints: Mapping[str, float] | Collection[str]) -> Scene:
        """The scene with some joints held still: they are no coordinates, and what acts on them alone is gone.

        A force on frames stays as long as one of its frames moves. A control of held joints alone is gone, too.

        Args:
            joints: Their positions by name [rad or m], such as :attr:`Required.idle`; or their names, for 0.

        Raises:
            InputError: The scene has constraints, a CustomForce or CustomNoise, which are of all joints.
            UnknownJoint: There is no such joint.
            RobotError: No joint is left of a robot; of :func:`combine`'s, leave the robot itself out.
        """
        from varpin.mechanics.reduction import without  # noqa: PLC0415 - it is made of scenes

        return without(self, joints)

    def required(
        self,
        q0: JointValues,
        v0: JointValues = 0.0,
        *,
        controls: ArrayLike | None = None,
        task: Iterable[str] = (),
    ) -> Required:
        """The joints that have to be computed, and those that stay at rest: ``scene.without(required.idle)``.

        A group of joints that shares no inertia with others is idle if it starts at rest, and no gravity, spring, noise
        or control acts on it, nor a task. The motion of the other joints is the same without it. Of combined robots,
        one whose joints are all idle keeps them.

        Args:
            q0: Initial configuration, (n,) or by joint name [rad or m].
            v0: Initial velocity, one number, (n,) or by joint name [rad/s or m/s].
            controls: Controls of the motion, (m,) or rows of them; left out, none act, and servos hold q0.
            task: Joints that a task moves by controls that are not known yet, such as those in the cost of a plan.

        Raises:
            InputError: A wrong shape, or a value that is not finite.
            UnknownJoint: There is no joint of that name.
        """
        from varpin.mechanics.reduction import requirements  # noqa: PLC0415 - it is made of scenes

        return requirements(self, q0, v0, controls, task)

    @property
    def dissipates(self) -> bool:
        """Whether any force may dissipate energy."""
        damped = any(map(dissipates, self.elements)) or any(map(dissipates, self.couplings))
        return damped or self.custom is not None

    @cached_property
    def smooth(self) -> bool:
        """Whether all forces beside the robot's own are smooth in a joint's q and v: no constraints, noise or kinks.

        Dry friction without Stribeck's effect is smooth over its width.
        """
        if self.constraints or self.couplings or self.processes or self.custom is not None:
            return False
        return all(
            element.kind in ("JointSpring", "JointDamper")
            or (element.kind == "CoulombFriction" and element.values[0] == element.values[2])
            or (element.kind == "PositionServo" and bool(np.isinf(element.values[2])))
            for element in self.elements
        )

    @property
    def conservative(self) -> bool:
        """Whether energy is constant without controls and noise: all forces have a potential."""
        return not self.dissipates and all(map(keeps_energy, self.couplings))

    @cached_property
    def group(self) -> NDArray[np.int64]:
        """Group (n,) of each coordinate, from 0 on: groups of the robot, merged by couplings and constraints.

        Coordinates of different groups do not affect each other.
        """
        group = self.robot.tree.group.copy()
        if self.custom is not None:
            # The joints that the function couples are unknown.
            group[:] = 0
        for coordinates in [*(self._moved_by([coupling]) for coupling in self.couplings), *self._constrained()]:
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
        """A label for each constraint row (c,)."""
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
        """The core's row of each :class:`KinematicInput`, mapped to the coordinate of its joint."""
        rows = self.bound_constraints.rows
        return {len(rows.products) + k: tie.follower for k, tie in enumerate(rows.ties) if is_input(tie)}

    @cached_property
    def rates(self) -> tuple[int, ...]:
        """For each of :attr:`inputs`, the control with its velocity at the end of a step; -1 for a linear input."""
        return tuple(tie.rate for tie in self.bound_constraints.rows.ties if is_input(tie))

    @cached_property
    def prescribed(self) -> Integers:
        """The controls that are positions, and velocities, of kinematic inputs at the ends of steps."""
        positions = [int(np.argmax(self.actuation[c])) for c in self.inputs.values()]
        return np.array([*positions, *(rate for rate in self.rates if rate >= 0)], dtype=np.int64)

    @cached_property
    def transmission(self) -> Floats:
        """Matrix from controls (m,) to the inputs of linearized steps: forces (n,), then velocities of cubic inputs."""
        rates = [rate for rate in self.rates if rate >= 0]
        if not rates:
            return self.actuation
        return np.vstack([self.actuation, np.eye(self.controls)[rates]])

    @cached_property
    def direct(self) -> bool:
        """Whether each control is the force of a joint: :attr:`actuation` is the identity, and :attr:`transmission`."""
        return np.array_equal(self.actuation, np.eye(self.robot.dof))

    @cached_property
    def controls(self) -> int:
        """m, the number of controls."""
        return int(self.actuation.shape[1])

    @property
    def _servos(self) -> tuple[Element, ...]:
        return of_kind(self.elements, "PositionServo")

    @cached_property
    def control_joints(self) -> tuple[str, ...] | None:
        """The joint of each of the m controls; None unless each is the force, or servo position, of a joint alone."""
        joints, gear = np.argmax(self.actuation, axis=0), np.eye(self.robot.dof)
        for servo in self._servos:
            gear[servo.coordinate] *= servo.values[0]
        alone = len(set(joints.tolist())) == self.controls
        if not alone or not np.array_equal(self.actuation, gear[:, joints]):
            return None
        return tuple(self.robot.joint_names[j] for j in joints)

    @cached_property
    def servo_joints(self) -> tuple[str, ...]:
        """The joints whose control is the target position of a servo."""
        return tuple(self.robot.joint_names[servo.coordinate] for servo in self._servos)

    @cached_property
    def holding(self) -> Floats:
        """Matrix (m, n) of the neutral controls at q, ``holding @ q``: see :meth:`command_at`."""
        holding = np.zeros((self.controls, self.robot.dof))
        for c in (*(servo.coordinate for servo in self._servos), *self.inputs.values()):
            holding[int(np.argmax(np.abs(self.actuation[c]))), c] = 1.0
        return holding

    def command_at(self, q: Floats) -> Floats:
        """Neutral controls (m,) at q (n,): zero forces; servos and kinematic inputs hold their positions."""
        held: Floats = self.holding @ q
        return held

    @cached_property
    def processes(self) -> int:
        """k, the number of Wiener processes."""
        return self.noise.processes

    def increments(self, *, linear: bool) -> int:
        """K, the number of increments of a step, (N3): k, and those for slopes of controls ``linear`` over it."""
        return self.processes + (len(self.noise.sloped) if linear else 0)

    @cached_property
    def core(self) -> Mechanism:
        """The scene in the compiled core."""
        rows, noise = self.bound_constraints.rows, self.noise
        tree = self.robot.tree._replace(
            **(self._constrained_tree() if self.constraints else {}),
            group=self.group,
            groups=int(self.group.max()) + 1,
            ends=np.array([self.robot.dof]) if self.constraints else block_ends(self.group),
            armature=self.armature,
        )
        return mechanism(
            tree,
            gravity=self.gravity,
            forces=self.elements,
            couplings=self.couplings,
            # The scene owns the functions of users: the core's references are not seen by the garbage collector, and
            # a function that refers to its scene would be a cycle for good.
            constraints=rows._replace(
                customs=tuple(
                    row._replace(value=weakref.proxy(row.value), curvature=weakref.proxy(row.curvature))
                    for row in rows.customs
                )
            ),
            custom=None if self.custom is None else weakref.proxy(self.custom),
            actuation=self.actuation,
            diffusion=noise.arrays,
            noise=(weakref.proxy(self.step_noise), noise.sloped, noise.velocity_dependent) if noise.own else None,
        )

    def _constrained_tree(self) -> dict[str, Any]:
        """Fields of the tree that differ under constraints."""
        tree, rows = self.robot.tree, self.bound_constraints.rows
        # Constraints do work on light parts, so these have no energy balance of their own.
        changed = {"loads": tree.loads[:0], "carried": tree.carried[:0]}
        # Ties, and possibly custom constraints, are not periodic in a full turn.
        periodic = tree.periodic.copy()
        periodic[[c for tie in rows.ties for c in (tie.follower, tie.leader)]] = 0
        if rows.customs:
            periodic[:] = 0
        return changed | {"periodic": periodic}

    @cached_property
    def bounds(self) -> Floats:
        """Lower and upper limits (3, 2, n) of position, velocity and force of the joints; infinite where there is none.

        They are those of the robot's description, of positions widened where a joint stop gives way.
        """
        lower, upper = self.robot.position_limits
        # Crossed limits are a fault of the description, which inspect_robot reports.
        none = ~(lower < upper)
        lower, upper = np.where(none, -np.inf, lower), np.where(none, np.inf, upper)
        for stop in of_kind(self.elements, "JointStop"):
            # A joint may press into its stop, up to the largest depth.
            c, (first, last, *_, width) = stop.coordinate, stop.values
            lower[c] = min(lower[c], first - _STOP_DEPTH * width) if first > lower[c] - width else lower[c]
            upper[c] = max(upper[c], last + _STOP_DEPTH * width) if last < upper[c] + width else upper[c]
        speed, effort = self.robot.velocity_limit, self.robot.effort_limit
        bounds = np.array([(lower, upper), (-speed, speed), (-effort, effort)])
        bounds.setflags(write=False)
        return bounds

    @cached_property
    def step_noise(self) -> StepNoise:
        """The noise of a step, where fields are in Python."""
        return StepNoise(self)

    @cached_property
    def values(self) -> Mapping[str, Floats]:
        """The numbers that motions depend on, by name; a trajectory stores them.

        Forces are rows (coordinate, numbers) or (body a, body b, numbers), those of springs and dampers on joints sums.
        The noise is stored as intensities (n, k); its factors of the controls are reduced to their norm. A
        :class:`varpin.CustomNoise` is not stored.
        """
        return values_of(self)

    @cached_property
    def silence(self) -> Floats:
        """Wiener increments (0, 0, k) of a rollout without noise."""
        # Not read-only, which has nothing to protect here and makes each call of the core longer.
        return np.zeros((0, 0, self.processes))

    @cached_property
    def no_drift(self) -> Floats:
        """Additional forces (0, 0, n) of a rollout without any."""
        return np.zeros((0, 0, self.robot.dof))

    def holding_torque(self, q: JointValues) -> Floats:
        """The generalized forces (n,) that hold the robot at rest at ``q`` [N m or N].

        They balance gravity and springs, -L_q(q, 0), and wrenches on frames. Constraint forces take the part normal to
        the constraints; the result is the smallest of the remaining solutions.

        Args:
            q: Configuration, (n,) or by joint name [rad or m]; it satisfies the constraints.

        Raises:
            InputError: A wrong shape, a value that is not finite, or a configuration off the constraints.
            UnknownJoint: ``q`` names a joint that is no coordinate of the robot.
        """
        at = joint_array("q", q, self.robot.joint_names)
        along = tangent_basis(self, at)
        return along @ (along.T @ self.static_pull(at))

    def static_pull(self, q: Floats) -> Floats:
        """The generalized forces (n,) that hold the robot without its constraints at rest at ``q`` (n,)."""
        at = np.asarray(q, dtype=np.float64)
        _, Lq, *_ = self.core.jet(at, np.zeros_like(at))
        acts = self.couplings or self.custom is not None
        wrenches = self.core.coupled_forces(at[None], np.zeros((1, at.size)))[0][0] if acts else 0.0
        return np.asarray(-Lq - wrenches, dtype=np.float64)

    def holding_controls(self, q: JointValues) -> Floats:
        """The smallest controls (m,) that hold the robot at rest at ``q``.

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
        # Rounding error of holding torques that cancel, in terms of the robot's weight at a metre.
        weight = float(self.robot.tree.mass.sum() * np.linalg.norm(self.gravity))
        if (np.abs(left) > 1e-9 * (np.abs(torque).max() + weight)).any():
            c = int(np.argmax(np.abs(left)))
            raise InputError(
                f"no controls hold the robot at this q: no actuator takes the remaining {left[c]:.4g} N m or N at "
                f"joint {self.robot.joint_names[c]!r}"
            )
        return controls


def with_forces(scene: Scene, forces: Sequence[Force], robot: Robot) -> Scene:
    """The scene with other numbers in its forces, and a robot of the same joints; its noise stays."""
    values = acting_forces(robot, forces, 0.0, 0.0, 0.0, 0.0)
    servos = {servo.coordinate: servo.values[0] for servo in of_kind(values["elements"], "PositionServo")}
    actuation = scene.actuation.copy()
    for before in scene._servos:
        actuation[before.coordinate] *= servos.get(before.coordinate, 0.0) / before.values[0]
    return scene.changed(robot=robot, actuation=actuation, **values)


def quiet(scene: Scene) -> Scene:
    """The scene without its noise."""
    return scene.changed(noise=bind((), scene.actuation, ())) if scene.processes else scene


def joints_with(values: ArrayLike, names: Sequence[str]) -> str:
    """The joints with values other than 0, in words."""
    acting = [name for name, value in zip(names, np.asarray(values).tolist(), strict=True) if value]
    return "on every joint" if acting and len(acting) == len(names) else f"on {', '.join(acting)}" if acting else "none"


def refuse_constraints(scene: Scene, what: object) -> None:
    """Refuse a scene with constraints in ``what``."""
    if scene.constraints:
        raise InputError(
            f"{what} does not take scenes with constraints, and this one has {scene.terms['constraints']}: motions and "
            "plans do, with varpin.Midpoint() or varpin.Gauss(stages)"
        )


def closest_controls(scene: Scene, q: Floats) -> Floats:
    """The least-squares controls (m,) for the forces that hold the robot at ``q`` (n,), the smallest of several.

    Effort limits of servos are ignored.
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
    """An orthonormal basis (n, f) of the velocities that constraints allow at ``q`` (n,); identity without any.

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
            "finds the nearest configuration that satisfies the constraints"
        )
    _, sizes, basis = np.linalg.svd(C)
    rank = int((sizes > _RANK * sizes[0]).sum())
    return np.ascontiguousarray(basis[rank:].T)


def require_scene(scene: object) -> Scene:
    """``scene`` itself; an InputError if it is no Scene."""
    if not isinstance(scene, Scene):
        raise InputError(f"scene must be a varpin.Scene, got {type(scene).__name__}")
    return scene
