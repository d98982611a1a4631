"""Parameters of a scene from logs: simulation error, or prediction error under noise.

Equations (I1) and (I2) of docs/mathematics.md.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from scipy.linalg import qr

from varpin.arrays import Floats
from varpin.errors import InputError
from varpin.estimation.filter import misfit, variances
from varpin.estimation.fit import LATEST, LOST, Fit, Run, Stretch, predictions, simulations
from varpin.estimation.grid import Grid
from varpin.estimation.log import Log, as_log
from varpin.estimation.parameters import parameters_of
from varpin.finding import Finding, announce
from varpin.integrators import Gauss, Integrator
from varpin.mechanics.scene import Scene, refuse_constraints, require_scene
from varpin.model import joint_unit
from varpin.model.urdf_output import save_urdf
from varpin.simulation.choice import given_integrator
from varpin.support.checks import JointValues, count, finite, positive, real, tuple_of
from varpin.support.frozen import Frozen
from varpin.support.markup import warning_count, warning_lines
from varpin.support.tables import Table
from varpin.trajectory import Trajectory

# Length [s] of the stretches that are simulated, each from a start of its own, unless it is given. Open-loop motions of
# arms depart from logs by e in about 0.3 s, whatever is not modelled, and a damper needs its time to tell.
_HORIZON = 1.0
# Singular value of normalized derivatives below which a combination moves nothing: derivatives are good to 1e-9.
_NOTHING = 1e-7
# Coefficients of a combination below this share of its largest are rounding.
_NAMED = 1e-3
# Standard deviations of a delay, and residuals in units of the encoders' noise, that are told.
_SURE, _MISFIT = 4.0, 2.0
# Deviations by which the logs ask for less than a least value that are told: zeros with noise are nearly always nearer.
_PULLED = 3.0
# Doubts about a log from which no value could be right.
_NEVER = ("dead encoder", "clock of the log", "degrees")

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Identification(Frozen):
    """Parameters of a scene from logs; made by :func:`identify`.

    Attributes:
        names: Names of the parameters (P,).
        values: Their values (P,).
        start: Those of the scene that was given (P,).
        units: Their units (P,).
        covariance: Covariance of the errors of the values (P, P), for encoders of the given noise, or for residuals as
            large as they are if that is more; infinite for what the logs do not tell.
        delay: By how much the controls act later than the logs say [s].
        delay_deviation: Its standard deviation [s]; 0 for a delay that was given.
        null_space: What the logs do not tell, one sentence for each combination of parameters.
        scene: The scene with the values.
        logs: The logs, in the scene's order.
        predicted: The positions at the samples of each log (K, n) by motions with the values, each over the horizon
            from a start of its own [rad or m].
        predicted_before: The same with the scene's own values, from the same starts.
        residuals: Samples minus ``predicted`` (K, n); NaN where one is missing, or Ctrl-C came before.
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
        payloads = "".join(f", {name}" for name in self.names if name.startswith("payload"))
        warned = warning_count(self.warnings)
        return f"Identification({len(self.names)} parameters{payloads}, {len(self.logs)} logs, {self.status}{warned})"

    def __str__(self) -> str:
        return "\n".join([repr(self), *(f"\n{part}" for part in self.tables), *warning_lines(self.warnings)])

    @property
    def tables(self) -> tuple[Table, ...]:
        """Tables of the values, of the residuals of each joint, and of the search."""
        numbers = zip(self.names, self.start, self.values, self.deviations, self.units, strict=True)
        values = [
            (name, f"{old:.5g}", f"{new:.5g}", f"{sd:.2g}" if np.isfinite(sd) else "not told", unit)
            for name, old, new, sd, unit in numbers
        ]
        robot = self.scene.robot
        before = [log.q - own for log, own in zip(self.logs, self.predicted_before, strict=True)]
        kinds = {"before": before, "after": self.residuals} | ({"held out": self.held_out} if self.held_out else {})
        units = [joint_unit(robot, c) for c in range(robot.dof)]
        spread = f" +- {1e3 * self.delay_deviation:.2g}" if self.delay_deviation else ", as given"
        search = [("status", self.status), ("delay of the controls", f"{1e3 * self.delay:.4g}{spread} ms")]
        search += [("not told", sentence) for sentence in self.null_space]
        return (
            Table(robot.name, ("parameter", "before", "value", "+-", "unit"), values),
            Table(
                "rms of the residuals",
                ("joint", *kinds, "unit"),
                list(zip(robot.joint_names, *map(_rms, kinds.values()), units, strict=True)),
            ),
            Table("search", (), search),
        )

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
            integrator of high order. Under noise it is as for :func:`kalman_filter`.
        horizon: Length [s] of the stretches that are simulated, each from a start of its own; 1 s if left out, np.inf
            for whole logs. Longer ones tell more of what is slow, and depart further from a log of which the scene
            does not model everything.
        integrator: ``varpin.Gauss(2)`` if left out.
        held_out: Logs for :attr:`Identification.held_out`, of which the parameters know nothing.
        evaluations: Most evaluations of each search.
        callback: Called with the number of evaluations and the residual in units of the noise after each. Ctrl-C ends
            the search with the best values so far.

    Raises:
        InputError: A name stands for no parameter, a log does not fit the scene or tells no value (a dead encoder,
            milliseconds, degrees), the scene has constraints, or a value is out of its range.
        UnknownJoint: A name is no joint of the robot.
    """
    refuse_constraints(require_scene(scene), "identify")
    of = parameters_of(scene, parameters)
    several = (tuple_of("logs", each, Log | Trajectory, "; varpin.Log.load reads files") for each in (logs, held_out))
    matched, apart = ([as_log(each).matched(scene) for each in some] for some in several)
    if not matched:
        raise InputError("logs is empty: give one varpin.Log at least")
    for doubt in (doubt for log in (*matched, *apart) for doubt in log.warnings if doubt.kind in _NEVER):
        raise InputError(f"{doubt}; values from this log would be wrong")
    step = min(float(np.median(np.diff(log.t))) for log in matched) if dt is None else positive("dt", dt, "s")
    length = _HORIZON if horizon is None else real("horizon", horizon)
    late = None if delay is None else finite("delay", delay)
    fit = Fit(of, given_integrator(integrator) or Gauss(2), step, length, q_noise, v_noise, late, callback)
    runs, others = ([Run(fit, log) for log in some] for some in (matched, apart))
    y, status, evaluation = fit.begin, "converged", count("evaluations", evaluations)
    try:
        if scene.processes:
            grids = [Grid.between(log, dt) for log in matched]
            y, status = fit.search(partial(predictions, fit, grids), y, evaluation, last=True)
        else:
            for finer in range(fit.doublings(runs), -1, -1):
                stretches = [part for run in runs for part in run.stretches(2**finer)]
                y, status = fit.search(partial(simulations, fit, stretches), y, evaluation, last=not finer)
    except KeyboardInterrupt:
        y, status = fit.best, "interrupted"
    return _made(fit, y, runs, others, status)


def _rms(residuals: Sequence[Floats]) -> list[str]:
    """That of each joint where there are samples; a motion that failed has none."""
    if any(np.isnan(each).all() for each in residuals):
        return ["no motion"] * residuals[0].shape[1]
    return [f"{rms:.3g}" for rms in np.sqrt(np.nanmean(np.square(np.concatenate(residuals)), axis=0))]


def _made(fit: Fit, y: Floats, runs: Sequence[Run], apart: Sequence[Run], status: str) -> Identification:
    values, slopes = fit.values(y)
    scene, late, P = fit.of.scene_with(values), fit.late(y), len(fit.of.names)
    covariance, null = _covariance(fit, slopes)
    # Where the residuals are larger than the encoders' noise, the values are less certain by as much.
    covariance = covariance * max(1.0, fit.cost / len(fit.jacobian))
    # Ctrl-C leaves out the motions and the check of the step that are not done, and keeps the values.
    every, known, of = [*runs, *apart], len(runs), fit.of
    predicted, before = ([np.full(run.log.q.shape, np.nan) for run in every] for _ in range(2))
    changes, stretches = np.zeros(P), []
    try:
        for k, run in enumerate(every):
            stretches.append(run.settled(scene, late))
            predicted[k] = _positions(run, stretches[k], scene, late)
            before[k] = _positions(run, stretches[k], of.scene, 0.0 if fit.delay is None else fit.delay)
        if status != "interrupted" and not of.scene.processes:
            changes = _step_error(fit, [part for parts in stretches[:known] for part in parts], y)
    except KeyboardInterrupt:
        status = "interrupted"
    residuals = [run.log.q - own for run, own in zip(every, predicted, strict=True)]
    made = Identification(
        names=of.names,
        values=values,
        start=of.values,
        units=of.units,
        covariance=covariance[:P, :P],
        delay=late,
        delay_deviation=float(np.sqrt(covariance[P, P])) if fit.delay is None else 0.0,
        null_space=null,
        scene=scene,
        logs=tuple(run.log for run in runs),
        predicted=tuple(predicted[:known]),
        predicted_before=tuple(before[:known]),
        residuals=tuple(residuals[:known]),
        held_out=tuple(residuals[known:]),
        status=status,
    )
    found = tuple(_doubts(fit, made, changes))
    announce(logger, of.scene.announced, fit.dt, found)
    return made.changed(warnings=(*(each for run in runs for each in run.log.warnings), *found))


def _positions(run: Run, stretches: Sequence[Stretch], scene: Scene, late: float) -> Floats:
    """Positions at the samples (K, n) of motions from the starts of stretches; NaN where they cannot be simulated."""
    found = np.full(run.log.q.shape, np.nan)
    for each in stretches:
        u, _ = run.grid.controls(late, each.begin, each.end)
        motion = each.motion(scene, u, run.starts[each.begin])
        if motion is not None:
            found[each.samples] = each.at_samples(motion.q, motion.v)[0]
    return found


def _covariance(fit: Fit, slopes: Floats) -> tuple[Floats, tuple[str, ...]]:
    """The covariance of values and delay (size, size), and what the logs do not tell in sentences."""
    # As many rows as columns, so that all that few samples leave open is in the null space.
    J = np.pad(fit.jacobian, ((0, max(0, fit.size - len(fit.jacobian))), (0, 0)))
    sizes = np.linalg.norm(J, axis=0)
    scale = np.where(sizes > _NOTHING * sizes.max(initial=1.0), sizes, 1.0)
    names = [*fit.of.names, *(["delay"] if fit.delay is None else [])]

    def split(J: Floats) -> tuple[Floats, Floats]:
        """A root of the inverse of J' J where J tells of y, and what it does not tell, in parameters."""
        _, spread, rows = np.linalg.svd(J / scale, full_matrices=False)
        known = spread > _NOTHING * max(spread[0], 1.0)
        return rows[known] / spread[known, None] / scale, (rows[~known] / scale) @ slopes.T

    _, null = split(J)
    root, left = split(fit.with_prior(np.zeros(len(J)), J, fit.best)[1])
    covariance = slopes @ (root.T @ root) @ slopes.T
    lost = np.abs(left).max(axis=0, initial=0.0) > _NAMED / scale.max()
    covariance[lost, :] = covariance[:, lost] = 0.0
    covariance[lost, lost] = np.inf
    return covariance, tuple(_sentences(null, names) if fit.done else ())


