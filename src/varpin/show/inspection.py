"""Inspection of robot descriptions: their content, and warnings about what looks wrong."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, product
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError, RobotError, SingularMassMatrix
from varpin.integrators import Guard, largest_step
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.model import Robot, build_robot, check_inertia, longest_reach, readable_geometry
from varpin.model.additions import Base
from varpin.model.inertia import fault, inertials_of, one_of_each, principal_moments
from varpin.model.mimic import joint_index
from varpin.model.tree import is_unbounded, joint_axis
from varpin.model.units import NO_LIMIT
from varpin.model.urdf import Inertial, Urdf, listed, read_urdf
from varpin.show.inspection_report import FrameKind, FrameReport, JointReport, Kind, LinkReport, RobotReport
from varpin.support.checks import JointValues, joint_array

# Thresholds of warnings: ratios of masses and of principal moments of neighbouring links, and the condition number of M
# with a unit diagonal. The largest values among the arms of example-robot-data are 320, 2e5 and 830.
MASS_RATIO = 1e3
INERTIA_RATIO = 1e6
CONDITION = 1e6
# Largest plausible radius of gyration and centre of mass distance of a link, as a multiple of the arm's reach, and [m]
# for an arm with all joints in one place.
LENGTH_RATIO = 2.0
LENGTH = 10.0
# A radius of gyration beyond this multiple of the distance of a link's farthest point from its centre of mass is
# impossible; motors may be left out of a shape, hence not 1.
SIZE_RATIO = 1.5
# Plausible sizes of the largest mesh of a moving link, as multiples of the arm's reach: inches taken for metres are 39
# times too large. Those of the robots of example-robot-data are 0.25 to 1.2.
MESH_RATIOS = (0.01, 10.0)
# Density of osmium, the densest element [kg/m^3].
DENSITY = 22_600.0


def inspect_robot(
    source: object,
    *,
    package_dirs: Sequence[str | os.PathLike[str]] | None = None,
    lock: Mapping[str, ArrayLike] | None = None,
    keep: Sequence[str] | None = None,
    mimic: Literal["tied", "free"] = "tied",
    q: JointValues | None = None,
    v: JointValues | None = None,
    gravity: ArrayLike | bool = True,
    base: Base = None,
    armature: JointValues | None = None,
) -> RobotReport:
    """Report on a robot description, valid or faulty.

    Main args:
        source: A source as for :func:`varpin.load_robot`, or a loaded robot.
        lock: Joints to lock, as for :func:`varpin.load_robot`.
        keep: Joints that stay, as for :func:`varpin.load_robot`.
        q: Configuration of the report: one number, (n,) or by joint name [rad or m]; 0 if left out.
        v: Velocity of the report, likewise [rad/s or m/s]; 0 if left out.

    Other Args:
        package_dirs: As for :func:`varpin.load_robot`.
        mimic: As for :func:`varpin.load_robot`.
        gravity: As for :class:`varpin.Scene`; the largest step depends on it.
        base: As for :func:`varpin.load_robot`.
        armature: As for :func:`varpin.load_robot`.

    Raises:
        RobotError: As for :func:`varpin.load_robot`, except for singular mass matrices.
        InputError: ``q`` or ``v`` has a wrong shape or is not finite, or an option of loading, such as ``lock``, is
            given with a loaded robot.
    """
    if isinstance(source, Robot):
        if lock or keep or package_dirs or mimic != "tied" or base is not None or armature is not None:
            raise InputError(
                "lock, keep, package_dirs, mimic, base and armature are options of loading; the robot is already loaded"
            )
        robot = source
    else:
        robot = build_robot(
            source, package_dirs=package_dirs, lock=lock, keep=keep, mimic=mimic, base=base, armature=armature
        )
    scene = Scene(robot, gravity=gravity, damping=0.0, constraints=())
    configuration = joint_array("q", 0.0 if q is None else q, robot.joint_names, uniform=True)
    velocity = joint_array("v", 0.0 if v is None else v, robot.joint_names, uniform=True)
    with np.errstate(all="ignore"):
        jet = lagrangian_jet(scene, configuration, velocity, backend="pinocchio")
    if not all(np.isfinite(array).all() for array in (jet.Lvv, jet.Lqq)):
        raise RobotError(f"robot {robot.name!r} cannot be inspected: its mass matrix or its derivatives are not finite")
    margin = Guard().branch_margin
    condition, scaled = _condition_numbers(jet.Lvv)
    urdf = None if robot.urdf is None else read_urdf(robot.urdf, robot.expanded)
    links = _links(robot, () if urdf is None else urdf.inertials)
    joints, (shapes, unread) = _joints(robot), readable_geometry(robot)
    warnings = [
        *(() if urdf is None else (*urdf.remarks, *urdf.notes, *urdf.faults)),
        *robot.limit_remarks(),
        *one_of_each(chain(_mass_warnings(robot), _inertia_warnings(robot, links, shapes), _ratio_warnings(robot))),
        *_mesh_warnings(robot, shapes),
        *dict.fromkeys(what for _, what in unread.values()),
        *_matrix_warnings(robot, scaled),
        *one_of_each(_limit_warnings(joints, robot, None if q is None else configuration)),
        *one_of_each(_mimic_warnings(robot, urdf, joints, tied=mimic == "tied")),
        *_damping_warnings(robot),
        *_loop_warnings(robot),
    ]
    return RobotReport(
        robot=robot,
        joints=joints,
        links=links,
        frames=_frames(robot),
        locked=robot.locked,
        total_mass=float(robot.tree.mass.sum()),
        q=configuration,
        v=velocity,
        condition=condition,
        scaled_condition=scaled,
        largest_step=largest_step(jet.Lvv, jet.Lqq, margin) if np.isfinite(scaled) else None,
        branch_margin=margin,
        warnings=tuple(warnings),
    )


def _condition_numbers(M: Floats) -> tuple[float, float]:
    """Condition number of M, and of M with a unit diagonal; both infinite where M is singular in double precision."""
    if not (np.diag(M) > 0.0).all():
        return np.inf, np.inf
    scale = np.sqrt(np.diag(M))
    scaled = np.linalg.eigvalsh(M / np.outer(scale, scale))
    if scaled[0] <= len(M) * np.finfo(float).eps:
        return np.inf, np.inf
    return float(np.linalg.cond(M)), float(scaled[-1] / scaled[0])


def _joints(robot: Robot) -> tuple[JointReport, ...]:
    model = robot.free_model
    ties = {tie.follower: tie for tie in robot.ties}
    reports = []
    for joint in range(1, model.njoints):
        slides, axis = joint_axis(model, joint)
        kind: Kind = "prismatic" if slides else "revolute"
        follows = ""
        lower, upper = -np.inf, np.inf
        entry = model.joints[joint]
        if is_unbounded(model, joint):
            kind = "continuous"
        else:
            lower, upper = model.lowerPositionLimit[entry.idx_q], model.upperPositionLimit[entry.idx_q]
        if joint in ties:
            kind, tie = "mimic", ties[joint]
            follows = f"{tie.ratio:g} * {model.names[tie.leader]}" + (f" {tie.offset:+g}" if tie.offset else "")
        reports.append(
            JointReport(
                name=model.names[joint],
                kind=kind,
                axis=axis,
                unit="m" if slides else "rad",
                lower=_limit(lower, NO_LIMIT),
                upper=_limit(upper, NO_LIMIT),
                velocity=_limit(model.velocityLimit[entry.idx_v]),
                effort=_limit(model.effortLimit[entry.idx_v]),
                follows=follows,
            )
        )
    return tuple(reports)


def _limit(value: float, none: float = 1e300) -> float:
    """A limit; infinite beyond ``none``: the largest double is no limit in Pinocchio."""
    return float(np.copysign(np.inf, value)) if abs(value) > none else float(value)


def _links(robot: Robot, inertials: Sequence[Inertial]) -> tuple[LinkReport, ...]:
    # The links of the URDF: Pinocchio merges links on fixed joints into one body, which can hide a faulty inertia.
    model = robot.free_model
    joints = joint_index(model)
    joints |= {frame.name: frame.parentJoint for frame in model.frames if frame.type == pin.FrameType.BODY}
    return tuple(
        LinkReport(
            name=link.link,
            joint=model.names[joints[link.link]] if joints[link.link] else "",
            mass=link.mass,
            center=link.center,
            inertia=link.inertia,
            moments=principal_moments(link.inertia),
        )
        for link in inertials or inertials_of(model)
        if link.link in joints
    )


_KINDS: dict[pin.FrameType, FrameKind] = {
    pin.FrameType.BODY: "link",
    pin.FrameType.JOINT: "joint",
    pin.FrameType.FIXED_JOINT: "fixed joint",
}


def _frames(robot: Robot) -> tuple[FrameReport, ...]:
    model, reports = robot.free_model, {}
    for index, frame in enumerate(model.frames):
        # The first frame is the world. Of several frames with the same name, varpin finds the first.
        if index == 0 or frame.name in reports:
            continue
        kind: FrameKind = _KINDS.get(frame.type, "frame")
        joint = model.names[frame.parentJoint] if frame.parentJoint else ""
        on = model.frames[frame.parentFrame].name if frame.parentFrame else ""
        # A frame that a user has added may have the world as its parent frame and yet move with a joint.
        reports[frame.name] = FrameReport(frame.name, kind, on or ("" if kind == "joint" else joint), joint)
    return tuple(reports.values())


def _body_name(robot: Robot, joint: int) -> str:
    """Name of the first link on a joint, or of the joint if the model has no links there."""
    for frame in robot.free_model.frames:
        if frame.parentJoint == joint and frame.type == pin.FrameType.BODY:
            return str(frame.name)
    return str(robot.free_model.names[joint])


def _mass_warnings(robot: Robot) -> Iterator[tuple[str, str, str]]:
    for body, mass in enumerate(robot.tree.mass):
        name, joint = _body_name(robot, body + 1), robot.free_model.names[body + 1]
        if mass == 0.0:
            carries = "only the links that it carries give the joint inertia"
            if body not in robot.tree.parent:
                carries = "and it carries nothing"
            yield "massless", name, f"link {name!r} is massless, yet joint {joint!r} moves it; {carries}"
        elif not np.array(robot.free_model.inertias[body + 1].inertia).any():
            yield "point mass", name, f"link {name!r} has a mass of {mass:g} kg and no rotational inertia: a point mass"


def _inertia_warnings(
    robot: Robot, links: Sequence[LinkReport], shapes: pin.GeometryModel
) -> Iterator[tuple[str, str, str]]:
    length, corners = LENGTH_RATIO * longest_reach(robot, slides=False, centers=False) or LENGTH, _corners(shapes)
    frames = {frame.name: frame for frame in robot.free_model.frames if frame.type == pin.FrameType.BODY}
    for link in links:
        if not link.joint or not link.inertia.any():
            continue
        name, frame = link.name, frames.get(link.name)
        kind, sentence = fault(name, link.mass, link.moments)
        if kind or link.mass <= 0.0:
            yield kind, name, sentence
            continue
        # A ball has the least inertia of all bodies of a given mass and density.
        radius = (3.0 * link.mass / (4.0 * np.pi * DENSITY)) ** (1.0 / 3.0)
        gyration, against, size = float(np.sqrt(link.moments[-1] / link.mass)), _against_reach(robot), np.inf
        near = [points for joint, points in corners if frame is not None and joint == frame.parentJoint]
        if frame is not None and near:
            size = float(np.linalg.norm(np.vstack(near) - frame.placement.act(link.center), axis=1).max())
        if SIZE_RATIO * size < length:
            against = f"and its body reaches {size:.2g} m from its centre of mass"
        if link.moments.sum() < 1.2 * link.mass * radius**2:
            moments = ", ".join(f"{moment:.3g}" for moment in link.moments)
            sentence = (
                f"link {name!r} has an implausibly small inertia: {link.mass:g} kg with principal moments "
                f"{moments} kg m^2 would be denser than osmium"
            )
            yield "small", name, sentence
        elif gyration > min(length, SIZE_RATIO * size):
            large = (
                f"link {name!r} has an implausibly large inertia: its radius of gyration is {gyration:.3g} m, {against}"
            )
            yield "large", name, large
    for link in links:
        away = float(np.linalg.norm(link.center))
        if link.joint and away > length:
            far = f"link {link.name!r} has its centre of mass {away:.3g} m away from its frame, {_against_reach(robot)}"
            yield "away", link.name, f"{far}; are these millimetres?"


def _corners(shapes: pin.GeometryModel) -> list[tuple[int, Floats]]:
    """The joint and the corners (8, 3) [m], in the joint's frame, of the box around each shape."""
    found = []
    for shape in shapes.geometryObjects:
        if isinstance(shape.geometry, pin.coal.BVHModelBase):
            vertices = np.asarray(shape.geometry.vertices(), dtype=np.float64)
            low, high = vertices.min(axis=0), vertices.max(axis=0)
        else:
            shape.geometry.computeLocalAABB()
            low, high = shape.geometry.aabb_local.min_, shape.geometry.aabb_local.max_
        corners = np.array(list(product(*zip(low, high, strict=True))))
        placed = corners @ shape.placement.rotation.T + shape.placement.translation
        found.append((shape.parentJoint, placed))
    return found


