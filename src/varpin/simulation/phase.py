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
_SHOWS = 0.02
# By how much an oscillation has to turn over the motion [rad]; what turns by less loses nothing that shows. A joint
# that nothing holds has the eigenvalue zero twice, which rounding splits into slow modes of any height.
_TURNS = 1.0
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
    fastest = np.sqrt(np.abs(aq).sum(axis=2).max()) + np.abs(av).sum(axis=2).max()
    drift = _drift(integrator, np.array([1j * fastest]), h)
    if drift is None or (h * fastest < 1.0 and abs(drift[0]) * trajectory.t[-1] < _SHOWS):
        return None
    way = largest_of_its_kind(scene, np.ptp(trajectory.q, axis=0))
    # A robot held in equilibrium has accelerations of rounding, and swings as little.
    rounding = ROUNDING * (1.0 + np.abs(q).max())
    worst = None
    for k, node in enumerate(at):
        A = np.block([[np.zeros((n, n)), np.eye(n)], [aq[k], av[k]]])
        try:
            rates, modes = np.linalg.eig(A)
            parts = np.linalg.solve(modes, np.append(v[k], a[k]))
        except np.linalg.LinAlgError:
            continue
        swings = rates.imag > np.maximum(np.abs(rates.real), _TURNS / trajectory.t[-1])
        rates, heights = rates[swings], 2.0 * np.abs(modes[:n, swings] * (parts[swings] / rates[swings]))
        drift = _drift(integrator, rates, h)
        if drift is None or not rates.size or not np.isfinite(drift).all():
            continue
        # What dies out, or grows, was not there before; what swings at the start is still there at the end.
        lasting = np.minimum(trajectory.t[-1 if node == 0 else node], 1.0 / np.maximum(np.abs(rates.real), 1e-300))
        left = np.exp(np.minimum(rates.real, 0.0) * lasting) if node == 0 else np.ones(rates.size)
        turned = np.minimum(np.abs(np.expm1(drift * lasting)), 2.0)
        off = heights * (left * turned)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.where(off > rounding, off / way[:, None], 0.0)
        joint, mode = np.unravel_index(int(shares.argmax()), shares.shape)
        share = float(shares[joint, mode])
        if share >= _SHOWS and (worst is None or share > worst.share):
            worst = Loss(int(joint), float(off[joint, mode]), share, float(rates[mode].imag), float(turned[mode]))
    return worst


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
