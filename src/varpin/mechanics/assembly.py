"""Configurations and velocities that satisfy a scene's constraints."""

from __future__ import annotations

import contextlib

import numpy as np

from varpin.arrays import Floats
from varpin.errors import AssemblyError, SingularMassMatrix
from varpin.mechanics.scene import Scene, require_scene
from varpin.model.kinematics import place_on_body
from varpin.support.checks import JointValues, joint_array

# Rank tolerance of the constraint Jacobian in the kinetic-energy metric, relative to the largest singular value.
_RANK = 1e-9
# A constraint holds if its residual is below this many rounding units of its cancelling terms.
_ROUNDING = 256.0 * np.finfo(np.float64).eps
# Residuals below this are equal up to rounding [m or rad].
_POLISHED = 1e-12
# Most Newton iterations, and most Levenberg-Marquardt trials.
_NEWTON_ITERATIONS, _TRIALS = 12, 200
# Shortest homotopy step, as a share of the whole, and longest change of q in one iteration [rad or m].
_SHORTEST, _LONGEST = 1e-3, 0.5
# Restarts around the start after a failed search, and the standard deviation of the last one [rad or m].
_RESTARTS, _FARTHEST = 20, 1.0


def assemble(scene: Scene, q: JointValues) -> Floats:
    """The configuration (n,) nearest to ``q`` that satisfies a scene's constraints [rad or m].

    The metric is the kinetic energy at ``q``: light joints move more than heavy ones. The search follows a continuous
    path from ``q``. If the path ends early, the result is any configuration that satisfies the constraints, found by a
    search from ``q`` or from twenty points around it (the same points in every call).

    Args:
        scene: The scene.
        q: Start of the search, (n,) or by joint name [rad or m].

    Raises:
        AssemblyError: No configuration was found; the message names the constraint with the largest residual.
        InputError: A wrong shape, or a value that is not finite.
        UnknownJoint: ``q`` names a joint that is no coordinate of the robot.
        SingularMassMatrix: M(q) is not positive definite.
    """
    start = joint_array("q", q, require_scene(scene).robot.joint_names)
    if not scene.constraints:
        return start
    try:
        return nearest(scene, start)
    except AssemblyError as error:
        failure = error
    root, rng = _root_of_mass(scene, start), np.random.default_rng(0)
    for size in np.linspace(0.1, _FARTHEST, _RESTARTS):
        found = _polished(scene, _reached(scene, start + size * rng.normal(size=start.size), root), root)
        with contextlib.suppress(AssemblyError):
            _require_kept(scene, found)
            return found
    raise failure


def nearest(scene: Scene, q: Floats) -> Floats:
    """:func:`assemble` without restarts around ``q`` (n,); it raises the same errors."""
    root = _root_of_mass(scene, q)
    followed = _followed(scene, q, root)
    found = _polished(scene, _reached(scene, q, root) if followed is None else followed, root)
    _require_kept(scene, found)
    return found


def along_constraints(scene: Scene, q: Floats, v: Floats) -> Floats:
    """The velocity (n,) nearest to ``v`` in the kinetic-energy metric that the constraints allow at ``q`` (n,)."""
    root = _root_of_mass(scene, q)
    _, C = _values(scene, q)
    for _ in range(2):
        v = v - _shift(C @ v, C, root)
    return v


def dependent_input(scene: Scene, q: Floats) -> str | None:
    """Label of a kinematic input whose joint the other constraints determine at ``q`` (n,); None if there is none."""
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
    """Label and size [m or rad] of the largest constraint residual at ``q`` (n,)."""
    g, _ = _values(scene, q)
    worst = int(np.argmax(np.abs(g)))
    return scene.bound_constraints.labels[worst], float(np.abs(g[worst]))


def _values(scene: Scene, q: Floats) -> tuple[Floats, Floats]:
    """Residuals g (c,) and Jacobian C (c, n); rows of kinematic inputs, which hold at any q, are zero."""
    g, _, C = scene.core.constraints(q[None])
    g[:, list(scene.inputs)], C[:, list(scene.inputs)] = 0.0, 0.0
    return g[0], C[0]


def _root_of_mass(scene: Scene, q: Floats) -> Floats:
    """The inverse of the Cholesky factor L of M(q) = L L' (n, n)."""
    M = scene.core.jets(q[None], np.zeros((1, q.size)))[0][0]
    try:
        L = np.linalg.cholesky(M)
    except np.linalg.LinAlgError:
        raise SingularMassMatrix(scene.robot.joint_names, q) from None
    return np.asarray(np.linalg.inv(L), dtype=np.float64)


