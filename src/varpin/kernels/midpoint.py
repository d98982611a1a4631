"""The midpoint integrator: one forced discrete Euler-Lagrange step after another, in position-momentum form.

A step is accepted only on the principal branch of its equation's solutions and with its energy balance closed; else
it is taken in halves, and halves of halves. Noise kicks the momentum before the step, or half before and half after.
"""

import numpy as np

from varpin.kernels._compile import inlined, kernel
from varpin.kernels.drive import apply_policy, constant_force, noise_impulse
from varpin.kernels.jet import mass_matrix, second_order
from varpin.kernels.linalg import factor_ldl, least_pivot_ratio, solve_lower, solve_upper
from varpin.kernels.load import (
    enter_loads,
    limit_of,
    load_balanced,
    load_energies,
    reset_loads,
    varied,
)
from varpin.kernels.midpoint_equation import (
    ENERGY,
    FOLD,
    HISTORY,
    NOTHING,
    SINGULAR,
    SOLVED,
    Options,
    State,
    Work,
    newton,
    set_midpoint,
)
from varpin.kernels.midpoint_jacobian import add_substep
from varpin.kernels.place import add, put, show, unwind
from varpin.kernels.tree import Commands, Floats, Mechanism, Nodes, block

FADE = 1.0 / 256.0  # by which a substep forgets how far kinetic energies have varied
ENERGY_ROUNDING = 1e-12  # of the magnitudes that make up an energy


@inlined
def branch_margin(mechanism: Mechanism, options: Options, h: float, k: Work) -> float:
    """How far the root is from the fold where branches of solutions meet: 1 as h -> 0, <= 0 where refused.

    The smallest ratio of a pivot of M + (h/2) D + h (a - 1/2)(A + A') - h^2 a (1-a) L_qq / (1 - margin),
    the symmetric part of -dr/dv with its destabilising term exaggerated, to the same pivot of M.
    """
    w = k.sweep
    a = options.alpha
    ends = mechanism.tree.ends
    exaggerated = h * h * a * (1.0 - a) / (1.0 - options.margin)
    least = np.inf
    for b in range(len(ends)):
        begin, end = block(ends, b)
        for i in range(begin, end):
            for j in range(begin, i + 1):
                k.lu[i, j] = w.M[i, j] - exaggerated * w.Lqq[i, j]
                k.ldl[i, j] = w.M[i, j]
            k.lu[i, i] += 0.5 * h * mechanism.damping[i]
        if a != 0.5:
            for i in range(begin, end):
                for j in range(begin, i + 1):
                    k.lu[i, j] += h * (a - 0.5) * (w.A[i, j] + w.A[j, i])
        least = min(least, least_pivot_ratio(k.lu, k.ldl, begin, end))
    return least


@inlined
def kinetic_energy(mechanism: Mechanism, p: Floats, v: Floats, k: Work) -> None:
    """The velocity v = M^-1 p from the factors L D L' of M in ``k.ldl``.

    Leaves in ``k.share`` the terms of the kinetic energy 1/2 y' D^-1 y with L y = p, none of which is negative: what is
    each coordinate's own while those before it are free. Leaves in ``k.balance[:, 0]`` the sums of each group.
    """
    ends = mechanism.tree.ends
    for i in range(p.size):
        k.balance[i, 0] = 0.0
    for b in range(len(ends)):
        begin, end = block(ends, b)
        solve_lower(k.ldl, p, v, begin, end)
        for i in range(begin, end):
            v[i], y = v[i] / k.ldl[i, i], v[i]
            k.share[i] = 0.5 * v[i] * y
            k.balance[mechanism.tree.group[i], 0] += k.share[i]
        solve_upper(k.ldl, v, begin, end)


@inlined
def node_energy(mechanism: Mechanism, q: Floats, p: Floats, v: Floats, k: Work) -> bool:
    """The velocity v = M(q)^-1 p of a node; whether M was positive definite.

    Leaves the factors of M in ``k.ldl``, what :func:`kinetic_energy` leaves, and the potential energy of each group
    in ``k.sweep.V``.
    """
    mass_matrix(mechanism, q, k.sweep)
    ends = mechanism.tree.ends
    for b in range(len(ends)):
        begin, end = block(ends, b)
        for i in range(begin, end):
            for j in range(begin, i + 1):
                k.ldl[i, j] = k.sweep.M[i, j]
        if not factor_ldl(k.ldl, begin, end):
            return False
    kinetic_energy(mechanism, p, v, k)
    return True


