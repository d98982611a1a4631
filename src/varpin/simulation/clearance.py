"""Motions that are clearly right: most plain motions, which are told without repeating any step.

The equations of motion are evaluated along the polynomials through the nodes. Where they hold far better than any
warning needs, and no force has a kink, the check of :mod:`varpin.simulation.soundness` would find nothing, and is left
out. All other motions go through it: only that check gives warnings.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from varpin.arrays import Floats
from varpin.core import Stretch, clear_growth
from varpin.integrators import Integrator, Reference
from varpin.integrators.tableau import interpolation
from varpin.integrators.within import Times
from varpin.mechanics.forces import of_kind
from varpin.mechanics.scene import Scene
from varpin.simulation.accuracy import EVEN, LIGHT, LITTLE, WINDOW, WRONG_ENERGY, WRONG_MOTION, WRONG_VELOCITY
from varpin.simulation.growth import ALIGNED, FEWEST, JOINTS, NEAR, growth_bound
from varpin.simulation.growth import WARNED as GROWTH_WARNED
from varpin.simulation.kinks import turns_over
from varpin.simulation.phase import WARNED as PHASE_WARNED
from varpin.trajectory import Trajectory

# Errors of a motion that is clearly right, as a share of what the check would accept; and rates of its dampers along
# single steps, in units of 1 / dt, where 2 is what the check calls fast.
_SHARE, _RATE = 0.5, 1.8
# Largest change of dry friction in a step, as a share of its level.
_TURNS = 0.25
# Parts of the warnings' thresholds that the check accepts in a window: for an error that grows over a period, and for
# one that adds up over the motion.
_PERIOD, _ADDS = 0.125, 0.25
# Velocities below this count as zero [rad/s or m/s].
_STILL = 1e-9
# Squared distances from the middle of two steps at which to look, with one or with two on either side: the integrals
# over either step are then exact for polynomials of degree 5 and 8.
_SQUARES = np.array([1.0 / 3.0, 0.13564321619, 0.61435678381])
# Number of nodes at which dampers are looked at.
_DAMPERS = 6
# Largest order of methods whose steps are short enough for quadratures with fewer points.
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
    if not scene.smooth or scene.robot.dof > JOINTS or scene.group.any() or turns_over(scene, trajectory, _TURNS):
        return False
    times = integrator.stage_times if trajectory.u_stages.shape[1] else ()
    narrow, wide = _stretches(times, integrator.order <= _SHORT_STEPS)
    # Between the nodes at which dampers are looked at, dry friction may be any damper.
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
        narrow=narrow,
        wide=wide,
        still=_STILL,
        energy=_SHARE * WRONG_ENERGY,
        damping=0.0 if of_kind(scene.elements, "CoulombFriction") else _RATE,
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
def _stretches(times: Times, short: bool) -> tuple[Stretch, Stretch | None]:
    """Polynomials over a step and over two, with ``short`` ones on fewer points, for controls at ``times`` of each.

    There are none over two where the end of a step is the begin of the next one.
    """
    inner = np.polynomial.legendre.Legendre.basis(2 if short else 3).deriv().roots()
    points = 0.5 + 0.5 * np.array([-1.0, *inner, 1.0])
    gains = _integrals(points, 0.0)
    # Lobatto's rule is exact for this product, too.
    narrow = _stretch(points, np.array([[gains], [(1.0 - points) * gains]]), np.array(times))
    if {0.0, 1.0} <= set(times):
        return narrow, None
    around = np.sqrt(_SQUARES[:1] if short else _SQUARES[1:])
    points = 1.0 + np.array([-1.0, *-around[::-1], 0.0, *around, 1.0])
    sums = np.array([[_integrals(points, begin, power) for begin in (0.0, 1.0)] for power in (0, 1)])
    return narrow, _stretch(points, sums, np.append(times, 1.0 + np.array(times)))


def _stretch(points: Floats, sums: Floats, times: Floats) -> Stretch:
    """A stretch with points (r,), weights (2, steps, r) and controls at times (s,), in steps of unit length."""
    nodes = np.arange(sums.shape[1] + 1.0)
    size = 3 * len(nodes)
    # Rows for q, v and a of each node, of polynomials about the middle.
    middle, powers = 0.5 * nodes[-1], np.eye(size)
    given = [polyval(node - middle, polyder(powers, order)) for node in nodes for order in range(3)]
    basis = np.linalg.inv(given)
    curves = [polyval(points - middle, polyder(basis, order)).T for order in (0, 1)]
    return Stretch.make(
        curves=np.ascontiguousarray(curves),
        sums=np.ascontiguousarray(sums),
        places=np.ascontiguousarray(interpolation(times, points)),
    )


def _integrals(points: Floats, begin: float, power: int = 0) -> Floats:
    """Integrals (r,) of (1 - t)^power times the Lagrange polynomials on points (r,) over a step that begins there."""
    x, weights = np.polynomial.legendre.leggauss(len(points))
    at = 0.5 * (1.0 + x)
    integrals: Floats = 0.5 * (weights * (1.0 - at) ** power) @ interpolation(points, begin + at)
    return integrals
