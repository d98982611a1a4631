"""The jet's own derivative along a direction: third derivatives of the Lagrangian, contracted, without a tensor.

Along (dq, dv) = (alpha, beta) everything below moves as the bodies do. With U = sum of S_i alpha_i over a joint and its
ancestors, the twist of the body along the direction (rotating along, as in :mod:`varpin.kernels.jet`),

    dS = U x S,    dY_b = (U x) applied to the inertia of body b,    dV = sum of dS v + S beta,    dW = dV x S + V x dS

and the product rule on the sweep gives the rest; sums over subtrees stay sums over subtrees. As
(alpha . d/dq + beta . d/dv) L = alpha . L_q + beta . L_v =: psi, the results are the second derivatives of psi:

    psi_vv = dM,    psi_vq = dA,    psi_qq = dL_qq.
"""

from typing import NamedTuple

import numpy as np

from varpin.kernels._compile import inlined, kernel
from varpin.kernels.jet import body_inertia, dot6, move_body, place_body, times_inertia
from varpin.kernels.tree import Floats, Mechanism, Sweep


class Tangent(NamedTuple):
    """Work arrays of the sweep along a direction, and where it leaves its results."""

    twist: Floats  # (b, 6) U
    axis: Floats  # (b, 6) dS
    velocity: Floats  # (b, 6) dV
    axis_rate: Floats  # (b, 6) dW
    inertia: Floats  # (b, 10) dY
    momentum: Floats  # (b, 6) dH
    dual_axis: Floats  # (b, 6) dF
    dual_rate: Floats  # (b, 6) dB
    part: Floats  # (b, 6) room
    M: Floats  # (n, n) dM
    A: Floats  # (n, n) dA
    Lqq: Floats  # (n, n) dL_qq


def new_tangent(bodies: int, dof: int) -> Tangent:
    """Allocate the work arrays for ``bodies`` bodies and ``dof`` coordinates."""
    spatial = [np.zeros((bodies, 6)) for _ in range(8)]
    return Tangent(
        twist=spatial[0],
        axis=spatial[1],
        velocity=spatial[2],
        axis_rate=spatial[3],
        inertia=np.zeros((bodies, 10)),
        momentum=spatial[4],
        dual_axis=spatial[5],
        dual_rate=spatial[6],
        part=spatial[7],
        M=np.zeros((dof, dof)),
        A=np.zeros((dof, dof)),
        Lqq=np.zeros((dof, dof)),
    )


@inlined
def add_cross_motion(a: Floats, b: Floats, j: int, out: Floats) -> None:
    """Add a_j x b_j of two motion vectors to out_j."""
    v0, v1, v2, w0, w1, w2 = a[j, 0], a[j, 1], a[j, 2], a[j, 3], a[j, 4], a[j, 5]
    s0, s1, s2, s3, s4, s5 = b[j, 0], b[j, 1], b[j, 2], b[j, 3], b[j, 4], b[j, 5]
    out[j, 0] += w1 * s2 - w2 * s1 + v1 * s5 - v2 * s4
    out[j, 1] += w2 * s0 - w0 * s2 + v2 * s3 - v0 * s5
    out[j, 2] += w0 * s1 - w1 * s0 + v0 * s4 - v1 * s3
    out[j, 3] += w1 * s5 - w2 * s4
    out[j, 4] += w2 * s3 - w0 * s5
    out[j, 5] += w0 * s4 - w1 * s3


@inlined
def add_cross_force(a: Floats, f: Floats, j: int, out: Floats) -> None:
    """Add a_j x* f_j of a motion and a force vector to out_j."""
    v0, v1, v2, w0, w1, w2 = a[j, 0], a[j, 1], a[j, 2], a[j, 3], a[j, 4], a[j, 5]
    f0, f1, f2, f3, f4, f5 = f[j, 0], f[j, 1], f[j, 2], f[j, 3], f[j, 4], f[j, 5]
    out[j, 0] += w1 * f2 - w2 * f1
    out[j, 1] += w2 * f0 - w0 * f2
    out[j, 2] += w0 * f1 - w1 * f0
    out[j, 3] += w1 * f5 - w2 * f4 + v1 * f2 - v2 * f1
    out[j, 4] += w2 * f3 - w0 * f5 + v2 * f0 - v0 * f2
    out[j, 5] += w0 * f4 - w1 * f3 + v0 * f1 - v1 * f0


@inlined
def move_inertia(Y: Floats, U: Floats, j: int, dY: Floats) -> None:
    """The rate dY_j of a body's inertia Y_j as it moves with the twist U_j: mass, first moment, inertia."""
    m, hx, hy, hz = Y[j, 0], Y[j, 1], Y[j, 2], Y[j, 3]
    ux, uy, uz, wx, wy, wz = U[j, 0], U[j, 1], U[j, 2], U[j, 3], U[j, 4], U[j, 5]
    xx, xy, yy, xz, yz, zz = Y[j, 4], Y[j, 5], Y[j, 6], Y[j, 7], Y[j, 8], Y[j, 9]
    dY[j, 0] = 0.0
    dY[j, 1] = m * ux + wy * hz - wz * hy
    dY[j, 2] = m * uy + wz * hx - wx * hz
    dY[j, 3] = m * uz + wx * hy - wy * hx
    # Turning: [w] I - I [w]; shifting: 2 (u . h) 1 - u h' - h u'.
    shift = 2.0 * (ux * hx + uy * hy + uz * hz)
    dY[j, 4] = 2.0 * (wy * xz - wz * xy) + shift - 2.0 * ux * hx
    dY[j, 5] = wy * yz - wz * yy + wz * xx - wx * xz - ux * hy - uy * hx
    dY[j, 6] = 2.0 * (wz * xy - wx * yz) + shift - 2.0 * uy * hy
    dY[j, 7] = wy * zz - wz * yz + wx * xy - wy * xx - ux * hz - uz * hx
    dY[j, 8] = wz * xz - wx * zz + wx * yy - wy * xy - uy * hz - uz * hy
    dY[j, 9] = 2.0 * (wx * yz - wy * xz) + shift - 2.0 * uz * hz


