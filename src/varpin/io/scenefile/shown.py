"""Marks of a scene's task in a replay: targets and paths of frames, and a ghost that follows joint references."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from varpin.arrays import Floats
from varpin.io.scenefile.task import CostTerm, Task
from varpin.marks import Marks

if TYPE_CHECKING:
    from varpin.control import OptimalControlProblem
    from varpin.mechanics.scene import Scene

# Points of a path.
_POINTS = 400


def marks_of(task: Task, duration: float, constraints: bool | Scene | OptimalControlProblem) -> Marks:
    """Marks from the cost: traces, targets, references and a ghost.

    Args:
        task: The scene.
        duration: Duration of the motion [s].
        constraints: What draws its constraints.
    """
    wanted = [term for term in task.costs if term.target is not None and term.weight.all()]
    positions = [term for term in wanted if term.table.kind == "frame_position"]
    orientations = [term for term in wanted if term.table.kind == "frame_orientation"]
    targets: dict[str, Floats] = {}
    references: dict[str, Floats] = {}
    for term in positions:
        orientation = next((other for other in orientations if _of_one_frame(term, other)), None)
        name = "target" if len(positions) == 1 else f"target of {term.table.frame}"
        while name in targets:
            name += "'"
        targets[name] = _target(term, orientation, duration)
        path = _values(term, duration)
        if len(path) > 1 and np.ptp(path, axis=0).any():
            references[f"path of {name}"] = path
    ghost = _ghost(task, duration)
    frames = list(dict.fromkeys(term.table.frame for term in positions))
    trace = frames or ghost is not None
    return Marks(trace=trace, targets=targets, reference=references or None, ghost=ghost, constraints=constraints)


def _of_one_frame(position: CostTerm, orientation: CostTerm) -> bool:
    """Whether two terms have the same frame, both over time or both at the end."""
    one, other = position.table, orientation.table
    return one.frame == other.frame and one.terminal == other.terminal


def _values(term: CostTerm, duration: float) -> Floats:
    """A target over time (K, c), or (1, c) if it is constant or the target of a terminal term."""
    assert term.target is not None
    if term.table.terminal:
        return term.target.at(np.array([duration]))
    t = np.linspace(0.0, duration, _POINTS if duration > 0.0 else 1)
    return term.target.at(t[:1] if term.target.constant else t)


def _target(position: CostTerm, orientation: CostTerm | None, duration: float) -> Floats:
    """Target positions (K, 3) of a frame, or poses (K, 4, 4) with a target of its orientation."""
    points = _values(position, duration)
    if orientation is None:
        return points
    angles = _values(orientation, duration)
    rows = max(len(points), len(angles))
    poses = np.tile(np.eye(4), (rows, 1, 1))
    poses[:, :3, 3] = points
    # As in a URDF: Rz(yaw) Ry(pitch) Rx(roll).
    poses[:, :3, :3] = scipy.spatial.transform.Rotation.from_euler("xyz", angles).as_matrix()
    return poses


def _ghost(task: Task, duration: float) -> Floats | None:
    """Configurations (K, n) that the joints should follow or reach; None if there is no such cost."""
    terms = [term for term in task.costs if term.table.kind == "tracking" and term.weight.any()]
    if not terms:
        return None
    term = next((term for term in terms if not term.table.terminal), terms[0])
    # Joints without weight are drawn where they start.
    return np.asarray(np.where(term.weight != 0.0, _values(term, duration), task.q0))
