"""The exact motion of a scene, and the distance of an integrator's motion from it.

The exact motion is LSODA's at 1e-11: it takes stiff dampers, and shares nothing with the integrator. From which error
on a motion is wrong is in :data:`LEVELS` of :mod:`varpin.study.extremes`, in units of the motion itself.
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
from varpin.integrators import ExplicitEuler, Integrator
from varpin.mechanics.forces import limited_servos
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.scene import Scene
from varpin.simulation.spectrum import largest_of_its_kind, masses
from varpin.trajectory import Trajectory

_TOLERANCE = 1e-11
# Speeds below this count as it [rad/s or m/s].
_SLOWEST = 1e-3
# Ways shorter than this count as it [rad or m].
SHORTEST = 1e-6
# Processor time for the motion of a window, which other programs do not change [s].
PATIENCE = 3.0
# Growth of a disturbance from which on a motion counts as unpredictable; and the disturbance, relative to q and v.
_PREDICTABLE, DISTURBANCE = 10.0, 1e-7
# For a joint that hardly moves, the unit of errors is at least the smaller of two: this share of the largest travel or
# speed among joints of its kind, and of the speed at which the joint would have their energy.
_LITTLE, _LIGHT = 1e-2, 1e-2
# Least change of a speed, as a share of it, for joints at constant speed.
_EVEN = 1e-3
# Nodes of a window, and those at its start, where what is stiff dies out.
NODES, START = 32, 4


class EndsHereError(ArithmeticError):
    """The exact motion goes no further, or takes too long."""


def integrated(
    dynamics: ForwardDynamics,
    force: Floats,
    x: Floats,
    dt: float,
    steps: int,
    end: float,
    beside: tuple[Scene, Floats] | None = None,
) -> Floats:
    """(q, v) after each of some steps (K, 2n) under one force, and one ``beside`` it that drives do not limit."""

    def rate(_: float, x: Floats) -> Floats:
        slope, regular = dynamics.rate(x, force)
        if beside is not None:
            slope[len(force) :] += np.linalg.solve(masses(beside[0], x[None, : len(force)])[0], beside[1])
        if not (regular and np.isfinite(slope).all()) or time.process_time() > end:
            raise EndsHereError
        return slope

    n = len(force)
    speed = max(float(np.abs(x[n:]).max() + dt * np.abs(rate(0.0, x)[n:]).max()), _SLOWEST)
    atol = _TOLERANCE * np.append(np.ones(n), np.full(n, speed))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.integrate.ODEintWarning)
        states, report = scipy.integrate.odeint(
            rate, x, dt * np.arange(steps + 1), rtol=_TOLERANCE, atol=atol, tfirst=True, mxstep=10**6, full_output=True
        )
    if report["message"] != "Integration successful.":
        raise EndsHereError
    return np.asarray(states[1:])


@dataclass(frozen=True, eq=False)
class Exact:
    """The exact motion at some nodes of a window.

    Attributes:
        nodes: Their indices (K,).
        q: (K, n) [rad or m].
        v: (K, n) [rad/s or m/s].
        travel: Largest distance from the start [rad or m].
        travels: The same for each joint (n,) [rad or m].
        speeds: Largest velocity of each joint (n,) [rad/s or m/s].
        cut: Whether it is known over a part of the window only.
    """

    nodes: NDArray[np.int64]
    q: Floats
    v: Floats
    travel: float
    travels: Floats
    speeds: Floats
    cut: bool = False

    def errors(self, trajectory: Trajectory) -> dict[str, float]:
        """Largest distances of a motion, NaN if it ends before the first node.

        ``error`` in q, in units of the travel; ``joint`` in q and ``velocity`` in v, each joint in units of its own
        travel and velocity, so that a far or fast joint does not hide the others.
        """
        nodes = self.nodes[self.nodes <= trajectory.steps]
        if not len(nodes):
            return {}
        q, v = (np.abs(a[nodes] - b[: len(nodes)]) for a, b in ((trajectory.q, self.q), (trajectory.v, self.v)))
        return {
            "error": float(q.max() / self.travel),
            "joint": float((q / self.travels).max()),
            "velocity": float((v / self.speeds).max()),
        }


def kicked(scene: Scene, x: Floats, u: Floats, dw: Floats, origin: Floats) -> Floats:
    """A state (2n,) after the kick of a step's increments (k,); diffusion fields are relative to ``origin`` (n,)."""
    q, v = np.split(x, 2)
    return np.append(q, v + np.linalg.solve(masses(scene, q[None])[0], impulse(scene, x, u, dw, origin)))


def impulse(scene: Scene, x: Floats, u: Floats, dw: Floats, origin: Floats) -> Floats:
    """The impulse (n,) of a step's increments (k,) at a state (2n,), as for :func:`kicked`."""
    q, v = np.split(x, 2)
    force: Floats = scene.noise.fields(q[None], v[None], u[None], origin).F[0] @ dw
    return force


