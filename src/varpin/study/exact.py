"""The exact motion of a scene, and the distance of an integrator's motion from it.

The exact motion is LSODA's at 1e-11: it takes stiff dampers, and shares nothing with the integrator. From which error
on a motion is wrong is in :data:`LEVELS` of :mod:`varpin.study.checks`, in units of the motion itself.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from varpin.arrays import Floats
from varpin.core import ForwardDynamics
from varpin.integrators import Integrator
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.simulation.spectrum import largest_of_its_kind, masses, speed_scales
from varpin.trajectory import Trajectory

_TOLERANCE = 1e-11
# Speeds below this count as it [rad/s or m/s].
_SLOWEST = 1e-3
# Ways shorter than this count as it [rad or m].
SHORTEST = 1e-6
# Processor time for an exact motion, which other programs do not change [s].
PATIENCE = 3.0
# Growth of a disturbance from which on a motion counts as unpredictable; and the disturbance, relative to q.
_PREDICTABLE, DISTURBANCE = 10.0, 1e-7
# For a joint that hardly moves, the unit of travels is at least the smaller of two: this share of the largest among
# joints of its kind, and of the way at the speed at which the joint would have their energy.
_LITTLE, _LIGHT = 1e-2, 1e-2
# Least change of a speed, as a share of it, for joints at constant speed.
_EVEN = 1e-3
# Nodes of a window, and those at its start, where what is stiff dies out.
NODES, START = 32, 4


@dataclass(frozen=True, eq=False)
class Exact:
    """The exact motion at some nodes of a window."""

    nodes: NDArray[np.int64]  # their indices (K,)
    q: Floats  # (K, n) [rad or m]
    v: Floats  # (K, n) [rad/s or m/s]
    travel: float  # largest distance from the start [rad or m]
    travels: Floats  # the same for each joint (n,) [rad or m]
    speeds: Floats  # largest velocity of each joint (n,) [rad/s or m/s]

    def errors(self, trajectory: Trajectory) -> dict[str, float]:
        """Largest distances of a motion, none if it ends before the first node.

        ``error`` in q, in units of the travel; ``joint`` in q and ``velocity`` in v, each joint in units of its own
        travel and velocity, so that a far or fast joint does not hide the others. Errors of velocities are those that
        last.
        """
        nodes = self.nodes[self.nodes <= trajectory.steps]
        if not len(nodes):
            return {}
        q, v = (np.abs(a[nodes] - b[: len(nodes)]) for a, b in ((trajectory.q, self.q), (trajectory.v, self.v)))
        return {
            "error": float(q.max() / self.travel),
            "joint": float((q / self.travels).max()),
            "velocity": float((lasting(v, nodes) / self.speeds).max()),
        }


def lasting(errors: Floats, nodes: NDArray[np.int64]) -> Floats:
    """Errors (K, ...) at nodes (K,), each but the smaller of it and the next where that is a step later.

    What comes a step too late, as after a jump, is no error of the motion.
    """
    after = np.append(errors[1:], errors[-1:], axis=0)
    followed = np.append(np.diff(nodes) == 1, False).reshape(-1, *[1] * (errors.ndim - 1))
    found: Floats = np.where(followed, np.minimum(errors, after), errors)
    return found


def before_step(integrator: Integrator) -> float | None:
    """The part of the noise's kicks that comes before an integrator's steps; None where it is held over them."""
    if integrator.holds_noise:
        return None
    return 0.0 if integrator.kicks_after else integrator.left


def nodes_of(steps: int, stride: int) -> NDArray[np.int64]:
    """The nodes of a window that are compared: every ``stride``-th, and the first ones."""
    return np.union1d(np.arange(1, min(steps, START) + 1), np.arange(stride, steps + 1, stride))


def exact_motion(
    scene: Scene,
    q0: Floats,
    v0: Floats,
    u: Floats,
    dw: Floats,
    *,
    dt: float,
    left: float | None = 1.0,
    ahead: Floats | float = 0.0,
) -> Exact | None:
    """The exact motion over a window, as far as a small disturbance does not grow; None where it has none.

    Its steps of ``dt`` [s] have controls ``u`` (N, m) and increments ``dw`` (N, k), of which ``left`` is as for
    :func:`path`; ``ahead`` (n,) are whole turns in q0, without which it is computed [rad].
    """
    if not len(u):
        return None
    varying = bool(dw.any() or (u != u[:1]).any())
    steps = min(len(u), 2 * NODES) if varying else len(u)
    nodes = nodes_of(steps, 1 if varying else max(1, steps // NODES))
    end, start, u, dw = time.process_time() + PATIENCE, q0 - ahead, u[:steps], dw[:steps]
    plain, disturbed = (
        path(scene, np.append(start + by, v0), u, dw, dt=dt, left=left, origin=q0, end=end) for by in (0.0, DISTURBANCE)
    )
    if not (known := grown(plain, disturbed, DISTURBANCE)):
        return None
    # At the last of the known steps the disturbance has grown already, if they are not all.
    count = int((nodes <= (known if known >= nodes[-1] else max(1, known - 1))).sum())
    q, v = np.split(plain[nodes[:count]], 2, axis=1)
    return in_units(scene, q0, v0, dt, nodes[:count], q + ahead, v)


def path(
    scene: Scene, x: Floats, u: Floats, dw: Floats, *, dt: float, left: float | None, origin: Floats, end: float
) -> Floats:
    """States (K + 1, 2n) of the exact motion from x = (q, v), until a processor time [s].

    Of each step's kick the part ``left`` comes before it and the rest after it; None holds the kick over the step.
    Diffusion fields are relative to ``origin`` (n,).
    """
    dynamics, noisy, states = ForwardDynamics(scene.core), bool(dw.any()), x[None]
    # The first of the steps that each control is held for.
    first = np.flatnonzero(np.append(True, (u[1:] != u[:-1]).any(axis=1) | noisy)).tolist()

    def impulse(x: Floats, step: int) -> Floats:
        q, v = np.split(x[None], 2, axis=1)
        force: Floats = scene.noise.fields(q, v, u[step][None], origin).F[0] @ dw[step]
        return force

    def kicked(x: Floats, step: int, part: float) -> Floats:
        q, v = np.split(x, 2)
        return np.append(q, v + part * np.linalg.solve(masses(scene, q[None])[0], impulse(x, step)))

    for begin, after in zip(first, [*first[1:], len(u)], strict=True):
        x, force = states[-1], scene.actuation @ u[begin]
        if noisy and left is None:
            force = force + impulse(x, begin) / dt
        elif noisy and left:
            x = kicked(x, begin, left)
        more = _integrated(dynamics, force, x, dt, after - begin, end)
        if more is None:
            break
        if noisy and left is not None and left < 1.0:
            more[-1] = kicked(more[-1], begin, 1.0 - left)
        states = np.concatenate([states, more])
    return states


class _EndsHereError(ArithmeticError):
    """The exact motion goes no further, or takes too long."""


def _integrated(
    dynamics: ForwardDynamics, force: Floats, x: Floats, dt: float, steps: int, end: float
) -> Floats | None:
    """(q, v) after each of some steps (K, 2n) under one force; None where it cannot be integrated."""

    def rate(_: float, x: Floats) -> Floats:
        slope, regular = dynamics.rate(x, force)
        if not (regular and np.isfinite(slope).all()) or time.process_time() > end:
            raise _EndsHereError
        return slope

    n, times = len(force), dt * np.arange(steps + 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.integrate.ODEintWarning)
        try:
            speed = max(float(np.abs(x[n:]).max() + dt * np.abs(rate(0.0, x)[n:]).max()), _SLOWEST)
            atol = _TOLERANCE * np.append(np.ones(n), np.full(n, speed))
            states, report = scipy.integrate.odeint(
                rate, x, times, rtol=_TOLERANCE, atol=atol, tfirst=True, mxstep=10**6, full_output=True
            )
        except _EndsHereError:
            return None
    return np.asarray(states[1:]) if report["message"] == "Integration successful." else None


def in_units(scene: Scene, q0: Floats, v0: Floats, dt: float, nodes: NDArray[np.int64], q: Floats, v: Floats) -> Exact:
    """An exact motion with travels, each joint's own or a small share of the others', and the check's speeds."""
    velocities = np.vstack([v0, v])
    travels = np.abs(q - q0).max(axis=0)
    root = np.sqrt(np.diag(lagrangian_jet(scene, q0, np.zeros_like(q0), backend="pinocchio").Lvv))
    # The speed at which a joint has the energy of the largest change.
    light = _LIGHT * (root * velocity_change(velocities)).max() / root
    least_travel = np.minimum(_LITTLE * largest_of_its_kind(scene, travels), light * float(nodes[-1]) * dt)
    travel = max(float(travels.max()), SHORTEST)
    travels = np.maximum(np.maximum(travels, least_travel), SHORTEST)
    return Exact(nodes, q, v, travel, travels, np.maximum(speed_scales(scene, velocities), SHORTEST))


def grown(plain: Floats, disturbed: Floats, disturbance: float) -> int:
    """Steps until the distance of two motions in q, each (K + 1, 2n), is a multiple of the disturbance."""
    known, n = min(len(plain), len(disturbed)), plain.shape[1] // 2
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(disturbed[:known, :n] - plain[:known, :n]).max(axis=1)
        apart = ~(off <= _PREDICTABLE * disturbance)
    return int(apart.argmax()) if apart.any() else known - 1


def velocity_change(v: Floats) -> Floats:
    """The change of velocities over the nodes (K, ...): the range they cover, at most the largest speed."""
    fastest = np.abs(v).max(axis=0)
    change: Floats = np.clip(np.ptp(v, axis=0), _EVEN * fastest, fastest)
    return change
