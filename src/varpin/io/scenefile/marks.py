"""Marks of a scene's task in a replay: targets and paths of frames, and a ghost that follows joint references."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from varpin.arrays import Floats
from varpin.io.scenefile.task import Task, Term
from varpin.marks import Marks

if TYPE_CHECKING:
    from varpin.control import OptimalControlProblem
    from varpin.mechanics.scene import Scene

# Points of a path.
_POINTS = 400


def marks_of(task: Task, duration: float, constraints: Scene | OptimalControlProblem) -> Marks:
    """Marks from the cost: traces, targets, references and a ghost."""
    wanted = [term for term in task.terms if term.target is not None and term.weight.all()]
    positions = [term for term in wanted if term.kind == "frame_position"]
    orientations = [term for term in wanted if term.kind == "frame_orientation"]
    targets: dict[str, Floats] = {}
    references: dict[str, Floats] = {}
    for term in positions:
        same = [other for other in orientations if (other.frame, other.terminal) == (term.frame, term.terminal)]
        name = "target" if len(positions) == 1 else f"target of {term.frame}"
        while name in targets:
            name += "'"
        targets[name] = _target(term, same, duration)
        path = _values(term, duration)
        if len(path) > 1 and np.ptp(path, axis=0).any():
            references[f"path of {name}"] = path
    ghost = _ghost(task, duration)
    frames = list(dict.fromkeys(term.frame for term in positions))
    trace = frames or ghost is not None
    return Marks(trace=trace, targets=targets, reference=references or None, ghost=ghost, constraints=constraints)


def _values(term: Term, duration: float) -> Floats:
    """A target over time (K, c), or (1, c) if it is constant or the target of a terminal term."""
    assert term.target is not None
    if term.terminal:
        return term.target.at(np.array([duration]))
    t = np.linspace(0.0, duration, _POINTS if duration > 0.0 else 1)
    return term.target.at(t[:1] if term.target.constant else t)


def _target(position: Term, orientations: list[Term], duration: float) -> Floats:
    """Target positions (K, 3) of a frame, or poses (K, 4, 4) with a target of its orientation."""
    points = _values(position, duration)
    if not orientations:
        return points
    angles = _values(orientations[0], duration)
    poses = np.tile(np.eye(4), (max(len(points), len(angles)), 1, 1))
    poses[:, :3, 3] = points
    # As in a URDF: Rz(yaw) Ry(pitch) Rx(roll).
    poses[:, :3, :3] = scipy.spatial.transform.Rotation.from_euler("xyz", angles).as_matrix()
    return poses


def _ghost(task: Task, duration: float) -> Floats | None:
    """Configurations (K, n) that the joints should follow or reach; None if there is no such cost."""
    terms = [term for term in task.terms if term.kind == "tracking" and term.weight.any()]
    if not terms:
        return None
    term = next((term for term in terms if not term.terminal), terms[0])
    # Joints without weight are drawn where they start.
    assert term.names is not None
    keep = [term.names.index(name) for name in task.scene.robot.joint_names]
    return np.asarray(np.where(term.weight[keep] != 0.0, _values(term, duration)[:, keep], task.q0))
