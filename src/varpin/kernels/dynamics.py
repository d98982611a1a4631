"""Forward dynamics and its derivatives, for the integrators that work on (q, v).

Inverse dynamics by the recursive Newton-Euler algorithm, tau = S . Phi with Phi the force that moves the subtree. Its
derivatives follow from the rotate-along argument of :mod:`varpin.kernels.jet`: replace d/dq_i by d/dq_i - S_i x; then,
for a body b below i, with V_p and A_p the velocity and the acceleration (gravity taken off) of i's parent,

    dV_b = W_i,    dA_b = Z_i + W_i x V_b,    Z_i = A_p x S_i + V_p x W_i,

and with C x = I (x x V) + x x* H + V x* I x, summed over the subtree like its inertia Y,

    dtau_j/dq_i = F_j . Z_i + (C_j' S_j) . W_i        dtau_i/dq_j = S_i . (Y_j Z_j + C_j W_j + S_j x* Phi_j)
    dtau_j/dv_i = 2 F_j . W_i + (C_j' S_j) . S_i      dtau_i/dv_j = S_i . (2 Y_j W_j + C_j S_j)
"""

from typing import NamedTuple

import numpy as np

from varpin.kernels._compile import inlined, kernel
from varpin.kernels.jet import (
    add_mass,
    body_inertia,
    clear_mass,
    dot6,
    move_body,
    origin_potential,
    pass_inertia,
    place_body,
    times_inertia,
)
from varpin.kernels.linalg import factor_ldl, solve_ldl
from varpin.kernels.tree import Floats, Mechanism, Sweep, block, new_sweep


class Dynamics(NamedTuple):
    """Work arrays and results."""

    sweep: Sweep
    acceleration: Floats  # (b, 6) A, gravity taken off
    force: Floats  # (b, 6) Phi
    coupling: Floats  # (b, 36) C, row-major
    bias: Floats  # (n,) inverse dynamics at zero acceleration, friction and springs included
    ldl: Floats  # (n, n) factors of M
    dq: Floats  # (n, n) derivative of inverse dynamics in q
    dv: Floats  # (n, n) and in v
    column: Floats  # (n,)
    solution: Floats  # (n,)


def new_dynamics(bodies: int, dof: int) -> Dynamics:
    """Allocate them."""
    return Dynamics(
        sweep=new_sweep(bodies, dof),
        acceleration=np.zeros((bodies, 6)),
        force=np.zeros((bodies, 6)),
        coupling=np.zeros((bodies, 36)),
        bias=np.zeros(dof),
        ldl=np.zeros((dof, dof)),
        dq=np.zeros((dof, dof)),
        dv=np.zeros((dof, dof)),
        column=np.zeros(dof),
        solution=np.zeros(dof),
    )


@inlined
def cross_motion(a: Floats, i: int, b: Floats, j: int) -> tuple[float, float, float, float, float, float]:
    """a[i] x b[j] of two stacks of motions."""
    a0, a1, a2, a3, a4, a5 = a[i, 0], a[i, 1], a[i, 2], a[i, 3], a[i, 4], a[i, 5]
    b0, b1, b2, b3, b4, b5 = b[j, 0], b[j, 1], b[j, 2], b[j, 3], b[j, 4], b[j, 5]
    return (
        a4 * b2 - a5 * b1 + a1 * b5 - a2 * b4,
        a5 * b0 - a3 * b2 + a2 * b3 - a0 * b5,
        a3 * b1 - a4 * b0 + a0 * b4 - a1 * b3,
        a4 * b5 - a5 * b4,
        a5 * b3 - a3 * b5,
        a3 * b4 - a4 * b3,
    )


