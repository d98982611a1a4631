// Elimination (elimination.hpp) for collocation with several stages. docs/mathematics.md, "Linear in the number of
// joints". A joint has one unknown for each stage, and
//
//     N_im = delta_im M_i + h (a_im A_i - abar_im A_m') - h^2 sum_c abar_ic a_cm L_qq,c + diag(d_im)
//
// is a sum over stages c of the form in elimination.hpp, with
//
//     row_i = (delta_ic S - h abar_ic W, h abar_ic S(angular))_c      u0_m = h a_cm (S x* H, g x (Y S)(linear))_c
//     column_m = (delta_cm S + h a_cm W, h a_cm S(angular))_c         l0_i = -h abar_ic (S x* H, -g x (Y S)(linear))_c
//
// each with nine entries for each c; D is a matrix (s, s).
// Equations (E1), (E2), (E3) and (E4) of docs/mathematics.md.
#pragma once

#include <algorithm>
#include <limits>
#include <memory>
#include <vector>

#include "varpin/dense.hpp"
#include "varpin/elimination.hpp"
#include "varpin/gathering.hpp"
#include "varpin/jet.hpp"
#include "varpin/spatial.hpp"
#include "varpin/symmetric_elimination.hpp"
#include "varpin/tableau.hpp"
#include "varpin/tree.hpp"

namespace varpin {

// The matrix of a step with several stages, the sum over stages of (E1) and (E2): factored and solved with by (E3).
class StageElimination {
  public:
    static constexpr int most_stages = 16;

    StageElimination(const Mechanism& mechanism, const Tableau& tableau)
        : StageElimination(mechanism, tableau, std::make_shared<Gathering>(mechanism.tree)) {}

    // Set the state of stage c from its sweep of first order.
    void take(int c, const Jet<double>& jet) {
        for (int j = 0; j < tree_->size(); ++j) state_[j * stages_ + c] = EliminatedBody::of(*mechanism_, j, jet);
    }

    // Factor N with diagonals d (s, s, n), armature included; false if its determinant, or with one stage a pivot, is
    // not positive.
    bool factor(double h, const double* diagonal) {
        h_ = h;
        diagonal_ = diagonal;
        sign_ = 1;
        for (int j = tree_->size() - 1; j >= 0 && sign_ != 0; --j) eliminate(j);
        if (ties().slots > 0) eliminate_ties(-1, matrix_.of_ground());
        return sign_ > 0;
    }

    // x with N x = b, both (s, n).
    void solve(const double* b, double* x) {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            double* z = force_.of(j);
            const int c = link.coordinate, slot = ties().slot[c];
            double* kept = slot < 0 ? small_.data() : z + at(slot);
            if (slot < 0) std::fill(small_.begin(), small_.end(), 0.0);
            for (int i = 0; i < stages_; ++i) kept[i] += detail::product(width_, factors(j).row + i * width_, z);
            if (slot < 0) substitute(c, j, b, z, x);
            if (link.parent < 0 && ties().slots == 0) continue;
            substitute_ties(j, b, z, x);
            if (link.origin) detail::keep_linear(bodies_, 9, z);
            force_.hand_on(j, link.parent);
        }
        if (ties().slots > 0) substitute_ties(-1, b, force_.of_ground(), x);
        move_ties(-1, x);
        for (int j = 0; j < tree_->size(); ++j) {
            const Body& link = tree_->bodies[j];
            const double* above = motion(link.parent);
            double* moved = motion(j);
            std::copy(above, above + width_, moved);
            move_ties(j, x);
            if (ties().slot[link.coordinate] < 0) find(link.coordinate, j, moved, x);
            for (int m = 0; m < stages_; ++m)
                detail::add_scaled(width_, x[m * tree_->dof() + link.coordinate], factors(j).column + m * width_,
                                   moved);
        }
    }

    // y_c = A_c' x_c + L_qq,c h sum_m a_cm x_m, (s, n), for the x of the last `solve`.
    void change_of_slope(const double* x, double* y) {
        const int n = tree_->dof();
        std::fill(y, y + stages_ * n, 0.0);
        for (int j = tree_->size() - 1; j >= 0; --j) {
            const Body& link = tree_->bodies[j];
            double* z = force_.of(j);
            for (int c = 0; c < stages_; ++c) {
                const EliminatedBody& state = state_[j * stages_ + c];
                const double *moved = motion(j) + 9 * c, *above = motion(link.parent) + 9 * c;
                double rate_of_x = 0.0;
                for (int m = 0; m < stages_; ++m)
                    rate_of_x += h_ * tableau_->a[c * stages_ + m] * x[m * n + link.coordinate];
                y[c * n + link.coordinate] += state.change_of_slope(rate_of_x, moved, above, z + 9 * c);
            }
            if (link.parent < 0) continue;
            if (link.origin) detail::keep_linear(bodies_, 9, z);
            force_.hand_on(j, link.parent);
        }
    }

