"""The scenes: chains of rods at every extreme, and those of them that make sense for any robot."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from battery.trial import ClosedForm, Setup, Trial
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.noise import AdditiveNoise
from varpin.mechanics.scene import Scene
from varpin.mechanics.wiener import wiener_increments
from varpin.model import Robot, load_robot
from varpin.model.chain import rod_chain
from varpin.study.extremes import Motion, flipping, motions_of

Floats = NDArray[np.float64]

_TURN = 2.0 * math.pi
# Squared rate of a hanging rod of 1 m [1/s^2].
_HANGING = 1.5 * 9.81

UP = -0.5 * math.pi


def _setup(
    robot: Robot,
    q: ArrayLike = 0.0,
    v: ArrayLike = 0.0,
    *,
    controls: Floats | None = None,
    increments: Floats | None = None,
    exact: ClosedForm | None = None,
    ahead: ArrayLike = 0.0,
    twin: Robot | None = None,
    **scene: Any,
) -> Setup:
    """A robot in a scene; ``ahead`` of itself as its own twin, or with another robot for a twin."""
    own, shift = Scene(robot, **scene), np.asarray(ahead, dtype=np.float64)
    other = own if shift.any() else None if twin is None else Scene(twin, **scene)
    q0, v0 = (np.broadcast_to(np.asarray(x, dtype=np.float64), (robot.dof,)).copy() for x in (q, v))
    return Setup(own, q0 + shift, v0, controls, increments, exact, other, shift)


def _chain(
    links: int,
    q: ArrayLike = 0.0,
    v: ArrayLike = 0.0,
    *,
    masses: Sequence[float] | None = None,
    lengths: Sequence[float] | None = None,
    armature: float = 0.0,
    rail: float | None = None,
    base: float = 0.0,
    **rest: Any,
) -> Callable[[], Setup]:
    """A chain of rods of 1 m and 1 kg; at rest along x, and its base at the origin, if nothing else is said."""

    def robot(place: float) -> Robot:
        sizes, weights = lengths or [1.0] * links, masses or [1.0] * links
        return rod_chain(sizes, weights, armature=armature, rail=rail, base=[place] * 3)

    return lambda: _setup(robot(base), q, v, twin=robot(0.0) if base else None, **rest)


def _oscillator(stiffness: float, damping: float, q: float, v: float) -> Callable[[], Setup]:
    """One rod on a spring and a damper, without gravity: a linear oscillator, known in closed form."""
    inertia = 1.0 / 3.0
    half, square = 0.5 * damping / inertia, stiffness / inertia
    root = np.sqrt(complex(half * half - square))
    # The slow exponent from the fast one: their difference would cancel.
    fast = -half - root
    slow = square / fast if fast else 0.0 * root

    def exact(t: float) -> tuple[Floats, Floats]:
        if abs(fast - slow) <= 1e-12 * abs(fast):
            drift = v - fast * q
            at, rate = q + drift * t, v + fast * drift * t
            return np.array([(at * np.exp(fast * t)).real]), np.array([(rate * np.exp(fast * t)).real])
        b = (v - slow * q) / (fast - slow)
        parts = (q - b) * np.exp(slow * t), b * np.exp(fast * t)
        return np.array([(parts[0] + parts[1]).real]), np.array([(slow * parts[0] + fast * parts[1]).real])

    return _chain(1, q, v, gravity=False, stiffness=stiffness, damping=damping, exact=exact)


def _stiff_finger(h_omega: float, dt: float) -> Callable[[], Setup]:
    """The finger, with springs whose fastest mode turns ``h_omega`` [rad] a step."""

    def build() -> Setup:
        robot = load_robot("finger")
        M = lagrangian_jet(Scene(robot), np.zeros(3), np.zeros(3)).Lvv
        stiffness = (h_omega / dt) ** 2 * float(np.linalg.eigvalsh(M).min())
        return _setup(robot, [0.3, 0.5, 0.4], gravity=False, stiffness=stiffness)

    return build


def _times() -> Iterator[Trial]:
    counts = {1e-6: 2000, 1e-4: 2000, 1e-3: 2000, 0.01: 1000, 0.05: 400, 0.1: 200, 0.2: 100, 0.5: 100}
    for dt, steps in counts.items():
        yield Trial(f"3 links, dt = {dt:g} s", "time step", _chain(3), dt, steps)
    for links in (2, 3, 5):
        for dt in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5):
            name = f"{links} links, dt = {dt:g} s, 1e5 steps"
            yield Trial(name, "time step", _chain(links), dt, 100_000, deep=True)
    pendulum = _chain(1, 0.5 - UP)
    yield Trial("pendulum, 1e5 steps of 1 ms", "horizon", pendulum, 1e-3, 100_000)
    yield Trial("pendulum, 1e5 steps of 50 ms", "horizon", pendulum, 0.05, 100_000)
    yield Trial("pendulum, 1e7 steps of 1 ms", "horizon", pendulum, 1e-3, 10_000_000, deep=True)
    for rate, dt in ((10.0, 1e-3), (100.0, 1e-3), (1e3, 1e-3), (1e3, 1e-5)):
        whirl = _chain(2, [0.0, 1.0], [rate, -0.5 * rate], gravity=False)
        yield Trial(f"{rate:g} rad/s, dt = {dt:g} s", "joint rate", whirl, dt, 1000, window=_TURN / rate)


def _bodies() -> Iterator[Trial]:
    for links, steps in ((3, 1000), (20, 200)):
        for ratio in (1e-6, 1e-3, 1e3, 1e6):
            graded = _chain(links, 0.1, masses=list(np.geomspace(1.0, ratio, links)))
            yield Trial(f"{links} links, tip {ratio:g} of base", "mass ratio", graded, 1e-3, steps, window=0.2)
    for inertia in (1e-12, 1e-6, 1e6):
        yield Trial(f"rod of {inertia:g} kg m^2", "inertia", _chain(1, masses=[3.0 * inertia]), 1e-2, 500)
        three = _chain(3, 0.2, masses=[3.0 * inertia] * 3)
        yield Trial(f"3 rods of {inertia:g} kg m^2", "inertia", three, 1e-3, 1000)
    small = _chain(3, 0.2, masses=[3e-6] * 3, lengths=[1e-3] * 3)
    yield Trial("3 rods of 1 mm and 3 mg", "inertia", small, 1e-4, 1000, window=0.03)
    for tip in (1e-6, 1e-9, 1e-15, 1e-300, 0.0):
        yield Trial(f"tip of {tip:g} kg", "mass matrix", _chain(3, 0.2, masses=[1.0, 1.0, tip]), 1e-3, 500, window=0.2)
    for between in (1e-3, 1e-8, 1e-15, 0.0):
        # Two joints on one axis with next to nothing in between: their difference moves next to nothing.
        coaxial = _chain(2, 0.2, lengths=[0.0, 1.0], masses=[1.0, 1.0], armature=between)
        yield Trial(f"coaxial joints, armature {between:g}", "mass matrix", coaxial, 1e-3, 500, window=0.2)


def _springs_and_dampers() -> Iterator[Trial]:
    for turned in (1e-3, 0.1, 0.5, 1.0, 2.4, 10.0, 1e4):
        omega = turned / 1e-2
        spring = _oscillator(omega * omega / 3.0, 0.0, 0.5, 0.0)
        yield Trial(f"spring, h omega = {turned:g}", "stiffness", spring, 1e-2, 1000, window=max(_TURN / omega, 0.04))
    for turned in (0.1, 1.0, 10.0):
        build = _chain(3, 0.1, stiffness=(turned / 1e-2) ** 2 / 3.0)
        yield Trial(f"3 links on springs, h omega = {turned:g}", "stiffness", build, 1e-2, 500, window=0.2)
    for turned in (0.1, 2.4, 50.0):
        build = _stiff_finger(turned, 1e-3)
        yield Trial(f"finger on springs, h omega = {turned:g}", "stiffness", build, 1e-3, 500, window=0.02)
    for lost in (1e-3, 0.1, 1.0, 2.5, 10.0, 1e4):
        rate = lost / 1e-2
        brake = _oscillator(0.0, rate / 3.0, 0.0, rate)
        yield Trial(f"damper, h d / I = {lost:g}", "damping", brake, 1e-2, 500, window=max(3.0 / rate, 0.04))
        # The same damper on a spring of h omega = 0.1.
        creep = _oscillator(100.0 / 3.0, rate / 3.0, 0.5, 0.0)
        yield Trial(f"spring and damper, h d / I = {lost:g}", "damping", creep, 1e-2, 500)
    yield Trial("3 links in treacle, h d / I = 300", "damping", _chain(3, 0.1, damping=1e4), 1e-2, 500)


def _distances() -> Iterator[Trial]:
    for turns in (1e3, 1e6):
        turned = _chain(3, [0.3, 0.2, 0.1], [1.0, 0.0, 0.0], ahead=_TURN * np.array([turns, -turns, turns]))
        yield Trial(f"3 links after {turns:g} turns", "turns", turned, 1e-3, 2000)
    rates = np.array([1e3, 0.0, 0.0])
    spinning = _chain(3, 0.0, rates, gravity=False, exact=lambda t: (t * rates, rates))
    yield Trial("spinning chain, 1 rad a step", "turns", spinning, 1e-3, 10_000, window=10.0)
    yield Trial("spinning chain, 1e6 turns", "turns", spinning, 1e-3, 6_283_186, window=10.0, deep=True)
    for offset in (1e2, 1e4, 1e6):
        yield Trial(f"base {offset:g} m away", "distance", _chain(3, base=offset), 1e-2, 500)
        # Two rods that hang from a carriage, far along its rail.
        carriage = _chain(2, [0.0, 0.3, 0.2], rail=1.0, ahead=[offset, 0.0, 0.0])
        yield Trial(f"carriage at {offset:g} m", "distance", carriage, 1e-3, 1000)


def _loads() -> Iterator[Trial]:
    drift = _chain(3, [0.0, 0.5, 0.3], [1.0, 0.0, -1.0], gravity=False)
    yield Trial("no gravity", "gravity", drift, 1e-2, 1000)
    for dt in (1e-4, 1e-3, 1e-2):
        heavy = _chain(3, 0.1, gravity=[0.0, 0.0, -1e4])
        yield Trial(f"gravity 1e4 m/s^2, dt = {dt:g} s", "gravity", heavy, dt, 1000, window=0.03)
    for links, steps in ((1, 1000), (2, 1000), (4, 1000), (16, 200), (64, 20)):
        yield Trial(f"{links} links", "links", _chain(links), 1e-2, steps, window=0.5)
    yield Trial("256 links", "links", _chain(256), 1e-3, 3, window=0.003, deep=True)
    yield Trial("64 links, 1000 steps", "links", _chain(64), 1e-2, 1000, window=0.5, deep=True)
    yield Trial("256 links, 200 steps", "links", _chain(256), 1e-2, 200, window=0.1, deep=True)
    for torque, dt in ((10.0, 1e-2), (1e3, 1e-2), (1e6, 1e-3)):
        flips = _chain(3, 0.1, controls=flipping(np.full(3, torque)))
        yield Trial(f"+-{torque:g} N m, every {dt:g} s", "torque", flips, dt, 200)
    # Of a rod of 1/3 kg m^2.
    alpha = np.array([3e6])
    push = _chain(1, gravity=False, controls=np.array([1e6]), exact=lambda t: (0.5 * t * t * alpha, t * alpha))
    yield Trial("1e6 N m on one rod", "torque", push, 1e-3, 1000)
    shove = _chain(3, 0.1, controls=np.array([1e6, 0.0, 0.0]))
    yield Trial("1e6 N m on 3 links", "torque", shove, 1e-4, 200, window=0.002)
    increments = wiener_increments(2, 1e-2, 200, 0)
    for strength in (1e-12, 1e-3, 1.0, 1e3):
        noisy = _chain(2, noise=AdditiveNoise(strength), increments=increments)
        yield Trial(f"noise of {strength:g} N m s^0.5", "noise", noisy, 1e-2, 200)


def _sensitive() -> Iterator[Trial]:
    swing = _chain(2, [UP, 0.5])
    for dt in (1e-3, 1e-2):
        yield Trial(f"double pendulum, dt = {dt:g} s", "chaos", swing, dt, round(20 / dt), window=5.0)
    yield Trial("double pendulum, 1e6 steps", "chaos", swing, 1e-2, 1_000_000, window=5.0, deep=True)
    yield Trial("upright to the last bit", "separatrix", _chain(1, UP), 1e-3, 5000, window=5.0)
    nearly = _chain(1, np.nextafter(UP, 0.0))
    yield Trial("upright but for the last bit", "separatrix", nearly, 1e-2, 2000, window=5.0)
    thrown = _chain(1, -UP, 2.0 * math.sqrt(_HANGING))
    yield Trial("just enough to stand upright", "separatrix", thrown, 1e-2, 1000, window=1.5)


TRIALS: tuple[Trial, ...] = (
    *(*_times(), *_bodies(), *_springs_and_dampers(), *_distances(), *_loads(), *_sensitive()),
)


def trials_on(robot: Robot) -> list[Trial]:
    """The motions of ``check_robot``, to be judged all over and with their noise."""

    def trial(m: Motion) -> Trial:
        twin = m.scene if m.ahead.any() else None
        setup = Setup(m.scene, m.q0, m.v0, m.controls, m.increments, twin=twin, shift=m.ahead)
        return Trial(m.name, "robot", lambda: setup, m.dt, m.steps, window=m.window)

    return [*map(trial, motions_of(robot))]
