"""The robot: a Pinocchio model, its generalized coordinates, and the tree that the core runs on."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from varpin.arrays import Floats
from varpin.core.arrays import Tree
from varpin.errors import InputError, RobotError, UnknownJoint, UnknownPosture
from varpin.model.equalities import Equality
from varpin.model.kinematics import place_on_body
from varpin.model.meshes import Reader, read_mesh, with_own_meshes
from varpin.model.mimic import Tie, rebuild
from varpin.model.mjcf import mjcf_shapes
from varpin.model.srdf import Posture
from varpin.model.tree import flatten, joint_axis, place_of_frame
from varpin.model.units import NO_LIMIT
from varpin.model.urdf import Inertial, build_shapes, listed, read_urdf
from varpin.support import markup
from varpin.support.checks import JointValues, as_floats, joint_array
from varpin.support.frozen import Frozen

# A velocity or an effort beyond this is none: files of other programs have the largest double.
_HUGE = 1e300
# Distance [m] of a frame from a joint's axis that is none: more than what rounded angles of a file make, and less than
# cameras and fingers are aside.
_ASIDE = 1e-3
# Names of joints of grippers, whose last one moves a jaw alone; and of frames of tools.
_FINGER = re.compile("finger|gripper|jaw", re.IGNORECASE)
_TOOL = re.compile(r"(^|_)(tool\d?|tcp|eef?|end_effector|flange)(_|$)")


class Part(NamedTuple):
    """A robot within a combined one."""

    robot: Robot
    prefix: str  # of its joint and frame names in the combined model
    place: pin.SE3 | None  # placement of its world in the combined one


@dataclass(frozen=True, eq=False)
class Robot(Frozen):
    """An arm in generalized coordinates. Made by :func:`load_robot`.

    The n coordinates are the positions of the joints that are neither locked, fixed nor mimicking, in
    Pinocchio's order: an angle [rad] for a revolute or continuous joint, a displacement [m] for a prismatic one.

    Attributes:
        name: Name of the file, the bundled robot or the model.
        model: The Pinocchio model, in which mimic joints are independent: :meth:`configuration` and :meth:`velocity`
            move them as their leaders do.
        ties: The mimic joints, by index in ``model``.
        locked: Locked joints and their positions [rad or m].
        urdf: The URDF or xacro file the robot was read from, or None.
        expanded: The URDF text of a xacro file.
        mjcf: The MJCF file the robot was read from, or None.
        package_dirs: Folders in which packages are looked up, besides those around the file.
        visuals: Geometry that came with a RobotWrapper, locked like the model, or None.
        group_states: The postures that :meth:`posture` reads.
        parts: The robots of a combined robot, see :func:`combine`; empty for others.
        loops: Pairs of frames that the description closes to loops (``<loop_joint>`` of a URDF file, ``<connect>`` and
            ``<weld>`` of an MJCF file). The tree leaves them open; constraints of a scene close them.
        equalities: Equality constraints of an MJCF file; ``Scene(constraints="robot")`` takes them.
        inertials: Inertias of the links of a URDF, which the model merges into bodies.
        remarks: How the source is read where that is not plain, in words.
        notes: What of the source has no effect on purpose, likewise.
        faults: What its masses lack, likewise.
    """

    name: str
    model: pin.Model = field(repr=False)
    ties: tuple[Tie, ...] = field(repr=False)
    locked: Mapping[str, float | tuple[float, ...]] = field(default_factory=lambda: MappingProxyType({}))
    urdf: Path | None = None
    expanded: str | None = field(default=None, repr=False)
    mjcf: Path | None = None
    package_dirs: tuple[str, ...] = field(default=(), repr=False)
    visuals: pin.GeometryModel | None = field(default=None, repr=False)
    group_states: tuple[Posture, ...] = field(default=(), repr=False)
    parts: tuple[Part, ...] = field(default=(), repr=False)
    loops: tuple[tuple[str, str], ...] = ()
    equalities: tuple[Equality, ...] = field(default=(), repr=False)
    inertials: tuple[Inertial, ...] = field(default=(), repr=False)
    remarks: tuple[str, ...] = field(default=(), repr=False)
    notes: tuple[str, ...] = field(default=(), repr=False)
    faults: tuple[str, ...] = field(default=(), repr=False)

    def __repr__(self) -> str:
        locked = f", {len(self.locked)} locked" if self.locked else ""
        loops = f", {len(self.loops)} loops for a scene to close" if self.loops else ""
        return f"Robot({self.name}: {', '.join(self.joint_names)}{locked}{loops})"

    def _repr_html_(self) -> str:
        lower, upper = self.position_limits
        columns = {"lower [rad or m]": lower, "upper": upper}
        columns |= {"velocity [1/s]": self.velocity_limit, "torque [N m or N]": self.effort_limit}
        tied = (self.model.names[tie.follower] for tie in self.ties)
        loops = (f"{a} on {b}" for a, b in self.loops)
        rows: list[tuple[str, object]] = [
            ("joints that move", self.dof),
            ("mass that moves [kg]", float(self.tree.mass.sum())),
            ("locked", markup.listed(self.locked)),
            ("tied to others", markup.listed(tied)),
            ("loops for a scene to close", markup.listed(loops)),
            ("end effector", self.end_effector),
        ]
        return markup.facts(f"Robot {self.name}", rows, markup.joint_table(self.joint_names, columns))

    def rebuilt(self, **changes: Any) -> Robot:
        """The robot with its model rebuilt; see :func:`varpin.model.mimic.rebuild`."""
        new = rebuild(self.model, **changes)
        return self.changed(model=new.model, ties=new.ties(self.ties), visuals=new.shapes(self.visuals))

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints that are coordinates, in order."""
        return tuple(self.model.names[joint] for joint in self._coordinates)

    @property
    def _coordinates(self) -> tuple[int, ...]:
        """Indices in ``model`` of the joints that are coordinates."""
        followers = {tie.follower for tie in self.ties}
        return tuple(joint for joint in range(1, self.model.njoints) if joint not in followers)

    @cached_property
    def tree(self) -> Tree:
        """Flat arrays for the core.

        Raises:
            UnsupportedJoint: A joint has no single axis.
        """
        return flatten(self.model, self.ties, self._coordinates)

    @cached_property
    def dof(self) -> int:
        """n, the number of generalized coordinates."""
        return len(self.joint_names)

    def coordinate(self, joint: str) -> int:
        """Index of a joint among the coordinates.

        Raises:
            UnknownJoint: The robot has no such coordinate.
        """
        if not isinstance(joint, str) or joint not in self.joint_names:
            raise UnknownJoint(str(joint), self.joint_names, f"robot {self.name!r} has no joint")
        return self.joint_names.index(joint)

    @property
    def postures(self) -> tuple[str, ...]:
        """Names of the postures that :meth:`posture` knows."""
        return tuple(dict.fromkeys(state.name for state in self.group_states))

    def posture(self, name: str, *, others: JointValues = 0.0) -> Floats:
        """A posture of the robot's SRDF file (its ``group_state``), or a reference configuration of its model.

        Joints of the posture that are not coordinates of the robot (locked, mimic or absent joints) are ignored.

        Args:
            name: Name of the posture: ``"home"``, of all joint groups that have one; or ``"arm/home"``, of one group.
            others: Positions of the joints that the posture does not set: a number, (n,), or by joint name [rad or m].

        Returns:
            Configuration (n,) [rad or m].

        Raises:
            UnknownPosture: There is no posture of this name; the message lists the names.
            InputError: Groups give a joint two positions.
            UnknownJoint: ``others`` names a joint that the robot does not have.
        """
        q = joint_array("others", others, self.joint_names, uniform=True)
        found = [state for state in self.group_states if name in (state.name, f"{state.group}/{state.name}")]
        if not found:
            raise UnknownPosture(str(name), self.postures, f"robot {self.name!r} has no posture")
        positions: dict[str, float] = {}
        for joint, position in (entry for state in found for entry in state.positions):
            if joint in self.joint_names:
                if positions.setdefault(joint, position) != position:
                    groups = ", ".join(repr(f"{state.group}/{state.name}") for state in found)
                    raise InputError(
                        f"the postures {name!r} give joint {joint!r} two positions: choose one of {groups}"
                    )
                q[self.coordinate(joint)] = position
        return q

    def configuration(self, q: ArrayLike) -> Floats:
        """``q`` (..., n) as Pinocchio configurations (..., model.nq) of ``model``.

        Raises:
            InputError: The last dimension of ``q`` is not n.
        """
        joints = self._rows("q", q)[..., self.tree.coordinate]
        positions = joints * self.tree.ratio + self.tree.offset
        found = np.empty((*positions.shape[:-1], self.model.nq))
        for joint, position in zip(self.model.joints[1:], np.moveaxis(positions, -1, 0), strict=True):
            # Pinocchio keeps the angle of a continuous joint as its cosine and sine.
            parts = (position,) if joint.nq == 1 else (np.cos(position), np.sin(position))
            for k, part in enumerate(parts, joint.idx_q):
                found[..., k] = part
        return found

    def velocity(self, v: ArrayLike) -> Floats:
        """``v`` (..., n) as velocities (..., model.nv) of ``model``: linear in v; errors as :meth:`configuration`."""
        return self._rows("v", v)[..., self.tree.coordinate] * self.tree.ratio

    def _rows(self, name: str, values: ArrayLike) -> Floats:
        """``values`` (..., n) as floats."""
        given = as_floats(name, values)
        if given.shape[-1:] != (self.dof,):
            raise InputError(f"{name} must have shape (..., {self.dof}), got {given.shape}")
        return given

    @cached_property
    def end_effector(self) -> str:
        """Name of the frame that is farthest out on the axis of the arm's last joint, as flanges and tools are.

        Of several there, or of all frames that the joint moves if none is on its axis, it is the last one; the last one
        with a name as tools have (tool0, tcp), if there is one. The arm's last joint is the last one above all branches
        that are more than half as deep as the deepest, and before any finger by its name; where this leaves out more
        than half of that branch, as of two arms, the deepest joint is.
        """
        model, paths = self.model, [list(joints) for joints in self.model.supports]
        deepest = max(range(model.njoints), key=lambda j: (len(paths[j]), j))
        # The paths begin with the world, which is no joint.
        half = 0.5 * (len(paths[deepest]) - 1)
        branches = (set(path) for path in paths if not model.children[path[-1]] and len(path) - 1 > half)
        *_, last = takewhile(lambda j: not _FINGER.search(model.names[j]), sorted(set.intersection(*branches)))
        last = deepest if len(paths[last]) - 1 < half else last
        frames = [frame for frame in model.frames if frame.parentJoint == last]
        places, axis = np.array([frame.placement.translation for frame in frames]), joint_axis(model, last)[1]
        out = np.abs(places @ axis)
        out[np.linalg.norm(np.cross(places, axis), axis=1) > _ASIDE] = 0.0
        far = [frames[k] for k in np.flatnonzero(out > out.max() - _ASIDE)]
        # Names of fixed joints are not those of their links: "tool_cam" moves a camera.
        tools = [frame for frame in far if frame.type != pin.FrameType.FIXED_JOINT and _TOOL.search(frame.name)]
        return str((tools or far)[-1].name)

    def frame_positions(self, q: ArrayLike, frame: str | None = None) -> Floats:
        """World positions (..., 3) [m] of a frame, or of :attr:`end_effector`, at ``q`` (..., n).

        Raises:
            InputError: The last dimension of ``q`` is not n, or there is no such frame.
        """
        q = self._rows("q", q)
        name = self.end_effector if frame is None else frame
        body, _, place = place_of_frame(self.model, name, self.name)
        positions = place_on_body(self.tree, q.reshape(-1, self.dof), body, place)
        return np.asarray(positions.reshape(*q.shape[:-1], 3), dtype=np.float64)

    @property
    def position_limits(self) -> tuple[Floats, Floats]:
        """Lower and upper bounds (n,), (n,) [rad or m]; infinite where there are none.

        Two bounds of 0 count as none, since a URDF without limits is read so; to hold a joint still, lock it. A leader
        keeps within the limits of the mimic joints that follow it, unless they leave it no room.
        """
        lower, upper, _, _ = self._limits[0]
        return lower, upper

    @property
    def velocity_limit(self) -> Floats:
        """Bound (n,) [rad/s or m/s]; infinite where there is none, or one of 0.

        The bound of a mimic joint is one of its leader.
        """
        return self._limits[0][2]

    @property
    def effort_limit(self) -> Floats:
        """Bound (n,) [N m or N]; infinite where there is none, or one of 0.

        The bound of a mimic joint is one of its leader: what the leader exerts, the follower has to bear.
        """
        return self._limits[0][3]

    @cached_property
    def _limits(self) -> tuple[tuple[Floats, Floats, Floats, Floats], tuple[str, ...]]:
        """All limits of the coordinates, and the followers whose limits would leave their leader no room."""
        lower, velocity, left_out = np.full(self.dof, -np.inf), np.full(self.dof, np.inf), []
        upper, effort, tree = velocity.copy(), velocity.copy(), self.tree
        for joint in (*self._coordinates, *(tie.follower for tie in self.ties)):
            c, ratio, offset = (values[joint - 1] for values in (tree.coordinate, tree.ratio, tree.offset))
            if ratio == 0.0:
                continue
            low, high, speed, force = limits_of(self.model, joint)
            velocity[c], effort[c] = min(velocity[c], speed / abs(ratio)), min(effort[c], force * abs(ratio))
            low, high = ((limit - offset) / ratio for limit in ((low, high) if ratio > 0.0 else (high, low)))
            low, high = max(low, lower[c]), min(high, upper[c])
            if joint in self._coordinates or low < high:
                lower[c], upper[c] = low, high
            else:
                left_out.append(self.model.names[joint])
        limits = lower, upper, velocity, effort
        for limit in limits:
            limit.setflags(write=False)
        return limits, tuple(left_out)

    def limit_remarks(self) -> Iterator[str]:
        """What is odd about limits, one sentence a kind."""
        bounds = zip(self.joint_names, *self.position_limits, strict=True)
        if tight := [f"{low:g} and {high:g} of {name!r}" for name, low, high in bounds if not low < high]:
            yield f"limits leave no room to move (lock= holds a joint): {listed(tight, 'joints')}"
        if names := self._limits[1]:
            joints = listed(map(repr, names), "mimic joints")
            yield f"limits that leave the joint that a mimic joint follows no room are left out: those of {joints}"

    @property
    def damping(self) -> Floats:
        """Viscous damping in the description (n,) [N m s/rad or N s/m]; ``Scene(damping="robot")`` uses it.

        The damping of a mimic joint is added to that of its leader.
        """
        return self._at_coordinates(self.model.damping, self.tree.ratio**2)

    @cached_property
    def slides(self) -> NDArray[np.bool_]:
        """Whether each coordinate (n,) belongs to a prismatic joint and is in [m]."""
        sliding = self.tree.prismatic[np.array(self._coordinates) - 1] == 1
        sliding.setflags(write=False)
        return sliding

    def built_like(self, other: Robot) -> bool:
        """Whether another robot has the same joints at the same places, up to rounding; masses may differ."""
        mine, its = self.tree, other.tree
        if self is other or mine is its:
            return True
        exact = ("parent", "prismatic", "coordinate")
        near = ("rotation", "translation", "ratio", "offset")
        return all(np.array_equal(getattr(mine, name), getattr(its, name)) for name in exact) and all(
            np.allclose(getattr(mine, name), getattr(its, name), rtol=1e-6, atol=1e-9) for name in near
        )

    @property
    def friction(self) -> Floats:
        """Dry friction in the description (n,) [N m or N]; ``Scene(friction="robot")`` uses it."""
        return self._at_coordinates(self.model.friction, np.abs(self.tree.ratio))

    def _at_coordinates(self, values: ArrayLike, weights: Floats) -> Floats:
        """Weighted sums (n,) over the joints of ``model`` that each coordinate moves."""
        sums = np.bincount(self.tree.coordinate, np.asarray(values, dtype=float) * weights, minlength=self.dof)
        return np.asarray(sums, dtype=np.float64)


