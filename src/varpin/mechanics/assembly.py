"""Configurations that keep a scene's constraints, and velocities along them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from varpin.errors import AssemblyError, SingularMassMatrix
from varpin.mechanics.scene import Scene, require_scene
from varpin.model.tree import place_on_body
from varpin.support.checks import JointValues, joint_array

Floats = NDArray[np.float64]

# Rows that depend on others have less than this of the largest singular value, in the metric of the kinetic energy.
_DEPENDENT = 1e-9
# A row is kept if it misses by so many rounding units of the terms that cancel in it.
_ROUNDING = 256.0 * np.finfo(np.float64).eps
# Misses below which rounding decides which of two is the smaller [m or rad].
_POLISHED = 1e-12
# Most corrections of Newton's method, most trials of Levenberg's and Marquardt's, the least part of the way that is
# followed at once, and the longest step [rad or m].
_MOST, _MOST_TRIALS, _SHORTEST, _LONGEST = 12, 200, 1e-3, 0.5
# Where nothing is found, places around the start to search from, and the standard deviation of the last [rad or m].
_PLACES, _FARTHEST = 20, 1.0


def assemble(scene: Scene, q: JointValues) -> Floats:
    """The configuration (n,) nearest to ``q`` that keeps a scene's constraints [rad or m].

    Nearest in the metric of the kinetic energy at ``q``, where light joints move more than heavy ones, among those that
    a continuous way leads to; where that way is lost, another one that keeps them, if need be sought from twenty places
    around ``q`` (the same ones every time).

    Args:
        scene: The scene.
        q: Where the search begins, (n,) or by joint name [rad or m].

    Raises:
        AssemblyError: The search ends where constraints are not kept; it says which one misses most, and by how much.
        InputError: A wrong shape, or a value that is not finite.
        UnknownJoint: ``q`` names a joint that is no coordinate of the robot.
        SingularMassMatrix: M(q) is not positive definite.
    """
    start = joint_array("q", q, require_scene(scene).robot.joint_names)
    if not scene.constraints:
        return start
    try:
        return nearest(scene, start)
    except AssemblyError:
        around = _reached_around(scene, start, _root_of_mass(scene, start))
        if around is None:
            raise
        return around


def nearest(scene: Scene, q: Floats) -> Floats:
    """:func:`assemble` from ``q`` (n,) alone, with the errors of that."""
    root = _root_of_mass(scene, q)
    followed = _followed(scene, q, root)
    found = _polished(scene, _reached(scene, q, root) if followed is None else followed, root)
    _require_kept(scene, found)
    return found


def along_constraints(scene: Scene, q: Floats, v: Floats) -> Floats:
    """The velocity (n,) nearest to ``v`` that constraints allow at ``q`` (n,), in the metric of the kinetic energy."""
    root = _root_of_mass(scene, q)
    _, C = _values(scene, q)
    for _ in range(2):
        v = v - _shift(C @ v, C, root)
    return v


def dependent_input(scene: Scene, q: Floats) -> str | None:
    """The label of a joint moved by hand that the other constraints do not leave free at ``q`` (n,), if one is."""
    root = _root_of_mass(scene, q)
    _, C = _values(scene, q)
    rows = [row for row in (C @ root.T) if row.any()]
    for row, c in scene.inputs.items():
        with_it = [*rows, np.eye(q.size)[c] @ root.T]
        if np.linalg.matrix_rank(np.array(with_it), tol=None) <= (np.linalg.matrix_rank(np.array(rows)) if rows else 0):
            return scene.bound_constraints.labels[row]
        rows = with_it
    return None


def missed(scene: Scene, q: Floats) -> tuple[str, float]:
    """The constraint that misses by most at ``q`` (n,), and by how much [m or rad]."""
    g, _ = _values(scene, q)
    worst = int(np.argmax(np.abs(g)))
    return scene.bound_constraints.labels[worst], float(np.abs(g[worst]))


def _values(scene: Scene, q: Floats) -> tuple[Floats, Floats]:
    """G and C, zero for joints that are moved by hand: they are wherever they are."""
    g, _, C = scene.core.constraints(np.ascontiguousarray(q[None]))
    g[:, list(scene.inputs)], C[:, list(scene.inputs)] = 0.0, 0.0
    return g[0], C[0]


def _root_of_mass(scene: Scene, q: Floats) -> Floats:
    """The inverse of L in M = L L' at q."""
    M = scene.core.jets(q[None], np.zeros((1, q.size)))[0][0]
    try:
        L = np.linalg.cholesky(M)
    except np.linalg.LinAlgError:
        raise SingularMassMatrix(scene.robot.joint_names, q) from None
    return np.asarray(np.linalg.inv(L), dtype=np.float64)


def _shift(g: Floats, C: Floats, root: Floats) -> Floats:
    """The smallest change of q, as the kinetic energy measures it, that takes g away to first order."""
    shift: Floats = root.T @ (np.linalg.pinv(C @ root.T, rcond=_DEPENDENT) @ g)
    return shift


