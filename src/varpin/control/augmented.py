"""Hard constraints by rounds of an augmented Lagrangian around S-DDP, and a last step onto the constraints.

Equations (P1) and (P3) of docs/plan-constraints.md: :meth:`Penalty.updated`, called by :meth:`_Rounds._kept`, updates
the multipliers, and :meth:`_Rounds._ended_or_next` the penalties' weights.

After Howell, Jackson and Manchester, "ALTRO: a fast solver for constrained trajectory optimization" (2019).
"""

from __future__ import annotations

import functools
import inspect
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ParamSpec, TypeAlias

import numpy as np
from scipy import ndimage

from varpin.arrays import Floats
from varpin.control.backward import backward
from varpin.control.between_nodes import NOWHERE, Instants, beyond, carried, enforced, in_force, seen, updated, watched
from varpin.control.constraints import BoundBetween, BoundConstraint
from varpin.control.costs import CostError
from varpin.control.examination import foreseen, looked_at
from varpin.control.first_node import out_of_reach
from varpin.control.history import ITERATIONS, Iteration, Status
from varpin.control.margins import widened
from varpin.control.multipliers import FEASIBLE, REPORTED, ConstraintReport, Multipliers, in_between, reports_of
from varpin.control.penalties import PenalizedProblem, flat, penalized, split, weights_for
from varpin.control.polish import Polished, judged, polished
from varpin.control.problem import OptimalControlProblem
from varpin.control.refinement import SUFFICIENT
from varpin.control.refinement_within import Warm, refine_within
from varpin.control.search import NOTHING, PATIENCE
from varpin.control.solution import Solution
from varpin.control.spread import Feedback, deviations
from varpin.control.unconstrained import checked_time, closing_of, require_reports
from varpin.errors import InputError, LinearizationError, VarpinError
from varpin.finding import announce
from varpin.mechanics.noise import NoiseFieldError
from varpin.support.checks import count, flag, positive
from varpin.support.one_thread import one_thread
from varpin.trajectory import Trajectory

P = ParamSpec("P")
# Values of a motion within steps, as of between_nodes.seen.
Looked: TypeAlias = list[Floats | None] | None

logger = logging.getLogger(__name__)

# Default tolerance.
_TOLERANCE = 1e-7
# Greatest number of iterations in a round, and in one with rows between nodes, which follow their peaks after it.
_OF_ROUND, _BEFORE_PEAKS = 40, 20
# Greatest number of rounds.
_ROUNDS = 40
# Tolerance of the search in the first round, and its factor from round to round.
_LOOSE, _TIGHTER = 1e-3, 0.1
# Tolerance of the last round, relative to the given one, and the least tolerance of a round whose search did nothing.
_FINAL, _FINEST = 1e-2, 1e-7
# A penalty's weight grows by _GROWTH after a round that leaves more than _ENOUGH of its constraint's violation.
_GROWTH, _ENOUGH = 10.0, 0.2
# Greatest weight of a penalty, relative to its first one: rounding errors of a heavier penalty exceed the cost.
_HEAVIEST = 1e9
# First penalties are light if the model would remove less than _LIGHT of them. They are made heavier until that is no
# longer so, by at most _HEAVIER at a time, in at most _LIFTS times. Shares up to _ROUNDED may be rounding errors.
_LIGHT, _HEAVIER, _LIFTS, _ROUNDED = 1e-2, 1e8, 8, 1e-9
# Least weights of penalties when rows between nodes begin, relative to those of the first motion's cost.
_LIGHTEST = 1e-5
# Violation of the first motion, relative to the constraint's scale, up to which its penalties are not made heavier.
_FAR = 1e-2
# Rounds in which margins are updated, and the relative change below which they have settled.
_MOVING, _SETTLED = 16, 1e-3
# From round _PLAIN on, margins that change by more than _DRIFT are made steadier over _NEAR nodes to either side, with
# the share _TAKEN in those of the next round.
_PLAIN, _DRIFT, _NEAR, _TAKEN = 5, 1e-2, 2, 0.5
# How often margins become wider at most, and further rounds in which they are updated each time.
_COUNTS, _ANEW = 3, 12
# A plan is infeasible when _STUCK rounds in a row have left more than _LOWERED of the worst violation.
_STUCK, _LOWERED = 3, 0.9
# Greatest number of iterations of a plan whose first node cannot meet a constraint.
_HOPELESS = 5
# Expected decrease, relative to the cost with penalties, with which a stalled search has not shown infeasibility.
_MUCH = 1e-2
# Greatest number of last steps, each with the rows between nodes of the motion before. As long as peaks move, a
# violation of _ROUGH and a decrease of the cost by _SHARE of the tolerance are enough.
_LOOKS, _ROUGH, _SHARE = 8, 1e-8, 0.1
# Last steps are tried before the rounds have ended where violations are at most _REACHED of a constraint's scale. Rows
# between nodes follow their peaks, and may be added, as long as the expected decrease has been less than _FALLS of the
# least one before at least once in _WAITS times.
_REACHED, _FALLS, _WAITS = 0.1, 0.5, 3
# Greatest decrease of the cost that they leave, relative to the cost at stake.
_EXACT = 1e-10
# Violation between nodes that is left to the last steps.
_CLOSE = 1e-6
# Violation at which penalties stop growing; the last step removes the rest.
_AIM = 1e-8