@inlined
def moved(mechanism: Mechanism, state: State, k: Work) -> None:
    """Leave in ``k.balance[:, 3]`` the kinetic energy that each group turns over."""
    groups, group = mechanism.tree.groups, mechanism.tree.group
    for r in range(groups):
        k.balance[r, 3] = 0.0
    for i in range(k.v.size):
        k.balance[group[i], 3] += varied(state, k, i)
    for r in range(groups):
        k.balance[r, 3] = min(k.balance[r, 3], max(k.balance[r, 0], state.energy[r, 0]))


@inlined
def enter_shares(fade: float, state: State, k: Work) -> None:
    """Enter the shares of a new node; the bounds of late ones draw together by ``fade``."""
    for i in range(k.v.size):
        share, new = state.share[i], k.share[i]
        share[0] = new
        share[1] = min(share[1] + fade * (new - share[1]), new)
        share[2] = max(share[2] + fade * (new - share[2]), new)


@inlined
def energy_error(state: State, k: Work, r: int) -> float:
    """How much the energy of group ``r`` has changed between the nodes that no force accounts for [J]."""
    ledger, new = state.energy[r], k.balance[r]
    return (new[0] - ledger[0]) + (k.sweep.V[r] - ledger[1]) - new[1]


@inlined
def balanced(options: Options, state: State, k: Work, r: int) -> bool:
    """Whether the energy balance of group ``r`` closes over a substep."""
    ledger, new = state.energy[r], k.balance[r]
    error = energy_error(state, k, r)
    exchanged = abs(k.sweep.V[r] - ledger[1]) + abs(new[1])
    limit = limit_of(options, error, ledger[2], new[3], exchanged, ledger[3])
    scale = k.sweep.V_scale[r]
    off_middle = abs(1.0 - 2.0 * options.alpha)
    rounding = ENERGY_ROUNDING * (scale + new[0]) + 1e-3 * off_middle * scale
    return abs(error) <= limit + rounding + NOTHING


@inlined
def enter(state: State, k: Work, r: int) -> None:
    """Enter an accepted substep into the ledger of group ``r``. What friction takes, it takes of the errors too."""
    ledger, new = state.energy[r], k.balance[r]
    defect = ledger[2] + energy_error(state, k, r)
    if new[2] > 0.0:
        defect *= max(0.0, 1.0 - new[2] / (new[2] + max(new[0], ledger[0])))
    ledger[0], ledger[1], ledger[2] = new[0], k.sweep.V[r], defect
    ledger[3] = max(ledger[3], new[3])


@inlined
def settle(mechanism: Mechanism, options: Options, state: State, k: Work) -> int:
    """Velocity and energy of the node in ``k.trial``, and whether the energy balance of the substep closes."""
    if not node_energy(mechanism, k.trial[0], k.trial[2], k.trial[4], k):
        return SINGULAR
    moved(mechanism, state, k)
    for r in range(mechanism.tree.groups):
        if not balanced(options, state, k, r):
            return ENERGY
    if mechanism.tree.loads.size > 0:
        load_energies(mechanism, k.trial[0], k.trial[2], k.trial[4], k)
        for r in range(mechanism.tree.loads.size):
            if not load_balanced(mechanism, options, state, k, r, ENERGY_ROUNDING):
                return ENERGY
        enter_loads(state, k)
    for r in range(mechanism.tree.groups):
        enter(state, k, r)
    enter_shares(FADE, state, k)
    return SOLVED


@inlined
def advance(mechanism: Mechanism, margin: float, state: State, k: Work) -> None:
    """Move the state to the node in ``k.trial``."""
    trial = k.trial
    k.quality[1] = min(k.quality[1], margin)
    k.tally[3] += 1
    for i in range(state.q.size):
        state.place[i], state.place_low[i] = trial[0, i], trial[1, i]
        unwind(mechanism, i, state)
        show(i, state)
        state.p[i], state.p_low[i] = trial[2, i], trial[3, i]
        state.v[i] = trial[4, i]


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
    group, groups = mechanism.tree.group, mechanism.tree.groups
    place, place_low, p, p_low = k.trial[0], k.trial[1], k.trial[2], k.trial[3]
    for r in range(groups):
        k.balance[r, 1] = 0.0
        k.balance[r, 2] = 0.0
    for i in range(n):
        drag = mechanism.damping[i] * k.v[i]
        force = k.force[i] - drag
        k.work[i] = h * force * k.v[i]
        k.balance[group[i], 1] += k.work[i]
        k.balance[group[i], 2] += h * drag * k.v[i]
        place[i], place_low[i] = add(state.place[i], state.place_low[i], h * k.v[i])
        p[i], p_low[i] = add(state.p[i], state.p_low[i], h * (k.sweep.Lq[i] + force))
    outcome = settle(mechanism, options, state, k)
    if outcome != SOLVED:
        return outcome
    if k.Jx.shape[0] > 0:
        set_midpoint(options.alpha, h, state, k)
        second_order(mechanism, k.qm, k.v, k.sweep)
        add_substep(mechanism, options, h, k)
    if k.tally[3] < k.trail.shape[0]:
        row = k.trail[k.tally[3]]
        for i in range(n):
            row[i], row[n + i], row[2 * n + i] = state.q[i], state.p[i], k.v[i]
        row[3 * n] = h
    advance(mechanism, margin, state, k)
    return SOLVED