def _followed(scene: Scene, start: Floats, root: Floats) -> Floats | None:
    """The nearest q, followed from ``start`` on as what constraints miss goes to zero; None where that is lost."""
    whole, _ = _values(scene, start)
    q, y, done, step = start, np.zeros(len(whole)), 0.0, 1.0
    while done < 1.0:
        ahead = min(1.0, done + step)
        found = _nearest(scene, start, (1.0 - ahead) * whole, q, y, root)
        if found is None:
            step *= 0.5
            if step < _SHORTEST:
                return None
            continue
        (q, y), done, step = found, ahead, 2.0 * step
    return q


def _nearest(
    scene: Scene, start: Floats, left: Floats, q: Floats, y: Floats, root: Floats
) -> tuple[Floats, Floats] | None:
    """Newton's method, from (q, y), on M0 (q - start) + C' y = 0, g = left; None where it does not contract."""
    metric = np.linalg.inv(root.T @ root)
    n, before = q.size, np.inf
    for _ in range(_MOST):
        g, C = _values(scene, q)
        B = C @ root.T
        H = np.eye(n) + root @ scene.core.constraint_curvature(q, y, np.zeros(n))[0] @ root.T
        K = np.block([[H, B.T], [B, np.zeros((len(g), len(g)))]])
        slope = root @ (metric @ (q - start) + C.T @ y)
        step = np.linalg.lstsq(K, -np.append(slope, g - left), rcond=_DEPENDENT)[0]
        way = root.T @ step[:n]
        size = float(np.abs(way).max())
        if not size <= min(0.5 * before, _LONGEST):
            return None
        q, y, before = q + way, y + step[n:], max(size, 1e-12)
        if size < 1e-10:
            # On the nearest branch H is positive along the constraints.
            _, sizes, basis = np.linalg.svd(B)
            along = basis[int((sizes > _DEPENDENT * sizes[0]).sum()) :]
            return (q, y) if not len(along) or np.linalg.eigvalsh(along @ H @ along.T)[0] > 0.0 else None
    return None


def _reached(scene: Scene, q: Floats, root: Floats) -> Floats:
    """Some q without g, or where g is least, from q on: Levenberg's and Marquardt's method."""
    g, C = _values(scene, q)
    damping = 1e-3
    for _ in range(_MOST_TRIALS):
        size = float(g @ g)
        if size < 1e-24:
            break
        B = C @ root.T
        scale = float(np.square(B).sum())
        way = -root.T @ (B.T @ np.linalg.solve(B @ B.T + damping * scale * np.eye(len(g)), g))
        trial = q + way * min(1.0, _LONGEST / max(float(np.abs(way).max()), 1e-300))
        g_there, C_there = _values(scene, trial)
        if float(g_there @ g_there) < size:
            q, g, C, damping = trial, g_there, C_there, max(0.1 * damping, 1e-14)
        else:
            damping *= 10.0
            if damping > 1e12:
                break
    return q


def _reached_around(scene: Scene, start: Floats, root: Floats) -> Floats | None:
    """Some q that keeps the constraints, sought from places around ``start``, farther and farther away."""
    rng = np.random.default_rng(0)
    for size in np.linspace(0.1, _FARTHEST, _PLACES):
        q = _polished(scene, _reached(scene, start + size * rng.normal(size=start.size), root), root)
        try:
            _require_kept(scene, q)
        except AssemblyError:
            continue
        return q
    return None


def _polished(scene: Scene, q: Floats, root: Floats) -> Floats:
    """To rounding; where that leads away, for the constraints cannot be kept here, not at all."""
    g, C = _values(scene, q)
    for _ in range(4):
        nearer = q - _shift(g, C, root)
        g_there, C_there = _values(scene, nearer)
        if not np.abs(g_there).max() <= max(np.abs(g).max(), _POLISHED):
            break
        q, g, C = nearer, g_there, C_there
    return q


def _require_kept(scene: Scene, q: Floats) -> None:
    scale = scene.core.constraints(q[None])[1][0]
    g, _ = _values(scene, q)
    wrong = np.abs(g) > _ROUNDING * np.maximum(scale, 1.0) * q.size
    if wrong.any() or not np.isfinite(g).all():
        label, miss = missed(scene, q)
        raise AssemblyError(label, miss, q)
    for x, y in scene.bound_constraints.aligned:
        ends = []
        for place in (x, y):
            ((body, _, along),) = scene.bound_constraints.rows.vectors[place]
            tree = scene.robot.tree
            both = [place_on_body(tree, q[None], body, np.array(at))[0] for at in (along, (0.0, 0.0, 0.0))]
            ends.append(both[0] - both[1])
        # The rows vanish at half a turn about an axis and at a third of one about the diagonals, too: 1, -1 or 0 there.
        if not ends[0] @ ends[1] > 0.5:
            weld = next(label for label in scene.bound_constraints.labels if label.startswith("FrameOnFrame"))
            raise AssemblyError(weld.rsplit(" ", 2)[0], float(np.arccos(np.clip(ends[0] @ ends[1], -1.0, 1.0))), q)
