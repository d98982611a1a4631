"""Extreme scenes, each run with every integrator and judged by independent checks: what docs/limits.md reports.

Chains of rods at every extreme, and those motions of them that make sense for any robot.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from mechanisms import rod_chain
from numpy.typing import ArrayLike

from varpin.arrays import Floats
from varpin.integrators import Integrator
from varpin.mechanics.lagrangian import lagrangian_jet
from varpin.mechanics.noise import AdditiveNoise
from varpin.mechanics.scene import Scene
from varpin.mechanics.wiener import wiener_increments
from varpin.model import Robot, load_robot
from varpin.simulation.spectrum import speed_scales, travel_scales
from varpin.study import checks
from varpin.study.checks import LEVELS
from varpin.study.exact import (
    DISTURBANCE,
    NODES,
    Exact,
    before_step,
    exact_motion,
    grown,
    in_units,
    nodes_of,
    path,
)
from varpin.study.extremes import INTEGRATORS, Cell, Motion, Record, cell, flipping, motions_of
from varpin.study.record import Progress, collect
from varpin.trajectory import Trajectory

# A motion in closed form: q and v, each (n,), at a time [s].
ClosedForm = Callable[[float], tuple[Floats, Floats]]

# A motion gets this long, and the plain battery half a minute at most for one [s].
_PATIENCE, _DEEP_PATIENCE = 20.0, 900.0
# Processor time, which other programs do not change [s]: for all periods, for one of them.
_PATIENCE_PERIODS, _PATIENCE_PERIOD = 4.0, 1.0
# Nodes from which the motion is repeated, and steps from each.
_BEGINS, _STEPS = 8, 64


@dataclass(frozen=True, eq=False)
class Bench(Motion):
    """A motion whose exact motion may be in closed form, and that is compared all over."""

    closed: ClosedForm | None = None
    known: dict[float | None, Exact | None] = field(default_factory=dict)

    def exact(self, left: float | None = 1.0) -> Exact | None:
        """The exact motion over the window.

        ``left`` is that of :func:`varpin.study.exact.path`: to strong order one, which is what is promised of additive
        noise, all are the same motion.
        """
        if left not in self.known:
            self.known[left] = self._exact(left)
        return self.known[left]

    def _exact(self, left: float | None) -> Exact | None:
        steps = min(self.steps, max(1, round(self.window / self.dt)))
        if self.closed is not None:
            nodes = nodes_of(steps, max(1, steps // NODES))
            q, v = (np.array(part) for part in zip(*(self.closed(k * self.dt) for k in nodes), strict=True))
            return in_units(self.scene, self.q0, self.v0, self.dt, nodes, q, v)
        controls = np.zeros(self.scene.controls) if self.controls is None else self.controls
        u = np.broadcast_to(controls, (steps, self.scene.controls)) if controls.ndim == 1 else controls[:steps]
        dw = np.zeros((steps, 0)) if self.increments is None else self.increments[:steps]
        return exact_motion(self.scene, self.q0, self.v0, u, dw, dt=self.dt, left=left, ahead=self.ahead)

    def measures(self, integrator: Integrator, trajectory: Trajectory) -> dict[str, float]:
        """And the error from nodes all over, in units of what is wrong."""
        exact = self.exact(1.0 if self.increments is None else before_step(integrator))
        found = checks.measures(self.scene, integrator, trajectory, exact)
        return found | {"period": period_error(self.scene, integrator, trajectory)}


@dataclass(frozen=True)
class Trial:
    """A motion at an extreme by its unique name; its building may be refused, and the deep ones take long."""

    name: str
    build: Callable[[], Bench]
    deep: bool = False


def period_error(scene: Scene, integrator: Integrator, trajectory: Trajectory) -> float:
    """The largest error from any of some nodes on, in units of what is wrong; NaN where none is known.

    Errors are shares of the scales by which motions are told of, as far as a small disturbance does not grow out of
    hand, and of velocities the smaller of two successive ones, as a small shift in time changes a peak by much.
    """
    if not trajectory.steps or scene.noise.diffusion is None or not np.abs(trajectory.v).max() > 0.0:
        return math.nan
    units = travel_scales(scene, trajectory.q)[-1], speed_scales(scene, trajectory.v)
    worst, end = math.nan, time.process_time() + _PATIENCE_PERIODS
    for step in np.unique(np.linspace(0, max(0, trajectory.steps - _STEPS), _BEGINS).astype(np.int64)).tolist():
        worst = np.fmax(worst, _error_from(scene, integrator, trajectory, step, units))
        if worst >= 1.0 or time.process_time() > end:
            break
    return float(worst)


def _error_from(
    scene: Scene, integrator: Integrator, trajectory: Trajectory, step: int, units: tuple[Floats, Floats]
) -> float:
    """The error from one node on; NaN where the exact motion ends before."""
    n, ahead = scene.robot.dof, slice(step, step + min(_STEPS, trajectory.steps - step))
    u, dw, begin = trajectory.u[ahead], trajectory.dw[ahead], (trajectory.q[step], trajectory.v[step])
    inputs = {"dt": trajectory.dt, "left": before_step(integrator), "origin": trajectory.q[0]}
    inputs["end"] = time.process_time() + _PATIENCE_PERIOD
    by = DISTURBANCE * max(1e-3, float(np.ptp(trajectory.q, axis=0).max()))
    plain, disturbed = (path(scene, np.append(begin[0] + off, begin[1]), u, dw, **inputs) for off in (0.0, by))
    known = grown(plain, disturbed, by)
    if known == min(len(plain), len(disturbed)) - 1 < len(u):
        return math.nan
    nodes, plain = slice(step, step + known + 1), plain[: known + 1]
    with np.errstate(over="ignore", invalid="ignore"):
        q = np.abs(plain[:, :n] - trajectory.q[nodes]) / units[0] / LEVELS["error"]
        v = np.abs(plain[:, n:] - trajectory.v[nodes]) / units[1] / LEVELS["velocity"]
    return float(max(q.max(), np.minimum(v[:-1], v[1:]).max()))


def run(
    trials: Sequence[Trial],
    *,
    name: str = "the battery",
    deep: bool = False,
    integrators: Sequence[Integrator] = INTEGRATORS,
    patience: float | None = None,
    progress: Progress | None = None,
) -> Record:
    """Run trials with every integrator and judge each motion; the deep ones too, which take hours, if asked to.

    A motion may take a processor time, ``patience`` [s], before it is judged by what there is.
    """
    chosen = [trial for trial in trials if deep or not trial.deep]
    limit = patience or (_DEEP_PATIENCE if deep else _PATIENCE)

    def cells() -> Iterator[Cell]:
        for trial in chosen:
            build = cache(trial.build)
            for member in integrators:
                yield cell(trial.name, build, member, limit)

    return collect(Record((), name), cells(), len(chosen) * len(integrators), progress)


# --- scenes ----------------------------------------------------------------------------------------------------------

_TURN = 2.0 * math.pi
# Squared rate of a hanging rod of 1 m [1/s^2].
_HANGING = 1.5 * 9.81

UP = -0.5 * math.pi

Build = Callable[[str, float, int, float], Bench]


def bench(
    robot: Callable[[], Robot],
    q: ArrayLike = 0.0,
    v: ArrayLike = 0.0,
    *,
    controls: Floats | None = None,
    increments: Floats | None = None,
    closed: ClosedForm | None = None,
    ahead: ArrayLike = 0.0,
    **scene: Any,
) -> Build:
    """A motion of a robot in a scene, of a name, a step, a number of steps and a window."""

    def build(name: str, dt: float, steps: int, window: float) -> Bench:
        own = Scene(robot(), **scene)
        q0, v0 = (np.broadcast_to(np.asarray(x, dtype=np.float64), (own.robot.dof,)).copy() for x in (q, v))
        return Bench(name, dt, steps, own, q0 + ahead, v0, controls, increments, np.asarray(ahead), window, closed)

    return build


def trial(name: str, build: Build, dt: float, steps: int, window: float = 1.0, *, deep: bool = False) -> Trial:
    """A trial of some steps, which are compared over a window [s]: some periods of what moves."""
    return Trial(name, lambda: build(name, dt, steps, window), deep)


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
) -> Build:
    """A chain of rods of 1 m and 1 kg; at rest along x, and its base at the origin, if nothing else is said."""
    sizes, weights = lengths or [1.0] * links, masses or [1.0] * links
    return bench(lambda: rod_chain(sizes, weights, armature=armature, rail=rail, base=[base] * 3), q, v, **rest)


def _oscillator(stiffness: float, damping: float, q: float, v: float) -> Build:
    """One rod on a spring and a damper, without gravity: a linear oscillator, known in closed form."""
    inertia = 1.0 / 3.0
    half, square = 0.5 * damping / inertia, stiffness / inertia
    root = np.sqrt(complex(half * half - square))
    # The slow exponent from the fast one: their difference would cancel.
    fast = -half - root
    slow = square / fast if fast else 0.0 * root

    def closed(t: float) -> tuple[Floats, Floats]:
        if abs(fast - slow) <= 1e-12 * abs(fast):
            drift = v - fast * q
            at, rate = q + drift * t, v + fast * drift * t
            return np.array([(at * np.exp(fast * t)).real]), np.array([(rate * np.exp(fast * t)).real])
        b = (v - slow * q) / (fast - slow)
        parts = (q - b) * np.exp(slow * t), b * np.exp(fast * t)
        return np.array([(parts[0] + parts[1]).real]), np.array([(slow * parts[0] + fast * parts[1]).real])

    return _chain(1, q, v, gravity=False, stiffness=stiffness, damping=damping, closed=closed)


def _stiff_finger(h_omega: float, dt: float) -> Build:
    """The finger, with springs whose fastest mode turns ``h_omega`` [rad] a step."""
    robot = load_robot("finger")
    M = lagrangian_jet(Scene(robot), np.zeros(3), np.zeros(3)).Lvv
    stiffness = (h_omega / dt) ** 2 * float(np.linalg.eigvalsh(M).min())
    return bench(lambda: robot, [0.3, 0.5, 0.4], gravity=False, stiffness=stiffness)


def _times() -> Iterator[Trial]:
    counts = {1e-6: 2000, 1e-4: 2000, 1e-3: 2000, 0.01: 1000, 0.05: 400, 0.1: 200, 0.2: 100, 0.5: 100}
    for dt, steps in counts.items():
        yield trial(f"3 links, dt = {dt:g} s", _chain(3), dt, steps)
    for links in (2, 3, 5):
        for dt in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5):
            name = f"{links} links, dt = {dt:g} s, 1e5 steps"
            yield trial(name, _chain(links), dt, 100_000, deep=True)
    pendulum = _chain(1, 0.5 - UP)
    yield trial("pendulum, 1e5 steps of 1 ms", pendulum, 1e-3, 100_000)
    yield trial("pendulum, 1e5 steps of 50 ms", pendulum, 0.05, 100_000)
    yield trial("pendulum, 1e7 steps of 1 ms", pendulum, 1e-3, 10_000_000, deep=True)
    for rate, dt in ((10.0, 1e-3), (100.0, 1e-3), (1e3, 1e-3), (1e3, 1e-5)):
        whirl = _chain(2, [0.0, 1.0], [rate, -0.5 * rate], gravity=False)
        yield trial(f"{rate:g} rad/s, dt = {dt:g} s", whirl, dt, 1000, window=_TURN / rate)


def _bodies() -> Iterator[Trial]:
    for links, steps in ((3, 1000), (20, 200)):
        for ratio in (1e-6, 1e-3, 1e3, 1e6):
            graded = _chain(links, 0.1, masses=list(np.geomspace(1.0, ratio, links)))
            yield trial(f"{links} links, tip {ratio:g} of base", graded, 1e-3, steps, window=0.2)
    for inertia in (1e-12, 1e-6, 1e6):
        yield trial(f"rod of {inertia:g} kg m^2", _chain(1, masses=[3.0 * inertia]), 1e-2, 500)
        three = _chain(3, 0.2, masses=[3.0 * inertia] * 3)
        yield trial(f"3 rods of {inertia:g} kg m^2", three, 1e-3, 1000)
    small = _chain(3, 0.2, masses=[3e-6] * 3, lengths=[1e-3] * 3)
    yield trial("3 rods of 1 mm and 3 mg", small, 1e-4, 1000, window=0.03)
    for tip in (1e-6, 1e-9, 1e-15, 1e-300, 0.0):
        yield trial(f"tip of {tip:g} kg", _chain(3, 0.2, masses=[1.0, 1.0, tip]), 1e-3, 500, window=0.2)
    for between in (1e-3, 1e-8, 1e-15, 0.0):
        # Two joints on one axis with next to nothing in between: their difference moves next to nothing.
        coaxial = _chain(2, 0.2, lengths=[0.0, 1.0], masses=[1.0, 1.0], armature=between)
        yield trial(f"coaxial joints, armature {between:g}", coaxial, 1e-3, 500, window=0.2)


def _springs_and_dampers() -> Iterator[Trial]:
    for turned in (1e-3, 0.1, 0.5, 1.0, 2.4, 10.0, 1e4):
        omega = turned / 1e-2
        spring = _oscillator(omega * omega / 3.0, 0.0, 0.5, 0.0)
        yield trial(f"spring, h omega = {turned:g}", spring, 1e-2, 1000, window=max(_TURN / omega, 0.04))
    for turned in (0.1, 1.0, 10.0):
        build = _chain(3, 0.1, stiffness=(turned / 1e-2) ** 2 / 3.0)
        yield trial(f"3 links on springs, h omega = {turned:g}", build, 1e-2, 500, window=0.2)
    for turned in (0.1, 2.4, 50.0):
        build = _stiff_finger(turned, 1e-3)
        yield trial(f"finger on springs, h omega = {turned:g}", build, 1e-3, 500, window=0.02)
    for lost in (1e-3, 0.1, 1.0, 2.5, 10.0, 1e4):
        rate = lost / 1e-2
        brake = _oscillator(0.0, rate / 3.0, 0.0, rate)
        yield trial(f"damper, h d / I = {lost:g}", brake, 1e-2, 500, window=max(3.0 / rate, 0.04))
        # The same damper on a spring of h omega = 0.1.
        creep = _oscillator(100.0 / 3.0, rate / 3.0, 0.5, 0.0)
        yield trial(f"spring and damper, h d / I = {lost:g}", creep, 1e-2, 500)
    yield trial("3 links in treacle, h d / I = 300", _chain(3, 0.1, damping=1e4), 1e-2, 500)


def _distances() -> Iterator[Trial]:
    for turns in (1e3, 1e6):
        turned = _chain(3, [0.3, 0.2, 0.1], [1.0, 0.0, 0.0], ahead=_TURN * np.array([turns, -turns, turns]))
        yield trial(f"3 links after {turns:g} turns", turned, 1e-3, 2000)
    rates = np.array([1e3, 0.0, 0.0])
    spinning = _chain(3, 0.0, rates, gravity=False, closed=lambda t: (t * rates, rates))
    yield trial("spinning chain, 1 rad a step", spinning, 1e-3, 10_000, window=10.0)
    yield trial("spinning chain, 1e6 turns", spinning, 1e-3, 6_283_186, window=10.0, deep=True)
    for offset in (1e2, 1e4, 1e6):
        yield trial(f"base {offset:g} m away", _chain(3, base=offset), 1e-2, 500)
        # Two rods that hang from a carriage, far along its rail.
        carriage = _chain(2, [0.0, 0.3, 0.2], rail=1.0, ahead=[offset, 0.0, 0.0])
        yield trial(f"carriage at {offset:g} m", carriage, 1e-3, 1000)


def _loads() -> Iterator[Trial]:
    drift = _chain(3, [0.0, 0.5, 0.3], [1.0, 0.0, -1.0], gravity=False)
    yield trial("no gravity", drift, 1e-2, 1000)
    for dt in (1e-4, 1e-3, 1e-2):
        heavy = _chain(3, 0.1, gravity=[0.0, 0.0, -1e4])
        yield trial(f"gravity 1e4 m/s^2, dt = {dt:g} s", heavy, dt, 1000, window=0.03)
    for links, steps in ((1, 1000), (2, 1000), (4, 1000), (16, 200), (64, 20)):
        yield trial(f"{links} links", _chain(links), 1e-2, steps, window=0.5)
    yield trial("256 links", _chain(256), 1e-3, 3, window=0.003, deep=True)
    yield trial("64 links, 1000 steps", _chain(64), 1e-2, 1000, window=0.5, deep=True)
    yield trial("256 links, 200 steps", _chain(256), 1e-2, 200, window=0.1, deep=True)
    for torque, dt in ((10.0, 1e-2), (1e3, 1e-2), (1e6, 1e-3)):
        flips = _chain(3, 0.1, controls=flipping(np.full(3, torque)))
        yield trial(f"+-{torque:g} N m, every {dt:g} s", flips, dt, 200)
    # Of a rod of 1/3 kg m^2.
    alpha = np.array([3e6])
    push = _chain(1, gravity=False, controls=np.array([1e6]), closed=lambda t: (0.5 * t * t * alpha, t * alpha))
    yield trial("1e6 N m on one rod", push, 1e-3, 1000)
    shove = _chain(3, 0.1, controls=np.array([1e6, 0.0, 0.0]))
    yield trial("1e6 N m on 3 links", shove, 1e-4, 200, window=0.002)
    increments = wiener_increments(2, 1e-2, 200, 0)
    for strength in (1e-12, 1e-3, 1.0, 1e3):
        noisy = _chain(2, noise=AdditiveNoise(strength), increments=increments)
        yield trial(f"noise of {strength:g} N m s^0.5", noisy, 1e-2, 200)


def _sensitive() -> Iterator[Trial]:
    swing = _chain(2, [UP, 0.5])
    for dt in (1e-3, 1e-2):
        yield trial(f"double pendulum, dt = {dt:g} s", swing, dt, round(20 / dt), window=5.0)
    yield trial("double pendulum, 1e6 steps", swing, 1e-2, 1_000_000, window=5.0, deep=True)
    yield trial("upright to the last bit", _chain(1, UP), 1e-3, 5000, window=5.0)
    nearly = _chain(1, np.nextafter(UP, 0.0))
    yield trial("upright but for the last bit", nearly, 1e-2, 2000, window=5.0)
    thrown = _chain(1, -UP, 2.0 * math.sqrt(_HANGING))
    yield trial("just enough to stand upright", thrown, 1e-2, 1000, window=1.5)


TRIALS: tuple[Trial, ...] = (
    *(*_times(), *_bodies(), *_springs_and_dampers(), *_distances(), *_loads(), *_sensitive()),
)


def trials_on(robot: Robot) -> list[Trial]:
    """The motions of ``check_robot``, to be judged all over and with their noise."""
    benches = [Bench(**vars(motion)) for motion in motions_of(robot)]
    return [Trial(own.name, lambda own=own: own) for own in benches]
