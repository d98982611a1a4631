"""Parameters of a scene from logs: simulation error, or prediction error under noise.

Equations (I1) and (I2) of docs/mathematics.md.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from varpin.arrays import Floats
from varpin.errors import InputError, LinearizationError, RobotError, SingularMassMatrix
from varpin.estimation.consistency import Body
from varpin.estimation.filter import kalman_filter, variances
from varpin.estimation.log import GAP, Log, as_log
from varpin.estimation.parameters import INERTIAL, Parameters, parameters_of
from varpin.estimation.sensitivity import motion_map
from varpin.finding import Finding, announce
from varpin.integrators import Gauss, Integrator
from varpin.integrators.base import Varied
from varpin.linearization import linearize_steps
from varpin.mechanics.scene import Scene, refuse_constraints, require_scene
from varpin.model.urdf_output import save_urdf
from varpin.signals.commands import open_loop
from varpin.simulation.choice import given_integrator
from varpin.simulation.record import rollout
from varpin.support.checks import JointValues, count, finite, positive, real
from varpin.support.frozen import Frozen
from varpin.trajectory import Trajectory

# Length [s] of the stretches that are simulated, each from a start of its own, unless it is given. Open-loop motions of
# arms depart from logs by e in about 0.3 s, whatever is not modelled, and a damper needs its time to tell.
_HORIZON = 1.0
# Shortest stretches [s], with which the search begins, before each is twice as long: from a scene without friction or
# payload, motions of a second are too far from the log to lead back.
_FIRST = 0.2
# Expected decrease of the cost at which a first search ends, as a share of the cost, and the last one, as a share of
# what one residual has in it: by a quarter of a deviation of a value. Where values are well told, the search is then
# far closer, as it converges quadratically; inertias that logs hardly tell would go on for hundreds of evaluations.
_LOOSE, _TIGHT = 1e-3, 0.05
# Most corrections of a stretch's start for given parameters, and the share of its cost below which it is found: later
# evaluations go on from it.
_CORRECTIONS, _FOUND = 6, 1e-8
# Most trials of a correction, each a quarter as long: where dry friction turns, whole ones lead astray.
_SHORTENED = 12
# Samples from which a stretch's start is guessed, by a parabola.
_GUESSED = 8
# Longest delay of the controls that is looked for [s]: buses and drives have some milliseconds.
_LATEST = 0.1
# Singular value of normalized derivatives below which a combination moves nothing: derivatives are good to 1e-9.
_NOTHING = 1e-7
# Coefficients of a combination below this share of its largest are rounding.
_NAMED = 1e-3
# Damping of a step in units of the squared column sizes: at first and after a step that was not right, where steps are,
# and where no step helps any more.
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-12, 1e6
# Standard deviations of a delay, and residuals in units of the encoders' noise, that are told.
_SURE, _MISFIT = 4.0, 2.0
# Doubts about a log from which no value could be right.
_NEVER = ("dead encoder", "clock of the log")
# Residual in units of the noise that stands for a motion that cannot be simulated.
_LOST = 1e8

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Identification(Frozen):
    """Parameters of a scene from logs; made by :func:`identify`.

    Attributes:
        names: Names of the parameters (P,).
        values: Their values (P,).
        start: Those of the scene that was given (P,).
        units: Their units (P,).
        covariance: Covariance of the errors of the values (P, P), for encoders of the given noise; infinite for what
            the logs do not tell.
        delay: By how much the controls act later than the logs say [s].
        delay_deviation: Its standard deviation [s]; 0 for a delay that was given.
        null_space: What the logs do not tell, one sentence for each combination of parameters.
        scene: The scene with the values.
        logs: The logs, in the scene's order.
        predicted: The positions at the samples of each log (K, n) by motions with the values, each over the horizon
            from a start of its own [rad or m].
        predicted_before: The same with the scene's own values, from the same starts.
        residuals: Samples minus ``predicted`` (K, n); NaN where one is missing.
        held_out: The same for the logs that were held out.
        status: ``"converged"``, ``"evaluations"`` where they were too few, or ``"interrupted"``.
        warnings: What is doubtful, the worst first.
    """

    names: tuple[str, ...]
    values: Floats
    start: Floats
    units: tuple[str, ...]
    covariance: Floats
    delay: float
    delay_deviation: float
    null_space: tuple[str, ...]
    scene: Scene
    logs: tuple[Log, ...] = field(repr=False)
    predicted: tuple[Floats, ...] = field(repr=False)
    predicted_before: tuple[Floats, ...] = field(repr=False)
    residuals: tuple[Floats, ...] = field(repr=False)
    held_out: tuple[Floats, ...] = field(repr=False)
    status: str
    warnings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        return f"Identification({len(self.names)} parameters of {len(self.logs)} logs, {self.status})"

    def __str__(self) -> str:
        rows = zip(self.names, self.start, self.values, self.deviations, self.units, strict=True)
        return "\n".join(f"{name}: {old:.4g} -> {new:.5g} +- {sd:.2g} {unit}" for name, old, new, sd, unit in rows)

    @cached_property
    def deviations(self) -> Floats:
        """Standard deviations of the values (P,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def save_urdf(self, path: str | os.PathLike[str]) -> Path:
        """Write the robot's URDF file with the values; other parameters than a URDF has are told in the log.

        Raises:
            InputError: The robot comes from no URDF, or ``path`` does not end in .urdf.
            FileError: The file cannot be written.
        """
        kinds: dict[str, dict[str, float]] = {"damping": {}, "friction": {}}
        apart = []
        for name, value in zip(self.names, self.values.tolist(), strict=True):
            kind, _, joint = name.partition(":")
            if kind in kinds:
                kinds[kind][joint] = value
            elif kind not in ("payload", "inertia"):
                apart.append(name)
        target = save_urdf(self.scene.robot, path, **kinds)
        if apart:
            logger.warning("%s: a URDF has no place for %s", target, ", ".join(apart))
        return target


def identify(
    scene: Scene,
    logs: Log | Trajectory | Sequence[Log | Trajectory],
    parameters: str | Sequence[str],
    *,
    q_noise: JointValues,
    v_noise: JointValues | None = None,
    delay: float | None = None,
    dt: float | None = None,
    horizon: float | None = None,
    integrator: Integrator | None = None,
    held_out: Log | Trajectory | Sequence[Log | Trajectory] = (),
    evaluations: int = 100,
    callback: Callable[[int, float], None] | None = None,
) -> Identification:
    """Identify parameters of a scene from logs of its arm.

    In a scene without noise it minimizes the simulation error: motions under the logged controls, over the horizon and
    from starts that are found, too, against the samples. In a scene with noise it minimizes the errors of the one-step
    predictions of :func:`kalman_filter`. Both are least squares on exact derivatives, (I1) of docs/mathematics.md.
    Bodies whose ten inertial numbers are all parameters stay such as a rigid body can have, and near the scene's where
    the logs do not tell: their prior is a factor of e, (I2).

    Main args:
        scene: The scene; its values are where the search begins.
        logs: One or several, also simulated motions.
        parameters: Names, see :func:`varpin.estimation.parameters.parameters_of`: ``"damping"``, ``"payload"``,
            ``"inertia:wrist_3_link"``.
        q_noise: Standard deviation of an encoder's error: one number, (n,) or by joint name [rad or m].
        v_noise: The same of measured velocities [rad/s or m/s]; without it they are not used.

    Other Args:
        delay: By how much the controls act later than the logs say [s]; found, too, if left out.
        dt: Time step [s]; if left out, the logs' usual one. What is identified has its error, so a coarse step needs an
            integrator of high order.
        horizon: Length [s] of the stretches that are simulated, each from a start of its own; 1 s if left out, np.inf
            for whole logs. Longer ones tell more of what is slow, and depart further from a log of which the scene
            does not model everything.
        integrator: ``varpin.Gauss(2)`` if left out.
        held_out: Logs for :attr:`Identification.held_out`, of which the parameters know nothing.
        evaluations: Most evaluations of each search.
        callback: Called with the number of evaluations and the residual in units of the noise after each. Ctrl-C ends
            the search with the best values so far.

    Raises:
        InputError: A name stands for no parameter, a log does not fit the scene or has a dead encoder, the scene has
            constraints, or a value is out of its range.
        UnknownJoint: A name is no joint of the robot.
    """
    refuse_constraints(require_scene(scene), "identify")
    of = parameters_of(scene, parameters)
    given, others = _several("logs", logs), _several("held_out", held_out)
    if not given:
        raise InputError("logs is empty: give one varpin.Log at least")
    chosen = given_integrator(integrator) or Gauss(2)
    matched, apart = (tuple(as_log(each).matched(scene) for each in some) for some in (given, others))
    if v_noise is not None and any(log.v is None for log in (*matched, *apart)):
        raise InputError("v_noise is given, and a log has no velocities v")
    for doubt in (doubt for log in (*matched, *apart) for doubt in log.warnings if doubt.kind in _NEVER):
        raise InputError(f"{doubt}; values from this log would be wrong")
    step = min(float(np.median(np.diff(log.t))) for log in matched) if dt is None else positive("dt", dt, "s")
    length = _HORIZON if horizon is None else real("horizon", horizon)
    late = None if delay is None else finite("delay", delay)
    fit = _Fit(of, chosen, step, length, q_noise, v_noise, late, callback)
    runs = [_Run(fit, log) for log in matched]
    y, status, evaluation = np.zeros(fit.size), "converged", count("evaluations", evaluations)
    y[: len(of.names)] = fit.begin
    fit.best = y
    try:
        if scene.processes:
            y, status = fit.search(partial(_predictions, fit, runs), y, evaluation, last=True)
        else:
            for finer in range(fit.doublings(runs), -1, -1):
                stretches = [part for run in runs for part in run.stretches(2**finer)]
                y, status = fit.search(partial(_simulations, fit, stretches), y, evaluation, last=not finer)
    except KeyboardInterrupt:
        y, status = fit.best, "interrupted"
    return _made(fit, y, runs, [_Run(fit, log) for log in apart], status)


def _several(name: str, logs: Any) -> tuple[Any, ...]:
    """One log or several as several."""
    if isinstance(logs, Log | Trajectory):
        return (logs,)
    if not isinstance(logs, Sequence):
        raise InputError(f"{name} must be a varpin.Log or several, got {type(logs).__name__}")
    return tuple(logs)


class _Fit:
    """What all evaluations share: y are coordinates of the parameters, then the delay if it is unknown."""

    def __init__(
        self,
        of: Parameters,
        integrator: Integrator,
        dt: float,
        horizon: float,
        q_noise: JointValues,
        v_noise: JointValues | None,
        delay: float | None,
        callback: Callable[[int, float], None] | None,
    ) -> None:
        self.of, self.integrator, self.dt, self.delay, self.callback = of, integrator, dt, delay, callback
        self.q_noise, self.v_noise, self.horizon = q_noise, v_noise, horizon
        if not horizon > 0.0:
            raise InputError(f"horizon must be positive [s], or np.inf for whole logs, got {horizon:g}")
        names = of.scene.robot.joint_names
        self.deviation = np.sqrt(variances("q_noise", q_noise, names))
        self.v_deviation = None if v_noise is None else np.sqrt(variances("v_noise", v_noise, names))
        self.bodies = _bodies(of)
        self.prior = [c for columns, _ in self.bodies for c in columns]
        self.size = len(of.names) + (delay is None)
        # L and F are linear in all parameters together, but for gains of servos and for springs with their rests.
        self.varied = of.varied()
        self.linear = not any(name.startswith(("servo", "rest", "stiffness")) for name in of.names)
        self.best, self.least, self.done = np.zeros(self.size), np.inf, 0
        self.jacobian = np.zeros((1, self.size))

    @cached_property
    def begin(self) -> Floats:
        """The coordinates of the scene's own values (P,)."""
        y = self.of.values.copy()
        for columns, _ in self.bodies:
            y[columns] = 0.0
        return y

    def values(self, y: Floats) -> tuple[Floats, Floats]:
        """The parameters' values (P,) and their derivatives in y (P, size)."""
        P = len(self.of.names)
        values, slopes = y[:P].copy(), np.eye(P, self.size)
        for columns, body in self.bodies:
            values[columns], slopes[np.ix_(columns, columns)] = body.numbers(y[columns])
        return values, slopes

    def late(self, y: Floats) -> float:
        """The delay [s]."""
        return float(y[-1]) if self.delay is None else self.delay

    def doublings(self, runs: Sequence[_Run]) -> int:
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
        P, prior = len(self.of.names), self.prior
        lower, upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        lower[:P] = np.where(np.isin(np.arange(P), prior), -np.inf, self.of.least)
        lower[P:], upper[P:] = -_LATEST, _LATEST

        def at(y: Floats) -> tuple[Floats, Floats, float]:
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    r, J = evaluate(y)
            except RobotError:
                # A step too far: inertias that are not finite.
                r, J = np.full(len(self.jacobian), _LOST), np.zeros_like(self.jacobian)
            self.done += 1
            both = np.concatenate([r, y[prior]])
            cost = float(both @ both)
            if cost < self.least:
                self.best, self.least, self.jacobian = y, cost, J
            if self.callback is not None:
                self.callback(self.done, float(np.sqrt(r @ r / len(r))))
            return both, np.concatenate([J, np.eye(self.size)[prior]]), cost

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


class _Run:
    """A log on the grid of the steps."""

    def __init__(self, fit: _Fit, log: Log) -> None:
        self.fit, self.log, h = fit, log, fit.dt
        self.starts: dict[int, Floats] = {}
        self.known: tuple[float, tuple[Floats, Floats]] = (np.nan, (np.zeros(0), np.zeros(0)))
        after = (log.t - log.t[0]) / h
        self.duration = float(log.t[-1] - log.t[0])
        self.steps = max(1, int(np.ceil(after[-1] - 1e-6)))
        # A sample next to a node is at it, though clocks round.
        near = np.abs(after - np.rint(after)) < max(1e-6, 4.0 * np.spacing(np.abs(log.t[-1])) / h)
        after = np.where(near, np.rint(after), after)
        self.node = np.minimum(after.astype(int), self.steps - 1)
        self.share = after - self.node
        # The integral of the held controls up to each sample.
        held = np.diff(log.t)[:, None] * log.u[:-1]
        self.integral = np.concatenate([np.zeros((1, log.u.shape[1])), np.cumsum(held, axis=0)])

    def controls(self, delay: float) -> tuple[Floats, Floats]:
        """The mean controls of the steps (N, m), and their derivatives in the delay."""
        if self.known[0] == delay:
            return self.known[1]
        edges = self.log.t[0] + self.fit.dt * np.arange(self.steps + 1) - delay
        at = np.clip(np.searchsorted(self.log.t, edges + 1e-9, side="right") - 1, 0, len(self.log.t) - 1)
        u = self.log.u[at]
        passed = self.integral[at] + (edges - self.log.t[at])[:, None] * u
        self.known = delay, (np.diff(passed, axis=0) / self.fit.dt, -np.diff(u, axis=0) / self.fit.dt)
        return self.known[1]

    def settled(self, scene: Scene, late: float) -> list[_Stretch]:
        """The stretches after a search for their starts, by shorter ones as :func:`identify` itself."""
        for finer in range(self.fit.doublings([self]), -1, -1):
            stretches = self.stretches(2**finer)
            for each in stretches:
                each.fitted(scene, (), late)
        return stretches

    def stretches(self, finer: int = 1) -> list[_Stretch]:
        """The log in stretches of about the horizon, or this much shorter."""
        parts = finer * max(1, round(self.duration / self.fit.horizon))
        # What acts in a gap is not in the log.
        gaps = np.flatnonzero(np.diff(self.log.t) > GAP * np.median(np.diff(self.log.t)))
        cuts = np.concatenate([self.node[gaps] + 1, self.node[gaps + 1]])
        ends = np.unique(np.concatenate([self.steps * np.arange(parts + 1) // parts, cuts]))
        found = [_Stretch(self, a, b) for a, b in pairwise(ends.tolist())]
        return [each for each in found if each.samples.any()]


class _Stretch:
    """Steps ``begin`` to ``end`` of a run, with the samples on them, and the start that was found last."""

    def __init__(self, run: _Run, begin: int, end: int) -> None:
        self.run, self.begin, self.end = run, begin, end
        last = end == run.steps
        self.samples = (run.node >= begin) & ((run.node < end) | last)
        if begin not in run.starts:
            run.starts[begin] = self._guess()

    def _guess(self) -> Floats:
        """Positions and velocities at the first node by parabolas through the samples next to it."""
        log, fit = self.run.log, self.run.fit
        at = log.t[0] + self.begin * fit.dt
        first = int(np.searchsorted(log.t, at - 1e-9))
        found = np.zeros((2, fit.of.scene.robot.dof))
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
        return None if failure is not None else motion

    def at_samples(self, q: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Positions and velocities (k, n, ...) at the samples from those at the nodes (N + 1, n, ...), by cubics."""
        run, h = self.run, self.run.fit.dt
        k = run.node[self.samples] - self.begin
        s = run.share[self.samples].reshape(-1, *[1] * (q.ndim - 1))
        moved, a, b = q[k + 1] - q[k], h * v[k], h * v[k + 1]
        bend, twist = 3.0 * moved - 2.0 * a - b, a + b - 2.0 * moved
        # The nodes themselves where samples are at them.
        at = np.where(s == 1.0, q[k + 1], q[k] + s * (a + s * (bend + s * twist)))
        return at, np.where(s == 1.0, v[k + 1], (a + s * (2.0 * bend + 3.0 * s * twist)) / h)

    def _weighed(self, q: Floats, v: Floats) -> Floats:
        """Rows (r, ...) of the samples that are there, in units of their deviations."""
        fit, log = self.run.fit, self.run.log
        at_q, at_v = self.at_samples(q, v)
        shape = (1, -1, *[1] * (q.ndim - 2))
        rows = [(at_q / fit.deviation.reshape(shape))[np.isfinite(log.q[self.samples])]]
        if fit.v_deviation is not None and log.v is not None:
            rows.append((at_v / fit.v_deviation.reshape(shape))[np.isfinite(log.v[self.samples])])
        return np.concatenate(rows)

    @cached_property
    def measured(self) -> Floats:
        fit, log = self.run.fit, self.run.log
        rows = [(log.q[self.samples] / fit.deviation)[np.isfinite(log.q[self.samples])]]
        if fit.v_deviation is not None and log.v is not None:
            rows.append((log.v[self.samples] / fit.v_deviation)[np.isfinite(log.v[self.samples])])
        return np.concatenate(rows)

    @np.errstate(over="ignore", invalid="ignore")
    def residuals(
        self, scene: Scene, varied: Sequence[Varied], delay: float, x0: Floats
    ) -> tuple[Floats, Floats, Floats] | None:
        """Predictions minus samples (r,), and derivatives in start (r, 2n) and in parameters and delay (r, P + 1)."""
        u, by_delay = (part[self.begin : self.end] for part in self.run.controls(delay))
        motion = self.motion(scene, u, x0)
        if motion is None:
            return None
        integrator, n = self.run.fit.integrator, scene.robot.dof
        try:
            linear = linearize_steps(scene, motion, integrator, motion.q[0])
            D = integrator.in_parameters(scene, motion, varied) if varied else np.zeros((motion.steps, 2 * n, 0))
        except LinearizationError:
            return None
        by = motion_map(scene, motion, varied, (linear.A, linear.B, D), variational=integrator.variational)
        none, late = np.zeros((len(D), 2 * n, 2 * n)), linear.B @ by_delay[:, :, None]
        begin = np.concatenate([by.by_q0, by.by_v0, by.by_theta, np.zeros((2 * n, 1))], axis=1)
        x = by.forward(begin, np.concatenate([none, D, late], axis=2))
        in_v = by.in_velocities(x)[:, n:]
        if by.variational:
            in_v[:, :, 2 * n : -1] += by.shift
        J, r = self._weighed(x[:, :n], in_v), self._weighed(motion.q, motion.v) - self.measured
        # Those of motions that fly apart overflow, and so do their squares.
        return (r, J[:, : 2 * n], J[:, 2 * n :]) if np.isfinite(np.vdot(J, J) + r @ r) else None

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
            for _ in range(_SHORTENED):
                trial = self.residuals(scene, (), late, x0 - step)
                if trial is not None and trial[0] @ trial[0] < r @ r:
                    break
                step = 0.25 * step
            else:
                break
            assert trial is not None
            x0, found = x0 - step, trial
        found = self.residuals(scene, varied, late, x0)
        if found is None:
            return np.full(self.measured.size, _LOST), np.zeros((self.measured.size, len(varied) + 1))
        r, Jx, J = found
        self.run.starts[self.begin] = x0
        along, _ = np.linalg.qr(Jx)
        return r - along @ (along.T @ r), J - along @ (along.T @ J)


def _simulations(fit: _Fit, stretches: Sequence[_Stretch], y: Floats) -> tuple[Floats, Floats]:
    """Residuals of all stretches and their derivatives in y, (I1)."""
    values, slopes = fit.values(y)
    scene = fit.of.scene_with(values)
    varied, late = fit.changed(scene, values), fit.late(y)
    before = [dict(each.run.starts) for each in stretches]
    rows = [each.fitted(scene, varied, late) for each in stretches]
    r, J = (np.concatenate(part) for part in zip(*rows, strict=True))
    if float(r @ r) > fit.least:
        # The next values are nearer to those before.
        for each, starts in zip(stretches, before, strict=True):
            each.run.starts = starts
    return r, _in_coordinates(fit, J, slopes)


def _in_coordinates(fit: _Fit, J: Floats, slopes: Floats) -> Floats:
    """Derivatives in y from those in the values and the delay (r, P + 1)."""
    found: Floats = J[:, :-1] @ slopes
    if fit.delay is None:
        found[:, -1] = J[:, -1]
    return found


def _predictions(fit: _Fit, runs: Sequence[_Run], y: Floats) -> tuple[Floats, Floats]:
    """Innovations of all logs in units of their deviations, and derivatives in y; gains are taken as constant."""
    values, slopes = fit.values(y)
    scene = fit.of.scene_with(values)
    varied, late = fit.changed(scene, values), fit.late(y)
    found = [_innovations(fit, run, scene, varied, late) for run in runs]
    r, J = (np.concatenate(part) for part in zip(*found, strict=True))
    return r, _in_coordinates(fit, J, slopes)


def _innovations(fit: _Fit, run: _Run, scene: Scene, varied: Sequence[Varied], late: float) -> tuple[Floats, Floats]:
    """As :func:`_predictions` for one log, in values and delay: one step from node to node of its grid."""
    log = run.log
    if not np.array_equal(run.node + run.share, np.arange(len(log.t))):
        raise InputError("under noise the samples of a log must be evenly spaced by dt: leave dt out, or resample it")
    u, by_delay = run.controls(late)
    log = replace(log, u=np.concatenate([u, u[-1:]]))
    try:
        seen = kalman_filter(scene, log, q_noise=fit.q_noise, v_noise=fit.v_noise, dt=2.0 * fit.dt,
                             integrator=fit.integrator)  # fmt: skip
    except LinearizationError:
        known = sum(part.measured.size for part in run.stretches())
        return np.full(known, _LOST), np.zeros((known, len(varied) + 1))
    n, q, v = scene.robot.dof, seen.q, seen.v
    motion = _through(scene, fit, seen.forward.state, q, v, u)
    D = fit.integrator.in_parameters(scene, motion, varied)
    B = linearize_steps(scene, motion, fit.integrator, q[0]).B
    more = np.concatenate([D, B @ by_delay[:, :, None]], axis=2)
    x = np.zeros((2 * n, more.shape[2]))
    rows: list[Floats] = []
    for k, (H, gain) in enumerate(zip(seen.forward.rows, seen.gains, strict=True)):
        if k:
            x = seen.forward.transition[k - 1] @ x + more[k - 1]
        rows.append(-H @ x)
        x = x + gain @ rows[-1]
    there = np.isfinite(seen.innovations)
    white = [np.linalg.cholesky(S[np.ix_(own, own)]) for S, own in zip(seen.S, there, strict=True)]
    parts = zip(white, seen.innovations, rows, there, strict=True)
    whitened = [np.linalg.solve(L, np.column_stack([e[own], J[own]])) for L, e, J, own in parts]
    both = np.concatenate(whitened)
    return both[:, 0], both[:, 1:]


def _through(scene: Scene, fit: _Fit, state: Floats, q: Floats, v: Floats, u: Floats) -> Trajectory:
    """Steps of the filter, from each state to about the next, as a motion."""
    first = rollout(scene.changed(), fit.integrator, q[0], v[0], open_loop(u[:1]), fit.dt)[0]
    N, statistics = len(u), first.statistics
    p = np.ascontiguousarray(state[:, scene.robot.dof : 2 * scene.robot.dof])
    whole = {
        name: np.zeros((N, *getattr(statistics, name).shape[1:]), getattr(statistics, name).dtype)
        for name in ("newton_iterations", "jets", "sweeps", "residual", "branch_margin", "energy_defect")
    }
    return first.changed(
        t=fit.dt * np.arange(N + 1.0),
        q=q, v=v, p=p, u=u, dw=np.zeros((N, scene.processes)),
        u_stages=np.zeros((N, 0, u.shape[1])), u_nodes=np.zeros((N + 1, 0)),
        statistics=replace(statistics, substeps=np.ones(N, np.int64), halvings=statistics.halvings[:0], **whole),
    )  # fmt: skip


def _made(fit: _Fit, y: Floats, runs: Sequence[_Run], apart: Sequence[_Run], status: str) -> Identification:
    values, slopes = fit.values(y)
    scene, late, P = fit.of.scene_with(values), fit.late(y), len(fit.of.names)
    covariance, null = _covariance(fit, slopes, fit.prior)
    predicted, before = [], []
    for run in [*runs, *apart]:
        stretches = run.settled(scene, late)
        predicted.append(_positions(run, stretches, scene, late))
        before.append(_positions(run, stretches, fit.of.scene, 0.0 if fit.delay is None else fit.delay))
    residuals = tuple(run.log.q - own for run, own in zip([*runs, *apart], predicted, strict=True))
    deviation = float(np.sqrt(covariance[P, P])) if fit.delay is None else 0.0
    known, of = len(runs), fit.of
    motions: dict[str, Any] = {"predicted": predicted[:known], "predicted_before": before[:known]}
    motions |= {"residuals": residuals[:known], "held_out": residuals[known:], "logs": [run.log for run in runs]}
    made = Identification(
        names=of.names, values=values, start=of.values, units=of.units, covariance=covariance[:P, :P], delay=late,
        delay_deviation=deviation, null_space=null, scene=scene, status=status,
        **{name: tuple(each) for name, each in motions.items()},
    )  # fmt: skip
    changes = np.zeros(P) if fit.of.scene.processes else _step_error(fit, runs, y)
    found = tuple(_doubts(fit, made, changes))
    announce(logger, fit.of.scene.announced, fit.dt, found)
    return made.changed(warnings=(*found, *(each for run in runs for each in run.log.warnings)))


def _positions(run: _Run, stretches: Sequence[_Stretch], scene: Scene, late: float) -> Floats:
    """Positions at the samples (K, n) of motions from the starts of stretches; NaN where they cannot be simulated."""
    found, u = np.full(run.log.q.shape, np.nan), run.controls(late)[0]
    for each in stretches:
        motion = each.motion(scene, u[each.begin : each.end], run.starts[each.begin])
        if motion is not None:
            found[each.samples] = each.at_samples(motion.q, motion.v)[0]
    return found


def _covariance(fit: _Fit, slopes: Floats, prior: Sequence[int]) -> tuple[Floats, tuple[str, ...]]:
    """The covariance of values and delay (size, size), and what the logs do not tell in sentences."""
    J = fit.jacobian
    sizes = np.linalg.norm(J, axis=0)
    scale = np.where(sizes > _NOTHING * sizes.max(initial=1.0), sizes, 1.0)
    _, spread, rows = np.linalg.svd(J / scale, full_matrices=False)
    known = spread > _NOTHING * max(spread[0], 1.0)
    names = [*fit.of.names, *(["delay"] if fit.delay is None else [])]
    # Of bodies the null space is that of their numbers.
    to = slopes.copy() if fit.delay is not None else np.vstack([slopes, np.eye(1, fit.size, fit.size - 1)])
    null = (rows[~known] / scale) @ to.T
    joined = np.concatenate([J, np.eye(fit.size)[list(prior)]]) / scale
    _, spread, rows = np.linalg.svd(joined, full_matrices=False)
    known = spread > _NOTHING * max(spread[0], 1.0)
    root = (rows[known] / spread[known, None]) / scale
    covariance = to @ (root.T @ root) @ to.T
    lost = np.abs((rows[~known] / scale) @ to.T).max(axis=0, initial=0.0) > _NAMED / scale.max()
    covariance[lost, :] = covariance[:, lost] = 0.0
    covariance[lost, lost] = np.inf
    return covariance, tuple(_sentences(null, names))


def _sentences(null: Floats, names: Sequence[str]) -> list[str]:
    """Combinations (k, P) that nothing depends on, in words: each has a parameter that no other has."""
    found = []
    rows = null / np.abs(null).max(axis=1, keepdims=True, initial=1e-300)
    for k in range(len(rows)):
        column = int(np.argmax(np.abs(rows[k])))
        if not abs(rows[k, column]) > _NAMED:
            continue
        rows[k] /= rows[k, column]
        for other in range(len(rows)):
            if other != k:
                rows[other] -= rows[other, column] * rows[k]
    for row in rows:
        own = int(np.argmax(np.isclose(row, 1.0)))
        rest = [c for c in np.argsort(-np.abs(row)) if c != own and abs(row[c]) > _NAMED]
        if not rest:
            found.append(f"{names[own]}: the logs do not depend on it")
        elif len(rest) == 1:
            found.append(f"{names[own]} and {names[rest[0]]}: only {names[rest[0]]} {-row[rest[0]]:+.4g} {names[own]}")
        else:
            trade = ", ".join(f"{row[c]:+.4g} {names[c]}" for c in rest)
            found.append(f"{names[own]}: a change of 1 is undone by {trade}")
    return found


def _step_error(fit: _Fit, runs: Sequence[_Run], y: Floats) -> Floats:
    """What half the step changes in the values (P,), to first order."""
    finer = copy(fit)
    finer.dt *= 0.5
    prior, steps = fit.prior, []
    scene = fit.of.scene_with(fit.values(y)[0])
    for each, of in ((fit, runs), (finer, [_Run(finer, run.log) for run in runs])):
        r, J = _simulations(each, [part for run in of for part in run.settled(scene, fit.late(y))], y)
        system = np.concatenate([J, np.eye(fit.size)[prior]]), np.concatenate([r, y[prior]])
        steps.append(np.linalg.lstsq(*system, rcond=_NOTHING)[0])
    change: Floats = fit.values(y)[1] @ (steps[0] - steps[1])
    return change


def _doubts(fit: _Fit, made: Identification, changes: Floats) -> list[Finding]:
    found = []
    if fit.least >= _LOST**2:
        text = "motions with these values cannot be simulated: a column or its unit is wrong, or dt is too long"
        found.append(Finding("lost", text))
    squares = [np.square(own / fit.deviation) for own in made.residuals]
    together = np.concatenate(squares)
    there = np.isfinite(together)
    by_joint = np.sqrt(np.where(there, together, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1))
    worst = int(np.argmax(by_joint))
    over = np.sqrt(fit.least / len(fit.jacobian))
    if fit.of.scene.processes and not over <= _MISFIT:
        text = f"the innovations are {over:.3g} times what the scene's noise and q_noise explain: something else acts"
        found.append(Finding("misfit", text, value=float(over)))
    if not by_joint[worst] <= _MISFIT and not fit.of.scene.processes:
        joint = fit.of.scene.robot.joint_names[worst]
        text = (
            f"the residuals of {joint!r} are {by_joint[worst]:.3g} times q_noise: something else acts (friction, a "
            "payload, noise), or its column, clock or q_noise is wrong"
        )
        found.append(Finding("misfit", text, joint, value=float(by_joint[worst])))
    by_noise = np.divide(np.abs(changes), made.deviations, out=np.zeros_like(changes), where=made.deviations > 0.0)
    k = int(np.argmax(by_noise))
    if not by_noise[k] <= 1.0:
        higher = "" if fit.integrator.order > 2 else " or a method of higher order, such as varpin.Gauss(2)"
        text = (
            f"half the step changes {made.names[k]} by {changes[k]:.3g} {made.units[k]}, {by_noise[k]:.3g} standard "
            f"deviations: take a smaller dt{higher}"
        )
        found.append(Finding("step", text, value=float(changes[k]), unit=made.units[k]))
    if made.status == "evaluations":
        found.append(Finding("evaluations", "the search ended at its most evaluations: evaluations= allows more"))
    if fit.delay is None and abs(made.delay) > max(_SURE * made.delay_deviation, 1e-2 * fit.dt):
        text = f"the controls act {1e3 * made.delay:.3g} ms later than the logs say, which the values allow for"
        if abs(made.delay) >= _LATEST:
            text = (
                f"the delay of the controls is {_LATEST:g} s or more, beyond what is looked for: give delay= or shift t"
            )
        found.append(Finding("delay", text, value=made.delay, unit="s"))
    return found