    // sum_c b_c x_c' M_c x_c, armature included.
    double kinetic_size(const double* x) {
        double total = 0.0;
        for (int c = 0; c < stages_; ++c) {
            const double* x_stage = x + c * tree_->dof();
            double size = 0.0;
            for (int j = 0; j < tree_->size(); ++j) {
                const Body& link = tree_->bodies[j];
                const EliminatedBody& state = state_[j * stages_ + c];
                twist_[j] = x_stage[link.coordinate] * state.axis;
                if (link.parent >= 0) twist_[j] += twist_[link.parent];
                size += dot(twist_[j], state.inertia * twist_[j]);
            }
            for (int k = 0; k < tree_->dof(); ++k) size += tree_->armature[k] * x_stage[k] * x_stage[k];
            total += tableau_->b[c] * size;
        }
        return total;
    }

    // The smallest ratio of a pivot of M + c (A + A') - k L_qq + diag(d) to the same pivot of M, armature included, all
    // averaged over the stages with b; 0 if one is not positive. The factors of `factor` are kept.
    double least_pivot_ratio(double coupling, double k, const double* diagonal) {
        for (int j = tree_->size() - 1; j >= 0; --j) {
            for (int c = 0; c < stages_; ++c) {
                const EliminatedBody& state = state_[j * stages_ + c];
                const double b = tableau_->b[c];
                const Force<double> by_axis = state.inertia * state.axis,
                                    by_rate = state.inertia * state.rate + state.turned;
                detail::write(state.axis, masses_.row(j) + 6 * c);
                detail::write(b * by_axis, masses_.u() + 6 * c);
                detail::write(state.axis, curved_.row(j) + 12 * c);
                detail::write(state.rate, curved_.row(j) + 12 * c + 6);
                detail::write(b * (by_axis + coupling * by_rate + Force<double>{{}, k * state.lifted}),
                              curved_.u() + 12 * c);
                detail::write(b * (coupling * by_axis + (-k) * by_rate), curved_.u() + 12 * c + 6);
            }
            const auto add_masses = [&](double* X, int width) {
                for (int c = 0; c < stages_; ++c)
                    detail::add_inertia(tableau_->b[c], inertia(j, c), width, X + 6 * c * (width + 1));
            };
            const auto add_curved = [&](double* X, int width) {
                for (int c = 0; c < stages_; ++c) {
                    const double b = tableau_->b[c];
                    double* block = X + 12 * c * (width + 1);
                    detail::add_inertia(b, inertia(j, c), width, block);
                    detail::add_inertia(-b * k, inertia(j, c), width, block + 6 * (width + 1));
                    if (coupling == 0.0) continue;
                    detail::add_inertia(b * coupling, inertia(j, c), width, block + 6);
                    detail::add_inertia(b * coupling, inertia(j, c), width, block + 6 * width);
                }
            };
            if (!masses_.eliminate(j, tree_->armature.data(), add_masses)) return 0.0;
            if (!curved_.eliminate(j, diagonal, add_curved)) return 0.0;
        }
        double least = std::numeric_limits<double>::infinity();
        for (int c = 0; c < tree_->dof(); ++c) least = std::min(least, curved_.pivot(c) / masses_.pivot(c));
        return least;
    }

  private:
    // Factors of one body: (s, width), and the inverse of D (s, s). l is multiplied by this inverse. u, l and D of a
    // tied coordinate are stored with the first body that it moves.
    struct Factors {
        double *row, *column, *u, *l, *inverse;
    };

    StageElimination(const Mechanism& mechanism, const Tableau& tableau, const std::shared_ptr<const Gathering>& order)
        : mechanism_(&mechanism),
          tree_(&mechanism.tree),
          tableau_(&tableau),
          stages_(tableau.stages),
          order_(order),
          bodies_(9 * stages_),
          width_(detail::even(bodies_ + stages_ * order->ties.slots)),
          state_(tree_->size() * stages_),
          factors_(tree_->size() * factor_size()),
          matrix_(order, width_ * width_),
          force_(order, width_),
          motion_(width_ * (tree_->size() + 1)),
          twist_(tree_->size()),
          small_(stages_),
          lu_(stages_ * stages_),
          rows_(stages_),
          curved_(*tree_, order, 12 * stages_),
          masses_(*tree_, order, 6 * stages_) {}

