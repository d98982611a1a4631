// Elimination (elimination.hpp) of a symmetric matrix, also in trees with mimic joints; and M alone.
// docs/mathematics.md, "Linear in the number of joints".
#pragma once

#include <algorithm>
#include <memory>
#include <optional>
#include <type_traits>
#include <vector>

#include "varpin/elimination_rows.hpp"
#include "varpin/jet.hpp"
#include "varpin/mechanism.hpp"
#include "varpin/subtree_sums.hpp"

namespace varpin {

// u = X row + u0, D = d + row . u, and X - u u' / D is passed to the parent. Rows have `size` entries, six for each
// motion, and then one for each slot of mimic joints. A body with a mimic coordinate passes X, with u added to the row
// and column of the slot, and row . u and twice the slot's entry of u added to its diagonal. A width is known where
// there are no mimic joints.
template <class Width>
class SymmetricElimination {
  public:
    SymmetricElimination(const Tree& tree, const std::shared_ptr<const SubtreeOrder>& order, int size)
        : tree_(&tree),
          order_(order),
          size_(size),
          width_(detail::even(size + order->mimics.slots)),
          matrix_(order, width_ * width_),
          force_(order, width_) {}

    // To be written before body j is eliminated, (size) each: its row, and u0 plus the part of u from its own inertia.
    double* row(int j) { return row_.data() + width_ * j; }
    double* u() { return u_.data(); }

    // Eliminate body j, from the last body to the first; false at a pivot that is not positive. `own` adds the
    // body's own inertias to X.
    template <class Own>
    bool eliminate(int j, const double* diagonal, const Own& own) {
        const Body& link = tree_->bodies[j];
        double* X = matrix_.of(j);
        std::fill(u_.begin() + size_, u_.end(), 0.0);
        detail::add_symmetric_product(width_, X, row(j), u_.data());
        const double along_axis = detail::product(width_, row(j), u_.data());
        const int slot = slot_of(link.coordinate);
        if (slot < 0) {
            const bool last = link.parent < 0 && slots() == 0;
            if (!take_out(link.coordinate, j, diagonal[link.coordinate] + along_axis, own, last ? nullptr : X))
                return false;
            if (last) return true;
        } else {
            const int at = size_ + slot;
            for (int r = 0; r < width_; ++r) X[r * width_ + at] += u_[r];
            detail::write_sum(width_, X + at * width_, 1.0, u_.data(), X + at * width_);
            X[at * width_ + at] += along_axis;
        }
        if constexpr (std::is_same_v<Width, int>) own.add(X, width_);
        if (!take_out_mimics(j, diagonal, X)) return false;
        if (link.origin) detail::keep_linear_rows(size_, 6, width_, X);
        matrix_.hand_on(j, link.parent);
        return j > 0 || slots() == 0 || take_out_mimics(-1, diagonal, matrix_.of_ground());
    }

    // D of a coordinate: for M, its inertia with its subtree free [kg m^2 or kg].
    double pivot(int coordinate) const { return pivot_[coordinate]; }

