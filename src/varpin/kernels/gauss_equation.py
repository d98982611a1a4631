"""The equation of a step of Gauss collocation, its Newton iteration, and the arrays that it works in.

With s stages at the Gauss points of the step, Q_i = q0 + h sum_j a_ij V_j and L the Lagrangian, the step solves for its
stage velocities V_i

    r_i(V) = p0 + h sum_j a_ij (L_q + F)(Q_j, V_j) - L_v(Q_i, V_i) = 0,      F(V) = f - D V

with a force f that is constant over the step: the controls', and the drift of the noise. It ends in
q1 = q0 + h sum_i b_i V_i and p1 = p0 + h sum_i b_i (L_q + F)(Q_i, V_i). One stage is the midpoint rule.
"""

import math
from typing import NamedTuple

import numpy as np

from varpin.kernels._compile import inlined
from varpin.kernels.gauss_tableau import Tableau
from varpin.kernels.jet import first_order, second_order
from varpin.kernels.linalg import factor_lu_pivoting, quadratic_form, solve_lu_pivoting
from varpin.kernels.midpoint_equation import (
    DIVERGED,
    EPS,
    FOLD,
    ITERATIONS,
    NOT_FINITE,
    NOTHING,
    ROUNDING,
    SOLVED,
    Options,
    State,
    Work,
    new_state,
)
from varpin.kernels.tree import Floats, Integers, Mechanism, Sweep

SURE = 10.0  # a residual that is expected this far below the tolerance need not be looked at


class Stages(NamedTuple):
    """Work arrays of the stages of a step."""

    V: Floats  # (s, n) velocities
    Q: Floats  # (s, n) configurations
    guess: Floats  # (s, n) of V, extrapolated from the step before
    M: Floats  # (s, n, n) L_vv at each stage, and so on
    A: Floats  # (s, n, n)
    Lqq: Floats  # (s, n, n)
    Lq: Floats  # (s, n)
    Lv: Floats  # (s, n)
    Lv_scale: Floats  # (s, n)
    Lq_scale: Floats  # (s, n)
    slope: Floats  # (s, n) L_q + F
    lu: Floats  # (s n, s n)
    rows: Floats  # (s, n s n) the same memory, stage by stage
    change: Floats  # (s, n s n) of each slope with V
    order: Integers  # (s n,) of the rows of lu
    residual: Floats  # (s n,)
    delta: Floats  # (s n,)


def new_stages(stages: int, dof: int) -> Stages:
    """Allocate the work arrays of ``stages`` stages."""
    vectors, matrices = (stages, dof), (stages, dof, dof)
    size = stages * dof
    lu = np.zeros((size, size))
    return Stages(
        V=np.zeros(vectors),
        Q=np.zeros(vectors),
        guess=np.zeros(vectors),
        M=np.zeros(matrices),
        A=np.zeros(matrices),
        Lqq=np.zeros(matrices),
        Lq=np.zeros(vectors),
        Lv=np.zeros(vectors),
        Lv_scale=np.zeros(vectors),
        Lq_scale=np.zeros(vectors),
        slope=np.zeros(vectors),
        lu=lu,
        rows=lu.reshape(stages, dof * size),
        change=np.zeros((stages, dof * size)),
        order=np.zeros(size, dtype=np.int64),
        residual=np.zeros(size),
        delta=np.zeros(size),
    )


def new_gauss_state(stages: int, paths: int, dof: int, processes: int, loads: int) -> State:
    """States of several paths, to be filled in.

    Their past is of the last whole step: the stage velocities, the velocity at its end, the force, and by how much the
    extrapolation of the step before missed each stage.
    """
    return new_state(paths, dof, processes, loads)._replace(past=np.zeros((paths, 2 * stages + 2, dof)))


@inlined
def stage_sweep(w: Sweep, g: Stages, i: int) -> Sweep:
    """The sweep's work arrays, with results that go to stage ``i``."""
    return Sweep(
        w.rotation,
        w.position,
        w.axis,
        w.velocity,
        w.axis_rate,
        w.inertia,
        w.momentum,
        w.dual_axis,
        w.dual_rate,
        w.magnitude,
        g.M[i],
        g.A[i],
        g.Lqq[i],
        g.Lq[i],
        g.Lv[i],
        g.Lv_scale[i],
        g.Lq_scale[i],
        w.V,
        w.V_scale,
    )


@inlined
def set_stages(tableau: Tableau, h: float, state: State, g: Stages) -> None:
    """The configurations Q of the stages."""
    stages, n = g.V.shape
    for i in range(stages):
        for r in range(n):
            total = 0.0
            for j in range(stages):
                total += tableau.a[i, j] * g.V[j, r]
            g.Q[i, r] = state.place[r] + (state.place_low[r] + h * total)


@inlined
def residuals(mechanism: Mechanism, tableau: Tableau, h: float, state: State, k: Work, g: Stages) -> float:
    """r(V) from the stages' L_q and L_v; returns its largest entry in rounding units of its terms."""
    stages, n = g.V.shape
    for i in range(stages):
        for r in range(n):
            drag = mechanism.damping[r] * g.V[i, r]
            g.slope[i, r] = g.Lq[i, r] + (k.force[r] - drag)
            g.Lq_scale[i, r] += abs(k.force[r]) + abs(drag)
    worst = 0.0
    for i in range(stages):
        for r in range(n):
            total, scale = 0.0, 0.0
            for j in range(stages):
                total += tableau.a[i, j] * g.slope[j, r]
                scale += abs(tableau.a[i, j]) * g.Lq_scale[j, r]
            error = (state.p[r] - g.Lv[i, r]) + (state.p_low[r] + h * total)
            g.residual[i * n + r] = error
            scale = h * scale + abs(state.p[r]) + g.Lv_scale[i, r]
            if scale > NOTHING:
                error = abs(error) / (EPS * scale)
            if not error <= worst:  # NaN ends up in worst
                worst = error
    return worst


