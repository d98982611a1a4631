"""Distances between links and to obstacles, with derivatives from the nearest points."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.errors import InputError, RobotError
from varpin.model.hull import Hull, hull_around
from varpin.model.kinematics import FrameKinematics, frame_kinematics
from varpin.model.meshes import joined, read_mesh, shape_points
from varpin.model.robot import Robot, readable_geometry
from varpin.model.tree import place_of_frame, z_to
from varpin.model.urdf import read_xml
from varpin.support.checks import finite_array, over_time, path_like, positive, require_function, rotation_matrix
from varpin.support.frozen import Frozen

coal = pin.coal

# coal's tolerance; its own of 1e-6 leaves errors of 4e-7 m in distances to some hulls, and of 1e-3 in their direction.
_TOLERANCE = 1e-10


@dataclass(frozen=True, eq=False)
class Obstacle(Frozen):
    """A body in the world, fixed or moving.

    Made by :meth:`sphere`, :meth:`capsule`, :meth:`box`, :meth:`convex` and :meth:`mesh`.

        ball = vp.Obstacle.sphere([0.5, 0.0, 0.4], 0.1).moving(lambda t: [0.0, 0.2 * np.sin(t), 0.0])

    Attributes:
        name: Name in messages.
        begin: One end of its axis (3,) [m]; the centre of a sphere, a box or the box around a hull.
        end: The other end (3,) [m].
        radius: Radius [m]; 0 for a box or a hull.
        sides: Sides of a box (3,) [m], else None.
        rotation: Axes of a box or a hull in the world (3, 3).
        hull: A convex hull around its centre and in its axes, else None.
        shift: Displacement (3,) [m] at a time [s]; None if the obstacle is fixed.
    """

    name: str
    begin: Floats
    end: Floats
    radius: float
    sides: Floats | None
    rotation: Floats
    hull: Hull | None = None
    shift: Callable[[float], ArrayLike] | None = None

    @classmethod
    def sphere(cls, center: ArrayLike, radius: float, name: str = "sphere") -> Obstacle:
        """A ball with ``center`` (3,) [m] and ``radius`` [m]."""
        at = finite_array("sphere center", center, (3,))
        return cls(str(name), at, at, positive("sphere radius", radius, "m"), None, np.eye(3))

    @classmethod
    def capsule(cls, begin: ArrayLike, end: ArrayLike, radius: float, name: str = "capsule") -> Obstacle:
        """The points within ``radius`` [m] of the segment from ``begin`` (3,) to ``end`` (3,) [m]."""
        first, last = finite_array("capsule begin", begin, (3,)), finite_array("capsule end", end, (3,))
        return cls(str(name), first, last, positive("capsule radius", radius, "m"), None, np.eye(3))

    @classmethod
    def box(cls, center: ArrayLike, sides: ArrayLike, rotation: ArrayLike | None = None, name: str = "box") -> Obstacle:
        """A box with ``sides`` (3,) [m] and ``center`` (3,) [m], turned by a ``rotation`` (3, 3)."""
        at, size = finite_array("box center", center, (3,)), finite_array("box sides", sides, (3,))
        if not (size > 0.0).all():
            raise InputError(f"box sides must be > 0 [m], got {size}")
        R = np.eye(3) if rotation is None else rotation_matrix("box rotation", rotation)
        return cls(str(name), at, at, 0.0, size, R)

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
        return cls._placed(hull_around("convex points", points), position, rotation, name)

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
        found = hull_around(f"vertices of the mesh {path}", joined(read_mesh(str(file))).vertices * factor)
        return cls._placed(found, position, rotation, Path(path).stem if name is None else name)

    @classmethod
    def _placed(cls, hull: Hull, position: ArrayLike, rotation: ArrayLike | None, name: str) -> Obstacle:
        at = finite_array(f"{name} position", position, (3,))
        R = np.eye(3) if rotation is None else rotation_matrix(f"{name} rotation", rotation)
        middle = 0.5 * (hull.points.min(axis=0) + hull.points.max(axis=0))
        center = at + R @ middle
        return cls(str(name), center, center, 0.0, None, R, hull.changed(points=hull.points - middle))

    @property
    def edged(self) -> bool:
        """Whether it is a box or a hull."""
        return self.sides is not None or self.hull is not None

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
        kind, given = "capsule", [self.begin.tolist(), self.end.tolist(), self.radius]
        if self.sides is not None:
            kind, given = "box", [self.begin.tolist(), self.sides.tolist(), self.rotation.tolist()]
        elif self.hull is not None:
            kind, given = "convex", [self.hull.points.tolist(), self.begin.tolist(), self.rotation.tolist()]
        elif self.begin is self.end:
            kind, given = "sphere", [self.begin.tolist(), self.radius]
        moving = "" if self.shift is None else f".moving({self.shift!r})"
        return f"Obstacle.{kind}({', '.join(map(repr, [*given, self.name]))}){moving}"


@dataclass(frozen=True, eq=False)
class _Body:
    """A body in the world or on a link."""

    solid: Obstacle  # or the link's capsule in its own axes, with the link's name
    kinematics: FrameKinematics | None = None  # of the link; None in the world
    shifts: Floats = field(default_factory=lambda: np.zeros((1, 3)))  # of the obstacle at the times (K, 3) [m]


class Clearance(Frozen):
    """Distances of pairs of bodies, links among them. Made by :func:`clearance`."""

    def __init__(self, bodies: Sequence[_Body], pairs: Sequence[tuple[int, int]]) -> None:
        self._bodies, self._pairs = tuple(bodies), tuple(pairs)
        self.names = tuple(f"{bodies[i].solid.name} and {bodies[k].solid.name}" for i, k in pairs)
        links = [body.solid for body in bodies if body.kinematics]
        self.capsules = {link.name: (link.begin, link.end, link.radius) for link in links}

    @property
    def moves(self) -> bool:
        """Whether an obstacle moves."""
        return any(body.solid.shift is not None for body in self._bodies)

    def over(self, times: Floats) -> Clearance:
        """The same with the obstacles at times (K,) [s].

        The N rows of q passed to :meth:`distances` are then at these times: N is a multiple of K, and row i belongs to
        the time i mod K.
        """
        if not self.moves:
            return self
        bodies = [replace(body, shifts=body.solid.shifts(times)) for body in self._bodies]
        return Clearance(bodies, self._pairs)

    def distances(self, q: Floats) -> Floats:
        """The distance of each pair (N, pairs) [m] at q (N, n); negative where they overlap."""
        return self._measured(q)[0]

    def slopes(self, q: Floats) -> Floats:
        """Derivatives of the distances in q (N, pairs, n), from the nearest points of each pair."""
        _, normal, first, second = self._measured(q)
        N, n = q.shape
        found = np.zeros((N, len(self._pairs), n))
        moving = {i for pair in self._pairs for i in pair if self._bodies[i].kinematics is not None}
        jacobians = {i: self._bodies[i].kinematics.jacobians(q) for i in moving}  # type: ignore[union-attr]
        for p, pair in enumerate(self._pairs):
            for i, points, sign in ((pair[0], first[:, p], -1.0), (pair[1], second[:, p], 1.0)):
                if i in jacobians:
                    _, origin, J = jacobians[i]
                    along = sign * normal[:, p]
                    found[:, p] += np.einsum("Na,Nan->Nn", along, J[:, :3])
                    found[:, p] += np.einsum("Na,Nan->Nn", np.cross(points - origin, along), J[:, 3:])
        return found

    def _measured(self, q: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Distances (N, pairs), unit vectors from first to second (N, pairs, 3), and the nearest points of both."""
        N, P = len(q), len(self._pairs)
        placed = [self._placed(body, np.ascontiguousarray(q)) for body in self._bodies]
        d, normal = np.empty((N, P)), np.empty((N, P, 3))
        first, second = np.empty((N, P, 3)), np.empty((N, P, 3))
        for p, (i, k) in enumerate(self._pairs):
            one, other = self._bodies[i].solid, self._bodies[k].solid
            measure = _edged if one.edged or other.edged else _round
            d[:, p], normal[:, p], first[:, p], second[:, p] = measure(one, other, placed[i], placed[k])
        return d, normal, first, second

    @staticmethod
    def _placed(body: _Body, q: Floats) -> tuple[Floats, Floats, Floats]:
        """Ends of the axis (N, 3) and (N, 3), and the axes of a box or a hull (N, 3, 3), in the world."""
        if body.kinematics is None:
            way = np.tile(body.shifts, (len(q) // len(body.shifts), 1))
            ends = (x + way for x in (body.solid.begin, body.solid.end))
            return *ends, np.broadcast_to(body.solid.rotation, (len(q), 3, 3))  # type: ignore[return-value]
        R, p = body.kinematics.placements(q)
        return R @ body.solid.begin + p, R @ body.solid.end + p, R @ body.solid.rotation


_Placed = tuple[Floats, Floats, Floats]


def _round(one: Obstacle, other: Obstacle, here: _Placed, there: _Placed) -> tuple[Floats, Floats, Floats, Floats]:
    """:meth:`Clearance._measured` of one pair of capsules (Ericson, "Real-time collision detection", 5.1.9)."""
    p1, p2 = here[0], there[0]
    d1, d2, r = here[1] - p1, there[1] - p2, p1 - p2
    a, e, b = ((x * y).sum(axis=1) for x, y in ((d1, d1), (d2, d2), (d1, d2)))
    c, f = (d1 * r).sum(axis=1), (d2 * r).sum(axis=1)
    safe_a, safe_e = np.where(a > 0.0, a, 1.0), np.where(e > 0.0, e, 1.0)
    across = a * e - b * b
    crossing = across > 1e-12 * safe_a * safe_e
    s = np.where(crossing, np.clip((b * f - c * e) / np.where(crossing, across, 1.0), 0.0, 1.0), 0.5 * (a > 0.0))
    t = np.where(e > 0.0, (b * s + f) / safe_e, 0.0)
    clipped = np.clip(t, 0.0, 1.0)
    # Where an end of the second axis is nearest, or the second axis is a point: the nearest point of the first axis.
    again = (clipped != t) | (e == 0.0) | ~crossing
    s = np.where(again & (a > 0.0), np.clip((b * clipped - c) / safe_a, 0.0, 1.0), s)
    first, second = p1 + s[:, None] * d1, p2 + clipped[:, None] * d2
    way = second - first
    length = np.linalg.norm(way, axis=1)
    # Axes that intersect have no direction of the shortest distance: take z.
    unit = np.where(length[:, None] > 0.0, way / np.where(length > 0.0, length, 1.0)[:, None], [0.0, 0.0, 1.0])
    return (
        length - one.radius - other.radius,
        unit,
        first + one.radius * unit,
        second - other.radius * unit,
    )


def _edged(one: Obstacle, other: Obstacle, here: _Placed, there: _Placed) -> tuple[Floats, Floats, Floats, Floats]:
    """As :func:`_round`, for two bodies of which at least one is a box or a hull, computed by coal."""
    N = len(here[0])
    d, normal, first, second = np.empty(N), np.empty((N, 3)), np.empty((N, 3)), np.empty((N, 3))
    shapes = [_shape(body) for body in (one, other)]
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = request.epa_tolerance = _TOLERANCE
    for k in range(N):
        places = [_transform(body, at, k) for body, at in ((one, here), (other, there))]
        result.clear()
        d[k] = coal.distance(shapes[0], places[0], shapes[1], places[1], request, result)
        first[k], second[k] = result.getNearestPoint1(), result.getNearestPoint2()
        normal[k] = result.normal
    return d, normal, first, second


def _shape(body: Obstacle) -> Any:
    if body.sides is not None:
        return coal.Box(*map(float, body.sides))
    if body.hull is not None:
        return body.hull.shape
    length = float(np.linalg.norm(body.end - body.begin))
    return coal.Capsule(body.radius, length) if length > 0.0 else coal.Sphere(body.radius)


def _transform(body: Obstacle, at: _Placed, k: int) -> Any:
    begin, end, R = at[0][k], at[1][k], at[2][k]
    if not body.edged:
        way = end - begin
        length = float(np.linalg.norm(way))
        R = z_to(way / length) if length > 0.0 else np.eye(3)
    return coal.Transform3s(np.ascontiguousarray(R), 0.5 * (begin + end))


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
    fitted = {} if links is not None and set(links) <= set(given) else _vertices(robot)
    names = list(dict.fromkeys([*fitted, *given])) if links is None else list(links)
    bodies = []
    for name in names:
        body, _, _ = place_of_frame(robot.model, name, robot.name)
        if name in given:
            begin, end, radius = given[name]
            shape = (
                finite_array(f"capsules[{name!r}] begin", begin, (3,)),
                finite_array(f"capsules[{name!r}] end", end, (3,)),
                positive(f"capsules[{name!r}] radius", radius, "m"),
            )
        elif name in fitted:
            shape = capsule_around(fitted[name])
        else:
            raise InputError(f"link {name!r} of robot {robot.name!r} has no shape; give capsules={{{name!r}: ...}}")
        # A link that no joint moves is fixed in the world.
        if body < 0:
            _, R, p = place_of_frame(robot.model, name, robot.name)
            shape = R @ shape[0] + p, R @ shape[1] + p, shape[2]
        solid = Obstacle(name, *shape, None, np.eye(3))
        bodies.append((body, _Body(solid, None if body < 0 else frame_kinematics(robot, name))))
    parts = [part for _, part in bodies]
    moving = [i for i, part in enumerate(parts) if part.kinematics is not None]
    pairs = _of_links(robot, bodies, _disabled(robot, srdf)) if itself else []
    for obstacle in obstacles:
        pairs += [(i, len(parts)) for i in moving]
        parts.append(_Body(obstacle))
    if not pairs:
        raise InputError(
            f"robot {robot.name!r} has nothing to keep clear of: give obstacles, or itself=True, and links with shapes "
            "or capsules"
        )
    return Clearance(parts, pairs)


def _of_links(
    robot: Robot, bodies: Sequence[tuple[int, _Body]], disabled: set[frozenset[str]]
) -> list[tuple[int, int]]:
    """Pairs of links that are not neighbours."""
    parent, parts = robot.tree.parent, [part for _, part in bodies]
    found = []
    for i, (one, first) in enumerate(bodies):
        for k, (other, second) in enumerate(bodies[:i]):
            near = one == other or (one >= 0 and parent[one] == other) or (other >= 0 and parent[other] == one)
            still = first.kinematics is None and second.kinematics is None
            if not near and not still and frozenset((first.solid.name, second.solid.name)) not in disabled:
                found.append((k, i))
    if not found:
        return []
    apart = Clearance(parts, found).distances(np.zeros((1, robot.dof)))[0]
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


def _vertices(robot: Robot) -> dict[str, Floats]:
    """Points (N, 3) [m], in each link's axes, whose hull contains the shapes of the link."""
    found: dict[str, list[Floats]] = {}
    shapes, faulty = readable_geometry(robot)
    for _, what in faulty.values():
        raise RobotError(what)
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
