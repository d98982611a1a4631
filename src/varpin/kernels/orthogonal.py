"""Triangular form of a stack of rows by Householder's transformations."""

import numpy as np

from varpin.kernels._compile import kernel
from varpin.kernels.tree import Floats


@kernel
def triangularize(a: Floats) -> None:
    """R of a = Q R in place of ``a`` (r, c), r >= c, the rows below it zero; signs of rows are as they come.

    The row that is largest in a column leads it: otherwise a large row that has nothing there would take the digits of
    small ones that have (Powell and Reid, "On applying Householder transformations to linear least squares problems",
    1969).
    """
    rows, columns = a.shape
    for k in range(columns):
        best = k
        for i in range(k + 1, rows):
            if abs(a[i, k]) > abs(a[best, k]):
                best = i
        largest = abs(a[best, k])
        if not largest > 0.0:
            continue
        total = 0.0
        for i in range(k, rows):
            part = a[i, k] / largest
            total += part * part
        if best != k:
            for j in range(columns):
                a[k, j], a[best, j] = a[best, j], a[k, j]
        norm = largest * np.sqrt(total)
        end = -norm if a[k, k] > 0.0 else norm
        # Scaled by its first entry the vector of the reflection is (1, w), of length^2 = 2 norm / (norm + |a_kk|).
        first = a[k, k] - end
        factor = (norm + abs(a[k, k])) / norm
        for i in range(k + 1, rows):
            a[i, k] /= first
        for j in range(k + 1, columns):
            along = a[k, j]
            for i in range(k + 1, rows):
                along += a[i, k] * a[i, j]
            along *= factor
            a[k, j] -= along
            for i in range(k + 1, rows):
                a[i, j] -= along * a[i, k]
        a[k, k] = end
        for i in range(k + 1, rows):
            a[i, k] = 0.0
