"""Energy balances of light parts: what rides on something far heavier is lost in the balance of both together.

For a part with coordinates i of its own, the Lagrangian L of its bodies alone depends on the motion of what carries it,
coordinates a. Its Jacobi energy J = sum_i p_i v_i - L changes by the work of forces on its own coordinates, and by
what the carrier does to it:

    dJ = sum_i F_i dq_i - sum_a (L_q,a dq_a + L_v,a dv_a).

L_q,a and L_v,a are taken at the nodes, by the trapezoidal rule. That costs one first-order sweep a node, and only
scenes in which such parts are found pay it.
"""

from varpin.kernels._compile import inlined
from varpin.kernels.jet import dot6, first_order
from varpin.kernels.midpoint_equation import NOTHING, Options, State, Work
from varpin.kernels.tree import Floats, Integers, Mechanism

# Columns of a row for each part; L_q and L_v in all coordinates follow.
JACOBI, POTENTIAL, SCALE, DEFECT, MOST, DRIVE = 0, 1, 2, 3, 4, 5

LOAD_ROOM = 4.0  # times the limits of whole groups: the trapezoidal rule errs too
FLOOR = 0.02  # of the energy guard's limit is always left, or a full ledger could never be worked off


@inlined
def limit_of(options: Options, error: float, defect: float, moved: float, exchanged: float, most: float) -> float:
    """The largest error of an energy balance over a substep.

    A small part of the energy turned over. An error that adds to those before it has less room the fuller the ledger
    is, so they do not wander off however often substeps break the structure. Off the middle the method is of first
    order and its energy errors with it, from rest on: there they have more room.
    """
    limit = options.balance * (1.0 + 9.0 * abs(1.0 - 2.0 * options.alpha)) * (moved + exchanged)
    if abs(defect + error) > abs(defect):
        room = options.budget * max(most, moved, exchanged)
        if room > 0.0:
            limit *= max(FLOOR, 1.0 - abs(defect) / room)
    return limit


@inlined
def varied(state: State, k: Work, i: int) -> float:
    """The kinetic energy that coordinate ``i`` may be said to turn over.

    Its share counts as far as it has varied of late: a heavy wheel that turns on and on would else leave room for any
    error of what it carries.
    """
    share, new = state.share[i], k.share[i]
    return min(max(share[0], new), max(share[2], new) - min(share[1], new))


@inlined
def below(parent: Integers, body: int, top: int) -> bool:
    """Whether ``body`` is ``top`` or hangs on it; parents come first."""
    while body > top:
        body = parent[body]
    return body == top


