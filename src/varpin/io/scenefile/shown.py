"""What a replay can mark of a scene's task: where its frames are to go, and which motion its joints are to follow."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy

from varpin.io.scenefile.layout import CostTerm, Layout
from varpin.io.scenefile.table import Floats

# Places of a reference that moves.
_LOOKS = 400


def marks_of(layout: Layout, duration: float) -> dict[str, Any]:
    """Options of :func:`varpin.replay`: traces, targets, references and a ghost, of what the cost is about.

    Args:
        layout: The scene.
        duration: Of the motion that is shown [s].
    """
    wanted = [term for term in layout.costs if term.target is not None and term.weight.all()]
    places = [term for term in wanted if term.spec.table.data["type"] == "frame_position"]
    turns = [term for term in wanted if term.spec.table.data["type"] == "frame_orientation"]
    marks: dict[str, Any] = {"trace": list(dict.fromkeys(term.spec.frame for term in places))}
    targets: dict[str, Floats] = {}
    references: dict[str, Floats] = {}
    for term in places:
        twin = next((turn for turn in turns if _together(term, turn)), None)
        name = "target" if len(places) == 1 else f"target of {term.spec.frame}"
        while name in targets:
            name += "'"
        targets[name] = _where(term, twin, duration)
        path = _values(term, duration)
        if len(path) > 1 and np.ptp(path, axis=0).any():
            references[f"path of {name}"] = path
    if targets:
        marks["targets"] = targets
    if references:
        marks["reference"] = references
    if (ghost := _followed(layout, duration)) is not None:
        marks["ghost"] = ghost
        marks["trace"] = marks["trace"] or True
    return marks


def _together(place: CostTerm, turn: CostTerm) -> bool:
    """Whether two terms are of one frame at one time."""
    return place.spec.frame == turn.spec.frame and place.spec.terminal == turn.spec.terminal


def _values(term: CostTerm, duration: float) -> Floats:
    """A target over time (K, c), or where it stays (1, c); of a term at the end, what holds there."""
    assert term.target is not None
    if term.spec.terminal:
        return term.target.at(np.array([duration]))
    t = np.linspace(0.0, duration, _LOOKS if duration > 0.0 else 1)
    return term.target.at(t[:1] if term.target.constant else t)


def _where(place: CostTerm, turn: CostTerm | None, duration: float) -> Floats:
    """Places (K, 3), or poses (K, 4, 4)."""
    points = _values(place, duration)
    if turn is None:
        return points
    angles = _values(turn, duration)
    rows = max(len(points), len(angles))
    poses = np.tile(np.eye(4), (rows, 1, 1))
    poses[:, :3, 3] = points
    # As in a URDF: Rz(yaw) Ry(pitch) Rx(roll).
    poses[:, :3, :3] = scipy.spatial.transform.Rotation.from_euler("xyz", angles).as_matrix()
    return poses


def _followed(layout: Layout, duration: float) -> Floats | None:
    """Configurations (K, n) that the joints are to follow, or to end at; None if none are."""
    terms = [term for term in layout.costs if term.spec.table.data["type"] == "tracking" and term.weight.any()]
    if not terms:
        return None
    term = next((term for term in terms if not term.spec.terminal), terms[0])
    # What has no weight may be anywhere.
    return np.asarray(np.where(term.weight != 0.0, _values(term, duration), layout.q0))
