"""Motions at extremes, their exact motions, and runs of them with integrators."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from varpin.arrays import Floats
from varpin.integrators import Integrator
from varpin.mechanics.scene import Scene
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
from varpin.study.extremes import INTEGRATORS, Cell, Motion, Record, cell
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
    units = travel_scales(scene, trajectory.q), speed_scales(scene, trajectory.v)
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
