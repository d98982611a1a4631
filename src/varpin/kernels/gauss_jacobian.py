"""The derivative of a step of Gauss collocation, by implicit differentiation of its equation at the root.

With N = -dr/dV from the jets of the stages

    dr_i/dq0 = h sum_j a_ij L_qq,j - A_i,    dr_i/dp0 = 1,    dr_i/df = h c_i

the root moves by dV = N^-1 dr, the stages by dQ_i = dq0 + h sum_j a_ij dV_j, and then

    dq1 = dq0 + h sum_i b_i dV_i,    dp1 = dp0 + h sum_i b_i (L_qq,i dQ_i + A_i' dV_i - D dV_i + df).
"""

from varpin.kernels._compile import inlined
from varpin.kernels.gauss_equation import Stages, factor_stages
from varpin.kernels.gauss_tableau import Tableau
from varpin.kernels.linalg import solve_lu_pivoting
from varpin.kernels.tree import Floats, Mechanism, block


@inlined
def stages_column(
    mechanism: Mechanism,
    tableau: Tableau,
    h: float,
    kind: int,
    c: int,
    begin: int,
    end: int,
    g: Stages,
    Jx: Floats,
    Jf: Floats,
) -> None:
    """The derivatives in entry ``c`` of q0, p0 or f (kind 0, 1 or 2) of what shares its block, ``begin`` to ``end``."""
    stages, n = g.V.shape
    a, b = tableau.a, tableau.b
    for i in range(stages):
        for r in range(begin, end):
            total = 0.0
            if kind == 0:
                for j in range(stages):
                    total += a[i, j] * g.Lqq[j, r, c]
                total = h * total - g.A[i, r, c]
            elif r == c:
                total = 1.0 if kind == 1 else h * tableau.c[i]
            g.residual[i * n + r] = total
    dV, dQ = g.delta, g.residual
    solve_lu_pivoting(g.lu, g.order, g.residual, dV, n, begin, end)
    for i in range(stages):
        for r in range(begin, end):
            total = 0.0
            for j in range(stages):
                total += a[i, j] * dV[j * n + r]
            dQ[i * n + r] = h * total
        if kind == 0:
            dQ[i * n + c] += 1.0
    for r in range(begin, end):
        dq, dp = 0.0, 0.0
        for i in range(stages):
            slope = -mechanism.damping[r] * dV[i * n + r]
            for m in range(begin, end):
                slope += g.Lqq[i, r, m] * dQ[i * n + m] + g.A[i, m, r] * dV[i * n + m]
            dq += b[i] * dV[i * n + r]
            dp += b[i] * slope
        dq, dp = h * dq, h * dp
        if r == c:
            dq += 1.0 if kind == 0 else 0.0
            dp += 1.0 if kind == 1 else 0.0
            dp += h if kind == 2 else 0.0
        if kind == 2:
            Jf[r, c], Jf[n + r, c] = dq, dp
        else:
            Jx[r, kind * n + c], Jx[n + r, kind * n + c] = dq, dp


@inlined
def stages_jacobian(mechanism: Mechanism, tableau: Tableau, h: float, g: Stages, Jx: Floats, Jf: Floats) -> None:
    """d(q1, p1)/d(q0, p0) (2n, 2n) and d(q1, p1)/df (2n, n) at the root in ``g.V`` and the jets of its stages."""
    cuts = mechanism.tree.cuts
    if cuts.size > 2:
        Jx[:] = 0.0
        Jf[:] = 0.0
    factor_stages(mechanism, tableau, h, g)
    for b in range(cuts.size - 1):
        begin, end = block(cuts, b)
        for kind in range(3):  # 0: of q0, 1: of p0, 2: of f
            for c in range(begin, end):
                stages_column(mechanism, tableau, h, kind, c, begin, end, g, Jx, Jf)
