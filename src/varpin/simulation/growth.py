"""Growth of the errors of single steps over a whole motion.

Where disturbances grow a thousandfold, steps that are right to five digits make a motion that is right to two. Repeated
steps give the error of a step, and the fastest modes of the linearized motion bound its growth. Only where the product
is large, the whole motion is repeated by a method of more stages.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats, Integers
from varpin.errors import LinearizationError
from varpin.integrators import Integrator, Reference
from varpin.integrators.base import open_loop
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import ROUNDING, largest_of_its_kind
from varpin.simulation.modes import first_order, linearized, of_inputs, rate_bounds
from varpin.simulation.retaking import finer, taken_again
from varpin.trajectory import Trajectory

# Begin of the warning.
SAID = "disturbances grow here"

# Number of repeated steps; fewest steps and most joints of an examined motion.
_PLACES, _LEAST, _JOINTS = 6, 40, 60
# Number of further steps, those that change velocities most, as where controls jump.
_VIOLENT = 4
# Threshold of the warning, as a share of the largest joint travel; and the part of it from which a motion is repeated.
WARNED, NEAR = 0.02, 0.3
# The share of the fastest mode's exponent by which a disturbance grows: at most half in 60 motions of arms and chains,
# because modes turn. And the largest exponent that is computed.
_ALIGNED, _MOST = 0.5, 60.0


class Growth(NamedTuple):
    """The error of a motion in which the errors of steps have grown.

    Attributes:
        joint: The coordinate with the largest error.
        off: The error [rad or m].
        share: The error as a share of the largest joint travel.
        time: When the error reaches the threshold of the warning [s].
        step: The largest error of a single step [rad or m].
    """

    joint: int
    off: float
    share: float
    time: float
    step: float


def growth_bound(scene: Scene, trajectory: Trajectory) -> float:
    """An estimate of the largest factor by which a disturbance grows over a motion.

    It comes from the fastest mode at two nodes; more would take longer than many a motion. It is 1 where
    :func:`grown_error` is None for every motion, and infinite where the linearization fails.
    """
    if _unexamined(scene, trajectory):
        return 1.0
    try:
        slopes = _slopes(scene, trajectory, np.array([trajectory.steps // 3, 2 * trajectory.steps // 3]))
    except LinearizationError:
        return np.inf
    if not slopes[0].shape[1]:
        return 1.0
    return _factor(float(_modes(*slopes).max()), trajectory)


def grown_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Growth | None:
    """The error of a motion after errors of its steps have grown; None below the threshold of the warning.

    None, too, under noise, with forces in Python, and of an integrator that chooses its own steps.
    """
    if isinstance(integrator, Reference) or _unexamined(scene, trajectory):
        return None
    steps = trajectory.steps
    other = finer(integrator, trajectory, damped=False, pulled=False)
    q, v = trajectory.q, trajectory.v
    at = _places(trajectory)
    # A few violent steps may be off by more than all others together.
    repeated = np.append(at, np.abs(np.diff(v, axis=0)).max(axis=1).argsort()[-_VIOLENT:])
    once = _once_more(scene, integrator, other.method, trajectory, repeated)
    if once is None:
        return None
    in_q, in_v = np.abs(once[0] - q[repeated + 1]), np.abs(once[1] - v[repeated + 1])
    way = largest_of_its_kind(scene, np.ptp(q, axis=0))
    least = ROUNDING * (1.0 + np.abs(q).max())
    begins = ((in_q + in_v * trajectory.dt) / np.maximum(way, least)).max(axis=1)
    small = NEAR * WARNED / max(steps * float(begins[: len(at)].max()), float(begins[len(at) :].sum()), 1e-300)
    if small > np.exp(_MOST):
        return None
    try:
        slopes = _slopes(scene, trajectory, at)
    except LinearizationError:
        return None
    if not slopes[0].shape[1]:
        return None
    # Eigenvalues take longer than all else: at half of the places.
    aq, av = slopes
    if small > _factor(float(np.median(rate_bounds(aq, av))), trajectory):
        return None
    typical = float(np.median(_modes(aq[::2], av[::2])))
    if scene.constraints:
        # Loops pass places where modes are much faster than elsewhere.
        typical = max(typical, float(np.maximum(_modes(aq, av), 0.0).mean()))
    if small > _factor(typical, trajectory):
        return None
    again = taken_again(scene, other.method, trajectory, integrator.stage_times, 0, steps, other.parts)
    if again is None:
        return None
    off = np.nan_to_num(np.abs(again[0] - q))
    shares = off / np.maximum(way, least)
    joint = int(shares.max(axis=0).argmax())
    share = float(shares[:, joint].max())
    if share <= WARNED:
        return None
    first = float(trajectory.t[(shares[:, joint] > WARNED).argmax()])
    return Growth(joint, float(off[:, joint].max()), share, first, float(in_q.max()))


def _once_more(
    scene: Scene, integrator: Integrator, method: Integrator, trajectory: Trajectory, steps: Integers
) -> tuple[Floats, Floats] | None:
    """Q and v (K, n) after each of some steps, repeated by another method; None where it fails."""
    if scene.inputs:
        again = [taken_again(scene, method, trajectory, integrator.stage_times, int(k), 1, 1) for k in steps]
        ends = [(each[0][1], each[1][1]) for each in again if each is not None]
        return (np.array([q for q, _ in ends]), np.array([v for _, v in ends])) if len(ends) == len(steps) else None
    # Controls that change within a step do so for both, nearly.
    forces = np.ascontiguousarray(trajectory.u[steps] @ scene.actuation.T)
    nothing = open_loop(np.zeros((1, scene.controls)))
    once = method.motions(scene, trajectory.q[steps], trajectory.v[steps], nothing, forces[:, None], trajectory.dt)
    return None if once is None else (once[0][:, 0], once[1][:, 0])


def _unexamined(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether growth is not examined: under noise or Python forces, for few steps or many joints."""
    hidden = scene.custom is not None or trajectory.dw.any()
    few = int(np.maximum(trajectory.statistics.substeps, 1).sum()) < _LEAST
    return bool(hidden or few or scene.robot.dof > _JOINTS)


def _places(trajectory: Trajectory) -> NDArray[np.int64]:
    """Nodes of the motion at which it is linearized."""
    return np.linspace(0, trajectory.steps - 1, _PLACES + 2).astype(np.int64)[1:-1]


def _slopes(scene: Scene, trajectory: Trajectory, at: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Derivatives of the accelerations in q and in v (K, n, n), under constraints on the tangent space (K, f, f).

    Raises:
        LinearizationError: There are none.
    """
    forces = np.ascontiguousarray(trajectory.u[at] @ scene.actuation.T)
    given = trajectory.q[at], trajectory.v[at], forces
    found = linearized(scene, *given, of_inputs(scene, trajectory, at))
    return found.aq, found.av


def _modes(aq: Floats, av: Floats) -> Floats:
    """The rate at which the fastest mode of the linearized accelerations grows at each place (K,) [1/s]."""
    rates: Floats = np.linalg.eigvals(first_order(aq, av)).real.max(axis=1)
    return rates


def _factor(rate: float, trajectory: Trajectory) -> float:
    """The factor by which a disturbance grows over a motion whose fastest mode has this rate [1/s]."""
    length = float(trajectory.t[-1] - trajectory.t[0])
    return float(np.exp(min(_ALIGNED * rate * length, _MOST)))
