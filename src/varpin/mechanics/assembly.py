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
_MOST = 200


def assemble(scene: Scene, q: JointValues) -> Floats:
    """The configuration (n,) nearest to ``q`` that keeps a scene's constraints [rad or m].

    Nearest in the metric of the kinetic energy at ``q``: as light joints move easily. It is a local search.

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
    root = _root_of_mass(scene, start)
    found = _reached(scene, start, root)
    found = _polished(scene, _nearest(scene, start, found, root), root)
    _require_kept(scene, found)
    return found


def along_constraints(scene: Scene, q: Floats, v: Floats) -> Floats:
    """The velocity (n,) nearest to ``v`` that constraints allow at ``q`` (n,), in the metric of the kinetic energy."""
    root = _root_of_mass(scene, q)
    _, C = _values(scene, q)
    for _ in range(2):
        v = v - _shift(C @ v, C, root)
    return v


def missed(scene: Scene, q: Floats) -> tuple[str, float]:
    """The constraint that misses by most at ``q`` (n,), and by how much [m or rad]."""
    g, _ = _values(scene, q)
    worst = int(np.argmax(np.abs(g)))
    return scene.bound_constraints.labels[worst], float(np.abs(g[worst]))


def _values(scene: Scene, q: Floats) -> tuple[Floats, Floats]:
    g, _, C = scene.core.constraints(np.ascontiguousarray(q[None]))
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


def _reached(scene: Scene, q: Floats, root: Floats) -> Floats:
    """Some configuration without g, from q on: Levenberg's and Marquardt's method."""
    g, C = _values(scene, q)
    damping = 1e-3
    for _ in range(_MOST):
        size = float(g @ g)
        if size < 1e-24:
            break
        B = C @ root.T
        scale = float(np.square(B).sum())
        trial = q - root.T @ (B.T @ np.linalg.solve(B @ B.T + damping * scale * np.eye(len(g)), g))
        g_there, C_there = _values(scene, trial)
        if float(g_there @ g_there) < size:
            q, g, C, damping = trial, g_there, C_there, max(0.1 * damping, 1e-14)
        else:
            damping *= 10.0
            if damping > 1e12:
                break
    return q


def _nearest(scene: Scene, start: Floats, found: Floats, root: Floats) -> Floats:
    """The nearest one, from one found: Newton's method on M0 (q - q0) + C' y = 0, g = 0."""
    metric = np.linalg.inv(root.T @ root)
    q, C = found, _values(scene, found)[1]
    y = np.asarray(np.linalg.lstsq(C.T, -metric @ (q - start), rcond=_DEPENDENT)[0], dtype=np.float64)

    def slope(q: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        g, C = _values(scene, q)
        return root @ (metric @ (q - start) + C.T @ y), g, C

    force, g, C = slope(q, y)
    merit = float(force @ force + g @ g)
    for _ in range(30):
        H = metric + scene.core.constraint_curvature(q, y, np.zeros_like(q))[0]
        n, c = q.size, len(g)
        K = np.block([[root @ H @ root.T, root @ C.T], [C @ root.T, np.zeros((c, c))]])
        step = np.linalg.lstsq(K, -np.append(force, g), rcond=1e-12)[0]
        length = 1.0
        while length > 1e-3:
            trial = q + length * (root.T @ step[:n]), y + length * step[n:]
            force_there, g_there, C_there = slope(*trial)
            there = float(force_there @ force_there + g_there @ g_there)
            if there < merit:
                break
            length *= 0.5
        else:
            break
        (q, y), force, g, C, merit = trial, force_there, g_there, C_there, there
    # A stationary point that is farther than what it began with is none to go to.
    far, near = (float(np.linalg.norm(np.linalg.solve(root.T, x - start))) for x in (q, found))
    return q if far <= near * (1.0 + 1e-9) else found


def _polished(scene: Scene, q: Floats, root: Floats) -> Floats:
    """To rounding."""
    for _ in range(4):
        g, C = _values(scene, q)
        q = q - _shift(g, C, root)
    return q


def _require_kept(scene: Scene, q: Floats) -> None:
    g, scale, _ = (part[0] for part in scene.core.constraints(q[None]))
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
        if not ends[0] @ ends[1] > 0.0:
            weld = next(label for label in scene.bound_constraints.labels if label.startswith("FrameOnFrame"))
            raise AssemblyError(weld.rpartition(" ")[0], float(np.arccos(np.clip(ends[0] @ ends[1], -1.0, 1.0))), q)
