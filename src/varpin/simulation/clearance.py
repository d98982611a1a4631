"""Motions that are clearly right: most plain motions, which are told without repeating any step.

The equations of motion are evaluated along the polynomials through the nodes. Where they hold far better than any
warning needs, and no force has a kink or is faster than the step, the check of :mod:`varpin.simulation.soundness` would
find nothing, and is left out. All other motions go through it: only that check gives warnings.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from varpin.arrays import Floats
from varpin.core import clear_growth
from varpin.integrators import Integrator, Reference
from varpin.integrators.tableau import interpolation
from varpin.integrators.within import Times
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import EVEN, LIGHT, LITTLE, WINDOW, WRONG_ENERGY, WRONG_MOTION, WRONG_VELOCITY
from varpin.simulation.growth import ALIGNED, FEWEST, JOINTS, NEAR, growth_bound
from varpin.simulation.growth import WARNED as GROWTH_WARNED
from varpin.simulation.phase import WARNED as PHASE_WARNED
from varpin.trajectory import Trajectory

# Errors of a motion that is clearly right, as a share of what the check would accept; and rates of its dampers, in
# units of 1 / dt, where 2 is what the check calls fast.
_SHARE, _RATE = 0.5, 1.8
# Parts of the warnings' thresholds that the check accepts in a window: for an error that grows over a period, and for
# one that adds up over the motion.
_PERIOD, _ADDS = 0.125, 0.25
# Velocities below this count as zero [rad/s or m/s].
_STILL = 1e-9
# Number of nodes at which dampers are looked at.
_DAMPERS = 6
# Points of quadratures on [0, 1], Lobatto's with three and with four, and their weights.
_FAR = np.sqrt(0.2)
_THREE = np.array([0.0, 0.5, 1.0]), np.array([1.0, 4.0, 1.0]) / 6.0
_FOUR = np.array([0.0, 0.5 - 0.5 * _FAR, 0.5 + 0.5 * _FAR, 1.0]), np.array([1.0, 5.0, 5.0, 1.0]) / 12.0
# Largest order of methods whose steps are short enough for the first.
_SHORT_STEPS = 4


def clearly_right(scene: Scene, integrator: Integrator, trajectory: Trajectory, error: float | None = None) -> bool:
    """Whether a motion certainly has no error that the check of its steps would find.

    ``error`` is the largest error of q at all nodes [rad or m], where it is known, as of a motion with a tolerance: the
    equations of motion are not evaluated then.

    False also where this cannot be told from its nodes alone: under constraints and noise, with forces that have kinks,
    with forces in Python, and for integrators that choose their own steps.
    """
    if isinstance(integrator, Reference) or not trajectory.steps:
        return False
    if not scene.linear or scene.robot.dof > JOINTS or scene.group.any():
        return False
    points, weights = _FOUR if integrator.order > _SHORT_STEPS else _THREE
    times = integrator.stage_times if trajectory.u_stages.shape[1] else ()
    allowed = clear_growth(
        scene.core,
        trajectory.q,
        trajectory.v,
        trajectory.p,
        trajectory.u,
        trajectory.u_stages,
        trajectory.statistics.energy_defect,
        trajectory.statistics.substeps,
        trajectory.dt,
        points=points,
        weights=weights,
        places=_places(times, len(points)),
        still=_STILL,
        energy=_SHARE * WRONG_ENERGY,
        damping=_RATE,
        damped_at=_DAMPERS,
        travel=_SHARE * _PERIOD * WRONG_MOTION,
        velocity=_SHARE * _PERIOD * WRONG_VELOCITY,
        little=LITTLE,
        light=LIGHT,
        even=EVEN,
        window=WINDOW,
        whole=_SHARE * _ADDS * PHASE_WARNED,
        grown=_SHARE * NEAR * GROWTH_WARNED,
        aligned=ALIGNED,
        few=FEWEST,
        known=-1.0 if error is None else error,
    )
    # The core has a bound of the growth only.
    return math.isinf(allowed) or (allowed > 1.0 and growth_bound(scene, trajectory) <= allowed)


@functools.cache
def _places(times: Times, points: int) -> Floats:
    """Factors (points, s) of controls at stages on those at the points of a quadrature; read-only."""
    at = (_THREE if points == len(_THREE[0]) else _FOUR)[0]
    factors = interpolation(np.array(times), at)
    factors.setflags(write=False)
    return factors
