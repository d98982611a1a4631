"""What errors of single steps, too small to speak of, grow to over a whole motion.

Where a disturbance grows a thousandfold, steps that are right to five digits make a motion that is right to two. Some
steps taken again tell what they are off by, and the fastest modes of the motion linearized at these places by how much
that may grow. Only if both together come to something is the whole motion made again by a method of more stages.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.errors import LinearizationError
from varpin.integrators import Integrator, Reference
from varpin.integrators.base import open_loop
from varpin.integrators.explicit import accelerations
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import ROUNDING, largest_of_its_kind
from varpin.simulation.retaking import finer, taken_again
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]

# How what is said of it begins.
SAID = "disturbances grow here"

# Steps that are taken again, the fewest of a motion that is asked of, and the most joints.
_PLACES, _LEAST, _JOINTS = 6, 40, 60
# What is spoken of, in units of the way of the joint that goes furthest, and the part of it that is looked after.
_SHOWS, _NEAR = 0.02, 0.3
# The part of the fastest mode's exponent that a disturbance grows by, at most half in 60 motions of arms and chains, as
# modes turn; and an exponent that stands for all beyond.
_ALIGNED, _MOST = 0.5, 60.0


class Growth(NamedTuple):
    """What a motion is off by after errors of its steps have grown.

    Attributes:
        joint: The coordinate that is off most.
        off: By how much [rad or m].
        share: The same, in units of the way of the joint that goes furthest.
        time: From when on it is off by so much that it is spoken of [s].
        step: What single steps are off by, at worst [rad or m].
    """

    joint: int
    off: float
    share: float
    time: float
    step: float


def grown_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Growth | None:
    """What errors of single steps grow to, if that is worth a word.

    None, too, under noise and constraints, with forces in Python, and of an integrator that chooses its own steps.
    """
    steps, n = trajectory.steps, scene.robot.dof
    hidden = scene.custom is not None or scene.constraints or trajectory.dw.any()
    if hidden or isinstance(integrator, Reference) or n > _JOINTS or steps < _LEAST:
        return None
    other = finer(integrator, trajectory, damped=False, pulled=False)
    at = np.linspace(0, steps - 1, _PLACES + 2).astype(np.int64)[1:-1]
    q, v = trajectory.q, trajectory.v
    forces = np.ascontiguousarray(trajectory.u[at] @ scene.actuation.T)
    nothing = open_loop(np.zeros((1, scene.controls)))
    once = other.method.motions(scene, q[at], v[at], nothing, forces[:, None], trajectory.dt)
    if once is None:
        return None
    # Controls that change within a step do so for both, nearly.
    in_q, in_v = np.abs(once[0][:, 0] - q[at + 1]), np.abs(once[1][:, 0] - v[at + 1])
    way = largest_of_its_kind(scene, np.ptp(q, axis=0))
    least = ROUNDING * (1.0 + np.abs(q).max())
    begins = (in_q + in_v * trajectory.dt) / np.maximum(way, least)
    length = float(trajectory.t[-1] - trajectory.t[0])
    small = _NEAR * _SHOWS / max(steps * float(begins.max()), 1e-300)
    if small > np.exp(_MOST):
        return None
    try:
        _, aq, av, _ = accelerations(scene, q[at], v[at], forces)
    except LinearizationError:
        return None
    # No mode is faster than this.
    fastest = np.sqrt(np.abs(aq).sum(axis=2).max(axis=1)) + np.abs(av).sum(axis=2).max(axis=1)
    if small > np.exp(min(_ALIGNED * float(np.median(fastest)) * length, _MOST)):
        return None
    # Eigenvalues take longer than all else: at half of the places.
    J = np.zeros((_PLACES // 2, 2 * n, 2 * n))
    J[:, range(n), range(n, 2 * n)] = 1.0
    J[:, n:, :n], J[:, n:, n:] = aq[::2], av[::2]
    rate = float(np.median(np.linalg.eigvals(J).real.max(axis=1)))
    if small > np.exp(min(_ALIGNED * rate * length, _MOST)):
        return None
    again = taken_again(scene, other.method, trajectory, integrator.stage_times, 0, steps, other.parts)
    if again is None:
        return None
    off = np.nan_to_num(np.abs(again[0] - q))
    shares = off / np.maximum(way, least)
    joint = int(shares.max(axis=0).argmax())
    share = float(shares[:, joint].max())
    if share <= _SHOWS:
        return None
    first = float(trajectory.t[(shares[:, joint] > _SHOWS).argmax()])
    return Growth(joint, float(off[:, joint].max()), share, first, float(in_q.max()))
