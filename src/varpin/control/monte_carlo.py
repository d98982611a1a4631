"""The expected cost of a policy, by simulation."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Executor
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from varpin.arrays import Floats, Integers
from varpin.control.constraints import BoundConstraint
from varpin.control.paths import Chunk, chunks_of, sent, shared_by
from varpin.control.problem import OptimalControlProblem
from varpin.control.verification import excess, percent
from varpin.ensemble.looks import greater, looked_at, looked_at_here
from varpin.ensemble.paths import Extremes, simulate_paths
from varpin.errors import VarpinError
from varpin.finding import Finding, announce
from varpin.mechanics.wiener import Children, children
from varpin.signals.policy import LinearPolicy
from varpin.simulation.check import check
from varpin.simulation.failures import NoiseError, StepFailure
from varpin.simulation.loop import unstable_loop
from varpin.support.checks import count, told_motion
from varpin.support.executors import executing, in_order, take_all
from varpin.support.frozen import Frozen
from varpin.support.markup import facts, warning_count

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Broken:
    """How often paths violated a constraint with a margin, in the row and at the time where they did so most often.

    Attributes:
        label: The constraint.
        row: The row.
        time: The time [s].
        count: Number of paths that violated it there.
        paths: Number of paths.
        promised: The share of paths that the margin allows: beyond it in a normal distribution.
    """

    label: str
    row: str
    time: float
    count: int
    paths: int
    promised: float

    @property
    def share(self) -> float:
        """Share of the paths."""
        return self.count / self.paths

    @property
    def standard_error(self) -> float:
        """Standard error of the share; of one path where none or all violated it."""
        p = min(max(self.share, 1.0 / self.paths), 1.0 - 1.0 / self.paths)
        return float(np.sqrt(p * (1.0 - p) / self.paths))

    def __str__(self) -> str:
        where = f" ({self.row} at t = {self.time:.4g} s)" if self.count else ""
        return (
            f"{self.label} is violated by {100.0 * self.share:.3g} +- {100.0 * self.standard_error:.1g} % of all paths"
            f"{where}, {self.count} of {self.paths}; its margin allows {100.0 * self.promised:.2g} %"
        )


@dataclass(frozen=True)
class MonteCarlo:
    """The expected cost of a policy, by simulation.

    Attributes:
        cost: Mean over the paths.
        standard_error: Standard error of the mean.
        predicted: Expected cost by the solver's model.
        paths: Number of paths in the mean.
        failures: Number of paths that failed; they are not in the mean.
        warnings: Warnings about the paths, one sentence each, as those of an :class:`Ensemble`.
        broken: How often paths violated each constraint with a ``margin=``.
    """

    cost: float
    standard_error: float
    predicted: float
    paths: int
    failures: int
    warnings: tuple[Finding, ...] = field(default=(), repr=False)
    broken: tuple[Broken, ...] = ()

    def __repr__(self) -> str:
        gap = f"MonteCarlo(cost {self.cost:.6g} +- {self.standard_error:.1e}, predicted {self.predicted:.6g}"
        lost = f", {self.failures} failed" if self.failures else ""
        return f"{gap}, {self.paths} paths{lost}{warning_count(self.warnings)})"

    def _repr_html_(self) -> str:
        rows: list[tuple[str, object]] = [
            ("simulated", f"{self.cost:.6e} +- {self.standard_error:.1e}"),
            ("predicted", f"{self.predicted:.6e}"),
            ("paths", self.paths),
            ("ran away", self.failures),
        ]
        rows += [("constraint", each) for each in self.broken]
        return facts("Expected cost", rows + [("warning", warning) for warning in self.warnings])

    def __str__(self) -> str:
        gap = self.cost - self.predicted
        apart = f", {gap / self.standard_error:+.1f} standard errors" if self.standard_error > 0.0 else ""
        lost = f"; {self.failures} more ran away and are not counted" if self.failures else ""
        return "\n".join(
            [
                f"{'':16}{'expected cost':>14}",
                f"{'simulated':16}{self.cost:14.6e} +- {self.standard_error:.1e} ({self.paths} paths{lost})",
                f"{'predicted':16}{self.predicted:14.6e}",
                f"{'difference':16}{gap:+14.6e} ({percent(excess(self.cost, self.predicted))}{apart})",
                "how to read it: within three standard errors (+-) the two agree; beyond, noise is too strong for the "
                "model",
                *map(str, self.broken),
                *(f"warning: {warning}" for warning in self.warnings),
            ]
        )


class MonteCarloInterrupted(KeyboardInterrupt):
    """Ctrl-C during :meth:`Solution.monte_carlo`.

    Attributes:
        result: The result of the paths done; None if there are fewer than two.
    """

    def __init__(self, result: MonteCarlo | None) -> None:
        self.result = result
        done = 0 if result is None else result.paths + result.failures
        super().__init__(f"interrupted after {done} paths" + ("; they are in .result" if done else ""))


@dataclass(frozen=True, eq=False)
class _Costs(Frozen):
    """Results of a chunk.

    Attributes:
        values: The costs of its paths (C,), NaN where one failed.
        extremes: The extreme paths to check.
        broken: Number of paths that violate each constraint with a margin, by its places and rows.
    """

    values: Floats
    extremes: Extremes
    broken: tuple[Integers, ...] = ()


@dataclass(frozen=True, eq=False)
class _Alone(Frozen):
    """A path of a problem with noise that only Python evaluates."""

    problem: OptimalControlProblem
    policy: LinearPolicy
    seeds: Children
    path: int


def monte_carlo(
    problem: OptimalControlProblem,
    policy: LinearPolicy,
    predicted: float,
    paths: int,
    rng: np.random.Generator | int,
    *,
    within: float,
    workers: int | None,
    executor: Executor | None,
    progress: Callable[[int, int], None] | None,
) -> MonteCarlo:
    """See :meth:`Solution.monte_carlo`; for any policy. ``within`` is what no path shows of the noise within steps."""
    paths = count("paths", paths, least=2)
    told_motion("progress", progress, "paths done, paths in all")
    costs: list[Floats] = []
    found: tuple[Finding, ...] = ()
    extremes: Extremes = {}
    done, bare = 0, sent(problem)
    broken = [np.zeros(bound.shape, dtype=np.int64) for bound in _with_margins(problem)]

    def add(part: _Costs) -> None:
        nonlocal extremes, done
        for total, counted in zip(broken, part.broken, strict=True):
            np.add(total, counted, out=total)
        costs.append(part.values)
        extremes = greater(extremes, part.extremes)
        done += len(part.values)

    with executing(executor, workers) as pool:
        seeds = children(rng, paths)
        q0, v0 = (np.broadcast_to(x, (paths, x.size)) for x in (bare.q0, bare.v0))
        shared = shared_by(bare, policy, seeds)
        try:
            parts: Generator[_Costs, None, None]
            if shared is not None:
                parts = in_order(pool, _together, chunks_of(bare, shared, 0, paths))
            elif executor is not None:
                parts = in_order(pool, _alone, (_Alone(bare, policy, seeds, path) for path in range(paths)))
            else:
                # Custom functions need not be thread-safe.
                parts = (_alone(_Alone(bare, policy, seeds, path)) for path in range(paths))
            with closing(parts):
                take_all(parts, add, lambda: progress(done, paths) if progress is not None else None)
            if shared is not None:
                found = looked_at(pool, shared, q0, v0, extremes)
            elif np.isfinite(costs[0]).all():
                found = _look_alone(_Alone(bare, policy, seeds, 0))
        except KeyboardInterrupt:
            so_far = _mean(costs, predicted, within, problem, broken)
            if so_far is None:
                raise MonteCarloInterrupted(None) from None
            if shared is not None:
                found = looked_at_here(shared, q0[:done], v0[:done], extremes)
            elif np.isfinite(costs[0]).all():
                # A second Ctrl-C skips the check.
                with suppress(KeyboardInterrupt):
                    found = _look_alone(_Alone(bare, policy, seeds, 0))
            raise MonteCarloInterrupted(_warned(so_far, (*_lost(so_far), *found))) from None
    result = _mean(costs, predicted, within, problem, broken)
    if result is None:
        raise VarpinError(f"fewer than two of {paths} paths got to the end; a smaller dt may help")
    found = (*_lost(result), *found)
    announce(logger, problem.scene.announced, problem.dt, found)
    return _warned(result, found)


def _together(chunk: Chunk) -> _Costs:
    part = simulate_paths(chunk.task)
    stored = part.stored
    u = stored["u_nodes" if chunk.problem.linear else "u"]
    values = chunk.problem.costs(stored["q"], stored["v"], u)
    return _Costs(values, part.extremes, _broken(chunk.problem, stored["q"], stored["v"], np.isfinite(values)))


def _alone(given: _Alone) -> _Costs:
    (child,) = given.seeds.generators(given.path, given.path + 1)
    try:
        motion = given.problem.simulate(given.policy, rng=child)
    except (StepFailure, NoiseError):
        nothing = np.zeros((0, *given.problem.q0.shape))
        return _Costs(np.full(1, np.nan), {}, _broken(given.problem, nothing, nothing, np.zeros(0, dtype=bool)))
    value = np.array([given.problem.cost_of(motion)])
    return _Costs(value, {}, _broken(given.problem, motion.q[None], motion.v[None], np.isfinite(value)))


def _with_margins(problem: OptimalControlProblem) -> list[BoundConstraint]:
    """The constraints with a margin, which are all on the state."""
    return [bound for bound in problem.bound_constraints if bound.source.margin > 0.0]


def _broken(problem: OptimalControlProblem, q: Floats, v: Floats, finished: NDArray[np.bool_]) -> tuple[Integers, ...]:
    """Number of finished paths (C, N + 1, n) that violate each constraint with a margin, by place and row."""
    no_controls, found = np.zeros((problem.decisions, problem.scene.controls)), []
    for bound in _with_margins(problem):
        count = np.zeros(bound.shape, dtype=np.int64)
        for path in np.flatnonzero(finished):
            count += bound.value(q[path], v[path], no_controls) > 0.0
        found.append(count)
    return tuple(found)


def _reports(problem: OptimalControlProblem, broken: Sequence[Integers], paths: int) -> tuple[Broken, ...]:
    found = []
    for bound, counts in zip(_with_margins(problem), broken, strict=True):
        place, row = np.unravel_index(int(counts.argmax()), counts.shape)
        where = bound.rows[row], float(bound.times[place])
        found.append(
            Broken(problem.label_of(bound.source), *where, int(counts.max()), paths, float(ndtr(-bound.source.margin)))
        )
    return tuple(found)


def _look_alone(given: _Alone) -> tuple[Finding, ...]:
    """Findings about the first path."""
    (child,) = given.seeds.generators(given.path, given.path + 1)
    motion = given.problem.simulate(given.policy, rng=child)
    # The loop's check is for held controls.
    hold = None if given.problem.linear else given.policy.hold_at(given.problem.dt)
    scene, policy = given.problem.scene, given.policy
    loop = () if hold is None else unstable_loop(scene, motion, hold)
    found = (*loop, *check(scene, given.problem.integrator, motion, policy).warnings)
    return tuple(finding.about(f"path {given.path}: ") for finding in found)


def _lost(result: MonteCarlo) -> tuple[Finding, ...]:
    """A finding about failed paths, if there are any."""
    if not result.failures:
        return ()
    lost = f"{result.failures} of {result.paths + result.failures} paths could not be finished, and are not counted"
    return (Finding("failed paths", f"{lost}; a smaller dt may help"),)


def _warned(result: MonteCarlo, found: Sequence[Finding]) -> MonteCarlo:
    return replace(result, warnings=tuple(found))


def _mean(
    costs: Sequence[Floats],
    predicted: float,
    within: float,
    problem: OptimalControlProblem,
    broken: Sequence[Integers],
) -> MonteCarlo | None:
    values = np.concatenate([np.zeros(0), *costs])
    good = values[np.isfinite(values)]
    if len(good) < 2:
        return None
    return MonteCarlo(
        cost=float(good.mean()) + within,
        standard_error=float(good.std(ddof=1) / np.sqrt(len(good))),
        predicted=predicted,
        paths=len(good),
        failures=len(values) - len(good),
        broken=_reports(problem, broken, len(good)),
    )
