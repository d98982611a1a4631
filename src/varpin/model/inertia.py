"""Masses and inertias: their faults, those of payloads, and those of shapes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError, RobotError, SingularMassMatrix
from varpin.model.robot import Robot, readable_geometry
from varpin.model.tree import frame_of, mechanism
from varpin.model.urdf import Inertial, listed
from varpin.support.checks import as_floats, finite_array, positive, require_finite

# Relative tolerance of the triangle inequality. A thin plate satisfies it with equality, and misses it by about this
# much if its numbers are rounded.
TRIANGLE_TOLERANCE = 1e-3
# Below this squared radius of gyration [m^2], a link is a point mass and its moments are rounding errors.
POINT = 1e-12
# No link of an arm, or of a crane, weighs more [kg]; a link of 100 g whose mesh is in mm does, 1e9 times too much.
HEAVY = 1e6
# A mesh is closed if the norm of its summed directed areas is at most this share of its area.
_CLOSED = 1e-3


def principal_moments(inertia: Floats) -> Floats:
    """Principal moments (3,), ascending [kg m^2], of an inertia (3, 3)."""
    return np.asarray(np.linalg.eigvalsh(inertia), dtype=np.float64)


def fault(link: str, mass: float, moments: Floats) -> tuple[str, str]:
    """The kind of fault of a link's mass [kg] or principal moments (3,), ascending [kg m^2], and a sentence about it.

    Both are empty if there is none.
    """
    if mass < 0.0:
        return "negative mass", f"link {link!r} has mass {mass:g} < 0 [kg]"
    if mass > HEAVY:
        return "heavy", f"link {link!r} has a mass of {mass:.3g} kg: are its sizes in millimetres?"
    if np.abs(moments).max() <= POINT * mass:
        return "", ""
    low, middle, high = moments
    shown = ", ".join(f"{moment:.3g}" for moment in moments)
    kind, sentence = "non-physical inertia", f"link {link!r} has a non-physical inertia: "
    if low < -TRIANGLE_TOLERANCE * abs(high):
        return kind, f"{sentence}it is not positive definite (principal moments {shown} kg m^2)"
    if high > (1.0 + TRIANGLE_TOLERANCE) * (low + middle):
        unequal = f"the triangle inequality, {high:.3g} > {low:.3g} + {middle:.3g}"
        return kind, f"{sentence}its principal moments {shown} kg m^2 violate {unequal}"
    return "", ""


def one_of_each(found: Iterable[tuple[str, str, str]]) -> Iterator[str]:
    """The first sentence of each kind, and which others it is true of."""
    kinds: dict[str, list[tuple[str, str]]] = {}
    for kind, name, sentence in found:
        if sentence:
            kinds.setdefault(kind, []).append((name, sentence))
    for (_, sentence), *others in kinds.values():
        names = ", ".join(repr(name) for name, _ in others[:2]) + (f", {len(others) - 2} more" if others[2:] else "")
        also = f"also {names}" if len(sentence) + len(names) < 230 else f"{len(others)} more"
        yield sentence + (f" ({also})" if others else "")


def faults(model: pin.Model, inertials: Iterable[Inertial]) -> Iterator[str]:
    """Faults of the inertias of a model's moving links, one sentence a kind."""
    links = {frame.name: frame.parentJoint for frame in model.frames if frame.type == pin.FrameType.BODY}
    found = [each for each in inertials if links.get(each.link, 0)] or inertials_of(model)
    return one_of_each(
        (kind, each.link, sentence)
        for each in found
        if np.isfinite(each.inertia).all()
        for kind, sentence in [fault(each.link, each.mass, principal_moments(each.inertia))]
    )


def inertials_of(model: pin.Model) -> list[Inertial]:
    """The bodies of a model's joints, with the name of their first link, or of the joint if it has no link."""
    links = {frame.parentJoint: frame.name for frame in reversed(model.frames) if frame.type == pin.FrameType.BODY}
    bodies = list(enumerate(model.inertias))[1:]
    return [Inertial(links.get(j, model.names[j]), x.mass, np.array(x.lever), np.array(x.inertia)) for j, x in bodies]


