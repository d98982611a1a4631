"""Gauss collocation: variational integrators of order 2 s in position-momentum form.

A step is accepted, cut and kicked as a midpoint step is; only its equation is another.
"""

import numpy as np

from varpin.kernels._compile import inlined, kernel
from varpin.kernels.drive import apply_policy, constant_force
from varpin.kernels.gauss_equation import Stages, newton_stages
from varpin.kernels.gauss_jacobian import stages_jacobian
from varpin.kernels.gauss_tableau import Tableau
from varpin.kernels.linalg import solve_ldl
from varpin.kernels.midpoint import (
    advance,
    branch_margin,
    kick,
    next_substep,
    node_energy,
    path,
    record_effort,
    record_node,
    settle,
)
from varpin.kernels.midpoint_equation import FOLD, SOLVED, Options, State, Work
from varpin.kernels.midpoint_jacobian import chain
from varpin.kernels.place import add
from varpin.kernels.tree import Commands, Floats, Mechanism, Nodes, block


@inlined
def average(mechanism: Mechanism, tableau: Tableau, k: Work, g: Stages) -> None:
    """Put into the sweep what the branch guard of the midpoint rule is to see of the stages.

    Were M and L_qq the same at all stages, N would be M - h^2 a^2 L_qq apart from gyroscopic and damping forces. Where
    L_qq pulls the state back it never becomes singular (the method is A-stable); where it pushes it away the symmetric
    part, weighted with b, is at least M - h^2 x L_qq, with x from the numerical range of a^2: 1/4 for one stage.
    """
    w, ends = k.sweep, mechanism.tree.ends
    for b in range(len(ends)):
        begin, end = block(ends, b)
        for r in range(begin, end):
            for c in range(begin, end):
                mass, curvature = 0.0, 0.0
                for i in range(g.V.shape[0]):
                    mass += tableau.b[i] * g.M[i, r, c]
                    curvature += tableau.b[i] * g.Lqq[i, r, c]
                w.M[r, c], w.Lqq[r, c] = mass, 4.0 * tableau.reach * curvature


@inlined
def attempt(
    mechanism: Mechanism, tableau: Tableau, options: Options, h: float, state: State, k: Work, g: Stages
) -> int:
    """One substep from ``state`` and the guess in ``g.V``; moves the state only if it ends in SOLVED."""
    outcome = newton_stages(mechanism, tableau, options, h, state, k, g)
    if outcome != SOLVED:
        return outcome
    average(mechanism, tableau, k, g)
    margin = branch_margin(mechanism, options, h, k)
    if not margin > 0.0:
        return FOLD
    stages, n = g.V.shape
    group = mechanism.tree.group
    place, place_low, p, p_low = k.trial[0], k.trial[1], k.trial[2], k.trial[3]
    for r in range(mechanism.tree.groups):
        k.balance[r, 1] = 0.0
        k.balance[r, 2] = 0.0
    for r in range(n):
        move, impulse = 0.0, 0.0
        k.work[r] = 0.0
        for i in range(stages):
            share, velocity = h * tableau.b[i], g.V[i, r]
            drag = mechanism.damping[r] * velocity
            move += tableau.b[i] * velocity
            impulse += tableau.b[i] * g.slope[i, r]
            k.work[r] += share * (k.force[r] - drag) * velocity
            k.balance[group[r], 2] += share * drag * velocity
        k.balance[group[r], 1] += k.work[r]
        place[r], place_low[r] = add(state.place[r], state.place_low[r], h * move)
        p[r], p_low[r] = add(state.p[r], state.p_low[r], h * impulse)
    outcome = settle(mechanism, options, state, k)
    if outcome != SOLVED:
        return outcome
    if k.Jx.shape[0] > 0:
        stages_jacobian(mechanism, tableau, h, g, k.part[: 2 * n], k.part[2 * n :, :n])
        chain(mechanism, k)
    advance(mechanism, margin, state, k)
    return SOLVED


