"""Loading of robots: additions to a description, and joints that are locked."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError, RobotError, UnknownJoint
from varpin.model.inertia import Payload, carry, check_inertia, faults, with_mesh_inertias
from varpin.model.mimic import joint_index
from varpin.model.robot import Robot, limits_of
from varpin.model.sources import describe
from varpin.model.tree import is_unbounded, joint_axis
from varpin.model.units import ADVICE, NO_LIMIT, TURNS
from varpin.support.checks import (
    JointValues,
    as_floats,
    joint_array,
    require_finite,
    rotation_matrix,
    tuple_of,
    word,
)

logger = logging.getLogger(__name__)

Base: TypeAlias = Literal["planar"] | ArrayLike | pin.SE3 | None

# Joints of the planar base.
PLANAR = ("base_x", "base_y", "base_turn")
# Locking a joint further outside its limits than this gives a warning [rad or m].
_OUTSIDE = 1e-6


def load_robot(
    source: str | os.PathLike[str] | pin.Model | pin.RobotWrapper,
    *,
    package_dirs: Sequence[str | os.PathLike[str]] | None = None,
    lock: Mapping[str, ArrayLike] | None = None,
    keep: Sequence[str] | None = None,
    mimic: Literal["tied", "free"] = "tied",
    payload: Payload | Sequence[Payload] = (),
    xacro_args: Mapping[str, object] | None = None,
    srdf: str | os.PathLike[str] | None = None,
    base: Base = None,
    armature: JointValues | None = None,
    inertia: Literal["file", "meshes"] = "file",
    density: float = 1000.0,
) -> Robot:
    """Load an arm.

    Any URDF that Pinocchio reads is accepted. The log reports what the file leaves out, and inertias that no body can
    have, with the link and its numbers.

    Main args:
        source: Path of a URDF file, of a xacro file (``arm.urdf.xacro``) or of an MJCF file (``arm.xml``); name of a
            bundled robot (``"finger"``); name of a fixed-base robot of example-robot-data (``"ur5"``); name of a robot
            of the package robot_descriptions (``"iiwa14_description"``), which downloads it on first use; a
            ``pin.Model``; or a ``RobotWrapper``. :func:`varpin.robot_names` lists the names that need no download.
        lock: Joints to lock and their positions by name: ``{"panda_finger_joint1": 0.02}`` [rad or m]. They are removed
            from the model. A joint with several axes (a free-flyer, say) takes its Pinocchio configuration.
        keep: Names of the joints that stay: ``["shoulder", "elbow"]``. All others are locked, where ``lock`` says or
            else at 0, or at the limit that is nearest to 0. Mimic joints stay with their leaders. All stay if left out.

    Other Args:
        package_dirs: Folders in which ``package://`` mesh paths, and ``$(find package)`` in xacro files, are looked up.
            The file's own folder, and the folders that contain its ROS packages, are always searched.
        mimic: ``"tied"`` moves a mimic joint with its leader; ``"free"`` makes it a coordinate of its own.
        payload: Bodies that the robot carries; they become part of its links.
        xacro_args: Arguments of a xacro file by name: ``{"prefix": "left_"}``.
        srdf: The SRDF file, or xacro file of an SRDF, that :meth:`Robot.posture` reads. If left out, the SRDF with the
            name of the robot's file, in the same folder or in a sibling folder ``srdf``, if there is one.
        base: Placement of the robot's base in the world, a transform (4, 4) [m] or a ``pin.SE3``; or ``"planar"`` for a
            moving base, which adds the joints ``base_x``, ``base_y`` [m] and ``base_turn`` [rad] before the robot's own
            and has the mass of its first link. At the world's origin if left out.
        armature: Rotor inertia reflected to the joints [kg m^2 or kg], >= 0: a number for all coordinates, (n,), or by
            joint name. It replaces that of the file; joints that are not named keep theirs.
        inertia: ``"meshes"`` gives massless links of a URDF the inertia of their visual shapes, which must be closed.
        density: Density of these shapes [kg/m^3].

    Returns:
        The robot; its geometry is read when it is needed.

    Raises:
        RobotNotFound: There is no such file or name; close matches are listed.
        RobotError: The file is not a URDF, its XML is broken, or a mass, an inertia or a mimic multiplier is not a
            usable number. Masses and inertias that Pinocchio leaves out of a URDF, and negative ones, are reported in
            the log instead.
        UnsupportedJoint: A joint has no single axis (free-flyer, spherical, planar, screw).
        UnknownJoint: ``lock`` or ``armature`` names a joint that the robot does not have.
        UnknownFrame: A payload names a frame that the robot does not have.
        MissingDependency: A xacro file needs the package xacro (extra ``xacro``), an MJCF file mujoco (extra
            ``mjcf``), a name robot_descriptions (extra ``descriptions``).
        InputError: A xacro file has no argument of that name, or a base or an armature is invalid.
        SingularMassMatrix: A joint moves no inertia, or a negative one.
    """
    robot = unchecked_robot(**locals())
    for note in robot.notes:
        logger.info("robot %r: %s", robot.name, note)
    wrong = (*robot.faults, *faults(robot.model, robot.inertials))
    for remark in (*robot.remarks, *wrong, *robot.limit_remarks()):
        logger.warning("robot %r: %s", robot.name, remark)
    check_inertia(robot)
    return robot


def unchecked_robot(
    source: object,
    *,
    payload: Payload | Sequence[Payload],
    lock: Mapping[str, ArrayLike] | None,
    keep: Sequence[str] | None,
    base: Base,
    armature: JointValues | None,
    inertia: str,
    density: float,
    **reading: Any,
) -> Robot:
    """The robot of :func:`load_robot`, whose arguments these are, before its inertia is checked."""
    word("inertia", inertia, ("file", "meshes"))
    robot = describe(source, **reading)
    if inertia == "meshes":
        robot = with_mesh_inertias(robot, density)
    robot = _on_base(robot, base)
    payload = tuple_of("payload", payload, Payload)
    carry(robot.model, payload, robot.name)
    names = list(robot.model.names)
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise RobotError(f"robot {robot.name!r} has several joints named {', '.join(map(repr, twice))}")
    robot = hold_joints(robot, _locks(robot, lock, keep))
    return robot if armature is None else _with_rotors(robot, armature)


def _on_base(robot: Robot, base: Base) -> Robot:
    """The robot on a placed base, (4, 4) or a pin.SE3, or on a base that moves in a plane."""
    if base is None:
        return robot
    if not isinstance(base, str):
        return robot.rebuilt(place=transform(base, "base", ", or 'planar'"))
    if base != "planar":
        raise InputError(f"base must be 'planar', a transform (4, 4) or a pin.SE3, got {base!r}")
    if taken := sorted(set(PLANAR) & set(robot.model.names)):
        raise InputError(f"base='planar' adds the joints {', '.join(PLANAR)}, but the robot already has {taken[0]!r}")
    kinds = pin.JointModelPX(), pin.JointModelPY(), pin.JointModelRZ()
    return robot.rebuilt(root=tuple(zip(PLANAR, kinds, strict=True)))


def transform(base: ArrayLike | pin.SE3, what: str, otherwise: str = "") -> pin.SE3:
    """A placement from a matrix (4, 4) of rounded numbers."""
    matrix = as_floats(what, base.homogeneous if isinstance(base, pin.SE3) else base)
    if matrix.shape != (4, 4) or (matrix[3] != [0.0, 0.0, 0.0, 1.0]).any():
        raise InputError(
            f"{what} must be a rotation and a translation (4, 4), its last row 0 0 0 1, or a pin.SE3{otherwise}, "
            f"got shape {matrix.shape}"
        )
    require_finite(what, matrix)
    u, _, v = np.linalg.svd(rotation_matrix(f"the rotation in {what}", matrix[:3, :3]))
    return pin.SE3(u @ v, matrix[:3, 3])


def _with_rotors(robot: Robot, armature: JointValues) -> Robot:
    """The robot with another armature of its coordinates, a number, (n,) or by joint name; locked joints have none."""
    model, names = robot.model, robot.joint_names
    values, indices = np.array(model.armature), [model.joints[model.getJointId(name)].idx_v for name in names]
    if isinstance(armature, Mapping):
        given = {name: value for name, value in armature.items() if name not in robot.locked}
        armature = dict(zip(names, values[indices].tolist(), strict=True)) | given
    values[indices] = joint_array("armature", armature, names, uniform=True)
    least, joint = min(zip(values[indices], names, strict=True))
    if least < 0.0:
        raise InputError(f"armature of joint {joint!r} must be >= 0 [kg m^2 or kg], got {least:g}")
    model.armature = values
    return robot.changed(model=model)


def _locks(robot: Robot, lock: Mapping[str, ArrayLike] | None, keep: Sequence[str] | None) -> Mapping[str, ArrayLike]:
    """The joints to lock and their positions: those of ``lock``, and those that ``keep`` does not name."""
    if not (lock is None or isinstance(lock, Mapping)):
        raise InputError(f"lock must map joint names to positions, as in {{'elbow': 0.5}}, got {lock!r}")
    given = dict(lock or {})
    if keep is None:
        return given
    keep, model = tuple_of("keep", keep, str), robot.model
    leaders = {model.names[tie.follower]: model.names[tie.leader] for tie in robot.ties}
    for name in keep:
        if name not in joint_index(model):
            raise UnknownJoint(str(name), joint_index(model), f"keep: robot {robot.name!r} has no joint")
        if name in given:
            raise InputError(f"joint {name!r} is in keep and in lock")
        if leaders.get(name, name) not in keep:
            raise InputError(f"keep: joint {name!r} mimics {leaders[name]!r}; keeping {leaders[name]!r} keeps both")
    neutral = pin.neutral(model)
    for joint, name in enumerate(model.names):
        # A planar base was asked for.
        if joint == 0 or name in (*keep, *PLANAR) or name in leaders or name in given:
            continue
        kind = model.joints[joint]
        if kind.nv > 1:
            given[name] = neutral[kind.idx_q : kind.idx_q + kind.nq]
        else:
            low, high, *_ = limits_of(model, joint)
            given[name] = min(max(0.0, low), high) if low < high else 0.0
    return given


def hold_joints(robot: Robot, lock: Mapping[str, ArrayLike]) -> Robot:
    """A robot that is no combined one, with joints locked at positions by name [rad or m].

    Followers of locked leaders are locked as well.
    """
    model, index = robot.model, joint_index(robot.model)
    leaders = {tie.follower: tie for tie in robot.ties}
    positions: dict[int, Floats] = {}
    for name, value in lock.items():
        if name not in index:
            raise UnknownJoint(str(name), index, f"lock: robot {robot.name!r} has no joint")
        joint = index[name]
        if joint in leaders:
            leader = model.names[leaders[joint].leader]
            raise InputError(f"lock: joint {name!r} mimics {leader!r}; locking {leader!r} locks both")
        positions[joint] = _locked_position(model, joint, value)
    for tie in robot.ties:
        if tie.leader in positions:
            positions[tie.follower] = tie.ratio * positions[tie.leader] + tie.offset
    held = {joint: _motion(model, joint, position) for joint, position in positions.items()}
    if held:
        robot = robot.rebuilt(held=held)
    now = {model.names[joint]: float(at[0]) if at.size == 1 else tuple(at.tolist()) for joint, at in positions.items()}
    loops = tuple((a, b) for a, b in robot.loops if _carriers(robot, a).isdisjoint(_carriers(robot, b)))
    robot = robot.changed(locked=MappingProxyType({**robot.locked, **now}), loops=loops)
    if not robot.joint_names:
        why = "".join(f"; {remark}" for remark in robot.remarks[:1])
        raise RobotError(f"robot {robot.name!r} has no joint that moves{why}")
    robot.tree  # noqa: B018
    return robot


def _motion(model: pin.Model, joint: int, position: Floats) -> pin.SE3:
    """The motion of a joint at its position."""
    kind, q = model.joints[joint], pin.neutral(model)
    if is_unbounded(model, joint):
        position = np.array([np.cos(position[0]), np.sin(position[0])])
    q[kind.idx_q : kind.idx_q + kind.nq] = position
    data = kind.createData()
    kind.calc(data, q)
    return pin.SE3(data.M)


def _carriers(robot: Robot, name: str) -> set[int]:
    """The joints that carry the frames of a name; a loop on one joint alone is closed for good."""
    frames = robot.model.frames
    return {frame.parentJoint for frame in frames if frame.name == name and frame.type != pin.FrameType.JOINT}


def _locked_position(model: pin.Model, joint: int, value: ArrayLike) -> Floats:
    kind, name = model.joints[joint], f"lock[{model.names[joint]!r}]"
    size = 1 if kind.nv == 1 else kind.nq
    position = np.atleast_1d(as_floats(name, value))
    if position.shape != (size,):
        raise InputError(f"{name} must have {size} value(s), got shape {position.shape}")
    require_finite(name, position)
    if kind.nv == 1:
        low, high, *_ = limits_of(model, joint)
        # A lock has no motion behind it in which the joint may have turned.
        if not kind.shortname().startswith("JointModelP") and TURNS < abs(position[0]) < NO_LIMIT:
            logger.warning("%s = %g looks like degrees: %s", name, position[0], ADVICE)
        elif low < high and not low - _OUTSIDE <= position[0] <= high + _OUTSIDE:
            unit = "m" if joint_axis(model, joint)[0] else "rad"
            logger.warning("%s = %g is outside the joint's limits, %g to %g %s", name, position[0], low, high, unit)
    if kind.nv > 1:
        reference = pin.neutral(model)
        reference[kind.idx_q : kind.idx_q + kind.nq] = position
        if not pin.isNormalized(model, reference, 1e-6):
            raise InputError(
                f"{name} must be a configuration of a {kind.shortname()}, its quaternion or (cos, sin) of "
                f"length 1, got {position}"
            )
        position = pin.normalize(model, reference)[kind.idx_q : kind.idx_q + kind.nq]
    return position
