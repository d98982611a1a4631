"""The fit of parameters to logs: logs on the grid of the steps, their stretches, residuals and derivatives.

Equation (I1) of docs/mathematics.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import lsq_linear

from varpin.arrays import Floats
from varpin.errors import InputError, LinearizationError, RobotError, SingularMassMatrix
from varpin.estimation.consistency import Body
from varpin.estimation.filter import Estimate, filtered, measurements
from varpin.estimation.grid import Grid
from varpin.estimation.log import GAP, Log
from varpin.estimation.parameters import INERTIAL, Parameters
from varpin.estimation.sensitivity import motion_map
from varpin.integrators import Integrator, Segment
from varpin.integrators.base import Varied
from varpin.linearization import linearize_steps
from varpin.mechanics.scene import Scene
from varpin.signals.commands import open_loop
from varpin.simulation.record import rollout, trajectory_of
from varpin.support.checks import JointValues
from varpin.trajectory import StepStatistics, Trajectory

# Shortest stretches [s], with which the search begins, before each is twice as long: from a scene without friction or
# payload, motions of a second are too far from the log to lead back.
_FIRST = 0.2
# Expected decrease of the cost at which a first search ends, as a share of the cost, and the last one, as a share of
# what one residual has in it: by a quarter of a deviation of a value. Where values are well told, the search is then
# far closer, as it converges quadratically; inertias that logs hardly tell would go on for hundreds of evaluations.
_LOOSE, _TIGHT = 0.01, 0.05
# Most corrections of a stretch's start for given parameters, and the share of its cost below which it is found: later
# evaluations go on from it.
_CORRECTIONS, _FOUND = 6, 1e-8
# Most trials of a correction, each a quarter as long: where dry friction turns, whole ones lead astray.
_SHORTENED = 12
# Most halvings of a step by a guard, without forces that turn within a step, as dry friction does; from 3 to 5. Motions
# of values that are far off have steps of thousands of parts, each with its derivatives, and are no nearer to the log.
_HALVINGS, _STEADY = 4, ("JointSpring", "JointDamper")
# Samples from which a stretch's start is guessed, by a parabola.
_GUESSED = 8
# Longest delay of the controls that is looked for [s]: buses and drives have some milliseconds.
LATEST = 0.1
# Damping of a step in units of the squared column sizes: at first and after a step that was not right, where steps are,
# and where no step helps any more.
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-12, 1e6
# Steps of a filter whose lengths differ by less than this share have their derivatives in parameters together: these
# are then off by about that share, and the search is slower by as much.
_ALIKE = 1e-3
# Residual in units of the noise that stands for a motion that cannot be simulated.
LOST = 1e8


@dataclass(eq=False)
class Fit:
    """What all evaluations share: y are coordinates of the parameters, then the delay if it is unknown."""

    of: Parameters
    integrator: Integrator
    dt: float
    horizon: float
    q_noise: JointValues
    v_noise: JointValues | None
    delay: float | None
    callback: Callable[[int, float], None] | None

    def __post_init__(self) -> None:
        if not self.horizon > 0.0:
            raise InputError(f"horizon must be positive [s], or np.inf for whole logs, got {self.horizon:g}")
        of, P, late = self.of, len(self.of.names), np.ones(int(self.delay is None))
        dry = any(name.startswith("friction") for name in of.names)
        if not dry and all(element.kind in _STEADY for element in of.scene.elements):
            self.integrator = self.integrator.halving(_HALVINGS)
        self.noise = of.scene.robot.joint_names, self.q_noise, self.v_noise
        self.bodies = _bodies(of)
        self.prior = [c for columns, _ in self.bodies for c in columns]
        self.size = P + late.size
        # The scene's own values and no delay; and the least and the greatest y, which bodies do not have.
        self.begin = np.concatenate([of.values, 0.0 * late])
        self.bounds = np.concatenate([of.least, -LATEST * late]), np.concatenate([np.full(P, np.inf), LATEST * late])
        self.begin[self.prior], self.bounds[0][self.prior] = 0.0, -np.inf
        # L and F are linear in all parameters together, but for gains of servos and for springs with their rests.
        self.varied = of.varied()
        self.linear = not any(name.startswith(("servo", "rest", "stiffness")) for name in of.names)
        self.best, self.least, self.done = self.begin, np.inf, 0
        self.rest, self.jacobian = np.zeros(1), np.zeros((1, self.size))

    def with_prior(self, r: Floats, J: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Residuals and their derivatives in y, with those of the prior of bodies."""
        return np.concatenate([r, y[self.prior]]), np.concatenate([J, np.eye(self.size)[self.prior]])

    @property
    def cost(self) -> float:
        """That of the best y so far; 0 before the first evaluation."""
        r, _ = self.with_prior(self.rest, self.jacobian, self.best)
        return float(r @ r)

    def values(self, y: Floats) -> tuple[Floats, Floats]:
        """The parameters' values (P,), and the derivatives of them, and of the delay if unknown, in y (size, size)."""
        values, slopes = y[: len(self.of.names)].copy(), np.eye(self.size)
        for columns, body in self.bodies:
            values[columns], slopes[np.ix_(columns, columns)] = body.numbers(y[columns])
        return values, slopes

    def late(self, y: Floats) -> float:
        """The delay [s]."""
        return float(y[-1]) if self.delay is None else self.delay

    def doublings(self, runs: Sequence[Run]) -> int:
        """How often the first stretches are doubled."""
        longest = min(self.horizon, max(run.duration for run in runs))
        return max(0, int(np.floor(np.log2(longest / _FIRST))))

    def changed(self, scene: Scene, values: Floats) -> tuple[Varied, ...]:
        """The scenes around the parameters of a scene with ``values`` (P,)."""
        return self.varied if self.linear else replace(self.of, scene=scene, values=values).varied()

    def search(
        self, evaluate: Callable[[Floats], tuple[Floats, Floats]], y: Floats, evaluations: int, *, last: bool
    ) -> tuple[Floats, str]:
        """The y of least squares from ``y``, and how it ended."""
        lower, upper = self.bounds

        def at(y: Floats) -> tuple[Floats, Floats, float]:
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    r, J = evaluate(y)
            except RobotError:
                # A step too far: inertias that are not finite.
                r, J = np.full(len(self.jacobian), LOST), np.zeros_like(self.jacobian)
            self.done += 1
            both = self.with_prior(r, J, y)
            cost = float(both[0] @ both[0])
            if cost < self.least:
                self.best, self.least, self.rest, self.jacobian = y, cost, r, J
            if self.callback is not None:
                self.callback(self.done, float(np.sqrt(r @ r / len(r))))
            return *both, cost

        self.least, damping = np.inf, _FIRST_DAMPING
        r, J, cost = at(np.clip(y, lower, upper))
        y = self.best
        for _ in range(evaluations):
            # The method of Levenberg and Marquardt within bounds; what moves nothing stays.
            sizes = np.linalg.norm(J, axis=0)
            weights = np.sqrt(damping) * np.where(sizes > 0.0, sizes, 1.0)
            system = np.concatenate([J, np.diag(weights)]), -np.concatenate([r, np.zeros(self.size)])
            step = lsq_linear(*system, (lower - y, upper - y), method="bvls").x
            gain = cost - float(np.square(r + J @ step).sum())
            if gain <= (_TIGHT / len(r) if last else _LOOSE) * cost:
                return y, "converged"
            trial = at(np.clip(y + step, lower, upper))
            if trial[2] < cost:
                y, (r, J, cost), damping = self.best, trial, max(0.3 * damping, _LEAST_DAMPING)
            elif damping > _MOST_DAMPING:
                return y, "converged"
            else:
                damping = max(10.0 * damping, _FIRST_DAMPING)
        return y, "evaluations"