    // x with the matrix times x = b; x may be b. `share`, unless null, receives the terms of 1/2 b . x, which are not
    // negative: left^2 / (2 D), with `left` the remainder of b_i when the subtree of coordinate i is free.
    void solve(const double* b, double* x, double* share) {
        const auto substitute = [&](int c, int body, double left, double* z) {
            x[c] = left / pivot_[c];
            if (share) share[c] = 0.5 * left * x[c];
            detail::write_sum(width_, z, left, answer(body), z);
        };
        const auto substitute_mimics = [&](int j, double* z) {
            for (const Mimics::Mimic& mimic : order_->mimics.ending(j)) {
                double& mimic_force = z[size_ + mimic.slot];
                substitute(mimic.coordinate, mimic.body, b[mimic.coordinate] - mimic_force, z);
                mimic_force = 0.0;
            }
        };
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            double* z = force_.of(j);
            const double along = detail::product(width_, row(j), z);
            const int c = link.coordinate, slot = slot_of(c);
            if (slot < 0) {
                substitute(c, j, b[c] - along, z);
            } else {
                z[size_ + slot] += along;
            }
            if (slots() > 0) substitute_mimics(j, z);
            if (link.origin) detail::keep_linear(size_, 6, z);
            force_.hand_on(j, link.parent);
        }
        if (slots() > 0) substitute_mimics(-1, force_.of_ground()), move_mimics(-1, motion_.data(), x);
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const double* above = motion_.data() + width_ * (link.parent + 1);
            double* moved = motion_.data() + width_ * (j + 1);
            if (slots() > 0) {
                std::copy(above, above + width_, moved);
                move_mimics(j, moved, x);
                above = moved;
            }
            const int c = link.coordinate;
            if (slot_of(c) < 0) x[c] -= detail::product(width_, answer(j), above);
            detail::write_sum(width_, above, x[c], row(j), moved);
        }
    }

  private:
    double* answer(int j) { return answer_.data() + width_ * j; }
    int slots() const { return std::is_same_v<Width, int> ? order_->mimics.slots : 0; }
    int slot_of(int coordinate) const { return std::is_same_v<Width, int> ? order_->mimics.slot[coordinate] : -1; }

    // Eliminate coordinate c with its u and D; `solve` needs u / D, which is stored with body j.
    template <class Own>
    bool take_out(int c, int j, double pivot, const Own& own, double* X) {
        pivot_[c] = pivot;
        if (!(pivot > 0.0)) return false;
        const double inverse = 1.0 / pivot;
        for (int r = 0; r < width_; ++r) answer(j)[r] = u_[r] * inverse;
        if (X) detail::subtract_outer<detail::Kept::upper>(width_, answer(j), u_.data(), own, X);
        return true;
    }

    bool take_out_mimics(int j, const double* diagonal, double* X) {
        if (slots() == 0) return true;
        for (const Mimics::Mimic& mimic : order_->mimics.ending(j)) {
            const int at = size_ + mimic.slot, c = mimic.coordinate;
            std::copy(X + at * width_, X + (at + 1) * width_, u_.begin());
            const double pivot = diagonal[c] + u_[at];
            u_[at] = 0.0;
            if (!take_out(c, mimic.body, pivot, detail::NoInertia{}, X)) return false;
            detail::clear_slot(at, 1, width_, X);
        }
        return true;
    }

    // In the order opposite to elimination.
    void move_mimics(int j, double* moved, double* x) {
        const std::vector<Mimics::Mimic>& ending = order_->mimics.ending(j);
        for (auto mimic = ending.rbegin(); mimic != ending.rend(); ++mimic) {
            x[mimic->coordinate] -= detail::product(width_, answer(mimic->body), moved);
            moved[size_ + mimic->slot] = x[mimic->coordinate];
        }
    }

    const Tree* tree_;
    std::shared_ptr<const SubtreeOrder> order_;
    int size_;
    Width width_;
    std::vector<double> u_ = zeros(width_);
    std::vector<double> row_ = zeros(width_, tree_->size()), answer_ = zeros(width_, tree_->size());  // row, and u / D
    std::vector<double> pivot_ = zeros(tree_->dof());
    detail::SubtreeSums matrix_, force_;
    std::vector<double> motion_ = zeros(width_, tree_->size() + 1);  // of each body, after a zero for the base
};

// The factors of M + diag(armature) at consecutive configurations: the articulated body algorithm (Featherstone 2008).
class ArticulatedBodies {
  public:
    explicit ArticulatedBodies(const Tree& tree) : tree_(&tree), inertia_(tree.size()) {
        const auto order = std::make_shared<const SubtreeOrder>(tree);
        if (order->mimics.slots > 0) {
            mimic_.emplace(tree, order, 6);
        } else {
            free_.emplace(tree, order, 6);
        }
    }

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
        detail::write(axis, free_ ? free_->row(j) : mimic_->row(j));
    }

    // Eliminate body j, from the last body to the first; false at a pivot that is not positive.
    bool eliminate(int j) { return free_ ? eliminate_in(*free_, j) : eliminate_in(*mimic_, j); }

    // As SymmetricElimination's.
    void solve(const double* b, double* x, double* share) {
        return free_ ? free_->solve(b, x, share) : mimic_->solve(b, x, share);
    }

  private:
    const Tree* tree_;
    std::vector<Inertia<double>> inertia_;
    std::optional<SymmetricElimination<Known<6>>> free_;
    std::optional<SymmetricElimination<int>> mimic_;  // for coordinates that move several bodies

    // Here and in step_elimination.hpp, the attribute `flatten` inlines all calls in the loop over bodies, which saves
    // a tenth of a step.
    template <class Matrix>
    [[gnu::flatten]] bool eliminate_in(Matrix& matrix, int j) {
        detail::write(inertia_[j] * detail::motion_at(matrix.row(j)), matrix.u());
        const auto inertia = [&](int) { return detail::InertiaRows(inertia_[j]); };
        return matrix.eliminate(j, tree_->armature.data(), detail::OwnInertia{inertia, 1, nullptr, 6, 0.0, 0.0});
    }
};

}  // namespace varpin
