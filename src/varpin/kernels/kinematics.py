"""Where bodies are, for many configurations at once."""

from typing import NamedTuple

import numpy as np

from varpin.kernels._compile import kernel
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
