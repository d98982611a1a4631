"""Paths of a problem under a policy and noise: their mean cost, and how they violate constraints with a margin."""

from __future__ import annotations

import contextlib
import copy
import logging
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np
from scipy.special import ndtr

from varpin.arrays import Floats, Integers
from varpin.control.constraints import BoundConstraint
from varpin.control.costs import CostSum
from varpin.control.problem import OptimalControlProblem
from varpin.control.verification import excess, percent
from varpin.ensemble.paths import Extremes, Shared, Task, chunks, simulate_paths, without_geometry
from varpin.ensemble.statistics import findings_of_paths, greater
from varpin.errors import VarpinError
from varpin.finding import Finding, announce
from varpin.mechanics.wiener import Children, children
from varpin.signals.controls import commands_of
from varpin.signals.policy import LinearPolicy
from varpin.simulation.check import check
from varpin.simulation.failures import NoiseError, StepFailure
from varpin.simulation.loop import Gains, unstable_loop
from varpin.support.checks import count, told_motion
from varpin.support.executors import executing, in_order, take_all
from varpin.support.frozen import Frozen
from varpin.support.markup import facts, warning_count
from varpin.trajectory import Trajectory

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
class Paths(Frozen):
    """The paths first, ..., last - 1 of a problem under a policy."""

    problem: OptimalControlProblem
    policy: LinearPolicy
    seeds: Children  # one child of the random generator for each path
    shared: Shared | None  # what the core needs; None where only Python evaluates the noise
    first: int
    last: int
    keep: int = 0  # of the largest values of each row of a constraint with a margin

    @classmethod
    def of(
        cls, problem: OptimalControlProblem, policy: LinearPolicy, seeds: Children, paths: int, keep: int = 0
    ) -> Paths:
        """All paths, of the problem without the robot's shapes and the cost's references, which no path needs."""
        bare, shared = copy.copy(problem), None
        vars(bare).update(scene=without_geometry(problem.scene), cost=CostSum(()))
        if problem.scene.noise.diffusion is not None:
            commands = commands_of(bare.scene, problem.integrator, policy, problem.steps, problem.dt)
            shared = Shared(bare.scene, problem.integrator, commands, problem.dt, problem.steps, seeds)
        return cls(bare, policy, seeds, shared, 0, paths, keep)

    def chunks(self) -> Iterator[Paths]:
        """The paths in parts: as the core integrates them, or one by one."""
        parts = ((k, k + 1) for k in range(self.last)) if self.shared is None else chunks(self.shared.steps, self.last)
        return (self.changed(first=first, last=last) for first, last in parts)


@dataclass(frozen=True, eq=False)
class Found(Frozen):
    """What C paths have shown; the last two of each constraint with a margin."""

    costs: Floats  # (C,), NaN where one failed
    extremes: Extremes  # the extreme paths, to check
    counts: tuple[Integers, ...]  # of paths that violate it, by places and rows
    largest: tuple[Floats, ...]  # its largest values, in no order, (at most keep, K, rows)


def simulated(paths: Paths) -> Found:
    """Simulate a chunk of paths."""
    problem, extremes = paths.problem, Extremes()
    if paths.shared is not None:
        q0, v0 = (np.tile(x, (paths.last - paths.first, 1)) for x in (problem.q0, problem.v0))
        names = "q", "v", "u_nodes" if problem.linear else "u"
        part = simulate_paths(Task(paths.shared, paths.first, q0, v0, names, moments=False))
        extremes, (q, v, u) = part.extremes, (part.stored[name] for name in names)
    else:
        q = v = np.full((1, problem.steps + 1, problem.scene.robot.dof), np.nan)
        u = np.full((1, problem.steps + problem.linear, problem.scene.controls), np.nan)
        with contextlib.suppress(StepFailure, NoiseError):
            motion = path_of(paths)
            q, v, u = motion.q[None], motion.v[None], problem.control_rows(motion)[None]
    costs = problem.costs(q, v, u)
    finished = np.isfinite(costs)
    values = [
        bound.value(q[finished], v[finished], u[finished]) if finished.any() else np.zeros((0, *bound.shape))
        for bound in with_margins(problem)
    ]
    counts = tuple((c > 0.0).sum(axis=0) for c in values)
    return Found(costs, extremes, counts, tuple(_largest(c, paths.keep) for c in values))


def path_of(paths: Paths) -> Trajectory:
    """The first of the paths, whose noise Python evaluates."""
    (child,) = paths.seeds.generators(paths.first, paths.first + 1)
    return paths.problem.simulate(paths.policy, rng=child)


