"""The watchdog of a search, (O16) of docs/mathematics.md: long steps that raise the cost, where short ones go on.

The motions that satisfy a steep cost, such as that of the end, are a curved valley. Long steps along the plan leave it,
and the line search takes short ones, iteration after iteration. From outside of the valley one or two iterations lead
back, further down. So a search departs from its best motion where its steps stay short, and returns to it if some
iterations later there is no better one (R. M. Chamberlain, M. J. D. Powell, C. Lemarechal and H. C. Pedersen, "The
watchdog technique for forcing convergence in algorithms for constrained optimization", 1982).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import NamedTuple

# A search departs after so many steps in a row that are no longer than _SHORT.
_IN_A_ROW, _SHORT = 3, 0.25
# Iterations after which it returns, and how many more they are after each departure in vain. Iterations before it
# departs again; they double with each departure in vain.
_AWAY, _LONGER, _REST = 6, 2, 4
# Greatest increase of the cost at a departure, as a share of the cost at stake on the first motion; its factor after a
# departure in vain.
_RISE, _LESS = 0.01, 0.1


class Watchdog(NamedTuple):
    """Whether a search is away from its best motion, (O16).

    Attributes:
        away: Iterations since the departure, that one included; 0 at home.
        failed: Departures in a row that were in vain.
        rest: Iterations before the next departure.
        regularization: Regularization of the search at home.
        growth: Last factor of that regularization.
    """

    away: int = 0
    failed: int = 0
    rest: int = 0
    regularization: float = 0.0
    growth: float = 1.0

    def departs(self, steps: Iterable[float]) -> bool:
        """Whether a search departs after steps of these lengths, the last one first."""
        if self.away or self.rest:
            return False
        short = itertools.takewhile(lambda step: 0.0 < step <= _SHORT, steps)
        return len(list(itertools.islice(short, _IN_A_ROW))) == _IN_A_ROW

    @property
    def rise(self) -> float:
        """Greatest increase of the cost at a departure, as a share of the cost at stake on the first motion."""
        return _RISE * _LESS**self.failed

    def departed(self, regularization: float, growth: float) -> Watchdog:
        """After a departure with this regularization at home."""
        return Watchdog(1, self.failed, 0, regularization, growth)

    def returned(self) -> Watchdog:
        """Back at home, in vain."""
        return self._replace(away=0, failed=self.failed + 1, rest=_REST * 2**self.failed)

    def stepped(self) -> Watchdog:
        """After an iteration."""
        if self.away == 0 and self.rest == 0:
            return self
        return self._replace(rest=max(0, self.rest - 1)) if self.away == 0 else self._replace(away=self.away + 1)

    @property
    def overdue(self) -> bool:
        """Whether the search has been away for too long."""
        return self.away > _AWAY + _LONGER * self.failed
