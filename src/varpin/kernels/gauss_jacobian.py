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
from varpin.kernels.tree import Floats, Mechanism


@inlined
def stages_jacobian(mechanism: Mechanism, tableau: Tableau, h: float, g: Stages, Jx: Floats, Jf: Floats) -> None:
    """d(q1, p1)/d(q0, p0) (2n, 2n) and d(q1, p1)/df (2n, n) at the root in ``g.V`` and the jets of its stages."""
    stages, n = g.V.shape
    a, b = tableau.a, tableau.b
    factor_stages(mechanism, tableau, h, g)
    for column in range(3 * n):
        kind, c = column // n, column % n  # 0: of q0, 1: of p0, 2: of f
        for i in range(stages):
            for r in range(n):
                total = 0.0
                if kind == 0:
                    for j in range(stages):
                        total += a[i, j] * g.Lqq[j, r, c]
                    total = h * total - g.A[i, r, c]
                elif r == c:
                    total = 1.0 if kind == 1 else h * tableau.c[i]
                g.residual[i * n + r] = total
        dV, dQ = g.delta, g.residual
        solve_lu_pivoting(g.lu, g.order, g.residual, dV)
        for i in range(stages):
            for r in range(n):
                total = 0.0
                for j in range(stages):
                    total += a[i, j] * dV[j * n + r]
                dQ[i * n + r] = h * total
            if kind == 0:
                dQ[i * n + c] += 1.0
        for r in range(n):
            dq, dp = 0.0, 0.0
            for i in range(stages):
                slope = -mechanism.damping[r] * dV[i * n + r]
                for m in range(n):
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
                Jx[r, column], Jx[n + r, column] = dq, dp
