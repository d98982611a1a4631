"""The derivative of the midpoint step, by implicit differentiation of its equation at the root.

With N = -dr/dv, its inverse Vp, and everything taken at the midpoint

    dr/dq0 = h(1-a) L_qq - A,    dr/dp0 = 1,    dr/df = h/2    (f: a force that is constant over the step)

the root moves by dv = Vp (dr/dq0 dq0 + dp0 + (h/2) df), and then

    dq1 = dq0 + h dv,    dp1 = dp0 + h (L_qq (dq0 + a h dv) + A' dv - D dv + df).

One factorisation, no finite difference. The same as the slot formulas with D1D1, D2D1 and D2D2 of the discrete
Lagrangian, but without their 1/h, so small steps lose no digits.
"""

from varpin.kernels._compile import inlined
from varpin.kernels.jet import second_order
from varpin.kernels.linalg import solve_lu_twice
from varpin.kernels.midpoint_equation import SOLVED, Options, State, Work, factor_newton, newton
from varpin.kernels.place import put
from varpin.kernels.tree import Floats, Mechanism, block


@inlined
def solve_at(
    mechanism: Mechanism,
    options: Options,
    h: float,
    q: Floats,
    p: Floats,
    guess: Floats,
    force: Floats,
    state: State,
    k: Work,
) -> int:
    """Solve the step equation at (q, p) under ``force``, each (n,), from a guess next to the root.

    Leaves the root in ``k.v`` and the jet there in the sweep; returns how it ended.
    """
    for i in range(q.size):
        k.force[i] = force[i]
        k.v[i] = guess[i]
    put(mechanism, q, p, state)
    k.tally[2] = 0
    outcome = newton(mechanism, options, h, state, k)
    if outcome == SOLVED and k.tally[2] > 0:  # the last look at the residual was a first-order one
        second_order(mechanism, k.qm, k.v, k.sweep)
    return outcome


@inlined
def root_jacobian(mechanism: Mechanism, options: Options, h: float, k: Work, dv: Floats) -> None:
    """dv/dq0 and dv/dp0, side by side in the first n rows of ``dv``, at the root in ``k.v``, the jet in the sweep.

    Writes the blocks alone.
    """
    w = k.sweep
    a = options.alpha
    n = k.v.size
    ends = mechanism.tree.ends
    factor_newton(mechanism, a, h, k)
    for b in range(len(ends)):
        begin, end = block(ends, b)
        for c in range(begin, end):
            for i in range(begin, end):
                k.residual[i] = h * (1.0 - a) * w.Lqq[i, c] - w.A[i, c]
                k.delta[i] = 1.0 if i == c else 0.0
            solve_lu_twice(k.lu, k.residual, k.residual, k.delta, k.delta, begin, end)
            for i in range(begin, end):
                dv[i, c], dv[i, n + c] = k.residual[i], k.delta[i]


@inlined
def substep_jacobian(mechanism: Mechanism, options: Options, h: float, k: Work, Jx: Floats, Jf: Floats) -> None:
    """d(q1, p1)/d(q0, p0) (2n, 2n) and d(q1, p1)/df (2n, n) at the root in ``k.v`` and the jet in the sweep."""
    w = k.sweep
    a = options.alpha
    n = k.v.size
    ends = mechanism.tree.ends
    if len(ends) > 1:
        Jx[:] = 0.0
        Jf[:] = 0.0
    root_jacobian(mechanism, options, h, k, Jx)
    for b in range(len(ends)):
        begin, end = block(ends, b)
        for i in range(begin, end):
            for c in range(begin, end):
                of_place, of_momentum = 0.0, 0.0
                for j in range(begin, end):
                    slope = a * h * w.Lqq[i, j] + w.A[j, i]
                    of_place += slope * Jx[j, c]
                    of_momentum += slope * Jx[j, n + c]
                of_place = (of_place - mechanism.damping[i] * Jx[i, c]) + w.Lqq[i, c]
                of_momentum -= mechanism.damping[i] * Jx[i, n + c]
                Jx[n + i, c], Jx[n + i, n + c] = h * of_place, h * of_momentum
                if i == c:
                    Jx[n + i, n + c] += 1.0
        for i in range(begin, end):
            for c in range(begin, end):
                # dp1 = dp0 + W dv + h df with dv = (h/2) Vp df; W Vp is what Jx[n:, n:] holds besides the identity.
                Jf[i, c] = 0.5 * h * h * Jx[i, n + c]
                Jf[n + i, c] = 0.5 * h * (Jx[n + i, n + c] + (1.0 if i == c else 0.0))
        for i in range(begin, end):
            for c in range(begin, end):
                Jx[i, c] *= h
                Jx[i, n + c] *= h
            Jx[i, i] += 1.0


@inlined
def identity(k: Work) -> None:
    """The derivatives of no step at all."""
    n = k.v.size
    for i in range(2 * n):
        for j in range(2 * n):
            k.Jx[i, j] = 1.0 if i == j else 0.0
        for j in range(n):
            k.Jf[i, j] = 0.0


@inlined
def add_substep(mechanism: Mechanism, options: Options, h: float, k: Work) -> None:
    """Let the substep at the root in ``k.v``, its jet in the sweep, follow those before."""
    n = k.v.size
    substep_jacobian(mechanism, options, h, k, k.part[: 2 * n], k.part[2 * n :, :n])
    chain(mechanism, k)


@inlined
def chain(mechanism: Mechanism, k: Work) -> None:
    """Let the substep whose derivatives stand in ``k.part`` follow those before: chain rule."""
    n = k.v.size
    Jx, Jf, product = k.part[: 2 * n], k.part[2 * n :, :n], k.part[2 * n :, n:]
    ends = mechanism.tree.ends
    for b in range(len(ends)):
        begin, end = block(ends, b)
        for half in range(2):
            for top in range(2):
                for i in range(top * n + begin, top * n + end):
                    for j in range(begin, end):
                        total = 0.0
                        for c in range(begin, end):
                            total += Jx[i, c] * k.Jx[c, half * n + j]
                        for c in range(n + begin, n + end):
                            total += Jx[i, c] * k.Jx[c, half * n + j]
                        product[i, j] = total
            for top in range(2):
                for i in range(top * n + begin, top * n + end):
                    for j in range(begin, end):
                        k.Jx[i, half * n + j] = product[i, j]
        for top in range(2):
            for i in range(top * n + begin, top * n + end):
                for j in range(begin, end):
                    total = Jf[i, j]
                    for c in range(begin, end):
                        total += Jx[i, c] * k.Jf[c, j]
                    for c in range(n + begin, n + end):
                        total += Jx[i, c] * k.Jf[c, j]
                    product[i, j] = total
        for top in range(2):
            for i in range(top * n + begin, top * n + end):
                for j in range(begin, end):
                    k.Jf[i, j] = product[i, j]