@inlined
def factor_stages(mechanism: Mechanism, tableau: Tableau, h: float, g: Stages) -> bool:
    """Factor N = -dr/dV from the stages' jets; False where its determinant is not positive.

        N_ij = delta_ij M_i + h a_ij (A_i - A_j' + D) - h^2 sum_c a_ic a_cj L_qq,c

    As h -> 0 the determinant is positive, and it vanishes nowhere on the branch of solutions that starts there.
    """
    stages, n = g.V.shape
    a = tableau.a
    # Row j of g.change: the derivative of slope j in all of V, which rows of N take a_ij of in one long loop.
    for j in range(stages):
        for r in range(n):
            for m in range(stages):
                factor = h * a[j, m]
                place = (r * stages + m) * n
                for c in range(n):
                    g.change[j, place + c] = factor * g.Lqq[j, r, c]
            place = (r * stages + j) * n
            for c in range(n):
                g.change[j, place + c] += g.A[j, c, r]
            g.change[j, place + r] -= mechanism.damping[r]
    for i in range(stages):
        rows = g.rows[i]
        rows[:] = 0.0
        for j in range(stages):
            factor, change = h * a[i, j], g.change[j]
            for m in range(rows.size):
                rows[m] -= factor * change[m]
        for r in range(n):
            for j in range(stages):
                factor = h * a[i, j]
                for c in range(n):
                    g.lu[i * n + r, j * n + c] += factor * g.A[i, r, c]
            for c in range(n):
                g.lu[i * n + r, i * n + c] += g.M[i, r, c]
    return factor_lu_pivoting(g.lu, g.order) > 0


@inlined
def size_of(tableau: Tableau, g: Stages, x: Floats) -> float:
    """The square of x (s n,) in the metric of the kinetic energy, averaged over the step."""
    stages, n = g.V.shape
    total = 0.0
    for i in range(stages):
        total += tableau.b[i] * quadratic_form(g.M[i], x[i * n : (i + 1) * n], (n,))
    return total


@inlined
def correct_slopes(mechanism: Mechanism, tableau: Tableau, h: float, g: Stages) -> None:
    """Bring L_q + F to where the correction ``g.delta`` has taken the stages, to first order in it."""
    stages, n = g.V.shape
    for i in range(stages):
        for r in range(n):
            total = 0.0
            for j in range(stages):
                total += tableau.a[i, j] * g.delta[j * n + r]
            g.residual[i * n + r] = h * total
    for i in range(stages):
        for r in range(n):
            total = -mechanism.damping[r] * g.delta[i * n + r]
            for c in range(n):
                total += g.Lqq[i, r, c] * g.residual[i * n + c] + g.A[i, c, r] * g.delta[i * n + c]
            g.slope[i, r] += total


@inlined
def newton_stages(
    mechanism: Mechanism, tableau: Tableau, options: Options, h: float, state: State, k: Work, g: Stages
) -> int:
    """Solve the step equation from the guess in ``g.V``; returns how it ended.

    As :func:`varpin.kernels.midpoint_equation.newton` does, with two differences. The first factorisation is kept at
    least until a second correction shows how fast it contracts, and for as long as three more would do. And a last
    correction is not looked at again if that contraction takes the residual below a tenth of the tolerance: what it
    changes in ``g.slope`` is then of first order to the last digit. Where derivatives are wanted it ends with the
    jets of the root.
    """
    stages, n = g.V.shape
    wanted = k.Jx.shape[0] > 0
    before = np.inf
    fresh = True
    worst = np.inf
    for iteration in range(ITERATIONS + 2):  # one more than may correct: to look at the jets of the root
        set_stages(tableau, h, state, g)
        for i in range(stages):
            if fresh:
                second_order(mechanism, g.Q[i], g.V[i], stage_sweep(k.sweep, g, i))
                k.tally[1] += 1
            else:
                first_order(mechanism, g.Q[i], g.V[i], stage_sweep(k.sweep, g, i))
                k.tally[2] += 1
        worst = residuals(mechanism, tableau, h, state, k, g)
        if worst <= options.tolerance:
            if fresh or not wanted:
                break
            fresh = True
            continue
        if not worst < np.inf:
            return NOT_FINITE
        if fresh and not factor_stages(mechanism, tableau, h, g):
            return FOLD
        solve_lu_pivoting(g.lu, g.order, g.residual, g.delta)
        size = size_of(tableau, g, g.delta)
        if iteration >= ITERATIONS or not size <= 0.25 * before:
            break
        for i in range(stages):
            for r in range(n):
                g.V[i, r] += g.delta[i * n + r]
        k.tally[0] += 1
        fresh = False
        if before < np.inf:
            contraction = math.sqrt(size / before)
            if SURE * contraction * worst <= options.tolerance and not wanted:
                correct_slopes(mechanism, tableau, h, g)
                worst *= contraction
                break
            fresh = not worst * contraction**3 <= options.tolerance
        before = size
    if not worst <= max(ROUNDING, options.tolerance):
        return DIVERGED
    k.quality[0] = max(k.quality[0], worst)
    return SOLVED
