"""The equation of the midpoint step, its Newton iteration, and the arrays that a step works in.

With qm = q0 + a h v and L the Lagrangian, the step solves for its velocity v

    r(v) = p0 + (h/2) F(v) + h (1-a) L_q(qm, v) - L_v(qm, v) = 0,      F(v) = f - D v

with a force f that is constant over the step: the controls', and the drift of the noise. It ends in q1 = q0 + h v and
p1 = p0 + h (L_q + F), which is the discrete Legendre transform with r = 0 put in.
"""

from typing import NamedTuple

import numpy as np

from varpin.kernels._compile import inlined
from varpin.kernels.jet import first_order, second_order
from varpin.kernels.linalg import factor_lu, quadratic_form, solve_lu
from varpin.kernels.tree import Floats, Integers, Mechanism, Sweep, block, new_sweep

# What an attempt at a step ends in.
SOLVED = 0
DIVERGED = 1  # a correction exceeded half of the one before
NOT_FINITE = 2
FOLD = 3  # M - h^2/4 L_qq and its kin lost definiteness: another branch of solutions
ENERGY = 4  # the energy balance of the step does not close
SINGULAR = 5  # the mass matrix at the new node is singular

EPS = float(np.finfo(np.float64).eps)
ITERATIONS = 10
NOTHING = 1e-290  # below, squares and products with EPS underflow: what dies out ends at rest
ROUNDING = 100.0  # rounding units: a residual below may stagnate; without rounding's own scatter it would be 1
HISTORY = 3


class State(NamedTuple):
    """Where a rollout stands. Low parts carry what rounding took from their sums."""

    q: Floats  # (n,) as it is shown
    place: Floats  # (n,) the same to more digits: without whole turns, and with a low part
    place_low: Floats  # (n,)
    turns: Floats  # (n,) whole turns from place to q
    p: Floats  # (n,)
    p_low: Floats  # (n,)
    v: Floats  # (n,) M(q)^-1 p
    past: Floats  # (HISTORY, n) velocities of the last whole steps, newest first
    energy: Floats  # (n, 4) of each group: kinetic, potential, errors added up, most that moved in a substep [J]
    share: Floats  # (n, 3) of the kinetic energy for each coordinate, its least and its largest of late [J]
    loads: Floats  # (l, 2n + 5) of each light part, as :mod:`varpin.kernels.load` says
    lead: Floats  # (n,) by how much the last whole step's velocity led the one it started with
    center: Floats  # (n, k) of the diffusion fields, for this rollout
    counters: Integers  # (2,) how many rows of past are set; halvings of the last step


class Work(NamedTuple):
    """Work arrays of a step."""

    sweep: Sweep
    lu: Floats  # (n, n)
    ldl: Floats  # (n, n)
    v: Floats  # (n,)
    qm: Floats  # (n,)
    start: Floats  # (n,) velocity at the start of the step
    force: Floats  # (n,) of the controls and the noise's drift, constant over the step
    residual: Floats  # (n,)
    delta: Floats  # (n,)
    balance: Floats  # (n, 4) of each group at the node that is tried: kinetic, work, dissipated, moved [J]
    share: Floats  # (n,) of its kinetic energy for each coordinate [J]
    work: Floats  # (n,) of the forces on each coordinate over the substep that is tried [J]
    loads: Floats  # (l, 2n + 5) of each light part at the node that is tried
    trial: Floats  # (5, n): place, place_low, p, p_low, v of the node that is tried
    Jx: Floats  # (2n, 2n) d(q1, p1)/d(q0, p0) of a step so far; (0, 0) where derivatives are not wanted
    Jf: Floats  # (2n, n) d(q1, p1)/df
    part: Floats  # (4n, 2n) of one substep, and room for their product
    trail: Floats  # (K, 3n + 1) q, p, v and length of each part of a step; (0, 3n + 1) where nobody asks for them
    tally: Integers  # (4,) of one step: Newton iterations, jets, first-order sweeps, substeps
    quality: Floats  # (2,) of one step: worst scaled residual, smallest branch margin


class Options(NamedTuple):
    """How a step is solved."""

    alpha: float
    tolerance: float  # on the residual, in rounding units of the terms that cancel in it
    margin: float  # of the branch guard
    balance: float  # largest energy error of a substep, in units of the energy it turns over
    budget: float  # of the errors added up, in units of the most energy that moved in a substep so far
    halvings: int  # at most
    left: float  # part of each kick that comes before the step; the rest comes after it


def new_state(paths: int, dof: int, processes: int, loads: int) -> State:
    """States of several paths, to be filled in: every array with one more axis in front."""
    return State(
        q=np.zeros((paths, dof)),
        place=np.zeros((paths, dof)),
        place_low=np.zeros((paths, dof)),
        turns=np.zeros((paths, dof)),
        p=np.zeros((paths, dof)),
        p_low=np.zeros((paths, dof)),
        v=np.zeros((paths, dof)),
        past=np.zeros((paths, HISTORY, dof)),
        energy=np.zeros((paths, dof, 4)),
        share=np.zeros((paths, dof, 3)),
        loads=np.zeros((paths, loads, 2 * dof + 5)),
        lead=np.zeros((paths, dof)),
        center=np.zeros((paths, dof, processes)),
        counters=np.zeros((paths, 2), dtype=np.int64),
    )


