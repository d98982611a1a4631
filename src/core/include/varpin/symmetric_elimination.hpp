// Elimination (elimination.hpp) of a symmetric matrix, and of M alone. docs/mathematics.md, "Linear in the number of
// joints".
#pragma once

#include <algorithm>
#include <vector>

#include "varpin/elimination_rows.hpp"
#include "varpin/jet.hpp"
#include "varpin/mechanism.hpp"

namespace varpin {

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