def _against_reach(robot: Robot) -> str:
    reach = longest_reach(robot, slides=False, centers=False)
    return f"where the arm's joints span {reach:.3g} m" if reach > 0.0 else "longer than any arm"


def _ratio_warnings(robot: Robot) -> Iterator[tuple[str, str, str]]:
    tree = robot.tree
    moments = [np.linalg.eigvalsh(np.array(body.inertia))[-1] for body in list(robot.free_model.inertias)[1:]]
    for body, parent in enumerate(tree.parent):
        if parent < 0:
            continue
        pair = f"{_body_name(robot, int(parent) + 1)!r} and {_body_name(robot, body + 1)!r}"
        for what, unit, values, most in (
            ("masses", "kg", tree.mass, MASS_RATIO),
            ("moments of inertia", "kg m^2", moments, INERTIA_RATIO),
        ):
            light, heavy = sorted((values[parent], values[body]))
            if light > 0.0 and heavy > most * light:
                yield (
                    what,
                    _body_name(robot, body + 1),
                    (
                        f"the {what} of neighbouring links {pair} differ by a factor of {heavy / light:.1g}: "
                        f"{values[parent]:.3g} and {values[body]:.3g} {unit}"
                    ),
                )


def _mesh_warnings(robot: Robot, shapes: pin.GeometryModel) -> Iterator[str]:
    sizes = {
        shape: float(np.ptp(shape.geometry.vertices(), axis=0).max())
        for shape in shapes.geometryObjects
        if shape.parentJoint and isinstance(shape.geometry, pin.coal.BVHModelBase)
    }
    reach = longest_reach(robot)
    if not sizes or not 0.0 < reach < np.inf:
        return
    shape, size = max(sizes.items(), key=lambda own: own[1])
    if not MESH_RATIOS[0] * reach <= size <= MESH_RATIOS[1] * reach:
        name, link = Path(shape.meshPath).name or shape.name, robot.free_model.frames[shape.parentFrame].name
        yield (
            f"mesh {name!r} of link {link!r} is {size:.3g} m long, where the arm reaches {reach:.3g} m: if it is not "
            "in metres, its scale= must make it so"
        )


