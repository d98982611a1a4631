"""The gate of the check: motions that are clearly right, which are told without repeating any step.

The equations of motion are evaluated along the polynomials through the nodes. What is left of them in each step, its
defect, propagates as the motion linearized along its own nodes does: that is the error, to first order.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from varpin.arrays import Floats
from varpin.core import Stretch, propagated_errors
from varpin.integrators import Integrator, Reference
from varpin.mechanics.forces import of_kind
from varpin.mechanics.scene import Scene
from varpin.signals.commands import Times, interpolation
from varpin.simulation.spectrum import fastest_rate, speed_scales, travel_scales
from varpin.trajectory import Trajectory

# Largest propagated errors of q and v of a motion that is let pass, as shares of the travel and of the largest speed: a
# third of what is told of. Of 2142 random motions 2.7 % had a true error above four times the propagated one, in fast
# chaotic ones up to 64 times, and none above 1 % of the travel.
_TRAVEL, _SPEED, _SURE = 3e-3, 0.05, 4.0
# Rate of dampers along single steps, in units of 1 / dt, beyond which what is left of a step does not tell its error.
_RATE = 1.8
# Largest change of dry friction in a step, as a share of its level.
_TURNS = 0.25
# Most joints: linearizations of more take longer than the motion.
_JOINTS = 60
# Squared distances from the middle of two steps at which to look, with one or with two on either side: the integrals
# over either step are then exact for polynomials of degree 5 and 8.
_SQUARES = np.array([1.0 / 3.0, 0.13564321619, 0.61435678381])
# Largest order of methods whose steps are short enough for quadratures with fewer points.
_SHORT_STEPS = 4


def proven_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> float | None:
    """Four times a motion's error to first order [rad or m], if it is small beside the travel; None where not known."""
    if isinstance(integrator, Reference) or not trajectory.steps or scene.robot.dof > _JOINTS:
        return None
    split = trajectory.statistics.substeps.max() > 1
    if split or not scene.smooth or scene.group.any() or _turns_over(scene, trajectory):
        return None
    times = integrator.stage_times if trajectory.u_stages.shape[1] else ()
    narrow, wide = _stretches(times, integrator.order <= _SHORT_STEPS)
    propagate = functools.partial(
        propagated_errors,
        scene.core,
        trajectory.q,
        trajectory.v,
        trajectory.u,
        trajectory.u_stages,
        trajectory.dt,
        narrow=narrow,
        wide=wide,
        most_q=_TRAVEL * travel_scales(scene, trajectory.q)[-1],
        most_v=_SPEED * speed_scales(scene, trajectory.v),
    )
    damped = bool(scene.elements)
    largest = float(propagate(damped=damped).max(initial=0.0))
    if damped and not math.isfinite(largest):
        rate = fastest_rate(scene, trajectory.q, trajectory.v, trajectory.u, _RATE / trajectory.dt)
        largest = largest if rate else float(propagate(damped=False).max(initial=0.0))
    return _SURE * largest if math.isfinite(largest) else None


def _turns_over(scene: Scene, trajectory: Trajectory) -> bool:
    """Whether the dry friction of a joint changes by much in a step."""
    own = of_kind(scene.elements, "CoulombFriction")
    turns = (np.diff(np.tanh(trajectory.v[:, each.coordinate] / each.values[1])) for each in own)
    return any(np.abs(change).max() > _TURNS for change in turns)


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
