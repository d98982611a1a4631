"""Whether margins suffice: motions under noise beside the linear model that margins come from."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr

from varpin.arrays import Floats
from varpin.control.history import Status
from varpin.control.linear_controls import in_step
from varpin.control.multipliers import at_nodes
from varpin.control.solution import Solution
from varpin.control.spread import Feedback, decided, state_slopes
from varpin.errors import VarpinError
from varpin.linearization import linearize_steps
from varpin.mechanics.wiener import wiener_increments
from varpin.simulation.soundness import Finding

# Pairs of motions with opposite noise, and how much more often than promised a bound may be violated.
_PAIRS, _OFTEN = 32, 1.2
# Standard errors of the second-order part of a value that count in favour of the margin.
_DOUBT = 2.0


def too_small(solution: Solution) -> list[Finding]:
    """Findings about constraints whose margin is too small, as noise is too strong for the linear model.

    Motions are played with noise and with its opposite. The mean of a value over such a pair has only terms of even
    order, and differences from the linear model have none of first order, so a few pairs suffice.
    """
    problem = solution.problem
    if not problem.scene.processes or solution.multipliers is None or solution.status is Status.INFEASIBLE:
        return []
    margins = at_nodes(problem, solution.multipliers, solution.multipliers.backoff)
    bounds = [(b, a) for b, a in zip(problem.bound_constraints, margins, strict=True) if a.any()]
    if not bounds:
        return []
    motion, rng = solution.trajectory, np.random.default_rng(0)
    width = problem.scene.increments(linear=problem.linear)
    dw = np.stack([wiener_increments(width, problem.dt, problem.steps, rng) for _ in range(_PAIRS)])
    try:
        linear = _linear(solution, dw)
        ahead, back = (
            [problem.simulate(solution.policy, increments=sign * noise) for noise in dw] for sign in (1.0, -1.0)
        )
    except VarpinError:
        # Without such motions nothing is known; plan.monte_carlo() tells of motions that fail.
        return []
    found = []
    slopes = state_slopes(problem, motion)
    for bound, backoff in bounds:
        c, J = bound.value(motion.q, motion.v, problem.control_rows(motion)), bound.jacobian(motion.q, motion.v)
        first = np.einsum("krx,Pkx->Pkr", J @ slopes[bound.places], linear[:, bound.places])
        plus, minus = (
            np.stack([bound.value(each.q, each.v, problem.control_rows(each)) for each in part])
            for part in (ahead, back)
        )
        even, odd = 0.5 * (plus + minus) - c, 0.5 * (plus - minus)
        margin = bound.source.margin
        planned = backoff / margin
        square = (first**2).sum(axis=0)
        share = np.where(square > 0.0, (odd * first).sum(axis=0) / np.where(square > 0.0, square, 1.0), 1.0)
        left = ((odd - share * first) ** 2).mean(axis=0)
        spread = np.sqrt((share * planned) ** 2 + left + even.var(axis=0))
        shift = even.mean(axis=0)
        doubt = _DOUBT * even.std(axis=0) / math.sqrt(_PAIRS)
        least = np.where(planned > 0.0, (c + shift - doubt) / np.where(spread > 0.0, spread, 1.0), -np.inf)
        at = np.unravel_index(int(least.argmax()), least.shape)
        promised = float(ndtr(-margin))
        often = float(ndtr((c[at] + shift[at]) / spread[at]))
        if ndtr(least[at]) <= _OFTEN * promised:
            continue
        needed = (shift[at] + margin * spread[at]) / planned[at]
        found.append(
            Finding(
                "small margin",
                f"{bound.source.label}: noise is too strong for margin={margin:g}, which is of the linear model: "
                f"{bound.rows[at[1]]} at t = {bound.times[at[0]]:.4g} s is violated by about {100.0 * often:.2g} % of "
                f"all motions, not {100.0 * promised:.2g} %, as {2 * _PAIRS} motions under noise say; "
                f"margin={math.ceil(10.0 * needed) / 10.0:g} is about enough there, and simulate_ensemble counts",
            )
        )
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
