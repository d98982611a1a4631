"""Additions to a robot's description: base placement or planar base, armature, inertias from meshes."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from varpin.errors import InputError, RobotError, UnknownJoint
from varpin.model.mimic import Tie, joint_index
from varpin.model.sources import Description
from varpin.model.urdf import build_shapes, listed, read_urdf
from varpin.support.checks import JointValues, as_floats, broadcast_array, finite, positive

Base: TypeAlias = Literal["planar"] | ArrayLike | pin.SE3 | None

# A mesh is closed if the norm of its summed directed areas is at most this share of its area.
_CLOSED = 1e-3
# Joints of the planar base.
PLANAR = ("base_x", "base_y", "base_turn")


def on_base(description: Description, base: Base) -> Description:
    """The robot on a placed base, (4, 4) or a pin.SE3, or on a base that moves in a plane.

    Raises:
        InputError: ``base`` is none of these, or a joint of the robot has the name of a joint of the planar base.
    """
    if base is None:
        return description
    if not isinstance(base, str):
        return description.rebuilt(place=transform(base, "base", ", or 'planar'"))
    if base != "planar":
        raise InputError(f"base must be 'planar', a transform (4, 4) or a pin.SE3, got {base!r}")
    if taken := sorted(set(PLANAR) & set(description.model.names)):
        raise InputError(f"base='planar' adds the joints {', '.join(PLANAR)}, but the robot already has {taken[0]!r}")
    kinds = pin.JointModelPX(), pin.JointModelPY(), pin.JointModelRZ()
    return description.rebuilt(root=tuple(zip(PLANAR, kinds, strict=True)))


def transform(base: ArrayLike | pin.SE3, what: str, otherwise: str = "") -> pin.SE3:
    """A placement from a matrix (4, 4) of rounded numbers.

    Raises:
        InputError: It is none; the message calls it ``what``, and names what it may be ``otherwise``.
    """
    matrix = as_floats(what, base.homogeneous if isinstance(base, pin.SE3) else base)
    if matrix.shape != (4, 4):
        raise InputError(f"{what} must be a transform (4, 4) or a pin.SE3{otherwise}, got shape {matrix.shape}")
    turn = matrix[:3, :3]
    rigid = np.isfinite(matrix).all() and np.abs(turn.T @ turn - np.eye(3)).max() < 1e-6 and np.linalg.det(turn) > 0.0
    if not rigid or (matrix[3] != [0.0, 0.0, 0.0, 1.0]).any():
        raise InputError(f"{what} must be a rotation and a translation, with 0 0 0 1 in its last row")
    u, _, v = np.linalg.svd(turn)
    return pin.SE3(u @ v, matrix[:3, 3])


def with_rotors(model: pin.Model, armature: JointValues | None, ties: Sequence[Tie], others: Collection[str]) -> None:
    """Replace the armature of the model's coordinates by a number, (n,) or values by joint name.

    Values of ``others``, the locked joints, are ignored.

    Raises:
        UnknownJoint: A name is of no coordinate.
        InputError: A value is negative or not finite.
    """
    if armature is None:
        return
    followers = {tie.follower for tie in ties}
    coordinates = [joint for joint in range(1, model.njoints) if joint not in followers]
    names = tuple(model.names[joint] for joint in coordinates)
    armatures = np.array([model.armature[model.joints[joint].idx_v] for joint in coordinates])
    if isinstance(armature, Mapping):
        for name, number in armature.items():
            value = finite(f"armature[{name!r}]", number)
            if name in names:
                armatures[names.index(name)] = value
            elif name not in others:
                raise UnknownJoint(str(name), names, "armature")
    else:
        armatures = broadcast_array("armature", armature, len(names))
    if (armatures < 0.0).any():
        worst = int(np.argmin(armatures))
        raise InputError(f"armature of joint {names[worst]!r} must be >= 0 [kg m^2 or kg], got {armatures[worst]:g}")
    values = np.array(model.armature)
    values[[model.joints[joint].idx_v for joint in coordinates]] = armatures
    model.armature = values


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


def with_mesh_inertias(description: Description, density: float) -> Description:
    """Give the links of a URDF that have no inertia that of their visual shapes, at uniform density [kg/m^3].

    Raises:
        InputError: The robot does not come from a URDF, or the density is not positive.
        RobotError: A mesh is missing, cannot be read, or bounds no volume; the message names link and file.
    """
    density = positive("density", density, "kg/m^3")
    if description.urdf is None:
        raise InputError(f"inertia='meshes' needs a URDF file; {description.name!r} does not come from one")
    urdf = read_urdf(description.urdf, description.expanded)
    known = {inertial.link for inertial in description.inertials}
    shapes, faults = build_shapes(urdf, description.package_dirs)
    for link, fault in faults.items():
        if link not in known:
            raise RobotError(fault)
    model, index = description.model.copy(), joint_index(description.model)
    masses: dict[str, float] = {}
    for shape in shapes.geometryObjects:
        link = urdf.model.frames[shape.parentFrame].name
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
        model.appendBodyToJoint(index.get(urdf.model.names[shape.parentJoint], 0), body, shape.placement)
        masses[link] = masses.get(link, 0.0) + density * volume
    weighed = listed((f"{link!r} {mass:.3g} kg" for link, mass in masses.items()), "links")
    remark = f"links without an inertia have that of their shapes at {density:g} kg/m^3: {weighed}"
    return replace(description, model=model, remarks=(*description.remarks, remark) if masses else description.remarks)
