"""A quadratic function's minimum in a box, by a primal active set (Nocedal and Wright, Numerical Optimization, 16.5).

Control-limited differential dynamic programming (Tassa, Mansard and Todorov 2014) projects Newton steps onto the box
instead. They may end where no projection of the next one descends; far from well conditioned they do.
"""

from varpin.kernels._compile import inlined
from varpin.kernels.linalg import factor_ldl, solve_ldl
from varpin.kernels.tree import Floats

# Of the terms that cancel in an entry of the gradient, what counts for zero.
_ROUNDING = 1e-13


@inlined
def solve_box(H: Floats, g: Floats, box: Floats, x: Floats, F: Floats, work: Floats) -> bool:
    """The x (m,) in box[0] <= x <= box[1] that minimizes g.x + (1/2) x'Hx, from a first guess in ``x``.

    Leaves in work[0] ones for the entries that the box holds and zeros for the free ones, and in F the factors L D L'
    of H with the held rows and columns replaced by those of the identity. ``work`` is (3, m), H positive definite;
    False where it is not, or where the iteration does not end.
    """
    m = x.size
    held, downhill, step = work[0], work[1], work[2]
    for i in range(m):
        x[i] = min(max(x[i], box[0, i]), box[1, i])
        held[i] = 0.0
    for iteration in range(10 * m + 10):
        for i in range(m):
            total = g[i]
            for j in range(m):
                total += H[i, j] * x[j]
            downhill[i] = -total
            if iteration == 0 and ((x[i] <= box[0, i] and total >= 0.0) or (x[i] >= box[1, i] and total <= 0.0)):
                held[i] = 1.0
        for i in range(m):
            for j in range(m):
                F[i, j] = H[i, j] if held[i] == 0.0 and held[j] == 0.0 else 0.0
            if held[i] != 0.0:
                F[i, i] = 1.0
                downhill[i] = 0.0
        if not factor_ldl(F, 0, m):
            return False
        solve_ldl(F, downhill, step, 0, m)
        # As far as the free entries go before the first of them meets a side.
        length, first = 1.0, -1
        for i in range(m):
            side = box[0, i] if step[i] < 0.0 else box[1, i]
            if held[i] == 0.0 and abs(step[i]) * length > abs(side - x[i]):
                length, first = abs(side - x[i]) / abs(step[i]), i
        for i in range(m):
            if held[i] == 0.0:
                x[i] = min(max(x[i] + length * step[i], box[0, i]), box[1, i])
        if first >= 0:
            held[first] = 1.0
            x[first] = box[0, first] if step[first] < 0.0 else box[1, first]
            continue
        # The least with these held: free the one that would gain most, if any would.
        most = 0.0
        for i in range(m):
            if held[i] == 0.0 or box[0, i] == box[1, i]:
                continue
            total, size = g[i], abs(g[i])
            for j in range(m):
                term = H[i, j] * x[j]
                total += term
                size += abs(term)
            gain = (-total if x[i] <= box[0, i] else total) - _ROUNDING * size
            if gain > most:
                most, first = gain, i
        if first < 0:
            return True
        held[first] = 0.0
    return False
