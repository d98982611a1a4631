"""Margins of rows under noise, (O13): they follow the motion of a search, and counted motions widen them."""

from __future__ import annotations

import contextlib
import math

import numpy as np
from scipy.special import ndtr, ndtri

from varpin.arrays import Floats
from varpin.control.between_nodes import NOWHERE, Instants
from varpin.control.constraints import BoundConstraint
from varpin.control.history import Status
from varpin.control.monte_carlo import PolicyPaths, with_margins
from varpin.control.multipliers import at_nodes, split
from varpin.control.noise import deviations
from varpin.control.problem import OptimalControlProblem
from varpin.control.riccati import Plan
from varpin.control.sizes import SLIGHT, TENTH
from varpin.control.solution import Solution
from varpin.control.stages import Feedback, Steps
from varpin.errors import VarpinError
from varpin.finding import Finding

# How often margins are widened by counting motions; from 2 to 5.
_COUNTS = 3
# Iterations in which margins follow the motion, and how often they do so later; from 10 to 50, and from 25.
_FOLLOWING, _ROUNDS = 20, 30
# Motions that are counted, and a quarter of them where only Python evaluates the noise: shares at margin 2 are then
# known to a seventh and to a third of themselves. From 1000 on the margins differ by a few percent.
_MOTIONS = 2048
# Motions beyond a quantile that determine it: its error is then a quarter of the share at most; from 10 to 40.
_ENOUGH = 20
# Standard errors by which the worst of many shares may exceed what is promised before a warning; a margin becomes wider
# from one on. From 2.5 to 4.
_DOUBT = 3.0
# Seeds of these motions, which are no user's: those of a search, and those of its warnings.
_SEARCH, _WARN = (0x76A3, 0), (0x76A3, 1)


def _counted(plan: Solution, seed: tuple[int, ...], *, largest: bool = False) -> PolicyPaths:
    """Motions of a plan's policy under noise, with the ``largest`` values of each row, as many as margins allow.

    Raises:
        VarpinError: Fewer than half of the motions get to the end.
    """
    problem = plan.problem
    paths = _MOTIONS // 4 if problem.scene.noise.diffusion is None else _MOTIONS
    beyond = (math.ceil(paths * ndtr(-bound.source.margin)) for bound in with_margins(problem))
    keep = max(_ENOUGH, *beyond) if largest else 0
    every = PolicyPaths(problem, plan.policy, paths, np.random.default_rng(seed), keep=keep)
    with every.executing(None, None) as pool:
        every.simulate(pool)
    if 2 * (finished := every.found.finished) < paths:
        raise VarpinError(f"{paths - finished} of {paths} motions under noise fail")
    return every


def widened(plan: Solution) -> list[Floats] | None:
    """What has to be added to margins (K, rows) for each constraint, in its unit, (O13); None if they suffice.

    Margins are of the linear model. Where noise is strong, or where it follows the controls, values in motions are not
    normally distributed, and violate bounds more often. Nothing is added where only Python evaluates the noise, as
    counting would take long.

    Raises:
        VarpinError: Motions cannot be counted: most fail.
    """
    problem, motion, known = plan.problem, plan.trajectory, plan.multipliers
    if problem.scene.noise.diffusion is None or known is None:
        return None
    # The same noise in every count: what is left of a violation is then that of the plan, not of other noise.
    counted = _counted(plan, _SEARCH, largest=True).found
    finished, enough = counted.finished, True
    bounds = problem.bound_constraints
    added = [np.zeros(bound.shape) for bound in bounds] if known.added is None else split(bounds, known.added)
    margins = at_nodes(problem, known, known.backoff)
    own = (i for i, bound in enumerate(bounds) if bound.source.margin > 0.0)
    for i, counts, largest in zip(own, counted.counts, counted.largest, strict=True):
        bound, promised = bounds[i], float(ndtr(-bounds[i].source.margin))
        error = math.sqrt(promised * (1.0 - promised) / finished)
        enough = enough and bool((counts / finished <= promised + error).all())
        # Where too few motions are beyond, a quantile of more of them, as far as a normal distribution has it to.
        often = max(round(finished * (promised - error)), _ENOUGH)
        planned = bound.value(motion.q, motion.v, problem.control_rows(motion))
        distance = np.partition(largest, len(largest) - often, axis=0)[len(largest) - often] - planned
        needed = distance * max(1.0, bound.source.margin / -float(ndtri(often / finished)))
        added[i] = np.maximum(needed - margins[i] + added[i], added[i])
    return None if enough else added


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
    for own in counted.broken():
        if own.share <= own.promised + _DOUBT * math.sqrt(own.promised * (1.0 - own.promised) / own.paths):
            continue
        sentence = (
            f"{own.label}: margin={own.margin:g} is too small for this noise, as {own.row} at t = {own.time:.4g} s is "
            f"violated by {100.0 * own.share:.3g} % of motions, not {100.0 * own.promised:.2g} %; less noise, a "
            "greater margin or a wider bound may do"
        )
        found.append(Finding("small margin", sentence, time=own.time, value=own.share))
    return found


