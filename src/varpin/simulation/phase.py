"""Errors in phase and amplitude of oscillations on springs over a whole motion.

Errors that are small over a period add up over many. On a linear system a step multiplies a mode exp(lambda t) by
R(h lambda), R the method's stability function (Hairer and Wanner II, IV.3): the error of its exponent grows at the rate
log(R(h lambda)) / h - lambda. The modes are those of the motion linearized at some of its nodes. Their amplitudes
follow from velocities and accelerations there, to which slow motions add little. Under constraints they are those on
the tangent space.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.errors import LinearizationError
from varpin.integrators import Integrator
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import ROUNDING, travel_scales
from varpin.simulation.modes import first_order, linearized, of_inputs, rate_bounds
from varpin.trajectory import Trajectory

Complexes = NDArray[np.complex128]

# Number of nodes with a linearization, and the most joints of a robot that is examined.
_NODES, _JOINTS = 9, 60
# Threshold of the warning, as a share of the joint's scale, see :func:`travel_scales`.
WARNED = 0.01
# Least phase of an oscillation over the motion [rad]. Slower ones lose little; and a free joint has the eigenvalue zero
# twice, which rounding splits into slow modes of any amplitude.
_TURNS = 1.0
# Error of the modes at the ends of a motion, as a share of the threshold, up to which other nodes are left out.
_NOTHING = 0.25
# Forces that make oscillations. Under gravity alone fast motions are chaotic, and slow ones lose little.
_SPRINGS = ("JointSpring", "JointStop", "PositionServo", "FrameSpring", "FrameLengthSpring", "FrameTurnSpring")


class Loss(NamedTuple):
    """The largest error of a motion by the phase and amplitude of an oscillation.

    Attributes:
        joint: The coordinate with the largest error.
        off: The error [rad or m].
        share: The error as a share of the joint's scale, see :func:`travel_scales`.
        rate: Of the oscillation [rad/s].
        turned: The error of the oscillation, in units of its amplitude.
    """

    joint: int
    off: float
    share: float
    rate: float
    turned: float


def phase_lost(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Loss | None:
    """The error by phase and amplitude of oscillations on springs, if it exceeds the threshold of the warning.

    Forces of noise are no part of the oscillation. None, too, where it is unknown: with forces or noise in Python, and
    for methods without a stability function.
    """
    if not _applies(scene, trajectory):
        return None
    steps = trajectory.steps
    at = np.unique(np.linspace(0, steps, _NODES).astype(np.int64))
    q, v = trajectory.q[at], trajectory.v[at]
    forces = trajectory.u[np.minimum(at, steps - 1)] @ scene.actuation.T
    try:
        a, aq, av, _, Z, onto = linearized(scene, q, v, forces, of_inputs(scene, trajectory, at))
    except LinearizationError:
        return None
    if not aq.shape[1]:
        return None
    speeds = (onto @ v[:, :, None])[:, :, 0]
    h = trajectory.dt / float(np.maximum(trajectory.statistics.substeps, 1).mean())
    # Upper bounds of the modes' rates. Slower modes lose less, as long as they turn by little in a step.
    bounds = rate_bounds(aq, av)
    fastest = float(bounds.max())
    drift = _drift(integrator, np.array([1j * fastest]), h)
    if drift is None or (h * fastest < 1.0 and abs(drift[0]) * trajectory.t[-1] < WARNED):
        return None
    travel = travel_scales(scene, trajectory.q)
    # In equilibrium accelerations and amplitudes are rounding.
    rounding = ROUNDING * (1.0 + np.abs(q).max())
    worst, most, ends = None, 0.0, (0, len(at) - 1)
    with np.errstate(over="ignore"):
        slowest = np.maximum(bounds[list(ends)].min(), np.finfo(np.float64).tiny)
        growth = float((fastest / slowest) ** (integrator.order + 1))
    alike = _damped_alike(scene, av)
    A = first_order(aq, av)
    for k in dict.fromkeys([*ends, *range(len(at))]):
        # Modes with the damping of those at the ends, and hardly faster, have nearly as small an error.
        if k not in ends and alike and most * growth < _NOTHING * WARNED:
            break
        node = at[k]
        try:
            rates, modes = np.linalg.eig(A[k])
            parts = np.linalg.solve(modes, np.append(speeds[k], a[k]))
        except np.linalg.LinAlgError:
            most = np.inf
            continue
        turns = rates.imag > _TURNS / trajectory.t[-1]
        rates, modes, parts = rates[turns], Z[k] @ modes[: a.shape[1], turns], parts[turns]
        heights = 2.0 * np.abs(modes * (parts / rates))
        drift = _drift(integrator, rates, h)
        if drift is None or not rates.size or not np.isfinite(drift).all():
            most = np.inf if rates.size else most
            continue
        # An oscillation at the start lasts to the end, unless it decays; one at a later node has lasted up to it.
        lasting = np.minimum(trajectory.t[-1 if node == 0 else node], 1.0 / np.maximum(np.abs(rates.real), 1e-300))
        left = np.exp(np.minimum(rates.real, 0.0) * lasting) if node == 0 else np.ones(rates.size)
        turned = np.minimum(np.abs(np.expm1(drift * lasting)), 2.0)
        most = max(most, float(turned.max()))
        swings = rates.imag > np.abs(rates.real)
        if not swings.any():
            continue
        rates, heights, left, turned = rates[swings], heights[:, swings], left[swings], turned[swings]
        off = heights * (left * turned)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.where(off > rounding, off / travel[:, None], 0.0)
        joint, mode = np.unravel_index(int(shares.argmax()), shares.shape)
        share = float(shares[joint, mode])
        if share >= WARNED and (worst is None or share > worst.share):
            worst = Loss(int(joint), float(off[joint, mode]), share, float(rates[mode].imag), float(turned[mode]))
    return worst


def _damped_alike(scene: Scene, av: Floats) -> bool:
    """Whether the damping at nodes (K, n, n) is at least half of that at the ends, and there are no stops.

    Not known under constraints, where coordinates differ from node to node.
    """
    if scene.constraints:
        return False
    damped = -np.diagonal(av, axis1=1, axis2=2)
    ends = damped[[0, -1]].max(axis=0)
    stopped = any(element.kind == "JointStop" for element in scene.elements)
    return not stopped and bool((2.0 * damped >= ends).all())


def _applies(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether there are springs, and no noise or forces in Python."""
    in_python = trajectory.dw.any() and scene.noise.diffusion is None
    if scene.custom is not None or in_python or scene.robot.dof > _JOINTS:
        return False
    kinds = [element.kind for element in scene.elements] + [coupling.kind for coupling in scene.couplings]
    sprung = scene.stiffness.any() or not set(_SPRINGS).isdisjoint(kinds)
    return bool(trajectory.steps and sprung)


def _drift(integrator: Integrator, rates: Complexes, h: float) -> Complexes | None:
    """Errors of the rates of modes in steps of h [s]: of growth (real) and of the phase (imaginary) [1/s]."""
    made = integrator.amplification(h * rates)
    if made is None:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.log(made) - h * rates
    # Whole turns between nodes do not show in them.
    off = off - 2j * np.pi * np.round(off.imag / (2.0 * np.pi))
    return np.asarray(off / h)
