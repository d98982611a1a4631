"""Margins by count: how often motions under noise violate a bound, and what a margin has to be for that, (P5)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.special import ndtr

from varpin.arrays import Floats, Mask
from varpin.control.constraints import BoundConstraint
from varpin.control.history import Status
from varpin.control.linear_controls import in_step
from varpin.control.multipliers import at_nodes
from varpin.control.paths import Chunk, chunks_of, sent, shared_by
from varpin.control.problem import OptimalControlProblem
from varpin.control.solution import Solution
from varpin.control.spread import Feedback, decided, propagated, state_slopes
from varpin.ensemble.paths import simulate_paths
from varpin.errors import VarpinError
from varpin.linearization import linearize_steps
from varpin.mechanics.wiener import Children, children
from varpin.simulation.soundness import Finding
from varpin.support.executors import executing, in_order
from varpin.support.frozen import Frozen

# Motions that are counted: at first, then twice as many until standard errors of shares are at most _SHARP of what is
# promised, and at most; and where only Python evaluates the noise.
_FIRST, _SHARP, _MOST, _ALONE = 1024, 0.12, 8192, 512
# How much more often than promised a bound is violated for wider margins, and, beyond doubt, for a warning.
_MORE, _OFTEN = 1.05, 1.2
# Standard errors of doubt, and those by which wider margins are on the safe side.
_DOUBT, _SAFE = 2.0, 1.0
# Motions beyond a quantile that determine it, and the share of motions from which the tail beyond is extrapolated.
_ENOUGH, _TAIL = 20, 0.02
# Bounds within _NEAR times their margin and _NEARER deviations are looked at.
_NEAR, _NEARER = 1.5, 0.5
# Nodes to either side over which what is added to margins is averaged.
_BESIDE = 2


@dataclass(frozen=True, eq=False)
class _Row(Frozen):
    """Rows of a constraint with a margin, at the places where the plan is near them.

    Attributes:
        bound: The constraint.
        near: Which rows at which places (K, rows), R in all.
        planned: Their values in the plan (R,).
        slopes: d(value)/dx (K, rows, 2n).
        own: Their standard deviations in the linear model (R,).
        simple: The same where the strength of the noise stays that along the plan (R,).
    """

    bound: BoundConstraint
    near: Mask
    planned: Floats
    slopes: Floats
    own: Floats
    simple: Floats

    @property
    def promised(self) -> float:
        """Share of the motions that the margin allows."""
        return float(ndtr(-self.bound.source.margin))


@dataclass(frozen=True, eq=False)
class _Counted(Frozen):
    """Values of the rows near their bounds in P motions under noise, and to first order under the same noise.

    Attributes:
        values: c (P, R).
        linear: Deviations from the plan to first order, in standard deviations (P, R).
    """

    values: Floats
    linear: Floats

    def shares(self, row: _Row) -> tuple[Floats, Floats]:
        """Shares of the motions that violate each row (R,), and standard errors (R,).

        The share in the linear model is known, and motions mostly agree with it: it is a control variate.
        """
        apart = (self.values > 0.0).astype(float) - (self.linear > row.bound.source.margin)
        share = np.clip(row.promised + apart.mean(axis=0), 0.0, 1.0)
        return share, np.maximum(apart.std(axis=0) / math.sqrt(len(apart)), 1.0 / len(apart))

    def and_more(self, other: _Counted) -> _Counted:
        """These motions and others."""
        return _Counted(np.concatenate([self.values, other.values]), np.concatenate([self.linear, other.linear]))

    def needed(self, row: _Row) -> Floats:
        """Distances from the plan that motions exceed as often as promised, on the safe side (R,).

        As many motions exceed such a quantile as exceed that of the linear model, which is known.
        """
        beyond = self.linear > row.bound.source.margin
        found = np.empty(len(row.planned))
        for r, exceeding in enumerate(beyond.mean(axis=0)):
            c = self.values[:, r] - row.planned[r]
            differ = (c > np.quantile(c, 1.0 - exceeding)) != beyond[:, r]
            share = max(exceeding - _SAFE * math.sqrt(differ.mean() / len(c)), 0.5 * row.promised)
            if share * len(c) >= _ENOUGH:
                found[r] = np.quantile(c, 1.0 - share)
                continue
            # An exponential tail, which is heavier than that of a normal distribution.
            begin = float(np.quantile(c, 1.0 - _TAIL))
            found[r] = begin + (c[c > begin].mean() - begin) * math.log(_TAIL / share)
        return found


def widened(plan: Solution) -> list[Floats] | None:
    """What has to be added to margins (K, rows) for each constraint, in its unit, (P5); None if they suffice.

    Margins are of the linear model. Where noise is strong, or where it follows the controls, values in motions are not
    normally distributed, and violate bounds more often. None, too, where motions fail or only Python evaluates the
    noise, as counting would take long.
    """
    problem = plan.problem
    if problem.scene.noise.diffusion is None:
        return None
    try:
        rows = _rows(plan)
        counted = _counted(plan, rows, 0)
    except VarpinError:
        # Without such motions nothing is known; plan.monte_carlo() tells of motions that fail.
        return None
    enough = True
    found = [np.zeros(bound.shape) for bound in problem.bound_constraints]
    for row, motions in zip(rows, counted, strict=True):
        enough = enough and bool((motions.shares(row)[0] <= _MORE * row.promised).all())
        more = np.maximum(motions.needed(row) - row.bound.source.margin * row.own, 0.0)
        found[problem.bound_constraints.index(row.bound)] = _spread(row.near, more)
    return None if enough else found


def _spread(near: Mask, more: Floats) -> Floats:
    """Distances (K, rows) from those of rows near bounds: no smaller than around them, and in between elsewhere."""
    whole = np.zeros(near.shape)
    whole[near] = more
    places = np.arange(len(near))
    for r in np.flatnonzero(near.any(axis=0)):
        known = np.flatnonzero(near[:, r])
        whole[:, r] = np.interp(places, known, whole[known, r])
    around = ndimage.uniform_filter1d(whole, 2 * _BESIDE + 1, axis=0, mode="nearest")
    found: Floats = np.maximum(whole, around)
    return found


def too_small(solution: Solution) -> list[Finding]:
    """Findings about constraints whose margin is too small, as noise is too strong for the linear model."""
    problem = solution.problem
    if not problem.scene.processes or solution.multipliers is None or solution.status is Status.INFEASIBLE:
        return []
    try:
        chosen = []
        rows = _rows(solution)
        looked = _counted(solution, rows, 1, sharp=np.inf)
        for row, motions in zip(rows, looked, strict=True):
            share, _ = motions.shares(row)
            if share.max() > _OFTEN * row.promised:
                one = np.zeros_like(row.near)
                one[tuple(np.argwhere(row.near)[share.argmax()])] = True
                chosen.append(_only(row, one))
        # The choice would make the same motions count too many.
        counted = _counted(solution, chosen, 2)
    except VarpinError:
        return []
    found = [_told(solution, row, motions) for row, motions in zip(chosen, counted, strict=True)]
    return [finding for finding in found if finding is not None]


def _only(row: _Row, near: Mask) -> _Row:
    """Some of the rows."""
    some = near[row.near]
    return _Row(row.bound, near, row.planned[some], row.slopes, row.own[some], row.simple[some])


def _told(solution: Solution, row: _Row, counted: _Counted) -> Finding | None:
    """A finding if a row at a place is clearly violated more often than promised."""
    bound, margin = row.bound, row.bound.source.margin
    (often,), (error,) = counted.shares(row)
    if often - _DOUBT * error <= _OFTEN * row.promised:
        return None
    place, r = np.argwhere(row.near)[0]
    enough = math.ceil(10.0 * counted.needed(row)[0] / row.own[0]) / 10.0
    return Finding(
        "small margin",
        f"{solution.problem.label_of(bound.source)}: margin={margin:g}, which is of the linear model, is too small for "
        f"this noise: {bound.rows[r]} at t = {bound.times[place]:.4g} s is violated by {100.0 * often:.2g} +- "
        f"{100.0 * error:.1g} % of all motions, not {100.0 * row.promised:.2g} %, as {len(counted.values)} motions "
        f"under noise say; margin={enough:g} is about enough there, and plan.monte_carlo counts",
    )


def _rows(plan: Solution) -> list[_Row]:
    """The rows of constraints with a margin that the plan is near.

    Raises:
        VarpinError: The plan's steps have no derivatives.
    """
    problem, motion, known = plan.problem, plan.trajectory, plan.multipliers
    assert known is not None
    margins = at_nodes(problem, known, known.backoff)
    kept = [(bound, b) for bound, b in zip(problem.bound_constraints, margins, strict=True) if b.any()]
    if not kept:
        return []
    lin = linearize_steps(problem.scene, motion, problem.integrator, problem.q0, ramps=problem.linear)
    (J, gz), x = in_step(lin), lin.A.shape[1]
    feedback = Feedback(plan.gains, plan.previous_gains)
    spreads = [propagated(J, lin.G, part, problem, feedback)[:, :x, :x] for part in (gz, np.zeros_like(gz))]
    to_state, u = state_slopes(problem, motion), problem.control_rows(motion)
    found = []
    for bound, b in kept:
        slopes = bound.jacobian(motion.q, motion.v) @ to_state[bound.places]
        own, simple = (
            np.sqrt(np.maximum(np.einsum("krx,kxy,kry->kr", slopes, part[bound.places], slopes), 0.0))
            for part in spreads
        )
        c = bound.value(motion.q, motion.v, u)
        near = (simple > 0.0) & (-c <= _NEAR * b + _NEARER * own)
        if near.any():
            found.append(_Row(bound, near, c[near], slopes, own[near], simple[near]))
    return found


def _counted(plan: Solution, rows: list[_Row], seed: int, sharp: float = _SHARP) -> list[_Counted]:
    """Motions under noise from a seed: as many as shares take whose errors are ``sharp`` of what is promised.

    Raises:
        VarpinError: Fewer than half of the motions get to the end.
    """
    if not rows:
        return []
    alone = plan.problem.scene.noise.diffusion is None
    seeds, first, last = children(seed, _MOST), 0, _ALONE if alone else _FIRST
    found: list[_Counted] = []
    while True:
        more = _played(plan, rows, seeds, first, last)
        found = [one.and_more(two) for one, two in zip(found, more, strict=True)] if found else more
        errors = (one.shares(row)[1].max() / row.promised for one, row in zip(found, rows, strict=True))
        if alone or last >= _MOST or max(errors) <= sharp:
            return found
        first, last = last, 2 * last


def _played(plan: Solution, rows: list[_Row], seeds: Children, first: int, last: int) -> list[_Counted]:
    """The motions of the seeds first, ..., last - 1.

    Raises:
        VarpinError: Fewer than half of the motions get to the end.
    """
    problem = sent(plan.problem)
    lin = linearize_steps(
        plan.problem.scene, plan.trajectory, problem.integrator, problem.q0, ramps=plan.problem.linear
    )
    J, G = in_step(lin)[0], lin.G
    feedback = Feedback(plan.gains, plan.previous_gains)

    def linear(dw: Floats) -> list[Floats]:
        x = _linear(problem, J, G, feedback, dw)
        return [np.einsum("krx,Pkx->Pkr", row.slopes, x[:, row.bound.places])[:, row.near] / row.simple for row in rows]

    def values(q: Floats, v: Floats) -> list[Floats]:
        no_controls = np.zeros((len(q), problem.decisions, problem.scene.controls))
        return [row.bound.value(q, v, no_controls)[:, row.near] for row in rows]

    def together(chunk: Chunk) -> list[tuple[Floats, Floats]]:
        task = chunk.task
        dw = np.stack([task.shared.drawn(each) for each in seeds.generators(task.first, task.first + len(task.q0))])
        stored = simulate_paths(task).stored
        return list(zip(values(stored["q"], stored["v"]), linear(dw), strict=True))

    shared = shared_by(problem, plan.policy, seeds)
    parts: list[list[tuple[Floats, Floats]]] = []
    if shared is not None:
        with executing(None, None) as pool:
            parts += in_order(pool, together, chunks_of(problem, shared, first, last))
    else:
        size = problem.steps, problem.scene.increments(linear=problem.linear)
        for generator in seeds.generators(first, last):
            dw = generator.normal(scale=math.sqrt(problem.dt), size=size)
            motion = problem.simulate(plan.policy, increments=dw)
            parts.append(list(zip(values(motion.q[None], motion.v[None]), linear(dw[None]), strict=True)))
    found = []
    for pairs in zip(*parts, strict=True):
        c, deviation = (np.concatenate(part) for part in zip(*pairs, strict=True))
        finished = np.isfinite(c).all(axis=1)
        if 2 * finished.sum() < len(c):
            raise VarpinError(f"{len(c) - int(finished.sum())} of {len(c)} motions under noise fail")
        found.append(_Counted(c[finished], deviation[finished]))
    return found


def _linear(problem: OptimalControlProblem, J: Floats, G: Floats, feedback: Feedback, dw: Floats) -> Floats:
    """Deviations of the state from the plan (P, N + 1, 2n) under increments (P, N, K), to first order."""
    x, m = J.shape[1], problem.scene.controls
    found, y = np.zeros((len(dw), len(J) + 1, x)), np.zeros((len(dw), x + m))
    for k in range(len(J)):
        T = decided(problem, feedback, k, x)
        z = y if T is None else y @ T.T
        y = np.hstack([z @ J[k].T + dw[:, k] @ G[k].T, z[:, -m:]])
        found[:, k + 1] = y[:, :x]
    return found