def found_by(paths: Paths, pool: Executor, *, serial: bool = True) -> Generator[Found, None, None]:
    """What each chunk of paths shows, in their order; ``serial`` where only Python evaluates the noise."""
    if paths.shared is None and serial:
        # Custom functions need not be thread-safe.
        return (simulated(one) for one in paths.chunks())
    return in_order(pool, simulated, paths.chunks())


def joined(parts: Sequence[Found], keep: int) -> Found:
    """What all paths have shown."""
    counts = tuple(np.sum(own, axis=0) for own in zip(*(part.counts for part in parts), strict=True))
    largest = zip(*(part.largest for part in parts), strict=True)
    return Found(
        costs=np.concatenate([part.costs for part in parts]),
        extremes=reduce(greater, (part.extremes for part in parts)),
        counts=counts,
        largest=tuple(_largest(np.concatenate(own), keep) for own in largest),
    )


def with_margins(problem: OptimalControlProblem) -> list[BoundConstraint]:
    """The constraints with a margin, which are all on the state."""
    return [bound for bound in problem.bound_constraints if bound.source.margin > 0.0]


def _largest(c: Floats, keep: int) -> Floats:
    """The largest ``keep`` of the values (C, K, rows) of each row at each place."""
    first = max(len(c) - keep, 0)
    found: Floats = np.partition(c, first, axis=0)[first:] if first < len(c) else c[:0]
    return found


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
    every, parts = Paths.of(problem, policy, children(rng, paths), paths), list[Found]()

    def tell() -> None:
        if progress is not None:
            progress(sum(len(part.costs) for part in parts), paths)

    with executing(executor, workers) as pool:
        result = None
        try:
            with contextlib.closing(found_by(every, pool, serial=executor is None)) as results:
                take_all(results, parts.append, tell)
            result = _mean(parts, predicted, within, problem)
            result = None if result is None else _with_findings(result, every, parts, pool)
        except KeyboardInterrupt:
            result = _mean(parts, predicted, within, problem)
            # A second Ctrl-C skips the check.
            with contextlib.suppress(KeyboardInterrupt):
                result = None if result is None else _with_findings(result, every, parts, None)
            raise MonteCarloInterrupted(result) from None
    if result is None:
        raise VarpinError(f"fewer than two of {paths} paths got to the end; a smaller dt may help")
    announce(logger, problem.scene.announced, problem.dt, result.warnings)
    return result


def _with_findings(result: MonteCarlo, every: Paths, parts: Sequence[Found], pool: Executor | None) -> MonteCarlo:
    """The result of some paths with findings about them."""
    found: tuple[Finding, ...] = ()
    if every.shared is not None:
        q0, v0 = (np.tile(x, (every.last, 1)) for x in (every.problem.q0, every.problem.v0))
        found = findings_of_paths(every.shared, q0, v0, joined(parts, 0).extremes, pool)
    elif np.isfinite(parts[0].costs).all():
        # The first path, whose noise Python evaluates.
        motion, scene, policy, integrator = path_of(every), every.problem.scene, every.policy, every.problem.integrator
        # The loop's check is for held controls.
        gains = Gains(policy.feedback, integrator.variational)
        loop = () if every.problem.linear else unstable_loop(scene, motion, policy.hold_at(every.problem.dt), gains)
        own = (*loop, *check(scene, integrator, motion, policy).warnings)
        found = tuple(finding.about("path 0: ") for finding in own)
    return replace(result, warnings=(*_lost(result), *found))


def _lost(result: MonteCarlo) -> tuple[Finding, ...]:
    """A finding about failed paths, if there are any."""
    if not result.failures:
        return ()
    lost = f"{result.failures} of {result.paths + result.failures} paths could not be finished, and are not counted"
    return (Finding("failed paths", f"{lost}; a smaller dt may help"),)


def _mean(parts: Sequence[Found], predicted: float, within: float, problem: OptimalControlProblem) -> MonteCarlo | None:
    """The result of the paths so far; None if fewer than two are finished."""
    if sum(int(np.isfinite(part.costs).sum()) for part in parts) < 2:
        return None
    found = joined(parts, 0)
    good = found.costs[np.isfinite(found.costs)]
    broken = []
    for bound, counts in zip(with_margins(problem), found.counts, strict=True):
        place, row = np.unravel_index(int(counts.argmax()), counts.shape)
        where = bound.rows[row], float(bound.times[place])
        often, promised = int(counts.max()), float(ndtr(-bound.source.margin))
        broken.append(Broken(problem.label_of(bound.source), *where, often, len(good), promised))
    return MonteCarlo(
        cost=float(good.mean()) + within,
        # Without noise all paths are the same, and differ by rounding.
        standard_error=float(good.std(ddof=1) / np.sqrt(len(good))) if problem.scene.processes else 0.0,
        predicted=predicted,
        paths=len(good),
        failures=len(found.costs) - len(good),
        broken=tuple(broken),
    )