def _sentences(null: Floats, names: Sequence[str]) -> list[str]:
    """Combinations (k, P) that nothing depends on, in words: each has a parameter that no other has."""
    found: list[str] = []
    rows = null / np.abs(null).max(axis=1, keepdims=True, initial=0.0)
    if not len(rows):
        return found
    own = qr(rows, mode="r", pivoting=True)[1][: len(rows)]
    for k, row in zip(own, np.linalg.solve(rows[:, own], rows), strict=True):
        rest = [c for c in np.argsort(-np.abs(row)) if c not in own and abs(row[c]) > _NAMED]
        if not rest:
            found.append(f"{names[k]}: the logs do not depend on it")
        elif len(rest) == 1:
            found.append(f"{names[k]} and {names[rest[0]]}: only {names[rest[0]]} {-row[rest[0]]:+.4g} {names[k]}")
        else:
            trade = ", ".join(f"{row[c]:+.4g} {names[c]}" for c in rest)
            found.append(f"{names[k]}: a change of 1 is undone by {trade}")
    return found


def _step_error(fit: Fit, parts: Sequence[Stretch], y: Floats) -> Floats:
    """What half the step changes in the values (P,), to first order."""
    finer, steps = copy(fit), []
    finer.dt *= 0.5
    runs = {part.run for part in parts}
    halved = {run: Run(finer, run.log, {2 * at: start for at, start in run.starts.items()}) for run in runs}
    again = [Stretch(halved[part.run], 2 * part.begin, 2 * part.end) for part in parts]
    for each, stretches in ((fit, parts), (finer, again)):
        both, slopes = fit.with_prior(*simulations(each, stretches, y), y)
        steps.append(np.linalg.lstsq(slopes, both, rcond=_NOTHING)[0])
    change: Floats = fit.values(y)[1] @ (steps[0] - steps[1])
    return change[: len(fit.of.names)]