    int factor_size() const { return 4 * stages_ * width_ + stages_ * stages_; }
    Factors factors(int j) {
        double* at = factors_.data() + j * factor_size();
        const int size = stages_ * width_;
        return {at, at + size, at + 2 * size, at + 3 * size, at + 4 * size};
    }
    double* motion(int j) { return motion_.data() + width_ * (j + 1); }

    const Ties& ties() const { return order_->ties; }
    int at(int slot) const { return bodies_ + slot * stages_; }
    detail::InertiaRows inertia(int j, int c) const { return detail::InertiaRows(state_[j * stages_ + c].inertia); }

    void eliminate(int j) {
        const Body& link = tree_->bodies[j];
        const Factors factors_here = factors(j);
        write_rows(j, factors_here);
        double* X = matrix_.of(j);
        for (int r = 0; r < width_; ++r) {
            const double* line = X + r * width_;
            for (int m = 0; m < stages_; ++m) {
                factors_here.u[m * width_ + r] += detail::product(width_, line, factors_here.column + m * width_);
                detail::add_scaled(width_, factors_here.row[m * width_ + r], line, factors_here.l + m * width_);
            }
        }
        for (int i = 0; i < stages_; ++i) {
            for (int m = 0; m < stages_; ++m)
                lu_[i * stages_ + m] =
                    detail::product(width_, factors_here.row + i * width_, factors_here.u + m * width_);
        }
        const int slot = ties().slot[link.coordinate];
        if (slot < 0) {
            take_out(link.coordinate, factors_here, X);
            if (sign_ == 0 || (link.parent < 0 && ties().slots == 0)) return;
        } else {
            for (int m = 0; m < stages_; ++m) {
                for (int r = 0; r < width_; ++r) X[r * width_ + at(slot) + m] += factors_here.u[m * width_ + r];
            }
            for (int i = 0; i < stages_; ++i) {
                double* line = X + (at(slot) + i) * width_;
                detail::add_scaled(width_, 1.0, factors_here.l + i * width_, line);
                detail::add_scaled(stages_, 1.0, &lu_[i * stages_], line + at(slot));
            }
        }
        for (int k = 0; k < stages_; ++k) detail::add_inertia(1.0, inertia(j, k), width_, X + 9 * k * (width_ + 1));
        eliminate_ties(j, X);
        if (link.origin) detail::keep_linear_rows(bodies_, 9, width_, X);
        matrix_.hand_on(j, link.parent);
    }

    // Add the bodies of mimic joints that end at body j to X, and eliminate their coordinates, (E4).
    void eliminate_ties(int j, double* X) {
        for (const Ties::Tied& tied : ties().ending(j)) {
            if (sign_ == 0) return;
            const Factors factors_here = factors(tied.body);
            const int slot = at(tied.slot);
            for (int i = 0; i < stages_; ++i) {
                const double* line = X + (slot + i) * width_;
                std::copy(line + slot, line + slot + stages_, &lu_[i * stages_]);
                std::copy(line, line + width_, factors_here.l + i * width_);
                for (int r = 0; r < width_; ++r) factors_here.u[i * width_ + r] = X[r * width_ + slot + i];
            }
            for (int i = 0; i < stages_; ++i) {
                for (double* x : {factors_here.u, factors_here.l}) std::fill_n(x + i * width_ + slot, stages_, 0.0);
            }
            take_out(tied.coordinate, factors_here, X);
            detail::clear_slot(slot, stages_, width_, X);
        }
    }

    // Eliminate coordinate c with its u, l and D, to which its diagonal is added; updates sign_ by that of det D.
    void take_out(int c, const Factors& factors_here, double* X) {
        for (int k = 0; k < stages_ * stages_; ++k) lu_[k] += diagonal_[k * tree_->dof() + c];
        const int sign = factor_lu_pivoting(lu_.data(), stages_, rows_.data());
        sign_ = stages_ == 1 ? std::max(sign, 0) : sign_ * sign;
        if (sign_ == 0) return;
        invert(factors_here.inverse);
        for (int r = 0; r < width_; ++r) {
            for (int i = 0; i < stages_; ++i) small_[i] = factors_here.l[i * width_ + r];
            for (int m = 0; m < stages_; ++m) {
                double total = 0.0;
                for (int i = 0; i < stages_; ++i) total += factors_here.inverse[m * stages_ + i] * small_[i];
                factors_here.l[m * width_ + r] = total;
            }
        }
        for (int r = 0; r < width_; ++r) {
            for (int m = 0; m < stages_; ++m)
                detail::add_scaled(width_, -factors_here.u[m * width_ + r], factors_here.l + m * width_,
                                   X + r * width_);
        }
    }