@inlined
def cross_force(a: Floats, i: int, f: Floats, j: int) -> tuple[float, float, float, float, float, float]:
    """a[i] x* f[j] of a stack of motions and one of forces."""
    a0, a1, a2, a3, a4, a5 = a[i, 0], a[i, 1], a[i, 2], a[i, 3], a[i, 4], a[i, 5]
    f0, f1, f2, f3, f4, f5 = f[j, 0], f[j, 1], f[j, 2], f[j, 3], f[j, 4], f[j, 5]
    return (
        a4 * f2 - a5 * f1,
        a5 * f0 - a3 * f2,
        a3 * f1 - a4 * f0,
        a4 * f5 - a5 * f4 + a1 * f2 - a2 * f1,
        a5 * f3 - a3 * f5 + a2 * f0 - a0 * f2,
        a3 * f4 - a4 * f3 + a0 * f1 - a1 * f0,
    )


@inlined
def accelerate_body(mechanism: Mechanism, j: int, v: Floats, acceleration: Floats, d: Dynamics) -> None:
    """A and Phi of body ``j`` alone, from its V, W and Y; joints accelerate by ``acceleration`` (n,)."""
    tree, g, w = mechanism.tree, mechanism.gravity, d.sweep
    A, f, S, W, V, H = d.acceleration, d.force, w.axis, w.axis_rate, w.velocity, w.momentum
    rate = tree.ratio[j] * v[tree.coordinate[j]]
    gain = tree.ratio[j] * acceleration[tree.coordinate[j]]
    k = tree.parent[j]
    for i in range(6):
        before = -g[i] if i < 3 else 0.0
        if k >= 0:
            before = A[k, i]
        A[j, i] = before + S[j, i] * gain + W[j, i] * rate
    times_inertia(w.inertia, j, V, H)
    times_inertia(w.inertia, j, A, f)
    x0, x1, x2, x3, x4, x5 = cross_force(V, j, H, j)
    f[j, 0] += x0
    f[j, 1] += x1
    f[j, 2] += x2
    f[j, 3] += x3
    f[j, 4] += x4
    f[j, 5] += x5


@inlined
def node(mechanism: Mechanism, q: Floats, v: Floats, d: Dynamics) -> tuple[bool, float]:
    """Mass matrix, its factors and the bias at (q, v), left in ``d``; whether M is definite, and the potential [J]."""
    tree, w = mechanism.tree, d.sweep
    bodies = tree.parent.size
    S, M = w.axis, w.M
    n = q.size
    potential = 0.0
    for i in range(n):
        w.V[i] = 0.0
        w.V_scale[i] = 0.0
        d.column[i] = 0.0
        deflection = q[i] - mechanism.rest[i]
        potential += 0.5 * mechanism.stiffness[i] * deflection * deflection
        d.bias[i] = mechanism.damping[i] * v[i] + mechanism.stiffness[i] * deflection
    clear_mass(tree, w)
    for j in range(bodies):
        place_body(tree, j, q, w)
        move_body(tree, j, v, w)
        body_inertia(tree, j, w)
        accelerate_body(mechanism, j, v, d.column, d)
    for j in range(bodies - 1, -1, -1):
        add_mass(tree, j, w)
        cj = tree.coordinate[j]
        d.bias[cj] += tree.ratio[j] * dot6(S, j, d.force, j)
        k = tree.parent[j]
        if k >= 0:
            pass_inertia(tree, j, 10, w)
            for i in range(6):
                d.force[k, i] += d.force[j, i]
        if tree.origin[j]:
            potential += origin_potential(mechanism, j, q, w)
    regular = True
    for b in range(len(tree.ends)):
        begin, end = block(tree.ends, b)
        for i in range(begin, end):
            M[i, i] += tree.armature[i]
            for j in range(begin, i + 1):
                d.ldl[i, j] = M[i, j]
        regular = factor_ldl(d.ldl, begin, end) and regular
    return regular, potential


@inlined
def solve_mass(mechanism: Mechanism, b: Floats, d: Dynamics, x: Floats) -> None:
    """The x with M x = b from what :func:`node` left."""
    ends = mechanism.tree.ends
    for r in range(len(ends)):
        begin, end = block(ends, r)
        solve_ldl(d.ldl, b, x, begin, end)


@inlined
def acceleration_at_node(mechanism: Mechanism, force: Floats, d: Dynamics, a: Floats) -> None:
    """Acceleration a = M^-1 (force - bias) from what :func:`node` left."""
    for i in range(force.size):
        d.column[i] = force[i] - d.bias[i]
    solve_mass(mechanism, d.column, d, a)


