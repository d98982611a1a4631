"""Margins by count: how often motions under noise violate a bound, and how wide its margin has to be, (O13)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from varpin.arrays import Floats
from varpin.control.constraints import BoundConstraint
from varpin.control.history import Status
from varpin.control.monte_carlo import Paths, joined, simulated, with_margins
from varpin.control.multipliers import at_nodes, split
from varpin.control.solution import Solution
from varpin.errors import VarpinError
from varpin.finding import Finding
from varpin.mechanics.wiener import children
from varpin.support.executors import executing, in_order

# Motions that are counted, and those where only Python evaluates the noise: shares at margin 2 are then known to a
# seventh and to a third of themselves. From 1000 on the margins differ by a few percent.
_MOTIONS, _ALONE = 2048, 512
# Motions beyond a quantile that determine it: its error is then a quarter of the share at most.
_ENOUGH = 20
# Standard errors by which a share may exceed what is promised before a margin becomes wider, and before a warning,
# where the worst of many rows is chosen.
_CLEARLY, _DOUBT = 1.0, 3.0
# Seeds of these motions, which are no user's: those of a search, and those of its warnings.
_SEARCH, _WARN = (0x76A3, 0), (0x76A3, 1)


class _Counted(NamedTuple):
    """What motions under noise have shown of a constraint with a margin."""

    bound: BoundConstraint
    share: Floats  # of the motions that violate each row (K, rows)
    needed: Floats  # distances from the plan that motions exceed as often as promised (K, rows)
    promised: float  # share that the margin allows
    error: float  # standard error of such a share


def _counted(plan: Solution, seed: tuple[int, ...]) -> list[_Counted]:
    """Motions of a plan's policy under noise, counted.

    Raises:
        VarpinError: Fewer than half of the motions get to the end.
    """
    problem, motion = plan.problem, plan.trajectory
    bounds, paths = with_margins(problem), _ALONE if problem.scene.noise.diffusion is None else _MOTIONS
    keep = max(_ENOUGH, *(math.ceil(paths * ndtr(-bound.source.margin)) for bound in bounds))
    every = Paths.of(problem, plan.policy, children(np.random.default_rng(seed), paths), paths, keep)
    if every.shared is None:
        found = joined([simulated(one) for one in every.chunks()], keep)
    else:
        with executing(None, None) as pool:
            found = joined(list(in_order(pool, simulated, every.chunks())), keep)
    finished = int(np.isfinite(found.costs).sum())
    if 2 * finished < paths:
        raise VarpinError(f"{paths - finished} of {paths} motions under noise fail")
    rows = []
    for bound, counts, largest in zip(bounds, found.counts, found.largest, strict=True):
        promised = float(ndtr(-bound.source.margin))
        error = math.sqrt(promised * (1.0 - promised) / finished)
        # Where too few motions are beyond, a quantile of more of them, as far as a normal distribution has it to.
        often = max(round(finished * (promised - _CLEARLY * error)), _ENOUGH)
        planned = bound.value(motion.q, motion.v, problem.control_rows(motion))
        distance = np.partition(largest, len(largest) - often, axis=0)[len(largest) - often] - planned
        needed = distance * max(1.0, bound.source.margin / -float(ndtri(often / finished)))
        rows.append(_Counted(bound, counts / finished, needed, promised, error))
    return rows


def widened(plan: Solution) -> list[Floats] | None:
    """What has to be added to margins (K, rows) for each constraint, in its unit, (O13); None if they suffice.

    Margins are of the linear model. Where noise is strong, or where it follows the controls, values in motions are not
    normally distributed, and violate bounds more often. Nothing is added where only Python evaluates the noise, as
    counting would take long.

    Raises:
        VarpinError: Motions cannot be counted: most fail.
    """
    problem, known = plan.problem, plan.multipliers
    if problem.scene.noise.diffusion is None or known is None:
        return None
    # The same noise in every count: what is left of a violation is then that of the plan, not of other noise.
    counted = {id(row.bound): row for row in _counted(plan, _SEARCH)}
    if all((row.share <= row.promised + _CLEARLY * row.error).all() for row in counted.values()):
        return None
    bounds = problem.bound_constraints
    added = [np.zeros(bound.shape) for bound in bounds] if known.added is None else split(bounds, known.added)
    margins = at_nodes(problem, known, known.backoff)
    return [
        np.maximum(counted[id(bound)].needed - margin + more, more) if id(bound) in counted else more
        for bound, margin, more in zip(bounds, margins, added, strict=True)
    ]


def too_small(solution: Solution) -> list[Finding]:
    """Findings about constraints whose margin is too small, as noise is too strong for it."""
    problem = solution.problem
    if not (problem.scene.processes and with_margins(problem)) or solution.status is Status.INFEASIBLE:
        return []
    try:
        counted = _counted(solution, _WARN)
    except VarpinError as error:
        return [Finding("margins not counted", f"how often motions violate bounds with a margin= is unknown: {error}")]
    found = []
    for row in counted:
        place, r = np.unravel_index(int(row.share.argmax()), row.share.shape)
        share, time = float(row.share[place, r]), float(row.bound.times[place])
        if share <= row.promised + _DOUBT * row.error:
            continue
        sentence = (
            f"{problem.label_of(row.bound.source)}: margin={row.bound.source.margin:g} is too small for this noise, as "
            f"{row.bound.rows[r]} at t = {time:.4g} s is violated by {100.0 * share:.3g} % of motions, not "
            f"{100.0 * row.promised:.2g} %; less noise, a greater margin or a wider bound may do"
        )
        found.append(Finding("small margin", sentence, time=time, value=share))
    return found