    // t = D^-1 (b - small_) of coordinate c into x; adds u t to z.
    void substitute(int c, int body, const double* b, double* z, double* x) {
        const int n = tree_->dof();
        const Factors factors_here = factors(body);
        for (int i = 0; i < stages_; ++i) small_[i] = b[i * n + c] - small_[i];
        for (int m = 0; m < stages_; ++m) {
            double t = 0.0;
            for (int i = 0; i < stages_; ++i) t += factors_here.inverse[m * stages_ + i] * small_[i];
            x[m * n + c] = t;
            detail::add_scaled(width_, t, factors_here.u + m * width_, z);
        }
    }
    void substitute_ties(int j, const double* b, double* z, double* x) {
        for (const Ties::Tied& tied : ties().ending(j)) {
            double* kept = z + at(tied.slot);
            std::copy(kept, kept + stages_, small_.begin());
            substitute(tied.coordinate, tied.body, b, z, x);
            std::fill(kept, kept + stages_, 0.0);
        }
    }

    // x = t - l . w_parent
    void find(int c, int body, const double* above, double* x) {
        for (int m = 0; m < stages_; ++m)
            x[m * tree_->dof() + c] -= detail::product(width_, factors(body).l + m * width_, above);
    }
    // In the order opposite to elimination.
    void move_ties(int j, double* x) {
        const std::vector<Ties::Tied>& ending = ties().ending(j);
        for (auto tied = ending.rbegin(); tied != ending.rend(); ++tied) {
            find(tied->coordinate, tied->body, motion(j), x);
            for (int m = 0; m < stages_; ++m) motion(j)[at(tied->slot) + m] = x[m * tree_->dof() + tied->coordinate];
        }
    }

    // Rows and columns of body j, and the parts of u and l from its own inertia.
    void write_rows(int j, const Factors& factors_here) const {
        for (int i = 0; i < stages_; ++i) {
            for (int c = 0; c < stages_; ++c) {
                const EliminatedBody& state = state_[j * stages_ + c];
                const double there = i == c ? 1.0 : 0.0;
                const double ahead = h_ * tableau_->a[c * stages_ + i];
                const double behind = h_ * tableau_->gradient[i * stages_ + c];
                const int at = i * width_ + 9 * c;
                const Motion<double> row = there * state.axis + (-behind) * state.rate;
                const Motion<double> column = there * state.axis + ahead * state.rate;
                detail::write(row, behind * state.axis.angular, factors_here.row + at);
                detail::write(column, ahead * state.axis.angular, factors_here.column + at);
                detail::write(state.inertia * column + ahead * state.turned, ahead * state.lifted, factors_here.u + at);
                detail::write(state.inertia * row + (-behind) * state.turned, behind * state.lifted,
                              factors_here.l + at);
            }
            for (double* x : {factors_here.row, factors_here.column, factors_here.u, factors_here.l})
                std::fill(x + i * width_ + bodies_, x + (i + 1) * width_, 0.0);
        }
    }

    // The inverse (s, s) of the matrix whose factors are in lu_.
    void invert(double* inverse) {
        for (int m = 0; m < stages_; ++m) {
            double column[most_stages], unit[most_stages] = {};
            unit[m] = 1.0;
            solve_lu_pivoting(lu_.data(), stages_, rows_.data(), unit, column);
            for (int i = 0; i < stages_; ++i) inverse[i * stages_ + m] = column[i];
        }
    }

    const Mechanism* mechanism_;
    const Tree* tree_;
    const Tableau* tableau_;
    int stages_;
    std::shared_ptr<const Gathering> order_;
    int bodies_;                         // nine entries for each stage
    int width_;                          // plus one for each stage and slot of ties, rounded up to an even number
    std::vector<EliminatedBody> state_;  // (b, s)
    std::vector<double> factors_;
    detail::Gathered matrix_, force_;
    std::vector<double> motion_;  // (b + 1, width) for the x of `solve`, after a zero for the base
    std::vector<Motion<double>> twist_;
    std::vector<double> small_, lu_;
    std::vector<int> rows_;
    SymmetricElimination curved_, masses_;
    double h_ = 0.0;
    int sign_ = 0;
    const double* diagonal_ = nullptr;
};

}  // namespace varpin
