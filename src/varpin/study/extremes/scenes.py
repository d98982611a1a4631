"""The scenes: chains of rods at every extreme, and what of it makes sense for any robot."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.noise import AdditiveNoise
from varpin.mechanics.scene import EARTH, Scene
from varpin.mechanics.wiener import wiener_increments
from varpin.model import Robot, load_robot
from varpin.model.chain import rod_chain
from varpin.study.extremes.plans import Plan, plans_on
from varpin.study.extremes.trial import Setup, Trial

Floats = NDArray[np.float64]

_UP = -0.5 * math.pi  # of a rod whose angle is 0 along x and turns down
_TURN = 2.0 * math.pi
# Steps from rest that make a motion of which half a step is little.
_FIRST = 40
# Squared rate of a hanging rod of 1 m [1/s^2].
_HANGING = 1.5 * 9.81


def _chain(
    links: int,
    q: ArrayLike = 0.0,
    v: ArrayLike = 0.0,
    *,
    masses: Sequence[float] | None = None,
    lengths: Sequence[float] | None = None,
    armature: float = 0.0,
    controls: Floats | None = None,
    **scene: Any,
) -> Callable[[], Setup]:
    """A chain, at rest along x if nothing else is said."""

    def build() -> Setup:
        robot = rod_chain(lengths or [1.0] * links, masses or [1.0] * links, armature=armature)
        q0, v0 = (np.broadcast_to(np.asarray(x, dtype=np.float64), (links,)).copy() for x in (q, v))
        return Setup(Scene(robot, **scene), q0, v0, controls=controls)

    return build


def _noisy(strength: float, dt: float, steps: int) -> Callable[[], Setup]:
    def build() -> Setup:
        scene = Scene(rod_chain([1.0] * 2, [1.0] * 2), noise=AdditiveNoise(strength))
        return Setup(scene, np.zeros(2), np.zeros(2), increments=wiener_increments(2, dt, steps, 0))

    return build


def _oscillator(stiffness: float, damping: float, q: float, v: float) -> Callable[[], Setup]:
    """One rod on a spring and a damper, without gravity: a linear oscillator, known in closed form."""
    inertia = 1.0 / 3.0
    half, square = 0.5 * damping / inertia, stiffness / inertia
    root = np.sqrt(complex(half * half - square))
    # The slow exponent from the fast one: their difference would cancel.
    fast = -half - root
    slow = square / fast if fast else 0.0 * root

    def exact(t: float) -> Floats:
        if abs(fast - slow) <= 1e-12 * abs(fast):
            return np.array([((q * (1.0 - fast * t) + v * t) * np.exp(fast * t)).real])
        b = (v - slow * q) / (fast - slow)
        return np.array([((q - b) * np.exp(slow * t) + b * np.exp(fast * t)).real])

    def rate(t: float) -> Floats:
        if abs(fast - slow) <= 1e-12 * abs(fast):
            return np.array([((v + fast * (v - fast * q) * t) * np.exp(fast * t)).real])
        b = (v - slow * q) / (fast - slow)
        return np.array([(slow * (q - b) * np.exp(slow * t) + fast * b * np.exp(fast * t)).real])

    def build() -> Setup:
        scene = Scene(rod_chain([1.0], [1.0]), gravity=False, stiffness=stiffness, damping=damping)
        return Setup(scene, np.array([q]), np.array([v]), exact=exact, rate=rate)

    return build


def _pushed(torque: float) -> Callable[[], Setup]:
    """One rod under a constant torque, without gravity."""

    def build() -> Setup:
        return Setup(
            Scene(rod_chain([1.0], [1.0]), gravity=False),
            np.zeros(1),
            np.zeros(1),
            controls=np.array([torque]),
            exact=lambda t: np.array([1.5 * torque * t * t]),
            rate=lambda t: np.array([3.0 * torque * t]),
        )

    return build


def _turned(q: Sequence[float], v: Sequence[float], turns: Sequence[float]) -> Callable[[], Setup]:
    """A chain whose joints have turned often before."""

    def build() -> Setup:
        scene = Scene(rod_chain([1.0] * len(q), [1.0] * len(q)))
        ahead = _TURN * np.array(turns)
        start = np.array(q) + ahead
        return Setup(scene, start, np.array(v), twin=scene, shift=ahead)

    return build


def _spinning(rate: float) -> Callable[[], Setup]:
    """Three rods stretched out, turning as one."""

    def build() -> Setup:
        return Setup(
            Scene(rod_chain([1.0] * 3, [1.0] * 3), gravity=False),
            np.zeros(3),
            np.array([rate, 0.0, 0.0]),
            exact=lambda t: np.array([rate * t, 0.0, 0.0]),
            rate=lambda _: np.array([rate, 0.0, 0.0]),
        )

    return build


def _away(offset: float) -> Callable[[], Setup]:
    """A chain whose base is far from the origin."""

    def build() -> Setup:
        scene, twin = (Scene(rod_chain([1.0] * 3, [1.0] * 3, base=base)) for base in ([offset] * 3, (0.0, 0.0, 0.0)))
        return Setup(scene, np.zeros(3), np.zeros(3), twin=twin)

    return build


def _on_rail(place: float) -> Callable[[], Setup]:
    """Two rods that hang from a carriage, far along its rail."""

    def build() -> Setup:
        scene = Scene(rod_chain([1.0] * 2, [1.0] * 2, rail=1.0))
        shift = np.array([place, 0.0, 0.0])
        return Setup(scene, shift + np.array([0.0, 0.3, 0.2]), np.zeros(3), twin=scene, shift=shift)

    return build


def _stiff_finger(h_omega: float, dt: float) -> Callable[[], Setup]:
    """The finger, with springs whose fastest mode turns ``h_omega`` [rad] a step."""

    def build() -> Setup:
        robot = load_robot("finger")
        M = lagrangian_jet(Scene(robot), np.zeros(3), np.zeros(3)).Lvv
        stiffness = (h_omega / dt) ** 2 * float(np.linalg.eigvalsh(M).min())
        return Setup(Scene(robot, gravity=False, stiffness=stiffness), np.array([0.3, 0.5, 0.4]), np.zeros(3))

    return build


def _flipping(torque: float, steps: int, links: int) -> Floats:
    """A torque on every joint that changes its sign at every step (N, n)."""
    signs = np.where(np.arange(steps) % 2 == 0, torque, -torque)
    return np.repeat(signs[:, None], links, axis=1)


def _graded(ratio: float, links: int) -> list[float]:
    """Masses from 1 kg at the base to ``ratio`` kg at the tip."""
    return list(np.geomspace(1.0, ratio, links))


def _trials() -> Iterator[Trial]:
    for dt, steps in ((1e-6, 2000), (1e-4, 2000), (1e-3, 2000), (0.01, 1000), (0.05, 400), (0.1, 200), (0.2, 100)):
        yield Trial(f"3 links, dt = {dt:g} s", "time step", _chain(3), dt, steps)
    yield Trial("3 links, dt = 0.5 s", "time step", _chain(3), 0.5, 100)
    for links in (2, 3, 5):
        for dt in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5):
            name = f"{links} links, dt = {dt:g} s, 1e5 steps"
            yield Trial(name, "time step", _chain(links), dt, 100_000, deep=True)

    pendulum = _chain(1, -_UP + 0.5)
    yield Trial("pendulum, 1e5 steps of 1 ms", "horizon", pendulum, 1e-3, 100_000)
    yield Trial("pendulum, 1e5 steps of 50 ms", "horizon", pendulum, 0.05, 100_000)
    yield Trial("pendulum, 1e7 steps of 1 ms", "horizon", pendulum, 1e-3, 10_000_000, deep=True)

    for rate, dt in ((10.0, 1e-3), (100.0, 1e-3), (1e3, 1e-3), (1e3, 1e-5)):
        whirl = _chain(2, [0.0, 1.0], [rate, -0.5 * rate], gravity=False)
        yield Trial(f"{rate:g} rad/s, dt = {dt:g} s", "joint rate", whirl, dt, 1000, window=_TURN / rate)

    for links, steps in ((3, 1000), (20, 200)):
        for ratio in (1e-6, 1e-3, 1e3, 1e6):
            name = f"{links} links, tip {ratio:g} of base"
            yield Trial(name, "mass ratio", _chain(links, 0.1, masses=_graded(ratio, links)), 1e-3, steps, window=0.2)

    for inertia in (1e-12, 1e-6, 1e6):
        build = _chain(1, masses=[3.0 * inertia])
        yield Trial(f"rod of {inertia:g} kg m^2", "inertia", build, 1e-2, 500)
        build = _chain(3, 0.2, masses=[3.0 * inertia] * 3)
        yield Trial(f"3 rods of {inertia:g} kg m^2", "inertia", build, 1e-3, 1000)
    small = _chain(3, 0.2, masses=[3e-6] * 3, lengths=[1e-3] * 3)
    yield Trial("3 rods of 1 mm and 3 mg", "inertia", small, 1e-4, 1000, window=0.03)

    for tip in (1e-6, 1e-9, 1e-15, 1e-300, 0.0):
        yield Trial(f"tip of {tip:g} kg", "mass matrix", _chain(3, 0.2, masses=[1.0, 1.0, tip]), 1e-3, 500, window=0.2)
    for between in (1e-3, 1e-8, 1e-15, 0.0):
        # Two joints on one axis with next to nothing in between: their difference moves next to nothing.
        build = _chain(2, 0.2, lengths=[0.0, 1.0], masses=[1.0, 1.0], armature=between)
        yield Trial(f"coaxial joints, armature {between:g}", "mass matrix", build, 1e-3, 500, window=0.2)

    for turned in (1e-3, 0.1, 0.5, 1.0, 2.4, 10.0, 1e4):
        dt, omega = 1e-2, turned / 1e-2
        spring = _oscillator(omega * omega / 3.0, 0.0, 0.5, 0.0)
        yield Trial(f"spring, h omega = {turned:g}", "stiffness", spring, dt, 1000, window=max(_TURN / omega, 4 * dt))
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

    for turns in (1e3, 1e6):
        build = _turned([0.3, 0.2, 0.1], [1.0, 0.0, 0.0], [turns, -turns, turns])
        yield Trial(f"3 links after {turns:g} turns", "turns", build, 1e-3, 2000)
    yield Trial("spinning chain, 1 rad a step", "turns", _spinning(1e3), 1e-3, 10_000, window=10.0)
    yield Trial("spinning chain, 1e6 turns", "turns", _spinning(1e3), 1e-3, 6_283_186, window=10.0, deep=True)

    for offset in (1e2, 1e4, 1e6):
        yield Trial(f"base {offset:g} m away", "distance", _away(offset), 1e-2, 500)
        yield Trial(f"carriage at {offset:g} m", "distance", _on_rail(offset), 1e-3, 1000)

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
        build = _chain(3, 0.1, controls=_flipping(torque, 200, 3))
        yield Trial(f"+-{torque:g} N m, every {dt:g} s", "torque", build, dt, 200)
    yield Trial("1e6 N m on one rod", "torque", _pushed(1e6), 1e-3, 1000)
    shove = _chain(3, 0.1, controls=np.array([1e6, 0.0, 0.0]))
    yield Trial("1e6 N m on 3 links", "torque", shove, 1e-4, 200, window=0.002)

    for strength in (1e-12, 1e-3, 1.0, 1e3):
        yield Trial(f"noise of {strength:g} N m s^0.5", "noise", _noisy(strength, 1e-2, 200), 1e-2, 200)

    swing = _chain(2, [_UP, 0.5])
    for dt in (1e-3, 1e-2):
        yield Trial(f"double pendulum, dt = {dt:g} s", "chaos", swing, dt, round(20 / dt), window=5.0)
    yield Trial("double pendulum, 1e6 steps", "chaos", swing, 1e-2, 1_000_000, window=5.0, deep=True)

    yield Trial("upright to the last bit", "separatrix", _chain(1, _UP), 1e-3, 5000, window=5.0)
    nearly = _chain(1, np.nextafter(_UP, 0.0))
    yield Trial("upright but for the last bit", "separatrix", nearly, 1e-2, 2000, window=5.0)
    thrown = _chain(1, -_UP, 2.0 * math.sqrt(_HANGING))
    yield Trial("just enough to stand upright", "separatrix", thrown, 1e-2, 1000, window=1.5)


TRIALS: tuple[Trial, ...] = tuple(_trials())


def trials_on(robot: Robot) -> list[Trial | Plan]:
    """What of the battery makes sense for any robot: scaled by what it weighs and how fast it falls from q = 0.3."""
    n = robot.dof
    start = np.full(n, 0.3)
    bare = Scene(robot, damping=0.0)
    M = lagrangian_jet(bare, start, np.zeros(n)).Lvv
    # The inertia that each joint has to move, and the heaviest of the forces that gravity takes it to.
    inertia = np.diag(M)
    weight = np.maximum(np.abs(lagrangian_jet(bare, start, np.zeros(n)).Lq), 1e-3 * inertia)

    def still(controls: Floats | None = None, v: ArrayLike = 0.0, **scene: Any) -> Callable[[], Setup]:
        def build() -> Setup:
            speed = np.broadcast_to(np.asarray(v, dtype=np.float64), (n,)).copy()
            return Setup(Scene(robot, **{"damping": 0.0} | scene), start.copy(), speed, controls=controls)

        return build

    def turned(turns: float) -> Callable[[], Setup]:
        def build() -> Setup:
            scene = Scene(robot, damping=0.0)
            # A mimic joint that follows turns by a part of it, and no motion is the same then.
            revolute = np.full(n, not robot.ties) & ~robot.slides
            shift = np.where(revolute, _TURN * turns, 0.0)
            return Setup(scene, start + shift, np.zeros(n), twin=scene, shift=shift)

        return build

    def noisy(strength: float, dt: float, steps: int) -> Callable[[], Setup]:
        def build() -> Setup:
            scene = Scene(robot, damping=0.0, noise=AdditiveNoise(strength * weight))
            return Setup(scene, start.copy(), np.zeros(n), increments=wiener_increments(n, dt, steps, 0))

        return build

    # What starts to slide down is behind by half a step with any method of first order: much of its first steps, little
    # of its motion.
    trials = [
        Trial(f"falls, dt = {dt:g} s", "time step", still(), dt, steps, window=max(0.3, _FIRST * dt))
        for dt, steps in ((1e-6, 500), (1e-4, 1000), (1e-3, 1000), (0.01, 500), (0.1, 100), (0.5, 40))
    ]
    for rate in (10.0, 1e3):
        whirl = still(v=rate, gravity=False)
        window = max(1.0 / rate, _FIRST * 1e-3)
        trials.append(Trial(f"{rate:g} rad/s", "joint rate", whirl, 1e-3, 500, window=window))
    trials += [Trial("after 1e6 turns", "turns", turned(1e6), 1e-3, 500, window=0.3)]
    trials += [
        Trial("no gravity", "gravity", still(v=1.0, gravity=False), 1e-2, 500, window=0.5),
        Trial("gravity 1e4 m/s^2", "gravity", still(gravity=1e3 * np.array(EARTH)), 1e-3, 500, window=_FIRST * 1e-3),
    ]
    for turned_by in (0.1, 2.4, 50.0):
        stiff = still(stiffness=(turned_by / 1e-3) ** 2 * inertia)
        trials.append(Trial(f"springs, h omega = {turned_by:g}", "stiffness", stiff, 1e-3, 500, window=0.01))
    for lost in (0.1, 10.0, 1e4):
        brakes = still(v=1.0, damping=lost / 1e-3 * inertia)
        trials.append(Trial(f"dampers, h d / I = {lost:g}", "damping", brakes, 1e-3, 500, window=0.05))
    for share in (10.0, 1e6):
        flips = still(controls=np.where(np.arange(200) % 2 == 0, share, -share)[:, None] * weight)
        trials.append(Trial(f"+-{share:g} times its weight", "torque", flips, 1e-3, 200))
    for strength in (1e-12, 1.0):
        trials.append(Trial(f"noise of {strength:g} times its weight", "noise", noisy(strength, 1e-3, 100), 1e-3, 100))
    return [*trials, *plans_on(robot)]