def exact_motion(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, window: float, ahead: Floats | float = 0.0
) -> Exact | None:
    """The exact motion from a trajectory's start over a window [s], as far as a small disturbance does not grow.

    Where q is ``ahead`` by whole turns it is computed without them. A kick comes before its step, or after the step of
    the explicit Euler method, which does not know of it; an integrator that holds the noise has the impulse as a
    constant force. None where it cannot be integrated over a single step.
    """
    dt, steps = trajectory.dt, min(trajectory.steps, max(1, round(window / trajectory.dt)))
    if not trajectory.steps:
        return None
    u, dw, q0, v0 = trajectory.u[:steps], trajectory.dw[:steps], trajectory.q[0] - ahead, trajectory.v[0]
    # The first of the steps that each control is held for.
    noisy, late, held = bool(dw.any()), isinstance(integrator, ExplicitEuler), integrator.holds_noise
    first = np.flatnonzero(np.append(True, (u[1:] != u[:-1]).any(axis=1) | noisy))
    if len(first) > 1:
        steps = min(steps, 2 * NODES)
    first, end = first[first < steps], time.process_time() + PATIENCE
    dynamics, paths = ForwardDynamics(scene.core), []
    for by in (0.0, DISTURBANCE):
        states = np.append(q0 + by, v0)[None]
        for begin, after in zip(first, np.append(first[1:], steps), strict=True):
            x, force, given = states[-1], scene.actuation @ u[begin], (u[begin], dw[begin], trajectory.q[0])
            beside = None
            if noisy and held and limited_servos(scene.elements):
                beside = scene, impulse(scene, x, *given) / dt
            elif noisy and held:
                force = force + impulse(scene, x, *given) / dt
            elif noisy and not late:
                x = kicked(scene, x, *given)
            try:
                more = integrated(dynamics, force, x, dt, int(after - begin), end, beside)
            except EndsHereError:
                break
            if noisy and late:
                more[-1] = kicked(scene, more[-1], *given)
            states = np.concatenate([states, more])
        paths.append(states)
    known = min(map(len, paths))
    if known < 2:
        return None
    plain, disturbed = (states[:known] for states in paths)
    known = grown(plain[:, : len(q0)], disturbed[:, : len(q0)], DISTURBANCE)
    stride = 1 if len(first) > 1 else max(1, steps // NODES)
    nodes = np.union1d(np.arange(1, min(steps, START) + 1), np.arange(stride, steps + 1, stride))
    # At the last of the known steps the disturbance has grown already, if they are not all.
    count = int((nodes <= (known if known >= nodes[-1] else max(1, known - 1))).sum())
    q, v = np.split(plain[nodes[:count]], 2, axis=1)
    return in_units(scene, trajectory.q[0], v0, dt, nodes[:count], q + ahead, v, cut=count < len(nodes))


def in_units(
    scene: Scene, q0: Floats, v0: Floats, dt: float, nodes: NDArray[np.int64], q: Floats, v: Floats, *, cut: bool
) -> Exact:
    """An exact motion with travels and speeds: each joint's own, or a small share of the others'."""
    velocities = np.vstack([v0, v])
    travels, speeds = np.abs(q - q0).max(axis=0), np.abs(velocities).max(axis=0)
    root = np.sqrt(np.diag(lagrangian_jet(scene, q0, np.zeros_like(q0), backend="pinocchio").Lvv))
    # The speed at which a joint has the energy of the largest change.
    light = _LIGHT * (root * velocity_change(velocities)).max() / root
    least = np.minimum(_LITTLE * largest_of_its_kind(scene, speeds), light)
    least_travel = np.minimum(_LITTLE * largest_of_its_kind(scene, travels), light * float(nodes[-1]) * dt)
    travel = max(float(travels.max()), SHORTEST)
    travels, speeds = np.maximum(travels, least_travel), np.maximum(speeds, least)
    return Exact(nodes, q, v, travel, np.maximum(travels, SHORTEST), np.maximum(speeds, SHORTEST), cut)


def grown(plain: Floats, disturbed: Floats, disturbance: float) -> int:
    """Steps, one at least, until the distance of two motions' q (K + 1, n) is a multiple of the disturbance."""
    with np.errstate(over="ignore", invalid="ignore"):
        apart = ~(np.abs(disturbed - plain).max(axis=1) <= _PREDICTABLE * disturbance)
    return max(1, int(apart.argmax())) if apart.any() else len(plain) - 1


def velocity_change(v: Floats) -> Floats:
    """The change of velocities over the nodes (K, ...): the range they cover, at most the largest speed."""
    fastest = np.abs(v).max(axis=0)
    change: Floats = np.clip(np.ptp(v, axis=0), _EVEN * fastest, fastest)
    return change