@inlined
def predict(state: State, k: Work) -> None:
    """Extrapolate the velocities of the last whole steps, two or three of them, into ``k.v``.

    Kicks make them jump; then the current velocity goes on by as much as in the last step.
    """
    past = state.past
    for i in range(k.v.size):
        if state.center.shape[1] > 0:
            k.v[i] = state.v[i] + state.lead[i]
            continue
        k.v[i] = 2.0 * past[0, i] - past[1, i]
        if state.counters[0] > 2:
            k.v[i] += past[0, i] - 2.0 * past[1, i] + past[2, i]


@inlined
def next_substep(outcome: int, extrapolated: bool, level: int, place: int, halvings: int) -> tuple[int, int]:
    """Level and place of the next attempt after one that ended in ``outcome``; level -1 where nothing is left to try.

    ``place`` counts substeps of h / 2^level. After a success at an even place the substep is doubled. After a failure
    it is halved, unless only the extrapolated guess may be to blame.
    """
    if outcome == SOLVED:
        place += 1
        if level > 0 and place % 2 == 0:
            return level - 1, place // 2
        return level, place
    if extrapolated and outcome != ENERGY:
        return level, place
    if level == halvings:
        return -1, place
    return level + 1, place * 2


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
    extrapolate = level == 0 and (state.counters[0] > 1 or state.center.shape[1] > 0)
    for i in range(n):
        k.start[i] = state.v[i]
    deepest = level
    place = 0  # in units of h / 2^level
    while place < 1 << level:
        if extrapolate:
            predict(state, k)
        else:
            for i in range(n):
                k.v[i] = state.v[i]
        outcome = attempt(mechanism, options, h / (1 << level), state, k)
        level, place = next_substep(outcome, extrapolate, level, place, options.halvings)
        if level < 0:
            return outcome
        deepest = max(deepest, level)
        extrapolate = False
    state.counters[1] = deepest
    for i in range(n):
        state.lead[i] = k.v[i] - k.start[i] if deepest == 0 else 0.0
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


@inlined
def path(states: State, i: int) -> State:
    """The state of one path of several."""
    return State(
        states.q[i],
        states.place[i],
        states.place_low[i],
        states.turns[i],
        states.p[i],
        states.p_low[i],
        states.v[i],
        states.past[i],
        states.energy[i],
        states.share[i],
        states.loads[i],
        states.lead[i],
        states.center[i],
        states.counters[i],
    )


@inlined
def kick(mechanism: Mechanism, part: float, controls: Floats, increments: Floats, state: State, k: Work) -> None:
    """Add ``part`` of the noise's impulse sum_i F_i(q, u) dw_i to the momentum.

    ``k.ldl`` holds the factors of M(q). What the kick does to the energy is entered as work: it is no error.
    """
    noise_impulse(mechanism, part, state.q, state.center, controls, increments, k.delta)
    add_impulse(mechanism, k.delta, state, k)


@inlined
def add_impulse(mechanism: Mechanism, impulse: Floats, state: State, k: Work) -> None:
    """Add to the momentum and bring velocity and kinetic energy along; ``k.ldl`` holds the factors of M(q)."""
    for i in range(impulse.size):
        state.p[i], state.p_low[i] = add(state.p[i], state.p_low[i], impulse[i])
    kinetic_energy(mechanism, state.p, state.v, k)
    moved(mechanism, state, k)
    for r in range(mechanism.tree.groups):
        state.energy[r, 0] = k.balance[r, 0]
        state.energy[r, 3] = max(state.energy[r, 3], k.balance[r, 3])
    enter_shares(0.0, state, k)
    reset_loads(mechanism, False, state, k)


@kernel
def apply_impulse(mechanism: Mechanism, impulse: Floats, states: State, k: Work) -> bool:
    """:func:`add_impulse` to the one path there is, for fields that are evaluated in Python."""
    state = path(states, 0)
    regular = node_energy(mechanism, state.place, state.p, state.v, k)
    add_impulse(mechanism, impulse, state, k)
    return regular


