"""What oscillations on springs lose over a whole motion: phase, and height.

Errors over a period that are too small to speak of add up over many. On a linear system a step multiplies a mode
exp(lambda t) by R(h lambda), R the method's stability function (Hairer and Wanner II, IV.3): it goes wrong at the rate
log(R(h lambda)) / h - lambda. Modes are those of the motion linearized at some of its nodes; the part of each in it
follows from velocities and accelerations there, to which slow motions add little.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from varpin.errors import LinearizationError
from varpin.integrators import Integrator
from varpin.integrators.explicit import accelerations
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import ROUNDING, largest_of_its_kind
from varpin.trajectory import Trajectory

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Nodes at which modes are looked at, and the most joints of a robot that they are looked for of.
_NODES, _JOINTS = 9, 60
# What is spoken of, in units of the way of the joint that goes furthest.
SHOWS = 0.02
# By how much an oscillation has to turn over the motion [rad]; what turns by less loses nothing that shows. A joint
# that nothing holds has the eigenvalue zero twice, which rounding splits into slow modes of any height.
_TURNS = 1.0
# What is told of modes at the ends of a motion tells of all the others if they turn by this part of what is spoken of.
_NOTHING = 0.25
# Forces that make oscillations; under gravity alone fast motions are chaotic, and slow ones lose little.
_SPRINGS = ("JointSpring", "JointStop", "PositionServo", "FrameSpring", "FrameLengthSpring", "FrameTurnSpring")


class Loss(NamedTuple):
    """What a motion has lost to the phase of its oscillations where that shows most.

    Attributes:
        joint: Which coordinate.
        off: What it is off by [rad or m].
        share: The same, in units of the way of the joint that goes furthest.
        rate: Of the oscillation [rad/s].
        turned: What the oscillation is off by, in units of its height.
    """

    joint: int
    off: float
    share: float
    rate: float
    turned: float


def phase_lost(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> Loss | None:
    """What is lost to phase and height of oscillations on springs, if that is worth a word.

    None, too, of what nobody knows: under noise, constraints and forces in Python, and of methods without a stability
    function.
    """
    if not _asks(scene, trajectory):
        return None
    steps, n = trajectory.steps, scene.robot.dof
    at = np.unique(np.linspace(0, steps, _NODES).astype(np.int64))
    q, v = trajectory.q[at], trajectory.v[at]
    forces = trajectory.u[np.minimum(at, steps - 1)] @ scene.actuation.T
    try:
        a, aq, av, _ = accelerations(scene, q, v, forces)
    except LinearizationError:
        return None
    h = trajectory.dt / float(np.maximum(trajectory.statistics.substeps, 1).mean())
    # No mode is faster than this, and no slower one loses more as long as it turns by little in a step.
    bounds = np.sqrt(np.abs(aq).sum(axis=2).max(axis=1)) + np.abs(av).sum(axis=2).max(axis=1)
    fastest = float(bounds.max())
    drift = _drift(integrator, np.array([1j * fastest]), h)
    if drift is None or (h * fastest < 1.0 and abs(drift[0]) * trajectory.t[-1] < SHOWS):
        return None
    way = largest_of_its_kind(scene, np.ptp(trajectory.q, axis=0))
    # A robot held in equilibrium has accelerations of rounding, and swings as little.
    rounding = ROUNDING * (1.0 + np.abs(q).max())
    worst, most, ends = None, 0.0, (0, len(at) - 1)
    with np.errstate(over="ignore"):
        slowest = np.maximum(bounds[list(ends)].min(), np.finfo(np.float64).tiny)
        growth = float((fastest / slowest) ** (integrator.order + 1))
    alike = _damped_alike(scene, av)
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:] = np.eye(n)
    for k in dict.fromkeys([*ends, *range(len(at))]):
        # Modes that are damped as those at the ends, and hardly faster, turn by nearly as little.
        if k not in ends and alike and most * growth < _NOTHING * SHOWS:
            break
        node, A[n:, :n], A[n:, n:] = at[k], aq[k], av[k]
        try:
            rates, modes = np.linalg.eig(A)
            parts = np.linalg.solve(modes, np.append(v[k], a[k]))
        except np.linalg.LinAlgError:
            most = np.inf
            continue
        turns = rates.imag > _TURNS / trajectory.t[-1]
        rates, modes, parts = rates[turns], modes[:n, turns], parts[turns]
        heights = 2.0 * np.abs(modes * (parts / rates))
        drift = _drift(integrator, rates, h)
        if drift is None or not rates.size or not np.isfinite(drift).all():
            most = np.inf if rates.size else most
            continue
        # What dies out, or grows, was not there before; what swings at the start is still there at the end.
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
            shares = np.where(off > rounding, off / way[:, None], 0.0)
        joint, mode = np.unravel_index(int(shares.argmax()), shares.shape)
        share = float(shares[joint, mode])
        if share >= SHOWS and (worst is None or share > worst.share):
            worst = Loss(int(joint), float(off[joint, mode]), share, float(rates[mode].imag), float(turned[mode]))
    return worst


def _damped_alike(scene: Scene, av: Floats) -> bool:
    """Whether all joints are damped at some nodes (K, n, n) nearly as at the first and the last, and no stop acts."""
    damped = -np.diagonal(av, axis1=1, axis2=2)
    ends = damped[[0, -1]].max(axis=0)
    stopped = any(element.kind == "JointStop" for element in scene.elements)
    return not stopped and bool((2.0 * damped >= ends).all())


def _asks(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether there are springs, and nothing that hides what they do."""
    if scene.custom is not None or scene.constraints or trajectory.dw.any() or scene.robot.dof > _JOINTS:
        return False
    kinds = [element.kind for element in scene.elements] + [coupling.kind for coupling in scene.couplings]
    sprung = scene.stiffness.any() or not set(_SPRINGS).isdisjoint(kinds)
    return bool(trajectory.steps and sprung)


def _drift(integrator: Integrator, rates: Complexes, h: float) -> Complexes | None:
    """By how much modes of some rates [1/s] grow and turn faster in steps of h [s] than they should [1/s]."""
    made = integrator.amplification(h * rates)
    if made is None:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.log(made) - h * rates
    # Nodes do not tell of whole turns between them.
    off = off - 2j * np.pi * np.round(off.imag / (2.0 * np.pi))
    return np.asarray(off / h)