def within_constraints(search: Callable[P, Solution]) -> Callable[P, Solution]:
    """Extend ``search``, which solves problems without constraints, to problems with constraints, (P1).

    The signature stays: the first argument is the problem, and the others are options of each round.
    """
    signature = inspect.signature(search)

    @functools.wraps(search)
    def solve(*args: P.args, **kwargs: P.kwargs) -> Solution:
        problem = args[0] if args else kwargs.get("problem")
        if not (isinstance(problem, OptimalControlProblem) and problem.constraints):
            return search(*args, **kwargs)
        given = signature.bind(*args, **kwargs)
        options = {name: value for name, value in given.arguments.items() if name not in ("problem", "true_cost")}
        wish = given.arguments.get("true_cost")
        with one_thread():
            if wish is None:
                return _Rounds(problem, search, options).run()
            return _to_true_cost(problem, search, options, positive("true_cost", wish, "1"))

    return solve


def _to_true_cost(
    problem: OptimalControlProblem, search: Callable[..., Solution], options: dict[str, Any], wish: float
) -> Solution:
    """Rounds on finer and finer grids, each from the plan before, until the true cost is accurate to ``wish``."""
    if options.get("resume") is not None:
        raise InputError("true_cost begins with a search of its own: leave out either resume or true_cost")
    deadline = time.perf_counter() + checked_time(options.get("time_limit", np.inf))
    sufficient = max(positive("tolerance", options.get("tolerance", _TOLERANCE), "1"), SUFFICIENT * wish)

    def once(finer: OptimalControlProblem, start: Warm | None) -> Solution:
        own = {**options, "check": False, "tolerance": sufficient}
        if start is not None:
            own |= {"controls": start.controls, "states": None}
        if np.isfinite(deadline):
            own["time_limit"] = max(deadline - time.perf_counter(), 1e-9)
        return _Rounds(finer, search, own, None if start is None else start.before).run()

    found = refine_within(problem, once, wish, lambda: deadline - time.perf_counter())
    return looked_at(found)[0] if options.get("check", True) else found


@dataclass
class _State:
    """The state before a round; see :class:`Multipliers` for its attributes."""

    multipliers: list[Floats]
    weights: Floats
    first_weights: Floats
    backoff: list[Floats]
    worst: Floats
    tolerance: float
    round: int = 0
    stuck: int = 0
    between: Instants = NOWHERE
    added: list[Floats] | None = None
    counts: int = 0