def limits_of(model: pin.Model, joint: int) -> tuple[float, float, float, float]:
    """Lower, upper, velocity and effort limit of a joint with one axis; infinite where there is none.

    No limit is the largest double or infinity in Pinocchio, and 0 in a URDF.
    """
    kind, low, high = model.joints[joint], -np.inf, np.inf
    if kind.nq == 1:
        low, high = float(model.lowerPositionLimit[kind.idx_q]), float(model.upperPositionLimit[kind.idx_q])
        none = low == high == 0.0
        low, high = -np.inf if none or low < -NO_LIMIT else low, np.inf if none or high > NO_LIMIT else high
    velocity, effort = (float(values[kind.idx_v]) for values in (model.velocityLimit, model.effortLimit))
    return low, high, velocity if 0.0 < velocity < _HUGE else np.inf, effort if 0.0 < effort < _HUGE else np.inf


def require_robot(robot: object, taker: str = "") -> Robot:
    """``robot`` itself; an InputError if it is no Robot, which names the taker, if there is one."""
    if not isinstance(robot, Robot):
        where = f"{taker}: " if taker else ""
        raise InputError(f"{where}robot must come from load_robot, got {type(robot).__name__}")
    return robot


def geometry(robot: Robot) -> pin.GeometryModel:
    """Read the robot's visual geometry from its meshes; empty where the source has none."""
    shapes, faulty = readable_geometry(robot)
    for _, what in faulty.values():
        raise RobotError(what)
    for shape in shapes.geometryObjects:
        if getattr(shape.geometry, "build_state", None) == pin.coal.BVHBuildState.BVH_BUILD_STATE_BEGUN:
            shape.geometry.endModel()
    return shapes


