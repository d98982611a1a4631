"""Inspection of robot descriptions: their content, and warnings about what looks wrong."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
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
from varpin.model import Robot, check_inertia, longest_reach, readable_geometry
from varpin.model.inertia import fault, inertials_of, one_of_each, principal_moments
from varpin.model.loading import Base, assemble
from varpin.model.meshes import shape_points
from varpin.model.mimic import joint_index
from varpin.model.robot import limits_of
from varpin.model.sources import describe
from varpin.model.tree import is_unbounded, joint_axis
from varpin.model.urdf import listed
from varpin.show.inspection_report import FrameKind, FrameReport, JointReport, Kind, LinkReport, RobotReport
from varpin.support.checks import JointValues, joint_array

# Thresholds of warnings: the ratio of masses of neighbouring links, and the condition number of M with a unit diagonal.
# The largest values among the arms of example-robot-data are 320 and 830.
MASS_RATIO = 1e3
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
        whole = describe(source, package_dirs, mimic=mimic)
        robot = assemble(whole, lock=lock, keep=keep, base=base, armature=armature)
    scene = Scene(robot, gravity=gravity, damping=0.0, constraints=())
    configuration = joint_array("q", 0.0 if q is None else q, robot.joint_names, uniform=True)
    velocity = joint_array("v", 0.0 if v is None else v, robot.joint_names, uniform=True)
    with np.errstate(all="ignore"):
        jet = lagrangian_jet(scene, configuration, velocity, backend="pinocchio")
    if not all(np.isfinite(array).all() for array in (jet.Lvv, jet.Lqq)):
        raise RobotError(f"robot {robot.name!r} cannot be inspected: its mass matrix or its derivatives are not finite")
    margin = Guard().branch_margin
    condition, scaled = _condition_numbers(jet.Lvv)
    links, (shapes, unread) = _links(robot), readable_geometry(robot)
    warnings = [
        *(*robot.faults, *robot.remarks, *robot.notes, *robot.limit_remarks()),
        *one_of_each(chain(_mass_warnings(robot), _inertia_warnings(robot, links, shapes))),
        *_mesh_warnings(robot, shapes),
        *dict.fromkeys(what for _, what in unread.values()),
        *_matrix_warnings(robot, scaled),
        *one_of_each(_limit_warnings(robot, configuration)),
        *_unused(robot),
    ]
    return RobotReport(
        robot=robot,
        joints=_joints(robot),
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
        kind: Kind = "prismatic" if slides else "continuous" if is_unbounded(model, joint) else "revolute"
        follows = ""
        if joint in ties:
            kind, tie = "mimic", ties[joint]
            follows = f"{tie.ratio:g} * {model.names[tie.leader]}" + (f" {tie.offset:+g}" if tie.offset else "")
        limits = limits_of(model, joint)
        reports.append(JointReport(model.names[joint], kind, axis, "m" if slides else "rad", *limits, follows))
    return tuple(reports)


def _links(robot: Robot) -> tuple[LinkReport, ...]:
    # The links of the URDF: Pinocchio merges links on fixed joints into one body, which can hide a faulty inertia.
    model = robot.free_model
    joints = joint_index(model)
    joints |= {frame.name: frame.parentJoint for frame in model.frames if frame.type == pin.FrameType.BODY}
    return tuple(
        LinkReport(
            name=link.link,
            joint=model.names[joints[link.link]] if joints[link.link] else "",
            mass=link.mass,
            center=link.center.copy(),
            inertia=link.inertia.copy(),
            moments=principal_moments(link.inertia),
        )
        for link in robot.inertials or inertials_of(model)
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


def _mass_warnings(robot: Robot) -> Iterator[tuple[str, str, str]]:
    tree, names = robot.tree, [part.link for part in inertials_of(robot.free_model)]
    for body, mass in enumerate(tree.mass):
        name, joint = names[body], robot.free_model.names[body + 1]
        if mass == 0.0:
            carries = "only the links that it carries give the joint inertia"
            if body not in tree.parent:
                carries = "and it carries nothing"
            yield "massless", name, f"link {name!r} is massless, yet joint {joint!r} moves it; {carries}"
        elif not tree.inertia[body].any():
            yield "point mass", name, f"link {name!r} has a mass of {mass:g} kg and no rotational inertia: a point mass"
        parent = int(tree.parent[body])
        light, heavy = sorted((tree.mass[parent], mass)) if parent >= 0 else (mass, mass)
        if light > 0.0 and heavy > MASS_RATIO * light:
            sentence = (
                f"the masses of neighbouring links {names[parent]!r} and {name!r} differ by a factor "
                f"of {heavy / light:.1g}: {tree.mass[parent]:.3g} and {mass:.3g} kg"
            )
            yield "masses", name, sentence


def _inertia_warnings(
    robot: Robot, links: Sequence[LinkReport], shapes: pin.GeometryModel
) -> Iterator[tuple[str, str, str]]:
    length = LENGTH_RATIO * longest_reach(robot, slides=False, centers=False) or LENGTH
    around: dict[int, list[Floats]] = {}
    for shape in shapes.geometryObjects:
        around.setdefault(shape.parentJoint, []).append(shape_points(shape))
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
        if frame is not None and frame.parentJoint in around:
            points = np.vstack(around[frame.parentJoint])
            size = float(np.linalg.norm(points - frame.placement.act(link.center), axis=1).max())
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


def _against_reach(robot: Robot) -> str:
    reach = longest_reach(robot, slides=False, centers=False)
    return f"where the arm's joints span {reach:.3g} m" if reach > 0.0 else "longer than any arm"


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


def _limit_warnings(robot: Robot, q: Floats) -> Iterator[tuple[str, str, str]]:
    for name, at, low, high in zip(robot.joint_names, q, *robot.position_limits, strict=True):
        if low < high and not low <= at <= high:
            yield "outside", name, f"q = {at:g} of joint {name!r} is outside its limits {low:g} and {high:g}"


def _unused(robot: Robot) -> Iterator[str]:
    """What the description gives and a scene takes only if it is told to."""
    given = {"damping": bool(robot.damping.any()), "friction": bool(robot.friction.any())}
    given |= {"constraints": bool(robot.equalities)}
    for what in (what for what in given if given[what]):
        yield f"the description gives joints {what}, which a scene uses with {what}='robot'"
    if robot.loops:
        pairs = listed((f"{a!r} on {b!r}" for a, b in robot.loops), "pairs")
        yield f"the description has loops, which the tree leaves open for a scene's constraints to close: {pairs}"