def _doubts(fit: Fit, made: Identification, changes: Floats) -> Iterator[Finding]:
    """What is doubtful about the values, the worst first; ``changes`` (P,) are those by half the step."""
    misfits = list(_misfit(fit, made))
    if fit.cost >= LOST**2:
        text = "motions with these values cannot be simulated: a column or its unit is wrong, or dt is too long"
        misfits = [Finding("lost", text)]
    yield from misfits
    by_noise = np.divide(np.abs(changes), made.deviations, out=np.zeros_like(changes), where=made.deviations > 0.0)
    k = int(np.argmax(by_noise))
    if not by_noise[k] <= 1.0:
        higher = "" if fit.integrator.order > 2 else " or a method of higher order, such as varpin.Gauss(2)"
        text = (
            f"half the step changes {made.names[k]} by {changes[k]:.3g} {made.units[k]}, {by_noise[k]:.3g} standard "
            f"deviations: take a smaller dt{higher}"
        )
        yield Finding("step", text, value=float(changes[k]), unit=made.units[k])
    if made.status == "evaluations":
        yield Finding("evaluations", "the search ended at its most evaluations: evaluations= allows more")
    if ended := _ended(fit):
        text = f"{', '.join(ended)} ended at the least value, and the logs ask for less: something else acts"
        yield Finding("bound", text)
    if fit.delay is None and abs(made.delay) > max(_SURE * made.delay_deviation, 1e-2 * fit.dt):
        text = f"the controls act {1e3 * made.delay:.3g} ms later than the logs say, which the values allow for"
        if misfits:
            text = f"a delay of {1e3 * made.delay:.3g} ms fits best, or stands for what the scene lacks"
        if abs(made.delay) >= LATEST:
            text = (
                f"the delay of the controls is {LATEST:g} s or more, beyond what is looked for: give delay= or shift t"
            )
        yield Finding("delay", text, value=made.delay, unit="s")


