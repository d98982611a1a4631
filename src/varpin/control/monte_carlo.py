"""Paths of a problem under a policy and noise: their mean cost, and how they violate constraints with a margin."""

from __future__ import annotations

import copy
import functools
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from varpin.arrays import Floats, Integers
from varpin.control.constraints import BoundConstraint
from varpin.control.costs import CostSum
from varpin.control.history import percent
from varpin.control.problem import OptimalControlProblem
from varpin.control.verification import excess
from varpin.ensemble.paths import Part, Paths, Reduction, Shared, without_geometry
from varpin.finding import Finding
from varpin.mechanics.wiener import children
from varpin.signals.controls import commands_of
from varpin.signals.policy import LinearPolicy
from varpin.support.markup import Printed, warning_count, warning_lines


@dataclass(frozen=True)
class Broken:
    """How often paths violated a constraint with a margin, in the row and at the time where they did so most often.

    Attributes:
        label: The constraint.
        row: The row.
        time: The time [s].
        count: Number of paths that violated it there.
        paths: Number of paths.
        margin: The margin, in standard deviations.
    """

    label: str
    row: str
    time: float
    count: int
    paths: int
    margin: float

    @property
    def promised(self) -> float:
        """The share of paths that the margin allows: beyond it in a normal distribution."""
        return float(ndtr(-self.margin))

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
class MonteCarlo(Printed):
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

    def __str__(self) -> str:
        gap = self.cost - self.predicted
        apart = f", {gap / self.standard_error:+.1f} standard errors" if self.standard_error > 0.0 else ""
        lost = f"; {self.failures} more ran away and are not counted" if self.failures else ""
        lines = [
            "expected cost",
            f"simulated:  {self.cost:.6e} +- {self.standard_error:.1e} ({self.paths} paths{lost})",
            f"predicted:  {self.predicted:.6e}",
            f"difference: {gap:+.6e} ({percent(excess(self.cost, self.predicted))}{apart})",
            "how to read it: within three standard errors the two agree; beyond, noise is too strong for the model",
        ]
        return "\n".join([*lines, *map(str, self.broken), *warning_lines(self.warnings)])


class Found(NamedTuple):
    """What C paths have shown; the last two of each constraint with a margin."""

    costs: Floats  # (C,), NaN where one failed
    counts: tuple[Integers, ...]  # of paths that violate it, by places and rows
    largest: tuple[Floats, ...]  # its largest values, in no order, (at most keep, K, rows)

    @property
    def finished(self) -> int:
        """Number of paths with a cost."""
        return int(np.isfinite(self.costs).sum())


class PolicyPaths(Paths):
    """Paths of a problem under a policy: their costs, and the rows of constraints with a margin.

    ``predicted`` is the expected cost by the solver's model, ``within`` the part of the noise cost that no path shows;
    of the values of each row the largest ``keep`` are kept.
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        policy: LinearPolicy,
        paths: int,
        rng: np.random.Generator | int,
        *,
        predicted: float = np.nan,
        within: float = 0.0,
        keep: int = 0,
    ) -> None:
        # No path needs the robot's shapes and the cost's references.
        self.problem, scene = copy.copy(problem), without_geometry(problem.scene)
        vars(self.problem).update(scene=scene, cost=CostSum(()))
        commands = commands_of(scene, problem.integrator, policy, problem.steps, problem.dt)
        shared = Shared(scene, problem.integrator, commands, problem.dt, problem.steps, children(rng, paths))
        super().__init__(shared, *(np.broadcast_to(x, (paths, x.size)) for x in (problem.q0, problem.v0)))
        self.predicted, self.within, self.keep = predicted, within, keep
        self.parts: list[Found] = []

    def reduction(self, first: int) -> tuple[tuple[str, ...], Reduction]:  # noqa: ARG002
        names = "q", "v", "u_nodes" if self.problem.linear else "u"
        return names, functools.partial(_found, problem=self.problem, keep=self.keep)

    def take(self, part: Part) -> None:
        self.parts.append(part.found)

    @property
    def found(self) -> Found:
        """What all paths so far have shown."""
        costs, counts, largest = zip(*self.parts, strict=True)
        return Found(
            np.concatenate(costs),
            tuple(np.sum(own, axis=0) for own in zip(*counts, strict=True)),
            tuple(_largest(np.concatenate(own), self.keep) for own in zip(*largest, strict=True)),
        )

    def lost(self) -> tuple[Finding, ...]:
        """A finding about the paths that have no cost, if there are any."""
        lost = self.done - self.found.finished
        if not lost:
            return ()
        told = f"{lost} of {self.done} paths could not be finished, and are not counted; a smaller dt may help"
        return (Finding("failed paths", told),)

    def broken(self) -> tuple[Broken, ...]:
        """How often paths violated each constraint with a margin."""
        broken, found = [], self.found
        for bound, counts in zip(with_margins(self.problem), found.counts, strict=True):
            place, row = np.unravel_index(int(counts.argmax()), counts.shape)
            label, time, most = self.problem.label_of(bound.source), float(bound.times[place]), int(counts.max())
            broken.append(Broken(label, bound.rows[row], time, most, found.finished, bound.source.margin))
        return tuple(broken)

    def result(self, found: tuple[Finding, ...]) -> MonteCarlo | None:
        costs = self.found.costs
        good = costs[np.isfinite(costs)]
        if len(good) < 2:
            return None
        return MonteCarlo(
            cost=float(good.mean()) + self.within,
            # Without noise all paths are the same, and differ by rounding.
            standard_error=float(good.std(ddof=1) / np.sqrt(len(good))) if self.problem.scene.processes else 0.0,
            predicted=self.predicted,
            paths=len(good),
            failures=self.done - len(good),
            warnings=found,
            broken=self.broken(),
        )


def _found(arrays: dict[str, Floats], nodes: Integers, *, problem: OptimalControlProblem, keep: int) -> Found:  # noqa: ARG001
    """What a chunk of paths has shown."""
    q, v, u = arrays["q"], arrays["v"], arrays["u_nodes" if problem.linear else "u"]
    costs = problem.costs(q, v, u)
    good = np.isfinite(costs)
    values = [
        bound.value(q[good], v[good], u[good]) if good.any() else np.zeros((0, *bound.shape))
        for bound in with_margins(problem)
    ]
    return Found(costs, tuple((c > 0.0).sum(axis=0) for c in values), tuple(_largest(c, keep) for c in values))


def with_margins(problem: OptimalControlProblem) -> list[BoundConstraint]:
    """The constraints with a margin, which are all on the state."""
    return [bound for bound in problem.bound_constraints if bound.source.margin > 0.0]


def _largest(c: Floats, keep: int) -> Floats:
    """The largest ``keep`` of the values (C, K, rows) of each row at each place."""
    first = max(len(c) - keep, 0)
    found: Floats = np.partition(c, first, axis=0)[first:] if first < len(c) else c[:0]
    return found
