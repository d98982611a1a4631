"""Distances between links and to obstacles, with derivatives from the nearest points."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import scipy
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError, RobotError
from varpin.model.meshes import MeshPart, joined, read_mesh, shape_points
from varpin.model.robot import Robot, readable_geometry
from varpin.model.tree import frame_of, z_to
from varpin.model.urdf import read_xml
from varpin.support.checks import (
    as_floats,
    finite_array,
    over_time,
    path_like,
    positive,
    require_finite,
    require_function,
    rotation_matrix,
)
from varpin.support.frozen import Frozen

coal = pin.coal

# coal counts the edges that meet in a vertex with 8 bits.
_EDGES = 254
# coal's tolerance; its own of 1e-6 leaves errors of 4e-7 m in distances to some hulls, and of 1e-3 in their direction.
_TOLERANCE = 1e-10


def hull_around(name: str, points: ArrayLike) -> MeshPart:
    """The convex hull of points (N, 3) [m], N >= 4."""
    given = as_floats(name, points)
    if given.ndim != 2 or given.shape[1] != 3 or len(given) < 4:
        raise InputError(f"{name} must have shape (N, 3) with N >= 4, got {given.shape}")
    try:
        found = scipy.spatial.ConvexHull(require_finite(name, given))
    except scipy.spatial.QhullError:
        raise InputError(f"{name} lie in a plane, and a hull needs a volume: give points on both sides of it") from None
    place = np.full(len(given), -1)
    place[found.vertices] = np.arange(len(found.vertices))
    corners, faces = given[found.vertices], place[found.simplices]
    a, b, c = (corners[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * found.equations[:, :3]).sum(axis=1) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    most = int(np.bincount(faces.ravel()).max())
    if most > _EDGES:
        raise InputError(f"{name} have a hull with {most} edges at one vertex, more than {_EDGES}: give fewer points")
    return MeshPart(corners, faces)


@dataclass(frozen=True, eq=False)
class Obstacle(Frozen):
    """A convex body in the world, fixed or moving: all that is within a radius of the hull of some points.

    Made by :meth:`sphere`, :meth:`capsule`, :meth:`box`, :meth:`convex` and :meth:`mesh`.

        ball = vp.Obstacle.sphere([0.5, 0.0, 0.4], 0.1).moving(lambda t: [0.0, 0.2 * np.sin(t), 0.0])

    Attributes:
        name: Name in messages.
        points: The points (P, 3) in its own axes [m]: one of a ball, both ends of a capsule, else vertices of the hull.
        radius: Radius [m]; 0 for a box or a hull.
        position: Origin of its axes in the world (3,) [m].
        rotation: Its axes in the world (3, 3).
        shift: Displacement (3,) [m] at a time [s]; None if the obstacle is fixed.
    """

    name: str
    points: Floats
    radius: float = 0.0
    position: Floats = field(default_factory=lambda: np.zeros(3))
    rotation: Floats = field(default_factory=lambda: np.eye(3))
    shift: Callable[[float], ArrayLike] | None = None

    @classmethod
    def sphere(cls, center: ArrayLike, radius: float, name: str = "sphere") -> Obstacle:
        """A ball with ``center`` (3,) [m] and ``radius`` [m]."""
        at = finite_array(f"{name} center", center, (3,))
        return cls(str(name), np.zeros((1, 3)), positive(f"{name} radius", radius, "m"), at)

    @classmethod
    def capsule(cls, begin: ArrayLike, end: ArrayLike, radius: float, name: str = "capsule") -> Obstacle:
        """The points within ``radius`` [m] of the segment from ``begin`` (3,) to ``end`` (3,) [m]."""
        ends = finite_array(f"{name} begin", begin, (3,)), finite_array(f"{name} end", end, (3,))
        return cls(str(name), np.array(ends), positive(f"{name} radius", radius, "m"))

    @classmethod
    def box(cls, center: ArrayLike, sides: ArrayLike, rotation: ArrayLike | None = None, name: str = "box") -> Obstacle:
        """A box with ``sides`` (3,) [m] and ``center`` (3,) [m], turned by a ``rotation`` (3, 3)."""
        at, size = finite_array(f"{name} center", center, (3,)), finite_array(f"{name} sides", sides, (3,))
        if not (size > 0.0).all():
            raise InputError(f"{name} sides must be > 0 [m], got {size}")
        return cls.convex(size * list(product((-0.5, 0.5), repeat=3)), at, rotation, name)

    @classmethod
    def convex(
        cls,
        points: ArrayLike,
        position: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike | None = None,
        name: str = "convex",
    ) -> Obstacle:
        """The convex hull of ``points`` (N, 3) [m], N >= 4, that do not lie in a plane.

        The points are in axes with their origin at ``position`` (3,) [m] in the world, turned by a ``rotation`` (3, 3).
        """
        at = finite_array(f"{name} position", position, (3,))
        R = np.eye(3) if rotation is None else rotation_matrix(f"{name} rotation", rotation)
        return cls(str(name), hull_around(f"{name} points", points).vertices, 0.0, at, R)

    @classmethod
    def mesh(
        cls,
        path: str | os.PathLike[str],
        scale: float = 1.0,
        position: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike | None = None,
        name: str | None = None,
    ) -> Obstacle:
        """The convex hull of the vertices of a mesh file (STL, OBJ, DAE), times ``scale``, placed as in :meth:`convex`.

        Hollows of the mesh are filled. It has the file's name if ``name`` is left out.

        Raises:
            FileError: The file is missing or is no mesh that can be read.
        """
        file, factor = path_like("mesh path", path), positive("mesh scale", scale, "1")
        points = joined(read_mesh(str(file))).vertices * factor
        return cls.convex(points, position, rotation, Path(path).stem if name is None else name)

    @property
    def body(self) -> tuple[Any, pin.SE3]:
        """The body for coal, and its placement before the obstacle moves."""
        if len(self.points) > 2:
            hull, points, triangles = hull_around(self.name, self.points), coal.StdVec_Vec3s(), coal.StdVec_Triangle()
            points.extend(hull.vertices)
            triangles.extend(coal.Triangle(*map(int, face)) for face in hull.faces)
            return coal.Convex(points, triangles), pin.SE3(self.rotation, self.position)
        way = self.points[-1] - self.points[0]
        length = float(np.linalg.norm(way))
        # A capsule is along its z axis.
        axes = z_to(way / length) if length > 0.0 else self.rotation
        return coal.Capsule(self.radius, length), pin.SE3(axes, self.position + self.points.mean(axis=0))

    def moving(self, shift: Callable[[float], ArrayLike]) -> Obstacle:
        """The obstacle displaced by ``shift(t)`` (3,) [m] from its described position at each time t [s].

        It does not turn. A constrained plan uses its motion over the whole horizon.

        Raises:
            InputError: ``shift`` is no function, or the obstacle moves already.
        """
        require_function("Obstacle.moving: shift", shift, "time")
        if self.shift is not None:
            raise InputError(f"obstacle {self.name!r} moves already: add both ways up in one function")
        return replace(self, shift=shift)

    def shifts(self, times: Floats) -> Floats:
        """Its displacement (N, 3) [m] at times (N,) [s]; zero if it is fixed.

        Raises:
            InputError: Its function fails, or does not return three finite numbers.
        """
        if self.shift is None:
            return np.zeros((len(times), 3))
        return over_time(f"the way of obstacle {self.name!r}", self.shift, times, 3)

    def __repr__(self) -> str:
        kind, given = "convex", [self.points.tolist(), self.position.tolist(), self.rotation.tolist()]
        if len(self.points) == 1:
            kind, given = "sphere", [self.position.tolist(), self.radius]
        elif len(self.points) == 2:
            kind, given = "capsule", [*self.points.tolist(), self.radius]
        moving = "" if self.shift is None else f".moving({self.shift!r})"
        return f"Obstacle.{kind}({', '.join(map(repr, [*given, self.name]))}){moving}"


@dataclass(frozen=True, eq=False)
class Clearance(Frozen):
    """Distances of pairs of bodies, links among them. Made by :func:`clearance`."""

    robot: Robot
    links: tuple[Obstacle, ...]  # capsules in the axes of the frames whose names they have
    obstacles: tuple[Obstacle, ...]
    pairs: tuple[tuple[int, int], ...]  # indices of links and, after them, obstacles
    shifts: Mapping[int, Floats] = field(default_factory=dict)  # of moving obstacles at the times (K, 3) [m]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of both bodies of each pair."""
        bodies = (*self.links, *self.obstacles)
        return tuple(f"{bodies[i].name} and {bodies[k].name}" for i, k in self.pairs)

    @property
    def capsules(self) -> dict[str, tuple[list[float], list[float], float]]:
        """Ends and radius of the capsules of the links that joints move, by name."""
        moving = (link for link in self.links if _joint(self.robot, link.name))
        return {link.name: (*link.points.tolist(), link.radius) for link in moving}

    def over(self, times: Floats) -> Clearance:
        """The same with the obstacles at times (K,) [s].

        The N rows of q passed to :meth:`distances` are then at these times: N is a multiple of K, and row i belongs to
        the time i mod K.
        """
        bodies = enumerate(self.obstacles, len(self.links))
        shifts = {i: body.shifts(times) for i, body in bodies if body.shift is not None}
        # The bodies stay.
        return self.changed(shifts=shifts, _shapes=self._shapes, _moved=self._moved) if shifts else self

    def distances(self, q: Floats) -> Floats:
        """The distance of each pair (N, pairs) [m] at q (N, n); negative where they overlap."""
        found = [[own.min_distance for own in results] for results, _ in self._results(q)]
        return np.array(found).reshape(len(q), len(self.pairs))

    def slopes(self, q: Floats) -> Floats:
        """Derivatives of the distances in q (N, pairs, n), from the nearest points of each pair."""
        model, n = self.robot.model, q.shape[1]
        (points, normals), J = np.empty((2, len(q), len(self.pairs), 3)), np.empty((len(q), 6, model.nv))
        for row, (results, data) in enumerate(self._results(q)):
            points[row] = [own.getNearestPoint1() for own in results]
            normals[row] = [own.normal for own in results]
            # Of what is at the world's origin.
            J[row] = pin.computeJointJacobians(model, data).reshape(6, -1)
        # The nearest point of the second body is on the same line.
        along = np.concatenate([normals, np.cross(points, normals)], axis=2) @ J
        first, second = np.array(self.pairs).T
        found: Floats = along * (self._moved[second] - self._moved[first]) @ self.robot.velocity(np.eye(n)).T
        return found

    @cached_property
    def _moved(self) -> Floats:
        """1 where a joint of the robot's model moves a body, else 0 (bodies, joints)."""
        model = self.robot.model
        found = np.zeros((len(self.links) + len(self.obstacles), model.njoints))
        for i, link in enumerate(self.links):
            found[i, list(model.supports[_joint(self.robot, link.name)])] = 1.0
        return found[:, 1:]

    @cached_property
    def _shapes(self) -> pin.GeometryModel:
        """The bodies on the joints of the robot's model, with the pairs."""
        model, shapes = self.robot.model, pin.GeometryModel()
        frames = [frame_of(model, link.name, self.robot.name) for link in self.links]
        frames += [model.frames[0]] * len(self.obstacles)
        for i, (own, frame) in enumerate(zip((*self.links, *self.obstacles), frames, strict=True)):
            shape, place = own.body
            shapes.addGeometryObject(pin.GeometryObject(str(i), frame.parentJoint, frame.placement * place, shape))
        for pair in self.pairs:
            shapes.addCollisionPair(pin.CollisionPair(*pair))
        return shapes

    def _results(self, q: Floats) -> Iterator[tuple[list[Any], pin.Data]]:
        """What coal finds of each pair, and where joints are, for each row of q; valid until the next row."""
        model, shapes, request = self.robot.model, self._shapes, coal.DistanceRequest()
        request.gjk_tolerance = request.epa_tolerance = _TOLERANCE
        data, at = model.createData(), shapes.createData()
        for p in range(len(self.pairs)):
            at.distanceRequests[p] = request
        # Python takes longer to find the results than coal does.
        results = list(at.distanceResults)
        for row, configuration in enumerate(self.robot.configuration(q)):
            pin.updateGeometryPlacements(model, data, shapes, at, configuration)
            for i, shifts in self.shifts.items():
                at.oMg[i].translation = at.oMg[i].translation + shifts[row % len(shifts)]
            pin.computeDistances(shapes, at)
            yield results, data


