// Small dense factorizations: at the size of an arm, the overhead of a LAPACK call exceeds its work. Matrices are
// square with rows of length n; a function works on the rows and columns [begin, end) of one block. Inner loops run
// along rows. docs/mathematics.md, "Solving a step".
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "varpin/simd.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// The larger of two numbers, and NaN if one of them is.
inline double larger(double a, double b) { return a > b || a != a ? a : b; }

namespace detail {

// y -= s x over columns [first, last) of two rows, two at a time: for short rows, the setup of the compiler's vector
// loop takes longer than the loop. Pairs always begin at even columns: a load of a pair stalls if one of its halves has
// just been stored alone.
[[gnu::always_inline]] inline void subtract_scaled(double* y, double s, const double* x, int first, int last) {
    const Pair factor{s, s};
    int c = first;
    if (c % 2 != 0 && c < last) {
        y[c] -= s * x[c];
        ++c;
    }
    for (; c + 1 < last; c += 2) put_pair(pair_at(y + c) - factor * pair_at(x + c), y + c);
    if (c < last) y[c] -= s * x[c];
}

// Column k of L U below the diagonal, and what is left of the rows below row k.
[[gnu::always_inline]] inline void eliminate_column(double* a, int n, int k, int end) {
    const double* top = a + k * n;
    const double inverse = 1.0 / top[k];
    for (int i = k + 1; i < end; ++i) {
        double* row = a + i * n;
        const double factor = row[k] * inverse;
        row[k] = factor;
        subtract_scaled(row, factor, top, k + 1, end);
    }
}

}  // namespace detail

// LU in place without pivoting; false at a pivot that is not positive. For a matrix whose symmetric part is positive
// definite every pivot is positive and none grows without bound.
inline bool factor_lu(double* a, int n, Block block) {
    for (int k = block.begin; k < block.end; ++k) {
        if (!(a[k * n + k] > 0.0)) return false;
        detail::eliminate_column(a, n, k, block.end);
    }
    return true;
}

// The x with L x = b for the unit L below the diagonal; x may be b.
inline void solve_lower(const double* factors, int n, Block block, const double* b, double* x) {
    for (int i = block.begin; i < block.end; ++i) {
        double total = b[i];
        for (int j = block.begin; j < i; ++j) total -= factors[i * n + j] * x[j];
        x[i] = total;
    }
}

// The x with L U x = b; x may be b.
inline void solve_lu(const double* lu, int n, Block block, const double* b, double* x) {
    solve_lower(lu, n, block, b, x);
    for (int i = block.end - 1; i >= block.begin; --i) {
        double total = x[i];
        for (int j = i + 1; j < block.end; ++j) total -= lu[i * n + j] * x[j];
        x[i] = total / lu[i * n + i];
    }
}

// LU with row pivoting; `order` (n) receives the permutation of rows. Returns the sign of the determinant, 0 at a pivot
// that is zero or not finite.
inline int factor_lu_pivoting(double* a, int n, int* order) {
    int sign = 1;
    for (int i = 0; i < n; ++i) order[i] = i;
    for (int k = 0; k < n; ++k) {
        int best = k;
        for (int i = k + 1; i < n; ++i) {
            if (std::abs(a[i * n + k]) > std::abs(a[best * n + k])) best = i;
        }
        if (best != k) {
            sign = -sign;
            std::swap(order[k], order[best]);
            for (int j = 0; j < n; ++j) std::swap(a[k * n + j], a[best * n + j]);
        }
        const double pivot = a[k * n + k];
        if (!(std::abs(pivot) > 0.0) || !(std::abs(pivot) < std::numeric_limits<double>::infinity())) return 0;
        if (pivot < 0.0) sign = -sign;
        detail::eliminate_column(a, n, k, n);
    }
    return sign;
}

// The x with a x = b, from the factors of factor_lu_pivoting.
inline void solve_lu_pivoting(const double* lu, int n, const int* order, const double* b, double* x) {
    for (int i = 0; i < n; ++i) x[i] = b[order[i]];
    solve_lu(lu, n, {0, n}, x, x);
}