class _Rounds:
    """Searches of the augmented Lagrangian, one after another, until the constraints hold."""

    def __init__(
        self,
        problem: OptimalControlProblem,
        search: Callable[..., Solution],
        options: dict[str, Any],
        before: Solution | None = None,
    ) -> None:
        self.problem, self.search = problem, search
        # A plan with twice the step.
        self.before = before
        # The problem of a round, with its rows between nodes.
        self.whole = problem
        self.options = dict(options)
        self.check = flag("check", self.options.pop("check", True))
        self.progress = self.options.pop("progress", None)
        self.controls = self.options.pop("controls", None)
        self.states = self.options.pop("states", None)
        self.resumed: Solution | None = self.options.pop("resume", None)
        self.tolerance = self.options.pop("tolerance", _TOLERANCE)
        self.most = count("max_iterations", self.options.pop("max_iterations", ITERATIONS))
        self.limit = checked_time(self.options.pop("time_limit", np.inf))
        self.report_all = require_reports(self.options.pop("callback", None), self.progress)
        self.label = f"{problem.scene.robot.name}, {problem.steps} steps of {problem.dt:g} s from t = {problem.t0:g} s"
        # Time of time.perf_counter at which the rounds and the last step end.
        self.until = np.inf
        self.history: list[Iteration] = []
        self.noisy = bool(problem.scene.processes) and any(item.margin > 0.0 for item in problem.constraints)
        self.state: _State

    @property
    def bound(self) -> tuple[BoundConstraint, ...]:
        """The bound constraints of a round."""
        return self.whole.bound_constraints

    def run(self) -> Solution:
        self.until = time.perf_counter() + self.limit
        # A search without iterations checks the options and makes the first motion.
        first = self._first()
        # Before the search, which takes long where there is no plan.
        before = foreseen(self.problem) if self.check else []
        announce(logger, self.problem.scene.announced, self.problem.dt, before)
        hopeless = out_of_reach(self.problem, first.trajectory)
        last = len(self.history) + (min(self.most, _HOPELESS) if hopeless else self.most)
        found, resume = first, self._resumed_search()
        while True:
            begun = self.state
            self.whole = enforced(self.problem, begun.between)
            known = len(self.history)
            done = 0 if resume is None or resume.search is None else len(resume.search.history)
            # Linear controls lead around the nodes until there are such rows.
            around = self.problem.linear and any(watched(self.problem))
            longest = _BEFORE_PEAKS if around or len(begun.between.rows) else _OF_ROUND
            left = min(last - known, longest - done)
            problem = self._penalized(begun)
            options: dict[str, Any] = dict(self.options)
            if resume is None:
                options["controls"] = self.controls if begun.round == 0 else found
                options["states"] = self.states if begun.round == 0 else None
            else:
                options["resume"] = replace(resume, problem=problem)
                known -= done
                self.history = self.history[:known]
            if np.isfinite(self.limit):
                options["time_limit"] = max(self.until - time.perf_counter(), 1e-9)
            found = self.search(
                problem,
                tolerance=begun.tolerance,
                max_iterations=max(left, 0),
                callback=functools.partial(self._report, known, last),
                check=False,
                **options,
            )
            resume = None
            self.history += [replace(item, index=item.index + known) for item in found.history]
            kept = ended_with = self._steady(self._kept(found, problem, begun, known))
            try:
                status, reason = self._ended_or_next(kept, begun, found, last)
                if hopeless and found.status not in (Status.INTERRUPTED, Status.OUT_OF_TIME):
                    status, reason = Status.INFEASIBLE, hopeless
                    break
                early = self._early(kept, begun) if status is None else None
                if early is not None:
                    kept, closing = early
                    status, reason = kept.status, f"last steps after round {begun.round}; {closing}"
                elif status is None and time.perf_counter() > self.until:
                    # The round has ended; the search goes on from there, and so do the last steps.
                    status, reason = Status.OUT_OF_TIME, found.reason
                    break
                elif self._goes_between(kept, begun, status) or status is None:
                    continue
                ended = status in (Status.INFEASIBLE, Status.STALLED) and kept.violation > FEASIBLE
                if ended and not self._clearly_beyond(kept):
                    # The last step may remove what the rounds have left.
                    closed, closing = self._polished(replace(kept, status=Status.STALLED))
                    if closed.violation <= FEASIBLE:
                        kept, status, reason = closed, closed.status, f"{found.reason}; {closing}"
                    elif status is Status.INFEASIBLE:
                        # So little says more of the search than of the constraints.
                        told = max(kept.constraints, key=lambda item: item.violation)
                        rest = f"{told.where} stays violated by {told.violation:.1e} {told.unit}"
                        status, reason = Status.STALLED, f"{found.reason}; {told.label}: {rest}"
                elif early is None and kept.violation <= FEASIBLE and status is not Status.INTERRUPTED:
                    closed, closing = self._polished(replace(kept, status=status))
                    missed = status is Status.CONVERGED and closed.status is Status.STALLED
                    if missed and self._goes_between(kept, begun, status, again=True):
                        continue
                    kept, status, reason = closed, closed.status, f"{reason}; {closing}"
                goes_on, counted = self._counts(kept, begun, status)
                if goes_on:
                    continue
                reason += counted
            except KeyboardInterrupt:
                # Without the last step: the search goes on from its own motion.
                kept, status, reason = ended_with, Status.INTERRUPTED, found.reason
            break
        plan = self._told_between(replace(kept, status=status, reason=reason))
        return looked_at(plan, before)[0] if self.check else plan

    def _first(self) -> Solution:
        """The first motion, and the state of the first round."""
        if self.resumed is not None:
            return self._take_up(self.resumed)
        zeros = [np.zeros(item.shape) for item in self.bound]
        plain = penalized(self.problem, zeros, np.zeros(len(self.bound)), zeros)
        first = self.search(
            plain,
            self.controls,
            tolerance=self.tolerance,
            max_iterations=0,
            check=False,
            states=self.states,
            **self.options,
        )
        if first.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        cost = abs(first.cost)
        if self.states is not None:
            # Where the auxiliary forces are dropped at once, the motion may fall, and its cost says nothing.
            cost = min(cost, abs(closing_of(plain, self.states, self.controls).motion.cost))
        weights = weights_for(cost or 1.0, self.bound)
        if self.states is None:
            weights = weights * self._heavier(plain, first.trajectory, weights)
        nothing = np.full(len(self.bound), np.inf)
        self.state = _State(zeros, weights, weights, zeros, nothing, _LOOSE)
        if self.before is not None and self.before.multipliers is not None:
            self.state = self._carried(self.before.problem, self.before.multipliers)
        return first

    def _carried(self, coarse: OptimalControlProblem, known: Multipliers) -> _State:
        """The state of the first round with the multipliers, weights and margins of a plan with twice the step.

        Rate limits begin anew: the plan's controls on this grid change at every other decision only.
        """
        begun, bound = self.state, coarse.bound_constraints
        size = sum(item.size for item in bound)
        values, backoff = (split(bound, part[:size]) for part in (known.values, known.backoff))
        weights = begun.weights.copy()
        for i, (before, item) in enumerate(zip(bound, self.bound, strict=True)):
            if item.of_controls:
                values[i] = begun.multipliers[i]
                continue
            share = len(before.places) / len(item.places)
            values[i] = share * in_between(before, item, values[i])
            weights[i] = max(weights[i], share * known.weights[i])

        def finer(parts: list[Floats]) -> list[Floats]:
            return [in_between(before, item, part) for before, item, part in zip(bound, self.bound, parts, strict=True)]

        added = None if known.added is None else finer(split(bound, known.added))
        return replace(begun, multipliers=values, weights=weights, backoff=finer(backoff), added=added)

    def _heavier(self, plain: OptimalControlProblem, motion: Trajectory, weights: Floats) -> float:
        """Factor of first weights that are light: those of a first motion that costs next to nothing.

        The share of the penalties that the model along the motion removes grows in proportion to light weights, and
        then goes towards the share that controls can remove at all. Where that is none, the factor is 1. So it is near
        the constraints, as along a plan within them. ``plain`` is the problem whose penalties have no weight.
        """
        zeros = [np.zeros(item.shape) for item in self.bound]
        known = reports_of(self.whole, motion, zeros, zeros)
        if not any(item.violation > _FAR * bound.scale for item, bound in zip(known, self.bound, strict=True)):
            return 1.0

        def removed(factor: float) -> float:
            made = penalized(self.problem, zeros, factor * weights, zeros)
            rows = self.problem.control_rows(motion)
            whole = float(sum(part.shares(motion.q, motion.v, rows).sum() for part in made.penalties))
            found = backward(made, motion, 0.0) if whole > 0.0 else None
            return np.nan if found is None else (found.expected_decrease - base) / whole

        base, factor = 0.0, 1.0
        try:
            alone = backward(plain, motion, 0.0)
            base = 0.0 if alone is None else alone.expected_decrease
            share = removed(factor)
            for _ in range(_LIFTS):
                if not share < _LIGHT:
                    break
                before = share
                factor *= float(np.clip(_LIGHT / max(share, 1e-300), 10.0, _HEAVIER))
                share = removed(factor)
                if before > _ROUNDED and share < 2.0 * before:
                    break
        except (CostError, NoiseFieldError, LinearizationError):
            return 1.0
        return factor if share >= _LIGHT else 1.0

    def _take_up(self, resumed: object) -> Solution:
        """Continue from the state of a solution."""
        if not isinstance(resumed, Solution):
            raise InputError(f"resume must be a Solution, got {type(resumed).__name__}")
        if self.controls is not None:
            raise InputError("resume goes on from the solution's own controls: leave out either controls or resume")
        if self.states is not None:
            raise InputError("resume goes on from the solution's own states: leave out either states or resume")
        difference = self.problem.differs(resumed.problem)
        if difference:
            raise InputError(f"resume: the solution is of another problem: {difference}; give it as controls")
        known = resumed.multipliers
        if resumed.search is None or known is None:
            raise InputError("resume: the solution does not hold the state of its search; give it as controls")
        self.whole = enforced(self.problem, known.begun_between)
        self.state = _State(
            split(self.bound, known.begun),
            known.weights,
            known.first_weights,
            split(self.bound, known.backoff),
            known.worst,
            known.tolerance,
            known.round,
            known.stuck,
            known.begun_between,
            None if known.added is None else split(self.problem.bound_constraints, known.added),
            known.counts,
        )
        self.history = list(resumed.search.history)
        return resumed

    def _resumed_search(self) -> Solution | None:
        """The resumed solution, with the history of its last round only."""
        resumed = self.resumed
        if resumed is None or resumed.search is None or resumed.multipliers is None:
            return None
        begun = resumed.multipliers.iterations
        history = [replace(item, index=item.index - begun) for item in resumed.search.history[begun:]]
        return replace(resumed, search=replace(resumed.search, history=tuple(history)))

    def _report(self, known: int, last: int, item: Iteration, motion: Trajectory) -> None:
        item = replace(item, index=item.index + known)
        self.report_all(item, motion)
        if self.progress is not None:
            self.progress(min(item.index + 1, last), last)

    def _kept(self, found: Solution, problem: PenalizedProblem, begun: _State, known: int) -> Solution:
        """The result of a round as a solution of the constrained problem, with updated multipliers."""
        motion = found.trajectory
        values = [
            part.updated(item.value(motion.q, motion.v, self.problem.control_rows(motion)))
            for item, part in zip(self.bound, problem.all_penalties, strict=True)
        ]
        multipliers = replace(_begun(begun, known), values=flat(values))
        search = found.search
        if search is not None:
            passed = self.history[:known]
            search = replace(
                search,
                history=(*passed, *(replace(item, index=item.index + known) for item in search.history)),
            )
        return replace(
            found,
            problem=self.problem,
            cost=self.problem.cost_of(motion),
            history=tuple(self.history),
            search=search,
            multipliers=multipliers,
        )

    def _ended_or_next(self, kept: Solution, begun: _State, found: Solution, last: int) -> tuple[Status | None, str]:
        """Status and reason if the rounds end; else update multipliers and weights for the next round, (P3)."""
        known = kept.multipliers
        assert known is not None
        values = split(self.bound, known.values)
        constraints = reports_of(self.whole, kept.trajectory, values, begun.backoff)
        violation = np.array([item.violation for item in constraints])
        worst = max(constraints, key=lambda item: item.violation)
        state = f"round {begun.round}: {worst.label} is violated by {worst.violation:.1e} {worst.unit}"
        logger.info("%s: %s", self.label, state)
        if found.status is Status.INTERRUPTED or found.status is Status.OUT_OF_TIME:
            return found.status, f"{found.reason}; {state}"
        out = len(self.history) >= last and found.status is Status.MAX_ITERATIONS
        feasible = worst.violation <= FEASIBLE
        exact = begun.tolerance <= _FINAL * self.tolerance and found.status is not Status.MAX_ITERATIONS
        backoff, settled = begun.backoff, True
        if self.noisy and begun.round < _MOVING + _ANEW * begun.counts:
            backoff = self._next_backoff(kept, begun)
            settled = _change(backoff, begun.backoff) <= _SETTLED
            backoff = begun.backoff if settled else backoff
        if exact and feasible and settled:
            return found.status, found.reason
        if out:
            return Status.MAX_ITERATIONS, f"{found.reason}; {state}"
        if found.iterations == 0 and begun.round > 0 and not feasible and begun.tolerance > _FINEST * self.tolerance:
            # The search has not moved, so the multipliers would not improve: repeat the round with a smaller tolerance.
            self.state = replace(begun, tolerance=_TIGHTER * begun.tolerance, round=begun.round + 1, backoff=backoff)
            return None, ""
        stays = worst.violation > max(FEASIBLE, _LOWERED * float(begun.worst.max()))
        stuck = begun.stuck + 1 if stays else 0
        heavy = bool((begun.weights >= _HEAVIEST * begun.first_weights).any())
        if not feasible and (stuck >= _STUCK or begun.round + 1 >= _ROUNDS or (heavy and stuck)):
            if _blocked(found):
                return found.status, f"{state}; {found.reason}"
            return Status.INFEASIBLE, self._infeasible(kept, begun, worst, constraints.index(worst))
        if feasible and begun.round + 1 >= _ROUNDS:
            return found.status, found.reason
        aim = _CLOSE if len(begun.between.rows) else _AIM
        more = (violation > np.maximum(aim, _ENOUGH * begun.worst)) & (begun.weights < _HEAVIEST * begun.first_weights)
        weights = np.where(more, _GROWTH * begun.weights, begun.weights)
        self.state = _State(
            multipliers=values,
            weights=weights,
            first_weights=begun.first_weights,
            backoff=backoff,
            worst=violation,
            # An accurate optimum is of no use while the violation does not decrease.
            tolerance=begun.tolerance if exact or stays else max(_FINAL * self.tolerance, _TIGHTER * begun.tolerance),
            round=begun.round + 1,
            stuck=stuck,
            between=begun.between,
            added=begun.added,
            counts=begun.counts,
        )
        return None, ""

    def _infeasible(self, kept: Solution, begun: _State, worst: ConstraintReport, constraint: int) -> str:
        """Why a problem is infeasible, by the worst report, of one of a round's constraints."""
        motion, margin = kept.trajectory, begun.backoff[constraint]
        c = self.bound[constraint].value(motion.q, motion.v, self.problem.control_rows(motion)) + margin
        own = float(margin.ravel()[int(c.argmax())])
        said = (
            f"{worst.label} cannot be met from here: {worst.where} stays violated by {worst.violation:.3g} {worst.unit}"
        )
        if own > 0.0:
            said += f", its margin of {own:.3g} {worst.unit} included"
            if begun.added is not None and self._margins(begun.added, begun.between)[constraint].any():
                said += ", which is as wide as motions under noise need"
        return f"{said}, whatever its penalty"

    def _goes_between(self, kept: Solution, begun: _State, ended: Status | None, *, again: bool = False) -> bool:
        """Whether a round follows with other rows between nodes, because the motion violates a constraint there.

        Only linear controls lead around the nodes, and held ones have such rows where the problem asks for them. There
        are none until the motion of a round, with held controls not that of the first, violates a constraint by more
        than a thousandth of its range; or at the end of the rounds by more than 1e-6 of its unit, if the problem asks
        for them. From then on the rows of each round follow the peaks of the motion before, with further ones that it
        violates or comes close to. When there are rows for the first time, penalties have their first weights again, or
        before the rounds have ended those for the present cost, where it is less. They are heavier in a round that is
        made ``again``, because the last step did not lead to an optimum.
        """
        before, base, known = begun.between, self.state, kept.multipliers
        assert known is not None
        values = split(self.bound, known.values)
        asked = self.problem.between_nodes
        first = not len(before.rows)
        # Held controls hardly lead around the nodes: their first round may only be far from its end.
        early = ended is None and first and begun.round == 0
        if not (self.problem.linear or asked) or (early and not self.problem.linear):
            return False
        if ended is not None:
            if begun.round + 1 >= _ROUNDS or ended not in (Status.CONVERGED, Status.STALLED):
                return False
            if kept.violation > FEASIBLE:
                return False
            base = replace(begun, multipliers=values, round=begun.round + 1, stuck=0)
            if again:
                heavier = np.minimum(_GROWTH * begun.weights, _HEAVIEST * begun.first_weights)
                base = replace(base, weights=np.maximum(begun.weights, heavier))
        looked = seen(self.problem, kept.trajectory)
        between = self._followed(before, looked, begun.backoff, anew=True)
        if not len(between.rows):
            return False
        if (ended is not None or first) and not again:
            close = ended is not None and (asked or not first)
            bounds = [_CLOSE if close else REPORTED * item.scale for item in self.problem.bound_constraints]
            if (self._beyond(looked, begun.backoff) <= bounds).all():
                return False
        self.state = self._with_rows(base, between)
        multipliers, backoff, first_weights = self.state.multipliers, self.state.backoff, self.state.first_weights
        whole = enforced(self.problem, between)
        told = reports_of(whole, kept.trajectory, multipliers, backoff)
        most = max(told, key=lambda item: item.violation)
        logger.info(
            "%s: between nodes %s is violated by %.1e %s: rows at %d instants from now on",
            self.label, most.label, most.violation, most.unit, len(between.rows),
        )  # fmt: skip
        if first:
            lighter = first_weights
            if ended is None and kept.cost:
                # The first motion may have cost many times as much as this one. The heavier penalties are beside their
                # multipliers, the shorter are the steps along which constraints are linear enough.
                of_cost = _of_all(weights_for(abs(kept.cost), self.bound), before, between)
                equality = [item.source.equality for item in whole.bound_constraints]
                lighter = np.where(equality, first_weights, np.clip(of_cost, _LIGHTEST * first_weights, first_weights))
            self.state = replace(
                self.state,
                weights=lighter,
                first_weights=lighter,
                worst=np.full(len(first_weights), np.inf),
                tolerance=_LOOSE,
            )
        return True

    def _counts(self, kept: Solution, begun: _State, status: Status) -> tuple[bool, str]:
        """Whether rounds follow with wider margins, as motions under noise violate bounds too often; a note on it.

        The last round is repeated from its own multipliers and weights.
        """
        ended = status in (Status.CONVERGED, Status.STALLED) and kept.violation <= FEASIBLE
        if not (self.noisy and ended):
            return False, ""
        try:
            added = widened(kept, self.until)
        except VarpinError as error:
            return False, f"; how often motions under noise violate bounds with a margin was not counted: {error}"
        if added is None:
            return False, ""
        if begun.counts >= _COUNTS or begun.round + 1 >= _ROUNDS:
            return False, "; motions under noise still violate bounds more often than their margins allow"
        logger.info("%s: motions under noise violate bounds more often than their margins allow", self.label)
        self.whole = enforced(self.problem, begun.between)
        worst = np.full(len(begun.worst), np.inf)
        begun = replace(begun, added=added, counts=begun.counts + 1, round=begun.round + 1, stuck=0, worst=worst)
        self.state = replace(begun, backoff=self._backoff(kept, begun))
        return True, ""

    def _followed(self, between: Instants, looked: Looked, backoff: list[Floats], *, anew: bool) -> Instants:
        """The rows between nodes at the peaks of a motion of values ``looked``; see :func:`updated`."""
        margins = backoff[: len(self.problem.bound_constraints)]
        return between if looked is None else updated(self.problem, between, looked, margins, anew=anew)

    def _beyond(self, looked: Looked, backoff: list[Floats]) -> Floats:
        """By how much a motion of values ``looked`` violates each constraint between its nodes."""
        count = len(self.problem.bound_constraints)
        return np.full(count, np.inf) if looked is None else beyond(looked, backoff[:count])

    def _told_between(self, plan: Solution) -> Solution:
        """The plan, which is not CONVERGED and says so where it violates constraints between nodes against the wish."""
        known = plan.multipliers
        if not self.problem.between_nodes or known is None or not any(watched(self.problem)):
            return plan
        bound = enforced(self.problem, known.between).bound_constraints
        left = self._beyond(seen(self.problem, plan.trajectory), split(bound, known.backoff))
        worst = int((left / [item.scale for item in self.problem.bound_constraints]).argmax())
        if (left <= FEASIBLE).all():
            return plan
        item = self.problem.bound_constraints[worst]
        told = f"between nodes {item.source.label} is violated by {left[worst]:.1e} {item.unit}"
        if not np.isfinite(left[worst]):
            told = "the motion between nodes is not known, as a step cannot be integrated in parts"
        status = Status.STALLED if plan.status.converged else plan.status
        return replace(plan, status=status, reason=f"{plan.reason}; {told}")

    def _left(self, motion: Trajectory, looked: Looked, backoff: list[Floats]) -> float:
        """The largest violation of a motion, at the nodes and between them, where its values are ``looked``."""
        margins = backoff[: len(self.problem.bound_constraints)]
        at_nodes = max(told.violation for told in reports_of(self.problem, motion, margins, margins))
        return max(at_nodes, float(self._beyond(looked, backoff).max()))

    def _margins(self, backoff: list[Floats], between: Instants) -> list[Floats]:
        """The margins of all rows, those between nodes as at the end of their step; none of rows not enforced."""
        count = len(self.problem.bound_constraints)
        enforced_rows = zip(between.constraints, in_force(self.problem, between), strict=True)
        of_instants = [np.where(rows, backoff[i][between.of(i)[:, 0]], 0.0) for i, rows in enforced_rows]
        return [*backoff[:count], *of_instants]

    def _with_rows(self, base: _State, between: Instants) -> _State:
        """A state with rows at other instants between nodes."""
        before = base.between
        parts = (carried(self.problem, before, between, array) for array in (base.multipliers, base.backoff))
        multipliers, backoff = next(parts), self._margins(next(parts), between)
        arrays = (base.weights, base.first_weights, base.worst)
        weights, first_weights, worst = (_of_all(array, before, between) for array in arrays)
        return replace(
            base,
            multipliers=multipliers,
            weights=weights,
            first_weights=first_weights,
            backoff=backoff,
            worst=worst,
            between=between,
        )

    def _early(self, kept: Solution, begun: _State) -> tuple[Solution, str] | None:
        """The plan after last steps before the rounds have ended; None where these do not lead exactly to an optimum.

        Rows between nodes are added where the motion violates a constraint there. These steps are tried after rounds
        whose number is a power of two, if the violation decreases.
        """
        due = begun.round > 0 and begun.round & (begun.round - 1) == 0
        if self.noisy or not due or self.state.stuck or self._clearly_beyond(kept, _REACHED):
            return None
        between = (self.problem.linear or self.problem.between_nodes) and any(watched(self.problem))
        try:
            near = self._brought_near(kept, begun) if between else kept
        except (CostError, NoiseFieldError, LinearizationError):
            near = None
        if near is not None:
            closed, closing = self._polished(replace(near, status=Status.CONVERGED), _EXACT)
            known = closed.multipliers
            assert known is not None
            looked = seen(self.problem, closed.trajectory) if between and not len(known.between.rows) else None
            holds = looked is None or not self._needs_rows(looked, begun)
            if closed.status.converged and closed.violation <= FEASIBLE and holds:
                return closed, closing
        logger.info("%s: last steps after round %d do not lead to an optimum", self.label, begun.round)
        self.whole = enforced(self.problem, begun.between)
        return None

    def _brought_near(self, kept: Solution, begun: _State) -> Solution | None:
        """The plan after rough last steps, with rows at all peaks between nodes of the motion before each of them.

        None where they do not lead to a motion that keeps to the constraints everywhere.
        """
        known = kept.multipliers
        assert known is not None
        motion, base = kept.trajectory, replace(begun, multipliers=split(self.bound, known.values))
        looked, least, waited = seen(self.problem, motion), np.inf, 0
        while looked is not None and waited < _WAITS:
            if self._needs_rows(looked, base):
                base = self._with_rows(base, self._followed(base.between, looked, base.backoff, anew=True))
            self.whole = enforced(self.problem, base.between)
            enough = _ROUGH, _SHARE * self.tolerance
            after = polished(self.whole, motion, base.multipliers, base.weights, base.backoff, self.until, enough)
            still, motion, base = after.motion is motion, after.motion, replace(base, multipliers=after.multipliers)
            looked = seen(self.problem, motion)
            rows = self._needs_rows(looked, base)
            left = self._left(motion, looked, base.backoff) if rows else after.violation
            if after.decrease <= self._bound(kept, after) and left <= FEASIBLE:
                return self._resumable(self._along(kept, motion, _begun(base, len(self.history))), base)
            if still or time.perf_counter() > self.until:
                break
            waited = 0 if after.decrease < _FALLS * least else waited + 1
            least = min(least, after.decrease)
        return None

    def _resumable(self, plan: Solution, begun: _State) -> Solution:
        """A plan with the state of a search that has just begun with it, in a round with its rows."""
        found = self.search(
            self._penalized(begun), plan, tolerance=begun.tolerance, max_iterations=0, check=False, **self.options
        )
        if found.status is Status.INTERRUPTED or found.search is None:
            raise KeyboardInterrupt
        return replace(plan, search=replace(found.search, history=tuple(self.history)))

    def _penalized(self, begun: _State) -> PenalizedProblem:
        """The problem of the search of a round."""
        state = begun.multipliers, begun.weights, begun.backoff
        return penalized(self.whole, *state, until=self.until, later=begun.round > 0)

    def _needs_rows(self, looked: Looked, base: _State) -> bool:
        """Whether there are rows between nodes, or a motion of values ``looked`` needs the first ones."""
        close = self.problem.between_nodes
        bounds = [_CLOSE if close else REPORTED * item.scale for item in self.problem.bound_constraints]
        return len(base.between.rows) > 0 or bool((self._beyond(looked, base.backoff) > bounds).any())

    def _polished(self, kept: Solution, least: float = np.inf) -> tuple[Solution, str]:
        """The plan moved onto its constraints and to its optimum, with matching gains, and its residuals in words.

        It is CONVERGED if the cost would fall by no more than the tolerance, and ``least``, of the cost at stake.

        Peaks between nodes then are elsewhere, so that the last step is made again. With such rows, the plan stays as
        it is if that does not lead closer, or to a peak that has no row. Steps are rough until the peaks stay inside.
        """
        known = kept.multipliers
        assert known is not None
        values, backoff = split(self.bound, known.values), split(self.bound, known.backoff)
        motion, between, dense = kept.trajectory, known.between, len(known.between.rows) > 0
        found: Polished | None = None
        looked = seen(self.problem, motion) if dense else None
        nearest = max(self._left(motion, looked, backoff), FEASIBLE) if dense else np.inf
        rough = dense
        try:
            for look in range(_LOOKS if dense else 1):
                if dense:
                    between = self._followed(between, looked, backoff, anew=False)
                self.whole = enforced(self.problem, between)
                rough = rough and look + 1 < _LOOKS
                enough = (_ROUGH, _SHARE * self.tolerance) if rough else None
                after = polished(self.whole, motion, values, known.weights, backoff, self.until, enough)
                still = after.motion is motion
                motion, values = after.motion, after.multipliers
                looked = seen(self.problem, motion) if dense else None
                left = self._left(motion, looked, backoff) if dense else 0.0
                closer = not dense or (after.decrease <= self._bound(kept, after) and left <= nearest)
                if closer:
                    found, nearest = after, max(left, FEASIBLE)
                    known = replace(known, values=flat(values), **_of_instants(between))
                # The peaks of a motion that does not move stay where they are, too.
                settled = still or (closer and left <= FEASIBLE)
                last = (settled and not rough and (look > 0 or still)) or (still and not closer)
                if last or time.perf_counter() > self.until:
                    break
                rough = rough and not settled
        except (CostError, NoiseFieldError, LinearizationError):
            pass
        self.whole = enforced(self.problem, known.between)
        if found is None:
            return self._judged(kept)
        plan = self._along(kept, found.motion, known)
        closing = (
            f"constraints hold to {plan.violation:.1e}, and within them the cost would fall by {found.decrease:.1e}"
        )
        if kept.status in (Status.CONVERGED, Status.STALLED):
            # The decrease is a bound, whatever the multipliers, and the search may have stalled at a finer tolerance.
            most = min(self._bound(kept, found), least * found.stake)
            there = found.decrease <= most and not self._clearly_beyond(plan)
            plan = replace(plan, status=Status.CONVERGED if there else self._stopped())
        return plan, closing

    def _judged(self, kept: Solution) -> tuple[Solution, str]:
        """The plan as it is, with the multipliers of the Lagrangian's least slope where that has derivatives.

        It is not CONVERGED if the cost would fall by more than the tolerance within the constraints.
        """
        known, closing = kept.multipliers, f"constraints hold to {kept.violation:.1e}"
        assert known is not None
        values, backoff = split(self.bound, known.values), split(self.bound, known.backoff)
        there = not self._clearly_beyond(kept)
        try:
            found = judged(self.whole, kept.trajectory, values, known.weights, backoff)
        except (CostError, NoiseFieldError, LinearizationError):
            pass
        else:
            kept = replace(kept, multipliers=replace(known, values=flat(found.multipliers)))
            there = there and (kept.status is not Status.CONVERGED or found.decrease <= self._bound(kept, found))
            closing += f", and within them the cost would fall by {found.decrease:.1e}"
        return kept if there else replace(kept, status=self._stopped()), closing

    def _bound(self, kept: Solution, found: Polished) -> float:
        """Greatest decrease of the cost within the constraints that counts as none."""
        first = 0.0 if kept.search is None else kept.search.first
        return float(self.tolerance * (found.stake + NOTHING * first))

    def _stopped(self) -> Status:
        """The status of a plan that a last step has not led to an optimum."""
        return Status.OUT_OF_TIME if time.perf_counter() > self.until else Status.STALLED

    def _clearly_beyond(self, plan: Solution, share: float = REPORTED) -> bool:
        """Whether the motion violates a constraint by more than a share of its range, by default a thousandth."""
        bound = self.problem.bound_constraints
        return any(told.violation > share * item.scale for told, item in zip(plan.constraints, bound, strict=True))

    def _along(self, kept: Solution, motion: Trajectory, multipliers: Multipliers) -> Solution:
        """The plan with a neighbouring motion, its multipliers and the results of a backward pass along it."""
        moved = replace(kept, trajectory=motion, cost=self.problem.cost_of(motion), multipliers=multipliers)
        values, backoff = split(self.bound, multipliers.values), split(self.bound, multipliers.backoff)
        try:
            found = backward(penalized(self.whole, values, multipliers.weights, backoff), motion, 0.0)
        except (CostError, NoiseFieldError, LinearizationError):
            return moved
        if found is None:
            return moved
        return self._steady(
            replace(
                moved,
                gains=found.feedback,
                previous_gains=found.previous,
                feedforward=found.feedforward,
                gradient=found.gradient,
            )
        )

    def _steady(self, kept: Solution) -> Solution:
        """Under noise, the plan with the feedback of its cost and of its equality constraints only.

        The penalty of an inequality would make the feedback stiff at its bound and leave it soft elsewhere. The margin
        takes its place.
        """
        if not self.problem.scene.processes:
            return kept
        known = kept.multipliers
        assert known is not None
        goals = [
            first if item.source.equality else 0.0 for item, first in zip(self.bound, known.first_weights, strict=True)
        ]
        zeros = [np.zeros(item.shape) for item in self.bound]
        calm = penalized(self.whole, zeros, np.array(goals), zeros, quiet=False)
        try:
            found = backward(calm, kept.trajectory, 0.0)
        except (CostError, NoiseFieldError, LinearizationError):
            found = None
        if found is None:
            return replace(kept, noise_cost=np.nan)
        return replace(kept, gains=found.feedback, previous_gains=found.previous, noise_cost=found.noise)

    def _backoff(self, kept: Solution, begun: _State) -> list[Floats]:
        """The margins of all constraints around a plan, in their units."""
        feedback = Feedback(kept.gains, kept.previous_gains)
        added = (
            self._margins(begun.added, begun.between) if begun.added else [np.zeros(item.shape) for item in self.bound]
        )
        found = [
            item.source.margin * deviations(self.problem, kept.trajectory, feedback, item) + more
            if item.source.margin > 0.0
            else np.zeros(item.shape)
            for item, more in zip(self.bound, added, strict=True)
        ]
        return [
            np.where(item.in_force, part, 0.0) if isinstance(item, BoundBetween) else part
            for item, part in zip(self.bound, found, strict=True)
        ]

    def _next_backoff(self, kept: Solution, begun: _State) -> list[Floats]:
        """The margins of the next round.

        Where noise follows the controls, margins that differ from node to node make controls jump, which makes margins
        differ more. Where they do not settle for that reason, steadier ones do, which are nowhere smaller.
        """
        backoff = self._backoff(kept, begun)
        if begun.round < _PLAIN or _change(backoff, begun.backoff) <= _DRIFT:
            return backoff
        count = len(self.problem.bound_constraints)
        steady = self._margins([_steadier(part) for part in backoff[:count]], begun.between)
        taken = 1.0 if begun.round == _PLAIN else _TAKEN
        return [old + taken * (new - old) for new, old in zip(steady, begun.backoff, strict=True)]