def _bodies(of: Parameters) -> list[tuple[list[int], Body]]:
    """The bodies of which all ten numbers are parameters, by the places of these."""
    found = []
    for k, name in enumerate(of.names):
        own = [f"{name.rpartition(':')[0]}:{number}" for number in INERTIAL]
        if name == own[0] and list(of.names[k : k + 10]) == own:
            found.append((list(range(k, k + 10)), Body.around(of.values[k : k + 10])))
    return found


@dataclass(eq=False)
class Run:
    """A log on the grid of equal steps, and the starts of its stretches that were found last, by their first nodes."""

    fit: Fit
    log: Log
    starts: dict[int, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.grid = Grid.even(self.log, self.fit.dt)
        self.duration = float(self.log.t[-1] - self.log.t[0])
        samples, variance = measurements(self.log, *self.fit.noise)
        self.deviation = np.sqrt(variance)
        self.measured = samples / self.deviation

    def settled(self, scene: Scene, late: float) -> list[Stretch]:
        """The stretches after a search for their starts, by shorter ones as :func:`identify` where none is known."""
        for finer in range(0 if self.starts else self.fit.doublings([self]), -1, -1):
            stretches = self.stretches(2**finer)
            for each in stretches:
                each.fitted(scene, (), late)
        return stretches

    def stretches(self, finer: int = 1) -> list[Stretch]:
        """The log in stretches of about the horizon, or this much shorter."""
        parts = finer * max(1, round(self.duration / self.fit.horizon))
        # What acts in a gap is not in the log.
        node, steps, intervals = self.grid.node, self.grid.steps, np.diff(self.log.t)
        gaps = np.flatnonzero(intervals > GAP * np.median(intervals))
        cuts = np.concatenate([node[gaps] + 1, node[gaps + 1]])
        ends = np.unique(np.concatenate([steps * np.arange(parts + 1) // parts, cuts]))
        found = [Stretch(self, a, b) for a, b in pairwise(ends.tolist())]
        return [each for each in found if each.samples.any()]


class Stretch:
    """Steps ``begin`` to ``end`` of a run, and the samples on them."""

    def __init__(self, run: Run, begin: int, end: int) -> None:
        self.run, self.begin, self.end = run, begin, min(end, run.grid.steps)
        node, last = run.grid.node, self.end == run.grid.steps
        self.samples = (node >= begin) & ((node < end) | last)
        self.there = np.isfinite(run.measured[self.samples])
        self.measured = run.measured[self.samples][self.there]
        if begin not in run.starts:
            run.starts[begin] = self._guess()

    def _guess(self) -> Floats:
        """Positions and velocities at the first node by parabolas through the samples next to it."""
        log, at = self.run.log, self.run.grid.t[self.begin]
        first = self.run.grid.at.searchsorted(self.begin)
        found = np.zeros((2, log.q.shape[1]))
        for joint in range(found.shape[1]):
            there = np.flatnonzero(np.isfinite(log.q[:, joint]))
            near = there[np.argsort(np.abs(there - first), kind="stable")[:_GUESSED]]
            curve = np.polynomial.Polynomial.fit(log.t[near], log.q[near, joint], min(2, len(near) - 1))
            found[:, joint] = curve(at), curve.deriv()(at)
        return found.ravel()

    def motion(self, scene: Scene, u: Floats, x0: Floats) -> Trajectory | None:
        """The motion from a start; None where it cannot be simulated."""
        n = scene.robot.dof
        try:
            motion, failure = rollout(scene, self.run.fit.integrator, x0[:n], x0[n:], open_loop(u), self.run.fit.dt)
        except SingularMassMatrix:
            return None
        return None if failure is not None or not np.isfinite([motion.q, motion.v]).all() else motion

    def at_samples(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Positions and velocities (k, n, ...) at the samples from those at the nodes (N + 1, n, ...), by cubics."""
        grid, h = self.run.grid, self.run.fit.dt
        curve, at = CubicHermiteSpline(np.arange(len(q)), q, h * v), grid.at[self.samples] - self.begin
        return curve(at), curve(at, 1) / h

    @np.errstate(over="ignore", invalid="ignore")
    def residuals(
        self, scene: Scene, varied: Sequence[Varied], delay: float, x0: Floats
    ) -> tuple[Floats, Floats, Floats] | None:
        """Predictions minus samples (r,), and derivatives in start (r, 2n) and in parameters and delay (r, P + 1)."""
        u, by_delay = self.run.grid.controls(delay, self.begin, self.end)
        motion = self.motion(scene, u, x0)
        if motion is None:
            return None
        integrator, m = self.run.fit.integrator, len(x0)
        try:
            linear = linearize_steps(scene, motion, integrator, motion.q[0])
            by = motion_map(scene, motion, varied, linear, integrator)
        except LinearizationError:
            return None
        late = by.B @ by_delay[:, :, None]
        begin, none = np.eye(m, m + len(varied) + 1), np.zeros((len(late), m, m))
        x = by.forward(begin, np.concatenate([none, by.D, late], axis=2))
        # Those of motions that fly apart overflow, and so do their squares.
        if not np.isfinite(x).all():
            return None
        state = np.concatenate([motion.q, motion.v], axis=1)[:, :, None]
        both = np.concatenate(self.at_samples(*np.split(np.concatenate([state, x], axis=2), 2, axis=1)), axis=1)
        rows = (both[:, : self.there.shape[1]] / self.run.deviation[:, None])[self.there]
        r, J = rows[:, 0] - self.measured, rows[:, 1:]
        return (r, J[:, :m], J[:, m:]) if np.isfinite(np.vdot(J, J) + r @ r) else None

    def fitted(self, scene: Scene, varied: Sequence[Varied], late: float) -> tuple[Floats, Floats]:
        """Residuals (r,) at the best start, and derivatives in parameters and delay (r, P + 1) as the start follows."""
        x0 = self.run.starts[self.begin]
        found = self.residuals(scene, (), late, x0)
        for _ in range(_CORRECTIONS):
            if found is None:
                break
            r, Jx, _ = found
            step = np.linalg.lstsq(Jx, r, rcond=None)[0]
            gain = 2.0 * float(step @ (Jx.T @ r)) - float(np.square(Jx @ step).sum())
            if gain <= _FOUND * float(r @ r):
                break
            starts = (x0 - 0.25**k * step for k in range(_SHORTENED))
            trials = ((start, self.residuals(scene, (), late, start)) for start in starts)
            nearer = next((each for each in trials if each[1] and each[1][0] @ each[1][0] < r @ r), None)
            if nearer is None:
                break
            x0, found = nearer
        found = self.residuals(scene, varied, late, x0)
        if found is None:
            return np.full(self.measured.size, LOST), np.zeros((self.measured.size, len(varied) + 1))
        r, Jx, J = found
        self.run.starts[self.begin] = x0
        along, _ = np.linalg.qr(Jx)
        return r - along @ (along.T @ r), J - along @ (along.T @ J)


def simulations(fit: Fit, stretches: Sequence[Stretch], y: Floats) -> tuple[Floats, Floats]:
    """Residuals of all stretches and their derivatives in y, (I1)."""
    before = {each.run: dict(each.run.starts) for each in stretches}
    r, J = _evaluated(fit, y, [each.fitted for each in stretches])
    if float(r @ r) > fit.least:
        # The next values are nearer to those before.
        for run, starts in before.items():
            run.starts = starts
    return r, J


def predictions(fit: Fit, grids: Sequence[Grid], y: Floats) -> tuple[Floats, Floats]:
    """Innovations of all logs in units of their deviations, and derivatives in y; gains are taken as constant."""
    return _evaluated(fit, y, [partial(_innovations, fit, grid) for grid in grids])


_Part = Callable[[Scene, Sequence[Varied], float], tuple[Floats, Floats]]


def _evaluated(fit: Fit, y: Floats, parts: Sequence[_Part]) -> tuple[Floats, Floats]:
    """Residuals and derivatives in y from those of parts in the values and the delay, (r,) and (r, P + 1)."""
    values, slopes = fit.values(y)
    scene = fit.of.scene_with(values)
    varied, late = fit.changed(scene, values), fit.late(y)
    r, J = (np.concatenate(each) for each in zip(*(part(scene, varied, late) for part in parts), strict=True))
    return r, J[:, : fit.size] @ slopes


def _innovations(fit: Fit, grid: Grid, scene: Scene, varied: Sequence[Varied], late: float) -> tuple[Floats, Floats]:
    """As :func:`predictions` for one log, in values and delay, by a filter with a row for each step."""
    u, by_delay = grid.controls(late)
    try:
        seen = filtered(scene, grid.at_nodes(u), *fit.noise[1:], method=fit.integrator)
    except LinearizationError:
        known = int(np.isfinite(measurements(grid.log, *fit.noise)[0]).sum())
        return np.full(known, LOST), np.zeros((known, len(varied) + 1))
    h, n = seen.given.h, scene.robot.dof
    alike = np.rint(np.log(h / h.min()) / _ALIKE)
    more = np.zeros((len(h), 2 * n, len(varied) + 1))
    for a, b in pairwise([0, *(np.flatnonzero(np.diff(alike)) + 1).tolist(), len(h)]):
        motion = _steps(scene, fit.integrator, float(h[a:b].mean()), seen, u, a, b)
        more[a:b, :, :-1] = fit.integrator.in_parameters(scene, motion, varied)
        by_force = fit.integrator.linearize(scene, motion)[1]
        more[a:b, :, -1:] = by_force @ scene.transmission @ by_delay[a:b, :, None]
    x = np.zeros(more.shape[1:])
    rows: list[Floats] = []
    for k, (H, gain) in enumerate(zip(seen.forward.rows, seen.gains, strict=True)):
        if k:
            x = seen.forward.transition[k - 1] @ x + more[k - 1]
        rows.append(-H @ x)
        x = x + gain @ rows[-1]
    there = np.isfinite(seen.innovations)
    both = seen.independent(np.concatenate([seen.innovations[:, :, None], np.array(rows)], axis=2))[there]
    return both[:, 0], both[:, 1:]


def _steps(scene: Scene, method: Integrator, dt: float, seen: Estimate, u: Floats, a: int, b: int) -> Trajectory:
    """Steps ``a`` to ``b`` of a filter, from each state to about the next, as a motion."""
    n = scene.robot.dof
    q, p, v = (x[a : b + 1] for x in (seen.q, seen.forward.state[:, n : 2 * n], seen.v))
    none, zero = np.zeros(b - a), np.zeros(b - a, np.int64)
    statistics = StepStatistics(zero, zero, zero, zero + 1, np.zeros(0, np.uint8), none, none, none)
    first = Segment(q[:1], p[:1], v[:1], u[:0], np.zeros(1), statistics)
    steps = Segment(q[1:], p[1:], v[1:], u[a:b], none, statistics)
    return trajectory_of(scene, method, dt, first, [steps], None, None)
