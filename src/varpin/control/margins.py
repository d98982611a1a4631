"""Margins by count: how often motions under noise violate a bound, and how wide its margin has to be, (O13)."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.special import ndtr

from varpin.arrays import Floats, Mask
from varpin.control.constraints import BoundConstraint
from varpin.control.history import Status
from varpin.control.multipliers import at_nodes, split
from varpin.control.noise import deviations
from varpin.control.paths import Chunk, chunks_of, sent, shared_by
from varpin.control.solution import Solution
from varpin.control.stages import Feedback, Steps
from varpin.ensemble.paths import simulate_paths
from varpin.errors import VarpinError
from varpin.finding import Finding
from varpin.mechanics.wiener import Children, children, wiener_increments
from varpin.simulation.failures import NoiseError, StepFailure
from varpin.support.executors import executing, in_order
from varpin.support.frozen import Frozen

# Motions that choose the rows to count. Motions that are counted: _FIRST, then twice as many until standard errors of
# shares are at most _SHARP of what is promised, up to _MOST; and _ALONE where only Python evaluates the noise.
_CHOOSING, _FIRST, _SHARP, _MOST, _ALONE = 256, 512, 0.12, 8192, 512
# Standard errors above what is promised at which margins become wider. How much more often than promised, beyond
# _DOUBT standard errors, a bound is violated for a warning.
_CLEARLY, _OFTEN, _DOUBT = 1.0, 1.2, 2.0
# Motions beyond a quantile that determine it, and the share of motions from which the tail beyond is extrapolated.
_ENOUGH, _TAIL = 20, 0.02
# Rows within _NEAR times their margin and _NEARER deviations of the plan are counted, and those that motions violate.
_NEAR, _NEARER = 1.5, 0.5
# Nodes to either side over which what is added to margins is averaged.
_BESIDE = 2
# Seeds of these motions, which are no user's: those of a count, of a look at a finished plan, and of its warnings.
_SEED, _COUNT, _LOOK, _WARN = 0x76A3, 0, 1, 2


@dataclass(frozen=True, eq=False)
class _Row(Frozen):
    """Rows of a constraint with a margin that are counted.

    Attributes:
        bound: The constraint.
        near: Which rows at which places (K, rows), R in all.
        planned: Values of all in the plan (K, rows).
        slopes: d(value)/dx (K, rows, 2n).
        own: Standard deviations of all in the linear model (K, rows).
        simple: The same where the strength of the noise stays that along the plan (K, rows).
        margin: Margins of all in the plan (K, rows).
        added: The share of counted motions in these (K, rows).
    """

    bound: BoundConstraint
    near: Mask
    planned: Floats
    slopes: Floats
    own: Floats
    simple: Floats
    margin: Floats
    added: Floats

    @property
    def promised(self) -> float:
        """Share of the motions that the margin allows."""
        return float(ndtr(-self.bound.source.margin))


@dataclass(frozen=True, eq=False)
class _Counted(Frozen):
    """P motions under noise, and the linear model under the same noise.

    Attributes:
        values: c in each motion (P, R).
        outside: Whether the linear model violates the bound (P, R).
        beyond: Whether it is more than the margin's standard deviations beyond the plan (P, R).
    """

    values: Floats
    outside: Mask
    beyond: Mask

    def shares(self, row: _Row) -> tuple[Floats, Floats]:
        """Shares of the motions that violate each row (R,), and standard errors (R,).

        The share of the linear model is known, and most motions agree with it: it is a control variate.
        """
        planned, simple = row.planned[row.near], row.simple[row.near]
        known = np.where(simple > 0.0, ndtr(planned / np.where(simple > 0.0, simple, 1.0)), 0.0)
        apart = (self.values > 0.0).astype(float) - self.outside
        share = np.clip(known + apart.mean(axis=0), 0.0, 1.0)
        return share, np.maximum(apart.std(axis=0) / math.sqrt(len(apart)), 1.0 / len(apart))

    def needed(self, row: _Row) -> Floats:
        """Distances from the plan that motions exceed as often as promised (R,), and a standard error more."""
        planned, simple, P = row.planned[row.near], row.simple[row.near], len(self.values)
        found = np.empty(len(planned))
        for r in range(len(planned)):
            c, promised = self.values[:, r] - planned[r], row.promised
            if promised * P >= _ENOUGH:
                # As many motions exceed such a quantile as exceed that of the linear model, which is known.
                share = float(self.beyond[:, r].mean()) if simple[r] > 0.0 else promised
                differ = float(((c > np.quantile(c, 1.0 - share)) != self.beyond[:, r]).mean())
                found[r] = np.quantile(c, 1.0 - max(share - math.sqrt(differ / P), 0.5 * promised))
                continue
            # An exponential tail, which is heavier than that of a normal distribution.
            tail = max(_TAIL, _ENOUGH / P)
            begin = float(np.quantile(c, 1.0 - tail))
            mean = float(c[c > begin].mean()) - begin
            found[r] = begin + mean * (1.0 + 1.0 / math.sqrt(tail * P)) * math.log(tail / promised)
        return found


def _joined(parts: Sequence[_Counted]) -> _Counted:
    """The motions of all parts that got to the end."""
    values = np.concatenate([part.values for part in parts])
    outside = np.concatenate([part.outside for part in parts])
    beyond = np.concatenate([part.beyond for part in parts])
    finished = np.isfinite(values).all(axis=1)
    return _Counted(values[finished], outside[finished], beyond[finished])


def widened(plan: Solution, deadline: float = math.inf) -> list[Floats] | None:
    """What has to be added to margins (K, rows) for each constraint, in its unit, (O13); None if they suffice.

    Margins are of the linear model. Where noise is strong, or where it follows the controls, values in motions are not
    normally distributed, and violate bounds more often. Nothing is added where only Python evaluates the noise, as
    counting would take long.

    Args:
        plan: The plan, with its margins.
        deadline: When counting ends, of ``time.perf_counter``.

    Raises:
        VarpinError: Motions cannot be counted: most fail, or the time is up.
    """
    problem = plan.problem
    if problem.scene.noise.diffusion is None:
        return None
    model = _Model.along(plan)
    # The same noise in every count: what is left of a violation is then that of the plan, not of other noise.
    rows = _chosen(plan, model, (_COUNT, 0))
    counted = _counted(plan, model, rows, (_COUNT, 1), deadline=deadline)
    enough = True
    found = [np.zeros(bound.shape) for bound in problem.bound_constraints]
    for row, motions in zip(rows, counted, strict=True):
        share, error = motions.shares(row)
        enough = enough and bool((share - _CLEARLY * error <= row.promised).all())
        more = motions.needed(row) - row.bound.source.margin * row.own[row.near]
        more = np.where(share > row.promised, np.maximum(more, row.added[row.near]), row.added[row.near])
        found[problem.bound_constraints.index(row.bound)] = _spread(row, more)
    return None if enough else found


def _spread(row: _Row, more: Floats) -> Floats:
    """Distances (K, rows) from those of the rows that are counted: no smaller than around them.

    In between they are as many deviations as there, and no longer: the first nodes have next to none.
    """
    near, whole = row.near, row.added.copy()
    whole[near] = more
    places = np.arange(len(near))
    for r in np.flatnonzero(near.any(axis=0)):
        known, left = np.flatnonzero(near[:, r]), np.flatnonzero(~near[:, r])
        own = row.own[:, r]
        shares = whole[known, r] / np.where(own[known] > 0.0, own[known], np.inf)
        distances = np.interp(places[left], known, whole[known, r])
        fewer = np.minimum(distances, np.interp(places[left], known, shares) * own[left])
        whole[left, r] = np.maximum(fewer, row.added[left, r])
    around = ndimage.uniform_filter1d(whole, 2 * _BESIDE + 1, axis=0, mode="nearest")
    found: Floats = np.where(near, np.maximum(whole, around), whole)
    return found


def too_small(solution: Solution) -> list[Finding]:
    """Findings about constraints whose margin is too small, as noise is too strong for it."""
    problem, known = solution.problem, solution.multipliers
    if not problem.scene.processes or known is None or solution.status is Status.INFEASIBLE:
        return []
    if not any(bound.source.margin > 0.0 for bound in problem.bound_constraints):
        return []
    try:
        model = _Model.along(solution)
        chosen = []
        rows = _chosen(solution, model, (_LOOK, 0))
        for row, motions in zip(rows, _counted(solution, model, rows, (_LOOK, 1), sharp=np.inf), strict=True):
            share, _ = motions.shares(row)
            if share.max() > _OFTEN * row.promised:
                one = np.zeros_like(row.near)
                one[tuple(np.argwhere(row.near)[share.argmax()])] = True
                chosen.append(replace(row, near=one))
        # The choice would make the same motions count too many.
        counted = _counted(solution, model, chosen, (_WARN, 0))
    except VarpinError as error:
        return [
            Finding("margins not counted", f"how often motions violate bounds with a margin= is not known: {error}")
        ]
    found = [_told(solution, row, motions) for row, motions in zip(chosen, counted, strict=True)]
    return [finding for finding in found if finding is not None]


def _told(solution: Solution, row: _Row, counted: _Counted) -> Finding | None:
    """A finding if a row at a place is clearly violated more often than promised."""
    bound, margin = row.bound, row.bound.source.margin
    (often,), (error,) = counted.shares(row)
    if often - _DOUBT * error <= _OFTEN * row.promised:
        return None
    place, r = np.argwhere(row.near)[0]
    needed = float(counted.needed(row)[0])
    if solution.problem.scene.noise.diffusion is None:
        enough = math.ceil(10.0 * needed / row.own[place, r]) / 10.0
        advice = f"margin={enough:g} is about enough there"
    else:
        narrower = needed - row.margin[place, r]
        unit = bound.unit
        advice = (
            f"a bound narrower by {narrower:.2g} {unit} may do"
            if narrower > 0.0
            else "less noise or a wider bound may do"
        )
    return Finding(
        "small margin",
        f"{solution.problem.label_of(bound.source)}: margin={margin:g} is too small for this noise: {bound.rows[r]} at "
        f"t = {bound.times[place]:.4g} s is violated by {100.0 * often:.3g} +- {100.0 * error:.1g} % of "
        f"{len(counted.values)} motions, not {100.0 * row.promised:.2g} %; {advice}",
        time=float(bound.times[place]),
        value=float(often),
    )


@dataclass(frozen=True, eq=False)
class _Model(Frozen):
    """The linear model along a plan under feedback.

    Attributes:
        steps: The steps.
        feedback: The gains.
    """

    steps: Steps
    feedback: Feedback

    @classmethod
    def along(cls, plan: Solution) -> _Model:
        """The model along a plan.

        Raises:
            LinearizationError: A step has no derivatives.
        """
        return cls(Steps(plan.problem, plan.trajectory), Feedback(plan.gains, plan.previous_gains))

    def deviations(self, dw: Floats) -> Floats:
        """Deviations of the state from the plan (P, N + 1, 2n) under increments (P, N, k), to first order."""
        J, G, T = self.steps.J, self.steps.lin.G, self.steps.closed(self.feedback)
        N, x, Z = J.shape
        found, y = np.zeros((len(dw), N + 1, x)), np.zeros((len(dw), Z))
        for k in range(N):
            z = y @ T[k].T
            y = np.hstack([z @ J[k].T + dw[:, k] @ G[k].T, z[:, x:]])
            found[:, k + 1] = y[:, :x]
        return found


def _chosen(plan: Solution, model: _Model, seed: tuple[int, ...]) -> list[_Row]:
    """The rows to count: those that the plan is near, and those that a few motions violate more often than promised.

    Raises:
        VarpinError: Fewer than half of the motions get to the end.
    """
    problem, motion, known = plan.problem, plan.trajectory, plan.multipliers
    assert known is not None
    u, constant = problem.control_rows(motion), copy(model.steps)
    vars(constant)["_in_step"] = model.steps.J, np.zeros_like(model.steps.Gz)
    rows = []
    bounds, margins = problem.bound_constraints, at_nodes(problem, known, known.backoff)
    added = [np.zeros(bound.shape) for bound in bounds] if known.added is None else split(bounds, known.added)
    for bound, margin, more in zip(bounds, margins, added, strict=True):
        if not bound.source.margin > 0.0:
            continue
        slopes = bound.jacobian(motion.q, motion.v) @ model.steps.slopes[bound.places]
        own, simple = (deviations(steps, model.feedback, [bound])[0] for steps in (model.steps, constant))
        planned = bound.value(motion.q, motion.v, u)
        rows.append(_Row(bound, np.ones(bound.shape, dtype=bool), planned, slopes, own, simple, margin, more))
    found = []
    few = _played(plan, model, rows, _children(seed, _CHOOSING), 0, _CHOOSING)
    for row, motions in zip(rows, few, strict=True):
        close = -row.planned <= _NEAR * row.margin + _NEARER * row.own
        near = (close & (row.own > 0.0)) | ((motions.values > 0.0).mean(axis=0) > row.promised).reshape(close.shape)
        if near.any():
            found.append(replace(row, near=near))
    return found


def _children(seed: tuple[int, ...], paths: int) -> Children:
    """The seeds of motions."""
    return children(np.random.default_rng([_SEED, *seed]), paths)


def _counted(
    plan: Solution,
    model: _Model,
    rows: list[_Row],
    seed: tuple[int, ...],
    *,
    sharp: float = _SHARP,
    deadline: float = math.inf,
) -> list[_Counted]:
    """Motions under noise: as many as shares take whose errors are ``sharp`` of what is promised.

    Raises:
        VarpinError: Fewer than half of the motions get to the end, or the time is up.
    """
    if not rows:
        return []
    alone = plan.problem.scene.noise.diffusion is None
    seeds, first, last = _children(seed, _MOST), 0, _ALONE if alone else _FIRST
    found: list[_Counted] = []
    while True:
        if time.perf_counter() > deadline:
            raise VarpinError("the time is up")
        more = _played(plan, model, rows, seeds, first, last)
        found = [_joined(pair) for pair in zip(found, more, strict=True)] if found else more
        errors = (one.shares(row)[1].max() / row.promised for one, row in zip(found, rows, strict=True))
        if alone or last >= _MOST or max(errors) <= sharp:
            return found
        first, last = last, 2 * last


def _played(plan: Solution, model: _Model, rows: list[_Row], seeds: Children, first: int, last: int) -> list[_Counted]:
    """The motions of the seeds first, ..., last - 1.

    Raises:
        VarpinError: Fewer than half of the motions get to the end.
    """
    problem = sent(plan.problem)

    def of_motions(q: Floats, v: Floats, dw: Floats) -> list[_Counted]:
        no_controls = np.zeros((len(q), problem.decisions, problem.scene.controls))
        x, found = model.deviations(dw), []
        for row in rows:
            linear = np.einsum("krx,Pkx->Pkr", row.slopes, x[:, row.bound.places])[:, row.near]
            moves, limit = row.simple[row.near] > 0.0, row.bound.source.margin * row.simple[row.near]
            values = row.bound.value(q, v, no_controls)[:, row.near]
            outside, beyond = moves & (linear > -row.planned[row.near]), moves & (linear > limit)
            found.append(_Counted(values, outside, beyond))
        return found

    def together(chunk: Chunk) -> list[_Counted]:
        task = chunk.task
        dw = np.stack([task.shared.drawn(each) for each in seeds.generators(task.first, task.first + len(task.q0))])
        stored = simulate_paths(task).stored
        return of_motions(stored["q"], stored["v"], dw)

    shared = shared_by(problem, plan.policy, seeds)
    parts: list[list[_Counted]] = []
    if shared is not None:
        with executing(None, None) as pool:
            parts += in_order(pool, together, chunks_of(problem, shared, first, last))
    else:
        width = problem.scene.increments(linear=problem.linear)
        for generator in seeds.generators(first, last):
            dw = wiener_increments(width, problem.dt, problem.steps, generator)
            try:
                motion = problem.simulate(plan.policy, increments=dw)
            except (StepFailure, NoiseError):
                continue
            parts.append(of_motions(motion.q[None], motion.v[None], dw[None]))
    found = [_joined(of_row) for of_row in zip(*parts, strict=True)]
    left = len(found[0].values) if found else 0
    if rows and 2 * left < last - first:
        raise VarpinError(f"{last - first - left} of {last - first} motions under noise fail")
    return found