@inlined
def third_order(mechanism: Mechanism, q: Floats, v: Floats, alpha: Floats, beta: Floats, w: Sweep, t: Tangent) -> None:
    """The derivatives of M, L_vq and L_qq at (q, v) along (alpha, beta), left in ``t``. Uses the arrays of ``w``."""
    tree, g = mechanism.tree, mechanism.gravity
    bodies = tree.parent.size
    S, V, W, Y, H, F, B = w.axis, w.velocity, w.axis_rate, w.inertia, w.momentum, w.dual_axis, w.dual_rate
    U, dS, dV, dW, dY, dH = t.twist, t.axis, t.velocity, t.axis_rate, t.inertia, t.momentum
    dF, dB, part = t.dual_axis, t.dual_rate, t.part
    gx, gy, gz = g[0], g[1], g[2]
    t.M[:] = 0.0
    t.A[:] = 0.0
    t.Lqq[:] = 0.0
    for j in range(bodies):
        place_body(tree, j, q, w)
        move_body(tree, j, v, w)
        body_inertia(tree, j, w)
        times_inertia(Y, j, V, H)
        c, k = tree.coordinate[j], tree.parent[j]
        turn, rate, change = tree.ratio[j] * alpha[c], tree.ratio[j] * v[c], tree.ratio[j] * beta[c]
        for i in range(6):
            U[j, i] = S[j, i] * turn
            if k >= 0:
                U[j, i] += U[k, i]
            dS[j, i] = 0.0
            dW[j, i] = 0.0
        add_cross_motion(U, S, j, dS)
        for i in range(6):
            dV[j, i] = dS[j, i] * rate + S[j, i] * change
            if k >= 0:
                dV[j, i] += dV[k, i]
        add_cross_motion(dV, S, j, dW)
        add_cross_motion(V, dS, j, dW)
        move_inertia(Y, U, j, dY)
        times_inertia(dY, j, V, dH)
        times_inertia(Y, j, dV, part)
        for i in range(6):
            dH[j, i] += part[j, i]
    for j in range(bodies - 1, -1, -1):
        times_inertia(Y, j, S, F)
        times_inertia(Y, j, W, B)
        add_cross_force(S, H, j, B)
        times_inertia(dY, j, S, dF)
        times_inertia(Y, j, dS, part)
        for i in range(6):
            dF[j, i] += part[j, i]
        times_inertia(dY, j, W, dB)
        times_inertia(Y, j, dW, part)
        for i in range(6):
            dB[j, i] += part[j, i]
        add_cross_force(dS, H, j, dB)
        add_cross_force(S, dH, j, dB)
        # Of F . (S_i x g) = S_i(angular) . (g x F(linear)), and of its derivative.
        nx, ny, nz = gy * F[j, 2] - gz * F[j, 1], gz * F[j, 0] - gx * F[j, 2], gx * F[j, 1] - gy * F[j, 0]
        dnx, dny, dnz = gy * dF[j, 2] - gz * dF[j, 1], gz * dF[j, 0] - gx * dF[j, 2], gx * dF[j, 1] - gy * dF[j, 0]
        cj = tree.coordinate[j]
        i = j
        while i >= 0:
            ci = tree.coordinate[i]
            ratio = tree.ratio[i] * tree.ratio[j]
            mass = ratio * (dot6(dS, i, F, j) + dot6(S, i, dF, j))
            curvature = dot6(dW, i, B, j) + dot6(W, i, dB, j)
            curvature -= dS[i, 3] * nx + dS[i, 4] * ny + dS[i, 5] * nz
            curvature -= S[i, 3] * dnx + S[i, 4] * dny + S[i, 5] * dnz
            curvature *= ratio
            t.M[ci, cj] += mass
            t.Lqq[ci, cj] += curvature
            t.A[ci, cj] += ratio * (dot6(dS, i, B, j) + dot6(S, i, dB, j))
            if i != j:
                t.M[cj, ci] += mass
                t.Lqq[cj, ci] += curvature
                t.A[cj, ci] += ratio * (dot6(dW, i, F, j) + dot6(W, i, dF, j))
            i = tree.parent[i]
        k = tree.parent[j]
        if k >= 0:
            for i in range(6):
                H[k, i] += H[j, i]
                dH[k, i] += dH[j, i]
            for i in range(10):
                Y[k, i] += Y[j, i]
                dY[k, i] += dY[j, i]


@kernel
def momentum_curvatures(
    mechanism: Mechanism, q: Floats, v: Floats, beta: Floats, w: Sweep, t: Tangent, dA: Floats, dLqq: Floats
) -> None:
    """Second derivatives of beta . L_v at each row of q, v and beta (N, n): in v and q, in q twice, (N, n, n)."""
    n = q.shape[1]
    for s in range(q.shape[0]):
        for i in range(n):
            w.V[i] = 0.0
        third_order(mechanism, q[s], v[s], w.V, beta[s], w, t)
        for i in range(n):
            for j in range(n):
                dA[s, i, j] = t.A[i, j]
                dLqq[s, i, j] = t.Lqq[i, j]
