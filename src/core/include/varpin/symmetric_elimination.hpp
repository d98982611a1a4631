// Elimination (elimination.hpp) of a symmetric matrix, and of M alone, by pairs of numbers: sizes are even.
// docs/mathematics.md, "Linear in the number of joints".
#pragma once

#include <algorithm>
#include <vector>

#include "varpin/jet.hpp"
#include "varpin/mechanism.hpp"
#include "varpin/simd.hpp"
#include "varpin/spatial.hpp"

namespace varpin {

namespace detail {

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

}  // namespace detail

// What bodies pass to their parents during elimination, `entries` numbers each, from the last body to the first. Cells
// of storage are reused: a chain needs one, which stays in the cache.
class SubtreeSums {
  public:
    SubtreeSums(const Tree& tree, int entries)
        : entries_(entries), cell_(tree.size(), -1), joins_(tree.size(), 0), leaf_(tree.size(), 1) {
        int cells = 0;
        std::vector<int> free;
        for (int j = tree.size() - 1; j >= 0; --j) {
            if (cell_[j] < 0) {
                if (free.empty()) free.push_back(cells++);
                cell_[j] = free.back();
                free.pop_back();
            }
            const int k = tree.bodies[j].parent;
            if (k >= 0 && cell_[k] < 0) {
                cell_[k] = cell_[j];
                leaf_[k] = 0;
                continue;
            }
            joins_[j] = k >= 0;
            free.push_back(cell_[j]);
        }
        at_.resize(cells * entries);
    }

    // The sum of the children of body j.
    double* of(int j) {
        double* entries = at(j);
        if (leaf_[j]) std::fill(entries, entries + entries_, 0.0);
        return entries;
    }
    // Pass the contribution of body j to its parent.
    void hand_on(int j, int parent) {
        if (!joins_[j]) return;
        const double* entries = at(j);
        double* __restrict up = at(parent);
        for (int k = 0; k < entries_; ++k) up[k] += entries[k];
    }

  private:
    int entries_;
    std::vector<int> cell_;    // of each body; a first child has the cell of its parent
    std::vector<char> joins_;  // has a cell of its own, which is added to that of its parent
    std::vector<char> leaf_;   // has no children: its cell is empty
    std::vector<double> at_;

    double* at(int j) { return at_.data() + cell_[j] * entries_; }
};

// u = X row + u0, D = d + row . u, and X - u u' / D is passed to the parent, (E3). Rows have six entries for each
// motion.
template <int size>
class SymmetricElimination {
  public:
    explicit SymmetricElimination(const Tree& tree) : tree_(&tree), matrix_(tree, size * size), force_(tree, size) {}

    // To be written before body j is eliminated: its row, and u0 plus the part of u from its own inertia.
    double* row(int j) { return row_.data() + size * j; }
    double* u() { return u_; }

    // Eliminate body j, from the last body to the first; false at a pivot that is not positive.
    bool eliminate(int j, const double* diagonal, const detail::OwnInertia<size>& own) {
        const Body& link = tree_->bodies[j];
        double* X = matrix_.of(j);
        detail::add_symmetric_product<size>(X, row(j), u_);
        const double pivot = diagonal[link.coordinate] + detail::product<size>(row(j), u_);
        pivot_[link.coordinate] = pivot;
        if (!(pivot > 0.0)) return false;
        const double inverse = 1.0 / pivot;
        for (int r = 0; r < size; ++r) answer(j)[r] = u_[r] * inverse;
        if (link.parent < 0) return true;
        detail::replace<detail::Kept::upper>(answer(j), detail::Pairs<size>(u_), own, X);
        if (link.origin) detail::keep_linear_rows<size, 6>(X);
        matrix_.hand_on(j, link.parent);
        return true;
    }

    // D of a coordinate: for M, its inertia with its subtree free [kg m^2 or kg].
    double pivot(int coordinate) const { return pivot_[coordinate]; }

    // x with the matrix times x = b; x may be b. `share`, unless null, receives the terms of 1/2 b . x, which are not
    // negative: left^2 / (2 D), with `left` the remainder of b_i when the subtree of coordinate i is free.
    void solve(const double* b, double* x, double* share) {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            double* z = force_.of(j);
            const int c = link.coordinate;
            const double left = b[c] - detail::product<size>(row(j), z);
            x[c] = left / pivot_[c];
            if (share) share[c] = 0.5 * left * x[c];
            detail::write_sum<size>(z, left, answer(j), z);
            if (link.origin) detail::keep_linear<size, 6>(z);
            force_.hand_on(j, link.parent);
        }
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const double* above = motion_.data() + size * (link.parent + 1);
            x[link.coordinate] -= detail::product<size>(answer(j), above);
            detail::write_sum<size>(above, x[link.coordinate], row(j), motion_.data() + size * (j + 1));
        }
    }

  private:
    double* answer(int j) { return answer_.data() + size * j; }

    const Tree* tree_;
    double u_[size] = {};
    std::vector<double> row_ = zeros(size, tree_->size()), answer_ = row_;  // row, and u / D, which `solve` needs
    std::vector<double> pivot_ = zeros(tree_->dof());
    SubtreeSums matrix_, force_;
    std::vector<double> motion_ = zeros(size, tree_->size() + 1);  // of each body, after a zero for the base
};

// The factors of M + diag(armature) at consecutive configurations: the articulated body algorithm (Featherstone 2008).
class ArticulatedBodies {
  public:
    explicit ArticulatedBodies(const Tree& tree) : tree_(&tree), inertia_(tree.size()), matrix_(tree) {}

    // Factor M at q, with potential energies in `jet`; false at a pivot that is not positive.
    bool at(const Mechanism& mechanism, const double* q, Jet<double>& jet) {
        const auto visit = [&](int j) { set_body(j, tree_->bodies[j].ratio * jet.body[j].axis, jet.body[j].inertia); };
        inertias(mechanism, q, jet, visit, [](int) {});
        for (int j = tree_->size() - 1; j >= 0; --j) {
            if (!eliminate(j)) return false;
        }
        return true;
    }

    // Set the axis and the inertia of body j alone.
    void set_body(int j, const Motion<double>& axis, const Inertia<double>& inertia) {
        inertia_[j] = inertia;
        detail::write(axis, matrix_.row(j));
    }

    // Eliminate body j, from the last body to the first; false at a pivot that is not positive. Here and below, the
    // attribute inlines all calls in the loop over bodies, which saves a tenth of a step.
    [[gnu::flatten]] bool eliminate(int j) {
        detail::write(inertia_[j] * detail::motion_at(matrix_.row(j)), matrix_.u());
        return matrix_.eliminate(j, tree_->armature.data(), detail::OwnInertia<6>(inertia_[j]));
    }

    // As SymmetricElimination's.
    void solve(const double* b, double* x, double* share) { matrix_.solve(b, x, share); }

  private:
    const Tree* tree_;
    std::vector<Inertia<double>> inertia_;
    SymmetricElimination<6> matrix_;
};

}  // namespace varpin