def _misfit(fit: Fit, made: Identification) -> Iterator[Finding]:
    """Residuals, or innovations under noise, that are larger than their noise."""
    if fit.of.scene.processes:
        yield from misfit(fit.cost, len(fit.jacobian))
        return
    squares = np.square(np.concatenate(made.residuals)) / variances("q_noise", fit.q_noise, fit.noise[0])
    there = np.isfinite(squares)
    by_joint = np.sqrt(np.where(there, squares, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1))
    worst = int(np.argmax(by_joint))
    over, joint = float(by_joint[worst]), fit.of.scene.robot.joint_names[worst]
    whose = f" of {joint!r}"
    if not there.any():
        # Ctrl-C came before the motions over the horizon: those of the search tell.
        over, whose = float(np.sqrt(fit.cost / len(fit.jacobian))), ""
    if not over <= _MISFIT:
        text = (
            f"the residuals{whose} are {over:.3g} times q_noise: something acts that is no parameter (friction, a "
            "payload elsewhere), or its column, clock or q_noise is wrong"
        )
        yield Finding("misfit", text, joint if whose else None, value=over)


def _ended(fit: Fit) -> list[str]:
    """Parameters at their least values which the logs hold there, by more than noise would."""
    sizes = np.maximum(np.linalg.norm(fit.jacobian, axis=0), np.finfo(float).tiny)
    # By how many of its deviations each would be less if it were alone.
    less = fit.rest @ fit.jacobian / sizes / max(1.0, np.sqrt(fit.cost / len(fit.jacobian)))
    held = (fit.best <= fit.bounds[0]) & (less > _PULLED)
    return [name for name, told in zip(fit.of.names, held, strict=False) if told]
