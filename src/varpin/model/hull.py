"""Convex hulls of points and of mesh files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin
import scipy
from numpy.typing import ArrayLike, NDArray

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.support.checks import as_floats, require_finite
from varpin.support.frozen import Frozen

coal = pin.coal

# A hull whose least thickness is below this share of its greatest extent is flat.
_FLAT = 1e-9
# coal counts the edges that meet in a vertex with 8 bits.
_EDGES = 254


@dataclass(frozen=True, eq=False)
class Hull(Frozen):
    """A convex polyhedron. Made by :func:`hull_around`."""

    points: Floats  # its vertices (P, 3) [m]
    faces: NDArray[np.int64]  # indices of the vertices of its triangles (F, 3), anticlockwise from outside

    @property
    def sides(self) -> Floats:
        """Sides of the box around it along its axes (3,) [m]."""
        found: Floats = np.ptp(self.points, axis=0)
        return found

    @cached_property
    def shape(self) -> Any:
        """The polyhedron for coal."""
        points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        points.extend(self.points)
        triangles.extend(coal.Triangle(*map(int, face)) for face in self.faces)
        return coal.Convex(points, triangles)


def hull_around(name: str, points: ArrayLike) -> Hull:
    """The convex hull of points (N, 3) [m], N >= 4."""
    given = as_floats(name, points)
    if given.ndim != 2 or given.shape[1] != 3 or len(given) < 4:
        raise InputError(f"{name} must have shape (N, 3) with N >= 4, got {given.shape}")
    require_finite(name, given)
    extents = np.linalg.svd(given - given.mean(axis=0), compute_uv=False)
    flat = InputError(f"{name} lie in a plane, and a hull needs a volume: give points on both sides of it")
    if extents[2] <= _FLAT * extents[0]:
        raise flat
    try:
        found = scipy.spatial.ConvexHull(given)
    except scipy.spatial.QhullError:
        raise flat from None
    place = np.full(len(given), -1)
    place[found.vertices] = np.arange(len(found.vertices))
    corners, faces = given[found.vertices], place[found.simplices]
    a, b, c = (corners[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * found.equations[:, :3]).sum(axis=1) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    most = int(np.bincount(faces.ravel()).max())
    if most > _EDGES:
        raise InputError(f"{name} have a hull with {most} edges at one vertex, more than {_EDGES}: give fewer points")
    return Hull(corners, faces)