def _shift(g: Floats, C: Floats, root: Floats) -> Floats:
    """The smallest change of q (n,) in the kinetic-energy metric with C shift = g."""
    shift: Floats = root.T @ (np.linalg.pinv(C @ root.T, rcond=_RANK) @ g)
    return shift


def _followed(scene: Scene, start: Floats, root: Floats) -> Floats | None:
    """The nearest q, by a homotopy that scales the residuals at ``start`` down to zero; None where it fails."""
    initial, _ = _values(scene, start)
    q, y, done, step = start, np.zeros(len(initial)), 0.0, 1.0
    while done < 1.0:
        ahead = min(1.0, done + step)
        found = _nearest(scene, start, (1.0 - ahead) * initial, q, y, root)
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
    """Newton's method from (q, y) on M0 (q - start) + C' y = 0 and g = left; None where it does not contract."""
    metric = np.linalg.inv(root.T @ root)
    n, before = q.size, np.inf
    for _ in range(_NEWTON_ITERATIONS):
        g, C = _values(scene, q)
        B = C @ root.T
        H = np.eye(n) + root @ scene.core.constraint_curvature(q, y, np.zeros(n))[0] @ root.T
        K = np.block([[H, B.T], [B, np.zeros((len(g), len(g)))]])
        gradient = root @ (metric @ (q - start) + C.T @ y)
        step = np.linalg.lstsq(K, -np.append(gradient, g - left), rcond=_RANK)[0]
        shift = root.T @ step[:n]
        size = float(np.abs(shift).max())
        if not size <= min(0.5 * before, _LONGEST):
            return None
        q, y, before = q + shift, y + step[n:], max(size, 1e-12)
        if size < 1e-10:
            # A minimum of the distance has H positive definite on the null space of C.
            _, sizes, basis = np.linalg.svd(B)
            along = basis[int((sizes > _RANK * sizes[0]).sum()) :]
            return (q, y) if not len(along) or np.linalg.eigvalsh(along @ H @ along.T)[0] > 0.0 else None
    return None


def _reached(scene: Scene, q: Floats, root: Floats) -> Floats:
    """A configuration with g = 0, or a local minimum of g, by the Levenberg-Marquardt method from q."""
    g, C = _values(scene, q)
    damping = 1e-3
    for _ in range(_TRIALS):
        size = float(g @ g)
        if size < 1e-24:
            break
        B = C @ root.T
        scale = float(np.square(B).sum())
        shift = -root.T @ (B.T @ np.linalg.solve(B @ B.T + damping * scale * np.eye(len(g)), g))
        trial = q + shift * min(1.0, _LONGEST / max(float(np.abs(shift).max()), 1e-300))
        g_trial, C_trial = _values(scene, trial)
        if float(g_trial @ g_trial) < size:
            q, g, C, damping = trial, g_trial, C_trial, max(0.1 * damping, 1e-14)
        else:
            damping *= 10.0
            if damping > 1e12:
                break
    return q


def _polished(scene: Scene, q: Floats, root: Floats) -> Floats:
    """``q`` after Gauss-Newton corrections down to rounding, as long as they do not increase the residual."""
    g, C = _values(scene, q)
    for _ in range(4):
        trial = q - _shift(g, C, root)
        g_trial, C_trial = _values(scene, trial)
        if not np.abs(g_trial).max() <= max(np.abs(g).max(), _POLISHED):
            break
        q, g, C = trial, g_trial, C_trial
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
        for index in (x, y):
            ((body, _, along),) = scene.bound_constraints.rows.vectors[index]
            tree = scene.robot.tree
            both = [place_on_body(tree, q[None], body, np.array(at))[0] for at in (along, (0.0, 0.0, 0.0))]
            ends.append(both[0] - both[1])
        # The rows also vanish at half a turn about an axis and at a third about a diagonal. The product is 1 where the
        # frames agree, and -1 or 0 there.
        if not ends[0] @ ends[1] > 0.5:
            weld = next(label for label in scene.bound_constraints.labels if label.startswith("FrameOnFrame"))
            raise AssemblyError(weld.rsplit(" ", 2)[0], float(np.arccos(np.clip(ends[0] @ ends[1], -1.0, 1.0))), q)