def inertial_numbers(robot: Robot, link: str) -> tuple[int, Floats]:
    """The joint of the body that a link is part of, and the body's m, m c and moments about the joint's origin (10,).

    Raises:
        UnknownFrame: There is no such link.
        InputError: The link belongs to the base.
    """
    joint = frame_of(robot.model, link, robot.name).parentJoint
    if joint == 0:
        raise InputError(f"link {link!r} of robot {robot.name!r} belongs to the base, which does not move")
    return joint, np.array(robot.model.inertias[joint].toDynamicParameters())


def pseudo_inertia(numbers: Floats) -> Floats:
    """The matrix [[S, h], [h', m]] (4, 4) of m, h = m c, and moments I (10,), S = tr(I) / 2 - I."""
    return np.asarray(pin.PseudoInertia.FromDynamicParameters(numbers).toMatrix())


def of_pseudo_inertia(matrix: Floats) -> Floats:
    """The numbers (10,) of :func:`pseudo_inertia`, in which they are linear."""
    return np.asarray(pin.PseudoInertia.FromMatrix(matrix).toDynamicParameters())


def point_mass(robot: Robot, frame: str) -> tuple[int, Floats]:
    """The joint that moves a frame, and the numbers (10,) of :func:`inertial_numbers` of 1 kg at its origin."""
    joint, _ = inertial_numbers(robot, frame)
    place = frame_of(robot.model, frame, robot.name).placement
    return joint, np.array(pin.Inertia(1.0, place.translation, np.zeros((3, 3))).toDynamicParameters())


def with_inertial_numbers(robot: Robot, added: Mapping[int, Floats]) -> Robot:
    """The robot with numbers (10,) of :func:`inertial_numbers` added to bodies by joint; they are not checked."""
    model = robot.model.copy()
    for joint, numbers in added.items():
        both = np.array(model.inertias[joint].toDynamicParameters()) + numbers
        model.inertias[joint] = pin.Inertia.FromDynamicParameters(both)
    return robot.changed(model=model, inertials=())


def check_inertia(robot: Robot) -> None:
    """Refuse a robot whose mass matrix is singular at q = 0 or at a few seeded random configurations."""
    rng, core = np.random.default_rng(0), mechanism(robot.tree)
    for q in [np.zeros(robot.dof), *rng.uniform(-np.pi, np.pi, (3, robot.dof))]:
        with np.errstate(all="ignore"):
            M = core.jet(q, np.zeros(robot.dof))[-1]
        if not np.isfinite(M).all():
            raise RobotError(
                f"the mass matrix of robot {robot.name!r} is not finite: masses, inertias, distances or "
                "mimic multipliers are beyond the range of floating-point numbers"
            )
        inertia = np.diag(M)
        scale = np.sqrt(np.where(inertia > 0.0, inertia, 1.0))
        values, vectors = np.linalg.eigh(M / np.outer(scale, scale))
        rounding = robot.dof * np.finfo(float).eps
        if values[0] > rounding:
            continue
        negative = bool(values[0] < -rounding)
        weights = np.abs(vectors[:, values < -rounding if negative else values <= rounding]).max(axis=1)
        faulty = weights >= 0.5 * weights.max()
        # Beside a link of a billion kg every other inertia is a rounding error.
        heavy = next((text for text in faults(robot.model, ()) if " has a mass of " in text), "")
        raise SingularMassMatrix(
            np.array(robot.joint_names)[faulty].tolist(), negative=negative, cause=heavy, hint="".join(robot.faults[:1])
        )


