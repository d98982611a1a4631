"""The control law of a motion under feedback, fitted to its record: u = Kq q + Kv v + S L_q(q, 0) + c."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from varpin.arrays import Floats, Integers
from varpin.errors import LinearizationError
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.signals.commands import no_limits
from varpin.trajectory import Trajectory

# Least nodes of a fit, spread over the motion, but four a joint at least: 30 to 300 give the same.
_NODES = 100
# Largest error of a fit by that of squares of the state: short smooth curves fit any function. 1e-9 to 1e-6: the same.
_TELLING = 1e-6
# Share of the largest below which a direction of the motion or the force at an equilibrium is zero: 1e-11 to 1e-6.
NOTHING = 1e-8


@dataclass(frozen=True)
class Law:
    """A control law from a record: u = K (q, v, L_q(q, 0)) + c, with the forces L_q(q, 0) of gravity and springs.

    Attributes:
        K: (m, 3n).
        c: (m,).
        directions: Of (q, v), in which the motion tells the law (2n, r).
        near: A configuration of the motion (n,) [rad or m].
        limits: The ends of the range of each control where it is there more than once (2, m); else infinite.
    """

    K: Floats
    c: Floats
    directions: Floats
    near: Floats
    limits: Floats

    def control(self, scene: Scene, q: Floats, v: Floats) -> Floats:
        """The control (m,) at a state (n,), (n,)."""
        found = self.K @ np.concatenate([q, v, lagrangian_jet(scene, q, np.zeros_like(q)).Lq]) + self.c
        limited: Floats = np.clip(found, *self.limits)
        return limited


def law_of(scene: Scene, trajectory: Trajectory, hold: int) -> Law | None:
    """The law of a motion under feedback every ``hold`` steps, if its record tells it."""
    at, x, u = decisions(trajectory, hold)
    # Commands of kinematic inputs are positions.
    if scene.inputs or len(at) < 3:
        return None
    with np.errstate(all="ignore"):
        try:
            return _law(scene, x, u)
        except (np.linalg.LinAlgError, LinearizationError):
            return None


def decisions(trajectory: Trajectory, hold: int) -> tuple[Integers, Floats, Floats]:
    """The nodes (P,) at which a period begins, the states (q, v) (P, 2n) there, and the controls (P, m)."""
    at = np.arange(0, trajectory.steps, hold)
    return at, np.concatenate([trajectory.q[at], trajectory.v[at]], axis=1), trajectory.u[at]


def _law(scene: Scene, x: Floats, u: Floats) -> Law | None:
    """The law from all nodes or, where it clips, of each control from the nodes at which it is inside its limits."""
    law = fitted_law(scene, x, u)
    ends = np.array([u.min(axis=0), u.max(axis=0)])
    at_end = u == ends[:, None]
    often = at_end.sum(axis=1) > 1
    clipped = (at_end & often[:, None]).any(axis=0)
    if law is not None or not clipped.any():
        return law
    laws = [fitted_law(scene, x[~rows], u[~rows, k : k + 1]) for k, rows in enumerate(clipped.T)]
    # Directions that one control does not know cannot be combined with those of another.
    known = [law for law in laws if law is not None and law.directions.shape[1] >= x.shape[1]]
    if len(known) < len(laws):
        return None
    K, c = np.concatenate([law.K for law in known]), np.concatenate([law.c for law in known])
    limits = np.where(often, ends, [[-np.inf], [np.inf]])
    return Law(K, c, known[0].directions, known[0].near, limits)


def fitted_law(scene: Scene, x: Floats, u: Floats) -> Law | None:
    """The law that gives u (P, m) at states (q, v) = x (P, 2n), if there is one that the record tells."""
    n = x.shape[1] // 2
    if len(x) < 3:
        return None
    # An odd interval: controls may alternate.
    every = 1 + 2 * (len(x) // max(2 * _NODES, 8 * n))
    x, u = x[::every], u[::every]
    pulled = (np.append(state, lagrangian_jet(scene, state[:n], np.zeros(n)).Lq) for state in x)
    fit = _affine(x, u) or _affine(np.array(list(pulled)), u)
    if fit is None:
        return None
    K, c, directions = fit
    K = np.pad(K, ((0, 0), (0, 3 * n - K.shape[1])))
    return Law(K, c, directions[: 2 * n], x[0, :n], no_limits(len(K)))


def _affine(x: Floats, u: Floats) -> tuple[Floats, Floats, Floats] | None:
    """K (m, k), c (m,) of u = K x + c, if the record tells that, and directions (k, r) of x; the least of equal K."""
    mean, mean_u = x.mean(axis=0), u.mean(axis=0)
    size = np.std(x, axis=0)
    moving = size > NOTHING * size.max()
    unit = np.where(moving, size, np.inf)
    state, target = (x - mean) / unit, u - mean_u
    left, sizes, right = np.linalg.svd(state, full_matrices=False)
    known = sizes > NOTHING * sizes[0]
    if not moving.any() or len(x) < known.sum() + 2:
        return None
    left, directions = left[:, known], right[known].T
    squares = state[:, moving] ** 2 - 1.0
    missed = np.abs(squares - left @ (left.T @ squares)).max(axis=0) / np.abs(squares).max(axis=0)
    off = np.abs(target - left @ (left.T @ target)).max()
    if off > _TELLING * np.median(missed) * np.abs(target).max():
        return None
    K = ((directions / sizes[known]) @ (left.T @ target)).T / unit
    return K, mean_u - K @ mean, directions * np.where(moving, size, 0.0)[:, None]
