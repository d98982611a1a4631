"""A quadratic function's minimum in a box, by projected Newton steps (Bertsekas 1982; Tassa, Mansard, Todorov 2014)."""

from varpin.kernels._compile import inlined
from varpin.kernels.linalg import factor_ldl, solve_ldl
from varpin.kernels.tree import Floats

# Of the terms that cancel in an entry of the gradient, what counts for zero.
_ROUNDING = 1e-13
_ARMIJO = 0.1
_TRIALS, _ITERATIONS = 30, 100


@inlined
def solve_box(H: Floats, g: Floats, box: Floats, x: Floats, F: Floats, work: Floats) -> bool:
    """The x (m,) in box[0] <= x <= box[1] that minimizes g.x + (1/2) x'Hx, from a first guess in ``x``.

    Leaves in work[0] ones for the entries that the box holds and zeros for the free ones, and in F the factors L D L'
    of H with the held rows and columns replaced by those of the identity. ``work`` is (4, m), H positive definite;
    False where it is not, or where the iteration does not end.
    """
    m = x.size
    held, gradient, aim, moved = work[0], work[1], work[2], work[3]
    for i in range(m):
        x[i] = min(max(x[i], box[0, i]), box[1, i])
        held[i] = 0.0
    newton = False
    for _ in range(_ITERATIONS):
        settled, same = True, True
        for i in range(m):
            total, size = g[i], abs(g[i])
            for j in range(m):
                term = H[i, j] * x[j]
                total += term
                size += abs(term)
            gradient[i] = total
            before = held[i]
            held[i] = 0.0
            if (x[i] <= box[0, i] and total >= 0.0) or (x[i] >= box[1, i] and total <= 0.0):
                held[i] = 1.0
            elif not abs(total) <= _ROUNDING * size:
                settled = False
            same = same and held[i] == before
        for i in range(m):
            for j in range(m):
                F[i, j] = H[i, j] if held[i] == 0.0 and held[j] == 0.0 else 0.0
            if held[i] != 0.0:
                F[i, i] = 1.0
            moved[i] = 0.0 if held[i] != 0.0 else -gradient[i]
        if not factor_ldl(F):
            return False
        # After a whole Newton step among the same free entries nothing is left but rounding.
        if settled or (newton and same):
            return True
        solve_ldl(F, moved, aim)
        # Backtracking along the projection of the step: the decrease is quadratic in what is left of it.
        length = 1.0
        for trial in range(_TRIALS):
            slope = 0.0
            change = 0.0
            for i in range(m):
                moved[i] = min(max(x[i] + length * aim[i], box[0, i]), box[1, i]) - x[i]
                slope += gradient[i] * moved[i]
            for i in range(m):
                for j in range(m):
                    change += 0.5 * moved[i] * H[i, j] * moved[j]
            if slope + change <= _ARMIJO * slope:
                break
            if trial == _TRIALS - 1:  # no more decrease than rounding has
                return True
            length *= 0.5
        newton = length == 1.0
        for i in range(m):
            # To the limit itself where the step ends there, not beside it by rounding.
            aim[i] = x[i] + length * aim[i]
            x[i] = min(max(aim[i], box[0, i]), box[1, i])
            newton = newton and x[i] == aim[i]
    return False
