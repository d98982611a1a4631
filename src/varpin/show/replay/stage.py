"""Where robots and their marks stand in a replay, and from where they are seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pinocchio as pin

from varpin.arrays import Floats
from varpin.show.given import frame_names, motion_of
from varpin.show.replay.figure import MOST_FRAMES, Figure, Shown, keyframe_times, rows_at, samples
from varpin.show.replay.marks import REGIONS, Mark, marks_of
from varpin.show.replay.picture import Picture, label
from varpin.show.replay.shapes import Item, shape_items, transform
from varpin.trajectory import Trajectory

# Colours of no torque, half of the limit and the whole limit; linear in between.
EFFORT_COLORS = np.array([[0.72, 0.76, 0.8], [0.98, 0.75, 0.1], [0.8, 0.05, 0.05]])
# Distance between robots side by side, relative to the widest of them.
_GAP = 0.15
# Part of a region that is shown around the rest, relative to the size of a robot's motion.
_AROUND = 0.3


@dataclass(frozen=True, eq=False)
class Stage:
    """The contents of a replay, in their places."""

    # Times of the keyframes (K,) [s of playback]. All tracks share them: each track loops on its own, and tracks of
    # unequal length would drift apart.
    times: Floats
    figures: Sequence[Figure]
    marks: Sequence[Sequence[Mark]]  # of each figure
    places: Sequence[Floats]  # position of the world of each (3,) [m]
    points: Floats  # points around everything that is shown (P, 3) [m]
    speed: float  # seconds of motion in a second of playback
    note: str  # how far the picture may be off in words, for the legend; empty where nothing is known

    @classmethod
    def of(cls, shown: Sequence[Shown], speed: float = 1.0, fps: float = 1.0) -> Stage:
        """The robots side by side with their marks, as a camera sees them that shows all."""
        times = keyframe_times(shown, fps / speed)
        figures = _figures(shown, times)
        marks = [list(marks_of(figure)) for figure in figures]
        extents = [_extent(figure, own) for figure, own in zip(figures, marks, strict=True)]
        places = side_by_side(extents, figures[0].right)
        points = np.concatenate([points + place for points, place in zip(extents, places, strict=True)])
        return cls(times / speed, figures, marks, places, points, speed, _note(shown, times))

    def items(self) -> Iterator[Item]:
        """Everything that is drawn."""
        for figure, place, marks in zip(self.figures, self.places, self.marks, strict=True):
            for kind in (*figure.rows, "notes"):
                yield Item(f"{kind}{figure.number}", pose=transform(place))
            for kind in figure.rows:
                yield from joint_items(figure, kind)
                yield from _shape_items(figure, kind)
            for k, mark in enumerate(marks):
                yield from mark_items(figure, k, mark)

    @property
    def title(self) -> str:
        """The names of the robots."""
        return ", ".join(dict.fromkeys(figure.robot.name for figure in self.figures))


def _figures(shown: Sequence[Shown], times: Floats) -> list[Figure]:
    """The robots at the keyframes (K,) [s]."""
    robots = [one.robot for one in shown]
    found = {id(robot): Picture.of(robot) for robot in robots}
    pictures = [found[id(robot)] for robot in robots]
    rows = [{name: rows_at(times, *motion) for name, motion in one.motions.items()} for one in shown]
    seen = [np.concatenate([*map(samples, motions.values())]) for motions in rows]
    swept = [picture.swept(q) for picture, q in zip(pictures, seen, strict=True)]
    axes = [picture.body_poses(q)[0][..., 2].reshape(-1, 3) for picture, q in zip(pictures, seen, strict=True)]
    size = max(float(np.ptp(points, axis=0).max()) for points in swept) or 1.0
    toward = view_direction(np.concatenate(axes))
    return [
        Figure(
            one,
            pictures[k],
            number=f" {k + 1}" if k else "",
            trace=frame_names("trace", robots, one.marks.trace)[k],
            frames=frame_names("frames", robots, one.marks.frames)[k],
            times=times,
            rows=rows[k],
            effort=one.effort(times),
            swept=swept[k],
            size=size,
            toward=toward,
        )
        for k, one in enumerate(shown)
    ]


def joint_items(figure: Figure, kind: str) -> Iterator[Item]:
    """The nodes of the joints of the "robot" or the "ghost", each below that of its parent."""
    tree, q = figure.robot.tree, figure.rows[kind]
    # Positions of all joints of the tree, mimic joints included.
    positions = q[:, tree.coordinate] * tree.ratio + tree.offset
    for j, slides in enumerate(tree.prismatic):
        node, along = figure.node(kind, j), np.array([0.0, 0.0, positions[0, j]])
        yield Item(node.removesuffix("/moving"), pose=transform(tree.translation[j], tree.rotation[j]))
        pose = transform(along) if slides else transform(np.zeros(3), pin.exp3(along))
        # One number, so that the page interpolates in q and links stay rigid at any frame rate.
        yield Item(node, pose=pose, tracks={"position[z]" if slides else "rotation[z]": positions[:, j]})


def _shape_items(figure: Figure, kind: str) -> Iterator[Item]:
    """The shapes of the "robot" or the "ghost", which has none on the base."""
    ghost = kind == "ghost"
    for k, shape in enumerate(figure.picture.shapes):
        if ghost and shape.body < 0:
            continue
        node, colors = f"{figure.node(kind, shape.body)}/shapes/{k} {label(shape.form.name)}", None
        if figure.effort is not None and shape.body >= 0 and not ghost:
            shares, stops = figure.effort[:, shape.body], np.linspace(0.0, 1.0, len(EFFORT_COLORS))
            colors = np.column_stack([np.interp(shares, stops, channel) for channel in EFFORT_COLORS.T])
        yield from shape_items(node, shape, ghost=ghost, colors=colors)


def mark_items(figure: Figure, index: int, mark: Mark) -> Iterator[Item]:
    """The items of one of the marks of a robot, in its world or on its bodies."""
    for item in mark.items:
        root = f"notes{figure.number}" if item.body is None else f"{figure.node('robot', item.body)}/notes"
        path = f"{root}/{index} {mark.kind} {label(mark.name)}/{item.node}".removesuffix("/")
        yield replace(item, node=path)


def _note(shown: Sequence[Shown], times: Floats) -> str:
    """How far the picture at the keyframes (K,) [s] may be off, in words."""
    motions = [motion_of(one.given) for one in shown]
    errors = [path.error_text for path in motions if isinstance(path, Trajectory) and path.error_text]
    notes = [f"estimated {'; '.join(errors)} rad or m"] if errors else []
    notes += [f"drawn every {times[1]:.2g} s, straight in between"] if len(times) == MOST_FRAMES else []
    return "; ".join(notes)


def _extent(figure: Figure, marks: Sequence[Mark]) -> Floats:
    """Points (P, 3) around a robot and its marks [m]; regions much larger than the rest are shown in part."""
    points = np.concatenate([figure.swept, *(mark.around for mark in marks if mark.kind not in REGIONS)])
    low, high, margin = points.min(axis=0), points.max(axis=0), _AROUND * figure.size
    regions = [mark.around for mark in marks if mark.kind in REGIONS]
    return np.concatenate([points, *(np.clip(region, low - margin, high + margin) for region in regions)])


def side_by_side(extents: Sequence[Floats], right: Floats) -> list[Floats]:
    """Translations (3,) that put figures, each of points (P, 3) [m], in a row to the right."""
    spans = [((points @ right).min(), (points @ right).max()) for points in extents]
    gap = _GAP * max(high - low for low, high in spans)
    at, places = 0.0, [np.zeros(3)]
    for (_, end), (begin, _) in pairwise(spans):
        at += end - begin + gap
        places.append(at * right)
    return places


def view_direction(joint_axes: Floats) -> Floats:
    """Unit vector (3,) to the camera: across the plane of planar joint axes (k, 3), else from front and side."""
    weights, directions = np.linalg.eigh(joint_axes.T @ joint_axes)
    if weights[-1] > 0.98 * weights.sum():
        normal = directions[:, -1]
        if normal @ [0.1, -0.2, 1.0] < 0.0:
            normal = -normal
        side = [0.0, -0.75, 0.0] if normal[2] > 0.7 else [0.0, 0.0, 0.25]
        toward = normal + side
    else:
        toward = np.array([1.0, -1.2, 0.6])
    return np.asarray(toward / np.linalg.norm(toward))
