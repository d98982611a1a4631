"""Small dense factorisations, written out: at the size of an arm a LAPACK call costs more than its work.

Where they take ``begin`` and ``end``, they are for the rows and columns from the one up to the other: one block of a
matrix that vanishes outside its blocks.
"""

import numpy as np

from varpin.kernels._compile import inlined
from varpin.kernels.tree import Ends, Floats, Integers, block


@inlined
def factor_lu(a: Floats, begin: int, end: int) -> bool:
    """LU of a block of ``a`` (n, n) in place, without pivoting; False at a pivot that is not positive.

    For a matrix whose symmetric part is positive definite every pivot is positive and none grows without bound.
    """
    for k in range(begin, end):
        pivot = a[k, k]
        if not pivot > 0.0:
            return False
        inverse = 1.0 / pivot
        for i in range(k + 1, end):
            factor = a[i, k] * inverse
            a[i, k] = factor
            for j in range(k + 1, end):
                a[i, j] -= factor * a[k, j]
    return True


@inlined
def solve_lu(lu: Floats, b: Floats, x: Floats, begin: int, end: int) -> None:
    """The x with L U x = b."""
    for i in range(begin, end):
        total = b[i]
        for j in range(begin, i):
            total -= lu[i, j] * x[j]
        x[i] = total
    for i in range(end - 1, begin - 1, -1):
        total = x[i]
        for j in range(i + 1, end):
            total -= lu[i, j] * x[j]
        x[i] = total / lu[i, i]


@inlined
def solve_lu_twice(lu: Floats, b: Floats, x: Floats, c: Floats, y: Floats, begin: int, end: int) -> None:
    """The x with L U x = b and the y with L U y = c: neither alone fills a processor's pipeline."""
    for i in range(begin, end):
        first, second = b[i], c[i]
        for j in range(begin, i):
            first -= lu[i, j] * x[j]
            second -= lu[i, j] * y[j]
        x[i], y[i] = first, second
    for i in range(end - 1, begin - 1, -1):
        first, second = x[i], y[i]
        for j in range(i + 1, end):
            first -= lu[i, j] * x[j]
            second -= lu[i, j] * y[j]
        x[i], y[i] = first / lu[i, i], second / lu[i, i]


@inlined
def factor_lu_pivoting(a: Floats, order: Integers) -> int:
    """LU of the rows ``order`` of ``a`` (n, n) in place; the sign of the determinant, 0 where it is not finite."""
    n = a.shape[0]
    sign = 1
    for i in range(n):
        order[i] = i
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(a[i, k]) > abs(a[best, k]):
                best = i
        if best != k:
            sign = -sign
            order[k], order[best] = order[best], order[k]
            for j in range(n):
                a[k, j], a[best, j] = a[best, j], a[k, j]
        pivot = a[k, k]
        if not abs(pivot) > 0.0 or not abs(pivot) < np.inf:
            return 0
        if pivot < 0.0:
            sign = -sign
        inverse = 1.0 / pivot
        # Slices, unlike indices from k + 1 on, let the compiler use vector instructions.
        top = a[k, k + 1 :]
        for i in range(k + 1, n):
            factor = a[i, k] * inverse
            a[i, k] = factor
            row = a[i, k + 1 :]
            for j in range(row.size):
                row[j] -= factor * top[j]
    return sign


@inlined
def solve_lu_pivoting(lu: Floats, order: Integers, b: Floats, x: Floats) -> None:
    """The x with a x = b for the ``a`` that :func:`factor_lu_pivoting` has factored."""
    n = lu.shape[0]
    for i in range(n):
        total = b[order[i]]
        for j in range(i):
            total -= lu[i, j] * x[j]
        x[i] = total
    for i in range(n - 1, -1, -1):
        total = x[i]
        for j in range(i + 1, n):
            total -= lu[i, j] * x[j]
        x[i] = total / lu[i, i]


@inlined
def factor_ldl(a: Floats, begin: int, end: int) -> bool:
    """L D L' of a block of the symmetric ``a`` (n, n) in place: pivots on the diagonal, unit L below it.

    Reads the lower triangle; False at a pivot that is not positive.
    """
    for k in range(begin, end):
        pivot = a[k, k]
        if not pivot > 0.0:
            return False
        inverse = 1.0 / pivot
        for i in range(k + 1, end):
            factor = a[i, k] * inverse
            for j in range(k + 1, i + 1):
                a[i, j] -= factor * a[j, k]
        for i in range(k + 1, end):
            a[i, k] *= inverse
    return True


@inlined
def least_pivot_ratio(a: Floats, b: Floats, begin: int, end: int) -> float:
    """The smallest ratio of a pivot of the symmetric ``a`` (n, n) to the same pivot of ``b``; 0 if one is not positive.

    Of a block of both. Reads and overwrites the lower triangles. Both are factored at once, as neither fills a
    processor's pipeline.
    """
    least = np.inf
    for k in range(begin, end):
        if not (a[k, k] > 0.0 and b[k, k] > 0.0):
            return 0.0
        least = min(least, a[k, k] / b[k, k])
        inverse_a, inverse_b = 1.0 / a[k, k], 1.0 / b[k, k]
        for i in range(k + 1, end):
            factor_a, factor_b = a[i, k] * inverse_a, b[i, k] * inverse_b
            for j in range(k + 1, i + 1):
                a[i, j] -= factor_a * a[j, k]
                b[i, j] -= factor_b * b[j, k]
    return least


@inlined
def solve_lower(ldl: Floats, b: Floats, x: Floats, begin: int, end: int) -> None:
    """The x with L x = b."""
    for i in range(begin, end):
        total = b[i]
        for j in range(begin, i):
            total -= ldl[i, j] * x[j]
        x[i] = total


@inlined
def solve_upper(ldl: Floats, x: Floats, begin: int, end: int) -> None:
    """The solution of L' y = x, in place of x."""
    for i in range(end - 1, begin - 1, -1):
        total = x[i]
        for j in range(i + 1, end):
            total -= ldl[j, i] * x[j]
        x[i] = total


@inlined
def solve_ldl(ldl: Floats, b: Floats, x: Floats, begin: int, end: int) -> None:
    """The x with L D L' x = b."""
    solve_lower(ldl, b, x, begin, end)
    for i in range(begin, end):
        x[i] /= ldl[i, i]
    solve_upper(ldl, x, begin, end)


@inlined
def solve_ldl_rows(ldl: Floats, b: Floats) -> None:
    """The X with L D L' X = b (n, k), in place, whole rows at a time."""
    n, k = b.shape
    for i in range(n):
        for j in range(i):
            factor = ldl[i, j]
            for c in range(k):
                b[i, c] -= factor * b[j, c]
    for i in range(n - 1, -1, -1):
        inverse = 1.0 / ldl[i, i]
        for c in range(k):
            b[i, c] *= inverse
        for j in range(i + 1, n):
            factor = ldl[j, i]
            for c in range(k):
                b[i, c] -= factor * b[j, c]


@inlined
def quadratic_form(a: Floats, x: Floats, ends: Ends) -> float:
    """X' a x, with the blocks of ``a`` that have these ends."""
    total = 0.0
    for b in range(len(ends)):
        begin, end = block(ends, b)
        for i in range(begin, end):
            row = 0.0
            for j in range(begin, end):
                row += a[i, j] * x[j]
            total += x[i] * row
    return total
