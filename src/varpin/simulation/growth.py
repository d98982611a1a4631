"""Growth of small errors of single steps over a whole motion.

Where a disturbance grows a thousandfold, steps that are right to five digits make a motion that is right to two. The
errors of some steps are estimated by repeating them, and their growth by the fastest modes of the motion linearized
there. Only if both together give a large error is the whole motion repeated by a method of more stages.
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

# First words of the warning.
SAID = "disturbances grow here"

# Number of repeated steps, and the fewest steps of a motion and most joints of a robot that are examined.
_PLACES, _LEAST, _JOINTS = 6, 40, 60
# Error from which on a warning is given, as a share of the way of the joint that goes furthest; and the part of it from
# which on the motion is repeated.
_WARNED, _NEAR = 0.02, 0.3
# Exponent of growth as a share of the fastest mode's: at most half in 60 motions of arms and chains, for the directions
# of modes turn; and the largest exponent.
_ALIGNED, _MOST = 0.5, 60.0


class Growth(NamedTuple):
    """The error of a motion after errors of its steps have grown.

    Attributes:
        joint: The coordinate with the largest error.
        off: The error [rad or m].
        share: The same, in units of the way of the joint that goes furthest.
        time: Time from which on the error exceeds the threshold of the warning [s].
        step: The largest error of a single step [rad or m].
    """

    joint: int
    off: float
    share: float
    time: float
    step: float


def grown_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Growth | None:
    """The error of a motion after errors of single steps have grown, if it exceeds the threshold of the warning.

    None, too, under noise and constraints, with forces in Python, and for an integrator that chooses its own steps.
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
    # The means of controls that change within a step serve: they do nearly the same in both methods.
    in_q, in_v = np.abs(once[0][:, 0] - q[at + 1]), np.abs(once[1][:, 0] - v[at + 1])
    way = largest_of_its_kind(scene, np.ptp(q, axis=0))
    least = ROUNDING * (1.0 + np.abs(q).max())
    begins = (in_q + in_v * trajectory.dt) / np.maximum(way, least)
    length = float(trajectory.t[-1] - trajectory.t[0])
    small = _NEAR * _WARNED / max(steps * float(begins.max()), 1e-300)
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
    # Eigenvalues, the most expensive part, at half of the places.
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
    if share <= _WARNED:
        return None
    first = float(trajectory.t[(shares[:, joint] > _WARNED).argmax()])
    return Growth(joint, float(off[:, joint].max()), share, first, float(in_q.max()))
