// Vectors and matrices of elimination (elimination.hpp), of a size that the compiler knows or does not: the same sums,
// by pairs of numbers where it does. Sizes are even; sums add even and odd terms apart. docs/mathematics.md, "Linear in
// the number of joints".
#pragma once

#include <algorithm>

#include "varpin/simd.hpp"
#include "varpin/size.hpp"
#include "varpin/spatial.hpp"

namespace varpin::detail {

inline constexpr int even(int size) { return size + size % 2; }

// Numbers that are read in pairs are also written in pairs: a load of a pair stalls after stores of single numbers.
template <class Six>
void write(const Six& a, double* x) {
    put_pair(Pair{a.linear.x, a.linear.y}, x);
    put_pair(Pair{a.linear.z, a.angular.x}, x + 2);
    put_pair(Pair{a.angular.y, a.angular.z}, x + 4);
}
// Writes nine entries.
template <class Six>
void write(const Six& a, const Vec3<double>& b, double* x) {
    write(a, x);
    put_pair(Pair{b.x, b.y}, x + 6);
    x[8] = b.z;
}
// Writes nine entries and a zero.
template <class Six>
void write_padded(const Six& a, const Vec3<double>& b, double* x) {
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
double product(Known<size>, const double* a, const double* b) {
    Pair sum = pair_at(a) * pair_at(b);
    for (int c = 2; c < size; c += 2) sum = sum + pair_at(a + c) * pair_at(b + c);
    return sum[0] + sum[1];
}
inline double product(int size, const double* a, const double* b) {
    double even = 0.0, odd = 0.0;
    for (int c = 0; c < size; c += 2) {
        even += a[c] * b[c];
        odd += a[c + 1] * b[c + 1];
    }
    return even + odd;
}

// y = a + s b
template <int size>
void write_sum(Known<size>, const double* a, double s, const double* b, double* y) {
    const Pair factor{s, s};
    for (int c = 0; c < size; c += 2) put_pair(pair_at(a + c) + factor * pair_at(b + c), y + c);
}
inline void write_sum(int size, const double* a, double s, const double* b, double* y) {
    for (int c = 0; c < size; ++c) y[c] = a[c] + s * b[c];
}

// y += X x
template <int size>
void add_product(Known<size>, const double* X, const double* x, double* y) {
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
inline void add_product(int size, const double* X, const double* x, double* y) {
    for (int r = 0; r < size; ++r) y[r] += product(size, X + r * size, x);
}

// y += X' x
template <int size>
void add_transposed_product(Known<size>, const double* X, const double* x, double* y) {
    Pairs<size> sum(y);
    for (int r = 0; r < size; ++r, X += size) {
        const Pair factor{x[r], x[r]};
        for (int c = 0; c < size; c += 2) sum.at[c / 2] = sum.at[c / 2] + factor * pair_at(X + c);
    }
    for (int c = 0; c < size; c += 2) put_pair(sum.at[c / 2], y + c);
}
inline void add_transposed_product(int size, const double* X, const double* x, double* __restrict y) {
    for (int r = 0; r < size; ++r) {
        for (int c = 0; c < size; ++c) y[c] += x[r] * X[r * size + c];
    }
}

// y += X x with a symmetric X, of which each row holds at least the pairs from the diagonal on.
template <int size>
void add_symmetric_product(Known<size>, const double* X, const double* x, double* y) {
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
inline void add_symmetric_product(int size, const double* X, const double* x, double* y) {
    add_transposed_product(size, X, x, y);
}

// The pairs that a matrix of a known size holds: all, or those from the diagonal on if it is symmetric.
enum class Kept { all, upper };

// X - u l' + own, in one pass where the size is known, since the next body needs it.
template <Kept kept, int size, int r = 0, class Own>
void replace(Known<size> width, const double* u, const Pairs<size>& l, const Own& own, double* X) {
    if constexpr (r < size) {
        const Pair factor{u[r], u[r]};
        for (int c = kept == Kept::upper ? r & ~1 : 0; c < size; c += 2)
            put_pair(own.plus(pair_at(X + c) - factor * l.at[c / 2], r, c), X + c);
        replace<kept, size, r + 1>(width, u, l, own, X + size);
    }
}
template <Kept kept, int size, class Own>
void subtract_outer(Known<size> width, const double* u, const double* l, const Own& own, double* X) {
    replace<kept>(width, u, Pairs<size>(l), own, X);
}
template <Kept, class Own>
void subtract_outer(int size, const double* u, const double* l, const Own&, double* __restrict X) {
    for (int r = 0; r < size; ++r) {
        for (int c = 0; c < size; ++c) X[r * size + c] -= u[r] * l[c];
    }
}

// The matrix of an inertia, in pairs along its rows.
struct InertiaRows {
    explicit InertiaRows(const Inertia<double>& I)
        : at{{{I.mass, 0.0}, {0.0, 0.0}, {I.moment.z, -I.moment.y}},
             {{0.0, I.mass}, {0.0, -I.moment.z}, {0.0, I.moment.x}},
             {{0.0, 0.0}, {I.mass, I.moment.y}, {-I.moment.x, 0.0}},
             {{0.0, -I.moment.z}, {I.moment.y, I.second.xx}, {I.second.xy, I.second.xz}},
             {{I.moment.z, 0.0}, {-I.moment.x, I.second.xy}, {I.second.yy, I.second.yz}},
             {{-I.moment.y, I.moment.x}, {0.0, I.second.xz}, {I.second.yz, I.second.zz}}} {}
    Pair at[6][3];
};

// Adds s I to a part of a matrix with rows of length `stride`.
inline void add_inertia(double s, const InertiaRows& I, int stride, double* x) {
    const Pair scale{s, s};
    for (int r = 0; r < 6; ++r, x += stride) {
        for (int c = 0; c < 3; ++c) put_pair(pair_at(x + 2 * c) + scale * I.at[r][c], x + 2 * c);
    }
}

// What a body adds to the matrix that it passes on: its inertia, once in a matrix of six entries or ten, or with the
// factors 1, c, c, -k in one of twelve; for each of several stages, with a weight.
template <class Inertia>
struct OwnInertia {
    Inertia inertia;  // of a stage, as InertiaRows
    int stages = 1;
    const double* weight = nullptr;  // (stages), null for 1
    int stride = 6;                  // entries of a stage
    double c = 0.0, k = 0.0;         // of twelve entries

    Pair plus(Pair rest, int r, int e) const {
        const double factor = r < 6 && e < 6 ? 1.0 : r >= 6 && e >= 6 ? -k : c;
        if (stride != 12) return r < 6 && e < 6 ? rest + first.at[r][e / 2] : rest;
        return rest + Pair{factor, factor} * first.at[r % 6][e % 6 / 2];
    }
    void add(double* X, int width) const {
        for (int s = 0; s < stages; ++s) {
            const double b = weight ? weight[s] : 1.0;
            const InertiaRows I = inertia(s);
            double* block = X + stride * s * (width + 1);
            add_inertia(b, I, width, block);
            if (stride != 12) continue;
            add_inertia(-b * k, I, width, block + 6 * (width + 1));
            if (c == 0.0) continue;
            add_inertia(b * c, I, width, block + 6);
            add_inertia(b * c, I, width, block + 6 * width);
        }
    }
    InertiaRows first = inertia(0);
};
template <class Inertia>
OwnInertia(Inertia, int, const double*, int, double, double) -> OwnInertia<Inertia>;

// What a coordinate that several bodies share adds of its own.
struct NoInertia {
    Pair plus(Pair rest, int, int) const { return rest; }
};

// Joints above an origin are prismatic: they need only linear parts, which are independent of the reference point.
// Set the entries that are no linear parts to zero, among the first `size`; the linear parts are the first three
// entries of every `part`.
inline void keep_linear(int size, int part, double* z) {
    for (int r = 0; r < size; ++r) {
        if (r % part >= 3) z[r] = 0.0;
    }
}
inline void keep_linear_rows(int size, int part, int width, double* X) {
    for (int r = 0; r < width; ++r) {
        if (r < size && r % part >= 3) {
            std::fill(X + r * width, X + (r + 1) * width, 0.0);
        } else {
            keep_linear(size, part, X + r * width);
        }
    }
}
// Set `size` rows and columns from `at` on to zero after elimination of their coordinate, to reuse the slot.
inline void clear_slot(int at, int size, int width, double* X) {
    std::fill(X + at * width, X + (at + size) * width, 0.0);
    for (int r = 0; r < width; ++r) std::fill(X + r * width + at, X + r * width + at + size, 0.0);
}

}  // namespace varpin::detail
