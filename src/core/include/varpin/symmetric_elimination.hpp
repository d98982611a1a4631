// Elimination (elimination.hpp) of a symmetric matrix with rows of any size, also in trees with ties.
// docs/mathematics.md, "Linear in the number of joints".
#pragma once

#include <algorithm>
#include <memory>
#include <utility>
#include <vector>

#include "varpin/gathering.hpp"
#include "varpin/tree.hpp"

namespace varpin {

namespace detail {

// Functions of vectors of even size.
inline double product(int size, const double* a, const double* b) {
    double even = 0.0, odd = 0.0;
    for (int c = 0; c < size; c += 2) {
        even += a[c] * b[c];
        odd += a[c + 1] * b[c + 1];
    }
    return even + odd;
}
inline void add_scaled(int size, double factor, const double* a, double* __restrict b) {
    for (int c = 0; c < size; ++c) b[c] += factor * a[c];
}
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

inline int even(int size) { return size + size % 2; }

}  // namespace detail

// u = X row + u0, D = d + row . u, and X - u u' / D is passed to the parent. Rows have `size` entries, six for each
// motion, and then one for each slot of ties. A body with a tied coordinate passes X, with u added to the row and
// column of the slot, and row . u and twice the slot's entry of u added to its diagonal.
class SymmetricElimination {
  public:
    SymmetricElimination(const Tree& tree, const std::shared_ptr<const Gathering>& order, int size)
        : tree_(&tree),
          order_(order),
          size_(size),
          width_(detail::even(size + order->ties.slots)),
          u_(width_),
          row_(width_ * tree.size()),
          answer_(width_ * tree.size()),
          pivot_(tree.dof()),
          matrix_(order, width_ * width_),
          force_(order, width_),
          motion_(width_ * (tree.size() + 1)) {}

    // To be written before body j is eliminated, (size) each: its row, and u0 plus the part of u from its own inertia.
    double* row(int j) { return row_.data() + width_ * j; }
    double* u() { return u_.data(); }

    // Eliminate body j, from the last body to the first; false at a pivot that is not positive. `add_own` adds the
    // body's own inertias to X, given the length of its rows.
    template <class AddOwn>
    bool eliminate(int j, const double* diagonal, const AddOwn& add_own) {
        const Body& link = tree_->bodies[j];
        const Ties& ties = order_->ties;
        double* X = matrix_.of(j);
        std::fill(u_.begin() + size_, u_.end(), 0.0);
        for (int r = 0; r < width_; ++r) detail::add_scaled(width_, row(j)[r], X + r * width_, u_.data());
        const double along_axis = detail::product(width_, row(j), u_.data());
        const int slot = ties.slot[link.coordinate];
        if (slot < 0) {
            if (!take_out(link.coordinate, j, diagonal[link.coordinate] + along_axis, X)) return false;
            if (link.parent < 0 && ties.slots == 0) return true;
        } else {
            const int at = size_ + slot;
            for (int r = 0; r < width_; ++r) X[r * width_ + at] += u_[r];
            detail::add_scaled(width_, 1.0, u_.data(), X + at * width_);
            X[at * width_ + at] += along_axis;
        }
        add_own(X, width_);
        if (!take_out_ties(j, diagonal, X)) return false;
        if (link.origin) detail::keep_linear_rows(size_, 6, width_, X);
        matrix_.hand_on(j, link.parent);
        return j > 0 || ties.slots == 0 || take_out_ties(-1, diagonal, matrix_.of_ground());
    }

    double pivot(int coordinate) const { return pivot_[coordinate]; }

    // x with the matrix times x = b, and shares of 1/2 b . x, as in ArticulatedBodies.
    void solve(const double* b, double* x, double* share) {
        const auto substitute = [&](int c, int body, double left, double* z) {
            x[c] = left / pivot_[c];
            if (share) share[c] = 0.5 * left * x[c];
            detail::add_scaled(width_, left, answer(body), z);
        };
        const auto substitute_ties = [&](int j, double* z) {
            for (const Ties::Tied& tied : order_->ties.ending(j)) {
                double& tied_force = z[size_ + tied.slot];
                substitute(tied.coordinate, tied.body, b[tied.coordinate] - tied_force, z);
                tied_force = 0.0;
            }
        };
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            double* z = force_.of(j);
            const double along = detail::product(width_, row(j), z);
            const int c = link.coordinate, slot = order_->ties.slot[c];
            if (slot < 0) {
                substitute(c, j, b[c] - along, z);
            } else {
                z[size_ + slot] += along;
            }
            substitute_ties(j, z);
            if (link.origin) detail::keep_linear(size_, 6, z);
            force_.hand_on(j, link.parent);
        }
        if (order_->ties.slots > 0) substitute_ties(-1, force_.of_ground());
        move_ties(-1, motion_.data(), x);
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const double* above = motion_.data() + width_ * (link.parent + 1);
            double* moved = motion_.data() + width_ * (j + 1);
            std::copy(above, above + width_, moved);
            move_ties(j, moved, x);
            const int c = link.coordinate;
            if (order_->ties.slot[c] < 0) x[c] -= detail::product(width_, answer(j), moved);
            detail::add_scaled(width_, x[c], row(j), moved);
        }
    }

  private:
    double* answer(int j) { return answer_.data() + width_ * j; }

    // Eliminate coordinate c with its u and D; `solve` needs u / D, which is stored with body j.
    bool take_out(int c, int j, double pivot, double* X) {
        pivot_[c] = pivot;
        if (!(pivot > 0.0)) return false;
        const double inverse = 1.0 / pivot;
        for (int r = 0; r < width_; ++r) {
            answer(j)[r] = u_[r] * inverse;
            detail::add_scaled(width_, -answer(j)[r], u_.data(), X + r * width_);
        }
        return true;
    }

    bool take_out_ties(int j, const double* diagonal, double* X) {
        for (const Ties::Tied& tied : order_->ties.ending(j)) {
            const int at = size_ + tied.slot, c = tied.coordinate;
            std::copy(X + at * width_, X + (at + 1) * width_, u_.begin());
            const double pivot = diagonal[c] + u_[at];
            u_[at] = 0.0;
            if (!take_out(c, tied.body, pivot, X)) return false;
            detail::clear_slot(at, 1, width_, X);
        }
        return true;
    }

    // In the order opposite to elimination.
    void move_ties(int j, double* moved, double* x) {
        const std::vector<Ties::Tied>& ending = order_->ties.ending(j);
        for (auto tied = ending.rbegin(); tied != ending.rend(); ++tied) {
            x[tied->coordinate] -= detail::product(width_, answer(tied->body), moved);
            moved[size_ + tied->slot] = x[tied->coordinate];
        }
    }

    const Tree* tree_;
    std::shared_ptr<const Gathering> order_;
    int size_, width_;
    std::vector<double> u_;
    std::vector<double> row_, answer_;  // (b, width) row, and u / D
    std::vector<double> pivot_;         // (n)
    detail::Gathered matrix_, force_;
    std::vector<double> motion_;  // (b + 1, width) of each body, after a zero for the base
};

}  // namespace varpin