@inlined
def predict(mechanism: Mechanism, tableau: Tableau, h: float, state: State, k: Work, g: Stages) -> None:
    """Extrapolate the last whole step into ``g.V``.

    The polynomial through its stage velocities and the velocity at its end goes on, moved by what a kick has since done
    to the velocity, and bent by what has changed in the force. Where nothing kicks, it misses by much the same
    from step to step. ``k.ldl`` holds the factors of M(q).
    """
    stages, n = g.V.shape
    past, end, force, miss = state.past, stages, stages + 1, stages + 2
    smooth = state.counters[0] > 1 and state.center.shape[1] == 0
    for r in range(n):
        k.residual[r] = k.force[r] - past[force, r]
    ends = mechanism.tree.ends
    for b in range(len(ends)):
        first, beyond = block(ends, b)
        solve_ldl(k.ldl, k.residual, k.delta, first, beyond)
    for i in range(stages):
        for r in range(n):
            total = state.v[r] - past[end, r]
            for row in range(stages + 1):
                total += tableau.ahead[i, row] * past[row, r]
            g.guess[i, r] = total + h * tableau.c[i] * k.delta[r]
            g.V[i, r] = g.guess[i, r]
            if smooth:
                g.V[i, r] += past[miss + i, r]


@inlined
def remember(state: State, k: Work, g: Stages) -> None:
    """Put the step just done into the past; ``g.guess`` holds what was extrapolated, if anything was known."""
    stages, n = g.V.shape
    past, end, force, miss = state.past, stages, stages + 1, stages + 2
    for r in range(n):
        for i in range(stages):
            past[i, r] = g.V[i, r]
            past[miss + i, r] = g.V[i, r] - g.guess[i, r]
        past[end, r] = state.v[r]
        past[force, r] = k.force[r]
    state.counters[0] = min(state.counters[0] + 1, 2)


@inlined
def step(mechanism: Mechanism, tableau: Tableau, options: Options, h: float, state: State, k: Work, g: Stages) -> int:
    """One whole step with the force in ``k.force``, in as many substeps as the guards ask for.

    The first attempt starts from the extrapolated past, the others from the current velocity.
    """
    stages, n = g.V.shape
    k.tally[:] = 0
    k.quality[0] = 0.0
    k.quality[1] = np.inf
    level = max(state.counters[1] - 1, 0)
    extrapolate = level == 0 and state.counters[0] > 0
    deepest = level
    place = 0  # in units of h / 2^level
    while place < 1 << level:
        if extrapolate:
            predict(mechanism, tableau, h, state, k, g)
        else:
            for i in range(stages):
                for r in range(n):
                    g.V[i, r] = state.v[r]
        outcome = attempt(mechanism, tableau, options, h / (1 << level), state, k, g)
        level, place = next_substep(outcome, extrapolate, level, place, options.halvings)
        if level < 0:
            return outcome
        deepest = max(deepest, level)
        extrapolate = False
    state.counters[1] = deepest
    if deepest > 0:
        state.counters[0] = 0
    else:
        remember(state, k, g)
    return SOLVED


@kernel
def rollout(
    mechanism: Mechanism,
    tableau: Tableau,
    options: Options,
    h: float,
    commands: Commands,
    increments: Floats,
    drift: Floats,
    states: State,
    k: Work,
    g: Stages,
    nodes: Nodes,
) -> None:
    """Steps of P paths from ``states``: as :func:`varpin.kernels.midpoint.rollout`."""
    noisy = increments.shape[0] > 0 and increments.shape[2] > 0
    for i in range(states.q.shape[0]):
        state = path(states, i)
        node_energy(mechanism, state.place, state.p, state.v, k)
        nodes.ended[i] = SOLVED
        nodes.done[i] = 0
        for s in range(nodes.u.shape[1]):
            apply_policy(commands, i, s, state.q, state.p, nodes.u[i])
            if noisy:
                kick(mechanism, options.left, nodes.u[i, s], increments[i, s], state, k)
            constant_force(mechanism, drift, i, s, nodes.u[i, s], k.force)
            outcome = step(mechanism, tableau, options, h, state, k, g)
            record_effort(outcome, i, s, k, nodes)
            if outcome != SOLVED:
                break
            if noisy and options.left < 1.0:
                kick(mechanism, 1.0 - options.left, nodes.u[i, s], increments[i, s], state, k)
            record_node(mechanism, i, s, state, nodes)
