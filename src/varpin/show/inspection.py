"""Inspection of robot descriptions: their content, and warnings about what looks wrong."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import signature
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from varpin.arrays import Floats
from varpin.errors import InputError, RobotError, SingularMassMatrix
from varpin.model import Robot, check_inertia, longest_reach, readable_geometry
from varpin.model.inertia import fault, inertials_of, one_of_each, principal_moments
from varpin.model.loading import load_robot, unchecked_robot
from varpin.model.meshes import shape_points
from varpin.model.mimic import joint_index
from varpin.model.robot import limits_of
from varpin.model.tree import is_unbounded, joint_axis, mechanism
from varpin.model.urdf import listed
from varpin.support import markup
from varpin.support.checks import JointValues, flag, joint_array
from varpin.support.frozen import Frozen
from varpin.support.tables import Table

Kind = Literal["revolute", "prismatic", "continuous", "mimic"]
FrameKind = Literal["link", "joint", "fixed joint", "frame"]

# Largest plausible condition number of M with a unit diagonal; 830 among the arms of example-robot-data.
CONDITION = 1e6
# Largest plausible radius of gyration and centre of mass distance of a link, as a multiple of the arm's reach, and [m]
# for an arm with all joints in one place.
LENGTH_RATIO = 2.0
LENGTH = 10.0
# A radius of gyration beyond this multiple of the distance of a link's farthest point from its centre of mass is
# impossible; motors may be left out of a shape, hence not 1.
SIZE_RATIO = 1.5
# A centre of mass may lie outside the box around its link's shapes and joints, by this multiple of the box's diagonal:
# at most 0.46 among 1294 links of example-robot-data, 1.0 to 9.9 in arms whose files give centres in the base's axes.
OUTSIDE_RATIO = 0.7
# Plausible sizes of the largest mesh of a moving link, as multiples of the arm's reach: inches taken for metres are 39
# times too large. Those of the robots of example-robot-data are 0.25 to 1.2.
MESH_RATIOS = (0.01, 10.0)
# Density of osmium, the densest element [kg/m^3].
DENSITY = 22_600.0


@dataclass(frozen=True, eq=False)
class JointReport(Frozen):
    """A joint that moves.

    Attributes:
        name: Name of the joint.
        kind: Revolute, prismatic, continuous (revolute without limits) or mimic.
        axis: Unit axis (3,) in the joint's own frame.
        unit: Unit of its position, rad or m.
        lower: Lower position limit [rad or m], -inf if none.
        upper: Upper position limit [rad or m], inf if none.
        velocity: Velocity limit [rad/s or m/s], inf if none.
        effort: Effort limit [N m or N], inf if none.
        follows: Leader, ratio and offset of a mimic joint, in words; empty for others.
    """

    name: str
    kind: Kind
    axis: Floats
    unit: Literal["rad", "m"]
    lower: float
    upper: float
    velocity: float
    effort: float
    follows: str = ""


@dataclass(frozen=True, eq=False)
class LinkReport(Frozen):
    """A link with mass or inertia; for a model in memory, all links on a joint together.

    Attributes:
        name: Name of the link.
        joint: The joint that moves it, or empty for a link of the base.
        mass: Mass [kg].
        center: Centre of mass (3,) in the link's frame [m].
        inertia: Inertia (3, 3) about the centre of mass [kg m^2].
    """

    name: str
    joint: str
    mass: float
    center: Floats
    inertia: Floats

    @property
    def moments(self) -> Floats:
        """Principal moments of inertia (3,), ascending [kg m^2]."""
        return principal_moments(self.inertia)


@dataclass(frozen=True)
class FrameReport:
    """A frame, for the names that costs, traces and payloads take.

    Attributes:
        name: Name of the frame.
        kind: Whether it belongs to a link, a joint, a fixed joint, or none of them.
        parent: The link or frame that it is attached to, or empty for the world.
        joint: The joint that moves it, or empty if it is fixed to the base.
    """

    name: str
    kind: FrameKind
    parent: str
    joint: str


@dataclass(frozen=True, eq=False)
class RobotReport(Frozen):
    """The content of a robot description, and warnings; ``print`` shows it in tables.

    Attributes:
        robot: The robot, possibly one that :func:`varpin.load_robot` refuses.
        joints: Moving joints, mimic joints included, in Pinocchio's order.
        links: Links with mass or inertia.
        frames: Frames that varpin finds by name, in Pinocchio's order.
        locked: Locked joints and their positions [rad or m].
        total_mass: Mass of all moving links [kg].
        q: Configuration of the report (n,) [rad or m].
        condition: Condition number of M(q) with rows and columns scaled to a unit diagonal, which does not depend on
            units. Infinite if M is singular.
        warnings: What looks wrong, in words that name the joint or link.
    """

    robot: Robot = field(repr=False)
    joints: tuple[JointReport, ...]
    links: tuple[LinkReport, ...]
    frames: tuple[FrameReport, ...]
    locked: Mapping[str, float | tuple[float, ...]]
    total_mass: float
    q: Floats
    condition: float
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        warned = markup.warning_count(self.warnings)
        return f"RobotReport({self.robot.name}: {len(self.joints)} joints, {len(self.links)} links{warned})"

    def __str__(self) -> str:
        told = markup.warning_lines(self.warnings) or ["nothing looks wrong"]
        return "\n".join([*(f"{table}\n" for table in self.tables), *told])

    @property
    def tables(self) -> tuple[Table, ...]:
        """Tables of joints, links, frames and the whole robot."""
        moving = iter(range(len(self.joints)))
        joints: list[tuple[object, ...]] = [
            (
                j.name,
                "-" if j.kind == "mimic" else next(moving),
                j.kind,
                _axis(j),
                j.follows or _range(j),
                "none" if math.isinf(j.velocity) else f"{j.velocity:g}",
                "none" if math.isinf(j.effort) else f"{j.effort:g}",
            )
            for j in self.joints
        ]
        joints += [(name, "-", f"locked at {at}", "", "", "", "") for name, at in self.locked.items()]
        links = [
            (x.name, f"{x.mass:.4g}", *("  ".join(f"{y:.3g}" for y in part) for part in (x.center, x.moments)))
            for x in self.links
        ]
        frames = [(x.name, x.kind, x.parent or "the world", x.joint or "the base") for x in self.frames]
        whole = [
            ("degrees of freedom", self.robot.dof),
            ("end effector", self.robot.end_effector),
            ("mass that moves [kg]", f"{self.total_mass:.5g}"),
            ("at q [rad or m]", "  ".join(f"{x:g}" for x in self.q)),
        ]
        units = {"rad": "[rad]", "m": "[m]"}
        unit = units.get("".join({j.unit for j in self.joints}), "[rad or m]")
        per = unit.replace("]", "/s]").replace(" or", "/s or")
        effort = {"[rad]": "[N m]", "[m]": "[N]"}.get(unit, "[N m or N]")
        heads = "joint", "q", "kind", "axis", f"limits {unit}", f"speed {per}", f"effort {effort}"
        name = self.robot.name
        return (
            Table(f"{name}: joints", heads, joints),
            Table(f"{name}: links", ("link", "mass [kg]", "centre of mass [m]", "principal moments [kg m^2]"), links),
            Table(f"{name}: frames", ("frame", "what it is", "on", "moved by"), frames),
            Table(f"{name}: as a whole", (), whole),
        )

    def _repr_html_(self) -> str:
        joints, links, frames, whole = self.tables
        rows = [(str(name), value) for name, value in whole.rows]
        rows += [("warning", warning) for warning in self.warnings]
        folded = (markup.folded(part.title, markup.table(part.columns, part.rows)) for part in (links, frames))
        return markup.facts(f"Robot {self.robot.name}", rows, markup.table(joints.columns, joints.rows), *folded)


def _range(joint: JointReport) -> str:
    free = math.isinf(joint.lower) and math.isinf(joint.upper)
    return "free" if free else f"{joint.lower:g} .. {joint.upper:g}"


def _axis(joint: JointReport) -> str:
    for letter, component in zip("xyz", joint.axis, strict=True):
        if abs(abs(component) - 1.0) < 1e-9:
            return f"{'+' if component > 0.0 else '-'}{letter}"
    return "(" + ", ".join(f"{component:.3g}" for component in joint.axis) + ")"


def inspect_robot(
    source: object,
    *,
    q: JointValues | None = None,
    meshes: bool = True,
    **loading: Any,
) -> RobotReport:
    """Report on a robot description, valid or faulty.

    Args:
        source: A source as for :func:`varpin.load_robot`, or a loaded robot.
        q: Configuration of the report: one number, (n,) or by joint name [rad or m]; 0 if left out.
        meshes: Whether to compare inertias with the sizes of meshes, which takes seconds if their files are large.
        loading: Options of :func:`varpin.load_robot`, such as ``lock``.

    Raises:
        RobotError: As for :func:`varpin.load_robot`, except for singular mass matrices.
        InputError: ``q`` has a wrong shape or is not finite, or options of loading are given with a loaded robot.
    """
    if isinstance(source, Robot):
        if given := [name for name, value in loading.items() if value is not None]:
            raise InputError(f"{', '.join(given)}: options of loading, and the robot is already loaded")
        robot = source
    else:
        options = signature(load_robot).bind(source, **loading)
        options.apply_defaults()
        robot = unchecked_robot(**options.arguments)
    configuration = joint_array("q", 0.0 if q is None else q, robot.joint_names, uniform=True)
    with np.errstate(all="ignore"):
        M = mechanism(robot.tree).jet(configuration, np.zeros(robot.dof))[-1]
    if not np.isfinite(M).all():
        raise RobotError(f"robot {robot.name!r} cannot be inspected: its mass matrix is not finite")
    condition = _condition_number(M)
    links = _links(robot)
    return RobotReport(
        robot=robot,
        joints=_joints(robot),
        links=links,
        frames=_frames(robot),
        locked=robot.locked,
        total_mass=float(robot.tree.mass.sum()),
        q=configuration,
        condition=condition,
        warnings=tuple(_warnings(robot, links, configuration, condition, meshes=flag("meshes", meshes))),
    )


def _warnings(robot: Robot, links: Sequence[LinkReport], q: Floats, condition: float, *, meshes: bool) -> Iterator[str]:
    yield from (*robot.faults, *robot.remarks, *robot.notes, *robot.limit_remarks())
    shapes, unread = readable_geometry(robot) if meshes else (pin.GeometryModel(), {})
    yield from one_of_each(chain(_mass_warnings(robot), _inertia_warnings(robot, links, shapes)))
    yield from _mesh_warnings(robot, shapes)
    yield from dict.fromkeys(what for _, what in unread.values())
    yield from _matrix_warnings(robot, condition)
    yield from one_of_each(_limit_warnings(robot, q))
    yield from _unused(robot)


def _condition_number(M: Floats) -> float:
    """Condition number of M with a unit diagonal; infinite where M is singular in double precision."""
    if not (np.diag(M) > 0.0).all():
        return np.inf
    scale = np.sqrt(np.diag(M))
    values = np.linalg.eigvalsh(M / np.outer(scale, scale))
    return float(values[-1] / values[0]) if values[0] > len(M) * np.finfo(float).eps else np.inf


def _joints(robot: Robot) -> tuple[JointReport, ...]:
    model = robot.model
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
    model = robot.model
    joints = joint_index(model)
    joints |= {frame.name: frame.parentJoint for frame in model.frames if frame.type == pin.FrameType.BODY}
    return tuple(
        LinkReport(
            name=link.link,
            joint=model.names[joints[link.link]] if joints[link.link] else "",
            mass=link.mass,
            center=link.center.copy(),
            inertia=link.inertia.copy(),
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
    model, reports = robot.model, {}
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
    tree, names = robot.tree, [part.link for part in inertials_of(robot.model)]
    for body, (name, mass) in enumerate(zip(names, tree.mass, strict=True)):
        # A massless link that carries others is sound: their joints move them.
        if mass == 0.0 and body not in tree.parent:
            joint = robot.model.names[body + 1]
            yield "massless", name, f"link {name!r} is massless and carries nothing, yet joint {joint!r} moves it"
        elif mass != 0.0 and not tree.inertia[body].any():
            yield "point mass", name, f"link {name!r} has a mass of {mass:g} kg and no rotational inertia: a point mass"


def _inertia_warnings(
    robot: Robot, links: Sequence[LinkReport], shapes: pin.GeometryModel
) -> Iterator[tuple[str, str, str]]:
    reach = longest_reach(robot, slides=False, centers=False)
    length = LENGTH_RATIO * reach or LENGTH
    span = f"where the arm's joints span {reach:.3g} m" if reach > 0.0 else "longer than any arm"
    around: dict[int, list[Floats]] = {}
    for shape in shapes.geometryObjects:
        around.setdefault(shape.parentJoint, []).append(shape_points(shape))
    frames = {frame.name: frame for frame in robot.model.frames if frame.type == pin.FrameType.BODY}
    for link in links:
        if not link.joint:
            continue
        where, away = f"link {link.name!r} has its centre of mass", float(np.linalg.norm(link.center))
        if away > length:
            yield "away", link.name, f"{where} {away:.3g} m away from its frame, {span}; are these millimetres?"
        kind, sentence = fault(link.name, link.mass, link.moments)
        if kind or link.mass <= 0.0 or not link.inertia.any():
            yield kind, link.name, sentence
            continue
        frame, size = frames.get(link.name), np.inf
        if frame is not None and frame.parentJoint in around:
            points, center = np.vstack(around[frame.parentJoint]), frame.placement.act(link.center)
            size = float(np.linalg.norm(points - center, axis=1).max())
            # Around the shapes, the joint and those that it carries.
            carried = [robot.model.jointPlacements[k].translation for k in robot.model.children[frame.parentJoint]]
            places = np.vstack([points, np.zeros(3), *carried])
            lower, upper = places.min(axis=0), places.max(axis=0)
            outside = float(np.linalg.norm(center - np.clip(center, lower, upper)))
            box = float(np.linalg.norm(upper - lower))
            if outside > OUTSIDE_RATIO * box:
                span_of_shapes = f"which span {box:.2g} m; is it given in the link's frame?"
                yield "away", link.name, f"{where} {outside:.3g} m outside of its shapes, {span_of_shapes}"
        reaches = f"and its body reaches {size:.2g} m from its centre of mass"
        yield from _odd_inertia(link, min(length, SIZE_RATIO * size), reaches if SIZE_RATIO * size < length else span)


def _odd_inertia(link: LinkReport, largest: float, against: str) -> Iterator[tuple[str, str, str]]:
    """An inertia that is too small for the mass, or whose radius of gyration is beyond the largest [m]."""
    odd, mass = f"link {link.name!r} has an implausibly {{}} inertia: {{}}", link.mass
    # A ball has the least inertia of all bodies of a given mass and density.
    radius = (3.0 * mass / (4.0 * np.pi * DENSITY)) ** (1.0 / 3.0)
    gyration = float(np.sqrt(link.moments[-1] / mass))
    if link.moments.sum() < 1.2 * mass * radius**2:
        moments = ", ".join(f"{moment:.3g}" for moment in link.moments)
        dense = f"{mass:g} kg with principal moments {moments} kg m^2 would be denser than osmium"
        yield "small", link.name, odd.format("small", dense)
    elif gyration > largest:
        yield "large", link.name, odd.format("large", f"its radius of gyration is {gyration:.3g} m, {against}")


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
        name, link = Path(shape.meshPath).name or shape.name, robot.model.frames[shape.parentFrame].name
        yield (
            f"mesh {name!r} of link {link!r} is {size:.3g} m long, where the arm reaches {reach:.3g} m: if it is not "
            "in metres, its scale= must make it so"
        )


def _matrix_warnings(robot: Robot, condition: float) -> Iterator[str]:
    try:
        check_inertia(robot)
    except SingularMassMatrix as error:
        yield str(error)
        return
    if condition > CONDITION:
        yield (
            f"the mass matrix is ill-conditioned: with a unit diagonal its condition number is {condition:.1e}, so "
            f"accelerations lose {int(np.log10(condition))} digits"
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
