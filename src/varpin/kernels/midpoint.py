"""The midpoint integrator: one forced discrete Euler-Lagrange step after another, in position-momentum form.

With qm = q0 + a h v and L the Lagrangian, the step solves for its velocity v

    r(v) = p0 + (h/2) F(v) + h (1-a) L_q(qm, v) - L_v(qm, v) = 0,      F(v) = B u - D v

and ends in q1 = q0 + h v, p1 = p0 + h (L_q + F), which is the discrete Legendre transform with r = 0 put in.
"""

from typing import NamedTuple

import numpy as np

from varpin.kernels._compile import inlined, kernel
from varpin.kernels.jet import first_order, mass_matrix, second_order
from varpin.kernels.linalg import factor_ldl, factor_lu, quadratic_form, solve_ldl, solve_lu
from varpin.kernels.tree import Floats, Integers, Mechanism, Sweep, new_sweep

# What an attempt at a step ends in.
SOLVED = 0
DIVERGED = 1  # a correction exceeded half of the one before
NOT_FINITE = 2
FOLD = 3  # M - h^2/4 L_qq and its kin lost definiteness: another branch of solutions
ENERGY = 4  # the energy balance of the step does not close
SINGULAR = 5  # the mass matrix at the new node is singular

EPS = float(np.finfo(np.float64).eps)
ITERATIONS = 12
ROUNDING = 100.0  # rounding units: a residual below may stagnate; without rounding's own scatter it would be 1
ENERGY_ROUNDING = 1e-12  # of the magnitudes that make up an energy
HISTORY = 3
FLOOR = 0.02  # of the energy guard's limit is always left, or a full ledger could never be worked off


class State(NamedTuple):
    """Where a rollout stands. Low parts carry what rounding took from q and p (compensated sums)."""

    q: Floats  # (n,)
    q_low: Floats  # (n,)
    p: Floats  # (n,)
    p_low: Floats  # (n,)
    v: Floats  # (n,) M(q)^-1 p
    past: Floats  # (HISTORY, n) velocities of the last whole steps, newest first
    energy: Floats  # (6,) kinetic, potential, errors added up, largest kinetic, work turned over [J], power [W]
    counters: Integers  # (2,) how many rows of past are set; halvings of the last step


class Work(NamedTuple):
    """Work arrays of a step."""

    sweep: Sweep
    lu: Floats  # (n, n)
    ldl: Floats  # (n, n)
    v: Floats  # (n,)
    qm: Floats  # (n,)
    force: Floats  # (n,) B u
    residual: Floats  # (n,)
    delta: Floats  # (n,)
    trial: Floats  # (5, n): q, q_low, p, p_low, v of the node that is tried
    tally: Integers  # (4,) of one step: Newton iterations, jets, first-order sweeps, substeps
    quality: Floats  # (2,) of one step: worst scaled residual, smallest branch margin


class Options(NamedTuple):
    """How a step is solved."""

    alpha: float
    tolerance: float  # on the residual, in rounding units of the terms that cancel in it
    margin: float  # of the branch guard
    balance: float  # largest energy error of a substep, in units of the energy it turns over
    budget: float  # of the energy errors added up, in units of the largest kinetic energy so far
    halvings: int  # at most


def new_state(dof: int) -> State:
    """A state to be filled in."""
    return State(
        q=np.zeros(dof),
        q_low=np.zeros(dof),
        p=np.zeros(dof),
        p_low=np.zeros(dof),
        v=np.zeros(dof),
        past=np.zeros((HISTORY, dof)),
        energy=np.zeros(6),
        counters=np.zeros(2, dtype=np.int64),
    )


