"""Drawing of a script in meshcat: robots, annotations, the view, and their animation."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import meshcat
import numpy as np
import pinocchio as pin
from meshcat.animation import Animation, AnimationClip, AnimationTrack

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.model.tree import z_to
from varpin.show.replay import marks
from varpin.show.replay.legend import (
    EFFORT_COLORS,
    GHOST_COLOR,
    REGION_COLORS,
    TARGET_COLOR,
    TIE_COLOR,
    TRACE_COLORS,
)
from varpin.show.replay.picture import Picture, label, labels
from varpin.show.replay.script import Actor, Outlook, Script, Target, Trace
from varpin.show.replay.shapes import ShapeLoader
from varpin.show.replay.view import across, set_view, side_by_side, view_direction

# Largest coordinate [m]: viewers compute squares in single precision.
_FARTHEST = 1e18

# Sizes of marks relative to the size of a robot's motion.
_TUBE, _BEAD, _BALL, _TRIAD, _LABEL, _TIE, _ROD, _EDGE = 0.003, 0.006, 0.02, 0.1, 0.045, 0.02, 0.006, 0.1

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Stage:
    """The contents for which the view was set.

    Attributes:
        size: Size of the largest robot's motion [m].
        places: Position of each robot's world (3,) [m].
        points: Points around everything that is shown (P, 3) [m].
        toward: Unit vector (3,) to the camera.
        floor: Height of the grid [m].
        pictures: Picture of each robot.
    """

    size: float
    places: list[Floats]
    points: Floats
    toward: Floats
    floor: float
    pictures: list[Picture]


def draw(viewer: meshcat.Visualizer, script: Script, *, legend: bool = False) -> Stage:
    """Send a script to a viewer.

    Args:
        viewer: The viewer.
        script: The script.
        legend: Whether a legend beside the picture names the targets: a single one then has no label.
    """
    return _Drawing(viewer, script, legend=legend).draw()


class _Drawing:
    """The drawing of one script in one viewer."""

    def __init__(self, viewer: meshcat.Visualizer, script: Script, *, legend: bool) -> None:
        self.viewer = viewer
        self.script = script
        self.labelled = not legend or len(script.target_names) > 1
        self.loader = ShapeLoader(viewer)
        self.clips: dict[meshcat.path.Path, AnimationClip] = {}
        robots = {id(actor.robot): actor.robot for actor in script.actors}
        self.pictures = {key: Picture.of(robot) for key, robot in robots.items()}

    def draw(self) -> Stage:
        stage = self._stage()
        size, places = stage.size, stage.places
        for k, (actor, place) in enumerate(zip(self.script.actors, places, strict=True)):
            number = f" {k + 1}" if k else ""
            self._actor(actor, number, place, size)
            # Robots in the same place share traces and targets.
            if not any((place == other).all() for other in places[:k]):
                targets = [*self.script.targets, *actor.goals]
                self._notes([*self.script.traces, *actor.traces], targets, f"notes{number}", place, size)
            else:
                self._notes(actor.traces, actor.goals, f"notes{number}", place, size)
            self._outlooks(actor.outlooks, f"notes{number}", size)
            self._ties(actor, number, size)
            self._regions(actor, f"notes{number}", size)
        if len(self.script.times) > 1:
            repetitions = math.inf if self.script.loop else 1
            self.viewer.set_animation(Animation(self.clips), play=True, repetitions=repetitions)
        return stage

    def _stage(self) -> Stage:
        """Set the view."""
        marked = [trace.points for trace in self.script.traces] + [target.places for target in self.script.targets]
        extents, poses = [], []
        size = 0.0
        for actor in self.script.actors:
            picture = self.pictures[id(actor.robot)]
            reach = [] if actor.reach is None else [actor.reach]
            positions = np.concatenate([*(_samples(rows) for rows in actor.positions.values()), *reach])
            points = picture.swept(positions)
            size = max(size, float(np.ptp(points, axis=0).max()))
            lines = [trace.points for trace in actor.traces]
            lines += [outlook.places.reshape(-1, 3) for outlook in actor.outlooks]
            lines += [tie.b[1][None] for tie in actor.ties if tie.b[0] < 0]
            lines += [tie.a[1][None] for tie in actor.ties if tie.a[0] < 0]
            lines += [goal.places for goal in actor.goals]
            seen = np.concatenate([points, *lines, *marked])
            # Regions much larger than the motion are shown in part.
            low, high, margin = seen.min(axis=0), seen.max(axis=0), 0.3 * size
            around = [np.clip(region.corners, low - margin, high + margin) for region in actor.regions]
            extents.append(np.concatenate([seen, *around]))
            poses.append(picture.body_poses(positions))
        if not np.abs(np.concatenate(extents)).max() < _FARTHEST:
            raise InputError(f"the replay has sizes or positions beyond {_FARTHEST:g} m, which no viewer draws")
        # The camera is one metre away from a point or anything of negligible size.
        size = size if size > 1.0 / _FARTHEST else 1.0
        toward = view_direction(np.concatenate([R[..., 2].reshape(-1, 3) for R, _ in poses]))
        for k, actor in enumerate(self.script.actors):
            extents[k] = np.concatenate([extents[k], *self._around_marks(actor, *poses[k], toward, size)])
        offset = self.script.offset
        places = side_by_side(extents, toward) if offset is None else [k * offset for k in range(len(extents))]
        base = self.pictures[id(self.script.actors[0].robot)].corners(-1)
        floor = (base if len(base) else extents[0])[:, 2].min()
        points = np.concatenate([points + place for points, place in zip(extents, places, strict=True)])
        set_view(self.viewer, points, toward, float(floor), size)
        pictures = [self.pictures[id(actor.robot)] for actor in self.script.actors]
        return Stage(size, places, points, toward, float(floor), pictures)

    def _around_marks(self, actor: Actor, R: Floats, p: Floats, toward: Floats, size: float) -> list[Floats]:
        """Points (P, 3) around labels and triads, for body poses R (S, b, 3, 3) and p (S, b, 3)."""
        found = []
        right = across(toward)
        up = np.cross(toward, right)
        for target in (*self.script.targets, *actor.goals):
            if self.labelled:
                half = 0.5 * marks.label_width(target.name) * _LABEL * size * right
                bottom = (1.2 * _BALL + _LABEL) * size * up
                found += [target.places - bottom - half, target.places - bottom + half]
            found += [target.places - _BALL * size * up, target.places + _BALL * size * up]
        for name in actor.frames:
            body, placement = self.pictures[id(actor.robot)].frame(name)
            tips = placement.translation + _TRIAD * size * placement.rotation.T
            found.append(tips if body < 0 else (tips @ R[:, body].transpose(0, 2, 1) + p[:, body, None]).reshape(-1, 3))
        return found

    def _actor(self, actor: Actor, number: str, place: Floats, size: float) -> None:
        picture, tree = self.pictures[id(actor.robot)], actor.robot.tree
        for kind, rows in actor.positions.items():
            root = f"{kind}{number}"
            self.viewer[root].set_transform(_translation(place))
            nodes = picture.moving_nodes(root)
            for j, node in enumerate(nodes):
                joint = pin.SE3(tree.rotation[j], tree.translation[j])
                self.viewer[node.removesuffix("/moving")].set_transform(joint.homogeneous)
                self.viewer[node].set_transform(joint_motion(bool(tree.prismatic[j]), rows[0, j]))
                self._animate(node, joint_track(bool(tree.prismatic[j])), "number", rows[:, j])
            shapes = zip(picture.shapes, picture.meshes, picture.bodies, picture.placements, strict=True)
            for k, (shape, parts, body, placement) in enumerate(shapes):
                parent = nodes[body] if body >= 0 else f"{root}/base"
                node = f"{parent}/shapes/{k} {label(shape.name)}"
                if kind == "ghost":
                    if body >= 0:
                        self.loader.load_ghost(shape, parts, placement, node)
                elif actor.effort is not None and body >= 0:
                    self.loader.load_plain(shape, parts, placement, node)
                    self._color(f"{node}/<object>", actor.effort[:, body])
                else:
                    self.loader.load(shape, parts, placement, node)
            for name, step in zip(actor.frames, labels(actor.frames), strict=True) if kind == "robot" else ():
                body, placement = picture.frame(name)
                node = f"{nodes[body] if body >= 0 else f'{root}/base'}/frames/{step}"
                self.viewer[node].set_transform(placement.homogeneous)
                self.viewer[node].set_object(marks.triad(_TRIAD * size))

    def _color(self, node: str, shares: Floats) -> None:
        stops = np.linspace(0.0, 1.0, len(EFFORT_COLORS))
        colors = np.column_stack([np.interp(shares, stops, channel) for channel in EFFORT_COLORS.T])
        self.viewer[node].set_property("color", [*colors[0].tolist(), 1.0])
        self._animate(node, "material.color", "color", colors)

    def _notes(self, traces: Sequence[Trace], targets: Sequence[Target], root: str, place: Floats, size: float) -> None:
        """Draw traces and targets in the world of one robot."""
        self.viewer[root].set_transform(_translation(place))
        for k, trace in enumerate(traces):
            node = f"{root}/traces/{k} {trace.kind} {label(trace.name)}"
            self.viewer[node].set_object(marks.tube(trace.points, _TUBE * size, TRACE_COLORS[trace.kind]))
            if trace.reached is not None:
                # drawRange is the number of corners that three.js draws, so that a piece can be drawn in part.
                corners = marks.TUBE_PIECE * trace.reached
                self._animate(f"{node}/<object>", "geometry[drawRange].count", "number", corners)
        for target, step in zip(targets, labels(target.name for target in targets), strict=True):
            node = f"{root}/targets/{step}"
            pose = _translation(target.places[0])
            if target.turns is not None:
                pose[:3, :3] = pin.Quaternion(target.turns[0]).toRotationMatrix()
            self.viewer[node].set_transform(pose)
            if len(target.places) > 1:
                self._animate(node, "position", "vector3", target.places)
                if target.turns is not None:
                    self._animate(node, "quaternion", "quaternion", target.turns)
            self.viewer[f"{node}/ball"].set_object(marks.ball(_BALL * size, TARGET_COLOR))
            if target.turns is not None:
                self.viewer[f"{node}/axes"].set_object(marks.triad(_TRIAD * size))
            # The tool comes to a target from above or from the side.
            if self.labelled:
                below = marks.Label(target.name, _LABEL * size, -1.2 * _BALL * size)
                self.viewer[f"{node}/label"].set_object(below)

    def _outlooks(self, outlooks: Sequence[Outlook], root: str, size: float) -> None:
        """Draw the planned paths of frames as beads."""
        for k, outlook in enumerate(outlooks):
            for b, places in enumerate(outlook.places.transpose(1, 0, 2)):
                node = f"{root}/plans/{k} {label(outlook.name)}/{b}"
                self.viewer[node].set_object(marks.bead(_BEAD * size, GHOST_COLOR))
                self.viewer[node].set_transform(_translation(places[0]))
                self._animate(node, "position", "vector3", places)

    def _ties(self, actor: Actor, number: str, size: float) -> None:
        """Draw the constraints of the mechanism as points, rods, lines and planes."""
        if not actor.ties:
            return
        picture, rows = self.pictures[id(actor.robot)], actor.positions["robot"]
        R, p = picture.body_poses(rows)
        nodes = picture.moving_nodes(f"robot{number}")

        def on(body: int, k: int) -> str:
            return f"{nodes[body] if body >= 0 else f'robot{number}/base'}/ties/{k}"

        def world(end: tuple[int, Floats]) -> Floats:
            body, place = end
            return np.broadcast_to(place, (len(rows), 3)) if body < 0 else R[:, body] @ place + p[:, body]

        planes: dict[tuple[float, ...], list[Floats]] = {}
        for k, tie in enumerate(actor.ties):
            for end in (tie.a, tie.b) if tie.axis is None else (tie.a,):
                node = f"{on(end[0], k)} {'a' if end is tie.a else 'b'}"
                self.viewer[node].set_object(marks.pin(_TIE * size, TIE_COLOR))
                self.viewer[node].set_transform(_translation(end[1]))
            a, b = world(tie.a), world(tie.b)
            body, place = tie.b
            if tie.axis is None:
                self._rod(f"notes{number}/ties/{k}", a, b, size)
                continue
            offset = a - (p[:, body] if body >= 0 else 0.0)
            seen = np.einsum("kji,kj->ki", R[:, body], offset) if body >= 0 else offset
            if tie.plane:
                # Points in the same plane share one square.
                key = (float(body), *tie.axis.round(9).tolist(), round(float(tie.axis @ place), 9))
                planes.setdefault(key, []).append(seen)
            else:
                along = (seen - place) @ tie.axis
                ends = [along.min() - _EDGE * size, along.max() + _EDGE * size]
                line = place + np.outer(ends, tie.axis)
                self.viewer[f"{on(body, k)} line"].set_object(marks.tube(line, _TUBE * size, TIE_COLOR))
        for k, (key, groups) in enumerate(planes.items()):
            body, normal, height = int(key[0]), np.array(key[1:4]), key[4]
            axes, points = z_to(normal), np.concatenate(groups)
            flat = points @ axes[:, :2]
            middle, half = 0.5 * (flat.min(axis=0) + flat.max(axis=0)), 0.5 * float(np.ptp(flat, axis=0).max())
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = axes, axes @ [*middle, height]
            node = f"{on(body, k)} plane"
            self.viewer[node].set_object(marks.sheet(half + _EDGE * size, TIE_COLOR))
            self.viewer[node].set_transform(pose)

    def _rod(self, node: str, a: Floats, b: Floats, size: float) -> None:
        """Draw a rod between two moving points (K, 3) of the world; none if they always coincide."""
        spans = b - a
        lengths = np.linalg.norm(spans, axis=1)
        if lengths.max() < _TUBE * size:
            return
        # The smallest rotation from keyframe to keyframe, as the page interpolates in between.
        before, turn = np.array([0.0, 0.0, 1.0]), pin.Quaternion.Identity()
        turns = []
        for span, length in zip(spans, lengths, strict=True):
            if length > 1e-9 * size:
                turn = pin.Quaternion.FromTwoVectors(before, span / length) * turn
                turn.normalize()
                before = span / length
            turns.append(turn.coeffs().copy())
        pose = _translation(0.5 * (a[0] + b[0]))
        pose[:3, :3] = pin.Quaternion(turns[0]).toRotationMatrix() @ np.diag([1.0, 1.0, lengths[0]])
        self.viewer[node].set_object(marks.rod(_ROD * size, TIE_COLOR))
        self.viewer[node].set_transform(pose)
        self._animate(node, "position", "vector3", 0.5 * (a + b))
        self._animate(node, "quaternion", "quaternion", np.array(turns))
        scales = np.column_stack([np.ones((len(lengths), 2)), lengths])
        self._animate(node, "scale", "vector3", scales)

    def _regions(self, actor: Actor, root: str, size: float) -> None:
        """Draw obstacles, and the regions that frames have to stay in or out of."""
        if not actor.regions:
            return
        picture = self.pictures[id(actor.robot)]
        points = picture.swept(np.concatenate([_samples(rows) for rows in actor.positions.values()]))
        for k, region in enumerate(actor.regions):
            if not np.abs(region.corners).max() < _FARTHEST:
                logger.warning("%s %r is too large for viewers and is left out", region.kind, region.name)
                continue
            color, node = REGION_COLORS[region.kind], f"{root}/regions/{k} {label(region.name)}"
            pose = np.eye(4)
            if region.hull is not None:
                pose[:3, :3], pose[:3, 3] = region.rotation, region.begin
                self.viewer[node].set_object(marks.hull(region.hull, color))
            elif region.box is None:
                axis = region.end - region.begin
                length = float(np.linalg.norm(axis))
                pose[:3, :3] = z_to(axis / length) if length > 0.0 else np.eye(3)
                pose[:3, 3] = 0.5 * (region.begin + region.end)
                self.viewer[node].set_object(marks.capsule(region.radius, length, color))
            else:
                low, high = region.box_within(points, _EDGE * size)
                pose[:3, :3] = region.rotation
                pose[:3, 3] = region.begin + region.rotation @ (0.5 * (low + high))
                if (high > low).all():
                    self.viewer[node].set_object(marks.box(high - low, color))
                else:
                    self.viewer[node].set_object(marks.sheet(0.5 * float((high - low).max()), color))
            self.viewer[node].set_transform(pose)
            if region.way is not None and len(region.way) > 1:
                self._animate(node, "position", "vector3", pose[:3, 3] + region.way)

    def _animate(self, node: str, name: str, kind: str, values: Floats) -> None:
        """Animate a property of a node with values (K, ...) at the keyframes."""
        path = self.viewer[node].path
        # With fps = 1, keyframe times are seconds.
        clip = self.clips.setdefault(path, AnimationClip({}, fps=1))
        clip.tracks[name] = AnimationTrack(name, kind, self.script.times.tolist(), values.tolist())


def _translation(place: Floats) -> Floats:
    """Transform (4, 4) of a translation."""
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose


def joint_track(prismatic: bool) -> str:
    """The animated property of a joint's node.

    It is one number, so that the page interpolates in q and links stay rigid at any frame rate.
    """
    return "position[z]" if prismatic else "rotation[z]"


def joint_motion(prismatic: bool, position: float) -> Floats:
    """Transform (4, 4) of a joint along or about z."""
    motion = np.eye(4)
    if prismatic:
        motion[2, 3] = position
    else:
        c, s = math.cos(position), math.sin(position)
        motion[:2, :2] = [[c, -s], [s, c]]
    return motion


def _samples(rows: Floats) -> Floats:
    """Up to 50 of the rows, the first and the last among them."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, 50).astype(int))]