def _matrix_warnings(robot: Robot, scaled: float) -> Iterator[str]:
    try:
        check_inertia(robot)
    except SingularMassMatrix as error:
        yield str(error)
        return
    if scaled > CONDITION:
        yield (
            f"the mass matrix is ill-conditioned: with a unit diagonal its condition number is {scaled:.1e}, so "
            f"accelerations lose {int(np.log10(scaled))} digits"
        )


def _limit_warnings(joints: Sequence[JointReport], robot: Robot, q: Floats | None) -> Iterator[tuple[str, str, str]]:
    bounded = [joint for joint in joints if joint.kind in ("revolute", "prismatic")]
    missing: dict[str, list[str]] = {}
    for joint in joints:
        none = {
            "position": joint in bounded
            and (joint.lower == joint.upper == 0.0 or not np.isfinite(joint.upper - joint.lower)),
            "velocity": joint.kind != "mimic" and joint.velocity in (0.0, np.inf),
            "effort": joint.kind != "mimic" and joint.effort in (0.0, np.inf),
        }
        if any(none.values()):
            missing.setdefault(", ".join(what for what in none if none[what]), []).append(repr(joint.name))
    if missing:
        groups = "; ".join(f"{what} of {listed(names, 'joints')}" for what, names in missing.items())
        yield "unlimited", "", f"limits that are missing, 0, negative or huge count as none: {groups}"
    at_zero = q is None
    for name, at, low, high in zip(
        robot.joint_names, np.zeros(robot.dof) if q is None else q, *robot.position_limits, strict=True
    ):
        if low < high and not low <= at <= high:
            where = f"q = 0 is no posture of joint {name!r}: it is" if at_zero else f"q puts joint {name!r} at {at:g},"
            yield "outside", name, f"{where} outside its limits {low:g} and {high:g}"


