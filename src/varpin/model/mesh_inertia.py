"""Inertias of links from their visual shapes."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from varpin.errors import InputError, RobotError
from varpin.model.mimic import joint_index
from varpin.model.robot import Robot
from varpin.model.urdf import build_shapes, listed, read_urdf
from varpin.support.checks import positive

# A mesh is closed if the norm of its summed directed areas is at most this share of its area.
_CLOSED = 1e-3


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
    urdf = read_urdf(robot.urdf, robot.expanded)
    known = {inertial.link for inertial in robot.inertials}
    shapes, faults = build_shapes(urdf, robot.package_dirs)
    for link, fault in faults.items():
        if link not in known:
            raise RobotError(fault)
    model, index = robot.model.copy(), joint_index(robot.model)
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
    return robot.changed(model=model, remarks=(*robot.remarks, remark)) if masses else robot
