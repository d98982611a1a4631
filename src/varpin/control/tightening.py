"""Margins of rows while a search goes on: they follow its motion, and counted motions widen them, (O13)."""

from __future__ import annotations

import contextlib

import numpy as np

from varpin.arrays import Floats
from varpin.control.between_nodes import NOWHERE, Instants
from varpin.control.constraints import BoundConstraint
from varpin.control.margins import widened
from varpin.control.noise import deviations
from varpin.control.problem import OptimalControlProblem
from varpin.control.riccati import Plan
from varpin.control.solution import Solution
from varpin.control.stages import Feedback, Steps
from varpin.errors import VarpinError

# How often margins are widened by counting motions.
_COUNTS = 3
# Iterations in which margins follow the motion, and the share of themselves by which they grow in each: a motion that
# meets wide margins at once is violent, and has wider ones. From 10 to 50, and 0.05 to 0.2.
_FOLLOWING, _GROWS = 20, 0.1
# How often margins follow the motion later, and by which share of the largest they then have to; from 1e-4 to 1e-2.
_ROUNDS, _MOVES = 30, 1e-3


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
        return bool(self.problem.processes) and any(item.source.margin > 0.0 for item in self.bound)

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
        if all((np.abs(move) <= _MOVES * own.max(axis=0)).all() for move, own in moves):
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

        The latter are standard deviations under the plan's feedback, and what is added. After each round the moves are
        a smaller part of the way: a motion far from its rows has small margins, which let it come near again.
        """
        share, most = 1.0 / (1.0 + self.rounds), _GROWS if grow else 0.0
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