// The x with a' x = b from the factors of a; `order` is null for factors without pivoting. Overwrites b.
inline void solve_lu_transposed(const double* lu, int n, const int* order, double* b, double* x) {
    // a = P' L U, so U' y = b, L' z = y, x = P' z.
    for (int i = 0; i < n; ++i) {
        b[i] /= lu[i * n + i];
        for (int j = i + 1; j < n; ++j) b[j] -= lu[i * n + j] * b[i];
    }
    for (int i = n - 1; i >= 0; --i) {
        for (int j = 0; j < i; ++j) b[j] -= lu[i * n + j] * b[i];
    }
    for (int i = 0; i < n; ++i) x[order ? order[i] : i] = b[i];
}

// L D L' of a symmetric matrix in place: pivots on the diagonal, unit L below it; the upper triangle is not defined.
// Reads the lower triangle; false at a pivot that is not positive.
inline bool factor_ldl(double* a, int n, Block block) {
    for (int k = block.begin; k < block.end; ++k) {
        double* top = a + k * n;
        if (!(top[k] > 0.0)) return false;
        const double inverse = 1.0 / top[k];
        // A copy of the column as a row, for the inner loop.
        for (int i = k + 1; i < block.end; ++i) {
            double* row = a + i * n;
            top[i] = row[k];
            row[k] *= inverse;
            detail::subtract_scaled(row, row[k], top, k + 1, i + 1);
        }
    }
    return true;
}

// The smallest ratio of a pivot of the symmetric a to the same pivot of b, with elimination from the last to the first;
// 0 if one is not positive. Reads and overwrites the lower triangles. Both are factored together, since neither fills
// the processor's pipeline.
inline double least_pivot_ratio(double* a, double* b, int n, Block block) {
    double least = std::numeric_limits<double>::infinity();
    for (int k = block.end - 1; k >= block.begin; --k) {
        const double* last_a = a + k * n;
        const double* last_b = b + k * n;
        const double pivot_a = last_a[k], pivot_b = last_b[k];
        if (!(pivot_a > 0.0 && pivot_b > 0.0)) return 0.0;
        least = std::min(least, pivot_a / pivot_b);
        const double inverse_a = 1.0 / pivot_a, inverse_b = 1.0 / pivot_b;
        for (int i = block.begin; i < k; ++i) {
            const double factor_a = last_a[i] * inverse_a, factor_b = last_b[i] * inverse_b;
            detail::subtract_scaled(a + i * n, factor_a, last_a, block.begin, i + 1);
            detail::subtract_scaled(b + i * n, factor_b, last_b, block.begin, i + 1);
        }
    }
    return least;
}

// Overwrites b, given in x, by the x with L' x = b.
inline void solve_upper(const double* ldl, int n, Block block, double* x) {
    for (int i = block.end - 1; i >= block.begin; --i) {
        double total = x[i];
        for (int j = i + 1; j < block.end; ++j) total -= ldl[j * n + i] * x[j];
        x[i] = total;
    }
}

// The x with L D L' x = b; x may be b.
inline void solve_ldl(const double* ldl, int n, Block block, const double* b, double* x) {
    solve_lower(ldl, n, block, b, x);
    for (int i = block.begin; i < block.end; ++i) x[i] /= ldl[i * n + i];
    solve_upper(ldl, n, block, x);
}

namespace detail {

// 2 * pairs columns of row -= sum_k factor(k) other(k), whose sums stay in registers.
template <int pairs, class Factor, class Row>
[[gnu::always_inline]] inline void subtract_pairs(double* row, int column, int begin, int end, const Factor& factor,
                                                  const Row& other) {
    Pair sum[pairs];
    for (int c = 0; c < pairs; ++c) sum[c] = pair_at(row + column + 2 * c);
    for (int k = begin; k < end; ++k) {
        const double f = factor(k);
        const Pair both{f, f};
        const double* x = other(k) + column;
        for (int c = 0; c < pairs; ++c) sum[c] = sum[c] - both * pair_at(x + 2 * c);
    }
    for (int c = 0; c < pairs; ++c) put_pair(sum[c], row + column + 2 * c);
}

}  // namespace detail