@inlined
def begin_at(mechanism: Mechanism, q: Floats, p: Floats, state: State, k: Work) -> bool:
    """Put the state at (q, p), with nothing known of the past; False where M(q) is not positive definite."""
    n = q.size
    put(mechanism, q, p, state)
    for i in range(n):
        state.lead[i] = 0.0
        for w in range(state.center.shape[1]):
            center = mechanism.diffusion.center[i, w]
            state.center[i, w] = q[i] if np.isnan(center) else center
    regular = node_energy(mechanism, state.place, state.p, state.v, k)
    for r in range(n):
        state.energy[r, 0], state.energy[r, 1] = k.balance[r, 0], k.sweep.V[r]
        state.energy[r, 2], state.energy[r, 3] = 0.0, 0.0
        state.share[r, :] = k.share[r]
    reset_loads(mechanism, True, state, k)
    state.counters[:] = 0
    return regular


@kernel
def begin_paths(mechanism: Mechanism, q: Floats, v: Floats, states: State, k: Work) -> bool:
    """Put each path at its row of q and v (P, n); False where an M(q) is not positive definite."""
    n = q.shape[1]
    ends = mechanism.tree.ends
    for i in range(q.shape[0]):
        state = path(states, i)
        mass_matrix(mechanism, q[i], k.sweep)
        for b in range(len(ends)):
            begin, end = block(ends, b)
            for r in range(begin, end):
                total = 0.0
                for c in range(begin, end):
                    total += k.sweep.M[r, c] * v[i, c]
                k.delta[r] = total
        if not begin_at(mechanism, q[i], k.delta, state, k):
            return False
        for r in range(n):
            state.v[r] = v[i, r]
    return True


@inlined
def record_effort(outcome: int, i: int, s: int, k: Work, nodes: Nodes) -> None:
    """Write down how step ``s`` of path ``i`` ended and what it took."""
    nodes.ended[i] = outcome
    for c in range(4):
        nodes.tally[i, s, c] = k.tally[c]
    for c in range(2):
        nodes.quality[i, s, c] = k.quality[c]


@inlined
def record_node(mechanism: Mechanism, i: int, s: int, state: State, nodes: Nodes) -> None:
    """Write down the node that step ``s`` of path ``i`` has reached."""
    for r in range(state.q.size):
        nodes.q[i, s, r], nodes.p[i, s, r], nodes.v[i, s, r] = state.q[r], state.p[r], state.v[r]
    nodes.energy[i, s] = 0.0
    nodes.quality[i, s, 2] = 0.0
    for r in range(mechanism.tree.groups):
        nodes.energy[i, s] += state.energy[r, 0] + state.energy[r, 1]
        nodes.quality[i, s, 2] += abs(state.energy[r, 2])
    nodes.done[i] = s + 1


@kernel
def rollout(
    mechanism: Mechanism,
    options: Options,
    h: float,
    commands: Commands,
    increments: Floats,
    drift: Floats,
    states: State,
    k: Work,
    nodes: Nodes,
) -> None:
    """Steps of P paths from ``states``, as many as the commands are for.

    ``increments`` are those of the Wiener processes, (P, N, k), or (0, 0, k) for none; ``drift`` is a force besides
    the controls', (P, N, n), or (0, 0, n) for none. Writes into ``nodes`` the node after each step, what was applied in
    it and what it took. A path that fails stops there; ``nodes.ended`` and ``nodes.done`` say how and where.
    """
    noisy = increments.shape[0] > 0 and increments.shape[2] > 0
    for i in range(states.q.shape[0]):
        state = path(states, i)
        if noisy:
            node_energy(mechanism, state.place, state.p, state.v, k)
        nodes.ended[i] = SOLVED
        nodes.done[i] = 0
        for s in range(nodes.u.shape[1]):
            apply_policy(commands, i, s, state.q, state.p, nodes.u[i])
            if noisy:
                kick(mechanism, options.left, nodes.u[i, s], increments[i, s], state, k)
            constant_force(mechanism, drift, i, s, nodes.u[i, s], k.force)
            outcome = step(mechanism, options, h, state, k)
            record_effort(outcome, i, s, k, nodes)
            if outcome != SOLVED:
                break
            if noisy and options.left < 1.0:
                kick(mechanism, 1.0 - options.left, nodes.u[i, s], increments[i, s], state, k)
            record_node(mechanism, i, s, state, nodes)