class Tightening:
    """The margins of a search's rows.

    Attributes:
        margins: Of each constraint at its places and rows, in its unit.
        added: What counted motions have added to those at nodes; None without.
        counts: How often motions have been counted.
        since: The first iteration from which on rows and margins stay.
        rounds: How often margins have followed the motion of a search that ended, since then.
    """

    def __init__(self, problem: OptimalControlProblem) -> None:
        self.problem = problem
        self.bound: tuple[BoundConstraint, ...] = ()
        self.between: Instants = NOWHERE
        self.margins: list[Floats] = []
        self.added: list[Floats] | None = None
        self.counts = self.since = self.rounds = 0

    @property
    def needed(self) -> bool:
        """Whether rows have margins that noise widens."""
        return bool(self.problem.scene.processes) and any(item.source.margin > 0.0 for item in self.bound)

    @property
    def countable(self) -> bool:
        """Whether motions may be counted again."""
        return self.needed and self.counts < _COUNTS

    def enforce(self, bound: tuple[BoundConstraint, ...], between: Instants) -> None:
        """Begin without margins on constraints, the last of which are at instants between nodes."""
        self.bound, self.between = bound, between
        self.margins = [np.zeros(item.shape) for item in bound]

    def renew(self, iteration: int) -> None:
        """Let margins follow the motion from an iteration on, as rows are new."""
        self.since, self.rounds = iteration + (_FOLLOWING if self.needed else 0), 0

    def follow(self, along: Steps, plan: Plan, iteration: int, *, grow: bool) -> None:
        """Move margins towards those of a motion while the search begins; they grow only where rows can be met."""
        if iteration < self.since:
            self._move([move for move, _ in self._moves(along, plan, grow=grow)])

    def settle(self, along: Steps, plan: Plan, iteration: int, *, grow: bool) -> bool:
        """Whether the margins of a motion are others than those that it was found with; they then follow it.

        In between they stay: a merit whose rows move with the motion has no minimum.
        """
        if not self.needed or self.rounds >= _ROUNDS:
            return False
        moves = self._moves(along, plan, grow=grow)
        if all((np.abs(move) <= SLIGHT * own.max(axis=0)).all() for move, own in moves):
            return False
        if iteration >= self.since:
            self.since, self.rounds = iteration, self.rounds + 1
        self._move([move for move, _ in moves])
        return True

    def widen(self, plan: Solution) -> bool:
        """Whether margins become wider, as motions under noise violate bounds more often than these promise."""
        self.counts += 1
        more = None
        with contextlib.suppress(VarpinError):
            more = widened(plan)
        self.added = self.added if more is None else more
        return more is not None

    def _move(self, moves: list[Floats]) -> None:
        self.margins = [used + move for used, move in zip(self.margins, moves, strict=True)]

    def _moves(self, along: Steps, plan: Plan, *, grow: bool) -> list[tuple[Floats, Floats]]:
        """The moves of all margins towards those of a motion, and these.

        The latter are standard deviations under the plan's feedback, and what is added. Margins grow by a tenth of
        themselves at most: a motion that meets wide ones at once is violent, and has wider ones. After each round the
        moves are a smaller part of the way: a motion far from its rows has small margins, which let it come near again.
        """
        share, most = 1.0 / (1.0 + self.rounds), TENTH if grow else 0.0
        kept = [item for item in self.bound if item.source.margin > 0.0]
        spreads = iter(deviations(along, Feedback(plan.feedback, plan.previous), kept))
        more = [np.zeros(1)] * len(self.bound)
        if self.added is not None:
            more = [*self.added, *(self.added[i][self.between.of(i)[0]] for i in self.between.constraints)]
        found = []
        for item, used, extra in zip(self.bound, self.margins, more, strict=True):
            own = extra + (item.source.margin * next(spreads) if item.source.margin > 0.0 else np.zeros(item.shape))
            found.append((np.minimum(share * (own - used), most * own), own))
        return found