def new_work(bodies: int, dof: int) -> Work:
    """Allocate the work arrays of a step."""
    return Work(
        sweep=new_sweep(bodies, dof),
        lu=np.zeros((dof, dof)),
        ldl=np.zeros((dof, dof)),
        v=np.zeros(dof),
        qm=np.zeros(dof),
        force=np.zeros(dof),
        residual=np.zeros(dof),
        delta=np.zeros(dof),
        trial=np.zeros((5, dof)),
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
        if scale > 0.0:
            r = abs(r) / (EPS * scale)
        if not r <= worst:  # NaN ends up in worst
            worst = r
    return worst


@inlined
def set_midpoint(a: float, h: float, state: State, k: Work) -> None:
    """Qm = q0 + a h v."""
    for i in range(k.v.size):
        k.qm[i] = state.q[i] + (state.q_low[i] + a * h * k.v[i])


@inlined
def factor_newton(mechanism: Mechanism, a: float, h: float, k: Work) -> bool:
    """Factor -dr/dv from the jet in the sweep."""
    w = k.sweep
    n = k.v.size
    for i in range(n):
        for j in range(n):
            k.lu[i, j] = w.M[i, j] + h * (a * w.A[i, j] - (1.0 - a) * w.A[j, i] - h * a * (1.0 - a) * w.Lqq[i, j])
        k.lu[i, i] += 0.5 * h * mechanism.damping[i]
    return factor_lu(k.lu)


@inlined
def newton(mechanism: Mechanism, options: Options, h: float, state: State, k: Work) -> int:
    """Solve the step equation from the guess in ``k.v``; returns how it ended.

    Newton with the factorisation kept while the corrections shrink fast. Gives up when a correction exceeds half
    of the one before (natural monotonicity, Deuflhard), unless the residual is down at its rounding floor.
    """
    a = options.alpha
    before = np.inf
    fresh = True
    worst = np.inf
    for _ in range(ITERATIONS + 1):
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
        solve_lu(k.lu, k.residual, k.delta)
        size = quadratic_form(k.sweep.M, k.delta)
        if not size <= 0.25 * before:
            break
        for i in range(k.v.size):
            k.v[i] += k.delta[i]
        k.tally[0] += 1
        # The squared contraction to expect: seen, or guessed from the size of the first correction.
        shrink = size / (quadratic_form(k.sweep.M, k.v) if before == np.inf else before)
        fresh = not worst * shrink <= options.tolerance
        before = size
    if not worst <= ROUNDING:
        return DIVERGED
    k.quality[0] = max(k.quality[0], worst)
    return SOLVED


@inlined
def branch_margin(mechanism: Mechanism, options: Options, h: float, k: Work) -> float:
    """How far the root is from the fold where branches of solutions meet: 1 as h -> 0, <= 0 where refused.

    The smallest ratio of a pivot of M + (h/2) D + h (a - 1/2)(A + A') - h^2 a (1-a) L_qq / (1 - margin),
    the symmetric part of -dr/dv with its destabilising term exaggerated, to the same pivot of M.
    """
    w = k.sweep
    a = options.alpha
    n = k.v.size
    exaggerated = h * h * a * (1.0 - a) / (1.0 - options.margin)
    for i in range(n):
        for j in range(i + 1):
            k.lu[i, j] = w.M[i, j] + h * (a - 0.5) * (w.A[i, j] + w.A[j, i]) - exaggerated * w.Lqq[i, j]
            k.ldl[i, j] = w.M[i, j]
        k.lu[i, i] += 0.5 * h * mechanism.damping[i]
    if not factor_ldl(k.ldl) or not factor_ldl(k.lu):
        return 0.0
    margin = np.inf
    for i in range(n):
        margin = min(margin, k.lu[i, i] / k.ldl[i, i])
    return margin


@inlined
def add(high: float, low: float, increment: float) -> tuple[float, float]:
    """High + low + increment as a new high and low part (Knuth's two-sum)."""
    increment += low
    total = high + increment
    part = total - high
    return total, (high - (total - part)) + (increment - part)


@inlined
def node_energy(mechanism: Mechanism, q: Floats, p: Floats, v: Floats, k: Work) -> tuple[bool, float, float]:
    """V = M(q)^-1 p, whether M was positive definite, and kinetic and potential energy [J]."""
    potential = mass_matrix(mechanism, q, k.sweep)
    n = q.size
    for i in range(n):
        for j in range(i + 1):
            k.ldl[i, j] = k.sweep.M[i, j]
    if not factor_ldl(k.ldl):
        return False, np.nan, potential
    solve_ldl(k.ldl, p, v)
    kinetic = 0.0
    for i in range(n):
        kinetic += 0.5 * p[i] * v[i]
    return True, kinetic, potential


@inlined
def balanced(
    options: Options,
    ledger: Floats,
    kinetic: float,
    potential: float,
    potential_scale: float,
    work: float,
    slack: float,
) -> bool:
    """Whether the energy balance of a substep closes; enters it into the ledger if it does.

    The error must be a small part of the energy turned over. An error that adds to those before it has less room
    the fuller the ledger is, so they do not wander off however often substeps break the structure. ``slack`` is what
    the method itself owes at nodes: its energy differs from the modified one that it nearly conserves.
    """
    before, height, defect, largest, throughput = ledger[0], ledger[1], ledger[2], ledger[3], ledger[4]
    error = (kinetic - before) + (potential - height) - work
    exchanged = abs(potential - height) + abs(work)
    limit = options.balance * (max(kinetic, before) + exchanged) + slack
    if abs(defect + error) > abs(defect):
        room = options.budget * (max(largest, exchanged) + throughput) + slack
        if room > 0.0:
            limit *= max(FLOOR, 1.0 - abs(defect) / room)
    if not abs(error) <= limit + ENERGY_ROUNDING * (potential_scale + kinetic):
        return False
    ledger[0], ledger[1], ledger[2] = kinetic, potential, defect + error
    ledger[3], ledger[4] = max(largest, kinetic), throughput + abs(work)
    return True


@inlined
def attempt(mechanism: Mechanism, options: Options, h: float, state: State, k: Work) -> int:
    """One substep from ``state`` and the guess in ``k.v``; moves the state only if it ends in SOLVED."""
    outcome = newton(mechanism, options, h, state, k)
    if outcome != SOLVED:
        return outcome
    margin = branch_margin(mechanism, options, h, k)
    if not margin > 0.0:
        return FOLD
    n = k.v.size
    q, q_low, p, p_low, v = k.trial[0], k.trial[1], k.trial[2], k.trial[3], k.trial[4]
    work = 0.0
    for i in range(n):
        force = k.force[i] - mechanism.damping[i] * k.v[i]
        work += h * force * k.v[i]
        q[i], q_low[i] = add(state.q[i], state.q_low[i], h * k.v[i])
        p[i], p_low[i] = add(state.p[i], state.p_low[i], h * (k.sweep.Lq[i] + force))
    regular, kinetic, potential = node_energy(mechanism, q, p, v, k)
    if not regular:
        return SINGULAR
    # To first order the method conserves H - (1/2 - a) h L_q . v: nothing at a = 1/2.
    start = 0.0
    end = 0.0
    for i in range(n):
        start += k.sweep.Lq[i] * state.v[i]
        end += k.sweep.Lq[i] * v[i]
    most = max(state.energy[5], abs(start), abs(end))
    slack = 2.0 * h * abs(1.0 - 2.0 * options.alpha) * most
    if not balanced(options, state.energy, kinetic, potential, k.sweep.V_scale[0], work, slack):
        return ENERGY
    state.energy[5] = most
    k.quality[1] = min(k.quality[1], margin)
    k.tally[3] += 1
    for i in range(n):
        state.q[i], state.q_low[i], state.p[i], state.p_low[i] = q[i], q_low[i], p[i], p_low[i]
        state.v[i] = v[i]
    return SOLVED


@inlined
def predict(state: State, k: Work) -> None:
    """Extrapolate the velocities of the last whole steps, two or three of them, into ``k.v``."""
    past = state.past
    for i in range(k.v.size):
        k.v[i] = 2.0 * past[0, i] - past[1, i]
        if state.counters[0] > 2:
            k.v[i] += past[0, i] - 2.0 * past[1, i] + past[2, i]


@inlined
def step(mechanism: Mechanism, options: Options, h: float, state: State, k: Work) -> int:
    """One whole step with the force in ``k.force``, in as many substeps as the guards ask for.

    The first attempt starts from the extrapolated velocity, the others from the current one. A failed attempt
    halves the substep; after a success at an even place it is doubled again.
    """
    n = k.v.size
    k.tally[:] = 0
    k.quality[0] = 0.0
    k.quality[1] = np.inf
    level = max(state.counters[1] - 1, 0)
    extrapolate = level == 0 and state.counters[0] > 1
    deepest = level
    place = 0  # in units of h / 2^level
    while place < 1 << level:
        if extrapolate:
            predict(state, k)
        else:
            for i in range(n):
                k.v[i] = state.v[i]
        outcome = attempt(mechanism, options, h / (1 << level), state, k)
        if outcome == SOLVED:
            place += 1
            if level > 0 and place % 2 == 0:
                level -= 1
                place //= 2
        elif extrapolate and outcome != ENERGY:
            extrapolate = False
        elif level == options.halvings:
            return outcome
        else:
            extrapolate = False
            level += 1
            place *= 2
            deepest = max(deepest, level)
    state.counters[1] = deepest
    if deepest > 0:
        state.counters[0] = 0
        return SOLVED
    known = min(state.counters[0] + 1, HISTORY)
    for row in range(known - 1, 0, -1):
        for i in range(n):
            state.past[row, i] = state.past[row - 1, i]
    for i in range(n):
        state.past[0, i] = k.v[i]
    state.counters[0] = known
    return SOLVED


@kernel
def begin(mechanism: Mechanism, q: Floats, v: Floats, state: State, k: Work) -> bool:
    """Put the state at (q, v), with nothing known of the past; False where M(q) is not positive definite."""
    n = q.size
    mass_matrix(mechanism, q, k.sweep)
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += k.sweep.M[i, j] * v[j]
        state.q[i], state.q_low[i], state.p[i], state.p_low[i] = q[i], 0.0, total, 0.0
    regular, kinetic, potential = node_energy(mechanism, state.q, state.p, state.v, k)
    state.energy[:] = 0.0
    state.energy[0], state.energy[1], state.energy[3] = kinetic, potential, kinetic
    state.counters[:] = 0
    for i in range(n):
        state.v[i] = v[i]
    return regular


@kernel
def rollout(
    mechanism: Mechanism,
    options: Options,
    h: float,
    controls: Floats,
    state: State,
    k: Work,
    q: Floats,
    p: Floats,
    v: Floats,
    energy: Floats,
    tally: Integers,
    quality: Floats,
) -> tuple[int, int]:
    """Steps from ``state``, one for each row of ``controls`` (N, m).

    Writes the nodes after each step into q, p, v (N, n) and energy (N,), and what each step took into
    tally (N, 4) and quality (N, 2). Returns how it ended and how many steps were completed.
    """
    n = k.v.size
    for s in range(controls.shape[0]):
        for i in range(n):
            total = 0.0
            for c in range(controls.shape[1]):
                total += mechanism.actuation[i, c] * controls[s, c]
            k.force[i] = total
        outcome = step(mechanism, options, h, state, k)
        for i in range(4):
            tally[s, i] = k.tally[i]
        for i in range(2):
            quality[s, i] = k.quality[i]
        if outcome != SOLVED:
            return outcome, s
        for i in range(n):
            q[s, i], p[s, i], v[s, i] = state.q[i], state.p[i], state.v[i]
        energy[s] = state.energy[0] + state.energy[1]
    return SOLVED, controls.shape[0]
