"""Whether margins suffice: motions under noise beside the linear model that margins come from."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr, ndtri

from varpin.arrays import Floats, Mask
from varpin.control.constraints import BoundConstraint
from varpin.control.history import Status
from varpin.control.linear_controls import in_step
from varpin.control.multipliers import at_nodes
from varpin.control.solution import Solution
from varpin.control.spread import Feedback, decided, deviations, state_slopes
from varpin.errors import VarpinError
from varpin.linearization import linearize_steps
from varpin.mechanics.wiener import wiener_increments
from varpin.simulation.soundness import Finding

# Pairs of motions with opposite noise, and how much more often than promised a bound may be violated.
_PAIRS, _OFTEN = 32, 1.2
# Standard errors that count in favour of the margin.
_DOUBT = 2.0
# Further motions: those that choose one of the bounds that the pairs point at, and those that count how often it is
# violated. The choice would make the first ones count too many.
_CHOOSING, _COUNTING = 256, 1024
# Motions beyond a quantile that determine it.
_ENOUGH = 10


def too_small(solution: Solution) -> list[Finding]:
    """Findings about constraints whose margin is too small, as noise is too strong for the linear model.

    Motions are played with noise and with its opposite. The mean of a value over such a pair has only terms of even
    order, and differences from the linear model have none of first order, so a few pairs suffice to point at bounds.
    Further motions are played where they do, and count.
    """
    problem = solution.problem
    if not problem.scene.processes or solution.multipliers is None or solution.status is Status.INFEASIBLE:
        return []
    margins = at_nodes(problem, solution.multipliers, solution.multipliers.backoff)
    bounds = [bound for bound, margin in zip(problem.bound_constraints, margins, strict=True) if margin.any()]
    if not bounds:
        return []
    rng = np.random.default_rng(0)
    try:
        suspects = [(bound, rows) for bound, rows in _suspects(solution, bounds, rng) if rows.any()]
        if not suspects:
            return []
        chosen, counts = [], _values(solution, [bound for bound, _ in suspects], _CHOOSING, rng)
        for (bound, rows), c in zip(suspects, counts, strict=True):
            share = np.where(rows, (c > 0.0).mean(axis=0), 0.0)
            place, row = np.unravel_index(int(share.argmax()), share.shape)
            if share.max() > _OFTEN * ndtr(-bound.source.margin):
                chosen.append((bound, int(place), int(row)))
        if not chosen:
            return []
        values = _values(solution, [bound for bound, *_ in chosen], _COUNTING, rng)
    except VarpinError:
        # Without such motions nothing is known; plan.monte_carlo() tells of motions that fail.
        return []
    found = [_told(solution, *at, c[:, at[1], at[2]]) for at, c in zip(chosen, values, strict=True)]
    return [finding for finding in found if finding is not None]


def _told(solution: Solution, bound: BoundConstraint, place: int, row: int, c: Floats) -> Finding | None:
    """A finding if a row at a place is clearly violated more often than promised, by its values (P,) of motions."""
    problem, motion, margin = solution.problem, solution.trajectory, bound.source.margin
    promised, often = float(ndtr(-margin)), float((c > 0.0).mean())
    error = math.sqrt(often * (1.0 - often) / len(c))
    if often - _DOUBT * error <= _OFTEN * promised:
        return None
    planned = float(bound.value(motion.q, motion.v, problem.control_rows(motion))[place, row])
    feedback = Feedback(solution.gains, solution.previous_gains)
    deviation = float(deviations(problem, motion, feedback, bound)[place, row])
    if promised * len(c) >= _ENOUGH:
        needed = float(np.quantile(c, 1.0 - promised)) - planned
    else:
        # As if the values were normally distributed with the share that is violated.
        needed = planned * margin / float(ndtri(often))
    return Finding(
        "small margin",
        f"{problem.label_of(bound.source)}: margin={margin:g}, which is of the linear model, is too small for this "
        f"noise: {bound.rows[row]} at t = {bound.times[place]:.4g} s is violated by {100.0 * often:.2g} +- "
        f"{100.0 * error:.1g} % of all motions, not {100.0 * promised:.2g} %, as {len(c)} motions under noise say; "
        f"margin={math.ceil(10.0 * needed / deviation) / 10.0:g} is about enough there, and simulate_ensemble counts",
    )


def _values(solution: Solution, bounds: list[BoundConstraint], paths: int, rng: np.random.Generator) -> list[Floats]:
    """Values (P, K, rows) of each bound in motions under noise.

    Raises:
        VarpinError: A motion fails.
    """
    problem = solution.problem
    found: list[Floats] = [np.zeros((paths, *bound.shape)) for bound in bounds]
    for path, child in enumerate(rng.spawn(paths)):
        motion = problem.simulate(solution.policy, rng=child)
        for values, bound in zip(found, bounds, strict=True):
            values[path] = bound.value(motion.q, motion.v, problem.control_rows(motion))
    return found


def _suspects(
    solution: Solution, bounds: list[BoundConstraint], rng: np.random.Generator
) -> list[tuple[BoundConstraint, Mask]]:
    """Which rows (K, rows) of each bound a few pairs of motions point at.

    Raises:
        VarpinError: A motion fails.
    """
    problem, motion = solution.problem, solution.trajectory
    width = problem.scene.increments(linear=problem.linear)
    dw = np.stack([wiener_increments(width, problem.dt, problem.steps, rng) for _ in range(_PAIRS)])
    linear = _linear(solution, dw)
    ahead, back = ([problem.simulate(solution.policy, increments=sign * noise) for noise in dw] for sign in (1.0, -1.0))
    found = []
    slopes = state_slopes(problem, motion)
    feedback = Feedback(solution.gains, solution.previous_gains)
    for bound in bounds:
        c, J = bound.value(motion.q, motion.v, problem.control_rows(motion)), bound.jacobian(motion.q, motion.v)
        first = np.einsum("krx,Pkx->Pkr", J @ slopes[bound.places], linear[:, bound.places])
        plus, minus = (
            np.stack([bound.value(each.q, each.v, problem.control_rows(each)) for each in part])
            for part in (ahead, back)
        )
        even, odd = 0.5 * (plus + minus) - c, 0.5 * (plus - minus)
        planned = deviations(problem, motion, feedback, bound)
        square = (first**2).sum(axis=0)
        share = np.where(square > 0.0, (odd * first).sum(axis=0) / np.where(square > 0.0, square, 1.0), 1.0)
        left = ((odd - share * first) ** 2).mean(axis=0)
        spread = np.sqrt((share * planned) ** 2 + left + even.var(axis=0))
        shift = even.mean(axis=0)
        doubt = _DOUBT * even.std(axis=0) / math.sqrt(_PAIRS)
        least = np.where(planned > 0.0, (c + shift - doubt) / np.where(spread > 0.0, spread, 1.0), -np.inf)
        found.append((bound, ndtr(least) > _OFTEN * ndtr(-bound.source.margin)))
    return found


def _linear(solution: Solution, dw: Floats) -> Floats:
    """Deviations of the state from the plan (P, N + 1, 2n) under increments (P, N, k), to first order."""
    problem, motion = solution.problem, solution.trajectory
    lin = linearize_steps(problem.scene, motion, problem.integrator, problem.q0, ramps=problem.linear)
    J, x, m = in_step(lin)[0], lin.A.shape[1], problem.scene.controls
    feedback = Feedback(solution.gains, solution.previous_gains)
    found, y = np.zeros((len(dw), lin.steps + 1, x)), np.zeros((len(dw), x + m))
    for k in range(lin.steps):
        T = decided(problem, feedback, k, x)
        z = y if T is None else y @ T.T
        y = np.hstack([z @ J[k].T + dw[:, k] @ lin.G[k].T, z[:, -m:]])
        found[:, k + 1] = y[:, :x]
    return found
