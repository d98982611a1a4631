"""Marks of a scene's task in a replay: targets and paths of frames, and a ghost that follows joint references."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from varpin.arrays import Floats
from varpin.control.costs import Cost, FrameOrientationCost, FramePositionCost, TrackingCost
from varpin.marks import Marks

if TYPE_CHECKING:
    from varpin.control import OptimalControlProblem
    from varpin.mechanics.scene import Scene

# Points of a path.
_POINTS = 400


def marks_of(costs: Sequence[Cost], rest: Floats, duration: float, constraints: Scene | OptimalControlProblem) -> Marks:
    """Traces, targets, references and a ghost of costs; joints without weight are drawn at ``rest`` (n,)."""
    # In directions without weight a target is nowhere.
    whole = [cost for cost in costs if np.all(getattr(cost, "weight", 0.0))]
    positions = [cost for cost in whole if isinstance(cost, FramePositionCost)]
    targets: dict[str, Floats] = {}
    references: dict[str, Floats] = {}
    for cost in positions:
        name = "target" if len(positions) == 1 else f"target of {cost.frame}"
        while name in targets:
            name += "'"
        targets[name] = path = _values(cost, cost.target, duration)
        if len(path) > 1 and np.ptp(path, axis=0).any():
            references[f"path of {name}"] = path
        for other in whole:
            if isinstance(other, FrameOrientationCost) and (other.frame, other.at_end) == (cost.frame, cost.at_end):
                targets[name] = _poses(path, _values(other, other.target, duration))
                break
    tracked = sorted((cost for cost in costs if isinstance(cost, TrackingCost)), key=lambda cost: cost.at_end)
    ghost = None
    if tracked:
        weight: Any = tracked[0].weight
        ghost = np.where(weight != 0.0, _values(tracked[0], tracked[0].reference, duration), rest)
    frames = list(dict.fromkeys(cost.frame for cost in positions))
    trace = frames or ghost is not None
    return Marks(trace=trace, targets=targets, reference=references or None, ghost=ghost, constraints=constraints)


def _values(cost: Cost, target: Any, duration: float) -> Floats:
    """A target over time (K, ...), or (1, ...) if it is constant or that of a terminal cost."""
    if not callable(target):
        return np.array([target])
    if cost.at_end or duration <= 0.0:
        return np.array([target(duration)])
    return np.array([target(t) for t in np.linspace(0.0, duration, _POINTS)])


def _poses(points: Floats, rotations: Floats) -> Floats:
    """Poses (K, 4, 4) at points (K, 3), or (1, 3), turned by rotations (K, 3, 3), or (1, 3, 3)."""
    poses = np.tile(np.eye(4), (max(len(points), len(rotations)), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = points, rotations
    return poses