def new_work(bodies: int, dof: int, loads: int, *, derivatives: bool = False, parts: int = 0) -> Work:
    """Allocate the work arrays of a step, with room for its derivatives or without, and for a trail of its parts."""
    size = 2 * dof if derivatives else 0
    return Work(
        sweep=new_sweep(bodies, dof),
        lu=np.zeros((dof, dof)),
        ldl=np.zeros((dof, dof)),
        v=np.zeros(dof),
        qm=np.zeros(dof),
        start=np.zeros(dof),
        force=np.zeros(dof),
        residual=np.zeros(dof),
        delta=np.zeros(dof),
        balance=np.zeros((dof, 4)),
        share=np.zeros(dof),
        work=np.zeros(dof),
        loads=np.zeros((loads, 2 * dof + 5)),
        trial=np.zeros((5, dof)),
        Jx=np.zeros((size, size)),
        Jf=np.zeros((size, size // 2)),
        part=np.zeros((2 * size, size)),
        trail=np.zeros((parts, 3 * dof + 1)),
        tally=np.zeros(4, dtype=np.int64),
        quality=np.zeros(2),
    )


@inlined
def residual(mechanism: Mechanism, a: float, h: float, state: State, k: Work) -> float:
    """r(v) from the L_q and L_v in the sweep; returns its largest entry in rounding units of its terms."""
    w = k.sweep
    worst = 0.0
    for i in range(k.v.size):
        drag = mechanism.damping[i] * k.v[i]
        small = state.p_low[i] + 0.5 * h * (k.force[i] - drag) + h * (1.0 - a) * w.Lq[i]
        r = (state.p[i] - w.Lv[i]) + small
        k.residual[i] = r
        scale = abs(state.p[i]) + w.Lv_scale[i]
        scale += 0.5 * h * (abs(k.force[i]) + abs(drag)) + h * (1.0 - a) * w.Lq_scale[i]
        if scale > NOTHING:
            r = abs(r) / (EPS * scale)
        if not r <= worst:  # NaN ends up in worst
            worst = r
    return worst


@inlined
def set_midpoint(a: float, h: float, state: State, k: Work) -> None:
    """The configuration qm = q0 + a h v."""
    for i in range(k.v.size):
        k.qm[i] = state.place[i] + (state.place_low[i] + a * h * k.v[i])


@inlined
def factor_newton(mechanism: Mechanism, a: float, h: float, k: Work) -> bool:
    """Factor -dr/dv from the jet in the sweep, block by block: dampers stand on its diagonal."""
    w = k.sweep
    ends = mechanism.tree.ends
    for b in range(len(ends)):
        begin, end = block(ends, b)
        for i in range(begin, end):
            for j in range(begin, end):
                k.lu[i, j] = w.M[i, j] + h * (a * w.A[i, j] - (1.0 - a) * w.A[j, i] - h * a * (1.0 - a) * w.Lqq[i, j])
            k.lu[i, i] += 0.5 * h * mechanism.damping[i]
        if not factor_lu(k.lu, begin, end):
            return False
    return True


@inlined
def newton(mechanism: Mechanism, options: Options, h: float, state: State, k: Work) -> int:
    """Solve the step equation from the guess in ``k.v``; returns how it ended.

    Newton with the factorisation kept while the corrections shrink fast. Gives up when a correction exceeds half
    of the one before (natural monotonicity, Deuflhard), unless the residual is down at its rounding floor.
    """
    a = options.alpha
    ends = mechanism.tree.ends
    before = np.inf
    fresh = True
    worst = np.inf
    for iteration in range(ITERATIONS + 1):
        set_midpoint(a, h, state, k)
        if fresh:
            second_order(mechanism, k.qm, k.v, k.sweep)
            k.tally[1] += 1
        else:
            first_order(mechanism, k.qm, k.v, k.sweep)
            k.tally[2] += 1
        worst = residual(mechanism, a, h, state, k)
        if worst <= options.tolerance:
            break
        if not worst < np.inf:
            return NOT_FINITE
        if fresh and not factor_newton(mechanism, a, h, k):
            return FOLD
        for b in range(len(ends)):
            begin, end = block(ends, b)
            solve_lu(k.lu, k.residual, k.delta, begin, end)
        size = quadratic_form(k.sweep.M, k.delta, ends)
        if iteration == ITERATIONS or not size <= 0.25 * before:
            break
        for i in range(k.v.size):
            k.v[i] += k.delta[i]
        k.tally[0] += 1
        # The squared contraction to expect: seen, or guessed from the size of the first correction.
        shrink = size / (quadratic_form(k.sweep.M, k.v, ends) if before == np.inf else before)
        fresh = not worst * shrink <= options.tolerance
        before = size
    if not worst <= max(ROUNDING, options.tolerance):
        return DIVERGED
    k.quality[0] = max(k.quality[0], worst)
    return SOLVED