@inlined
def couple_body(tree_index: int, d: Dynamics) -> None:
    """C of one body: C x = I (x x V) + x x* H + V x* I x, column by column."""
    j = tree_index
    w = d.sweep
    # The stacks' own rows of F and B serve as room; they are computed anew in the backward sweep.
    x, y = w.dual_axis, w.dual_rate
    for c in range(6):
        for i in range(6):
            x[j, i] = 1.0 if i == c else 0.0
        t0, t1, t2, t3, t4, t5 = cross_motion(x, j, w.velocity, j)
        y[j, 0], y[j, 1], y[j, 2], y[j, 3], y[j, 4], y[j, 5] = t0, t1, t2, t3, t4, t5
        h0, h1, h2, h3, h4, h5 = cross_force(x, j, w.momentum, j)
        # times_inertia reads the whole row before it writes it, so input and output may be the same.
        times_inertia(w.inertia, j, y, y)
        C = d.coupling
        C[j, c] = y[j, 0] + h0
        C[j, 6 + c] = y[j, 1] + h1
        C[j, 12 + c] = y[j, 2] + h2
        C[j, 18 + c] = y[j, 3] + h3
        C[j, 24 + c] = y[j, 4] + h4
        C[j, 30 + c] = y[j, 5] + h5
        times_inertia(w.inertia, j, x, y)
        h0, h1, h2, h3, h4, h5 = cross_force(w.velocity, j, y, j)
        C[j, c] += h0
        C[j, 6 + c] += h1
        C[j, 12 + c] += h2
        C[j, 18 + c] += h3
        C[j, 24 + c] += h4
        C[j, 30 + c] += h5


@inlined
def times_coupling(C: Floats, j: int, x: Floats, transpose: bool, out: Floats) -> None:
    """out[j] = C_j x[j], or C_j' x[j]."""
    for i in range(6):
        total = 0.0
        for c in range(6):
            total += (C[j, 6 * c + i] if transpose else C[j, 6 * i + c]) * x[j, c]
        out[j, i] = total


@inlined
def inverse_dynamics_derivatives(
    mechanism: Mechanism, q: Floats, v: Floats, acceleration: Floats, Z: Floats, P: Floats, Q: Floats, d: Dynamics
) -> None:
    """Dq and dv of inverse dynamics at (q, v, acceleration), left in ``d``; Z, P, Q (b, 6) are room."""
    tree, w = mechanism.tree, d.sweep
    bodies = tree.parent.size
    S, V, W, Y, F, R = w.axis, w.velocity, w.axis_rate, w.inertia, w.dual_axis, w.dual_rate
    for b in range(len(tree.ends)):
        begin, end = block(tree.ends, b)
        for i in range(begin, end):
            for j in range(begin, end):
                d.dq[i, j] = 0.0
                d.dv[i, j] = 0.0
            d.dq[i, i] = mechanism.stiffness[i]
            d.dv[i, i] = mechanism.damping[i]
    for j in range(bodies):
        place_body(tree, j, q, w)
        move_body(tree, j, v, w)
        body_inertia(tree, j, w)
        accelerate_body(mechanism, j, v, acceleration, d)
        couple_body(j, d)
        k = tree.parent[j]
        if k >= 0:
            z0, z1, z2, z3, z4, z5 = cross_motion(d.acceleration, k, S, j)
            y0, y1, y2, y3, y4, y5 = cross_motion(V, k, W, j)
            Z[j, 0], Z[j, 1], Z[j, 2] = z0 + y0, z1 + y1, z2 + y2
            Z[j, 3], Z[j, 4], Z[j, 5] = z3 + y3, z4 + y4, z5 + y5
        else:
            # (-g, 0) x S
            g = mechanism.gravity
            Z[j, 0] = -g[1] * S[j, 5] + g[2] * S[j, 4]
            Z[j, 1] = -g[2] * S[j, 3] + g[0] * S[j, 5]
            Z[j, 2] = -g[0] * S[j, 4] + g[1] * S[j, 3]
            Z[j, 3] = 0.0
            Z[j, 4] = 0.0
            Z[j, 5] = 0.0
    for j in range(bodies - 1, -1, -1):
        times_inertia(Y, j, S, F)
        times_coupling(d.coupling, j, S, True, P)
        times_coupling(d.coupling, j, W, False, Q)
        times_inertia(Y, j, Z, R)
        x0, x1, x2, x3, x4, x5 = cross_force(S, j, d.force, j)
        Q[j, 0] += R[j, 0] + x0
        Q[j, 1] += R[j, 1] + x1
        Q[j, 2] += R[j, 2] + x2
        Q[j, 3] += R[j, 3] + x3
        Q[j, 4] += R[j, 4] + x4
        Q[j, 5] += R[j, 5] + x5
        cj = tree.coordinate[j]
        i = j
        while i >= 0:
            ci = tree.coordinate[i]
            ratio = tree.ratio[i] * tree.ratio[j]
            d.dq[cj, ci] += ratio * (dot6(F, j, Z, i) + dot6(P, j, W, i))
            d.dv[cj, ci] += ratio * (2.0 * dot6(F, j, W, i) + dot6(P, j, S, i))
            if i != j:
                d.dq[ci, cj] += ratio * dot6(S, i, Q, j)
            i = tree.parent[i]
        # From here R is 2 Y W + C S.
        times_inertia(Y, j, W, R)
        times_coupling(d.coupling, j, S, False, P)
        for i in range(6):
            R[j, i] = 2.0 * R[j, i] + P[j, i]
        i = tree.parent[j]
        while i >= 0:
            d.dv[tree.coordinate[i], cj] += tree.ratio[i] * tree.ratio[j] * dot6(S, i, R, j)
            i = tree.parent[i]
        k = tree.parent[j]
        if k >= 0:
            pass_inertia(tree, j, 10, w)
            for i in range(6):
                d.force[k, i] += d.force[j, i]
            for i in range(36):
                d.coupling[k, i] += d.coupling[j, i]