def _joint(robot: Robot, frame: str) -> int:
    """The joint in the robot's model that moves a frame; 0 if none does."""
    return int(frame_of(robot.model, frame, robot.name).parentJoint)


def clearance(
    robot: Robot,
    obstacles: Sequence[Obstacle],
    *,
    links: Sequence[str] | None = None,
    itself: bool = False,
    srdf: Path | None = None,
    capsules: Mapping[str, tuple[ArrayLike, ArrayLike, float]] | None = None,
) -> Clearance:
    """Distances of a robot's links, each in a capsule, to obstacles and to each other; see :class:`varpin.KeepClear`.

    ``itself`` pairs links with each other, except neighbours (links on the same joint or on successive joints), links
    that overlap at q = 0, and the pairs of ``disable_collisions`` in an ``srdf`` file.
    """
    if capsules is not None and not isinstance(capsules, Mapping):
        raise InputError(f"capsules must be a dictionary, link: (begin, end, radius), got {type(capsules).__name__}")
    given = dict(capsules or {})
    for name, capsule in given.items():
        if not isinstance(capsule, Sequence) or len(capsule) != 3:
            raise InputError(f"capsules[{name!r}] must be (begin, end, radius), got {capsule!r}")
    if links is not None and len(set(links)) < len(links):
        raise InputError(f"links has a name twice: {', '.join(map(str, links))}")
    fitted = {} if links is not None and set(links) <= set(given) else _vertices(robot, links, given)
    names = list(dict.fromkeys([*fitted, *given])) if links is None else list(links)
    joints = [_joint(robot, name) for name in names]
    bodies = []
    for name in names:
        if name in given:
            bodies.append(replace(Obstacle.capsule(*given[name], f"capsules[{name!r}]"), name=name))
        elif name in fitted:
            bodies.append(Obstacle.capsule(*capsule_around(fitted[name]), name))
        else:
            raise InputError(f"link {name!r} of robot {robot.name!r} has no shape; give capsules={{{name!r}: ...}}")
    pairs = _of_links(robot, bodies, joints, _disabled(robot, srdf)) if itself else []
    for k in range(len(obstacles)):
        pairs += [(i, len(bodies) + k) for i, joint in enumerate(joints) if joint]
    if not pairs:
        raise InputError(
            f"robot {robot.name!r} has nothing to keep clear of: give obstacles, or itself=True, and links with shapes "
            "or capsules"
        )
    return Clearance(robot, tuple(bodies), tuple(obstacles), tuple(pairs))