@dataclass(frozen=True, eq=False)
class Payload:
    """A rigid body fastened to a frame of the robot.

    Attributes:
        frame: Name of the frame.
        mass: Mass [kg], > 0.
        center: Centre of mass (3,) in the frame [m].
        inertia: Inertia about the centre of mass, in the frame's axes [kg m^2]: 0 for a point mass, (3,) principal
            moments along the axes, or (3, 3).
    """

    frame: str
    mass: float
    center: ArrayLike = (0.0, 0.0, 0.0)
    inertia: ArrayLike = 0.0

    def __post_init__(self) -> None:
        positive("payload mass", self.mass, "kg")
        finite_array("payload center", self.center, (3,))
        self.moments()

    def moments(self) -> Floats:
        """The inertia as a matrix (3, 3).

        Raises:
            InputError: No rigid body has it: it is not symmetric, is negative, or violates the triangle inequality.
        """
        given = require_finite("payload inertia", as_floats("payload inertia", self.inertia))
        if given.shape not in ((), (3,), (3, 3)) or (given.ndim == 0 and given != 0.0):
            raise InputError(
                "payload inertia must be 0, three principal moments or a matrix (3, 3), got "
                + (f"{given:g}" if given.ndim == 0 else f"shape {given.shape}")
            )
        matrix = given * np.eye(3) if given.ndim < 2 else given
        size = float(np.abs(matrix).max())
        if np.abs(matrix - matrix.T).max() > 1e-9 * size:
            raise InputError("payload inertia must be symmetric")
        _, sentence = fault(self.frame, float(self.mass), principal_moments(matrix))
        if sentence:
            raise InputError(f"payload inertia: {sentence}")
        return np.asarray(matrix)


def carry(model: pin.Model, payload: Sequence[Payload], robot: str) -> None:
    """Add payloads to the links of ``model``."""
    for part in payload:
        frame = frame_of(model, part.frame, robot)
        if frame.parentJoint == 0:
            raise InputError(
                f"payload of robot {robot!r}: frame {part.frame!r} belongs to the base, which does not move"
            )
        body = pin.Inertia(float(part.mass), np.array(part.center, dtype=float), part.moments())
        model.appendBodyToJoint(frame.parentJoint, body, frame.placement)


def _gaps(shape: pin.coal.CollisionGeometry) -> float:
    """Norm of the sum of a mesh's directed areas as a share of its area: 0 for a closed mesh."""
    if not isinstance(shape, pin.coal.BVHModelBase):
        return 0.0
    corners = np.asarray(shape.vertices(), dtype=float)[
        [[triangle[k] for k in range(3)] for triangle in map(shape.tri_indices, range(shape.num_tris))]
    ]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = float(np.linalg.norm(areas, axis=1).sum())
    return float(np.linalg.norm(areas.sum(axis=0))) / total if total > 0.0 else 1.0


def with_mesh_inertias(robot: Robot, density: float) -> Robot:
    """Give the links of a URDF that have no inertia that of their visual shapes, at uniform density [kg/m^3]."""
    density = positive("density", density, "kg/m^3")
    if robot.urdf is None:
        raise InputError(f"inertia='meshes' needs a URDF file; {robot.name!r} does not come from one")
    known = {inertial.link for inertial in robot.inertials}
    shapes, unread = readable_geometry(robot)
    for link, (_, what) in unread.items():
        if link not in known:
            raise RobotError(what)
    model, masses = robot.model.copy(), dict[str, float]()
    for shape in shapes.geometryObjects:
        link = model.frames[shape.parentFrame].name
        if link in known:
            continue
        volume = float(shape.geometry.computeVolume())
        if not (np.isfinite(volume) and volume > 0.0) or _gaps(shape.geometry) > _CLOSED:
            raise RobotError(
                f"link {link!r}: {shape.meshPath or shape.name} bounds no volume ({volume:g} m^3): its triangles leave "
                "gaps or face inwards; give the link an <inertial>"
            )
        center = np.asarray(shape.geometry.computeCOM(), dtype=float).reshape(3)
        moments = np.asarray(shape.geometry.computeMomentofInertiaRelatedToCOM(), dtype=float)
        body = pin.Inertia(density * volume, center, 0.5 * density * (moments + moments.T))
        model.appendBodyToJoint(shape.parentJoint, body, shape.placement)
        masses[link] = masses.get(link, 0.0) + density * volume
    weighed = listed((f"{link!r} {mass:.3g} kg" for link, mass in masses.items()), "links")
    remark = f"links without an inertia have that of their shapes at {density:g} kg/m^3: {weighed}"
    return robot.changed(model=model, remarks=(*robot.remarks, remark)) if masses else robot
