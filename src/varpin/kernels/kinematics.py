"""Where bodies and frames are, and how rotations differ, for many configurations at once."""

from typing import NamedTuple

import numpy as np

from varpin.kernels._compile import inlined, kernel
from varpin.kernels.tree import Floats, Integers


class Bodies(NamedTuple):
    """Some bodies of a tree and all their ancestors, as in :class:`varpin.kernels.tree.Tree`."""

    parent: Integers  # (c,) index among these bodies, -1 at a root; parents come first
    prismatic: Integers  # (c,)
    rotation: Floats  # (c, 3, 3)
    translation: Floats  # (c, 3) [m]
    coordinate: Integers  # (c,) among all n
    ratio: Floats  # (c,)
    offset: Floats  # (c,) [rad or m]


@kernel
def place(bodies: Bodies, q: Floats, rotation: Floats, position: Floats) -> None:
    """World rotations (N, c, 3, 3) and positions (N, c, 3) of the bodies' frames at q (N, n)."""
    for k in range(q.shape[0]):
        for j in range(bodies.parent.size):
            parent = bodies.parent[j]
            R, p = rotation[k, j], position[k, j]
            for r in range(3):
                if parent < 0:
                    p[r] = bodies.translation[j, r]
                    for c in range(3):
                        R[r, c] = bodies.rotation[j, r, c]
                    continue
                p[r] = position[k, parent, r]
                for c in range(3):
                    p[r] += rotation[k, parent, r, c] * bodies.translation[j, c]
                    total = 0.0
                    for i in range(3):
                        total += rotation[k, parent, r, i] * bodies.rotation[j, i, c]
                    R[r, c] = total
            angle = bodies.ratio[j] * q[k, bodies.coordinate[j]] + bodies.offset[j]
            if bodies.prismatic[j] != 0:
                for r in range(3):
                    p[r] += angle * R[r, 2]
                continue
            cos, sin = np.cos(angle), np.sin(angle)
            for r in range(3):
                x, y = R[r, 0], R[r, 1]
                R[r, 0] = cos * x + sin * y
                R[r, 1] = cos * y - sin * x


@kernel
def place_frame(
    bodies: Bodies,
    turned: Floats,
    shifted: Floats,
    q: Floats,
    rotation: Floats,
    position: Floats,
    R: Floats,
    p: Floats,
    J: Floats,
) -> None:
    """World rotation R (N, 3, 3) and position p (N, 3) of a frame on the last body at q (N, n), and its Jacobian.

    The frame stands at (``turned`` (3, 3), ``shifted`` (3,)) in the body. J (N, 6, n) is linear over angular velocity
    in world axes; (0, 6, n) where nobody asks for it. ``rotation`` and ``position`` are work arrays of :func:`place`.
    """
    place(bodies, q, rotation, position)
    last = bodies.parent.size - 1
    for k in range(q.shape[0]):
        for r in range(3):
            p[k, r] = position[k, last, r]
            for c in range(3):
                p[k, r] += rotation[k, last, r, c] * shifted[c]
                total = 0.0
                for i in range(3):
                    total += rotation[k, last, r, i] * turned[i, c]
                R[k, r, c] = total
        if J.shape[0] == 0:
            continue
        J[k] = 0.0
        for j in range(bodies.parent.size):
            column, ratio = bodies.coordinate[j], bodies.ratio[j]
            x, y, z = rotation[k, j, 0, 2], rotation[k, j, 1, 2], rotation[k, j, 2, 2]
            if bodies.prismatic[j] != 0:
                J[k, 0, column] += ratio * x
                J[k, 1, column] += ratio * y
                J[k, 2, column] += ratio * z
                continue
            a, b, c = p[k, 0] - position[k, j, 0], p[k, 1] - position[k, j, 1], p[k, 2] - position[k, j, 2]
            J[k, 0, column] += ratio * (y * c - z * b)
            J[k, 1, column] += ratio * (z * a - x * c)
            J[k, 2, column] += ratio * (x * b - y * a)
            J[k, 3, column] += ratio * x
            J[k, 4, column] += ratio * y
            J[k, 5, column] += ratio * z


@inlined
def quaternion(E: Floats, z: Floats) -> None:
    """A multiple of the quaternion (w, x, y, z) of a rotation matrix, w not negative.

    From the largest of its entries, so that none is a difference of what cancels (Shepperd, "Quaternion from rotation
    matrix", 1978).
    """
    trace = E[0, 0] + E[1, 1] + E[2, 2]
    largest, most = -1, trace
    for i in range(3):
        if E[i, i] > most:
            largest, most = i, E[i, i]
    if largest < 0:
        z[0] = 1.0 + trace
        z[1], z[2], z[3] = E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]
        return
    i = largest
    j, k = (i + 1) % 3, (i + 2) % 3
    z[0] = E[k, j] - E[j, k]
    z[1 + i] = 1.0 + E[i, i] - E[j, j] - E[k, k]
    z[1 + j] = E[i, j] + E[j, i]
    z[1 + k] = E[i, k] + E[k, i]
    if z[0] < 0.0:
        for c in range(4):
            z[c] = -z[c]


@kernel
def rotation_logarithms(target: Floats, R: Floats, E: Floats, z: Floats, r: Floats, D: Floats) -> None:
    """The logarithms r (N, 3) of target' R, for R (N, 3, 3) and targets that repeat after T of them (T, 3, 3).

    D (N, 3, 3), or (0, 3, 3) where nobody asks for it: d r = D w dt for an R that turns with w in its own axes,

        D = 1 + [r]/2 + (1 - (a/2) cot(a/2)) [r]^2 / a^2,    a = |r|

    (Chirikjian, Stochastic Models, Information Theory, and Lie Groups 2, 2011, 10.86). ``E`` (3, 3) and ``z`` (4,) are
    work arrays.
    """
    for k in range(R.shape[0]):
        of = target[k % target.shape[0]]
        for i in range(3):
            for j in range(3):
                E[i, j] = of[0, i] * R[k, 0, j] + of[1, i] * R[k, 1, j] + of[2, i] * R[k, 2, j]
        quaternion(E, z)
        sine = np.sqrt(z[1] * z[1] + z[2] * z[2] + z[3] * z[3])
        angle = 2.0 * np.arctan2(sine, z[0])
        scale = angle / sine if sine > 0.0 else 0.0
        for i in range(3):
            r[k, i] = scale * z[1 + i]
        if D.shape[0] == 0:
            continue
        square = angle * angle
        half = 0.5 * angle
        factor = 1.0 / 12.0 + square / 720.0 if angle < 1e-3 else (1.0 - half / np.tan(half)) / square
        # [r]^2 = r r' - a^2
        for i in range(3):
            for j in range(3):
                D[k, i, j] = factor * r[k, i] * r[k, j]
            D[k, i, i] += 1.0 - factor * square
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            D[k, a, b] -= 0.5 * r[k, i]
            D[k, b, a] += 0.5 * r[k, i]