def _of_links(
    robot: Robot, bodies: Sequence[Obstacle], joints: Sequence[int], disabled: set[frozenset[str]]
) -> list[tuple[int, int]]:
    """Pairs of links that are not neighbours."""
    parents, found = robot.model.parents, []
    for i, one in enumerate(joints):
        for k, other in enumerate(joints[:i]):
            near = one == other or parents[one] == other or parents[other] == one
            if not near and frozenset((bodies[i].name, bodies[k].name)) not in disabled:
                found.append((k, i))
    if not found:
        return []
    apart = Clearance(robot, tuple(bodies), (), tuple(found)).distances(np.zeros((1, robot.dof)))[0]
    return [pair for pair, d in zip(found, apart, strict=True) if d > 0.0]


def _disabled(robot: Robot, srdf: Path | None) -> set[frozenset[str]]:
    """Pairs of links that an SRDF file excludes from collision checks."""
    if srdf is None:
        return set()
    root = read_xml(srdf, kind="SRDF")
    pairs = {frozenset((e.get("link1", ""), e.get("link2", ""))) for e in root.findall("disable_collisions")}
    links = {link for pair in pairs for link in pair}
    if links.isdisjoint(frame.name for frame in robot.model.frames):
        raise InputError(f"{srdf} leaves out no pair of links of robot {robot.name!r}: give the robot's own SRDF")
    return pairs


