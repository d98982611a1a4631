// Vectors and matrices of elimination (elimination.hpp), by pairs of numbers. Sizes are even. docs/mathematics.md,
// "Linear in the number of joints".
#pragma once

#include "varpin/simd.hpp"
#include "varpin/spatial.hpp"

namespace varpin::detail {

// Numbers that are read in pairs are also written in pairs: a load of a pair stalls after stores of single numbers.
template <class Six>
void write(const Six& a, double* x) {
    put_pair(Pair{a.linear.x, a.linear.y}, x);
    put_pair(Pair{a.linear.z, a.angular.x}, x + 2);
    put_pair(Pair{a.angular.y, a.angular.z}, x + 4);
}
// Writes nine entries and a zero.
template <class Six>
void write(const Six& a, const Vec3<double>& b, double* x) {
    write(a, x);
    put_pair(Pair{b.x, b.y}, x + 6);
    put_pair(Pair{b.z, 0.0}, x + 8);
}
inline Motion<double> motion_at(const double* x) { return {{x[0], x[1], x[2]}, {x[3], x[4], x[5]}}; }

template <int size>
struct Pairs {
    explicit Pairs(const double* x) {
        for (int c = 0; c < size; c += 2) at[c / 2] = pair_at(x + c);
    }
    Pair at[size / 2];
};

template <int size>
double product(const double* a, const double* b) {
    Pair sum = pair_at(a) * pair_at(b);
    for (int c = 2; c < size; c += 2) sum = sum + pair_at(a + c) * pair_at(b + c);
    return sum[0] + sum[1];
}

// y = a + s b
template <int size>
void write_sum(const double* a, double s, const double* b, double* y) {
    const Pair factor{s, s};
    for (int c = 0; c < size; c += 2) put_pair(pair_at(a + c) + factor * pair_at(b + c), y + c);
}

// y += X x
template <int size>
void add_product(const double* X, const double* x, double* y) {
    const Pairs<size> factor(x);
    for (int r = 0; r < size; r += 2, X += 2 * size) {
        Pair first = pair_at(X) * factor.at[0], second = pair_at(X + size) * factor.at[0];
        for (int c = 2; c < size; c += 2) {
            first = first + pair_at(X + c) * factor.at[c / 2];
            second = second + pair_at(X + size + c) * factor.at[c / 2];
        }
        put_pair(pair_at(y + r) + (Pair{first[0], second[0]} + Pair{first[1], second[1]}), y + r);
    }
}

// y += X' x
template <int size>
void add_transposed_product(const double* X, const double* x, double* y) {
    Pairs<size> sum(y);
    for (int r = 0; r < size; ++r, X += size) {
        const Pair factor{x[r], x[r]};
        for (int c = 0; c < size; c += 2) sum.at[c / 2] = sum.at[c / 2] + factor * pair_at(X + c);
    }
    for (int c = 0; c < size; c += 2) put_pair(sum.at[c / 2], y + c);
}

// y += X x with a symmetric X, of which each row holds at least the pairs from the diagonal on.
template <int size>
void add_symmetric_product(const double* X, const double* x, double* y) {
    const Pairs<size> factor(x);
    Pairs<size> sum(y);
    for (int r = 0; r < size; r += 2) {
        const double *above = X + r * size, *below = above + size;
        const Pair first{x[r], x[r]}, second{x[r + 1], x[r + 1]};
        Pair along = first * pair_at(above + r), beside = second * pair_at(below + r);
        sum.at[r / 2] = sum.at[r / 2] + (along + beside);
        if (r + 2 == size) break;
        along = beside = Pair{0.0, 0.0};
        for (int c = r + 2; c < size; c += 2) {
            const Pair upper = pair_at(above + c), lower = pair_at(below + c);
            sum.at[c / 2] = sum.at[c / 2] + (first * upper + second * lower);
            along = along + upper * factor.at[c / 2];
            beside = beside + lower * factor.at[c / 2];
        }
        sum.at[r / 2] = sum.at[r / 2] + (Pair{along[0], beside[0]} + Pair{along[1], beside[1]});
    }
    for (int c = 0; c < size; c += 2) put_pair(sum.at[c / 2], y + c);
}

// What a body adds to the matrix that it passes on, (E3): its inertia I, or in one of twelve entries (I, cI; cI, -kI).
template <int size>
struct OwnInertia {
    explicit OwnInertia(const Inertia<double>& I, double c = 0.0, double k = 0.0)
        : c(c),
          k(k),
          at{{{I.mass, 0.0}, {0.0, 0.0}, {I.moment.z, -I.moment.y}},
             {{0.0, I.mass}, {0.0, -I.moment.z}, {0.0, I.moment.x}},
             {{0.0, 0.0}, {I.mass, I.moment.y}, {-I.moment.x, 0.0}},
             {{0.0, -I.moment.z}, {I.moment.y, I.second.xx}, {I.second.xy, I.second.xz}},
             {{I.moment.z, 0.0}, {-I.moment.x, I.second.xy}, {I.second.yy, I.second.yz}},
             {{-I.moment.y, I.moment.x}, {0.0, I.second.xz}, {I.second.yz, I.second.zz}}} {}

    double c, k;
    Pair at[6][3];

    // The sum of entries e and e + 1 of row r, and others.
    Pair plus(Pair rest, int r, int e) const {
        if (size < 12) return r < 6 && e < 6 ? rest + at[r][e / 2] : rest;
        const double factor = r < 6 && e < 6 ? 1.0 : r >= 6 && e >= 6 ? -k : c;
        return rest + Pair{factor, factor} * at[r % 6][e % 6 / 2];
    }
};

// The pairs that a matrix holds: all, or those from the diagonal on if it is symmetric.
enum class Kept { all, upper };

// X - u l' + own, in one pass, since the next body needs it.
template <Kept kept, int size, int r = 0>
void replace(const double* u, const Pairs<size>& l, const OwnInertia<size>& own, double* X) {
    if constexpr (r < size) {
        const Pair factor{u[r], u[r]};
        for (int c = kept == Kept::upper ? r & ~1 : 0; c < size; c += 2)
            put_pair(own.plus(pair_at(X + c) - factor * l.at[c / 2], r, c), X + c);
        replace<kept, size, r + 1>(u, l, own, X + size);
    }
}

// Joints above an origin are prismatic: they need only linear parts, which are independent of the reference point. Set
// the other entries of a vector to zero, or those of a matrix.
template <int size, int part>
void keep_linear(double* z) {
    for (int r = 0; r < size; ++r) {
        if (r % part >= 3) z[r] = 0.0;
    }
}
template <int size, int part>
void keep_linear_rows(double* X) {
    for (int r = 0; r < size; ++r) {
        keep_linear<size, part>(X + r * size);
        for (int c = 0; c < size && r % part >= 3; ++c) X[r * size + c] = 0.0;
    }
}

}  // namespace varpin::detail
