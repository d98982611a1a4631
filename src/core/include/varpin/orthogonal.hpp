// Triangular form of a stack of rows by Householder transformations, which preserve sums of squares: a = Q R,
// a'a = R'R. docs/mathematics.md, "Digits".
#pragma once

#include <algorithm>
#include <cmath>

namespace varpin {

// Overwrites a (rows, columns) so that its first `leading` columns are triangular, leading <= min(rows, columns). The
// signs of rows are arbitrary. `work` is (columns).
//
// The row with the largest entry in a column is the pivot row. Otherwise a large row with a zero there would destroy
// digits of small rows (Powell and Reid, "On applying Householder transformations to linear least squares problems",
// 1969).
inline void triangularize(double* a, int rows, int columns, int leading, double* __restrict work) {
    for (int k = 0; k < leading; ++k) {
        int best = k;
        for (int i = k + 1; i < rows; ++i) {
            if (std::abs(a[i * columns + k]) > std::abs(a[best * columns + k])) best = i;
        }
        const double largest = std::abs(a[best * columns + k]);
        if (!(largest > 0.0)) continue;
        double total = 0.0;
        for (int i = k; i < rows; ++i) {
            const double part = a[i * columns + k] / largest;
            total += part * part;
        }
        double* __restrict top = a + k * columns;
        if (best != k) std::swap_ranges(top, top + columns, a + best * columns);
        const double norm = largest * std::sqrt(total);
        const double end = top[k] > 0.0 ? -norm : norm;
        // The vector of the reflection, scaled by its first entry, is (1, w) with length^2 = 2 norm / (norm + |a_kk|).
        const double first = top[k] - end, factor = (norm + std::abs(top[k])) / norm;
        for (int j = k + 1; j < columns; ++j) work[j] = top[j];
        for (int i = k + 1; i < rows; ++i) {
            double* __restrict row = a + i * columns;
            row[k] /= first;
            const double entry = row[k];
            if (entry == 0.0) continue;
            for (int j = k + 1; j < columns; ++j) work[j] += entry * row[j];
        }
        for (int j = k + 1; j < columns; ++j) {
            work[j] *= factor;
            top[j] -= work[j];
        }
        for (int i = k + 1; i < rows; ++i) {
            double* __restrict row = a + i * columns;
            const double entry = row[k];
            row[k] = 0.0;
            if (entry == 0.0) continue;
            for (int j = k + 1; j < columns; ++j) row[j] -= entry * work[j];
        }
        top[k] = end;
    }
}

}  // namespace varpin