@inlined
def load_energies(mechanism: Mechanism, place: Floats, p: Floats, v: Floats, k: Work) -> None:
    """Jacobi energy, potential energy and carrier's derivatives of each light part at a node, into ``k.loads``."""
    tree, g, w = mechanism.tree, mechanism.gravity, k.sweep
    n = v.size
    first_order(mechanism, place, v, w)
    S, W, V, H, Y = w.axis, w.axis_rate, w.velocity, w.momentum, w.inertia
    strength = abs(g[0]) + abs(g[1]) + abs(g[2])
    for r in range(tree.loads.size):
        j = tree.loads[r]
        row = k.loads[r]
        m, hx, hy, hz = Y[j, 0], Y[j, 1], Y[j, 2], Y[j, 3]
        a = tree.parent[j]
        carried = 0.5 * dot6(V, a, H, j)
        # Of what carries the part's origin up and down the carrier's L_q is spared too.
        potential = -(g[0] * hx + g[1] * hy + g[2] * hz)
        scale = strength * (abs(hx) + abs(hy) + abs(hz)) + abs(carried)
        for b in range(j, tree.parent.size):
            if tree.origin[b] and below(tree.parent, b, j):
                # Moments past an origin are about it, and it slides.
                if b > j:
                    potential -= g[0] * Y[b, 1] + g[1] * Y[b, 2] + g[2] * Y[b, 3]
                    scale += strength * (abs(Y[b, 1]) + abs(Y[b, 2]) + abs(Y[b, 3]))
                if tree.prismatic[b]:
                    slid = tree.ratio[b] * place[tree.coordinate[b]] + tree.offset[b]
                    potential -= Y[b, 0] * slid * (g[0] * S[b, 0] + g[1] * S[b, 1] + g[2] * S[b, 2])
                    scale += strength * Y[b, 0] * abs(slid)
        jacobi = -carried
        for c in range(n):
            row[DRIVE + c] = 0.0
            row[DRIVE + n + c] = 0.0
            if tree.carried[r, c]:
                deflection = place[c] - mechanism.rest[c]
                potential += 0.5 * mechanism.stiffness[c] * deflection * deflection
                jacobi += 0.5 * p[c] * v[c]
                scale += abs(p[c] * v[c])
        while a >= 0:
            c = tree.coordinate[a]
            slope = dot6(W, a, H, j)
            if not (tree.origin[a] and tree.prismatic[a]):
                slope += m * (S[a, 0] * g[0] + S[a, 1] * g[1] + S[a, 2] * g[2])
                slope += S[a, 3] * (hy * g[2] - hz * g[1])
                slope += S[a, 4] * (hz * g[0] - hx * g[2])
                slope += S[a, 5] * (hx * g[1] - hy * g[0])
            row[DRIVE + c] += tree.ratio[a] * slope
            row[DRIVE + n + c] += tree.ratio[a] * dot6(S, a, H, j)
            a = tree.parent[a]
        row[JACOBI], row[POTENTIAL], row[SCALE] = jacobi + potential, potential, scale


@inlined
def load_balanced(mechanism: Mechanism, options: Options, state: State, k: Work, r: int, rounding: float) -> bool:
    """Whether the balance of light part ``r`` closes over a substep; leaves its ledger in ``k.loads``."""
    tree = mechanism.tree
    old, new = state.loads[r], k.loads[r]
    n = k.v.size
    place, low, v = k.trial[0], k.trial[1], k.trial[4]
    work, drive, exchanged, moved = 0.0, 0.0, 0.0, 0.0
    for c in range(n):
        if tree.carried[r, c]:
            work += k.work[c]
            moved += varied(state, k, c)
            continue
        by_place = 0.5 * (old[DRIVE + c] + new[DRIVE + c])
        by_place *= (place[c] - state.place[c]) + (low[c] - state.place_low[c])
        by_rate = 0.5 * (old[DRIVE + n + c] + new[DRIVE + n + c]) * (v[c] - state.v[c])
        drive += by_place + by_rate
        exchanged += abs(by_place) + abs(by_rate)
    error = (new[JACOBI] - old[JACOBI]) - work + drive
    exchanged += abs(new[POTENTIAL] - old[POTENTIAL]) + abs(work)
    limit = limit_of(options, error, old[DEFECT], moved, exchanged, LOAD_ROOM * old[MOST])
    new[DEFECT], new[MOST] = old[DEFECT] + error, max(old[MOST], moved)
    return abs(error) <= LOAD_ROOM * limit + rounding * (old[SCALE] + new[SCALE] + exchanged) + NOTHING


@inlined
def enter_loads(state: State, k: Work) -> None:
    """Enter the rows of a new node."""
    for r in range(state.loads.shape[0]):
        for c in range(state.loads.shape[1]):
            state.loads[r, c] = k.loads[r, c]


@inlined
def reset_loads(mechanism: Mechanism, fresh: bool, state: State, k: Work) -> None:
    """Bring the rows along where the state has been put or kicked; a fresh start has no errors behind it."""
    if mechanism.tree.loads.size == 0:
        return
    load_energies(mechanism, state.place, state.p, state.v, k)
    for r in range(mechanism.tree.loads.size):
        k.loads[r, DEFECT] = 0.0 if fresh else state.loads[r, DEFECT]
        k.loads[r, MOST] = 0.0 if fresh else state.loads[r, MOST]
    enter_loads(state, k)
