// M X = B + sum_k s_k W_k X_k for many columns at once: what derivatives of accelerations ask for, where those of
// earlier accelerations X_k enter, and their sums. docs/mathematics.md, "Explicit methods".
#pragma once

#include "varpin/simd.hpp"

namespace varpin {

// Rows (n, columns), padded with zeros to a multiple of four columns.
struct SlopeRows {
    static constexpr int padding = 4;
    static constexpr int most_others = 2;
    static int columns(int n) { return (3 * n + padding - 1) / padding * padding; }

    // A term of the right-hand side.
    struct Other {
        double scale;          // s
        const double* weight;  // W (n, n), rows `weight_stride` apart
        const double* x;       // X (n, columns)
    };

    int n = 0;
    const double* ldl = nullptr;  // L D L' of M, with rows at distance `ldl_stride`
    int ldl_stride = 0;
    int weight_stride = 0;
    Other other[most_others] = {};
    int others = 0;
};

// sum_k factor_k x_k of rows that are as long.
struct SlopeSum {
    static constexpr int most = 4;

    double factor[most] = {};
    const double* x[most] = {};
    int count = 0;
};

namespace detail {

// 4 * fours columns, whose sums stay in registers.
template <int fours>
[[gnu::always_inline]] inline void solve_some(const SlopeRows& rows, int columns, double* __restrict x, int first) {
    const int n = rows.n;
    double sum[fours][4];
    const auto subtract = [&](double factor, const double* row) {
        for (int f = 0; f < fours; ++f) {
            for (int c = 0; c < 4; ++c) sum[f][c] -= factor * row[4 * f + c];
        }
    };
    for (int i = 0; i < n; ++i) {
        double* own = x + i * columns + first;
        for (int f = 0; f < fours; ++f) {
            for (int c = 0; c < 4; ++c) sum[f][c] = own[4 * f + c];
        }
        for (int o = 0; o < rows.others; ++o) {
            const double scale = -rows.other[o].scale;
            const double* weight = rows.other[o].weight + i * rows.weight_stride;
            const double* other = rows.other[o].x + first;
            for (int k = 0; k < n; ++k, other += columns) subtract(scale * weight[k], other);
        }
        const double* factor = rows.ldl + i * rows.ldl_stride;
        for (int k = 0; k < i; ++k) subtract(factor[k], x + k * columns + first);
        for (int f = 0; f < fours; ++f) {
            for (int c = 0; c < 4; ++c) own[4 * f + c] = sum[f][c];
        }
    }
    for (int i = n - 1; i >= 0; --i) {
        double* own = x + i * columns + first;
        const double inverse = 1.0 / rows.ldl[i * rows.ldl_stride + i];
        for (int f = 0; f < fours; ++f) {
            for (int c = 0; c < 4; ++c) sum[f][c] = own[4 * f + c] * inverse;
        }
        for (int k = i + 1; k < n; ++k) subtract(rows.ldl[k * rows.ldl_stride + i], x + k * columns + first);
        for (int f = 0; f < fours; ++f) {
            for (int c = 0; c < 4; ++c) own[4 * f + c] = sum[f][c];
        }
    }
}

// 3 times four sums fill the registers with two numbers each, 6 times four those with four numbers each.
template <int most>
[[gnu::always_inline]] inline void solve_all(const SlopeRows& rows, double* x) {
    const int columns = SlopeRows::columns(rows.n);
    int c = 0;
    for (; c + 4 * most <= columns; c += 4 * most) solve_some<most>(rows, columns, x, c);
    if constexpr (most > 3) {
        for (; c + 12 <= columns; c += 12) solve_some<3>(rows, columns, x, c);
    }
    for (; c + 8 <= columns; c += 8) solve_some<2>(rows, columns, x, c);
    if (c < columns) solve_some<1>(rows, columns, x, c);
}

// Of rows from `first` on, of a multiple of four columns.
[[gnu::always_inline]] inline void add_fours(const SlopeSum& of, int first, int columns, double* __restrict sum) {
    for (int c = 0; c < columns; c += 4) {
        double total[4] = {};
        for (int k = 0; k < of.count; ++k) {
            for (int f = 0; f < 4; ++f) total[f] += of.factor[k] * of.x[k][first + c + f];
        }
        for (int f = 0; f < 4; ++f) sum[c + f] = total[f];
    }
}

#if defined(__x86_64__) && defined(__GNUC__)
#if !defined(__clang__)
[[gnu::optimize("no-tree-loop-vectorize")]]
#endif
[[gnu::target("avx2")]] inline void add_wide_fours(const SlopeSum& of, int first, int columns, double* sum) {
    add_fours(of, first, columns, sum);
}

// GCC would make four sums at once of one row by four others instead, with twice the instructions.
#if !defined(__clang__)
[[gnu::optimize("no-tree-loop-vectorize")]]
#endif
[[gnu::target("avx2")]] inline void solve_wide(const SlopeRows& rows, double* x) {
    solve_all<6>(rows, x);
}
#endif

}  // namespace detail

// Overwrites B (n, columns) by X.
#if defined(__GNUC__) && !defined(__clang__)
[[gnu::optimize("no-tree-loop-vectorize")]]
#endif
inline void solve_slope_rows(const SlopeRows& rows, double* x) {
#if defined(__x86_64__) && defined(__GNUC__)
    if (has_avx2()) return detail::solve_wide(rows, x);
#endif
    detail::solve_all<3>(rows, x);
}

// The sum of rows from `first` on, of a multiple of four columns.
#if defined(__GNUC__) && !defined(__clang__)
[[gnu::optimize("no-tree-loop-vectorize")]]
#endif
inline void add_slopes(const SlopeSum& of, int first, int columns, double* sum) {
#if defined(__x86_64__) && defined(__GNUC__)
    if (has_avx2()) return detail::add_wide_fours(of, first, columns, sum);
#endif
    detail::add_fours(of, first, columns, sum);
}

}  // namespace varpin