@kernel
def forward_derivatives(
    mechanism: Mechanism,
    q: Floats,
    v: Floats,
    force: Floats,
    Z: Floats,
    P: Floats,
    Q: Floats,
    d: Dynamics,
    a: Floats,
    aq: Floats,
    av: Floats,
    af: Floats,
) -> bool:
    """Acceleration a (N, n) at each row of q, v and force, and its derivatives (N, n, n); False where M is singular."""
    ends = mechanism.tree.ends
    aq[:] = 0.0
    av[:] = 0.0
    af[:] = 0.0
    for s in range(q.shape[0]):
        regular, _ = node(mechanism, q[s], v[s], d)
        if not regular:
            return False
        acceleration_at_node(mechanism, force[s], d, a[s])
        inverse_dynamics_derivatives(mechanism, q[s], v[s], a[s], Z, P, Q, d)
        for b in range(len(ends)):
            begin, end = block(ends, b)
            for c in range(begin, end):
                for i in range(begin, end):
                    d.column[i] = -d.dq[i, c]
                solve_ldl(d.ldl, d.column, d.solution, begin, end)
                for i in range(begin, end):
                    aq[s, i, c] = d.solution[i]
                    d.column[i] = -d.dv[i, c]
                solve_ldl(d.ldl, d.column, d.solution, begin, end)
                for i in range(begin, end):
                    av[s, i, c] = d.solution[i]
                    d.column[i] = 1.0 if i == c else 0.0
                solve_ldl(d.ldl, d.column, d.solution, begin, end)
                for i in range(begin, end):
                    af[s, i, c] = d.solution[i]
    return True


@kernel
def forward_dynamics(mechanism: Mechanism, x: Floats, force: Floats, d: Dynamics, rate: Floats) -> bool:
    """The rate (v, a) of x = (q, v), each (2n,), under a force (n,); False where M is singular."""
    n = force.size
    q, v = x[:n], x[n:]
    regular, _ = node(mechanism, q, v, d)
    acceleration_at_node(mechanism, force, d, rate[n:])
    for i in range(n):
        rate[i] = v[i]
    return regular
