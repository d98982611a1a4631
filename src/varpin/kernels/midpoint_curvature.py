"""Second derivatives of the midpoint step, contracted with a vector.

For z = (zq, zp) the step equation r = 0 is joined to phi = zq . q1 + zp . p1 with the multiplier lam that makes the sum
stationary in v: N' lam = phi_v, N = -dr/dv. What is not linear in (q0, p0, f, v) there is h zp . L_q + lam . r, so

    psi = alpha . L_q + beta . L_v,    alpha = h zp + h (1-a) lam,    beta = -lam,

taken at (qm, v), holds every second derivative; at a root first derivatives of v are enough:

    d2 phi = dqm' psi_qq dqm + dqm' psi_qv dv + dv' psi_vq dqm + dv' psi_vv dv,    dqm = dq0 + a h dv.
"""

from varpin.kernels._compile import inlined, kernel
from varpin.kernels.jet_tangent import Tangent, third_order
from varpin.kernels.midpoint import begin_at, path, step
from varpin.kernels.midpoint_equation import SINGULAR, SOLVED, Options, State, Work
from varpin.kernels.midpoint_jacobian import root_jacobian, solve_at
from varpin.kernels.tree import Floats, Mechanism, block


@inlined
def substep_curvature(
    mechanism: Mechanism, options: Options, h: float, z: Floats, k: Work, t: Tangent, dv: Floats, H: Floats
) -> None:
    """Add z . d2(q1, p1)/d(q0, p0, f)2 to H (3n, 3n), at the root in ``k.v`` and the jet in the sweep.

    Leaves the blocks of dv/d(q0, p0, f) (n, 3n) in ``dv``.
    """
    w = k.sweep
    a = options.alpha
    n = k.v.size
    ends = mechanism.tree.ends
    root_jacobian(mechanism, options, h, k, dv)
    for b in range(len(ends)):
        begin, end = block(ends, b)
        for i in range(begin, end):
            for c in range(begin, end):
                dv[i, 2 * n + c] = 0.5 * h * dv[i, n + c]
        for i in range(begin, end):
            total = z[i] - mechanism.damping[i] * z[n + i]
            for j in range(begin, end):
                total += (a * h * w.Lqq[i, j] + w.A[i, j]) * z[n + j]
            k.residual[i] = h * total
        for i in range(begin, end):
            total = 0.0
            for j in range(begin, end):
                total += dv[j, n + i] * k.residual[j]  # dv/dp0 is the inverse of N
            k.start[i] = h * z[n + i] + h * (1.0 - a) * total
            k.delta[i] = -total
    third_order(mechanism, k.qm, k.v, k.start, k.delta, w, t)
    for b in range(len(ends)):
        begin, end = block(ends, b)
        for third in range(3):
            for c in range(third * n + begin, third * n + end):
                for i in range(begin, end):
                    in_q, in_v = 0.0, 0.0
                    for j in range(begin, end):
                        moved = a * h * dv[j, c]
                        if j == c:
                            moved += 1.0
                        in_q += t.Lqq[i, j] * moved + t.A[j, i] * dv[j, c]
                        in_v += t.A[i, j] * moved + t.M[i, j] * dv[j, c]
                    k.residual[i] = in_q
                    k.delta[i] = in_v
                for before in range(third + 1):
                    for r in range(before * n + begin, min(before * n + end, c + 1)):
                        total = 0.0
                        for i in range(begin, end):
                            moved = a * h * dv[i, r]
                            if i == r:
                                moved += 1.0
                            total += moved * k.residual[i] + dv[i, r] * k.delta[i]
                        H[r, c] += total
                        if r != c:
                            H[c, r] += total


@kernel
def contract(
    mechanism: Mechanism,
    options: Options,
    h: float,
    q: Floats,
    p: Floats,
    guess: Floats,
    force: Floats,
    z: Floats,
    states: State,
    k: Work,
    t: Tangent,
    dv: Floats,
    H: Floats,
) -> tuple[int, int]:
    """Second derivatives of steps that are taken whole, contracted with the rows of z (N, 2n), into H (N, 3n, 3n).

    In (q0, p0, f) with a constant force f; ``dv`` (n, 3n) is room. The other arguments and what is returned are those
    of :func:`varpin.kernels.midpoint_linearize.linearize`.
    """
    state = path(states, 0)
    for s in range(q.shape[0]):
        outcome = solve_at(mechanism, options, h, q[s], p[s], guess[s], force[s], state, k)
        if outcome != SOLVED:
            return outcome, s
        H[s] = 0.0
        substep_curvature(mechanism, options, h, z[s], k, t, dv, H[s])
    return SOLVED, q.shape[0]


@kernel
def parts_of_step(
    mechanism: Mechanism, options: Options, h: float, q: Floats, p: Floats, force: Floats, states: State, k: Work
) -> int:
    """Take a step from (q, p) (n,) and note its parts down in ``k.trail``; returns how it ended."""
    state = path(states, 0)
    for i in range(q.size):
        k.force[i] = force[i]
    if not begin_at(mechanism, q, p, state, k):
        return SINGULAR
    return step(mechanism, options, h, state, k)