def _mimic_warnings(
    robot: Robot, urdf: Urdf | None, joints: Sequence[JointReport], *, tied: bool
) -> Iterator[tuple[str, str, str]]:
    for joint in joints:
        if joint.follows:
            yield (
                "tied",
                joint.name,
                f"mimic joint {joint.name!r} is tied to its leader, as {joint.follows}: no coordinate",
            )
    if urdf is None:
        return
    index = joint_index(robot.free_model)
    moving = {joint.get("name") for joint in urdf.root.findall("joint") if joint.get("type") not in (None, "fixed")}
    for name, mimic in urdf.mimics.items():
        if name not in index:
            continue
        if mimic.leader not in moving:
            yield (
                "alone",
                name,
                (f"joint {name!r} mimics {mimic.leader!r}, which is not a moving joint of the robot: it stays free"),
            )
        elif not tied:
            yield "free", name, f"joint {name!r} mimics {mimic.leader!r}, but mimic='free' makes it free"


def _damping_warnings(robot: Robot) -> Iterator[str]:
    for what, values, unit, usage in (
        ("damping", robot.damping, "N m s/rad or N s/m", "which a scene uses with damping='robot'"),
        (
            "dry friction",
            robot.friction,
            "N m or N",
            "which a scene uses with friction='robot'",
        ),
    ):
        given = [f"{name!r} {value:g}" for name, value in zip(robot.joint_names, values, strict=True) if value]
        if given:
            yield f"the description gives joint {what} [{unit}], {usage}: {listed(given, 'joints')}"


def _loop_warnings(robot: Robot) -> Iterator[str]:
    if robot.loops:
        pairs = listed((f"{a!r} on {b!r}" for a, b in robot.loops), "pairs")
        yield f"the description has loops, which the tree leaves open for a scene's constraints to close: {pairs}"
    if robot.equalities:
        named = listed((equality.name for equality in robot.equalities), "of them")
        yield f"the description has equality constraints, which a scene uses with constraints='robot': {named}"