def _vertices(robot: Robot, links: Sequence[str] | None, given: Collection[str]) -> dict[str, Floats]:
    """Points (N, 3) [m], in each link's axes, whose hull contains the shapes of the link.

    Those of ``links``, or of all if None, must be readable, but for links with a given capsule.
    """
    found: dict[str, list[Floats]] = {}
    shapes, faulty = readable_geometry(robot)
    for name, (_, what) in faulty.items():
        if (links is None or name in links) and name not in given:
            raise RobotError(f"{what}; give capsules={{{name!r}: (begin, end, radius)}}, or links= without it")
    for shape in shapes.geometryObjects:
        frame = robot.model.frames[shape.parentFrame]
        place = frame.placement.inverse()
        found.setdefault(frame.name, []).append(shape_points(shape) @ place.rotation.T + place.translation)
    return {name: np.vstack(parts) for name, parts in found.items()}


def capsule_around(points: Floats) -> tuple[Floats, Floats, float]:
    """Ends and radius of the smallest capsule around points (N, 3) with its axis along one of their principal axes."""
    center = points.mean(axis=0)
    axes = np.linalg.svd(points - center, full_matrices=False)[2]
    found = []
    for i, axis in enumerate(axes):
        across = np.delete(axes, i, axis=0)
        lateral = (points - center) @ across.T
        middle = 0.5 * (lateral.min(axis=0) + lateral.max(axis=0))
        away = np.linalg.norm(lateral - middle, axis=1)
        radius = float(away.max()) * (1.0 + 1e-12)
        reach = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
        along = (points - center) @ axis
        low, high = float((along + reach).min()), float((along - reach).max())
        if low > high:
            low = high = 0.5 * (low + high)
        volume = radius**2 * (high - low) + 4.0 / 3.0 * radius**3
        base = center + middle @ across
        found.append((volume, i, base + low * axis, base + high * axis, radius))
    _, _, begin, end, radius = min(found)
    if not radius > 0.0:
        raise InputError("points of no extent have no capsule around them")
    return begin, end, radius