def _change(new: list[Floats], old: list[Floats]) -> float:
    """Largest change of margins, relative to the largest margin of their constraint."""
    changes = [
        float(np.abs(after - before).max() / after.max()) for after, before in zip(new, old, strict=True) if after.any()
    ]
    return max(changes, default=0.0)


def _steadier(margins: Floats) -> Floats:
    """Margins (K, rows) that change less from node to node, and are at least the given ones.

    They are no larger than all before: margins begin near zero, and later ones may not be possible there.
    """
    size = 2 * _NEAR + 1
    most = ndimage.maximum_filter1d(margins, size, axis=0, mode="nearest")
    smooth = ndimage.uniform_filter1d(most, size, axis=0, mode="nearest")
    found: Floats = np.minimum(smooth, np.maximum.accumulate(margins, axis=0))
    return found


def _begun(begun: _State, iterations: int) -> Multipliers:
    """The state before a round, which begins after that many iterations, as part of a solution."""
    return Multipliers(
        values=flat(begun.multipliers),
        backoff=flat(begun.backoff),
        begun=flat(begun.multipliers),
        weights=begun.weights.copy(),
        first_weights=begun.first_weights.copy(),
        worst=begun.worst.copy(),
        tolerance=begun.tolerance,
        round=begun.round,
        iterations=iterations,
        stuck=begun.stuck,
        added=None if begun.added is None else flat(begun.added),
        counts=begun.counts,
        **_of_instants(begun.between),
        **_of_instants(begun.between, "begun_"),
    )


def _of_instants(between: Instants, prefix: str = "") -> dict[str, Any]:
    """The rows between nodes as fields of :class:`Multipliers`; with the prefix ``begun_`` those of the round."""
    if not len(between.rows):
        return {}
    found = {f"{prefix}moments": between.moments, f"{prefix}bends": between.bends}
    return found if prefix else found | {"instants": between.rows}


def _of_all(values: Floats, old: Instants, new: Instants) -> Floats:
    """Numbers (C,) of all constraints and those with rows at instants ``old``, for ``new`` ones, that have others.

    A constraint that had no such rows has the number of its rows at the nodes.
    """
    count = len(values) - len(old.constraints)
    known = dict(zip(old.constraints, values[count:], strict=True))
    return np.array([*values[:count], *(known.get(i, values[i]) for i in new.constraints)])


def _blocked(found: Solution) -> bool:
    """Whether a round's search ended although its model expects much less, which says nothing about constraints."""
    if found.status in (Status.INDEFINITE, Status.NOT_DIFFERENTIABLE):
        return True
    expected = max((item.expected_decrease for item in found.history[-PATIENCE:]), default=0.0)
    return found.status is Status.STALLED and expected > _MUCH * abs(found.cost)