// row -= sum_k factor(k) other(k) over k in [begin, end).
template <class Factor, class Row>
void subtract_rows(double* row, int columns, int begin, int end, const Factor& factor, const Row& other) {
    if (begin == end) return;
    int c = 0;
    for (; c + 11 < columns; c += 12) detail::subtract_pairs<6>(row, c, begin, end, factor, other);
    for (; c + 7 < columns; c += 8) detail::subtract_pairs<4>(row, c, begin, end, factor, other);
    if (c + 5 < columns) {
        detail::subtract_pairs<3>(row, c, begin, end, factor, other);
        c += 6;
    } else if (c + 3 < columns) {
        detail::subtract_pairs<2>(row, c, begin, end, factor, other);
        c += 4;
    } else if (c + 1 < columns) {
        detail::subtract_pairs<1>(row, c, begin, end, factor, other);
        c += 2;
    }
    if (c == columns) return;
    double sum = row[c];
    for (int k = begin; k < end; ++k) sum -= factor(k) * other(k)[c];
    row[c] = sum;
}

namespace detail {

// out (rows, columns) = a (rows, depth) b (depth, columns).
inline void multiply(const double* a, const double* b, int rows, int depth, int columns, double* out) {
    std::fill_n(out, rows * columns, 0.0);
    for (int i = 0; i < rows; ++i) {
        subtract_rows(
            out + i * columns, columns, 0, depth, [&](int k) { return -a[i * depth + k]; },
            [&](int k) { return b + k * columns; });
    }
}

// Of a (n, n), in place.
inline void transpose(double* a, int n) {
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j < i; ++j) std::swap(a[i * n + j], a[j * n + i]);
    }
}

}  // namespace detail

// Overwrites B (size of the block, columns) by the X with L U X = B. Row i of the block is at x + (i - begin) * stride.
inline void solve_lu_rows(const double* lu, int n, Block block, double* x, int columns, int stride) {
    const auto row = [&](int i) { return x + (i - block.begin) * stride; };
    const auto of_row = [&](int i) { return [=](int j) { return lu[i * n + j]; }; };
    for (int i = block.begin; i < block.end; ++i) subtract_rows(row(i), columns, block.begin, i, of_row(i), row);
    for (int i = block.end - 1; i >= block.begin; --i) {
        double* solved_row = row(i);
        subtract_rows(solved_row, columns, i + 1, block.end, of_row(i), row);
        const double inverse = 1.0 / lu[i * n + i];
        for (int c = 0; c < columns; ++c) solved_row[c] *= inverse;
    }
}

// Overwrites B (size of the block, columns) by the X with L D L' X = B. Row i of the block is at
// x + (i - begin) * stride.
inline void solve_ldl_rows(const double* ldl, int n, Block block, double* x, int columns, int stride) {
    const auto row = [&](int i) { return x + (i - block.begin) * stride; };
    for (int i = block.begin; i < block.end; ++i) {
        subtract_rows(row(i), columns, block.begin, i, [&](int j) { return ldl[i * n + j]; }, row);
    }
    for (int i = block.end - 1; i >= block.begin; --i) {
        double* __restrict solved_row = row(i);
        const double inverse = 1.0 / ldl[i * n + i];
        for (int c = 0; c < columns; ++c) solved_row[c] *= inverse;
        subtract_rows(solved_row, columns, i + 1, block.end, [&](int j) { return ldl[j * n + i]; }, row);
    }
}

// The same over a whole matrix, for X (n, columns).
inline void solve_ldl_rows(const double* ldl, int n, double* x, int columns) {
    solve_ldl_rows(ldl, n, {0, n}, x, columns, columns);
}

// Overwrites a (rows, columns) so that its first `leading` columns are triangular, leading <= min(rows, columns). The
// signs of rows are arbitrary.
//
// The row with the largest entry in a column is the pivot row. Otherwise a large row with a zero there would destroy
// digits of small rows (Powell and Reid, "On applying Householder transformations to linear least squares problems",
// 1969).
inline void triangularize(double* a, int rows, int columns, int leading) {
    std::vector<double> reflected(columns);
    double* __restrict work = reflected.data();
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

// x' a x over one block.
inline double quadratic_form(const double* a, int n, Block block, const double* x) {
    double total = 0.0;
    for (int i = block.begin; i < block.end; ++i) {
        double row = 0.0;
        for (int j = block.begin; j < block.end; ++j) row += a[i * n + j] * x[j];
        total += x[i] * row;
    }
    return total;
}

}  // namespace varpin