def readable_geometry(robot: Robot, read: Reader = read_mesh) -> tuple[pin.GeometryModel, dict[str, tuple[int, str]]]:
    """The readable part of :func:`geometry`, link by link.

    Returns:
        The shapes of the links that can be read, and for each other link by name, its joint in ``model`` and its
        fault in words; missing meshes share one message.
    """
    joints = {frame.name: frame.parentJoint for frame in robot.model.frames if frame.type == pin.FrameType.BODY}
    together = pin.GeometryModel()
    faulty: dict[str, tuple[int, str]] = {}
    for part, prefix, _ in robot.parts:
        shapes, what = readable_geometry(part, read)
        faulty |= {prefix + name: (joints[prefix + name], fault) for name, (_, fault) in what.items()}
        _hang(robot, part.model, shapes, prefix)
        for shape in shapes.geometryObjects:
            shape.name = prefix + shape.name
            together.addGeometryObject(shape)
    if robot.parts:
        return together, faulty
    try:
        if robot.visuals is not None:
            return with_own_meshes(robot.visuals, read), {}
        if robot.mjcf is not None:
            full, shapes = mjcf_shapes(robot.mjcf)
            return _hang(robot, full, shapes), {}
        if robot.urdf is None:
            return together, {}
        urdf = read_urdf(robot.urdf, robot.expanded)
        shapes, unread = build_shapes(urdf, robot.package_dirs, read)
    except RobotError as error:
        return together, {name: (joint, str(error)) for name, joint in joints.items()}
    return _hang(robot, urdf.model, shapes), {link: (joints[link], what) for link, what in unread.items()}


def _hang(robot: Robot, full: pin.Model, shapes: pin.GeometryModel, prefix: str = "") -> pin.GeometryModel:
    """Hang shapes of another model, such as that of the file before joints were locked, on the frames of a robot."""
    model = robot.model
    for shape in shapes.geometryObjects:
        link = full.frames[shape.parentFrame]
        shape.parentFrame = model.getFrameId(prefix + link.name, link.type) if shape.parentFrame else 0
        frame = model.frames[shape.parentFrame]
        shape.placement = frame.placement * link.placement.inverse() * shape.placement
        shape.parentJoint = frame.parentJoint
    return shapes
